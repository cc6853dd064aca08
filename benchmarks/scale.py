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
import statistics
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import client_scale
import table
from table import Row, row

import aerokit
from aerokit import messages
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import MavCmd
from aerokit.mavlink.message import Message
from aerokit.missions import Mission, land, take_off, waypoint
from aerokit.sim import SimulatedCopter, SimulatedPx4, SimulatedVehicle, SimulatorServer, simulated_link
from aerokit.testing import run_virtual
from aerokit.transport import memory_link_pair
from aerokit.vehicle.state.states import DEFAULT_RATES_HZ

NAMES = ("copter_hundred", "px4_hundred", "copter_flight", "px4_flight", "clients")
RATES: Mapping[type[Message], float] = {getattr(messages, name): 4.0 for name in DEFAULT_RATES_HZ}
HEARTBEAT = messages.Heartbeat(6, 8, 0, 0, 4, 3)
FLIGHT_S = 600.0
LEG_M = 100.0


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure the requested rows, print and write the results."""
    parser = _parser()
    options = parser.parse_args(arguments)
    wanted = options.names or NAMES
    if not set(wanted) <= set(NAMES):
        parser.error(f"the names are {', '.join(NAMES)}")
    rows = [measured_row for name in wanted for measured_row in _measured(name, options.quick)]
    print(table.printed(rows))
    for measured_row in rows:
        print(f"{measured_row['name']}: {measured_row['note']}")
    missed = [measured_row["name"] for measured_row in rows if table.is_missed(measured_row)]
    print(f"MISSED: {', '.join(missed)}" if missed else "every aim is met")
    table.write(rows, options.output)
    return 0


def _measured(name: str, quick: bool) -> list[Row]:
    kind, _, what = name.partition("_")
    print(f"measuring {name} …", file=sys.stderr, flush=True)
    if what == "hundred":
        return [_hundred(name, kind, 5 if quick else 100, 1 if quick else 3)]
    if what == "flight":
        return [_flight(name, kind, FLIGHT_S / 10 if quick else FLIGHT_S, 1 if quick else 5)]
    return client_scale.rows((1, 3), turns=2, rounds=1) if quick else client_scale.rows()


# ------------------------------------------------------------------------------- a hundred of them


def _hundred(name: str, kind: str, count: int, rounds: int) -> Row:
    window_s = 5.0 if count == 100 else 0.5
    shares = asyncio.run(_shares(kind, count, rounds, window_s))
    both, vehicles = (100 * statistics.median(share) for share in zip(*shares, strict=True))
    found = row(name, both, 100.0, "one core", unit="% of a core", ratio=100.0 / both, aim=1.0)
    note = f"the vehicles took {vehicles:.1f} %, their {count} clients and the loop {both - vehicles:.1f} %"
    return {**found, "vehicles": round(vehicles, 1), "note": note}


async def _shares(kind: str, count: int, rounds: int, window_s: float) -> list[tuple[float, float]]:
    """Return processor time per second, in total and of the vehicles, for several windows of time."""
    near, far = memory_link_pair()
    server = _MeasuredServer([_hovering(kind, number) for number in range(1, count + 1)], far)
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
    wall, both, vehicles = time.perf_counter(), time.process_time(), server.spent_s
    await asyncio.sleep(window_s)
    wall, both = time.perf_counter() - wall, time.process_time() - both
    return both / wall, (server.spent_s - vehicles) / wall


class _MeasuredServer(SimulatorServer):
    """Measures the processor time of the vehicles."""

    spent_s = 0.0

    def _run(self, now: float) -> None:
        started = time.thread_time()
        super()._run(now)
        self.spent_s += time.thread_time() - started

    def on_bytes(self, data: bytes, peer: Any, port: Any) -> None:
        started = time.thread_time()
        super().on_bytes(data, peer, port)
        self.spent_s += time.thread_time() - started


def _hovering(kind: str, system_id: int) -> SimulatedVehicle:
    """Create a vehicle that has already taken off."""
    vehicle = _made(kind, system_id)
    target = (system_id, 1)
    encoder = FrameEncoder(255, 190)
    # PX4 expects altitudes above mean sea level; home is at 489 m.
    height_m = 10.0 if kind == "copter" else 500.0

    def order(command: int, *params: float) -> None:
        numbers = (*params, *(0.0,) * (7 - len(params)))
        vehicle.receive(encoder.encode(messages.CommandLong(*target, command, 0, *numbers)), vehicle.now)

    vehicle.step(2.0)
    vehicle.receive(encoder.encode(HEARTBEAT), 3.0)  # PX4 does not arm without a ground station
    if kind == "copter":
        order(MavCmd.DO_SET_MODE, 1, 4)
    order(MavCmd.COMPONENT_ARM_DISARM, 1)
    order(MavCmd.NAV_TAKEOFF, 0, 0, 0, float("nan"), 0, 0, height_m)
    for step in range(1, 18):
        vehicle.receive(encoder.encode(HEARTBEAT), 3.0 + step)
    vehicle.take_outbox()
    return vehicle


def _made(kind: str, system_id: int = 1) -> SimulatedVehicle:
    if kind == "copter":
        return SimulatedCopter(system_id=system_id, seed=system_id, boot_time_s=0.0)
    return SimulatedPx4(system_id=system_id, seed=system_id, boot_time_s=1.0, fast_rate_hz=4.0)


# ---------------------------------------------------------------------------------------- a flight


def _flight(name: str, kind: str, flight_s: float, rounds: int) -> Row:
    took, flown = [], 0.0
    for _ in range(rounds):
        started = time.perf_counter()
        flown = run_virtual(_fly(kind, flight_s))
        took.append(1000 * (time.perf_counter() - started) * flight_s / flown)
    wall = statistics.median(took)
    found = row(name, wall, 1000.0, "one second", unit="ms", ratio=1000.0 / wall, aim=1.0)
    return {**found, "note": f"{flown:.0f} s were flown each time; the figure is for {flight_s:.0f} s"}


async def _fly(kind: str, flight_s: float) -> float:
    """Fly back and forth, and land. Return the simulated duration in seconds."""
    loop = asyncio.get_running_loop()
    async with simulated_link(_made(kind)) as link, aerokit.connect(link) as vehicle:
        await vehicle.wait_ready()
        await vehicle.mission.upload(_mission(vehicle.position.value, kind, flight_s))
        await vehicle.arm()
        await vehicle.mission.start()
        await vehicle.mission.wait_finished(timeout=2 * flight_s)
        return loop.time()


def _mission(start: aerokit.Position, kind: str, flight_s: float) -> Mission:
    there = start.offset(north_m=LEG_M)
    speed_m_s = 10.0 if kind == "copter" else 5.0
    legs = max(2, int((flight_s - 40.0) / (LEG_M / speed_m_s + 5.0)))
    ends = [there if leg % 2 == 0 else start for leg in range(legs)]
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
