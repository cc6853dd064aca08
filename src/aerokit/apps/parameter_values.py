"""Checks parameter values against metadata, for ``aerokit params`` and ``aerokit serve``."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from aerokit.errors import InvalidArgument

if TYPE_CHECKING:
    from collections.abc import Mapping

    from aerokit.parameters import Metadata, ParameterMetadata
    from aerokit.vehicle.parameters.writing import ParameterWrite


def check_values(metadata: Metadata | None, values: Mapping[str, float], *, force_option: str) -> None:
    """Raise InvalidArgument if the metadata does not allow some of the values.

    Names without metadata are accepted. The text mentions ``force_option``, which sets the values nevertheless.
    """
    if metadata is None:
        return
    problems = [problem for name, value in values.items() if (problem := _problem(metadata, name, value))]
    if problems:
        raise InvalidArgument(f"{'; '.join(problems)}; nothing was set; {force_option} sets these values nevertheless")


def with_range_note(metadata: Metadata | None, result: ParameterWrite, *, metadata_option: str) -> ParameterWrite:
    """Add a note to the result if the value was set without a check of its range.

    The note mentions ``metadata_option``, the command line option that loads metadata with ranges.
    """
    if result.error is not None or result.outcome == "unchanged":
        return result
    if metadata is None:
        text = f"range not checked ({metadata_option} checks it)"
    else:
        entry, _ = metadata_entry(metadata, result.name)
        if entry is not None:
            return result
        text = "range not checked (the metadata does not have this parameter)"
    return result.replace(note=f"{result.note}; {text}" if result.note else text)


def _problem(metadata: Metadata, name: str, value: float) -> str | None:
    entry, convert = metadata_entry(metadata, name)
    problem = None if entry is None else entry.problem(convert(value))
    if problem is None or entry is None or entry.name == name:
        return problem
    return f"{name} = {value:g}: {problem}"


def metadata_entry(metadata: Metadata, name: str) -> tuple[ParameterMetadata | None, Callable[[float], float]]:
    """Return the metadata of a parameter, and a function that converts its values to the unit of the metadata.

    The metadata may have the parameter under an earlier or later name, with another unit.
    """
    from aerokit.parameters.renames import resolve_rename

    for spelling in (name, name.upper()):
        if spelling in metadata:
            return metadata[spelling], lambda value: value
    renamed = resolve_rename(name.upper(), metadata)
    if renamed is None:
        return None, lambda value: value
    return metadata[renamed.name], renamed.to_vehicle
