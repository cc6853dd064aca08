"""A simulated copter on a real socket, run by a thread of its own: what blocking programs are tested against."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import asynccontextmanager, contextmanager
from typing import TYPE_CHECKING, Any

from anyio.from_thread import start_blocking_portal

from aerokit.sim import SimulatedCopter, open_simulator
from aerokit.sim.kinds import wait_longer

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Sequence

SPEEDUP = 20.0


def complaints(stderr: str) -> str:
    """What a program wrote to standard error, without the warning that this machine kept its event loop waiting."""
    return re.sub(r"the event loop was blocked for .*\n", "", stderr)


@contextmanager
def served_copter(*addresses: str, speedup: float = SPEEDUP, **options: Any) -> Iterator[str]:
    """A copter that is ready when it is switched on; gives the address to connect to."""
    options.setdefault("boot_time_s", 0.0)
    with served([SimulatedCopter(**options)], *addresses, speedup=speedup) as address:
        yield address


@contextmanager
def served(copters: Sequence[SimulatedCopter], *addresses: str, speedup: float = SPEEDUP) -> Iterator[str]:
    """Serve copters on addresses (by default one TCP port); gives the first address, as a client spells it.

    They wait for us by our clock: ten seconds of theirs pass quickly, and this machine may be busy.
    """
    wait_longer(copters, speedup)

    @asynccontextmanager
    async def serve() -> AsyncIterator[str]:
        async with open_simulator(
            copters, *(addresses or ["tcpin:127.0.0.1:0"]), speedup=speedup
        ) as simulator:
            yield simulator.addresses[0].replace("tcpin:", "tcp:")

    with start_blocking_portal() as portal, portal.wrap_async_context_manager(serve()) as address:
        yield address
