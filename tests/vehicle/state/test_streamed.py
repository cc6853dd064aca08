"""Streamed messages are decoded on access, without a visible difference."""

from __future__ import annotations

import threading
from typing import Any

import pytest

from aerokit.autopilots import autopilot_for
from aerokit.connection.bus import Bus
from aerokit.mavlink import Field, FrameEncoder, Framer, Message, messages
from aerokit.mavlink.frame import Frame
from aerokit.mavlink.message import offset_of
from aerokit.vehicle.state.field import MESSAGE_IDS, message_type
from aerokit.vehicle.state.states import LAZY, SOURCES
from aerokit.vehicle.state.telemetry import Telemetry

HEARTBEAT = messages.Heartbeat(2, 3, 81, 4, 3)
CHANNELS: dict[str, int] = {f"chan{number}_raw": 1500 for number in range(1, 19)}
SIM_STATE: dict[str, Any] = {field.name: 0.0 for field in messages.SimState.FIELDS}
SIM_STATE |= {"lat_int": 473977000, "lon_int": 85456000}
ANYTHING: dict[str, Message] = {
    "SysStatus": messages.SysStatus(1, 1, 1, 100, 12000, 100, 90, 0, 0, 0, 0, 0, 0),
    "SystemTime": messages.SystemTime(1_700_000_000_000_000, 5),
    "GpsRawInt": messages.GpsRawInt(0, 3, 473977000, 85456000, 0, 100, 100, 0, 0, 10),
    "Gps2Raw": messages.Gps2Raw(0, 3, 473977000, 85456000, 0, 100, 100, 0, 0, 10, 0, 0),
    "Attitude": messages.Attitude(0, 0.1, 0.2, 0.3, 0.0, 0.0, 0.0),
    "AttitudeQuaternion": messages.AttitudeQuaternion(0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    "LocalPositionNed": messages.LocalPositionNed(0, 1.0, 2.0, 3.0, 0.1, 0.2, 0.3),
    "GlobalPositionInt": messages.GlobalPositionInt(0, 473977000, 85456000, 498000, 10000, 100, -200, 50, 9000),
    "RcChannels": messages.RcChannels(0, 8, **CHANNELS, rssi=200),
    "ServoOutputRaw": messages.ServoOutputRaw(0, 0, *[1500] * 8),
    "MissionCurrent": messages.MissionCurrent(2),
    "VfrHud": messages.VfrHud(3.0, 4.0, 271, 50, 20.0, 0.5),
    "DistanceSensor": messages.DistanceSensor(0, 10, 5000, 300, 0, 0, 25, 255),
    "Rangefinder": messages.Rangefinder(3.0, 1.0),
    "BatteryStatus": messages.BatteryStatus(0, 1, 1, 2500, (12000, *[65535] * 9), 100, 10, 10, 90),
    "Wind": messages.Wind(10.0, 3.0, 0.0),
    "WindCov": messages.WindCov(0, 1.0, 2.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    "PowerStatus": messages.PowerStatus(5012, 0, 1),
    "EkfStatusReport": messages.EkfStatusReport(831, 0.1, 0.1, 0.1, 0.1, 0.1),
    "EstimatorStatus": messages.EstimatorStatus(0, 831, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 1.0, 1.0),
    "HilStateQuaternion": messages.HilStateQuaternion(
        0, (1.0, 0.0, 0.0, 0.0), 0.0, 0.0, 0.0, 473977000, 85456000, 488000, *[0] * 8
    ),
    "SimState": messages.SimState(**SIM_STATE),
    "Vibration": messages.Vibration(0, 1.0, 1.0, 1.0, 0, 0, 0),
}


def ones(kind: type[Message]) -> Message:
    """All fields are 1: plausible for most messages; for others `ANYTHING` has one."""
    return kind(**{field.name: value_of_ones(field) for field in kind.FIELDS})


def value_of_ones(field: Field) -> object:
    if field.is_text:
        return "1"
    values = (1,) * field.array_length
    return 1 if not values else bytes(values) if field.type == "uint8_t" else values


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def telemetry(clock: Clock) -> Telemetry:
    return Telemetry(clock, autopilot=autopilot_for(HEARTBEAT))


def frame_of(message: Message, at: float = 0.0, component_id: int = 1) -> Frame:
    return Framer().receive(FrameEncoder(1, component_id).encode(message), at)[0]


def take(telemetry: Telemetry, message: Message, at: float, component_id: int = 1) -> None:
    telemetry.streams[message.ID].receive(frame_of(message, at, component_id))


@pytest.mark.parametrize("name", LAZY)
def test_table_lists_every_cell_of_message(telemetry: Telemetry, name: str) -> None:
    telemetry.receive(ANYTHING.get(name) or ones(message_type(name)))
    changed = {cell.name for cell in telemetry.cells.values() if cell.is_known}
    assert changed == {reported.name for reported, _ in SOURCES[name]}


@pytest.mark.parametrize(
    ("name", "field"), [("ServoOutputRaw", "port"), ("DistanceSensor", "id"), ("BatteryStatus", "id")]
)
def test_instance_field_is_read_from_payload(name: str, field: str) -> None:
    message = ANYTHING[name]
    fields = {field.name: getattr(message, field.name) for field in message.FIELDS}
    body = frame_of(message_type(name)(**{**fields, field: 201})).body
    assert body[9 + offset_of(message_type(name), field)] == 201


def test_unread_value_is_not_decoded(telemetry: Telemetry, clock: Clock) -> None:
    stream = telemetry.streams[MESSAGE_IDS["Attitude"]]
    take(telemetry, messages.Attitude(0, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0), 100.0)
    assert not stream.pending, "the first message is decoded at once, so that is_known is true"
    take(telemetry, messages.Attitude(0, 0.2, 0.0, 0.0, 0.0, 0.0, 0.0), 100.5)
    take(telemetry, messages.Attitude(0, 0.3, 0.0, 0.0, 0.0, 0.0, 0.0), 101.0)
    clock.now = 103.0
    assert stream.pending
    assert telemetry.attitude.age == 2.0
    assert not stream.pending
    assert telemetry.attitude.updated_at == 101.0
    assert telemetry.attitude.value.roll_deg == pytest.approx(17.19, abs=0.01)


def test_status_texts_of_other_components_are_ignored(telemetry: Telemetry) -> None:
    take(telemetry, ANYTHING["Attitude"], 100.0, component_id=154)
    assert not telemetry.attitude.is_known


def test_observers_see_every_frame(telemetry: Telemetry) -> None:
    take(telemetry, messages.VfrHud(3.0, 4.0, 10, 50, 20.0, 0.5), 100.0)
    take(telemetry, messages.VfrHud(3.0, 5.0, 10, 50, 20.0, 0.5), 100.1)
    observed: list[tuple[float | None, float]] = []
    end = telemetry.ground_speed_m_s.observe(lambda before, after: observed.append((before, after)))
    for number in range(3):
        take(telemetry, messages.VfrHud(3.0, 6.0 + number, 10, 50, 20.0, 0.5), 100.2 + number / 10)
    end()
    assert observed == [(5.0, 6.0), (6.0, 7.0), (7.0, 8.0)]
    take(telemetry, messages.VfrHud(3.0, 9.0, 10, 50, 20.0, 0.5), 100.6)
    assert telemetry.streams[MESSAGE_IDS["VfrHud"]].pending
    assert telemetry.ground_speed_m_s.value == 9.0


def test_pending_frames_of_two_batteries_are_kept(telemetry: Telemetry) -> None:
    for percent in (90, 80):
        for number in (0, 1):
            battery = messages.BatteryStatus(number, 1, 1, 2500, (12000, *[65535] * 9), 100, 10, 10, percent - number)
            take(telemetry, battery, 100.0 + (90 - percent) / 100)
    assert [battery.remaining_percent for battery in telemetry.batteries.value] == [80, 79]


def test_instance_field_truncated_is_zero(telemetry: Telemetry) -> None:
    """MAVLink 2 cuts off the zeros at the end of a message."""
    at = offset_of(messages.ServoOutputRaw, "port")
    for first, ninth in ((1100, 0), (1200, 1500), (1300, 0)):
        others = 1500, 1500, 1500, 1500, 1500, 1500, 1500
        message = messages.ServoOutputRaw(0, 0, first, *others, servo9_raw=ninth)
        assert (len(frame_of(message).body) > 9 + at) is bool(ninth)
        take(telemetry, message, 100.0)
    assert telemetry.servo_outputs.value.outputs_us[0] == 1300


def battery(number: int, percent: int) -> Message:
    return messages.BatteryStatus(number, 1, 1, 2500, (12000, *[65535] * 9), 100, 10, 10, percent)


@pytest.mark.parametrize("ends", [0, 1, 2])
def test_value_age_is_of_last_frame(telemetry: Telemetry, clock: Clock, ends: int) -> None:
    """An instance that is no longer reported does not make the others old."""
    take(telemetry, battery(0, 80), 100.0)
    for at in range(101, 105):
        for number in range(3):
            if at == 101 or number != ends:
                take(telemetry, battery(number, 80), float(at))
    clock.now = 104.5
    assert telemetry.batteries.fresh(1.0) == telemetry.batteries.value
    assert telemetry.batteries.updated_at == 104.0
    assert [battery.id for battery in telemetry.batteries.value] == [0, 1, 2]


def test_pending_frames_are_kept_per_instance(telemetry: Telemetry) -> None:
    for number in (0, *range(256)):
        take(telemetry, battery(number, number % 100), 100.0)
    assert [battery.remaining_percent for battery in telemetry.batteries.value] == [n % 100 for n in range(256)]


def test_better_source_wins_in_any_read_order(telemetry: Telemetry) -> None:
    for at in (100.0, 101.0):
        take(telemetry, ANYTHING["GlobalPositionInt"], at)
        take(telemetry, ANYTHING["VfrHud"], at + 0.1)
    assert telemetry.heading_deg.value == 90.0
    take(telemetry, ANYTHING["VfrHud"], 104.0)
    assert telemetry.heading_deg.value == 271.0


@pytest.mark.parametrize("newer", ["Attitude", "AttitudeQuaternion"])
def test_older_pending_frame_does_not_replace_newer_value(newer: str, telemetry: Telemetry) -> None:
    older = "AttitudeQuaternion" if newer == "Attitude" else "Attitude"
    for name in (older, newer):
        take(telemetry, ANYTHING[name], 0.0)  # The first frame of each type is decoded at once.
    take(telemetry, ANYTHING[older], 1.0)
    take(telemetry, ANYTHING[newer], 1.7)
    source = telemetry.attitude.source
    assert source is not None
    assert (source.message, telemetry.attitude.updated_at) == (message_type(newer).NAME, 1.7)


def test_older_pending_frame_of_second_receiver_is_kept(telemetry: Telemetry) -> None:
    for at in (0.0, 1.0):
        take(telemetry, ANYTHING["Gps2Raw"], at)
        take(telemetry, ANYTHING["GpsRawInt"], at + 0.5)
    assert len(telemetry.gps.value) == 2


def test_unread_value_is_decoded_every_five_seconds(telemetry: Telemetry) -> None:
    streamed = telemetry.streams[messages.GlobalPositionInt.ID]
    waits = []
    for number in range(21):
        take(telemetry, ANYTHING["GlobalPositionInt"], 100.0 + number / 2)
        waits.append(bool(streamed.pending))
    assert waits == [number % 10 != 0 for number in range(21)]


def test_position_without_fix_keeps_previous(telemetry: Telemetry) -> None:
    """Also without access: it is decoded every few seconds."""
    place, nowhere = ANYTHING["GlobalPositionInt"], messages.GlobalPositionInt(0, 0, 0, 0, 0, 0, 0, 0, 9000)
    for number in range(50):
        take(telemetry, place, 100.0 + number / 4)
    take(telemetry, nowhere, 113.0)
    position = telemetry.position.value
    assert position.latitude_deg == pytest.approx(47.3977)
    assert 112.25 - telemetry.position.updated_at <= 5.0


def test_reboot_discards_pending_frames(telemetry: Telemetry) -> None:
    take(telemetry, ANYTHING["Wind"], 100.0)
    take(telemetry, ANYTHING["Wind"], 100.1)
    telemetry.forget()
    assert not telemetry.wind.is_known
    take(telemetry, ANYTHING["Wind"], 100.2)
    assert telemetry.wind.updated_at == 100.2


def test_cells_can_be_read_by_other_threads(telemetry: Telemetry) -> None:
    """A value is always one message's, and never older than one seen before."""
    wrong: list[object] = []
    ended = threading.Event()

    def look() -> None:
        last = 0.0
        while not ended.is_set():
            cell = telemetry.attitude
            if cell.is_known:
                value = cell.value
                if value.roll_deg != value.pitch_deg or value.roll_deg < last:
                    wrong.append(value)
                last = value.roll_deg

    threads = [threading.Thread(target=look) for _ in range(2)]
    for thread in threads:
        thread.start()
    for number in range(3000):
        angle = number / 1000
        take(telemetry, messages.Attitude(0, angle, angle, 0.0, 0.0, 0.0, 0.0), 100.0 + number / 1000)
    ended.set()
    for thread in threads:
        thread.join()
    assert wrong == []


def test_decoded_message_is_reused(telemetry: Telemetry) -> None:
    bus, observed = Bus(), list[Message]()
    stream = telemetry.streams[MESSAGE_IDS["Attitude"]]
    bus.attach_lazily(messages.Attitude, stream.receive)
    bus.attach(messages.Attitude, observed.append)
    for at in (100.0, 100.5):
        bus.deliver(frame_of(ANYTHING["Attitude"], at))
    (pending,) = stream.pending.values()
    assert pending is observed[1]
    assert telemetry.attitude.value.yaw_deg == pytest.approx(17.19, abs=0.01)
