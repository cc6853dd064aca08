"""How it stands with a link, or with one vehicle behind it: heard, silent, or gone."""

from __future__ import annotations

import enum

__all__ = ["SILENT_AFTER_S", "LinkState"]

SILENT_AFTER_S = 3.5
"""Three missed heartbeats and a half."""


class LinkState(enum.Enum):
    """Told by ``vehicle.link_state`` and ``connection.link_state``; each change is a ``LinkStateChanged``."""

    CONNECTED = "connected"
    """Something was heard within the last 3.5 seconds: heartbeats of the vehicle, any frame on the link."""
    SILENT = "silent"
    """Nothing was heard for longer; the link itself is there, as far as the system tells."""
    LOST = "lost"
    """The link has gone, or the connection was closed. With ``reconnect=True`` it may be CONNECTED again."""
