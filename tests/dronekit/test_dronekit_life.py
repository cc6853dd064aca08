"""Connecting and closing a classic vehicle, leaks, and Ctrl-C."""

from __future__ import annotations

import _thread
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType, SimpleNamespace
from typing import Any

import pytest
from served_copter import served_copter

import aerokit.dronekit as dronekit
from aerokit.dronekit import mavlink
from aerokit.dronekit import vehicle as vehicle_module
from aerokit.dronekit.classic_connection import BackgroundCall
from aerokit.mavlink.messages import GlobalPositionInt

LIMIT_S = 100.0
ORDER = BackgroundCall("arm")
SOURCES = Path(__file__).parent.parent.parent / "src"


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    with served_copter() as served:
        yield served


@pytest.fixture
def vehicle(address: str) -> Iterator[dronekit.Vehicle]:
    connected = dronekit.connect(address, wait_ready=["mode", "armed"])
    yield connected
    connected.close()


def own_threads() -> list[str]:
    return sorted(thread.name for thread in threading.enumerate() if thread.name.startswith(("aerokit", "dronekit")))


def open_sockets() -> int:
    found = 0
    for number in os.listdir("/proc/self/fd"):
        try:
            found += os.readlink(f"/proc/self/fd/{number}").startswith("socket:")
        except OSError:
            continue
    return found


def eventually(is_true: Callable[[], object]) -> None:
    deadline = time.monotonic() + LIMIT_S
    while not is_true():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_close_leaves_no_threads(address: str) -> None:
    threads, sockets = own_threads(), open_sockets()
    vehicle = dronekit.connect(address, wait_ready=["attitude"])
    vehicle.add_attribute_listener("attitude", lambda *_: None)
    vehicle.on_message("*")(lambda *_: None)
    assert len(own_threads()) >= len(threads) + 1
    vehicle.close()
    vehicle.close()
    assert own_threads() == threads
    eventually(lambda: open_sockets() <= sockets)  # the server closes its side, too


def test_closed_vehicle_keeps_attributes_and_orders_raise(vehicle: dronekit.Vehicle) -> None:
    vehicle.close()
    assert vehicle.mode.name == "STABILIZE"
    for use in (
        lambda: setattr(vehicle, "mode", "LOITER"),
        lambda: setattr(vehicle, "armed", True),
        lambda: vehicle.simple_takeoff(10),
        lambda: vehicle.arm(),
        lambda: vehicle.wait_for_mode("LOITER"),
        lambda: vehicle.wait_for(lambda: False),
        lambda: vehicle.wait_ready("nothing"),
        lambda: vehicle.send_mavlink(vehicle.message_factory.heartbeat_encode(6, 8, 0, 0, 0)),
        lambda: vehicle.commands.download(),
        lambda: vehicle.reboot(),
    ):
        with pytest.raises(dronekit.APIException):
            use()


@pytest.mark.parametrize("kind", ["attribute", "message"])
def test_callback_may_close_vehicle(address: str, kind: str) -> None:
    threads = own_threads()
    vehicle = dronekit.connect(address)
    closed = threading.Event()

    def close(*_: Any) -> None:
        vehicle.close()
        closed.set()

    if kind == "attribute":
        vehicle.add_attribute_listener("*", close)
    else:
        vehicle.add_message_listener("*", close)
    assert closed.wait(LIMIT_S)
    vehicle.close()
    eventually(lambda: own_threads() == threads)


def test_close_ends_waiting_calls_of_other_threads(vehicle: dronekit.Vehicle) -> None:
    errors: list[BaseException] = []

    def wait(call: Callable[[], object]) -> None:
        try:
            call()
        except dronekit.APIException as error:
            errors.append(error)

    calls = [
        lambda: vehicle.wait_for(lambda: False, interval=100),
        lambda: vehicle.wait_ready("nothing", timeout=100),
        lambda: vehicle.wait_for_alt(1000),
    ]
    threads = [threading.Thread(target=wait, args=(call,)) for call in calls]
    for thread in threads:
        thread.start()
    vehicle.close()
    for running in threads:
        running.join(LIMIT_S)
    assert len(errors) == len(calls)


def test_callback_may_block_during_reception(vehicle: dronekit.Vehicle) -> None:
    observed: list[str] = []
    done = threading.Event()

    def change_mode(self: dronekit.Vehicle, name: str, value: Any) -> None:
        self.remove_attribute_listener(name, change_mode)
        self.wait_for_mode("ALT_HOLD", timeout=LIMIT_S)
        self.parameters["RTL_ALT"] = 2000
        observed.append(self.mode.name)
        self.wait_for_mode("STABILIZE", timeout=LIMIT_S)
        done.set()

    vehicle.add_attribute_listener("attitude", change_mode)
    assert done.wait(LIMIT_S)
    assert observed == ["ALT_HOLD"]


def test_attributes_are_read_without_loop(vehicle: dronekit.Vehicle) -> None:
    vehicle.wait_ready("attitude", "gps_0", "battery", "location", "heading", timeout=LIMIT_S)
    is_held, may_go_on = threading.Event(), threading.Event()

    def hold() -> None:
        is_held.set()
        may_go_on.wait(LIMIT_S)

    vehicle._handler.loop.call_soon(hold)
    assert is_held.wait(LIMIT_S)
    try:
        for name in [
            "mode",
            "armed",
            "attitude",
            "location",
            "velocity",
            "gps_0",
            "battery",
            "heading",
            "airspeed",
            "version",
        ]:
            getattr(vehicle, name)
        assert vehicle.location.global_relative_frame.lat is not None
    finally:
        may_go_on.set()


def test_location_numbers_are_of_one_message(vehicle: dronekit.Vehicle) -> None:
    ended, torn = threading.Event(), []
    location = vehicle.location

    def read() -> None:
        while not ended.is_set():
            place = location.global_frame
            if place.alt != place.lat and place.alt is not None and place.alt < 90:
                torn.append(str(place))

    reader = threading.Thread(target=read)

    def feed() -> None:
        for number in range(1, 81):
            degrees, millimetres = number * 10_000_000, number * 1000
            location._global.receive(GlobalPositionInt(0, degrees, degrees, millimetres, 0, 0, 0, 0, 0))

    vehicle._handler.loop.call(feed)
    reader.start()
    for _ in range(20):
        vehicle._handler.loop.call(feed)
    ended.set()
    reader.join(LIMIT_S)
    assert not torn


BLOCKING: dict[str, Callable[[dronekit.Vehicle], object]] = {
    "wait_ready": lambda vehicle: vehicle.wait_ready("nothing", timeout=LIMIT_S),
    "wait_for": lambda vehicle: vehicle.wait_for(lambda: False, timeout=LIMIT_S),
    "wait_for_alt": lambda vehicle: vehicle.wait_for_alt(1000, timeout=LIMIT_S),
    "run": lambda vehicle: vehicle.run(vehicle.aio.telemetry.mode.wait_until, lambda _: False),
    "sync": lambda vehicle: vehicle.sync.mode.wait_until(lambda _: False, timeout=LIMIT_S),
    "connect": lambda _: dronekit.connect("udpin:127.0.0.1:0", heartbeat_timeout=LIMIT_S),
}


@pytest.mark.sampled(3)
@pytest.mark.parametrize("name", BLOCKING)
def test_ctrl_c_ends_blocking_call(vehicle: dronekit.Vehicle, name: str) -> None:
    threads = own_threads()
    timer = threading.Timer(0.3, _thread.interrupt_main)
    timer.start()
    try:
        with pytest.raises(KeyboardInterrupt):
            BLOCKING[name](vehicle)
            time.sleep(LIMIT_S)  # pragma: no cover - only when the call returned instead
    finally:
        timer.cancel()
    eventually(lambda: own_threads() == threads)


@pytest.mark.sampled(3)
@pytest.mark.parametrize(
    ("ending", "last_mode"),
    [("", None), ("vehicle.mode = 'RTL'", "RTL"), ("vehicle.mode = 'LAND'; vehicle.close()", "LAND")],
)
def test_program_exit_delivers_last_order(ending: str, last_mode: str | None) -> None:
    with served_copter() as address:
        program = f"""
import logging
logging.basicConfig()
from aerokit.dronekit import connect
vehicle = connect({address!r}, wait_ready=['mode', 'attitude'])
vehicle.add_attribute_listener('attitude', lambda *_: None)
{ending}
"""
        result = subprocess.run(
            [sys.executable, "-c", program],
            env={**os.environ, "PYTHONPATH": str(SOURCES)},
            capture_output=True,
            text=True,
            timeout=200,
            check=False,
        )
        assert (result.returncode, result.stdout) == (0, "")
        assert "Traceback" not in result.stderr
        if last_mode is not None:
            vehicle = dronekit.connect(address)
            assert vehicle.mode.name == last_mode
            vehicle.close()


def test_connect_failure_raises_operating_system_exception(monkeypatch: pytest.MonkeyPatch) -> None:
    threads, pauses = own_threads(), list[float]()
    monkeypatch.setattr(mavlink, "time", SimpleNamespace(sleep=pauses.append))
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        port = listener.getsockname()[1]
    with pytest.raises(ConnectionRefusedError):
        dronekit.connect(f"tcp:127.0.0.1:{port}")
    assert pauses == [1.0, 1.0]
    with pytest.raises(OSError, match="no/such"):
        dronekit.connect("/dev/no/such/device")
    with pytest.raises(ValueError, match="port"):
        dronekit.connect("udpin:127.0.0.1")
    assert own_threads() == threads


def test_connect_without_vehicle_times_out_and_closes() -> None:
    threads, sockets = own_threads(), open_sockets()
    with pytest.raises(dronekit.APIException, match="Timeout in initializing connection") as caught:
        dronekit.connect("udpin:127.0.0.1:0", heartbeat_timeout=0.2)
    assert "no bytes were received" in str(caught.value)
    with pytest.raises(builtin_timeout()), served_copter(boot_time_s=0.0) as address:
        dronekit.connect(address, wait_ready=["no such attribute"], timeout=0.2)
    assert own_threads() == threads
    eventually(lambda: open_sockets() <= sockets)


def builtin_timeout() -> type[Exception]:
    return TimeoutError


def test_vehicle_is_context_manager(address: str) -> None:
    threads = own_threads()
    with dronekit.connect(address) as vehicle:
        assert vehicle.mode.name == "STABILIZE"
    assert own_threads() == threads


def test_reset_link_reopens(vehicle: dronekit.Vehicle, caplog: pytest.LogCaptureFixture) -> None:
    connection: Any = vehicle._handler.connection
    vehicle._handler.reset()
    eventually(lambda: "is back" in caplog.text or connection.counts(1)[0] == 0 or connection.link.is_away)
    notified: list[str] = []
    eventually(lambda: not connection.link.is_away)
    vehicle.on_message("ATTITUDE")(lambda _, name, message: notified.append(name))
    eventually(lambda: notified)
    vehicle.wait_for_mode("ALT_HOLD", timeout=LIMIT_S)
    vehicle.wait_for_mode("STABILIZE", timeout=LIMIT_S)


def test_is_mode_available(vehicle: dronekit.Vehicle) -> None:
    assert vehicle._is_mode_available(5)
    assert not vehicle._is_mode_available(222)


@pytest.mark.exhaustive
def test_subclass_attributes_do_not_collide(address: str) -> None:
    class Own(dronekit.Vehicle):
        def __init__(self, *args: Any) -> None:
            super().__init__(*args)
            own: Any = self
            own._heartbeat = own._gps = own._version = own._sync = own._tasks = own._aio = 0
            own.wind = own.aio = own.sync = "mine"

        def _run(self) -> None: ...
        def _send(self, message: object) -> None: ...
        def _order(self) -> None: ...
        def _on_heartbeat(self) -> None: ...
        def _on_attitude(self, name: str, message: object) -> None: ...
        def _tell(self) -> None: ...
        def _check_link(self) -> None: ...

    with dronekit.connect(address, wait_ready=True, vehicle_class=Own) as connected:
        vehicle: Any = connected
        assert vehicle.wind == vehicle.aio == vehicle.sync == "mine"
        vehicle.wait_for_mode("ALT_HOLD", timeout=LIMIT_S)
        assert vehicle.parameters["RTL_ALT"] is not None
        vehicle.wait_for_mode("STABILIZE", timeout=LIMIT_S)
        assert vehicle.attitude.pitch is not None


def test_connect_waits_for_first_values(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vehicle_module, "FIRST_VALUES_TIMEOUT_S", LIMIT_S)
    monkeypatch.setattr(vehicle_module, "NEXT_VALUE_TIMEOUT_S", LIMIT_S)
    with dronekit.connect(address) as vehicle:
        assert vehicle.location.global_relative_frame.alt is not None
        assert vehicle.attitude.yaw is not None
        assert vehicle.battery.voltage is not None


def test_connect_does_not_wait_for_missing_values(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vehicle_module, "FIRST_VALUES", ("attitude", "heading", "a value never reported"))
    monkeypatch.setattr(vehicle_module, "FIRST_VALUES_TIMEOUT_S", 1e6)
    monkeypatch.setattr(vehicle_module, "NEXT_VALUE_TIMEOUT_S", 0.05)
    dronekit.connect(address).close()


def test_connect_counts_earlier_values(vehicle: dronekit.Vehicle, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vehicle_module, "FIRST_VALUES", ("mode", "a value never reported"))
    monkeypatch.setattr(vehicle_module, "FIRST_VALUES_TIMEOUT_S", 1e6)
    monkeypatch.setattr(vehicle_module, "NEXT_VALUE_TIMEOUT_S", 0.05)
    vehicle._dk_wait_for_first_values()


@pytest.mark.parametrize("wrong", [None, 14550, b"udp:127.0.0.1:14550"])
def test_connect_non_string_raises(wrong: Any) -> None:
    with pytest.raises(ValueError, match="is not a connection string"):
        dronekit.connect(wrong)


def test_errors_name_missing_values(vehicle: dronekit.Vehicle) -> None:
    with pytest.raises(dronekit.TimeoutError) as waited:
        vehicle.wait_ready("mode", "batery", timeout=0.01)
    assert str(waited.value) == "wait_ready experienced a timeout after 0.01 seconds."
    assert str(waited.value.__cause__) == "not received: batery"
    with pytest.raises(KeyError) as wrong:
        vehicle.mode = dronekit.VehicleMode("GIUDED")
    assert wrong.value.args == ("GIUDED",)
    assert "GUIDED" in str(wrong.value.__cause__)
    with pytest.raises(dronekit.TimeoutError, match=r"within 0\.01 s"):
        vehicle.wait_for(lambda: False, timeout=0.01)


def test_rejections_describe_vehicle_state(vehicle: dronekit.Vehicle, caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(dronekit.TimeoutError, match=r"failed to reach specified altitude: .*NAV_TAKEOFF"):
        vehicle.wait_simple_takeoff(10, timeout=LIMIT_S)
    assert "takeoff: " in caplog.text
    assert "(the vehicle is disarmed, in STABILIZE)" in caplog.text


@pytest.mark.parametrize(
    "wait",
    [
        lambda vehicle: vehicle.wait_ready("unknown"),
        lambda vehicle: vehicle.wait_for(lambda: False),
        lambda vehicle: vehicle.arm(),
        lambda vehicle: vehicle._master.motors_armed_wait(),
        lambda vehicle: (vehicle.commands.download(), vehicle.commands.clear()),
    ],
)
def test_wait_on_loop_thread_raises(vehicle: dronekit.Vehicle, wait: Callable[[Any], object]) -> None:
    """Nothing could arrive meanwhile, so such a wait would last forever and stop our heartbeat."""

    async def call() -> None:
        wait(vehicle)

    with pytest.raises(dronekit.APIException, match="loop's own thread would be a deadlock"):
        vehicle.run(call)
    vehicle.wait_ready("commands")
    assert not vehicle.armed


def test_wait_with_negative_interval_ends(vehicle: dronekit.Vehicle) -> None:
    """-1 means "no limit" for a lock."""
    with pytest.raises(dronekit.TimeoutError):
        vehicle.wait_for(lambda: False, timeout=0.01, interval=-1)


@pytest.mark.parametrize(
    "wait",
    [
        lambda vehicle: vehicle._dk.ready.wait_for_change({"new"}, 0.001),
        lambda vehicle: vehicle._master.recv_match(type="NAMED_VALUE_INT", blocking=True, timeout=0.001),
        lambda vehicle: vehicle.wait_for(iter((False, True)).__next__, interval=0.001),
        lambda _: ORDER.done(),
    ],
)
def test_waits_do_not_use_condition(vehicle: dronekit.Vehicle, wait: Callable[[Any], object]) -> None:
    """Ctrl-C can leave the lock of threading.Condition acquired; the loop's thread or close() then hangs forever."""
    wait(vehicle)  # The first wait imports modules, which must not be traced.
    used = set[str]()

    def trace(frame: FrameType, *_: object) -> None:
        if frame.f_code.co_name != "current_thread":  # current_thread() takes no lock.
            used.add(frame.f_code.co_filename)

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        wait(vehicle)
    finally:
        sys.settrace(before)
    assert threading.__file__ not in used
