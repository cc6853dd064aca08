"""Several orders at once, some cancelled, on a bad link: only the newest is sent, and none after a pilot's takeover."""

from __future__ import annotations

import asyncio
import math
import os
import random
from collections.abc import Awaitable, Callable, Hashable
from contextlib import suppress
from dataclasses import dataclass

import anyio
import pytest
from disturbed_link import Disturbances, DisturbedLink, TrafficEntry
from order_flights import RATES, Simulated, mode_of, take_over

import aerokit
from aerokit.errors import AerokitError
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import CommandInt, CommandLong, SetPositionTargetLocalNed
from aerokit.sim import SimulatedCopter, SimulatedPx4, simulated_link
from aerokit.testing import run_virtual
from aerokit.vehicle.commanding.arbiter import MODE_GRACE_S

SEEDS = int(os.environ.get("AEROKIT_ORDER_SEEDS", "2"))
COMMANDS = (176, 192, 400, 20)


def kind_of(message: Message) -> Hashable:
    """Return the subject of a message; None if it neither steers nor arms."""
    if isinstance(message, SetPositionTargetLocalNed):
        return "set-point"
    if isinstance(message, CommandInt):
        return "place" if message.command == 192 else None
    if not isinstance(message, CommandLong) or message.command not in (20, 115, 176, 192, 400):
        return None
    if message.command == 176:
        return "mode", int(message.param2), int(message.param3)
    if message.command == 192:
        return "stop" if math.isnan(message.param4) else "turn"
    return message.command, int(message.param1) if message.command == 400 else 0


@dataclass(frozen=True)
class Choice:
    """An order of a program, and its messages on ArduCopter and on PX4; no messages mean that it does not steer."""

    name: str
    give: Callable[[aerokit.Vehicle], Awaitable[object]]
    sends: tuple[set[Hashable], set[Hashable]] = (set(), set())


async def _stream(vehicle: aerokit.Vehicle) -> None:
    async with vehicle.guided.velocity() as stream:
        await stream.fly(aerokit.VelocitySetpoint(north_m_s=1.0), 3.0)


GUIDED = ("mode", 4, 0)
HOLD: tuple[set[Hashable], set[Hashable]] = ({("mode", 17, 0)}, {"stop", ("mode", 4, 3)})
CHOICES = (
    Choice("hold", lambda v: v.hold(), HOLD),
    Choice("land", lambda v: v.land(), ({("mode", 9, 0)}, {("mode", 4, 6)})),
    Choice("return", lambda v: v.return_to_launch(), ({("mode", 6, 0)}, {("mode", 4, 5)})),
    Choice("go_to", lambda v: v.go_to(v.position.value.offset(north_m=9)), ({"place"}, {"place"})),
    Choice("set_mode", lambda v: v.set_mode("LOITER"), ({("mode", 5, 0)}, {("mode", 4, 3)})),
    Choice("set_heading", lambda v: v.set_heading(90), ({(115, 0), GUIDED}, {"turn"})),
    Choice("stream", _stream, ({"set-point", GUIDED}, {"set-point", ("mode", 6, 0)})),
    Choice("command", lambda v: v.command(20), ({(20, 0)}, {(20, 0)})),
    Choice("set_speed", lambda v: v.set_speed(3)),
    Choice("arm", lambda v: v.arm()),
    Choice("disarm", lambda v: v.disarm()),
)


@dataclass
class GivenOrder:
    """An order, and how much the program had sent before it."""

    choice: Choice
    sent: int
    at: float
    abandoned_at: float = math.inf
    """Time at which the call was cancelled or raised an error."""


async def _fly(seed: int, is_px4: bool) -> None:
    dice = random.Random(f"{seed} {is_px4}")
    simulated: Simulated = SimulatedPx4(boot_time_s=1.0) if is_px4 else SimulatedCopter(boot_time_s=0.0)
    given: list[GivenOrder] = []
    async with simulated_link(simulated) as link:
        path = DisturbedLink(link)
        async with aerokit.connect(path, rates=RATES) as vehicle:
            await _climb(simulated, vehicle)
            path.disturbances = _disturbances(dice)
            path.begin()
            taken_at = dice.choice((None, dice.uniform(0.1, 5.0)))
            if taken_at is not None:
                asyncio.get_running_loop().call_later(taken_at, take_over, simulated)
            await _give_orders(dice, vehicle, path, given)
            await anyio.sleep(15.0)
    pilots = {2} if not is_px4 else {3 << 16}
    takeover = next(
        (heartbeat for heartbeat in path.heartbeats if getattr(heartbeat.message, "custom_mode", 0) in pilots), None
    )
    story = f"seed {seed}: {[(round(order.at - path.began_at, 2), order.choice.name) for order in given]}"
    for place, crossing in enumerate(path.sent):
        _judge(crossing, [order for order in given if order.sent <= place], takeover, is_px4, story)


async def _climb(simulated: Simulated, vehicle: aerokit.Vehicle) -> None:
    await vehicle.wait_ready()
    if isinstance(simulated, SimulatedCopter):
        simulated.rc[2] = 1500
        await vehicle.set_mode("GUIDED")
    await vehicle.arm()
    await vehicle.take_off(10.0)
    await anyio.sleep(2.5)
    assert mode_of(simulated) in ("GUIDED", "LOITER")


def _disturbances(dice: random.Random) -> Disturbances:
    disturbances = Disturbances(
        command=dice.choice(COMMANDS),
        lost_acks=dice.choice((0, 1, 9)),
        lost_commands=dice.choice((0, 1, 2)),
        latency_s=dice.choice((0.01, 0.2)),
    )
    if dice.random() < 0.3:
        begin = dice.uniform(0.0, 4.0)
        disturbances.outage = begin, begin + dice.uniform(1.0, 8.0)
    return disturbances


async def _give_orders(
    dice: random.Random, vehicle: aerokit.Vehicle, path: DisturbedLink, given: list[GivenOrder]
) -> None:
    async def give(choice: Choice) -> None:
        now = asyncio.get_running_loop().time
        order = GivenOrder(choice, len(path.sent), now())
        given.append(order)
        with suppress(AerokitError):
            try:
                await choice.give(vehicle)
            except BaseException:
                order.abandoned_at = now()
                raise

    tasks: list[asyncio.Task[None]] = []
    for _ in range(dice.randint(2, 6)):
        await anyio.sleep(dice.choice((0.0, 0.01, 0.1, 0.5, 1.0)))
        tasks.append(asyncio.ensure_future(give(dice.choice(CHOICES))))
        if dice.random() < 0.3:
            dice.choice(tasks).cancel()
    await anyio.sleep(25.0)
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


def _judge(
    sent: TrafficEntry, given: list[GivenOrder], takeover: TrafficEntry | None, is_px4: bool, story: str
) -> None:
    kind = kind_of(sent.message)
    if kind is None:
        return
    about = f"{kind} at {sent.at:.2f}; {story}"
    if kind in ((400, 0), (400, 1)):
        newest = [order for order in given if order.choice.name in ("arm", "disarm")][-1]
        is_wanted = newest.choice.name == ("arm" if kind == (400, 1) else "disarm") or newest.at == sent.at
        # After an abandoned arm(), aerokit disarms the vehicle.
        is_cleanup = kind == (400, 0) and newest.abandoned_at <= sent.at
        assert is_wanted or is_cleanup, f"against the newer {newest.choice.name}(): {about}"
        return
    steering = [order for order in given if order.choice.sends[is_px4]]
    newest = steering[-1]
    eager = [order for order in steering if order.at == newest.at]
    allowed = HOLD[is_px4].union(*(order.choice.sends[is_px4] for order in eager))
    assert kind in allowed, f"a superseded order: {about}"
    is_against_the_pilot = takeover is not None and newest.at < takeover.at and sent.number > takeover.number
    own = [order.at for order in given if order.choice.name == "command"]
    if takeover is not None and own and takeover.at - own[-1] < MODE_GRACE_S:
        return  # Any mode change counts as an effect of the raw command (docs/reliability.md).
    assert kind == "set-point" or not is_against_the_pilot, f"after the pilot had taken over: {about}"


@pytest.mark.sampled(30)
@pytest.mark.parametrize("is_px4", [False, True], ids=["ardupilot", "px4"])
@pytest.mark.parametrize("seed", range(4 * SEEDS))
def test_posted_orders_only_newest_is_sent(seed: int, is_px4: bool) -> None:
    run_virtual(_fly(seed, is_px4))
