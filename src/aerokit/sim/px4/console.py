"""System shell and log streaming of a simulated PX4."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavResult, SerialControlDev, SerialControlFlag
from aerokit.sim.commands import ReceivedCommand
from aerokit.sim.vehicle import sender_of

if TYPE_CHECKING:
    from aerokit.sim.channel import Channel
    from aerokit.sim.vehicle import SimulatedVehicle

# Sizes of the fields `data` of SERIAL_CONTROL and LOGGING_DATA.
_SERIAL_BYTES, _LOGGING_BYTES = 70, 249
_BLOCK_INTERVAL_S, _MAX_TRIES = 0.05, 50
_DEFINITION_BLOCKS = 2
# Magic bytes with the file version, and a start time of 0 (https://docs.px4.io/main/en/dev_log/ulog_file_format.html).
_HEADER = b"ULog\x01\x12\x35\x01" + bytes(8)


class Px4Shell:
    """Answers each line with an echo, its output and the prompt. The answer goes to the sender of the line."""

    def __init__(self, px4: SimulatedVehicle) -> None:
        self._px4 = px4
        self._line = b""  # characters received since the last line end
        self.is_open: bool = False
        px4.on(m.SerialControl, self._on_input)

    def _on_input(self, message: m.SerialControl, channel: Channel) -> None:
        if message.device != SerialControlDev.DEV_SHELL or message.flags & SerialControlFlag.REPLY:
            return
        self.is_open = bool(message.flags & SerialControlFlag.RESPOND)
        # Without RESPOND, PX4 closes the shell (mavlink_receiver.cpp), which forgets the line.
        self._line = self._line + bytes(message.data[: message.count]) if self.is_open else b""
        if not self._line.endswith(b"\n"):
            return
        line = self._line
        self._line = b""
        output = line + self._output(line.decode(errors="replace").strip()) + b"pxh> "
        for start in range(0, len(output), _SERIAL_BYTES):
            piece = output[start : start + _SERIAL_BYTES]
            target_system, target_component = sender_of(message)
            reply = m.SerialControl(
                device=SerialControlDev.DEV_SHELL, flags=SerialControlFlag.REPLY, timeout=0, baudrate=0,
                count=len(piece), data=piece.ljust(_SERIAL_BYTES, b"\0"), target_system=target_system,
                target_component=target_component,
            )  # fmt: skip
            self._px4.send(reply, channel)

    def _output(self, command: str) -> bytes:
        if command.startswith("echo "):
            return command.removeprefix("echo ").encode() + b"\n"
        if not command:
            return b""
        return f"Invalid command: {command}\ntype 'help' for a list of commands\n".encode()


class Px4LogStream:
    """Streams a log. The definitions come first and must be acknowledged. Data follows without acknowledgements."""

    def __init__(self, px4: SimulatedVehicle) -> None:
        self._px4 = px4
        # System id and component id of the client; None while no log is streamed.
        self._client: tuple[int, int] | None = None
        self._channel: Channel | None = None
        self._stream_number = 0  # number of this stream; a scheduled `_send_block` of an earlier stream does nothing
        self._sequence = 0  # number of the next block
        self._tries = 0  # how often this block was sent
        self._acknowledged = 0  # number of definition blocks that were acknowledged
        px4.on(m.LoggingAck, self._on_ack)

    def start(self, command: ReceivedCommand) -> int:
        if self._client is not None:
            return MavResult.TEMPORARILY_REJECTED
        log_format = command.param1
        if log_format:  # PX4 supports only ULog (0).
            return MavResult.UNSUPPORTED
        self._client = command.sender
        self._channel = command.channel
        self._sequence = self._tries = self._acknowledged = 0
        self._stream_number += 1
        self._schedule_block(self._stream_number)
        return MavResult.ACCEPTED

    def stop(self, _: ReceivedCommand) -> int:
        self._client = None
        return MavResult.ACCEPTED

    def _on_ack(self, ack: m.LoggingAck, _: Channel) -> None:
        if ack.sequence == self._sequence and self._sends_definitions:
            self._sequence += 1
            self._acknowledged += 1
            self._tries = 0

    @property
    def _sends_definitions(self) -> bool:
        return self._acknowledged < _DEFINITION_BLOCKS

    def _schedule_block(self, stream: int) -> None:
        self._px4.call_later(_BLOCK_INTERVAL_S, lambda: self._send_block(stream))

    def _send_block(self, stream: int) -> None:
        if self._client is None or stream != self._stream_number:
            return
        self._tries += 1
        if self._tries > _MAX_TRIES and self._sends_definitions:  # No acknowledgement has arrived, so the stream ends.
            self._client = None
            return
        # Each block contains two text messages, and the first block begins with the header of the file.
        message_class = m.LoggingDataAcked if self._sends_definitions else m.LoggingData
        header = _HEADER if self._acknowledged == 0 else b""
        data = header + b"".join(_ulog_message(number) for number in range(2))
        sequence = self._sequence & 0xFFFF
        first_message_offset = len(header)
        padded = data.ljust(_LOGGING_BYTES, b"\0")
        block = message_class(*self._client, sequence, len(data), first_message_offset, padded)
        self._px4.send(block, self._channel)
        if not self._sends_definitions:  # A block of ULog definitions is sent again until it is acknowledged.
            self._sequence += 1
        self._schedule_block(stream)


def _ulog_message(number: int) -> bytes:
    """Return a text message of ULog: its size, "L", level, time in µs, text."""
    text = bytes([ord("6")]) + bytes(8) + f"part {number}".encode()
    return len(text).to_bytes(2, "little") + b"L" + text
