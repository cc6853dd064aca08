"""One flight of the order table by a fleet of three, each on its own disturbed link, and the policy for failures."""

from __future__ import annotations

import asyncio
import math
import random
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator
from contextlib import AsyncExitStack
from dataclasses import dataclass, replace

import anyio
from call_table import Row
from disturbed_link import DisturbedLink, TrafficEntry
from order_cases import Case, random_case
from order_flights import WATCH_S, Flown, Simulated, another_party_acts, go_to_place, set_up, take_over
from order_judge import faults, orders_in
from order_table import ARM, ROWS, SET_MODE

import aerokit
from aerokit.errors import AerokitError
from aerokit.fleets.events import PolicyApplied
from aerokit.fleets.fleet import Fleet
from aerokit.fleets.policy import FleetResult, PolicyName
from aerokit.mavlink import FrameEncoder
from aerokit.mavlink.enums import CopterMode, MavCmd
from aerokit.protocols.command import command_long
from aerokit.sim import SimulatedPx4, simulated_link
from aerokit.testing import run_virtual

AUTOPILOTS = {"a": "ardupilot", "b": "px4", "c": "ardupilot"}
"""Autopilot by network."""
POLICIES: tuple[PolicyName, ...] = ("hold_others", "land_others", "return_others", "continue_others")
OWN = ("BRAKE", "LOITER"), ("LAND", "LAND"), ("RTL", "RTL")
"""Modes that the policies, and stopping, may bring about, on ArduCopter and on PX4."""


async def _go_to(fleet: Fleet) -> FleetResult:
    return await fleet.go_to(lambda member: member.vehicle.position.value.offset(north_m=12.0), timeout=30)


ACTIONS: dict[str, Callable[[Fleet], Awaitable[FleetResult]]] = {
    "hold": lambda fleet: fleet.hold(),
    "land": lambda fleet: fleet.land(),
    "return_to_launch": lambda fleet: fleet.return_to_launch(timeout=40),
    "go_to": _go_to,
    "take_off": lambda fleet: fleet.take_off(6.0, timeout=30),
}
"""Rows of the table that a fleet has as an action of its own."""


@dataclass(frozen=True)
class FleetCase:
    """Events of one flight of a fleet."""

    action: str
    policy: PolicyName
    members: dict[str, Case]
    cancel_at: float | None
    of_others: str = ""
    """The member that another station flies from the start; empty: none."""


def random_fleet_case(action: str, policy: PolicyName, seed: int) -> FleetCase:
    """Draw disturbances, pilot and failsafe for each member; a cancellation concerns all."""
    dice = random.Random(f"a fleet {action} {policy} {seed}")
    members = {}
    for name, autopilot in AUTOPILOTS.items():
        case = random_case(_row(action, autopilot), autopilot, dice.randrange(10_000))
        if dice.random() < 0.4:  # At least one member must be healthy for the policies to matter.
            case = replace(case, pilot_at=None, failsafe_at=None, disturbances=replace(case.disturbances, outage=None))
        members[name] = replace(case, cancel_at=None)
    cancel_at = round(dice.uniform(0.05, 12.0), 2) if dice.random() < 0.2 else None
    of_others = dice.choice(tuple(AUTOPILOTS)) if dice.random() < 0.4 else ""
    return FleetCase(action, policy, members, cancel_at, of_others)


def _row(action: str, autopilot: str) -> Row:
    """Return the row, with the modes of the policies."""
    row = next(entry for entry in ROWS if entry.name == action and autopilot in entry.on)
    copter, px4 = row.modes
    return replace(row, modes=((*copter, *(modes[0] for modes in OWN)), (*px4, *(modes[1] for modes in OWN))))


def faults_of(case: FleetCase) -> list[str]:
    """Fly the case on virtual time; return every rule that was broken, with the member's name."""
    return run_virtual(_fly(case))


async def _fly(case: FleetCase) -> list[str]:
    cases = {name: replace(member, disturbances=replace(member.disturbances)) for name, member in case.members.items()}
    vehicles = {name: set_up(case) for name, case in cases.items()}
    async with AsyncExitStack() as stack:
        paths = {
            name: DisturbedLink(await stack.enter_async_context(simulated_link(vehicle)))
            for name, vehicle in vehicles.items()
        }
        fleet = await stack.enter_async_context(aerokit.fleet(dict(paths), count=len(paths), on_error=case.policy))
        with fleet.events(PolicyApplied) as news:
            flown = await _give(case, cases, vehicles, paths, fleet)
            ordered: list[PolicyApplied] = []
            while isinstance(event := news.get_nowait(), PolicyApplied):
                ordered.append(event)
    found = list(_of_the_policy(case, ordered))
    for name, one in flown.items():
        if name == case.of_others:
            found += [f"{name}: {order.message.NAME} was sent" for order in orders_in(one.traffic)]
            continue
        one.fresh_at = tuple(order_set.at for order_set in ordered if f"{name}/1" in order_set.orders)
        if one.fresh_at and case.policy != "hold_others":
            # The policy's order continues even if the member's call is cancelled.
            one.error = AerokitError("the policy had another order for it")
        found += [f"{name}: {fault}" for fault in faults(one)]
    return found


def _of_the_policy(case: FleetCase, ordered: list[PolicyApplied]) -> Iterator[str]:
    """Return the orders of the policy, one for each member."""
    said = {"hold_others": "hold", "land_others": "land", "return_others": "return"}.get(case.policy)
    reported = [(member, order) for order_set in ordered for member, order in order_set.orders.items()]
    for member, order in reported:
        if order != said:
            yield f"{member}: {case.policy} ordered {order}"
    for member, count in Counter(member for member, _ in reported).items():
        if count > 1:
            yield f"{member}: {case.policy} was ordered {count} times"


async def _give(
    case: FleetCase,
    cases: dict[str, Case],
    vehicles: dict[str, Simulated],
    paths: dict[str, DisturbedLink],
    fleet: Fleet,
) -> dict[str, Flown]:
    loop = asyncio.get_running_loop()
    programs = {name: fleet.members[f"{name}/1"].vehicle for name in vehicles}
    place = next(iter(cases.values())).row.place
    others = case.of_others
    if others:
        await fly_by_another_station(vehicles[others], paths[others])
    own = [name for name in vehicles if name != others]
    await asyncio.gather(*(go_to_place(place, vehicles[name], programs[name]) for name in own))
    given_at = loop.time()
    acted = {}
    for name, member_case in cases.items():
        paths[name].disturbances = member_case.disturbances
        paths[name].begin()
        acted[name] = another_party_acts(member_case, vehicles[name])
    errors: dict[str, BaseException] = {}
    with anyio.CancelScope(deadline=given_at + (case.cancel_at or 1e6)) as scope:
        try:
            result = await ACTIONS[case.action](fleet)
            errors.update({**result.failed, **result.stopped})
        except AerokitError as caught:
            errors.update(dict.fromkeys(fleet.members, caught))
    if scope.cancelled_caught:
        errors.update(dict.fromkeys(fleet.members, asyncio.CancelledError()))
    ended_at = loop.time()
    reported = {name: (program.mode_name or "", program.is_armed) for name, program in programs.items()}
    await anyio.sleep(WATCH_S)
    return {
        name: Flown(
            cases[name],
            vehicles[name],
            Judged(list(paths[name].sent), paths[name].heartbeats),
            given_at,
            ended_at,
            errors.get(f"{name}/1") or _not_compared(acted[name]),
            reported[name],
            acted[name],
        )
        for name in vehicles
    }


async def fly_by_another_station(vehicle: Simulated, path: DisturbedLink) -> None:
    """Arm, take off and fly manually by another station; this program has given no order."""
    station, seconds = FrameEncoder(200, 190), 40.0  # the vehicle boots, and gets its position
    is_px4 = isinstance(vehicle, SimulatedPx4)
    if is_px4:
        vehicle.parameters["MIS_TAKEOFF_ALT"] = 10.0
    height_m = math.nan if is_px4 else 10.0
    steps = [(ARM, (1.0,), 1.5), (MavCmd.NAV_TAKEOFF, (0.0,) * 6 + (height_m,), 12.0)]
    for command, params, then_s in steps if is_px4 else [(SET_MODE, (1.0, CopterMode.GUIDED), 1.5), *steps]:
        await anyio.sleep(seconds)
        path.link.write(station.encode(command_long(vehicle.system_id, 1, command, params)))
        seconds = then_s
    await anyio.sleep(seconds)
    take_over(vehicle)
    await anyio.sleep(1.5)
    assert vehicle.altitude_m > 1.0


def _not_compared(acted: list[tuple[float, str]]) -> BaseException | None:
    """Return an error if another party has acted; the results of the members are not compared then."""
    return AerokitError("another party has acted") if acted else None


@dataclass
class Judged:
    """Traffic until the evaluation; commands sent when the block is left do not belong to this order."""

    sent: list[TrafficEntry]
    heartbeats: list[TrafficEntry]
