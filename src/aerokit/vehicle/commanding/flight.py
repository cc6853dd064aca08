"""Taking off and coming back to the ground."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import anyio

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit.errors import CommandRejected, NotSupported, OperationRejected, OperationTimeout
from aerokit.mavlink.enums import MavLandedState
from aerokit.position import Position
from aerokit.vehicle.commanding.arbiter import MODE_GRACE_S
from aerokit.vehicle.commanding.context import Part
from aerokit.vehicle.commanding.progress import LONGEST_SILENCE_S, OLD_POSITION_S, Stillness, await_progress

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.autopilots import TakeOff
    from aerokit.vehicle.commanding.order import Order

IN_THE_AIR: dict[int | None, str] = {
    MavLandedState.IN_AIR: "in the air",
    MavLandedState.TAKEOFF: "taking off",
    MavLandedState.LANDING: "landing",
}
"""MAV_LANDED_STATE."""

FLYING_M = 2.0
"""So far above home, who says nothing of it is taken to fly."""

RISEN_M = 0.5
"""Who is so much higher than before has obeyed an order to take off."""

MODE_TIMEOUT_S = 6.0

SURFACE_M = 1.5
"""Who is deeper below home has not surfaced, but was given another mode on the way: home is at the surface."""


@checks_arguments
class FlightActions(Part):
    """Take-off, landing, return."""

    async def take_off(
        self,
        altitude_m: float,
        *,
        timeout: float = 60.0,
        max_silence_s: float | None = LONGEST_SILENCE_S,
    ) -> None:
        """Take off and climb to ``altitude_m`` above home; returns at that altitude.

        The vehicle must be armed. Where the autopilot needs its guided mode for this, it is put into it. Cancelled
        half-way, or when it does not get there in time, the vehicle is told to hold where it is.

        Args:
            altitude_m: metres above home, above 0, at most 10,000.
            timeout: seconds until it is there.
            max_silence_s: give up when no heartbeat has come for so many seconds; None: wait on, however long.

        Raises:
            InvalidArgument: the altitude is out of range. Nothing was sent.
            NotSupported: this type of vehicle cannot take off.
            OperationRejected: it is not armed or flies already, it refused, or its mode changed or it disarmed on the
                way.
            CommandTimeout: there was no answer.
            HeartbeatTimeout: the vehicle has been silent for ``max_silence_s`` seconds.
            OperationTimeout: it did not get there in time, or does not move.
            ValueUnknownError: home is not known, and PX4 needs its altitude.
        """
        check_range("altitude_m", altitude_m, 0, 10_000, above=True)
        plan = self._take_off_plan(altitude_m)
        if not self.telemetry.is_armed:
            raise OperationRejected("take_off: the vehicle is not armed: arm() comes first; nothing was sent")
        landed = self.telemetry.landed_state
        flies = landed.latest in (MavLandedState.IN_AIR, MavLandedState.LANDING)
        if flies and landed.age <= OLD_POSITION_S:  # its mode alone would end a landing
            raise OperationRejected(
                f"take_off: the vehicle flies already ({IN_THE_AIR[landed.latest]}): go_to() climbs too;"
                " nothing was sent"
            )
        modes = (
            plan.mode,
            plan.mode_after,
            self.autopilot.mode_for("take_off", is_vtol=self.telemetry.is_vtol),
        )
        order = self._arbiter.order(*(mode for mode in modes if mode is not None))
        try:
            await self._begin_take_off(plan, order)
            with self._holding.flying(order):
                await self._await_altitude(altitude_m, timeout, max_silence_s, order)
        except (anyio.get_cancelled_exc_class(), OperationTimeout):  # it may have heard the order
            self._holding.hold_soon(order)
            raise
        except CommandRejected as error:
            raise self._with_state(error) from error

    def _with_state(self, error: CommandRejected) -> CommandRejected:
        """What the vehicle leaves unsaid when it is asked to take off in the air."""
        state, altitude = IN_THE_AIR.get(self.telemetry.landed_state.latest), self._where.altitude_relative()
        if state is None and not altitude > FLYING_M:
            return error
        height = f", {altitude:.1f} m above home" if altitude > -math.inf else ""
        why = f"it is {state or 'in the air, it seems'}{height}: it takes off from the ground only; go_to() climbs, too"
        explained = CommandRejected(f"{error}", command=error.command, result=error.result, reasons=(why,))
        explained.reasons = (*error.reasons, why)
        return explained

    def _take_off_plan(self, altitude_m: float) -> TakeOff:
        home = self._where.home_altitude() if self.autopilot.take_off_needs_home() else None
        plan = self.autopilot.take_off(altitude_m, home, is_vtol=self.telemetry.is_vtol)
        if plan is None:
            raise NotSupported(f"take_off: {self.autopilot.firmware} cannot take off")
        return plan

    async def _begin_take_off(self, plan: TakeOff, order: Order) -> None:
        if plan.mode is not None:
            await self._sender.ensure_mode(plan.mode, order)
        if plan.command is not None:
            is_rising = self._rises_from_here()
            with self._talk.streaming("position", "landed_state"):
                await self._sender.give(
                    order,
                    self._talk.commands.send_long,
                    plan.command,
                    *plan.params,
                    modes=order.modes,
                    is_done=is_rising,
                )

    def _rises_from_here(self) -> Callable[[], bool]:
        """Whether it rises, by what it tells from now on: what it told before may be of its last flight."""
        here, landed = self.telemetry.position.latest, self.telemetry.landed_state
        begins_at = math.nan if here is None else self._where.altitude_relative()
        state_before = landed.latest

        def is_rising() -> bool:
            is_told = landed.latest != state_before and landed.latest in (
                MavLandedState.IN_AIR,
                MavLandedState.TAKEOFF,
            )
            return is_told or self._where.altitude_relative() > begins_at + RISEN_M

        return is_rising

    async def _await_altitude(
        self, altitude_m: float, timeout: float, max_silence_s: float | None, order: Order
    ) -> None:
        """The mode may become the take-off's own and the one after it; any other one is somebody else's doing."""
        enough_m = altitude_m - max(0.5, 0.05 * altitude_m)
        started = self.connection.now()

        def is_up() -> bool:
            is_high = self._where.is_known_since(started) and self._where.altitude_relative() >= enough_m
            return is_high and not order.end

        with self._talk.streaming("position"):
            await await_progress(
                self._talk,
                f"take_off({altitude_m:g} m)",
                is_done=is_up,
                trouble=self._sender.stays_in(order, *order.modes),
                describe=lambda: f"it is at {self._where.altitude_relative():.1f} m",
                timeout=timeout,
                max_silence_s=max_silence_s,
                stillness=Stillness(self._talk),
            )

    async def land(
        self, *, timeout: float | None = 300.0, max_silence_s: float | None = LONGEST_SILENCE_S
    ) -> None:
        """Land where the vehicle is; returns on the ground, where the motors may still be turning.

        Follow ``vehicle.armed`` for the motors. Cancelled, the vehicle goes on landing.

        Args:
            timeout: seconds until it is on the ground; None: as long as it takes.
            max_silence_s: give up when no heartbeat has come for so many seconds; None: wait on, however long.

        Raises:
            NotSupported: this type of vehicle has no mode for it. Nothing was sent.
            CommandRejected: the vehicle refused the mode.
            CommandTimeout: there was no answer.
            OperationRejected: the mode changed on the way.
            HeartbeatTimeout: the vehicle has been silent for ``max_silence_s`` seconds.
            OperationTimeout: not on the ground in time.
        """
        mode = self._sender.mode_for("land", "land")
        if self.autopilot.landing_ends_in is None:
            order = self._arbiter.order(mode)
            await self._sender.change_mode(mode, order, told_since=order.given_at)
        else:
            order = self._arbiter.order(mode, self.autopilot.modes.find(self.autopilot.landing_ends_in))
            with self._arbiter.changing_mode():
                # The landing may be over before HEARTBEAT tells its mode.
                await self._sender.request_mode(mode, order, attempt_timeout=min(1.0, MODE_TIMEOUT_S / 4))
        await self._await_ground("land", order, timeout, max_silence_s)

    async def return_to_launch(
        self, *, timeout: float | None = 600.0, max_silence_s: float | None = LONGEST_SILENCE_S
    ) -> None:
        """Return to the launch place; returns on the ground, or above it where the vehicle does not land by itself.

        Raises as :meth:`land`.
        """
        mode = self._sender.mode_for("return_to_launch", "return")
        order = self._arbiter.order(mode)
        await self._sender.change_mode(mode, order, told_since=order.given_at)
        if self.autopilot.lands_after_return:
            await self._await_ground("return_to_launch", order, timeout, max_silence_s)
        else:
            await self._await_home(order, timeout, max_silence_s)

    async def _await_ground(
        self, what: str, order: Order, timeout: float | None, max_silence_s: float | None
    ) -> None:
        """Only what was told after the order counts: a state that had gone stale would end a landing in the air."""
        armed, landed, mode = self.telemetry.armed, self.telemetry.landed_state, self.telemetry.mode
        accepted_at = self.connection.now()

        def is_down() -> bool:
            is_disarmed = self.telemetry.is_surely_disarmed and armed.updated_at > order.given_at
            is_landed = landed.latest == MavLandedState.ON_GROUND and landed.updated_at > order.given_at
            return is_disarmed or is_landed or (is_over() and not is_deep())

        def is_over() -> bool:
            return (
                self.telemetry.mode_name == self.autopilot.landing_ends_in and mode.updated_at > accepted_at
            )

        def is_deep() -> bool:
            return self._where.is_known_since(order.given_at) and self._where.altitude_relative() < -SURFACE_M

        stays = self._sender.stays_in(order, *order.modes)

        def trouble() -> str | None:
            if is_over() and is_deep() and self.connection.now() > accepted_at + MODE_GRACE_S:
                return f"the mode changed to {self.telemetry.mode_name} at {self._where.altitude_relative():.1f} m"
            if order.has_lost_mode and armed.updated_at < order.mode_lost_at:
                return None  # the HEARTBEAT that comes next may tell that it has landed and disarmed
            return stays()

        depth = () if self.autopilot.landing_ends_in is None else ("position",)
        with self._talk.streaming("landed_state", *depth):
            await await_progress(
                self._talk,
                what,
                is_done=is_down,
                trouble=trouble,
                describe=lambda: f"it is at {self._where.altitude_relative():.1f} m",
                timeout=timeout,
                max_silence_s=max_silence_s,
            )

    async def _await_home(self, order: Order, timeout: float | None, max_silence_s: float | None) -> None:
        home = self.telemetry.home.value
        place = Position(home.latitude_deg, home.longitude_deg)
        near_m = self.autopilot.arrival_radius_m
        started = self.connection.now()

        def is_back() -> bool:
            is_near = self._where.is_known_since(started) and self._where.distance_to(place) <= near_m
            return is_near and not order.end

        with self._talk.streaming("position"):
            await await_progress(
                self._talk,
                "return_to_launch",
                is_done=is_back,
                trouble=self._sender.stays_in(order, *order.modes),
                describe=lambda: f"it is {self._where.distance_to(place):.1f} m from home",
                timeout=timeout,
                max_silence_s=max_silence_s,
            )


@checks_arguments
class ModeActions(Part):
    """Changing the flight mode; stopping."""

    async def set_mode(self, mode: str | int, *, timeout: float = 6.0) -> None:
        """Change the flight mode and wait until HEARTBEAT tells it.

        Args:
            mode: a name as the autopilot's own documentation spells it (``"GUIDED"``, ``"POSCTL"``; case does not
                matter), or the number in HEARTBEAT.custom_mode.
            timeout: seconds for the whole of it.

        Sends MAV_CMD_DO_SET_MODE, and SET_MODE to a vehicle that does not know that command
        (https://mavlink.io/en/messages/common.html#MAV_CMD_DO_SET_MODE).

        Raises:
            InvalidArgument: this vehicle has no such mode; the text lists those it has. Nothing was sent.
            CommandRejected: the vehicle refused; ``reasons`` has what it said meanwhile.
            OperationRejected: a pilot or a failsafe has chosen another mode meanwhile.
            OperationTimeout: it accepted and stayed in another mode, or did not answer.
        """
        wanted = self.autopilot.find_mode(mode, self.telemetry.mode_names)
        await self._sender.change_mode(wanted, self._arbiter.order(wanted), timeout)

    async def hold(self) -> None:
        """Stop and stay (a fixed wing circles); returns when HEARTBEAT tells the autopilot's mode for that.

        Copter BRAKE, Plane LOITER, Rover HOLD (a boat LOITER), Sub POSHOLD; PX4 LOITER where it comes to a stop.

        Raises:
            NotSupported: this vehicle has no mode for it. Nothing was sent.
            CommandRejected: the vehicle refused; ``reasons`` has what it said meanwhile.
            OperationRejected: a pilot or a failsafe has chosen another mode meanwhile.
            OperationTimeout: it accepted and stayed in another mode, or did not answer.
        """
        await self._holding.hold()

    @property
    def is_told_to_hold(self) -> bool:
        """Whether a flight was given up, and the order to hold that followed is not confirmed yet."""
        return self._holding.is_told_to_hold

    @property
    def is_flown_by_program(self) -> bool:
        """Whether the vehicle is armed and does what this program has ordered.

        The program has armed it, or has given an order that steers since somebody else did; and no pilot, failsafe or
        other program has taken it from that. False for a vehicle that others fly and that this program only watches.
        """
        return self.telemetry.is_armed and self._arbiter.is_flown_by_program

    @property
    def taken_over(self) -> str:
        """What somebody else has made of the program's last action, as a clause; empty: nothing that was told.

        "the mode changed to LOITER": by a pilot, a failsafe or another program, which HEARTBEAT does not tell apart; or
        "a failsafe became active (MAV_STATE_CRITICAL)", which may come some seconds before the mode changes.
        A vehicle that only disarmed, as after a landing, was not taken over. The program's next action begins anew.
        """
        order = self._arbiter.current or self._arbiter.newest
        if order is None or not order.has_lost_mode:
            return "" if order is None else order.failsafe
        may_have_landed = self.telemetry.landed_state.latest != MavLandedState.IN_AIR
        if may_have_landed and self.telemetry.armed.updated_at < order.mode_lost_at:
            return (
                ""  # PX4 leaves LAND when it disarms: CURRENT_MODE tells that a moment before HEARTBEAT does
            )
        return order.taken_by
