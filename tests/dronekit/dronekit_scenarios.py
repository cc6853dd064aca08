"""All scenarios: importing the modules that hold them fills the list."""

from __future__ import annotations

import dronekit_scenarios_data
import dronekit_scenarios_listeners
import dronekit_scenarios_orders
import dronekit_scenarios_state
from dronekit_stage import SCENARIOS, Scenario

__all__ = [
    "SCENARIOS",
    "Scenario",
    "dronekit_scenarios_data",
    "dronekit_scenarios_listeners",
    "dronekit_scenarios_orders",
    "dronekit_scenarios_state",
]

SCENARIOS.sort(key=lambda scenario: scenario.name)  # in every worker of pytest-xdist the same order
