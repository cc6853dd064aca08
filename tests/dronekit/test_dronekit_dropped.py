"""A classic vehicle that the program has dropped without ``close()``: it ends, unless it has listeners or orders."""

from __future__ import annotations

import gc
import logging
import os
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import anyio
import pytest
from served_copter import served_copter

import aerokit.dronekit as dronekit
from aerokit.dronekit import mavlink
from aerokit.dronekit import parameters as parameter_transfers
from aerokit.transport import tcp

LIMIT_S = 100.0
SOURCES = Path(__file__).parent.parent.parent / "src"
CLOSED = "the program dropped it without close()"


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    with served_copter() as served:
        yield served


@pytest.fixture(autouse=True)
def nothing_else_is_open() -> Iterator[None]:
    """Close connections that a failed test left open."""
    with mavlink.created_connections() as connections:
        yield
        for connection in tuple(connections):
            connection.close()


def own_threads() -> list[str]:
    return [thread.name for thread in threading.enumerate() if thread.name.startswith(("aerokit", "dronekit"))]


def eventually(is_true: Callable[[], object]) -> None:
    deadline = time.monotonic() + LIMIT_S
    while not is_true():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def is_gone(vehicle: weakref.ref[Any]) -> bool:
    """The loop may be executing one of its methods at this moment."""
    gc.collect()
    return vehicle() is None


class Listening(dronekit.Vehicle):
    """Listens to itself, as subclasses of the classic Vehicle do."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.add_message_listener("ATTITUDE", self.on_attitude)

    def on_attitude(self, _vehicle: object, _name: str, _message: object) -> None: ...


def test_dropped_vehicle_is_closed_and_frees_its_link(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(tcp, "MAX_CLIENTS", 1)
    with served_copter() as address:
        vehicle = dronekit.connect(address, wait_ready=["attitude"])
        dropped = weakref.ref(vehicle)
        del vehicle
        eventually(lambda: is_gone(dropped))
        eventually(lambda: not own_threads())
    with (
        served_copter(address.replace("tcp:", "tcpin:")),
        dronekit.connect(address, wait_ready=["attitude"]) as vehicle,
    ):
        assert vehicle.attitude.pitch is not None
    notified = [
        (record.name, record.levelname, record.getMessage()) for record in caplog.records if CLOSED in record.message
    ]
    assert notified == [("dronekit", "WARNING", f"the connection to {address} was closed: {CLOSED}")]


def _download(vehicle: dronekit.Vehicle) -> None:
    vehicle.commands.download()
    vehicle.commands.wait_ready()


def _order(vehicle: dronekit.Vehicle) -> None:
    vehicle.mode = "ALT_HOLD"
    vehicle.wait_for_mode("STABILIZE")


USES: dict[str, Callable[[dronekit.Vehicle], object]] = {
    "everything": lambda vehicle: vehicle.wait_ready(True, timeout=LIMIT_S),
    "aio and sync": lambda vehicle: (vehicle.aio.mode.value, vehicle.sync.mode.value),
    "inbox": lambda vehicle: vehicle._master.recv_match(type="HEARTBEAT", blocking=True, timeout=LIMIT_S),
    "mission": _download,
    "orders": _order,
    "refused": lambda vehicle: vehicle.simple_takeoff(10),
}


@pytest.mark.sampled(2)
@pytest.mark.parametrize("use", USES.values(), ids=USES)
def test_dropped_vehicle_is_not_kept_by_previous_use(address: str, use: Callable[[dronekit.Vehicle], object]) -> None:
    vehicle = dronekit.connect(address)
    dropped = weakref.ref(vehicle)
    use(vehicle)
    del vehicle
    eventually(lambda: is_gone(dropped))
    eventually(lambda: not own_threads())


def test_dropped_vehicle_is_not_kept_by_parameter_download(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parameter_transfers, "_download_method", lambda _: anyio.sleep_forever())
    vehicle = dronekit.connect(address)
    dropped = weakref.ref(vehicle)
    del vehicle
    eventually(lambda: is_gone(dropped))
    eventually(lambda: not own_threads())


OWNERS: dict[str, Callable[[dronekit.Vehicle], Any]] = {
    "vehicle": lambda vehicle: vehicle,
    "location": lambda vehicle: vehicle.location,
}


@pytest.mark.parametrize("owner", OWNERS.values(), ids=OWNERS)
def test_dropped_vehicle_is_kept_by_attribute_listener_until_removed(
    address: str, owner: Callable[[dronekit.Vehicle], Any]
) -> None:
    notified, is_to_go = threading.Event(), threading.Event()

    def listener(self: Any, name: str, value: object) -> None:
        notified.set()
        if is_to_go.is_set():
            self.remove_attribute_listener("*", listener)

    vehicle = dronekit.connect(address)
    dropped = weakref.ref(vehicle)
    owner(vehicle).add_attribute_listener("*", listener)
    del vehicle
    for _ in range(3):
        assert not is_gone(dropped)
        notified.clear()
        assert notified.wait(LIMIT_S)
    is_to_go.set()
    eventually(lambda: is_gone(dropped))
    eventually(lambda: not own_threads())


@pytest.mark.parametrize("name", ["*", "ATTITUDE"])
def test_dropped_vehicle_is_kept_by_message_listener_until_removed(address: str, name: str) -> None:
    notified, is_to_go = threading.Event(), threading.Event()

    def listener(self: dronekit.Vehicle, _: str, message: object) -> None:
        notified.set()
        if is_to_go.is_set():
            self.remove_message_listener(name, listener)

    vehicle = dronekit.connect(address)
    dropped = weakref.ref(vehicle)
    vehicle.add_message_listener(name, listener)
    del vehicle
    for _ in range(3):
        assert not is_gone(dropped)
        notified.clear()
        assert notified.wait(LIMIT_S)
    is_to_go.set()
    eventually(lambda: is_gone(dropped))
    eventually(lambda: not own_threads())


@pytest.mark.parametrize("left", ["attribute", "message"])
def test_dropped_vehicle_is_kept_by_remaining_listener(address: str, left: str) -> None:
    notified = threading.Event()

    def to_attribute(_: object, name: str, value: object) -> None:
        if left == "attribute":
            notified.set()

    def to_message(_: object, name: str, message: object) -> None:
        if left == "message":
            notified.set()

    vehicle = dronekit.connect(address)
    vehicle.add_attribute_listener("attitude", to_attribute)
    vehicle.add_message_listener("ATTITUDE", to_message)
    if left == "attribute":
        vehicle.remove_message_listener("ATTITUDE", to_message)
    else:
        vehicle.remove_attribute_listener("attitude", to_attribute)
    dropped = weakref.ref(vehicle)
    del vehicle
    for _ in range(3):
        assert not is_gone(dropped)
        notified.clear()
        assert notified.wait(LIMIT_S)


@pytest.mark.exhaustive
def test_dropped_vehicle_is_kept_by_parameter_listener(address: str) -> None:
    notified = threading.Event()
    vehicle = dronekit.connect(address, wait_ready=["parameters"])
    vehicle.parameters.add_attribute_listener("RTL_ALT", lambda *_: notified.set())
    dropped = weakref.ref(vehicle)
    del vehicle
    assert not is_gone(dropped)
    with dronekit.connect(address) as other:
        other.parameters["RTL_ALT"] = 1234 if other.parameters["RTL_ALT"] != 1234 else 1235
        assert notified.wait(LIMIT_S)


@pytest.mark.parametrize(
    "options", [{"vehicle_class": Listening}, {"status_printer": lambda _: None}], ids=["subclass", "printer"]
)
def test_dropped_vehicle_is_kept_by_connect_callbacks(address: str, options: dict[str, Any]) -> None:
    dropped = weakref.ref(dronekit.connect(address, **options))
    assert not is_gone(dropped)
    vehicle = dropped()
    assert vehicle is not None
    vehicle.close()
    del vehicle
    eventually(lambda: is_gone(dropped))


def test_dropped_vehicle_is_kept_by_connection_listeners(address: str) -> None:
    notified = threading.Event()
    dronekit.connect(address)._handler.forward_message(lambda _, message: notified.set())
    for _ in range(3):
        gc.collect()
        notified.clear()
        assert notified.wait(LIMIT_S)


PARTS: dict[str, Callable[[dronekit.Vehicle], Any]] = {
    "parameters": lambda vehicle: vehicle.parameters,
    "location": lambda vehicle: vehicle.location,
    "commands": lambda vehicle: vehicle.commands,
    "channels": lambda vehicle: vehicle.channels,
    "gimbal": lambda vehicle: vehicle.gimbal,
    "factory": lambda vehicle: vehicle.message_factory,
    "handler": lambda vehicle: vehicle._handler,
    "sync": lambda vehicle: vehicle.sync,
    "cell": lambda vehicle: vehicle.sync.position,
}


@pytest.mark.parametrize("part", PARTS.values(), ids=PARTS)
def test_dropped_vehicle_part_keeps_connection(address: str, part: Callable[[dronekit.Vehicle], Any]) -> None:
    kept = part(dronekit.connect(address))
    gc.collect()
    assert own_threads() == ["aerokit loop"]
    del kept
    eventually(lambda: (gc.collect(), not own_threads())[1])


def test_dropped_vehicle_is_kept_by_running_order(address: str) -> None:
    may_end, has_ended = threading.Event(), threading.Event()

    async def order() -> None:
        await anyio.to_thread.run_sync(may_end.wait, LIMIT_S)
        has_ended.set()

    vehicle = dronekit.connect(address)
    dropped = weakref.ref(vehicle)
    vehicle._dk.order("test", order)
    del vehicle
    for _ in range(3):
        assert not is_gone(dropped)
        assert own_threads() == ["aerokit loop"]
    may_end.set()
    eventually(lambda: is_gone(dropped))
    eventually(lambda: not own_threads())
    assert has_ended.is_set()


def test_dropped_vehicle_is_kept_by_waiting_call(address: str) -> None:
    may_end, ended = threading.Event(), list[str]()

    def wait(vehicle: dronekit.Vehicle) -> None:
        vehicle.wait_for(may_end.is_set, timeout=LIMIT_S)
        ended.append("well")

    vehicle = dronekit.connect(address)
    dropped = weakref.ref(vehicle)
    waiting = threading.Thread(target=wait, args=(vehicle,))
    waiting.start()
    del vehicle
    assert not is_gone(dropped)
    may_end.set()
    waiting.join(LIMIT_S)
    assert ended == ["well"]
    eventually(lambda: is_gone(dropped))
    eventually(lambda: not own_threads())


def test_dropped_connection_is_not_kept_by_created_connections(address: str) -> None:
    with mavlink.created_connections() as made:
        connection = mavlink.MAVConnection(address)
        assert list(made) == [connection]
        del connection
        eventually(lambda: (gc.collect(), not own_threads())[1])
        assert not made


def test_dropped_vehicle_calls_on_close_functions(address: str) -> None:
    closed = list[str]()
    dronekit.connect(address)._handler.on_close(lambda: closed.append("well"))
    eventually(lambda: (gc.collect(), closed)[1])
    eventually(lambda: not own_threads())


def test_closed_vehicle_logs_no_dropped_warning(address: str, caplog: pytest.LogCaptureFixture) -> None:
    with dronekit.connect(address) as vehicle:
        dropped = weakref.ref(vehicle)
    del vehicle
    eventually(lambda: is_gone(dropped))
    assert CLOSED not in caplog.text


@pytest.mark.sampled(2)
@pytest.mark.parametrize("collects", ["", "gc.collect()"])
def test_program_exits_with_dropped_vehicle(collects: str) -> None:
    with served_copter() as address:
        program = f"""
import gc
from aerokit.dronekit import connect
connect({address!r}, wait_ready=['attitude'])
{collects}
"""
        result = subprocess.run(
            [sys.executable, "-W", "error", "-c", program],
            env={**os.environ, "PYTHONPATH": str(SOURCES)},
            capture_output=True,
            text=True,
            timeout=200,
            check=False,
        )
    assert (result.returncode, result.stdout) == (0, "")
    assert not [line for line in result.stderr.splitlines() if CLOSED not in line]


def test_dropped_vehicle_slow_log_handler_does_not_block_collector(address: str) -> None:
    is_held, may_go_on = threading.Event(), threading.Event()

    class Slow(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            if CLOSED in record.getMessage():
                is_held.set()
                may_go_on.wait(LIMIT_S)

    handler = Slow()
    logging.getLogger("dronekit").addHandler(handler)
    try:
        dropped = weakref.ref(dronekit.connect(address))
        eventually(lambda: is_gone(dropped))  # on this thread: it does not wait for the handler
        assert is_held.wait(LIMIT_S)
        assert own_threads()
    finally:
        may_go_on.set()
        logging.getLogger("dronekit").removeHandler(handler)
    eventually(lambda: not own_threads())
