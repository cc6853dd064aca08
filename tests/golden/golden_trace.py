"""Golden traces: the frames of an exchange as text, one a line, with the virtual time since the exchange began."""

from __future__ import annotations

import asyncio
import itertools
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from aerokit.mavlink import enums
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.enums import MavCmd, MavFtpOpcode, MavModeFlag
from aerokit.mavlink.frame import Frame
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.message import SECRET_FIELDS, Message
from aerokit.mavlink.messages import CommandInt, CommandLong, FileTransferProtocol, Heartbeat
from aerokit.protocols.ftp import FtpMessage
from aerokit.transport.link import Link, Peer, Receiver

ANSWERS = frozenset(
    (
        "AUTOPILOT_VERSION",
        "CAMERA_IMAGE_CAPTURED",
        "LOG_DATA",
        "LOG_ENTRY",
        "MISSION_ITEM_REACHED",
        "PARAM_VALUE",
    )
)
"""Incoming messages that are shown although they name no target; HEARTBEAT is shown when its content changes."""
ROUTINE = frozenset(("HEARTBEAT", "SYSTEM_TIME", "TIMESYNC"))
"""Messages that are shown only if a scene asks for them, because they are sent whatever the program does."""
RATES = "SET_MESSAGE_INTERVAL"
"""Commands that ask for a rate are shown where a scene asks for them; their acknowledgements never are."""
CLOCKS = frozenset(("flight_custom_version", "initial_timestamp", "time_boot_ms", "time_usec", "time_utc"))
"""Fields that are irrelevant to the exchange, or come from the wall clock."""
TELLING_ZEROS = frozenset(("param_index", "result", "seq", "type"))
"""Fields whose zero is significant; other zeros, and empty texts, are omitted."""
PLACES = frozenset(("lat", "latitude", "lon", "longitude", "x", "y"))
MIN_DEGREES_1E7 = 1_000_000
"""Smaller numbers in fields for places are no degrees."""
REQUESTS = (MavFtpOpcode.READFILE, MavFtpOpcode.BURSTREADFILE)


@dataclass(frozen=True)
class Line:
    """One frame, or a remark."""

    at_s: float
    way: str
    name: str
    fields: str

    def __str__(self) -> str:
        return f"{self.at_s:9.3f} {self.way}  {self.name} {self.fields}".rstrip()


class Trace:
    """Recording of one exchange.

    Args:
        show: names of further messages, or commands, that are shown.
        max_alike: longer runs of frames of the same name are folded.
    """

    def __init__(self, show: Iterable[str] = (), max_alike: int = 6) -> None:
        self._show, self._max_alike = frozenset(show), max_alike
        self._lines: list[Line] = []
        self._began_at: float | None = None
        self._states: dict[str, str] = {}

    def begin(self) -> None:
        """Record from here on and discard earlier traffic."""
        self._lines.clear()
        self._began_at = asyncio.get_running_loop().time()

    def note(self, text: str) -> None:
        """Add a line about an action of the program, or of its environment."""
        self._add("#", "", text)

    def record(self, frame: Frame, *, is_sent: bool, link: str = "") -> None:
        """Record a frame, if it is one that matters."""
        source, message = f"{frame.system_id}/{frame.component_id}", STANDARD.decode(frame)
        if self._is_shown(message, source, is_sent):
            way = f"{link} {source} {'→' if is_sent else '⇒'} {_target_of(message)}".strip()
            self._add(way, f"{message.NAME}{' signed' if frame.signature else ''}", text_of(message))

    def text(self) -> str:
        """One line a frame; runs of frames of the same kind are folded."""
        return "".join(f"{line}\n" for line in _folded(self._lines, self._max_alike))

    def _is_shown(self, message: Message, source: str, is_sent: bool) -> bool:
        if getattr(message, "command", None) == MavCmd.SET_MESSAGE_INTERVAL:
            return is_sent and RATES in self._show
        if isinstance(message, Heartbeat) and not is_sent:
            before, self._states[source] = self._states.get(source), text_of(message)
            return before != self._states[source]
        if message.NAME in self._show:
            return True
        is_for_us = is_sent or getattr(message, "target_system", 0) != 0
        return message.NAME in ANSWERS or (is_for_us and message.NAME not in ROUTINE)

    def _add(self, way: str, name: str, fields: str) -> None:
        if self._began_at is not None:
            self._lines.append(Line(asyncio.get_running_loop().time() - self._began_at, way, name, fields))


class Tap(Link):
    """A link whose frames are recorded, in both directions."""

    def __init__(self, link: Link, trace: Trace, name: str = "") -> None:
        self.address = link.address
        self._link, self._trace, self._name = link, trace, name
        self._framers = {True: Framer(), False: Framer()}
        self._receiver: Receiver | None = None

    async def open(self, receiver: Receiver) -> None:
        self._receiver = receiver
        await self._link.open(self)

    def write(self, data: bytes, peer: Peer = None) -> None:
        self._record(data, is_sent=True)
        self._link.write(data, peer)

    def close(self) -> None:
        self._link.close()

    async def wait_closed(self) -> None:
        await self._link.wait_closed()

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        self._record(data, is_sent=False)
        assert self._receiver is not None
        self._receiver.bytes_received(data, peer)

    def link_lost(self, error: Any) -> None:
        assert self._receiver is not None
        self._receiver.link_lost(error)

    def _record(self, data: bytes, *, is_sent: bool) -> None:
        for frame in self._framers[is_sent].receive(data, 0.0):
            self._trace.record(frame, is_sent=is_sent, link=self._name)


def text_of(message: Message) -> str:
    """The fields that matter."""
    if isinstance(message, FileTransferProtocol):
        return _text_of_ftp(FtpMessage.decode(message.payload))
    if isinstance(message, Heartbeat):
        state = "armed" if message.base_mode & MavModeFlag.SAFETY_ARMED else "disarmed"
        kind, status = _in_enum("MAV_TYPE", message.type), _in_enum("MAV_STATE", message.system_status)
        return f"{kind} {state} custom_mode={message.custom_mode} {status}"
    if isinstance(message, (CommandLong, CommandInt)):
        return _text_of_command(message)
    return " ".join(_texts_of_fields(message))


def _texts_of_fields(message: Message) -> Iterator[str]:
    """Return the fields by name; zeros and empty texts are omitted."""
    for field in message.FIELDS:
        value: Any = getattr(message, field.name)
        is_empty = not (any(value) if isinstance(value, (bytes, tuple)) else value)
        if field.name in CLOCKS or field.name.startswith("target_"):
            continue
        if is_empty and field.name not in TELLING_ZEROS:
            continue
        if field.name == "command":
            yield _in_enum("MAV_CMD", value)
        elif field.name in SECRET_FIELDS:
            yield f"{field.name}=…"
        else:
            shown = _in_enum(field.enum, value) if field.enum else _plain(value, field.name)
            yield f"{field.name}={shown}"


def _text_of_command(message: CommandLong | CommandInt) -> str:
    """Return the command's name and its parameters up to the last non-zero one; message ids are shown as names."""
    if message.command in (MavCmd.SET_MESSAGE_INTERVAL, MavCmd.REQUEST_MESSAGE):
        assert isinstance(message, CommandLong)
        name = STANDARD[int(message.param1)].NAME
        interval = f", {message.param2:g} µs" if message.command == MavCmd.SET_MESSAGE_INTERVAL else ""
        return f"{_in_enum('MAV_CMD', message.command)}({name}{interval})"
    params: list[float] = [message.param1, message.param2, message.param3, message.param4]
    if isinstance(message, CommandLong):
        params += [message.param5, message.param6, message.param7]
    while len(params) > 1 and params[-1] == 0:
        params.pop()
    text = f"{_in_enum('MAV_CMD', message.command)}({', '.join(_plain(param, '') for param in params)})"
    if isinstance(message, CommandInt):
        place = f"x={_plain(message.x, 'x')} y={_plain(message.y, 'y')} z={message.z:.4g}"
        return f"{text} {_in_enum('MAV_FRAME', message.frame)} {place}"
    return f"{text} confirmation={message.confirmation}" if message.confirmation else text


def _text_of_ftp(message: FtpMessage) -> str:
    name = _in_enum("MAV_FTP_OPCODE", message.opcode)
    if message.opcode == MavFtpOpcode.NAK:
        return f"{name} of {_in_enum('MAV_FTP_OPCODE', message.request_opcode)}: " + _in_enum(
            "MAV_FTP_ERR", message.data[0]
        )
    if message.opcode == MavFtpOpcode.ACK:
        name += f" of {_in_enum('MAV_FTP_OPCODE', message.request_opcode)}"
    if message.opcode in REQUESTS:
        return f"{name} offset={message.offset} size={message.size}"
    offset = f" offset={message.offset}" if message.offset or "READ" in name else ""
    data = message.data
    if data and data.isascii() and data.decode().isprintable() and len(data) < 60:
        return f"{name}{offset} {data.decode()!r}"
    return f"{name}{offset} {len(data)} bytes" if data else f"{name}{offset}"


def _target_of(message: Message) -> str:
    system = getattr(message, "target_system", None)
    return "all" if system is None else f"{system}/{getattr(message, 'target_component', 0)}"


def _in_enum(name: str, value: Any) -> str:
    kind: Any = getattr(enums, "".join(part.capitalize() for part in name.split("_")), None)
    members = {} if kind is None else {int(member): member.name for member in kind}
    return str(members.get(int(value), value))


def _plain(value: Any, name: str) -> str:
    if isinstance(value, (bytes, bytearray)):
        return f"{len(value.rstrip(bytes(1)))} bytes"
    if isinstance(value, tuple):
        return f"({', '.join(_plain(part, name) for part in value)})"
    if isinstance(value, float):
        return str(value) if not math.isfinite(value) else f"{value:.4g}"
    if name in PLACES and abs(value) > MIN_DEGREES_1E7:
        return f"{value / 1e7:.5f}°"
    return repr(value) if isinstance(value, str) and " " in value else str(value)


def _folded(lines: list[Line], max_alike: int) -> Iterator[str]:
    """Fold long runs: the first three lines, the number and interval of the others, and the last line."""
    start = 0
    while start < len(lines):
        end = start + 1
        while end < len(lines) and (lines[end].way, lines[end].name) == (lines[start].way, lines[start].name):
            end += 1
        run = lines[start:end]
        if len(run) > max_alike:
            times = [line.at_s for line in run[2:-1]]
            gaps = {round(later - earlier, 3) for earlier, later in itertools.pairwise(times)}
            interval = f", one every {gaps.pop():.3f} s" if len(gaps) == 1 and max(gaps) else ""
            yield from map(str, run[:3])
            yield f"{'…':>9} {len(run) - 4} more{interval}"
            yield str(run[-1])
        else:
            yield from map(str, run)
        start = end
