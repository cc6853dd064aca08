"""What AUTOPILOT_VERSION says (https://mavlink.io/en/messages/common.html#AUTOPILOT_VERSION)."""

from __future__ import annotations

from aerokit.snapshot import Snapshot

__all__ = ["AutopilotVersion", "version_text"]

_KINDS = ((255, ""), (192, "-rc"), (128, "-beta"), (64, "-alpha"), (0, "-dev"))
"""FIRMWARE_VERSION_TYPE: each kind begins at its number."""


class AutopilotVersion(Snapshot):
    """Firmware and hardware of an autopilot.

    ``firmware`` is ``"4.7.0-dev"``, ``number`` its (major, minor, patch) for comparisons, ``git_hash`` the
    beginning of the firmware's commit or an empty text. ``capabilities`` are MAV_PROTOCOL_CAPABILITY bits;
    ``uid`` identifies the hardware, 0 when it is not told.
    """

    firmware: str
    number: tuple[int, int, int]
    git_hash: str
    capabilities: int
    vendor_id: int
    product_id: int
    board_version: int
    uid: int

    def __str__(self) -> str:
        return f"{self.firmware} ({self.git_hash})" if self.git_hash else self.firmware


def version_text(flight_sw_version: int) -> tuple[str, tuple[int, int, int]]:
    """Turn ``flight_sw_version`` into a text and its (major, minor, patch): ``("4.6.1-rc", (4, 6, 1))``."""
    major, minor, patch, kind = flight_sw_version.to_bytes(4, "big")
    suffix = next(text for begin, text in _KINDS if kind >= begin)
    return f"{major}.{minor}.{patch}{suffix}", (major, minor, patch)
