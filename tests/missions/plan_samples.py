"""Sample plans in QGroundControl's format."""

from __future__ import annotations

import json
from typing import Any


def simple(command: int, number: int, frame: int = 2, *params: float | None) -> dict[str, Any]:
    values = [*params, *[0] * (7 - len(params))]
    return {
        "autoContinue": True,
        "command": command,
        "doJumpId": number,
        "frame": frame,
        "params": values,
        "type": "SimpleItem",
    }


def place(command: int, number: int, latitude: float, longitude: float, altitude: float) -> dict[str, Any]:
    shown = {"AMSLAltAboveTerrain": None, "Altitude": altitude, "AltitudeMode": 1}
    return shown | simple(command, number, 3, 0, 0, 0, None, latitude, longitude, altitude)


def survey(first: int) -> dict[str, Any]:
    items = [
        place(16, first, 47.39771234567891, 8.545601234567891, 50),
        simple(206, first + 1, 2, 25, 0, 1, None, None, None, None),
        place(16, first + 2, 47.398, 8.5461, 50),
        simple(206, first + 3, 2, 0, 0, 1),
    ]
    for item in items:
        for key in ("AMSLAltAboveTerrain", "Altitude", "AltitudeMode"):
            item.pop(key, None)
    return {
        "TransectStyleComplexItem": {
            "CameraCalc": {"CameraName": "Manual (no camera specs)", "DistanceToSurface": 50, "version": 2},
            "CameraShots": 12,
            "HoverAndCapture": False,
            "Items": items,
            "Refly90Degrees": False,
            "TurnAroundDistance": 10.5,
            "VisualTransectPoints": [[47.39771234567891, 8.545601234567891], [47.398, 8.5461]],
            "version": 2,
        },
        "angle": 12.3,
        "complexItemType": "survey",
        "polygon": [[47.397, 8.545], [47.398, 8.545], [47.398, 8.547]],
        "type": "ComplexItem",
        "version": 5,
    }


def landing() -> dict[str, Any]:
    return {
        "altitudesAreRelative": True,
        "complexItemType": "fwLandingPattern",
        "landCoordinate": [47.3977, 8.5456, 0],
        "landingApproachCoordinate": [47.399, 8.549, 40],
        "loiterClockwise": False,
        "loiterRadius": 75,
        "stopTakingPhotos": True,
        "stopVideoPhotos": True,
        "type": "ComplexItem",
        "useLoiterToAlt": True,
        "valueSetIsDistance": False,
        "version": 2,
    }


def document(*items: dict[str, Any]) -> dict[str, Any]:
    return {
        "fileType": "Plan",
        "geoFence": {
            "breachReturn": [47.3975, 8.5452, 42.5],
            "circles": [
                {
                    "circle": {"center": [47.39756763610029, 8.544649762407738], "radius": 319.85},
                    "inclusion": True,
                    "version": 1,
                }
            ],
            "polygons": [
                {
                    "inclusion": False,
                    "polygon": [[47.3980777, 8.5438346], [47.3983519, 8.55002464], [47.3964101, 8.5449928]],
                    "version": 1,
                }
            ],
            "version": 2,
        },
        "groundStation": "QGroundControl",
        "mission": {
            "cruiseSpeed": 15,
            "firmwareType": 12,
            "globalPlanAltitudeMode": 1,
            "hoverSpeed": 5.5,
            "items": list(items),
            "plannedHomePosition": [47.39774191234, 8.545594, 487.989],
            "vehicleType": 2,
            "version": 2,
        },
        "rallyPoints": {
            "points": [[47.39760401, 8.5509154, 50], [47.39902017, 8.54263274, 49.5]],
            "version": 2,
        },
        "version": 1,
        "x-not-known-to-us": {"kept": [1, None, "ü"]},
    }


def full_document() -> dict[str, Any]:
    """Take-off, survey (4 items), a waypoint, a jump to it, landing pattern (6 items)."""
    return document(
        place(22, 1, 47.3977507, 8.5456075, 50),
        survey(2),
        place(16, 6, 47.39827377, 8.54660532, 50),
        simple(177, 7, 2, 6, 3),
        landing(),
    )


def text(value: object) -> str:
    return json.dumps(value, indent=4)
