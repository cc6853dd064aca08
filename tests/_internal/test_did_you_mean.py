"""Suggestions for unknown names."""

from __future__ import annotations

import pytest
from flight_harness import Flight

from aerokit._internal.formatting import did_you_mean, short_repr
from aerokit.apps.cli import main
from aerokit.errors import InvalidArgument, ParameterRejected
from aerokit.sim.kinds import kind_class
from aerokit.transport import parse_address


@pytest.mark.sampled(4)
@pytest.mark.parametrize(
    ("arguments", "meant"),
    [
        (["dmeo"], "'demo'"),
        (["params", "lsit"], "'list'"),
        (["demo", "--altitde", "5"], "'--altitude'"),
        (["sim", "--sped-up=3"], "'--speedup'"),
        (["params", "list", "udpin:0.0.0.0:14550", "--changd"], "'--changed'"),
        (["sim", "--vehicle", "coptr"], "'copter'"),
        (["demo", "--connect", "upd://0.0.0.0:14550"], "'udp'"),
    ],
    ids=lambda value: " ".join(value),
)
def test_did_you_mean_for_commands_and_options(
    arguments: list[str], meant: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as exit_:
        main(arguments)
    assert exit_.value.code == 2
    assert f"(did you mean {meant}?)" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("address", "meant"),
    [
        ("tpc://127.0.0.1:5760", "'tcp'"),
        ("udpinn://:14550", "'udpin'"),
        ("serial:///dev/ttyS0?buad=9600", "'baud'"),
    ],
)
def test_did_you_mean_for_address_parts(address: str, meant: str) -> None:
    with pytest.raises(InvalidArgument, match=f"did you mean {meant}"):
        parse_address(address)


def test_did_you_mean_for_vehicle_kinds() -> None:
    with pytest.raises(InvalidArgument, match="did you mean 'rover'"):
        kind_class("rowver")


@pytest.mark.anyio
async def test_did_you_mean_for_parameters(grounded: Flight) -> None:
    parameters = grounded.vehicle.parameters
    with pytest.raises(ParameterRejected) as before:
        await parameters.get("RTL_ATL")
    assert "did you mean" not in str(before.value)
    await parameters.download()
    with pytest.raises(ParameterRejected, match="did you mean 'RTL_ALT'"):
        await parameters.get("RTL_ATL")
    with pytest.raises(ParameterRejected, match="did you mean 'RTL_ALT'"):
        await parameters.set("RTL_ATL", 1500)


def test_did_you_mean_without_similar_name() -> None:
    assert did_you_mean("zzzz", ("demo", "sim")) == ""
    assert did_you_mean(["demo"], ("demo",)) == ""


class _NoRepr:
    def __repr__(self) -> str:
        raise RuntimeError("no")


@pytest.mark.parametrize(
    ("value", "text"),
    [("a", "'a'"), (_NoRepr(), "<_NoRepr>"), ("b" * 200, f"'{'b' * 96}..."), (10**5000, "<int>")],
    ids=["short", "none", "long", "huge"],
)
def test_short_repr_accepts_any_value(value: object, text: str) -> None:
    assert short_repr(value) == text
