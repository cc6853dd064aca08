"""MAV_RESULT of each command to each kind of ArduPilot, disarmed on the ground, as recorded in SITL."""

from __future__ import annotations

import math

import pytest
from simulated_client import Client

from aerokit.mavlink.enums import MavCmd, MavResult
from aerokit.sim.kinds import simulated

KINDS = ("copter", "plane", "rover", "sub")
TABLE = """
IMAGE_START_CAPTURE 0 0 1          | F F F F
IMAGE_START_CAPTURE 2 0 1          | F F F F
IMAGE_STOP_CAPTURE 0               | A A A A
DO_DIGICAM_CONTROL 0 0 0 0 1       | A A A A
DO_DIGICAM_CONFIGURE               | A A A A
DO_SET_CAM_TRIGG_DIST 0            | A A A A
SET_CAMERA_ZOOM 2 50               | U U U U
SET_CAMERA_FOCUS 2 50              | F F F F
SET_CAMERA_SOURCE 0 1              | D D D D
VIDEO_START_CAPTURE 0              | F F F F
VIDEO_STOP_CAPTURE 0               | F F F F
CAMERA_TRACK_POINT 0.5 0.5 0.1     | U U U U
SET_CAMERA_MODE 0 1                | U U U U
DO_CONTROL_VIDEO                   | U U U U
DO_MOUNT_CONFIGURE 3               | A A A A
DO_MOUNT_CONTROL -20 0 0 0 0 0 2   | A A A A
DO_GIMBAL_MANAGER_CONFIGURE -2 -2 -1 -1 | A A A A
DO_GIMBAL_MANAGER_PITCHYAW -30 0 nan nan | A A A A
DO_SET_ROI 0 0 0 0 47.4 8.55 20    | A A A A
DO_SET_ROI_LOCATION 0 0 0 0 47.4 8.55 20 | A A A A
DO_SET_ROI_NONE                    | A A A A
DO_SET_ROI_SYSID 5                 | A A A A
DO_SET_ROI_WPNEXT_OFFSET           | U U U U
DO_GUIDED_LIMITS 5                 | U U U U
GUIDED_CHANGE_SPEED 0 20 0         | U F U U
GUIDED_CHANGE_ALTITUDE             | U F U U
GUIDED_CHANGE_HEADING              | U F U U
CONDITION_YAW 90 0 1 0             | A U U A
DO_CHANGE_SPEED 1 3 -1             | F F F A
DO_REPOSITION -1 1 0 0 47.4 8.55 20 | U U U U
DO_PAUSE_CONTINUE 0                | F U U U
DO_SET_REVERSE 0                   | U U A U
DO_SET_SERVO 9 1600                | A A A A
DO_REPEAT_SERVO 9 1600 1 1         | A A A A
DO_SET_RELAY 0 1                   | A A A A
DO_REPEAT_RELAY 0 1 1              | A A A A
DO_PARACHUTE 0                     | A A U U
DO_GRIPPER 1 0                     | F F F F
DO_WINCH 1 0                       | F U U U
DO_SPRAYER 0                       | A F A F
DO_AUX_FUNCTION 7 0                | A F A F
DO_LAND_START                      | F F U U
DO_VTOL_TRANSITION 4               | U F U U
NAV_TAKEOFF 0 0 0 0 0 0 10         | F F U U
NAV_VTOL_TAKEOFF 0 0 0 0 0 0 10    | F U U U
PREFLIGHT_STORAGE 0                | D D D D
PREFLIGHT_SET_SENSOR_OFFSETS 2     | U U U U
BATTERY_RESET 1 80                 | A A A A
SET_EKF_SOURCE_SET 1               | A A A A
LOGGING_START                      | U U U U
FLASH_BOOTLOADER                   | U U U U
DO_SET_SAFETY_SWITCH_STATE 0       | A A A A
DO_FOLLOW                          | D D D U
OVERRIDE_GOTO 0 2                  | U U U U
DO_START_MAG_CAL 0                 | A A A A
DO_ACCEPT_MAG_CAL 0                | F F F F
DO_CANCEL_MAG_CAL 0                | A A A A
ACCELCAL_VEHICLE_POS 1             | F F F F
REQUEST_PROTOCOL_VERSION 1         | U U U U
REQUEST_FLIGHT_INFORMATION 1       | U U U U
GET_MESSAGE_INTERVAL 30            | A A A A
UAVCAN_GET_NODE_INFO               | U U U U
INJECT_FAILURE                     | U U U U
USER_1                             | U U U U
NAV_LAND                           | A U U A
NAV_VTOL_LAND                      | A U U U
"""
RESULTS = {
    "A": MavResult.ACCEPTED,
    "D": MavResult.DENIED,
    "F": MavResult.FAILED,
    "U": MavResult.UNSUPPORTED,
}


def rows() -> list[tuple[str, list[float], list[str]]]:
    found = []
    for line in TABLE.strip().splitlines():
        order, answers = line.split("|")
        name, *params = order.split()
        found.append((name, [float(param) for param in params], answers.split()))
    return found


@pytest.mark.parametrize("kind", KINDS)
def test_command_result_matches_recorded_firmware(kind: str) -> None:
    vehicle = simulated(kind, boot_time_s=0.0, parameters={"MNT1_TYPE": 1.0})
    client = Client(vehicle)
    client.run(3.0)
    wrong = []
    for name, params, answers in rows():
        expected = RESULTS[answers[KINDS.index(kind)]]
        answer = client.command(MavCmd[name], *params)
        client.run(0.2)
        if answer is None or answer != expected:
            wrong.append((name, answer, expected.name))
    assert not wrong
    assert not any(math.isnan(value) for value in (vehicle.motion.north, vehicle.motion.yaw))  # type: ignore[attr-defined]
