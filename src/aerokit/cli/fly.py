"""``aerokit fly``: a plan from a file, flown from the ground to its end."""

from __future__ import annotations

from contextlib import AsyncExitStack
from typing import TYPE_CHECKING

from aerokit.cli.arguments import number, vehicle_kind
from aerokit.cli.asking import is_somebody_there
from aerokit.cli.completers import kinds, offer
from aerokit.cli.demo_lines import FlightReport
from aerokit.cli.exits import INTERRUPTED
from aerokit.cli.flown_plan import PlanFlight
from aerokit.cli.interrupt import Interruptible, on_interrupt
from aerokit.cli.output import add_json, tell
from aerokit.cli.own_flight import ON_INTERRUPT
from aerokit.cli.plans import PARTS, read_plan, tell_items
from aerokit.cli.signing import signing_of
from aerokit.cli.vehicle_command import add_vehicle, default_address, reached
from aerokit.errors import InvalidArgument

if TYPE_CHECKING:
    import argparse

    from aerokit.links.link import Link
    from aerokit.missions import Plan

__all__ = ["add_arguments", "run_fly"]

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
    from aerokit.cli.vehicles import simulated_vehicle
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
