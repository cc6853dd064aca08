"""Parameters as values: tables, encoding, files and metadata.

This package does not communicate with a vehicle; ``vehicle.parameters`` does, with these values.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from aerokit._internal.imports import lazy_exports

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.parameters.definition import CameraDefinition as CameraDefinition
    from aerokit.parameters.definition import SettingDefinition as SettingDefinition
    from aerokit.parameters.definition import SettingOption as SettingOption
    from aerokit.parameters.definition import SettingRange as SettingRange
    from aerokit.parameters.definition import load_definition as load_definition
    from aerokit.parameters.definition import parse_definition as parse_definition
    from aerokit.parameters.files import FileFormat as FileFormat
    from aerokit.parameters.files import ParameterFile as ParameterFile
    from aerokit.parameters.files import parse_parameter_file as parse_parameter_file
    from aerokit.parameters.files import read_parameter_file as read_parameter_file
    from aerokit.parameters.files import write_parameter_file as write_parameter_file
    from aerokit.parameters.metadata import Metadata as Metadata
    from aerokit.parameters.metadata import ParameterMetadata as ParameterMetadata
    from aerokit.parameters.metadata import load_metadata as load_metadata
    from aerokit.parameters.metadata import parse_metadata as parse_metadata
    from aerokit.parameters.pack import pack_parameters as pack_parameters
    from aerokit.parameters.pack import unpack_parameters as unpack_parameters
    from aerokit.parameters.parameter import Parameter as Parameter
    from aerokit.parameters.parameter import ParameterType as ParameterType
    from aerokit.parameters.parameter import Setting as Setting
    from aerokit.parameters.parameter import SettingValue as SettingValue
    from aerokit.parameters.parameter import check_name as check_name
    from aerokit.parameters.parameter import checked_value as checked_value
    from aerokit.parameters.renames import ParameterRenamedWarning as ParameterRenamedWarning
    from aerokit.parameters.renames import Rename as Rename
    from aerokit.parameters.renames import Renamed as Renamed
    from aerokit.parameters.renames import find_rename as find_rename
    from aerokit.parameters.renames import other_names as other_names
    from aerokit.parameters.renames import replacement_of as replacement_of
    from aerokit.parameters.renames import resolve_rename as resolve_rename
    from aerokit.parameters.renames import translate_values as translate_values
    from aerokit.parameters.table import ParameterDifference as ParameterDifference
    from aerokit.parameters.table import ParameterTable as ParameterTable
    from aerokit.parameters.table import ParameterValues as ParameterValues
    from aerokit.parameters.table import diff as diff

__getattr__: Callable[[str], Any]
__dir__: Callable[[], list[str]]
__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "aerokit.parameters.definition": (
            "CameraDefinition",
            "SettingDefinition",
            "SettingOption",
            "SettingRange",
            "load_definition",
            "parse_definition",
        ),
        "aerokit.parameters.files": (
            "FileFormat",
            "ParameterFile",
            "parse_parameter_file",
            "read_parameter_file",
            "write_parameter_file",
        ),
        "aerokit.parameters.metadata": ("Metadata", "ParameterMetadata", "load_metadata", "parse_metadata"),
        "aerokit.parameters.pack": ("pack_parameters", "unpack_parameters"),
        "aerokit.parameters.parameter": (
            "Parameter",
            "ParameterType",
            "Setting",
            "SettingValue",
            "check_name",
            "checked_value",
        ),
        "aerokit.parameters.renames": (
            "ParameterRenamedWarning",
            "Rename",
            "Renamed",
            "find_rename",
            "other_names",
            "replacement_of",
            "resolve_rename",
            "translate_values",
        ),
        "aerokit.parameters.table": ("ParameterDifference", "ParameterTable", "ParameterValues", "diff"),
    },
)
