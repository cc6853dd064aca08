"""``aerokit record``: everything that comes over a link, in a telemetry log."""

from __future__ import annotations

import os
from argparse import ArgumentTypeError
from collections import Counter
from typing import TYPE_CHECKING

from aerokit.apps.cli.arguments import writable_file
from aerokit.apps.cli.link_command import add_link, add_seconds, await_end, opened
from aerokit.apps.cli.output import DONE, FAILED, INTERRUPTED, make_new_recording, remove_if_empty, tell
from aerokit.errors import AerokitError

if TYPE_CHECKING:
    import argparse

    from aerokit.connection.connection import Connection
    from aerokit.mavlink.frame import Frame
    from aerokit.transport.link import Peer


def add_arguments(command: argparse.ArgumentParser) -> None:
    """The arguments of the command."""
    command.set_defaults(run=run_record)
    add_link(command)
    command.add_argument(
        "file",
        type=_log_file,
        metavar="FILE",
        help="flight.tlog; none that is there already; behind ADDRESS, without options in between",
    )
    add_seconds(command, "end after so many seconds (with Ctrl-C)")
    command.add_argument(
        "--ask",
        action="store_true",
        help="ask the vehicles for the rates that every aerokit program asks for; else only what comes is recorded",
    )


def _log_file(text: str) -> str:
    """An address in the place of the file is no name for it."""
    if not text.lower().endswith(".tlog"):
        raise ArgumentTypeError(f"{text!r} does not end in .tlog")
    return writable_file(text)


async def run_record(options: argparse.Namespace) -> int:
    """Record until interrupted, or for as long as was asked; a link that is lost is opened again."""
    counts: Counter[tuple[int, int]] = Counter()

    def count(frame: Frame, peer: Peer) -> None:
        counts[frame.system_id, frame.message_id] += 1

    make_new_recording(options.file)
    error: AerokitError | None = None
    try:
        async with opened(options, reconnect=True) as connection:
            started = connection.now()
            connection.record(options.file)
            connection.tap(count)
            text = f"recording {connection.link.address} to {options.file}, until Ctrl-C"
            tell(options, "recording", {"address": connection.link.address, "file": options.file}, text)
            try:
                is_interrupted = await _record(connection, options)
            except AerokitError as ended:  # what came until then is in the file all the same
                error, is_interrupted = ended, False
            seconds = connection.now() - started
    except BaseException:
        remove_if_empty(options.file)
        raise
    _tell_counts(options, counts, seconds)
    if error is not None:
        raise error
    if not counts:
        return FAILED
    return INTERRUPTED if is_interrupted and options.seconds is not None else DONE


async def _record(connection: Connection, options: argparse.Namespace) -> bool:
    if not options.ask:
        return await await_end(connection, options.seconds)
    from aerokit.vehicle.connect import vehicles_on

    async with vehicles_on(connection):
        return await await_end(connection, options.seconds)


def _tell_counts(options: argparse.Namespace, counts: Counter[tuple[int, int]], seconds: float) -> None:
    from aerokit.mavlink.dialect import STANDARD

    messages: Counter[str] = Counter()
    for (_, message_id), number in counts.items():
        known = STANDARD.get(message_id)
        messages[str(message_id) if known is None else known.NAME] += number
    systems = sorted({system_id for system_id, _ in counts})
    size = os.path.getsize(options.file)
    record = {
        "file": options.file,
        "seconds": seconds,
        "frames": sum(counts.values()),
        "bytes": size,
        "systems": systems,
        "messages": dict(messages.most_common()),
    }
    whose = f" of system{'s' if len(systems) > 1 else ''} {', '.join(map(str, systems))}" if systems else ""
    most = ", ".join(f"{name} {number}" for name, number in messages.most_common(5))
    text = f"{options.file}: {sum(counts.values())} frames received{whose} in {seconds:.1f} s, {size} bytes"
    if set(messages) == {"HEARTBEAT"} and not options.ask:
        most += "; nothing else: --ask asks the vehicle for position, attitude and the rest"
    tell(options, "recorded", record, f"{text}\n  {most}" if most else f"{text}: nothing was heard")
