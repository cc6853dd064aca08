"""pymavlink flies the vehicle, message by message, as the many scripts do that use it directly."""

# pyright: reportMissingImports=false
from __future__ import annotations

import os
import sys
import time
from typing import Any

os.environ["MAVLINK20"] = "1"

from pymavlink import mavutil
from steps import ALTITUDE_M, PARAMETERS, Steps, mission

M: Any = mavutil.mavlink


class Client:
    def __init__(self, kind: str, port: int) -> None:
        self.kind = kind
        self.link: Any = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}", source_system=255)
        self._next_heartbeat = 0.0

    def wait(self, *types: str, until: Any = lambda message: True, timeout: float = 60.0) -> Any:
        """The next message of these types that fulfils a condition; heartbeats go out meanwhile."""
        deadline = time.monotonic() + timeout
        while time.monotonic() < deadline:
            if time.monotonic() >= self._next_heartbeat:
                self._next_heartbeat = time.monotonic() + 0.5
                self.link.mav.heartbeat_send(M.MAV_TYPE_GCS, M.MAV_AUTOPILOT_INVALID, 0, 0, 0)
            message = self.link.recv_match(type=list(types), blocking=True, timeout=0.2)
            if message is not None and until(message):
                return message
        sys.exit(f"not within {timeout:.0f} s: {types}")

    def command(self, command: int, *parameters: float) -> int:
        values = (*parameters, *[0.0] * (7 - len(parameters)))
        self.link.mav.command_long_send(self.link.target_system, 1, command, 0, *values)
        ack = self.wait("COMMAND_ACK", until=lambda ack: ack.command == command, timeout=5)
        return int(ack.result)

    def command_until_accepted(self, command: int, *parameters: float) -> None:
        """A command is repeated until the vehicle is ready for it."""
        for _ in range(60):
            if self.command(command, *parameters) == M.MAV_RESULT_ACCEPTED:
                return
            time.sleep(0.5)
        sys.exit(f"command {command} was not accepted")

    def set_mode(self, name: str) -> None:
        mode = self.link.mode_mapping()[name]
        if isinstance(mode, tuple):
            self.command_until_accepted(M.MAV_CMD_DO_SET_MODE, mode[0], mode[1], mode[2])
        else:
            self.command_until_accepted(M.MAV_CMD_DO_SET_MODE, M.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, mode)
        self.wait("HEARTBEAT", until=lambda _: self.link.flightmode == name)

    def wait_altitude(self, altitude_m: float) -> Any:
        return self.wait(
            "GLOBAL_POSITION_INT", until=lambda position: position.relative_alt / 1000 > altitude_m - 1, timeout=60
        )


def all_parameters(client: Client) -> int:
    """Download by PARAM_REQUEST_LIST, and PARAM_REQUEST_READ for missing ones."""
    client.link.mav.param_request_list_send(client.link.target_system, 1)
    got: dict[int, float] = {}
    count = 1
    while len(got) < count:
        value = client.wait("PARAM_VALUE", timeout=10)
        if value.param_index != 65535:
            count, got[value.param_index] = value.param_count, value.param_value
    return len(got)


def upload(client: Client) -> bool:
    """Upload the mission; return True if it was accepted."""
    items = mission(client.kind)
    link = client.link
    link.mav.mission_count_send(link.target_system, 1, len(items), M.MAV_MISSION_TYPE_MISSION)
    while True:
        message = client.wait("MISSION_REQUEST", "MISSION_REQUEST_INT", "MISSION_ACK", timeout=10)
        if message.get_type() == "MISSION_ACK":
            return bool(message.type == M.MAV_MISSION_ACCEPTED)
        item = items[message.seq]
        link.mav.mission_item_int_send(
            link.target_system, 1, message.seq, item.frame, item.command, 0, 1, item.hold_s, 0, 0, 0,
            round(item.latitude * 1e7), round(item.longitude * 1e7), item.altitude_m, M.MAV_MISSION_TYPE_MISSION,
        )  # fmt: skip


def download(client: Client) -> int:
    link = client.link
    link.mav.mission_request_list_send(link.target_system, 1, M.MAV_MISSION_TYPE_MISSION)
    count = client.wait("MISSION_COUNT", timeout=10).count
    items = mission(client.kind)
    assert count == len(items), count
    for number in range(count):
        link.mav.mission_request_int_send(link.target_system, 1, number, M.MAV_MISSION_TYPE_MISSION)
        got = client.wait("MISSION_ITEM_INT", until=lambda item, number=number: item.seq == number, timeout=10)
        assert got.command == items[number].command, got
        if number:
            assert abs(got.x - items[number].latitude * 1e7) <= 1, got
    link.mav.mission_ack_send(link.target_system, 1, M.MAV_MISSION_ACCEPTED, M.MAV_MISSION_TYPE_MISSION)
    return int(count)


def take_off(client: Client) -> None:
    """Take off. ArduPilot expects an altitude above home, PX4 a position and an altitude above sea level."""
    if client.kind == "copter":
        client.command_until_accepted(M.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, ALTITUDE_M)
        return
    here = client.wait("GLOBAL_POSITION_INT")
    nan = float("nan")
    client.command_until_accepted(
        M.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, nan, here.lat / 1e7, here.lon / 1e7, here.alt / 1000 + ALTITUDE_M
    )


def fly(client: Client) -> None:
    """Fly the mission to its end."""
    last = len(mission(client.kind)) - 1
    client.set_mode("AUTO" if client.kind == "copter" else "MISSION")
    client.wait("MISSION_ITEM_REACHED", until=lambda report: report.seq == last, timeout=90)


def main() -> None:
    steps = Steps()
    client = Client(sys.argv[1], int(sys.argv[2]))
    client.wait("HEARTBEAT", until=lambda heartbeat: heartbeat.get_srcComponent() == 1)
    client.link.target_system = client.link.messages["HEARTBEAT"].get_srcSystem()
    steps.done("connect", f"system {client.link.target_system}")
    client.link.mav.request_data_stream_send(client.link.target_system, 1, M.MAV_DATA_STREAM_ALL, 4, 1)
    count = all_parameters(client)
    assert count >= PARAMETERS[client.kind], count
    steps.done("parameters", count)
    while not upload(client):  # ArduPilot has no room for a mission until it has booted
        time.sleep(0.5)
    steps.done("upload", len(mission(client.kind)))
    steps.done("download", download(client))
    if client.kind == "copter":
        client.set_mode("GUIDED")
    client.command_until_accepted(M.MAV_CMD_COMPONENT_ARM_DISARM, 1)
    client.wait("HEARTBEAT", until=lambda _: client.link.motors_armed())
    steps.done("arm")
    take_off(client)
    steps.done("take off", f"{client.wait_altitude(ALTITUDE_M).relative_alt / 1000} m")
    fly(client)
    steps.done("fly")
    client.set_mode("LAND")
    client.wait("HEARTBEAT", until=lambda _: not client.link.motors_armed(), timeout=60)
    steps.done("land")


if __name__ == "__main__":
    main()
