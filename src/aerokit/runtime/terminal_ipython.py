"""IPython in a terminal: its event loop runs only while a cell runs, so nothing is sent while it waits for input."""

from __future__ import annotations

import asyncio
import sys
from typing import Any

__all__ = ["TERMINAL_IPYTHON", "stands_still_between_inputs"]

TERMINAL_IPYTHON = (
    "IPython in a terminal runs the loop only while a cell runs: type %gui asyncio before you connect,"
    " use aerokit.sync, or keep the whole flight in one cell"
)
"""What is wrong, and what to do."""


def stands_still_between_inputs() -> bool:
    """Whether the running loop is that of IPython in a terminal, and ``%gui asyncio`` was not typed."""
    module = sys.modules.get("IPython.terminal.interactiveshell")
    shell: Any = getattr(getattr(module, "TerminalInteractiveShell", None), "_instance", None)
    if shell is None or getattr(shell, "active_eventloop", None) == "asyncio":
        return False
    helpers = sys.modules.get("IPython.core.async_helpers")
    return asyncio.get_running_loop() is getattr(helpers, "_asyncio_event_loop", None)
