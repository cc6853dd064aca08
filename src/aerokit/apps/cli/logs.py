"""``aerokit logs``: the flight logs on a vehicle."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from aerokit.apps.cli.arguments import directory
from aerokit.apps.cli.output import DONE, FAILED, tell, tell_done
from aerokit.apps.cli.terminal import file_size, progress_bar
from aerokit.apps.cli.vehicle_command import add_action, agreed, connected
from aerokit.errors import InvalidArgument

if TYPE_CHECKING:
    from collections.abc import Sequence

    from aerokit.vehicle.files.logs import LogEntry


def add_arguments(command: argparse.ArgumentParser) -> None:
    """The actions of the command, and their arguments."""
    actions = command.add_subparsers(required=True, metavar="ACTION", title="actions")
    add_action(actions, "list", _list, "List the flight logs.")
    get = add_action(actions, "get", _get, "Download flight logs; what was begun before is continued.")
    get.add_argument("ids", nargs="*", type=int, metavar="ID", help="of the logs (the newest)")
    get.add_argument("--all", action="store_true", help="every log")
    get.add_argument(
        "--to", type=directory, default=Path(), metavar="DIRECTORY", help="where to put them (this directory)"
    )
    get.add_argument(
        "--method", choices=("auto", "ftp", "log"), default="auto", help="of the download (auto)"
    )
    erase = add_action(actions, "erase", _erase, "Erase all flight logs.")
    erase.add_argument("--yes", action="store_true", help="do not ask")


async def _list(options: argparse.Namespace) -> int:
    async with connected(options) as vehicle:
        for entry in await vehicle.logs.list(patience_s=options.patience):
            time = "" if entry.time_utc is None else f"{entry.time_utc:%Y-%m-%d %H:%M:%S}"
            tell(options, "log", entry.to_dict(), f"{entry.id:>6}  {entry.size:>12}  {time}".rstrip())
    return DONE


async def _get(options: argparse.Namespace) -> int:
    async with connected(options) as vehicle:
        entries = await vehicle.logs.list(patience_s=options.patience)
        for entry in _chosen(entries, options):
            to = options.to / f"log{entry.id:05}{vehicle.autopilot.log_suffix}"
            with progress_bar(to.name, "B") as show:
                await vehicle.logs.download(
                    entry, to, method=options.method, patience_s=options.patience, on_progress=show
                )
            size = file_size(to)
            tell(options, "fetched_log", {"id": entry.id, "file": to, "bytes": size}, f"{to}: {size} bytes")
    return DONE


def _chosen(entries: Sequence[LogEntry], options: argparse.Namespace) -> Sequence[LogEntry]:
    if options.all or not options.ids:
        return entries if options.all else entries[-1:]
    known = {entry.id: entry for entry in entries}
    for log_id in options.ids:
        if log_id not in known:
            raise InvalidArgument(
                f"there is no log {log_id}: {', '.join(map(str, known)) or 'there are none'}"
            )
    return [known[log_id] for log_id in options.ids]


async def _erase(options: argparse.Namespace) -> int:
    if not options.yes and not agreed("erase all flight logs of the vehicle?"):
        tell(options, "declined", {"action": "logs erase"}, "nothing was erased")
        return FAILED
    async with connected(options, changes=True) as vehicle:
        await vehicle.logs.erase(patience_s=options.patience)
    tell_done(options, "logs erase", "erased")
    return DONE
