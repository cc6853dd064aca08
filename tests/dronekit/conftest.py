"""The scripted flight controller streams nothing: connecting does not wait for it to."""

from __future__ import annotations

import pytest

from aerokit.dronekit import vehicle


@pytest.fixture(autouse=True, scope="session")
def no_first_values() -> None:
    """For the whole session: stages are shared by the tests of a module."""
    pytest.MonkeyPatch().setattr(vehicle, "FIRST_VALUES_TIMEOUT_S", 0.0)
