"""Share of a core for a hundred simulated vehicles, and duration of a flight on virtual time.

    python benchmarks/scale.py                        # everything, four minutes; writes bench-scale.json
    python benchmarks/scale.py copter_hundred         # these only
    python benchmarks/scale.py --quick                # a short check that it runs; the figures mean little

- ``…_hundred``: processor time of 100 hovering vehicles and their clients as a share of one core, and the part of the
  vehicles. All are in one process and on one link in memory, in real time, with the states of a client at 4 Hz.
- ``…_flight``: wall time of a flight of ten virtual minutes, including the client: arming, take-off, mission, landing.
- ``clients``: 1 to 500 clients without simulated vehicles, see ``client_scale.py``.
"""

from __future__ import annotations

import argparse
import asyncio
import math
import statistics
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import client_scale
import table
from stopwatch import Stopwatch
from table import Row, row

import aerokit
from aerokit import messages
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import MavAutopilot, MavCmd, MavModeFlag, MavType
from aerokit.mavlink.message import Message
from aerokit.missions import Mission, land, take_off, waypoint
from aerokit.sim import SimulatedCopter, SimulatedPx4, SimulatedVehicle, SimulatorServer, simulated_link
from aerokit.testing import run_virtual
from aerokit.transport import memory_link_pair
from aerokit.vehicle.state.states import DEFAULT_RATES_HZ

NAMES = ("copter_hundred", "px4_hundred", "copter_flight", "px4_flight", "clients")
RATES: Mapping[type[Message], float] = {getattr(messages, name): 4.0 for name in DEFAULT_RATES_HZ}
HEARTBEAT = messages.Heartbeat(
    type=MavType.GCS, autopilot=MavAutopilot.INVALID, base_mode=0, custom_mode=0, system_status=4, mavlink_version=3
)
COPTER_GUIDED = 4
"""Number of the mode GUIDED of ArduCopter."""
FLIGHT_S = 600.0
LEG_M = 100.0


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure the requested rows, print and write the results."""
    parser = _parser()
    options = parser.parse_args(arguments)
    wanted = options.names or NAMES
    if not set(wanted) <= set(NAMES):
        parser.error(f"the names are {', '.join(NAMES)}")
    rows: list[Row] = []
    for name in wanted:
        rows += _measure(name, options.quick)
    print(table.printed(rows))
    for measured_row in rows:
        print(f"{measured_row['name']}: {measured_row['note']}")
    missed = [measured_row["name"] for measured_row in rows if table.is_missed(measured_row)]
    print(f"MISSED: {', '.join(missed)}" if missed else "every aim is met")
    table.write(rows, options.output)
    return 0


def _measure(name: str, quick: bool) -> list[Row]:
    kind, _, measurement = name.partition("_")
    print(f"measuring {name} …", file=sys.stderr, flush=True)
    if measurement == "hundred":
        return [_hundred(name, kind, count=5 if quick else 100, rounds=1 if quick else 3)]
    if measurement == "flight":
        return [_flight(name, kind, flight_s=FLIGHT_S / 10 if quick else FLIGHT_S, rounds=1 if quick else 5)]
    return client_scale.rows((1, 3), turns=2, rounds=1) if quick else client_scale.rows()


# ------------------------------------------------------------------------------- a hundred of them


def _hundred(name: str, kind: str, count: int, rounds: int) -> Row:
    window_s = 5.0 if count == 100 else 0.5
    shares = asyncio.run(_shares(kind, count, rounds, window_s))
    total_percent = 100 * statistics.median(total for total, _ in shares)
    vehicles_percent = 100 * statistics.median(of_vehicles for _, of_vehicles in shares)
    clients_percent = total_percent - vehicles_percent
    measured_row = row(name, total_percent, 100.0, "one core", unit="% of a core", ratio=100.0 / total_percent, aim=1.0)
    note = f"the vehicles took {vehicles_percent:.1f} %, their {count} clients and the loop {clients_percent:.1f} %"
    return {**measured_row, "vehicles": round(vehicles_percent, 1), "note": note}


async def _shares(kind: str, count: int, rounds: int, window_s: float) -> list[tuple[float, float]]:
    """Return the share of a core for several windows of time: in total, and of the vehicles only."""
    near, far = memory_link_pair()
    server = _MeasuredServer([hovering(kind, number) for number in range(1, count + 1)], far)
    async with AsyncExitStack() as stack:
        await stack.enter_async_context(server)
        connection = await stack.enter_async_context(aerokit.open_connection(near))
        clients = [
            await stack.enter_async_context(aerokit.connect(connection, system_id=number, rates=RATES))
            for number in range(1, count + 1)
        ]
        await asyncio.sleep(window_s)
        shares = [await _share(server, window_s) for _ in range(rounds)]
        if not all(client.position.is_known and client.armed.value for client in clients):
            raise AssertionError("a client does not know the position of its vehicle, or the vehicle is disarmed")
    return shares


async def _share(server: _MeasuredServer, window_s: float) -> tuple[float, float]:
    vehicles_before_s = server.spent_s
    stopwatch = Stopwatch()
    await asyncio.sleep(window_s)
    real_s = stopwatch.real_s
    vehicles_s = server.spent_s - vehicles_before_s
    return stopwatch.cpu_s / real_s, vehicles_s / real_s


class _MeasuredServer(SimulatorServer):
    """Measures the processor time of the vehicles."""

    spent_s = 0.0

    def _run(self, now: float) -> None:
        started_at = time.thread_time()
        super()._run(now)
        self.spent_s += time.thread_time() - started_at

    def on_bytes(self, data: bytes, peer: Any, port: Any) -> None:
        started_at = time.thread_time()
        super().on_bytes(data, peer, port)
        self.spent_s += time.thread_time() - started_at


def hovering(kind: str, system_id: int) -> SimulatedVehicle:
    """Create a vehicle that has already taken off."""
    vehicle = _create(kind, system_id)
    encoder = FrameEncoder(255, 190)
    # PX4 expects altitudes above mean sea level; home is at 489 m.
    height_m = 10.0 if kind == "copter" else 500.0

    def send_command(command: int, **params: float) -> None:
        all_params = dict.fromkeys((f"param{number}" for number in range(1, 8)), 0.0) | params
        message = messages.CommandLong(
            target_system=system_id, target_component=1, command=command, confirmation=0, **all_params
        )
        vehicle.receive(encoder.encode(message), vehicle.now)

    vehicle.step(2.0)
    vehicle.receive(encoder.encode(HEARTBEAT), 3.0)  # PX4 does not arm without a ground station
    if kind == "copter":
        send_command(MavCmd.DO_SET_MODE, param1=MavModeFlag.CUSTOM_MODE_ENABLED, param2=COPTER_GUIDED)
    send_command(MavCmd.COMPONENT_ARM_DISARM, param1=1)
    send_command(MavCmd.NAV_TAKEOFF, param4=math.nan, param7=height_m)
    for step in range(1, 18):
        vehicle.receive(encoder.encode(HEARTBEAT), 3.0 + step)
    vehicle.take_outbox()
    return vehicle


def _create(kind: str, system_id: int = 1) -> SimulatedVehicle:
    if kind == "copter":
        return SimulatedCopter(system_id=system_id, seed=system_id, boot_time_s=0.0)
    return SimulatedPx4(system_id=system_id, seed=system_id, boot_time_s=1.0, fast_rate_hz=4.0)


# ---------------------------------------------------------------------------------------- a flight


def _flight(name: str, kind: str, flight_s: float, rounds: int) -> Row:
    durations_ms = []
    flown_s = 0.0
    for _ in range(rounds):
        stopwatch = Stopwatch()
        flown_s = run_virtual(_fly(kind, flight_s))
        durations_ms.append(1000 * stopwatch.real_s * flight_s / flown_s)
    duration_ms = statistics.median(durations_ms)
    measured_row = row(name, duration_ms, 1000.0, "one second", unit="ms", ratio=1000.0 / duration_ms, aim=1.0)
    return {**measured_row, "note": f"{flown_s:.0f} s were flown each time; the figure is for {flight_s:.0f} s"}


async def _fly(kind: str, flight_s: float) -> float:
    """Fly back and forth, and land. Return the simulated duration in seconds."""
    loop = asyncio.get_running_loop()
    async with simulated_link(_create(kind)) as link, aerokit.connect(link) as vehicle:
        await vehicle.wait_ready()
        await vehicle.mission.upload(_mission(vehicle.position.value, kind, flight_s))
        await vehicle.arm()
        await vehicle.mission.start()
        await vehicle.mission.wait_finished(timeout=2 * flight_s)
        return loop.time()


def _mission(start: aerokit.Position, kind: str, flight_s: float) -> Mission:
    far_end = start.offset(north_m=LEG_M)
    speed_m_s = 10.0 if kind == "copter" else 5.0
    legs = max(2, int((flight_s - 40.0) / (LEG_M / speed_m_s + 5.0)))
    ends = [far_end if leg % 2 == 0 else start for leg in range(legs)]
    return Mission([
        take_off(start.latitude_deg, start.longitude_deg, altitude_relative_m=20),
        *(waypoint(end.latitude_deg, end.longitude_deg, altitude_relative_m=20) for end in ends),
        land(start.latitude_deg, start.longitude_deg, altitude_relative_m=0),
    ])  # fmt: skip


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(NAMES))
    parser.add_argument("--quick", action="store_true", help="short measurements, to check that everything runs")
    parser.add_argument("--output", type=Path, default=Path("bench-scale.json"), help="default: bench-scale.json")
    return parser


if __name__ == "__main__":
    sys.exit(main())
