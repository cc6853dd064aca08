"""Between aerokit's frames and pymavlink's message objects: what listeners get, and what programs send."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any

from pymavlink import mavutil

from aerokit.dronekit.sendable_messages import sendable
from aerokit.mavlink.checksum import x25
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.frame import HEADER_LENGTH, SIGNATURE_LENGTH, SIGNED

if TYPE_CHECKING:
    from types import ModuleType

    from aerokit.mavlink.frame import Frame

__all__ = ["message_of", "sendable"]

DIALECTS = ("ardupilotmega", "development")
"""Where pymavlink's classes come from when the program's own dialect has none; together they know all of STANDARD."""
CHECKSUM_LENGTH = 2

Decoder = Callable[["Frame"], Any]


def message_of(frame: Frame) -> Any:
    """The frame's message as pymavlink decodes it: fields, header, buffers and ``str()`` are the same; never raises.

    Its class is that of ``mavutil.mavlink`` when this is a MAVLink 2 dialect with the message, otherwise that of
    pymavlink's ardupilotmega or development dialect for MAVLink 2, which has the extension fields as well. A message
    that none of them knows is pymavlink's ``MAVLink_unknown``, type ``UNKNOWN_<id>``. ``_timestamp`` is the time of
    this call, in seconds since 1970.
    """
    return _decoder(frame.message_id, mavutil.mavlink)(frame)


@cache
def _decoder(message_id: int, preferred: ModuleType) -> Decoder:
    """How to decode a message for a program whose dialect is this one; a program may change its dialect."""
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


def _dialects(preferred: ModuleType) -> Any:
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
    new, now = object.__new__, time.time

    def decode(frame: Frame) -> Any:
        body = frame.body
        values = unpack(body if len(body) >= length else body.ljust(length, b"\0"), HEADER_LENGTH)
        message = new(received)
        fields = message.__dict__
        fields["_frame"] = frame
        fields["_timestamp"] = now()
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
    _signed = False  # aerokit checks no signatures
    _link_id = None
    _instances = None

    def __getattr__(self, name: str) -> Any:
        make = _LATE.get(name)
        if make is None:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        value = self.__dict__[name] = make(self)
        return value

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Copies, also those of ``pickle``, are plain objects of pymavlink's class."""
        names = (*_LATE, "_type", "_fieldnames", "_instance_field", "_instance_offset")
        state = {name: getattr(self, name) for name in (*names, "_signed", "_link_id", "_instances")}
        state.update((name, value) for name, value in self.__dict__.items() if name != "_frame")
        return _restored, (self._decoded_class, state)


def _header(message: _Received) -> Any:
    frame = message._frame
    body = frame.body
    source = frame.system_id, frame.component_id
    return message._header_class(frame.message_id, body[1], body[2], body[0], body[3], *source)


def _payload(message: Any) -> bytearray:
    buffer: bytearray = message._msgbuf
    end = CHECKSUM_LENGTH + (SIGNATURE_LENGTH if message._frame.incompat_flags & SIGNED else 0)
    return buffer[6:-end]  # pymavlink has it begin there in MAVLink 2, too


_LATE: dict[str, Callable[[Any], Any]] = {
    "_header": _header,
    "_msgbuf": lambda message: bytearray(message._frame.raw),
    "_payload": _payload,
    "_crc": lambda message: message._frame.checksum,
}


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

    def decode_if_right(frame: Frame) -> Any:
        raw = frame.raw
        end = len(raw) - CHECKSUM_LENGTH - (SIGNATURE_LENGTH if frame.incompat_flags & SIGNED else 0)
        is_right = x25(raw[1:end] + bytes((message_class.crc_extra,))) == frame.checksum
        return decode(frame) if is_right else _unknown(frame)

    return decode_if_right


def _unknown(frame: Frame) -> Any:
    module: Any = import_module("pymavlink.dialects.v20.ardupilotmega")
    message = module.MAVLink_unknown(frame.message_id, bytearray(frame.raw))
    header = message.get_header()
    header.seq, header.srcSystem, header.srcComponent = frame.sequence, frame.system_id, frame.component_id
    message._timestamp = time.time()
    return message
