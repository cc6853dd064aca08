"""Fuzz targets of the protocols: each exchange with a vehicle that answers anything, and then nothing."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

from simulator_script import Script
from target import Target

from aerokit.errors import AerokitError
from aerokit.mavlink import Message
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd, MavFrame, MavFtpOpcode, MavParamExtType
from aerokit.missions import MissionItem
from aerokit.parameters import Parameter, ParameterType
from aerokit.protocols.blocks import Reassembly
from aerokit.protocols.command import CommandExchange
from aerokit.protocols.exchange import Exchange
from aerokit.protocols.extended_parameters import SettingList, SettingReads, SettingWrite
from aerokit.protocols.ftp import DATA_SIZE, FtpClient, FtpMessage, FtpRequest
from aerokit.protocols.ftp_transfer import FtpDownload, FtpUpload
from aerokit.protocols.logs import LOG_BLOCK, LogDownload, LogList
from aerokit.protocols.mission_download import MissionDownload
from aerokit.protocols.mission_upload import MissionUpload
from aerokit.protocols.missions import MissionClear, SetCurrentItem
from aerokit.protocols.parameter_list import ParameterList
from aerokit.protocols.parameter_requests import ParameterReads, ParameterWrites

__all__ = ["EXCHANGE_TARGETS"]

MAX_ANSWERS, MAX_DEADLINES = 150, 3000
MAX_TEXT_LENGTH = 4000
_ITEMS = [MissionItem(16, MavFrame.GLOBAL_RELATIVE_ALT, x=473977420 + n, y=85455940, z=20.0) for n in range(5)]
_WANTED = [Parameter("A", 1.5, ParameterType.REAL32), Parameter("B", 7, ParameterType.INT32)]
_NAMES = ("A", "B", "C", "_HASH_CHECK", "", "\ufffd" * 5)
Op = MavFtpOpcode


class _ScriptedExchange:
    """An exchange, its last request, and a clock."""

    def __init__(self, exchange: Exchange[Any], script: Script) -> None:
        self.exchange, self.script = exchange, script
        self.now = 100.0
        self.last: Message | None = None
        exchange.start(self.now)
        self._take()

    def _take(self) -> None:
        for message in self.exchange.take_outbox():
            message.encode()
            self.last = message

    def run(self) -> None:
        for _ in range(MAX_ANSWERS):
            if self.exchange.done or not self.script.has_more:
                break
            self._answer()
        for _ in range(MAX_DEADLINES):
            if self.exchange.done:
                break
            self._expire()
        assert self.exchange.done, "the exchange does not end"
        text = ""
        try:
            self.exchange.result()
        except AerokitError as error:
            text = str(error)
        assert len(text) < MAX_TEXT_LENGTH

    def _expire(self) -> None:
        deadline = self.exchange.deadline
        assert deadline is not None, "the exchange has no deadline and has not ended"
        self.now = max(self.now, deadline)
        self.exchange.expire(self.now)
        self._take()
        later = self.exchange.deadline
        assert self.exchange.done or later is None or later > deadline, "the exchange repeats without progress"

    def _answer(self) -> None:
        kind = self.script.byte()
        if kind < 20:
            self._expire()
            return
        self.now += kind / 2000
        deadline = self.exchange.deadline
        assert deadline is not None
        if self.now > deadline:
            self.now = deadline
        message_class = self.exchange.expects[kind % len(self.exchange.expects)]
        self.exchange.receive(self._message(message_class, kind), self.now)
        self._take()

    def _message(self, message_class: type[Message], kind: int) -> Message:
        """Any bytes, or a variation of the expected answer."""
        if kind < 90:
            return message_class.decode(self.script.take(self.script.byte() % (message_class.LENGTH + 1)))
        if message_class is m.FileTransferProtocol:
            return m.FileTransferProtocol(0, 255, 190, self._ftp_reply())
        message = message_class.decode(b"")
        near = {
            "mission_type": 0,
            "target_system": 255,
            "target_component": 190,
            "param_type": 9,
            "command": 400,
        }
        for field in message_class.FIELDS:
            setattr(
                message,
                field.name,
                near.get(field.name, self._value(field.name, field.type, field.array_length))
                if field.is_text or field.type != "char"
                else self.script.take(self.script.byte() % 10),
            )
        return message_class.decode(message.encode())

    def _value(self, name: str, kind: str, array_length: int) -> Any:
        if kind == "char":
            return _NAMES[self.script.byte() % len(_NAMES)]
        if array_length:
            return bytes(array_length) if kind == "uint8_t" else (0,) * array_length
        if kind in ("float", "double"):
            return struct.unpack("<f", struct.pack("<f", self.script.number()))[0]
        number = self.script.byte() if self.script.byte() < 200 else int.from_bytes(self.script.take(4), "little")
        if name in ("seq", "id", "ofs", "param_index", "count"):
            number = number % 8 * (LOG_BLOCK if name == "ofs" else 1) if number < 256 else number
        size = 8 * int(kind.strip("uint_")) // 8
        number %= 1 << size
        return number - (1 << size) if kind[0] == "i" and number >> (size - 1) else number

    def _ftp_reply(self) -> bytes:
        asked = FtpMessage.decode(self.last.payload) if isinstance(self.last, m.FileTransferProtocol) else None
        asked = asked or FtpMessage(0, Op.READFILE, 0, 0, Op.NONE, offset=0, data=b"")
        choice = self.script.byte()
        data = bytes((DATA_SIZE if choice < 150 else choice - 150,)) * (DATA_SIZE if choice < 150 else choice - 150)
        ahead = 1 + (self.script.byte() if choice & 1 else 0)
        offset = asked.offset + (self.script.byte() * DATA_SIZE if choice & 2 else 0)
        if choice & 28 == 28:
            offset = int.from_bytes(self.script.take(4), "little")
        code = Op.NAK if choice % 11 == 0 else Op.ACK
        return FtpMessage(
            (asked.sequence + ahead) % 0x10000, code, asked.session, len(data) & 0xFF, asked.opcode,
            offset=offset & 0xFFFFFFFF, data=data,
        ).encode()  # fmt: skip


def _client() -> FtpClient:
    return FtpClient(1, 1, source_system=255, source_component=190, first_sequence=7)


def _sink(block_size: int) -> Reassembly:
    return Reassembly(lambda data: None, block_size=block_size)


def _command() -> Exchange[Any]:
    message = m.CommandLong(1, 1, MavCmd.COMPONENT_ARM_DISARM, 0, 1, 0, 0, 0, 0, 0, 0)
    return CommandExchange(message, own_system=255, own_component=190)


EXCHANGES: dict[str, Callable[[], Exchange[Any]]] = {
    "command": _command,
    "ftp_request": lambda: FtpRequest(_client(), Op.OPENFILERO, path="/a", session=1, data=b"/a"),
    "ftp_download": lambda: FtpDownload(_client(), "/a", _sink(DATA_SIZE), session=1, size=5000),
    "ftp_download_virtual": lambda: FtpDownload(_client(), "@PARAM/param.pck", _sink(DATA_SIZE), session=1, size=0),
    "ftp_upload": lambda: FtpUpload(_client(), "/a", bytes(2000), session=1),
    "mission_download": lambda: MissionDownload(1, 1, window=4),
    "mission_download_one_by_one": lambda: MissionDownload(1, 1, window=1),
    "mission_upload": lambda: MissionUpload(1, 1, _ITEMS, window=4),
    "mission_upload_one_by_one": lambda: MissionUpload(1, 1, _ITEMS, window=1),
    "mission_clear": lambda: MissionClear(1, 1),
    "mission_current": lambda: SetCurrentItem(1, 1, 2),
    "parameter_list": lambda: ParameterList(1, 1, bytewise=False),
    "parameter_list_bytewise": lambda: ParameterList(1, 1, bytewise=True),
    "parameter_reads": lambda: ParameterReads(1, 1, ["A", "B", "C"], bytewise=False, probe=True),
    "parameter_writes": lambda: ParameterWrites(1, 1, _WANTED, bytewise=True, before={"A": 0.0}),
    "setting_list": lambda: SettingList(1, 1),
    "setting_reads": lambda: SettingReads(1, 1, ["A", "B", "C"]),
    "setting_write": lambda: SettingWrite(1, 1, "A", 1.5, MavParamExtType.REAL32, before=0.0),
    "log_list": lambda: LogList(1, 1, first_id=1),
    "log_download": lambda: LogDownload(1, 1, 1, 5000, _sink(LOG_BLOCK)),
}


def _target(name: str) -> Target:
    def fuzz_one(data: bytes) -> None:
        _ScriptedExchange(EXCHANGES[name](), Script(data)).run()

    return Target(name, fuzz_one)


EXCHANGE_TARGETS = tuple(_target(name) for name in EXCHANGES)
