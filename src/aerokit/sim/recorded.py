"""A recorded flight as a vehicle: it streams what was recorded, and answers as the vehicle in the recording did."""

from __future__ import annotations

from bisect import bisect_right
from typing import TYPE_CHECKING, BinaryIO

from aerokit.mavlink import messages as m
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.enums import MavCmd, MavFtpErr, MavResult
from aerokit.sim.commands import Command, CommandServer
from aerokit.sim.ftp import FtpPacket
from aerokit.sim.recorded_missions import RecordedMissions
from aerokit.sim.recorded_parameters import RecordedParameters
from aerokit.sim.recording import Answer, FlightRecording
from aerokit.sim.vehicle import SimulatedVehicle, sender_of

if TYPE_CHECKING:
    from collections.abc import Iterable
    from os import PathLike

    from aerokit.mavlink.message import Message
    from aerokit.sim.channel import Channel
    from aerokit.sim.vehicle import Component

__all__ = ["RecordedVehicle"]

_ABOUT_A_MESSAGE = (MavCmd.SET_MESSAGE_INTERVAL, MavCmd.REQUEST_MESSAGE)


class RecordedVehicle(SimulatedVehicle):
    """A ``.tlog`` played by the simulator's clock; what a client asks changes nothing of what is streamed.

    - A command gets the acknowledgements that it got then, after the same time: those of the same params first, and
      when it is sent more often than then, the last ones again. A command that nobody gave then is UNSUPPORTED.
      REQUEST_MESSAGE gives any message that the recording has, as it was last said.
    - Parameters: those that were told then, numbered anew without holes. One is set if it was set then; any other
      keeps its value and says so. Unknown names meet silence, or PARAM_ERROR where the vehicle said that.
    - Missions: what was on the vehicle then. An upload is taken, and a plan cleared, with the result that it had then;
      UNSUPPORTED if there was none.
    - Files are refused, there are no logs, rates cannot be changed; TIMESYNC and PING are answered.

    ``system_id``: which vehicle of the recording, None for the first; ``start_s``: so much of the recording is left
    out; ``repeat``: it begins anew at its end, where it is silent else. Faults work as on any vehicle, but for those
    of its sensors and parameters. InvalidArgument when no vehicle is in the recording, OSError when it cannot be
    read.
    """

    def __init__(
        self,
        recording: str | PathLike[str] | BinaryIO,
        *,
        system_id: int | None = None,
        start_s: float = 0.0,
        repeat: bool = False,
        seed: int = 0,
        components: Iterable[Component] = (),
    ) -> None:
        self.recording: FlightRecording = FlightRecording(recording, system_id)
        super().__init__(
            system_id=self.recording.system_id,
            component_id=self.recording.component_id,
            seed=seed,
            components=components,
        )
        self._start, self._repeat = start_s, repeat
        self._next = 0
        self._began_at = 0.0
        self._asked: dict[int, int] = {}
        self.parameters: RecordedParameters = RecordedParameters(self)
        """What it knows at present."""
        self.missions: RecordedMissions = RecordedMissions(self)
        """Its plans."""
        commands = dict.fromkeys(self.recording.answers, self._on_command)
        commands[MavCmd.REQUEST_MESSAGE] = self._on_request_message
        CommandServer(self, dict(commands))
        self.on(m.FileTransferProtocol, self._on_ftp)
        self.on(m.LogRequestList, self._on_log_list)
        self.on(m.Timesync, self._on_timesync)
        self.on(m.Ping, self._on_ping)

    # ----------------------------------------------------------------------------------------- playing

    @property
    def position_s(self) -> float:
        """Which second of the recording it is."""
        return min(self._start + self.now - self._began_at, self.recording.duration_s)

    @property
    def has_ended(self) -> bool:
        """Whether everything has been played, and the vehicle is silent."""
        return not self._is_on and self._next >= len(self.recording.stream)

    def boot(self) -> None:
        """Begin the recording."""
        stream = self.recording.stream
        self._began_at = self.now
        self._next = bisect_right([time for time, _ in stream], self._start - 1e-9)
        self._plan_next()

    def start_channel(self, channel: Channel) -> None:
        """Nothing of its own: a new port hears what all hear."""

    def build(self, message_id: int) -> Message | None:
        """Nothing: no stream is its own."""

    def tick(self, dt: float) -> None:
        """Nothing moves."""

    def _plan_next(self) -> None:
        stream = self.recording.stream
        if self._next < len(stream):
            self.call_at(self._began_at + stream[self._next][0] - self._start, self._play)
        else:
            self.call_at(self._began_at + self.recording.duration_s - self._start, self._end)

    def _play(self) -> None:
        stream = self.recording.stream
        time = stream[self._next][0]
        while self._next < len(stream) and stream[self._next][0] <= time:
            frame = stream[self._next][1]
            self.send(STANDARD.decode(frame), sender=(frame.system_id, frame.component_id))
            self._next += 1
        self._plan_next()

    def _end(self) -> None:
        if self._repeat and self.recording.duration_s > self._start:
            self.boot()
        else:
            self._is_on = False

    # --------------------------------------------------------------------------------------- answering

    def _on_command(self, command: Command) -> int | None:
        answer = self._answer_to(command)
        if answer is None:
            return MavResult.UNSUPPORTED
        for delay, ack in answer.acks:
            again = m.CommandAck(ack.command, ack.result, ack.progress, ack.result_param2, *command.sender)
            self.call_later(delay, lambda again=again: self.send(again, command.channel))  # type: ignore[misc]
        return None

    def _answer_to(self, command: Command) -> Answer | None:
        answers = self.recording.answers.get(command.command, [])
        params = (command.param1, command.param2, command.param3, command.param4)
        alike = [answer for answer in answers if repr(answer.params) == repr(params)]
        if command.command in _ABOUT_A_MESSAGE and not alike:
            alike = answers = [answer for answer in answers if answer.params[:1] == params[:1]]
        chosen = alike or answers
        if not chosen:
            return None
        number = self._asked.get(id(chosen[0]), 0)
        self._asked[id(chosen[0])] = number + 1
        return chosen[min(number, len(chosen) - 1)]

    def _on_request_message(self, command: Command) -> int | None:
        message = self._last_said(int(command.param1) if command.param1 == command.param1 else -1)
        if message is not None:
            self.send(message, command.channel)
            return MavResult.ACCEPTED
        return self._on_command(command)

    def _last_said(self, message_id: int) -> Message | None:
        """The message as it was last said, or will be said first."""
        stream = self.recording.stream
        own = (self.system_id, self.component_id)
        for _, frame in (*reversed(stream[: self._next]), *stream[self._next :]):
            if frame.message_id == message_id and (frame.system_id, frame.component_id) == own:
                return STANDARD.decode(frame)
        return None

    def _on_ftp(self, message: m.FileTransferProtocol, channel: Channel) -> None:
        if not self.faults.no_ftp:
            self.send(FtpPacket.parse(message).refuse(MavFtpErr.UNKNOWNCOMMAND).message(), channel)

    def _on_log_list(self, message: m.LogRequestList, channel: Channel) -> None:
        self.send(m.LogEntry(0, 0, 0, 0, 0), channel)

    def _on_timesync(self, message: m.Timesync, channel: Channel) -> None:
        if message.tc1 == 0:
            nanoseconds = int(self.position_s * 1e9)
            self.send(m.Timesync(nanoseconds, message.ts1), channel)

    def _on_ping(self, message: m.Ping, channel: Channel) -> None:
        if message.target_system == 0:
            self.send(m.Ping(message.time_usec, message.seq, *sender_of(message)), channel)
