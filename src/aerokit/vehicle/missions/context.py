"""`PlanContext` and `MissionTracker`: state of the plans of one vehicle."""

from __future__ import annotations

import asyncio
import math
from functools import partial
from itertools import takewhile
from typing import TYPE_CHECKING, Literal, NamedTuple

import anyio

from aerokit.connection.cells import Source, StateCell
from aerokit.errors import ConnectionClosed
from aerokit.events import MissionCurrentChanged, MissionFinished, MissionItemReached
from aerokit.mavlink.enums import MavCmd, MavMissionResult, MavMissionType, MissionState
from aerokit.mavlink.messages import MissionAck, MissionCurrent
from aerokit.position import position_with_altitude
from aerokit.protocols.exchange import is_addressed_to
from aerokit.vehicle.state.condition import MissionProgress

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from aerokit.autopilots.base import Autopilot
    from aerokit.autopilots.modes import Mode
    from aerokit.mavlink.frame import Frame
    from aerokit.missions.item import MissionItem
    from aerokit.position import Position
    from aerokit.vehicle.commanding.context import VehicleContext
    from aerokit.vehicle.files.files import Files
    from aerokit.vehicle.session.session import VehicleSession
    from aerokit.vehicle.session.transfers import Transfers

# Maps commands that may land the vehicle at the end of a mission to the purpose of the mode in which it lands.
LANDING_PURPOSES: dict[int, Literal["return", "land"]] = {
    MavCmd.NAV_RETURN_TO_LAUNCH: "return",
    MavCmd.NAV_LAND: "land",
    MavCmd.NAV_VTOL_LAND: "land",
}

# Maximum age of a reported plan id: two and a half periods of MISSION_CURRENT, which is sent at 1 Hz.
PLAN_ID_MAX_AGE_S = 2.5

# A MISSION_ACK to this program that arrives within this time after its own transfer is a duplicate.
DUPLICATE_ACK_S = 1.0

# If the same item is reported as reached again within this time, the message is a duplicate.
DUPLICATE_WINDOW_S = 0.3

# If an item becomes current more than this many seconds after it was reached, the vehicle flies to it again.
SECOND_APPROACH_S = 1.0

# After a landing, a vehicle may report another item than the last one for up to this many seconds, until it disarms.
FINAL_ITEM_MAX_AGE_S = 3.0

# For this many seconds after a second start of its mission, a vehicle may still report that the mission is complete.
STALE_STATE_S = 3.0
# Every MISSION_CURRENT is compared with these members. They are looked up once, because Python 3.11 takes 0.3 µs each.
_ACTIVE, _COMPLETE = MissionState.ACTIVE, MissionState.COMPLETE


class PlanCache:
    """Last known content of one kind of plan on the vehicle. Items are numbered as the vehicle numbers them."""

    def __init__(self) -> None:
        self.items: tuple[MissionItem, ...] | None = None
        """Items, with ArduPilot's home as item 0; None if they are unknown."""
        self.updated_at: float = -math.inf
        """Time of the last call of `set` or `forget`."""
        self.plan_id: int = 0  # the vehicle's id of these items; 0 if it reports none
        self.changes: int = 0  # number of calls of `set` and `forget`
        # True if the vehicle offers the plan as a file; None until tried.
        self.has_file: bool | None = None
        self.on_forget: Callable[[], None] = lambda: None

    def set(self, items: Sequence[MissionItem], now: float, plan_id: int = 0) -> None:
        self.items, self.updated_at, self.plan_id = tuple(items), now, plan_id
        self.changes += 1

    def forget(self, now: float) -> None:
        """Record that the plan was, or may have been, replaced."""
        self.items, self.updated_at, self.plan_id = None, now, 0
        self.changes += 1
        self.on_forget()


class PlanVersion(NamedTuple):
    """Value that changes whenever this program notices a change of the vehicle's plan."""

    changes: int  # number of known changes, including those by other stations on a shared link
    plan_id: int  # the vehicle's id; 0 except on PX4


class PlanContext:
    """State shared by the mission, the fence and the rally points of one vehicle.

    The three plans share one lock, because autopilots have a single state machine for transfers of plans. ``files`` is
    a function that returns the vehicle's files.
    """

    def __init__(self, vehicle_context: VehicleContext, files: Callable[[], Files]) -> None:
        self.vehicle_context: VehicleContext = vehicle_context
        self.session: VehicleSession = vehicle_context.session
        self.files: Callable[[], Files] = files
        self.transfers: Transfers = vehicle_context.session.transfers
        self.autopilot: Autopilot = vehicle_context.session.autopilot
        self.lock: asyncio.Lock = asyncio.Lock()
        # Time at which an upload was last cancelled or timed out. The vehicle may not have received its cancellation.
        self.upload_abandoned_at: float = -math.inf
        # The index is the MAV_MISSION_TYPE.
        self.caches: tuple[PlanCache, PlanCache, PlanCache] = (PlanCache(), PlanCache(), PlanCache())
        self._current: Frame | None = None  # the last MISSION_CURRENT, decoded when it is needed
        session = vehicle_context.session
        session.at_close(
            session.connection.bus.attach_frames(MissionCurrent, self._on_current, system_id=session.system_id),
            session.connection.bus.attach(MissionAck, self._on_ack, system_id=session.system_id),
            session.connection.bus.attach_event(MissionFinished, self._on_finished),
        )
        # After a reboot, or if the reopened link leads to another vehicle, the vehicle may have other plans.
        session.on_reboot += [partial(self._forget_plan, cache) for cache in self.caches]
        self.tracker: MissionTracker = MissionTracker(session, self._may_end_by_landing, self._count_final_jumps)
        self.caches[MavMissionType.MISSION].on_forget = self.tracker.on_plan_replaced

    def _may_end_by_landing(self) -> bool:
        """Return True if the last item of the mission is a landing or a return, or is unknown."""
        items = self.caches[MavMissionType.MISSION].items
        return not items or items[-1].command in LANDING_PURPOSES

    def _count_final_jumps(self) -> int | None:
        """Return the number of DO_JUMPs after the last other item; None if the items are unknown."""
        items = self.caches[MavMissionType.MISSION].items
        if items is None or self._was_replaced(MavMissionType.MISSION):
            return None
        return sum(1 for _ in takewhile(lambda item: item.command == MavCmd.DO_JUMP, reversed(items)))

    def now(self) -> float:
        return self.session.connection.now()

    def offset_of(self, mission_type: int) -> int:
        """Return the number of the plan's first item on the vehicle: 1 if item 0 is home, else 0."""
        return int(mission_type == 0 and self.autopilot.home_is_item_0)

    def may_differ(self, mission_type: int, items: Sequence[MissionItem] | None) -> bool:
        """Return True if the vehicle may have other items now than these, which `PlanCache.items` contained before."""
        cache = self.caches[mission_type]
        known_items = cache.items
        if items is None or known_items is None or len(items) != len(known_items):
            return True
        if self._was_replaced(mission_type):
            return True
        from aerokit.missions.compare import ItemStorage, changed_items

        changed_seqs = changed_items(items, known_items, ItemStorage(self.autopilot.mission_storage))
        return any(seq >= self.offset_of(mission_type) for seq in changed_seqs)

    def _was_replaced(self, mission_type: int) -> bool:
        """Return True if the vehicle reports another plan than the known one, e.g. that of another station."""
        cache = self.caches[mission_type]
        reported_id, count = self.plan_id(mission_type, cache.updated_at), self.tracker.count
        are_ids_known = reported_id != 0 and cache.plan_id != 0
        has_other_id = are_ids_known and reported_id != cache.plan_id
        is_count_newer = mission_type == MavMissionType.MISSION and count.updated_at > cache.updated_at
        known_count = len(cache.items or ()) - self.offset_of(mission_type)
        return has_other_id or (is_count_newer and count.latest != known_count)

    def _forget_plan(self, cache: PlanCache) -> None:
        cache.forget(self.now())

    @property
    def home(self) -> Position | None:
        home = self.session.telemetry.home.latest
        return None if home is None else position_with_altitude(home)

    @property
    def is_flying_mission(self) -> bool:
        return self.tracker.is_in_mission_mode and not self.session.telemetry.is_confirmed_disarmed

    def plan_id(self, mission_type: int, since: float) -> int:
        """Return the plan's id from a recent MISSION_CURRENT that arrived after ``since``, or 0."""
        frame = self._current
        if frame is None or frame.received_at <= since or self.now() - frame.received_at > PLAN_ID_MAX_AGE_S:
            return 0
        current = MissionCurrent.decode_body(frame.body)
        ids_by_mission_type = (current.mission_id, current.fence_id, current.rally_points_id)
        return ids_by_mission_type[mission_type]

    def version(self, mission_type: int) -> PlanVersion:
        cache = self.caches[mission_type]
        return PlanVersion(cache.changes, self.plan_id(mission_type, cache.updated_at) or cache.plan_id)

    async def wait_for_plan_id(self, mission_type: int, expected_id: int) -> bool:
        """Wait up to `PLAN_ID_MAX_AGE_S` for a MISSION_CURRENT with this id. Return True if one has arrived."""
        received, started_at = asyncio.Event(), self.now()

        def check(_: MissionCurrent) -> None:
            if self.plan_id(mission_type, started_at) == expected_id:
                received.set()

        detach = self.session.connection.bus.attach(MissionCurrent, check, system_id=self.session.system_id)
        try:
            with anyio.move_on_after(PLAN_ID_MAX_AGE_S):
                await received.wait()
        finally:
            detach()
        return received.is_set()

    def _on_current(self, frame: Frame) -> None:
        if self.session.telemetry.accepts(frame):
            self._current = frame

    def _on_ack(self, ack: MissionAck) -> None:
        """Forget a plan that another station has replaced or cleared."""
        frame, connection = ack.received_frame, self.session.connection
        is_from_autopilot = frame is not None and self.session.telemetry.accepts(frame)
        is_addressed = is_addressed_to(ack, connection.source_system, connection.source_component)
        # Another station on a shared link may use the same ids as this program (255 and 190 by default). An ack to
        # these ids is therefore ours only while this program transfers a plan.
        is_ours = is_addressed and self.lock.locked()
        if is_ours or not is_from_autopilot or ack.type != MavMissionResult.ACCEPTED:
            return
        for mission_type, cache in enumerate(self.caches):
            is_duplicate = is_addressed and self.now() - cache.updated_at < DUPLICATE_ACK_S
            if ack.mission_type in (mission_type, MavMissionType.ALL) and not is_duplicate:
                cache.forget(self.now())

    def _on_finished(self, event: MissionFinished) -> None:
        session = self.session
        hold_mode = self.autopilot.mode_for("hold", is_vtol=session.telemetry.is_vtol)
        holds = self.autopilot.holds_after_mission and self.tracker.is_in_mission_mode
        if event.system_id == session.system_id and holds and hold_mode is not None:
            # At the end of a mission, the vehicle changes to this mode by itself. An order that is given now must not
            # take the mode change for a takeover.
            self.vehicle_context.arbiter.expect_late(hold_mode)


class MissionTracker:
    """State values and events for mission progress. Items are numbered from 0, without home.

    If the mission of an ArduCopter ends with a landing, the vehicle disarms and reports its first item as current, but
    never reports the mission as complete. PX4 reports completion until the next mission has started. PX4 also reports
    an active mission in its modes for a take-off and a landing, and completion at their end, with the item that is
    current then. It sends each MISSION_ITEM_REACHED ten times.
    """

    def __init__(
        self,
        session: VehicleSession,
        may_end_by_landing: Callable[[], bool],
        count_final_jumps: Callable[[], int | None],
    ) -> None:
        self._session = session
        self._may_end_by_landing = may_end_by_landing
        self._count_final_jumps = count_final_jumps
        self._source = Source(session.system_id, session.component_id, "MISSION_CURRENT")
        self._offset = int(session.autopilot.home_is_item_0)  # number of items before the program's first item
        self._repeats_item_reached = session.autopilot.repeats_item_reached  # True for PX4.
        new_cell = session.connection.new_cell
        self.current: StateCell[int | None] = new_cell("mission.current", "MISSION_CURRENT")
        self.count: StateCell[int] = new_cell("mission.count", "MISSION_CURRENT with a number of items")
        self.progress: StateCell[MissionProgress] = new_cell("mission.progress", "MISSION_CURRENT")
        session.add_timeout_hint(self.current, self.count, self.progress)
        self.reached: int | None = None
        # The item that was reached last since the last start of the mission.
        self._reached_since_start: int | None = None
        # True if the last mission was flown to its end.
        self.is_complete: bool = False
        # True if another mission has replaced that mission, and was not flown yet.
        self._was_replaced = False
        self._mode_changed_at = -math.inf
        self._flight_mode: Mode | None = None  # the last mode other than the one in which the vehicle holds
        self._reached_at = -math.inf
        self._last_item_current_at = -math.inf
        # True if the vehicle flies to the item in `reached` once more.
        self._is_approached_again = False
        # True from the first report that the vehicle flies the mission until the mission ends.
        self._has_begun = False
        # A report of completion before this time may be about the previous flight.
        self.stale_until: float = -math.inf
        telemetry = session.telemetry
        session.at_close(
            telemetry.mission_current.observe(self._on_current, every_arrival=True),
            telemetry.mission_reached.observe(self._on_reached, every_arrival=True),
            telemetry.armed.observe(self._on_armed),
            telemetry.mode.observe(self._on_mode),
            session.connection.on_end(self.close),
            lambda: self.close(ConnectionClosed("the async with block of this vehicle was left")),
        )
        session.on_reboot.append(self.forget)

    @property
    def last_item(self) -> int | None:
        """Index of the last item. None if the mission is empty or its length unknown."""
        count = self.count.latest
        return count - 1 if count else None

    @property
    def is_present_plan_complete(self) -> bool:
        """True if the mission that is on the vehicle now was flown to its end."""
        # If the mission mode was entered after the last MISSION_CURRENT, the vehicle may be flying the mission again.
        is_outdated = self.is_in_mission_mode and self.progress.updated_at <= self._mode_changed_at
        return self.is_complete and not self._was_replaced and not is_outdated

    @property
    def is_last_item_reached(self) -> bool:
        return self.last_item is not None and self._reached_since_start == self.last_item

    @property
    def is_at_last_item(self) -> bool:
        """True while the current item is the last item, and shortly afterwards."""
        return self._session.connection.now() - self._last_item_current_at <= FINAL_ITEM_MAX_AGE_S

    def on_transfer_count(self, count: int) -> None:
        self.count.set(count, Source(self._session.system_id, self._session.component_id, "MISSION_COUNT"))

    def on_plan_replaced(self) -> None:
        self._was_replaced = self.is_complete
        self._reached_since_start = None

    def start(self) -> None:
        """Begin to track a new flight of the mission."""
        self._has_begun = False
        self._reached_since_start = None
        self.discard_completion()

    def discard_completion(self) -> None:
        if not self._has_begun:
            self.is_complete = self._was_replaced = False
            # Reports of completion before this time are about the previous flight.
            self.stale_until = self._session.connection.now() + STALE_STATE_S

    def forget(self) -> None:
        for cell in (self.current, self.count, self.progress):
            cell.forget()
        self.reached = self._reached_since_start = None
        self.is_complete = self._was_replaced = False
        self._has_begun = False

    def close(self, error: Exception) -> None:
        for cell in (self.current, self.count, self.progress):
            cell.close(error)

    def _on_current(self, _: MissionProgress | None, reported: MissionProgress) -> None:
        current_before = self.current.latest
        current = None if reported.current is None else reported.current - self._offset
        if current is not None and current < 0:  # The current item is ArduPilot's item 0, which is home.
            current = None
        # A vehicle without a mission reports no total, so `total` is never 0; see `mission_progress`.
        if reported.total is None and reported.state == MissionState.NO_MISSION:
            current = None
            self.count.set(0, self._source)
        elif reported.total is not None:
            self.count.set(reported.total, self._source)
        count = self.count.latest
        self.progress.set(MissionProgress(current, count, reported.state), self._source)
        self.current.set(current, self._source)
        if current is not None and current + 1 == count:  # The current item is the last one.
            self._last_item_current_at = self._session.connection.now()
        if current != current_before:
            self._detect_second_approach(current_before, current)
            self._session.publish(MissionCurrentChanged, current_before, current)
        self._on_state(reported.state)

    def _detect_second_approach(self, current_before: int | None, current: int | None) -> None:
        """Detect that the vehicle flies once more to the item that it reached last."""
        if current is None or current != self.reached:
            return
        # PX4 may report an item as reached just before it reports the item as current. This is no second approach.
        is_long_ago = self._session.connection.now() - self._reached_at > SECOND_APPROACH_S
        comes_from_later_item = current_before is not None and current_before > current
        if is_long_ago or comes_from_later_item:
            self._is_approached_again = True

    def _on_state(self, state: int) -> None:
        if state == _COMPLETE:
            if self._session.connection.now() >= self.stale_until and self._may_be_complete:
                self._complete()
            return
        self.stale_until = -math.inf
        is_new_flight = state == _ACTIVE and (self.is_complete or not self._has_begun)
        if is_new_flight and self.is_in_mission_mode and self._session.telemetry.is_armed:
            self._has_begun = True
            self.is_complete = self._was_replaced = False

    @property
    def _may_be_complete(self) -> bool:
        """False if the completion that the vehicle reports is that of a take-off or a landing in another mode."""
        current, last = self.current.latest, self.last_item
        if not self._session.autopilot.completes_mission_in_other_modes or current is None or last is None:
            return True
        final_jumps = self._count_final_jumps()
        if final_jumps is None:  # The mission may end with DO_JUMPs, so `current` does not tell.
            autopilot = self._session.autopilot
            return self._flight_mode not in (autopilot.mode_for("take_off"), autopilot.mode_for("land"))
        return current >= last - final_jumps

    def _on_mode(self, _: Mode | None, mode: Mode) -> None:
        self._mode_changed_at = self._session.connection.now()
        if mode != self._session.autopilot.mode_for("hold"):
            self._flight_mode = mode

    def _on_armed(self, _: bool | None, is_armed: bool) -> None:
        if is_armed:
            return
        # A vehicle that disarms on its way to a last waypoint has not flown the mission: it may have hit a slope.
        may_be_complete = self.is_last_item_reached or self._may_end_by_landing()
        was_at_end = self._has_begun and self.is_at_last_item and self.is_in_mission_mode
        if was_at_end and may_be_complete:
            self._complete()
        elif not self._has_begun and self._session.connection.now() < self.stale_until:
            self.stale_until = math.inf  # This flight has not begun, so it cannot be complete.

    def _on_reached(self, _: int | None, seq: int) -> None:
        now = self._session.connection.now()
        item = seq - self._offset  # negative if ArduPilot reports item 0 (home), as it does at a guided target
        if self._repeats_item_reached:  # An item counts as reached again only if it was approached again.
            is_duplicate = item == self.reached and not self._is_approached_again
        else:
            is_duplicate = item == self.reached and now - self._reached_at < DUPLICATE_WINDOW_S
        if item < 0 or is_duplicate:
            return
        self.reached = self._reached_since_start = item
        self._reached_at = now
        self._is_approached_again = False
        self._session.publish(MissionItemReached, item)

    def _complete(self) -> None:
        self.is_complete = True
        if self._has_begun:
            self._has_begun = False
            self._session.publish(MissionFinished)

    @property
    def is_in_mission_mode(self) -> bool:
        mode = self._session.autopilot.mode_for("mission", is_vtol=self._session.telemetry.is_vtol)
        return mode is not None and self._session.telemetry.is_in(mode)
