"""Parameters as values: tables, how they travel, the files they are kept in, what is known about them.

Nothing here talks to a vehicle. ``vehicle.parameters`` does, and takes and gives these values.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from aerokit.parameters.parameter import Parameter, ParameterType, check_name, checked_value
from aerokit.parameters.table import ParameterTable

if TYPE_CHECKING:
    from aerokit.parameters.definition import (
        CameraDefinition,
        SettingDefinition,
        SettingOption,
        SettingRange,
        load_definition,
        parse_definition,
    )
    from aerokit.parameters.files import (
        FileFormat,
        ParameterFile,
        parse_parameter_file,
        read_parameter_file,
        write_parameter_file,
    )
    from aerokit.parameters.metadata import Metadata, ParameterMetadata, load_metadata, parse_metadata
    from aerokit.parameters.pack import pack_parameters, unpack_parameters
    from aerokit.parameters.renames import (
        ParameterRenamedWarning,
        Rename,
        Renamed,
        find_rename,
        other_names,
        replacement_of,
        to_known,
        translate_values,
    )
    from aerokit.parameters.setting import Setting, SettingValue
    from aerokit.parameters.table import ParameterDifference, ParameterValues, diff

__all__ = [
    "CameraDefinition",
    "FileFormat",
    "Metadata",
    "Parameter",
    "ParameterDifference",
    "ParameterFile",
    "ParameterMetadata",
    "ParameterRenamedWarning",
    "ParameterTable",
    "ParameterType",
    "ParameterValues",
    "Rename",
    "Renamed",
    "Setting",
    "SettingDefinition",
    "SettingOption",
    "SettingRange",
    "SettingValue",
    "check_name",
    "checked_value",
    "diff",
    "find_rename",
    "load_definition",
    "load_metadata",
    "other_names",
    "pack_parameters",
    "parse_definition",
    "parse_metadata",
    "parse_parameter_file",
    "read_parameter_file",
    "replacement_of",
    "to_known",
    "translate_values",
    "unpack_parameters",
    "write_parameter_file",
]

_HOMES = {
    "definition": "CameraDefinition SettingDefinition SettingOption SettingRange load_definition parse_definition",
    "differences": "ParameterDifference ParameterValues diff",
    "files": "FileFormat ParameterFile parse_parameter_file read_parameter_file write_parameter_file",
    "metadata": "Metadata ParameterMetadata load_metadata parse_metadata",
    "pack": "pack_parameters unpack_parameters",
    "renames": "ParameterRenamedWarning Rename Renamed find_rename other_names replacement_of to_known"
    " translate_values",
    "setting": "Setting SettingValue",
}
_HOME_OF = {name: module for module, names in _HOMES.items() for name in names.split()}


def __getattr__(name: str) -> Any:
    """Import a module of this package when one of its names is first used: most programs need few of them."""
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    value = getattr(import_module(f"{__name__}.{_HOME_OF[name]}"), name)
    globals()[name] = value
    return value
