"""``aerokit files``: the files on a vehicle, by MAVFTP."""

from __future__ import annotations

import argparse
from pathlib import Path, PurePosixPath

from aerokit.apps.cli.output import DONE, tell, tell_done
from aerokit.apps.cli.terminal import file_size, progress_bar
from aerokit.apps.cli.vehicle_command import add_action, connected


def add_arguments(command: argparse.ArgumentParser) -> None:
    """The actions of the command, and their arguments."""
    actions = command.add_subparsers(required=True, metavar="ACTION", title="actions")
    listing = add_action(actions, "ls", _list, "List a directory.")
    listing.add_argument("path", nargs="?", default="/", help="directory on the vehicle (/)")
    get = add_action(actions, "get", _get, "Fetch a file; one begun before is continued.")
    get.add_argument("path", help="on the vehicle")
    get.add_argument("to", nargs="?", help="here (the same name in this directory)")
    put = add_action(actions, "put", _put, "Write a file to the vehicle.")
    put.add_argument("file", help="here")
    put.add_argument("path", help="on the vehicle")
    for name, run, text in (
        ("rm", _remove, "Remove a file."),
        ("rmdir", _remove_directory, "Remove an empty directory."),
        ("mkdir", _make_directory, "Make a directory."),
        ("crc", _crc, "Print the CRC-32 that the vehicle computes of a file."),
    ):
        add_action(actions, name, run, text).add_argument("path", help="on the vehicle")
    move = add_action(actions, "mv", _move, "Rename a file or directory.")
    move.add_argument("path", help="on the vehicle")
    move.add_argument("new_path", help="on the vehicle")


async def _list(options: argparse.Namespace) -> int:
    async with connected(options) as vehicle:
        for entry in await vehicle.files.list(options.path, patience_s=options.patience):
            size = "" if entry.size is None else f"{entry.size}"
            text = f"{size:>12}  {entry.name}{'/' if entry.is_directory else ''}"
            tell(options, "file", {"directory": options.path, **entry.to_dict()}, text)
    return DONE


async def _get(options: argparse.Namespace) -> int:
    to = _destination(options)
    async with connected(options) as vehicle:
        with progress_bar(to.name, "B") as show:
            await vehicle.files.download(
                options.path, to, resume=True, patience_s=options.patience, on_progress=show
            )
    size = file_size(to)
    tell(options, "fetched", {"path": options.path, "file": to, "bytes": size}, f"{to}: {size} bytes")
    return DONE


def _destination(options: argparse.Namespace) -> Path:
    """Where to put a file: where it is wanted, or under its own name."""
    name = PurePosixPath(options.path).name
    to = Path(options.to or name)
    return to / name if to.is_dir() else to


async def _put(options: argparse.Namespace) -> int:
    size = file_size(options.file)
    async with connected(options, changes=True) as vehicle:
        with progress_bar(Path(options.file).name, "B") as show:
            await vehicle.files.upload(
                options.file, options.path, patience_s=options.patience, on_progress=show
            )
    record = {"file": options.file, "path": options.path, "bytes": size}
    tell(options, "sent", record, f"{options.path}: {size} bytes")
    return DONE


async def _remove(options: argparse.Namespace) -> int:
    async with connected(options, changes=True) as vehicle:
        await vehicle.files.remove(options.path, patience_s=options.patience)
    tell_done(options, "files rm")
    return DONE


async def _remove_directory(options: argparse.Namespace) -> int:
    async with connected(options, changes=True) as vehicle:
        await vehicle.files.remove_directory(options.path, patience_s=options.patience)
    tell_done(options, "files rmdir")
    return DONE


async def _make_directory(options: argparse.Namespace) -> int:
    async with connected(options, changes=True) as vehicle:
        await vehicle.files.make_directory(options.path, patience_s=options.patience)
    tell_done(options, "files mkdir")
    return DONE


async def _move(options: argparse.Namespace) -> int:
    async with connected(options, changes=True) as vehicle:
        await vehicle.files.rename(options.path, options.new_path, patience_s=options.patience)
    tell_done(options, "files mv")
    return DONE


async def _crc(options: argparse.Namespace) -> int:
    async with connected(options) as vehicle:
        crc = f"{await vehicle.files.crc32(options.path, patience_s=options.patience):08x}"
    tell(options, "crc", {"path": options.path, "crc32": crc}, crc)
    return DONE
