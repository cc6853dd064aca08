"""The NTRIP client, with real sockets, against a caster on this computer."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import reduce
from operator import xor
from unittest.mock import AsyncMock, Mock

import anyio
import pytest
from caster import CasterServer, open_caster, rtcm
from exhaustive import exhaustive

import aerokit
from aerokit import messages as m
from aerokit.errors import BusyError, InvalidArgument, LinkOpenError, OperationRejected, OperationTimeout
from aerokit.sim import SimulatedCopter, simulated_link
from aerokit.vehicle.rtk import ntrip

pytestmark = [pytest.mark.anyio, pytest.mark.parametrize("anyio_backend", ["asyncio"])]


@asynccontextmanager
async def stage(**settings: object) -> AsyncIterator[tuple[CasterServer, aerokit.Vehicle, SimulatedCopter]]:
    copter = SimulatedCopter(boot_time_s=0.0)
    async with (
        open_caster(**settings) as caster,
        simulated_link(copter) as link,
        aerokit.connect(link, rates={}) as vehicle,
    ):
        with anyio.fail_after(20):
            yield caster, vehicle, copter


@pytest.mark.sampled(3)
@pytest.mark.parametrize(("version", "chunked"), [(2, True), (2, False), (1, False)])
async def test_corrections_reach_vehicle(version: int, chunked: bool) -> None:
    async with stage(version=version, chunked=chunked) as (caster, vehicle, _):
        async with vehicle.rtk.ntrip(caster.url()) as client:
            await vehicle.rtk.corrections.wait_until(lambda corrections: corrections.messages == 2)
            assert client.is_connected
            assert client.problem == ""
        assert vehicle.rtk.corrections.value.bytes_sent == 425
        assert len(caster.data_requests) == 1
        assert caster.sentences == []


@pytest.mark.parametrize("version", [2, exhaustive(1)])
async def test_wrong_password_is_refused_without_showing_it(version: int, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    async with stage(version=version) as (caster, vehicle, _):
        client = vehicle.rtk.ntrip(caster.url(credentials="someone:Geheim123@"))
        with pytest.raises(OperationRejected, match="the user or the password") as caught:
            await client.__aenter__()
        for text in (str(caught.value), repr(client), repr(vars(client)), caplog.text):
            assert "Geheim123" not in text
        assert not client.is_connected


@pytest.mark.exhaustive
@pytest.mark.parametrize("version", [1, 2])
async def test_unknown_mount_is_refused_with_known_ones(version: int) -> None:
    async with stage(version=version) as (caster, vehicle, _):
        with pytest.raises(OperationRejected, match="no mount point 'NOWHERE'"):
            async with vehicle.rtk.ntrip(caster.url("NOWHERE")):
                pass


@pytest.mark.exhaustive
async def test_source_table_lists_mounts_in_error() -> None:
    async with stage(version=1) as (caster, vehicle, _):
        with pytest.raises(OperationRejected, match="it has MOUNT, OTHER"):
            async with vehicle.rtk.ntrip(caster.url("NOWHERE")):
                pass


@pytest.mark.parametrize("passes", range(5))
async def test_cancellation_that_coincides_with_answer_is_kept(passes: int, monkeypatch: pytest.MonkeyPatch) -> None:
    reader = asyncio.StreamReader()
    left: list[str] = []

    async def connect(*_: object, **__: object) -> tuple[asyncio.StreamReader, Mock]:
        return reader, Mock(wait_closed=AsyncMock())

    async def use() -> None:
        async with vehicle.rtk.ntrip("ntrip://127.0.0.1/MOUNT", send_position=False):
            await anyio.sleep(0.1)
            left.append("the cancellation was lost")

    monkeypatch.setattr(ntrip, "open_connection", connect)
    async with simulated_link(SimulatedCopter(boot_time_s=0.0)) as link, aerokit.connect(link, rates={}) as vehicle:
        using = asyncio.create_task(use())
        await anyio.wait_all_tasks_blocked()
        reader.feed_data(b"ICY 200 OK\r\n")
        for _ in range(passes):
            await asyncio.sleep(0)
        using.cancel()
        await asyncio.wait([using])
        assert not left
        assert using.cancelled()


async def test_position_is_sent_if_table_asks_for_it() -> None:
    async with stage(needs_position=True) as (caster, vehicle, _):
        await vehicle.wait_ready()
        with vehicle.rate(m.GpsRawInt, 4):
            await vehicle.gps.wait_until(lambda _: True)
        async with vehicle.rtk.ntrip(caster.url()):
            await caster.received_sentence.wait()
        fields, _, checksum = caster.sentences[0].strip()[1:].partition("*")
        assert reduce(xor, fields.encode()) == int(checksum, 16)
        kind, _, latitude, north, longitude, east, quality, *_ = fields.split(",")
        place = vehicle.position.value
        assert (kind, north, east, quality) == ("GPGGA", "S", "E", "4")
        assert -(int(latitude[:2]) + float(latitude[2:]) / 60) == pytest.approx(place.latitude_deg, abs=1e-6)
        assert int(longitude[:3]) + float(longitude[3:]) / 60 == pytest.approx(place.longitude_deg, abs=1e-6)


@pytest.mark.exhaustive
async def test_position_is_not_sent_if_program_forbids() -> None:
    async with stage(needs_position=True) as (caster, vehicle, _):
        async with vehicle.rtk.ntrip(caster.url(), send_position=False):
            await vehicle.rtk.corrections.wait_until(lambda corrections: corrections.messages == 2)
        assert caster.sentences == []
        assert len(caster.requests) == 1


async def test_closed_connection_is_opened_again(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(ntrip, "MIN_RETRY_S", 0.01)
    async with stage(closes_after=True) as (caster, vehicle, _):
        async with vehicle.rtk.ntrip(caster.url()) as client:
            await vehicle.rtk.corrections.wait_until(lambda corrections: corrections.messages >= 6)
            assert client.reconnects >= 2
        assert "the caster closed the connection after 2 messages" in caplog.text


@pytest.mark.exhaustive
async def test_refusal_while_connecting_again_is_retried(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ntrip, "MIN_RETRY_S", 0.01)
    async with stage(closes_after=True) as (caster, vehicle, _), vehicle.rtk.ntrip(caster.url()) as client:
        await vehicle.rtk.corrections.wait_until(lambda corrections: corrections.messages >= 2)
        caster.answer = b"HTTP/1.1 401 Unauthorized\r\n\r\n"
        while "refused" not in client.problem:  # noqa: ASYNC110
            await anyio.sleep(0.01)
        caster.answer, before = None, vehicle.rtk.corrections.value.messages
        await vehicle.rtk.corrections.wait_until(lambda corrections: corrections.messages > before)


@pytest.mark.exhaustive
async def test_silent_caster_is_connected_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ntrip, "MIN_RETRY_S", 0.01)
    monkeypatch.setattr(ntrip, "MAX_SILENCE_S", 0.05)
    async with stage() as (caster, vehicle, _), vehicle.rtk.ntrip(caster.url()):
        await vehicle.rtk.corrections.wait_until(lambda corrections: corrections.messages >= 4)


@pytest.mark.exhaustive
async def test_long_message_is_left_out() -> None:
    messages = [rtcm(900), b"noise between", rtcm(25)]
    async with stage(messages=messages) as (caster, vehicle, _), vehicle.rtk.ntrip(caster.url()) as client:
        await vehicle.rtk.corrections.wait_until(lambda corrections: corrections.messages == 1)
        assert client.oversized == 1


class StalledTable:
    """A source table whose end arrives in two pieces, or not at all; the caster keeps the connection open."""

    def __init__(self, *pieces: bytes) -> None:
        self._pieces = pieces

    async def body(self) -> AsyncIterator[bytes]:
        for piece in (b"STR;MOUNT;Town\r\n", *self._pieces):
            yield piece
        await asyncio.Event().wait()


@pytest.mark.parametrize(("pieces", "timeout"), [((b"ENDSOURCE", b"TABLE\r\n"), 1000.0), ((), 0.01)])
async def test_stalled_source_table_ends(pieces: tuple[bytes, ...], timeout: float) -> None:
    async with stage() as (caster, vehicle, _):
        client = vehicle.rtk.ntrip(caster.url(), timeout=timeout)
        assert await client._read_source_table(StalledTable(*pieces)) == {"MOUNT": False}  # type: ignore[arg-type]


STRANGE_ANSWERS = (
    b"",
    b"\xff" * 100,
    b"HTTP/1.1 500 Internal Error\r\n\r\n",
    b"HTTP/1.1 200 OK\r\nContent-Type: gnss/sourcetable\r\n\r\nSTR;\r\nrubbish",
    b"ERROR\r\n",
)


@pytest.mark.exhaustive
async def test_strange_answer_is_refused() -> None:
    async with stage() as (caster, vehicle, _):
        for answer in STRANGE_ANSWERS:
            caster.answer = answer
            with pytest.raises(OperationRejected):
                async with vehicle.rtk.ntrip(caster.url()):
                    pass


@pytest.mark.exhaustive
async def test_endless_header_line_is_refused() -> None:
    async with stage(answer=b"HTTP/1.1 200 OK\r\nX: " + b"a" * 200_000) as (caster, vehicle, _):
        with pytest.raises(LinkOpenError):
            async with vehicle.rtk.ntrip(caster.url()):
                pass


@pytest.mark.exhaustive
@pytest.mark.parametrize("size", [b"zz", b"-1", b"100001"])
async def test_wrong_chunk_size_ends_connection_only(
    size: bytes, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(ntrip, "MIN_RETRY_S", 0.01)
    answer = b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n%s\r\n" % size
    async with stage(answer=answer) as (caster, vehicle, _), vehicle.rtk.ntrip(caster.url()) as client:
        while not client.reconnects:  # noqa: ASYNC110
            await anyio.sleep(0.01)
    assert "the connection failed (ValueError) after 0 messages" in caplog.text


@pytest.mark.exhaustive
async def test_caster_that_is_absent_raises_link_error() -> None:
    async with stage() as (caster, vehicle, _):
        url = caster.url().replace(str(caster.port), "1")
        with pytest.raises(LinkOpenError, match="the connection to the caster failed"):
            async with vehicle.rtk.ntrip(url):
                pass


@pytest.mark.exhaustive
async def test_caster_without_answer_times_out() -> None:
    async def ignore(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.read()
        writer.close()

    async with stage() as (_, vehicle, _), await asyncio.start_server(ignore, "127.0.0.1", 0) as server:
        port = server.sockets[0].getsockname()[1]
        with pytest.raises(OperationTimeout, match=r"within 0\.1 s"):
            async with vehicle.rtk.ntrip(f"ntrip://127.0.0.1:{port}/A", timeout=0.1):
                pass


async def test_cancelled_client_leaves_nothing() -> None:
    async with stage(needs_position=True) as (caster, vehicle, _):
        before = {task for task in asyncio.all_tasks() if "ntrip" in task.get_name()}

        async def run() -> None:
            async with vehicle.rtk.ntrip(caster.url()):
                await asyncio.Event().wait()

        task = asyncio.create_task(run())
        await vehicle.rtk.corrections.wait_until(lambda corrections: corrections.messages == 2)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        assert {each for each in asyncio.all_tasks() if "ntrip" in each.get_name()} == before
        while caster.open_connections:  # noqa: ASYNC110
            await anyio.sleep(0.01)


@pytest.mark.exhaustive
async def test_client_outlived_by_vehicle_block_ends() -> None:
    async with stage() as (caster, vehicle, _), vehicle.rtk.ntrip(caster.url()) as client:
        await vehicle.rtk.corrections.wait_until(lambda corrections: corrections.messages == 2)
        vehicle._session.background.cancel()
        while client.is_connected:  # noqa: ASYNC110
            await anyio.sleep(0.01)


@pytest.mark.exhaustive
async def test_client_entered_twice_raises_busy_error() -> None:
    async with stage() as (caster, vehicle, _), vehicle.rtk.ntrip(caster.url()) as client:
        with pytest.raises(BusyError):
            await client.__aenter__()


INVALID_URLS = (
    "http://someone:Geheim123@host/M",
    "ntrip://someone:Geheim123@host",
    "ntrip://someone:Geheim123@/M",
    "ntrip://someone:Geheim123/x@host:2101/M",
    "ntrip://someone:Geheim123@host:99999/M",
    "ntrip://someone:Geheim123@host:port/M",
    "ntrip://someone:Geheim123@host/M%0d%0aX-Header:1",
    "ntrip://someone:Geheim123@[host/M",
)


async def test_invalid_url_is_refused_without_showing_it() -> None:
    async with stage() as (_, vehicle, _):
        for url in INVALID_URLS:
            with pytest.raises(InvalidArgument) as caught:
                vehicle.rtk.ntrip(url)
            assert "Geheim" not in str(caught.value)
            with pytest.raises(InvalidArgument) as caught:
                vehicle.rtk.ntrip(url.encode())  # type: ignore[arg-type]
            assert "Geheim" not in str(caught.value)
