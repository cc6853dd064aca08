"""Scenarios: attributes and their notifications."""

from __future__ import annotations

from operator import attrgetter
from typing import Any

from dronekit_stage import Stage, caught, scenario

POSITION = {
    "lat": -353632610,
    "lon": 1491652300,
    "alt": 584000,
    "relative_alt": 10000,
    "vx": 10,
    "vy": -20,
    "vz": 30,
}
GLOBAL = "LocationGlobal:lat=-35.363261,lon=149.16523,alt=584.0"
RELATIVE = "LocationGlobalRelative:lat=-35.363261,lon=149.16523,alt=10.0"

# ----------------------------------------------------------------------------------- connecting


@scenario(
    {
        "heartbeat": (6, 8, 0),
        "source": (255, 0),
        "stream": (1, 0, 4, 1),
        "version": (520, 1.0),
        "parameters": 1,
    },
    connect={"rate": 4},
    is_slow=True,
)
def row_01_frames_of_a_connect(stage: Stage) -> Any:
    heartbeat, stream = stage.fc.wait_for("HEARTBEAT"), stage.fc.wait_for("REQUEST_DATA_STREAM")
    version = stage.fc.wait_for_command(520)
    return {
        "heartbeat": (heartbeat.type, heartbeat.autopilot, heartbeat.base_mode),
        "source": (heartbeat.system, heartbeat.component),
        "stream": (stream.target[0], stream.req_stream_id, stream.req_message_rate, stream.start_stop),
        "version": (version.command, version.param1),
        "parameters": stage.fc.wait_for("PARAM_REQUEST_LIST").target[0],
    }


@scenario([], is_slow=True)
def row_02_no_rate_asks_for_no_streams(stage: Stage) -> Any:
    stage.fc.wait_for("HEARTBEAT")
    stage.reached()
    return stage.fc.received("REQUEST_DATA_STREAM")


@scenario((10, [(42, 7)]), connect={"rate": 10, "source_system": 42, "source_component": 7}, is_slow=True)
def row_02_rate_and_source(stage: Stage) -> Any:
    stream = stage.fc.wait_for("REQUEST_DATA_STREAM")
    stage.fc.wait_for("HEARTBEAT")
    return stream.req_message_rate, sorted({(frame.system, frame.component) for frame in stage.fc.received()})


# --------------------------------------------------------------------------------------- values


@scenario(
    {
        "armed": "False",
        "is_armable": "False",
        "ekf_ok": "False",
        "velocity": "[None, None, None]",
        "attitude": "Attitude:pitch=None,yaw=None,roll=None",
        "heading": "None",
        "airspeed": "None",
        "groundspeed": "None",
        "gps_0": "GPSInfo:fix=None,num_sat=None",
        "battery": "None",
        "rangefinder": "Rangefinder: distance=None, voltage=None",
        "gimbal": "Gimbal: pitch=None, roll=None, yaw=None",
        "mount_status": "[None, None, None]",
        "channels": str(dict.fromkeys(map(str, range(1, 9)))),
        "home_location": "None",
        "location.global_frame": "LocationGlobal:lat=None,lon=None,alt=None",
        "location.global_relative_frame": "LocationGlobalRelative:lat=None,lon=None,alt=None",
        "location.local_frame": "LocationLocal:north=None,east=None,down=None",
    },
    prepare=lambda fc: setattr(fc, "home", None),
)
def attributes_before_there_is_data(stage: Stage) -> Any:
    names = "armed is_armable ekf_ok velocity attitude heading airspeed groundspeed gps_0 battery rangefinder gimbal"
    frames = "location.global_frame location.global_relative_frame location.local_frame"
    every = [*names.split(), "mount_status", "channels", "home_location", *frames.split()]
    return {name: str(attrgetter(name)(stage.vehicle)) for name in every}


@scenario(("GUIDED", True, True, False, "VehicleMode:GUIDED"))
def row_06_mode(stage: Stage) -> Any:
    stage.fc.custom_mode = 4
    stage.beat()
    mode, other = stage.vehicle.mode, stage.dronekit.VehicleMode("GUIDED")
    return mode.name, mode == "GUIDED", mode == other, mode != "GUIDED", str(mode)


@scenario("LocationGlobal:lat=-35.363261,lon=149.16523,alt=584.0")
def row_15_home_position(stage: Stage) -> Any:
    stage.report("HOME_POSITION", latitude=-353632610, longitude=1491652300, altitude=584000)
    return str(stage.vehicle.home_location)


@scenario((GLOBAL, RELATIVE, "[0.1, -0.2, 0.3]"))
def row_16_position_and_velocity(stage: Stage) -> Any:
    stage.report("GLOBAL_POSITION_INT", **POSITION)
    location = stage.vehicle.location
    return str(location.global_frame), str(location.global_relative_frame), str(stage.vehicle.velocity)


@scenario((["location.global_relative_frame", "location", "velocity"], None))
def row_17_position_before_its_altitude(stage: Stage) -> Any:
    events = stage.listen("*")
    stage.report("GLOBAL_POSITION_INT", **{**POSITION, "alt": 0})
    names = [name for _, name, _ in events if name.startswith(("loc", "vel"))]
    return names, stage.vehicle.location.global_frame.alt


@scenario(
    (
        None,
        "Battery:voltage=12.587,current=0.0,level=100",
        "Battery:voltage=12.587,current=None,level=None",
    )
)
def row_22_battery(stage: Stage) -> Any:
    before = stage.vehicle.battery
    stage.report("SYS_STATUS", voltage_battery=12587, current_battery=0, battery_remaining=100)
    first = str(stage.vehicle.battery)
    stage.report("SYS_STATUS", voltage_battery=12587, current_battery=-1, battery_remaining=-1)
    return before, first, str(stage.vehicle.battery)


@scenario(("GPSInfo:fix=3,num_sat=10", 121, 65535, 3, 10))
def row_23_gps(stage: Stage) -> Any:
    stage.report("GPS_RAW_INT", fix_type=3, satellites_visible=10, eph=121, epv=65535)
    gps = stage.vehicle.gps_0
    return str(gps), gps.eph, gps.epv, gps.fix_type, gps.satellites_visible


@scenario(
    (3.0, 4.0, 271, "int", [("heading", "271"), ("airspeed", "3.0"), ("groundspeed", "4.0")]),
)
def row_24_vfr_hud(stage: Stage) -> Any:
    events = stage.listen("airspeed", "groundspeed", "heading")
    stage.report("VFR_HUD", airspeed=3, groundspeed=4, heading=271)
    vehicle = stage.vehicle
    notified = [(name, value) for _, name, value in events]
    return vehicle.airspeed, vehicle.groundspeed, vehicle.heading, type(vehicle.heading).__name__, notified


@scenario(
    (
        "Gimbal: pitch=-45.0, roll=1.0, yaw=90.0",
        [-45.0, 90.0, 1.0],
        (-45.0, 1.0, 90.0),
        [("mount", "[-45.0, 90.0, 1.0]"), ("gimbal", "Gimbal: pitch=-45.0, roll=1.0, yaw=90.0")],
    )
)
def row_25_gimbal(stage: Stage) -> Any:
    events = stage.listen("mount", "gimbal", "mount_status")
    stage.report("MOUNT_STATUS", pointing_a=-4500, pointing_b=100, pointing_c=9000)
    gimbal = stage.vehicle.gimbal
    notified = [(name, value) for _, name, value in events]
    return str(gimbal), stage.vehicle.mount_status, (gimbal.pitch, gimbal.roll, gimbal.yaw), notified


@scenario(
    (
        "APM:Copter-3.3.2",
        True,
        0,
        "APM:Copter-3.3.0-rc23",
        23,
        "rc",
        True,
        False,
        [("autopilot_version", "50528471")],
    )
)
def row_26_version(stage: Stage) -> Any:
    stage.reached()  # The answer to the request at connecting must not arrive after the versions below.
    stage.fc.flight_sw_version = 0x030302FF
    stage.fc.send_version(flight_sw_version=0x030302FF)
    stage.settle()
    vehicle = stage.vehicle
    stable = vehicle.version
    stage.fc.flight_sw_version = 0x030300D7
    events = stage.listen("autopilot_version", "version", "capabilities")
    stage.fc.send_version(flight_sw_version=0x030300D7)
    stage.settle()
    version, can = vehicle.version, vehicle.capabilities
    notified = [(name, value) for _, name, value in events][-1:]
    return (
        *(str(stable), stable.is_stable(), stable.release_version()),
        *(str(version), version.release_version(), version.release_type(), can.mission_int, can.ftp),
        notified,
    )


@scenario((False, False, True, True, [("ekf_ok", "True")]))
def row_27_ekf(stage: Stage) -> Any:
    vehicle = stage.vehicle
    before = vehicle.is_armable, vehicle.ekf_ok
    stage.report("GPS_RAW_INT", fix_type=3)
    events = stage.listen("ekf_ok", "is_armable")
    for _ in range(3):
        stage.report("EKF_STATUS_REPORT", flags=831)
    return *before, vehicle.is_armable, vehicle.ekf_ok, [(name, value) for _, name, value in events]


@scenario(
    {
        "flags 0": (False, False),
        "armed, absolute": (True, True),
        "armed, absolute, constant": (False, True),
        "armed, predicted": (False, True),
    }
)
def row_27_ekf_while_armed(stage: Stage) -> Any:
    observed = {}
    stage.report("GPS_RAW_INT", fix_type=3)
    stage.fc.base_mode = 129
    stage.beat()
    for name, flags in (
        ("flags 0", 0),
        ("armed, absolute", 16 | 512),
        ("armed, absolute, constant", 16 | 128 | 512),
        ("armed, predicted", 512),
    ):
        stage.report("EKF_STATUS_REPORT", flags=flags)
        observed[name] = stage.vehicle.ekf_ok, stage.vehicle.is_armable
    return observed


RAW = {f"chan{number}_raw": 1400 + 100 * number for number in range(1, 9)}


@scenario(
    (
        dict.fromkeys(map(str, range(1, 9))),
        {str(number): 1400 + 100 * number for number in range(1, 9)},
        (8, True, "KeyError: '9'"),
        (16, 1500, True, 2),
    ),
    controller={"version": 1},
)
def row_28_channels(stage: Stage) -> Any:
    channels, events = stage.vehicle.channels, stage.listen("channels")
    before = dict(channels)
    stage.report("RC_CHANNELS_RAW", port=0, **RAW)
    eight = dict(channels)
    observed = len(channels), channels[1] == channels["1"], caught(lambda: channels["9"])
    stage.report("RC_CHANNELS_RAW", port=1, **RAW)
    return before, eight, observed, (len(channels), channels[9], channels[9] == channels["9"], len(events))


@scenario(
    [
        ("Locations", "local_frame", "LocationLocal:north=1.0,east=2.0,down=-3.0"),
        ("Vehicle", "location.local_frame", "LocationLocal:north=1.0,east=2.0,down=-3.0"),
        ("Vehicle", "location", "Locations"),
    ]
)
def local_position(stage: Stage) -> Any:
    events = stage.listen("local_frame", to=stage.vehicle.location)
    stage.listen("location.local_frame", "location", into=events)
    stage.report("LOCAL_POSITION_NED", x=1, y=2, z=-3)
    return events


@scenario(
    (
        "Rangefinder: distance=0.5, voltage=0.25",
        [("rangefinder", "Rangefinder: distance=0.5, voltage=0.25")] * 2,
    )
)
def rangefinder(stage: Stage) -> Any:
    events = stage.listen("rangefinder")
    stage.fc.report("RANGEFINDER", distance=0.5, voltage=0.25)
    stage.report("RANGEFINDER", distance=0.5, voltage=0.25)
    return str(stage.vehicle.rangefinder), [(name, value) for _, name, value in events]


@scenario(["home_location", "home_location"], prepare=lambda fc: setattr(fc, "home", None))
def home_is_notified_each_time(stage: Stage) -> Any:
    events = stage.listen("home_location")
    for _ in range(2):
        stage.report("HOME_POSITION", latitude=-353632610, longitude=1491652300, altitude=584000)
    return [name for _, name, _ in events]


@scenario(
    [(status, f"SystemStatus:{status}") for status in ("BOOT", "CALIBRATING", "STANDBY", "ACTIVE", "CRITICAL")]
    + [("EMERGENCY", "SystemStatus:EMERGENCY"), ("POWEROFF", "SystemStatus:POWEROFF"), (None, None)]
)
def system_status(stage: Stage) -> Any:
    stage.fc.heartbeat_s = None
    observed = []
    for number in range(1, 9):
        stage.beat(system_status=number)
        status = stage.vehicle.system_status
        observed.append((status and status.state, status and str(status)))
    return observed


@scenario([("gimbal", "Gimbal: pitch=-45.0, roll=1.0, yaw=90.0")], controller={"version": 2}, is_kept=False)
def mount_orientation(stage: Stage) -> Any:
    """Only in MAVLink 2, which these scenarios do not use with DroneKit."""
    events = stage.listen("mount", "gimbal")
    stage.report("MOUNT_ORIENTATION", pitch=-45, roll=1, yaw=90, yaw_absolute=90)
    return [(name, value) for _, name, value in events]


@scenario([])
def messages_without_values(stage: Stage) -> Any:
    stage.settle()
    events = stage.listen("*")
    stage.fc.report("STATUSTEXT", severity=6, text=b"hello")
    stage.fc.report("COMMAND_ACK", command=31000, result=0)
    stage.fc.report("MISSION_ACK", type=0)
    stage.fc.report("MISSION_CURRENT", seq=3)
    stage.fc.beat()
    stage.settle()
    always_notified = ("autopilot_version", "home_location", "parameters")  # requested on connecting
    return [name for _, name, _ in events if name not in always_notified]
