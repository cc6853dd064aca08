"""Calls about corrections, with an NTRIP caster in memory, because virtual time has no sockets."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

from call_stage import Stage
from caster import rtcm
from provoked import Do, Provocation, Table, lost

from aerokit.vehicle.rtk import ntrip

__all__ = ["RTK", "RTK_AWAITED", "RTK_BLOCKING", "memory_caster"]

URL = "ntrip://someone:secret@caster/MOUNT"
DATA = b"HTTP/1.1 200 OK\r\nContent-Type: gnss/data\r\n\r\n" + rtcm(25)


class _Writer:
    """The program's end of the connection. Like a real transport, it closes in the next loop iteration."""

    def write(self, data: bytes) -> None:
        pass

    def close(self) -> None:
        pass

    async def wait_closed(self) -> None:
        await asyncio.sleep(0)


@contextmanager
def memory_caster(answer: bytes | None = DATA, error: Exception | None = None) -> Iterator[None]:
    """Answer each connection with these bytes; None: no answer."""

    async def open_connection(*_: Any, **__: Any) -> Any:
        await asyncio.sleep(0.1)
        if error is not None:
            raise error
        reader = asyncio.StreamReader()
        if answer is not None:
            reader.feed_data(answer)
        return reader, _Writer()

    with patch.object(ntrip, "open_connection", open_connection):
        yield


def _with(do: Callable[[Any], Awaitable[object]], **caster: Any) -> Do:
    async def run(stage: Stage) -> None:
        with memory_caster(**caster):
            await do(stage.vehicle.rtk)

    return run


async def _fetch(rtk: Any) -> None:
    count = rtk.corrections.value.messages if rtk.corrections.is_known else 0
    async with rtk.ntrip(URL, send_position=True):
        await rtk.corrections.wait_until(lambda corrections: corrections.messages > count)


async def _enter_twice(rtk: Any) -> None:
    client = rtk.ntrip(URL, send_position=False)
    async with client, client:
        pass


def _send(trouble: Callable[[Stage], object]) -> Provocation:
    async def send(stage: Stage) -> None:
        rtk = stage.vehicle.rtk
        trouble(stage)
        await asyncio.sleep(0.1)
        rtk.send(rtcm(25))

    return Provocation(send, alone=True)


async def _send_damaged(stage: Stage) -> None:
    stage.vehicle.rtk.send(b"no message")


async def _wrong_url(stage: Stage) -> None:
    stage.vehicle.rtk.ntrip("http://caster/MOUNT")


RTK_AWAITED: dict[str, Do] = {"Rtk.ntrip": _with(_fetch)}
RTK_BLOCKING: dict[str, Callable[[Any], object]] = {
    "Rtk.send": lambda s: s.vehicle.rtk.send(rtcm(25)),
    "Rtk.ntrip": lambda s: s.vehicle.rtk.ntrip(URL),
}
RTK: Table = {
    ("Rtk.send", "InvalidArgument"): Provocation(_send_damaged),
    ("Rtk.send", "ConnectionClosed"): _send(lambda s: s.vehicle.connection.close()),
    ("Rtk.send", "LinkLost"): _send(lost),
    ("Rtk.ntrip", "InvalidArgument"): Provocation(_wrong_url),
    ("NtripClient", "BusyError"): Provocation(_with(_enter_twice)),
    ("NtripClient", "OperationRejected"): Provocation(_with(_fetch, answer=b"HTTP/1.1 401 Unauthorized\r\n\r\n")),
    ("NtripClient", "OperationTimeout"): Provocation(_with(_fetch, answer=None)),
    ("NtripClient", "LinkOpenError"): Provocation(_with(_fetch, error=OSError(111, "Connection refused"))),
}
