"""Ground station failsafes: the action that a vehicle takes according to its parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping

    from aerokit.vehicle.vehicle import Vehicle

_OFF = "continues: the failsafe is off"
_RETURN, _SMART, _HOLD, _TERMINATE = (
    "returns to launch",
    "returns on its own track",
    "holds",
    "stops its motors",
)
# Maps firmwares to the parameters that determine the action, the most important parameter first, and to the actions of
# their values. If a value is not listed, the next parameter decides. Sources: Parameters.cpp of ArduPilot's firmwares,
# navigator parameters of PX4.
_ACTIONS: Mapping[str, Mapping[str, Mapping[float, str]]] = {
    "ArduCopter": {
        "FS_GCS_ENABLE": {
            0: _OFF,
            1: _RETURN,
            2: f"continues its mission, otherwise {_RETURN}",
            3: f"{_SMART}, otherwise {_RETURN}",
            4: f"{_SMART}, otherwise lands",
            5: "lands",
            6: f"flies its landing sequence, otherwise {_RETURN}",
            7: "brakes, otherwise lands",
        }
    },
    "ArduPlane": {
        "FS_GCS_ENABL": {0: _OFF},
        "FS_LONG_ACTN": {
            0: f"continues in AUTO and GUIDED, otherwise {_RETURN}",
            1: _RETURN,
            2: "glides",
            3: "opens its parachute",
            4: "flies its mission",
            5: f"lands (AUTOLAND), otherwise {_RETURN}",
        },
    },
    "Rover": {
        "FS_GCS_ENABLE": {0: _OFF},
        "FS_ACTION": {
            0: "continues",
            1: _RETURN,
            2: _HOLD,
            3: f"{_SMART}, otherwise {_RETURN}",
            4: f"{_SMART}, otherwise {_HOLD}",
            5: _TERMINATE,
            6: _HOLD,
        },
    },
    "ArduSub": {"FS_GCS_ENABLE": {0: _OFF, 1: "continues", 2: _TERMINATE, 3: "holds its depth", 4: "surfaces"}},
    "PX4": {"NAV_DLL_ACT": {0: _OFF, 1: _HOLD, 2: _RETURN, 3: "lands", 5: _TERMINATE, 6: _TERMINATE}},
}


def ground_station_failsafe(vehicle: Vehicle) -> dict[str, Any]:
    """Return the vehicle's action after the loss of the ground station, according to its parameters.

    ``action`` is a clause, or None while the action is unknown. ``because`` is the parameter that decides, with its
    value. ``unread`` lists parameters that would be needed but were not read. Requests nothing.
    """
    for name, actions in _ACTIONS.get(vehicle.autopilot.firmware, {}).items():
        parameter = vehicle.parameters.known(name)
        if parameter is None:
            return {"action": None, "because": None, "unread": [name]}
        action = actions.get(parameter.value)
        if action is not None:
            return {"action": action, "because": f"{name} = {parameter.value:g}", "unread": []}
    return {"action": None, "because": None, "unread": []}
