"""One flight of the order table: a vehicle, an order, disturbances, and another party that acts."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace

import anyio
from device_calls import FITTED
from disturbed_hub import through_hub
from disturbed_link import DisturbedLink, DisturbedPath, RecordedTraffic
from disturbed_link_pair import over_two
from order_cases import Case
from order_table import upload

import aerokit
from aerokit.errors import AerokitError
from aerokit.mavlink.enums import CopterMode
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import GlobalPositionInt
from aerokit.sim import SimulatedCopter, SimulatedPx4, simulated_link
from aerokit.sim.px4.modes import POSITION, RTL
from aerokit.testing import run_virtual
from aerokit.testing.track import true_point
from aerokit.transport import Link

Simulated = SimulatedCopter | SimulatedPx4

RATES: dict[type[Message], float] = {GlobalPositionInt: 4.0}
WATCH_S, WATCH_ARMING_S = 8.0, 18.0
"""Seconds of observation after the order's end, because an arm command may arrive late."""


@dataclass
class Flown:
    """Result of one flight."""

    case: Case
    vehicle: Simulated
    traffic: RecordedTraffic
    given_at: float
    ended_at: float
    error: BaseException | None
    state_at_end: tuple[str, bool]
    """Mode and armed as the program knew them when the call ended."""
    acted: list[tuple[float, str]]
    """Time at which another party acted, on the program's clock, and the mode of the vehicle then."""
    fresh_at: tuple[float, ...] = ()
    """Time at which the policy of a fleet gave a newer order."""

    @property
    def is_armed_at_end(self) -> bool:
        return true_point(self.vehicle).armed


def mode_of(vehicle: Simulated) -> str:
    """The true mode of the vehicle, as programs spell it."""
    return true_point(vehicle).mode


def fly(case: Case) -> Flown:
    """Fly the case on virtual time."""
    return run_virtual(_fly(replace(case, disturbances=replace(case.disturbances))))


async def go_to_place(place: str, vehicle: Simulated, program: aerokit.Vehicle) -> None:
    await program.wait_ready()
    if isinstance(vehicle, SimulatedCopter):
        vehicle.rc[2] = 1000 if place in ("ground", "armed") else 1500
        await program.set_mode("GUIDED")
    if place != "ground":
        await program.arm()
    if place.startswith("air"):
        await program.take_off(10.0)
        await anyio.sleep(1.0)
    if "mission" in place:
        await upload(program)
    if "on its mission" in place:
        await program.mission.start()
    if "by hand" in place:
        take_over(vehicle)
    await anyio.sleep(1.5)


def take_over(vehicle: Simulated) -> None:
    """Turn the pilot's mode switch, with centered sticks."""
    if isinstance(vehicle, SimulatedCopter):
        vehicle.rc[2] = 1500
    turn_switch(vehicle)


def turn_switch(vehicle: Simulated) -> None:
    """Turn the switch to a manually flown mode."""
    if isinstance(vehicle, SimulatedCopter):
        vehicle.set_mode(CopterMode.ALT_HOLD)
    else:
        vehicle.switch_to(POSITION)


def _return(vehicle: Simulated) -> None:
    if isinstance(vehicle, SimulatedCopter):
        vehicle.set_mode(CopterMode.RTL)
    else:
        vehicle.change_mode(RTL)


def run_the_battery_down(vehicle: Simulated) -> None:
    """Trigger a battery failsafe in flight: ArduCopter only warns, PX4 holds first and returns 5 s later."""
    vehicle.battery.percent = 6.0
    if isinstance(vehicle, SimulatedPx4):
        vehicle.parameters["COM_LOW_BAT_ACT"] = 3.0
    else:
        vehicle.parameters["BATT_LOW_MAH"] = vehicle.parameters["BATT_CAPACITY"]


def _act(case: Case, vehicle: Simulated) -> None:
    """Another station disarms a landed vehicle or changes its mode; a pilot takes over a flying one."""
    if case.row.place == "ground":
        if case.by_switch:
            turn_switch(vehicle)
        elif isinstance(vehicle, SimulatedCopter):
            vehicle.arming.disarm()
        else:
            vehicle.arming.disarm("another station")
    else:
        take_over(vehicle)


def another_party_acts(case: Case, vehicle: Simulated) -> list[tuple[float, str]]:
    """Run the events of the case, and record them in :attr:`Flown.acted`."""
    loop = asyncio.get_running_loop()
    acted: list[tuple[float, str]] = []

    def later(at: float | None, act: Callable[[], None]) -> None:
        def happen() -> None:
            act()
            acted.append((loop.time(), mode_of(vehicle)))

        if at is not None:
            loop.call_later(at, happen)

    later(case.pilot_at, lambda: _act(case, vehicle))
    later(case.failsafe_at, lambda: _return(vehicle))
    later(case.state_at, lambda: run_the_battery_down(vehicle))
    return acted


def set_up(case: Case) -> Simulated:
    if case.autopilot == "px4":
        px4 = SimulatedPx4(boot_time_s=1.0)
        px4.parameters["NAV_DLL_ACT"] = 2.0 * case.station_failsafe
        px4.parameters["COM_DISARM_PRFLT"] = 0.0  # a vehicle that stays armed must be noticed
        return px4
    copter = SimulatedCopter(boot_time_s=0.0)
    copter.parameters["FS_GCS_ENABLE"] = 1.0 * case.station_failsafe
    copter.parameters["DISARM_DELAY"] = 0.0
    if case.row.name.startswith("gimbal"):
        copter.parameters["MNT1_TYPE"] = 1.0
    for name, value in FITTED.items():
        copter.parameters[name] = value
    return copter


async def _fly(case: Case) -> Flown:
    vehicle = set_up(case)
    async with (
        _under(case, vehicle) as (path, source),
        aerokit.connect(source, rates=RATES) as program,
    ):
        return await _give(case, vehicle, path, program)


@asynccontextmanager
async def _under(case: Case, vehicle: Simulated) -> AsyncIterator[tuple[DisturbedPath, Link | aerokit.Connection]]:
    """Return the links between program and vehicle."""
    if case.hub is not None:
        async with through_hub(vehicle, case.hub) as through:
            yield through
    elif case.two is not None:
        async with over_two(vehicle, case.two) as over:
            yield over
    else:
        async with simulated_link(vehicle) as link:
            path = DisturbedLink(link)
            yield path, path


async def _give(case: Case, vehicle: Simulated, path: DisturbedPath, program: aerokit.Vehicle) -> Flown:
    loop = asyncio.get_running_loop()
    await go_to_place(case.row.place, vehicle, program)
    path.disturbances = case.disturbances
    path.begin()
    given_at = loop.time()
    acted = another_party_acts(case, vehicle)
    error: BaseException | None = None
    with anyio.CancelScope(deadline=given_at + (case.cancel_at or 1e6)) as scope:
        try:
            await case.row.give(program)
        except AerokitError as caught:
            error = caught
    if scope.cancelled_caught:
        error = asyncio.CancelledError()
    ended_at = loop.time()
    reported = (program.mode_name or "", program.is_armed)
    await anyio.sleep(WATCH_ARMING_S if case.row.name == "arm" else WATCH_S)
    return Flown(case, vehicle, path, given_at, ended_at, error, reported, acted)
