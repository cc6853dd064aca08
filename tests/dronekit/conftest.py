"""Waits of the classic layer that tests change."""

from __future__ import annotations

import inspect

import pytest

from aerokit.dronekit import vehicle


@pytest.fixture(autouse=True, scope="session")
def no_first_values() -> None:
    """Do not wait for first values: the scripted flight controller streams none.

    The scope is the session, because the tests of a module share a stage.
    """
    pytest.MonkeyPatch().setattr(vehicle, "FIRST_VALUES_TIMEOUT_S", 0.0)


@pytest.fixture(autouse=True)
def patient_connect(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    """Wait longer than 30 s for parameters: a simulated vehicle at many times real time and a busy machine may need it.

    Tests of signatures see the real defaults.
    """
    if request.path.stem != "test_dronekit_reference":
        parameters = inspect.signature(vehicle.connect).parameters
        patient = {**{name: parameter.default for name, parameter in parameters.items()}, "timeout": 200.0}
        defaults = tuple(value for value in patient.values() if value is not inspect.Parameter.empty)
        monkeypatch.setattr(vehicle.connect, "__defaults__", defaults)
