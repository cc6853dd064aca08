"""The page of ``aerokit serve`` in a browser: starting the server, opening the page, giving orders.

With AEROKIT_SCREENSHOTS=DIRECTORY, `picture` leaves pictures of the page there.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

CHROMIUM = os.environ.get("AEROKIT_CHROMIUM") or shutil.which("chromium")


@contextlib.contextmanager
def serving(*arguments: str) -> Iterator[dict[str, Any]]:
    command = [sys.executable, "-m", "aerokit", "serve", *arguments, "--port", "0", "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            yield json.loads(process.stdout.readline())
        finally:
            process.terminate()
            assert process.wait(10) == 0


@contextlib.contextmanager
def opened(browser: Any, url: str, wide: int = 1360, high: int = 820, scheme: str = "dark") -> Iterator[Any]:
    """A page, which at the end must have had no mistake, no foreign request and nothing refused by its policy."""
    mistakes: list[str] = []
    context = browser.new_context(viewport={"width": wide, "height": high}, color_scheme=scheme)
    page = context.new_page()
    page.set_default_timeout(10_000)
    page.on("pageerror", lambda error: mistakes.append(str(error)))
    page.on("console", lambda each: mistakes.append(each.text) if each.type == "error" else None)
    page.on("dialog", lambda each: mistakes.append(each.message))
    page.on("request", lambda each: mistakes.append(each.url) if "//127.0.0.1:" not in each.url else None)
    page.goto(url)
    page.wait_for_selector(".vehicle[aria-pressed=true]")
    yield page
    mistakes = [each for each in mistakes if "Failed to load resource" not in each]  # refused orders
    assert mistakes == [], mistakes
    context.close()


def picture(page: Any, name: str) -> None:
    if directory := os.environ.get("AEROKIT_SCREENSHOTS"):
        page.screenshot(path=str(Path(directory) / f"{name}.png"))


def order(page: Any, name: str, fields: dict[str, str] | None = None) -> None:
    page.click(f"button[data-order='{name}']")
    for field, value in (fields or {}).items():
        page.fill(f"dialog input[name={field}]", value)
    page.click("dialog .yes")


def wait_done(page: Any, text: str) -> None:
    page.locator(".toast.done", has_text=text).first.wait_for(timeout=60_000)


def check_contrast(page: Any) -> None:
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="axe is installed by `nox -s browser`")
    found = axe.Axe().run(page).response["violations"]
    severe = [each for each in found if each["impact"] in ("serious", "critical")]
    assert [(each["id"], [node["html"][:120] for node in each["nodes"]]) for each in severe] == []


def boxes_of_orders(page: Any) -> list[Any]:
    return list(page.locator("#orders button").evaluate_all("all => all.map(e => e.getBoundingClientRect().toJSON())"))


def assert_toasts_beside_orders(page: Any) -> None:
    orders, toasts = page.locator("#orders").bounding_box(), page.locator("#toasts").bounding_box()
    assert toasts["y"] + toasts["height"] <= orders["y"] or orders["y"] + orders["height"] <= toasts["y"]
