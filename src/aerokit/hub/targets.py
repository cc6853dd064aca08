"""``Targets``: for whom a frame is, read from its bytes without decoding the message.

A table instead of the definitions: to import all of those takes a third of a second, and it would be in mid-flight.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.hub.outgoing import Kind, kind_of
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.frame import HEADER_LENGTH
from aerokit.mavlink.message import offset_of

if TYPE_CHECKING:
    from aerokit.mavlink.dialect import Dialect
    from aerokit.mavlink.frame import Frame
    from aerokit.mavlink.message import Message

STANDARD_OFFSETS: dict[tuple[int, int | None], tuple[int, ...]] = {
    (0, None): (5,),
    (0, 1): (
        21,
        43,
        45,
        47,
        121,
        122,
        123,
        156,
        161,
        176,
        183,
        186,
        216,
        218,
        258,
        321,
        323,
        12900,
        12903,
        12905,
        12915,
    ),
    (1, 2): (110,),
    (2, 3): (20, 40, 41, 44, 51, 66, 80, 266, 267, 268, 320, 345, 385),
    (3, 4): (248,),
    (4, None): (11,),
    (4, 5): (
        23,
        37,
        38,
        117,
        155,
        184,
        185,
        386,
        387,
        400,
        401,
        412,
        413,
        421,
        11000,
        11002,
        11035,
        12902,
        50005,
    ),
    (6, 7): (151, 154, 214, 420),
    (8, 9): (77, 160, 256, 11004, 50004),
    (10, None): (69,),
    (10, 11): (119,),
    (12, None): (48,),
    (12, 13): (4, 157, 158, 201, 354),
    (14, 15): (175,),
    (16, 17): (70, 111, 11033, 12919),
    (18, 19): (50,),
    (20, 21): (287, 288),
    (24, 25): (54, 292),
    (26, None): (179,),
    (28, 29): (12904,),
    (30, 31): (75, 76, 284, 12901),
    (32, 33): (39, 73, 282, 388),
    (36, 37): (82, 296),
    (38, 39): (285,),
    (40, 41): (200, 513),
    (41, 42): (139,),
    (42, None): (180,),
    (50, 51): (84, 86, 286),
    (52, None): (243,),
    (79, 80): (126,),
}
"""Offset in the payload of the target's system id, and of its component id if there is one → message ids."""

NOWHERE = 1 << 16
"""A place behind the end of every frame: there is no such field."""

Places = tuple[int, int]
"""Where in `Frame.body` the target's system id and component id are; `NOWHERE`: the message has none."""

_SYSTEM_FIELDS = {"MANUAL_CONTROL": "target"}  # the one message that calls it otherwise


class Targets:
    """Where each message of a dialect says for whom it is; of other dialects than ours worked out when it is asked."""

    def __init__(self, dialect: Dialect) -> None:
        self._dialect = dialect
        self.places: dict[int, Places | None] = {}
        """Message id → places; None: a message for everybody. What was not asked for yet may not be in here."""
        if dialect is STANDARD:
            self.places.update(dict.fromkeys(dialect.rows))
            for (system, component), message_ids in STANDARD_OFFSETS.items():
                component = NOWHERE if component is None else HEADER_LENGTH + component
                self.places.update(dict.fromkeys(message_ids, (HEADER_LENGTH + system, component)))

    def look_up(self, message_id: int) -> Places | None:
        """The places of a message; None for one that is for everybody, or that the dialect does not know."""
        if message_id not in self._dialect.rows:
            return None  # not kept: noise could name any number
        places = self.places[message_id] = _places(self._dialect[message_id])
        return places

    def is_unknown(self, message_id: int) -> bool:
        """Whether the dialect does not know a message, so that its checksum cannot have been checked."""
        return message_id not in self._dialect.rows

    def is_order(self, message_id: int) -> bool:
        """Whether it is an order to whomever it names."""
        if self.places.get(message_id) is None:
            return False
        return kind_of(self._dialect[message_id].NAME, is_for_one=True) is Kind.ORDER

    def of(self, frame: Frame) -> tuple[int, int]:
        """System id and component id that a frame is for; 0 is everybody."""
        message_id = frame.message_id
        places = self.places[message_id] if message_id in self.places else self.look_up(message_id)
        if places is None:
            return 0, 0
        # MAVLink 2 cuts zeros off the end, MAVLink 1 has no extensions: what is not there is 0.
        body, (system, component) = frame.body, places
        size = len(body)
        return body[system] if system < size else 0, body[component] if component < size else 0


def _places(message_type: type[Message]) -> Places | None:
    names = {field.name for field in message_type.FIELDS}
    system = _SYSTEM_FIELDS.get(message_type.NAME, "target_system")
    if system not in names:
        return None
    component = NOWHERE
    if "target_component" in names:
        component = HEADER_LENGTH + offset_of(message_type, "target_component")
    return HEADER_LENGTH + offset_of(message_type, system), component
