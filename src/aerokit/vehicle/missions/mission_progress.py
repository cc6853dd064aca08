"""``MissionWatch``: how far a vehicle is in its mission, by MISSION_CURRENT and MISSION_ITEM_REACHED."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.connection.cells import Source, StateCell
from aerokit.errors import ConnectionClosed
from aerokit.events import MissionCurrentChanged, MissionFinished, MissionItemReached
from aerokit.mavlink.enums import MavCmd, MavLandedState, MissionState
from aerokit.position import Position
from aerokit.vehicle.commanding.arbiter import MODE_GRACE_S
from aerokit.vehicle.state.condition import MissionProgress

if TYPE_CHECKING:
    from collections.abc import Sequence

    from aerokit.autopilots.modes import Mode
    from aerokit.missions.item import MissionItem
    from aerokit.vehicle.commanding.context import Bridge
    from aerokit.vehicle.commanding.order import Order
    from aerokit.vehicle.session.session import Talk

TWICE_S = 0.3
"""The same item reached again so soon is one message that came twice."""

AGAIN_S = 1.0

LAST_S = 3.0
"""How long before it disarms a vehicle that has landed may have left its last item."""

STALE_S = 3.0
"""How long a vehicle that starts its mission anew may go on saying that it is complete."""


class MissionWatch:
    """Cells and events. Items are counted without home.

    An ArduCopter that lands at the end disarms and goes back to its first item, and never says that it is complete.
    PX4 says so until the next mission is under way, says that it is active in its landing mode too, and tells each item
    reached ten times over.
    """

    def __init__(self, talk: Talk) -> None:
        self._talk = talk
        self._offset = int(talk.autopilot.home_is_item_0)
        self._repeats = talk.autopilot.repeats_item_reached
        new_cell = talk.connection.new_cell
        self.current: StateCell[int | None] = new_cell("mission.current", "MISSION_CURRENT")
        self.count: StateCell[int] = new_cell("mission.count", "MISSION_CURRENT with a number of items")
        self.progress: StateCell[MissionProgress] = new_cell("mission.progress", "MISSION_CURRENT")
        talk.explain_timeouts(self.current, self.count, self.progress)
        self.reached: int | None = None
        """The item that was reached last."""
        self.is_complete: bool = False
        """Whether the mission that was flown last came to its end."""
        self._reached_at = self._at_last_at = -math.inf
        self._may_repeat = False
        self._was_active = False
        self._stale_until = -math.inf
        telemetry = talk.telemetry
        talk.at_close(
            telemetry.mission_current.observe(self._on_current, every_arrival=True),
            telemetry.mission_reached.observe(self._on_reached, every_arrival=True),
            telemetry.armed.observe(self._on_armed),
            talk.connection.on_end(self.close),
            lambda: self.close(ConnectionClosed("the block of this vehicle was left")),
        )
        talk.on_reboot.append(self.forget)

    @property
    def last(self) -> int | None:
        """The last item, None when it is not known how many there are."""
        count = self.count.latest
        return count - 1 if count else None

    @property
    def is_at_last(self) -> bool:
        """Whether it goes for the last item, or did so a moment ago."""
        return self._talk.connection.now() - self._at_last_at <= LAST_S

    def counted(self, count: int) -> None:
        """A transfer has told how many items there are."""
        self._set_count(count, "MISSION_COUNT")

    def start(self) -> None:
        """The mission is flown from now on; what is told of the one before does not count."""
        self.is_complete = self._was_active = False
        self._stale_until = self._talk.connection.now() + STALE_S

    def forget(self) -> None:
        """The vehicle has rebooted."""
        for cell in (self.current, self.count, self.progress):
            cell.forget()
        self.reached, self._was_active, self.is_complete = None, False, False

    def close(self, error: Exception) -> None:
        """Nothing more will come."""
        for cell in (self.current, self.count, self.progress):
            cell.close(error)

    # ----------------------------------------------------------------------------------- messages

    def _on_current(self, _: MissionProgress | None, told: MissionProgress) -> None:
        before = self.current.latest
        current = None if told.current is None or told.current < self._offset else told.current - self._offset
        if told.total is None and told.state == MissionState.NO_MISSION:
            current = None
            self._set_count(0, "MISSION_CURRENT")
        elif told.total is not None:
            self._set_count(told.total, "MISSION_CURRENT")
        self.progress.set(
            MissionProgress(current, self.count.latest, told.state), self._source("MISSION_CURRENT")
        )
        self.current.set(current, self._source("MISSION_CURRENT"))
        if current is not None and current == self.last:
            self._at_last_at = self._talk.connection.now()
        if current != before:
            self._note_return(before, current)
            self._talk.publish(MissionCurrentChanged, before, current)
        self._on_state(told.state)

    def _note_return(self, before: int | None, current: int | None) -> None:
        """Going for an item again that was reached before; PX4 may tell that it is reached before it is the current."""
        if current is not None and current == self.reached:
            is_long_ago = self._talk.connection.now() - self._reached_at > AGAIN_S
            self._may_repeat = self._may_repeat or is_long_ago or (before is not None and before > current)

    def _on_state(self, state: int) -> None:
        if state != MissionState.COMPLETE:
            self._stale_until = -math.inf
            if state == MissionState.ACTIVE and self._is_in_mission_mode and self._talk.telemetry.is_armed:
                self._was_active, self.is_complete = True, False
        elif self._talk.connection.now() >= self._stale_until:
            self._complete()

    def _on_armed(self, _: bool | None, is_armed: bool) -> None:
        if not is_armed and self._was_active and self.is_at_last and self._is_in_mission_mode:
            self._complete()

    def _on_reached(self, _: int | None, seq: int) -> None:
        """ArduPilot tells item 0, home, when it has come to a guided target."""
        item, now = seq - self._offset, self._talk.connection.now()
        is_again = item == self.reached and (
            not self._may_repeat if self._repeats else now - self._reached_at < TWICE_S
        )
        if item < 0 or is_again:
            return
        self.reached, self._reached_at, self._may_repeat = item, now, False
        self._talk.publish(MissionItemReached, item)

    # ------------------------------------------------------------------------------------ inside

    def _complete(self) -> None:
        self.is_complete = True
        if self._was_active:
            self._was_active = False
            self._talk.publish(MissionFinished)

    @property
    def _is_in_mission_mode(self) -> bool:
        mode = self._talk.autopilot.mode_for("mission", is_vtol=self._talk.telemetry.is_vtol)
        return mode is not None and self._talk.telemetry.is_in(mode)

    def _set_count(self, count: int, message: str) -> None:
        self.count.set(count, self._source(message))

    def _source(self, message: str) -> Source:
        return Source(self._talk.system_id, self._talk.component_id, message)


LANDINGS = (MavCmd.NAV_RETURN_TO_LAUNCH, MavCmd.NAV_LAND, MavCmd.NAV_VTOL_LAND)

END_GRACE_S = 2.0
"""MISSION_CURRENT comes at 1 Hz or faster, and may be lost."""

BACK_AT_LAST_S = 300.0
"""A return may go to a rally point, which is not known here: so long after its mission is complete it is over."""


class MissionEnd:
    """The ends a mission can have.

    The vehicle says that it is complete, or has landed and disarmed at its last item. A mission that ends with a
    landing, or with a return that ends in one, ends on the ground: PX4 calls it complete when the return begins, which
    it flies in another mode. A return that does not end in a landing ends at home. Vehicles that do not tell the state
    have reached the last item.
    """

    def __init__(
        self, bridge: Bridge, watch: MissionWatch, mode: Mode, items: Sequence[MissionItem] | None
    ) -> None:
        talk = bridge.talk
        self._bridge, self._talk = bridge, talk
        self._watch, self._mode = watch, mode
        self._order = bridge.arbiter.newest
        last = items[-1].command if items else None
        self._ends_by_landing = last in LANDINGS
        self._stays_up = last == MavCmd.NAV_RETURN_TO_LAUNCH and not talk.autopilot.lands_after_return
        self._returns_since: float | None = None
        self._landing_modes = tuple(
            talk.autopilot.mode_for(purpose, is_vtol=talk.telemetry.is_vtol) for purpose in ("return", "land")
        )
        self._grace_until = talk.connection.now() + MODE_GRACE_S
        self._was_in_mode = False
        self._left_at: float | None = None

    def is_reached(self) -> bool:
        """Whether it is over."""
        if self._watch.is_complete:
            at_home = self._stays_up and (self._talk.autopilot.completes_at_home or self._is_back)
            return not self._ends_by_landing or self._is_down or at_home
        if self._stays_up and self._is_landing:  # ArduPlane returns in another mode, and its mission stops
            return self._is_down or self._is_back
        self._returns_since = None
        if self._talk.telemetry.is_surely_disarmed and self._is_landing:
            return True
        progress = self._watch.progress.latest
        tells_state = progress is not None and progress.state != MissionState.UNKNOWN
        return not tells_state and self._watch.last is not None and self._watch.reached == self._watch.last

    def trouble(self, order: Order | None, *, is_paused: bool) -> str | None:
        """Why it will not come to its end any more. ``order`` is the last one that was given for the mission."""
        talk, now = self._talk, self._talk.connection.now()
        if self._bridge.arbiter.newest not in (self._order, order):
            return "another order was given"
        is_in_mode = talk.telemetry.is_in(self._mode)
        self._was_in_mode = self._was_in_mode or is_in_mode
        if not talk.telemetry.is_surely_disarmed and (
            is_paused or is_in_mode or self._is_landing or now < self._bridge.arbiter.mode_settles_at
        ):
            self._left_at = None
            return None
        if self._left_at is None:  # the end of the mission may be told after what it brings about
            self._left_at = now
        if now - self._left_at < END_GRACE_S or now < self._grace_until:
            return None
        if talk.telemetry.is_surely_disarmed:
            return f"the vehicle is not armed, {self.describe()}"
        if self._was_in_mode:
            return f"the mode changed to {talk.telemetry.mode_name}, {self.describe()}"
        return f"the vehicle does not fly its mission, it is in {talk.telemetry.mode_name}"

    def describe(self) -> str:
        """How far it is."""
        current, count = self._watch.current.latest, self._watch.count.latest
        where = "before its first item" if current is None else f"at item {current}"
        return f"{where} of {'?' if count is None else count}"

    @property
    def _is_landing(self) -> bool:
        """Whether it has left the mission's mode for that of its last item."""
        mode = self._talk.telemetry.mode.latest
        current, last = self._watch.current.latest, self._watch.last
        return (
            self._ends_by_landing and current is not None and current == last and mode in self._landing_modes
        )

    @property
    def _is_back(self) -> bool:
        """At home, or wherever else it has gone to in ``BACK_AT_LAST_S`` seconds."""
        talk, now = self._talk, self._talk.connection.now()
        if self._returns_since is None:
            self._returns_since = now
        home = talk.telemetry.home.latest
        place = None if home is None else Position(home.latitude_deg, home.longitude_deg)
        is_near = (
            place is not None and self._bridge.where.distance_to(place) <= talk.autopilot.arrival_radius_m
        )
        return is_near or now - self._returns_since > BACK_AT_LAST_S

    @property
    def _is_down(self) -> bool:
        landed = self._talk.telemetry.landed_state.latest
        return self._talk.telemetry.is_surely_disarmed or landed == MavLandedState.ON_GROUND
