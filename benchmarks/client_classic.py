"""One script for DroneKit, dronekit2 and ``aerokit.dronekit``: the client of ``dronekit_compare.py``.

    python benchmarks/client_classic.py MODULE '{"task": "cpu", "address": "udpin:127.0.0.1:14550"}'

MODULE is ``dronekit`` or ``aerokit.dronekit``. The script prints ``connecting`` and ``connected``, and on its last line
the result as JSON.
"""

from __future__ import annotations

import collections
import collections.abc
import importlib
import json
import logging
import os
import statistics
import sys
import time
import timeit
from collections.abc import Callable
from typing import Any

from stopwatch import Stopwatch

__all__ = ["READS"]

REPEATS = 7
READS = (
    "armed", "mode", "mode.name", "system_status", "system_status.state", "attitude", "attitude.roll", "velocity",
    "heading", "airspeed", "groundspeed", "gps_0", "gps_0.fix_type", "battery", "battery.voltage", "location",
    "location.global_frame", "location.global_relative_frame", "location.global_relative_frame.alt",
    "location.local_frame", "is_armable", "ekf_ok", "last_heartbeat", "rangefinder", "channels", "gimbal",
)  # fmt: skip
"""Attributes whose read time is measured."""
# Attributes that a typical program listens to, besides the message HEARTBEAT.
TYPICAL_ATTRIBUTES = (
    "mode", "armed", "attitude", "location.global_relative_frame", "heading", "battery", "gps_0",
)  # fmt: skip

Result = dict[str, Any]


def main(arguments: list[str]) -> None:
    """Run one task and print its result."""
    module, options_text = arguments
    options = json.loads(options_text)
    began_at = time.perf_counter()
    collections.MutableMapping = collections.abc.MutableMapping  # type: ignore[attr-defined]  # for DroneKit
    dronekit = importlib.import_module(module)
    imported_s = time.perf_counter() - began_at
    logging.disable(logging.CRITICAL)
    result = TASKS[options.pop("task")](dronekit, **options)
    print(json.dumps({**result, "import_s": imported_s}), flush=True)
    os._exit(0)  # threads of DroneKit would keep the process alive


# --------------------------------------------------------------------------------------- the tasks


def connect_ready(dronekit: Any, address: str) -> Result:
    """Measure the duration of ``connect(wait_ready=True)``."""
    print("connecting", flush=True)
    stopwatch = Stopwatch()
    vehicle = dronekit.connect(address, wait_ready=True, timeout=120)
    return {"seconds": stopwatch.real_s, "cpu": stopwatch.cpu_s, "parameters": len(vehicle.parameters)}


def cpu(dronekit: Any, address: str, listeners: str, settle_s: float, window_s: float) -> Result:
    """Measure the processor time of this process with all threads, and count the messages received meanwhile."""
    vehicle = _connect(dronekit, address)
    calls = LISTENERS[listeners](vehicle)
    _report_connected()
    time.sleep(settle_s)
    received_before = _received_frames(vehicle)
    calls_before = len(calls)
    stopwatch = Stopwatch()
    time.sleep(window_s)
    return {
        "cpu_s": stopwatch.cpu_s,
        "seconds": stopwatch.real_s,
        "received": _received_frames(vehicle) - received_before,
        "called": len(calls) - calls_before,
    }


def latency(dronekit: Any, address: str, settle_s: float, window_s: float) -> Result:
    """Record the time of each call of a listener, in ns of the monotonic clock, with the round number of the value."""
    from dronekit_traffic import round_number_of

    vehicle = _connect(dronekit, address)
    calls: list[tuple[int, str, Any]] = []
    clock = time.monotonic_ns

    def record(_: Any, name: str, value: Any) -> None:
        calls.append((clock(), name, value))

    _add_typical_listeners(vehicle, record, record)
    _report_connected()
    time.sleep(settle_s)
    calls.clear()
    time.sleep(window_s)
    numbered_calls = []
    for called_at, name, value in tuple(calls):
        number = round_number_of(name, value)
        if number is not None:
            numbered_calls.append((called_at, name, number))
    return {"calls": numbered_calls}


def reads(dronekit: Any, address: str, names: list[str], settle_s: float) -> Result:
    """Measure the nanoseconds that reading each attribute takes while messages arrive."""
    vehicle = _connect(dronekit, address)
    _report_connected()
    vehicle.wait_ready("gps_0", "armed", "mode", "attitude", timeout=30)
    time.sleep(settle_s)
    return {"ns": {name: _nanoseconds(f"vehicle.{name}", vehicle) for name in names}}


def only_import(dronekit: Any) -> Result:
    """Do nothing: the import time is reported in any case."""
    return {}


TASKS: dict[str, Callable[..., Result]] = {
    "connect": connect_ready, "cpu": cpu, "latency": latency, "reads": reads, "import": only_import,
}  # fmt: skip


# --------------------------------------------------------------------------------------- listeners


def _no_listeners(vehicle: Any) -> list[None]:
    return []


def _usual_listeners(vehicle: Any) -> list[None]:
    calls: list[None] = []

    def record(_: Any, name: str, value: Any) -> None:
        calls.append(None)

    _add_typical_listeners(vehicle, record, record)
    return calls


def _every_message(vehicle: Any) -> list[None]:
    calls: list[None] = []

    def record(_: Any, name: str, message: Any) -> None:
        calls.append(None)

    vehicle.add_message_listener("*", record)
    return calls


LISTENERS: dict[str, Callable[[Any], list[None]]] = {
    "none": _no_listeners, "usual": _usual_listeners, "every_message": _every_message,
}  # fmt: skip


def _add_typical_listeners(
    vehicle: Any, on_attribute: Callable[[Any, str, Any], None], on_message: Callable[[Any, str, Any], None]
) -> None:
    vehicle.on_message("HEARTBEAT")(on_message)
    for name in TYPICAL_ATTRIBUTES:
        vehicle.on_attribute(name)(on_attribute)


# ------------------------------------------------------------------------------------------ helpers


def _connect(dronekit: Any, address: str) -> Any:
    print("connecting", flush=True)
    return dronekit.connect(address, wait_ready=["mode"], rate=None)


def _report_connected() -> None:
    print("connected", flush=True)


def _received_frames(vehicle: Any) -> int:
    """Return the number of received frames, from the counters of the library, which does not decode all frames."""
    if not hasattr(vehicle, "aio"):  # not aerokit
        return int(vehicle._master.mav.total_packets_received)
    received = 0
    for peer in vehicle.aio.connection.statistics():
        received += sum(source.received for source in peer.sources.values())
    return received


def _nanoseconds(expression: str, vehicle: Any) -> float:
    timer = timeit.Timer(expression, globals={"vehicle": vehicle})
    number, _ = timer.autorange()
    number = max(1, number // 4)
    return statistics.median(timer.repeat(REPEATS, number)) / number * 1e9


if __name__ == "__main__":
    main(sys.argv[1:])
