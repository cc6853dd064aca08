"""`aerokit.sync.component`: plain functions run in threads, and progress reaches the sender."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import pytest

import aerokit.sync
from aerokit.errors import CommandRejected, InvalidArgument
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavAutopilot, MavCmd, MavResult, MavType, WinchActions
from aerokit.mavlink.message import Message
from aerokit.missions import waypoint
from aerokit.onboard import (
    AutopilotDriver,
    CameraDriver,
    CommandRequest,
    GimbalDriver,
    GimbalTarget,
    OnboardComponent,
    Photo,
    Range,
    WinchDriver,
)
from aerokit.onboard.host import ComponentHost
from aerokit.protocols.servers.commands import MAX_RUNNING_COMMANDS


@contextmanager
def autopilot_and_client(
    parameters_file: Path | None = None,
) -> Iterator[tuple[aerokit.sync.OnboardComponent, aerokit.sync.Vehicle]]:
    kind, generic = MavType.QUADROTOR, MavAutopilot.GENERIC
    with aerokit.sync.component(
        "udpin:127.0.0.1:0", component_id=1, type=kind, autopilot=generic, parameters_file=parameters_file
    ) as node:
        port = node.aio.connection.link.address.rpartition(":")[2]
        with aerokit.sync.connect(f"udpout:127.0.0.1:{port}", rates={}) as vehicle:
            yield node, vehicle


def test_plain_function_runs_in_thread_and_reports_progress() -> None:
    threads: list[int | None] = []
    with autopilot_and_client() as (node, vehicle):

        @node.command(MavCmd.USER_1)
        def drop(request: CommandRequest, height_m: Annotated[float, Range(0, 50)]) -> None:
            threads.append(threading.get_ident())
            request.report_progress(50)
            if height_m == 13:
                raise ValueError("unlucky height")

        with vehicle.subscribe(m.CommandAck, capacity=100) as acks:
            vehicle.command(MavCmd.USER_1, 12)
            while (ack := acks.get(timeout=5)).command != MavCmd.USER_1:
                pass
            assert (ack.result, ack.progress) == (MavResult.IN_PROGRESS, 50)
        with pytest.raises(CommandRejected) as raised:
            vehicle.command(MavCmd.USER_1, 13)
    assert raised.value.result == MavResult.DENIED
    assert len(set(threads) - {threading.get_ident()}) >= 1


def test_sixteen_waiting_functions_do_not_keep_parameters_from_being_saved(tmp_path: Path) -> None:
    may_end, begun = threading.Event(), threading.Semaphore(0)

    def wait(_: CommandRequest) -> None:
        begun.release()
        assert may_end.wait(30)

    path = tmp_path / "parameters.json"
    with autopilot_and_client(parameters_file=path) as (node, vehicle):
        node.parameters.add("SPEED", 1.0)
        for number in range(MAX_RUNNING_COMMANDS):
            node.command(31_010 + number)(wait)
            vehicle.send(m.CommandLong(vehicle.system_id, 1, 31_010 + number, 0, 0, 0, 0, 0, 0, 0, 0))
        try:
            assert all(begun.acquire(timeout=10) for _ in range(MAX_RUNNING_COMMANDS))
            vehicle.parameters.set("SPEED", 2.0)
            while node.aio.parameters._save_task is not None:
                vehicle.parameters.get("SPEED")
        finally:
            may_end.set()
    assert "2.0" in path.read_text()


class SlowVehicle(AutopilotDriver):
    def __init__(self) -> None:
        self.has_begun, self.may_end = threading.Event(), threading.Event()
        self.count = 0

    def arm(self, force: bool) -> None:  # type: ignore[override]
        self.count += 1
        self.has_begun.set()
        assert self.may_end.wait(10)


def test_cancelled_arming_in_thread_is_reported_as_armed() -> None:
    """A thread cannot be stopped: the motors start, so HEARTBEAT must say so, and a second thread must not begin."""
    driver = SlowVehicle()
    with autopilot_and_client() as (node, vehicle):
        node.add_autopilot(driver)
        ids = (vehicle.system_id, vehicle.component_id)
        arm = m.CommandLong(*ids, MavCmd.COMPONENT_ARM_DISARM, 0, 1, 0, 0, 0, 0, 0, 0)
        with vehicle.subscribe(m.CommandAck, capacity=100) as acks:

            def result() -> int:
                while True:
                    ack = acks.get(timeout=5)
                    if ack.command == MavCmd.COMPONENT_ARM_DISARM and ack.result != MavResult.IN_PROGRESS:
                        return int(ack.result)

            vehicle.send(arm)
            assert driver.has_begun.wait(10)
            vehicle.send(m.CommandCancel(*ids, MavCmd.COMPONENT_ARM_DISARM))
            vehicle.send(arm)
            assert result() == MavResult.TEMPORARILY_REJECTED
            driver.may_end.set()
            assert result() == MavResult.ACCEPTED
        assert vehicle.armed.wait_until(bool, timeout=5)
    assert driver.count == 1


def test_parameters_and_missions_are_used_from_the_program() -> None:
    with autopilot_and_client() as (node, vehicle):
        node.parameters.add("SPEED", 1.5, maximum=3.0)
        assert vehicle.parameters.get("SPEED") == 1.5
        vehicle.parameters.set("SPEED", 2.0)
        assert (node.parameters["SPEED"], list(node.parameters), len(node.parameters)) == (2.0, ["SPEED"], 1)
        with pytest.raises(InvalidArgument):
            node.parameters.set("SPEED", 4.0)
        assert node.missions.items() == ()


def test_mission_function_runs_in_thread_but_loop_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    threads: dict[str, str] = {}

    def send(self: ComponentHost, message: Message, *arguments: Any) -> None:
        threads[message.NAME] = threading.current_thread().name
        send_on_loop(self, message, *arguments)

    send_on_loop = ComponentHost.send
    with autopilot_and_client() as (node, vehicle):
        node.missions.replace([waypoint(47.0, 8.0, altitude_relative_m=10)] * 2)

        @node.missions.on_set_current
        def go_on(_: int) -> None:
            threads["function"] = threading.current_thread().name

        monkeypatch.setattr(ComponentHost, "send", send)
        vehicle.command(MavCmd.DO_SET_MISSION_CURRENT, 1)
        assert node.missions.current == 1
    assert threads["MISSION_CURRENT"] == threads["COMMAND_ACK"] != threads["function"]


def test_winch_started_by_thread_at_block_end_is_stopped() -> None:
    class Winch(WinchDriver):
        def set_rate(self, rate_m_s: float) -> None:  # type: ignore[override]
            has_begun.set()
            assert may_start.wait(10)
            calls.append("start")

        def hold(self) -> None:  # type: ignore[override]
            calls.append("stop")
            may_start.set()

    has_begun, may_start = threading.Event(), threading.Event()
    calls: list[str] = []
    with autopilot_and_client() as (node, vehicle):
        node.add_winch(Winch())
        ids = (vehicle.system_id, vehicle.component_id)
        vehicle.send(m.CommandLong(*ids, MavCmd.DO_WINCH, 0, 1, WinchActions.RATE_CONTROL, 0, 1.0, 0, 0, 0))
        assert has_begun.wait(10)
    assert calls == ["stop", "start", "stop"]


def test_turning_gimbal_is_stopped_on_event_loop() -> None:
    class Head(GimbalDriver):
        def point(self, target: GimbalTarget) -> None:
            threads.append(threading.current_thread().name)

        def attitude(self) -> tuple[float, float, float]:
            return (0.0, 0.0, 0.0)

    threads: list[str] = []
    with autopilot_and_client() as (node, vehicle):
        node.add_gimbal(Head())
        vehicle.command(MavCmd.DO_GIMBAL_MANAGER_CONFIGURE, 255, 190, -1, -1, 0, 0, vehicle.component_id)
        vehicle.command(MavCmd.DO_GIMBAL_MANAGER_PITCHYAW, math.nan, math.nan, 5, 9, 0, 0, vehicle.component_id)
    assert len(threads) == 2
    assert threads[0] == threads[1]


class Slow(CameraDriver):
    def take_photo(self, index: int) -> Photo:  # type: ignore[override]
        time.sleep(0.2)
        return Photo(url=f"mftp:///{index}.jpg")


def test_camera_of_blocking_program_takes_photo_in_thread() -> None:
    with autopilot_and_client() as (node, vehicle):
        node.add_camera(Slow())
        with vehicle.subscribe(m.CameraImageCaptured, capacity=5) as captures:
            vehicle.command(MavCmd.IMAGE_START_CAPTURE, 0, 0, 1, 1)
            assert captures.get(timeout=5).file_url == "mftp:///0.jpg"


def test_second_component_shares_the_connection() -> None:
    with (
        aerokit.sync.open_connection("udpin:127.0.0.1:0") as connection,
        aerokit.sync.component(connection=connection, component_id=100) as first,
        aerokit.sync.component(connection=connection, component_id=101) as second,
    ):
        assert (first.component_id, second.component_id, connection.is_open) == (100, 101, True)
        first.set_state(5)
        assert first.state == 5


def test_component_that_fails_to_open_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(self: object) -> None:
        raise KeyboardInterrupt

    with aerokit.sync.open_connection("udpin:127.0.0.1:0") as connection:
        with monkeypatch.context() as patch:
            patch.setattr(OnboardComponent, "_use_threads", interrupt)
            with pytest.raises(KeyboardInterrupt):
                aerokit.sync.component(connection=connection, component_id=100)
        with aerokit.sync.component(connection=connection, component_id=100) as second:
            assert second.component_id == 100
