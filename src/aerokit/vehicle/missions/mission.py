"""``MissionControl``: the mission that a vehicle holds, and flying it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import anyio

from aerokit._internal.arguments import checks_arguments
from aerokit.errors import CommandRejected, InvalidArgument, OperationRejected, OperationTimeout
from aerokit.mavlink.enums import MavCmd, MavResult
from aerokit.vehicle.commanding.progress import LONGEST_SILENCE_S, await_progress
from aerokit.vehicle.missions.mission_progress import MissionEnd
from aerokit.vehicle.missions.plans import HeldPlan

if TYPE_CHECKING:
    from aerokit.autopilots.modes import Mode
    from aerokit.connection.cells import StateCell
    from aerokit.missions import Mission
    from aerokit.vehicle.commanding.order import Order, SentCommand
    from aerokit.vehicle.missions.context import PlanContext
    from aerokit.vehicle.state.condition import MissionProgress

__all__ = ["MissionControl"]

MODE_TIMEOUT_S = 6.0
LAST_ITEM = 0xFFFF - 1


@checks_arguments
class MissionControl(HeldPlan["Mission"]):
    """``await vehicle.mission.upload(mission)``, ``start()``, ``wait_finished()``.

    Items are counted from 0 and home is never one of them, whatever the autopilot. Starting, pausing and resuming are
    orders like taking off: the newest one wins.
    """

    def __init__(self, context: PlanContext) -> None:
        super().__init__(context)
        self._bridge, self._talk = context.bridge, context.talk
        self._watch = context.watch
        self._order: Order | None = None
        """The last one given here."""
        self._is_paused = False

    # ------------------------------------------------------------------------------------- state

    @property
    def current(self) -> StateCell[int | None]:
        """The item it goes for (MISSION_CURRENT); None: it has not begun, or there is no mission."""
        return self._watch.current

    @property
    def count(self) -> StateCell[int]:
        """How many items it holds, by MISSION_CURRENT or by the last transfer."""
        return self._watch.count

    @property
    def progress(self) -> StateCell[MissionProgress]:
        """``current``, ``total`` and ``state`` (MISSION_STATE: 2 not started, 3 active, 4 paused, 5 complete)."""
        return self._watch.progress

    @property
    def reached(self) -> int | None:
        """The item that was reached last (MISSION_ITEM_REACHED), None before the first."""
        return self._watch.reached

    # ------------------------------------------------------------------------------------ orders

    async def set_current(self, item: int, *, timeout: float = 5.0) -> None:
        """Have it go for this item next; it does so at once when it is flying its mission.

        Sends MAV_CMD_DO_SET_MISSION_CURRENT, or MISSION_SET_CURRENT to PX4, which knows that alone. An item that is no
        place to go to (a DO command) is run through: ``current`` then shows the one behind it.

        Raises:
            InvalidArgument: there is no such item. Nothing was sent.
            CommandRejected: the vehicle refused.
            OperationRejected: somebody else steers, or a newer order was given, before it was confirmed.
            OperationTimeout: MISSION_CURRENT did not confirm it.
        """
        self._check_item(item)
        with self._bridge.arbiter.aside() as order:
            await self._set_current(item, timeout, order)

    async def start(self, item: int = 0, *, timeout: float = 10.0) -> None:
        """Fly the mission from ``item`` on, its first one by default; returns when HEARTBEAT tells the mission mode.

        The vehicle must be armed: **it takes off** if the mission says so. A copter on the ground needs a take-off item
        first. Cancelled half-way, the vehicle is told to hold.

        Sends MISSION_START to ArduPilot, which takes off then also from the ground, and changes the mode of others.

        Raises:
            InvalidArgument: there is no such item. Nothing was sent.
            OperationRejected: it is not armed, or its mode changed meanwhile.
            CommandRejected: the vehicle refused: it has no mission, no position, …; ``reasons`` tells.
            OperationTimeout: it accepted and stayed in another mode.
            NotSupported: this type of vehicle has no mode for missions.
        """
        self._check_item(item)
        bridge, talk = self._bridge, self._talk
        mode = bridge.sender.mode_for("mission.start", "mission")
        if not talk.telemetry.is_armed:
            raise OperationRejected(
                "mission.start: the vehicle is not armed: arm() comes first; nothing was sent"
            )
        order = self._order = bridge.arbiter.order(mode)
        self._is_paused = False
        self._watch.start()
        try:
            await self._set_current(item, timeout, order, goes_on=False)
            await self._enter(mode, order, timeout)
        except (anyio.get_cancelled_exc_class(), OperationTimeout):  # it may have heard the order
            bridge.holding.hold_soon(order)
            raise

    async def pause(self) -> None:
        """Stop where it is and keep the place in the mission; returns when HEARTBEAT tells the mode for holding.

        Raises OperationRejected when it does not fly its mission, else as :meth:`Vehicle.hold`.
        """
        bridge, talk = self._bridge, self._talk
        mode = bridge.sender.mode_for("mission.pause", "hold")
        if not self._context.is_flown:
            raise OperationRejected(
                f"mission.pause: the vehicle does not fly its mission, it is in {talk.telemetry.mode_name};"
                " nothing was sent"
            )
        self._order = bridge.arbiter.order(mode)
        self._is_paused = True
        await bridge.holding.stop_in(mode, self._order)

    async def resume(self, *, timeout: float = 10.0) -> None:
        """Go on with the mission from the current item; also after a pilot or another order has interrupted it.

        ArduPilot begins anew if its parameter MIS_RESTART is 1. Raises as :meth:`start`.
        """
        bridge, talk = self._bridge, self._talk
        mode = bridge.sender.mode_for("mission.resume", "mission")
        if not talk.telemetry.is_armed:
            raise OperationRejected("mission.resume: the vehicle is not armed; nothing was sent")
        order = self._order = bridge.arbiter.order(mode)
        self._watch.start()
        try:
            await self._enter(mode, order, timeout)
        except (anyio.get_cancelled_exc_class(), OperationTimeout):
            bridge.holding.hold_soon(order)
            raise
        self._is_paused = False

    async def wait_finished(
        self, *, timeout: float | None = None, max_silence_s: float | None = LONGEST_SILENCE_S
    ) -> None:
        """Wait until the mission has been flown to its end; for a mission that ends with landing, until it has landed.

        A :meth:`pause` from elsewhere in the program is waited through. Cancelled, the vehicle goes on.

        Args:
            timeout: seconds until it is finished; None: as long as it takes.
            max_silence_s: give up when no heartbeat has come for so many seconds; None: wait on, however long.

        Raises:
            OperationRejected: it does not fly the mission any more: a pilot, a failsafe or another order has taken it
                out of the mission's mode, or it disarmed on the way. ``reasons`` has what the vehicle said.
            OperationTimeout: not finished in time.
            HeartbeatTimeout: the vehicle has been silent for ``max_silence_s`` seconds.
        """
        bridge, talk = self._bridge, self._talk
        mode = bridge.sender.mode_for("mission.wait_finished", "mission")
        end = MissionEnd(bridge, self._watch, mode, self._context.memories[0].items)
        with talk.streaming("mission_current", "landed_state"):
            await await_progress(
                talk,
                "mission.wait_finished",
                is_done=end.is_reached,
                trouble=lambda: end.trouble(self._order, is_paused=self._is_paused),
                describe=end.describe,
                timeout=timeout,
                max_silence_s=max_silence_s,
            )

    @property
    def explains_mode(self) -> bool:
        """Whether the vehicle is in a mode in which its mission ends by itself: holding, returning or landing.

        That is so when the mission was ordered last, and is complete or at its last item; it is nobody else's doing.
        """
        talk = self._bridge.talk
        if self._order is None or self._bridge.arbiter.newest is not self._order:
            return False
        ends_in = [
            talk.autopilot.mode_for(purpose, is_vtol=talk.telemetry.is_vtol)
            for purpose in ("hold", "return", "land")
        ]
        return (self._watch.is_complete or self._watch.is_at_last) and talk.telemetry.mode.latest in ends_in

    # ------------------------------------------------------------------------------------ inside

    def _plan_type(self) -> type[Mission]:
        from aerokit.missions import Mission

        return Mission

    def _counted(self, count: int) -> None:
        self._watch.counted(count)

    def _check_item(self, item: int) -> None:
        count = self._watch.count.latest
        last = LAST_ITEM if count is None else count - 1
        if count == 0:
            raise InvalidArgument("the vehicle's mission is empty: upload() comes first; nothing was sent")
        if not isinstance(item, int) or isinstance(item, bool) or not 0 <= item <= last:
            raise InvalidArgument(f"item = {item!r} is not allowed: 0 to {last}")

    async def _set_current(self, item: int, timeout: float, order: Order, *, goes_on: bool = True) -> None:
        """``goes_on``: keep what it has counted of jumps. ArduPilot's item 0, home, stands for a fresh start."""
        bridge, talk = self._bridge, self._talk
        seq = item + self._context.offset_of(0)
        if talk.autopilot.sets_current_by_command:
            try:
                await bridge.sender.command_of(
                    order, MavCmd.DO_SET_MISSION_CURRENT, 0 if item == 0 and not goes_on else seq
                )
            except CommandRejected as error:
                if error.result != MavResult.UNSUPPORTED:
                    raise
            else:
                return
        with bridge.arbiter.sending(order) as sending:
            try:
                await self._set_current_by_message(seq, timeout, sending)
            except OperationTimeout as error:
                if order.end:
                    raise OperationRejected(str(error), reasons=talk.texts_since(order.given_at)) from None
                raise

    async def _set_current_by_message(
        self, seq: int, timeout: float, standing: SentCommand | None = None
    ) -> None:
        from aerokit.protocols.missions import MissionSetCurrent

        transfers = self._context.transfers
        target = (transfers.system_id, transfers.component_id)
        async with self._context.lock:  # PX4 does not hear it during a transfer
            if standing is not None:
                self._bridge.sender.raise_if_over(standing.order)
            await transfers.run(
                MissionSetCurrent(
                    *target,
                    seq,
                    self._told_seq,
                    standing=standing,
                    round_trip=transfers.round_trip,
                    patience_s=timeout,
                )
            )

    @property
    def _told_seq(self) -> int | None:
        """The item in the last MISSION_CURRENT, as counted on the wire."""
        progress = self._talk.telemetry.mission_current.latest
        return None if progress is None else progress.current

    async def _enter(self, mode: Mode, order: Order, timeout: float) -> None:
        bridge, talk = self._bridge, self._talk
        if not talk.autopilot.mission_starts_by_command:
            await bridge.sender.change_mode(mode, order, timeout, told_since=order.given_at)
            return
        try:
            with bridge.arbiter.changing_mode():
                await bridge.sender.give(order, talk.commands.send_long, MavCmd.MISSION_START, modes=(mode,))
                await bridge.sender.await_mode(mode, order, [], timeout, order.given_at)
        except CommandRejected as error:
            if error.result != MavResult.UNSUPPORTED:
                raise
            await bridge.sender.change_mode(mode, order, timeout, told_since=order.given_at)
