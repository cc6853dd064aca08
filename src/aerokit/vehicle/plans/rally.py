"""``RallyControl``: the rally points that a vehicle holds."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.vehicle.plans.held import HeldPlan

if TYPE_CHECKING:
    from aerokit.missions import RallyPoints

__all__ = ["RallyControl"]


class RallyControl(HeldPlan["RallyPoints"]):
    """``await vehicle.rally.upload(RallyPoints([...]))``: where the vehicle may return to instead of home.

    PX4 calls them safe points, and returns to one of them when RTL_TYPE says so.
    """

    def _plan_type(self) -> type[RallyPoints]:
        from aerokit.missions import RallyPoints

        return RallyPoints
