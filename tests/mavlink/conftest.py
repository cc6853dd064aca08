"""Runs the tests of the wire with both implementations, in one process."""

from __future__ import annotations

from collections.abc import Iterator
from types import MethodType

import framer_harness
import pytest
from exhaustive import exhaustive

from aerokit.mavlink import STANDARD, Dialect, encoder, tlog
from aerokit.mavlink.frame import x25_in_python
from aerokit.mavlink.framer import Framer, PythonFramer

WITH_BOTH = ("test_framer", "test_hostile_bytes", "test_encoder", "test_tlog", "test_recorded_traffic", "test_signing")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    name = getattr(metafunc.module, "__name__", "")
    if name in WITH_BOTH:
        python = exhaustive("python") if name == "test_recorded_traffic" else "python"
        rows = ["python"] if Framer is PythonFramer else ["c", python]  # built, and not AEROKIT_PURE=1?
        metafunc.parametrize("implementation", rows, indirect=True, scope="module")


@pytest.fixture(scope="module", autouse=True)  # Without autouse, pytest ignores the parameter.
def implementation(request: pytest.FixtureRequest) -> Iterator[None]:
    """Replace the compiled code by the Python code if the parameter is "python"."""
    with pytest.MonkeyPatch.context() as patch:
        if getattr(request, "param", "c") == "python":
            patch.setattr(encoder.FrameEncoder, "_encode_frame", None)
            patch.setattr(encoder, "x25", x25_in_python())
            patch.setattr(tlog, "_compiled", None)
            patch.setattr(STANDARD, "decode", MethodType(Dialect.decode, STANDARD))
            for module in (request.module, framer_harness):
                patch.setattr(module, "Framer", PythonFramer, raising=False)
        yield
