"""The reference pages list every public name."""

from __future__ import annotations

import importlib
import inspect
import runpy
from pathlib import Path
from typing import Any

import pytest
from for_each import for_each

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def site() -> dict[str, Any]:
    return runpy.run_path(str(ROOT / "docs" / "site_reference.py"))


@pytest.fixture(scope="module")
def pages(site: dict[str, Any]) -> dict[str, str]:
    return dict(site["reference_pages"]())


def test_every_object_is_listed_once(pages: dict[str, str]) -> None:
    listed = [line for text in pages.values() for line in text.splitlines() if line.startswith("::: ")]
    assert len(listed) > 400
    assert sorted(listed) == sorted(set(listed))


@for_each(
    "page, names",
    [
        (
            "aerokit",
            ["connection.opening.open_connection", "mavlink.signing.Signing"],
        ),
        ("vehicle", ["vehicle.vehicle.Vehicle", "vehicle.connect.connect"]),
        ("missions", ["vehicle.missions.mission.MissionControl", "missions.mission.Mission"]),
        ("parameters", ["vehicle.parameters.parameters.Parameters", "parameters.table.ParameterTable"]),
        ("dronekit", ["dronekit.vehicle.connect", "dronekit.vehicle.Vehicle"]),
        ("sync", ["sync.twins.Vehicle"]),
    ],
)
def test_page_lists_central_names(pages: dict[str, str], page: str, names: list[str]) -> None:
    for name in names:
        assert f"\n::: aerokit.{name}\n" in pages[f"reference/{page}.md"]


@for_each("name", ["", "missions", "parameters", "errors", "events", "sim", "testing", "transport"])
def test_every_exported_name_is_listed(pages: dict[str, str], name: str) -> None:
    module = importlib.import_module(f"aerokit.{name}" if name else "aerokit")
    text = pages[f"reference/{name or 'aerokit'}.md"]
    for exported in module.__all__:
        if not inspect.ismodule(getattr(module, exported)):
            assert f".{exported}\n" in text or f"[`{exported}`][" in text, exported


def test_messages_and_enums_are_listed(pages: dict[str, str]) -> None:
    for page, min_count in (("messages", 300), ("enums", 200)):
        assert pages[f"reference/{page}.md"].count('<a id="') > min_count
    assert "**Attitude** · ATTITUDE (30): " in pages["reference/messages.md"]


def test_every_command_is_listed(pages: dict[str, str]) -> None:
    for command in (
        "demo",
        "sim",
        "run",
        "params",
        "mission",
        "files",
        "logs",
        "camera",
        "gimbal",
        "monitor",
    ):
        assert f"aerokit {command}\n" in pages["reference/cli.md"]
