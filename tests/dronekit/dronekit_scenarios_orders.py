"""Scenarios: orders and the messages that they send."""

from __future__ import annotations

import math
from typing import Any

from dronekit_stage import Stage, caught, scenario
from flight_controller_services import Item

HOME = Item(16, -35.363261, 149.16523, 584.0, 0)
GOTO = ("MISSION_ITEM", "COMMAND_INT", "SET_POSITION_TARGET_GLOBAL_INT")
"""Commands for a destination: DroneKit's, and the better one."""
REPOSITION = 192

# ---------------------------------------------------------------------------------------- modes


@scenario([[(176, 1, 5, 0, 0, 0, 0, 0)]] * 3)
def row_04_mode(stage: Stage) -> Any:
    observed = []
    for value in ("LOITER", stage.dronekit.VehicleMode("LOITER"), 5):
        stage.fc.custom_mode = 0
        stage.beat()
        observed.append(stage.commands_of(stage.assign("mode", value)))
    return observed


@scenario(
    [[(176, 29, 4, 4, 0, 0, 0, 0)], [(176, 29, 6, 0, 0, 0, 0, 0)]],
    controller={"autopilot": 12, "mode": 3 << 16},
)
def row_04_mode_of_px4(stage: Stage) -> Any:
    return [stage.commands_of(stage.assign("mode", name)) for name in ("MISSION", "OFFBOARD")]


@scenario(("KeyError: 'NOPE'", "KeyError: 'NOPE'", []))
def row_05_unknown_mode(stage: Stage) -> Any:
    texts: list[str] = []

    def order() -> None:
        texts.append(caught(stage.assign("mode", "NOPE")))
        texts.append(caught(stage.assign("mode", stage.dronekit.VehicleMode("NOPE"))))

    sent = stage.commands_of(order)
    return *texts, sent


@scenario(("TimeoutError: failed to set flight mode", [(176, 1, 3, 0, 0, 0, 0, 0)], "None", "AUTO"), is_slow=True)
def row_09_wait_for_mode(stage: Stage) -> Any:
    stage.fc.results[176] = 4
    text = ""

    def order() -> None:
        nonlocal text
        text = caught(lambda: stage.vehicle.wait_for_mode("AUTO", timeout=2))

    sent = stage.commands_of(order)
    del stage.fc.results[176]
    return (
        text[:39],
        sent,
        caught(lambda: stage.vehicle.wait_for_mode("AUTO", timeout=50)),
        stage.vehicle.mode.name,
    )


# --------------------------------------------------------------------------------------- arming


@scenario(([], [(400, 1)], [], [(400, 0)]))
def row_07_armed(stage: Stage) -> Any:
    observed = [stage.commands_of(stage.assign("armed", False)), stage.commands_of(stage.assign("armed", True))]
    stage.settle()
    observed += [stage.commands_of(stage.assign("armed", True)), stage.commands_of(stage.assign("armed", False))]
    return tuple([frame[:2] for frame in frames] for frames in observed)


@scenario(("TimeoutError: failed to arm vehicle", [(400, 1)]), is_slow=True)
def row_08_arm_refused(stage: Stage) -> Any:
    stage.fc.results[400] = 4
    stage.fc.reasons[400] = "PreArm: Compass not healthy"
    text = ""

    def order() -> None:
        nonlocal text
        text = caught(lambda: stage.vehicle.arm(timeout=2))

    sent = stage.commands_of(order)
    return text[:35], [frame[:2] for frame in sent]


@scenario(("None", True, "None", False))
def arm_and_disarm(stage: Stage) -> Any:
    vehicle = stage.vehicle
    armed = caught(lambda: vehicle.arm(timeout=50)), vehicle.armed
    return *armed, caught(lambda: vehicle.disarm(timeout=50)), vehicle.armed


# --------------------------------------------------------------------------------------- flying


@scenario(
    (
        [],
        [(22, 0, 0, 0, 0, 0, 0, 12)],
        [(22, 0, 0, 0, 0, 0, 0, 12)],
        ["ValueError: Altitude was NaN or Infinity. Please provide a real number"] * 2,
        [],
    )
)
def row_10_takeoff(stage: Stage) -> Any:
    take_off = stage.vehicle.simple_takeoff
    texts: list[str] = []

    def refused() -> None:
        texts.extend(caught(lambda value=value: take_off(value)) for value in (math.nan, math.inf))  # type: ignore[misc]

    return (
        stage.commands_of(take_off),
        stage.commands_of(lambda: take_off(12)),
        stage.commands_of(lambda: take_off("12")),
        texts,
        stage.commands_of(refused),
    )


def places(stage: Stage, location: Any, **speeds: float) -> list[tuple[Any, ...]]:
    """Return what ``simple_goto`` sent: positions as ``("goto", lat, lon, alt above home)``, commands unchanged."""
    observed: list[tuple[Any, ...]] = []
    names = (*GOTO, "COMMAND_LONG")
    for frame in stage.sent_by(lambda: stage.vehicle.simple_goto(location, **speeds), *names):
        if frame.name == "MISSION_ITEM":
            assert (frame.frame, frame.command, frame.current) == (3, 16, 2)
            observed.append(("goto", round(frame.x, 4), round(frame.y, 4), round(frame.z, 3)))
        elif frame.name == "COMMAND_INT":
            assert (frame.frame in (3, 6), frame.command) == (True, REPOSITION)
            observed.append(("goto", round(frame.x / 1e7, 4), round(frame.y / 1e7, 4), round(frame.z, 3)))
        elif frame.name == "SET_POSITION_TARGET_GLOBAL_INT":
            observed.append(("goto", round(frame.lat_int / 1e7, 4), round(frame.lon_int / 1e7, 4), round(frame.alt, 3)))
        elif frame.command == 178:
            observed.append((frame.command, *frame.params[:3]))
    return observed


@scenario([("goto", -35.1, 149.2, 20.0), (178, 0, 5, -1), (178, 1, 3, -1)], controller={"mode": 4})
def row_11_goto(stage: Stage) -> Any:
    stage.settle()
    place = stage.dronekit.LocationGlobalRelative(-35.1, 149.2, 20)
    return places(stage, place, airspeed=5, groundspeed=3)


@scenario(
    (
        [("goto", -35.1, 149.2, 16.0)],
        "ValueError: Expecting location to be LocationGlobal or LocationGlobalRelative.",
        "LocationGlobal",
    ),
    controller={"mode": 4},
    prepare=lambda fc: fc.missions.items.append(HOME),
)
def row_12_goto_above_the_sea(stage: Stage) -> Any:
    sent = places(stage, stage.dronekit.LocationGlobal(-35.1, 149.2, 600))
    text = caught(lambda: stage.vehicle.simple_goto((1, 2, 3)))
    return sent, text, type(stage.vehicle.home_location).__name__


@scenario(([(178, 1, 7, -1)], [(178, 0, 8.5, -1)], 4.0, 3.0))
def row_13_speeds(stage: Stage) -> Any:
    stage.report("VFR_HUD", airspeed=3, groundspeed=4)
    ground = stage.commands_of(stage.assign("groundspeed", 7))
    air = stage.commands_of(stage.assign("airspeed", 8.5))
    vehicle = stage.vehicle
    return [frame[:4] for frame in ground], [frame[:4] for frame in air], vehicle.groundspeed, vehicle.airspeed


@scenario(
    (
        [(179, 0, -35.1, 149.2, 600.0)],
        "LocationGlobal:lat=-35.1,lon=149.2,alt=600",
        False,
        "ValueError: Expecting home_location to be set to a LocationGlobal.",
    )
)
def row_14_setting_home(stage: Stage) -> Any:
    place = stage.dronekit.LocationGlobal(-35.1, 149.2, 600)
    stage.report("HOME_POSITION", latitude=-353632610, longitude=1491652300, altitude=584000)
    (sent,) = stage.sent_by(stage.assign("home_location", place))
    x, y, z = sent.params[4:]
    scale = 1e7 if sent.name == "COMMAND_INT" else 1
    home = stage.vehicle.home_location
    home.lat, home.lon, home.alt = round(home.lat, 4), round(home.lon, 4), round(home.alt)
    relative = stage.dronekit.LocationGlobalRelative(1, 2, 3)
    return (
        [(sent.command, sent.param1, round(x / scale, 4), round(y / scale, 4), z)],
        str(home),
        home is stage.vehicle.home_location,
        caught(stage.assign("home_location", relative)),
    )


@scenario(
    (
        "TimeoutError: too late",
        "None",
        "TimeoutError: failed to reach specified altitude",
        ["None", "None", "None"],
    ),
    is_slow=True,
)
def waiting(stage: Stage) -> Any:
    vehicle = stage.vehicle
    late = caught(lambda: vehicle.wait_for(lambda: False, timeout=0.2, interval=0.05, errmsg="too late"))
    done = caught(lambda: vehicle.wait_for(lambda: True))
    stage.report("GLOBAL_POSITION_INT", lat=1, lon=1, alt=5000, relative_alt=3000)
    low = caught(lambda: vehicle.wait_for_alt(10, timeout=0.3))
    at_altitude = [
        caught(lambda: vehicle.wait_for_alt(3, timeout=50)),
        caught(lambda: vehicle.wait_for_alt(3.4, epsilon=0.5, timeout=50)),
        caught(lambda: vehicle.wait_for_alt(5, rel=False, timeout=50)),
    ]
    return late, done, low, at_altitude


@scenario("TimeoutError", is_slow=True)
def wait_for_armable(stage: Stage) -> Any:
    text = caught(lambda: stage.vehicle.wait_for_armable(timeout=0.3))
    stage.fc.report("GPS_RAW_INT", fix_type=3)
    stage.report("EKF_STATUS_REPORT", flags=831)
    stage.vehicle.wait_for_armable(timeout=50)
    return text.split(":")[0]


# ---------------------------------------------------------------------------------- maintenance


@scenario(
    {
        "reboot": [(246, 1, 0, 0, 0, 0, 0, 0)],
        "gyro": [(241, 1, 0, 0, 0, 0, 0, 0)],
        "barometer": [(241, 0, 0, 1, 0, 0, 0, 0)],
        "level": [(241, 0, 0, 0, 0, 2, 0, 0)],
        "accelerometer": [(241, 0, 0, 0, 0, 1, 0, 0)],
        "accelerometer, simple": [(241, 0, 0, 0, 0, 4, 0, 0)],
        "magnetometer": [(42424, 0, 1, 1, 0, 0, 0, 0)],
    }
)
def maintenance(stage: Stage) -> Any:
    vehicle = stage.vehicle
    return {
        "reboot": stage.commands_of(vehicle.reboot),
        "gyro": stage.commands_of(vehicle.send_calibrate_gyro),
        "barometer": stage.commands_of(vehicle.send_calibrate_barometer),
        "level": stage.commands_of(vehicle.send_calibrate_vehicle_level),
        "accelerometer": stage.commands_of(vehicle.send_calibrate_accelerometer),
        "accelerometer, simple": stage.commands_of(lambda: vehicle.send_calibrate_accelerometer(simple=True)),
        "magnetometer": stage.commands_of(vehicle.send_calibrate_magnetometer),
    }


@scenario([(241, 0, 1, 0, 0, 0, 0, 0)], controller={"autopilot": 12, "mode": 3 << 16})
def magnetometer_of_px4(stage: Stage) -> Any:
    return stage.commands_of(stage.vehicle.send_calibrate_magnetometer)


@scenario(True)
def capabilities_request(stage: Stage) -> Any:
    stage.settle()
    vehicle, since = stage.vehicle, stage.fc.mark()
    vehicle.send_capabilities_request(vehicle, "HEARTBEAT", None)
    vehicle.send_capabilties_request(vehicle, "HEARTBEAT", None)
    stage.reached()
    return len([frame for frame in stage.fc.commands(520, since=since) if frame.param1 == 1]) >= 2


# ------------------------------------------------------------------------------------- messages


@scenario((1, 9, [("COMMAND_LONG", (1, 9), (1.5, 0, 0, 0, 0, 0, 7))]))
def send_mavlink(stage: Stage) -> Any:
    stage.fc.results[31000] = None
    message = stage.vehicle.message_factory.command_long_encode(0, 9, 31000, 0, 1.5, 0, 0, 0, 0, 0, 7)
    sent = stage.sent_by(lambda: stage.vehicle.send_mavlink(message))
    observed = [(frame.name, frame.target, frame.params) for frame in sent]
    return message.target_system, message.target_component, observed


@scenario((1, 2))
def messages_have_this_source(stage: Stage) -> Any:
    factory = stage.vehicle.message_factory
    message = factory.set_position_target_local_ned_encode(0, 0, 0, 1, 0b111111000111, 0, 0, 0, 1, 2, -3, 0, 0, 0, 0, 0)
    (sent,) = stage.sent_by(lambda: stage.vehicle.send_mavlink(message), "SET_POSITION_TARGET_LOCAL_NED")
    return sent.target_system, sent.vy


# ------------------------------------------------------------------------------------- channels


def channels_of(stage: Stage, action: Any) -> list[tuple[int, ...]]:
    """Channels 1 to 8 of each RC_CHANNELS_OVERRIDE."""
    sent = stage.sent_by(action, "RC_CHANNELS_OVERRIDE")
    return [tuple(getattr(frame.message, f"chan{number}_raw") for number in range(1, 9)) for frame in sent]


def override(*values: int) -> list[tuple[int, ...]]:
    return [(*values, *(0,) * (8 - len(values)))]


@scenario(
    [
        *(override(0, 200), override(0, 200, 1500), override(0, 200), override(0)),
        *(override(0, 0, 500), override(0), {}, {"1": 1100}),
    ]
)
def row_29_overrides(stage: Stage) -> Any:
    channels = stage.vehicle.channels
    observed: list[Any] = [
        channels_of(stage, lambda: channels.overrides.__setitem__("2", 200)),
        channels_of(stage, lambda: channels.overrides.__setitem__(3, 1500)),
        channels_of(stage, lambda: channels.overrides.__delitem__("3")),
        channels_of(stage, lambda: channels.overrides.__setitem__("2", None)),
        channels_of(stage, lambda: setattr(channels, "overrides", {"5": None, "3": 500})),
        channels_of(stage, lambda: setattr(channels, "overrides", {})),
        dict(channels.overrides),
    ]
    channels.overrides["1"] = 1100
    return [*observed, dict(channels.overrides)]


@scenario(("KeyError: 'Invalid channel index 9'", "KeyError: 'Invalid channel index 9'", []))
def row_30_overrides_of_no_channel(stage: Stage) -> Any:
    channels = stage.vehicle.channels
    texts: list[str] = []

    def order() -> None:
        texts.append(caught(lambda: channels.overrides.__setitem__("9", 1)))
        texts.append(caught(lambda: setattr(channels, "overrides", {"9": 900})))

    sent = channels_of(stage, order)
    return *texts, sent


@scenario(("TypeError: __setitem__ is not supported on Channels object", "KeyError: '9'", "KeyError: '2'"))
def row_31_channels_are_read(stage: Stage) -> Any:
    channels = stage.vehicle.channels
    return (
        caught(lambda: channels.__setitem__("1", 1)),
        caught(lambda: channels["9"]),
        caught(lambda: channels.overrides["2"]),
    )


# --------------------------------------------------------------------------------------- gimbal


@scenario([(201, -35.1, 149.2, 10.0)], controller={"mode": 4}, is_slow=True)
def region_of_interest_of_old_firmware(stage: Stage) -> Any:
    stage.fc.results[195] = 3  # Old firmware answers UNSUPPORTED to DO_SET_ROI_LOCATION.
    stage.vehicle.gimbal.target_location(stage.dronekit.LocationGlobalRelative(-35.1, 149.2, 10))
    sent = stage.fc.wait_for_command(201)
    return [(sent.command, *(round(p, 4) for p in sent.params[4:]))]
