"""Decoded state values of each message, for many field values."""

from __future__ import annotations

import random
from collections.abc import Iterator

import pytest
from any_message import anything

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


@pytest.mark.exhaustive
def test_message_updates_only_declared_states() -> None:
    faults = [fault for name in sorted(SOURCES) for vehicle in HEARTBEATS for fault in faults_of(name, vehicle)]
    assert not faults, "\n".join(faults)


def faults_of(name: str, vehicle: str) -> Iterator[str]:
    """Return the invalid states after a message with any content."""
    dice, kind = random.Random(name), message_type(name)
    declared = {state.name for state, _ in SOURCES[name]}
    for _ in range(6):
        now = 100.0
        telemetry = Telemetry(lambda: now, autopilot=autopilot_for(HEARTBEATS[vehicle]))  # noqa: B023
        telemetry.receive(HEARTBEATS[vehicle])
        before = {cell.name: cell.updated_at for cell in telemetry.cells.values()}
        now = 101.0
        telemetry.receive(anything(kind, dice))
        changed = {cell.name for cell in telemetry.cells.values() if cell.updated_at != before[cell.name]}
        if not changed <= declared:
            yield f"{name} of a {vehicle} updates {sorted(changed - declared)}"
