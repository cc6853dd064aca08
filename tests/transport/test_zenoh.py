from __future__ import annotations

import asyncio
import gc
import os
import threading
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import anyio
import pytest
from free_ports import free_port
from link_harness import Recorder, each_loop
from zenoh_harness import RefusalRecorder, client, reconnecting, serving, until_open_error
from zenoh_network import SERVER, HoldingProxy, eventually, process, router

from aerokit.errors import BusyError, ConnectionClosed, InvalidArgument, LinkOpenError
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import CommandLong, Heartbeat, ParamRequestList, SetPositionTargetLocalNed
from aerokit.transport import create_link
from aerokit.transport import link as needed
from aerokit.transport.zenoh import listen as zenoh_listen
from aerokit.transport.zenoh.keys import RefusalNotice, SendTime, Stamp
from aerokit.transport.zenoh.listen import CLIENT_TIMEOUT_S, MAX_CLIENTS, ZenohListen
from aerokit.transport.zenoh.session import LoopQueue

CongestionControl = pytest.importorskip("zenoh").CongestionControl
pytestmark = pytest.mark.anyio

ENCODER = FrameEncoder(255, 190)
ARM = CommandLong(1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0)
SET_POINT = SetPositionTargetLocalNed(0, 1, 1, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0)
PIECES = [b"\xfd\x09\x00", bytes(range(256)), b"\n\r\x11\x13", *(bytes([n]) * (1 + n) for n in range(200))]


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


def frame(message: Message = ARM) -> bytes:
    return ENCODER.encode(message)


@each_loop
@pytest.mark.usefixtures("any_delay")
async def test_zenoh_bytes_pass_both_ways() -> None:
    port = free_port()
    async with serving(port) as (vehicle, recorder), client(port, "&client=ground") as (link, answered):
        frames = [frame(ParamRequestList(1, 1)) for _ in range(100)]
        for received_frame in frames:
            link.write(received_frame)
        await recorder.until_data(b"".join(frames))
        assert recorder.peers == ["ground"] == list(vehicle.peers)
        for piece in PIECES:
            vehicle.write(piece, "ground")
        await answered.until_data(b"".join(PIECES))
        vehicle.write(b"to all")
        await answered.until_data(b"".join(PIECES) + b"to all")
        assert answered.peers == [None]
        assert link.lease_holder is None
        vehicle.write(b"to nobody", "stranger")
        assert vehicle.dropped_writes == 1
        assert vehicle.has_peer("ground") > vehicle.has_peer("stranger")
        assert link.dropped_writes == link.late_frames == vehicle.late_datagrams == 0
    assert recorder.losses == []


@pytest.mark.usefixtures("any_delay")
async def test_only_complete_frames_of_a_client_pass() -> None:
    port = free_port()
    async with serving(port) as (_, recorder), client(port) as (link, _client_recorder):
        link.write(b"noise")
        link.write(frame()[:10])
        link.write(last := frame(ParamRequestList(1, 1)))
        await eventually(lambda: recorder.data != b"")
        assert recorder.data == last


async def test_closed_server_is_a_lost_link() -> None:
    port = free_port()
    async with serving(port) as (vehicle, _), client(port) as (_link, answered):
        vehicle.close()
        await eventually(lambda: bool(answered.losses))
        assert "the server was closed" in str(answered.losses[0])


async def test_unknown_name() -> None:
    port = free_port()
    address = f"zenoh://north/alpha?connect=tcp/127.0.0.1:{port}"
    with router(port):
        async with serving(port, "beta", "connect"), serving(port, "gamma", "connect"):
            await until_open_error(address, r"no server named alpha .*available: beta, gamma")
        await until_open_error(address, "the fleet is empty")


async def test_no_router() -> None:
    with pytest.raises(LinkOpenError, match=r"cannot open zenoh://north/alpha: cannot connect to tcp/127"):
        async with client(free_port()):
            pass
    with pytest.raises(LinkOpenError, match="cannot open zenohin://north/alpha"):
        async with serving(free_port(), how="connect"):
            pass


async def test_port_in_use() -> None:
    port = free_port()
    async with serving(port):
        with pytest.raises(LinkOpenError, match="cannot open zenohin://north/beta"):
            async with serving(port, "beta"):
                pass


async def test_name_in_use(monkeypatch: pytest.MonkeyPatch) -> None:
    port = free_port()
    with router(port):
        async with serving(port, how="connect"):
            with (
                monkeypatch.context() as patched,
                pytest.raises(LinkOpenError, match="another program has opened a server with this name"),
            ):
                patched.setattr(zenoh_listen, "_TOKEN_QUERY_TIMEOUT_S", 100.0)
                patched.setattr(zenoh_listen, "_BEACON_TIMEOUT_S", 100.0)
                async with serving(port, how="connect"):
                    pass
        with anyio.fail_after(100):
            while True:
                # On a busy machine, a beacon of the first program may arrive after its end.
                with suppress(LinkOpenError):
                    async with serving(port, how="connect"):
                        break


async def test_zenoh_link_is_opened_once(tmp_path: Path) -> None:
    port = free_port()
    async with serving(port) as (vehicle, _), client(port) as (link, _client_recorder):
        for endpoint in (vehicle, link):
            with pytest.raises(BusyError):
                await endpoint.open(Recorder())
    for opened in (vehicle, link):
        with pytest.raises(ConnectionClosed):
            await opened.open(Recorder())
        opened.write(b"nothing happens")
    wrong = tmp_path / "zenoh.json5"
    wrong.write_text("{ mode: 7 }")
    with pytest.raises(InvalidArgument, match="zenoh://north/alpha: config="):
        await create_link(f"zenoh://north/alpha?config={wrong}").open(Recorder())


async def test_without_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(name: str) -> Any:
        raise ModuleNotFoundError(f"No module named {name!r}", name=name)

    monkeypatch.setattr(needed, "import_module", fail)
    for address in ("zenoh://north/alpha", "zenohin://north/alpha"):
        with pytest.raises(LinkOpenError, match=r"pip install 'aerokit-mavlink\[zenoh\]'"):
            await create_link(address).open(Recorder())


# ------------------------------------------------------------------------------------ broken connections


async def test_orders_held_back_by_broken_connection_are_refused() -> None:
    port = free_port()
    fresh, held = frame(), frame(CommandLong(1, 1, 400, 0, 0, 0, 0, 0, 0, 0, 0))
    async with serving(port) as (vehicle, recorder), HoldingProxy(port) as line:  # noqa: SIM117 - the line's port
        async with client(line.port, "&client=ground") as (link, client_recorder):

            def goes_through() -> bool:
                link.write(fresh)
                return recorder.data != b""

            await eventually(goes_through)
            line.hold()
            written, dropped, late = 0, link.dropped_writes, vehicle.late_datagrams
            while link.dropped_writes == dropped:  # until no beacon has come for two seconds
                vehicle.write(b"telemetry")
                link.write(held)
                written += 1
                await asyncio.sleep(0.02)
            assert line.held_bytes > 1000
            await asyncio.sleep(0.5)  # until the youngest of them is too old: its stamp is one period older than it
            line.release()
            await eventually(lambda: vehicle.late_datagrams >= late + written - 1)
            await eventually(lambda: ("COMMAND_LONG", "it arrived too late", None) in client_recorder.refused)
            assert set(client_recorder.answers) == {()}
            recorder.pieces = [piece for piece in recorder.pieces if piece != (fresh, "ground")]
            assert recorder.pieces == []  # not one of them
            await eventually(goes_through)
            assert client_recorder.losses == []


@pytest.mark.exhaustive
async def test_killed_router_returns() -> None:
    port = free_port()
    with router(port) as first:
        async with serving(port, how="connect") as (vehicle, recorder), reconnecting(port) as (link, client_recorder):

            def passes() -> bool:
                link.write(frame())
                return recorder.data != b""

            await eventually(passes)
            first.kill()
            first.wait()
            await eventually(lambda: client_recorder.interruptions == 1)
            recorder.pieces.clear()
            link.write(frame())  # into the void
            with router(port):
                await eventually(lambda: client_recorder.restored == 1)
                assert recorder.pieces == []
                late = frame()

                def arrives() -> bool:
                    link.write(late)
                    return recorder.data != b""

                await eventually(arrives)
                assert {piece for piece, _ in recorder.pieces} == {late}
                assert len(vehicle.peers) == 1


@pytest.mark.exhaustive
async def test_killed_server_is_replaced() -> None:
    port = free_port()
    address = f"zenohin://north/alpha?connect=tcp/127.0.0.1:{port}"
    with router(port), process(SERVER, address) as first:
        async with reconnecting(port) as (_, client_recorder):
            await eventually(lambda: client_recorder.data != b"")
            first.kill()
            await eventually(lambda: client_recorder.interruptions >= 1)
            client_recorder.pieces.clear()
            with process(SERVER, address):
                await eventually(lambda: client_recorder.restored >= 1 and client_recorder.data != b"")


async def test_late_client_finds_server_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The next beacon is disabled."""
    port = free_port()
    monkeypatch.setattr(zenoh_listen, "BEACON_INTERVAL_S", 3600.0)
    with router(port):
        async with serving(port, how="connect") as (vehicle, _):
            async with client(port):
                pass
            await eventually(lambda: vehicle.peers == ())


# ---------------------------------------------------------------------------- the control lease


@pytest.mark.usefixtures("any_delay")
async def test_two_programs_order_the_same_vehicle() -> None:
    port = free_port()
    with router(port):
        async with (
            serving(port, how="connect") as (vehicle, recorder),
            client(port, "&client=one") as (one, _),
            client(port, "&client=two") as (two, client_recorder),
        ):
            one.write(frame())
            await eventually(lambda: vehicle.lease_holder == "one" == two.lease_holder)
            recorder.pieces.clear()
            two.write(frame())
            two.write(frame(SET_POINT))
            two.write(read := frame(ParamRequestList(1, 1)))
            await eventually(lambda: len(client_recorder.refused) == 2)
            assert client_recorder.refused[0] == ("COMMAND_LONG", "one has control", "one")
            assert len(client_recorder.answers[0]) == 2
            assert recorder.data == read
            assert vehicle.refused_frames == 2 == two.dropped_writes
            one.close()
            await one.wait_closed()
            await eventually(lambda: vehicle.lease_holder is None)
            two.write(frame())
            await eventually(lambda: vehicle.lease_holder == "two")
            async with (
                client(port, "&client=three&control=take") as (three, _),
                client(port, "&control=never") as (four, no),
            ):
                await eventually(lambda: vehicle.lease_holder == "three" == three.lease_holder)
                four.write(frame())
                await eventually(
                    lambda: no.refused == [("COMMAND_LONG", "this link is read-only (control=never)", None)]
                )
                two.write(frame())
                await eventually(lambda: client_recorder.refused[-1] == ("COMMAND_LONG", "three has control", "three"))


@pytest.mark.usefixtures("any_delay")
async def test_router_restricts_reading_and_ordering(tmp_path: Path) -> None:
    """The configuration of docs/network.md."""
    port = free_port()
    page = (Path(__file__).parents[2] / "docs" / "network.md").read_text(encoding="utf-8")
    users, files = tmp_path / "users.txt", {}
    users.write_text("router:r\nalpha:a\nground-1:g\nonlooker:o\n")
    config = page.split("```json5\n")[1].split("```")[0]
    assert config.count("tcp/0.0.0.0:7447") == config.count("/etc/zenoh/users.txt") == 1
    files["router"] = tmp_path / "router.json5"
    files["router"].write_text(
        config.replace("tcp/0.0.0.0:7447", f"tcp/127.0.0.1:{port}").replace("/etc/zenoh/users.txt", str(users))
    )
    for user, password in (("alpha", "a"), ("ground-1", "g"), ("onlooker", "o")):
        files[user] = tmp_path / f"{user}.json5"
        files[user].write_text(
            f"""{{ mode: "client", connect: {{ endpoints: ["tcp/127.0.0.1:{port}"] }},
            scouting: {{ multicast: {{ enabled: false }} }},
            transport: {{ auth: {{ usrpwd: {{ user: "{user}", password: "{password}" }} }} }} }}"""
        )
    with router(port, str(files["router"])):
        vehicle, received = create_link(f"zenohin://north/alpha?config={files['alpha']}"), Recorder()
        pilot, onlooker = (
            create_link(f"zenoh://north/alpha?client={name}&timeout=100&config={files[name]}")
            for name in ("ground-1", "onlooker")
        )
        liar = create_link(f"zenohin://north/beta?config={files['ground-1']}")
        observed, client_recorder = RefusalRecorder(), RefusalRecorder()
        opened = ((vehicle, received), (pilot, client_recorder), (onlooker, observed), (liar, Recorder()))
        for link, receiver in opened:
            await link.open(receiver)
        vehicle.write(b"telemetry")
        for recorder in (observed, client_recorder):
            await recorder.until_data(b"telemetry")
        onlooker.write(frame())
        liar.write(b"a vehicle that is none")
        pilot.write(order := frame())
        await received.until_data(order)
        assert received.peers == ["ground-1"]
        address = f"zenoh://north/beta?config={files['onlooker']}"
        await until_open_error(address, r"no server named beta in the fleet north \(available: alpha\)")
        for link, _ in opened:
            link.close()
        for link, _ in opened:
            await link.wait_closed()


# ---------------------------------------------------------------------------------------------- leaks


def open_resources() -> tuple[int, int]:
    gc.collect()
    return threading.active_count(), len(os.listdir("/proc/self/fd"))


@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="Linux counts files")
@pytest.mark.usefixtures("any_delay")
async def test_closed_links_leave_nothing() -> None:
    async def once() -> None:
        port = free_port()
        async with serving(port) as (vehicle, recorder), client(port) as (link, answered):
            vehicle.write(b"x")
            link.write(frame())
            await eventually(lambda: recorder.data != b"" and answered.data != b"")
            link._session.put("aerokit/north/alpha/from/all", b"y", attachment=b"")
        recorder.pieces.clear()
        await asyncio.sleep(0.05)
        assert recorder.pieces == []  # no callback after close

    await once()
    before = open_resources()
    for _ in range(3):
        await once()
    await eventually(lambda: open_resources() <= (before[0] + 6, before[1]))  # threads of the loop's executor


@pytest.mark.parametrize("after_s", [0, 0.001, 0.005, 0.02, 0.3])
async def test_cancelled_while_opening(after_s: float) -> None:
    port = free_port()
    link = create_link(f"zenoh://north/alpha?listen=tcp/127.0.0.1:{port}&timeout=5")
    opening = asyncio.get_running_loop().create_task(link.open(Recorder()))
    await asyncio.sleep(after_s)
    opening.cancel()
    with pytest.raises(asyncio.CancelledError):
        await opening
    link.close()
    await link.wait_closed()

    def is_port_free() -> bool:
        import socket

        with socket.socket() as sock:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                sock.bind(("127.0.0.1", port))
            except OSError:
                return False
            return True

    await eventually(is_port_free)


async def test_slow_loop_costs_bounded_memory() -> None:
    taken: list[int] = []
    queue = LoopQueue(limit=100)

    def post() -> None:
        for number in range(10_000):
            queue.post(partial(taken.append, number))

    thread = threading.Thread(target=post)
    thread.start()
    thread.join()  # the loop does not come round
    assert queue.dropped == 9_900
    await eventually(lambda: len(taken) == 100)
    assert taken == list(range(9_900, 10_000))
    queue.post(partial(taken.append, 1))
    queue.close()
    queue.post(partial(taken.append, 2))
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    assert len(taken) == 100


async def test_loop_queue_continues_after_exception() -> None:
    taken: list[int] = []

    def take(number: int) -> None:
        if number == 1:
            raise ValueError("a mistake")
        taken.append(number)

    mistakes: list[Any] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: mistakes.append(context))
    queue = LoopQueue()
    for number in range(600):
        queue.post(partial(take, number))
    await eventually(lambda: len(taken) == 599)
    assert len(mistakes) == 1


def test_recorder_of_harness_is_a_refusal_listener() -> None:
    from aerokit.transport import OrderRefusalListener

    assert isinstance(RefusalRecorder, type)
    assert issubclass(RefusalRecorder, OrderRefusalListener)
    assert frame(Heartbeat(6, 8, 0, 0, 4, 3))


async def test_foreign_keys_do_not_block_clients(monkeypatch: pytest.MonkeyPatch) -> None:
    """A client is accepted by its liveliness token; a peer that only publishes on its key is dropped at the limit."""
    link, now = ZenohListen("north", "alpha"), 100.0
    monkeypatch.setattr(link, "_now", lambda: now)
    for number in range(MAX_CLIENTS):
        link._on_datagram(f"noise-{number}", b"", b"")
    assert len(link.peers) == MAX_CLIENTS
    assert link._get_or_add_client("ground-1") is None
    now += CLIENT_TIMEOUT_S + 1
    link._on_datagram("noise-7", b"", b"")
    assert link._get_or_add_client("ground-1") is not None
    assert len(link.peers) == MAX_CLIENTS
    assert "noise-7" in link.peers


async def test_duplicated_datagram_reaches_vehicle_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Duplicated by the network or replayed by an attacker, an order is executed once and in order."""
    link, taken = ZenohListen("north", "alpha"), list[bytes]()
    monkeypatch.setattr(link, "_now", lambda: 100.0)
    monkeypatch.setattr(link, "_deliver", lambda data, peer: taken.append(data))
    epoch = link._freshness.make_beacon(100.0).epoch
    orders = [frame(ParamRequestList(1, 1)) for _ in range(3)]
    for sequence in (1, 1, 3, 2, 3):
        link._on_datagram("ground", orders[sequence - 1], Stamp(epoch, 1, 7, sequence).encode())
    assert taken == [orders[0], orders[2]]
    assert (link._freshness.duplicates, link.late_datagrams) == (3, 0)


@pytest.mark.usefixtures("any_delay")
async def test_payload_larger_than_datagram_is_ignored() -> None:
    """On either side, a publisher on the network cannot fill the memory or block the event loop."""
    port = free_port()
    async with serving(port) as (vehicle, recorder), client(port, "&client=ground") as (link, answered):
        link.write(order := frame(ParamRequestList(1, 1)))
        await recorder.until_data(order)
        stamp, sent = link._tracker.make_stamp(link._now()), SendTime(vehicle._freshness.epoch, vehicle._now()).encode()
        assert stamp is not None
        for session, key, attachment in (
            (link._session, link._keys.to_server("ground"), stamp.encode()),
            (vehicle._session, vehicle._keys.from_server("ground"), sent),
        ):  # blocks until it is sent; the small ones arrive after it
            session.put(key, order * 10_000, attachment=attachment, congestion_control=CongestionControl.BLOCK)

        def small_ones_arrive() -> bool:
            link.write(order)
            vehicle.write(b"small", "ground")  # dropped while the large one fills the queue
            return len(recorder.pieces) > 1 and answered.pieces != []

        await eventually(small_ones_arrive)
        assert {piece for piece, _ in recorder.pieces} == {order}
        assert {piece for piece, _ in answered.pieces} == {b"small"}


# ------------------------------------------------------------------------------------ openings that were given up


async def test_declarations_of_abandoned_opening_are_ignored() -> None:
    """A thread cannot be stopped, so it may declare when the link is already opened again."""
    client_link = create_link("zenoh://north/alpha")
    vehicle = ZenohListen("north", "alpha")
    for link, declare in ((client_link, "_declare"), (vehicle, "_find_conflict")):
        present: Any = link
        present._queue = LoopQueue()
        getattr(present, declare)(LoopQueue(), MagicMock(), MagicMock())
        assert present._declared == []
        assert present._publisher is None
    vehicle._serve(LoopQueue(), MagicMock())
    assert vehicle._publisher is None


async def test_refused_name_can_be_served_later(monkeypatch: pytest.MonkeyPatch) -> None:
    """A beacon that made an earlier opening fail is no reason for the next one to fail."""
    link = ZenohListen("north", "alpha")

    async def open_session(*_: object) -> Any:
        link._zenoh, link._may_have_conflict = pytest.importorskip("zenoh"), True
        return MagicMock()

    monkeypatch.setattr(zenoh_listen, "open_session", open_session)
    monkeypatch.setattr(zenoh_listen, "_BEACON_TIMEOUT_S", 0.001)
    link._name_conflict.set()
    await link.open(Recorder())
    link.close()
    await link.wait_closed()


async def test_failed_declaration_is_open_error(monkeypatch: pytest.MonkeyPatch) -> None:
    threads: list[threading.Thread] = []

    def fail(*_: object) -> None:
        threads.append(threading.current_thread())
        raise pytest.importorskip("zenoh").ZError("session closed")

    link = create_link(f"zenohin://north/alpha?listen=tcp/127.0.0.1:{free_port()}")
    monkeypatch.setattr(link, "_serve", fail)
    with pytest.raises(LinkOpenError, match="cannot open zenohin://north/alpha: session closed"):
        await link.open(Recorder())
    assert threads != [threading.main_thread()]  # it may block
    await link.wait_closed()


async def test_notice_for_other_program_is_ignored() -> None:
    link: Any = create_link("zenoh://north/alpha?client=ground")
    link._receiver = recorder = RefusalRecorder()
    for nonce in (link._nonce ^ 1, link._nonce, None):
        link._on_notice(RefusalNotice("COMMAND_LONG", f"{nonce}", None, nonce=nonce).encode(), b"")
    assert [reason for _, reason, _ in recorder.refused] == [str(link._nonce), "None"]


async def test_notice_has_nonce_of_refused_datagram(monkeypatch: pytest.MonkeyPatch) -> None:
    link, sent = ZenohListen("north", "alpha"), list[bytes]()
    monkeypatch.setattr(link, "_now", lambda: 100.0)
    monkeypatch.setattr(link, "_put", lambda _key, data, _attachment: sent.append(data))
    epoch = link._freshness.make_beacon(100.0).epoch
    link._on_datagram("ground", frame(), Stamp(epoch, 1, 7, 1, "never").encode())
    link._on_datagram("ground", frame(SET_POINT), Stamp(epoch, 99, 8, 2).encode())
    notices = [RefusalNotice.decode(data) for data in sent]
    assert [notice and notice.nonce for notice in notices] == [7, 8]
