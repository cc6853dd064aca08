"""Effects that a vehicle reports by status text only."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

from aerokit.vehicle.commanding.progress import await_progress

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from aerokit.vehicle.commanding.context import VehicleContext
    from aerokit.vehicle.commanding.order import Order
    from aerokit.vehicle.state.condition import StatusText


class TextWatch:
    """Status texts received since an order was given; see :func:`watch_texts`."""

    def __init__(self, context: VehicleContext, name: str) -> None:
        self._context, self._name = context, name
        self.texts: list[str] = []

    def on_text(self, _: StatusText | None, text: StatusText) -> None:
        self.texts.append(text.text)

    async def wait(
        self,
        is_done: Callable[[str], bool],
        *,
        refused: Callable[[str], bool] = lambda _: False,
        begun: Callable[[str], bool] = lambda _: False,
        begun_for_s: float = 0.0,
        order: Order | None = None,
        timeout: float,
    ) -> None:
        """Wait for a text that reports the effect.

        A text for which ``begun`` is true will do if ``begun_for_s`` seconds have passed since.

        Raises:
            OperationRejected: a text for which ``refused`` is true was received, or the order was superseded.
            HeartbeatTimeout: the vehicle was silent for ten seconds.
            OperationTimeout: there was no such text in time.
        """
        session = self._context.session
        started = session.connection.now()

        def done() -> bool:
            if any(map(is_done, self.texts)):
                return True
            return any(map(begun, self.texts)) and session.connection.now() - started >= begun_for_s

        def trouble() -> str | None:
            if order is not None and not order.is_newest:
                return "another order was given"
            return next((f"the vehicle reports {text!r}" for text in self.texts if refused(text)), None)

        await await_progress(
            session,
            self._name,
            is_done=done,
            trouble=trouble,
            describe=lambda: "no status text reported it",
            timeout=timeout,
        )


@contextmanager
def watch_texts(context: VehicleContext, name: str) -> Iterator[TextWatch]:
    """Collect the status texts of the vehicle for the duration of the block, which sends the order."""
    watch = TextWatch(context, name)
    detach = context.session.telemetry.status_text.observe(watch.on_text, every_arrival=True)
    try:
        yield watch
    finally:
        detach()
