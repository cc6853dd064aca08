"""Commands that listen to a link: ``aerokit record``, ``events`` and ``monitor``."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
import threading
from collections import Counter
from contextlib import AsyncExitStack, ExitStack, contextmanager, suppress
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING

import anyio

from aerokit.apps.cli.arguments import add_record, log_file
from aerokit.apps.cli.connecting import (
    SIGNING_KEY_VARIABLE,
    add_address,
    add_link,
    add_seconds,
    add_signing_key,
    await_end,
    opened,
    signing_of,
)
from aerokit.apps.cli.output import DONE, FAILED, INTERRUPTED, can_print, emit, import_extra, new_recording
from aerokit.apps.cli.terminal import on_interrupt, showing_countdown
from aerokit.apps.event_text import event_details
from aerokit.errors import AerokitError, InvalidArgument
from aerokit.events import Event, LinkReport, StatusTextReceived

if TYPE_CHECKING:
    import argparse
    from collections.abc import Iterator

    from aerokit.connection.connection import Connection
    from aerokit.mavlink.frame import Frame
    from aerokit.transport.link import Peer

# If more events wait because the terminal prints slowly, the oldest are dropped and counted.
_MAX_WAITING_EVENTS = 1000
_POLL_INTERVAL_S = 0.1  # how often to check whether a stopped terminal accepts output again
_SEVERITIES = ("EMERGENCY", "ALERT", "CRITICAL", "ERROR", "WARNING", "NOTICE", "INFO", "DEBUG")
# The countdown ends after this time. The command then continues to wait without a countdown.
_COUNTDOWN_S = 30.0
EXIT_TIMEOUT_S = 3.0
"""Seconds after a signal at which the process is ended by force, in case Textual does not exit."""


def add_arguments(command: argparse.ArgumentParser) -> None:
    command.set_defaults(run=run_record)
    add_link(command)
    command.add_argument("file", type=log_file, metavar="FILE", help="flight.tlog; directly after ADDRESS")
    add_seconds(command, "stop after S seconds (default: at Ctrl-C)")
    command.add_argument(
        "--as-is", action="store_true", help="request nothing; by default, request aerokit's usual message rates"
    )


async def run_record(options: argparse.Namespace) -> int:
    with new_recording(options.file):
        return await _record_link(options)


async def _record_link(options: argparse.Namespace) -> int:
    counts: Counter[tuple[int, int]] = Counter()

    def count(frame: Frame, peer: Peer) -> None:
        counts[frame.system_id, frame.message_id] += 1

    error: AerokitError | None = None
    async with opened(options, reconnect=True) as connection:
        started_at = connection.now()
        connection.record(options.file)
        connection.observe_frames(count)
        text = f"recording {connection.link.address} to {options.file} until Ctrl-C"
        emit(options, "recording", {"address": connection.link.address, "file": options.file}, text)
        try:
            is_interrupted = await _wait_for_end(connection, options)
        except AerokitError as connection_error:  # raised again below, after the report of the counts
            error = connection_error
            is_interrupted = False
        seconds = connection.now() - started_at
    _emit_counts(options, counts, seconds)
    if error is not None:
        raise error
    if not counts:
        return FAILED
    # Without --seconds, Ctrl-C is the normal end of the command.
    return INTERRUPTED if is_interrupted and options.seconds is not None else DONE


async def _wait_for_end(connection: Connection, options: argparse.Namespace) -> bool:
    """Wait for the end of the recording. Return True after Ctrl-C."""
    if options.as_is:
        return await await_end(connection, options.seconds)
    from aerokit.vehicle.connect import vehicles_on

    async with vehicles_on(connection):  # This requests message rates from each vehicle.
        return await await_end(connection, options.seconds)


def _emit_counts(options: argparse.Namespace, counts: Counter[tuple[int, int]], seconds: float) -> None:
    """Print which messages were recorded, and how many.

    The keys of ``counts`` are (system id, message id).
    """
    from aerokit.mavlink.dialect import STANDARD

    messages: Counter[str] = Counter()
    for (_, message_id), count in counts.items():
        message = STANDARD.get(message_id)
        messages[str(message_id) if message is None else message.NAME] += count
    systems = sorted({system_id for system_id, _ in counts})
    # Without a received frame, this command creates no file. An existing file is an earlier recording.
    size = os.path.getsize(options.file) if counts else 0
    record = {
        "file": options.file,
        "seconds": seconds,
        "frames": sum(counts.values()),
        "bytes": size,
        "systems": systems,
        "messages": dict(messages.most_common()),
    }
    sources = f" from system{'s' if len(systems) > 1 else ''} {', '.join(map(str, systems))}" if systems else ""
    details = ", ".join(f"{name} {count}" for name, count in messages.most_common(5))
    text = f"{options.file}: {sum(counts.values())} frames received{sources} in {seconds:.1f} s, {size} bytes"
    has_only_heartbeats = set(messages) == {"HEARTBEAT"}
    if has_only_heartbeats and options.as_is:
        details += "; no other messages: without --as-is, position, attitude and other messages are requested"
    emit(options, "recorded", record, f"{text}\n  {details}" if details else f"{text}: nothing was received")


def add_events_arguments(command: argparse.ArgumentParser) -> None:
    command.set_defaults(run=run_events)
    add_link(command)
    add_seconds(command, "stop after S seconds (default: at Ctrl-C)")
    command.add_argument("--all", action="store_true", help="include the link quality of each vehicle, once a second")


async def run_events(options: argparse.Namespace) -> int:
    from aerokit.vehicle.connect import vehicles_on

    async with AsyncExitStack() as stack:
        connection = await stack.enter_async_context(opened(options, reconnect=True))
        # The task starts before the vehicles are connected, so that their first events are printed, too.
        printing = asyncio.create_task(_print_all(connection, options))
        stack.push_async_callback(_cancel, printing)
        await stack.enter_async_context(vehicles_on(connection, rates={}))
        is_interrupted = await await_end(connection, options.seconds, work=printing)
    return INTERRUPTED if is_interrupted and options.seconds is not None else DONE


async def _print_all(connection: Connection, options: argparse.Namespace) -> None:
    unix_time_at_0 = connection.unix_time() - connection.now()
    # get() raises an error when the connection ends. The error is suppressed, because await_end() raises it as well.
    with suppress(AerokitError), connection.subscribe(Event, capacity=_MAX_WAITING_EVENTS) as events:
        missed = 0
        async with showing_countdown(options, connection.link.address, _COUNTDOWN_S):
            event = await events.get()
        while True:
            while not can_print():  # noqa: ASYNC110 - printing would block the event loop, and with it our heartbeat
                await anyio.sleep(_POLL_INTERVAL_S)
            if events.missed > missed:
                new_missed = events.missed - missed
                emit(options, "missed", {"events": new_missed}, f"{new_missed} events were dropped")
                missed = events.missed
            if options.all or not isinstance(event, LinkReport):
                _emit_event(event, unix_time_at_0 + event.at, options)
            event = await events.get()


async def _cancel(task: asyncio.Task[None]) -> None:
    task.cancel()
    with suppress(asyncio.CancelledError, AerokitError):
        await task


def _emit_event(event: Event, unix_s: float, options: argparse.Namespace) -> None:
    details = {name: value for name, value in event.to_dict().items() if name not in ("at", "system_id")}
    record = {"time_unix_s": unix_s, "system_id": event.system_id, "event": type(event).__name__, "details": details}
    time = datetime.fromtimestamp(unix_s, timezone.utc).astimezone()
    system = "  -" if event.system_id == 0 else f"{event.system_id:>3}"
    emit(options, "event", record, f"{time:%H:%M:%S}.{time.microsecond // 1000:03}  {system}  {_event_text(event)}")


def _event_text(event: Event) -> str:
    if isinstance(event, StatusTextReceived):
        severity = _SEVERITIES[event.severity] if 0 <= event.severity < len(_SEVERITIES) else event.severity
        return f"{severity}: {event.text}"
    return f"{type(event).__name__}  {event_details(event)}".rstrip()


def add_monitor_arguments(command: argparse.ArgumentParser) -> None:
    command.set_defaults(run=run_monitor)
    add_address(command)
    add_signing_key(command, f"signing key of the vehicles (${SIGNING_KEY_VARIABLE})")
    add_record(command)


async def run_monitor(options: argparse.Namespace) -> int:
    import_extra("textual", extra="monitor")
    from aerokit.apps.monitor.app import run_monitor as run_app

    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise InvalidArgument("aerokit monitor needs a terminal, but stdin or stdout is redirected")
    with ExitStack() as stack:

        def force_exit_later(signal_number: int) -> None:
            # The signal handler itself starts the timer, because a blocked event loop could not do so.
            if signal_number == getattr(signal, "SIGHUP", None):
                _detach_terminal()
            timer = threading.Timer(EXIT_TIMEOUT_S, os._exit, (INTERRUPTED,))
            timer.daemon = True
            timer.start()
            stack.callback(timer.cancel)

        stack.enter_context(new_recording(options.record))
        stack.enter_context(_printing_kept_name(options.record))
        return await run_app(
            options.address,
            baud=options.baud,
            signing=signing_of(options),
            record=options.record,
            on_start=lambda app: stack.enter_context(on_interrupt(app.exit, in_handler=force_exit_later)),
        )


@contextmanager
def _printing_kept_name(path: str | None) -> Iterator[None]:
    """If the block renames the existing file at ``path``, print its new name afterwards."""
    if path is None or not os.path.isfile(path):
        yield
        return
    # Textual hides the link's log message with the new name, so the name is found by the file's inode.
    existing_file = os.stat(path)
    yield
    for file in Path(path).resolve().parent.iterdir():
        if file.name != Path(path).name and os.path.samestat(file.lstat(), existing_file):
            print(f"{path} existed and was kept as {file.name}", file=sys.stderr)


def _detach_terminal() -> None:
    # Textual's output thread ends when it writes to a closed terminal. Later writes would then block the event loop.
    with open(os.devnull, "w") as null_device:
        for stream in (1, 2):  # stdout and stderr
            os.dup2(null_device.fileno(), stream)
