"""``aerokit bridge zenoh``: states of every vehicle on a link."""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import signal
from types import SimpleNamespace
from typing import Any

import pytest
from free_ports import free_port
from zenoh_network import eventually, router

from aerokit.apps.cli import bridge
from aerokit.apps.cli.main import make_parser
from aerokit.sim import SimulatedCopter, SimulatedPlane, simulated_link

zenoh: Any = pytest.importorskip("zenoh")
pytestmark = pytest.mark.anyio


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


async def test_bridge_zenoh_publishes_states_of_all_vehicles(capsys: pytest.CaptureFixture[str]) -> None:
    endpoint = f"tcp/127.0.0.1:{(port := free_port())}"
    config = zenoh.Config()
    for key, value in (
        ("mode", "client"),
        ("connect/endpoints", [endpoint]),
        ("scouting/multicast/enabled", False),
    ):
        config.insert_json5(key, json.dumps(value))
    received: dict[str, Any] = {}

    def hear(sample: Any) -> None:
        received[str(sample.key_expr)] = json.loads(sample.payload.to_bytes())["value"]

    network = f"zenoh://north/box?connect={endpoint}"
    arguments = ["bridge", "zenoh", "udpin:127.0.0.1:0", network, "--json", "--rate", "20"]
    options = make_parser("bridge").parse_args(arguments)
    vehicles = [SimulatedCopter(system_id=1), SimulatedPlane(system_id=2)]
    with router(port):
        listener = zenoh.open(config)
        subscriber = listener.declare_subscriber("aerokit/north/box/state/**", hear)
        async with simulated_link(vehicles) as options.address:
            command = asyncio.get_running_loop().create_task(options.run(options))
            keys = {f"aerokit/north/box/state/{n}/{name}" for n in (1, 2) for name in ("mode", "link")}
            await eventually(lambda: keys <= received.keys())
            os.kill(os.getpid(), signal.SIGINT)
            assert await command is None  # no exit code: the command succeeded
        del subscriber
        listener.close()
    printed = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [each["type"] for each in printed] == ["publishing", "bridged_vehicle", "bridged_vehicle"]
    assert printed[0]["network"] == network


@pytest.mark.parametrize("network", ["tcp:127.0.0.1:5763", "zenoh://north", "north/box"])
def test_bridge_zenoh_with_other_address_exits_with_code_2(network: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        make_parser("bridge").parse_args(["bridge", "zenoh", "zenoh://north/box", network])
    assert ended.value.code == 2
    assert "argument NETWORK: " in (printed := capsys.readouterr().err)
    assert "zenoh://" in printed


def test_bridge_prints_nothing_while_terminal_is_stopped(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Printing would block, and the bridge would publish nothing."""
    monkeypatch.setattr(bridge, "can_print", lambda: False)
    vehicle: Any = SimpleNamespace(system_id=1, autopilot=SimpleNamespace(firmware="PX4"))
    bridge._emit_vehicle(argparse.Namespace(json=False), vehicle)
    assert capsys.readouterr().out == ""


def test_bridge_zenoh_uses_default_vehicle_address() -> None:
    options = make_parser("bridge").parse_args(["bridge", "zenoh", "zenoh://north/box"])
    assert (options.network, options.rate) == ("zenoh://north/box", 5.0)
