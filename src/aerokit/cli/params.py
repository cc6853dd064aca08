"""``aerokit params``: list, get, set, save, load and compare the parameters of a vehicle."""

from __future__ import annotations

import argparse
import fnmatch
from typing import TYPE_CHECKING

from aerokit.cli.arguments import assignment, writable_file
from aerokit.cli.progress import progress_bar
from aerokit.cli.vehicle_command import add_action, connected

if TYPE_CHECKING:
    from collections.abc import Iterable

    from aerokit.parameters import Parameter, ParameterTable
    from aerokit.vehicle.parameters.parameters import ParameterWrite
    from aerokit.vehicle.vehicle import Vehicle

__all__ = ["add_params"]

DONE, FAILED = 0, 1
FORMATS = ("missionplanner", "mavproxy", "qgroundcontrol")


def add_params(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the parser."""
    text = "Read, set, save, load and compare the parameters of a vehicle."
    params = commands.add_parser("params", help="parameters of a vehicle", description=text)
    actions = params.add_subparsers(required=True, metavar="ACTION", title="actions")
    _add_reading(actions)
    _add_writing(actions)


def _add_reading(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    listing = add_action(actions, "list", _list, "List parameters with their values.")
    listing.add_argument("pattern", nargs="?", default="*", help="names to list: 'BATT_*' (all)")
    listing.add_argument("--changed", action="store_true", help="only those that differ from their default")
    get = add_action(actions, "get", _get, "Read single parameters.")
    get.add_argument("names", nargs="+", metavar="NAME")
    save = add_action(actions, "save", _save, "Save all parameters to a file.")
    save.add_argument("file", type=writable_file)
    save.add_argument("--format", choices=FORMATS, default=FORMATS[0], help="of the file (missionplanner)")
    diff = add_action(actions, "diff", _diff, "Show where the vehicle differs from a file.")
    diff.add_argument("file")


def _add_writing(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    set_ = add_action(actions, "set", _set, "Set parameters, each confirmed by the vehicle.")
    set_.add_argument("values", nargs="+", type=assignment, metavar="NAME=VALUE")
    load = add_action(actions, "load", _load, "Set all parameters of a file that differ on the vehicle.")
    load.add_argument("file")


# ---------------------------------------------------------------------------------------- actions


async def _list(options: argparse.Namespace) -> int:
    async with connected(options) as vehicle:
        table = await _download(vehicle, options)
    if options.changed:
        table = table.changed_from_default()
    _print(parameter for name, parameter in table.items() if fnmatch.fnmatch(name, options.pattern.upper()))
    return DONE


async def _get(options: argparse.Namespace) -> int:
    async with connected(options) as vehicle:
        _print([await vehicle.parameters.read(name, patience_s=options.patience) for name in options.names])
    return DONE


async def _save(options: argparse.Namespace) -> int:
    from aerokit.parameters import write_parameter_file

    async with connected(options) as vehicle:
        table = await _download(vehicle, options)
    write_parameter_file(options.file, table, format=options.format)
    print(f"{len(table)} parameters in {options.file}")
    return DONE


async def _diff(options: argparse.Namespace) -> int:
    from aerokit.parameters import read_parameter_file

    wanted = read_parameter_file(options.file)
    async with connected(options) as vehicle:
        await _download(vehicle, options)
        differences = await vehicle.parameters.diff(wanted, patience_s=options.patience)
    for difference in differences:
        print(difference)
    print(f"{len(differences)} of {len(wanted)} differ")
    return DONE if not differences else FAILED


async def _set(options: argparse.Namespace) -> int:
    async with connected(options) as vehicle:
        results = await vehicle.parameters.set_many(dict(options.values), patience_s=options.patience)
    return _print_results(results.values())


async def _load(options: argparse.Namespace) -> int:
    from aerokit.parameters import read_parameter_file

    wanted = read_parameter_file(options.file)
    async with connected(options) as vehicle:
        await _download(vehicle, options)
        with progress_bar("parameters", "parameter") as show:
            results = await vehicle.parameters.upload(wanted, patience_s=options.patience, on_progress=show)
    return _print_results(result for result in results.values() if result.outcome != "unchanged")


async def _download(vehicle: Vehicle, options: argparse.Namespace) -> ParameterTable:
    with progress_bar("parameters", "parameter") as show:
        return await vehicle.parameters.download(patience_s=options.patience, on_progress=show)


# --------------------------------------------------------------------------------------- printing


def _print(parameters: Iterable[Parameter]) -> None:
    for parameter in parameters:
        is_changed = parameter.default is not None and parameter.default != parameter.value
        default = f"  (default {_text(parameter.default)})" if is_changed else ""
        print(f"{parameter.name:16} {_text(parameter.value):<12}{default}".rstrip())


def _print_results(results: Iterable[ParameterWrite]) -> int:
    """One line each; FAILED when one of them has not the value that was asked for, rounding apart."""
    code = DONE
    for result in results:
        if result.error is None:
            print(f"{result.name:16} {_text(result.value):<12} {result.outcome} {result.note}".rstrip())
        else:
            print(f"{result.name:16} not set: {result.error}")
        if result.error is not None or result.outcome == "clamped":
            code = FAILED
    return code


def _text(value: float | None) -> str:
    """Integers whole, floats as far as 32 bits go."""
    return str(value) if isinstance(value, int) else f"{value:.9g}"
