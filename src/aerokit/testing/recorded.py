"""`RecordedVehicle`: plays a recorded flight as a vehicle."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterable
from functools import partial
from os import PathLike
from typing import BinaryIO, ClassVar

from aerokit.mavlink import messages as m
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.enums import MavCmd, MavFrame, MavFtpErr, MavMissionResult, MavParamError, MavResult
from aerokit.mavlink.message import Message
from aerokit.missions import MissionItem
from aerokit.missions.item import LOCAL_FRAMES
from aerokit.parameters.encoding import UNKNOWN_INDEX
from aerokit.parameters.pack import HASH_NAME
from aerokit.protocols.servers.ftp_packets import FtpPacket
from aerokit.protocols.servers.host import ComponentIds
from aerokit.protocols.servers.missions import (
    AnyItem,
    AnyListMessage,
    AnyRequest,
    ListUpload,
    MissionServer,
    item_from,
    item_message,
)
from aerokit.protocols.servers.parameters import ParameterProtocolServer
from aerokit.sim.channel import Channel
from aerokit.sim.commands import CommandServer, ReceivedCommand
from aerokit.sim.vehicle import AttachableComponent, SimulatedVehicle, sender_of
from aerokit.testing.recording import RecordedAnswer, RecordedFlight

_LIST_RATE_HZ = 1000.0
_MAX_ITEMS = 1 << 16


class RecordedParameters(ParameterProtocolServer):
    """Handles PARAM_REQUEST_LIST, PARAM_REQUEST_READ and PARAM_SET."""

    starts_at_once = True

    def __init__(self, vehicle: RecordedVehicle) -> None:
        super().__init__(vehicle, self, list_rate_hz=_LIST_RATE_HZ)
        self._vehicle = vehicle
        self._written: dict[str, float] = {}  # values that clients have set
        self._recorded: dict[str, list[tuple[float, m.ParamValue]]] = {}  # recorded values with their times, by name
        for time, value in vehicle.recording.parameters:
            self._recorded.setdefault(value.param_id, []).append((time, value))
        values = [value for _, value in vehicle.recording.parameters]
        # ArduPilot's answers to writes and to reads by name have UNKNOWN_INDEX instead of the index.
        indices = {value.param_id: value.param_index for value in values if value.param_index != UNKNOWN_INDEX}
        without_index = [name for name in self._recorded if name not in indices]
        is_complete = bool(indices) and len(indices) == max(value.param_count for value in values)
        self.names: list[str] = sorted(indices, key=lambda name: (indices[name], name))
        """Names in the order in which the vehicle lists its parameters."""
        self.names += [name for name in without_index if name != HASH_NAME]
        # PX4's hash covers all parameters, so the recorded hash is wrong for an incomplete list of parameters.
        self._has_hash = is_complete and HASH_NAME in without_index

    def value_message(self, name: str, index: int) -> m.ParamValue:
        recorded = self._recorded[name]
        _, latest = recorded[0]
        for time, value in recorded:
            if time <= self._vehicle.position_s:
                latest = value
        written = self._written.get(name, latest.param_value)
        return m.ParamValue(name, written, latest.param_type, len(self.names), index)

    def _on_list(self, request: m.ParamRequestList, channel: Channel) -> None:
        if self._has_hash:
            self.send(HASH_NAME, UNKNOWN_INDEX, channel)
        self.start_list(channel)

    def _on_read(self, request: m.ParamRequestRead, channel: Channel) -> None:
        if self.send_requested(request.param_id, request.param_index, channel):
            return
        is_by_name = request.param_index < 0
        if is_by_name and request.param_id == HASH_NAME and self._has_hash:
            self.send(HASH_NAME, UNKNOWN_INDEX, channel)
        else:
            self._refuse(request, request.param_index, channel)

    def _on_set(self, request: m.ParamSet, channel: Channel) -> None:
        name = request.param_id
        if name not in self.names:
            self._refuse(request, index=-1, channel=channel)  # -1 because the request has no index
            return
        # Only parameters that were set in the recording can be set. The answer always contains the current value.
        if name in self._vehicle.recording.settable:
            self._written[name] = request.param_value
        self.send(name, self.names.index(name), None)

    def _refuse(self, request: m.ParamRequestRead | m.ParamSet, index: int, channel: Channel) -> None:
        # The recorded vehicle answers with PARAM_ERROR only if it ever sent PARAM_ERROR.
        if self._vehicle.recording.has_parameter_errors:
            self.send_error(sender_of(request), request.param_id, index, MavParamError.DOES_NOT_EXIST, channel)


class RecordedMissions(MissionServer):
    """Serves the recorded plans, and answers uploads with the recorded results."""

    retry_interval_s: ClassVar[float] = 1.0

    def __init__(self, vehicle: RecordedVehicle) -> None:
        super().__init__(vehicle, capacity=_MAX_ITEMS)
        self._vehicle = vehicle
        self.requests_int: bool = vehicle.recording.uses_int
        self._received: list[AnyItem] = []  # items of the upload in progress
        self._written: dict[int, tuple[AnyItem, ...]] = {}  # uploaded plans by MAV_MISSION_TYPE
        # Number of recorded results that were already sent, by operation and MAV_MISSION_TYPE.
        self._result_counts: dict[tuple[str, int], int] = {}

    def items(self, mission_type: int) -> tuple[AnyItem, ...] | None:
        """Return the items of the plan that the vehicle has at present; None without such a plan."""
        if mission_type in self._written:
            return self._written[mission_type]
        items = None
        for plan in self._vehicle.recording.plans:  # The plans are in the order of their times.
            is_first = items is None  # The first plan is served from the start, like the first value of a parameter.
            if plan.mission_type == mission_type and (is_first or plan.since <= self._vehicle.position_s):
                items = plan.items
        return items

    def count(self, mission_type: int) -> int:
        return len(self.items(mission_type) or ())

    def _refusal(self, message: AnyListMessage, channel: Channel) -> int | None:
        kind = message.mission_type
        if isinstance(message, m.MissionCount):  # an upload
            is_recorded = kind in self._vehicle.recording.uploads
        else:
            is_recorded = self.items(kind) is not None
        return None if is_recorded else MavMissionResult.UNSUPPORTED

    def item(self, mission_type: int, seq: int) -> MissionItem | None:
        items = self.items(mission_type) or ()
        return item_from(items[seq]) if seq < len(items) else None

    def _message(self, item: MissionItem, request: AnyRequest) -> AnyItem:
        recorded = (self.items(request.mission_type) or ())[request.seq]
        wants_float = isinstance(request, m.MissionRequest)
        return _item_message(recorded, request.seq, sender_of(request), wants_float=wants_float)

    def _store_item(self, upload: ListUpload, message: AnyItem) -> None:
        self._received[message.seq :] = [message]

    def _finish(self, upload: ListUpload) -> None:
        kind = upload.mission_type
        result = self._recorded_result("upload", self._vehicle.recording.uploads[kind], kind)
        if result == MavMissionResult.ACCEPTED:
            self._written[kind] = tuple(self._received[: upload.end])
        self._end(upload, result)

    def _time_out(self, upload: ListUpload) -> None:
        self._drop(upload)

    def _on_clear(self, request: m.MissionClearAll, channel: Channel) -> None:
        kind = request.mission_type
        result = int(MavMissionResult.UNSUPPORTED)
        if kind in self._vehicle.recording.clears:
            result = self._recorded_result("clear", self._vehicle.recording.clears[kind], kind)
        if result == MavMissionResult.ACCEPTED:
            self._written[kind] = ()
        self._acknowledge(sender_of(request), kind, result, channel)

    def _on_set_current(self, request: m.MissionSetCurrent, channel: Channel) -> None:
        """Do nothing: the recording decides which item is current."""

    def _recorded_result(self, request: str, results: list[int], mission_type: int) -> int:
        """Return the next of the recorded results. After the last one, return it again."""
        number = self._result_counts.get((request, mission_type), 0)
        self._result_counts[request, mission_type] = number + 1
        return results[min(number, len(results) - 1)]


def _item_message(item: AnyItem, seq: int, client: ComponentIds, *, wants_float: bool) -> AnyItem:
    """Convert a recorded item to MISSION_ITEM (``wants_float``) or MISSION_ITEM_INT."""
    # In MISSION_ITEM_INT, x and y are degrees times 1e7, in local frames metres times 1e4, and in MAV_FRAME_MISSION
    # numbers without a scale.
    scale = 1e4 if item.frame in LOCAL_FRAMES else 1e7
    if item.frame == MavFrame.MISSION:
        scale = 1.0
    was_float = isinstance(item, m.MissionItem)
    place = (item.x, item.y) if was_float else (item.x / scale, item.y / scale)
    converted = item_from(item)  # with x and y as recorded
    if was_float and not wants_float:
        converted = converted.replace(x=round(item.x * scale), y=round(item.y * scale))
    current = bool(item.current)
    return item_message(converted, seq, client, item.mission_type, as_int=not wants_float, current=current, place=place)


_MESSAGE_REQUESTS = (MavCmd.SET_MESSAGE_INTERVAL, MavCmd.REQUEST_MESSAGE)


class RecordedVehicle(SimulatedVehicle):
    """Plays a ``.tlog`` by the simulator's clock. Requests of clients do not change the streamed messages.

    - Commands: a command gets the acknowledgements that were recorded for the same params or, if there are none, for
      other params, each after its recorded delay. If a command is repeated, it gets the next recorded answer; after the
      last one, it gets the last one again. Commands that were not recorded are UNSUPPORTED. REQUEST_MESSAGE sends the
      latest played message of this type or, if none was played yet, the first in the recording.
    - Parameters: the vehicle has the recorded parameters, renumbered without gaps. Only parameters that were set in the
      recording can be set. A request for an unknown parameter gets PARAM_ERROR if the recorded vehicle ever sent
      PARAM_ERROR, otherwise no answer.
    - Missions: the vehicle has the recorded missions. An upload or a clearing gets the recorded result or, if there is
      none, UNSUPPORTED.
    - File operations are refused, the list of logs is empty, and rates cannot be changed. TIMESYNC and PING are
      answered.

    ``system_id`` selects a vehicle of the recording, by default the first. ``start_s`` skips the beginning. At the end,
    the vehicle falls silent or, with ``repeat``, the recording starts again. Faults apply, except those of sensors and
    parameters.

    Raises InvalidArgument if there is no vehicle in the recording, OSError if it cannot be read.
    """

    def __init__(
        self,
        recording: str | PathLike[str] | BinaryIO,
        *,
        system_id: int | None = None,
        start_s: float = 0.0,
        repeat: bool = False,
        seed: int = 0,
        components: Iterable[AttachableComponent] = (),
    ) -> None:
        self.recording: RecordedFlight = RecordedFlight(recording, system_id)
        super().__init__(
            system_id=self.recording.system_id,
            component_id=self.recording.component_id,
            seed=seed,
            components=components,
        )
        self._start_s = start_s
        self._repeat = repeat
        self._next = 0  # index of the next frame in `recording.stream`
        self._began_at = 0.0  # the vehicle's time at which playing began
        # Maps lists of recorded answers to the number of answers that were sent. A list is identified by the `id()`s of
        # its answers.
        self._answered_counts: dict[tuple[int, ...], int] = {}
        self.parameters: RecordedParameters = RecordedParameters(self)
        """Current parameters."""
        self.missions: RecordedMissions = RecordedMissions(self)
        """Current plans."""
        commands = dict.fromkeys(self.recording.answers, self._on_command)
        commands[MavCmd.REQUEST_MESSAGE] = self._on_request_message
        CommandServer(self, dict(commands))
        self.on(m.FileTransferProtocol, self._on_ftp)
        self.on(m.LogRequestList, self._on_log_list)
        self.on(m.Timesync, self._on_timesync)
        self.on(m.Ping, self._on_ping)

    @property
    def position_s(self) -> float:
        """Current position in the recording, in seconds."""
        return min(self._start_s + self.now - self._began_at, self.recording.duration_s)

    @property
    def has_ended(self) -> bool:
        """True if the whole recording was played and the vehicle is silent."""
        return not self.is_on and self._next >= len(self.recording.stream)

    def boot(self) -> None:
        stream = self.recording.stream
        self._began_at = self.now
        # The tolerance includes messages that were recorded at exactly the start time.
        self._next = bisect_right([time for time, _ in stream], self._start_s - 1e-9)
        self._schedule_next()

    def _schedule_next(self) -> None:
        stream = self.recording.stream
        if self._next < len(stream):
            time, _ = stream[self._next]
            self.call_at(self._began_at + time - self._start_s, self._play)
        else:
            self.call_at(self._began_at + self.recording.duration_s - self._start_s, self._end)

    def _play(self) -> None:
        stream = self.recording.stream
        due_at, _ = stream[self._next]
        while self._next < len(stream):
            time, frame = stream[self._next]
            if time > due_at:
                break
            self.send(STANDARD.decode(frame), sender=(frame.system_id, frame.component_id))
            self._next += 1
        self._schedule_next()

    def _end(self) -> None:
        if self._repeat and self.recording.duration_s > self._start_s:
            self.boot()
        else:
            self.is_on = False

    def _on_command(self, command: ReceivedCommand) -> int | None:
        answer = self._answer_to(command)
        if answer is None:
            return MavResult.UNSUPPORTED
        for delay, ack in answer.acks:
            # The recorded acknowledgement is addressed to the recorded client. Address it to the sender of `command`
            # instead.
            system_id, component_id = command.sender
            readdressed = m.CommandAck(
                command=ack.command,
                result=ack.result,
                progress=ack.progress,
                result_param2=ack.result_param2,
                target_system=system_id,
                target_component=component_id,
            )
            self.call_later(delay, partial(self.send, readdressed, command.channel))
        return None  # The simulator sends no COMMAND_ACK besides the recorded ones.

    def _answer_to(self, command: ReceivedCommand) -> RecordedAnswer | None:
        """Return the next recorded answer to a command; None if none was recorded.

        After the last answer, the last answer is returned again.
        """
        answers = self.recording.answers.get(command.command, [])
        params = (command.param1, command.param2, command.param3, command.param4)
        # The params are compared by repr(), because NaN is not equal to NaN.
        candidates = [answer for answer in answers if repr(answer.params) == repr(params)]
        # A request for a message matches any answer for that message. Param 1 is the id of the message.
        if not candidates and command.command in _MESSAGE_REQUESTS:
            candidates = [answer for answer in answers if answer.params[:1] == params[:1]]
        elif not candidates:  # Use the answers to the same command with other params.
            candidates = answers
        if not candidates:
            return None
        list_id = tuple(map(id, candidates))
        count = self._answered_counts.get(list_id, 0)
        self._answered_counts[list_id] = count + 1
        return candidates[min(count, len(candidates) - 1)]

    def _on_request_message(self, command: ReceivedCommand) -> int | None:
        message_id = -1 if math.isnan(command.param1) else int(command.param1)
        message = self._latest_message(message_id)
        if message is not None:
            self.send(message, command.channel)
            return MavResult.ACCEPTED
        return self._on_command(command)

    def _latest_message(self, message_id: int) -> Message | None:
        """Return the latest played message with this id, or else the first recorded one, or None."""
        stream = self.recording.stream
        own_ids = (self.system_id, self.component_id)
        played = stream[: self._next]
        not_yet_played = stream[self._next :]
        for _, frame in (*reversed(played), *not_yet_played):
            if frame.message_id == message_id and (frame.system_id, frame.component_id) == own_ids:
                return STANDARD.decode(frame)
        return None

    def _on_ftp(self, message: m.FileTransferProtocol, channel: Channel) -> None:
        if not self.faults.no_ftp:
            self.send(FtpPacket.parse(message).refuse(MavFtpErr.UNKNOWNCOMMAND).message(), channel)

    def _on_log_list(self, message: m.LogRequestList, channel: Channel) -> None:
        self.send(m.LogEntry(id=0, num_logs=0, last_log_num=0, time_utc=0, size=0), channel)

    def _on_timesync(self, message: m.Timesync, channel: Channel) -> None:
        if message.tc1 == 0:  # A TIMESYNC with another value is an answer.
            self.send(m.Timesync(tc1=int(self.position_s * 1e9), ts1=message.ts1), channel)

    def _on_ping(self, message: m.Ping, channel: Channel) -> None:
        if message.target_system == 0:  # A PING with a target is an answer.
            system_id, component_id = sender_of(message)
            self.send(m.Ping(message.time_usec, message.seq, system_id, component_id), channel)
