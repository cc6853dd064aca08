"""Services of the scripted vehicle: parameters, files by MAVFTP, requests for streams and messages."""

from __future__ import annotations

import struct
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from dronekit_traffic import packed

if TYPE_CHECKING:
    from dronekit_vehicle import Vehicle

__all__ = ["Services", "parameter_names"]

REAL32 = 9
LOOP_PERIOD_S = 0.0025
"""Period of ArduCopter's main loop (400 Hz), in which it sends parameters."""
PARAM_VALUE_SIZE = 37
"""Bytes of a PARAM_VALUE frame."""
FTP = 32
CAPABILITIES_WITHOUT_FTP = 64495 & ~FTP
# MAV_CMDs, and the id of a message.
REQUEST_MESSAGE = 512
REQUEST_CAPABILITIES = 520
AUTOPILOT_VERSION = 148
# Values of MAV_RESULT.
ACCEPTED = 0
UNSUPPORTED = 3

FTP_HEADER = struct.Struct("<HBBBBBxI")
# Opcodes of MAVFTP.
TERMINATE = 1
RESET = 2
OPEN_RO = 4
READ = 5
BURST_READ = 15
ACK = 128
NAK = 129
# Error codes of MAVFTP.
FAIL = 1
END_OF_FILE = 6
NOT_FOUND = 10
DATA_SIZE = 239
PACK = "@PARAM/param.pck"
PACKED_FLOAT = 4
"""Type of a 32-bit float in this file."""
GROUPS = ("ATC", "BATT", "EK3", "INS", "RC", "SERVO", "PSC", "WPNAV")


def parameter_names(count: int) -> list[str]:
    """Return parameter names with the typical length of ArduPilot's, in the order of their indices."""
    return [f"{GROUPS[number % len(GROUPS)]}_BENCH{number}" for number in range(count)]


class Services:
    """Answers requests with the timing of a real vehicle."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._vehicle = vehicle
        self._options = vehicle.options
        names = sorted(parameter_names(vehicle.options.parameters))
        self._parameters = [(name, 0.5 + index) for index, name in enumerate(names)]
        # Numbers of the newest list and burst. A list or burst with an older number stops.
        self._list_number = 0
        self._burst_number = 0
        self._file = b""
        self._answers: dict[str, Callable[[Any], None]] = {
            "PARAM_REQUEST_LIST": self._on_list,
            "PARAM_REQUEST_READ": self._on_read,
            "REQUEST_DATA_STREAM": lambda request: vehicle.stream(request.req_message_rate),
            "COMMAND_LONG": self._on_command,
            "FILE_TRANSFER_PROTOCOL": self._on_file,
        }

    def receive(self, message: Any) -> None:
        """Process a pymavlink message of the client."""
        answer = self._answers.get(message.get_type())
        if answer is not None:
            answer(message)

    def _send(self, kind: str, **values: Any) -> None:
        self._vehicle.send(packed(kind, self._options.version, **values))

    # --------------------------------------------------------------------------- parameters

    def _on_list(self, request: Any) -> None:
        """Start the list, or restart it if it is requested again."""
        self._list_number += 1
        self._send_parameters(time.monotonic(), self._list_number, 0.0)

    def _send_parameters(self, due_at: float, list_number: int, begin: float) -> None:
        """Send the parameters of one period of the main loop, from the index ``begin``, which may have a fraction.

        On a slow link ArduPilot uses only 30 % of the bandwidth for parameters.
        """
        if list_number != self._list_number:
            return
        rate_hz = self._options.list_rate
        if self._options.bandwidth:
            rate_hz = min(rate_hz, 0.3 * self._options.bandwidth / PARAM_VALUE_SIZE)
        end = min(begin + rate_hz * LOOP_PERIOD_S, len(self._parameters))
        for index in range(int(begin), int(end)):
            self._send_parameter(index)
        if end < len(self._parameters):
            next_due = due_at + LOOP_PERIOD_S
            self._vehicle.at(next_due, lambda: self._send_parameters(next_due, list_number, end))

    def _on_read(self, request: Any) -> None:
        index = request.param_index
        if index < 0:
            names = [name for name, _ in self._parameters]
            index = names.index(request.param_id) if request.param_id in names else len(names)
        if index < len(self._parameters):
            self._send_parameter(index)

    def _send_parameter(self, index: int) -> None:
        name, value = self._parameters[index]
        self._send(
            "PARAM_VALUE", param_id=name.encode(), param_value=value, param_type=REAL32,
            param_count=len(self._parameters), param_index=index,
        )  # fmt: skip

    # ----------------------------------------------------------------------------- commands

    def _on_command(self, request: Any) -> None:
        requests_version = request.command == REQUEST_MESSAGE and request.param1 == AUTOPILOT_VERSION
        is_supported = requests_version or request.command == REQUEST_CAPABILITIES
        self._send(
            "COMMAND_ACK", command=request.command, result=ACCEPTED if is_supported else UNSUPPORTED, progress=0,
            result_param2=0, target_system=request.get_srcSystem(), target_component=request.get_srcComponent(),
        )  # fmt: skip
        if is_supported:
            capabilities = CAPABILITIES_WITHOUT_FTP | (FTP if self._options.has_ftp else 0)
            self._send("AUTOPILOT_VERSION", capabilities=capabilities, flight_sw_version=0x040600FF)

    # -------------------------------------------------------------------------------- files

    def _on_file(self, request: Any) -> None:
        if not self._options.has_ftp:
            return
        payload = bytes(request.payload)
        sequence, session, opcode, size, _, _, offset = FTP_HEADER.unpack_from(payload)
        data = payload[FTP_HEADER.size : FTP_HEADER.size + size]
        reply = _Reply(self._vehicle, request, sequence + 1, session, opcode, self._options.version)
        if opcode == OPEN_RO:
            path, _, _ = data.partition(b"\0")
            self._open(path.decode(), reply)
        elif opcode == READ:
            block = self._file[offset : offset + (size or DATA_SIZE)]
            if block:
                reply.send(ACK, offset, block)
            else:
                reply.send(NAK, offset, bytes([END_OF_FILE]))
        elif opcode == BURST_READ:
            self._burst_number += 1
            self._send_burst(time.monotonic(), self._burst_number, reply, offset, size or DATA_SIZE)
        elif opcode in (TERMINATE, RESET):
            reply.send(ACK, 0)
        else:
            reply.send(NAK, 0, bytes([FAIL]))

    def _open(self, path: str, reply: _Reply) -> None:
        name, _, query = path.partition("?")
        if name != PACK:
            reply.send(NAK, 0, bytes([NOT_FOUND]))
            return
        self._file = _packed_parameters(self._parameters, with_defaults="withdefaults=1" in query)
        # ArduPilot generates this file while it is read, and reports this size.
        reply.send(ACK, 0, struct.pack("<I", 1 << 20))

    def _send_burst(self, due_at: float, burst_number: int, reply: _Reply, offset: int, size: int) -> None:
        """Send one block of a burst, and schedule the next block. Stop if the client has requested another burst."""
        if burst_number != self._burst_number:
            return
        block = self._file[offset : offset + size]
        if not block:
            reply.send(NAK, offset, bytes([END_OF_FILE]))
            return
        is_last = len(block) < size
        reply.send(ACK, offset, block, is_last=is_last)
        reply.sequence += 1
        if is_last:
            reply.send(NAK, offset + len(block), bytes([END_OF_FILE]))
            return
        rate = self._options.file_rate
        if self._options.bandwidth:
            rate = min(rate, self._options.bandwidth / 3)
        next_due = due_at + size / rate
        self._vehicle.at(next_due, lambda: self._send_burst(next_due, burst_number, reply, offset + size, size))


class _Reply:
    """An answer to one FILE_TRANSFER_PROTOCOL."""

    def __init__(self, vehicle: Vehicle, request: Any, sequence: int, session: int, opcode: int, version: int) -> None:
        self._vehicle = vehicle
        self._session = session
        self._request_opcode = opcode
        self._target_system = request.get_srcSystem()
        self._target_component = request.get_srcComponent()
        self.sequence = sequence

    def send(self, opcode: int, offset: int, data: bytes = b"", *, is_last: bool = False) -> None:
        header = FTP_HEADER.pack(
            self.sequence & 0xFFFF, self._session, opcode, len(data), self._request_opcode, is_last, offset
        )
        payload = (header + data).ljust(FTP_HEADER.size + DATA_SIZE, b"\0")
        self._vehicle.send(
            packed("FILE_TRANSFER_PROTOCOL", 2, target_network=0, target_system=self._target_system,
                   target_component=self._target_component, payload=list(payload))
        )  # fmt: skip


def _packed_parameters(parameters: list[tuple[str, float]], *, with_defaults: bool) -> bytes:
    """Create ``param.pck``. A name omits the beginning that it shares with the previous name.

    Padding keeps each value within one block. All values equal their defaults.
    """
    magic = 0x671C if with_defaults else 0x671B
    count = len(parameters)
    file = bytearray(struct.pack("<HHH", magic, count, count))
    previous_name = ""
    for name, value in parameters:
        shared_length = 0
        max_shared_length = min(len(name), len(previous_name), 15)  # 15 because both lengths have four bits each.
        while shared_length < max_shared_length and name[shared_length] == previous_name[shared_length]:
            shared_length += 1
        suffix = name[shared_length:].encode()
        lengths = (len(suffix) - 1) << 4 | shared_length
        packed_value = struct.pack("<f", value)
        entry = bytes([PACKED_FLOAT, lengths]) + suffix + packed_value
        bytes_in_next_block = (len(file) + len(entry)) % DATA_SIZE
        if 0 < bytes_in_next_block < len(packed_value):
            file += bytes(len(packed_value) - bytes_in_next_block)
        file += entry
        previous_name = name
    return bytes(file)
