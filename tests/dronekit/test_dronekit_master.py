"""``message_factory`` and ``_master``: the parts of pymavlink's objects that programs use."""

from __future__ import annotations

import random
import socket
import threading
import time
from collections.abc import Callable, Iterator
from importlib import import_module
from typing import Any

import pytest
from pymavlink import mavutil

from aerokit.dronekit.exceptions import APIException
from aerokit.dronekit.master import Master
from aerokit.dronekit.mavlink import MAVConnection
from aerokit.errors import InvalidArgument
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.message_factory import MessageFactory
from aerokit.mavlink.pymavlink import from_pymavlink

v10: Any = import_module("pymavlink.dialects.v10.ardupilotmega")
v20: Any = import_module("pymavlink.dialects.v20.ardupilotmega")
storm32: Any = import_module("pymavlink.dialects.v20.storm32")

SYSTEM, COMPONENT = 255, 190
LIMIT_S = 100.0


class Sent(list[Any]):
    """Messages sent by a factory."""

    def bytes(self) -> bytes:
        encoder = FrameEncoder(SYSTEM, COMPONENT)
        return b"".join(encoder.encode(from_pymavlink(message)) for message in self)


class Buffer:
    def __init__(self) -> None:
        self.data = b""

    def write(self, data: bytes) -> None:
        self.data += data


@pytest.fixture
def sent() -> Sent:
    return Sent()


@pytest.fixture
def factory(sent: Sent) -> MessageFactory:
    return MessageFactory(sent.append, SYSTEM, COMPONENT)


def values_of(message_class: Any, randomness: random.Random, *, texts_as_str: bool = False) -> list[Any]:
    """Random arguments, in the order of the definition."""
    data = bytes(randomness.randrange(1, 127) for _ in range(message_class.unpacker.size))
    unpacked, values, at = message_class.unpacker.unpack(data), {}, 0
    for name, width in zip(message_class.ordered_fieldnames, message_class.lengths, strict=True):
        value = unpacked[at] if width == 1 else list(unpacked[at : at + width])
        values[name] = value.decode() if texts_as_str and isinstance(value, bytes) else value
        at += width
    return [values[name] for name in message_class.fieldnames]


# --------------------------------------------------------------------------------------- factory


def test_message_factory_matches_pymavlink(factory: MessageFactory, sent: Sent) -> None:
    randomness, golden = random.Random(1), Buffer()
    theirs = v20.MAVLink(golden, SYSTEM, COMPONENT)
    for message_class in v20.mavlink_map.values():
        if message_class.id < 0:
            continue
        name = message_class.msgname.lower()
        values = values_of(message_class, randomness)
        made = getattr(factory, f"{name}_encode")(*values)
        assert type(made) is message_class
        getattr(factory, f"{name}_send")(*values)
        getattr(theirs, f"{name}_send")(*values)
        factory.send(made)
        theirs.send(made)
    assert sent.bytes() == golden.data
    assert (factory.seq, factory.total_packets_sent) == (theirs.seq, theirs.total_packets_sent)


def test_message_factory_accepts_mavlink_1_arguments(factory: MessageFactory, sent: Sent) -> None:
    randomness, expected = random.Random(2), []
    for message_class in v10.mavlink_map.values():
        if message_class.id < 0:
            continue
        values = values_of(message_class, randomness, texts_as_str=True)
        getattr(factory, f"{message_class.msgname.lower()}_send")(*values)
        as_bytes = [value.encode() if isinstance(value, str) else value for value in values]
        expected.append(message_class(*as_bytes))
    encoder, theirs = FrameEncoder(SYSTEM, COMPONENT, version=1), Buffer()
    mav = v10.MAVLink(theirs, SYSTEM, COMPONENT)
    for message in expected:
        mav.send(message)
    assert b"".join(encoder.encode(from_pymavlink(message)) for message in sent) == theirs.data


def test_message_factory_accepts_floats_and_strings(factory: MessageFactory, sent: Sent) -> None:
    factory.mount_control_send(0, 1, -9050.4, 0.0, 1e3, 0)
    factory.param_set_send(1, 1, param_id="WPNAV_SPEED", param_value=500, param_type=9.0)
    factory.play_tune_send(1, 1, bytearray(b"CDE"))
    factory.statustext_send(6, "gr\u00fc\u00df")
    mount, param, tune, text = (from_pymavlink(message) for message in sent)
    assert (mount.to_dict()["input_a"], mount.to_dict()["input_c"]) == (-9050, 1000)
    assert (param.to_dict()["param_id"], param.to_dict()["param_type"]) == ("WPNAV_SPEED", 9)
    assert tune.to_dict()["tune"] == "CDE"
    assert text.to_dict()["text"] == "gr\u00fc\u00df"


def test_message_factory_checks_values_on_send(factory: MessageFactory) -> None:
    message = factory.mission_set_current_encode(1, 1, None)
    with pytest.raises(InvalidArgument, match=r"MISSION_SET_CURRENT\.seq"):
        from_pymavlink(message)
    with pytest.raises(InvalidArgument, match="play_tune_encode: the value of a text field must be"):
        factory.play_tune_encode(1, 1, None)
    with pytest.raises(TypeError):
        factory.mission_set_current_encode(1, 1)
    with pytest.raises(AttributeError, match="nothing_encode"):
        _ = factory.nothing_encode


def test_message_factory_uses_programs_dialect(
    monkeypatch: pytest.MonkeyPatch, factory: MessageFactory, sent: Sent
) -> None:
    name = next(c.msgname for i, c in sorted(storm32.mavlink_map.items()) if i not in v20.mavlink_map)
    message_class = next(c for c in storm32.mavlink_map.values() if c.msgname == name)
    assert not hasattr(factory, f"{name.lower()}_encode")
    monkeypatch.setattr(mavutil, "mavlink", storm32)
    getattr(factory, f"{name.lower()}_send")(*values_of(message_class, random.Random(3)))
    assert [type(message) for message in sent] == [message_class]


def test_probably_vehicle_heartbeat(factory: MessageFactory) -> None:
    assert (factory.srcSystem, factory.srcComponent, factory.seq) == (SYSTEM, COMPONENT, 0)
    notified: list[Any] = []
    factory.set_send_callback(lambda message, extra: notified.append((message.get_type(), extra)), "extra")
    factory.ping_send(1, 2, 3, 4)
    assert notified == [("PING", "extra")]


# ---------------------------------------------------------------------------------------- master


class Vehicle:
    """The vehicle's side of a UDP link, implemented with pymavlink."""

    def __init__(self, address: str, vehicle_type: int, autopilot: int) -> None:
        host, port = address.rsplit(":", 2)[-2:]
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect((host, int(port)))
        self._socket.settimeout(LIMIT_S)
        self._kind = vehicle_type, autopilot
        self.mav = v20.MAVLink(self, 1, 1)
        self.mav.robust_parsing = True
        self.base_mode, self.custom_mode = 81, 4

    def write(self, data: bytes) -> None:
        self._socket.send(data)

    def beat(self) -> None:
        self.mav.heartbeat_send(*self._kind, self.base_mode, self.custom_mode, 4)

    def received(self, name: str) -> Any:
        """The next message of this type."""
        end = time.monotonic() + LIMIT_S
        while time.monotonic() < end:
            for message in self.mav.parse_buffer(self._socket.recv(2048)) or ():
                if message.get_type() == name:
                    return message
        raise AssertionError(f"no {name}")

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def connection() -> Iterator[MAVConnection]:
    connection = MAVConnection("udpin:127.0.0.1:0")
    yield connection
    connection.close()


@pytest.fixture
def connected(
    connection: MAVConnection, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> Iterator[tuple[Master, Vehicle]]:
    """A master with a known vehicle: an ArduPilot copter by default."""
    monkeypatch.setattr(mavutil, "mavlink", v20)  # independent of the dialect that other tests of this process have set
    kind = getattr(request, "param", (2, 3))
    assert connection.master.target_component == 0
    assert connection.master.mode_mapping() is None
    vehicle = Vehicle(connection.master.address, *kind)
    vehicle.beat()
    connection.target_system = 1
    until(lambda: connection.master.target_component == 1)
    yield connection.master, vehicle
    vehicle.close()


def until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


Connected = tuple[Master, Vehicle]


def test_master_properties(connected: Connected) -> None:
    master, vehicle = connected
    assert (master.target_system, master.target_component) == (1, 1)
    assert (master.mav.srcSystem, master.mav.srcComponent) == (255, 0)
    assert master.flightmode == "GUIDED"
    assert not master.motors_armed()
    master.motors_disarmed_wait()
    assert master.mode_mapping() == mavutil.mode_mapping_byname(2)
    assert master.probably_vehicle_heartbeat(v20.MAVLink_heartbeat_message(2, 3, 0, 0, 0, 3))
    assert not master.probably_vehicle_heartbeat(v20.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3))
    vehicle.base_mode |= 128
    waiting = threading.Thread(target=master.motors_armed_wait)
    waiting.start()
    while waiting.is_alive():
        vehicle.beat()
        waiting.join(0.02)
    assert master.motors_armed()


def test_master_sends_messages(connected: Connected) -> None:
    master, vehicle = connected
    for call, name, expected in (
        (lambda: master.arducopter_arm(), "COMMAND_LONG", {"command": 400, "param1": 1}),
        (lambda: master.arducopter_disarm(), "COMMAND_LONG", {"command": 400, "param1": 0}),
        (lambda: master.set_mode(5), "COMMAND_LONG", {"command": 176, "param1": 1, "param2": 5}),
        (lambda: master.set_mode("LOITER"), "COMMAND_LONG", {"command": 176, "param1": 1, "param2": 5}),
        (lambda: master.set_servo(7, 1100), "COMMAND_LONG", {"command": 183, "param1": 7, "param2": 1100}),
        (
            lambda: master.param_set_send("FOO", 2),
            "PARAM_SET",
            {"param_id": "FOO", "param_value": 2, "param_type": 9},
        ),
        (master.param_fetch_all, "PARAM_REQUEST_LIST", {}),
        (master.waypoint_clear_all_send, "MISSION_CLEAR_ALL", {}),
        (lambda: master.waypoint_count_send(3), "MISSION_COUNT", {"count": 3}),
        (master.waypoint_request_list_send, "MISSION_REQUEST_LIST", {}),
        (lambda: master.waypoint_request_send(2), "MISSION_REQUEST", {"seq": 2}),
        (lambda: master.waypoint_set_current_send(2), "MISSION_SET_CURRENT", {"seq": 2}),
        (lambda: master.mav.set_mode_send(0, 1, 5), "SET_MODE", {"base_mode": 1, "custom_mode": 5}),
    ):
        call()
        message = vehicle.received(name)
        fields = message.to_dict()
        assert fields["target_system"] == 1
        assert fields.get("target_component", 1) == 1
        assert {key: fields[key] for key in expected} == expected
        assert (message.get_srcSystem(), message.get_srcComponent()) == (255, 0)


def test_message_factory_rejects_invalid_values(connected: Connected) -> None:
    master, vehicle = connected
    with pytest.raises(KeyError, match="NOPE"):
        master.set_mode("NOPE")
    with pytest.raises(InvalidArgument):
        master.waypoint_count_send(70_000)
    master.mav.ping_send(1, 77, 0, 0)
    assert vehicle.received("PING").seq == 77


@pytest.mark.parametrize("connected", [(2, 12)], indirect=True)
def test_mode_mapping_px4(connected: Connected) -> None:
    master, vehicle = connected
    assert master.mode_mapping() == mavutil.px4_map
    calls: list[Callable[[], None]] = [
        lambda: master.set_mode_px4("OFFBOARD", None, None),
        lambda: master.set_mode(29, 6),
    ]
    for call in calls:
        call()
        message = vehicle.received("COMMAND_LONG")
        assert (message.command, message.param1, message.param2, message.param3) == (176, 29, 6, 0)


def test_master_set_mode_uses_vehicle(connected: Connected) -> None:
    class Known:
        mode: Any = None

    master, _ = connected
    known: Any = Known()
    master._connection.vehicle = known
    master.set_mode("LOITER")
    assert known.mode == "LOITER"
    master.set_mode(14)
    assert known.mode == 14


# ------------------------------------------------------------------------------------- receiving


def test_recv_match_returns_messages_in_order(connected: Connected) -> None:
    master, vehicle = connected
    assert master.recv_match(type="ATTITUDE") is None, "no messages are stored before the first access"
    for number in range(3):
        vehicle.mav.attitude_send(number, 0, 0, 0, 0, 0, 0)
        vehicle.mav.mission_current_send(number)
    first = master.recv_match(type="ATTITUDE", blocking=True, timeout=LIMIT_S)
    assert (first.get_type(), first.time_boot_ms) == ("ATTITUDE", 0)
    assert isinstance(first, v20.MAVLink_attitude_message)
    chosen = master.recv_match(
        condition="MISSION_CURRENT.seq==2", type=["MISSION_CURRENT"], blocking=True, timeout=LIMIT_S
    )
    assert chosen.seq == 2
    assert master.recv_match() is None
    assert master.recv_match(type="ATTITUDE", blocking=True, timeout=0.01) is None


def test_location_is_newest_received(connected: Connected) -> None:
    master, vehicle = connected
    len(master.messages)  # From the first access on, messages are stored.
    for latitude in (470000000, 480000000):
        vehicle.mav.gps_raw_int_send(0, 3, latitude, 80000000, 0, 0, 0, 0, 0, 9)
        vehicle.mav.vfr_hud_send(0, 0, 271, 0, latitude / 1e6, 0)
        vehicle.mav.global_position_int_send(0, latitude, 80000000, 0, latitude, 0, 0, 0, 0)
    until(lambda: "GLOBAL_POSITION_INT" in master.messages)
    until(lambda: bool(master.messages["GLOBAL_POSITION_INT"].lat == 480000000))
    location = master.location()
    assert (location.lat, location.lng, location.alt, location.heading) == (48.0, 8.0, 480.0, 271)


def test_wait_heartbeat(connected: Connected) -> None:
    master, vehicle = connected
    found: list[Any] = []
    waiting = threading.Thread(target=lambda: found.append(master.wait_heartbeat()))
    waiting.start()
    while waiting.is_alive():
        vehicle.beat()
        waiting.join(0.02)
    assert found[0].get_srcSystem() == 1


def test_master_messages_has_last_of_every_type(connected: Connected) -> None:
    master, vehicle = connected
    timer = threading.Timer(0.05, vehicle.mav.raw_imu_send, range(10))
    timer.start()
    assert master.messages["RAW_IMU"].zmag == 9, "only the first accesses wait"
    timer.join()
    vehicle.mav.raw_imu_send(*range(10, 20))
    until(lambda: bool(master.messages["RAW_IMU"].zmag == 19))
    assert "RAW_IMU" in list(master.messages)
    assert len(master.messages) >= 1
    assert master.messages.get("NONSENSE") is None


def test_recv_match_ends_on_close(connected: Connected) -> None:
    master, _ = connected
    ended: list[BaseException] = []

    def wait() -> None:
        try:
            master.recv_match(type="ATTITUDE", blocking=True)
        except APIException as error:
            ended.append(error)

    waiting = threading.Thread(target=wait)
    waiting.start()
    master.close()
    waiting.join(LIMIT_S)
    assert len(ended) == 1
    with pytest.raises(APIException, match="closed"):
        master.recv_match(type="ATTITUDE")
    with pytest.raises(APIException):
        master.arducopter_arm()


def test_master_port_can_be_closed(connected: Connected) -> None:
    master, _ = connected
    master.port.close()
    with pytest.raises(APIException, match="closed"):
        master.arducopter_arm()
