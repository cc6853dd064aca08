"""Corrections from the program: sent once on each link, with number, bytes and bandwidth in a cell."""

from __future__ import annotations

import anyio
import pytest
from flight_harness import Wire

import aerokit
from aerokit import messages as m
from aerokit.errors import ConnectionClosed, InvalidArgument
from aerokit.protocols.rtcm import crc24q
from aerokit.sim import SimulatedCopter, SimulatedPx4, simulated_link

pytestmark = pytest.mark.anyio


def rtcm(size: int, number: int = 1077) -> bytes:
    body = bytes([0xD3, size - 6 >> 8, size - 6 & 0xFF, number >> 4, number << 4 & 0xFF]) + bytes(size - 8)
    return body + crc24q(body).to_bytes(3, "big")


async def test_correction_reaches_vehicle_whole() -> None:
    px4 = SimulatedPx4(boot_time_s=0.0)
    async with simulated_link(px4) as link, aerokit.connect(link) as vehicle:
        await vehicle.wait_ready()
        assert vehicle.gps.value[0].fix_type == 3
        vehicle.rtk.send(rtcm(25, 1005) + rtcm(400))
        await vehicle.gps.wait_until(lambda receivers: receivers[0].fix_type == 6, timeout=5)
        assert px4.corrections.messages == [rtcm(25, 1005), rtcm(400)]
        await vehicle.gps.wait_until(lambda receivers: receivers[0].fix_type == 3, timeout=10)


async def test_cell_reports_age_number_and_bandwidth() -> None:
    async with simulated_link(SimulatedCopter(boot_time_s=0.0)) as link, aerokit.connect(link) as vehicle:
        assert not vehicle.rtk.corrections.is_known
        for _ in range(20):
            vehicle.rtk.send(rtcm(100))
            await anyio.sleep(1.0)
        corrections = vehicle.rtk.corrections
        assert corrections.value.messages == 20
        assert corrections.value.bytes_sent == 2000
        assert corrections.value.message_number == 1077
        assert corrections.value.bandwidth_bytes_s == pytest.approx(100)
        assert corrections.age == pytest.approx(1.0)


async def test_two_vehicles_on_one_link_send_once() -> None:
    copters = [SimulatedCopter(system_id=number, boot_time_s=0.0) for number in (1, 2)]
    async with simulated_link(copters) as link:
        wire = Wire(link)
        async with (
            aerokit.open_connection(wire) as connection,
            aerokit.connect(connection, system_id=1) as one,
            aerokit.connect(connection, system_id=2) as other,
        ):
            for _ in range(3):
                for vehicle in (one, other):
                    vehicle.rtk.send(rtcm(300))
                await anyio.sleep(1.0)
            assert [piece.flags >> 3 for piece in wire.all(m.GpsRtcmData)] == [0, 0, 1, 1, 2, 2]
            assert other.rtk.corrections.value.messages == 3
            assert [len(copter.corrections.messages) for copter in copters] == [3, 3]


async def test_one_vehicle_repeating_message_sends_each() -> None:
    async with simulated_link(SimulatedCopter(boot_time_s=0.0)) as link:
        wire = Wire(link)
        async with aerokit.connect(wire) as vehicle:
            vehicle.rtk.send(rtcm(25))
            vehicle.rtk.send(rtcm(25))
            assert len(wire.all(m.GpsRtcmData)) == 2


async def test_damaged_message_after_whole_one_sends_nothing() -> None:
    async with simulated_link(SimulatedCopter(boot_time_s=0.0)) as link:
        wire = Wire(link)
        async with aerokit.connect(wire) as vehicle:
            rtk = vehicle.rtk
            with pytest.raises(InvalidArgument, match="CRC"):
                rtk.send(rtcm(25) + rtcm(25)[:-1] + b"x")
            assert wire.all(m.GpsRtcmData) == []
        with pytest.raises(ConnectionClosed):
            rtk.send(rtcm(25))
