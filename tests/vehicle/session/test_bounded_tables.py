"""Received data fills no table without limit: one test for each table keyed by names or numbers from the link.

Framers, senders, routes and peers are tested in ``connection/test_nobody_elses.py`` and
``mavlink/test_hostile_bytes.py``.
"""

from __future__ import annotations

import pytest
from flight_harness import Flight, open_flight

from aerokit.connection.bus import Bus
from aerokit.dronekit.parameters import ParameterValues
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import AvailableModes, Heartbeat, ParamRequestRead, ParamValue, Statustext
from aerokit.parameters import Parameter, ParameterType
from aerokit.parameters.parameter import MAX_PARAMETERS
from aerokit.protocols.exchange import RoundTrip
from aerokit.protocols.parameter_list import ParameterList
from aerokit.sim.channel import MAX_PEERS, Channel
from aerokit.vehicle.state.status_text import MAX_OPEN, StatusTextAssembler
from aerokit.vehicle.state.telemetry import MAX_MODE_NAMES

pytestmark = pytest.mark.anyio


def deliver(flight: Flight, encoder: FrameEncoder, message: Message) -> None:
    flight.wire.deliver(encoder.encode(message))


async def test_parameter_names() -> None:
    async with open_flight() as flight:
        encoder = FrameEncoder(1, 1)
        for number in range(MAX_PARAMETERS + 100):
            deliver(flight, encoder, ParamValue(f"P{number}", float(number), 9, 65535, 65535))
        assert len(flight.vehicle.parameters.table) == MAX_PARAMETERS
        deliver(flight, encoder, ParamValue("P7", 8.5, 9, 65535, 65535))
        assert flight.vehicle.parameters.table["P7"].value == 8.5


def test_subject_names_match() -> None:
    """A vehicle that gives an index another name each time."""
    exchange = ParameterList(1, 1, bytewise=False)
    exchange.start(0.0)
    for number in range(MAX_PARAMETERS + 100):
        exchange.receive(ParamValue(f"P{number}", 1.0, 9, 65535, number % 10), 0.0)
    assert len(exchange._parameters) == MAX_PARAMETERS


def test_parameter_beyond_table_limit_is_not_requested_repeatedly() -> None:
    exchange, count = ParameterList(1, 1, bytewise=False, round_trip=RoundTrip(0.1)), MAX_PARAMETERS + 1
    exchange.start(0.0)
    for number in range(count):
        exchange.receive(ParamValue(f"P{number}", 1.0, 9, count, number), 0.0)
    for _ in range(3):
        exchange.receive(ParamValue(f"P{count - 1}", 1.0, 9, count, count - 1), 0.1)
    asked = [message for message in exchange.take_outbox() if isinstance(message, ParamRequestRead)]
    assert [request.param_index for request in asked] == [count - 1]


async def test_mode_names() -> None:
    async with open_flight() as flight:
        encoder = FrameEncoder(1, 1)
        for number in range(MAX_MODE_NAMES + 50):
            deliver(flight, encoder, AvailableModes(255, number % 256, 0, 10_000 + number, 0, f"NEW {number}"))
        assert len(flight.vehicle.telemetry.mode_names) <= MAX_MODE_NAMES


def test_classic_parameters() -> None:
    values = ParameterValues()
    for number in range(MAX_PARAMETERS + 100):
        values.store(Parameter(f"p{number}", 1.0, ParameterType.REAL32))
    assert len(values) == MAX_PARAMETERS
    assert values.store(Parameter("p5", 2.0, ParameterType.REAL32))


def test_status_text_open_table_is_bounded() -> None:
    texts = StatusTextAssembler()
    for number in range(1, 5000):
        texts.receive(Statustext(6, "x" * 50, id=number, chunk_seq=0), 0.0)
    assert len(texts._incomplete) == MAX_OPEN


def test_peers_of_a_simulated_vehicle() -> None:
    channel = Channel(1, 1, (), version=2)
    reader = channel.reader
    for port in range(2 * MAX_PEERS):
        channel.messages(b"\xfd", 0.0, ("10.0.0.9", port))
    assert len(reader._framers) == MAX_PEERS


def test_bus_plans_are_bounded() -> None:
    """There is one entry for each subscribed system and message, and no other."""
    bus = Bus()
    bus.attach(Heartbeat, lambda _: None)
    for system_id in range(1, 256):
        for message in (Heartbeat(2, 3, 0, 0, 3), Statustext(6, "x")):
            encoder = FrameEncoder(system_id, 1)
            (frame,) = Framer().receive(encoder.encode(message))
            bus.deliver(frame)
    assert sum(map(len, bus._plans.values())) == 255
