"""One flight of the order table: a vehicle in its place, an order, the weather, and somebody else who acts."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable
from dataclasses import dataclass, replace

import anyio
from order_air import Air, Silence, Weather
from order_airs import Airs, TwoLinks, over_two
from order_table import Row, upload

import aerokit
from aerokit.errors import AerokitError
from aerokit.mavlink.enums import CopterMode
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import GlobalPositionInt
from aerokit.sim import SimulatedCopter, SimulatedPx4, simulated_link
from aerokit.sim.px4.modes import POSITION, RTL
from aerokit.sim.track import true_point
from aerokit.testing import run_virtual

Simulated = SimulatedCopter | SimulatedPx4

RATES: dict[type[Message], float] = {GlobalPositionInt: 4.0}
RIGHT_AFTER_S = 0.001
"""What is sent with the call has left by then."""
WATCH_S, WATCH_ARMING_S = 8.0, 18.0
"""So long after the order's end it is looked what becomes of it: an order to arm may come late."""


@dataclass(frozen=True)
class Case:
    """What happens: all times are seconds since the order was given."""

    row: Row
    autopilot: str
    weather: Weather
    pilot_at: float | None = None
    """When somebody else acts: turns the mode switch; on the ground, disarms, unless ``by_switch``."""
    by_switch: bool = False
    failsafe_at: float | None = None
    """When the vehicle returns by itself."""
    station_failsafe: bool = False
    """Whether it returns when it does not hear the ground station."""
    cancel_at: float | None = None
    two: TwoLinks | None = None
    """None: over one link."""


@dataclass
class Flown:
    """What came of it."""

    case: Case
    vehicle: Simulated
    air: Air | Airs
    given_at: float
    ended_at: float
    error: BaseException | None
    told_at_end: tuple[str, bool]
    """Mode and armed as the program knew them when the call ended."""
    acted: list[tuple[float, str]]
    """When somebody else acted, on the program's clock, and in which mode the vehicle was then."""

    @property
    def is_armed_at_end(self) -> bool:
        return true_point(self.vehicle).armed


def mode_of(vehicle: Simulated) -> str:
    """The mode that it is truly in, as programs spell it."""
    return true_point(vehicle).mode


def random_case(row: Row, autopilot: str, seed: int) -> Case:
    """Lost answers × lost copies × delays × pilot × failsafe × outage, by a seed."""
    dice = random.Random(f"{row.name} {row.command} {autopilot} {seed}")
    weather = Weather(
        command=row.command,
        lost_acks=dice.choice((0, 1, 1, 2, 9)),
        lost_commands=dice.choice((0, 0, 1, 2)),
        latency_s=dice.choice((0.01, 0.05, 0.2)),
    )
    if dice.random() < 0.35:
        begin = round(dice.uniform(0.0, 5.0), 2)
        weather.outage = (begin, begin + round(dice.uniform(1.0, 14.0), 2))
    elif dice.random() < 0.15:
        weather.stall = (0.0, round(dice.uniform(1.0, 8.0), 2))
    happens = dice.random()
    return Case(
        row,
        autopilot,
        weather,
        pilot_at=round(dice.uniform(0.05, 6.0), 2) if happens < 0.45 else None,
        failsafe_at=round(dice.uniform(0.05, 6.0), 2) if 0.45 <= happens < 0.6 else None,
        station_failsafe=dice.random() < 0.5,
        cancel_at=round(dice.uniform(0.05, 12.0), 2) if dice.random() < 0.25 else None,
        by_switch=dice.random() < 0.5,
    )


def random_case_over_two(row: Row, autopilot: str, seed: int) -> Case:
    """The same over two links: the one in use falls silent before, with or after the order; answers come over the other
    one, or are lost on both. None of them delivers late: what a network keeps cannot be taken back.
    """
    case = random_case(row, autopilot, seed)
    dice = random.Random(f"two links {row.name} {row.command} {autopilot} {seed}")
    begin_s = dice.choice((0.0, RIGHT_AFTER_S, RIGHT_AFTER_S, round(dice.uniform(0.05, 4.0), 2)))
    lasts_s = dice.choice((float("inf"), float("inf"), round(dice.uniform(0.5, 8.0), 2)))
    silence = Silence(begin_s, begin_s + lasts_s, is_one_way=dice.random() < 0.5)
    two = TwoLinks(silence, is_copied=dice.random() < 0.5)
    return replace(case, weather=replace(case.weather, stall=None), two=two)


def fly(case: Case) -> Flown:
    """Fly it on virtual time."""
    return run_virtual(_fly(replace(case, weather=replace(case.weather))))


async def _go_to_place(place: str, vehicle: Simulated, program: aerokit.Vehicle) -> None:
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
    """The pilot turns the mode switch, the sticks in the middle."""
    if isinstance(vehicle, SimulatedCopter):
        vehicle.rc[2] = 1500
    turn_switch(vehicle)


def turn_switch(vehicle: Simulated) -> None:
    """To a mode that is flown by hand."""
    if isinstance(vehicle, SimulatedCopter):
        vehicle.set_mode(CopterMode.ALT_HOLD)
    else:
        vehicle.switch_to(POSITION)


def _return(vehicle: Simulated) -> None:
    if isinstance(vehicle, SimulatedCopter):
        vehicle.set_mode(CopterMode.RTL)
    else:
        vehicle.change_mode(RTL)


def _act(case: Case, vehicle: Simulated) -> None:
    """Another station disarms what stands on the ground, or changes its mode; a pilot takes what flies."""
    if case.row.place == "ground":
        if case.by_switch:
            turn_switch(vehicle)
        elif isinstance(vehicle, SimulatedCopter):
            vehicle.arming.disarm()
        else:
            vehicle.arming.disarm("another station")
    else:
        take_over(vehicle)


def _set_up(case: Case) -> Simulated:
    if case.autopilot == "px4":
        px4 = SimulatedPx4(boot_time_s=1.0)
        px4.parameters["NAV_DLL_ACT"] = 2.0 * case.station_failsafe
        px4.parameters["COM_DISARM_PRFLT"] = 0.0  # what stays armed is seen
        return px4
    copter = SimulatedCopter(boot_time_s=0.0)
    copter.parameters["FS_GCS_ENABLE"] = 1.0 * case.station_failsafe
    copter.parameters["DISARM_DELAY"] = 0.0
    if case.row.name.startswith("gimbal"):
        copter.parameters["MNT1_TYPE"] = 1.0
    return copter


async def _fly(case: Case) -> Flown:
    vehicle = _set_up(case)
    if case.two is not None:
        async with (
            over_two(vehicle, case.two) as (airs, connection),
            aerokit.connect(connection, rates=RATES) as program,
        ):
            return await _give(case, vehicle, airs, program)
    async with simulated_link(vehicle) as link:
        air = Air(link)
        async with aerokit.connect(air, rates=RATES) as program:
            return await _give(case, vehicle, air, program)


async def _give(case: Case, vehicle: Simulated, air: Air | Airs, program: aerokit.Vehicle) -> Flown:
    loop = asyncio.get_running_loop()
    await _go_to_place(case.row.place, vehicle, program)
    air.weather = case.weather
    air.begin()
    given_at = loop.time()
    acted: list[tuple[float, str]] = []

    def later(at: float | None, act: Callable[[], None]) -> None:
        def happen() -> None:
            act()
            acted.append((loop.time(), mode_of(vehicle)))

        if at is not None:
            loop.call_later(at, happen)

    later(case.pilot_at, lambda: _act(case, vehicle))
    later(case.failsafe_at, lambda: _return(vehicle))
    error: BaseException | None = None
    with anyio.CancelScope(deadline=given_at + (case.cancel_at or 1e6)) as scope:
        try:
            await case.row.give(program)
        except AerokitError as caught:
            error = caught
    if scope.cancelled_caught:
        error = asyncio.CancelledError()
    ended_at = loop.time()
    told = (program.mode_name or "", program.is_armed)
    await anyio.sleep(WATCH_ARMING_S if case.row.name == "arm" else WATCH_S)
    return Flown(case, vehicle, air, given_at, ended_at, error, told, acted)
