"""MAVLink's numbers are used through the generated enums only."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from aerokit import enums

SOURCE = Path(__file__).parent.parent / "src" / "aerokit"
GENERATED = ("mavlink/enums", "mavlink/messages")
ENUMS = (
    enums.MavCmd, enums.MavResult, enums.MavFrame, enums.MavType, enums.MavAutopilot, enums.MavComponent,
    enums.MavLandedState, enums.MavModeFlag, enums.MissionState, enums.MavMissionResult, enums.MavProtocolCapability,
)  # fmt: skip
PREFIXES = (
    "",
    "MAV_CMD_",
    "RESULT_",
    "MAV_FRAME_",
    "MAV_TYPE_",
    "MAV_AUTOPILOT_",
    "MAV_COMP_ID_",
    "LANDED_",
    "STATE_",
)
NAMES = {f"{prefix}{member.name}": member.value for kind in ENUMS for member in kind for prefix in PREFIXES}


def declared(path: Path) -> Iterator[tuple[str, int]]:
    """Return integer constants of a module."""
    for node in ast.parse(path.read_text()).body:
        if not isinstance(node, ast.Assign) or len(node.targets) != 1:
            continue
        target, value = node.targets[0], node.value
        pairs = [(target, value)]
        if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
            pairs = list(zip(target.elts, value.elts, strict=False))
        for name, number in pairs:
            if isinstance(name, ast.Name) and isinstance(number, ast.Constant) and type(number.value) is int:
                yield name.id, number.value


@pytest.mark.exhaustive
@pytest.mark.parametrize("package", sorted(path.name for path in SOURCE.iterdir() if path.is_dir()))
def test_standard_numbers_are_not_redeclared(package: str) -> None:
    files = [
        path for path in (SOURCE / package).rglob("*.py") if not str(path.relative_to(SOURCE)).startswith(GENERATED)
    ]
    again = [
        f"{file.relative_to(SOURCE)}: {name} = {number}"
        for file in files
        for name, number in declared(file)
        if NAMES.get(name.lstrip("_")) == number and len(name) > 8
    ]
    assert not again
