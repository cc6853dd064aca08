"""DroneKit's private names that programs read."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import pytest
from dronekit_stage import Stage, on_stage

from aerokit import dronekit

SPEEDS = {"rollspeed": 0.125, "pitchspeed": 0.25, "yawspeed": 0.5}
UNKNOWN = ("_yawspeed", "_heading", "_voltage", "_vx", "_fix_type", "_rngfnd_distance", "_mount_pitch")


@pytest.fixture
def stage() -> Iterator[Stage]:
    with on_stage(dronekit, connect={"rate": None}) as opened:
        yield opened


def test_privates_state(stage: Stage) -> None:
    vehicle = stage.vehicle
    assert [getattr(vehicle, name) for name in UNKNOWN] == [None] * len(UNKNOWN)
    stage.report("ATTITUDE", roll=1.0, pitch=2.0, yaw=3.0, **SPEEDS)
    stage.report("VFR_HUD", airspeed=4.0, groundspeed=5.0, heading=271)
    stage.report("SYS_STATUS", voltage_battery=12587, current_battery=150, battery_remaining=80)
    stage.report("GPS_RAW_INT", fix_type=3, eph=121, epv=200, satellites_visible=10)
    stage.report(
        "GLOBAL_POSITION_INT",
        lat=-35 * 10**7,
        lon=149 * 10**7,
        alt=584000,
        relative_alt=1500,
        vx=10,
        vy=-20,
        vz=30,
    )
    assert (vehicle._roll, vehicle._pitch, vehicle._yaw) == (1, 2, 3)
    assert (vehicle._rollspeed, vehicle._pitchspeed, vehicle._yawspeed) == tuple(SPEEDS.values())
    assert (vehicle._airspeed, vehicle._groundspeed, vehicle._heading) == (4, 5, 271)
    assert (vehicle._voltage, vehicle._current, vehicle._level) == (12587, 150, 80)
    assert (vehicle._fix_type, vehicle._eph, vehicle._epv, vehicle._satellites_visible) == (3, 121, 200, 10)
    assert [vehicle._vx, vehicle._vy, vehicle._vz] == vehicle.velocity == [0.1, -0.2, 0.3]
    location = vehicle.location
    assert (location._lat, location._lon, location._alt, location._relative_alt) == (-35, 149, 584, 1.5)
    assert location._north is vehicle.gimbal._pitch is None


def test_privates_heartbeat(stage: Stage) -> None:
    """``if vehicle._heartbeat_timeout: land()`` works: the attribute is a flag, not the limit."""
    vehicle = stage.vehicle
    assert vehicle._heartbeat_timeout is False
    assert vehicle._heartbeat_started is True
    assert vehicle._heartbeat_system == 1
    assert 0 <= dronekit.time.monotonic() - vehicle._heartbeat_lastreceived < 60
    assert 0 <= vehicle._last_heartbeat < 60


def test_privates_transfers(stage: Stage) -> None:
    vehicle = stage.vehicle
    vehicle.wait_ready("parameters")
    assert vehicle._params_count == len(vehicle._params_map) > 0
    assert vehicle._params_loaded is True
    vehicle.commands._vehicle._current_waypoint = 2  # written by programs; means nothing
    assert vehicle._current_waypoint == 2
    assert vehicle._mode_mapping["GUIDED"] == 4
    assert vehicle._mode_mapping_bynumber[4] == "GUIDED"


def test_privates_own_ids(stage: Stage) -> None:
    assert (stage.vehicle._master.source_system, stage.vehicle._master.source_component) == (255, 0)


def test_privates_subclass_may_override(stage: Stage) -> None:
    stage.vehicle._yaw = "mine"
    stage.report("ATTITUDE", yaw=3.0)
    assert stage.vehicle._yaw == "mine"
    assert stage.vehicle.attitude.yaw == 3


def test_privates_can_be_assigned(stage: Stage) -> None:
    """DroneKit's own tests do, with those of a ground station."""
    stage.vehicle._vehicle_type, stage.vehicle._autopilot_type = 6, 8
    assert stage.vehicle._is_mode_available(0) in (True, False)
    assert str(stage.vehicle.version).startswith("UnknownAutoPilotUnknownVehicleType6-")


def test_privates_master_messages_and_parameters(stage: Stage) -> None:
    master = stage.vehicle._master
    stage.vehicle.wait_ready("parameters")
    assert (master.param("FOO"), master.param("foo", 7), master.param("NOPE", 7)) == (1.0, 1.0, 7)
    assert master.field("ATTITUDE", "yaw", 5) == 5
    assert master.time_since("VFR_HUD") >= 0
    stage.report("ATTITUDE", yaw=0.25)
    assert master.field("ATTITUDE", "yaw") == 0.25
    assert master.field("ATTITUDE", "nonsense", 5) == 5
    assert 0 <= master.time_since("ATTITUDE") <= master.time_since("VFR_HUD")


@pytest.mark.parametrize(("is_relative", "alt"), [(False, 600.0), (True, 16.5)])
def test_privates_master_location(stage: Stage, is_relative: bool, alt: float) -> None:
    found: list[Any] = []
    asking = threading.Thread(target=lambda: found.append(stage.vehicle._master.location(is_relative)))
    asking.start()
    while asking.is_alive():  # earlier messages do not count
        stage.report("GPS_RAW_INT", fix_type=2, lat=1, lon=1)
        stage.report("GPS_RAW_INT", fix_type=3, lat=-350000000, lon=1490000000)
        stage.report("VFR_HUD", alt=600.0, heading=271)
        stage.report("GLOBAL_POSITION_INT", relative_alt=16500)
    assert (found[0].lat, found[0].lng, found[0].alt, found[0].heading) == (-35.0, 149.0, alt, 271)
