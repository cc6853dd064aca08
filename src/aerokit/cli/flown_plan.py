"""``PlanFlight``: a plan on its way: made ready, uploaded, asked about, armed, flown, and brought to an end."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import TYPE_CHECKING

from aerokit import events
from aerokit.cli.asking import agrees
from aerokit.cli.exits import DONE, FAILED, INTERRUPTED
from aerokit.cli.output import tell
from aerokit.cli.plans import upload_parts
from aerokit.errors import (
    AerokitError,
    CommandRejected,
    HeartbeatTimeout,
    NotSupported,
    OperationRejected,
    OperationTimeout,
)
from aerokit.mavlink.enums import MavLandedState
from aerokit.runtime.link_state import SILENT_AFTER_S
from aerokit.vehicle.orders.late_arming import LATE_S

if TYPE_CHECKING:
    import argparse
    from collections.abc import Awaitable, Callable
    from typing import Literal

    from aerokit.cli.demo_lines import FlightReport
    from aerokit.cli.interrupt import Interruptible
    from aerokit.missions import MissionItem, Plan
    from aerokit.vehicle.vehicle import Vehicle

__all__ = ["ON_INTERRUPT", "PlanFlight"]

ON_INTERRUPT: dict[str, str] = {
    "return": "returning to launch",
    "land": "landing here",
    "hold": "holding here",
    "nothing": "it is left to itself",
}
"""What ``--on-interrupt`` takes, and what is said then."""
DISARMS_WITHIN_S = 30.0
FAR_M = 1000.0


class PlanFlight:
    """Flies a plan on a vehicle, and says what becomes of it.

    Nothing is ordered of a vehicle that was armed before, or whose mode somebody else has changed since.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        plan: Plan,
        report: FlightReport,
        interruptible: Interruptible,
        options: argparse.Namespace,
    ) -> None:
        self._vehicle, self._plan, self._options = vehicle, plan, options
        self._report, self._say, self._interruptible = report, report.say, interruptible
        self.is_ours: bool = False
        """Whether it was told to arm by us."""
        self._may_arm_late = False  # the order to arm has not come to its end
        self._has_started = False
        self._modes_armed_in: set[str] = set()

    async def fly(self) -> int:
        """Fly it to its end, and return the exit code; what ends it otherwise is raised, once it is safe or left."""
        try:
            code = await self._interruptible.run(self._fly)
        except Exception as error:  # whatever it is, what stands armed by our doing is not left so
            self._say(f"failed: {error}")
            if self.is_ours:
                await self._come_to_rest(self._after_failure)
            raise
        if code is None:
            self._say(f"interrupted, {self._vehicle.describe_now()}")
            if self.is_ours:
                await self._come_to_rest(self._after_interrupt)
            return INTERRUPTED
        return code

    # ------------------------------------------------------------------------------ as it should go

    async def _fly(self) -> int:
        vehicle = self._vehicle
        self._say(f"found {vehicle.autopilot.firmware}, system {vehicle.system_id}")
        self._check_vehicle()
        await upload_parts(vehicle, self._plan, self._options)
        held = await self._held_mission() if self._asks else ()
        self._say("waiting until it is ready")
        await vehicle.wait_ready(timeout=self._options.ready)
        for warning in self._warnings():
            self._say(f"  ! {warning}")
        if not await self._is_agreed():
            self._say("not flown: nobody agreed")
            return FAILED
        self._check_disarmed()  # the question may have stood for long
        if self._asks and await self._held_mission() != held:
            raise OperationRejected(
                "the vehicle holds another mission than the one asked about; nothing was started"
            )
        await self._arm()
        following = asyncio.create_task(self._follow())
        try:
            self._say("armed; starting the mission")
            await vehicle.mission.start()
            self._has_started = True
            await vehicle.mission.wait_finished()
        finally:
            following.cancel()
            with suppress(asyncio.CancelledError):
                await following
        return await self._finish()

    async def _held_mission(self) -> tuple[MissionItem, ...]:
        return tuple((await self._vehicle.mission.download(patience_s=self._options.patience)).items)

    async def _arm(self) -> None:
        self._check_disarmed()
        self.is_ours = self._may_arm_late = True
        self._say("arming")
        self._modes_armed_in.add(self._vehicle.mode_name)
        try:
            await self._vehicle.arm()
        except CommandRejected:
            self._may_arm_late = False
            raise
        self._may_arm_late = False
        self._modes_armed_in.add(self._vehicle.mode_name)

    def _check_vehicle(self) -> None:
        vehicle, wanted = self._vehicle, self._options.on_interrupt
        self._check_disarmed()
        possible = [each for each in ON_INTERRUPT if each == "nothing" or self._has_mode_for(each)]
        if wanted not in possible:
            raise NotSupported(
                f"{vehicle.autopilot.firmware} cannot do what Ctrl-C is to do, {wanted!r}: choose --on-interrupt"
                f" {' or '.join(possible)}; nothing was sent"
            )
        self._plan.mission.check(home_is_item_0=vehicle.autopilot.home_is_item_0)

    def _has_mode_for(self, purpose: str) -> bool:
        mode_for, is_vtol = self._vehicle.autopilot.mode_for, self._vehicle.is_vtol
        modes = {
            "return": mode_for("return", is_vtol=is_vtol),
            "land": mode_for("land", is_vtol=is_vtol),
            "hold": mode_for("hold", is_vtol=is_vtol),
        }
        return modes[purpose] is not None

    def _check_disarmed(self) -> None:
        now = self._vehicle.describe_now()
        if self._vehicle.heartbeat_age > SILENT_AFTER_S:
            raise HeartbeatTimeout(f"whether somebody has armed it is not known ({now}); nothing was started")
        if not self._vehicle.is_surely_disarmed:
            raise OperationRejected(f"it is left to whoever armed it ({now}); nothing was started")

    def _warnings(self) -> list[str]:
        items, warnings = self._plan.mission.items, []
        place = next((item.position for item in items if item.position is not None), None)
        if place is not None:
            distance = self._vehicle.distance_to(place)
            if distance > FAR_M:
                warnings.append(f"the first place of the mission is {distance / 1000:.1f} km away")
        if not any(part in items[-1].name for part in ("LAND", "RETURN_TO_LAUNCH")):
            warnings.append("the mission does not end with a landing: the vehicle stays where it ends")
        return warnings

    @property
    def _asks(self) -> bool:
        return not (self._options.sim or self._options.yes)

    async def _is_agreed(self) -> bool:
        if not self._asks:
            return True
        vehicle = self._vehicle
        name = f"{vehicle.autopilot.firmware}, system {vehicle.system_id}"
        self._report.shows_life = False
        try:
            return await agrees(f"arm {name}, and fly {len(self._plan.mission)} items?")
        finally:
            self._report.shows_life = True

    async def _follow(self) -> None:
        """Say which item it goes for."""
        with (
            self._vehicle.subscribe(
                events.MissionCurrentChanged, events.MissionItemReached, capacity=100
            ) as news,
            suppress(AerokitError),
        ):
            async for event in news:
                if isinstance(event, events.MissionItemReached):
                    self._say(f"item {event.item} reached")
                elif isinstance(event, events.MissionCurrentChanged) and event.after is not None:
                    self._say(f"on to item {event.after}{self._name_of(event.after)}")

    def _name_of(self, index: int) -> str:
        items = self._plan.mission.items
        return f" of {len(items)}, {items[index].name}" if index < len(items) else ""

    async def _finish(self) -> int:
        vehicle = self._vehicle
        if vehicle.landed_state.latest == MavLandedState.ON_GROUND:
            with suppress(OperationTimeout):
                await vehicle.armed.wait_until(lambda armed: not armed, timeout=DISARMS_WITHIN_S)
        self._say(f"the mission is finished, {vehicle.describe_now()}")
        tell(self._options, "flown", {"system_id": vehicle.system_id, "armed": vehicle.is_armed}, None)
        return DONE

    # --------------------------------------------------------------------------------- otherwise

    async def _come_to_rest(self, action: Callable[[], Awaitable[int]]) -> None:
        """A second Ctrl-C, and whatever fails now, leaves it to itself."""
        try:
            if await self._interruptible.run(action) is None:
                self._say(f"interrupted again: left {self._vehicle.describe_now()}")
        except AerokitError as error:
            self._say(f"that failed, too: {error}")
            self._say(f"left {self._vehicle.describe_now()}")

    async def _after_failure(self) -> int:
        """Switch off what stands on the ground by our doing; what flies is left to its mission, pilot or failsafe."""
        vehicle = self._vehicle
        if vehicle.is_surely_disarmed:
            await self._watch_late_arming()
        elif self._stands_armed and self._is_in_our_mode:
            await self._disarm()
        else:
            self._say(f"no order is given: left {vehicle.describe_now()}")
        return DONE

    async def _after_interrupt(self) -> int:
        vehicle, wanted = self._vehicle, self._options.on_interrupt
        if vehicle.is_surely_disarmed:
            await self._watch_late_arming()
            return DONE
        if not self._is_left_to_us():
            return DONE
        if self._stands_armed and wanted != "nothing":
            try:
                await self._disarm()
            except CommandRejected as error:  # it has left the ground since it told where it is
                self._say(f"it does not disarm: {error}")
            if vehicle.is_surely_disarmed or not self._is_left_to_us():
                return DONE
        self._say(
            ON_INTERRUPT[wanted] + ("" if wanted == "nothing" else "; Ctrl-C again to leave it to itself")
        )
        if wanted == "return":
            await vehicle.return_to_launch(timeout=None)
        elif wanted == "land":
            await vehicle.land(timeout=None)
        elif wanted == "hold":
            await vehicle.hold()
        if wanted in ("return", "land") and vehicle.landed_state.latest == MavLandedState.ON_GROUND:
            with suppress(OperationTimeout):
                await vehicle.armed.wait_until(lambda armed: not armed, timeout=DISARMS_WITHIN_S)
        self._say(vehicle.describe_now())
        return DONE

    def _is_left_to_us(self) -> bool:
        if not self._is_in_our_mode:
            now = self._vehicle.describe_now()
            self._say(f"no order is given, for it does not fly the mission now: left {now}")
        return self._is_in_our_mode

    async def _watch_late_arming(self) -> None:
        """An order to arm that was given up may still arrive: while we are connected, it is disarmed then."""
        if not self._may_arm_late:
            return
        self._say(
            f"the order to arm may still be carried out: watched for {LATE_S:g} s, and disarmed if it arms;"
            " Ctrl-C again to leave it"
        )
        armed = self._vehicle.armed
        with suppress(OperationTimeout):
            await armed.wait_until(bool, timeout=LATE_S)
            await armed.wait_until(lambda armed: not armed, timeout=DISARMS_WITHIN_S)
        self._say(self._vehicle.describe_now())

    async def _disarm(self) -> None:
        self._say("on the ground and armed; disarming")
        await self._vehicle.disarm()
        self._say("disarmed")

    @property
    def _stands_armed(self) -> bool:
        return self._vehicle.is_armed and self._vehicle.landed_state.latest == MavLandedState.ON_GROUND

    @property
    def _is_in_our_mode(self) -> bool:
        """Whether it flies the mission, or has not begun to: nobody else has changed its mode.

        A landing or a return is none of ours to end, be it the mission's own last item or a failsafe's.
        """
        vehicle = self._vehicle
        purposes: tuple[Literal["mission", "hold"], ...] = ("mission",)
        if not self._has_started:
            if vehicle.mode_name in self._modes_armed_in:
                return True
            purposes = ("mission", "hold")  # a start that was given up ends in holding
        modes = [vehicle.autopilot.mode_for(each, is_vtol=vehicle.is_vtol) for each in purposes]
        return vehicle.mode_name in [mode.name for mode in modes if mode is not None]
