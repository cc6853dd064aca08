"""The schema matches the types, and published messages match the schema."""

from __future__ import annotations

import asyncio
import inspect
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import aerokit
from aerokit.apps.network import Publisher, publishing
from aerokit.apps.network.publishing import REPEAT_INTERVAL_S
from aerokit.apps.network.schema import ENUMS, document, rendered
from aerokit.errors import ConnectionClosed, InvalidArgument
from aerokit.sim import SimulatedCopter, SimulatedPlane, SimulatedPx4, SimulatedVehicle, simulated_link
from aerokit.testing import run_virtual
from aerokit.vehicle.state import states

SCHEMA = document()
KINDS: dict[str, Any] = {
    "object": dict, "array": list, "string": str, "boolean": bool, "integer": int, "number": (int, float),
    "null": type(None),
}  # fmt: skip


def faults(value: object, schema: dict[str, Any], at: str = "") -> list[str]:
    """Return the violations, for the parts of JSON Schema that aerokit uses."""
    known = {
        "$ref", "anyOf", "const", "description", "enum", "format", "items", "maxItems", "maximum", "minItems",
        "minimum", "pattern", "prefixItems", "properties", "required", "title", "type",
    }  # fmt: skip
    assert schema.keys() <= known, schema.keys() - known
    problems: list[str] = []
    if "$ref" in schema:
        problems += faults(value, SCHEMA["$defs"][schema["$ref"].removeprefix("#/$defs/")], at)
    if "type" in schema:
        kinds = [schema["type"]] if isinstance(schema["type"], str) else schema["type"]
        is_one = any(
            isinstance(value, KINDS[kind]) and (isinstance(value, bool) <= (kind == "boolean")) for kind in kinds
        )
        if not is_one:
            return [*problems, f"{at}: {value!r} is no {kinds}"]
    if "anyOf" in schema and all(faults(value, each, at) for each in schema["anyOf"]):
        problems.append(f"{at}: {value!r} is none of {schema['anyOf']}")
    if "const" in schema and value != schema["const"]:
        problems.append(f"{at}: {value!r} is not {schema['const']!r}")
    if "enum" in schema and value not in schema["enum"]:
        problems.append(f"{at}: {value!r} is none of {schema['enum']}")
    if isinstance(value, dict):
        problems += [f"{at}: {name} is missing" for name in schema.get("required", ()) if name not in value]
        for name, each in schema.get("properties", {}).items():
            if name in value:
                problems += faults(value[name], each, f"{at}/{name}")
    if isinstance(value, list):
        members = schema.get("prefixItems", [schema.get("items", {})] * len(value))
        if not schema.get("minItems", 0) <= len(value) <= schema.get("maxItems", len(value)):
            problems.append(f"{at}: {len(value)} items")
        for number, each in enumerate(value):
            problems += faults(each, members[number], f"{at}/{number}")
    if isinstance(value, str) and not re.search(schema.get("pattern", ""), value):
        problems.append(f"{at}: {value!r} is not like {schema['pattern']}")
    if isinstance(value, (int, float)) and not value >= schema.get("minimum", value):
        problems.append(f"{at}: {value!r} is too small")
    return problems


class Kept(Publisher):
    """A publisher that keeps everything."""

    def __init__(self) -> None:
        self.put_: list[tuple[str, dict[str, Any]]] = []

    def put(self, name: str, data: bytes) -> None:
        self.put_.append((name, json.loads(data)))

    def of(self, state: str) -> list[dict[str, Any]]:
        return [message for name, message in self.put_ if name == f"1/{state}"]


def test_schema_file_matches_types() -> None:
    path = Path(__file__).parents[3] / "docs" / "state.schema.json"
    assert path.read_text(encoding="utf-8") == rendered(), (
        "run python -m aerokit.apps.network.schema > docs/state.schema.json"
    )
    assert json.loads(rendered()) == SCHEMA


def test_schema_enums_cover_all_named_integers() -> None:
    folder = Path(inspect.getfile(states)).parent
    used = {name for path in folder.glob("*.py") for name in re.findall(r"\bmember\((\w+)", path.read_text("utf-8"))}
    assert used - {"enum"} <= {each.__name__ for each in ENUMS.values()}


@pytest.mark.parametrize("kind", [SimulatedCopter, SimulatedPlane, SimulatedPx4])
def test_published_states_of_flight_match_schema(kind: Callable[[], SimulatedVehicle]) -> None:
    kept = Kept()

    async def main() -> None:
        async with (
            simulated_link(kind()) as link,
            aerokit.connect(link) as vehicle,
            publishing(vehicle, kept, rate_hz=10),
        ):
            await vehicle.wait_ready()
            if kind is SimulatedCopter:
                await vehicle.set_mode("GUIDED")
            if kind is not SimulatedPlane:
                await vehicle.arm()
                await vehicle.take_off(5)

    run_virtual(main())
    by_name = {each["properties"]["state"]["const"]: each for each in SCHEMA["oneOf"]}
    states = {message["state"] for _, message in kept.put_}
    assert {"mode", "armed", "position", "attitude", "gps", "batteries", "version", "home", "link"} <= states
    for name, message in kept.put_:
        assert name == f"1/{message['state']}"
        assert faults(message, by_name[message["state"]]) == []


def test_schema_check_finds_errors() -> None:
    (position,) = (each for each in SCHEMA["oneOf"] if each["title"] == "armed")
    good = {"version": 1, "system_id": 1, "state": "armed", "value": True, "age_s": 0.1, "unix_s": 1.0}
    assert faults(good, position) == []
    for wrong in ({"value": 1}, {"version": 2}, {"system_id": 0}, {"state": "mode"}, {"age_s": "old"}):
        assert faults({**good, **wrong}, position)
    assert faults({name: each for name, each in good.items() if name != "value"}, position)


def test_unchanged_state_is_repeated_every_two_seconds() -> None:
    kept = Kept()

    async def main() -> None:
        async with simulated_link(SimulatedCopter()) as link, aerokit.connect(link) as vehicle:
            await vehicle.wait_ready()
            async with publishing(vehicle, kept, rate_hz=4, states=["attitude", "armed", "link"]) as under_way:
                await asyncio.sleep(10)
                assert under_way.published == len(kept.put_)
                assert not kept.of("position")

    run_virtual(main())
    assert 5 <= len(kept.of("armed")) <= 10 / REPEAT_INTERVAL_S + 1
    assert 5 <= len(kept.of("link")) <= 10 / REPEAT_INTERVAL_S + 1
    assert len(kept.of("attitude")) <= 41
    ages = [message["age_s"] for message in kept.of("armed")]
    assert all(0 <= age <= 1.1 for age in ages)  # sent with each heartbeat


def test_publishing_invalid_arguments_raise() -> None:
    async def main() -> None:
        async with simulated_link(SimulatedCopter()) as link, aerokit.connect(link) as vehicle:
            wrongs: list[dict[str, Any]] = [{"rate_hz": 0.0}, {"rate_hz": 51.0}, {"states": ["nonsense"]}]
            for wrong in wrongs:
                with pytest.raises(InvalidArgument, match=r"not allowed|is not a state"):
                    async with publishing(vehicle, Kept(), **wrong):
                        pass
            with pytest.raises(InvalidArgument, match="they are mqtt, mqtts, zenoh, zenohin"):
                async with publishing(vehicle, "udpin:0.0.0.0:14550"):
                    pass
        with pytest.raises(ConnectionClosed):
            async with publishing(vehicle, Kept()):
                pass

    run_virtual(main())
