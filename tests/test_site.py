"""The documentation site as it is built: what the search finds, what the reference shows, what fits a phone.

Building takes half a minute. With AEROKIT_SITE=DIRECTORY, the tests use a site that is built already.
"""

from __future__ import annotations

import ast
import html
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pages
import pytest
from for_each import for_each

HELPERS = Path(__file__).parent / "helpers"
HOW_TO = pages.ROOT / "docs" / "how-to"
MAX_INDEX_BYTES = 600_000
PHONE = {"width": 390, "height": 844}
CHROMIUM = os.environ.get("AEROKIT_CHROMIUM") or shutil.which("chromium")
FIRST_HITS = {
    "take_off": "Vehicle.take_off",
    "take off": "Vehicle.take_off",
    "arm": "Vehicle.arm",
    "arm()": "Vehicle.arm",
    "vehicle.arm": "Vehicle.arm",
    "go_to": "Vehicle.go_to",
    "land": "Vehicle.land",
    "hold": "Vehicle.hold",
    "set_mode": "Vehicle.set_mode",
    "wait_ready": "Vehicle.wait_ready",
    "return_to_launch": "Vehicle.return_to_launch",
    "subscribe": "Vehicle.subscribe",
    "command": "Vehicle.command",
    "StateCell": "StateCell",
    "wait_until": "StateCell.wait_until",
    "fresh": "StateCell.fresh",
    "connect": "connect",
    "open_connection": "open_connection",
    "Position": "Position",
    "Mission": "Mission",
    "waypoint": "waypoint",
    "take_photo": "Camera.take_photo",
    "Parameters.download": "Parameters.download",
    "set_heading": "Vehicle.set_heading",
    "OperationRejected": "OperationRejected",
    "ModeChanged": "ModeChanged",
    "SimulatedCopter": "SimulatedCopter",
    "run_virtual": "run_virtual",
    "BATTERY_STATUS": "BatteryStatus BATTERY_STATUS (147)",
    "MavCmd": "MavCmd MAV_CMD",
}
"""Query: title of the first entry that the site shows."""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if "AEROKIT_SITE" in os.environ:
        return Path(os.environ["AEROKIT_SITE"])
    pytest.importorskip("mkdocs", reason="mkdocs is installed by `nox -s docs`")
    directory = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(directory)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    subprocess.run(command, check=True, cwd=pages.ROOT, env=environment, timeout=240)
    return directory


def reference(site: Path, name: str) -> str:
    return (site / "reference" / f"{name}.html").read_text(encoding="utf-8")


def text_of(markup: str) -> str:
    return " ".join(html.unescape(re.sub(r"<[^>]+>", "", markup)).split())


@pytest.mark.exhaustive
@pytest.mark.timeout(300)
@pytest.mark.skipif(shutil.which("node") is None, reason="there is no node")
def test_search_finds_the_api_first(site: Path) -> None:
    command = ["node", str(HELPERS / "search_site.mjs"), str(site), *FIRST_HITS]
    found = json.loads(subprocess.run(command, check=True, capture_output=True, timeout=60).stdout)
    first = {query: hits[0][1] if hits else "" for query, hits in found.items()}
    assert first == FIRST_HITS
    assert all(found[query][0][0].startswith("reference/") for query in FIRST_HITS)


@pytest.mark.exhaustive
@pytest.mark.timeout(300)
def test_search_index_is_small(site: Path) -> None:
    assert (site / "search" / "search_index.json").stat().st_size < MAX_INDEX_BYTES


@pytest.mark.exhaustive
@pytest.mark.timeout(300)
def test_headings_of_reference_have_no_module_paths(site: Path) -> None:
    for path in (site / "reference").glob("*.html"):
        headings = re.findall(r"<h([2-6])[^>]*>(.*?)</h\1>", path.read_text(encoding="utf-8"), re.DOTALL)
        assert not [title for _, title in headings if re.search(r"aerokit\.\w+\.", text_of(title))], path.name


@pytest.mark.exhaustive
@pytest.mark.timeout(300)
def test_vehicle_page_shows_no_internals(site: Path) -> None:
    markup = reference(site, "vehicle")
    start, end = markup.index('id="aerokit.Vehicle"'), markup.index('id="aerokit.Vehicle.wait_ready"')
    assert "Vehicle(" not in text_of(markup[start:end])
    assert "StateCell(" not in text_of(reference(site, "cells"))
    signatures = [text_of(found) for found in re.findall(r"<pre>(.*?)</pre>", markup, re.DOTALL)]
    take_off = next(found for found in signatures if found.startswith("take_off("))
    assert "timeout: float = 60.0" in take_off
    assert not [found for found in signatures if re.search(r"= [A-Z][A-Z_]+_S\b", found)]


@pytest.mark.exhaustive
@pytest.mark.timeout(300)
def test_actions_come_before_attributes(site: Path) -> None:
    markup = reference(site, "vehicle")
    places = [
        markup.index(f'id="aerokit.Vehicle.{name}"') for name in ("arm", "take_off", "subscribe", "position", "mode")
    ]
    assert max(places[:3]) < min(places[3:])


@pytest.mark.exhaustive
@pytest.mark.timeout(300)
def test_entries_show_their_examples(site: Path) -> None:
    entry = text_of(reference(site, "vehicle").partition('id="aerokit.Vehicle.go_to"')[2].partition("Parameters:")[0])
    assert "await vehicle.go_to(here.offset(north_m=30, up_m=5), speed_m_s=6)" in entry


@pytest.fixture
def phone() -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is installed by `nox -s browser`")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu"])
        yield browser.new_page(viewport=PHONE)
        browser.close()


@pytest.mark.exhaustive
@pytest.mark.timeout(300)
@pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium")
def test_pages_fit_a_phone(site: Path, phone: Any) -> None:
    for name in (
        "index",
        "tutorial",
        "how-to/index",
        "how-to/actions",
        "reference/index",
        "reference/vehicle",
    ):
        phone.goto((site / f"{name}.html").as_uri())
        assert phone.evaluate("document.documentElement.scrollWidth") <= PHONE["width"], name


@for_each("page", sorted(HOW_TO.glob("*.md")))
def test_how_to_blocks_fit_the_shortest_program(page: Path) -> None:
    """The program on the index has the imports of a block at the top, and the rest of the block in ``main``."""
    program = pages.blocks(HOW_TO / "index.md")[0].body
    opening = re.search(r"^( +)async with .* as vehicle:\n", program, re.MULTILINE)
    assert opening
    head, tail = program[: opening.end()], program[program.index("\n\nasyncio.run") :]
    for chain in pages.chains(page):
        if not pages.needs_vehicle(chain) or not pages.is_runnable(chain):
            continue
        statements = [statement for block in chain for statement in block.tree.body]
        imports = [ast.unparse(node) for node in statements if isinstance(node, (ast.Import, ast.ImportFrom))]
        first = chain[0].tree.body
        leading = [isinstance(node, (ast.Import, ast.ImportFrom)) for node in first]
        assert leading == sorted(leading, reverse=True), f"{page.name}: imports come first"
        rest = [ast.unparse(node) for node in statements if not isinstance(node, (ast.Import, ast.ImportFrom))]
        body = "\n".join(f"{opening[1]}    {line}" for text in rest for line in text.splitlines())
        compile("\n".join([*imports, head + body + tail]), str(page), "exec")
