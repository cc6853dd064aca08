"""Taking off and coming back to the ground."""

from __future__ import annotations

from typing import TYPE_CHECKING

import anyio

from aerokit.errors import LocalProtocolError, NotSupported, OperationRejected
from aerokit.vehicle.progress import await_progress
from aerokit.vehicle.travel import TravelActions
from aerokit.vehicle.values import Position

if TYPE_CHECKING:
    from aerokit.autopilots import Mode, TakeOff

__all__ = ["FlightActions"]

LANDED_ON_GROUND, LANDED_IN_AIR = 1, 2


class FlightActions(TravelActions):
    """Take-off, landing, return."""

    async def take_off(self, altitude_m: float, *, timeout: float = 60.0) -> None:
        """Take off and climb to ``altitude_m`` above home; returns at that altitude.

        The vehicle must be armed. Where the autopilot needs its guided mode for this, it is put into it. Cancelled
        half-way, the vehicle is told to hold where it is.

        Args:
            altitude_m: metres above home, above 0, at most 10,000.
            timeout: seconds until it is there.

        Raises:
            LocalProtocolError: the altitude is out of range. Nothing was sent.
            NotSupported: this type of vehicle cannot take off.
            OperationRejected: it is not armed or flies already, it refused, or its mode changed or it disarmed on the
                way.
            OperationTimeout: it did not get there in time.
        """
        if not 0 < altitude_m <= 10_000:
            raise LocalProtocolError(f"altitude_m = {altitude_m!r} is not allowed: above 0, at most 10,000")
        plan = self._take_off_plan(altitude_m)
        self._supersede_hold()
        if not self.is_armed:
            raise OperationRejected("take_off: the vehicle is not armed: await arm() first; nothing was sent")
        if self.telemetry.landed_state.latest == LANDED_IN_AIR:
            raise OperationRejected(
                "take_off: the vehicle flies already: go_to() climbs too; nothing was sent"
            )
        try:
            await self._begin_take_off(plan)
            await self._await_altitude(altitude_m, plan, timeout)
        except anyio.get_cancelled_exc_class():
            self._hold_soon()
            raise

    def _take_off_plan(self, altitude_m: float) -> TakeOff:
        home = self._home_altitude() if self.autopilot.take_off_needs_home() else None
        plan = self.autopilot.take_off(altitude_m, home, is_vtol=self.is_vtol)
        if plan is None:
            raise NotSupported(f"take_off: {self.autopilot.firmware} cannot take off")
        return plan

    async def _begin_take_off(self, plan: TakeOff) -> None:
        if plan.mode is not None:
            await self._ensure_mode(plan.mode)
        if plan.command is not None:
            await self._explained_command(plan.command, *plan.params)

    async def _await_altitude(self, altitude_m: float, plan: TakeOff, timeout: float) -> None:
        """The mode may become the take-off's own and the one after it; any other one is somebody else's doing."""
        enough_m = altitude_m - max(0.5, 0.05 * altitude_m)
        started = self.connection.now()
        modes = [plan.mode, plan.mode_after, self.autopilot.mode_for("take_off", is_vtol=self.is_vtol)]
        with self._streaming("position"):
            await await_progress(
                self,
                f"take_off({altitude_m:g} m)",
                is_done=lambda: self._knows_position_since(started) and self._altitude_relative() >= enough_m,
                trouble=self._stays_in(*(mode for mode in modes if mode is not None)),
                describe=lambda: f"it is at {self._altitude_relative():.1f} m",
                timeout=timeout,
            )

    async def land(self, *, timeout: float | None = 300.0) -> None:
        """Land where the vehicle is; returns on the ground.

        Raises:
            NotSupported: this type of vehicle has no mode for it. Nothing was sent.
            CommandRejected: the vehicle refused the mode.
            OperationRejected: the mode changed on the way.
            OperationTimeout: not on the ground in time.
        """
        mode = self._mode_for("land", "land")
        await self._ensure_mode(mode)
        await self._await_ground("land", mode, timeout)

    async def return_to_launch(self, *, timeout: float | None = 600.0) -> None:
        """Return to the launch place; returns on the ground, or above it where the vehicle does not land by itself.

        Raises as :meth:`land`.
        """
        mode = self._mode_for("return_to_launch", "return")
        await self._ensure_mode(mode)
        if self.autopilot.lands_after_return:
            await self._await_ground("return_to_launch", mode, timeout)
        else:
            await self._await_home(mode, timeout)

    async def _await_ground(self, what: str, mode: Mode, timeout: float | None) -> None:
        def is_down() -> bool:
            return not self.is_armed or self.telemetry.landed_state.latest == LANDED_ON_GROUND

        await await_progress(
            self,
            what,
            is_done=is_down,
            trouble=self._stays_in(mode),
            describe=lambda: f"it is at {self._altitude_relative():.1f} m",
            timeout=timeout,
        )

    async def _await_home(self, mode: Mode, timeout: float | None) -> None:
        home = self.telemetry.home.value
        place = Position(home.latitude_deg, home.longitude_deg)
        near_m = self.autopilot.arrival_radius_m
        started = self.connection.now()
        with self._streaming("position"):
            await await_progress(
                self,
                "return_to_launch",
                is_done=lambda: self._knows_position_since(started) and self.distance_to(place) <= near_m,
                trouble=self._stays_in(mode),
                describe=lambda: f"it is {self.distance_to(place):.1f} m from home",
                timeout=timeout,
            )
