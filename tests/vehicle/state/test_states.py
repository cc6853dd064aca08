"""States are declared once: rates, errors of a declaration, the attribute on both vehicles, the page in docs/."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import pytest
from for_each import for_each

import aerokit
import aerokit.sync
from aerokit.mavlink import messages
from aerokit.mavlink.enums import MavPowerStatus
from aerokit.vehicle.session.subscriber import subscription_rate_hz
from aerokit.vehicle.state import condition, equipment, measurements, movement
from aerokit.vehicle.state.equipment import Power
from aerokit.vehicle.state.field import MessageSource, StateField
from aerokit.vehicle.state.states import DEFAULT_RATES_HZ, STATES
from aerokit.vehicle.state.table import documentation, rendered
from aerokit.vehicle.state.telemetry import Telemetry


def test_subscription_rate_defaults_to_message_rate() -> None:
    assert DEFAULT_RATES_HZ["Attitude"] > 4.0
    kinds = (messages.Attitude, messages.RawImu, messages.Odometry, messages.Statustext)
    rates = [subscription_rate_hz(kind) for kind in kinds]
    assert rates == [DEFAULT_RATES_HZ["Attitude"], 4.0, 4.0, None]


def test_power() -> None:
    telemetry = Telemetry(lambda: 0.0)
    assert telemetry.power.waits_for == "POWER_STATUS"
    telemetry.receive(messages.PowerStatus(5012, 0, MavPowerStatus.BRICK_VALID))
    assert telemetry.power.value == Power(5.012, None, MavPowerStatus.BRICK_VALID)


def test_state_field_invalid_declaration_raises() -> None:
    with pytest.raises(ValueError, match="needs at least one message"):
        StateField[int]()
    with pytest.raises(ValueError, match="Heartbeet is not the name of a message class"):
        MessageSource("Heartbeet", lambda message: 1)


@for_each("name", STATES)
def test_states_are_on_both_vehicle_classes_and_documented(name: str) -> None:
    assert hasattr(aerokit.Vehicle, name)
    assert hasattr(aerokit.sync.Vehicle, name), "it has no twin: run python -m aerokit.sync.generator"
    assert documentation()[name][1].endswith(".")


@for_each("module", [condition, equipment, measurements, movement])
def test_value_classes_are_all_exported(module: ModuleType) -> None:
    classes = [name for name, item in vars(module).items() if getattr(item, "__module__", "") == module.__name__]
    missing = [name for name in classes if name[0].isupper() and name not in module.__all__]
    assert not missing, f"add them to __all__, so that the reference lists them: {missing}"


def test_states_page_is_current() -> None:
    page = Path(__file__).parents[3] / "docs" / "states.md"
    assert page.read_text(encoding="utf-8") == rendered(), "run python -m aerokit.vehicle.state.table > docs/states.md"
