"""``GimbalControl``: control of a gimbal for the time of a block."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from aerokit.arguments import checks_arguments
from aerokit.errors import (
    BusyError,
    CommandRejected,
    GimbalTaken,
    NotSupported,
    OperationRejected,
    OperationTimeout,
)
from aerokit.mavlink.enums import MavResult
from aerokit.mavlink.messages import GimbalManagerStatus
from aerokit.runtime.events import GimbalControlLost
from aerokit.vehicle.gimbal.claims import Claim
from aerokit.vehicle.gimbal.ending import LastWord
from aerokit.vehicle.gimbal.orders import CONFIGURE, GimbalOrders
from aerokit.vehicle.orders.newest import Newest

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import TracebackType

    from typing_extensions import Self

    from aerokit.vehicle.gimbal.device import Device
    from aerokit.vehicle.gimbal.values import GimbalControllers

__all__ = ["GimbalControl"]

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
            await orders.give(Newest(orders.bridge.helm).begin(), CONFIGURE, *params)
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
