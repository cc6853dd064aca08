"""What all tests share: async tests run on asyncio, on virtual time unless a test asks for real sockets."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import settings
from recorded import headline

from aerokit.testing.clock import VirtualClockLoop

settings.register_profile("aerokit", deadline=None, max_examples=60, derandomize=True)
settings.load_profile("aerokit")


@pytest.fixture
def anyio_backend() -> tuple[str, dict[str, Any]]:
    return "asyncio", {"loop_factory": VirtualClockLoop}


def pytest_report_header() -> str:
    return headline()
