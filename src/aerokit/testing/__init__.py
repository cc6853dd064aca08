"""For tests of programs that use aerokit: an event loop on virtual time. Nothing in aerokit imports this."""

from __future__ import annotations

from .clock import VIRTUAL_BACKEND, DeadlockError, VirtualClockLoop, run_virtual

__all__ = ["VIRTUAL_BACKEND", "DeadlockError", "VirtualClockLoop", "run_virtual"]
