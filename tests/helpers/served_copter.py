"""A simulated copter on a real socket, in a separate thread, for blocking programs."""

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


def without_loop_warnings(stderr: str) -> str:
    """Remove warnings about a blocked event loop, which depend on the load of the machine, from standard error."""
    return re.sub(r"the event loop was blocked for .*\n", "", stderr)


@contextmanager
def served_copter(*addresses: str, speedup: float = SPEEDUP, **options: Any) -> Iterator[str]:
    """Serve a copter that is ready at power-on. Yield the address to connect to.

    Its battery lasts ``speedup`` times as long, because the machine that runs the client may be busy.
    """
    options.setdefault("boot_time_s", 0.0)
    options.setdefault("battery_capacity_mah", 3300.0 * max(speedup, 1.0))
    with served([SimulatedCopter(**options)], *addresses, speedup=speedup) as address:
        yield address


@contextmanager
def served(copters: Sequence[SimulatedCopter], *addresses: str, speedup: float = SPEEDUP) -> Iterator[str]:
    """Serve copters on addresses, by default one TCP port. Yield the first address, as a client writes it.

    Time-outs of the copters are multiplied by ``speedup``, because the machine that runs the client may be busy.
    """
    scale_timeouts(copters, speedup)

    @asynccontextmanager
    async def serve() -> AsyncIterator[str]:
        async with open_simulator(copters, *(addresses or ["tcpin:127.0.0.1:0"]), speedup=speedup) as simulator:
            yield simulator.addresses[0].replace("tcpin:", "tcp:")

    with start_blocking_portal() as portal, portal.wrap_async_context_manager(serve()) as address:
        yield address
