"""`Dialect`: maps message ids to message classes.

`STANDARD` has all generated messages: minimal, standard, common and development of MAVLink, and ardupilotmega with its
includes. Other dialects are read at run time from an XML file or a pymavlink module. Messages that another dialect
shares with the standard have the same classes, so that ``isinstance(message, messages.Heartbeat)`` works.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from enum import IntFlag
from functools import partial
from typing import TYPE_CHECKING, Any

import aerokit.mavlink.enums as enums
import aerokit.mavlink.messages as messages
from aerokit._internal.wire import wire
from aerokit.errors import InvalidArgument
from aerokit.mavlink.message import Message, layout_of, make_enum

if TYPE_CHECKING:
    from pathlib import Path
    from types import ModuleType

    from aerokit.mavlink.frame import Frame

Row = tuple[int, int, int]  # CRC_EXTRA, payload length without extensions, payload length with extensions


class Dialect:
    """Maps message ids to message classes, and names to enums. Immutable."""

    def __init__(
        self, name: str, classes: Iterable[type[Message]], enum_types: Mapping[str, type[Any]] | None = None
    ) -> None:
        """Create a dialect. ``enum_types`` maps names in the standard, such as ``"MAV_CMD"``, to enums."""
        self.name = name
        """Name of the dialect, for example the name of its XML file."""
        self._classes = {cls.ID: cls for cls in classes}
        self._enums = dict(enum_types or {})
        self._set_rows({cls.ID: (cls.CRC_EXTRA, cls.BASE_LENGTH, cls.LENGTH) for cls in self._classes.values()})

    def _set_rows(self, rows: dict[int, Row]) -> None:
        self.rows = rows
        """Maps message ids to (CRC_EXTRA, payload length without extensions, payload length with extensions)."""
        self.extras: dict[int, bytes] = {
            message_id: bytes((crc_extra,)) for message_id, (crc_extra, *_) in rows.items()
        }
        """Maps message ids to CRC_EXTRA as a byte, which is appended to the payload for the checksum."""
        # Each decoder loads its message class at the first use.
        self._decoders: dict[int, Callable[[bytes, Frame | None], Message]] = {
            message_id: partial(self._decode_first, message_id) for message_id in rows
        }
        if wire is not None:  # Compiled code is available, and decodes faster.
            self.table: Any = wire.table(
                rows, lambda message_id: layout_of(self[message_id]), partial(Dialect.decode, self)
            )
            self.decode = self.table.decode  # type: ignore[method-assign]

    @classmethod
    def from_xml(cls, path: str | Path) -> Dialect:
        """Read an XML file with its includes, which are searched beside it and in pymavlink's package.

        Raises:
            InvalidArgument: a file is missing or invalid, or an id is defined twice.
        """
        from aerokit.mavlink.runtime_dialect import read_xml_dialect

        return Dialect(*read_xml_dialect(path, STANDARD))

    @classmethod
    def from_pymavlink(cls, module: str | ModuleType) -> Dialect:
        """Convert a pymavlink dialect: a module, its dotted name, or the last part of the name (``"storm32"``).

        Raises:
            InvalidArgument: there is no such module, or it is not a dialect.
        """
        from aerokit.mavlink.runtime_dialect import read_pymavlink_dialect

        return Dialect(*read_pymavlink_dialect(module, STANDARD))

    def __getitem__(self, message_id: int) -> type[Message]:
        """Return the class of a message id; KeyError if there is none."""
        return self._classes[message_id]

    def get(self, message_id: int) -> type[Message] | None:
        """Return the class of a message id, or None."""
        return self[message_id] if message_id in self.rows else None

    def by_name(self, name: str) -> type[Message]:
        """Return the class of the message with a name, such as ``"GLOBAL_POSITION_INT"``; InvalidArgument if none."""
        for message_class in self:
            if name == message_class.NAME:
                return message_class
        raise InvalidArgument(f"dialect {self.name!r} has no message {name!r}")

    def enum(self, name: str) -> type[Any]:
        """Return the enum with a name, such as ``"MAV_CMD"``. InvalidArgument if there is none."""
        if name in self._enums:
            return self._enums[name]
        raise InvalidArgument(f"dialect {self.name!r} has no enum {name!r}")

    def __contains__(self, message_id: object) -> bool:
        return message_id in self.rows

    def __iter__(self) -> Iterator[type[Message]]:
        return (self[message_id] for message_id in sorted(self.rows))

    def __len__(self) -> int:
        return len(self.rows)

    def __repr__(self) -> str:
        return f"<Dialect {self.name!r}: {len(self)} messages>"

    def decode(self, frame: Frame) -> Message:
        """Decode a frame, which becomes the message's ``received_frame``. KeyError if the dialect lacks the id."""
        return self._decoders[frame.message_id](frame.body, frame)

    def _decode_first(self, message_id: int, body: bytes, frame: Frame | None) -> Message:
        # Replace this function by the class's decoder, so that `decode` need not check whether the class is loaded.
        decoder = self._decoders[message_id] = self[message_id].decode_body
        return decoder(body, frame)

    def extended_by(self, other: Dialect) -> Dialect:
        """Return a dialect with the messages of both dialects. InvalidArgument if an id is defined differently."""
        for message_id in self.rows.keys() & other.rows.keys():
            if self.rows[message_id] != other.rows[message_id]:
                ours, theirs = self[message_id], other[message_id]
                raise InvalidArgument(
                    f"message id {message_id} is {ours.NAME} (CRC_EXTRA {ours.CRC_EXTRA}, {ours.LENGTH} bytes) in"
                    f" {self.name!r}, but {theirs.NAME} (CRC_EXTRA {theirs.CRC_EXTRA}, {theirs.LENGTH} bytes) in"
                    f" {other.name!r}"
                )
        return _Extended(self, other)


class _Standard(Dialect):
    """The generated messages, whose modules are imported on first use."""

    def __init__(self) -> None:
        super().__init__("standard", ())
        # A row of INDEX has the names of the class and its module before the three numbers.
        self._set_rows({message_id: row[2:] for message_id, row in messages.INDEX.items()})

    def __getitem__(self, message_id: int) -> type[Message]:
        class_name, *_ = messages.INDEX[message_id]
        message_class: type[Message] = getattr(messages, class_name)
        return message_class

    def by_name(self, name: str) -> type[Message]:
        message_class = getattr(messages, _cap_words(name), None)
        return super().by_name(name) if message_class is None else message_class

    def enum(self, name: str) -> type[Any]:
        enum_type = getattr(enums, _cap_words(name), None)
        return super().enum(name) if enum_type is None else enum_type


class _Extended(Dialect):
    """The messages and enums of two dialects. If both have a message, that of the first one is used."""

    def __init__(self, first: Dialect, second: Dialect) -> None:
        super().__init__(f"{first.name}+{second.name}", ())
        self._parts = (first, second)
        self._set_rows({**second.rows, **first.rows})

    def __getitem__(self, message_id: int) -> type[Message]:
        first, second = self._parts
        return first[message_id] if message_id in first else second[message_id]

    def enum(self, name: str) -> type[Any]:
        enum_types: list[type[Any]] = []
        for part in self._parts:
            try:
                enum_types.append(part.enum(name))
            except InvalidArgument:
                continue
        if not enum_types:
            return super().enum(name)  # This raises InvalidArgument.
        first, *others = enum_types
        is_first_complete = all(other.__members__.keys() <= first.__members__.keys() for other in others)
        if is_first_complete:
            return first
        if name not in self._enums:
            self._enums[name] = _merge_enums(*enum_types)
        return self._enums[name]


def _merge_enums(first: type[Any], second: type[Any]) -> type[Any]:
    # A private dialect may add entries to an enum of the standard. Entries of `first` take precedence.
    members = {**second.__members__, **first.__members__}
    bitmask = issubclass(first, IntFlag)
    return make_enum(first.__module__, first.__name__, bitmask, first.__doc__ or "", members.items())


def _cap_words(name: str) -> str:
    return "".join(part.capitalize() for part in name.split("_"))


STANDARD: Dialect = _Standard()
"""All generated messages. Their modules are imported on first use."""
