"""Streams, messages, sensors, boot texts and modes of each kind, compared with recordings of ArduPilot 4.7-dev."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
from simulated_client import Client, set_mode
from vehicles import flying_plane

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import (
    CopterMode,
    MavCmd,
    MavDataStream,
    MavResult,
    MavState,
    PlaneMode,
    RoverMode,
    SubMode,
)
from aerokit.sim import SimulatedCopter, SimulatedPlane, SimulatedRover, SimulatedSub
from aerokit.sim.ardupilot.copter_guided import CopterGuided, GuidedSubmode
from aerokit.sim.ardupilot.telemetry import BUILDERS_OF_KIND
from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle

CLASSES: dict[str, type[ArduPilotVehicle]] = {
    "copter": SimulatedCopter,
    "plane": SimulatedPlane,
    "rover": SimulatedRover,
    "sub": SimulatedSub,
}
every_kind = pytest.mark.parametrize("kind", CLASSES)

IN_ALL_STREAMS = {
    "SYS_STATUS", "SYSTEM_TIME", "GPS_RAW_INT", "RAW_IMU", "SCALED_PRESSURE", "ATTITUDE", "LOCAL_POSITION_NED",
    "GLOBAL_POSITION_INT", "SERVO_OUTPUT_RAW", "MISSION_CURRENT", "RC_CHANNELS", "VFR_HUD", "SCALED_IMU2",
    "POWER_STATUS", "SCALED_IMU3", "SCALED_PRESSURE2", "BATTERY_STATUS", "MEMINFO", "AHRS", "SIMSTATE", "AHRS2",
    "EKF_STATUS_REPORT", "VIBRATION",
}  # fmt: skip
FLYING = {"WIND", "TERRAIN_REPORT", "TERRAIN_REQUEST", "ESC_TELEMETRY_1_TO_4"}
OWN_STREAMS = {
    "copter": FLYING | {"NAV_CONTROLLER_OUTPUT"},
    "plane": FLYING | {"AIRSPEED", "AOA_SSA"},
    "rover": {"RC_CHANNELS_SCALED"},
    "sub": {
        "NAV_CONTROLLER_OUTPUT",
        "TERRAIN_REPORT",
        "SCALED_PRESSURE3",
        "NAMED_VALUE_FLOAT",
        "GIMBAL_DEVICE_ATTITUDE_STATUS",
    },
}  # fmt: skip
"""Disarmed, in the mode in which it wakes up. The real sub has a range finder in addition."""


def booted(kind: str, **options: object) -> tuple[ArduPilotVehicle, Client]:
    vehicle = CLASSES[kind](boot_time_s=0.0, **options)  # type: ignore[arg-type]
    client = Client(vehicle)
    client.run(3.0)
    client.clear()
    return vehicle, client


def all_streams(client: Client, rate: int) -> None:
    client.send(m.RequestDataStream(1, 1, MavDataStream.ALL, rate, 1))


# --------------------------------------------------------------------------------------- streams


@every_kind
def test_all_streams_match_recording(kind: str) -> None:
    _, client = booted(kind)
    all_streams(client, 4)
    client.run(3.0)
    received = {message.NAME for _, message in client.received}
    assert received - {"HEARTBEAT", "PARAM_VALUE"} == IN_ALL_STREAMS | OWN_STREAMS[kind]


@pytest.mark.parametrize(
    ("kind", "rates"),
    [
        ("copter", {}),
        ("plane", {m.Attitude: 1, m.SysStatus: 1, m.VfrHud: 1, m.Airspeed: 1}),
        ("rover", {m.Attitude: 1, m.SysStatus: 1, m.VfrHud: 1, m.RcChannelsScaled: 1}),
        ("sub", {m.Attitude: 10, m.SysStatus: 2, m.VfrHud: 10, m.SystemTime: 3, m.NamedValueFloat: 18}),
    ],
)
def test_stream_parameters_start_streams_at_boot(kind: str, rates: dict[type, int]) -> None:
    _, client = booted(kind)
    client.run(4.0)
    counts = {message: len(client.all(message)) / 4.0 for message in rates}
    assert counts == pytest.approx(rates, abs=0.5)
    if not rates:
        assert {message.NAME for _, message in client.received} == {"HEARTBEAT"}


def test_plane_saves_and_announces_requested_rates() -> None:
    plane, client = booted("plane")
    client.send(m.RequestDataStream(1, 1, MavDataStream.EXTRA1, 5, 1))
    client.run(0.1)
    value = client.last(m.ParamValue)
    assert (value.param_id, value.param_value, value.param_index) == ("MAV1_EXTRA1", 5.0, 0xFFFF)
    assert client.command(MavCmd.PREFLIGHT_REBOOT_SHUTDOWN, 1) == MavResult.ACCEPTED
    client.run(3.0)
    client.clear()
    client.run(2.0)
    assert len(client.all(m.Attitude)) == pytest.approx(10, abs=1)
    assert plane.parameters["MAV1_EXTRA1"] == 5.0


@pytest.mark.parametrize("kind", ["copter", "rover", "sub"])
def test_other_kinds_reset_requested_rates_at_reboot(kind: str) -> None:
    vehicle, client = booted(kind)
    before = vehicle.parameters["MAV1_EXTRA1"]
    client.send(m.RequestDataStream(1, 1, MavDataStream.EXTRA1, 25, 1))
    client.run(0.1)
    assert vehicle.parameters["MAV1_EXTRA1"] == 25.0
    assert client.all(m.ParamValue) == []
    assert client.command(MavCmd.PREFLIGHT_REBOOT_SHUTDOWN, 1) == MavResult.ACCEPTED
    client.run(3.0)
    client.clear()
    client.run(2.0)
    assert vehicle.parameters["MAV1_EXTRA1"] == before
    assert len(client.all(m.Attitude)) == pytest.approx(2 * before, abs=1)


# -------------------------------------------------------------------------- requests by message id


@every_kind
def test_supported_message_without_data_is_accepted(kind: str) -> None:
    _, client = booted(kind)
    own: set[int] = {"copter": set(), "plane": {195, 11020}, "rover": {34, 11038}, "sub": set()}[kind]
    for message_id in (*own, 124, 128, 180, 225, 9005, 10008):
        assert client.command(MavCmd.REQUEST_MESSAGE, message_id) == MavResult.ACCEPTED
        assert client.command(MavCmd.SET_MESSAGE_INTERVAL, message_id, 1e6) == MavResult.ACCEPTED
    for message_id in {3, 111, 230, 251, 300, 331, 410, 436, 34, 195, 11020, 11038} - own:
        assert client.command(MavCmd.REQUEST_MESSAGE, message_id) == MavResult.FAILED
        assert client.command(MavCmd.SET_MESSAGE_INTERVAL, message_id, 1e6) == MavResult.DENIED


@every_kind
def test_message_outside_streams_is_sent_on_request(kind: str) -> None:
    _, client = booted(kind)
    for wanted in (
        m.Hwstatus, m.ScaledImu, m.HighresImu, m.FlightInformation, m.RelayStatus, m.MissionItemReached,
        m.AttitudeQuaternion, m.ExtendedSysState,
    ):  # fmt: skip
        assert client.command(MavCmd.REQUEST_MESSAGE, wanted.ID) == MavResult.ACCEPTED
        client.run(0.05)
        assert client.all(wanted), wanted
    assert client.last(m.MissionItemReached).seq == 0xFFFF
    assert client.last(m.ExtendedSysState).landed_state == (1 if kind in ("copter", "plane") else 0)


@every_kind
def test_all_messages_encode_within_range(kind: str) -> None:
    vehicle, client = booted(kind)
    arm(client)
    client.run(1.0)
    for message_id in BUILDERS_OF_KIND[vehicle.KIND]:
        client.command(MavCmd.REQUEST_MESSAGE, message_id)
        client.run(0.05)
    assert client.last(m.Heartbeat).base_mode == vehicle.base_mode


# ---------------------------------------------------------------------------------------- sensors


@dataclass(frozen=True)
class Sensors:
    present: int
    enabled: int
    health: int


WAKING_UP = {
    "copter": Sensors(0x5371FC2F, 0x52619C2F, 0x57719C2F),
    "plane": Sensors(0x1361FC3F, 0x1261803F, 0x1331803F),
    "rover": Sensors(0x1331DC2F, 0x1221802F, 0x1331812F),
    "sub": Sensors(0x1331FD2F, 0x12219D2F, 0x13319D2F),
}
IN_MODES: dict[str, dict[int, tuple[int, int]]] = {
    "copter": {
        CopterMode.ALT_HOLD: (0x5261BC2F, 0x5771BC2F),
        CopterMode.GUIDED: (0x5261FC2F, 0x5771FC2F),
        CopterMode.LOITER: (0x5261FC2F, 0x5771FC2F),
    },
    "plane": {
        PlaneMode.STABILIZE: (0x12618C3F, 0x13318C3F),
        PlaneMode.FLY_BY_WIRE_A: (0x12618C3F, 0x13318C3F),
        PlaneMode.CIRCLE: (0x1261FC3F, 0x1331FC3F),
        PlaneMode.LOITER: (0x1261FC3F, 0x1331FC3F),
    },
    "rover": {
        RoverMode.ACRO: (0x12218C2F, 0x13318D2F),
        RoverMode.HOLD: (0x1221802F, 0x1331812F),
        RoverMode.LOITER: (0x1221DC2F, 0x1331DD2F),
    },
    "sub": {
        SubMode.STABILIZE: (0x12219D2F, 0x13319D2F),
        SubMode.ALT_HOLD: (0x1221FD2F, 0x1331FD2F),
        SubMode.POSHOLD: (0x1221FD2F, 0x1331FD2F),
    },
}
"""Mode → enabled and healthy."""


def sensors(client: Client) -> Sensors:
    client.command(MavCmd.REQUEST_MESSAGE, m.SysStatus.ID)
    client.run(0.05)
    status = client.last(m.SysStatus)
    return Sensors(
        status.onboard_control_sensors_present,
        status.onboard_control_sensors_enabled,
        status.onboard_control_sensors_health,
    )


@every_kind
def test_sensor_status_matches_recording_in_each_mode(kind: str) -> None:
    _, client = booted(kind)
    assert sensors(client) == WAKING_UP[kind]
    for mode, (enabled, health) in IN_MODES[kind].items():
        assert set_mode(client, mode) == MavResult.ACCEPTED
        assert sensors(client) == Sensors(WAKING_UP[kind].present, enabled, health), mode


def test_logging_bit_stays_fifteen_seconds_after_disarming() -> None:
    logging = 1 << 24
    _, client = booted("rover")
    assert not sensors(client).enabled & logging
    assert client.command(MavCmd.COMPONENT_ARM_DISARM, 1, 2989) == MavResult.ACCEPTED
    assert sensors(client).enabled & logging
    assert client.command(MavCmd.COMPONENT_ARM_DISARM, 0, 21196) == MavResult.ACCEPTED
    client.run(14.0)
    assert sensors(client).enabled & logging
    client.run(1.5)
    assert not sensors(client).enabled & logging


# ---------------------------------------------------------------------------------------- outputs


def outputs(client: Client, *sticks: int) -> tuple[int, ...]:
    """Override sticks from channel 1 on (0: unchanged) and return the servo outputs."""
    client.send(m.RcChannelsOverride(1, 1, *(stick or 0xFFFF for stick in sticks), *(0xFFFF,) * (8 - len(sticks))))
    client.run(0.1)
    client.command(MavCmd.REQUEST_MESSAGE, m.ServoOutputRaw.ID)
    client.run(0.05)
    message = client.last(m.ServoOutputRaw)
    return tuple(getattr(message, f"servo{number}_raw") for number in range(1, 11))


def arm(client: Client) -> None:
    assert client.command(MavCmd.COMPONENT_ARM_DISARM, 1, 2989) == MavResult.ACCEPTED


def test_copter_motors_start_after_arming_delay() -> None:
    _, client = booted("copter")
    assert outputs(client)[:5] == (1000, 1000, 1000, 1000, 0)
    arm(client)
    client.run(1.0)
    assert outputs(client)[:4] == (1000,) * 4
    client.run(1.5)
    assert outputs(client)[:4] == (1100,) * 4


def test_plane_sticks_move_surfaces_while_disarmed() -> None:
    _, client = booted("plane")
    assert outputs(client)[:5] == (1500, 1500, 1000, 1500, 0)
    assert outputs(client, 1000, 1300, 1900, 1900)[:4] == (1100, 1340, 1000, 1820)
    arm(client)
    assert outputs(client, 1500, 1500, 1900, 1500)[:4] == (1500, 1500, 1900, 1500)


def test_plane_elevator_above_middle_raises_the_nose() -> None:
    plane, client = booted("plane")
    assert set_mode(client, PlaneMode.FLY_BY_WIRE_A) == MavResult.ACCEPTED
    plane.motion.pitch_rate = 0.25
    assert outputs(client)[1] == 1700


def test_rover_sticks_move_steering_while_disarmed() -> None:
    _, client = booted("rover")
    assert outputs(client)[:5] == (1500, 0, 1500, 0, 0)
    assert outputs(client, 1300)[0] == 1320
    assert outputs(client, 1900)[0] == 1893
    assert outputs(client, 1500, 0, 1900)[2] == 1500


def test_sub_thrusters_stop_while_disarmed() -> None:
    _, client = booted("sub")
    still = (1500, 1500, 1500, 1500, 1500, 1500, 0, 1500, 0, 1500)
    assert outputs(client, 1900, 1900, 1900, 1900, 1900, 1900) == still
    arm(client)
    middle = (1500,) * 6
    assert outputs(client, *middle[:3], 1300, 1500, 1500)[:4] == (1340, 1660, 1660, 1340)
    assert outputs(client, *middle[:4], 1300, 1500)[:4] == (1660, 1660, 1340, 1340)
    assert outputs(client, *middle[:5], 1300)[:4] == (1340, 1660, 1340, 1660)
    assert outputs(client, 1500, 1300, *middle[2:])[4:6] == (1340, 1660)


# ------------------------------------------------------------------------------------------- boot


BOOT_TEXTS = {
    "plane": [


        "ArduPilot Ready", "AHRS: DCM active",
        "GPS 1: probing for u-blox at 230400 baud", "GPS 1: detected u-blox",

        "EKF3 IMU0 initialised", "EKF3 IMU1 initialised", "EKF3 IMU0 tilt alignment complete",
        "EKF3 IMU1 tilt alignment complete", "EKF3 IMU0 MAG0 initial yaw alignment complete",
        "EKF3 IMU1 MAG0 initial yaw alignment complete",

        "EKF3 IMU0 origin set", "EKF3 IMU1 origin set", "Field Elevation Set: 584m", "EKF3 IMU0 is using GPS",
        "EKF3 IMU1 is using GPS", "AHRS: EKF3 active",
    ],
    "rover": [


        "ArduPilot Ready", "AHRS: DCM active", "EKF3 IMU0 initialised",
        "EKF3 IMU1 initialised", "EKF3 IMU0 tilt alignment complete", "EKF3 IMU1 tilt alignment complete",
        "EKF3 IMU0 MAG0 initial yaw alignment complete", "EKF3 IMU1 MAG0 initial yaw alignment complete",
        "GPS 1: probing for u-blox at 230400 baud", "GPS 1: detected u-blox", "EKF3 IMU0 origin set",
        "EKF3 IMU1 origin set", "Field Elevation Set: 584m", "EKF3 IMU0 is using GPS", "EKF3 IMU1 is using GPS",
        "AHRS: EKF3 active",
    ],
    "sub": [

        "ArduPilot Ready", "AHRS: DCM active", "EKF3 IMU0 initialised",
        "EKF3 IMU1 initialised", "AHRS: EKF3 active", "EKF3 IMU0 tilt alignment complete",
        "EKF3 IMU1 tilt alignment complete", "EKF3 IMU0 MAG0 initial yaw alignment complete",
        "EKF3 IMU1 MAG0 initial yaw alignment complete", "GPS 1: probing for u-blox at 230400 baud",
        "GPS 1: detected u-blox", "EKF3 IMU0 origin set", "EKF3 IMU1 origin set", "EKF3 IMU0 is using GPS",
        "EKF3 IMU1 is using GPS",
    ],
}  # fmt: skip
POSITION_AT = {"plane": 20.15, "rover": 42.05, "sub": 41.0}


@pytest.mark.parametrize("kind", BOOT_TEXTS)
def test_boot_matches_recording(kind: str) -> None:
    real_time = POSITION_AT[kind]
    client = Client(CLASSES[kind](boot_time_s=real_time))
    all_streams(client, 0)
    client.send(m.RequestDataStream(1, 1, MavDataStream.EXTRA3, 4, 1))
    client.run(46.0)
    assert [text for text in client.texts if not text.startswith(("PreArm", "MYGCS"))] == BOOT_TEXTS[kind]
    modes = dict.fromkeys((beat.custom_mode, beat.system_status) for beat in client.all(m.Heartbeat))
    if kind != "sub":
        assert next(iter(modes)) == (16, MavState.CALIBRATING)
    flags = dict.fromkeys(report.flags for report in client.all(m.EkfStatusReport))
    assert list(flags) == [1024, 0, 167, 831]
    first = next(
        now for now, message in client.received if isinstance(message, m.EkfStatusReport) and message.flags == 831
    )
    assert first == pytest.approx(real_time, abs=0.3)
    home = next(now for now, message in client.received if isinstance(message, m.HomePosition))
    assert home == pytest.approx(19.2 if kind == "sub" else 9.5, abs=0.6)


# --------------------------------------------------------------------------------------- commands

A, F, D, U = MavResult.ACCEPTED, MavResult.FAILED, MavResult.DENIED, MavResult.UNSUPPORTED
ANSWERS: dict[tuple[int, ...], tuple[int, int, int, int]] = {
    (MavCmd.DO_SET_SERVO, 9, 1600): (A, A, A, A),
    (MavCmd.DO_SET_SERVO, 1, 1600): (F, F, F, F),
    (MavCmd.DO_SET_SERVO, 99, 1600): (F, F, F, F),
    (MavCmd.DO_SET_RELAY, 0, 1): (A, A, A, A),
    (MavCmd.DO_SET_RELAY, 9, 1): (F, F, F, F),
    (MavCmd.DO_AUX_FUNCTION, 9, 2): (A, A, A, A),
    (MavCmd.DO_AUX_FUNCTION, 9, 7): (D, D, D, D),
    (MavCmd.DO_AUX_FUNCTION, 999, 2): (F, F, F, F),
    (MavCmd.DO_AUX_FUNCTION, 0, 0): (F, F, A, F),
    (MavCmd.DO_PARACHUTE, 0): (A, A, U, U),
    (MavCmd.DO_SPRAYER, 1): (A, F, A, F),
    (MavCmd.DO_GRIPPER, 1): (F, F, F, F),
    (MavCmd.DO_SET_REVERSE, 1): (U, U, A, U),
    (MavCmd.DO_FOLLOW, 0): (D, D, D, U),
    (MavCmd.DO_LAND_START, 0): (F, F, U, U),
    (MavCmd.DO_VTOL_TRANSITION, 4): (U, F, U, U),
    (MavCmd.DO_CHANGE_SPEED, 2, 5): (F, F, D, D),
    (MavCmd.DO_FLIGHTTERMINATION, 0): (F, F, U, F),
    (MavCmd.SET_EKF_SOURCE_SET, 1): (A, A, A, A),
    (MavCmd.SET_EKF_SOURCE_SET, 9): (D, D, D, D),
    (MavCmd.PREFLIGHT_STORAGE, 1): (D, D, D, D),
    (MavCmd.BATTERY_RESET, 1, 50): (A, A, A, A),
}
"""Command and parameters → what Copter, Plane, Rover and Sub answered, disarmed."""


@every_kind
def test_command_results_match_recording(kind: str) -> None:
    vehicle, client = booted(kind)
    number = list(CLASSES).index(kind)
    answers = {request: client.command(*request) for request in ANSWERS}
    assert answers == {request: results[number] for request, results in ANSWERS.items()}
    assert vehicle.battery.percent == 50.0


def test_servo_and_relay_commands_show_in_telemetry() -> None:
    _, client = booted("plane")
    assert client.command(MavCmd.DO_SET_SERVO, 9, 1600) == A
    assert client.command(MavCmd.DO_SET_SERVO, 1, 1600) == F
    assert client.command(MavCmd.DO_SET_RELAY, 0, 1) == A
    assert client.command(MavCmd.REQUEST_MESSAGE, m.RelayStatus.ID) == A
    assert outputs(client)[:9] == (1500, 1500, 1000, 1500, 0, 0, 0, 0, 1600)
    assert (client.last(m.RelayStatus).on, client.last(m.RelayStatus).present) == (1, 1)
    assert "ServoRelayEvent: Channel 1 is already in use" in client.texts


def test_plane_refuses_vtol_modes_and_auto_without_mission_returns() -> None:
    plane, client = booted("plane")
    assert set_mode(client, PlaneMode.QLOITER) == F
    client.run(0.1)
    assert client.texts[-1] == "Q_ENABLE 0"
    assert set_mode(client, PlaneMode.AUTOLAND) == F
    client.run(0.1)
    assert client.texts[-1] == "Flight mode change failed"
    assert set_mode(client, PlaneMode.AUTO) == A
    client.run(0.1)
    assert plane.mode.number == PlaneMode.RTL
    assert client.texts[-1] == "Mission complete, changing mode to RTL"
    assert "FLY_BY_WIRE_A" in {mode.mode_name for mode in plane.available_modes()}


# ------------------------------------------------------------------------------------------ modes


COPTER_REFUSES = {
    CopterMode.FLIP: ["Mode change to FLIP failed: init failed"],
    CopterMode.AUTOTUNE: ["Mode change to AUTOTUNE failed: init failed"],
    CopterMode.FLOWHOLD: ["Mode change to FLOWHOLD failed: init failed"],
    CopterMode.FOLLOW: ["Set FOLL_ENABLE = 1", "Mode change to FOLLOW failed: init failed"],
    CopterMode.SYSTEMID: ["No axis selected, SID_AXIS = 0", "Mode change to SYSTEMID failed: init failed"],
    CopterMode.AUTO_RTL: [
        "Unable to start landing sequence",
        "Mode change to AUTO RTL failed: No return path or landing sequence found",
    ],
    CopterMode.TURTLE: ["Mode change to TURTLE failed: init failed"],
}
MODES = {
    "copter": [27, 3, 1, 0, 2, 7, 5, 4, 9, 6, 11, 14, 15, 16, 17, 18, 19, 20, 21, 22, 23, 24, 25, 28],
    "plane": [0, 1, 2, 3, 4, 5, 6, 7, 8, 10, 11, 12, 14, 15, 16, 13, 24, 26],
}


@pytest.mark.parametrize("kind", MODES)
def test_available_modes_match_recording(kind: str) -> None:
    _, client = booted(kind)
    client.command(MavCmd.REQUEST_MESSAGE, m.AvailableModes.ID, 0)
    client.run(0.1)
    assert [mode.custom_mode for mode in client.all(m.AvailableModes)] == MODES[kind]


def test_copter_enters_available_modes_on_ground() -> None:
    _, client = booted("copter")
    for number in range(31):
        client.clear()
        accepted = set_mode(client, number) == MavResult.ACCEPTED
        client.run(0.1)
        assert accepted == (number in MODES["copter"] and number not in COPTER_REFUSES), number
        if number not in MODES["copter"]:
            assert client.texts == [f"No such mode {number}"]
        elif not accepted:
            assert "".join(client.texts) == "".join(COPTER_REFUSES[CopterMode(number)])


def test_plane_refuses_unavailable_modes_on_ground() -> None:
    _, client = booted("plane")
    refused = {PlaneMode.INITIALIZING: 16, PlaneMode.THERMAL: 24}
    for number in (3, 4, 8, 14, *refused.values()):
        client.clear()
        accepted = set_mode(client, number) == MavResult.ACCEPTED
        client.run(0.1)
        assert accepted == (number not in refused.values())
        assert client.texts == {
            8: ["Started autotune", "Autotuning roll pitch yaw"],
            16: ["Flight mode change failed"],
            24: ["Flight mode change failed"],
        }.get(number, [])


def test_guided_nogps_accepts_attitude_targets_only() -> None:
    vehicle, client = booted("copter")
    assert set_mode(client, CopterMode.GUIDED_NOGPS) == MavResult.ACCEPTED
    assert isinstance(vehicle.mode, CopterGuided)
    lean = m.SetAttitudeTarget(0, 1, 1, 0x07, (0.9962, 0.0872, 0.0, 0.0), 0.0, 0.0, 0.0, 0.5)
    client.send(m.SetPositionTargetLocalNed(0, 1, 1, 1, 0xDF8, 5.0, 0, -5.0, 0, 0, 0, 0, 0, 0, 0, 0))
    assert vehicle.mode.submode != GuidedSubmode.POSITION
    client.send(lean)
    assert vehicle.mode.submode == GuidedSubmode.ATTITUDE


def test_motor_of_plane_takes_whole_battery_current() -> None:
    plane, client = flying_plane()
    client.command(MavCmd.REQUEST_MESSAGE, m.EscTelemetry1To4.ID)
    client.run(0.1)
    assert sum(client.last(m.EscTelemetry1To4).current) == pytest.approx(plane.battery.current_a * 100, rel=0.05)
