"""`Dialect`: which message an id stands for.

`STANDARD` knows all generated messages: MAVLink's own minimal, standard, common and development, and ardupilotmega
(with what it includes). Others are read at run time from an XML file or a pymavlink dialect module; their messages
which are the standard's are the same classes, so that ``isinstance(message, messages.Heartbeat)`` goes on working.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from enum import IntFlag
from functools import partial
from typing import TYPE_CHECKING, Any

import aerokit.mavlink.enums as enums
import aerokit.mavlink.messages as messages
from aerokit.errors import InvalidArgument
from aerokit.mavlink.enumeration import make_enum
from aerokit.mavlink.message import Message

if TYPE_CHECKING:
    from pathlib import Path
    from types import ModuleType

    from aerokit.mavlink.frame import Frame

Row = tuple[int, int, int]


class Dialect:
    """Message ids and their classes. Dialects do not change once they are made."""

    def __init__(
        self, name: str, classes: Iterable[type[Message]], enum_types: Mapping[str, type[Any]] | None = None
    ) -> None:
        """Make a dialect of classes; ``enum_types`` maps the standard's spelling, ``"MAV_CMD"``, to enums."""
        self.name = name
        """Its name, the XML file's for example."""
        self._classes = {cls.ID: cls for cls in classes}
        self._enums = dict(enum_types or {})
        self._take(
            {cls.ID: (cls.CRC_EXTRA, cls.BASE_LENGTH, cls.LENGTH) for cls in self._classes.values()},
        )

    def _take(self, rows: dict[int, Row]) -> None:
        self.rows = rows
        """Message id → (CRC_EXTRA, length of the payload without extensions, and with them)."""
        self.extras: dict[int, bytes] = {message_id: bytes((row[0],)) for message_id, row in rows.items()}
        """Message id → CRC_EXTRA as the byte that goes behind the payload into the checksum."""
        self._decoders: dict[int, Callable[[bytes, Frame | None], Message]] = {
            message_id: partial(self._decode_first, message_id) for message_id in rows
        }

    @classmethod
    def from_xml(cls, path: str | Path) -> Dialect:
        """Read an XML file and all it includes, beside it or in pymavlink's package.

        Raises InvalidArgument when a file is missing or wrong, or an id is defined twice.
        """
        from aerokit.mavlink.runtime_dialect import read_xml_dialect

        return Dialect(*read_xml_dialect(path, STANDARD))

    @classmethod
    def from_pymavlink(cls, module: str | ModuleType) -> Dialect:
        """Take over a pymavlink dialect: the module, its dotted name, or the last part of it (``"storm32"``).

        Raises InvalidArgument when there is no such module or it is no dialect.
        """
        from aerokit.mavlink.runtime_dialect import read_pymavlink_dialect

        return Dialect(*read_pymavlink_dialect(module, STANDARD))

    def __getitem__(self, message_id: int) -> type[Message]:
        """The class of a message id; KeyError when the dialect has none."""
        return self._classes[message_id]

    def get(self, message_id: int) -> type[Message] | None:
        """The class of a message id, or None."""
        return self[message_id] if message_id in self.rows else None

    def by_name(self, name: str) -> type[Message]:
        """The class of the standard's name, ``"GLOBAL_POSITION_INT"``; InvalidArgument when there is none."""
        for message_class in self:
            if name == message_class.NAME:
                return message_class
        raise InvalidArgument(f"dialect {self.name!r} has no message {name!r}")

    def enum(self, name: str) -> type[Any]:
        """The enum of the standard's name, ``"MAV_CMD"``; InvalidArgument when there is none."""
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
        """The message of a frame, its ``received_frame`` set; KeyError when the dialect does not know the id."""
        return self._decoders[frame.message_id](frame.body, frame)

    def _decode_first(self, message_id: int, body: bytes, frame: Frame | None) -> Message:
        """Stands in for a class that is not loaded yet, so that `decode` need not ask each time."""
        decoder = self._decoders[message_id] = self[message_id].decode_body
        return decoder(body, frame)

    def extended_by(self, other: Dialect) -> Dialect:
        """Both together. InvalidArgument when an id means one message here and another there."""
        for message_id in self.rows.keys() & other.rows.keys():
            if self.rows[message_id] != other.rows[message_id]:
                raise InvalidArgument(
                    f"message id {message_id} is {self[message_id].NAME} (CRC_EXTRA {self.rows[message_id][0]}) in"
                    f" {self.name!r}, but {other[message_id].NAME} (CRC_EXTRA {other.rows[message_id][0]}) in"
                    f" {other.name!r}"
                )
        return _Extended(self, other)


class _Standard(Dialect):
    """The generated messages; their modules are imported when one of them is first needed."""

    def __init__(self) -> None:
        super().__init__("standard", ())
        self._take({message_id: row[2:] for message_id, row in messages.INDEX.items()})

    def __getitem__(self, message_id: int) -> type[Message]:
        message_class: type[Message] = getattr(messages, messages.INDEX[message_id][0])
        return message_class

    def by_name(self, name: str) -> type[Message]:
        message_class = getattr(messages, _cap_words(name), None)
        return super().by_name(name) if message_class is None else message_class

    def enum(self, name: str) -> type[Any]:
        found = getattr(enums, _cap_words(name), None)
        return super().enum(name) if found is None else found


class _Extended(Dialect):
    def __init__(self, first: Dialect, second: Dialect) -> None:
        super().__init__(f"{first.name}+{second.name}", ())
        self._parts = (first, second)
        self._take({**second.rows, **first.rows})

    def __getitem__(self, message_id: int) -> type[Message]:
        first, second = self._parts
        return first[message_id] if message_id in first else second[message_id]

    def enum(self, name: str) -> type[Any]:
        found: list[type[Any]] = []
        for part in self._parts:
            try:
                found.append(part.enum(name))
            except InvalidArgument:
                continue
        if len(found) < 2 or found[1].__members__.keys() <= found[0].__members__.keys():
            return found[0] if found else super().enum(name)
        if name not in self._enums:
            self._enums[name] = _united(*found)
        return self._enums[name]


def _united(first: type[Any], second: type[Any]) -> type[Any]:
    """An enum with the entries of both: private dialects add to enums of the standard, which has more than theirs."""
    members = {**second.__members__, **first.__members__}
    bitmask = issubclass(first, IntFlag)
    return make_enum(first.__module__, first.__name__, bitmask, first.__doc__ or "", members.items())


def _cap_words(name: str) -> str:
    return "".join(part.capitalize() for part in name.split("_"))


STANDARD: Dialect = _Standard()
"""All messages that aerokit carries; made without importing one of them."""
