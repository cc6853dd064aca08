"""Messages on request: REQUEST_MESSAGE, and streams set by SET_MESSAGE_INTERVAL.

https://mavlink.io/en/mavgen_python/howto_requestmessages.html
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from aerokit.mavlink.enums import MavCmd, MavResult
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import MessageInterval
from aerokit.protocols.servers.commands import CommandHandler, ReceivedCommand, to_int
from aerokit.protocols.servers.host import Channel, ServerHost

# Function that returns the current messages with one id. Its argument is the REQUEST_MESSAGE command, or None when the
# messages are streamed.
Builder = Callable[["ReceivedCommand | None"], "Iterable[Message]"]


# A longer interval is divided, so that the timers of streams that were stopped or replaced do not accumulate.
_MAX_TIMER_S = 10.0
_NOT_STREAMED = -1  # interval in MESSAGE_INTERVAL


class MessageStreams:
    """Sends messages on request or periodically. ``builders`` maps each message id to its `Builder`.

    A stream with an interval below ``min_interval_s`` is sent every ``min_interval_s``. At most ``max_streams`` run.
    """

    def __init__(self, host: ServerHost, *, min_interval_s: float = 0.0, max_streams: int | None = None) -> None:
        self.builders: dict[int, Builder] = {}
        self._host = host
        self._min_interval_s = min_interval_s
        self._max_streams = max_streams
        self._streams: dict[tuple[Channel, int], _Stream] = {}

    def commands(self) -> dict[int, CommandHandler]:
        return {
            MavCmd.REQUEST_MESSAGE: lambda command: self.answer_with(to_int(command.param1), command),
            MavCmd.SET_MESSAGE_INTERVAL: self._set_interval,
            MavCmd.GET_MESSAGE_INTERVAL: self._get_interval,
        }

    def clear(self) -> None:
        self._streams.clear()

    def stream(self, message_id: int, interval_s: float, channel: Channel = None) -> bool:
        """Stream messages with this id on one channel, or on all channels (None).

        An interval of 0 or less stops the stream. Returns False if there are too many streams.
        """
        key = (channel, message_id)
        if interval_s <= 0.0:
            self._streams.pop(key, None)
            return True
        interval_s = max(interval_s, self._min_interval_s)
        running = self._streams.get(key)
        if running is None and self._max_streams is not None and len(self._streams) >= self._max_streams:
            return False
        if running is None or running.interval_s != interval_s:
            self._streams[key] = _Stream(interval_s)
            try:
                self._send_stream(key, self._streams[key])
            except Exception:  # The requester gets the error as the answer, so nothing must be streamed to it.
                del self._streams[key]
                raise
        return True

    def _send_stream(self, key: tuple[Channel, int], stream: _Stream) -> None:
        if self._streams.get(key) is not stream:  # This stream was stopped, or replaced by a new one.
            return
        channel, message_id = key
        try:
            for message in self.builders[message_id](None):
                self._host.send(message, channel)
            stream.is_failing = False
        except Exception:
            if not stream.is_failing:  # The host reports the first failure only, and the stream continues.
                stream.is_failing = True
                raise
        finally:
            self._wait(key, stream, self._host.now + stream.interval_s)

    def _wait(self, key: tuple[Channel, int], stream: _Stream, due_at: float) -> None:
        """Send the next message of a stream at ``due_at``."""
        if due_at - self._host.now <= _MAX_TIMER_S:
            self._host.call_at(due_at, lambda: self._send_stream(key, stream))
        elif self._streams.get(key) is stream:
            self._host.call_later(_MAX_TIMER_S, lambda: self._wait(key, stream, due_at))

    def answer_with(self, message_id: int, command: ReceivedCommand) -> int:
        """Send the requested messages. Return DENIED for an unknown id, or FAILED if there is nothing to send yet."""
        builder = self.builders.get(message_id)
        if builder is None:
            return MavResult.DENIED
        messages = list(builder(command))
        for message in messages:
            self._host.send(message, command.channel)
        return MavResult.ACCEPTED if messages else MavResult.FAILED

    def _set_interval(self, command: ReceivedCommand) -> int:
        message_id = to_int(command.param1)
        if message_id not in self.builders:
            return MavResult.DENIED
        # Stop the stream to all channels: this channel would get it in addition to its own stream.
        self._streams.pop((None, message_id), None)
        # 0 requests the default rate. There is none, so the stream stops, as with -1.
        is_accepted = self.stream(message_id, to_int(command.param2) / 1e6, command.channel)
        return MavResult.ACCEPTED if is_accepted else MavResult.TEMPORARILY_REJECTED

    def _get_interval(self, command: ReceivedCommand) -> int:
        message_id = to_int(command.param1)
        if message_id not in self.builders:
            return MavResult.DENIED
        stream_to_all = self._streams.get((None, message_id))
        stream = self._streams.get((command.channel, message_id), stream_to_all)
        interval_us = _NOT_STREAMED if stream is None else round(stream.interval_s * 1e6)
        self._host.send(MessageInterval(message_id, interval_us), command.channel)
        return MavResult.ACCEPTED


class _Stream:
    def __init__(self, interval_s: float) -> None:
        self.interval_s = interval_s
        self.is_failing = False  # True if the builder has raised at its last call
