"""The measured cases, and the rows of their results."""

from __future__ import annotations

import statistics
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import table
from client_classic import READS
from dronekit_runs import Library, run
from table import Row

__all__ = ["Plan", "connect_rows", "cpu_rows", "import_rows", "latency_rows", "read_rows"]

READ_TARGET_NS = 1000.0
"""Target for the time to read an attribute."""
# Delays of the first heartbeat. Vehicles send heartbeats each second, so the time to connect depends on their phase.
CONNECT_PHASES_S = (0.1, 0.3, 0.5, 0.7, 0.9)
SLOW_LINK = 5760.0
"""Bytes per second of a radio with 57,600 baud."""
RATES = ("100", "500", "2000", "max")
"""Messages per second. ArduCopter sends 100 if all streams are requested at 4 Hz, and 500 at 20 Hz."""
WINDOW_S = {"100": 8.0, "500": 5.0, "2000": 4.0, "max": 4.0}
QUICK_S = 0.3
SETTLE_S = 1.0
RATE_WHILE_CONNECTING = 100.0
"""Messages per second while clients connect."""
ATTRIBUTE_OF = {
    "ATTITUDE": "attitude",
    "GLOBAL_POSITION_INT": "location.global_relative_frame",
    "GPS_RAW_INT": "gps_0",
    "SYS_STATUS": "battery",
}

# Maps the name of a library to its measured values, one for each turn.
Values = dict[str, list[float]]


@dataclass(frozen=True)
class Plan:
    """Extent of the measurement."""

    rounds: int
    quick: bool = False
    only: str = ""

    def wants(self, case: str) -> bool:
        """Return True if a case was requested."""
        return self.only in case

    def window(self, seconds: float) -> float:
        """Return the duration of a measurement."""
        return QUICK_S if self.quick else seconds


# ---------------------------------------------------------------------------------------- processor


def cpu_rows(libraries: Sequence[Library], plan: Plan) -> list[Row]:
    """Measure the processor time per message in microseconds. The target is a quarter of DroneKit's."""
    cases = _cpu_cases()
    rows: list[Row] = []
    for listeners, transport, version, rate in cases[::9] if plan.quick else cases:
        case = f"dronekit_cpu_{listeners}_{transport}_v{version}_{rate.replace(' ', '_')}"
        if not plan.wants(case):
            continue
        vehicle = {"transport": transport, "version": version, "rate": RATE_WHILE_CONNECTING}
        task = {
            "task": "cpu",
            "listeners": listeners,
            "settle_s": plan.window(SETTLE_S),
            "window_s": plan.window(WINDOW_S[rate.removesuffix(" evenly")]),
        }
        values = _in_turns(libraries, plan, case, partial(_measure_cpu_us, vehicle, task, rate))
        rows += _rows(libraries, case, values, unit="µs", aim=4.0)
    return rows


def _cpu_cases() -> list[tuple[str, str, int, str]]:
    """Return the cases as listeners, transport, MAVLink version and message rate."""
    cases = []
    for transport in ("udp", "tcp"):
        for version in (2, 1):
            cases += [("usual", transport, version, rate) for rate in RATES]
    cases.append(("usual", "udp", 2, "500 evenly"))
    for listeners in ("none", "every_message"):
        cases += [(listeners, "udp", 2, rate) for rate in ("500", "max")]
    return cases


def _measure_cpu_us(vehicle: dict[str, Any], task: dict[str, Any], rate: str, library: Library, _turn: int) -> float:
    """Return the processor time of each message in microseconds."""
    result = run(library, vehicle, task, rate=rate)
    seconds: float = result["cpu_s"]
    received: int = result["received"]
    return seconds / max(received, 1) * 1e6


# -------------------------------------------------------------------------------------------- reads


def read_rows(libraries: Sequence[Library], plan: Plan) -> list[Row]:
    """Measure the nanoseconds to read each attribute at 50 messages per second. The target is a microsecond."""
    names = [name for name in READS if plan.wants(f"dronekit_read_{name}")]
    if not names:
        return []
    durations_ns: dict[str, Values] = {name: {library.name: [] for library in libraries} for name in names}

    def read(library: Library, _: int) -> float:
        result = run(library, {"rate": 50.0}, {"task": "reads", "names": names, "settle_s": plan.window(SETTLE_S)})
        for name, nanoseconds in result["ns"].items():
            durations_ns[name][library.name].append(nanoseconds)
        return float(max(result["ns"].values()))

    _in_turns(libraries, plan, "dronekit_reads", read)
    rows: list[Row] = []
    for name in names:
        for row in _rows(libraries, f"dronekit_read_{name}", durations_ns[name], unit="ns", aim=1.0):
            rows.append({**row, "aim": round(row["peer"] / READ_TARGET_NS, 3)})
    return rows


# ------------------------------------------------------------------------------------------ latency


def latency_rows(libraries: Sequence[Library], plan: Plan) -> list[Row]:
    """Measure the microseconds from sending a message to calling the listener of its attribute.

    The rows are the median and the 99th percentile of all turns.
    """
    rows: list[Row] = []
    for version in (2, 1):
        for rate, window_s in (("50", 30.0), ("500", 10.0), ("500 evenly", 10.0)):
            case = f"dronekit_latency_v{version}_{rate.replace(' ', '_')}"
            is_left_out = plan.quick and (version, rate) != (2, "500")  # A quick run measures one case.
            if not plan.wants(case) or is_left_out:
                continue
            vehicle = {"rate": RATE_WHILE_CONNECTING, "version": version}
            task = {"task": "latency", "settle_s": plan.window(SETTLE_S), "window_s": plan.window(window_s)}
            samples: Values = {library.name: [] for library in libraries}
            _in_turns(libraries, plan, case, partial(_measure_latency_us, vehicle, task, rate, samples))
            for share, name in ((0.5, "median"), (0.99, "p99")):
                values = {library: [table.quantile(delays, share)] for library, delays in samples.items()}
                rows += _rows(libraries, f"{case}_{name}", values, unit="µs", aim=1.0)
    return rows


def _measure_latency_us(
    vehicle: dict[str, Any], task: dict[str, Any], rate: str, samples: Values, library: Library, _turn: int
) -> float:
    """Add the delays of all messages to ``samples``, and return their median."""
    delays = _delays_us(run(library, vehicle, task, rate=rate))
    samples[library.name] += delays
    return float(statistics.median(delays))


def _delays_us(result: dict[str, Any]) -> list[float]:
    """Return the time from sending each message to the call of its listener, in microseconds."""
    sent_at = {}  # maps attributes and round numbers to times in ns
    for message_name, number, sent_ns in result["stamps"]:
        if message_name in ATTRIBUTE_OF:
            sent_at[ATTRIBUTE_OF[message_name], number] = sent_ns
    delays = []
    for called_ns, attribute, number in result["calls"]:
        if (attribute, number) in sent_at:
            delays.append((called_ns - sent_at[attribute, number]) / 1000)
    if not delays:
        raise RuntimeError("no listener was called")
    return delays


# ------------------------------------------------------------------------------------------ connect


def connect_rows(libraries: Sequence[Library], plan: Plan) -> list[Row]:
    """Measure the seconds of ``connect(wait_ready=True)`` with 1,350 parameters. The target is a third of DroneKit's.

    The vehicle sends its first heartbeat 0.1 to 0.9 s after the call, with the same delays for all libraries.
    """
    cases: list[tuple[str, dict[str, Any]]] = []
    for method, has_ftp in (("mavftp", True), ("list", False)):
        cases.append((f"{method}_0ms", {"has_ftp": has_ftp, "delay": 0.0}))
        cases.append((f"{method}_10ms", {"has_ftp": has_ftp, "delay": 0.01}))
        cases.append((f"{method}_57600_baud", {"has_ftp": has_ftp, "delay": 0.02, "bandwidth": SLOW_LINK}))
    rows: list[Row] = []
    for name, options in cases[::2] if plan.quick else cases:
        case = f"dronekit_connect_{name}"
        if not plan.wants(case):
            continue
        vehicle = {"parameters": 50 if plan.quick else 1350, **options}
        is_slow = "bandwidth" in options
        case_plan = Plan(rounds=1, quick=plan.quick) if is_slow else plan
        values = _in_turns(libraries, case_plan, case, partial(_measure_connect_s, vehicle))
        rows += _rows(libraries, case, values, unit="s", aim=3.0, decimals=3)
    return rows


def _measure_connect_s(vehicle: dict[str, Any], library: Library, turn: int) -> float:
    heartbeat_after_s = CONNECT_PHASES_S[turn % len(CONNECT_PHASES_S)]
    result = run(library, {**vehicle, "heartbeat_after": heartbeat_after_s}, {"task": "connect"})
    if result["parameters"] != vehicle["parameters"]:
        raise RuntimeError(f"{library.name} has {result['parameters']} parameters")
    return float(result["seconds"])


def import_rows(libraries: Sequence[Library], plan: Plan) -> list[Row]:
    """Measure the milliseconds that the import takes, without the start of the interpreter."""
    if not plan.wants("dronekit_import"):
        return []
    values = _in_turns(
        libraries,
        plan,
        "dronekit_import",
        lambda library, _: run(library, None, {"task": "import"})["import_s"] * 1000,
    )
    return _rows(libraries, "dronekit_import", values, unit="ms", aim=1.0)


# -------------------------------------------------------------------------------------------- turns


def _in_turns(libraries: Sequence[Library], plan: Plan, case: str, measure: Callable[[Library, int], float]) -> Values:
    """Return the results of ``measure(library, turn)``."""
    values: Values = {library.name: [] for library in libraries}
    order = list(libraries)
    for turn in range(plan.rounds):
        for library in order:
            values[library.name].append(measure(library, turn))
        order.append(order.pop(0))
    medians = ", ".join(f"{name} {statistics.median(measured):.4g}" for name, measured in values.items())
    print(f"{case}: {medians}", file=sys.stderr, flush=True)
    return values


def _rows(
    libraries: Sequence[Library], case: str, values: Values, *, unit: str, aim: float, decimals: int | None = None
) -> list[Row]:
    """Return a row for each peer. ``decimals`` replaces the usual number of decimals."""
    own = statistics.median(values["aerokit"])
    rows = []
    for library in libraries:
        if library.name == "aerokit":
            continue
        peer = statistics.median(values[library.name])
        name = case if library.name == "dronekit" else f"{case}_vs_{library.name}"
        row = table.row(name, own, peer, library.title, unit=unit, ratio=peer / own, aim=aim)
        if decimals is not None:
            row["aerokit"] = round(own, decimals)
            row["peer"] = round(peer, decimals)
        rows.append(row)
    return rows
