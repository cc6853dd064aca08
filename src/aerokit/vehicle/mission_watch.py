"""``MissionWatch``: how far a vehicle is in its mission, by MISSION_CURRENT and MISSION_ITEM_REACHED."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.errors import ConnectionClosed
from aerokit.runtime.cells import Source, StateCell
from aerokit.runtime.events import MissionCurrentChanged, MissionFinished, MissionItemReached
from aerokit.vehicle.values import MissionProgress

if TYPE_CHECKING:
    from aerokit.vehicle.vehicle import Vehicle

__all__ = ["MissionWatch"]

STATE_NO_MISSION, STATE_ACTIVE, STATE_COMPLETE = 1, 3, 5
TWICE_S = 0.3
"""The same item reached again so soon is one message that came twice."""


class MissionWatch:
    """Cells and events. Items are counted without home."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._vehicle = vehicle
        self._offset = int(vehicle.autopilot.home_is_item_0)
        self._repeats = vehicle.autopilot.repeats_item_reached
        now = vehicle.connection.now
        self.current: StateCell[int | None] = StateCell("mission.current", now, "MISSION_CURRENT")
        self.count: StateCell[int] = StateCell("mission.count", now, "MISSION_CURRENT with a number of items")
        self.progress: StateCell[MissionProgress] = StateCell("mission.progress", now, "MISSION_CURRENT")
        self.reached: int | None = None
        """The item that was reached last."""
        self._reached_at = -math.inf
        self._moved_since = True
        self.completed_at = -math.inf
        """When the vehicle last said that its mission is complete."""
        self._was_active = False
        telemetry = vehicle.telemetry
        vehicle._detach += [
            telemetry.mission_current.observe(self._on_current, every_arrival=True),
            telemetry.mission_reached.observe(self._on_reached, every_arrival=True),
            vehicle.connection.on_end(self.close),
            lambda: self.close(ConnectionClosed("the block of this vehicle was left")),
        ]

    @property
    def last(self) -> int | None:
        """The last item, None when it is not known how many there are."""
        count = self.count.latest
        return count - 1 if count else None

    def counted(self, count: int) -> None:
        """A transfer has told how many items there are."""
        self._set_count(count, "MISSION_COUNT")
        self.reached = None

    def finish(self) -> None:
        """It was seen that the mission has come to its end."""
        if self._was_active:
            self._was_active = False
            self._vehicle._publish(MissionFinished)

    def start(self) -> None:
        """The mission is flown from now on."""
        self._was_active, self._moved_since, self.completed_at = True, True, -math.inf

    def forget(self) -> None:
        """The vehicle has rebooted."""
        for cell in (self.current, self.count, self.progress):
            cell.forget()
        self.reached, self._was_active = None, False

    def close(self, error: Exception) -> None:
        """Nothing more will come."""
        for cell in (self.current, self.count, self.progress):
            cell.close(error)

    # ----------------------------------------------------------------------------------- messages

    def _on_current(self, _: MissionProgress | None, told: MissionProgress) -> None:
        before = self.current.latest
        current = None if told.current is None or told.current < self._offset else told.current - self._offset
        source = Source(self._vehicle.system_id, self._vehicle.component_id, "MISSION_CURRENT")
        if told.total is None and told.state == STATE_NO_MISSION:
            current = None
            self._set_count(0, "MISSION_CURRENT")
        elif told.total is not None:
            self._set_count(told.total, "MISSION_CURRENT")
        self.progress.set(MissionProgress(current, self.count.latest, told.state), source)
        self.current.set(current, source)
        if current != before:
            self._moved_since = True
            self._vehicle._publish(MissionCurrentChanged, before, current)
        self._on_state(told.state)

    def _on_state(self, state: int) -> None:
        if state == STATE_ACTIVE:
            self._was_active = True
            self.completed_at = -math.inf
        elif state == STATE_COMPLETE:
            self.completed_at = self._vehicle.connection.now()
            self.finish()

    def _on_reached(self, _: int | None, seq: int) -> None:
        """PX4 tells an item ten times over; ArduPilot once, and item 0 when it has come to a guided target."""
        item, now = seq - self._offset, self._vehicle.connection.now()
        is_again = item == self.reached and (
            not self._moved_since if self._repeats else now - self._reached_at < TWICE_S
        )
        if item < 0 or is_again:
            return
        self.reached, self._reached_at, self._moved_since = item, now, False
        self._vehicle._publish(MissionItemReached, item)

    def _set_count(self, count: int, message: str) -> None:
        self.count.set(count, Source(self._vehicle.system_id, self._vehicle.component_id, message))
