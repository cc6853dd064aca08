"""``aerokit events``: what happens on a link and what vehicles say, as it comes."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack, suppress
from datetime import datetime, timezone
from typing import TYPE_CHECKING, Any

from aerokit._internal.wording import in_words
from aerokit.apps.cli.link_command import add_link, add_seconds, await_end, opened
from aerokit.apps.cli.output import DONE, INTERRUPTED, tell
from aerokit.apps.cli.terminal import waiting
from aerokit.errors import AerokitError
from aerokit.events import Event, LinkReport, StatusTextReceived

if TYPE_CHECKING:
    import argparse

    from aerokit.connection.connection import Connection

WAITING = 1000
"""So many events may wait to be printed; of more, the oldest are dropped and counted."""
SEVERITIES = ("EMERGENCY", "ALERT", "CRITICAL", "ERROR", "WARNING", "NOTICE", "INFO", "DEBUG")
PATIENCE_S = 30.0
"""After so long it waits on, without a countdown."""


def add_arguments(command: argparse.ArgumentParser) -> None:
    """The arguments of the command."""
    command.set_defaults(run=run_events)
    add_link(command)
    add_seconds(command, "end after so many seconds (with Ctrl-C)")
    command.add_argument(
        "--all", action="store_true", help="how the link did, too, once a second for each vehicle"
    )


async def run_events(options: argparse.Namespace) -> int:
    """Print them until interrupted, or for as long as was asked; a link that is lost is opened again."""
    from aerokit.vehicle.connect import vehicles_on

    async with AsyncExitStack() as stack:
        connection = await stack.enter_async_context(opened(options, reconnect=True))
        # before the vehicles: what they tell first is an event, too
        printing = asyncio.create_task(_print_all(connection, options))
        stack.push_async_callback(_end, printing)
        await stack.enter_async_context(vehicles_on(connection, rates={}))
        is_interrupted = await await_end(connection, options.seconds, printing)
    return INTERRUPTED if is_interrupted and options.seconds is not None else DONE


async def _print_all(connection: Connection, options: argparse.Namespace) -> None:
    wall_at_0 = connection.unix_time() - connection.now()
    async with AsyncExitStack() as stack:
        news = stack.enter_context(connection.subscribe(Event, capacity=WAITING))
        missed = 0
        async with waiting(options, connection.link.address, PATIENCE_S):
            event = await news.get()
        with suppress(AerokitError):  # the end of the connection, which is told elsewhere
            while True:
                if options.all or not isinstance(event, LinkReport):
                    _tell(event, wall_at_0 + event.at, options)
                if news.missed > missed:
                    tell(options, "missed", {"events": news.missed - missed}, None)
                    missed = news.missed
                event = await news.get()


async def _end(task: asyncio.Task[None]) -> None:
    task.cancel()
    with suppress(asyncio.CancelledError, AerokitError):
        await task


def _tell(event: Event, unix_s: float, options: argparse.Namespace) -> None:
    details = {name: value for name, value in event.to_dict().items() if name not in ("at", "system_id")}
    record = {
        "time_unix_s": unix_s,
        "system_id": event.system_id,
        "event": type(event).__name__,
        "details": details,
    }
    time = datetime.fromtimestamp(unix_s, timezone.utc).astimezone()
    who = "  -" if event.system_id == 0 else f"{event.system_id:>3}"
    tell(
        options,
        "event",
        record,
        f"{time:%H:%M:%S}.{time.microsecond // 1000:03}  {who}  {_text(event, details)}",
    )


def _text(event: Event, details: dict[str, Any]) -> str:
    if isinstance(event, StatusTextReceived):
        severity = SEVERITIES[event.severity] if 0 <= event.severity < len(SEVERITIES) else event.severity
        return f"{severity}: {event.text}"
    shown = ", ".join(f"{name} {in_words(value)}" for name, value in details.items())
    return f"{type(event).__name__}  {shown}".rstrip()
