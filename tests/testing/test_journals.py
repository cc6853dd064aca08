"""Journals of simulated vehicles, and conditional faults."""

from __future__ import annotations

import anyio
import pytest

from aerokit import messages
from aerokit.mavlink.enums import MavCmd, MavSeverity
from aerokit.testing import Flight, Journal, open_fleet, open_flight

pytestmark = pytest.mark.anyio


async def fly(flight: Flight, altitude_m: float = 10.0) -> None:
    await flight.vehicle.wait_ready()
    await flight.vehicle.arm()
    await flight.vehicle.take_off(altitude_m)


async def test_journal_has_texts_and_messages() -> None:
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        await flight.vehicle.set_mode("GUIDED")
        await fly(flight)
    journal = flight.journal
    journal.assert_sent_text("Arming motors")
    journal.assert_received_command(MavCmd.NAV_TAKEOFF, times=1)
    journal.assert_received_command(MavCmd.COMPONENT_ARM_DISARM)
    journal.assert_received_command(MavCmd.NAV_LAND, times=0)
    assert [order.param7 for order in journal.of(messages.CommandLong) if order.command == 22] == [10]
    assert len(journal.of(messages.Heartbeat)) >= 5
    times = [received.time_s for received in journal.messages]
    assert times == sorted(times)


async def test_px4_texts_are_whole_and_without_tabs() -> None:
    async with open_flight("px4") as flight:
        await fly(flight)
    assert all(text.text == text.text.strip() for text in flight.journal.texts)
    flight.journal.assert_sent_text("Armed by external command")


async def test_reboot_does_not_end_the_journal() -> None:
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        before = len(flight.journal.texts)
        flight.faults.reboot()
        await anyio.sleep(6)
        assert len(flight.journal.texts) > before


def test_failed_assertions_list_the_journal() -> None:
    journal = Journal()
    with pytest.raises(AssertionError, match=r"no text with 'Crash' was sent; sent texts: none"):
        journal.assert_sent_text("Crash")
    journal.on_text_sent(1.25, MavSeverity.CRITICAL, "Arm: Compass not healthy\t")
    with pytest.raises(AssertionError, match=r"1\.2 s CRITICAL 'Arm: Compass not healthy'"):
        journal.assert_sent_text("Crash")
    journal.on_message_received(2.0, messages.CommandLong(1, 1, MavCmd.NAV_LAND, 0, *[0.0] * 7))
    with pytest.raises(
        AssertionError, match=r"NAV_LAND was received 1 times, not 2 times; received commands:\n +- NAV_LAND"
    ):
        journal.assert_received_command(MavCmd.NAV_LAND, times=2)
    journal.on_message_received(3.0, messages.CommandLong(1, 1, MavCmd.NAV_LAND, 1, *[0.0] * 7))
    with pytest.raises(
        AssertionError, match=r"NAV_TAKEOFF was received 0 times; received commands:\n +- NAV_LAND, 2 times"
    ):
        journal.assert_received_command(MavCmd.NAV_TAKEOFF)


async def test_fault_waits_for_its_condition() -> None:
    async with open_flight() as flight:
        high = flight.faults.when(lambda here: here.altitude_m > 8)
        high.lose_gps(for_s=2)
        high.lose_rc(after_s=1)
        await flight.vehicle.wait_ready()
        await flight.vehicle.set_mode("GUIDED")
        await flight.vehicle.arm()
        await anyio.sleep(5)
        assert vars(flight.faults.all)["gps_lost"] is False
        await flight.vehicle.take_off(10)
        lost_at = next(point.time_s for point in flight.track if point.altitude_m > 8)
        assert vars(flight.faults.all)["gps_lost"] is True
        await anyio.sleep(lost_at + 2.3 - flight.simulated.now)
        assert (flight.faults.all.gps_lost, flight.faults.all.rc_lost) == (False, True)


async def test_fleet_reports_minimum_distance() -> None:
    async with open_fleet(count=2) as fleet, anyio.create_task_group() as group:
        for flight, altitude_m in zip(fleet, (10, 20), strict=True):
            await flight.vehicle.wait_ready()
            await flight.vehicle.set_mode("GUIDED")
            group.start_soon(fly, flight, altitude_m)
    fleet.assert_stayed_apart(4.9)  # They start 5 m apart, to the east.
    with pytest.raises(AssertionError, match=r"system 1 and system 2 came nearer than 6 m: 5\.0 m at "):
        fleet.assert_stayed_apart(6)
