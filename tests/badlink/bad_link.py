"""A simulated vehicle behind a bad radio, and the cost of one transfer over it, on virtual time.

`attempt` runs one transfer and returns an `Attempt`: its outcome, its duration, the messages sent, and the state left
on either side.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import anyio
from flight_harness import Wire, attached_sinks, make_parts, waiting_on_cells

import aerokit
from aerokit import messages as m
from aerokit.sim import SimulatedVehicle, simulated_link
from aerokit.testing import FaultModel, FaultyLink, run_virtual

DELAY_S = 0.05
PERFECT = FaultModel(delay_s=DELAY_S)
GRACE_S = 15.0
"""Maximum time for the background work of a transfer whose messages get lost."""

OWN_LIFE = (m.Heartbeat, m.CommandLong, m.Timesync, m.Ping)
"""Messages that a program sends anyway."""


@dataclass(frozen=True)
class Radio:
    """A kind of radio. Both directions are alike unless stated otherwise."""

    name: str
    model: FaultModel = PERFECT
    half_duplex: bool = False
    port_bytes_per_s: float | None = None
    """Rate that the vehicle assumes for its port; None: flow control."""
    outage_after_s: float | None = None
    """Seconds from the beginning of the transfer, after which nothing gets through."""
    outage_s: float = 0.0
    """Length of the outage; infinite: the link fails for good."""

    def with_loss(self, share: float) -> Radio:
        return replace(self, model=self.model.replace(loss=share))


WIDE = Radio("50 ms each way")
"""A network: the vehicle's own pace is what limits it."""
NARROW = Radio(
    "57,600 baud, half duplex",
    FaultModel(delay_s=DELAY_S, bandwidth=5760.0, queue_bytes=4000.0),
    half_duplex=True,
    port_bytes_per_s=5760.0,
)
"""A telemetry radio: one frequency for both directions, and a queue that overflows."""


@dataclass
class Program:
    """Objects with which a transfer is run."""

    vehicle: aerokit.Vehicle
    simulated: Any
    wire: Wire
    radio: FaultyLink
    opened_at: float
    known: Any = None
    """Result of the preparation, while the radio was good."""

    def degrade(self, radio: Radio) -> None:
        """Apply the faults of the bad radio from now on."""
        model = radio.model
        if radio.outage_after_s is not None:
            begin = asyncio.get_running_loop().time() - self.opened_at + radio.outage_after_s
            model = model.replace(outages=((begin, begin + radio.outage_s),))
        self.radio.outgoing.model = self.radio.incoming.model = model


@dataclass
class Attempt:
    """Result of one transfer."""

    seed: int
    error: Exception | None
    value: Any
    seconds: float
    sent: Counter[str] = field(default_factory=Counter)
    received: int = 0
    left: list[str] = field(default_factory=list)

    @property
    def messages(self) -> int:
        return sum(self.sent.values())


Work = Callable[[Program], Awaitable[Any]]


def attempt(
    work: Work,
    radio: Radio,
    seed: int,
    make_vehicle: Callable[[], SimulatedVehicle],
    *,
    before: Work | None = None,
    timeout_s: float = 900.0,
    leftovers: Callable[[Any], Iterator[str]] = lambda simulated: iter(()),
) -> Attempt:
    """Run one transfer. The radio turns bad when the vehicle is connected and ``before`` has run.

    ``leftovers`` returns names of the state that the vehicle kept.
    """
    return run_virtual(_attempt(work, radio, seed, make_vehicle(), before, timeout_s, leftovers))


async def _attempt(
    work: Work,
    radio: Radio,
    seed: int,
    simulated: SimulatedVehicle,
    before: Work | None,
    timeout_s: float,
    leftovers: Callable[[Any], Iterator[str]],
) -> Attempt:
    loop = asyncio.get_running_loop()
    async with open_program(simulated, seed, half_duplex=radio.half_duplex) as program:
        if before is not None:
            await before(program)
        held = _held(program)
        program.degrade(radio)
        program.wire.clear()
        received_before, begun = program.radio.incoming.frames, loop.time()
        outcome = Attempt(seed, None, None, 0.0)
        try:
            with anyio.fail_after(timeout_s):
                outcome.value = await work(program)
        except Exception as error:
            outcome.error = error
        outcome.seconds = loop.time() - begun
        outcome.received = program.radio.incoming.frames - received_before
        outcome.left = await _remaining_state(program, held, leftovers)
        outcome.sent = Counter(
            type(message).NAME for _, message in program.wire.sent if not isinstance(message, OWN_LIFE)
        )
    return outcome


@asynccontextmanager
async def open_program(
    simulated: SimulatedVehicle, seed: int = 0, *, half_duplex: bool = False
) -> AsyncIterator[Program]:
    """Open a connected program: capabilities known, no streams but the vehicle's own, the radio still good."""
    async with simulated_link(simulated) as link:
        radio = FaultyLink(link, PERFECT, seed=seed, half_duplex=half_duplex)
        opened_at = asyncio.get_running_loop().time()
        wire = Wire(radio)
        async with aerokit.connect(wire, rates={}, system_id=simulated.system_id) as vehicle:
            await vehicle.version.wait_until(lambda _: True)
            await anyio.sleep(0.5)
            make_parts(vehicle)
            yield Program(vehicle, simulated, wire, radio, opened_at)


def _held(program: Program) -> tuple[int, int, int, int]:
    connection = program.vehicle.connection
    return (
        attached_sinks(connection),
        waiting_on_cells(program.vehicle),
        len(connection.deadlines._deadlines),
        len(asyncio.all_tasks()),
    )


async def _remaining_state(
    program: Program, held: tuple[int, ...], leftovers: Callable[[Any], Iterator[str]]
) -> list[str]:
    """Close at once if possible; the radio is still bad, and closing needs it."""
    names = ("sinks", "waiters", "deadlines", "tasks")
    until = asyncio.get_running_loop().time() + GRACE_S
    while True:
        left = [
            f"{now - then} {name}" for name, then, now in zip(names, held, _held(program), strict=True) if now > then
        ]
        left += leftovers(program.simulated)
        if not left or asyncio.get_running_loop().time() >= until:
            return left
        await anyio.sleep(0.1)
