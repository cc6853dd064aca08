"""``GimbalControl``: control of a gimbal for the time of a block."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import TYPE_CHECKING

from aerokit._internal.arguments import checks_arguments
from aerokit.errors import (
    AerokitError,
    BusyError,
    CommandRejected,
    CommandTimeout,
    GimbalTaken,
    NotSupported,
    OperationRejected,
    OperationTimeout,
)
from aerokit.events import SILENT_AFTER_S, GimbalControlLost
from aerokit.mavlink.enums import MavResult
from aerokit.mavlink.messages import GimbalManagerStatus, Heartbeat
from aerokit.vehicle.gimbal.device import Claim
from aerokit.vehicle.gimbal.orders import CONFIGURE, GimbalOrders

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import TracebackType

    from typing_extensions import Self

    from aerokit.vehicle.gimbal.device import Device, GimbalControllers

__all__ = ["GimbalControl", "LastWord"]

ATTEMPTS, ANSWER_S = 10, 0.5


class LastWord:
    """Goes out at once, without waiting, if the vehicle has told lately what it does, else when it is heard again.

    ``is_meant`` is asked before each sending: what a newer order or another controller has made of the gimbal is left
    alone. It is sent again right after a HEARTBEAT until it is answered; to a manager that has fallen silent once more
    when that is heard again.
    """

    def __init__(
        self, orders: GimbalOrders, command: int, params: tuple[float, ...], is_meant: Callable[[], bool]
    ) -> None:
        self._orders, self._talk = orders, orders.talk
        self._command, self._params, self._is_meant = command, params, is_meant
        self._target = orders.manager_id

    async def say(self, what: str) -> None:
        """At the end of a block that ended well: wait for the answer.

        Raises:
            OperationTimeout: the vehicle is silent; it is told when it is heard again.
            CommandRejected: it was refused.
            CommandTimeout: there was no answer.
        """
        if not self._is_meant():
            return
        if not self._orders.bridge.arbiter.is_known:
            self.leave()
            raise OperationTimeout(
                f"{what}: not sent yet, because the vehicle is silent: it will be when it is heard again;"
                f" {self._talk.describe_link()}"
            )
        self._send()
        await self._confirm()

    def leave(self) -> None:
        """At the end of a block that is left by an error or cancelled: do not wait."""
        if not self._talk.connection.is_open or self._talk.is_closed or not self._is_meant():
            return
        is_sent = self._orders.bridge.arbiter.is_known
        if is_sent:
            self._send()

        async def see_to_it() -> None:
            with suppress(AerokitError):
                if not is_sent:
                    await self._hear()
                    if not self._is_meant():
                        return
                    self._send()
                try:
                    await self._confirm()
                except CommandTimeout:
                    if not self._is_target_silent():
                        raise
                    await self._hear_target()
                    if self._is_meant():
                        self._send()
                        await self._confirm()

        self._talk.background.start(see_to_it, "aerokit gimbal")

    def _send(self) -> None:
        self._talk.commands.send_unconfirmed(self._command, *self._params, component_id=self._target)

    async def _confirm(self) -> None:
        with self._orders.bridge.arbiter.aside() as order:
            await self._orders.bridge.sender.give(
                order,
                self._talk.commands.send_long,
                self._command,
                *self._params,
                component_id=self._target,
                is_done=lambda: not self._is_meant(),
                attempts=ATTEMPTS,
                attempt_timeout=ANSWER_S,
                is_sent=True,
            )

    async def _hear(self) -> None:
        armed, since = self._talk.telemetry.armed, self._talk.connection.now()
        await armed.wait_until(lambda _: armed.updated_at > since)

    def _is_target_silent(self) -> bool:
        is_autopilot = self._target == self._talk.component_id
        return not is_autopilot and self._orders.silent_for_s(self._target) > SILENT_AFTER_S

    async def _hear_target(self) -> None:
        """Until its HEARTBEAT comes; the end of the connection cancels this."""
        heard = asyncio.Event()

        def note(heartbeat: Heartbeat) -> None:
            frame = heartbeat.received_frame
            if frame is not None and frame.component_id == self._target:
                heard.set()

        detach = self._talk.connection.bus.attach(Heartbeat, note, system_id=self._talk.system_id)
        try:
            await heard.wait()
        finally:
            detach()


TOLD_S, CONFIRMED_S = 0.5, 3.0
"""So long the manager has to tell by itself that we are in control; then it is asked, and has this long in all."""

STATUS_HZ = 1.0


@checks_arguments
class GimbalControl:
    """We are in control of a gimbal while its ``async with`` lasts (MAV_CMD_DO_GIMBAL_MANAGER_CONFIGURE).

    Entering claims it, from whoever has it, and returns when the manager tells that we have it. Leaving gives it back,
    in any way: without waiting when the block is left by an error or cancelled. When somebody else takes it, that is
    the event ``GimbalControlLost``; orders to the gimbal, those under way too, raise :class:`GimbalTaken`, and so does
    leaving the block if nothing in it was told. Nothing is given back then. A station with our own system and component
    id is not told from us.

    Entering raises:
        NotSupported: the vehicle has no gimbal manager, or its manager knows no secondary control.
        BusyError: a block of this program has that control already. Nothing was sent.
        CommandRejected: the manager refused.
        CommandTimeout: there was no answer.
        OperationTimeout: it was accepted, and the manager does not tell that we have it.
    """

    def __init__(self, orders: GimbalOrders, is_primary: bool) -> None:
        self._orders, self._talk = orders, orders.talk
        self._is_primary = is_primary
        self._device: Device | None = None
        self._claimed = Claim(0, 0, is_primary=is_primary)
        self._taken: GimbalTaken | None = None
        self._was_told = self._was_entered = self._is_ended = False
        self._lost = asyncio.Event()
        self._detach: list[Callable[[], None]] = []

    @property
    def is_primary(self) -> bool:
        """Whether it is the primary control."""
        return self._is_primary

    @property
    def is_held(self) -> bool:
        """Whether we are in control."""
        return self._device is not None and self._taken is None and not self._is_ended

    @property
    def is_taken(self) -> bool:
        """Whether it was lost."""
        return self._taken is not None

    async def until_lost(self) -> tuple[int, int]:
        """Wait until somebody else has taken control; their system and component id, (0, 0): nobody has it.

        Raises:
            OperationRejected: the block was left meanwhile.
            ConnectionClosed, LinkLost: the connection ended.
        """
        detach = self._talk.connection.on_end(lambda _: self._lost.set())
        try:
            await self._lost.wait()
        finally:
            detach()
        self._talk.connection.raise_if_ended()
        if self._taken is None:
            raise OperationRejected(f"{self._orders.name}: the block that had control was left")
        self._was_told = True
        return self._taken.system_id, self._taken.component_id

    def raise_if_taken(self) -> None:
        """Raise what tells who has it now; nothing while we have it.

        Raises:
            GimbalTaken: somebody else has taken control, or nobody has it any more.
        """
        if self._taken is not None:
            self._was_told = True
            raise _anew(self._taken)

    async def __aenter__(self) -> Self:
        orders = self._orders
        if self._was_entered:
            raise BusyError("control of a gimbal is entered once: call control() again")
        if self._is_primary in orders.device.controls:
            raise BusyError(f"{orders.name}: this program is in control of it already; nothing was sent")
        if not self._is_primary and not orders.rules.has_secondary:
            orders.not_supported("knows no secondary control")
        self._was_entered = True
        self._claimed = Claim(orders.manager_id, orders.parameter, is_primary=self._is_primary)
        orders.claims.add(self._claimed)
        word = self._last_word()
        since = self._talk.connection.now()
        try:
            await self._claim()
            await self._be_told(since)
        except (CommandRejected, NotSupported, BusyError):  # we have nothing of it
            self._end()
            if self._claimed.owes_release:
                word.leave()
            raise
        except BaseException:
            self._end()
            word.leave()
            raise
        return self

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._taken is not None:
            self._end()
            if exc is None and not self._was_told:
                self.raise_if_taken()
            return
        if self._is_ended:  # with the block of the vehicle
            return
        word = self._last_word()
        self._end()
        if exc is None:
            await word.say(f"{self._orders.name}: giving control back")
        else:
            word.leave()

    async def _claim(self) -> None:
        orders = self._orders
        params = orders.configure(is_primary=self._is_primary)
        try:
            await orders.give(None, CONFIGURE, *params)
        except CommandRejected as error:
            if error.result == MavResult.UNSUPPORTED:
                orders.not_supported("has no gimbal manager, whose control could be taken")
            raise

    async def _be_told(self, since: float) -> None:
        """Until GIMBAL_MANAGER_STATUS says that we have it; an older one does not count."""
        orders, talk = self._orders, self._talk
        cell = orders.shown.controllers
        if orders.manager_id == talk.component_id:
            self._detach.append(talk.rates.want(GimbalManagerStatus, STATUS_HZ, is_optional=True))

        async def wait(seconds: float) -> None:
            await cell.wait_until(
                lambda each: self._of(each) == orders.us and cell.updated_at >= since,
                timeout=seconds,
                description=f"{orders.name}: being told that we are in control",
            )

        try:
            await wait(TOLD_S)
        except OperationTimeout:
            orders.ask_in_background(GimbalManagerStatus.ID)
            await wait(CONFIRMED_S - TOLD_S)
        device = orders.device
        if self._is_primary in device.controls:
            raise BusyError(f"{orders.name}: this program is in control of it already")
        device.controls[self._is_primary], self._device = self, device
        self._detach.append(device.controllers.observe(self._on_controllers, every_arrival=True))
        orders.bridge.on_finish.append(self._finish)

    def _on_controllers(self, _: GimbalControllers | None, now: GimbalControllers) -> None:
        whose = self._of(now)
        if whose == self._orders.us or self._taken is not None:
            return
        text = f"{whose[0]}/{whose[1]} has it now" if whose != (0, 0) else "nobody has it now"
        self._taken = GimbalTaken(
            f"{self._orders.name}: control was lost: {text}", system_id=whose[0], component_id=whose[1]
        )
        device_id = 0 if self._device is None else self._device.device_id
        self._talk.publish(GimbalControlLost, device_id, self._is_primary, *whose)
        self._lost.set()

    def _of(self, controllers: GimbalControllers) -> tuple[int, int]:
        return controllers.primary if self._is_primary else controllers.secondary

    def _last_word(self) -> LastWord:
        """Given back, unless it was taken meanwhile, or is claimed again by this program: then by that block."""
        orders = self._orders
        params = orders.configure(is_primary=self._is_primary, release=True)
        return LastWord(orders, CONFIGURE, params, self._is_release_meant)

    def _is_release_meant(self) -> bool:
        return self._taken is None and self._orders.claims.may_give_back(self._claimed)

    def _finish(self) -> None:
        """The block of the vehicle is left."""
        word = self._last_word()
        self._end()
        word.leave()

    def _end(self) -> None:
        self._is_ended = True
        self._lost.set()
        self._orders.claims.end(self._claimed)
        if self._device is not None and self._device.controls.get(self._is_primary) is self:
            del self._device.controls[self._is_primary]
        if self._finish in self._orders.bridge.on_finish:
            self._orders.bridge.on_finish.remove(self._finish)
        for each in self._detach:
            each()
        self._detach.clear()


def _anew(error: GimbalTaken) -> GimbalTaken:
    return GimbalTaken(str(error), system_id=error.system_id, component_id=error.component_id)
