"""The classic API of DroneKit-Python 2.9: unmodified programs run."""

from __future__ import annotations
