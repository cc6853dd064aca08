"""``aerokit params``: list, get, set, save, load and compare the parameters of a vehicle."""

from __future__ import annotations

import argparse
import fnmatch
import sys
from contextlib import suppress
from typing import TYPE_CHECKING

import anyio

from aerokit.apps.cli.arguments import assignment, writable_file
from aerokit.apps.cli.completion import assignments, parameter_names, set_completions
from aerokit.apps.cli.connecting import add_action, connected
from aerokit.apps.cli.output import DONE, FAILED, add_force, check_not_existing, emit, exit_code, near_names, suggestion
from aerokit.apps.cli.params_metadata import (
    add_metadata,
    check_allowed,
    defaults_unknown_text,
    load_metadata_option,
    metadata_facts,
    metadata_for_check,
    metadata_text,
    ranges_unchecked_text,
    reboot_note,
)
from aerokit.apps.cli.terminal import progress_bar
from aerokit.apps.parameter_values import with_range_note
from aerokit.errors import AerokitError, InvalidArgument, ParameterRejected, ParameterTimeout, ValueUnknownError
from aerokit.mavlink.enums import MavParamError
from aerokit.parameters import checked_value

# Needed only later, but an import during the connection would block the event loop.
from aerokit.vehicle.parameters.parameters import ParameterWrite
from aerokit.vehicle.parameters.writing import resolve_known

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

    from aerokit.parameters import Metadata, Parameter, ParameterFile, ParameterTable
    from aerokit.vehicle.vehicle import Vehicle

# How long to read the names of the vehicle's parameters when only a suggestion needs them.
_NAMES_TIMEOUT_S = 10.0
# If the given name begins with a known name of at least this length, the known name is suggested.
_MIN_BEGINNING = 5
_FORMATS = ("missionplanner", "mavproxy", "qgroundcontrol")


def add_arguments(command: argparse.ArgumentParser) -> None:
    actions = command.add_subparsers(required=True, metavar="ACTION", title="actions")
    _add_reading(actions)
    _add_writing(actions)


def _add_reading(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    listing = add_action(actions, "list", _list, "List parameters with their values.")
    pattern = listing.add_argument(
        "pattern", nargs="?", default="*", help="part of the names, or 'BATT_*' (default: all)"
    )
    set_completions(pattern, parameter_names)
    add_metadata(listing)
    listing.add_argument(
        "--changed",
        action="store_true",
        help="only those that differ from their default (on PX4: from that in --metadata FILE)",
    )
    get = add_action(actions, "get", _get, "Read single parameters.")
    set_completions(get.add_argument("names", nargs="+", metavar="NAME"), parameter_names)
    add_metadata(get)
    save = add_action(actions, "save", _save, "Save all parameters to a file.")
    save.add_argument("file", type=writable_file)
    add_force(save)
    save.add_argument("--format", choices=_FORMATS, default=_FORMATS[0], help="file format (default: missionplanner)")
    diff = add_action(actions, "diff", _diff, "Compare the vehicle's parameters with a file.")
    diff.add_argument("file")


def _add_writing(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    set_ = add_action(actions, "set", _set, "Set parameters. The vehicle confirms each value.")
    set_completions(set_.add_argument("values", nargs="+", type=assignment, metavar="NAME=VALUE"), assignments)
    add_metadata(set_, checks=True)
    load = add_action(actions, "load", _load, "Set all parameters in a file that differ on the vehicle.")
    load.add_argument("file")
    add_metadata(load, checks=True)


async def _list(options: argparse.Namespace) -> int:
    metadata = load_metadata_option(options)
    async with connected(options) as vehicle:
        table = await _download(vehicle, options)
    if options.changed:
        table = _changed(table, metadata, vehicle)
    pattern = options.pattern.upper()
    if not any(wildcard in pattern for wildcard in "*?["):
        pattern = f"*{pattern}*"
    matching = [parameter for name, parameter in table.items() if fnmatch.fnmatch(name, pattern)]
    _emit_parameters(options, matching, metadata)
    if not matching and options.pattern != "*":
        hint = suggestion(options.pattern.strip("*"), table, count=3)
        print(f"aerokit: none of {len(table)} parameters matches {options.pattern!r}{hint}", file=sys.stderr)
        return FAILED
    return DONE


def _changed(table: ParameterTable, metadata: Metadata | None, vehicle: Vehicle) -> ParameterTable:
    """Return the parameters that differ from their default.

    If the vehicle has not reported a default, that of the metadata counts. Raises ValueUnknownError if no default is
    known.
    """
    if metadata is not None:
        table = table.updated_with(
            parameter.replace(default=metadata[name].default)
            for name, parameter in table.items()
            if parameter.default is None and name in metadata
        )
    try:
        return table.changed_from_default()
    except ValueUnknownError:
        raise ValueUnknownError(defaults_unknown_text(vehicle)) from None


async def _get(options: argparse.Namespace) -> None:
    metadata = load_metadata_option(options)
    async with connected(options) as vehicle:
        for name in options.names:
            _emit_parameters(options, [await _read(vehicle, name, options)], metadata)


async def _save(options: argparse.Namespace) -> None:
    from aerokit.parameters import write_parameter_file

    check_not_existing(options.file, options)
    async with connected(options) as vehicle:
        table = await _download(vehicle, options)
    write_parameter_file(options.file, table, format=options.format)
    record = {"file": options.file, "what": "parameters", "count": len(table)}
    emit(options, "saved", record, f"{len(table)} parameters written to {options.file}")


async def _diff(options: argparse.Namespace) -> int:
    from aerokit.parameters import read_parameter_file

    file_values = read_parameter_file(options.file)
    async with connected(options) as vehicle:
        await _download(vehicle, options)
        differences = await vehicle.parameters.diff(file_values, idle_timeout_s=options.patience)
    for difference in differences:
        values = f"vehicle {_value_or_missing(difference.before)}, file {_value_or_missing(difference.after)}"
        emit(options, "parameter_difference", difference.to_dict(), f"{difference.name:16} {values}")
    record = {"file": options.file, "parameters": len(file_values), "different": len(differences)}
    emit(options, "comparison", record, f"{len(differences)} of {len(file_values)} parameters differ")
    return DONE if not differences else FAILED


async def _set(options: argparse.Namespace) -> int:
    values = dict(options.values)
    metadata = load_metadata_option(options)
    if not options.force:
        check_allowed(metadata, values)  # if --metadata is given, values are checked before connecting
    async with connected(options, changes_vehicle=True) as vehicle:
        if metadata is None:
            metadata = await metadata_for_check(vehicle, from_file=None, options=options)
            check_allowed(metadata, values)
        results = await vehicle.parameters.set_many(values, idle_timeout_s=options.patience)
        known_names = await _names_for_hints(vehicle, results.values())
    # Without metadata, all results would have the same note. Text output has one line at its end instead.
    has_notes = metadata is not None or options.json
    if has_notes and not options.force:
        results = {
            name: with_range_note(metadata, result, metadata_option="--metadata FILE")
            for name, result in results.items()
        }
    code = _emit_results(options, results.values(), known_names, metadata)
    has_changed = any(result.error is None and result.outcome != "unchanged" for result in results.values())
    is_unchecked = metadata is None and not options.force
    if has_changed and is_unchecked and not options.json:
        print(ranges_unchecked_text(vehicle))
    return code


async def _load(options: argparse.Namespace) -> int:
    from aerokit.parameters import read_parameter_file

    file_values = read_parameter_file(options.file)
    file_metadata = load_metadata_option(options)
    async with connected(options, changes_vehicle=True) as vehicle:
        _check_file(file_values, await _download(vehicle, options), vehicle)
        metadata = await metadata_for_check(vehicle, file_metadata, options)
        if metadata is not None:
            # Only changes are checked, because a backup may contain unusual values that the vehicle already has.
            differences = await vehicle.parameters.diff(file_values, idle_timeout_s=options.patience)
            new_values = {change.name: change.after for change in differences if change.after is not None}
            check_allowed(metadata, new_values)
        with progress_bar("parameters", unit="parameter") as on_progress:
            results = await vehicle.parameters.upload(
                file_values, idle_timeout_s=options.patience, on_progress=on_progress
            )
        table = vehicle.parameters.table
    if options.json:
        return _emit_results(options, results.values(), table, metadata)
    changed = [result for result in results.values() if result.outcome != "unchanged"]
    code = _emit_results(options, changed, table, metadata)
    failed_count = sum(result.error is not None for result in changed)
    not_set = f", {failed_count} were not set" if failed_count else ""
    print(f"{len(results)} parameters in {options.file}, {len(changed) - failed_count} of them differed{not_set}")
    is_unchecked = metadata is None and not options.force
    if len(changed) > failed_count and is_unchecked:
        print(ranges_unchecked_text(vehicle))
    return code


def _check_file(file_values: ParameterFile, table: ParameterTable, vehicle: Vehicle) -> None:
    """Raise InvalidArgument if values of the file do not fit the types of the vehicle's parameters.

    The text lists these values, and the names that the vehicle does not have.
    """
    names_are_upper_case = vehicle.autopilot.name == "ArduPilot"
    invalid = []
    unknown = []
    for name, value in file_values.items():
        line = file_values.places[name]
        target = resolve_known(name.upper() if names_are_upper_case else name, table)
        if target is None:
            unknown.append(f"{line}: the vehicle has no parameter {name}{suggestion(name, table, count=3)}")
            continue
        try:
            checked_value(name, target.to_vehicle(value), target.parameter.type)
        except InvalidArgument as error:
            invalid.append(f"{line}: {error}")
    if invalid:
        raise InvalidArgument("\n".join([*invalid, *unknown, "nothing was set"]))


async def _download(vehicle: Vehicle, options: argparse.Namespace) -> ParameterTable:
    with progress_bar("parameters", unit="parameter") as on_progress:
        return await vehicle.parameters.download(idle_timeout_s=options.patience, on_progress=on_progress)


async def _read(vehicle: Vehicle, name: str, options: argparse.Namespace) -> Parameter:
    try:
        return await vehicle.parameters.read(name, idle_timeout_s=options.patience)
    except (ParameterRejected, ParameterTimeout) as error:
        known_names = await _known_names(vehicle) if _is_unknown_name(error) else ()
        error.args = (f"{_with_hint(name, error, known_names)}",)
        raise


async def _names_for_hints(vehicle: Vehicle, results: Iterable[ParameterWrite]) -> Collection[str]:
    is_needed = any(_is_unknown_name(result.error) for result in results)
    return await _known_names(vehicle) if is_needed else ()


def _is_unknown_name(error: Exception | None) -> bool:
    if not isinstance(error, ParameterRejected):
        return False
    return error.code == MavParamError.DOES_NOT_EXIST or "has no parameter" in str(error)


async def _known_names(vehicle: Vehicle) -> Collection[str]:
    with anyio.move_on_after(_NAMES_TIMEOUT_S), suppress(AerokitError):
        return await vehicle.parameters.download()
    return ()


def _with_hint(name: str, error: Exception, known_names: Collection[str]) -> str:
    """Return the text of an error. If the vehicle does not have the parameter, add similar ``known_names``."""
    text = str(error)
    has_right_name = "replaced by" in text or "its name on" in text
    if has_right_name or not _is_unknown_name(error):
        return text
    # The error's own suggestions are replaced, because they include only parameters that were already read.
    bare_text, _, _ = text.partition(" (did you mean")
    long_names = [known_name for known_name in known_names if len(known_name) >= _MIN_BEGINNING]
    beginnings = [known_name for known_name in long_names if name.upper().startswith(known_name)]
    names = dict.fromkeys([*beginnings, *near_names(name, known_names, count=3)])
    hint = " or ".join(map(repr, list(names)[:3]))
    return f"{bare_text} (did you mean {hint}?)" if hint else f"{bare_text}; `aerokit params list` shows all names"


def _emit_parameters(options: argparse.Namespace, parameters: Iterable[Parameter], metadata: Metadata | None) -> None:
    for parameter in parameters:
        is_changed = parameter.default is not None and parameter.default != parameter.value
        default = f"  (default {_text(parameter.default)})" if is_changed else ""
        facts = metadata_facts(metadata, parameter)
        description = f"  {metadata_text(facts)}".rstrip()
        text = f"{parameter.name:16} {_text(parameter.value):<12}{default}{description}".rstrip()
        emit(options, "parameter", {**_record(parameter), **facts}, text)


def _emit_results(
    options: argparse.Namespace,
    results: Iterable[ParameterWrite],
    known_names: Collection[str],
    metadata: Metadata | None,
) -> int:
    """Print a line for each result, and return the exit code.

    The exit code is not DONE if a parameter was not set, or if the vehicle clamped its value.
    """
    code = DONE
    for result in results:
        if result.error is None and result.outcome != "unchanged":
            reboot = reboot_note(metadata, result.name, result.value)
            result = result.replace(note="; ".join(filter(None, (result.note, reboot))))
        if result.error is None:
            shows_one_value = result.before is None or result.outcome == "unchanged"
            value = _text(result.value) if shows_one_value else f"{_text(result.before)} → {_text(result.value)}"
            text = f"{result.name:16} {value:<12} {result.outcome} {result.note}".rstrip()
        else:
            text = f"{result.name:16} not set: {_with_hint(result.name, result.error, known_names)}"
        emit(options, "parameter_write", _record(result), text)
        if result.error is not None and code in (DONE, FAILED):  # An error's exit code is more specific than FAILED.
            code = exit_code(result.error)
        elif result.outcome == "clamped" and code == DONE:
            code = FAILED
    return code


def _record(parameter: Parameter | ParameterWrite) -> dict[str, object]:
    # The key "type" is reserved for the type of the record.
    fields = parameter.to_dict()
    return {("value_type" if name == "type" else name): value for name, value in fields.items()}


def _value_or_missing(value: float | None) -> str:
    return "does not have it" if value is None else _text(value)


def _text(value: float | None) -> str:
    return str(value) if isinstance(value, int) else f"{value:.9g}"
