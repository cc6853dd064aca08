"""What the commands that listen to a whole link share: its address, how long to listen, and the connection."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING

import anyio

from aerokit.apps.cli.arguments import number
from aerokit.apps.cli.output import add_json
from aerokit.apps.cli.terminal import on_interrupt, waiting
from aerokit.apps.cli.vehicle_command import ENVIRONMENT, add_place, add_signing_key, signing_of
from aerokit.errors import ConnectFailed

if TYPE_CHECKING:
    import argparse
    from collections.abc import AsyncIterator

    from aerokit.connection.connection import Connection
    from aerokit.transport.link import Link


def add_link(command: argparse.ArgumentParser, *, default: str | None = None) -> None:
    """Add the address, what belongs to it, and ``--json``; ``default`` says what happens without an address."""
    add_place(command, default=default)
    add_signing_key(command, f"of vehicles that want signed messages (${ENVIRONMENT})")
    add_json(command)


def add_seconds(command: argparse.ArgumentParser, text: str, default: float | None = None) -> None:
    """Add ``--seconds``."""
    command.add_argument("--seconds", type=number(0.1, 1e6), default=default, metavar="S", help=text)


@asynccontextmanager
async def opened(options: argparse.Namespace, *, reconnect: bool = False) -> AsyncIterator[Connection]:
    """A connection to the address, or to the link, that the options name; nothing but heartbeats is sent.

    ``reconnect``: one that is lost is opened again, if it has an address.
    """
    from aerokit.connection.opening import ONLOOKER, open_connection

    place: str | Link = options.address
    async with open_connection(
        place,
        baud=options.baud,
        signing=signing_of(options),
        source_system=ONLOOKER,
        reconnect=reconnect and isinstance(place, str),
    ) as connection:
        yield connection


async def await_vehicle(connection: Connection, options: argparse.Namespace, patience_s: float) -> None:
    """Wait for the first heartbeat of an autopilot.

    Raises:
        ConnectFailed: none came; the text says what was heard instead.
        ConnectionClosed, LinkLost: the connection ended.
    """
    from aerokit.connection.opening import no_vehicle_reason

    async with AsyncExitStack() as stack:
        await stack.enter_async_context(waiting(options, connection.link.address, patience_s))
        with anyio.move_on_after(patience_s):
            async for _ in connection.vehicles():
                return
    raise ConnectFailed(
        f"no heartbeat of an autopilot within {patience_s:g} s on {connection.link.address}:"
        f" {no_vehicle_reason(connection, None)}"
    )


async def await_end(
    connection: Connection, seconds: float | None, work: asyncio.Task[None] | None = None
) -> bool:
    """Wait for Ctrl-C or for so many seconds; whether it was Ctrl-C. Raises what ended the connection, if it did.

    ``work``: what is done meanwhile; its end, by an error of its own, ends the waiting, too.
    """
    ended = asyncio.Event()
    interrupted = False

    def interrupt() -> None:
        nonlocal interrupted
        interrupted = True
        ended.set()

    detach = connection.on_end(lambda _: ended.set())
    if work is not None:
        work.add_done_callback(lambda _: ended.set())
    try:
        with on_interrupt(interrupt), anyio.move_on_after(seconds):
            await ended.wait()
    finally:
        detach()
    if not interrupted:
        connection.raise_if_ended()
    return interrupted
