"""Orders to one camera: given once where a second time would be harm, and at the ends of blocks."""

from __future__ import annotations

import math
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import anyio

from aerokit.errors import AerokitError, CommandRejected, CommandTimeout
from aerokit.protocols.command import command_long, command_name
from aerokit.vehicle.commanding.order import OVERRULED

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator

    from aerokit.vehicle.commanding.context import Bridge
    from aerokit.vehicle.commanding.order import Order, SentCommand, Topic
    from aerokit.vehicle.components.component import Component
    from aerokit.vehicle.session.session import Talk

SENT = 8
"""An order that must not be given twice goes out so often at most, each time because the one before was lost."""


class _Standing:
    """Whether a command to a camera may be sent again: to one that has told of itself.

    One with a component id of its own must have been heard since the order: HEARTBEAT of the autopilot is none of its.
    """

    def __init__(self, line: Ordering, sent: SentCommand) -> None:
        self._line, self._sent = line, sent

    @property
    def end(self) -> str:
        """Why it must not be sent again, as a clause; empty while it may."""
        return self._sent.end

    @property
    def told_at(self) -> float:
        """When the camera last told of itself, of a vehicle that is not silent either."""
        return self._sent.told_at if self._line.is_behind else self._line.heard_at()


class Ordering:
    """What a line to a camera gives orders by."""

    _bridge: Bridge
    _talk: Talk
    _component: Component | None

    @property
    def is_behind(self) -> bool:
        """Whether the autopilot speaks for it."""
        raise NotImplementedError

    @property
    def device(self) -> int:
        """The target camera id in commands."""
        raise NotImplementedError

    @property
    def component(self) -> Component:
        """What it is reached by; only once it is found."""
        assert self._component is not None
        return self._component

    def heard_at(self) -> float:
        """When its own HEARTBEAT came last; never, while the vehicle is silent."""
        heard_at = self._talk.connection.heard_at(self._talk.system_id, self.component.component_id)
        return heard_at if self._bridge.arbiter.is_known else -math.inf

    @property
    def on_finish(self) -> list[Callable[[], None]]:
        """What is to be sent when the vehicle's block ends, without waiting."""
        return self._bridge.on_finish

    def topic(self, subject: str) -> Topic:
        """What orders to this camera are about; the same for all objects of it."""
        return ("camera", self.component.component_id, self.device, subject)

    def begin(self, subject: str) -> Order:
        """A new order about this; withdrawn, it lets the one before count again."""
        return self._bridge.arbiter.of_device(self.topic(subject), may_be_withdrawn=True)

    def latest(self, subject: str) -> Order | None:
        """The newest order about this that was not withdrawn."""
        return self._bridge.arbiter.latest(self.topic(subject))

    @contextmanager
    def giving(self, subject: str) -> Iterator[Order]:
        """A new order about this is given, for the time of the block; one that fails lets those before count again."""
        given = self.begin(subject)
        try:
            yield given
        except BaseException:
            given.withdraw()
            raise
        given.settle()

    async def order(self, command: int, *params: float, given: Order | None = None, **options: Any) -> None:
        """A command that changes something; sent again as docs/reliability.md has it.

        ``given`` is the order that it is of, if a newer one about the same may end it.
        """
        if given is not None and not given.is_newest:
            raise CommandTimeout(f"{command_name(command)} was not sent: {OVERRULED}")
        if given is not None and not self._talk.is_closed:
            given.is_given = True
        talk, started = self._talk, self._talk.connection.now()
        arbiter = self._bridge.arbiter
        with arbiter.aside(given) as order, arbiter.sending(order) as sent:
            try:
                await talk.commands.send_long(
                    command,
                    *params,
                    component_id=self.component.component_id,
                    standing=_Standing(self, sent),
                    **options,
                )
            except CommandRejected as error:
                await talk.settle()
                raise talk.explained(error, started) from None

    async def order_once(
        self,
        given: Order,
        send: Callable[[], Awaitable[None]],
        has_worked: Callable[[], Awaitable[bool | None]],
    ) -> None:
        """An order that must not be given twice: again only when the camera, asked after it, has done nothing.

        ``has_worked`` asks; None is no answer, and then nobody knows. A newer order is not undone.
        """
        for sent in range(1, SENT + 1):
            try:
                await send()
                return
            except CommandTimeout as error:
                if not given.is_newest:
                    raise CommandTimeout(f"{error}; not sent again: {OVERRULED}") from None
                worked = await has_worked()
                if not given.is_newest:
                    raise CommandTimeout(f"{error}; not sent again: {OVERRULED}") from None
                if worked:
                    return
                if worked is None or sent == SENT:
                    raise

    def order_now(self, command: int, *params: float) -> None:
        """Send a command once and do not wait: for ends of blocks, which must not await."""
        if self._component is None or self._talk.is_closed or not self._talk.connection.is_open:
            return
        target = self._component.component_id
        self._talk.connection.send(command_long(self._talk.system_id, target, command, params))

    async def finish(self, given: Order, command: int, *params: float, is_awaited: bool) -> None:
        """The end of a block: the command leaves at once, and is sent again beside the program until it is answered.

        Not if a newer order about the same was given meanwhile. Raises, if ``is_awaited``, what :meth:`order` does.
        """
        if not given.is_newest or self._talk.is_closed:
            return
        answered, errors = anyio.Event(), []

        async def insist() -> None:
            try:
                if given.is_newest:
                    await self.order(command, *params, given=given, is_sent=True)
            except AerokitError as error:
                if given.is_newest:
                    errors.append(error)
            finally:
                answered.set()

        self.order_now(command, *params)
        self._talk.background.start(insist, "aerokit end of a camera's block")
        if not is_awaited:
            return
        await answered.wait()
        if errors:
            raise errors[0]
