"""The example project: its own tests pass, with nothing but the plugin."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

pytest_plugins = ["pytester"]

PROJECT = Path(__file__).parent.parent.parent / "examples" / "testing_a_mission"


@pytest.mark.exhaustive
def test_the_example_passes(pytester: pytest.Pytester) -> None:
    for file in PROJECT.glob("*.py"):
        shutil.copy(file, pytester.path)
    pytester.syspathinsert()
    result = pytester.runpytest_inprocess(
        "-p", "no:aerokit", "-p", "aerokit.testing.plugin", "-p", "no:xdist", "-p", "no:anyio", "-p", "no:asyncio",
        "-p", "no:cacheprovider", "-W", "error", "--durations", "0",
    )  # fmt: skip
    result.assert_outcomes(passed=7)
