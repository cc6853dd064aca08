"""Parameters between the client's protocol machines and simulated vehicles over bad radios: list, read, write."""

from __future__ import annotations

import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from protocol_pair import KINDS, Pair, radios, seeds, vehicle_of

from aerokit.errors import ParameterRejected, ParameterTimeout
from aerokit.parameters import Parameter
from aerokit.parameters.pack import px4_hash
from aerokit.protocols.parameter_list import ParameterList
from aerokit.protocols.parameter_requests import ParameterReads, ParameterWrites
from aerokit.testing.fault_model import FaultModel

each = pytest.mark.parametrize("kind", KINDS)
# No shrinking: a failure reports radio and seed, and shrinking a transfer that hangs would take minutes.
few = settings(max_examples=6, phases=[Phase.generate])


@each
@few
@given(radio=radios, seed=seeds)
def test_list_equals_the_parameters(kind: str, radio: FaultModel, seed: int) -> None:
    vehicle = vehicle_of(kind)
    table = Pair(vehicle, radio, seed).run(ParameterList(1, 1, bytewise=kind == "px4"))
    assert {name: table[name].value for name in table} == pytest.approx(
        {name: vehicle.parameters[name] for name in vehicle.parameters}, rel=1e-6
    )


@few
@given(radio=radios, seed=seeds)
def test_list_hash_equals_px4_hash(radio: FaultModel, seed: int) -> None:
    vehicle = vehicle_of("px4")
    volatile = {name for name in vehicle.parameters if vehicle.parameters.row(name).is_volatile}
    pair = Pair(vehicle, radio, seed)
    table = pair.run(ParameterList(1, 1, bytewise=True))
    reported = pair.run(ParameterReads(1, 1, ["_HASH_CHECK"], bytewise=True))["_HASH_CHECK"]
    assert isinstance(reported, Parameter)
    assert int(reported.value) == px4_hash(table, volatile)


@each
@few
@given(radio=radios, seed=seeds, picks=st.lists(st.integers(0, 59), max_size=12, unique=True))
def test_read_value_equals_the_parameter(kind: str, radio: FaultModel, seed: int, picks: list[int]) -> None:
    vehicle = vehicle_of(kind)
    known = sorted(vehicle.parameters)
    names = [known[pick] for pick in picks]
    exchange = ParameterReads(1, 1, [*names, "NOT_THERE"], bytewise=kind == "px4", probe=True, idle_timeout_s=60)
    answers = Pair(vehicle, radio, seed).run(exchange)
    assert isinstance(answers.pop("NOT_THERE"), ParameterRejected | ParameterTimeout)  # Autopilots do not answer.
    assert {name: answer.value for name, answer in answers.items() if isinstance(answer, Parameter)} == (
        pytest.approx({name: vehicle.parameters[name] for name in names}, rel=1e-6)
    )


@each
@few
@given(radio=radios, seed=seeds, values=st.lists(st.integers(0, 9), min_size=1, max_size=8))
def test_set_changes_only_its_parameter(kind: str, radio: FaultModel, seed: int, values: list[int]) -> None:
    vehicle = vehicle_of(kind)
    table = Pair(vehicle).run(ParameterList(1, 1, bytewise=kind == "px4"))
    before = {name: vehicle.parameters[name] for name in vehicle.parameters}
    names = [name for name in table if not name.startswith(("STAT_", "MAV_", "SYSID", "FORMAT"))][5:]
    wanted = [table[name].replace(value=value) for name, value in zip(names, values, strict=False)]
    exchange = ParameterWrites(1, 1, wanted, bytewise=kind == "px4", idle_timeout_s=60)
    answers = Pair(vehicle, radio, seed).run(exchange)
    for one in wanted:
        answer = answers[one.name]
        assert isinstance(answer, Parameter)
        assert answer.value == vehicle.parameters[one.name] == one.value
    changed = {name for name in before if vehicle.parameters[name] != before[name]}
    assert changed <= {one.name for one in wanted}
