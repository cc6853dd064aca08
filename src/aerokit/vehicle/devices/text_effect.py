"""Effects that a vehicle reports by status text only."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

from aerokit.vehicle.commanding.order import SUPERSEDED
from aerokit.vehicle.commanding.progress import await_progress

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from aerokit.vehicle.commanding.context import VehicleContext
    from aerokit.vehicle.commanding.order import Order


async def await_text(
    context: VehicleContext,
    name: str,
    texts: list[str],
    is_done: Callable[[str, float], bool],
    *,
    is_refusal: Callable[[str], bool] = lambda _: False,
    order: Order,
    timeout: float,
) -> None:
    """Wait for a status text that reports the effect: ``is_done(text, seconds since the call)``.

    Raises:
        OperationRejected: a refusal was received, or the order was superseded.
        HeartbeatTimeout: the vehicle was silent for ten seconds.
        OperationTimeout: there was no such text in time.
    """
    now = context.session.connection.now
    started = now()

    def trouble() -> str | None:
        if not order.is_newest:
            return SUPERSEDED
        return next((f"the vehicle reports {text!r}" for text in texts if is_refusal(text)), None)

    await await_progress(
        context.session,
        name,
        is_done=lambda: any(is_done(text, now() - started) for text in texts),
        trouble=trouble,
        describe=lambda: "no status text reported it",
        timeout=timeout,
    )


@contextmanager
def collected_texts(context: VehicleContext) -> Iterator[list[str]]:
    """Collect the status texts of the vehicle for the duration of the block, which sends the order."""
    texts: list[str] = []
    cell = context.session.telemetry.status_text
    detach = cell.observe(lambda _, text: texts.append(text.text), every_arrival=True)
    try:
        yield texts
    finally:
        detach()
