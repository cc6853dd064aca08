"""Recordings as vehicles: streams and answers."""

from __future__ import annotations

from collections import Counter
from io import BytesIO
from pathlib import Path

import pytest
from recorded import SHORT
from simulated_client import Client

import aerokit
from aerokit.errors import InvalidArgument
from aerokit.mavlink import messages as m
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import MavCmd, MavFrame, MavMissionResult, MavParamError, MavResult
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.message import Message
from aerokit.mavlink.tlog import TlogWriter, read_tlog
from aerokit.sim import simulated_link
from aerokit.testing import run_virtual
from aerokit.testing.recorded import RecordedVehicle

COPTER, PX4 = SHORT / "ardupilot-copter.tlog", SHORT / "px4-quad.tlog"
HEARTBEAT = m.Heartbeat(2, 3, 81, 0, 3, 3)
ARM = (MavCmd.COMPONENT_ARM_DISARM, 1.0)
GROUND = (255, 190)


def tlog(*records: tuple[float, Message, tuple[int, int]]) -> BytesIO:
    """Return a recording of (seconds, message, sender)."""
    file, encoders = BytesIO(), {sender: FrameEncoder(*sender) for _, _, sender in records}
    writer = TlogWriter(file)
    for time, message, sender in records:
        writer.write(encoders[sender].encode(message), 1e9 + time)
    file.seek(0)
    return file


def vehicle_of(*records: tuple[float, Message, tuple[int, int]], **options: bool | float) -> RecordedVehicle:
    """Return a vehicle of a two-minute recording with a heartbeat at its start and end."""
    ends = ((0.0, HEARTBEAT, (7, 1)), *records, (50.0, HEARTBEAT, (7, 1)))
    return RecordedVehicle(tlog(*ends), **options)  # type: ignore[arg-type]


def command(number: int, *params: float, confirmation: int = 0) -> m.CommandLong:
    return m.CommandLong(7, 1, number, confirmation, *params, *(0.0,) * (7 - len(params)))


def ack(number: int, result: int, progress: int = 0) -> m.CommandAck:
    return m.CommandAck(number, result, progress, 0, *GROUND)


# ------------------------------------------------------------------------------------------ streaming


@pytest.mark.parametrize("path", [COPTER, PX4], ids=lambda path: path.stem)
def test_streams_are_played_at_their_times(path: Path) -> None:
    vehicle = RecordedVehicle(path)
    client = Client(vehicle)
    client.run(vehicle.recording.duration_s + 1.0)
    framer, reported = Framer(), Counter[str]()
    start, times = None, []
    for stamp, raw in read_tlog(path):
        for frame in framer.receive(raw):
            if frame.system_id == 1:
                start = stamp if start is None else start
                message = STANDARD.decode(frame)
                reported[message.NAME] += 1
                times += [stamp - start] * isinstance(message, m.Heartbeat)
    received = Counter(message.NAME for _, message in client.received)
    for name in ("HEARTBEAT", "GLOBAL_POSITION_INT", "STATUSTEXT", "GPS_RAW_INT", "MISSION_CURRENT"):
        assert received[name] == reported[name] > 0
    for name in ("COMMAND_ACK", "PARAM_VALUE", "MISSION_ITEM_INT", "TIMESYNC"):
        assert received[name] == 0
    assert client.framer.statistics.bad_bytes == 0
    heartbeats = [time for time, message in client.received if isinstance(message, m.Heartbeat)]
    assert all(-1e-6 <= ours - theirs <= 0.051 for ours, theirs in zip(heartbeats, times, strict=True))


def test_vehicle_is_silent_after_the_end() -> None:
    vehicle = vehicle_of()
    client = Client(vehicle)
    client.run(51.0)
    assert (len(client.all(m.Heartbeat)), vehicle.has_ended) == (2, True)
    assert client.command(*ARM) is None
    assert vehicle.next_due == float("inf")


def test_repeat_and_start_offset() -> None:
    client = Client(vehicle_of((20.0, m.Statustext(6, "half time"), (7, 1)), repeat=True, start_s=10.0))
    client.run(60.0)
    assert [time for time, message in client.received if isinstance(message, m.Statustext)] == pytest.approx(
        [10, 50], abs=0.06
    )


def test_long_gaps_are_cut() -> None:
    records = ((0.0, HEARTBEAT, (7, 1)), (5000.0, HEARTBEAT, (7, 1)))
    assert RecordedVehicle(tlog(*records)).recording.duration_s == 60.0


def test_other_systems_are_left_out() -> None:
    client = Client(vehicle_of((1.0, HEARTBEAT, (7, 154)), (1.0, HEARTBEAT, (8, 1)), (1.0, HEARTBEAT, GROUND)))
    client.run(2.0)
    assert client.framer.statistics.sources.keys() == {(7, 1), (7, 154)}


def test_a_recording_without_a_vehicle_is_refused() -> None:
    with pytest.raises(InvalidArgument, match="no vehicle"):
        RecordedVehicle(tlog((0.0, m.Heartbeat(6, 8, 0, 0, 4, 3), GROUND)))
    with pytest.raises(InvalidArgument, match="system id 9"):
        RecordedVehicle(COPTER, system_id=9)


# ------------------------------------------------------------------------------------------- commands


def test_commands_get_recorded_answers_and_delays() -> None:
    client = Client(
        vehicle_of(
            (1.0, command(*ARM), GROUND),
            (1.5, ack(400, MavResult.FAILED), (7, 1)),
            (2.0, command(*ARM), GROUND),
            (2.2, command(*ARM, confirmation=1), GROUND),
            (2.5, ack(400, MavResult.ACCEPTED), (7, 1)),
            (3.0, command(400, 0.0), GROUND),
            (3.1, ack(400, MavResult.DENIED), (7, 1)),
        )
    )
    results = []
    for _ in range(3):
        assert client.command(*ARM) is None
        client.run(0.4)
        assert not client.all(m.CommandAck)
        client.run(0.2)
        results.append(client.last(m.CommandAck).result)
        client.clear()
    client.command(400, 0.0)
    client.run(0.2)
    results.append(client.last(m.CommandAck).result)
    assert results == [MavResult.FAILED, MavResult.ACCEPTED, MavResult.ACCEPTED, MavResult.DENIED]


def test_only_requests_to_the_autopilot_and_its_answers_count() -> None:
    to_other_system = m.CommandLong(8, 1, 400, 0, 0.0, 0, 0, 0, 0, 0, 0)
    to_camera = m.CommandLong(7, 100, 400, 0, 0.0, 0, 0, 0, 0, 0, 0)
    client = Client(
        vehicle_of(
            (1.0, command(*ARM), (7, 191)),  # a companion computer
            (1.1, to_other_system, GROUND),
            (1.2, to_camera, GROUND),
            (1.3, ack(400, MavResult.DENIED), (7, 100)),
            (1.4, ack(400, MavResult.ACCEPTED), (7, 1)),
        )
    )
    client.run(5.0)
    assert not client.all(m.CommandLong)
    assert not client.all(m.CommandAck)
    client.command(*ARM)
    client.run(1.0)
    assert [answer.result for answer in client.all(m.CommandAck)] == [MavResult.ACCEPTED]


def test_answers_to_other_params_are_counted_apart() -> None:
    client = Client(
        vehicle_of(
            (1.0, command(*ARM), GROUND),
            (1.1, ack(400, MavResult.FAILED), (7, 1)),
            (2.0, command(400, 0.0), GROUND),
            (2.1, ack(400, MavResult.DENIED), (7, 1)),
        )
    )
    client.command(*ARM)
    client.run(0.5)
    client.clear()
    client.command(400, 2.0)
    client.run(0.5)
    assert client.last(m.CommandAck).result == MavResult.FAILED


def test_unrecorded_command_is_unsupported() -> None:
    assert Client(vehicle_of()).command(MavCmd.NAV_TAKEOFF) == MavResult.UNSUPPORTED


def test_progress_and_double_acknowledgements_are_repeated() -> None:
    client = Client(
        vehicle_of(
            (1.0, command(241, 1.0), GROUND),
            (1.1, ack(241, MavResult.IN_PROGRESS, 40), (7, 1)),
            (3.0, ack(241, MavResult.ACCEPTED), (7, 1)),
        )
    )
    client.command(241, 1.0)
    client.run(2.1)
    assert [(a.result, a.progress) for a in client.all(m.CommandAck)] == [(5, 40), (0, 0)]


def test_recorded_message_is_sent_on_request() -> None:
    client = Client(RecordedVehicle(PX4))
    client.run(5.0)
    client.clear()
    assert client.command(MavCmd.REQUEST_MESSAGE, m.Attitude.ID) == MavResult.ACCEPTED
    assert client.all(m.Attitude)
    assert client.command(MavCmd.REQUEST_MESSAGE, m.Rpm.ID) == MavResult.UNSUPPORTED


# ----------------------------------------------------------------------------------------- parameters


def value(name: str, number: float, index: int = 5, count: int = 900) -> m.ParamValue:
    return m.ParamValue(name, number, 9, count, index)


def parameter_client(*more: tuple[float, Message, tuple[int, int]]) -> Client:
    return Client(
        vehicle_of(
            (1.0, value("B", 2.0, 7), (7, 1)),
            (1.0, value("A", 1.0, 3), (7, 1)),
            (2.0, m.ParamSet(7, 1, "B", 5.0, 9), GROUND),
            (2.1, value("B", 5.0, 7), (7, 1)),
            *more,
        )
    )


def test_parameter_list_has_no_gaps() -> None:
    client = parameter_client()
    client.send(m.ParamRequestList(7, 1))
    client.run(0.1)
    reported = [(v.param_id, v.param_value, v.param_index, v.param_count) for v in client.all(m.ParamValue)]
    assert reported == [("A", 1.0, 0, 2), ("B", 2.0, 1, 2)]


def test_parameter_values_follow_the_recording() -> None:
    client = parameter_client()
    client.run(3.0)
    client.send(m.ParamRequestRead(7, 1, "B", -1))
    client.send(m.ParamRequestRead(7, 1, "", 0))
    assert [v.param_value for v in client.all(m.ParamValue)] == [5.0, 1.0]


def test_only_recorded_sets_are_accepted() -> None:
    client = parameter_client()
    client.send(m.ParamSet(7, 1, "B", 9.0, 9))
    client.send(m.ParamSet(7, 1, "A", 9.0, 9))
    assert [(v.param_id, v.param_value) for v in client.all(m.ParamValue)] == [("B", 9.0), ("A", 1.0)]


def test_unknown_parameters_follow_the_recording() -> None:
    silent = parameter_client()
    silent.send(m.ParamRequestRead(7, 1, "NO_SUCH", -1))
    assert len(silent.received) == 1
    client = parameter_client((3.0, m.ParamError(*GROUND, "X", -1, MavParamError.DOES_NOT_EXIST), (7, 1)))
    client.send(m.ParamRequestRead(7, 1, "NO_SUCH", -1))
    assert client.last(m.ParamError).error == MavParamError.DOES_NOT_EXIST


# ------------------------------------------------------------------------------------------- missions


def item(seq: int) -> m.MissionItemInt:
    return m.MissionItemInt(7, 1, seq, 3, 16, 0, 1, 0, 0, 0, 0, 473977420 + seq, 85455940, 10.0 + seq, 0)


def upload(client: Client, count: int = 2) -> int:
    client.send(m.MissionCount(7, 1, count, 0))
    for seq in range(count):
        assert client.last(m.MissionRequestInt).seq == seq
        client.send(item(seq))
    return client.last(m.MissionAck).type


def uploaded_then(result: int) -> Client:
    return Client(
        vehicle_of(
            (1.0, m.MissionCount(7, 1, 1, 0), GROUND),
            (1.1, m.MissionRequestInt(*GROUND, 0, 0), (7, 1)),
            (1.2, item(0), GROUND),
            (1.3, m.MissionAck(*GROUND, result, 0), (7, 1)),
        )
    )


def test_recorded_local_item_is_in_metres() -> None:
    local = item(0).to_dict() | {"frame": MavFrame.LOCAL_NED, "x": 2_000_000, "y": -50_000}
    client = Client(
        vehicle_of(
            (1.0, m.MissionCount(7, 1, 1, 0), GROUND),
            (1.2, m.MissionItemInt(**local), GROUND),
            (1.3, m.MissionAck(*GROUND, 0, 0), (7, 1)),
        )
    )
    client.send(m.MissionRequestList(7, 1, 0))
    client.send(m.MissionRequest(7, 1, 0, 0))
    given = client.last(m.MissionItem)
    assert (given.x, given.y) == (200.0, -5.0)


def test_recorded_plan_is_downloaded() -> None:
    client = uploaded_then(MavMissionResult.ACCEPTED)
    client.send(m.MissionRequestList(7, 1, 0))
    assert client.last(m.MissionCount).count == 1
    client.send(m.MissionRequestInt(7, 1, 0, 0))
    given = client.last(m.MissionItemInt)
    assert (given.x, given.z, given.target_system) == (473977420, 10.0, 255)
    client.send(m.MissionRequest(7, 1, 0, 0))
    assert client.last(m.MissionItem).x == pytest.approx(47.397742)
    client.send(m.MissionRequestInt(7, 1, 1, 0))
    assert client.last(m.MissionAck).type == MavMissionResult.INVALID_SEQUENCE


def test_uploads_get_recorded_results() -> None:
    accepting = uploaded_then(MavMissionResult.ACCEPTED)
    assert upload(accepting) == MavMissionResult.ACCEPTED
    accepting.send(m.MissionRequestList(7, 1, 0))
    assert accepting.last(m.MissionCount).count == 2
    assert upload(uploaded_then(MavMissionResult.NO_SPACE)) == MavMissionResult.NO_SPACE


def test_lost_item_is_requested_again() -> None:
    client = uploaded_then(MavMissionResult.ACCEPTED)
    client.send(m.MissionCount(7, 1, 1, 0))
    client.run(1.5)
    assert [request.seq for request in client.all(m.MissionRequestInt)] == [0, 0]
    client.run(20.0)
    assert len(client.all(m.MissionRequestInt)) == 5


def test_uploads_without_recorded_plan_are_refused() -> None:
    client = Client(vehicle_of())
    for request in (m.MissionRequestList(7, 1, 1), m.MissionCount(7, 1, 3, 1), m.MissionClearAll(7, 1, 1)):
        client.send(request)
    assert [answer.type for answer in client.all(m.MissionAck)] == [MavMissionResult.UNSUPPORTED] * 3


# ------------------------------------------------------------------------------------- with a program


@pytest.mark.parametrize(
    ("path", "firmware", "items"), [(COPTER, "ArduCopter", 8), (PX4, "PX4", 4)], ids=["ardupilot", "px4"]
)
def test_program_runs_with_a_recording(path: Path, firmware: str, items: int) -> None:
    vehicle_then = RecordedVehicle(path, repeat=True)

    async def program() -> None:
        async with simulated_link(vehicle_then) as link, aerokit.connect(link) as vehicle:
            assert vehicle.autopilot.firmware == firmware
            await vehicle.position.wait_until(lambda position: position.latitude_deg != 0.0)
            parameters = await vehicle.parameters.download()
            assert len(parameters) == len(vehicle_then.parameters.names)
            assert len((await vehicle.mission.download()).items) == items
            await vehicle.armed.wait_until(lambda armed: armed)

    run_virtual(program())


def test_playback_is_deterministic() -> None:
    def output_with(step: float) -> bytes:
        vehicle, data = RecordedVehicle(PX4), b""
        for number in range(round(20 / step) + 1):
            vehicle.step(number * step)
            data += vehicle.take_outbox()
        return data

    assert output_with(0.01) == output_with(5.0)
