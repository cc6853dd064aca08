"""MANUAL_CONTROL and RC_CHANNELS_OVERRIDE on every kind of ArduPilot."""

from __future__ import annotations

import math
from typing import Any

import pytest
from simulated_client import Client, set_mode

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import CopterMode, MavCmd, MavDataStream, PlaneMode, RoverMode, SubMode
from aerokit.sim.kinds import simulated

NONE = 0x7FFF


def started(kind: str, **options: Any) -> tuple[Any, Client]:
    vehicle = simulated(kind, boot_time_s=0.0, heading_deg=0.0, **options)
    client = Client(vehicle)
    client.run(3.0)
    return vehicle, client


def armed(kind: str, mode: int) -> tuple[Any, Client]:
    vehicle, client = started(kind)
    assert set_mode(client, mode) == 0
    assert client.command(MavCmd.COMPONENT_ARM_DISARM, 1) == 0
    return vehicle, client


def fly(client: Client, seconds: float, x: int = 0, y: int = 0, z: int = 500, r: int = 0) -> None:
    """Repeat MANUAL_CONTROL every 0.2 s, as a ground station does."""
    for _ in range(round(seconds / 0.2)):
        client.send(m.ManualControl(client.vehicle.system_id, x, y, z, r, 0))
        client.run(0.2)


def pulses(client: Client) -> list[int]:
    client.command(MavCmd.REQUEST_MESSAGE, m.RcChannels.ID)
    client.run(0.05)
    channels = client.last(m.RcChannels)
    return [getattr(channels, f"chan{index}_raw") for index in range(1, 7)]


@pytest.mark.parametrize(
    ("kind", "axes", "expected"),
    [
        ("copter", (300, -200, 800, 500), [1400, 1350, 1800, 1750]),
        ("plane", (300, -200, 800, 500), [1400, 1350, 1800, 1750]),
        ("rover", (0, 500, -500, 0), [1750, 1500, 1250]),
        ("sub", (500, 0, 500, 0), [1500, 1500, 1500, 1500, 1600, 1500]),
        ("sub", (0, 300, 200, 400), [1500, 1500, 1380, 1580, 1500, 1560]),
    ],
)
def test_manual_control_axes_become_pulses(kind: str, axes: tuple[int, ...], expected: list[int]) -> None:
    _, client = started(kind)
    fly(client, 0.4, *axes)
    assert pulses(client)[: len(expected)] == expected


def test_axis_without_value_releases_channel() -> None:
    _, client = started("rover")
    fly(client, 0.4, y=500, z=500)
    fly(client, 0.4, y=NONE, z=500)
    assert pulses(client)[:3] == [1500, 1500, 1750]


@pytest.mark.parametrize(("kind", "pulse"), [("rover", 1750), ("sub", 1620)])
def test_silent_joystick_releases_channels_after_three_seconds(kind: str, pulse: int) -> None:
    _, client = started(kind)
    fly(client, 0.4, z=500 if kind == "rover" else 800)
    client.run(2.5)
    assert pulses(client)[2] == pulse
    client.run(0.6)
    assert pulses(client)[2] == 1500


def test_manual_control_of_other_ground_station_is_ignored() -> None:
    vehicle, _ = started("rover")
    stranger = Client(vehicle, system_id=77)
    stranger.now = vehicle.now
    fly(stranger, 0.4, z=900)
    assert vehicle.rc[2] == 1500
    client = Client(vehicle)
    client.now = vehicle.now
    client.send(m.ManualControl(9, 0, 0, 900, 0, 0))
    assert vehicle.rc[2] == 1500


def test_copter_negative_thrust_is_ignored() -> None:
    vehicle, client = started("copter")
    fly(client, 0.4, z=-5)
    assert vehicle.rc[2] == 1000


def test_copter_follows_joystick() -> None:
    copter, client = armed("copter", CopterMode.ALT_HOLD)
    fly(client, 6.0, z=800)
    assert copter.altitude_m > 2.0
    fly(client, 3.0, x=300)
    assert copter.motion.velocity_north > 1.0
    fly(client, 4.0, x=-300)
    assert copter.motion.velocity_north < 0.0
    fly(client, 1.0, r=300)
    assert copter.motion.yaw > 0.3
    assert set_mode(client, CopterMode.LOITER) == 0
    fly(client, 6.0)
    assert copter.motion.ground_speed_m_s < 0.3
    height = copter.altitude_m
    fly(client, 4.0, y=400)
    assert copter.motion.ground_speed_m_s > 1.0
    assert copter.altitude_m == pytest.approx(height, abs=0.5)


def test_rover_follows_joystick() -> None:
    rover, client = armed("rover", RoverMode.MANUAL)
    fly(client, 4.0, z=500)
    assert rover.motion.velocity_north > 2.0
    fly(client, 1.0, z=500, y=500)
    assert rover.motion.yaw > 0.1
    fly(client, 6.0, z=-500)
    assert rover.motion.speed_m_s < -0.9


def test_sub_follows_joystick() -> None:
    sub, client = armed("sub", SubMode.ALT_HOLD)
    fly(client, 6.0, z=0)
    depth = sub.motion.down
    assert depth > 0.5
    fly(client, 4.0, x=500)
    assert sub.motion.north > 0.3
    fly(client, 3.0, r=400)
    assert sub.motion.yaw > 0.2
    fly(client, 3.0)
    still = sub.motion.down
    fly(client, 2.0)
    assert sub.motion.down == pytest.approx(still, abs=0.1)


def test_plane_follows_joystick() -> None:
    plane, client = armed("plane", PlaneMode.TAKEOFF)
    client.run_until(lambda: plane.altitude_m > 40.0)
    assert set_mode(client, PlaneMode.FLY_BY_WIRE_A) == 0
    fly(client, 4.0, y=500)
    assert math.degrees(plane.motion.roll) > 10.0
    height = plane.altitude_m
    fly(client, 4.0, x=-500)
    assert plane.altitude_m > height + 3.0
    assert abs(math.degrees(plane.motion.roll)) < 5.0
    assert set_mode(client, PlaneMode.FLY_BY_WIRE_B) == 0
    height = plane.altitude_m
    fly(client, 5.0, x=500)
    assert plane.altitude_m < height - 2.0


def test_rc_override_moves_vehicle_like_joystick() -> None:
    rover, client = armed("rover", RoverMode.MANUAL)
    client.send(m.RequestDataStream(1, 1, MavDataStream.RC_CHANNELS, 5, 1))
    for _ in range(20):
        client.send(m.RcChannelsOverride(1, 1, 1500, 0, 1750, 0, 0, 0, 0, 0))
        client.run(0.2)
    assert rover.motion.velocity_north > 2.0
    assert client.last(m.RcChannels).chan3_raw == 1750


@pytest.mark.parametrize("kind", ["copter", "plane", "rover", "sub"])
def test_axis_beyond_range_is_not_rejected(kind: str) -> None:
    vehicle, client = started(kind)
    for axis in (-32768, 32766):
        client.send(m.ManualControl(vehicle.system_id, axis, axis, abs(axis) // 2, axis, 0))
        assert all(0 <= pulse <= 0xFFFF for pulse in pulses(client))
