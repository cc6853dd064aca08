"""Flights without fixtures: immediate and scheduled faults, current tracks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import anyio
import pytest

from aerokit import messages
from aerokit.errors import CommandRejected, InvalidArgument, OperationTimeout
from aerokit.testing import Flight, open_fleet, open_flight, run_virtual, serve_flight

pytestmark = pytest.mark.anyio


async def take_off(flight: Flight, altitude_m: float = 10.0) -> None:
    await flight.vehicle.wait_ready()
    await flight.vehicle.set_mode("GUIDED")
    await flight.vehicle.arm()
    await flight.vehicle.take_off(altitude_m)


async def test_faults_start_and_end_on_time() -> None:
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        flight.faults.lose_gps(after_s=2, for_s=3)
        observed = []
        for _ in range(6):
            observed.append(flight.faults.all.gps_lost)
            await anyio.sleep(1.001)
        assert observed == [False, False, True, True, True, False]


async def test_scheduled_faults_survive_hang_and_reboot() -> None:
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        flight.faults.hang(for_s=4)
        flight.faults.reboot(after_s=8)
        flight.faults.go_silent(for_s=8, after_s=7)
        await anyio.sleep(5)
        assert flight.faults.all.frozen is False
        await anyio.sleep(5)
        assert vars(flight.faults.all)["silent"]
        assert flight.simulated.uptime < 2.0
        await anyio.sleep(6)
        assert not flight.faults.all.silent
        await flight.vehicle.wait_ready()


async def test_failed_motor_shows_in_the_track() -> None:
    async with open_flight() as flight:
        await take_off(flight)
        before = flight.track.end
        flight.faults.fail_motor()
        flight.faults.set_wind(north_m_s=5)
        await anyio.sleep(5)
        assert before.altitude_m > 9
        assert flight.track.end.time_s == pytest.approx(before.time_s + 5, abs=0.05)
        assert flight.track.end.altitude_m < 0.3
        assert flight.simulated.motion.wind.north_m_s == 5
    flight.track.assert_reached_altitude(10)


async def test_low_battery_and_failing_checks() -> None:
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        flight.faults.set_battery(12)
        await flight.vehicle.batteries.wait_until(lambda packs: (packs[0].remaining_percent or 99) <= 12, timeout=10)
        flight.faults.fail_prearm("Gyros still settling", for_s=5)
        with pytest.raises(CommandRejected, match="Gyros still settling"):
            await flight.vehicle.arm()
        await anyio.sleep(6)
        assert flight.faults.all.prearm_failures == []


async def test_timeout_error_lists_failed_checks() -> None:
    async with open_flight() as flight:
        flight.faults.fail_prearm("Compass not healthy")
        with pytest.raises(OperationTimeout, match=r"still missing:(.|\n)*PreArm: Compass not healthy"):
            await flight.vehicle.wait_ready(timeout=40)


async def test_fleet_stands_in_a_row() -> None:
    async with open_fleet("px4", "copter", "rover", spacing_m=8) as fleet:
        pass
    first = fleet[0].track.home
    for number, flight in enumerate(fleet):
        assert first.distance_to(flight.track.home) == pytest.approx(8 * number, abs=0.1)
        assert flight.track.home.longitude_deg >= first.longitude_deg


async def test_unknown_parameter_lists_similar_names() -> None:
    with pytest.raises(InvalidArgument, match=r"no parameter 'RTL_ALT_MM'; similar names: RTL_ALT\b"):
        async with open_flight(parameters={"RTL_ALT_MM": 15}):
            pass


def packets_through(seed: int) -> tuple[int, int]:
    async def main() -> tuple[int, int]:
        async with open_flight(seed=seed) as flight:
            flight.faults.drop_packets(0.2)
            received = 0

            def count(*_: Any) -> None:
                nonlocal received
                received += 1

            flight.simulated.on(messages.Heartbeat, count)
            with flight.vehicle.subscribe(messages.Heartbeat, capacity=200) as heartbeats:
                await anyio.sleep(100)
                reported = 0
                while heartbeats.get_nowait() is not None:
                    reported += 1
            return received, reported

    return run_virtual(main())


@pytest.mark.exhaustive
@pytest.mark.parametrize("seed", [1])
def test_dropped_packets_are_determined_by_the_seed(seed: int) -> None:
    first = packets_through(seed)
    assert packets_through(seed) == first
    assert all(60 < number < 95 for number in first)


async def test_end_removes_all_faults() -> None:
    async with open_flight() as flight:
        flight.faults.drop_packets(1.0)
        flight.faults.lose_gps()
        flight.faults.end(after_s=3)
        await flight.vehicle.wait_ready()
        assert flight.simulated.now > 3


async def test_invalid_arguments_are_refused() -> None:
    async with open_flight(connect=False) as flight:
        wrongs: list[Callable[[], None]] = [
            lambda: flight.faults.drop_packets(20),
            lambda: flight.faults.set_battery(-1),
            lambda: flight.faults.lose_gps(after_s=-1),
            lambda: flight.faults.go_silent(for_s=0),
        ]
        for wrong in wrongs:
            with pytest.raises(InvalidArgument):
                wrong()
        assert not flight.faults.all.gps_lost
    with pytest.raises(RuntimeError, match="is not open"):
        _ = flight.vehicle
    with pytest.raises(InvalidArgument, match="only with one"):
        open_fleet("copter", "px4", count=2)


async def test_fleet_flies_in_a_row() -> None:
    async with open_fleet(count=2) as fleet, anyio.create_task_group() as group:
        for number, flight in enumerate(fleet):
            group.start_soon(take_off, flight, 10.0 + 10 * number)
    assert [round(flight.track.max_altitude_m, -1) for flight in fleet] == [10, 20]


def test_a_served_flight_is_recorded() -> None:
    with serve_flight("px4", speedup=50) as flight:
        flight.faults.set_battery(50)
        assert flight.address.startswith("tcp:127.0.0.1:")
        assert flight.simulated.battery.percent == 50
        assert flight.track.end.armed is False
    assert len(flight.track) >= 1


async def test_unknown_attribute_of_fault_injector_is_error() -> None:
    async with open_flight("copter") as flight:
        with pytest.raises(AttributeError):
            flight.faults.rc_lost = True  # type: ignore[attr-defined]  # a field of flight.faults.all
