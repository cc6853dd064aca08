"""``aerokit files`` and ``aerokit logs``: files on a vehicle by MAVFTP, and its flight logs."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from aerokit.apps.cli.arguments import directory
from aerokit.apps.cli.connecting import add_action, command_action, connected
from aerokit.apps.cli.output import DONE, FAILED, add_force, check_not_existing, emit
from aerokit.apps.cli.terminal import progress_bar
from aerokit.connection.frame_observers import keep_existing
from aerokit.errors import InvalidArgument

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sequence

    from aerokit.vehicle.files.logs import LogEntry
    from aerokit.vehicle.vehicle import Vehicle


def add_arguments(command: argparse.ArgumentParser) -> None:
    actions = command.add_subparsers(required=True, metavar="ACTION", title="actions")
    listing = add_action(actions, "ls", _list, "List a directory.")
    listing.add_argument("path", nargs="?", default="/", help="directory on the vehicle (default: /)")
    get = add_action(actions, "get", _get, "Download a file; a partial download is resumed.")
    get.add_argument("path", help="path on the vehicle")
    get.add_argument("to", nargs="?", help="local file or directory (default: the same name in this directory)")
    add_force(get)
    put = add_action(actions, "put", _put, "Upload a file.")
    put.add_argument("file", help="local file")
    put.add_argument("path", help="path on the vehicle")
    remove = command_action("files rm", "removed {path}", _action_on_path("remove"))
    rmdir = command_action("files rmdir", "removed {path}", _action_on_path("remove_directory"))
    mkdir = command_action("files mkdir", "created {path}", _action_on_path("make_directory"))
    rename = command_action(
        "files mv",
        "renamed {path} to {new_path}",
        lambda vehicle, options: vehicle.files.rename(options.path, options.new_path, idle_timeout_s=options.patience),
    )
    for name, run, text in (
        ("rm", remove, "Remove a file."),
        ("rmdir", rmdir, "Remove an empty directory."),
        ("mkdir", mkdir, "Create a directory."),
        ("crc", _crc, "Print the CRC-32 of a file, computed by the vehicle."),
    ):
        add_action(actions, name, run, text).add_argument("path", help="path on the vehicle")
    move = add_action(actions, "mv", rename, "Rename a file or directory.")
    move.add_argument("path", help="path on the vehicle")
    move.add_argument("new_path", help="path on the vehicle")


def _action_on_path(method: str) -> Callable[[Vehicle, argparse.Namespace], Awaitable[object]]:
    """Return an action that calls a method of `vehicle.files` with the path of the options."""
    return lambda vehicle, options: getattr(vehicle.files, method)(options.path, idle_timeout_s=options.patience)


def _size(path: str | os.PathLike[str]) -> int:
    return os.path.getsize(path)


async def _list(options: argparse.Namespace) -> None:
    async with connected(options) as vehicle:
        for entry in await vehicle.files.list(options.path, idle_timeout_s=options.patience):
            size = "" if entry.size is None else f"{entry.size}"
            text = f"{size:>12}  {entry.name}{'/' if entry.is_directory else ''}"
            emit(options, "file", {"directory": options.path, **entry.to_dict()}, text)


async def _get(options: argparse.Namespace) -> None:
    target = _destination(options)
    check_not_existing(target, options)
    async with connected(options) as vehicle:
        with progress_bar(target.name, unit="B") as on_progress:
            await vehicle.files.download(
                options.path, target, resume=True, idle_timeout_s=options.patience, on_progress=on_progress
            )
    size = _size(target)
    emit(options, "fetched", {"path": options.path, "file": target, "bytes": size}, f"{target}: {size} bytes")


def _destination(options: argparse.Namespace) -> Path:
    name = PurePosixPath(options.path).name
    target = Path(options.to or name)
    return target / name if target.is_dir() else target


async def _put(options: argparse.Namespace) -> None:
    size = _size(options.file)
    async with connected(options, changes_vehicle=True) as vehicle:
        with progress_bar(Path(options.file).name, unit="B") as on_progress:
            await vehicle.files.upload(
                options.file, options.path, idle_timeout_s=options.patience, on_progress=on_progress
            )
    record = {"file": options.file, "path": options.path, "bytes": size}
    emit(options, "sent", record, f"{options.path}: {size} bytes")


async def _crc(options: argparse.Namespace) -> None:
    async with connected(options) as vehicle:
        crc = f"{await vehicle.files.crc32(options.path, idle_timeout_s=options.patience):08x}"
    emit(options, "crc", {"path": options.path, "crc32": crc}, crc)


def add_logs_arguments(command: argparse.ArgumentParser) -> None:
    actions = command.add_subparsers(required=True, metavar="ACTION", title="actions")
    add_action(actions, "list", _list_logs, "List the flight logs.")
    get = add_action(actions, "get", _get_logs, "Download flight logs; a partial download is resumed.")
    get.add_argument("ids", nargs="*", type=int, metavar="ID", help="ids of logs (default: the newest)")
    get.add_argument("--all", action="store_true", help="every log")
    get.add_argument(
        "--to",
        type=directory,
        default=Path(),
        metavar="DIRECTORY",
        help="directory to write them to, which is created if needed (default: this directory)",
    )
    get.add_argument("--method", choices=("auto", "ftp", "log"), default="auto", help="download method (default: auto)")
    run_erase = command_action(
        "logs erase",
        "erased",
        lambda vehicle, options: vehicle.logs.erase(idle_timeout_s=options.patience),
        question="erase all flight logs of the vehicle?",
    )
    erase = add_action(actions, "erase", run_erase, "Erase all flight logs.")
    erase.add_argument("--yes", action="store_true", help="do not ask")


async def _list_logs(options: argparse.Namespace) -> None:
    async with connected(options) as vehicle:
        for entry in await vehicle.logs.list(idle_timeout_s=options.patience):
            time = "" if entry.time_utc is None else f"{entry.time_utc:%Y-%m-%d %H:%M:%S}"
            emit(options, "log", entry.to_dict(), f"{entry.id:>6}  {entry.size:>12}  {time}".rstrip())


async def _get_logs(options: argparse.Namespace) -> int:
    async with connected(options) as vehicle:
        entries = await vehicle.logs.list(idle_timeout_s=options.patience)
        options.to.mkdir(parents=True, exist_ok=True)
        for entry in _selected_logs(entries, options):
            target = options.to / f"log{entry.id:05}{vehicle.autopilot.log_suffix}"
            # The vehicle counts from 1 again after its logs were erased, so the file may be of another flight.
            kept_as = keep_existing(target) if target.exists() else None
            if kept_as is not None:
                print(f"aerokit: {target} existed and was kept as {kept_as}", file=sys.stderr)
            with progress_bar(target.name, unit="B") as on_progress:
                await vehicle.logs.download(
                    entry, target, method=options.method, idle_timeout_s=options.patience, on_progress=on_progress
                )
            size = _size(target)
            emit(options, "fetched_log", {"id": entry.id, "file": target, "bytes": size}, f"{target}: {size} bytes")
    if not entries:
        print("aerokit: the vehicle has no logs", file=sys.stderr)
    return DONE if entries else FAILED


def _selected_logs(entries: Sequence[LogEntry], options: argparse.Namespace) -> Sequence[LogEntry]:
    if options.all:
        return entries
    if not options.ids:
        return entries[-1:]  # the newest log, which is the last one
    by_id = {entry.id: entry for entry in entries}
    for log_id in options.ids:
        if log_id not in by_id:
            raise InvalidArgument(f"the vehicle has no log {log_id}; its logs: {', '.join(map(str, by_id)) or 'none'}")
    return [by_id[log_id] for log_id in options.ids]
