"""Values of the DroneKit API: exact texts, attribute names, equality."""

from __future__ import annotations

import copy
import logging
import pickle
from typing import Any

import pytest

from aerokit.dronekit.exceptions import APIException, TimeoutError  # noqa: A004
from aerokit.dronekit.util import ErrprinterHandler, errprinter, logger
from aerokit.dronekit.values import (
    Attitude,
    Battery,
    Capabilities,
    GPSInfo,
    LocationGlobal,
    LocationGlobalRelative,
    LocationLocal,
    Rangefinder,
    SystemStatus,
    VehicleMode,
    Version,
    Wind,
)

ARDUPILOT, PX4, OTHER = 3, 12, 8
PLANE, QUAD, ROVER, HEXA = 1, 2, 10, 13

TEXTS: list[tuple[Any, str]] = [
    (Attitude(0.1, 0.2, 0.3), "Attitude:pitch=0.1,yaw=0.2,roll=0.3"),
    (Attitude(None, None, None), "Attitude:pitch=None,yaw=None,roll=None"),
    (LocationGlobal(-35.36, 149.16, 584.1), "LocationGlobal:lat=-35.36,lon=149.16,alt=584.1"),
    (LocationGlobal(1, 2), "LocationGlobal:lat=1,lon=2,alt=None"),
    (LocationGlobalRelative(-35.36, 149.16, 10), "LocationGlobalRelative:lat=-35.36,lon=149.16,alt=10"),
    (LocationLocal(1.0, 2.0, -3.0), "LocationLocal:north=1.0,east=2.0,down=-3.0"),
    (GPSInfo(121, 65535, 3, 10), "GPSInfo:fix=3,num_sat=10"),
    (Battery(12587, 0, 100), "Battery:voltage=12.587,current=0.0,level=100"),
    (Battery(12587, -1, -1), "Battery:voltage=12.587,current=None,level=None"),
    (Battery(65535, 250, 0), "Battery:voltage=65.535,current=2.5,level=0"),
    (Rangefinder(0.09, 0.009), "Rangefinder: distance=0.09, voltage=0.009"),
    (Wind(90.0, 3.5, -0.5), "Wind: wind direction: 90.0, wind speed: 3.5, wind speed z: -0.5"),
    (VehicleMode("GUIDED"), "VehicleMode:GUIDED"),
    (SystemStatus("ACTIVE"), "SystemStatus:ACTIVE"),
    (Version(0x030302FF, ARDUPILOT, QUAD), "APM:Copter-3.3.2"),
    (Version(0x030300D7, ARDUPILOT, QUAD), "APM:Copter-3.3.0-rc23"),
    (Version(0x030300BF, ARDUPILOT, QUAD), "APM:Copter-3.3.0-beta63"),
    (Version(0x04000000, ARDUPILOT, PLANE), "APM:Plane-4.0.0-dev0"),
    (Version(0x04000041, ARDUPILOT, ROVER), "APM:Rover-4.0.0-alpha1"),
    (Version(0x04000081, ARDUPILOT, HEXA), "APM:UnknownVehicleType13-4.0.0-beta1"),
    (Version(0x010800FF, PX4, QUAD), "PX4Copter-1.8.0"),
    (Version(0x010800FF, OTHER, QUAD), "UnknownAutoPilotCopter-1.8.0"),
    (Version(None, ARDUPILOT, QUAD), "APM:Copter-None.None.NoneUnknownReleaseType"),
    (
        Version(None, None, None),
        "UnknownAutoPilotUnknownVehicleTypeNone-None.None.NoneUnknownReleaseType",
    ),
]


@pytest.mark.parametrize(("value", "text"), TEXTS, ids=[text for _, text in TEXTS])
def test_value_texts(value: Any, text: str) -> None:
    assert str(value) == text
    assert repr(value) == text
    assert str(pickle.loads(pickle.dumps(copy.copy(value)))) == text


def test_values_have_dronekit_attribute_names() -> None:
    assert vars(Attitude(1, 2, 3)) == {"pitch": 1, "yaw": 2, "roll": 3}
    assert vars(GPSInfo(1, 2, 3, 4)) == {"eph": 1, "epv": 2, "fix_type": 3, "satellites_visible": 4}
    assert vars(Rangefinder(1, 2)) == {"distance": 1, "voltage": 2}
    assert vars(Wind(1, 2, 3)) == {"wind_direction": 1, "wind_speed": 2, "wind_speed_z": 3}
    assert vars(LocationLocal(1, 2, 3)) == {"north": 1, "east": 2, "down": 3}
    for location in (LocationGlobal(1, 2, 3), LocationGlobalRelative(1, 2, 3)):
        assert (location.lat, location.lon, location.alt) == (1, 2, 3)
        assert (location.local_frame, location.global_frame) == (None, None)


def test_values_are_mutable() -> None:
    place: Any = LocationGlobalRelative(1, 2, 3)
    place.alt += 10
    place.name = "over there"
    assert str(place) == "LocationGlobalRelative:lat=1,lon=2,alt=13"


def test_locations_compare_by_identity() -> None:
    place = LocationGlobal(1, 2, 3)
    assert place == place
    assert place != LocationGlobal(1, 2, 3)


def test_distance_home() -> None:
    assert LocationLocal(3, 4, 12).distance_home() == 13.0
    assert LocationLocal(3, 4, None).distance_home() == 5.0
    assert LocationLocal(None, 4, 12).distance_home() is None
    assert LocationLocal(3, None, 12).distance_home() is None


@pytest.mark.parametrize("kind", [VehicleMode, SystemStatus])
def test_modes_and_states_equal_names(kind: Any) -> None:
    value = kind("AUTO")
    assert value == "AUTO"
    assert "AUTO" == value  # noqa: SIM300
    assert value == kind("AUTO")
    assert value != "GUIDED"
    assert value != kind("GUIDED")
    assert value != None  # noqa: E711 - as programs write it
    assert {value: 1}["AUTO"] == 1
    assert kind("AUTO") in {"AUTO"}


def test_version_release_type() -> None:
    release, candidate, unknown = (Version(raw, ARDUPILOT, QUAD) for raw in (0x030302FF, 0x030300D7, None))
    assert (release.major, release.minor, release.patch, release.release) == (3, 3, 2, 255)
    assert (release.is_stable(), release.release_type(), release.release_version()) == (True, "rc", 0)
    assert (candidate.is_stable(), candidate.release_type(), candidate.release_version()) == (False, "rc", 23)
    assert (unknown.is_stable(), unknown.release_type(), unknown.release_version()) == (False, None, None)
    assert (release.raw_version, release.autopilot_type, release.vehicle_type) == (0x030302FF, 3, 2)


CAPABILITIES = [
    "mission_float",
    "param_float",
    "mission_int",
    "command_int",
    "param_union",
    "ftp",
    "set_attitude_target",
    "set_attitude_target_local_ned",
    "set_altitude_target_global_int",
    "terrain",
    "set_actuator_target",
    "flight_termination",
    "compass_calibration",
]


def test_capabilities_from_bits() -> None:
    for bit, name in enumerate(CAPABILITIES):
        assert [attribute for attribute, value in vars(Capabilities(1 << bit)).items() if value] == [name]
    assert repr(Capabilities(0b100001)) == "Capabilities(mission_float, ftp)"


@pytest.mark.parametrize("bits", [None, 0])
def test_unknown_capabilities_are_false(bits: int | None) -> None:
    assert list(vars(Capabilities(bits))) == CAPABILITIES
    assert not any(vars(Capabilities(bits)).values())


def test_timeout_error_is_builtin() -> None:
    import builtins

    assert issubclass(TimeoutError, builtins.TimeoutError)
    assert issubclass(TimeoutError, APIException)
    assert not issubclass(APIException, OSError)
    assert str(TimeoutError("failed to arm vehicle")) == "failed to arm vehicle"
    assert str(APIException("no")) == "no"


def test_errprinter_prints_to_stderr(capsys: pytest.CaptureFixture[str]) -> None:
    errprinter("one", 2)
    logger("three")
    notified = capsys.readouterr()
    assert (notified.out, notified.err) == ("", "one 2\nthree\n")


def test_errprinter_handler_passes_records() -> None:
    notified: list[str] = []
    handler = ErrprinterHandler(notified.append)
    handler.setFormatter(logging.Formatter("%(levelname)s %(message)s"))
    log = logging.Logger("texts")
    log.addHandler(handler)
    log.warning("PreArm: %s", "RC not calibrated")
    assert notified == ["WARNING PreArm: RC not calibrated"]
