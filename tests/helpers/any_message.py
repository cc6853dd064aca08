"""Hypothesis strategies for messages with random field values."""

from __future__ import annotations

import random
from typing import Any

from aerokit.mavlink import Field, Message

PLAUSIBLE = {
    "lat": 473977000, "lon": 85456000, "latitude": 473977000, "longitude": 85456000, "fix_type": 3,
    "severity": 4, "seq": 2, "landed_state": 2, "mission_state": 3, "total": 7,
}  # fmt: skip


def value_of(field: Field, dice: random.Random) -> Any:
    """Return a random value of a field, or a plausible one for fields whose odd values would hide other fields."""
    if field.name in PLAUSIBLE and dice.random() < 0.7:
        return PLAUSIBLE[field.name]
    count = field.array_length or 1
    if field.type == "char":
        return dice.choice(("", "abc", "Mode 3"))
    values: list[Any]
    if field.type in ("float", "double"):
        values = [dice.choice((0.0, 1.0, round(dice.uniform(-4, 4), 3), 250.0)) for _ in range(count)]
    else:
        bits = 8 * {"8": 1, "1": 2, "3": 4, "6": 8}[field.type.strip("uint")[0]]
        top = (1 << bits) - 1 if field.type.startswith("u") else (1 << (bits - 1)) - 1
        values = [dice.choice((0, 1, dice.randint(2, 120), dice.randint(0, top), top)) for _ in range(count)]
    if not field.array_length:
        return values[0]
    return bytes(values) if field.type == "uint8_t" else tuple(values)


def anything(kind: type[Message], dice: random.Random) -> Message:
    return kind(**{field.name: value_of(field, dice) for field in kind.FIELDS})
