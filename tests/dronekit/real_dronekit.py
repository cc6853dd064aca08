"""Run the scenarios marked ``is_kept`` with the real DroneKit of this interpreter.

Prints a JSON object: name of the scenario → observations.
"""

from __future__ import annotations

import collections
import collections.abc
import json
import logging
import sys
from typing import Any

import dronekit_scenarios
from dronekit_stage import Scenario, as_json, play


def main(names: list[str]) -> None:
    collections.MutableMapping = collections.abc.MutableMapping  # type: ignore[attr-defined]  # it is from Python 2
    import dronekit  # type: ignore[import-not-found, unused-ignore]

    logging.getLogger().addHandler(logging.NullHandler())
    kept = [
        scenario
        for scenario in dronekit_scenarios.SCENARIOS
        if scenario.is_kept and (not names or scenario.name in names)
    ]
    print(json.dumps({scenario.name: _observed(dronekit, scenario) for scenario in kept}))  # noqa: T201


def _observed(dronekit: Any, case: Scenario) -> Any:
    # DroneKit is observed with MAVLink 1, because with MAVLink 2 it sends commands as broadcasts.
    try:
        return as_json(play(dronekit, case, version=1))
    except BaseException as error:
        return f"{type(error).__name__}: {error}"


if __name__ == "__main__":
    main(sys.argv[1:])
