"""What a vehicle said, as people read it: a log may hold the colours that were meant for a terminal."""

from __future__ import annotations

import re

__all__ = ["readable"]

_CONTROL = re.compile(
    r"(?:\x1b\[|\x9b)[0-?]*[ -/]*[@-~]"  # colours and the like (ECMA-48, CSI)
    r"|\x1b\][^\x07\x1b]*(?:\x07|\x1b\\)"  # titles of windows (OSC)
    r"|[\x00-\x08\x0b-\x1f\x7f-\x9f]"  # any other control character but tab and new line
)


def readable(text: str) -> str:
    """``text`` without what only a terminal obeys, and without white space around it: PX4 ends texts with a tab."""
    return _CONTROL.sub("", text).strip()
