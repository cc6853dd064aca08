"""Assignments to read-only attributes raise errors that name the method to call."""

from __future__ import annotations

import copy
import inspect
from typing import Any
from unittest import mock

import pytest
from flight_harness import Flight
from served_copter import served_copter

import aerokit.sync

PARTS = ("gimbal", "camera", "mission", "fence", "rally", "parameters", "guided")
CALLS = [
    ("mode", "GUIDED", r"Vehicle\.mode = 'GUIDED' is not allowed: .*set_mode\('GUIDED'\)"),
    ("armed", True, r"Vehicle\.armed = True is not allowed: .*arm\(\) or disarm\(\)"),
    ("home", None, r"set_home\(place\)"),
    ("heading_deg", 90, r"set_heading\(degrees\)"),
    ("is_silent", True, r"Vehicle\.is_silent = True is not allowed: this attribute is read-only"),
]


@pytest.mark.anyio
@pytest.mark.parametrize(("name", "value", "text"), CALLS)
async def test_assignment_error_names_method(grounded: Flight, name: str, value: object, text: str) -> None:
    cell = getattr(grounded.vehicle, name)
    with pytest.raises(AttributeError, match=text) as caught:
        setattr(grounded.vehicle, name, value)
    assert ("await" in str(caught.value)) == ("write" in str(caught.value))
    assert getattr(grounded.vehicle, name) is cell


@pytest.mark.anyio
async def test_vehicle_attributes_are_read_only(grounded: Flight) -> None:
    objects = [grounded.vehicle, *(getattr(grounded.vehicle, part) for part in PARTS[:-1])]
    assert [assigned for thing in objects for assigned in assignable(thing)] == []


def test_blocking_vehicle_attributes_are_read_only() -> None:
    with served_copter() as address, aerokit.sync.connect(address) as vehicle:
        vehicle.wait_ready()
        with pytest.raises(AttributeError, match=r"write ….set_mode\('GUIDED'\)"):
            vehicle.mode = "GUIDED"  # type: ignore[assignment]
        with pytest.raises(AttributeError, match=r"position is a StateCell: did you mean \.value\.latitude_deg\?"):
            vehicle.position.latitude_deg  # type: ignore[attr-defined]  # noqa: B018
        assert copy.copy(vehicle.position).latest is not None
        objects = [vehicle, *(getattr(vehicle, part) for part in PARTS)]
        assert [assigned for thing in objects for assigned in assignable(thing)] == []


def assignable(thing: Any) -> list[str]:
    """Return the reported attributes (cells, properties, parts) that accept another value, and restore them."""
    found = []
    for name in dir(type(thing)):
        attribute = inspect.getattr_static(type(thing), name)
        is_told = not name.startswith("_") and hasattr(type(attribute), "__get__") and not callable(attribute)
        if not is_told or (isinstance(attribute, property) and attribute.fset is not None):
            continue
        try:
            setattr(thing, name, None)
        except AttributeError:
            continue
        found.append(f"{type(thing).__name__}.{name}")
    return found


@pytest.mark.anyio
async def test_program_attributes_and_mocks_can_be_assigned(grounded: Flight) -> None:
    vehicle: Any = grounded.vehicle
    for vehicle.note in (1, 2):
        assert vehicle.note
    with mock.patch.object(vehicle, "go_to") as go_to:
        assert vehicle.go_to is go_to
    assert vehicle.go_to is not go_to


@pytest.mark.anyio
async def test_cell_error_names_value_attribute(grounded: Flight) -> None:
    vehicle: Any = grounded.vehicle
    with pytest.raises(AttributeError, match=r"position is a StateCell: did you mean \.value\.latitude_deg\?"):
        vehicle.position.latitude_deg  # noqa: B018
    with pytest.raises(AttributeError, match=r"StateCell has no attribute 'latitude'"):
        vehicle.position.latitude  # noqa: B018
    assert not hasattr(vehicle.position, "__deepcopy__")
