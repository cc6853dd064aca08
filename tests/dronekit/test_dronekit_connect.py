"""``connect``: imports, exception types and tracebacks."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import traceback
from collections.abc import Iterator
from pathlib import Path

import pytest
import serial
from ctrl_c import interrupt_soon
from flight_controller import FlightController

import aerokit.dronekit as dronekit
from aerokit.dronekit import mavlink

SOURCES = Path(__file__).parent.parent.parent / "src"
MAX_LINES = 10


@pytest.fixture
def fc() -> Iterator[FlightController]:
    with FlightController() as controller:
        yield controller


def test_simple_program_imports_neither_pymavlink_nor_sync(
    fc: FlightController,
) -> None:
    program = f"""
import sys
from aerokit.dronekit import VehicleMode, connect
vehicle = connect({fc.address!r}, wait_ready=['mode'])
vehicle.mode = VehicleMode('GUIDED')
vehicle.armed = True
vehicle.close()
print([module for module in ('pymavlink', 'aerokit.sync.twins', 'argparse') if module in sys.modules])
"""
    ran = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, "PYTHONPATH": str(SOURCES)},
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
    )
    assert ran.stdout == "[]\n", ran.stderr


@pytest.mark.parametrize("caught_as", [OSError, serial.SerialException, ValueError])
def test_connect_invalid_string_raises_dronekit_exceptions(caught_as: type[Exception]) -> None:
    with pytest.raises(caught_as, match="'nonsense' is not a link address"):
        dronekit.connect("nonsense")


def refused() -> None:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        port = listener.getsockname()[1]
    dronekit.connect(f"tcp:127.0.0.1:{port}")


def no_vehicle() -> None:
    dronekit.connect("udpin:127.0.0.1:0", heartbeat_timeout=0.1)


@pytest.mark.parametrize("failing", [refused, no_vehicle])
def test_connect_failure_has_short_traceback(failing: object, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mavlink, "RETRY_INTERVAL_S", 0.0)
    assert callable(failing)
    with pytest.raises((OSError, dronekit.APIException)) as caught:
        failing()
    assert caught.tb.tb_next is not None
    shown = "".join(traceback.format_exception(caught.type, caught.value, caught.tb.tb_next))
    assert shown.count("\n") <= MAX_LINES, shown


@pytest.mark.skipif(not hasattr(signal, "pthread_kill"), reason="needs POSIX signals")
def test_ctrl_c_during_connect_has_short_traceback() -> None:
    before = threading.enumerate()
    timers = []
    with pytest.raises(KeyboardInterrupt) as caught:
        timers.append(interrupt_soon())
        dronekit.connect("udpin:127.0.0.1:0")
    timers[0].join()
    assert len(caught.traceback) <= 3
    assert [thread for thread in threading.enumerate() if thread not in before] == []


def test_error_in_vehicle_class_has_full_traceback(fc: FlightController) -> None:
    def broken(handler: mavlink.MAVConnection) -> dronekit.Vehicle:
        raise ValueError("a mistake in here")

    with pytest.raises(ValueError, match="in here") as caught:
        dronekit.connect(fc.address, vehicle_class=broken)
    assert caught.traceback[-1].name == "broken"


@pytest.mark.parametrize("wrong", ["guided", "Guided", "5", "alt_hold"])
def test_mode_names_are_upper_case(fc: FlightController, wrong: str) -> None:
    with dronekit.connect(fc.address, rate=None) as vehicle:
        since = fc.mark()
        with pytest.raises(KeyError, match=wrong):
            vehicle.mode = wrong
        vehicle.mode = "GUIDED"
        vehicle.wait_for_mode("GUIDED", timeout=100)
        assert {frame.param2 for frame in fc.commands(since=since)} == {4}


def test_unknown_autopilot_has_ardupilot_modes() -> None:
    """iNav calls itself generic."""
    with FlightController(autopilot=0, mode=4) as fc, dronekit.connect(fc.address, rate=None) as vehicle:
        assert vehicle.mode.name == "GUIDED"
        vehicle.wait_for_mode("LOITER", timeout=100)


def test_accept_input_discards_received_bytes(fc: FlightController) -> None:
    """Programs set it to simulate a lost link."""
    with dronekit.connect(fc.address, rate=None) as vehicle:
        handler = vehicle._handler
        assert handler._accept_input
        handler._accept_input = False
        assert not handler._accept_input
        before = vehicle.last_heartbeat
        fc.custom_mode = 5
        for _ in range(3):
            fc.beat()
        with pytest.raises(dronekit.TimeoutError):
            vehicle.wait_for(lambda: vehicle.mode == "LOITER", timeout=0.2)
        assert vehicle.last_heartbeat > before
        handler._accept_input = True
        fc.beat()
        vehicle.wait_for(lambda: vehicle.mode == "LOITER", timeout=100)
    assert not handler._accept_input
