"""Metadata for ``aerokit params``: units and meanings of values, and the check of values before they are sent."""

from __future__ import annotations

import json
import sys
from typing import TYPE_CHECKING, Any

import anyio

from aerokit.apps.parameter_values import check_values, metadata_entry
from aerokit.errors import AerokitError, CommandRejected, FileError, NotSupported

if TYPE_CHECKING:
    import argparse
    from collections.abc import Mapping

    from aerokit.parameters import Metadata, Parameter
    from aerokit.vehicle.vehicle import Vehicle

# Parameters with the system id. ArduPilot uses a new id at once (GCS_Common.cpp, update_send); PX4 and old versions of
# ArduPilot use it after a reboot.
_SYSTEM_ID_NAMES = ("SYSID_THISMAV", "MAV_SYSID", "MAV_SYS_ID")
# How long to read the metadata from the vehicle. Over a slow radio, this may be too short for all of it.
_READ_TIMEOUT_S = 10.0


_PX4_FILE = "FILE is parameters.json, which `make parameters_metadata` writes in PX4's sources"


def ranges_unchecked_text(vehicle: Vehicle) -> str:
    if vehicle.autopilot.name == "PX4":
        file = _PX4_FILE
    else:
        file = f"FILE is https://autotest.ardupilot.org/Parameters/{vehicle.autopilot.firmware}/apm.pdef.xml"
    return f"ranges were not checked: --metadata FILE checks them; {file} (docs/how-to/parameters.md)"


def defaults_unknown_text(vehicle: Vehicle) -> str:
    if vehicle.autopilot.name == "PX4":
        return (
            f"PX4 does not report the defaults of its parameters: --metadata FILE has them; {_PX4_FILE}. To"
            " compare with a file of `aerokit params save` instead: aerokit params diff FILE"
        )
    return (
        "the vehicle reported no defaults: ArduPilot reports them only by MAVFTP. To compare with a file of"
        " `aerokit params save` instead: aerokit params diff FILE"
    )


def add_metadata(command: argparse.ArgumentParser, *, checks: bool = False) -> None:
    """Add ``--metadata`` to a command. With ``checks``, also add ``--force``."""
    command.add_argument(
        "--metadata",
        metavar="FILE",
        help="metadata of the firmware's parameters, for ranges and units (apm.pdef.xml, apm.pdef.json or"
        " parameters.json)",
    )
    if checks:
        command.add_argument("--force", action="store_true", help="also set values that the metadata does not allow")


def load_metadata_option(options: argparse.Namespace) -> Metadata | None:
    if options.metadata is None:
        return None
    from aerokit.parameters import load_metadata

    return load_metadata(options.metadata)


async def metadata_for_check(
    vehicle: Vehicle, from_file: Metadata | None, options: argparse.Namespace
) -> Metadata | None:
    """Return the metadata of the file or else of the vehicle.

    The result is None with ``--force``, or if there is no metadata.
    """
    if options.force:
        return None
    if from_file is not None or vehicle.autopilot.name != "PX4":  # ArduPilot has no component metadata
        return from_file
    return await _read_from_vehicle(vehicle)


async def _read_from_vehicle(vehicle: Vehicle) -> Metadata | None:
    from aerokit.parameters.metadata import parse_metadata

    problem = f"time-out after {_READ_TIMEOUT_S:g} s"  # unless reading fails before the time-out
    with anyio.move_on_after(_READ_TIMEOUT_S):
        try:
            content = await vehicle.component(vehicle.component_id).metadata("parameter")
            return parse_metadata(json.dumps(content).encode(), "the vehicle's metadata")
        except (NotSupported, CommandRejected, FileError):  # the vehicle does not provide metadata
            return None
        except AerokitError as error:
            problem = str(error)
    print(
        "aerokit: the ranges of the values are not checked, because reading the metadata from the vehicle failed:"
        f" {problem}; use --metadata FILE",
        file=sys.stderr,
    )
    return None


def check_allowed(metadata: Metadata | None, values: Mapping[str, float]) -> None:
    check_values(metadata, values, force_option="--force")


def reboot_note(metadata: Metadata | None, name: str, value: float) -> str:
    if name.upper() in _SYSTEM_ID_NAMES:
        return f"the system id changes at the next reboot at the latest; then connect with --system-id {value:g}"
    if metadata is None:
        return ""
    entry, _ = metadata_entry(metadata, name)
    return "takes effect after a reboot" if entry is not None and entry.reboot_required else ""


def metadata_facts(metadata: Metadata | None, parameter: Parameter) -> dict[str, object]:
    # The parameter's other names are not tried, because their metadata may have another unit.
    entry = None if metadata is None else metadata.get(parameter.name)
    if entry is None:
        return {"unit": None, "minimum": None, "maximum": None, "meaning": None}
    has_names = parameter.value in entry.values or entry.bitmask
    meaning = entry.describe(parameter.value) if has_names else None
    return {"unit": entry.unit or None, "minimum": entry.minimum, "maximum": entry.maximum, "meaning": meaning}


def metadata_text(facts: Mapping[str, Any]) -> str:
    low, high = facts["minimum"], facts["maximum"]
    has_range = low is not None or high is not None
    parts = (facts["unit"], facts["meaning"], f"range {_bound(low)} to {_bound(high)}" if has_range else "")
    return ", ".join(part for part in parts if part)


def _bound(value: float | None) -> str:
    return "…" if value is None else f"{value:g}"
