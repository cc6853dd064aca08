"""Flight modes, and telling the vehicle to hold: what every other action rests on."""

from __future__ import annotations

import logging
import math
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import anyio

from aerokit.errors import AerokitError, CommandRejected, NotSupported
from aerokit.vehicle.checks import check_seconds
from aerokit.vehicle.orders import MOVING_COMMANDS, Order
from aerokit.vehicle.progress import await_progress
from aerokit.vehicle.state import VehicleState

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from aerokit.autopilots import Mode, Purpose
    from aerokit.mavlink.messages import CommandAck
    from aerokit.vehicle.guided import SetpointStream

__all__ = ["CHANGE_MODE", "DO_REPOSITION", "RESULT_UNSUPPORTED", "ModeActions"]

logger = logging.getLogger("aerokit")

DO_SET_MODE = 176
DO_REPOSITION = 192
CHANGE_MODE = 1
RESULT_UNSUPPORTED = 3
MODE_GRACE_S = 3.0
"""How long HEARTBEAT, at 1 Hz, may lag behind an accepted command that changes the mode."""
FRESH_MODE_S = 2.5
"""An older mode is no reason to leave an order out."""
HOLD_AT_END_S = 1.5
"""How long the end of a block waits for the answer to an order to hold."""
HOLD_AGAIN_S = 0.4
"""When HEARTBEAT does not tell it by then, an order to hold is given again."""
STOP_HERE = (DO_REPOSITION, -1, CHANGE_MODE, 0, *(math.nan,) * 4)
"""A place that is no number means: here, with the way it takes to brake."""


class ModeActions(VehicleState):
    """Changing the flight mode, holding."""

    _order: Order | None = None
    _stream: SetpointStream[Any] | None = None
    """The set-point stream that is open."""
    _hold_scope: anyio.CancelScope | None = None
    _mode_is_in_doubt = False
    """An order that changes the mode is out and its end is not known: the mode in HEARTBEAT may be about to change."""
    _mode_settles_at = -math.inf
    """Until then HEARTBEAT may tell the mode of an order that was given up."""

    async def set_mode(self, mode: str | int, *, timeout: float = 6.0) -> None:
        """Change the flight mode and wait until HEARTBEAT tells it.

        Args:
            mode: a name as the autopilot's own documentation spells it (``"GUIDED"``, ``"POSCTL"``; case does not
                matter), or the number in HEARTBEAT.custom_mode.
            timeout: seconds for the whole of it.

        Sends MAV_CMD_DO_SET_MODE, and SET_MODE to a vehicle that does not know that command
        (https://mavlink.io/en/messages/common.html#MAV_CMD_DO_SET_MODE).

        Raises:
            LocalProtocolError: this vehicle has no such mode; the text lists those it has. Nothing was sent.
            CommandRejected: the vehicle refused; ``reasons`` has what it said meanwhile.
            OperationTimeout: it accepted and stayed in another mode.
        """
        check_seconds("timeout", timeout)
        wanted = self.autopilot.find_mode(mode, self.telemetry.mode_names)
        self._new_order(wanted)
        await self._change_mode(wanted, timeout)

    async def hold(self) -> None:
        """Stop and stay (a fixed wing circles); returns when HEARTBEAT tells the autopilot's mode for that.

        Copter BRAKE, Plane LOITER, Rover HOLD (a boat LOITER), Sub POSHOLD; PX4 LOITER where it comes to a stop.

        Raises as :meth:`set_mode`; NotSupported when this vehicle has no mode for it.
        """
        mode = self._mode_for("hold", "hold")
        self._new_order(mode)
        await self._stop_in(mode)

    async def _change_mode(
        self, wanted: Mode, timeout: float = 6.0, *, told_since: float = -math.inf
    ) -> None:
        """Order the mode and wait until it is told, by a message that came after ``told_since``."""
        started = self.connection.now()
        was_in_doubt = self._mode_is_in_doubt
        with self._refusals_of(DO_SET_MODE) as refusals, self._changing_mode():
            await self._request_mode(wanted, timeout)
            told_since = self.connection.now() if was_in_doubt else told_since
            await self._await_mode(wanted, refusals, started, timeout, told_since)
            self._mode_settles_at = -math.inf

    @contextmanager
    def _changing_mode(self) -> Iterator[None]:
        """Until the vehicle's answer is known, which it is not when this is cancelled or times out, trust no mode."""
        self._mode_is_in_doubt = True
        try:
            yield
        except CommandRejected:
            self._mode_is_in_doubt = False
            raise
        except BaseException:
            self._doubt_mode()
            raise
        self._mode_is_in_doubt = False

    def _doubt_mode(self) -> None:
        """An order that changes the mode is out and nobody waits for what comes of it."""
        self._mode_is_in_doubt = True
        self._mode_settles_at = self.connection.now() + MODE_GRACE_S

    async def _request_mode(self, wanted: Mode, timeout: float) -> None:
        started = self.connection.now()
        params = self.autopilot.mode_order(wanted).params
        try:
            await self._commands.send_long(DO_SET_MODE, *params, attempt_timeout=min(1.0, timeout / 4))
        except CommandRejected as error:
            if error.result != RESULT_UNSUPPORTED:
                await self._settle()
                raise self._explained(error, started) from None
            self.connection.send(self.autopilot.mode_order(wanted).legacy(self.system_id))

    async def _await_mode(
        self,
        wanted: Mode,
        refusals: list[CommandAck],
        started: float,
        timeout: float,
        told_since: float,
    ) -> None:
        """PX4 acks twice: the first ack is always ACCEPTED, the second one may take it back."""

        def trouble() -> str | None:
            return "the vehicle took its acceptance back" if refusals else None

        await await_progress(
            self,
            f"set_mode({wanted.name})",
            is_done=lambda: self._is_in(wanted) and self.telemetry.mode.updated_at > told_since,
            trouble=trouble,
            describe=lambda: f"the vehicle is in {self.mode_name}",
            timeout=max(0.1, timeout - (self.connection.now() - started)),
        )

    def _is_in(self, mode: Mode) -> bool:
        latest = self.telemetry.mode.latest
        return latest is not None and latest.custom_mode == mode.custom_mode

    async def _ensure_mode(self, mode: Mode) -> None:
        """Change the mode, unless it was told lately that the vehicle is in it."""
        is_told = self._is_in(mode) and self.telemetry.mode.age <= FRESH_MODE_S
        if self._mode_is_in_doubt or not is_told:
            await self._change_mode(mode)

    async def _stop_in(self, mode: Mode) -> None:
        """Order it in any case; PX4 in LOITER may be on its way somewhere, where the mode alone would not stop it."""
        started = self.connection.now()
        if self._holds_by_reposition:
            await self._explained_command(*STOP_HERE)
            await self._ensure_mode(mode)
        else:
            await self._change_mode(mode, told_since=started)

    def _new_order(self, *modes: Mode) -> Order:
        """A new order is given: the one before ends, and what it left to be confirmed is not confirmed any more."""
        if self._hold_scope is not None:
            self._hold_scope.cancel()
            self._hold_scope = None
        self._order = Order(self.connection.now(), self.telemetry.mode.latest, modes)
        return self._order

    def _before_command(self, command: int) -> None:
        """A program that steers past the actions gives a new order too."""
        if command in MOVING_COMMANDS:
            self._new_order()

    def _on_mode(self, before: Mode | None, after: Mode) -> None:
        """Once the vehicle is in a mode of the order, the mode before would be somebody else's doing too."""
        if self._order is not None and after in self._order.modes:
            self._order.mode_before = None
        super()._on_mode(before, after)

    def _is_somebody_elses(self, order: Order) -> bool:
        """Whether a newer order, a pilot or a failsafe steers by now: then this order has nothing to say any more."""
        mode = self.telemetry.mode
        return order is not self._order or (
            mode.updated_at > order.given_at and not order.explains(mode.latest)
        )

    def _hold_soon(self, order: Order) -> bool:
        """Tell the vehicle to hold without waiting: for the ends of blocks and for cancelled calls.

        One command goes out at once; a task of the vehicle's own confirms it, as long as the connection is there.
        Nothing is sent when the vehicle is not this order's any more, or is known to be disarmed; says whether it was.
        """
        mode = self.autopilot.mode_for("hold", is_vtol=self.is_vtol)
        if mode is None or not self.connection.is_open or self.is_surely_disarmed:
            return False
        if self._is_somebody_elses(order):
            return False
        if self._holds_by_reposition:
            self._commands.send_unconfirmed(*STOP_HERE)
        else:
            self._commands.send_unconfirmed(DO_SET_MODE, *self.autopilot.mode_order(mode).params)
        hold = self._new_order(*order.modes, mode)
        self._doubt_mode()
        scope = self._hold_scope = anyio.CancelScope()

        async def confirm() -> None:
            with scope:
                await self._confirm_hold(mode, hold)
                self._hold_scope = None

        self._background.start(confirm, "aerokit hold")
        return True

    async def _confirm_hold(self, mode: Mode, order: Order) -> None:
        await anyio.sleep(HOLD_AGAIN_S)
        is_told = self._is_in(mode) and self.telemetry.mode.updated_at > order.given_at
        if is_told or self._is_somebody_elses(order):
            return
        try:
            await self._stop_in(mode)
        except AerokitError as error:
            logger.warning("the vehicle was told to hold and did not confirm it: %s", error)

    async def _finish_hold(self) -> None:
        """At the end of everything: give an order to hold the time to be answered, or to be given again."""
        command = STOP_HERE[0] if self._holds_by_reposition else DO_SET_MODE
        with anyio.CancelScope(shield=True), anyio.move_on_after(HOLD_AT_END_S):
            while self.connection.is_open and self._hold_scope is not None:
                if not self._commands.awaits_answer(int(command)):
                    return
                await anyio.sleep(0.02)

    def _end_stream(self) -> None:
        """At the end of everything: a set-point stream that is still open ends, and the vehicle is told to hold."""
        if self._stream is not None:
            self._stream._stop("the block of its vehicle was left")

    def _mode_for(self, action: str, purpose: Purpose) -> Mode:
        mode = self.autopilot.mode_for(purpose, is_vtol=self.is_vtol)
        if mode is None:
            raise NotSupported(f"{action}: {self.autopilot.firmware} has no mode for it")
        return mode

    def _stays_in(self, order: Order, *modes: Mode) -> Callable[[], str | None]:
        """What can go wrong on the way: another order, it disarms, or its mode becomes another one than these."""
        grace_until, settles_at = self.connection.now() + MODE_GRACE_S, self._mode_settles_at
        arrived = False

        def trouble() -> str | None:
            nonlocal arrived
            if order is not self._order:
                return "another order was given"
            if self.is_surely_disarmed:
                return "the vehicle disarmed"
            if self.connection.now() < settles_at:
                return None
            mode = self.telemetry.mode.latest
            arrived = arrived or mode in modes
            if mode not in modes and (arrived or self.connection.now() > grace_until):
                return f"the mode changed to {mode}" if arrived else f"the vehicle stayed in {mode}"
            return None

        return trouble

    @property
    def _holds_by_reposition(self) -> bool:
        return self.autopilot.reposition is not None and self.autopilot.reposition_purpose == "hold"

    async def _explained_command(self, command: int, *params: float) -> None:
        started = self.connection.now()
        try:
            await self._commands.send_long(command, *params)
        except CommandRejected as error:
            await self._settle()
            raise self._explained(error, started) from None
