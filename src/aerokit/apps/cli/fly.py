"""``aerokit fly``: a plan from a file, flown from the ground to its end."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack, suppress
from typing import TYPE_CHECKING

from aerokit import events
from aerokit.apps.cli.arguments import number, vehicle_kind
from aerokit.apps.cli.completers import kinds, offer
from aerokit.apps.cli.mission import PARTS, read_plan, tell_items, upload_parts
from aerokit.apps.cli.output import DONE, FAILED, INTERRUPTED, add_json, tell
from aerokit.apps.cli.own_flight import ON_INTERRUPT, FlightReport, OwnFlight
from aerokit.apps.cli.terminal import Interruptible, agrees, is_somebody_there, on_interrupt
from aerokit.apps.cli.vehicle_command import add_vehicle, default_address, reached, signing_of
from aerokit.errors import AerokitError, InvalidArgument, NotSupported, OperationRejected

if TYPE_CHECKING:
    import argparse

    from aerokit.apps.cli.own_flight import Purpose
    from aerokit.missions import MissionItem, Plan
    from aerokit.transport.link import Link
    from aerokit.vehicle.vehicle import Vehicle

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


BOOT_S = 2.0


def add_arguments(command: argparse.ArgumentParser) -> None:
    """The arguments of the command."""
    command.add_argument(
        "file", metavar="FILE", help=".plan (QGroundControl), or a file that begins with QGC WPL 110"
    )
    command.add_argument("--yes", action="store_true", help="do not ask before it is armed")
    command.add_argument(
        "--on-interrupt",
        choices=tuple(ON_INTERRUPT),
        default="return",
        help="what Ctrl-C has the vehicle do in the air; a second one leaves it to itself (return)",
    )
    command.add_argument(
        "--ready",
        type=number(0, 3600),
        default=120.0,
        metavar="S",
        help="wait so long until the vehicle is ready to fly (120)",
    )
    simulated = command.add_argument_group("simulated")
    simulated.add_argument(
        "--sim", action="store_true", help="on a simulated vehicle at the planned home instead; does not ask"
    )
    kind = simulated.add_argument(
        "--vehicle",
        type=vehicle_kind,
        metavar="KIND",
        help="copter, plane, px4 … (what the plan was made for)",
    )
    offer(kind, kinds)
    simulated.add_argument(
        "--speedup", type=number(0.1, 100), default=10.0, metavar="X", help="times real time (10)"
    )
    add_vehicle(command)
    add_json(command)
    command.set_defaults(run=run_fly, connect=None)


async def run_fly(options: argparse.Namespace) -> int:
    """Fly it; 0 when the mission was flown to its end."""
    plan = read_plan(options.file)
    _check_arguments(options, plan)
    for part in PARTS:
        items = getattr(plan, part).to_items()
        if items:
            tell_items(options, part, items, "in the file")
    interruptible, flights = Interruptible(), list[PlanFlight]()
    with on_interrupt(interruptible.interrupt):
        code = await interruptible.run(lambda: _connect_and_fly(options, plan, interruptible, flights))
    if code is None:
        was_armed = any(flight.is_ours for flight in flights)
        tell(options, "interrupted", {}, "interrupted" if was_armed else "interrupted; nothing was armed")
        return INTERRUPTED
    return code


def _check_arguments(options: argparse.Namespace, plan: Plan) -> None:
    if not plan.mission.items:
        raise InvalidArgument(f"{options.file} has no mission items: there is nothing to fly")
    if options.sim and options.connect is not None:
        raise InvalidArgument("--sim and --connect are not allowed together: which vehicle is meant?")
    if options.vehicle is not None and not options.sim:
        raise InvalidArgument("--vehicle is for --sim")
    if not (options.sim or options.yes or is_somebody_there()):
        raise InvalidArgument("nobody is at a terminal to agree, and --yes is not given: nothing was sent")


async def _connect_and_fly(
    options: argparse.Namespace, plan: Plan, interruptible: Interruptible, flights: list[PlanFlight]
) -> int:
    async with AsyncExitStack() as stack:
        link: str | Link = options.connect or default_address()
        if options.sim:
            link = await _simulated(options, plan, stack)
        address = link if isinstance(link, str) else link.address
        if not options.sim:
            tell(options, "connecting", {"address": address}, f"connecting to {address}")
        signing = None if options.sim else signing_of(options)
        vehicle = await stack.enter_async_context(
            reached(options, link, changes=not options.sim, signing=signing)
        )
        report = FlightReport(vehicle, options)
        async with report.running():
            flights.append(PlanFlight(vehicle, plan, report, interruptible, options))
            code = await flights[-1].fly()
        report.print_summary()
    return code


async def _simulated(options: argparse.Namespace, plan: Plan, stack: AsyncExitStack) -> Link:
    """A vehicle of the kind that the plan was made for, where it begins."""
    from aerokit.apps.cli.sim import simulated_vehicle
    from aerokit.sim import simulated_link
    from aerokit.sim.kinds import wait_longer
    from aerokit.sim.local_frame import HOME

    kind = options.vehicle or _kind_for(plan)
    places = [plan.mission.home, *(item.position for item in plan.mission.items)]
    start = next((place for place in places if place is not None), None)
    home = HOME
    if start is not None:
        home = (start.latitude_deg, start.longitude_deg, start.altitude_amsl_m or HOME[2])
    vehicle = simulated_vehicle(kind, home=home, boot_time_s=BOOT_S)
    wait_longer([vehicle], options.speedup)
    link = await stack.enter_async_context(simulated_link(vehicle, speedup=options.speedup))
    record = {"system_ids": [vehicle.system_id], "address": link.address, "speedup": options.speedup}
    text = f"simulated {kind} at {home[0]:.6f}, {home[1]:.6f}, {options.speedup:g} times real time"
    tell(options, "simulated", record, text)
    return link


def _kind_for(plan: Plan) -> str:
    """What flies it here; VTOLs fly as planes."""
    from aerokit.mavlink.enums import MavAutopilot, MavType

    vtols = range(MavType.VTOL_TAILSITTER_DUOROTOR, MavType.VTOL_RESERVED5 + 1)
    is_plane = plan.vehicle_type == MavType.FIXED_WING or plan.vehicle_type in vtols
    if plan.firmware_type == MavAutopilot.PX4:
        return "px4_plane" if is_plane else "px4"
    if is_plane:
        return "plane"
    if plan.vehicle_type in (MavType.GROUND_ROVER, MavType.SURFACE_BOAT):
        return "rover"
    return "sub" if plan.vehicle_type == MavType.SUBMARINE else "copter"
