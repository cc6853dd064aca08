"""The measured cases, and the rows of their results."""

from __future__ import annotations

import statistics
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import table
from client_classic import READS
from dronekit_runs import Library, run
from table import Row

__all__ = ["Plan", "connect_rows", "cpu_rows", "import_rows", "latency_rows", "read_rows"]

MIN_NS = 1000.0
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
BEFORE_IT_RUNS = 100.0
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
    cases = [
        ("usual", transport, version, rate) for transport in ("udp", "tcp") for version in (2, 1) for rate in RATES
    ]
    cases += [("usual", "udp", 2, "500 evenly")]
    cases += [(listeners, "udp", 2, rate) for listeners in ("none", "every_message") for rate in ("500", "max")]
    rows: list[Row] = []
    for listeners, transport, version, rate in cases[::9] if plan.quick else cases:
        case = f"dronekit_cpu_{listeners}_{transport}_v{version}_{rate.replace(' ', '_')}"
        if not plan.wants(case):
            continue
        vehicle = {"transport": transport, "version": version, "rate": BEFORE_IT_RUNS}
        task = {
            "task": "cpu",
            "listeners": listeners,
            "settle_s": plan.window(SETTLE_S),
            "window_s": plan.window(WINDOW_S[rate.split()[0]]),
        }

        def measure(library: Library, _: int, vehicle: Any = vehicle, task: Any = task, rate: str = rate) -> float:
            return _microseconds(run(library, vehicle, task, rate=rate))

        values = _in_turns(libraries, plan, case, measure)
        rows += _rows(libraries, case, values, unit="µs", aim=4.0)
    return rows


def _microseconds(found: dict[str, Any]) -> float:
    seconds: float = found["cpu_s"]
    received: int = found["received"]
    return seconds / max(received, 1) * 1e6


# -------------------------------------------------------------------------------------------- reads


def read_rows(libraries: Sequence[Library], plan: Plan) -> list[Row]:
    """Measure the nanoseconds to read each attribute at 50 messages per second. The target is a microsecond."""
    names = [name for name in READS if plan.wants(f"dronekit_read_{name}")]
    if not names:
        return []
    taken: dict[str, Values] = {name: {library.name: [] for library in libraries} for name in names}

    def read(library: Library, _: int) -> float:
        found = run(library, {"rate": 50.0}, {"task": "reads", "names": names, "settle_s": plan.window(SETTLE_S)})
        for name, nanoseconds in found["ns"].items():
            taken[name][library.name].append(nanoseconds)
        return float(max(found["ns"].values()))

    _in_turns(libraries, plan, "dronekit_reads", read)
    rows: list[Row] = []
    for name in names:
        for row in _rows(libraries, f"dronekit_read_{name}", taken[name], unit="ns", aim=1.0):
            rows.append({**row, "aim": round(row["peer"] / MIN_NS, 3)})
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
            if not plan.wants(case) or (plan.quick and (version, rate) != (2, "500")):
                continue
            vehicle = {"rate": BEFORE_IT_RUNS, "version": version}
            task = {"task": "latency", "settle_s": plan.window(SETTLE_S), "window_s": plan.window(window_s)}
            samples: Values = {library.name: [] for library in libraries}

            def measure(
                library: Library,
                _: int,
                vehicle: Any = vehicle,
                task: Any = task,
                rate: str = rate,
                samples: Any = samples,
            ) -> float:
                found = _delays(run(library, vehicle, task, rate=rate))
                samples[library.name] += found
                return float(statistics.median(found))

            _in_turns(libraries, plan, case, measure)
            for share, name in ((0.5, "median"), (0.99, "p99")):
                values = {who: [table.quantile(found, share)] for who, found in samples.items()}
                rows += _rows(libraries, f"{case}_{name}", values, unit="µs", aim=1.0)
    return rows


def _delays(found: dict[str, Any]) -> list[float]:
    sent = {(ATTRIBUTE_OF[kind], number): at for kind, number, at in found["stamps"] if kind in ATTRIBUTE_OF}
    delays = [(at - sent[name, number]) / 1000 for at, name, number in found["calls"] if (name, number) in sent]
    if not delays:
        raise RuntimeError("no listener was called")
    return delays


# ------------------------------------------------------------------------------------------ connect


def connect_rows(libraries: Sequence[Library], plan: Plan) -> list[Row]:
    """Measure the seconds of ``connect(wait_ready=True)`` with 1,350 parameters. The target is a third of DroneKit's.

    The vehicle sends its first heartbeat 0.1 to 0.9 s after the call, with the same delays for all libraries.
    """
    cases: list[tuple[str, dict[str, Any]]] = [
        (f"{'mavftp' if has_ftp else 'list'}_{delay_ms}ms", {"has_ftp": has_ftp, "delay": delay_ms / 1000})
        for has_ftp in (True, False)
        for delay_ms in (0, 10)
    ]
    cases += [
        (
            f"{'mavftp' if has_ftp else 'list'}_57600_baud",
            {"has_ftp": has_ftp, "delay": 0.02, "bandwidth": SLOW_LINK},
        )
        for has_ftp in (True, False)
    ]
    rows: list[Row] = []
    for name, options in cases[::2] if plan.quick else cases:
        case = f"dronekit_connect_{name}"
        if not plan.wants(case):
            continue
        vehicle = {"parameters": 50 if plan.quick else 1350, **options}
        slow = "bandwidth" in options

        def measure(library: Library, turn: int, vehicle: Any = vehicle) -> float:
            phase = CONNECT_PHASES_S[turn % len(CONNECT_PHASES_S)]
            found = run(library, {**vehicle, "heartbeat_after": phase}, {"task": "connect"})
            if found["parameters"] != vehicle["parameters"]:
                raise RuntimeError(f"{library.name} has {found['parameters']} parameters")
            return float(found["seconds"])

        values = _in_turns(libraries, Plan(1, plan.quick) if slow else plan, case, measure)
        rows += _rows(libraries, case, values, unit="s", aim=3.0, scale=1000)
    return rows


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
    values: Values = {library.name: [] for library in libraries}
    order = list(libraries)
    for turn in range(plan.rounds):
        for library in order:
            values[library.name].append(measure(library, turn))
        order.append(order.pop(0))
    medians = ", ".join(f"{name} {statistics.median(found):.4g}" for name, found in values.items())
    print(f"{case}: {medians}", file=sys.stderr, flush=True)
    return values


def _rows(
    libraries: Sequence[Library], case: str, values: Values, *, unit: str, aim: float, scale: float = 1.0
) -> list[Row]:
    """Return a row for each peer."""
    own = statistics.median(values["aerokit"])
    rows = []
    for library in libraries:
        if library.name != "aerokit":
            peer = statistics.median(values[library.name])
            found = table.row(
                f"{case}_vs_{library.name}" if library.name != "dronekit" else case,
                own, peer, library.title, unit=unit, ratio=peer / own, aim=aim,
            )  # fmt: skip
            if scale > 1:
                found["aerokit"], found["peer"] = round(own, 3), round(peer, 3)
            rows.append(found)
    return rows
