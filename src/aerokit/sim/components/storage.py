"""The memory card of a simulated camera."""

from __future__ import annotations

import base64
from typing import TYPE_CHECKING

from aerokit.mavlink.enums import StorageStatus, StorageType, StorageUsageFlag
from aerokit.mavlink.messages import StorageInformation

if TYPE_CHECKING:
    from aerokit.sim.components.component import SimulatedComponent

__all__ = ["GREY_JPEG", "MemoryCard"]

GREY_JPEG = base64.b85decode(
    "|JeWF01!$>Nk#wx0RR9200961|JwjV02B@n5)Ta&5)cv>6%-gAG9exu93DL^E+jHZKuk+VKt@GST61DhRc%&9Mr4R(ZFhTtf`Lw8jhBpl"
    "mUDiAeE+}z3kU!Z01yEI5di<h02KfM0RR910000000000000000{_GS6c7Ob00000000000000000030+5iXv0RR9$0DvF=*#"
)
"""A picture of 16 × 16 pixels."""

_READ_MIB_S, _WRITE_MIB_S = 90.0, 45.0
_NUMBER = 1


class MemoryCard:
    """Sizes are in MiB. Take it out with ``is_inserted`` False, fill it up with ``used_mib``."""

    def __init__(self, capacity_mib: float) -> None:
        self.capacity_mib = capacity_mib
        self.used_mib: float = 0.0
        self.is_inserted = True

    @property
    def free_mib(self) -> float:
        """0 without a card."""
        return max(0.0, self.capacity_mib - self.used_mib) if self.is_inserted else 0.0

    def store(self, size_mib: float) -> bool:
        """Write so much; False when it does not fit, or there is no card."""
        if size_mib > self.free_mib:
            return False
        self.used_mib += size_mib
        return True

    def format(self) -> None:
        """Forget everything."""
        self.used_mib = 0.0

    def information(self, camera: SimulatedComponent, number: int) -> list[StorageInformation]:
        """STORAGE_INFORMATION of a card by its number; 0 is all, of which there is one."""
        if number not in (0, _NUMBER):
            return []
        here = self.is_inserted
        return [
            StorageInformation(
                time_boot_ms=camera.time_boot_ms,
                storage_id=_NUMBER,
                storage_count=1,
                status=StorageStatus.READY if here else StorageStatus.EMPTY,
                total_capacity=self.capacity_mib if here else 0.0,
                used_capacity=self.used_mib if here else 0.0,
                available_capacity=self.free_mib,
                read_speed=_READ_MIB_S,
                write_speed=_WRITE_MIB_S,
                type=StorageType.MICROSD,
                name="SD",
                storage_usage=StorageUsageFlag.SET | StorageUsageFlag.PHOTO | StorageUsageFlag.VIDEO,
            )
        ]
