"""docs/features-onboard.md has an equivalent for each server call of MAVSDK."""

from __future__ import annotations

import ast
import importlib.util
import re
from pathlib import Path
from typing import Any

import pytest

from aerokit.mavlink import messages
from aerokit.mavlink.enums import MavCmd
from aerokit.onboard import AutopilotDriver, CameraDriver, ComponentMissions, ComponentParameters, OnboardComponent

PAGE = Path(__file__).parents[2] / "docs" / "features-onboard.md"
ROW = re.compile(r"^\| `(\w+)\.(\w+)` \| (.+) \|$", re.MULTILINE)
ROOTS: dict[str, Any] = {
    "component.parameters": ComponentParameters,
    "component.missions": ComponentMissions,
    "component": OnboardComponent,
    "camera": CameraDriver,
    "autopilot": AutopilotDriver,
    "messages": messages,
    "MavCmd": MavCmd,
}
SET_BY_CONSTRUCTOR = {"component.parameters", "camera.zoom_percent", "camera.focus_percent"}
MIN_ROWS = 88


def rows() -> list[tuple[str, str, str]]:
    return ROW.findall(PAGE.read_text(encoding="utf-8"))


def test_page_has_a_row_for_each_call() -> None:
    found = rows()
    assert len({(plugin, call) for plugin, call, _ in found}) == len(found)
    assert len([answer for *_, answer in found if not answer.startswith("no")]) >= MIN_ROWS


def test_names_in_rows_exist() -> None:
    missing = []
    for _, call, answer in rows():
        for code in re.findall(r"`([^`]+)`", answer):
            for root, owner in ROOTS.items():
                for name in re.findall(rf"(?<![\w.]){re.escape(root)}\.(\w+)", code):
                    if f"{root}.{name}" not in SET_BY_CONSTRUCTOR and not hasattr(owner, name):
                        missing.append(f"{call}: {root}.{name}")
    assert not missing


@pytest.mark.skipif(importlib.util.find_spec("mavsdk") is None, reason="MAVSDK is not installed")
def test_calls_are_those_of_installed_mavsdk() -> None:
    spec = importlib.util.find_spec("mavsdk")
    assert spec is not None
    assert spec.origin is not None
    expected = set()
    for path in (Path(spec.origin).parent / "asyncio" / "plugins").glob("*server*/*server*.py"):
        plugin = path.stem
        tree = ast.parse(path.read_text())
        methods = {node.name for node in ast.walk(tree) if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))}
        calls = {name for name in methods if not name.startswith(("_", "respond_", "from_c", "to_c", "destroy"))}
        if plugin not in ("mavlink_direct_server",):
            expected |= {(plugin, call) for call in calls if not call.startswith(("callback", "wrapper", "run"))}
    path = Path(spec.origin).parent / "asyncio" / "plugins" / "server_utility" / "server_utility.py"
    assert {(plugin, call) for plugin, call, _ in rows()} == expected, path
