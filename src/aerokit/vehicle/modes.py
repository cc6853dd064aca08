"""Flight modes, and telling the vehicle to hold: what every other action rests on."""

from __future__ import annotations

import logging
import math
from contextlib import contextmanager
from typing import TYPE_CHECKING

import anyio

from aerokit.errors import AerokitError, CommandRejected, NotSupported
from aerokit.vehicle.progress import await_progress
from aerokit.vehicle.state import VehicleState

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from aerokit.autopilots import Mode, Purpose
    from aerokit.mavlink.messages import CommandAck

__all__ = ["CHANGE_MODE", "DO_REPOSITION", "RESULT_UNSUPPORTED", "ModeActions"]

logger = logging.getLogger("aerokit")

DO_SET_MODE = 176
DO_REPOSITION = 192
CHANGE_MODE = 1
RESULT_UNSUPPORTED = 3
MODE_GRACE_S = 3.0
"""How long HEARTBEAT, at 1 Hz, may lag behind an accepted command that changes the mode."""
HOLD_AGAIN_S = 0.4
"""When HEARTBEAT does not tell it by then, an order to hold is given again."""
STOP_HERE = (DO_REPOSITION, -1, CHANGE_MODE, 0, *(math.nan,) * 4)
"""A place that is no number means: here, with the way it takes to brake."""


class ModeActions(VehicleState):
    """Changing the flight mode, holding."""

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
        self._supersede_hold()
        await self._change_mode(self.autopilot.find_mode(mode, self.telemetry.mode_names), timeout)

    async def hold(self) -> None:
        """Stop and stay (a fixed wing circles); returns when HEARTBEAT tells the autopilot's mode for that.

        Copter BRAKE, Plane LOITER, Rover HOLD (a boat LOITER), Sub POSHOLD; PX4 LOITER where it comes to a stop.

        Raises as :meth:`set_mode`; NotSupported when this vehicle has no mode for it.
        """
        mode = self._mode_for("hold", "hold")
        self._supersede_hold()
        await self._stop_in(mode)

    async def _change_mode(self, wanted: Mode, timeout: float = 6.0) -> None:
        started = self.connection.now()
        was_in_doubt = self._mode_is_in_doubt
        with self._refusals_of(DO_SET_MODE) as refusals, self._changing_mode():
            await self._request_mode(wanted)
            told_since = self.connection.now() if was_in_doubt else -math.inf
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

    async def _request_mode(self, wanted: Mode) -> None:
        started = self.connection.now()
        try:
            await self._commands.send_long(DO_SET_MODE, *self.autopilot.mode_order(wanted).params)
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
        self._supersede_hold()
        if self._mode_is_in_doubt or not self._is_in(mode):
            await self._change_mode(mode)

    async def _stop_in(self, mode: Mode) -> None:
        """PX4 in LOITER may be on its way somewhere: asking for the mode again would not stop it."""
        if self._holds_by_reposition:
            await self._explained_command(*STOP_HERE)
        if self._mode_is_in_doubt or not self._is_in(mode):
            await self._change_mode(mode)

    def _hold_soon(self) -> None:
        """Tell the vehicle to hold without waiting: for the ends of blocks and for cancelled calls.

        One command goes out at once; a task of the vehicle's own confirms it, as long as the connection is there.
        """
        mode = self.autopilot.mode_for("hold", is_vtol=self.is_vtol)
        if mode is None or not self.connection.is_open or not self.is_armed:
            return
        if self._holds_by_reposition:
            self._commands.send_unconfirmed(*STOP_HERE)
        else:
            self._commands.send_unconfirmed(DO_SET_MODE, *self.autopilot.mode_order(mode).params)
        self._supersede_hold()
        self._doubt_mode()
        ordered_at, scope = self.connection.now(), anyio.CancelScope()
        self._hold_scope = scope

        async def confirm() -> None:
            with scope:
                await anyio.sleep(HOLD_AGAIN_S)
                if self._is_in(mode) and self.telemetry.mode.updated_at > ordered_at:
                    return
                try:
                    await self._stop_in(mode)
                except AerokitError as error:
                    logger.warning("the vehicle was told to hold and did not confirm it: %s", error)

        self._in_background(confirm)

    def _supersede_hold(self) -> None:
        """A new order is given: what an earlier one left to be confirmed must not come after it."""
        if self._hold_scope is not None:
            self._hold_scope.cancel()
            self._hold_scope = None

    def _mode_for(self, action: str, purpose: Purpose) -> Mode:
        mode = self.autopilot.mode_for(purpose, is_vtol=self.is_vtol)
        if mode is None:
            raise NotSupported(f"{action}: {self.autopilot.firmware} has no mode for it")
        return mode

    def _stays_in(self, *modes: Mode) -> Callable[[], str | None]:
        """What can go wrong on the way: it disarms, or its mode becomes another one than these."""
        grace_until, settles_at = self.connection.now() + MODE_GRACE_S, self._mode_settles_at
        arrived = False

        def trouble() -> str | None:
            nonlocal arrived
            if not self.is_armed:
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
