from __future__ import annotations

import asyncio
from contextlib import suppress
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from link_harness import Recorder, each_loop, each_traffic

import aerokit
from aerokit.errors import BusyError, CommandTimeout, ConnectionClosed, InvalidArgument, LinkOpenError
from aerokit.mavlink import FrameEncoder, messages
from aerokit.sim import SimulatedCopter, simulated_link
from aerokit.testing import FaultModel, FaultyLink, run_virtual
from aerokit.testing.fault_model import Air, FaultyPath, split_frames
from aerokit.transport import Peer, UdpConnect, UdpListen, memory_link_pair
from aerokit.transport.link import BaseLink

shares = st.floats(0.0, 1.0)
seconds = st.floats(0.0, 3.0)
models = st.builds(
    FaultModel,
    loss=shares,
    duplication=shares,
    reordering=shares,
    corruption=shares,
    delay_s=seconds,
    jitter_s=seconds,
    bandwidth=st.floats(10.0, 1e9),
    queue_bytes=st.floats(1.0, 1e9),
    outages=st.lists(st.tuples(seconds, seconds).map(lambda pair: (min(pair), max(pair)))).map(tuple),
    per_frame=st.booleans(),
)
pieces = st.lists(st.tuples(st.floats(0.0, 1.0), st.binary(max_size=40)), max_size=30)


def frames(count: int, version: int = 2) -> list[bytes]:
    encoder = FrameEncoder(1, 1, version=version)
    return [encoder.encode(messages.ParamValue(f"P{n}", float(n), 9, count, n % 65536)) for n in range(count)]


def carried(path: FaultyPath, data: list[bytes], now: float = 0.0) -> list[tuple[float, bytes]]:
    return [arrival for datagram in data for arrival in path.carry(datagram, now)]


# --------------------------------------------------------------------------------------- one direction


def test_without_faults_frames_arrive_in_order() -> None:
    sent = frames(50)
    assert carried(FaultyPath(FaultModel()), sent, 3.0) == [(3.0, frame) for frame in sent]


@given(model=models, data=pieces, seed=st.integers())
def test_same_seed_gives_same_faults(model: FaultModel, data: list[tuple[float, bytes]], seed: int) -> None:
    one, two, now = FaultyPath(model, seed), FaultyPath(model, seed), 0.0
    for wait, piece in data:
        now += wait
        arrivals = one.carry(piece, now)
        assert arrivals == two.carry(piece, now)
        assert all(due >= now + model.delay_s for due, _ in arrivals)
    arrived = one.frames - one.lost - one.overflowed
    assert one.duplicated <= arrived
    assert one.corrupted <= arrived


@pytest.mark.parametrize("share", [0.05, 0.3])
@pytest.mark.parametrize("fault", ["loss", "duplication", "reordering", "corruption"])
def test_shares_are_met(fault: str, share: float) -> None:
    count = 4000
    options: dict[str, Any] = {fault: share}
    path = FaultyPath(FaultModel(**options), 1)
    sent = frames(count)
    arrived = [data for _, data in carried(path, sent)]
    observed = {
        "loss": count - len(arrived),
        "duplication": len(arrived) - count,
        "reordering": path.reordered,
        "corruption": sum(a != b for a, b in zip(sent, arrived, strict=False)) if fault == "corruption" else 0,
    }[fault]
    assert (
        observed
        == {
            "loss": path.lost,
            "duplication": path.duplicated,
            "reordering": path.reordered,
            "corruption": path.corrupted,
        }[fault]
    )
    assert observed / count == pytest.approx(share, abs=0.03)


def test_changing_one_share_keeps_other_faults() -> None:
    sent = frames(300)
    few = {data for _, data in carried(FaultyPath(FaultModel(loss=0.2), 5), sent)}
    more = {data for _, data in carried(FaultyPath(FaultModel(loss=0.2, duplication=0.5), 5), sent)}
    less = {data for _, data in carried(FaultyPath(FaultModel(loss=0.1), 5), sent)}
    assert few == more
    assert few < less


def test_jitter_keeps_order_and_reordering_does_not() -> None:
    sent = frames(200)
    path = FaultyPath(FaultModel(delay_s=0.05, jitter_s=0.1))
    due = [when for n, message in enumerate(sent) for when, _ in path.carry(message, n * 0.001)]
    assert due == sorted(due)
    path = FaultyPath(FaultModel(reordering=0.1, overtaken_s=0.02))
    due = [when for n, message in enumerate(sent) for when, _ in path.carry(message, n * 0.001)]
    assert sum(before > after for before, after in pairwise(due)) == pytest.approx(path.reordered, abs=5)


def test_bandwidth_is_a_queue_that_overflows() -> None:
    path = FaultyPath(FaultModel(bandwidth=100.0, queue_bytes=50.0, delay_s=1.0))
    arrivals = carried(path, [bytes(20)] * 10)
    assert [when for when, _ in arrivals] == pytest.approx([1.2, 1.4])  # 20 on the air, 20 wait, 20 are too many
    assert path.overflowed == 8
    assert [when for when, _ in path.carry(bytes(20), 0.4)] == pytest.approx([1.6])


def test_frame_larger_than_queue_passes_when_empty() -> None:
    path = FaultyPath(FaultModel(bandwidth=100.0, queue_bytes=50.0))
    assert [when for when, _ in path.carry(bytes(200), 0.0)] == [2.0]


def test_half_duplex_directions_take_turns() -> None:
    air = Air()
    there, back = (
        FaultyPath(FaultModel(bandwidth=100.0), air=air),
        FaultyPath(FaultModel(bandwidth=50.0), air=air),
    )
    assert [when for when, _ in there.carry(bytes(100), 0.0)] == [1.0]
    assert [when for when, _ in back.carry(bytes(50), 0.5)] == [2.0]
    assert [when for when, _ in there.carry(bytes(100), 0.5)] == [3.0]


def test_half_duplex_without_bandwidth_limit_waits() -> None:
    air = Air()
    slow, fast = FaultyPath(FaultModel(bandwidth=100.0), air=air), FaultyPath(FaultModel(), air=air)
    assert [when for when, _ in fast.carry(bytes(100), 0.5)] == [0.5]
    assert [when for when, _ in slow.carry(bytes(100), 0.5)] == [1.5]
    assert [when for when, _ in fast.carry(bytes(100), 1.0)] == [1.5]
    assert [when for when, _ in fast.carry(bytes(100), 2.0)] == [2.0]


def test_outages_count_from_start() -> None:
    path = FaultyPath(FaultModel(outages=((1.0, 2.0), (5.0, 6.0))))
    path.start(100.0)
    arrived = [when for tenth in range(80) for when, _ in path.carry(b"x", 100.0 + tenth / 10)]
    assert len(arrived) == 60
    assert not any(101.0 <= when < 102.0 or 105.0 <= when < 106.0 for when in arrived)


def test_model_can_be_replaced_at_any_time() -> None:
    path = FaultyPath(FaultModel(loss=1.0))
    assert path.carry(b"gone", 0.0) == []
    path.model = path.model.replace(loss=0.0)
    assert path.carry(b"here", 0.0) == [(0.0, b"here")]


@pytest.mark.parametrize(
    "wrong",
    [
        {"loss": 1.1},
        {"loss": -0.1},
        {"corruption": float("nan")},
        {"delay_s": -1.0},
        {"jitter_s": float("inf")},
        {"bandwidth": 0.0},
        {"queue_bytes": float("nan")},
        {"outages": ((2.0, 1.0),)},
    ],
)
def test_invalid_model_is_refused(wrong: dict[str, Any]) -> None:
    (field,) = wrong
    with pytest.raises(InvalidArgument, match=field):
        FaultModel(**wrong)


# ------------------------------------------------------------------------------------------- frames


@given(st.lists(st.sampled_from([*frames(3), *frames(3, version=1)]), min_size=1), st.binary(max_size=5))
def test_joined_frames_are_split(parts: list[bytes], tail: bytes) -> None:
    tail = tail.replace(b"\xfd", b"").replace(b"\xfe", b"")
    assert split_frames(b"".join(parts) + tail) == parts + ([tail] if tail else [])


@given(st.binary())
def test_splitting_loses_nothing(data: bytes) -> None:
    assert b"".join(split_frames(data)) == data


def test_signed_frame_is_not_split() -> None:
    signed = bytearray(frames(1)[0] + bytes(13))
    signed[2] = 1
    assert split_frames(bytes(signed) * 2) == [bytes(signed)] * 2


def test_whole_datagrams_share_faults_on_request() -> None:
    datagram = b"".join(frames(4))
    assert len(FaultyPath(FaultModel()).carry(datagram, 0.0)) == 4
    assert FaultyPath(FaultModel(per_frame=False)).carry(datagram, 0.0) == [(0.0, datagram)]


# --------------------------------------------------------------------------------- the link's contract

DELAYED = FaultModel(delay_s=0.01, jitter_s=0.01)
each_model = pytest.mark.parametrize("model", [FaultModel(), DELAYED], ids=["perfect", "delayed"])


@each_loop
@each_traffic
@each_model
async def test_faulty_writes_arrive_unsplit_in_order(pieces: list[bytes], model: FaultModel) -> None:
    inner, far = memory_link_pair()
    near, left, right = FaultyLink(inner, model), Recorder(), Recorder()
    await near.open(left)
    await far.open(right)
    for piece in pieces:
        near.write(piece)
        far.write(piece)
    assert left.pieces == []  # never from inside write
    await right.until_data(b"".join(pieces))
    await left.until_data(b"".join(pieces))
    assert left.pieces == right.pieces == [(piece, None) for piece in pieces]
    near.close()
    far.close()
    await near.wait_closed()


@each_loop
async def test_udp_peers_are_separate_and_answered() -> None:
    listening = FaultyLink(UdpListen("127.0.0.1", 0), DELAYED)
    recorder = Recorder()
    await listening.open(recorder)
    assert listening.address.startswith("faulty(udpin:127.0.0.1:")
    assert ":0)" not in listening.address
    assert isinstance(listening.link, UdpListen)
    remotes = [UdpConnect(*listening.link.local_address) for _ in range(2)]
    answers = [Recorder(), Recorder()]
    for number, (remote, answer) in enumerate(zip(remotes, answers, strict=True)):
        await remote.open(answer)
        remote.write(b"hello %d" % number)
    await recorder.until(lambda: len(recorder.pieces) == 2)
    for data, peer in recorder.pieces:
        listening.write(b"re: " + data, peer)
    for number, answer in enumerate(answers):
        await answer.until_data(b"re: hello %d" % number)
    for link in (listening, *remotes):
        link.close()
        await link.wait_closed()


@each_loop
@each_model
async def test_written_data_leaves_before_close_ends(model: FaultModel) -> None:
    inner, far = memory_link_pair()
    near, right = FaultyLink(inner, model), Recorder()
    await near.open(Recorder())
    await far.open(right)
    near.write(b"last words")
    near.close()
    near.close()
    near.write(b"too late")
    await near.wait_closed()
    assert "the other end was closed" in str(await right.until_lost())
    assert right.data == b"last words"


def test_closed_link_lingers_briefly() -> None:
    async def main() -> None:
        inner, far = memory_link_pair()
        near, right = FaultyLink(inner, FaultModel(delay_s=30.0)), Recorder()
        await near.open(Recorder())
        await far.open(right)
        near.write(b"never received")
        near.close()
        await near.wait_closed()
        assert asyncio.get_running_loop().time() == pytest.approx(1.0)
        assert right.data == b""

    run_virtual(main())


@each_loop
@each_model
async def test_data_in_transit_arrives_before_the_loss(model: FaultModel) -> None:
    inner, far = memory_link_pair()
    near, left = FaultyLink(inner, model), Recorder()
    await near.open(left)
    await far.open(Recorder())
    far.write(b"last words")
    near.write(b"into the void")
    far.close()
    assert "the other end was closed" in str(await left.until_lost())
    assert left.data == b"last words"
    assert len(left.losses) == 1
    near.write(b"nobody there")
    await near.wait_closed()
    near.close()
    await near.wait_closed()


@each_loop
@each_model
async def test_closed_link_delivers_nothing(model: FaultModel) -> None:
    inner, far = memory_link_pair()
    near, left, right = FaultyLink(inner, model), Recorder(), Recorder()
    await near.open(left)
    await far.open(right)
    left.at_each_piece = lambda data, peer: near.close()
    far.write(frames(1)[0] * 3)
    far.write(b"second")
    await right.until_lost()
    assert len(left.pieces) == 1
    assert left.losses == []


@each_loop
async def test_lost_link_closed_while_draining_is_released() -> None:
    inner, far = memory_link_pair()
    near, left = FaultyLink(inner, FaultModel(delay_s=0.5)), Recorder()
    await near.open(left)
    await far.open(Recorder())
    near.write(b"on its way")
    near.close()
    far.close()
    await near.wait_closed()
    assert left.losses == []


@each_loop
async def test_link_opens_once_and_may_retry_after_failure() -> None:
    taken = UdpListen("127.0.0.1", 0)
    await taken.open(Recorder())
    near = FaultyLink(UdpListen(*taken.local_address))
    near.write(b"not even open")
    with pytest.raises(LinkOpenError, match="another program"):
        await near.open(Recorder())
    taken.close()
    await taken.wait_closed()
    await near.open(Recorder())
    with pytest.raises(BusyError, match="is already open"):
        await near.open(Recorder())
    near.close()
    with pytest.raises(ConnectionClosed, match="was closed"):
        await near.open(Recorder())


def test_unopened_link_can_be_closed_without_loop() -> None:
    inner, far = memory_link_pair()
    near = FaultyLink(inner)
    near.write(b"")
    near.close()
    far.close()


def test_dropped_writes_include_link_and_queue() -> None:
    async def main() -> None:
        inner, far = memory_link_pair()
        model = FaultModel(loss=0.5, bandwidth=100.0, queue_bytes=200.0)
        near = FaultyLink(inner, model, seed=3)
        await near.open(Recorder())
        for _ in range(50):
            near.write(bytes(20))
        assert near.dropped_writes == near.outgoing.overflowed == 40
        await asyncio.sleep(10.0)
        assert near.dropped_writes == 40 + 10 - near.outgoing.lost  # the other end is not open
        near.close()
        far.close()

    run_virtual(main())


def test_half_duplex_shares_the_channel() -> None:
    async def main() -> None:
        inner, far = memory_link_pair()
        near = FaultyLink(inner, FaultModel(bandwidth=100.0), half_duplex=True)
        left, right, times = Recorder(), Recorder(), list[float]()
        left.at_each_piece = right.at_each_piece = lambda data, peer: times.append(asyncio.get_running_loop().time())
        await near.open(left)
        await far.open(right)
        near.write(bytes(100))
        far.write(bytes(100))
        await left.until_data(bytes(100))
        assert times == pytest.approx([1.0, 2.0])
        near.close()
        far.close()

    run_virtual(main())


class EchoLink(BaseLink):
    """Delivers each write to its own receiver within the call."""

    def __init__(self) -> None:
        super().__init__("echo")

    async def _connect(self) -> None: ...

    def _release(self) -> None: ...

    def write(self, data: bytes, peer: Peer = None) -> None:
        self._deliver(data, peer)


def test_frame_sent_by_delivery_does_not_hasten_others() -> None:
    async def main() -> None:
        near, echo, times = FaultyLink(EchoLink(), outgoing=FaultModel(delay_s=1.0)), Recorder(), dict[bytes, float]()

        def answer_first_frames(data: bytes, peer: Peer) -> None:
            times[data] = asyncio.get_running_loop().time()
            if data in (b"a", b"b"):
                near.write(data.upper())

        echo.at_each_piece = answer_first_frames
        await near.open(echo)
        near.write(b"a")
        near.write(b"b")
        await asyncio.sleep(0.5)
        near.write(b"c")
        await asyncio.sleep(3.0)
        assert times == pytest.approx({b"a": 1.0, b"b": 1.0, b"c": 1.5, b"A": 2.0, b"B": 2.0})
        near.close()

    run_virtual(main())


def test_new_peer_is_stalled_if_others_filled_system() -> None:
    async def main() -> None:
        inner, far = memory_link_pair()
        near = FaultyLink(inner)
        await near.open(Recorder())
        await far.open(Recorder())
        near.stall(system_bytes=10)
        near.write(bytes(10), "one")
        near.write(bytes(5), "two")
        near.discard_unsent()
        assert near.unsent_bytes == 10
        near.close()
        far.close()

    run_virtual(main())


def test_drain_ends_stall_that_began_before_second_stall() -> None:
    async def main() -> None:
        inner, far = memory_link_pair()
        radio = FaultyLink(inner)
        await far.open(Recorder())
        async with aerokit.open_connection(radio) as connection:
            changes: list[aerokit.events.Event] = []
            connection.bus.attach_event(aerokit.events.LinkStalled, changes.append)
            connection.bus.attach_event(aerokit.events.LinkDrained, changes.append)
            radio.stall()
            await asyncio.sleep(3.0)
            radio.stall()
            radio.drain()
            await asyncio.sleep(0.1)
            assert [type(event) for event in changes] == [aerokit.events.LinkStalled, aerokit.events.LinkDrained]
        far.close()

    run_virtual(main())


# ------------------------------------------------------------------------------------- a whole program


def test_program_flies_over_a_bad_radio() -> None:
    async def main() -> tuple[float, int]:
        bad = FaultModel(loss=0.1, duplication=0.1, corruption=0.02, delay_s=0.05, jitter_s=0.05)
        async with simulated_link(SimulatedCopter(boot_time_s=0.0)) as link:
            radio = FaultyLink(link, bad, seed=14)
            async with aerokit.connect(radio) as vehicle:
                await vehicle.wait_ready()
                await vehicle.set_mode("GUIDED")
                while not vehicle.is_armed:
                    with suppress(CommandTimeout):  # `arm` is sent once, and may be lost.
                        await vehicle.arm()
                await vehicle.take_off(10.0)
                assert vehicle.position.value.altitude_relative_m == pytest.approx(10.0, abs=1.5)
            return asyncio.get_running_loop().time(), radio.incoming.lost

    first = run_virtual(main())
    assert first == run_virtual(main())
    assert first[1] > 20
