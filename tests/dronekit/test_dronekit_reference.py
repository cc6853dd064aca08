"""DroneKit's API reference, entry by entry: names, arguments, defaults, documented behaviour, examples."""

from __future__ import annotations

import importlib
import inspect
import logging
from collections.abc import Iterator
from functools import reduce
from typing import Any

import pytest
from dronekit_reference import ATTRIBUTES, MODULE_NAMES, OTHER_NAMES, SIGNATURES, SUBCLASSES
from dronekit_scenarios_state import POSITION
from dronekit_stage import Stage, caught, on_stage, until
from dronekit_streams import READY, answer_streams
from for_each import for_each

import aerokit.dronekit as dronekit

for module in OTHER_NAMES:
    importlib.import_module(f"aerokit.dronekit.{module}")


def found(path: str) -> Any:
    return reduce(getattr, path.split("."), dronekit)


@pytest.fixture(scope="module")
def notified() -> Iterator[Stage]:
    """A vehicle with all values; tests only read it."""
    with on_stage(dronekit, {"mode": 4}, READY, answer_streams) as stage:
        stage.vehicle.wait_ready("ekf_ok", "capabilities", timeout=100)
        until(lambda: stage.vehicle.home_location)  # requested by the library in the background
        stage.settle()
        yield stage


@pytest.fixture
def stage() -> Iterator[Stage]:
    with on_stage(dronekit, {"mode": 4}, READY, answer_streams) as opened:
        opened.settle()
        yield opened


# ---------------------------------------------------------------------------------------- names


@for_each("name", MODULE_NAMES)
def test_module_has(name: str) -> None:
    assert getattr(dronekit, name) is not None


@for_each("module, name", [(module, name) for module in OTHER_NAMES for name in OTHER_NAMES[module]])
def test_other_modules_have_names(module: str, name: str) -> None:
    assert found(f"{module}.{name}") is not None


def test_star_import_gives_the_public_names() -> None:
    for module in ("aerokit.dronekit", "aerokit.dronekit.lib"):
        names: dict[str, Any] = {}
        exec(f"from {module} import *", names)
        missing = [name for name in MODULE_NAMES if name not in names]
        assert missing == []


@for_each("name, base", SUBCLASSES)
def test_subclasses(name: str, base: str) -> None:
    assert issubclass(found(name), found(base))


def test_exceptions() -> None:
    assert str(dronekit.APIException("why")) == "why"
    assert issubclass(dronekit.APIException, Exception)
    assert issubclass(dronekit.TimeoutError, TimeoutError)
    assert found("lib.APIException") is found("mavlink.APIException") is dronekit.APIException


def test_pymavlink_is_reexported() -> None:
    import pymavlink.mavutil
    import pymavlink.mavwp

    assert dronekit.mavutil is pymavlink.mavutil
    assert dronekit.mavwp is pymavlink.mavwp
    assert dronekit.ardupilotmega.MAVLink_mission_item_message is not None
    assert isinstance("text", dronekit.basestring)


# ----------------------------------------------------------------------------------- signatures


@for_each("path", SIGNATURES)
def test_signature(path: str) -> None:
    """Everybody's calls work: the same arguments in the same order, with the same defaults."""
    wanted = SIGNATURES[path]
    if path in ("APIException", "Command"):  # of Exception, of pymavlink
        found(path)(*[1] * len(wanted))
        return
    own = [
        parameter
        for name, parameter in inspect.signature(found(path)).parameters.items()
        if name != "self" and parameter.kind not in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD)
    ]
    by_position = [parameter for parameter in own if parameter.kind is not parameter.KEYWORD_ONLY]
    assert [parameter.name for parameter in by_position[: len(wanted)]] == list(wanted)
    assert all(parameter.default is not parameter.empty for parameter in own[len(wanted) :])
    for parameter in by_position[: len(wanted)]:
        is_required = parameter.default is parameter.empty
        default = ... if is_required else getattr(parameter.default, "__name__", parameter.default)
        assert default == wanted[parameter.name], parameter.name


@pytest.mark.parametrize("name", ["add_attribute_listener", "remove_attribute_listener"])
def test_signature_of_parameter_listeners(name: str) -> None:
    inspect.signature(getattr(dronekit.Parameters, name)).bind(None, "thr_min", print)


def test_signature_of_wait_ready() -> None:
    options = {
        "timeout": 1,
        "raise_exception": False,
        "still_waiting_callback": None,
        "still_waiting_interval": 1,
    }
    signature = inspect.signature(dronekit.Vehicle.wait_ready)
    signature.bind(None)
    signature.bind(None, True)
    signature.bind(None, "mode", "armed", **options)
    inspect.signature(dronekit.Parameters.wait_ready).bind(None, **options)
    inspect.signature(dronekit.CommandSequence.wait_ready).bind(None, **options)


@for_each("owner, name", [(owner, name) for owner in ATTRIBUTES for name in ATTRIBUTES[owner].split()])
def test_attribute(notified: Stage, owner: str, name: str) -> None:
    vehicle = notified.vehicle
    objects = {
        "Attitude": vehicle.attitude,
        "Battery": vehicle.battery,
        "Channels": vehicle.channels,
        "CommandSequence": vehicle.commands,
        "GPSInfo": vehicle.gps_0,
        "Gimbal": vehicle.gimbal,
        "LocationGlobal": vehicle.location.global_frame,
        "LocationGlobalRelative": vehicle.location.global_relative_frame,
        "LocationLocal": vehicle.location.local_frame,
        "Locations": vehicle.location,
        "Rangefinder": vehicle.rangefinder,
        "SystemStatus": vehicle.system_status,
        "Vehicle": vehicle,
        "VehicleMode": vehicle.mode,
        "Version": vehicle.version,
    }
    assert isinstance(objects[owner], found(owner))
    assert getattr(objects[owner], name) is not None


# --------------------------------------------------------------------------------------- values


def test_values_of_a_vehicle(notified: Stage) -> None:
    vehicle = notified.vehicle
    assert str(vehicle.attitude) == "Attitude:pitch=0.5,yaw=-0.5,roll=0.25"
    assert str(vehicle.battery) == "Battery:voltage=12.587,current=1.5,level=77"
    assert str(vehicle.gps_0) == "GPSInfo:fix=3,num_sat=10"
    assert str(vehicle.rangefinder) == "Rangefinder: distance=0.5, voltage=0.25"
    assert str(vehicle.system_status) == "SystemStatus:STANDBY"
    assert str(vehicle.mode) == "VehicleMode:GUIDED"
    assert str(vehicle.version) == "APM:Copter-4.5.3"
    assert str(vehicle.gimbal) == "Gimbal: pitch=-45.0, roll=1.0, yaw=90.0"
    assert vehicle.mount_status == [-45.0, 90.0, 1.0]
    assert vehicle.velocity == [0.1, -0.2, 0.3]
    assert (vehicle.airspeed, vehicle.groundspeed, vehicle.heading) == (3.0, 4.0, 271)
    assert (vehicle.armed, vehicle.is_armable, vehicle.ekf_ok) == (False, True, True)
    assert vehicle.location.local_frame.distance_home() == 13.0
    assert vehicle.channels == {str(number): 1000 + number for number in range(1, 9)}
    assert vehicle.channels.count == 8
    assert 0 <= vehicle.last_heartbeat < 10


def test_capabilities(notified: Stage) -> None:
    names = (
        *("mission_float", "param_float", "mission_int", "command_int", "param_union", "ftp"),
        *(
            "set_attitude_target",
            "set_attitude_target_local_ned",
            "set_altitude_target_global_int",
            "terrain",
        ),
        *("set_actuator_target", "flight_termination", "compass_calibration"),
    )
    for bit, name in enumerate(names):
        one = dronekit.Capabilities(1 << bit)
        assert [name for name in names if getattr(one, name)] == [name]
        assert getattr(one, name) is True
    assert notified.vehicle.capabilities.mission_int is True
    assert notified.vehicle.capabilities.ftp is False


def test_version_numbers() -> None:
    rc = dronekit.Version(0x030300D7, 3, 2)
    assert (rc.major, rc.minor, rc.patch, rc.release) == (3, 3, 0, 0xD7)
    assert (rc.release_type(), rc.release_version(), rc.is_stable()) == ("rc", 23, False)
    assert dronekit.Version(0x030302FF, 3, 2).is_stable()


def test_modes_and_states_equality() -> None:
    for kind in (dronekit.VehicleMode, dronekit.SystemStatus):
        one = kind("ACTIVE")
        assert one == kind("ACTIVE")
        assert one == "ACTIVE"
        assert one == one
        assert one != kind("OTHER")
        assert one != "OTHER"
        assert one != None  # noqa: E711


@pytest.mark.parametrize("kind", [dronekit.LocationGlobal, dronekit.LocationGlobalRelative])
def test_locations_compare_by_identity_and_are_mutable(kind: Any) -> None:
    one = kind(1.0, 2.0)
    one.alt = 3.0
    assert (one.lat, one.lon, one.alt, one.local_frame, one.global_frame) == (1.0, 2.0, 3.0, None, None)


# -------------------------------------------------------------------------------- mapping methods


def test_channels_are_a_dict(notified: Stage) -> None:
    channels = notified.vehicle.channels
    whole = {str(number): 1000 + number for number in range(1, 9)}
    assert dict in type(channels).__mro__
    assert channels.copy() == whole
    assert (channels.get("1"), channels.get("99"), channels.get("99", 7)) == (1001, None, 7)
    assert (channels.has_key("1"), channels.has_key("99")) == (True, False)
    assert list(channels.items()) == list(channels.iteritems()) == list(channels.viewitems()) == list(whole.items())
    assert list(channels.keys()) == list(channels.iterkeys()) == list(channels.viewkeys()) == list(whole)
    assert list(channels.values()) == list(channels.itervalues()) == list(channels.viewvalues())
    assert list(channels.values()) == list(whole.values())
    assert channels.fromkeys(["1", "2"], 5) == {"1": 5, "2": 5}
    assert str(channels) == str(whole)


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("__setitem__", ("1", 5)),
        ("__delitem__", ("1",)),
        ("clear", ()),
        ("pop", ("1",)),
        ("popitem", ()),
        ("setdefault", ("77", 5)),
        ("update", ({"1": 5},)),
    ],
)
def test_channels_reject_writing(notified: Stage, name: str, arguments: tuple[Any, ...]) -> None:
    before = dict(notified.vehicle.channels)
    with pytest.raises(TypeError):
        getattr(notified.vehicle.channels, name)(*arguments)
    assert dict(notified.vehicle.channels) == before


def test_overrides_are_a_dict(stage: Stage) -> None:
    channels = stage.vehicle.channels
    channels.overrides = {"1": 1100, 2: 1200}
    overrides = channels.overrides
    assert dict in type(overrides).__mro__
    assert type(overrides) is dronekit.ChannelsOverride
    assert overrides.copy() == overrides == {"1": 1100, "2": 1200}
    assert (overrides.get("1"), overrides.get("3"), overrides.get("3", 7)) == (1100, None, 7)
    assert (overrides.has_key("1"), overrides.has_key("3"), "2" in overrides) == (True, False, True)
    assert list(overrides.iteritems()) == list(overrides.viewitems()) == [("1", 1100), ("2", 1200)]
    assert list(overrides.iterkeys()) == list(overrides.viewkeys()) == ["1", "2"]
    assert list(overrides.itervalues()) == list(overrides.viewvalues()) == [1100, 1200]
    assert overrides.setdefault("3", 1300) == 1300
    assert overrides.setdefault("3", 1400) == 1300
    overrides.update({"4": 1400}, **{"5": 1500})
    assert (overrides.pop("5"), overrides.pop("5", 9)) == (1500, 9)
    assert caught(lambda: overrides.pop("5")) == "KeyError: '5'"
    assert overrides.popitem() == ("4", 1400)
    assert dict(overrides.fromkeys(["1"], 5)) == {"1": 5}
    overrides.clear()
    assert dict(channels.overrides) == {}
    assert caught(overrides.popitem).startswith("KeyError")


def test_parameters_are_a_mapping(stage: Stage) -> None:
    parameters = stage.vehicle.parameters
    whole = {"BAR": 2.5, "FOO": 1.0, "THR_MIN": 130.0}
    assert dict(parameters) == whole
    assert sorted(parameters.keys()) == sorted(parameters.iterkeys()) == sorted(parameters.viewkeys()) == sorted(whole)
    assert sorted(parameters.items()) == sorted(parameters.iteritems()) == sorted(parameters.viewitems())
    assert sorted(parameters.values()) == sorted(parameters.itervalues()) == sorted(parameters.viewvalues())
    assert sorted(parameters.values()) == sorted(whole.values())
    assert (parameters.has_key("foo"), parameters.has_key("NOPE")) == (True, False)
    assert parameters.setdefault("FOO", 9) == 1.0
    parameters.update({"FOO": 4}, BAR=5)
    assert (parameters["FOO"], parameters["BAR"]) == (4.0, 5.0)
    for remove in (lambda: parameters.pop("FOO"), parameters.popitem, parameters.clear):
        assert caught(remove) == "APIException: Cannot delete value from parameters list."
    assert parameters.pop("NOPE", 7) == 7
    assert parameters.wait_ready() is None


# --------------------------------------------------------------------------------- other classes


def test_command_is_mission_item() -> None:
    command = dronekit.Command(0, 0, 0, 3, 16, 0, 0, 1, 2, 3, 4, -34.25, 149.5, 30)
    assert (command.frame, command.command, command.x, command.y, command.z) == (3, 16, -34.25, 149.5, 30)
    assert (command.param1, command.param2, command.param3, command.param4) == (1, 2, 3, 4)
    assert (command.seq, command.current, command.autocontinue, command.target_system) == (0, 0, 0, 0)
    assert command.get_type() == "MISSION_ITEM"
    assert command.format_attr("z") == 30
    assert str(command).startswith("MISSION_ITEM {target_system : 0, target_component : 0, seq : 0, frame : 3, ")
    command.z = 40
    assert command.z == 40


def test_own_observers() -> None:
    class Mine(dronekit.HasObservers):
        pass

    mine, calls = Mine(), []

    @mine.on_attribute("size")
    def listener(source: Any, name: str, value: Any) -> None:
        calls.append((source is mine, name, value))

    for value in (1, 1, 2):
        mine.notify_attribute_listeners("size", value, cache=True)
    assert calls == [(True, "size", 1), (True, "size", 2)]


def test_errprinter(capsys: pytest.CaptureFixture[str]) -> None:
    dronekit.util.errprinter("one", 2)
    dronekit.util.logger("three")
    printed: list[str] = []
    handler = dronekit.ErrprinterHandler(printed.append)
    handler.emit(logging.LogRecord("autopilot", logging.INFO, "", 0, "text %d", (4,), None))
    assert capsys.readouterr().err.split("\n") == ["one 2", "three", ""]
    assert printed == ["text 4"]


def test_still_waiting_callback_logs(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.DEBUG, "dronekit"):
        dronekit.default_still_waiting_callback(["a", "b"])
    assert caplog.record_tuples == [("dronekit", logging.DEBUG, "Still waiting for data from vehicle: a,b")]


def test_listeners_of_locations_get_the_locations(stage: Stage) -> None:
    events = stage.listen("global_frame", "*", to=stage.vehicle.location)
    stage.report("GLOBAL_POSITION_INT", **POSITION)
    names = ["global_relative_frame", "global_frame", "global_frame"]
    assert [(source, name) for source, name, _ in events] == [("Locations", name) for name in names]
