"""The reference pages list every public name, by what users import."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import runpy
from pathlib import Path
from typing import Any

import pages as page_blocks
import pytest
from for_each import for_each

ROOT = Path(__file__).parent.parent
EXAMPLES = ROOT / "docs" / "reference-examples.md"
IMPORTED = [
    "",
    "sync",
    "dronekit",
    "missions",
    "parameters",
    "errors",
    "events",
    "testing",
    "sim",
    "hub",
    "transport",
]


@pytest.fixture(scope="module")
def site() -> dict[str, Any]:
    return runpy.run_path(str(ROOT / "docs" / "site_reference.py"))


@pytest.fixture(scope="module")
def listing(site: dict[str, Any]) -> Any:
    return site["Listing"]()


@pytest.fixture(scope="module")
def pages(site: dict[str, Any], listing: Any) -> dict[str, str]:
    return dict(site["reference_pages"](listing))


@pytest.mark.exhaustive
def test_every_object_is_listed_once(pages: dict[str, str]) -> None:
    listed = [line for text in pages.values() for line in text.splitlines() if line.startswith("::: ")]
    assert len(listed) > 400
    assert sorted(listed) == sorted(set(listed))


@pytest.mark.exhaustive
@for_each(
    "page, names",
    [
        ("aerokit", ["connect", "open_connection", "Position", "Signing"]),
        ("vehicle", ["Vehicle"]),
        ("missions", ["missions.Mission", "missions.waypoint"]),
        ("parameters", ["parameters.ParameterTable"]),
        ("dronekit", ["dronekit.connect", "dronekit.Vehicle"]),
        ("sync", ["sync.connect", "sync.Vehicle"]),
        ("hub", ["Hub"]),
    ],
)
def test_page_lists_names_as_users_import_them(pages: dict[str, str], page: str, names: list[str]) -> None:
    for name in names:
        assert f"\n::: aerokit.{name}\n" in pages[f"reference/{page}.md"]


@for_each("name", IMPORTED)
def test_every_exported_name_is_listed(pages: dict[str, str], name: str) -> None:
    """Names of other libraries, which DroneKit's modules export, are left out."""
    module = importlib.import_module(f"aerokit.{name}" if name else "aerokit")
    text = pages[f"reference/{name or 'aerokit'}.md"]
    for exported in module.__all__:
        item = getattr(module, exported)
        if not inspect.ismodule(item) and str(getattr(item, "__module__", "aerokit")).startswith("aerokit"):
            assert f".{exported}\n" in text or f"[`{exported}`][" in text, exported


@for_each("path", [page for page in page_blocks.pages() if page_blocks.blocks(page)])
def test_every_name_that_a_page_imports_is_listed(listing: Any, path: Path) -> None:
    listed = {(entry.item.__module__, entry.name) for entry in listing.entries.values() if callable(entry.item)}
    for chain in page_blocks.chains(path):
        for node in (node for block in chain for node in ast.walk(block.tree)):
            if not isinstance(node, ast.ImportFrom) or not str(node.module).startswith("aerokit."):
                continue
            if str(node.module) in ("aerokit.mavlink.enums", "aerokit.mavlink.messages"):
                continue
            module = importlib.import_module(str(node.module))
            for name in (alias.name for alias in node.names):
                item = getattr(module, name, None)
                assert item is not None, f"{node.module} has no {name}; is it in the lazy_exports of its package?"
                assert inspect.ismodule(item) or (item.__module__, name) in listed, f"{node.module}.{name}"


def test_classes_of_the_vehicle_are_reached_from_its_annotations(listing: Any) -> None:
    names = {entry.name for entry in listing.entries.values()}
    assert {
        "StateCell",
        "Attitude",
        "Parameters",
        "MissionControl",
        "Camera",
        "CameraStatus",
        "Gimbal",
    } <= names


def test_messages_and_enums_have_headings(pages: dict[str, str]) -> None:
    for page, min_count in (("messages", 300), ("enums", 200)):
        assert pages[f"reference/{page}.md"].count("\n## ") > min_count
    assert "## Attitude <small>ATTITUDE (30)</small> { #Attitude }" in pages["reference/messages.md"]


def test_every_command_is_listed(pages: dict[str, str]) -> None:
    commands = ("demo", "sim", "run", "params", "mission", "files", "logs", "camera", "gimbal", "monitor")
    assert all(f"aerokit {command}\n" in pages["reference/cli.md"] for command in commands)


def test_examples_belong_to_entries(listing: Any) -> None:
    for name in re.findall(r"^## (\S+)$", EXAMPLES.read_text(encoding="utf-8"), re.MULTILINE):
        entry, member = listing.find(name)
        assert not member or hasattr(entry.item, member), name
