"""What each message says of a vehicle, for many values of its fields; it stands in the test's wire diary."""

from __future__ import annotations

import random

import pytest
from any_message import anything
from wire_diary import DIARY

from aerokit.autopilots import autopilot_for
from aerokit.mavlink import messages
from aerokit.vehicle.state.field import message_type
from aerokit.vehicle.state.states import SOURCES
from aerokit.vehicle.state.telemetry import Telemetry

HEARTBEATS = {
    "copter": messages.Heartbeat(2, 3, 81, 4, 3),
    "plane": messages.Heartbeat(1, 3, 81, 10, 4),
    "rover": messages.Heartbeat(10, 3, 193, 0, 4),
    "px4": messages.Heartbeat(2, 12, 29, 50593792, 3),
}


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
