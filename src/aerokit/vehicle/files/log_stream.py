"""``LogStream``: receives the flight log that PX4 sends while it is being written."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit._internal.arguments import checks_arguments
from aerokit._internal.async_block import ReadOnly
from aerokit.errors import CommandRejected
from aerokit.mavlink.enums import MavCmd
from aerokit.mavlink.messages import LoggingAck, LoggingData, LoggingDataAcked
from aerokit.vehicle.commanding.simple_orders import SimpleOrder

if TYPE_CHECKING:
    from typing_extensions import Self

    from aerokit.connection.bus import Subscription
    from aerokit.vehicle.commanding.context import VehicleContext

__all__ = ["LogStream"]

START = SimpleOrder("logs.stream", MavCmd.LOGGING_START, (0,), missing_on=("ArduPilot",))
STOP = SimpleOrder("logs.stream", MavCmd.LOGGING_STOP)
MAGIC, HEADER_BYTES = b"ULog\x01\x12\x35", 16
NO_MESSAGE_START = 255
"""Value of ``first_message_offset`` if no ULog message begins in a LOGGING_DATA."""
SEQUENCE_RANGE = 1 << 16
"""The sequence numbers of the stream have 16 bits."""
MAX_WAITING = 8192
"""Maximum number of messages that wait for the reader; they need about 2 MB."""
DROPOUT = b"\x02\x00O"
"""Beginning of the ULog message that marks a gap; the duration in ms follows (2 bytes)."""


class UlogAssembler:
    """Assembles the messages of a log stream into a valid ULog file, with marks where messages are missing.

    After a gap in the sequence numbers, all data up to the start of the next ULog message is discarded.
    """

    def __init__(self) -> None:
        self.lost: int = 0
        """Number of messages that were not received."""
        # Expected sequence number; None before the first message.
        self._next_sequence: int | None = None
        self._has_header = False
        # False after a gap, until the beginning of a ULog message is received.
        self._is_aligned = False
        # The received part of a ULog message that is not complete yet.
        self._buffer = bytearray()
        self.received_at: float = 0.0
        """Time of the last message that was used."""

    def add(self, message: LoggingData | LoggingDataAcked, now: float) -> bytes:
        """Add a message of the stream, and return the bytes to append to the file."""
        gap = 0 if self._next_sequence is None else (message.sequence - self._next_sequence) % SEQUENCE_RANGE
        if gap >= SEQUENCE_RANGE // 2:  # An old message, which PX4 repeats if our acknowledgement was lost.
            return b""
        data = bytes(message.data[: message.length])
        prefix = b""  # the header of the file, or a ULog message that marks a gap
        if gap:
            self.lost += gap
            self._buffer.clear()  # The rest of this ULog message is lost.
            self._is_aligned = False
        self._next_sequence = (message.sequence + 1) % SEQUENCE_RANGE
        if not self._has_header:
            if not data.startswith(MAGIC):
                return b""  # The log begins with its header, so nothing before the header is used.
            self._has_header = True
            self._is_aligned = True
            prefix, data = data[:HEADER_BYTES], data[HEADER_BYTES:]
        elif not self._is_aligned:
            if message.first_message_offset == NO_MESSAGE_START:
                return b""  # This is the rest of a ULog message whose beginning was lost.
            data = data[message.first_message_offset :]
            self._is_aligned = True
            gap_ms = round(1000 * (now - self.received_at))
            prefix = DROPOUT + min(0xFFFF, gap_ms).to_bytes(2, "little")  # The field has 16 bits.
        self.received_at = now
        self._buffer += data
        return prefix + self._pop_complete()

    def _pop_complete(self) -> bytes:
        end = 0
        while len(self._buffer) >= end + 3:
            # A ULog message has 2 bytes of length, 1 byte of type, and the content.
            message_size = 3 + int.from_bytes(self._buffer[end : end + 2], "little")
            if len(self._buffer) < end + message_size:
                break
            end += message_size
        complete = bytes(self._buffer[:end])
        del self._buffer[:end]
        return complete


@checks_arguments
class LogStream(ReadOnly):
    """PX4's flight log, received while PX4 writes it (LOGGING_DATA): an async iterator over bytes.

    If you append all bytes to a file, the file is a valid ULog file at any time. Lost messages are marked in the log as
    dropouts; ``lost`` counts them. PX4 streams its log to one station at a time.

    The iterator has no end: leave the loop by ``break``, or cancel the task. Leaving the block stops the stream.

    Entering raises:
        NotSupported: the vehicle runs ArduPilot. Nothing was sent.
        CommandRejected: PX4 streams to another station, or the port is too slow (below 5 kB/s).
        CommandTimeout: there was no acknowledgement; aerokit stops the stream, which may have begun.
    """

    def __init__(self, context: VehicleContext, idle_timeout_s: float) -> None:
        self._context, self._idle_timeout_s = context, idle_timeout_s
        session = context.session
        self._messages: Subscription[LoggingData | LoggingDataAcked] = session.connection.subscribe(
            LoggingData, LoggingDataAcked, system_id=session.system_id, capacity=MAX_WAITING, overflow="drop_newest"
        )
        self._assembler = UlogAssembler()

    @property
    def lost(self) -> int:
        """Number of LOGGING_DATA messages that were lost, or dropped because your program read too slowly."""
        return self._assembler.lost

    async def __aenter__(self) -> Self:
        """Begin to receive and acknowledge messages, and start the stream."""
        START.check_supported(self._context)
        self._messages.__enter__()
        session = self._context.session
        self._detach = session.connection.bus.attach(LoggingDataAcked, self._acknowledge, system_id=session.system_id)
        self._detach_end = session.end.on_end(self._messages.close)
        self._detach_finish = self._context.on_finish(self._stop_soon)
        try:
            await START.send(self._context)
        except BaseException as error:
            self._close()
            # If the vehicle refused, a running stream may belong to another station, so do not stop the stream.
            if not isinstance(error, CommandRejected):
                self._stop_soon()
            raise
        return self

    def _close(self) -> None:
        self._messages.close()
        self._detach()
        self._detach_end()
        self._detach_finish()

    def _stop_soon(self) -> None:
        session = self._context.session
        if session.is_open:
            # Send the command now, because the connection may close before the background task runs.
            session.commands.send_unconfirmed(MavCmd.LOGGING_STOP)
            session.transfers.command_in_background(MavCmd.LOGGING_STOP, was_just_sent=True)

    def _acknowledge(self, message: LoggingDataAcked) -> None:
        # PX4 repeats a message every 50 ms until it is acknowledged, and ends the stream after 50 times.
        session = self._context.session
        session.send(LoggingAck(session.system_id, session.component_id, message.sequence))

    async def __aexit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        """Stop the stream; after an error or a cancellation, without waiting for the acknowledgement."""
        is_stopped = False
        try:
            if error is None:
                # PX4 answers STOP only after its last log message was acknowledged (logger.cpp), so send STOP before
                # `_close` ends the acknowledgements.
                await STOP.send(self._context)
                is_stopped = True
        finally:
            self._close()
            if not is_stopped:
                self._stop_soon()

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> bytes:
        """Return the next complete part of the log.

        Raises:
            InvalidArgument: the block is not open.
            ConnectionClosed, LinkLost: the connection or the vehicle's block has ended.
            OperationTimeout: nothing was received for ``idle_timeout_s`` seconds.
        """
        connection = self._context.session.connection
        started_at = connection.now()
        while True:  # Messages that add nothing to the log do not extend the time-out.
            idle_since = max(started_at, self._assembler.received_at)
            message = await self._messages.get(max(0.0, idle_since + self._idle_timeout_s - connection.now()))
            if message.target_system not in (0, connection.source_system):
                continue  # PX4 streams to another station.
            data = self._assembler.add(message, connection.now())
            if data:
                return data
