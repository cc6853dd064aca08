"""An error in a publisher must not end the connection to a flying vehicle."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from importlib import import_module

import anyio
import pytest

import aerokit
from aerokit.apps.network import Publisher, discover, publishing, zenoh_publisher
from aerokit.apps.network.mqtt_publisher import parse_broker
from aerokit.errors import InvalidArgument
from aerokit.sim import SimulatedCopter, simulated_link
from aerokit.testing import run_virtual


class Broken(Publisher):
    """A client of some network that has gone."""

    def __init__(self) -> None:
        self.puts = 0

    def put(self, name: str, data: bytes) -> None:
        self.puts += 1
        raise ConnectionError("the broker has gone")


@pytest.mark.parametrize(
    ("address", "reason"),
    [("mqtt:///north/alpha", "the host is missing"), ("mqtt://10.0.0.5:0/north/alpha", "the port must not be 0")],
)
def test_broker_address_error_names_the_wrong_part(address: str, reason: str) -> None:
    with pytest.raises(InvalidArgument, match=reason):
        parse_broker(address)


def test_publisher_error_does_not_end_connection(caplog: pytest.LogCaptureFixture) -> None:
    async def run() -> None:
        broken = Broken()
        async with (
            simulated_link(SimulatedCopter(boot_time_s=0.0)) as link,
            aerokit.connect(link) as vehicle,
            publishing(vehicle, broken) as under_way,
        ):
            await asyncio.sleep(3)
            vehicle.connection.raise_if_ended()
            assert broken.puts > 10
            assert under_way.published == 0

    with caplog.at_level(logging.ERROR, "aerokit"):
        run_virtual(run())
    assert len([each for each in caplog.records if "publisher" in each.getMessage()]) == 1


def test_cancelled_zenoh_publisher_has_closed_its_session(monkeypatch: pytest.MonkeyPatch) -> None:
    closed_sessions = []

    async def open_session(*_: object) -> str:
        return "session"

    def close_session(session: str, closed: Callable[[], object]) -> None:
        def close() -> None:
            closed_sessions.append(session)
            closed()

        asyncio.get_running_loop().call_later(1.0, close)

    async def run() -> None:
        with anyio.CancelScope() as scope:
            async with zenoh_publisher("zenoh://north/alpha"):
                scope.cancel()
                await anyio.sleep(10)
        assert closed_sessions == ["session"]

    module = import_module("aerokit.apps.network.zenoh_publisher")
    monkeypatch.setattr(module, "open_session", open_session)
    monkeypatch.setattr(module, "close_session", close_session)
    run_virtual(run())


@pytest.mark.parametrize("wait", [0.0, -1.0, float("nan")])
def test_discover_with_invalid_wait_raises(wait: float) -> None:
    with pytest.raises(InvalidArgument, match="wait"):
        asyncio.run(discover("north", wait=wait))
