"""`to_pymavlink`: a received frame as the message object that pymavlink would have made of it."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any

from aerokit.mavlink.checksum import x25
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.frame import HEADER_LENGTH, SIGNATURE_LENGTH, SIGNED

if TYPE_CHECKING:
    from types import ModuleType

    from aerokit.mavlink.frame import Frame

__all__ = ["to_pymavlink"]

DIALECTS = ("ardupilotmega", "development")
"""Where pymavlink's classes come from when the program's own dialect has none; together they know all of STANDARD."""
CHECKSUM_LENGTH = 2

LATE = ("_header", "_msgbuf", "_payload", "_crc")
"""What most listeners never ask for."""

Decoder = Callable[["Frame", float], Any]


def to_pymavlink(frame: Frame, *, dialect: ModuleType | None = None, timestamp: float = 0.0) -> Any:
    """The frame's message as pymavlink decodes it: fields, header, buffers and ``str()`` are the same; never raises.

    Args:
        frame: as received: ``message.received_frame``, or what a tap of the connection is given.
        dialect: pymavlink's module whose classes are preferred, if it is one for MAVLink 2 and has the message.
            Otherwise they are those of pymavlink's ardupilotmega or development for MAVLink 2, which have the extension
            fields as well. A message that none of them knows is pymavlink's ``MAVLink_unknown``, type ``UNKNOWN_<id>``.
        timestamp: becomes the message's ``_timestamp``: seconds since 1970 by pymavlink's convention.
    """
    return _decoder(frame.message_id, dialect)(frame, timestamp)


@cache
def _decoder(message_id: int, preferred: ModuleType | None) -> Decoder:
    """How to decode a message for a program that prefers this dialect."""
    row = STANDARD.rows.get(message_id)
    for module in _dialects(preferred):
        message_class = module.mavlink_map.get(message_id)
        if message_class is None:
            continue
        if row is None:
            return _checked(message_class, _decoder_for(message_class))
        if message_class.crc_extra == row[0]:
            return _decoder_for(message_class)
    return _unknown


def _dialects(preferred: ModuleType | None) -> Any:
    if getattr(preferred, "WIRE_PROTOCOL_VERSION", None) == "2.0":
        yield preferred
    for name in DIALECTS:
        yield import_module(f"pymavlink.dialects.v20.{name}")


def _decoder_for(message_class: Any) -> Decoder:
    received = _received_class(message_class)
    unpack = message_class.unpacker.unpack_from
    length = HEADER_LENGTH + message_class.unpacker.size
    layout = _Layout(message_class)
    names, arrays, texts = layout.names, layout.arrays, layout.texts
    new = object.__new__

    def decode(frame: Frame, timestamp: float) -> Any:
        body = frame.body
        values = unpack(body if len(body) >= length else body.ljust(length, b"\0"), HEADER_LENGTH)
        message = new(received)
        fields = message.__dict__
        fields["_frame"] = frame
        fields["_timestamp"] = timestamp
        if arrays:
            values = [values[at] if width == 1 else list(values[at : at + width]) for at, width in arrays]
        fields.update(zip(names, values))  # noqa: B905 - of one length
        for name, raw_name in texts:
            raw = fields[raw_name] = fields[raw_name].rstrip(b"\0")
            fields[name] = (raw.partition(b"\0")[0] if b"\0" in raw else raw).decode("ascii", "replace")
        return message

    return decode


class _Layout:
    """Where pymavlink's attributes are among the unpacked values."""

    def __init__(self, message_class: Any) -> None:
        zeros = message_class.unpacker.unpack(bytes(message_class.unpacker.size))
        self.names: list[str] = []
        """In the wire's order; texts are first stored under the name for their bytes."""
        self.arrays: list[tuple[int, int]] = []
        """Place and width of every field; empty when there are no arrays."""
        self.texts: list[tuple[str, str]] = []
        """Names of texts, and of their bytes."""
        at = 0
        for name, width in zip(message_class.ordered_fieldnames, message_class.lengths):  # noqa: B905
            if isinstance(zeros[at], bytes):
                self.texts.append((name, f"_{name}_raw"))
            self.names.append(f"_{name}_raw" if isinstance(zeros[at], bytes) else name)
            self.arrays.append((at, width))
            at += width
        if at == len(self.names):
            self.arrays = []


# ------------------------------------------------------------------- what most listeners never ask for


class _Received:
    """Header and buffers, made of the frame when somebody asks for them: making them costs more than the fields."""

    _frame: Frame
    _header_class: Any
    _decoded_class: Any
    _signed = False  # nobody has checked a signature here
    _link_id = None
    _instances = None

    def __getattr__(self, name: str) -> Any:
        if name not in LATE:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        value = self.__dict__[name] = getattr(self, f"made{name}")()
        return value

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Copies, also those of ``pickle``, are plain objects of pymavlink's class."""
        names = (*LATE, "_type", "_fieldnames", "_instance_field", "_instance_offset")
        state = {name: getattr(self, name) for name in (*names, "_signed", "_link_id", "_instances")}
        state.update((name, value) for name, value in self.__dict__.items() if name != "_frame")
        return _restored, (self._decoded_class, state)

    def made_header(self) -> Any:
        frame, body = self._frame, self._frame.body
        source = frame.system_id, frame.component_id
        return self._header_class(frame.message_id, body[1], body[2], body[0], body[3], *source)

    def made_msgbuf(self) -> bytearray:
        return bytearray(self._frame.raw)

    def made_payload(self) -> bytearray:
        """Pymavlink has it begin there in MAVLink 2, too."""
        return bytearray(self._frame.raw)[6 : -_behind_the_payload(self._frame)]

    def made_crc(self) -> int:
        return self._frame.checksum


def _behind_the_payload(frame: Frame) -> int:
    return CHECKSUM_LENGTH + (SIGNATURE_LENGTH if frame.incompat_flags & SIGNED else 0)


def _received_class(message_class: Any) -> Any:
    """A subclass that looks like the class itself."""
    return type(
        message_class.__name__,
        (_Received, message_class),
        {
            "__module__": message_class.__module__,
            "__doc__": message_class.__doc__,
            "_decoded_class": message_class,
            "_header_class": sys.modules[message_class.__module__].MAVLink_header,
            "_type": message_class.msgname,
            "_fieldnames": message_class.fieldnames,
            "_instance_field": message_class.instance_field,
            "_instance_offset": message_class.instance_offset,
        },
    )


def _restored(message_class: Any, state: dict[str, Any]) -> Any:
    message = object.__new__(message_class)
    message.__dict__.update(state)
    return message


# -------------------------------------------------------------------------------- unknown messages


def _checked(message_class: Any, decode: Decoder) -> Decoder:
    """Nobody has checked a message that the standard does not have; the program's dialect says how."""

    def decode_if_right(frame: Frame, timestamp: float) -> Any:
        raw = frame.raw
        is_right = (
            x25(raw[1 : -_behind_the_payload(frame)] + bytes((message_class.crc_extra,))) == frame.checksum
        )
        return (decode if is_right else _unknown)(frame, timestamp)

    return decode_if_right


def _unknown(frame: Frame, timestamp: float) -> Any:
    module: Any = import_module("pymavlink.dialects.v20.ardupilotmega")
    message = module.MAVLink_unknown(frame.message_id, bytearray(frame.raw))
    header = message.get_header()
    header.seq, header.srcSystem, header.srcComponent = frame.sequence, frame.system_id, frame.component_id
    vars(message)["_timestamp"] = timestamp
    return message
