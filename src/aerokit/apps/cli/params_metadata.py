"""Metadata for ``aerokit params``: units and meanings of values, and the check of values before they are sent."""

from __future__ import annotations

import json
import sys
from typing import TYPE_CHECKING, Any

import anyio

from aerokit.errors import AerokitError, CommandRejected, FileError, InvalidArgument, NotSupported

if TYPE_CHECKING:
    import argparse
    from collections.abc import Mapping

    from aerokit.parameters import Metadata, Parameter, ParameterMetadata
    from aerokit.vehicle.parameters.parameters import ParameterWrite
    from aerokit.vehicle.vehicle import Vehicle

# ArduPilot uses a new system id at once (GCS_Common.cpp, update_send), PX4 and old ArduPilots after a reboot.
_SYSTEM_ID_NAMES = ("SYSID_THISMAV", "MAV_SYSID", "MAV_SYS_ID")
# Limits the time that reading the metadata from the vehicle takes; over a slow radio it takes longer.
_FETCH_TIMEOUT_S = 10.0
RANGES_NOT_CHECKED = "ranges not checked (--metadata FILE checks them)"


def add_metadata(command: argparse.ArgumentParser, *, checks: bool = False) -> None:
    """Add ``--metadata``; with ``checks`` also ``--force``, for commands that set parameters."""
    command.add_argument(
        "--metadata",
        metavar="FILE",
        help="metadata of the firmware's parameters, for ranges and units (apm.pdef.xml, apm.pdef.json or"
        " parameters.json)",
    )
    if checks:
        command.add_argument("--force", action="store_true", help="also set values that the metadata does not allow")


def load_given(options: argparse.Namespace) -> Metadata | None:
    """Read the file given as ``--metadata``, if any."""
    if options.metadata is None:
        return None
    from aerokit.parameters import load_metadata

    return load_metadata(options.metadata)


async def metadata_for_check(vehicle: Vehicle, given: Metadata | None, options: argparse.Namespace) -> Metadata | None:
    """Return the metadata to check values with: the given one, or the vehicle's if it has some. None with --force."""
    if options.force:
        return None
    # ArduPilot has no component metadata.
    return given if given is not None or vehicle.autopilot.name != "PX4" else await _fetch(vehicle)


async def _fetch(vehicle: Vehicle) -> Metadata | None:
    from aerokit.parameters.metadata import parse_metadata

    problem = f"not read within {_FETCH_TIMEOUT_S:g} s"
    with anyio.move_on_after(_FETCH_TIMEOUT_S):
        try:
            content = await vehicle.component(vehicle.component_id).metadata("parameter")
            return parse_metadata(json.dumps(content).encode(), "the vehicle's metadata")
        except (NotSupported, CommandRejected, FileError):  # the vehicle has none
            return None
        except AerokitError as error:
            problem = str(error)
    text = f"the ranges of the values are not checked: the vehicle's metadata: {problem}; use --metadata FILE"
    print(f"aerokit: {text}", file=sys.stderr)
    return None


def check_values(metadata: Metadata | None, values: Mapping[str, float]) -> None:
    """Raise InvalidArgument with all values that the metadata does not allow. Unknown names are accepted."""
    if metadata is None:
        return
    problems = [problem for name, value in values.items() if (problem := _problem(metadata, name, value))]
    if problems:
        raise InvalidArgument(f"{'; '.join(problems)}; nothing was set; --force sets such values too")


def _problem(metadata: Metadata, name: str, value: float) -> str | None:
    """Return why the value is not allowed, in the name and unit of the user."""
    entry, convert = _entry(metadata, name)
    problem = None if entry is None else entry.problem(convert(value))
    if problem is None or entry is None or entry.name == name:
        return problem
    return f"{name} = {value:g}: {problem}"


def _entry(metadata: Metadata, name: str) -> tuple[ParameterMetadata | None, Any]:
    """Return the metadata of a parameter under any of its names, and the conversion to its unit."""
    from aerokit.parameters.renames import resolve_rename

    for spelled in (name, name.upper()):
        if spelled in metadata:
            return metadata[spelled], lambda value: value
    renamed = resolve_rename(name.upper(), metadata)
    return (None, lambda value: value) if renamed is None else (metadata[renamed.name], renamed.to_vehicle)


def with_range_note(metadata: Metadata | None, result: ParameterWrite) -> str:
    """Return the note of a result; if the value was set without a check of its range, the note says so."""
    text = ""
    if metadata is None:
        text = RANGES_NOT_CHECKED.replace("ranges", "range").replace("them", "it")
    elif _entry(metadata, result.name)[0] is None:
        text = "range not checked (the metadata does not have this parameter)"
    is_set = result.error is None and result.outcome != "unchanged"
    return "; ".join(filter(None, (result.note, text if is_set else "")))


def reboot_note(metadata: Metadata | None, name: str, value: float) -> str:
    """Return what is still to do until the new value takes effect; empty if nothing is known."""
    if name.upper() in _SYSTEM_ID_NAMES:
        return f"the system id changes at the next reboot at the latest; then connect with --system-id {value:g}"
    entry = None if metadata is None else _entry(metadata, name)[0]
    return "takes effect after a reboot" if entry is not None and entry.reboot_required else ""


def about(metadata: Metadata | None, parameter: Parameter) -> dict[str, object]:
    """Return unit, range and meaning of a parameter, for its record; null if unknown."""
    # Metadata under another name may have another unit.
    known = None if metadata is None else metadata.get(parameter.name)
    if known is None:
        return {"unit": None, "minimum": None, "maximum": None, "meaning": None}
    has_names = parameter.value in known.values or known.bitmask
    meaning = known.describe(parameter.value) if has_names else None
    return {"unit": known.unit or None, "minimum": known.minimum, "maximum": known.maximum, "meaning": meaning}


def about_text(facts: Mapping[str, Any]) -> str:
    """Return unit, range and meaning in a few words; empty if unknown."""
    low, high = facts["minimum"], facts["maximum"]
    bounds = "" if low is None and high is None else f"{_bound(low)} to {_bound(high)}"
    parts = (facts["unit"], facts["meaning"], bounds and f"range {bounds}")
    return ", ".join(part for part in parts if part)


def _bound(value: float | None) -> str:
    return "…" if value is None else f"{value:g}"
