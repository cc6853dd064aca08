"""How it stands with a link, or with one vehicle behind it: heard, silent, or gone."""

from __future__ import annotations

import enum

from aerokit.snapshot import Snapshot

__all__ = ["SILENT_AFTER_S", "LinkState", "LinkStatus"]

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


class LinkStatus(Snapshot):
    """How one of several links does: ``connection.links``."""

    link: str
    """Its address."""
    state: LinkState
    """SILENT: nothing of any vehicle has come for a second or two; LOST: it is closed, and opened again if possible."""
    is_costly: bool
    """Whether it is used only when the others fail (``costly=1``)."""
    systems: tuple[int, ...]
    """Which systems were heard over it."""
    used_for: tuple[int, ...]
    """What is for these goes over it, and what they say is taken from it."""
    loss_percent: float | None
    """Frames missing by their numbers in the last seconds, of the system that misses most; None: not known yet."""
    round_trip_s: float | None
    """Seconds from a question (TIMESYNC) to its answer, of the slowest system; None: nothing was answered yet."""
