"""``PlanFlight``: a plan on its way: made ready, uploaded, asked about, armed, flown, and brought to an end."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import TYPE_CHECKING

from aerokit import events
from aerokit.cli.asking import agrees
from aerokit.cli.exits import DONE, FAILED
from aerokit.cli.output import tell
from aerokit.cli.own_flight import ON_INTERRUPT, OwnFlight
from aerokit.cli.plans import upload_parts
from aerokit.errors import AerokitError, NotSupported, OperationRejected

if TYPE_CHECKING:
    import argparse

    from aerokit.cli.demo_lines import FlightReport
    from aerokit.cli.interrupt import Interruptible
    from aerokit.cli.own_flight import Purpose
    from aerokit.missions import MissionItem, Plan
    from aerokit.vehicle.vehicle import Vehicle

__all__ = ["PlanFlight"]

FAR_M = 1000.0


class PlanFlight(OwnFlight):
    """Flies a plan on a vehicle, and says what becomes of it."""

    def __init__(
        self,
        vehicle: Vehicle,
        plan: Plan,
        report: FlightReport,
        interruptible: Interruptible,
        options: argparse.Namespace,
    ) -> None:
        super().__init__(vehicle, report, interruptible, options.on_interrupt)
        self._plan, self._options, self._report = plan, options, report

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
        self._say("arming")
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
        await self._wait_disarmed_on_ground()
        self._say(f"the mission is finished, {vehicle.describe_now()}")
        tell(self._options, "flown", {"system_id": vehicle.system_id, "armed": vehicle.is_armed}, None)
        return DONE

    def _our_purposes(self) -> tuple[Purpose, ...]:
        """A landing or a return is none of ours to end, be it the mission's own last item or a failsafe's."""
        return ("mission",) if self._has_started else ("mission", "hold")  # a start given up ends in holding
