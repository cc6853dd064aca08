"""Parameters as values: tables, how they travel, the files they are kept in, what is known about them.

Nothing here talks to a vehicle. ``vehicle.parameters`` does, and takes and gives these values.
"""

from __future__ import annotations

from aerokit.parameters.parameter import Parameter, ParameterType, check_name, checked_value
from aerokit.parameters.table import ParameterTable

__all__ = [
    "Parameter",
    "ParameterTable",
    "ParameterType",
    "check_name",
    "checked_value",
]
