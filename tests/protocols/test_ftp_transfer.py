"""FTP downloads and uploads over a bad channel, with servers of both autopilots."""

from __future__ import annotations

import random
from typing import Any

import pytest
from ftp_server import FileServer, as_message, make_client, reply_to, requests_in, run
from hypothesis import given
from hypothesis import strategies as st

from aerokit.errors import FileError, FileTimeout
from aerokit.mavlink.enums import MavFtpErr, MavFtpOpcode
from aerokit.protocols.blocks import Reassembly
from aerokit.protocols.exchange import RoundTrip, TransferProgress
from aerokit.protocols.ftp import DATA_SIZE, FtpSessionLost
from aerokit.protocols.ftp_transfer import MAX_GAPS, MAX_REPEATED_BURSTS, FtpDownload, FtpUpload, is_virtual

Op = MavFtpOpcode
SIZES = [0, 1, DATA_SIZE - 1, DATA_SIZE, DATA_SIZE + 1, 2 * DATA_SIZE, 5000, 20 * DATA_SIZE]


def content(size: int) -> bytes:
    return random.Random(size).randbytes(size)


class Download:
    """A download and the content it has written."""

    def __init__(self, size: int | None, *, path: str = "/a", start: int = 0, **options: Any) -> None:
        self.content = bytearray()
        self.into = Reassembly(self.content.extend, block_size=DATA_SIZE, start=start)
        self.exchange = FtpDownload(
            make_client(), path, self.into, session=1, size=size or 0, round_trip=RoundTrip(0.1), **options
        )


# ---------------------------------------------------------------------------------- downloads


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("exact_end", [False, True])
@pytest.mark.parametrize("path", ["/a", "@SYS/a"])
def test_download_without_loss(size: int, exact_end: bool, path: str) -> None:
    download = Download(size, path=path)
    outcome = run(download.exchange, FileServer(bytearray(content(size)), exact_end=exact_end))
    assert download.exchange.result() == size
    assert download.content == content(size)
    assert outcome.messages == 1


def test_download_ignores_size_of_virtual_file() -> None:
    for guess in (10, 1_000_000):
        download = Download(guess, path="@PARAM/param.pck")
        run(download.exchange, FileServer(bytearray(content(5000))))
        assert download.content == content(5000)


def test_download_requests_consecutive_bursts() -> None:
    download = Download(5000)
    outcome = run(download.exchange, FileServer(bytearray(content(5000)), burst_blocks=6))
    assert download.content == content(5000)
    assert outcome.messages == 4


def test_download_without_bursts_reads_blocks() -> None:
    for path in ("/a", "@SYS/a"):
        download = Download(5000, path=path)
        run(download.exchange, FileServer(bytearray(content(5000)), has_burst=False, queue=None), loss=0.1)
        assert download.content == content(5000)


def test_download_resumes() -> None:
    download = Download(5000, start=1234)
    run(download.exchange, FileServer(bytearray(content(5000))), loss=0.1)
    assert download.content == content(5000)[1234:]
    assert download.exchange.result() == 5000


@given(
    st.integers(0, 12_000),
    st.sampled_from([0.0, 0.05, 0.3]),
    st.sampled_from([0.0, 0.2]),
    st.sampled_from([0.0, 0.06]),
    st.sampled_from([5, 30, 500]),
    st.sampled_from([None, 5]),
    st.booleans(),
    st.sampled_from(["/a", "@SYS/a"]),
    st.integers(0, 2**32),
)
def test_download_arrives_despite_losses(
    size: int,
    loss: float,
    duplicates: float,
    jitter_s: float,
    burst_blocks: int,
    queue: int | None,
    exact_end: bool,
    path: str,
    seed: int,
) -> None:
    server = FileServer(bytearray(content(size)), burst_blocks, queue, exact_end=exact_end)
    download = Download(size, path=path)
    outcome = run(
        download.exchange,
        server,
        loss=loss,
        duplicates=duplicates,
        jitter_s=jitter_s,
        seed=seed,
        longest_s=120,
    )
    assert download.exchange.done
    assert download.exchange.result() == size
    assert download.content == content(size)
    assert outcome.messages <= 40 + 6 * (size // DATA_SIZE + 1)


def test_download_requests_gap_during_burst() -> None:
    download = Download(10_000)
    exchange = download.exchange
    exchange.start(0.0)
    (burst,) = requests_in(exchange.take_outbox())
    exchange.receive(as_message(reply_to(burst, content(239), offset=0)), 0.1)
    assert exchange.take_outbox() == []
    exchange.receive(as_message(reply_to(burst, content(239), offset=7 * 239, ahead=8)), 0.11)
    reads = requests_in(exchange.take_outbox())
    assert [(read.opcode, read.offset) for read in reads] == [(Op.READFILE, 239 * n) for n in (1, 2, 3, 4)]
    sequences = {read.sequence for read in reads}
    assert not sequences & set(range(burst.sequence, burst.sequence + 500))  # may be replies of the burst
    exchange.receive(as_message(reply_to(reads[0], content(239), offset=239)), 0.2)
    assert [request.offset for request in requests_in(exchange.take_outbox())] == [239 * 5]


def test_download_ignores_blocks_of_other_bursts() -> None:
    download = Download(10_000)
    exchange = download.exchange
    exchange.start(0.0)
    (burst,) = requests_in(exchange.take_outbox())
    exchange.receive(as_message(reply_to(burst, b"x" * 239, offset=0, ahead=5)), 0.1)
    assert not download.content
    assert download.into.tail == 0


def bursts_in(download: Download) -> list[int]:
    """Return the offsets of the bursts requested since."""
    requests = requests_in(download.exchange.take_outbox())
    return [request.offset for request in requests if request.opcode == Op.BURSTREADFILE]


def test_download_requests_next_burst_at_once() -> None:
    download = Download(10_000)
    download.exchange.start(0.0)
    (burst,) = requests_in(download.exchange.take_outbox())
    download.exchange.receive(as_message(reply_to(burst, content(239), offset=0)), 0.1)
    assert bursts_in(download) == []
    last = reply_to(burst, content(239), offset=239, ahead=2).replace(burst_complete=True)
    download.exchange.receive(as_message(last), 0.11)
    assert bursts_in(download) == [478]


@pytest.mark.parametrize(("missing", "asked"), [(MAX_GAPS - 1, 1), (MAX_GAPS, 0)])
def test_download_with_many_gaps_pauses_bursts(missing: int, asked: int) -> None:
    download = Download(10_000_000)
    download.exchange.start(0.0)
    (burst,) = requests_in(download.exchange.take_outbox())
    last = reply_to(burst, content(239), offset=239 * missing, ahead=missing + 1)
    download.exchange.receive(as_message(last.replace(burst_complete=True)), 0.1)
    assert len(bursts_in(download)) == asked


def test_download_backs_off_after_two_failed_bursts() -> None:
    download = Download(1000)
    exchange = download.exchange
    round_trip = exchange.round_trip
    exchange.start(0.0)
    waits, now = list[float](), 0.0
    for _ in range(4):
        assert bursts_in(download) == [0]
        assert exchange.deadline is not None
        waits.append(exchange.deadline - now)
        now = exchange.deadline
        exchange.expire(now)
    assert waits == pytest.approx([round_trip.timeout_s(attempt) for attempt in (1, 2, 3, 4)])
    assert waits[1] == pytest.approx(waits[0])
    assert waits[2] > 1.4 * waits[1]


def test_download_measures_round_trip_by_first_block() -> None:
    for ahead, measured in ((1, 0.3), (2, None)):
        into = Reassembly(bytearray().extend, block_size=DATA_SIZE)
        exchange = FtpDownload(make_client(), "/a", into, session=1, size=5000)
        exchange.start(0.0)
        (burst,) = requests_in(exchange.take_outbox())
        block = reply_to(burst, content(239), offset=239 * (ahead - 1), ahead=ahead)
        exchange.receive(as_message(block), 0.3)
        assert exchange.round_trip.smoothed_s == measured


def test_download_late_block_does_not_shorten_measured_interval() -> None:
    """Blocks 0, 2 and 3 arrive in order, one each 0.1 s; block 1 arrives late, shortly before block 3."""
    download = Download(10_000)
    download.exchange.start(0.0)
    (burst,) = requests_in(download.exchange.take_outbox())
    for number, at in ((0, 0.1), (2, 0.3), (1, 0.39), (3, 0.4)):
        block = reply_to(burst, content(239), offset=239 * number, ahead=number + 1)
        download.exchange.receive(as_message(block), at)
    assert download.exchange._interval.smoothed_s == pytest.approx(0.1)


def test_download_of_grown_file_ends_at_old_size() -> None:
    download = Download(300)
    download.exchange.start(0.0)
    (burst,) = requests_in(download.exchange.take_outbox())
    for number in (0, 1):
        block = reply_to(burst, content(600)[239 * number :][:239], offset=239 * number, ahead=number + 1)
        download.exchange.receive(as_message(block), 0.1)
    assert download.exchange.result() == 300
    assert download.content == content(600)[:300]


def test_download_drops_read_block_after_old_size() -> None:
    download = Download(300)
    exchange = download.exchange
    exchange.start(0.0)
    (burst,) = requests_in(exchange.take_outbox())
    exchange.receive(as_message(reply_to(burst, code=MavFtpErr.UNKNOWNCOMMAND)), 0.1)
    reads = {request.offset: request for request in requests_in(exchange.take_outbox())}
    exchange.receive(as_message(reply_to(reads[478], bytes(239), offset=478)), 0.2)
    assert download.into.received_bytes == 0
    for offset in (239, 0):
        exchange.receive(as_message(reply_to(reads[offset], content(600)[offset:][:239], offset=offset)), 0.3)
    assert exchange.result() == 300
    assert download.content == content(600)[:300]


def test_download_of_empty_blocks_times_out() -> None:
    """After three such bursts only newly arrived data counts as progress."""
    download = Download(1000, idle_timeout_s=2.0)
    exchange = download.exchange
    exchange.start(0.0)
    now = heard_at = believed_until = 0.0
    answered = 0
    while not exchange.done:
        for request in requests_in(exchange.take_outbox()):
            heard_at, answered = now, answered + 1
            exchange.receive(as_message(reply_to(request, b"", offset=0)), now)
        assert exchange.deadline is not None
        now = exchange.deadline
        exchange.expire(now)
        if answered == MAX_REPEATED_BURSTS:
            believed_until = heard_at + 2.0
    assert now == pytest.approx(believed_until)


def test_download_timeout_names_missing() -> None:
    download = Download(1000, idle_timeout_s=2.0)
    exchange = download.exchange
    exchange.start(0.0)
    (burst,) = requests_in(exchange.take_outbox())
    exchange.receive(as_message(reply_to(burst, content(239), offset=0)), 0.1)
    exchange.receive(as_message(reply_to(burst, content(239), offset=478, ahead=3)), 0.1)
    messages = len(exchange.take_outbox())
    while not exchange.done:
        assert exchange.deadline is not None
        exchange.expire(exchange.deadline)
        messages += len(exchange.take_outbox())
    with pytest.raises(FileTimeout, match="read /a: no data received for 2 s") as raised:
        exchange.result()
    assert raised.value.missing == ((239, 239), (717, 283))
    assert messages < 40


def test_download_reports_lost_session() -> None:
    download = Download(1000)
    run(download.exchange, FileServer(bytearray(content(1000)), is_open=False))
    with pytest.raises(FtpSessionLost):
        download.exchange.result()


def test_download_ends_on_read_error() -> None:
    download = Download(1000)
    download.exchange.start(0.0)
    (burst,) = requests_in(download.exchange.take_outbox())
    download.exchange.receive(as_message(reply_to(burst, code=MavFtpErr.FAILERRNO)), 0.1)
    with pytest.raises(FileError, match="burst read /a"):
        download.exchange.result()


def test_download_reports_progress() -> None:
    reported: list[TransferProgress] = []
    download = Download(1000, on_progress=reported.append)
    run(download.exchange, FileServer(bytearray(content(1000))))
    assert [event.done for event in reported] == [239, 478, 717, 956, 1000]
    assert all(event.total == 1000 for event in reported)


# ------------------------------------------------------------------------------------ uploads


@given(
    st.integers(0, 12_000),
    st.sampled_from([0.0, 0.1, 0.3]),
    st.sampled_from([0.0, 0.2]),
    st.sampled_from([0.0, 0.06]),
    st.integers(0, 2**32),
)
def test_upload_arrives_despite_losses(size: int, loss: float, duplicates: float, jitter_s: float, seed: int) -> None:
    server = FileServer(bytearray())
    upload = FtpUpload(make_client(65530), "/a", content(size), session=1, round_trip=RoundTrip(0.1))
    outcome = run(upload, server, loss=loss, duplicates=duplicates, jitter_s=jitter_s, seed=seed, longest_s=120)
    assert upload.done
    upload.result()
    assert server.content == content(size)
    assert outcome.messages <= 40 + 6 * (size // DATA_SIZE + 1)


def test_upload_respects_server_queue() -> None:
    upload = FtpUpload(make_client(), "/a", content(5000), session=1, round_trip=RoundTrip(0.1))
    upload.start(0.0)
    writes = requests_in(upload.take_outbox())
    assert [(write.opcode, write.offset, write.size) for write in writes] == [
        (Op.WRITEFILE, 239 * n, 239) for n in range(4)
    ]


def test_upload_sends_first_block_last() -> None:
    upload = FtpUpload(make_client(), "@PARAM/param.pck", content(500), session=1, first_block_last=True)
    upload.start(0.0)
    offsets = []
    while not upload.done:
        for write in requests_in(upload.take_outbox()):
            offsets.append(write.offset)
            upload.receive(as_message(reply_to(write)), 0.1)
    assert offsets == [239, 478, 0]


def test_upload_refusal() -> None:
    for code, kind in ((MavFtpErr.FAIL, FileError), (MavFtpErr.INVALIDSESSION, FtpSessionLost)):
        upload = FtpUpload(make_client(), "/a", content(500), session=1)
        upload.start(0.0)
        first = requests_in(upload.take_outbox())[0]
        upload.receive(as_message(reply_to(first, code=code)), 0.1)
        with pytest.raises(kind, match="write /a"):
            upload.result()


def test_upload_without_answer_times_out() -> None:
    upload = FtpUpload(make_client(), "/a", content(500), session=1, idle_timeout_s=1.0)
    run(upload, FileServer(bytearray()), loss=1.0)
    with pytest.raises(FileTimeout, match="3 of 3 blocks") as raised:
        upload.result()
    assert raised.value.missing == ((0, 239), (239, 239), (478, 22))


def test_virtual_files_begin_with_at_sign() -> None:
    assert is_virtual("@PARAM/param.pck")
    assert not is_virtual("/APM/LOGS")
