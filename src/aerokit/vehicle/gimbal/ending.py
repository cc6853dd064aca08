"""`LastWord`: the command with which a block about a gimbal ends, however it is left."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import TYPE_CHECKING

from aerokit.errors import AerokitError, CommandTimeout, OperationTimeout
from aerokit.mavlink.messages import Heartbeat
from aerokit.runtime.link_state import SILENT_AFTER_S

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.vehicle.gimbal.orders import GimbalOrders

__all__ = ["LastWord"]

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
        if not self._orders.bridge.helm.is_known:
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
        is_sent = self._orders.bridge.helm.is_known
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
        with self._orders.bridge.helm.aside() as order:
            await self._orders.bridge.orders.give(
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
