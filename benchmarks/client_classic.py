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
USUAL = (
    "mode", "armed", "attitude", "location.global_relative_frame", "heading", "battery", "gps_0",
)  # fmt: skip

Found = dict[str, Any]


def main(arguments: list[str]) -> None:
    """Run one task and print its result."""
    module, options = arguments[0], json.loads(arguments[1])
    began_at = time.perf_counter()
    collections.MutableMapping = collections.abc.MutableMapping  # type: ignore[attr-defined]  # for DroneKit
    dronekit = importlib.import_module(module)
    imported_s = time.perf_counter() - began_at
    logging.disable(logging.CRITICAL)
    found = TASKS[options.pop("task")](dronekit, **options)
    print(json.dumps({**found, "import_s": imported_s}), flush=True)
    os._exit(0)  # threads of DroneKit would keep the process alive


# --------------------------------------------------------------------------------------- the tasks


def connect_ready(dronekit: Any, address: str) -> Found:
    """Measure the duration of ``connect(wait_ready=True)``."""
    print("connecting", flush=True)
    cpu, began_at = time.process_time(), time.perf_counter()
    vehicle = dronekit.connect(address, wait_ready=True, timeout=120)
    seconds = time.perf_counter() - began_at
    return {"seconds": seconds, "cpu": time.process_time() - cpu, "parameters": len(vehicle.parameters)}


def cpu(dronekit: Any, address: str, listeners: str, settle_s: float, window_s: float) -> Found:
    """Measure the processor time of this process with all threads, and count the messages received meanwhile."""
    vehicle = _connected(dronekit, address)
    calls = LISTENERS[listeners](vehicle)
    _report_connected()
    time.sleep(settle_s)
    received, called, used, began_at = (
        _received(vehicle),
        len(calls),
        time.process_time(),
        time.perf_counter(),
    )
    time.sleep(window_s)
    used, seconds = time.process_time() - used, time.perf_counter() - began_at
    return {
        "cpu_s": used, "seconds": seconds, "received": _received(vehicle) - received, "called": len(calls) - called,
    }  # fmt: skip


def latency(dronekit: Any, address: str, settle_s: float, window_s: float) -> Found:
    """Record the time of each call of a listener, in ns of the monotonic clock, with the round number of the value."""
    from dronekit_traffic import keys_of

    vehicle = _connected(dronekit, address)
    calls: list[tuple[int, str, Any]] = []
    clock = time.monotonic_ns

    def record(_: Any, name: str, value: Any) -> None:
        calls.append((clock(), name, value))

    _add_typical_listeners(vehicle, record, record)
    _report_connected()
    time.sleep(settle_s)
    first = len(calls)
    time.sleep(window_s)
    keyed = [(at, name, keys_of(name, value)) for at, name, value in calls[first:]]
    return {"calls": [entry for entry in keyed if entry[2] is not None]}


def reads(dronekit: Any, address: str, names: list[str], settle_s: float) -> Found:
    """Measure the nanoseconds that reading each attribute takes while messages arrive."""
    vehicle = _connected(dronekit, address)
    _report_connected()
    vehicle.wait_ready("gps_0", "armed", "mode", "attitude", timeout=30)
    time.sleep(settle_s)
    return {"ns": {name: _nanoseconds(f"vehicle.{name}", vehicle) for name in names}}


def only_import(dronekit: Any) -> Found:
    """Do nothing: the import time is reported in any case."""
    return {}


TASKS: dict[str, Callable[..., Found]] = {
    "connect": connect_ready, "cpu": cpu, "latency": latency, "reads": reads, "import": only_import,
}  # fmt: skip


# --------------------------------------------------------------------------------------- listeners


def _no_listeners(vehicle: Any) -> list[None]:
    return []


def _usual_listeners(vehicle: Any) -> list[None]:
    calls: list[None] = []

    def note(_: Any, name: str, value: Any) -> None:
        calls.append(None)

    _add_typical_listeners(vehicle, note, note)
    return calls


def _every_message(vehicle: Any) -> list[None]:
    calls: list[None] = []

    def note(_: Any, name: str, message: Any) -> None:
        calls.append(None)

    vehicle.add_message_listener("*", note)
    return calls


LISTENERS: dict[str, Callable[[Any], list[None]]] = {
    "none": _no_listeners, "usual": _usual_listeners, "every_message": _every_message,
}  # fmt: skip


def _add_typical_listeners(
    vehicle: Any, on_attribute: Callable[[Any, str, Any], None], on_message: Callable[[Any, str, Any], None]
) -> None:
    vehicle.on_message("HEARTBEAT")(on_message)
    for name in USUAL:
        vehicle.on_attribute(name)(on_attribute)


# ------------------------------------------------------------------------------------------ helpers


def _connected(dronekit: Any, address: str) -> Any:
    print("connecting", flush=True)
    return dronekit.connect(address, wait_ready=["mode"], rate=None)


def _report_connected() -> None:
    print("connected", flush=True)


def _received(vehicle: Any) -> int:
    """Return the number of received frames, from the counters of the library, which does not decode all frames."""
    if hasattr(vehicle, "aio"):
        return sum(
            source.received
            for statistics_ in vehicle.aio.connection.statistics()
            for source in statistics_.sources.values()
        )
    return int(vehicle._master.mav.total_packets_received)


def _nanoseconds(expression: str, vehicle: Any) -> float:
    timer = timeit.Timer(expression, globals={"vehicle": vehicle})
    number, _ = timer.autorange()
    number = max(1, number // 4)
    return statistics.median(timer.repeat(REPEATS, number)) / number * 1e9


if __name__ == "__main__":
    main(sys.argv[1:])
