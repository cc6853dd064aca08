"""A simulated copter on a real socket, in a thread of its own, for blocking programs."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import asynccontextmanager, contextmanager
from typing import TYPE_CHECKING, Any

from anyio.from_thread import start_blocking_portal

from aerokit.sim import SimulatedCopter, open_simulator
from aerokit.sim.kinds import scale_timeouts

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Sequence

SPEEDUP = 20.0


def complaints(stderr: str) -> str:
    """Return what a program wrote to standard error, without the warning about a blocked event loop on this machine."""
    return re.sub(r"the event loop was blocked for .*\n", "", stderr)


@contextmanager
def served_copter(*addresses: str, speedup: float = SPEEDUP, **options: Any) -> Iterator[str]:
    """A copter that is ready at power-on. Yield the address to connect to."""
    options.setdefault("boot_time_s", 0.0)
    with served([SimulatedCopter(**options)], *addresses, speedup=speedup) as address:
        yield address


@contextmanager
def served(copters: Sequence[SimulatedCopter], *addresses: str, speedup: float = SPEEDUP) -> Iterator[str]:
    """Serve copters on addresses, by default one TCP port. Yield the first address, as a client writes it.

    The copters measure time-outs by our clock, because their ten seconds pass quickly, and this machine may be busy.
    """
    scale_timeouts(copters, speedup)

    @asynccontextmanager
    async def serve() -> AsyncIterator[str]:
        async with open_simulator(copters, *(addresses or ["tcpin:127.0.0.1:0"]), speedup=speedup) as simulator:
            yield simulator.addresses[0].replace("tcpin:", "tcp:")

    with start_blocking_portal() as portal, portal.wrap_async_context_manager(serve()) as address:
        yield address
