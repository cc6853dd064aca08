"""A plugin of pytest: writes which lines of the sources each test runs, and the processor time it takes."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from pathlib import Path

import coverage
import pytest

FOLDER = Path(os.environ["AEROKIT_REACH_SOURCE"])
RESULT = Path(os.environ["AEROKIT_REACH_RESULT"])

# Code that is not mutated here: tracing the simulator would double the time.
OTHERS = ("cli", "dronekit", "mavlink/enums", "mavlink/messages", "sim", "sync", "testing")

measured = coverage.Coverage(
    data_file=None, config_file=False, include=[f"{FOLDER}/*"], omit=[f"{FOLDER}/{name}/*" for name in OTHERS]
)
measured.start()
seconds: dict[str, float] = {}
failed: set[str] = set()


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    measured.switch_context(item.nodeid)
    begin = time.process_time()
    yield
    seconds[item.nodeid] = round(time.process_time() - begin, 3)


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    if report.failed:
        failed.add(report.nodeid)  # a test that fails anyway notices nothing


def pytest_sessionfinish() -> None:
    measured.stop()
    data, lines = measured.get_data(), dict[str, dict[str, list[int]]]()
    for path in data.measured_files():
        name = str(Path(path).relative_to(FOLDER))
        for line, contexts in data.contexts_by_lineno(path).items():
            for context in set(contexts) - failed:
                lines.setdefault(context, {}).setdefault(name, []).append(line)
    passed = {test: took for test, took in seconds.items() if test not in failed}
    RESULT.write_text(json.dumps({"seconds": passed, "lines": lines}))
