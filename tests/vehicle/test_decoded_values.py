"""What each message says of a vehicle, for many values of its fields; it stands in the test's wire diary."""

from __future__ import annotations

import random
from typing import Any

import pytest
from wire_diary import DIARY

from aerokit.autopilots import autopilot_for
from aerokit.mavlink import Field, Message, messages
from aerokit.vehicle.state.states import SOURCES
from aerokit.vehicle.state.telemetry import Telemetry
from aerokit.vehicle.state.told import message_type

HEARTBEATS = {
    "copter": messages.Heartbeat(2, 3, 81, 4, 3),
    "plane": messages.Heartbeat(1, 3, 81, 10, 4),
    "rover": messages.Heartbeat(10, 3, 193, 0, 4),
    "px4": messages.Heartbeat(2, 12, 29, 50593792, 3),
}
PLAUSIBLE = {
    "lat": 473977000, "lon": 85456000, "latitude": 473977000, "longitude": 85456000, "fix_type": 3,
    "severity": 4, "seq": 2, "landed_state": 2, "mission_state": 3, "total": 7,
}  # fmt: skip


def value_of(field: Field, dice: random.Random) -> Any:
    """Anything that the field can hold, its "unknown" among it; what would make all else unknown is plausible."""
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
    return kind(**{each.name: value_of(each, dice) for each in kind.FIELDS})


@pytest.mark.parametrize("vehicle", HEARTBEATS)
@pytest.mark.parametrize("name", sorted(SOURCES))
def test_what_it_says(name: str, vehicle: str, request: pytest.FixtureRequest) -> None:
    diary, dice, kind = request.node.stash[DIARY], random.Random(name), message_type(name)
    told = {each.name for each, _ in SOURCES[name]}
    heard: set[str] = set()
    for _ in range(12):
        now = 100.0
        telemetry = Telemetry(lambda: now, autopilot=autopilot_for(HEARTBEATS[vehicle]))  # noqa: B023
        telemetry.receive(HEARTBEATS[vehicle])
        before = {cell.name: cell.updated_at for cell in telemetry.cells.values()}
        now = 101.0
        message = anything(kind, dice)
        telemetry.receive(message)
        changed = {each for each in telemetry.cells.values() if each.updated_at != before[each.name]}
        heard |= {each.name for each in changed}
        diary.write(f"{message!r}: {sorted(f'{each.name} = {each.latest!r}' for each in changed)}")
    assert heard <= told
