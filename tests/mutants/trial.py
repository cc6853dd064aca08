"""Runs tests on a changed copy of the sources, in a forked process that has everything but aerokit imported already."""

from __future__ import annotations

import compileall
import importlib.util
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType

import pytest
from reach import PYTEST, ROOT, SOURCE

NOTICED, TOO_LONG, SURVIVED = "noticed", "too long", "SURVIVED"
PRELOADED = (
    "anyio._backends._asyncio",
    "hypothesis",
    "fastcrc",
    "pymavlink.mavutil",
    "geographiclib.geodesic",
    "serial",
)

NOTICED_BY = (pytest.ExitCode.TESTS_FAILED, pytest.ExitCode.INTERRUPTED, pytest.ExitCode.USAGE_ERROR)
# pytest fails at its very end, without an exit code, if a test left a file open.
LEFT_OPEN = "PytestUnraisableExceptionWarning"

PRELOADED_IS_FINE = ("-W", "ignore::pytest.PytestAssertRewriteWarning")


class Trials:
    """A copy of the sources in ``folder``, to be changed one file at a time; nothing in the working tree is touched."""

    def __init__(self, folder: Path) -> None:
        self._copy = folder / "aerokit"

    def __enter__(self) -> Trials:
        shutil.copytree(SOURCE, self._copy)
        compileall.compile_dir(self._copy, quiet=2)  # The copy lacks .pyc files of modules that were never imported.
        for name in PRELOADED:
            importlib.import_module(name)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass

    def run(self, path: str, changed: str, tests: Sequence[str], seconds: Mapping[str, float]) -> tuple[str, str]:
        """Return the result of the change, and the test that detected it."""
        if not tests:
            return SURVIVED, "no test runs it"
        target = self._copy / path
        cached = Path(importlib.util.cache_from_source(str(target)))
        original, compiled = target.read_text(), cached.read_bytes()
        cached.unlink()
        target.write_text(changed)
        try:
            return self._fork(tests, sum(seconds[test] for test in tests))
        finally:
            target.write_text(original)
            cached.write_bytes(compiled)

    def _fork(self, tests: Sequence[str], expected_s: float) -> tuple[str, str]:
        with tempfile.TemporaryFile("w+") as output:
            child = os.fork()
            if child == 0:
                self._child(tests, int(10 + 3 * expected_s), output.fileno())
            status = _wait(child, 120 + 10 * expected_s)
            output.seek(0)
            said = output.read()
        if not os.WIFEXITED(status):
            return TOO_LONG, ""
        code = os.WEXITSTATUS(status)
        if code == pytest.ExitCode.OK:
            return SURVIVED, ""
        if code not in NOTICED_BY and LEFT_OPEN not in said:
            raise RuntimeError(f"pytest did not run {tests[0]}: {said[-2000:]}")
        return NOTICED, _first_failure(said)

    def _child(self, tests: Sequence[str], limit_s: int, output: int) -> None:
        os.setsid()
        resource.setrlimit(resource.RLIMIT_CPU, (_cpu_now() + limit_s, _cpu_now() + limit_s + 5))
        os.dup2(output, 1)
        os.dup2(output, 2)
        os.chdir(ROOT)
        sys.dont_write_bytecode = True
        sys.path.insert(0, str(self._copy.parent))
        try:
            code = int(pytest.main([*PYTEST, *PRELOADED_IS_FINE, "-x", "--tb=line", "--timeout=0", *tests]))
        except BaseException:
            sys.stdout.write(traceback.format_exc())
            code = int(pytest.ExitCode.INTERNAL_ERROR)
        sys.stdout.flush()
        os._exit(code)


def _cpu_now() -> int:
    return int(time.process_time()) + 1


def _wait(child: int, limit_s: float) -> int:
    end = time.monotonic() + limit_s
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return status
        if time.monotonic() > end:
            os.killpg(child, signal.SIGKILL)
            return os.waitpid(child, 0)[1]
        time.sleep(0.02)


def _first_failure(said: str) -> str:
    lines = [line for line in said.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return lines[0] if lines else said[-150:].replace("\n", " ")
