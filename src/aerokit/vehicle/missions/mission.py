"""``MissionControl``: transfers the mission of a vehicle, and makes the vehicle fly it."""

from __future__ import annotations

from enum import Enum, auto
from typing import TYPE_CHECKING

import anyio

from aerokit._internal.arguments import checks_arguments
from aerokit.errors import CommandRejected, InvalidArgument, OperationRejected, OperationTimeout
from aerokit.mavlink.enums import MavCmd, MavMissionType, MavResult, MissionState
from aerokit.vehicle.commanding.arbiter import MODE_GRACE_S
from aerokit.vehicle.commanding.ground import GroundCheck
from aerokit.vehicle.commanding.progress import MAX_SILENCE_S, CircleDetector, await_progress
from aerokit.vehicle.missions.context import LANDING_PURPOSES
from aerokit.vehicle.missions.plans import VehiclePlan
from aerokit.vehicle.missions.stalling import MissionStallDetector
from aerokit.vehicle.state.telemetry import is_reported_on_ground

if TYPE_CHECKING:
    from collections.abc import Sequence

    from aerokit.autopilots.modes import Mode
    from aerokit.connection.cells import StateCell
    from aerokit.missions import Mission
    from aerokit.missions.item import MissionItem
    from aerokit.vehicle.commanding.context import VehicleContext
    from aerokit.vehicle.commanding.order import Order, SentCommand
    from aerokit.vehicle.missions.context import MissionTracker, PlanContext
    from aerokit.vehicle.state.condition import MissionProgress

__all__ = ["MissionControl"]

MAX_ITEM = 0xFFFF - 1
# Seconds to wait for MISSION_CURRENT to report the end of the mission. It is sent at 1 Hz or faster, and may be lost.
END_GRACE_S = 2.0

# On a bad link, several MISSION_CURRENTs may be lost. The mission counts as interrupted if the next one does not report
# the end, or if none arrives within this many seconds.
END_REPORT_TIMEOUT_S = 10.0

# A return may end at a rally point, whose position is unknown here, so it counts as finished after this time.
RETURN_TIMEOUT_S = 300.0


class Ending(Enum):
    """The last item of a mission."""

    UNKNOWN = auto()  # The items are unknown.
    LANDING = auto()  # a landing, or a return with a landing
    RETURN = auto()  # a return without a landing
    OTHER = auto()


class MissionEndDetector:
    """Detects the end of a mission.

    The vehicle must report completion or, if it reports no mission state, must have reached the last item. Some
    missions end later:

    - If the last item is a landing, or a return with a landing, the vehicle must also be on the ground, because PX4
      reports completion when the return starts. A vehicle that disarms in the mode of this item needs no report.
    - If the last item is a return without a landing, the vehicle must be at home.
    - If the items are unknown, the mode after the completion shows whether the vehicle still lands.

    If a failsafe during the last item changes the mode, e.g. to land elsewhere, the mission has failed.
    """

    def __init__(
        self, vehicle_context: VehicleContext, tracker: MissionTracker, mode: Mode, items: Sequence[MissionItem] | None
    ) -> None:
        session = vehicle_context.session
        self._vehicle_context = vehicle_context
        self._session = session
        self._tracker = tracker
        self._mode = mode
        self._newest_order_at_start = vehicle_context.arbiter.newest
        last_command = items[-1].command if items else None
        if last_command is None:
            self._ending = Ending.UNKNOWN
        elif last_command == MavCmd.NAV_RETURN_TO_LAUNCH and not session.autopilot.lands_after_return:
            self._ending = Ending.RETURN
        else:
            self._ending = Ending.LANDING if last_command in LANDING_PURPOSES else Ending.OTHER
        self._completed_at: float | None = None  # when a mission whose items are unknown was first seen complete
        self._return_began_at: float | None = None  # when `_has_returned` was first called
        self._circle = CircleDetector(session)
        # Modes in which the vehicle may land. If the last item is a landing or a return, only the mode of this item.
        autopilot, is_vtol = session.autopilot, session.telemetry.is_vtol
        self._return_modes = autopilot.return_modes(is_vtol=is_vtol)
        modes_of_purpose = {"return": self._return_modes, "land": (autopilot.mode_for("land", is_vtol=is_vtol),)}
        self._landing_modes = [
            mode
            for command, purpose in LANDING_PURPOSES.items()
            if command == last_command or self._ending in (Ending.UNKNOWN, Ending.OTHER)
            for mode in modes_of_purpose[purpose]
        ]
        # Until this time, HEARTBEAT may still report the mode before the mission.
        self._mode_grace_until = session.connection.now() + MODE_GRACE_S
        self._was_in_mode = False
        self._interrupted_at: float | None = None  # when the vehicle was first seen disarmed, or in another mode
        self.ground: GroundCheck = GroundCheck(session)

    def has_ended(self) -> bool:
        is_reported, is_on_ground = self._is_end_reported(), self._is_on_ground
        # `confirms` must be called each time, because it watches the velocity.
        has_landed = self.ground.confirms(is_reported and is_on_ground)
        # A vehicle that has crashed is on the ground, too, but its mission has not ended.
        return has_landed if is_on_ground else is_reported

    def _is_end_reported(self) -> bool:
        """Return True if the vehicle reports the end of the mission. A crashed vehicle may report it, too."""
        if self._tracker.is_present_plan_complete:
            return self._is_completion_final()
        # ArduPlane leaves the mission mode for the return. The mode change stops the mission, so that its completion is
        # not reported.
        is_returning = self._ending is Ending.RETURN and self._is_landing
        if is_returning or self._has_disarmed_after_return:
            has_returned, mode = self._has_returned(), self._session.telemetry.mode.latest
            lands_at_home = mode is not None and self._session.autopilot.lands_at_home(mode)
            return self._is_on_ground or (has_returned and not lands_at_home)
        # The mission is not complete. The vehicle may fly it once more, so earlier observations do not count.
        if not self._is_in_landing_mode:
            self._return_began_at = None
        self._completed_at = None
        if self._session.telemetry.is_confirmed_disarmed and self._is_landing:
            return True
        progress = self._tracker.progress.latest
        reports_state = progress is not None and progress.state != MissionState.UNKNOWN
        # A vehicle that does not report the state of its mission has ended it when it reaches the last item.
        return not reports_state and self._tracker.is_last_item_reached

    @property
    def _has_disarmed_after_return(self) -> bool:
        # When ArduPlane disarms, it makes the first item the current one (AP_Arming_Plane.cpp, disarm).
        has_begun_return = self._return_began_at is not None
        return has_begun_return and self._session.telemetry.is_confirmed_disarmed and self._is_in_landing_mode

    def _is_completion_final(self) -> bool:
        """Return True if a complete mission needs no further return or landing."""
        if self._ending is Ending.RETURN:
            # ArduPilot reports completion at home, PX4 already when it begins to return.
            completes_at_home = self._session.autopilot.mission_completes_at_home
            return completes_at_home or self._has_returned() or self._is_on_ground
        if self._lands_or_returns:
            return self._is_on_ground
        if self._ending is Ending.OTHER:
            return True
        # The items are unknown. Only a mode change, a little after the completion, shows a final landing or return.
        return self._is_on_ground or self._has_stayed_complete()

    def _has_stayed_complete(self) -> bool:
        """Return True if the mission, which is complete now, has been complete for ``END_GRACE_S``."""
        now = self._session.connection.now()
        if self._completed_at is None:
            self._completed_at = now
        # PX4 reports completion when a return or a landing begins, which HEARTBEAT may show a little later.
        return now - self._completed_at >= END_GRACE_S

    @property
    def _lands_or_returns(self) -> bool:
        if self._ending is not Ending.UNKNOWN:
            return self._ending is not Ending.OTHER
        # The items are unknown, but the vehicle's mode after the completion shows whether it lands.
        is_complete, lands = self._tracker.is_present_plan_complete, self._session.autopilot.lands_after_return
        return is_complete and lands and self._is_in_landing_mode

    def failure(self, mission_order: Order | None, *, is_paused: bool) -> str | None:
        """Return the reason why the vehicle will not fly the mission to its end, or None.

        ``mission_order`` is the last order to start, pause or resume the mission.
        """
        session, now = self._session, self._session.connection.now()
        if self._vehicle_context.arbiter.newest not in (self._newest_order_at_start, mission_order):
            return "another order was given"
        fall = self.ground.fall()
        if fall:
            return f"{fall}, {self.describe()}"
        if self.ground.is_reported_on_ground:  # `has_ended` decides whether it has landed.
            return None
        if self._completed_at is not None:  # The mission is complete: `has_ended` waits for END_GRACE_S.
            return None
        is_in_mode = session.telemetry.is_in(self._mode)
        self._was_in_mode = self._was_in_mode or is_in_mode
        is_mode_settling = now < self._vehicle_context.arbiter.mode_settles_at
        is_mode_expected = is_paused or is_in_mode or self._is_landing or is_mode_settling
        if is_mode_expected and not session.telemetry.is_confirmed_disarmed:
            self._interrupted_at = None
            return None
        if not self._is_interruption_final():
            return None
        if session.telemetry.is_confirmed_disarmed:
            return f"the mission has not ended ({self.describe()}), but the vehicle is disarmed"
        if self._was_in_mode:
            return f"the mode changed to {session.telemetry.mode_name}, {self.describe()}"
        return f"the vehicle is not flying its mission but is in {session.telemetry.mode_name}"

    def _is_interruption_final(self) -> bool:
        # A mission that ends also changes the mode, and may report its end a little later. Another mode is therefore a
        # failure only after END_GRACE_S and a MISSION_CURRENT.
        now = self._session.connection.now()
        if self._interrupted_at is None:
            self._interrupted_at = now
        has_report = self._tracker.progress.updated_at > max(self._interrupted_at, self._tracker.stale_until)
        timeout_s = END_GRACE_S if has_report else END_REPORT_TIMEOUT_S
        return now - self._interrupted_at >= timeout_s and now >= self._mode_grace_until

    def describe(self) -> str:
        current, count = self._tracker.current.latest, self._tracker.count.latest
        place = "before its first item" if current is None else f"at item {current}"
        return f"{place} of {'?' if count is None else count}"

    @property
    def _is_landing(self) -> bool:
        """True if the vehicle executes the landing or the return that ends its mission."""
        current, last_item = self._tracker.current.latest, self._tracker.last_item
        is_at_last_item = current is not None and current == last_item
        # If the items are unknown, the number of the current item does not matter.
        is_at_end = is_at_last_item or self._ending is Ending.UNKNOWN
        return is_at_end and self._lands_or_returns and self._is_in_landing_mode

    @property
    def _is_in_landing_mode(self) -> bool:
        return self._session.telemetry.mode.latest in self._landing_modes

    def _has_returned(self) -> bool:
        """Return True if the vehicle is at home, or if the first call was more than ``RETURN_TIMEOUT_S`` ago."""
        session, now = self._session, self._session.connection.now()
        if self._return_began_at is None:
            self._return_began_at, self._circle = now, CircleDetector(session)
        if now - self._return_began_at > RETURN_TIMEOUT_S:
            return True  # The vehicle may have returned to a rally point, whose position is unknown here.
        home = session.telemetry.home.latest
        if home is None:
            return False
        if len(self._return_modes) > 1:  # Near home, the vehicle may still change to a return mode that lands.
            return self._circle.circles(home.position)
        return self._vehicle_context.vehicle_position.is_at(home.position, self._circle)

    @property
    def _is_on_ground(self) -> bool:
        telemetry = self._session.telemetry
        return telemetry.is_confirmed_disarmed or is_reported_on_ground(telemetry)


@checks_arguments
class MissionControl(VehiclePlan["Mission"]):
    """The mission of a vehicle: ``await vehicle.mission.upload(mission)``, ``start()``, ``wait_finished()``.

    For all autopilots, item numbers count from 0 and home is not an item. Starting, pausing and resuming are orders:
    each supersedes earlier orders to move, and is superseded by later ones.
    """

    def __init__(self, context: PlanContext) -> None:
        super().__init__(context)
        self._vehicle_context = context.vehicle_context
        self._session = context.session
        self._tracker = context.tracker
        self._order: Order | None = None  # the last order that was given by a method of this object
        self._is_paused = False

    @property
    def current(self) -> StateCell[int | None]:
        """Number of the current item (MISSION_CURRENT).

        None without a mission, and while ArduPilot reports home as its current item, as it does before the start.
        """
        return self._tracker.current

    @property
    def count(self) -> StateCell[int]:
        """Number of items, from MISSION_CURRENT or the last transfer."""
        return self._tracker.count

    @property
    def progress(self) -> StateCell[MissionProgress]:
        """``current``, ``total`` and ``state`` (MISSION_STATE: 2 not started, 3 active, 4 paused, 5 complete)."""
        return self._tracker.progress

    @property
    def reached(self) -> int | None:
        """Number of the item that was reached last (MISSION_ITEM_REACHED), even if the mission has started again since.

        None if no item was reached since the program connected or the vehicle rebooted.
        """
        return self._tracker.reached

    async def set_current(self, item: int, *, timeout: float = 5.0) -> None:
        """Make ``item`` the current item. A vehicle that is flying its mission proceeds to it immediately.

        A vehicle that has finished its mission stays where it is, also in its mission mode (ArduPilot), until you call
        :meth:`resume`.

        Sends MAV_CMD_DO_SET_MISSION_CURRENT, or MISSION_SET_CURRENT to PX4, which does not support the command. An item
        without a position (a DO command) is executed; ``current`` then shows the item after it.

        Args:
            item: number of the item.
            timeout: only for MISSION_SET_CURRENT: seconds for each of two steps, the end of a running transfer and the
                confirmation by MISSION_CURRENT.

        Raises:
            InvalidArgument: there is no such item. Nothing was sent.
            CommandRejected: the vehicle refused.
            OperationRejected: a pilot took over, or a newer order was given, before the item was confirmed.
            OperationTimeout: the vehicle did not acknowledge the command. With MISSION_SET_CURRENT: a running transfer
                did not end, MISSION_CURRENT did not confirm the item, or the vehicle fell silent before it was sent.
        """
        self._check_item(item)
        with self._vehicle_context.arbiter.auxiliary_order() as order:
            await self._set_current(item, timeout, order)

    async def start(self, item: int = 0, *, timeout: float = 10.0) -> None:
        """Fly the mission from ``item`` on; returns when HEARTBEAT reports the mission mode.

        The vehicle must be armed: **it takes off** if the mission begins with a take-off. A copter on the ground needs
        a take-off as the first item. If you cancel the call, or it raises OperationTimeout, aerokit orders the vehicle
        to hold.

        ArduPilot gets MISSION_START, because a mode change alone does not make it take off. Other autopilots get a mode
        change.

        Args:
            item: number of the first item to fly.
            timeout: seconds for each step: to make ``item`` the current item (as in :meth:`set_current`), and to enter
                the mission mode.

        Raises:
            InvalidArgument: there is no such item. Nothing was sent.
            OperationRejected: the vehicle is not armed, its mode changed meanwhile, or no item is left to fly (PX4).
            CommandRejected: the vehicle refused: it has no mission, no position, …; see ``reasons``.
            OperationTimeout: the vehicle did not acknowledge a command, accepted it but stayed in another mode, did not
                confirm the item, or was busy with a transfer of plans.
            NotSupported: this type of vehicle has no mission mode.
        """
        self._check_item(item)
        mode = self._vehicle_context.sender.mode_for("mission.start", "mission")
        if not self._session.telemetry.is_armed:
            raise OperationRejected("mission.start: the vehicle is not armed: call arm() first; nothing was sent")
        await self._fly(mode, timeout, first_item=item)

    async def pause(self) -> None:
        """Hold; returns when HEARTBEAT reports the hold mode. The vehicle keeps its item for :meth:`resume`.

        Raises OperationRejected if the vehicle is not flying its mission. Otherwise raises as :meth:`Vehicle.hold`.
        """
        vehicle_context, session = self._vehicle_context, self._session
        mode = vehicle_context.sender.mode_for("mission.pause", "hold")
        if not self._context.is_flying_mission:
            raise OperationRejected(
                f"mission.pause: the vehicle is not flying its mission but is in {session.telemetry.mode_name};"
                " nothing was sent"
            )
        order = vehicle_context.arbiter.order(mode)
        self._order = order
        self._is_paused = True
        try:
            await vehicle_context.flight_cleanup.stop_in(mode, order)
        except (CommandRejected, OperationRejected):
            # After these two errors, the vehicle does not hold. After others it may, so `_is_paused` stays True.
            if self._order is order:
                self._is_paused = False
            raise

    async def resume(self, *, timeout: float = 10.0) -> None:
        """Continue the mission from the current item, even if a pilot or another order has interrupted the mission.

        If its parameter MIS_RESTART is 1, ArduPilot starts again from the first item. Raises as :meth:`start`.
        """
        mode = self._vehicle_context.sender.mode_for("mission.resume", "mission")
        if not self._session.telemetry.is_armed:
            raise OperationRejected("mission.resume: the vehicle is not armed; nothing was sent")
        await self._fly(mode, timeout)

    async def _fly(self, mode: Mode, timeout: float, first_item: int | None = None) -> None:
        """Make the vehicle fly its mission from ``first_item`` on, or from the current item."""
        vehicle_context = self._vehicle_context
        order = vehicle_context.arbiter.order(mode)
        self._order = order
        self._tracker.start()
        with vehicle_context.flight_cleanup.holding_if_abandoned(order):
            needs_reset = self._session.autopilot.restarts_mission_by_reset and self._tracker.is_in_mission_mode
            if first_item is None and needs_reset:
                first_item = await self._item_to_restart_from()
            if first_item is not None:
                await self._set_current(first_item, timeout, order, keeps_jump_counts=False, restarts=needs_reset)
            await self._enter_mode(mode, order, timeout)
        if self._order is order:  # False if another task has paused the mission since.
            self._is_paused = False

    async def _item_to_restart_from(self) -> int | None:
        """Return the item from which a mission continues that does not run in its mode; None if it runs."""
        progress, since = self._tracker.progress, self._session.connection.now()
        with self._session.streaming("mission_current"), anyio.move_on_after(END_GRACE_S):
            await progress.wait_until(lambda _: progress.updated_at > since)
        state = None if progress.latest is None else progress.latest.state
        if state == MissionState.COMPLETE:
            return 0  # ArduPilot resumes a complete mission from its beginning.
        return self._tracker.current.latest or 0 if state == MissionState.NOT_STARTED else None

    async def wait_finished(self, *, timeout: float | None = None, max_silence_s: float | None = MAX_SILENCE_S) -> None:
        """Wait until the mission has been flown to its end.

        If the last item is a landing, or a return that ends with a landing (copters), this includes the landing. If it
        is a return without a landing (planes, rovers), the vehicle must be at home; after five minutes of returning, it
        may also be elsewhere, e.g. at a rally point.

        A :meth:`pause` by another task does not end the wait, but a pilot who then changes the mode does. Cancelling
        this call does not stop the vehicle, and no command is sent when it fails.

        aerokit knows the last item from an upload or a download. Otherwise, or after another station has replaced the
        mission, the mode after the completion shows whether the vehicle lands.

        When the call begins, aerokit checks whether another station has replaced the mission. It compares the number of
        items and the mission id (PX4 1.15 and later). On a shared link, the vehicle's answer to the other station also
        shows it. aerokit does not notice a mission with the same number of items that ArduPilot has received over
        another link or as a file. Call :meth:`download` first if another station may replace missions.

        Args:
            timeout: seconds to wait; None for no limit.
            max_silence_s: fail after this many seconds without a heartbeat; None for no limit.

        Raises:
            OperationRejected: the vehicle no longer flies the mission: a pilot, a failsafe or another order changed the
                mode, or the vehicle disarmed on the way or fell. ``reasons`` has the vehicle's status texts.
            OperationTimeout: the mission was not finished in time; or the armed vehicle has not moved for 12 s after it
                descended to the ground at more than 3 m/s; or the vehicle has not moved for 60 s at a take-off or at a
                waypoint without a hold (only if the items are known from an upload or a download).
            HeartbeatTimeout: the vehicle was silent for ``max_silence_s`` seconds.
        """
        vehicle_context, session = self._vehicle_context, self._session
        mode = vehicle_context.sender.mode_for("mission.wait_finished", "mission")
        cache = self._context.caches[MavMissionType.MISSION]
        items = (cache.items or ())[self._context.offset_of(MavMissionType.MISSION) :]
        plan_id = self._version.plan_id
        has_other_id = cache.plan_id != 0 and plan_id != cache.plan_id
        if has_other_id or self._tracker.count.latest not in (None, len(items)):
            items = ()  # Another ground station has replaced the mission, so its items are unknown.
        end = MissionEndDetector(vehicle_context, self._tracker, mode, items)
        with session.streaming("mission_current", "landed_state", "position"), end.ground.watching():
            await await_progress(
                session,
                "mission.wait_finished",
                is_done=end.has_ended,
                failure_reason=lambda: end.failure(self._order, is_paused=self._is_held_by_pause()),
                describe=end.describe,
                timeout=timeout,
                max_silence_s=max_silence_s,
                stall_reason=MissionStallDetector(session, self._tracker, mode, items, self._is_held_by_pause),
                at_positions=False,  # In a mission of hours, checks at each position would take much CPU time.
            )

    def _is_held_by_pause(self) -> bool:
        """Return True from `pause` until `start` or `resume`, or until another party has changed the mode."""
        return self._is_paused and self._order is not None and not self._order.has_lost_mode

    @property
    def explains_mode(self) -> bool:
        """True if the vehicle holds, returns or lands because its mission has ended.

        The mission must be the last order to the vehicle, must not be paused, and must be complete or at its last item.
        """
        session = self._vehicle_context.session
        if self._order is None or self._vehicle_context.arbiter.newest is not self._order or self._is_paused:
            return False
        autopilot, is_vtol = session.autopilot, session.telemetry.is_vtol
        hold_and_land = [autopilot.mode_for(purpose, is_vtol=is_vtol) for purpose in ("hold", "land")]
        final_modes = (*hold_and_land, *autopilot.return_modes(is_vtol=is_vtol))
        is_at_end = self._tracker.is_complete or self._tracker.is_at_last_item
        return is_at_end and session.telemetry.mode.latest in final_modes

    def _get_plan_type(self) -> type[Mission]:
        from aerokit.missions import Mission

        return Mission

    def _on_count(self, count: int) -> None:
        self._tracker.on_transfer_count(count)

    def _check_item(self, item: int) -> None:
        count = self._tracker.count.latest
        last_item = MAX_ITEM if count is None else count - 1
        if count == 0:
            raise InvalidArgument("the vehicle's mission is empty: call upload() first; nothing was sent")
        if not isinstance(item, int) or isinstance(item, bool) or not 0 <= item <= last_item:
            raise InvalidArgument(f"item = {item!r} is not allowed: it must be 0 to {last_item}")

    async def _set_current(
        self, item: int, timeout: float, order: Order, *, keeps_jump_counts: bool = True, restarts: bool = False
    ) -> None:
        vehicle_context, session = self._vehicle_context, self._session
        seq = item + self._context.offset_of(MavMissionType.MISSION)
        if session.autopilot.sets_current_by_command:
            # With 0, which is home, ArduPilot begins with the first item and also resets its jump counts.
            number = 0 if item == 0 and not keeps_jump_counts else seq
            self._expect_motion(order)
            try:
                await vehicle_context.sender.send_long(order, MavCmd.DO_SET_MISSION_CURRENT, number, float(restarts))
            except CommandRejected as error:
                if error.result != MavResult.UNSUPPORTED:
                    raise
            else:
                return
        # The vehicle supports only the older MISSION_SET_CURRENT.
        with vehicle_context.arbiter.sending(order) as sent:
            try:
                await self._set_current_by_message(seq, timeout, sent)
            except OperationTimeout as error:
                if not order.end:  # The order has not ended, so the vehicle did not confirm it in time.
                    raise
                # The new current item may have changed the mode, which ends the order: PX4 leaves MISSION for a return.
                if order.is_newest and await self._is_reported_soon(item, since=order.given_at):
                    return
                raise OperationRejected(str(error), reasons=session.texts_since(order.given_at)) from None

    async def _is_reported_soon(self, item: int, *, since: float) -> bool:
        reported = self._tracker.current
        with anyio.move_on_after(END_GRACE_S):
            await reported.wait_until(lambda current: current == item and reported.updated_at > since)
            return True
        return False

    async def _set_current_by_message(self, seq: int, timeout: float, sent: SentCommand) -> None:
        from aerokit.protocols.missions import SetCurrentItem

        transfers = self._context.transfers
        with transfers.limit(timeout):
            await self._context.lock.acquire()  # PX4 ignores MISSION_SET_CURRENT during a transfer.
        try:
            self._vehicle_context.sender.raise_if_ended(sent.order)
            await self._vehicle_context.sender.await_recent_state(sent.order)
            self._expect_motion(sent.order)
            await transfers.run(
                SetCurrentItem(
                    transfers.system_id,
                    transfers.component_id,
                    seq,
                    self._current_seq,
                    order_status=sent,
                    round_trip=transfers.round_trip,
                    idle_timeout_s=timeout,
                )
            )
        finally:
            self._context.lock.release()

    def _expect_motion(self, order: Order) -> None:
        # A vehicle that flies its mission proceeds to the new current item at once.
        order.may_move = order.may_move or self._context.is_flying_mission

    @property
    def _current_seq(self) -> int | None:
        progress = self._session.telemetry.mission_current.latest
        return None if progress is None else progress.current

    async def _enter_mode(self, mode: Mode, order: Order, timeout: float) -> None:
        await self._order_mode(mode, order, timeout)
        if self._session.telemetry.is_in(mode):
            # After a landing, the HEARTBEAT that reports the mode may also report that the vehicle has disarmed.
            if self._session.telemetry.is_confirmed_disarmed:
                raise OperationRejected("the mission was not started: the vehicle disarmed")
            self._tracker.discard_completion()  # Reports so far may be about the previous flight.

    def _is_over(self, acknowledged_at: float) -> bool:
        """Return True if PX4 has ended the mission before HEARTBEAT reported its mode, e.g. at the last waypoint."""
        end_text = self._session.autopilot.mission_end_text
        texts = self._session.texts_since(acknowledged_at)
        is_end_reported = end_text is not None and any(end_text in text for text in texts)
        return is_end_reported and self._tracker.is_complete

    def _refusals(self, order: Order) -> tuple[str, ...]:
        """Return PX4's status texts, sent after the order, that it left the mode because it has no mission to fly."""
        refusal = self._session.autopilot.no_mission_text
        texts = self._session.texts_since(order.given_at)
        return tuple(text for text in texts if refusal is not None and refusal in text)

    async def _order_mode(self, mode: Mode, order: Order, timeout: float) -> None:
        vehicle_context, session = self._vehicle_context, self._session
        if not session.autopilot.mission_starts_by_command:
            await vehicle_context.sender.change_mode(
                mode,
                order,
                timeout,
                reported_since=order.given_at,
                is_over=lambda acknowledged_at: bool(self._refusals(order)) or self._is_over(acknowledged_at),
            )
            if refusals := self._refusals(order):
                raise OperationRejected("the vehicle does not fly its mission", reasons=refusals)
            return
        try:
            with vehicle_context.arbiter.changing_mode():
                await vehicle_context.sender.send_long(order, MavCmd.MISSION_START, modes=(mode,))
                # `refusals` is empty, because only PX4 refuses accepted commands, and PX4 does not get MISSION_START.
                await vehicle_context.sender.await_mode(
                    mode, order, refusals=[], timeout=timeout, reported_since=order.given_at
                )
        except CommandRejected as error:
            if error.result != MavResult.UNSUPPORTED:
                raise
            # The vehicle does not know MISSION_START.
            await vehicle_context.sender.change_mode(mode, order, timeout, reported_since=order.given_at)
