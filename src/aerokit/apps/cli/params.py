"""``aerokit params``: list, get, set, save, load and compare the parameters of a vehicle."""

from __future__ import annotations

import argparse
import fnmatch
import sys
from typing import TYPE_CHECKING

from aerokit._internal.wording import did_you_mean
from aerokit.apps.cli.arguments import assignment, writable_file
from aerokit.apps.cli.completers import assignments, offer, parameter_names, parameters
from aerokit.apps.cli.output import DONE, FAILED, add_force, check_new, tell
from aerokit.apps.cli.terminal import progress_bar
from aerokit.apps.cli.vehicle_command import add_action, connected
from aerokit.errors import ParameterRejected, ParameterTimeout

if TYPE_CHECKING:
    from collections.abc import Iterable

    from aerokit.parameters import Parameter, ParameterTable
    from aerokit.vehicle.parameters.parameters import ParameterWrite
    from aerokit.vehicle.vehicle import Vehicle

FORMATS = ("missionplanner", "mavproxy", "qgroundcontrol")


def add_arguments(command: argparse.ArgumentParser) -> None:
    """The actions of the command, and their arguments."""
    actions = command.add_subparsers(required=True, metavar="ACTION", title="actions")
    _add_reading(actions)
    _add_writing(actions)


def _add_reading(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    listing = add_action(actions, "list", _list, "List parameters with their values.")
    pattern = listing.add_argument("pattern", nargs="?", default="*", help="names to list: 'BATT_*' (all)")
    offer(pattern, parameters)
    listing.add_argument("--changed", action="store_true", help="only those that differ from their default")
    get = add_action(actions, "get", _get, "Read single parameters.")
    offer(get.add_argument("names", nargs="+", metavar="NAME"), parameters)
    save = add_action(actions, "save", _save, "Save all parameters to a file.")
    save.add_argument("file", type=writable_file)
    add_force(save)
    save.add_argument("--format", choices=FORMATS, default=FORMATS[0], help="of the file (missionplanner)")
    diff = add_action(actions, "diff", _diff, "Show where the vehicle differs from a file.")
    diff.add_argument("file")


def _add_writing(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    set_ = add_action(actions, "set", _set, "Set parameters, each confirmed by the vehicle.")
    offer(set_.add_argument("values", nargs="+", type=assignment, metavar="NAME=VALUE"), assignments)
    load = add_action(actions, "load", _load, "Set all parameters of a file that differ on the vehicle.")
    load.add_argument("file")


# ---------------------------------------------------------------------------------------- actions


async def _list(options: argparse.Namespace) -> int:
    async with connected(options) as vehicle:
        table = await _download(vehicle, options)
    if options.changed:
        table = table.changed_from_default()
    found = [each for name, each in table.items() if fnmatch.fnmatch(name, options.pattern.upper())]
    _tell_parameters(options, found)
    if not found and options.pattern != "*":
        hint = did_you_mean(options.pattern, table)
        print(f"aerokit: none of {len(table)} parameters is called {options.pattern}{hint}", file=sys.stderr)
        return FAILED
    return DONE


async def _get(options: argparse.Namespace) -> int:
    async with connected(options) as vehicle:
        for name in options.names:
            _tell_parameters(options, [await _read(vehicle, name, options)])
    return DONE


async def _save(options: argparse.Namespace) -> int:
    from aerokit.parameters import write_parameter_file

    check_new(options.file, options)
    async with connected(options) as vehicle:
        table = await _download(vehicle, options)
    write_parameter_file(options.file, table, format=options.format)
    record = {"file": options.file, "what": "parameters", "count": len(table)}
    tell(options, "saved", record, f"{len(table)} parameters in {options.file}")
    return DONE


async def _diff(options: argparse.Namespace) -> int:
    from aerokit.parameters import read_parameter_file

    wanted = read_parameter_file(options.file)
    async with connected(options) as vehicle:
        await _download(vehicle, options)
        differences = await vehicle.parameters.diff(wanted, patience_s=options.patience)
    for difference in differences:
        tell(options, "parameter_difference", difference.to_dict(), str(difference))
    record = {"file": options.file, "parameters": len(wanted), "different": len(differences)}
    tell(options, "comparison", record, f"{len(differences)} of {len(wanted)} differ")
    return DONE if not differences else FAILED


async def _set(options: argparse.Namespace) -> int:
    async with connected(options, changes=True) as vehicle:
        results = await vehicle.parameters.set_many(dict(options.values), patience_s=options.patience)
    return _tell_results(options, results.values())


async def _load(options: argparse.Namespace) -> int:
    from aerokit.parameters import read_parameter_file

    wanted = read_parameter_file(options.file)
    async with connected(options, changes=True) as vehicle:
        await _download(vehicle, options)
        with progress_bar("parameters", "parameter") as show:
            results = await vehicle.parameters.upload(wanted, patience_s=options.patience, on_progress=show)
    if options.json:
        return _tell_results(options, results.values())
    return _tell_results(options, (each for each in results.values() if each.outcome != "unchanged"))


async def _download(vehicle: Vehicle, options: argparse.Namespace) -> ParameterTable:
    with progress_bar("parameters", "parameter") as show:
        return await vehicle.parameters.download(patience_s=options.patience, on_progress=show)


async def _read(vehicle: Vehicle, name: str, options: argparse.Namespace) -> Parameter:
    try:
        return await vehicle.parameters.read(name, patience_s=options.patience)
    except (ParameterRejected, ParameterTimeout) as error:
        if meant := _meant(name, error):
            print(f"aerokit: no answer about {name!r}{meant}", file=sys.stderr)
        raise


def _meant(name: str, error: Exception) -> str:
    """What was perhaps meant, by the names that the simulated vehicles have."""
    names = parameter_names()
    return "" if "did you mean" in str(error) or name in names else did_you_mean(name, names)


# --------------------------------------------------------------------------------------- printing


def _tell_parameters(options: argparse.Namespace, parameters: Iterable[Parameter]) -> None:
    for parameter in parameters:
        is_changed = parameter.default is not None and parameter.default != parameter.value
        default = f"  (default {_text(parameter.default)})" if is_changed else ""
        text = f"{parameter.name:16} {_text(parameter.value):<12}{default}".rstrip()
        tell(options, "parameter", _record(parameter), text)


def _tell_results(options: argparse.Namespace, results: Iterable[ParameterWrite]) -> int:
    """One line each; FAILED when one of them has not the value that was asked for, rounding apart."""
    code = DONE
    for result in results:
        if result.error is None:
            text = f"{result.name:16} {_text(result.value):<12} {result.outcome} {result.note}".rstrip()
        else:
            text = f"{result.name:16} not set: {result.error}{_meant(result.name, result.error)}"
        tell(options, "parameter_write", _record(result), text)
        if result.error is not None or result.outcome == "clamped":
            code = FAILED
    return code


def _record(told: Parameter | ParameterWrite) -> dict[str, object]:
    """``type`` is what every record has in front."""
    fields = told.to_dict()
    return {("value_type" if name == "type" else name): value for name, value in fields.items()}


def _text(value: float | None) -> str:
    """Integers whole, floats as far as 32 bits go."""
    return str(value) if isinstance(value, int) else f"{value:.9g}"
