"""Commands to a component: arguments, progress, cancellation, errors, repeated transmissions."""

from __future__ import annotations

import asyncio
import math
from enum import Enum
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import pytest
from flight_harness import block_loop
from onboard_peers import autopilot_and_client, payload_and_station

import aerokit
from aerokit.errors import BusyError, CommandRejected, InvalidArgument
from aerokit.mavlink import Dialect
from aerokit.mavlink import messages as m
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import MavCmd, MavFrame, MavMissionResult, MavParamType, MavResult, MavType
from aerokit.missions import MissionItem
from aerokit.onboard import CommandRequest, CommandResult, Param, Range
from aerokit.protocols.servers.commands import MAX_RESULTS
from aerokit.transport import memory_link_pair

pytestmark = pytest.mark.anyio

Height = Annotated[float, Range(0, 50)]


async def test_command_calls_handler_with_arguments() -> None:
    calls: list[tuple[object, ...]] = []
    async with autopilot_and_client() as (node, vehicle):

        @node.command(MavCmd.USER_1)
        async def drop(
            request: CommandRequest,
            height_m: Height,
            is_armed: bool,
            kind: MavType,
            speed: Annotated[float | None, Param(7)],
        ) -> None:
            calls.append((request.sender, height_m, is_armed, kind, speed))

        await vehicle.command(MavCmd.USER_1, 12.5, 1, MavType.WINCH, 0, 0, 0, float("nan"))
    assert calls == [((255, 190), 12.5, True, MavType.WINCH, None)]


@pytest.mark.parametrize("params", [(51.0,), (float("nan"),), (1.0, 2.0), (1.0, 1.0, 0.5), (1.0, 0.0, 254.0)])
async def test_command_with_other_values_is_denied(params: tuple[float, ...]) -> None:
    async with payload_and_station() as (payload, station):

        @payload.command(MavCmd.USER_1)
        async def drop(_: CommandRequest, height_m: Height, is_armed: bool, kind: MavType) -> None:
            raise AssertionError

        with station.collecting(m.Statustext) as texts:
            ack = await station.command(MavCmd.USER_1, *params)
    assert ack.result == MavResult.DENIED
    assert "is not allowed" in texts[0].text


OWN_COMMAND_LONG = """<mavlink><messages>
<message id="0" name="HEARTBEAT"><field type="uint8_t" name="type"/><field type="uint8_t" name="autopilot"/>
<field type="uint8_t" name="base_mode"/><field type="uint32_t" name="custom_mode"/>
<field type="uint8_t" name="system_status"/><field type="uint8_t_mavlink_version" name="mavlink_version"/></message>
<message id="76" name="COMMAND_LONG"><field type="uint8_t" name="target_system"/>
<field type="uint8_t" name="target_component"/><field type="uint16_t" name="command"/>
<field type="uint8_t" name="confirmation"/>{params}<extensions/><field type="uint32_t" name="token"/></message>
<message id="77" name="COMMAND_ACK"><field type="uint16_t" name="command"/><field type="uint8_t" name="result"/>
<extensions/><field type="uint8_t" name="progress"/><field type="int32_t" name="result_param2"/>
<field type="uint8_t" name="target_system"/><field type="uint8_t" name="target_component"/></message>
</messages></mavlink>"""


async def test_dialect_with_own_command_long_is_answered(tmp_path: Path) -> None:
    """The class of a dialect's own COMMAND_LONG is no subclass of the standard class."""
    path = tmp_path / "own.xml"
    params = "".join(f'<field type="float" name="param{number}"/>' for number in range(1, 8))
    path.write_text(OWN_COMMAND_LONG.format(params=params))
    dialect = Dialect.from_xml(path)
    own: Any = dialect[m.CommandLong.ID]
    assert own is not m.CommandLong
    calls: list[tuple[float, ...]] = []
    near, far = memory_link_pair()
    async with (
        aerokit.component(near, system_id=9, component_id=100, dialect=dialect) as node,
        aerokit.open_connection(far, dialect=dialect) as connection,
    ):

        @node.command(MavCmd.USER_1)
        async def work(request: CommandRequest) -> None:
            calls.append(request.params)

        with connection.subscribe(m.CommandAck) as acks:
            connection.send(own(9, 100, MavCmd.USER_1, 0, 1, 2, 3, 4, 5, 6, 7, token=8))
            ack = await acks.get(timeout=10)
    assert (ack.result, calls) == (MavResult.ACCEPTED, [(1, 2, 3, 4, 5, 6, 7)])


async def test_error_without_text_is_reported_by_its_type(caplog: pytest.LogCaptureFixture) -> None:
    async with payload_and_station() as (payload, station):

        @payload.command(MavCmd.USER_1)
        async def drop(_: CommandRequest) -> None:
            raise OSError

        with station.collecting(m.Statustext) as texts:
            ack = await station.command(MavCmd.USER_1)
    assert ack.result == MavResult.FAILED
    assert [message.text for message in texts] == ["drop: OSError"]
    assert [record.getMessage() for record in caplog.records] == ["component 1/191: drop: OSError"]


async def test_running_command_reports_progress_and_is_not_started_twice() -> None:
    started = 0
    async with payload_and_station() as (payload, station):

        @payload.command(MavCmd.USER_1)
        async def drop(request: CommandRequest) -> None:
            nonlocal started
            started += 1
            await asyncio.sleep(0.3)
            request.report_progress(40)
            await asyncio.sleep(1.0)

        with station.collecting(m.CommandAck) as acks:
            station.connection.send(station.command_long(MavCmd.USER_1, 1))
            await asyncio.sleep(0.4)
            station.connection.send(station.command_long(MavCmd.USER_1, 1, confirmation=1))
            await asyncio.sleep(0.1)
            station.connection.send(station.command_long(MavCmd.USER_1, 2))
            await asyncio.sleep(2.0)
            station.connection.send(station.command_long(MavCmd.USER_1, 1, confirmation=2))
            await asyncio.sleep(1.0)
    results = [(ack.result, ack.progress) for ack in acks]
    progress = MavResult.IN_PROGRESS
    rejected, accepted = (MavResult.TEMPORARILY_REJECTED, 0), (MavResult.ACCEPTED, 0)
    assert results == [
        (progress, 255),
        (progress, 40),
        (progress, 40),
        rejected,
        (progress, 40),
        (progress, 40),
        accepted,
        accepted,
    ]
    assert started == 1


@pytest.mark.parametrize("duration_s", [0.0, 3.0])
async def test_repeated_command_with_nan_is_executed_once(duration_s: float) -> None:
    started = 0
    async with payload_and_station() as (payload, station):

        @payload.command(MavCmd.USER_1)
        async def drop(_: CommandRequest) -> None:
            nonlocal started
            started += 1
            await asyncio.sleep(duration_s)

        with station.collecting(m.CommandAck) as acks:
            for confirmation in range(2):
                message = station.command_long(MavCmd.USER_1, 1, math.nan, math.nan, confirmation=confirmation)
                station.connection.send(message)
                await asyncio.sleep(1.0)
    assert started == 1
    assert MavResult.TEMPORARILY_REJECTED not in [ack.result for ack in acks]


async def test_command_repeated_for_long_is_executed_once() -> None:
    """Its answers are lost, and a repetition arrives more than five seconds after the end."""
    started = 0
    async with payload_and_station() as (payload, station):

        @payload.command(MavCmd.USER_1)
        async def drop(_: CommandRequest) -> None:
            nonlocal started
            started += 1

        results = []
        for confirmation in range(4):
            results.append((await station.command(MavCmd.USER_1, 1, confirmation=confirmation)).result)
            await asyncio.sleep(3.0)
    assert started == 1
    assert results == [MavResult.ACCEPTED] * 4


@pytest.mark.parametrize("duration_s", [0.0, 0.5])
async def test_command_copied_by_link_is_executed_and_answered_once(duration_s: float) -> None:
    started = 0
    async with payload_and_station() as (payload, station):

        @payload.command(MavCmd.USER_1)
        async def drop(_: CommandRequest) -> None:
            nonlocal started
            started += 1
            await asyncio.sleep(duration_s)

        frame = FrameEncoder(200, 190).encode(station.command_long(MavCmd.USER_1, 1))
        with station.collecting(m.CommandAck) as acks:
            for _ in range(3):
                station.connection.write_raw(frame)
                await asyncio.sleep(0.3)
            await asyncio.sleep(2.0)
    assert started == 1
    assert [ack.result for ack in acks if ack.result != MavResult.IN_PROGRESS] == [MavResult.ACCEPTED]


async def test_equal_commands_of_sender_with_constant_sequence_are_executed() -> None:
    started = 0
    async with payload_and_station() as (payload, station):

        @payload.command(MavCmd.USER_1)
        async def drop(_: CommandRequest) -> None:
            nonlocal started
            started += 1

        for message in (m.Heartbeat(6, 8, 0, 0, 4, 3), *(station.command_long(MavCmd.USER_1, 1),) * 2):
            station.connection.write_raw(FrameEncoder(200, 190).encode(message))
            await asyncio.sleep(0.3)
    assert started == 2


async def test_repetition_after_command_of_other_sender_is_not_executed() -> None:
    senders: list[tuple[int, int]] = []
    async with payload_and_station() as (payload, station):

        @payload.command(MavCmd.USER_1)
        async def drop(request: CommandRequest) -> None:
            senders.append(request.sender)

        with station.collecting(m.CommandAck) as acks:
            station.connection.send(station.command_long(MavCmd.USER_1, 1))
            await asyncio.sleep(0.5)
            station.connection.send_as(FrameEncoder(200, 190), station.command_long(MavCmd.USER_1, 1))
            await asyncio.sleep(0.5)
            station.connection.send(station.command_long(MavCmd.USER_1, 1, confirmation=1))
            await asyncio.sleep(0.5)
    assert senders == [(255, 190), (200, 190)]
    assert [(ack.target_system, ack.result) for ack in acks] == [
        (system, MavResult.ACCEPTED) for system in (255, 200, 255)
    ]


@pytest.mark.parametrize(("blocked_s", "is_executed"), [(3.0, True), (10.0, False)])
async def test_command_from_before_blocked_loop_is_not_executed(blocked_s: float, is_executed: bool) -> None:
    """Its sender has given up, and people may have come near since."""
    calls = 0
    async with payload_and_station() as (payload, station):

        @payload.command(MavCmd.USER_1)
        async def drop(_: CommandRequest) -> None:
            nonlocal calls
            calls += 1

        await asyncio.sleep(1.0)
        station.connection.send(station.command_long(MavCmd.USER_1, 1))
        block_loop(blocked_s)
        await asyncio.sleep(1.0)
        assert calls == is_executed
        await station.command(MavCmd.USER_1, 2)
        assert calls == is_executed + 1


async def test_orders_without_command_from_before_blocked_loop_are_not_executed() -> None:
    currents: list[int] = []
    async with payload_and_station() as (payload, station):
        payload.parameters.add("SPEED", 1.0)
        payload.missions.replace([MissionItem(16, 6, x=number, y=number) for number in range(3)])
        payload.missions.on_set_current(currents.append)
        await asyncio.sleep(1.0)
        station.connection.send(m.ParamSet(*station.target, "SPEED", 2.0, MavParamType.REAL32))
        station.connection.send(m.MissionSetCurrent(*station.target, 2))
        station.connection.send(m.MissionClearAll(*station.target, 0))
        block_loop(10.0)
        await asyncio.sleep(1.0)
        assert (payload.parameters["SPEED"], currents, len(payload.missions.items())) == (1.0, [], 3)


async def test_results_of_many_senders_are_bounded() -> None:
    async with payload_and_station() as (payload, station):

        @payload.command(MavCmd.USER_1)
        async def drop(_: CommandRequest) -> None:
            pass

        for number in range(2 * MAX_RESULTS):
            encoder = FrameEncoder(1 + number % 250, 10 + number // 250)
            station.connection.send_as(encoder, station.command_long(MavCmd.USER_1, 1))
            await asyncio.sleep(0.001)
        await asyncio.sleep(0.1)
        assert len(payload._commands._running._ended) == MAX_RESULTS


async def test_cancelled_command_ends_with_cancelled() -> None:
    was_cancelled = False
    async with payload_and_station() as (payload, station):

        @payload.command(MavCmd.USER_2)
        async def lower(_: CommandRequest) -> None:
            nonlocal was_cancelled
            try:
                await asyncio.sleep(60.0)
            except asyncio.CancelledError:
                was_cancelled = True
                raise

        await station.command(MavCmd.USER_2)
        with station.connection.subscribe(m.CommandAck, capacity=100) as acks:
            station.connection.send(m.CommandCancel(*station.target, MavCmd.USER_2))
            ack = await acks.get(1.0)
    assert (ack.result, was_cancelled) == (MavResult.CANCELLED, True)


async def test_command_cancelled_before_its_task_begins_is_not_executed() -> None:
    calls = 0
    async with payload_and_station() as (payload, station):

        @payload.command(MavCmd.USER_2)
        async def lower(_: CommandRequest) -> None:
            nonlocal calls
            calls += 1

        with station.collecting(m.CommandAck) as acks:
            station.connection.send(station.command_long(MavCmd.USER_2))
            station.connection.send(m.CommandCancel(*station.target, MavCmd.USER_2))
            await asyncio.sleep(1.0)
    assert ([ack.result for ack in acks], calls) == ([MavResult.CANCELLED], 0)


@pytest.mark.parametrize(
    ("error", "result"),
    [
        (InvalidArgument("too high"), MavResult.DENIED),
        (BusyError("loading"), MavResult.TEMPORARILY_REJECTED),
        (RuntimeError("jammed"), MavResult.FAILED),
    ],
)
async def test_error_of_handler_is_result_and_text(error: Exception, result: MavResult) -> None:
    async with payload_and_station() as (payload, station):

        @payload.command(MavCmd.USER_3)
        async def lift(_: CommandRequest) -> None:
            raise error

        with station.collecting(m.Statustext) as texts:
            ack = await station.command(MavCmd.USER_3)
    assert ack.result == result
    assert texts[0].text == f"lift: {error}"


async def test_unknown_command_is_unsupported_unless_broadcast() -> None:
    async with payload_and_station() as (_, station):
        ack = await station.command(MavCmd.NAV_TAKEOFF)
        with station.collecting(m.CommandAck) as acks:
            station.connection.send(m.CommandLong(1, 0, MavCmd.NAV_LAND, 0, 0, 0, 0, 0, 0, 0, 0))
            await asyncio.sleep(1.0)
    assert ack.result == MavResult.UNSUPPORTED
    assert acks == []


async def test_position_of_command_int_is_in_degrees() -> None:
    found: list[CommandRequest] = []
    async with payload_and_station() as (payload, station):

        @payload.command(MavCmd.DO_SET_ROI_LOCATION)
        def look(request: CommandRequest) -> None:
            found.append(request)

        system, component = station.target
        head = (system, component, MavFrame.GLOBAL_RELATIVE_ALT, MavCmd.DO_SET_ROI_LOCATION, 0, 0)
        command = m.CommandInt(*head, 0.0, 0.0, 0.0, 0.0, 473977420, 85455940, 30.0)
        await station.ask(command, m.CommandAck)
    position = found[0].position
    assert (position.latitude_deg, position.altitude_relative_m) == (47.397742, 30.0)


async def test_function_that_raises_cancelled_error_has_failed() -> None:
    cancelled: asyncio.Future[None] = asyncio.get_running_loop().create_future()
    cancelled.cancel()
    async with payload_and_station() as (payload, station):

        @payload.command(MavCmd.USER_1)
        def read(_: CommandRequest) -> None:
            cancelled.result()

        @payload.missions.on_upload
        def check(kind: str, items: tuple[MissionItem, ...]) -> None:
            cancelled.result()

        for _ in range(2):
            assert (await station.command(MavCmd.USER_1)).result == MavResult.FAILED
            ack = await station.ask(m.MissionClearAll(*station.target, mission_type=0), m.MissionAck)
            assert ack.type == MavMissionResult.ERROR


async def test_end_of_block_cancels_running_command() -> None:
    async with payload_and_station() as (payload, station):

        @payload.command(MavCmd.USER_1)
        async def drop(_: CommandRequest) -> None:
            await asyncio.sleep(60.0)

        await station.command(MavCmd.USER_1)
        with station.connection.subscribe(m.CommandAck, capacity=100) as acks:
            await payload._aclose()
            ack = await acks.get(1.0)
    assert ack.result == MavResult.CANCELLED


async def test_client_gets_result_of_long_command() -> None:
    async with autopilot_and_client() as (node, vehicle):

        @node.command(MavCmd.USER_1)
        async def drop(_: CommandRequest) -> int:
            await asyncio.sleep(20.0)
            return MavResult.DENIED

        with pytest.raises(CommandRejected) as raised:
            await vehicle.command(MavCmd.USER_1)
    assert raised.value.result == MavResult.DENIED


async def test_handler_without_annotation_is_refused() -> None:
    async with payload_and_station() as (payload, _):
        with pytest.raises(InvalidArgument, match="annotated"):

            @payload.command(MavCmd.USER_1)
            async def drop(_: CommandRequest, height_m) -> None:  # type: ignore[no-untyped-def]
                pass


async def test_handler_may_use_variables_that_are_assigned_later() -> None:
    async with payload_and_station() as (payload, station):

        @payload.command(MavCmd.USER_1)
        async def drop(_: CommandRequest, count: int) -> None:
            assert drop is not None  # `drop` has no value yet while it is being registered.
            calls.append(count)

        calls: list[int] = []
        await station.command(MavCmd.USER_1, 3)
    assert calls == [3]


async def test_handler_that_is_no_function_is_refused() -> None:
    def drop(unit: str, _: CommandRequest, height_m: float) -> None:
        pass

    async with payload_and_station() as (payload, _):
        with pytest.raises(InvalidArgument, match="must be a function"):
            payload.command(MavCmd.USER_1)(partial(drop, "m"))


async def test_optional_argument_may_have_a_range() -> None:
    calls: list[float | None] = []
    async with payload_and_station() as (payload, station):

        @payload.command(MavCmd.USER_1)
        async def drop(_: CommandRequest, height_m: Height | None) -> None:
            calls.append(height_m)

        results = [(await station.command(MavCmd.USER_1, height)).result for height in (math.nan, 5.0, 51.0)]
    assert calls == [None, 5.0]
    assert results == [MavResult.ACCEPTED, MavResult.ACCEPTED, MavResult.DENIED]


class Unit(Enum):
    METRES = "m"


async def test_argument_that_is_an_enum_of_texts_is_refused() -> None:
    async with payload_and_station() as (payload, _):
        with pytest.raises(InvalidArgument, match="enum of integers"):

            @payload.command(MavCmd.USER_1)
            async def drop(_: CommandRequest, unit: Unit) -> None:
                pass


async def test_text_of_denied_command_has_all_digits() -> None:
    async with payload_and_station() as (payload, station):

        @payload.command(MavCmd.USER_1)
        async def drop(_: CommandRequest, count: int) -> None:
            pass

        with station.collecting(m.Statustext) as texts:
            await station.command(MavCmd.USER_1, 1000000.5)
    assert texts[0].text.startswith("drop: count = 1000000.5 is not allowed")


@pytest.mark.parametrize("value", [300, -1, CommandResult(progress=1000), CommandResult(detail=1 << 40)])
@pytest.mark.parametrize("is_coroutine", [True, False])
async def test_impossible_result_is_failed_and_connection_stays_open(value: object, is_coroutine: bool) -> None:
    async with payload_and_station() as (payload, station):

        async def drop_later(_: CommandRequest) -> object:
            return value

        def drop(_: CommandRequest) -> object:
            return value

        payload.command(MavCmd.USER_1)(drop_later if is_coroutine else drop)
        ack = await station.command(MavCmd.USER_1)
        assert payload.connection.is_open
    assert ack.result == MavResult.FAILED


async def test_command_while_component_closes_is_cancelled() -> None:
    has_started, may_end = asyncio.Event(), asyncio.Event()
    async with payload_and_station() as (payload, station):

        @payload.command(MavCmd.USER_1)
        async def drop(_: CommandRequest) -> None:
            has_started.set()
            try:
                await asyncio.sleep(60.0)
            finally:
                await may_end.wait()

        @payload.command(MavCmd.USER_2)
        async def other(_: CommandRequest) -> None:
            raise AssertionError

        station.connection.send(station.command_long(MavCmd.USER_1))
        await has_started.wait()
        closing = asyncio.create_task(payload._aclose())
        await asyncio.sleep(0)
        ack = await station.command(MavCmd.USER_2)
        may_end.set()
        await closing
    assert ack.result == MavResult.CANCELLED
