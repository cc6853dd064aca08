"""An exchange on the loop: its messages, its time and its end, on virtual time."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

import anyio
import pytest
from flight_harness import block_loop

from aerokit import open_connection
from aerokit.connection.connection import Connection
from aerokit.connection.exchanges import run_exchange
from aerokit.errors import CommandTimeout, ConnectionClosed, InvalidArgument, LinkLost
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import Attitude, CommandAck, CommandLong, Heartbeat, Ping
from aerokit.protocols.exchange import Exchange
from aerokit.transport import MemoryLink, Peer, memory_link_pair

pytestmark = pytest.mark.anyio

SYSTEM = 1


class Counting(Exchange[int]):
    """Sends a request every second until enough answers arrived; fails after five requests."""

    expects = (Attitude,)

    def __init__(self, answers: int = 1, question: Message | None = None) -> None:
        super().__init__()
        self.question = question or Ping(0, 0, SYSTEM, 1)
        self.answers, self.received, self.asked = answers, 0, 0

    def start(self, now: float) -> None:
        self._ask(now)

    def receive(self, message: Message, now: float) -> None:
        self.received += 1
        if self.received >= self.answers:
            self._finish(self.received)

    def expire(self, now: float) -> None:
        if self.asked == 5:
            self._fail(CommandTimeout("asked five times"))
        else:
            self._ask(now)

    def _ask(self, now: float) -> None:
        self.asked += 1
        self._outbox.append(self.question)
        self.deadline = now + 1.0


class FarEnd:
    """The other end of the link: receives requests, and answers on demand."""

    def __init__(self, link: MemoryLink) -> None:
        self.link = link
        self.questions: list[float] = []
        self._encoder = FrameEncoder(SYSTEM, 1)

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        for frame in Framer().receive(data):
            if isinstance(STANDARD.decode(frame), Ping):
                self.questions.append(anyio.current_time())

    def link_lost(self, error: LinkLost) -> None:
        """Ignore it."""

    def answer(self, system_id: int = SYSTEM) -> None:
        encoder = self._encoder if system_id == SYSTEM else FrameEncoder(system_id, 1)
        self.link.write(encoder.encode(Attitude(0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)))


class Pair:
    """A connection and its far end."""

    def __init__(self, connection: Connection, far: FarEnd) -> None:
        self.connection, self.far = connection, far
        self.before = self.attached()

    def attached(self) -> tuple[int, int, int]:
        sinks = sum(len(sinks) for sinks in self.connection.bus._sinks.values())
        return sinks, len(self.connection._end_signal._callbacks), len(self.connection.deadlines._deadlines)

    async def run(self, exchange: Exchange[int]) -> int:
        return await run_exchange(self.connection, SYSTEM, exchange)


@pytest.fixture
async def pair(anyio_backend: object) -> AsyncIterator[Pair]:
    near, link = memory_link_pair()
    far = FarEnd(link)
    await link.open(far)
    async with open_connection(near) as connection:
        pair = Pair(connection, far)
        yield pair
        assert pair.attached() == (pair.before if connection.is_open else (1, 0, 0))
    link.close()


def later(seconds: float, action: object) -> None:
    assert callable(action)
    asyncio.get_running_loop().call_later(seconds, action)


async def test_request_is_repeated_at_deadlines_until_answered(pair: Pair) -> None:
    started = anyio.current_time()
    later(2.5, pair.far.answer)
    assert await pair.run(Counting()) == 1
    assert pair.far.questions == pytest.approx([started, started + 1, started + 2])
    assert anyio.current_time() == pytest.approx(started + 2.5)
    await anyio.sleep(5)
    assert len(pair.far.questions) == 3


async def test_run_ends_when_the_exchange_fails(pair: Pair) -> None:
    started = anyio.current_time()
    with pytest.raises(CommandTimeout, match="five times"):
        await pair.run(Counting())
    assert anyio.current_time() == pytest.approx(started + 5)
    assert len(pair.far.questions) == 5


async def test_exchange_without_deadline_is_not_called(pair: Pair) -> None:
    class Pausing(Counting):
        def receive(self, message: Message, now: float) -> None:
            super().receive(message, now)
            self.deadline = None

    later(0.5, pair.far.answer)
    later(5.0, pair.far.answer)
    assert await pair.run(Pausing(answers=2)) == 2
    assert len(pair.far.questions) == 1


async def test_ended_exchange_has_no_deadline(pair: Pair) -> None:
    """The answer and the deadline wait for a loop that was blocked; the answer comes first."""
    exchange = Counting()

    def answer_and_block() -> None:
        pair.far.answer()
        block_loop(1.0)

    later(0.5, answer_and_block)
    assert await pair.run(exchange) == 1
    assert exchange.asked == 1


async def test_messages_of_other_systems_are_ignored(pair: Pair) -> None:
    later(0.5, lambda: pair.far.answer(2))
    exchange = Counting()
    with pytest.raises(CommandTimeout):
        await pair.run(exchange)
    assert exchange.received == 0


async def test_concurrent_exchanges_end_separately(pair: Pair) -> None:
    results: dict[int, int] = {}

    async def run(answers: int) -> None:
        results[answers] = await pair.run(Counting(answers))

    async with anyio.create_task_group() as tasks:
        for answers in (1, 2, 3):
            tasks.start_soon(run, answers)
        await anyio.sleep(0.1)
        for expected in ({1: 1}, {1: 1, 2: 2}, {1: 1, 2: 2, 3: 3}):
            pair.far.answer()
            await anyio.sleep(0.1)
            assert results == expected


@pytest.mark.parametrize("seconds", [0.0, 0.5, 1.0, 1.5])
async def test_cancelled_exchange_sends_nothing_more(pair: Pair, seconds: float) -> None:
    started = anyio.current_time()
    with anyio.move_on_after(seconds) as scope:
        await pair.run(Counting())
    assert scope.cancelled_caught
    assert anyio.current_time() == pytest.approx(started + seconds)
    asked = len(pair.far.questions)
    await anyio.sleep(3)
    assert len(pair.far.questions) <= asked + 1  # one may already have been sent
    assert pair.attached() == pair.before


async def test_end_of_connection_ends_exchange(pair: Pair) -> None:
    later(0.5, pair.connection.close)
    with pytest.raises(ConnectionClosed):
        await pair.run(Counting())
    with pytest.raises(ConnectionClosed):
        await pair.run(Counting())
    assert len(pair.far.questions) == 1


async def test_lost_link_ends_exchange(pair: Pair) -> None:
    later(1.5, pair.far.link.close)
    with pytest.raises(LinkLost):
        await pair.run(Counting())


async def test_unsendable_message_is_raised_at_once(pair: Pair) -> None:
    """The error is raised for a later message as well; there is no other way to report it."""
    nonsense = CommandLong(300, 1, 400, 0, *(0.0,) * 7)
    with pytest.raises(InvalidArgument, match="target_system"):
        await pair.run(Counting(question=nonsense))
    exchange = Counting()
    later(0.5, lambda: setattr(exchange, "question", nonsense))
    started = anyio.current_time()
    with pytest.raises(InvalidArgument, match="target_system"):
        await pair.run(exchange)
    assert anyio.current_time() == pytest.approx(started + 1)


async def test_exception_at_deadline_is_raised_in_result(pair: Pair) -> None:
    class Broken(Counting):
        def expire(self, now: float) -> None:
            raise ZeroDivisionError("ours")

    with pytest.raises(ZeroDivisionError):
        await pair.run(Broken())


async def test_exception_in_receive_does_not_stop_deadlines(pair: Pair) -> None:
    class Broken(Counting):
        def receive(self, message: Message, now: float) -> None:
            raise ZeroDivisionError("ours")

    later(0.5, pair.far.answer)
    with pytest.raises(CommandTimeout):
        await pair.run(Broken())


async def test_unexpected_messages_are_not_decoded(pair: Pair) -> None:
    assert set(pair.connection.bus.wanted) == {Heartbeat.ID}
    task = asyncio.ensure_future(pair.run(Counting()))
    await anyio.sleep(0.1)
    assert set(pair.connection.bus.wanted) == {Heartbeat.ID, Attitude.ID}
    assert CommandAck.ID not in pair.connection.bus.wanted
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task


async def test_failed_attachment_leaves_nothing_attached(pair: Pair) -> None:
    exchange = Counting()
    exchange.expects = (Attitude, None)  # type: ignore[assignment]
    with pytest.raises(AttributeError):
        await pair.run(exchange)
    assert Attitude.ID not in pair.connection.bus.wanted
