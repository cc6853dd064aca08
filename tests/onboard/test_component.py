"""`aerokit.component`: heartbeat, identity, messages, texts, events, PING and TIMESYNC."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest
from onboard_peers import autopilot_and_client, payload_and_station

import aerokit
from aerokit.connection.opening import open_connection
from aerokit.errors import BusyError, InvalidArgument
from aerokit.mavlink import Dialect
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavAutopilot, MavCmd, MavResult, MavState, MavType
from aerokit.onboard import CommandRequest, Identity
from aerokit.onboard.host import MAX_STORED_EVENTS
from aerokit.transport import memory_link_pair

pytestmark = pytest.mark.anyio


async def test_heartbeat_has_type_state_and_mode() -> None:
    async with payload_and_station(type=MavType.WINCH) as (payload, station):
        with station.connection.subscribe(m.Heartbeat, capacity=10) as beats:
            first = await beats.get(5.0)
            payload.set_state(MavState.CRITICAL, custom_mode=7)
            second = await beats.get(5.0)
    assert (first.type, first.autopilot, first.system_status) == (MavType.WINCH, MavAutopilot.INVALID, MavState.ACTIVE)
    assert (second.system_status, second.custom_mode) == (MavState.CRITICAL, 7)


async def test_two_components_share_a_connection() -> None:
    near, far = memory_link_pair()
    async with (
        open_connection(near) as own,
        aerokit.component(connection=own, component_id=100, type=MavType.CAMERA),
        aerokit.component(connection=own, component_id=154, type=MavType.GIMBAL),
        open_connection(far) as peer,
    ):
        await asyncio.sleep(3.0)
        assert {key: beat.type for key, beat in peer.heartbeats.items()} == {
            (255, 190): MavType.GCS,
            (1, 100): MavType.CAMERA,
            (1, 154): MavType.GIMBAL,
        }
        with pytest.raises(BusyError):
            async with aerokit.component(connection=own, component_id=100):
                pass


async def test_version_and_information_are_served() -> None:
    identity = Identity("Acme", "Dropper", "1.4.2", uid=77)
    async with payload_and_station(identity=identity) as (_, station):
        request = station.command_long(MavCmd.REQUEST_MESSAGE, m.AutopilotVersion.ID)
        version = await station.ask(request, m.AutopilotVersion)
        request = station.command_long(MavCmd.REQUEST_MESSAGE, m.ComponentInformationBasic.ID)
        basic = await station.ask(request, m.ComponentInformationBasic)
        ack = await station.command(MavCmd.REQUEST_MESSAGE, m.Attitude.ID)
    assert (version.flight_sw_version, version.uid) == (0x01040200, 77)
    assert (basic.vendor_name, basic.model_name, basic.software_version) == ("Acme", "Dropper", "1.4.2")
    assert ack.result == MavResult.DENIED


@pytest.mark.parametrize(
    "fields", [{"version": "1.2.3.4.5"}, {"version": "1.2.3.4.rc1"}, {"version": "1.256"}, {"serial_number": 33 * "7"}]
)
def test_identity_that_does_not_fit_is_refused(fields: dict[str, str]) -> None:
    with pytest.raises(InvalidArgument, match="is not allowed"):
        Identity(**fields)  # type: ignore[arg-type]


async def test_message_is_streamed_at_requested_interval() -> None:
    async with payload_and_station() as (payload, station):

        @payload.message(m.RawRpm)
        def rpm() -> m.RawRpm:
            return m.RawRpm(0, 1200.0)

        await station.command(MavCmd.SET_MESSAGE_INTERVAL, m.RawRpm.ID, 100_000)
        with station.collecting(m.RawRpm) as received:
            await asyncio.sleep(1.95)
        assert len(received) == 19
        with pytest.raises(InvalidArgument, match="already"):
            payload.message(m.RawRpm)(rpm)


async def test_long_text_arrives_in_chunks() -> None:
    async with autopilot_and_client() as (node, vehicle):
        with vehicle.subscribe(m.Statustext, capacity=10) as texts:
            node.send_text("The winch is jammed: pull the line by hand and then reset it, please.")
            first, second = await texts.get(1.0), await texts.get(1.0)
    assert first.text + second.text == "The winch is jammed: pull the line by hand and then reset it, please."
    assert (first.id, second.chunk_seq) == (second.id, 1)


async def test_lost_event_is_sent_again_on_request() -> None:
    async with payload_and_station() as (payload, station):
        for number in range(3):
            payload.send_event(191 << 24 | number, bytes([number]))
        await asyncio.sleep(0.1)
        event = await station.ask(m.RequestEvent(*station.target, 1, 1), m.Event)
        error = await station.ask(m.RequestEvent(*station.target, 9, 9), m.ResponseEventError)
    assert (event.sequence, event.arguments[0]) == (1, 1)
    assert (error.sequence, error.sequence_oldest_available) == (9, 0)


async def test_stored_events_of_a_longer_range_are_sent_again() -> None:
    async with payload_and_station() as (payload, station):
        for number in range(100):
            payload.send_event(191 << 24 | number)
        await asyncio.sleep(0.1)
        with station.collecting(m.Event, m.ResponseEventError) as answers:
            station.connection.send(m.RequestEvent(*station.target, 0, 99))
            await asyncio.sleep(1.0)
    assert [answer.sequence for answer in answers] == list(range(100 - MAX_STORED_EVENTS, 100))


async def test_ping_and_timesync_are_answered() -> None:
    async with payload_and_station() as (_, station):
        ping = await station.ask(m.Ping(123, 5, 0, 0), m.Ping)
        sync = await station.ask(m.Timesync(0, 987), m.Timesync)
    assert (ping.time_usec, ping.seq, ping.target_system) == (123, 5, 255)
    assert sync.ts1 == 987
    assert sync.tc1 > 0


async def test_messages_of_other_systems_are_ignored_with_accepts() -> None:
    async with payload_and_station(accepts={7}) as (_, station):
        with pytest.raises(aerokit.errors.OperationTimeout):
            await station.ask(m.Ping(1, 1, 0, 0), m.Ping, timeout=2.0)


@pytest.mark.parametrize("arguments", [{"component_id": 0}, {"system_id": 256}, {"type": 999}])
async def test_invalid_id_is_refused(arguments: dict[str, int]) -> None:
    near, _ = memory_link_pair()
    with pytest.raises(InvalidArgument):
        async with aerokit.component(near, **arguments):  # type: ignore[arg-type]
            pass


@pytest.mark.parametrize(
    "argument",
    [{"baud": 9600}, {"dialect": Dialect("own", [m.Heartbeat])}, {"mavlink_version": 1}, {"reconnect": True}],
)
async def test_argument_of_link_is_refused_with_open_connection(argument: dict[str, Any]) -> None:
    near, _ = memory_link_pair()
    async with open_connection(near) as connection:
        with pytest.raises(InvalidArgument, match=f"{next(iter(argument))} = … is not allowed with connection=…"):
            async with aerokit.component(connection=connection, **argument):
                pass
        assert not connection.components


async def test_ids_of_component_that_closes_are_not_free() -> None:
    has_started, may_end = asyncio.Event(), asyncio.Event()
    near, far = memory_link_pair()
    async with open_connection(near) as connection, open_connection(far) as other:

        async def run() -> None:
            async with aerokit.component(connection=connection) as component:

                @component.command(MavCmd.USER_1)
                async def wait(_: CommandRequest) -> None:
                    has_started.set()
                    try:
                        await asyncio.sleep(60.0)
                    finally:
                        await may_end.wait()

                other.send(m.CommandLong(1, 191, MavCmd.USER_1, 0, 0, 0, 0, 0, 0, 0, 0))
                await has_started.wait()

        task = asyncio.create_task(run())
        await has_started.wait()
        await asyncio.sleep(0.1)
        with pytest.raises(BusyError):
            async with aerokit.component(connection=connection):
                pass
        may_end.set()
        await task
        async with aerokit.component(connection=connection):
            pass
