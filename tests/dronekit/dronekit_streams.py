"""A flight controller that sends one message of each kind as soon as streams are requested."""

from __future__ import annotations

from typing import Any

from dronekit_scenarios_orders import HOME
from dronekit_scenarios_state import POSITION
from flight_controller import FlightController, message_of

__all__ = ["READY", "answer_streams"]

READY = {"rate": 4, "wait_ready": True, "timeout": 10}
PULSES = {f"chan{number}_raw": 1000 + number for number in range(1, 9)}


def answer_streams(fc: FlightController) -> None:
    """The messages of a vehicle in answer to a stream request."""
    fc.missions.items = [HOME]

    def stream(_: Any) -> None:
        fc.report("GPS_RAW_INT", fix_type=3, satellites_visible=10, eph=121, epv=65535)
        fc.report("ATTITUDE", roll=0.25, pitch=0.5, yaw=-0.5)
        fc.report("VFR_HUD", airspeed=3, groundspeed=4, heading=271)
        fc.send(message_of("GLOBAL_POSITION_INT", **POSITION))
        fc.report("LOCAL_POSITION_NED", x=3, y=4, z=-12)
        fc.report("SYS_STATUS", voltage_battery=12587, current_battery=150, battery_remaining=77)
        fc.report("RANGEFINDER", distance=0.5, voltage=0.25)
        fc.send(message_of("RC_CHANNELS", chancount=8, **PULSES))
        fc.report("MOUNT_STATUS", pointing_a=-4500, pointing_b=100, pointing_c=9000)
        fc.report("EKF_STATUS_REPORT", flags=831)

    fc.answers["REQUEST_DATA_STREAM"] = stream
