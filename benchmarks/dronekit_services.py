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
UNCOUNTED = 65535
BEAT_S = 0.0025
"""Period of ArduCopter's main loop (400 Hz), in which it sends parameters."""
CAPABILITIES_WITHOUT_FTP = 64495 & ~32
FTP = 32
REQUEST_MESSAGE, REQUEST_CAPABILITIES, AUTOPILOT_VERSION = 512, 520, 148
ACCEPTED, UNSUPPORTED = 0, 3

FTP_HEADER = struct.Struct("<HBBBBBxI")
TERMINATE, RESET, OPEN_RO, READ, BURST_READ, ACK, NAK = 1, 2, 4, 5, 15, 128, 129
FAIL, END_OF_FILE, NOT_FOUND = 1, 6, 10
DATA_SIZE = 239
PACK = "@PARAM/param.pck"
GROUPS = ("ATC", "BATT", "EK3", "INS", "RC", "SERVO", "PSC", "WPNAV")


def parameter_names(count: int) -> list[str]:
    """Return parameter names with the typical length of ArduPilot's, in the order of their indices."""
    return [f"{GROUPS[n % len(GROUPS)]}_BENCH{n}" for n in range(count)]


class Services:
    """Answers requests with the timing of a real vehicle."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._vehicle, self._options = vehicle, vehicle.options
        names = sorted(parameter_names(vehicle.options.parameters))
        self._parameters = [(name, 0.5 + index) for index, name in enumerate(names)]
        self._list = 0
        self._burst = 0
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
        self._list += 1
        self._send_parameters(time.monotonic(), self._list, 0.0)

    def _send_parameters(self, when: float, number: int, sent: float) -> None:
        """Send the parameters of one period of the main loop.

        On a slow link ArduPilot uses only 30 % of the bandwidth for parameters.
        """
        if number != self._list:
            return
        rate = self._options.list_rate
        if self._options.bandwidth:
            rate = min(rate, 0.3 * self._options.bandwidth / 37)
        until = min(sent + rate * BEAT_S, len(self._parameters))
        for index in range(int(sent), int(until)):
            self._send_parameter(index)
        if until < len(self._parameters):
            self._vehicle.at(when + BEAT_S, lambda: self._send_parameters(when + BEAT_S, number, until))

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
        knows = request.command == REQUEST_CAPABILITIES or (
            request.command == REQUEST_MESSAGE and request.param1 == AUTOPILOT_VERSION
        )
        self._send(
            "COMMAND_ACK", command=request.command, result=ACCEPTED if knows else UNSUPPORTED, progress=0,
            result_param2=0, target_system=request.get_srcSystem(), target_component=request.get_srcComponent(),
        )  # fmt: skip
        if knows:
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
            self._open(data.split(b"\0")[0].decode(), reply)
        elif opcode == READ:
            block = self._file[offset : offset + (size or DATA_SIZE)]
            reply.send(ACK, offset, block) if block else reply.send(NAK, offset, bytes([END_OF_FILE]))
        elif opcode == BURST_READ:
            self._burst += 1
            self._send_burst(time.monotonic(), self._burst, reply, offset, size or DATA_SIZE)
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

    def _send_burst(self, when: float, number: int, reply: _Reply, offset: int, size: int) -> None:
        if number != self._burst:
            return
        block = self._file[offset : offset + size]
        if not block:
            reply.send(NAK, offset, bytes([END_OF_FILE]))
            return
        reply.send(ACK, offset, block, is_last=len(block) < size)
        reply.sequence += 1
        if len(block) < size:
            reply.send(NAK, offset + len(block), bytes([END_OF_FILE]))
            return
        rate = self._options.file_rate
        if self._options.bandwidth:
            rate = min(rate, self._options.bandwidth / 3)
        when += size / rate
        self._vehicle.at(when, lambda: self._send_burst(when, number, reply, offset + size, size))


class _Reply:
    """An answer to one FILE_TRANSFER_PROTOCOL."""

    def __init__(self, vehicle: Vehicle, request: Any, sequence: int, session: int, opcode: int, version: int) -> None:
        self._vehicle, self._session, self._request_opcode = vehicle, session, opcode
        self._to = request.get_srcSystem(), request.get_srcComponent()
        self.sequence = sequence

    def send(self, opcode: int, offset: int, data: bytes = b"", *, is_last: bool = False) -> None:
        header = FTP_HEADER.pack(
            self.sequence & 0xFFFF, self._session, opcode, len(data), self._request_opcode, is_last, offset
        )
        payload = (header + data).ljust(FTP_HEADER.size + DATA_SIZE, b"\0")
        system, component = self._to
        self._vehicle.send(
            packed("FILE_TRANSFER_PROTOCOL", 2, target_network=0, target_system=system, target_component=component,
                   payload=list(payload))
        )  # fmt: skip


def _packed_parameters(parameters: list[tuple[str, float]], *, with_defaults: bool) -> bytes:
    """Create ``param.pck``. Names omit the beginning that they share with the previous one, and padding keeps values
    within one block. All values equal their defaults.
    """
    file, last = (
        bytearray(struct.pack("<HHH", 0x671C if with_defaults else 0x671B, *[len(parameters)] * 2)),
        "",
    )
    for name, value in parameters:
        common = 0
        while common < min(len(name), len(last), 15) and name[common] == last[common]:
            common += 1
        rest = name[common:].encode()
        entry = bytes([4, (len(rest) - 1) << 4 | common]) + rest + struct.pack("<f", value)
        beyond = (len(file) + len(entry)) % DATA_SIZE
        file += bytes(4 - beyond if 0 < beyond < 4 else 0) + entry
        last = name
    return bytes(file)
