"""`RecordedFlight`: streams, answers, parameters and plans of one vehicle in a recording (.tlog)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from os import PathLike
from typing import Any, BinaryIO, NamedTuple

from aerokit.errors import InvalidArgument
from aerokit.mavlink import messages as m
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.enums import MavAutopilot, MavMissionResult, MavType
from aerokit.mavlink.frame import Frame
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.message import Message
from aerokit.mavlink.tlog import read_tlog

MAX_GAP_S = 60.0
"""Longer gaps between messages are shortened to this time, because the recording was paused or the clock was set."""

_ITEMS = (m.MissionItemInt, m.MissionItem)
_COMMANDS = (m.CommandLong, m.CommandInt)
# Messages that answer requests of the recorded client. The replayed vehicle sends them only on request.
_ANSWER_IDS = frozenset(
    kind.ID
    for kind in (
        m.CommandAck, m.CommandLong, m.CommandInt, m.ParamValue, m.ParamError, m.MissionCount, m.MissionItem,
        m.MissionItemInt, m.MissionRequest, m.MissionRequestInt, m.MissionAck, m.FileTransferProtocol, m.LogEntry,
        m.LogData, m.Timesync, m.Ping,
    )
)  # fmt: skip
_REQUEST_IDS = frozenset(
    kind.ID
    for kind in (*_COMMANDS, *_ITEMS, m.ParamSet, m.MissionCount, m.MissionClearAll)
)  # fmt: skip


_ItemsByIndex = dict[int, m.MissionItemInt | m.MissionItem]


class _Download(NamedTuple):
    item_count: int
    items: _ItemsByIndex


@dataclass
class RecordedAnswer:
    """The acknowledgements of one command."""

    params: tuple[float, ...]
    """Params 1 to 4 of the command; empty if the command itself was not recorded."""
    requested_at: float  # time of the command
    acks: list[tuple[float, m.CommandAck]] = field(default_factory=list)
    """The acknowledgements, each with its time in seconds after the command."""


@dataclass(frozen=True)
class RecordedPlan:
    """A mission, fence or list of rally points, and the time at which the vehicle got it."""

    since: float
    mission_type: int
    items: tuple[m.MissionItemInt | m.MissionItem, ...]


class RecordedFlight:
    """The part of a recording that concerns one vehicle.

    Times are in seconds since the first message of the vehicle. Long gaps in the recording are shortened.

    If ``system_id`` is None, the vehicle is the first autopilot with a HEARTBEAT. Raises InvalidArgument if the
    recording contains no such vehicle, and OSError if the file cannot be read.
    """

    system_id: int
    component_id: int

    def __init__(self, source: str | PathLike[str] | BinaryIO, system_id: int | None = None) -> None:
        frames = _frames(source)
        self.system_id, self.component_id = _find_autopilot(frames, system_id)
        self.stream: list[tuple[float, Frame]] = []
        """Frames that the vehicle sent without a request, with their times, in order."""
        self.answers: dict[int, list[RecordedAnswer]] = {}
        """Recorded answers by MAV_CMD, in order."""
        self.parameters: list[tuple[float, m.ParamValue]] = []
        """All parameter values with their times."""
        self.has_parameter_errors: bool = False
        """True if the vehicle sent PARAM_ERROR."""
        self.settable: set[str] = set()
        """Names of parameters that were set successfully."""
        self.plans: list[RecordedPlan] = []
        self.uploads: dict[int, list[int]] = {}
        """MAV_MISSION_RESULTs of uploads, by MAV_MISSION_TYPE."""
        self.clears: dict[int, list[int]] = {}
        """MAV_MISSION_RESULTs of MISSION_CLEAR_ALL, by MAV_MISSION_TYPE."""
        self.uses_int: bool = True
        """True if the vehicle requests items by MISSION_REQUEST_INT, False by MISSION_REQUEST."""
        self.duration_s: float = 0.0
        self._unconfirmed_sets: dict[str, float] = {}  # values of PARAM_SET that are not confirmed yet, by name
        # Transfers in progress, by MAV_MISSION_TYPE.
        self._uploads: dict[int, _ItemsByIndex] = {}
        self._downloads: dict[int, _Download] = {}
        self._clearing: set[int] = set()  # types of which MISSION_CLEAR_ALL is not answered yet
        self._read(frames)

    def _read(self, frames: list[tuple[float, Frame]]) -> None:
        """Divide the frames into requests of clients, answers of the vehicle, and other messages."""
        now = 0.0  # seconds since the vehicle's first message, without long gaps
        previous_unix_s = None
        for unix_s, frame in frames:
            is_of_vehicle = frame.system_id == self.system_id
            is_of_autopilot = is_of_vehicle and frame.component_id == self.component_id
            if previous_unix_s is not None:
                now += min(max(unix_s - previous_unix_s, 0.0), MAX_GAP_S)
            elif not is_of_vehicle:
                continue  # Messages before the first message of the vehicle are skipped.
            previous_unix_s = unix_s
            if frame.message_id in _REQUEST_IDS and not is_of_autopilot:
                self._read_request(STANDARD.decode(frame), now)
            elif frame.message_id in _ANSWER_IDS:
                if is_of_autopilot:
                    self._read_answer(STANDARD.decode(frame), now)
            elif is_of_vehicle:
                self.stream.append((now, frame))
        self.duration_s = now
        self._discard_unanswered()

    def _discard_unanswered(self) -> None:
        acknowledged = {
            command: [answer for answer in answers if answer.acks] for command, answers in self.answers.items()
        }
        self.answers = {command: answers for command, answers in acknowledged.items() if answers}

    def _read_request(self, message: Any, now: float) -> None:
        # Id 0 means all systems or all components.
        if message.target_system not in (0, self.system_id) or message.target_component not in (0, self.component_id):
            return
        if isinstance(message, _COMMANDS):
            is_repetition = isinstance(message, m.CommandLong) and message.confirmation > 0
            answers = self.answers.setdefault(message.command, [])
            if not answers or not is_repetition:  # A repeated command shares the answer to the first one.
                params = (message.param1, message.param2, message.param3, message.param4)
                answers.append(RecordedAnswer(params, now))
        elif isinstance(message, m.ParamSet):
            self._unconfirmed_sets[message.param_id] = message.param_value
        elif isinstance(message, m.MissionCount):
            self._uploads[message.mission_type] = {}
        elif isinstance(message, _ITEMS):
            self._uploads.setdefault(message.mission_type, {})[message.seq] = message
        elif isinstance(message, m.MissionClearAll):
            self._clearing.add(message.mission_type)

    def _read_answer(self, message: Message, now: float) -> None:
        readers: dict[type[Message], Callable[..., None]] = {
            m.CommandAck: self._read_ack,
            m.ParamValue: self._read_value,
            m.MissionCount: self._read_count,
            m.MissionItem: self._read_item,
            m.MissionItemInt: self._read_item,
            m.MissionAck: self._read_mission_ack,
        }
        if type(message) in readers:
            readers[type(message)](message, now)
        elif isinstance(message, m.ParamError):
            self.has_parameter_errors = True
        elif isinstance(message, m.MissionRequest):
            self.uses_int = False

    def _read_ack(self, ack: m.CommandAck, now: float) -> None:
        answers = self.answers.setdefault(ack.command, [])
        if not answers:
            answers.append(RecordedAnswer((), now))
        answers[-1].acks.append((now - answers[-1].requested_at, ack))

    def _read_value(self, value: m.ParamValue, now: float) -> None:
        self.parameters.append((now, value))
        if self._unconfirmed_sets.pop(value.param_id, None) == value.param_value:
            self.settable.add(value.param_id)

    def _read_count(self, count: m.MissionCount, now: float) -> None:
        self._downloads[count.mission_type] = _Download(count.count, {})
        if count.count == 0:
            self.plans.append(RecordedPlan(now, count.mission_type, ()))

    def _read_item(self, item: m.MissionItemInt | m.MissionItem, now: float) -> None:
        download = self._downloads.get(item.mission_type)
        if download is None:
            return
        download.items[item.seq] = item
        if len(download.items) == download.item_count:
            del self._downloads[item.mission_type]
            self._add_plan(item.mission_type, download.items, now)

    def _read_mission_ack(self, ack: m.MissionAck, now: float) -> None:
        # The acknowledgement ends the upload that is in progress. Without an upload, it answers MISSION_CLEAR_ALL.
        if ack.mission_type in self._uploads:
            items = self._uploads.pop(ack.mission_type)
            self.uploads.setdefault(ack.mission_type, []).append(ack.type)
            if ack.type == MavMissionResult.ACCEPTED:
                self._add_plan(ack.mission_type, items, now)
        elif ack.mission_type in self._clearing:
            self._clearing.discard(ack.mission_type)
            self.clears.setdefault(ack.mission_type, []).append(ack.type)

    def _add_plan(self, mission_type: int, items: dict[int, m.MissionItemInt | m.MissionItem], now: float) -> None:
        self.plans.append(RecordedPlan(now, mission_type, tuple(items[seq] for seq in sorted(items))))


def _frames(source: str | PathLike[str] | BinaryIO) -> list[tuple[float, Frame]]:
    """Return the frames of a recording with their times, in seconds since 1970."""
    framer = Framer()
    frames: list[tuple[float, Frame]] = []
    for unix_s, raw in read_tlog(source):
        frames += [(unix_s, frame) for frame in framer.receive(raw, unix_s)]
    return frames


def _find_autopilot(frames: list[tuple[float, Frame]], system_id: int | None) -> tuple[int, int]:
    """Return the system id and the component id of the first autopilot. Look only for ``system_id`` if it is given."""
    for _, frame in frames:
        if frame.message_id != m.Heartbeat.ID or system_id not in (None, frame.system_id):
            continue
        heartbeat = STANDARD.decode(frame)
        assert isinstance(heartbeat, m.Heartbeat)
        is_vehicle = heartbeat.autopilot != MavAutopilot.INVALID and heartbeat.type != MavType.GCS
        if is_vehicle:
            return frame.system_id, frame.component_id
    wanted = "an autopilot" if system_id is None else f"an autopilot with system id {system_id}"
    raise InvalidArgument(f"the recording contains no vehicle to play: it has no HEARTBEAT of {wanted}")
