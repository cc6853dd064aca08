"""Gripper, winch, tunes, status texts, failures, the shell and the log stream."""

from __future__ import annotations

import asyncio
import contextlib
from typing import Any

import anyio
import pytest
from device_calls import components_of
from flight_harness import Px4Flight, open_flight
from test_actuators import on_ground, on_px4, params

import aerokit
from aerokit import messages as m
from aerokit.errors import (
    CommandRejected,
    ConnectionClosed,
    InvalidArgument,
    NotSupported,
    OperationRejected,
    OperationTimeout,
)
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import MavCmd as C
from aerokit.mavlink.enums import MavResult
from aerokit.sim import SimulatedCopter, SimulatedPx4, simulated_link
from aerokit.vehicle.commanding.simple_orders import receive_once
from aerokit.vehicle.files.log_stream import UlogAssembler

pytestmark = pytest.mark.anyio


async def test_gripper_on_ardupilot_returns_at_its_end() -> None:
    async with on_ground() as flight:
        began = anyio.current_time()
        await flight.vehicle.gripper().grab()
        assert anyio.current_time() - began == pytest.approx(0.7, abs=0.3)
        assert flight.copter.devices.is_gripped
        await flight.vehicle.gripper().release()
        assert not flight.copter.devices.is_gripped


async def test_gripper_that_reports_beginning_only_ends_later() -> None:
    """An electro-permanent gripper sends no text at its end."""
    async with on_ground() as flight:
        flight.copter.faults.refuse(C.DO_GRIPPER, 0, text="Gripper load grabbing")
        began = anyio.current_time()
        await flight.vehicle.gripper().grab()
        assert anyio.current_time() - began == pytest.approx(3.0, abs=0.6)


async def test_gripper_on_px4_returns_when_moved() -> None:
    async with on_px4() as flight:
        began = anyio.current_time()
        await flight.vehicle.gripper(2).release()
        assert anyio.current_time() - began > 1.0
        assert params(flight, C.DO_GRIPPER) == [(2, 0, 0, 0, 0, 0, 0)]


async def test_winch_pays_out_length_and_reports_it() -> None:
    async with on_ground() as flight:
        winch = flight.vehicle.winch()
        await winch.pay_out(2.0)
        assert flight.copter.devices.line_m == pytest.approx(2.0, abs=0.15)
        assert params(flight, C.DO_WINCH) == [(1, 1, 2.0, 0.5, 0, 0, 0)]
        status = await winch.status.wait_until(lambda _: True, timeout=2)
        assert status.length_m == pytest.approx(2.0, abs=0.15)
        assert status.is_healthy


async def test_receive_once_ends_despite_messages_of_others() -> None:
    async with on_ground() as flight, anyio.create_task_group() as tasks:
        flight.copter.faults.lose(m.WinchStatus, times=1_000)
        other = FrameEncoder(1, 169)

        async def send_status_of_another_component() -> None:
            while True:
                flight.wire.deliver(other.encode(m.WinchStatus(0, 1.0, 0.0, 0.0, 0.0, 0.0, 20, 0)))
                await anyio.sleep(0.5)

        tasks.start_soon(send_status_of_another_component)
        with anyio.fail_after(5.0):
            assert await receive_once(flight.vehicle._context, m.WinchStatus) is None
        tasks.cancel_scope.cancel()


@pytest.mark.parametrize("is_component_request", [True, False], ids=["Component.request", "receive_once"])
async def test_late_refusal_of_cancelled_request_refuses_no_other(is_component_request: bool) -> None:
    async with open_flight(rates={}, latency_s=0.3) as flight:
        await anyio.sleep(15.0)
        component = flight.vehicle.component(1)
        flight.copter.faults.refuse(C.REQUEST_MESSAGE, MavResult.UNSUPPORTED, times=1)
        with anyio.move_on_after(0.2):
            await component.request(m.WinchStatus)
        if is_component_request:
            assert await component.request(m.AutopilotVersion)
        else:
            assert await receive_once(flight.vehicle._context, m.AutopilotVersion)


@pytest.mark.parametrize("lost", ["acknowledgement", "message"])
async def test_pay_out_waits_although_first_status_was_lost(lost: str) -> None:
    async with on_ground() as flight:
        if lost == "message":
            flight.copter.faults.lose(m.WinchStatus, times=1)
        else:
            flight.copter.faults.lose_ack(C.REQUEST_MESSAGE, times=1)
        await flight.vehicle.winch().pay_out(2.0)
        assert flight.copter.devices.line_m == pytest.approx(2.0, abs=0.15)


async def test_pay_out_waits_although_link_was_interrupted() -> None:
    async with on_ground() as flight, anyio.create_task_group() as tasks:
        flight.copter.faults.silent = True
        tasks.start_soon(flight.vehicle.winch().pay_out, 2.0)
        await anyio.sleep(6)
        flight.copter.faults.silent = False
    assert flight.copter.devices.line_m == pytest.approx(2.0, abs=0.15)


@pytest.mark.parametrize("name", ["pay_out", "look_at"])
async def test_call_ends_with_vehicle_although_connection_stays(name: str) -> None:
    copter = SimulatedCopter(boot_time_s=0.0)
    copter.parameters["MNT1_TYPE"] = copter.parameters["WINCH_TYPE"] = 1.0
    async with simulated_link(copter) as link, aerokit.open_connection(link) as connection:
        async with aerokit.connect(connection) as vehicle:
            await vehicle.wait_ready()
            copter.faults.lose(m.GimbalDeviceAttitudeStatus, times=1_000)
            north = aerokit.Position(vehicle.position.value.latitude_deg + 1.0, vehicle.position.value.longitude_deg)
            calls = {
                "pay_out": lambda: vehicle.winch().pay_out(100.0),
                "look_at": lambda: vehicle.gimbal.look_at(north),
            }
            call = asyncio.create_task(calls[name]())
            await anyio.sleep(3.0)
            assert not call.done()
        await asyncio.wait([call], timeout=1.0)
        with pytest.raises(ConnectionClosed):
            call.result()


@pytest.mark.parametrize("rate_m_s", [-0.5, 0.5])
@pytest.mark.parametrize("length_m", [-2.0, 2.0])
async def test_winch_pays_out_while_it_turns(length_m: float, rate_m_s: float) -> None:
    async with on_ground(latency_s=0.3) as flight:
        await flight.vehicle.winch().set_rate(rate_m_s)
        await flight.vehicle.winch().pay_out(length_m, timeout=10)
        assert flight.copter.devices.line_rate_m_s == 0


async def test_winch_newer_order_ends_wait_for_previous() -> None:
    async with on_ground() as flight, anyio.create_task_group() as tasks:

        async def stop() -> None:
            await anyio.sleep(1.0)
            await flight.vehicle.winch().set_rate(0)

        tasks.start_soon(stop)
        with pytest.raises(OperationRejected, match="another order was given"):
            await flight.vehicle.winch().pay_out(50)
        assert flight.copter.devices.line_rate_m_s == 0


async def test_winch_order_that_firmware_lacks_is_sent_to_component_only() -> None:
    async with on_ground() as flight:
        stage: Any = flight
        stage.simulated, stage.is_px4 = flight.copter, False
        components_of(stage)
        for component_id in (None, 1):  # 1 is the autopilot's own component id.
            with pytest.raises(NotSupported, match="ArduCopter has no action RETRACT"):
                await flight.vehicle.winch(component_id=component_id).retract()
        await flight.vehicle.winch(component_id=169).retract()
        assert [sent.target_component for sent in flight.wire.commands(C.DO_WINCH)] == [169]


async def test_tune_is_divided_between_both_fields() -> None:
    async with on_ground() as flight:
        flight.vehicle.play_tune("T200 L8 " + "CEG" * 10)
        tune = flight.wire.last(m.PlayTune)
        assert (tune.tune, tune.tune2) == ("T200 L8 CEGCEGCEGCEGCEGCEGCEGC", "EGCEGCEG")


@pytest.mark.parametrize("tune", ["", "héhé", "C" * 231])
async def test_invalid_tune_is_not_sent(tune: str) -> None:
    async with on_ground() as flight:
        with pytest.raises(InvalidArgument, match="tune"):
            flight.vehicle.play_tune(tune)
        assert flight.wire.all(m.PlayTune) == []


@pytest.mark.parametrize("text", ["short", "x" * 50, "x" * 51, "ä" * 60, "y" * 100])
async def test_status_text_is_sent_in_chunks_that_join(text: str) -> None:
    async with on_ground() as flight:
        flight.vehicle.send_status_text(text, severity="warning")
        sent = flight.wire.all(m.Statustext)
        assert "".join(chunk.text for chunk in sent).replace(" ", "") == text
        assert {chunk.severity for chunk in sent} == {4}
        assert [chunk.chunk_seq for chunk in sent] == list(range(len(sent)))
        is_full = [len(chunk.text.encode()) == 50 for chunk in sent]
        assert is_full == ([len(text) == 50] if len(sent) == 1 else [True] * (len(sent) - 1) + [False])


async def test_failure_is_injected_once_and_needs_intent() -> None:
    async with on_px4() as flight:
        await flight.vehicle.parameters.set("SYS_FAILURE_EN", 1)
        intent: Any = "please"
        with pytest.raises(InvalidArgument, match="intent"):
            await flight.vehicle.inject_failure("motor", "off", instance=2, intent=intent)
        await flight.vehicle.inject_failure("motor", "off", instance=2, intent="inject failure")
        assert params(flight, C.INJECT_FAILURE) == [(101, 1, 2, 0, 0, 0, 0)]


async def test_failure_that_px4_does_not_allow_is_refused() -> None:
    async with on_px4() as flight:
        flight.px4.parameters["SYS_FAILURE_EN"] = 0.0
        with pytest.raises(CommandRejected, match="DENIED"):
            await flight.vehicle.inject_failure("motor", "off", intent="inject failure")


# --------------------------------------------------------------------------------------- shell


async def test_shell_returns_output_of_command() -> None:
    async with on_px4() as flight:
        async with flight.vehicle.shell() as shell:
            assert await shell.run("echo " + "long " * 30) == ("long " * 30).strip()
            assert "Invalid command: nothing" in await shell.run("nothing")
            assert flight.px4.shell.is_open
        await anyio.sleep(0.1)
        assert not flight.px4.shell.is_open


async def test_shell_that_outlives_vehicle_keeps_its_exception() -> None:
    async with simulated_link(SimulatedPx4(boot_time_s=0.0)) as link, aerokit.open_connection(link) as connection:
        with pytest.raises(ZeroDivisionError):
            async with contextlib.AsyncExitStack() as outer:
                async with aerokit.connect(connection) as vehicle:
                    await outer.enter_async_context(vehicle.shell())
                raise ZeroDivisionError


async def test_vehicle_block_closes_shell_and_ends_read() -> None:
    px4 = SimulatedPx4(boot_time_s=0.0)
    async with (
        simulated_link(px4) as link,
        aerokit.open_connection(link) as connection,
        contextlib.AsyncExitStack() as outer,
    ):
        async with aerokit.connect(connection) as vehicle:
            shell = await outer.enter_async_context(vehicle.shell())
            reading = asyncio.create_task(shell.read())
            await anyio.sleep(1.0)
        await asyncio.wait([reading], timeout=1.0)
        with pytest.raises(ConnectionClosed):
            reading.result()
        await anyio.sleep(0.5)
        assert not px4.shell.is_open


async def test_shell_addresses_its_vehicle_only() -> None:
    async with on_px4() as flight:
        async with flight.vehicle.shell() as shell:
            await shell.run("echo 1")
        assert {(sent.target_system, sent.target_component) for sent in flight.wire.all(m.SerialControl)} == {(1, 1)}


async def test_shell_output_of_other_station_is_ignored() -> None:
    async with on_px4() as flight, flight.vehicle.shell() as shell:
        shell.write("echo 1")
        flight.px4.send(m.SerialControl(10, 1, 0, 0, 3, b"no!".ljust(70, b"\0"), 254, 190))
        text = ""
        while not text.endswith("pxh> "):
            text += await shell.read(timeout=2)
        assert text == "echo 1\n1\npxh> "


async def test_shell_read_ends_despite_messages_of_others() -> None:
    async with on_px4() as flight, flight.vehicle.shell() as shell, anyio.create_task_group() as tasks:

        async def talk() -> None:
            while True:
                flight.px4.send(m.SerialControl(10, 1, 0, 0, 3, b"no!".ljust(70, b"\0"), 254, 190))
                await anyio.sleep(0.5)

        tasks.start_soon(talk)
        with anyio.fail_after(5), pytest.raises(OperationTimeout):
            await shell.read(timeout=2)
        tasks.cancel_scope.cancel()


async def test_shell_without_answer_times_out_and_is_closed() -> None:
    async with on_px4() as flight:
        flight.px4.handlers[m.SerialControl.ID] = lambda *_: None
        with pytest.raises(OperationTimeout, match="has not ended within 5 s"):
            async with flight.vehicle.shell():
                raise AssertionError
        assert flight.wire.last(m.SerialControl).flags == 0


# ---------------------------------------------------------------------------------- log stream


async def streamed(flight: Px4Flight, seconds: float) -> tuple[bytes, Any]:
    data = bytearray()
    async with flight.vehicle.logs.stream() as stream:
        with anyio.move_on_after(seconds):
            async for part in stream:
                data += part
    return bytes(data), stream


async def test_log_stream_is_valid_ulog() -> None:
    async with on_px4() as flight:
        data, stream = await streamed(flight, 2.0)
        assert data.startswith(b"ULog\x01\x12\x35")
        assert b"part 0" in data
        assert stream.lost == 0
        assert len(flight.wire.all(m.LoggingAck)) == 2
        assert len(params(flight, C.LOGGING_START)) == len(params(flight, C.LOGGING_STOP)) == 1


async def test_log_stream_read_ends_with_vehicle_block() -> None:
    px4 = SimulatedPx4(boot_time_s=0.0)
    async with simulated_link(px4) as link, aerokit.open_connection(link) as connection:
        async with aerokit.connect(connection) as vehicle:

            async def read() -> None:
                async with vehicle.logs.stream() as stream:
                    async for _ in stream:
                        pass

            reading = asyncio.create_task(read())
            await anyio.sleep(2.0)
        await asyncio.wait([reading], timeout=0.1)
        assert reading.done()
        with pytest.raises(ConnectionClosed, match="block of this vehicle was left"):
            await reading


async def wait_for_end(task: asyncio.Task[Any]) -> None:
    with contextlib.suppress(ConnectionClosed):
        await task


@pytest.mark.parametrize("first", ["stream", "vehicle", "entering"])
async def test_log_stream_is_stopped_when_vehicle_block_ends(first: str) -> None:
    px4, stops = SimulatedPx4(boot_time_s=0.0), []
    px4.observe(m.CommandLong, lambda message, _: stops.append(message.command == C.LOGGING_STOP))
    async with simulated_link(px4) as link, aerokit.open_connection(link) as connection:
        with contextlib.suppress(ZeroDivisionError):
            async with contextlib.AsyncExitStack() as outer, aerokit.connect(connection) as vehicle:
                await vehicle.wait_ready()
                inner = vehicle.logs.stream()
                if first == "entering":
                    px4.faults.lose_ack(C.LOGGING_START)
                    entering = asyncio.create_task(inner.__aenter__())
                    await anyio.sleep(0.2)
                    outer.push_async_callback(wait_for_end, entering)
                elif first == "vehicle":
                    await outer.enter_async_context(inner)
                else:
                    async with inner:
                        raise ZeroDivisionError
                raise ZeroDivisionError
        await anyio.sleep(1.0)
        assert any(stops)


async def test_log_stream_of_other_station_is_not_stopped() -> None:
    async with on_px4() as flight:
        flight.px4.faults.refuse(C.LOGGING_START, 1)
        with pytest.raises(CommandRejected):
            await streamed(flight, 1.0)
        assert params(flight, C.LOGGING_STOP) == []


async def test_log_stream_without_ack_of_start_is_stopped() -> None:
    async with on_px4() as flight:
        with anyio.move_on_after(0.0):
            await streamed(flight, 1.0)
        flight.px4.faults.ignore(C.LOGGING_START)
        with anyio.move_on_after(1.0):
            await streamed(flight, 1.0)
        await anyio.sleep(0.5)
        assert params(flight, C.LOGGING_STOP) != []


@pytest.mark.parametrize("target", [254, 255])
async def test_log_stream_without_usable_data_times_out(target: int) -> None:
    async with on_px4() as flight, anyio.create_task_group() as tasks:
        flight.px4.faults.lost_messages.update({m.LoggingData.ID: 10_000, m.LoggingDataAcked.ID: 10_000})

        async def send() -> None:
            for sequence in range(1000):  # The messages lack the header of the log, which was lost.
                data = m.LoggingData(target, 190, sequence, 3, 0, b"abc".ljust(249, b"\0"))
                flight.wire.deliver(FrameEncoder(1, 1).encode(data))
                await anyio.sleep(0.5)

        async with flight.vehicle.logs.stream(idle_timeout_s=3.0) as stream:
            tasks.start_soon(send)
            with anyio.fail_after(10), pytest.raises(OperationTimeout):
                await anext(stream)
        tasks.cancel_scope.cancel()


def message(sequence: int, data: bytes, first: int = 0) -> m.LoggingData:
    return m.LoggingData(255, 190, sequence, len(data), first, data.ljust(249, b"\0"))


HEADER = b"ULog\x01\x12\x35\x01" + bytes(8)


def ulog(text: bytes) -> bytes:
    return len(text).to_bytes(2, "little") + b"I" + text


def test_assembler_joins_message_over_two_parts() -> None:
    assembler, whole = UlogAssembler(), ulog(b"a" * 300)
    assert assembler.add(message(0, HEADER + whole[:200]), 0.0) == HEADER
    assert assembler.add(message(1, whole[200:], 255), 0.1) == whole


def test_assembler_marks_gap_as_dropout_and_continues_at_next_message() -> None:
    assembler, cut, complete = UlogAssembler(), ulog(b"a" * 100), ulog(b"b")
    assembler.add(message(0xFFFF, HEADER + cut[:50]), 0.0)
    assert assembler.add(message(2, b"rest", 255), 0.2) == b""
    assert assembler.add(message(3, b"rest" + complete, 4), 0.25) == b"\x02\x00O\xfa\x00" + complete
    assert assembler.lost == 2


def test_assembler_ignores_repetition_and_data_before_header() -> None:
    assembler = UlogAssembler()
    assert assembler.add(message(7, ulog(b"a")), 0.0) == b""
    assert assembler.add(message(8, HEADER + ulog(b"b")), 0.0) == HEADER + ulog(b"b")
    assert assembler.add(message(8, HEADER + ulog(b"b")), 0.0) == b""
    assert assembler.lost == 0
