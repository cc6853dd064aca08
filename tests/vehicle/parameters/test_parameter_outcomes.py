"""What the vehicle's answer to a write means."""

from __future__ import annotations

import pytest

from aerokit.errors import ParameterRejected
from aerokit.parameters import Parameter, ParameterType
from aerokit.vehicle.parameters.writing import outcome_of

INT, REAL = ParameterType.INT32, ParameterType.REAL32


@pytest.mark.parametrize(
    ("type_", "before", "wanted", "answer", "outcome"),
    [
        (INT, 1, 7, 7, "set"),
        (INT, 7, 7, 7, "unchanged"),
        (INT, None, 7, 7, "set"),
        (INT, 1, 7, 8, "clamped"),
        (INT, 1, 100, 50, "clamped"),
        (INT, 1, -7, 7, "clamped"),
        (REAL, 1.0, 100.0, 100.1, "rounded"),
        (REAL, 1.0, -100.0, -100.05, "rounded"),
        (REAL, 1.0, 100.0, 100.2, "clamped"),
        (REAL, 1.0, 0.0, 0.001, "clamped"),
    ],
)
def test_outcomes(
    type_: ParameterType, before: float | None, wanted: float, answer: float, outcome: str
) -> None:
    known = None if before is None else Parameter("P", before, type_)
    assert outcome_of(Parameter("P", wanted, type_), known, Parameter("P", answer, type_)) == outcome


def test_a_vehicle_that_keeps_its_value_refuses() -> None:
    error = outcome_of(Parameter("P", 7, INT), Parameter("P", 1, INT), Parameter("P", 1, INT))
    assert isinstance(error, ParameterRejected)
    assert str(error).startswith("P = 7 was refused: the vehicle keeps 1")
