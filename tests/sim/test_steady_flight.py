"""Long ticks in steady flight: fewer of them, with the same flight and equally recent samples."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any

import pytest
from simulated_client import Client, flying_copter, set_mode

from aerokit.mavlink import Message
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import CopterMode, MavCmd
from aerokit.sim import SimulatedCopter, SimulatedPx4, SimulatedVehicle, SimulatedWind
from aerokit.sim.px4 import modes

TICK_S = 0.02


def hovering_copter(**options: Any) -> tuple[SimulatedCopter, Client]:
    copter, client = flying_copter(20.0, **options)
    client.run(10.0)
    return copter, client


def hovering_px4(kind: type[SimulatedPx4] = SimulatedPx4, **options: Any) -> tuple[SimulatedPx4, Client]:
    px4 = kind(boot_time_s=0.0, link_modes=("minimal",), **options)
    client = Client(px4)
    client.run(3.0)
    client.send(m.Heartbeat(6, 8, 0, 0, 4, 3))
    client.command(MavCmd.COMPONENT_ARM_DISARM, 1)
    px4.change_mode(modes.TAKEOFF)
    client.run(25.0)
    assert px4.is_armed
    assert not px4.is_landed
    return px4, client


def fly_north(vehicle: Any, metres: float) -> None:
    place = (vehicle.motion.north + metres, vehicle.motion.east, vehicle.motion.down)
    if isinstance(vehicle, SimulatedCopter):
        vehicle.guided.go_to(place)
    else:
        vehicle.flight.target = place


def recorded_ticks(vehicle: Any) -> list[tuple[float, float]]:
    """Return a list that fills with the time and length of each tick."""
    ticks: list[tuple[float, float]] = []
    tick = vehicle.tick

    def record(dt: float) -> None:
        ticks.append((vehicle.now, dt))
        tick(dt)

    vehicle.tick = record
    return ticks


BOTH = pytest.mark.parametrize("fly", [hovering_copter, hovering_px4])
Take = Callable[[], tuple[Any, Client]]


@BOTH
def test_hovering_vehicle_ticks_ten_times_a_second(fly: Take) -> None:
    vehicle, client = fly()
    ticks = recorded_ticks(vehicle)
    client.run(10.0)
    assert 99 <= len(ticks) <= 210
    assert sum(dt for _, dt in ticks) == pytest.approx(10.0, abs=0.11)
    assert max(dt for _, dt in ticks) == pytest.approx(0.1)


@BOTH
def test_change_of_acceleration_is_followed_by_short_ticks(fly: Take) -> None:
    vehicle, client = fly()
    ticks = recorded_ticks(vehicle)
    fly_north(vehicle, 60.0)
    client.run(0.3)
    assert [dt for _, dt in ticks[1:3]] == pytest.approx([TICK_S, TICK_S])


@BOTH
@pytest.mark.parametrize(
    ("message", "is_short"), [(m.ParamRequestRead(1, 1, "X", -1), True), (m.Heartbeat(6, 8, 0, 0, 4, 3), False)]
)
def test_next_tick_is_short_unless_the_message_is_a_heartbeat(fly: Take, message: Message, is_short: bool) -> None:
    vehicle, client = fly()
    ticks = recorded_ticks(vehicle)
    sent_at = client.now
    client.send(message)
    client.run(0.2)
    assert any(sent_at < at <= sent_at + TICK_S + 1e-9 for at, _ in ticks) is is_short


def test_gusts_prevent_long_ticks() -> None:
    copter, client = hovering_copter(wind=SimulatedWind(3.0, 0.0, gusts_m_s=1.0))
    ticks = recorded_ticks(copter)
    client.run(2.0)
    assert max(dt for _, dt in ticks) == pytest.approx(TICK_S)


def test_descent_near_the_ground_ticks_at_full_rate() -> None:
    copter, client = hovering_copter()
    set_mode(client, CopterMode.LAND)
    client.run_until(lambda: copter.altitude_m < 0.15)
    ticks = recorded_ticks(copter)
    client.run_until(lambda: copter.motion.is_on_ground)
    assert max(dt for _, dt in ticks) == pytest.approx(TICK_S)


@BOTH
def test_samples_between_long_ticks_are_recent(fly: Take) -> None:
    vehicle, client = fly()
    fly_north(vehicle, 200.0)
    client.run(8.0)
    client.clear()
    client.command(MavCmd.SET_MESSAGE_INTERVAL, m.LocalPositionNed.ID, 70_000)
    client.run(3.0)
    samples = client.all(m.LocalPositionNed)[2:]
    assert len(samples) > 35
    assert samples[0].vx > 4.0
    for before, after in itertools.pairwise(samples):
        moved, seconds = after.x - before.x, (after.time_boot_ms - before.time_boot_ms) / 1000
        assert moved == pytest.approx(before.vx * seconds, abs=before.vx * (TICK_S + 0.002))


class FineCopter(SimulatedCopter):
    """Copter that always ticks at 50 Hz."""

    @property
    def is_steady(self) -> bool:
        return False


class FinePx4(SimulatedPx4):
    @property
    def is_steady(self) -> bool:
        return False


@pytest.mark.parametrize(
    ("fly", "fine"), [(hovering_copter, FineCopter), (hovering_px4, FinePx4)], ids=["ardupilot", "px4"]
)
def test_flight_with_long_ticks_equals_flight_without(
    fly: Callable[..., tuple[Any, Client]], fine: type[SimulatedVehicle]
) -> None:
    flown = []
    for options in ({}, {"kind": fine}):
        vehicle, client = fly(**options)
        begun, speeds, leans = client.now, [0.0], [0.0]
        fly_north(vehicle, 80.0)
        target = vehicle.motion.north + 80.0
        while abs(vehicle.motion.north - target) > 0.3:
            client.run(0.05)
            speeds.append(vehicle.motion.ground_speed_m_s)
            leans.append(math.hypot(vehicle.motion.roll, vehicle.motion.pitch))
        client.run(5.0)
        arrived, place = client.now - begun, vehicle.motion.place
        client.command(MavCmd.NAV_LAND)
        client.run_until(lambda: vehicle.is_landed)  # noqa: B023
        flown.append((arrived, client.now - begun, max(speeds), max(leans), vehicle.battery.percent, *place))
    (arrived, landed, *rest), (fine_arrived, fine_landed, *fine_rest) = flown
    assert arrived == pytest.approx(fine_arrived, abs=0.2)
    assert landed == pytest.approx(fine_landed, abs=0.3)
    assert rest == pytest.approx(fine_rest, rel=0.005, abs=0.02)
