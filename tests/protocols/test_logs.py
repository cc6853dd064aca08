"""Flight logs by LOG_* messages over bad links; the vehicle serves one request at a time or only the latest."""

from __future__ import annotations

import tracemalloc
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from log_vehicle import LogVehicle, content, run
from parameter_channel import framed

from aerokit.errors import FileTimeout, RemoteProtocolError
from aerokit.mavlink.messages import LogData, LogEntry, LogRequestData, LogRequestEnd
from aerokit.protocols.blocks import Reassembly
from aerokit.protocols.exchange import RoundTrip
from aerokit.protocols.logs import LOG_BLOCK, SPACING_S, LogDownload, LogList, LogStop


def make_list(first_id: int = 1, **options: Any) -> LogList:
    return LogList(1, 1, first_id=first_id, round_trip=RoundTrip(0.1), **options)


def make_download(size: int, log_id: int = 1, *, start: int = 0, **options: Any) -> tuple[LogDownload, bytearray]:
    written = bytearray()
    into = Reassembly(written.extend, block_size=LOG_BLOCK, start=start)
    return LogDownload(1, 1, log_id, size, into, round_trip=RoundTrip(0.1), **options), written


# -------------------------------------------------------------------------------------- lists


@given(
    st.integers(1, 60),
    st.sampled_from([0, 1]),
    st.booleans(),
    st.sampled_from([0.0, 0.1, 0.3]),
    st.integers(0, 99),
)
def test_log_list_is_complete(count: int, first_id: int, latest_wins: bool, loss: float, seed: int) -> None:
    vehicle = LogVehicle([content(number) for number in range(count)], first_id, latest_wins)
    exchange = make_list(first_id)
    sent = run(exchange, vehicle, loss=loss, seed=seed)
    entries = exchange.result()
    assert [entry.id for entry in entries] == list(range(first_id, first_id + count))
    assert [entry.size for entry in entries] == list(range(count))
    assert sent < 100


def test_log_list_without_logs() -> None:
    exchange = make_list()
    run(exchange, LogVehicle([]))
    assert exchange.result() == ()


def test_log_list_of_one_entry() -> None:
    exchange = make_list(from_id=2, to_id=2)
    run(exchange, LogVehicle([content(5), content(6), content(7)]))
    assert [log.size for log in exchange.result()] == [6]


def test_log_list_without_answer_times_out() -> None:
    exchange = make_list(idle_timeout_s=3.0)
    assert run(exchange, LogVehicle([b"a"]), loss=1.0) < 20
    with pytest.raises(FileTimeout, match="does not answer") as raised:
        exchange.result()
    assert raised.value.missing == ((1, 0),)  # from there to an unknown end
    exchange = make_list(max_unanswered=4)
    assert run(exchange, LogVehicle([b"a"]), loss=1.0) == 5


def test_log_list_timeout_names_missing() -> None:
    exchange = make_list(idle_timeout_s=1.0)
    exchange.start(0.0)
    exchange.receive(LogEntry(2, 4, 4, 0, 7), 0.1)
    while not exchange.done:
        assert exchange.deadline is not None
        exchange.expire(exchange.deadline)
    with pytest.raises(FileTimeout, match="entries of logs 1, 3–4") as raised:
        exchange.result()
    assert raised.value.missing == ((1, 1), (3, 1), (4, 1))
    assert isinstance(exchange.take_outbox()[-1], LogRequestEnd)


# ----------------------------------------------------------------------------------- downloads


@pytest.mark.parametrize("size", [1, 89, 90, 91, 180, 5000, 512 * LOG_BLOCK + 1])
@pytest.mark.parametrize("latest_wins", [False, True])
def test_log_download_without_loss(size: int, latest_wins: bool) -> None:
    exchange, written = make_download(size)
    sent = run(exchange, LogVehicle([content(size)], latest_wins=latest_wins))
    assert exchange.result() == size
    assert written == content(size)
    assert sent <= 3


def test_empty_log_sends_only_end() -> None:
    exchange, written = make_download(0)
    assert run(exchange, LogVehicle([b""])) == 1
    assert written == b""


@given(st.integers(1, 90_000), st.booleans(), st.sampled_from([0.0, 0.05, 0.3]), st.integers(0, 99))
def test_log_download_arrives_despite_losses(size: int, latest_wins: bool, loss: float, seed: int) -> None:
    exchange, written = make_download(size)
    sent = run(exchange, LogVehicle([content(size)], latest_wins=latest_wins), loss=loss, seed=seed)
    assert exchange.done
    assert exchange.result() == size
    assert written == content(size)
    assert sent < 60 + 30 * (size // LOG_BLOCK + 1) * loss + size / 4000


def test_log_download_resumes() -> None:
    exchange, written = make_download(5000, start=1234)
    run(exchange, LogVehicle([content(5000)]), loss=0.1)
    assert written == content(5000)[1234:]


def test_log_download_resumes_with_gaps() -> None:
    written = bytearray()
    into = Reassembly(written.extend, block_size=LOG_BLOCK)
    into.add(30 * LOG_BLOCK, content(5000)[30 * LOG_BLOCK : 31 * LOG_BLOCK])
    exchange = LogDownload(1, 1, 1, 5000, into, round_trip=RoundTrip(0.1))
    run(exchange, LogVehicle([content(5000)]))
    assert exchange.result() == 5000
    assert written == content(5000)


def test_log_download_to_full_disk_fails_and_sends_end() -> None:
    def write(data: bytes) -> None:
        raise OSError(28, "No space left on device")

    exchange = LogDownload(1, 1, 1, 1000, Reassembly(write, block_size=LOG_BLOCK), round_trip=RoundTrip(0.1))
    exchange.start(0.0)
    exchange.receive(LogData(1, 0, 90, bytes(90)), 0.1)
    with pytest.raises(OSError, match="No space left"):
        exchange.result()
    assert isinstance(exchange.take_outbox()[-1], LogRequestEnd)


def test_log_download_timeout_sends_end() -> None:
    exchange, _ = make_download(1000, idle_timeout_s=2.0)
    exchange.start(0.0)
    exchange.receive(LogData(1, 0, 90, bytes(90)), 0.1)
    exchange.receive(LogData(1, 180, 90, bytes(90)), 0.1)
    exchange.receive(LogData(1, 450, 90, bytes(90)), 0.1)
    exchange.receive(LogData(2, 270, 90, bytes(90)), 0.1)  # another log
    messages = exchange.take_outbox()
    while not exchange.done:
        assert exchange.deadline is not None
        exchange.expire(exchange.deadline)
        messages += exchange.take_outbox()
    with pytest.raises(FileTimeout, match="log 1: no data received for 2 s") as raised:
        exchange.result()
    assert raised.value.missing == ((90, 90), (270, 180), (540, 460))
    assert isinstance(messages[-1], LogRequestEnd)
    assert len(messages) < 40


def test_log_download_spaces_single_block_requests() -> None:
    exchange, _ = make_download(5 * LOG_BLOCK)
    exchange.start(0.0)
    exchange.take_outbox()
    for offset in (0, 4 * LOG_BLOCK):
        exchange.receive(LogData(1, offset, LOG_BLOCK, bytes(LOG_BLOCK)), 0.1)
    asked = [message.ofs for message in exchange.take_outbox() if isinstance(message, LogRequestData)]
    assert asked == [LOG_BLOCK, 2 * LOG_BLOCK]
    assert exchange.deadline == pytest.approx(0.1 + SPACING_S)


def test_log_download_of_short_log_fails() -> None:
    vehicle = LogVehicle([content(500)])
    exchange, _ = make_download(1000)
    exchange.start(0.0)
    for _ in range(3):
        (request,) = exchange.take_outbox()  # immediately: the next read may be of this log
        assert isinstance(request, LogRequestData)
        exchange.receive(LogData(1, 450, 50, bytes(90)), 0.1)
    with pytest.raises(RemoteProtocolError, match="ends after 500 bytes"):
        exchange.result()
    assert isinstance(exchange.take_outbox()[-1], LogRequestEnd)
    assert vehicle.queue == []


# ---------------------------------------------------------------------------------------- end


def test_log_stop_repeats_while_vehicle_sends() -> None:
    exchange = LogStop(1, 1, round_trip=RoundTrip(0.1))
    exchange.start(0.0)
    assert exchange.take_outbox() == []
    exchange.receive(LogData(1, 0, 90, bytes(90)), 0.1)
    exchange.expire(exchange.deadline or 0.0)
    assert len(exchange.take_outbox()) == 1
    exchange.expire(exchange.deadline or 0.0)
    assert exchange.done
    assert exchange.take_outbox() == []


def test_log_download_ignores_distant_block() -> None:
    """Storing each gap would take 47 million entries (3 GB)."""
    content = bytearray()
    exchange = LogDownload(1, 1, 1, 0xFFFF_FFFF, Reassembly(content.extend, block_size=LOG_BLOCK))
    exchange.start(0.0)
    last = 0xFFFF_FFFF // LOG_BLOCK * LOG_BLOCK
    tracemalloc.start()
    try:
        for offset in (last, last - LOG_BLOCK, 0):
            exchange.receive(LogData(1, offset, LOG_BLOCK, bytes(LOG_BLOCK)), 0.1)
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()
    assert len(content) == LOG_BLOCK


def test_log_list_timeout_shortens_many_missing() -> None:
    exchange = make_list(idle_timeout_s=1.0)
    exchange.start(0.0)
    for number in range(2, 60_000, 1000):
        exchange.receive(LogEntry(number, 65_535, 65_535, 0, 7), 0.1)
    while not exchange.done:
        assert exchange.deadline is not None
        exchange.expire(exchange.deadline)
    with pytest.raises(FileTimeout) as raised:
        exchange.result()
    assert len(str(raised.value)) < 300
    assert len(raised.value.missing) == 65_535 - 60


@pytest.mark.parametrize(("blocks_ahead", "is_taken"), [(0, True), (39_999, True), (40_000, False)])
def test_log_download_ignores_distant_blocks_anywhere(blocks_ahead: int, is_taken: bool) -> None:
    start = 30_000 * LOG_BLOCK
    into = Reassembly(lambda data: None, block_size=LOG_BLOCK, start=start)
    exchange = LogDownload(1, 1, 1, 100_000 * LOG_BLOCK, into)
    exchange.start(0.0)
    offset = start + blocks_ahead * LOG_BLOCK
    exchange.receive(framed(LogData(1, offset, LOG_BLOCK, bytes(LOG_BLOCK))), 0.1)
    assert (into.received_bytes > start) is is_taken
