"""Measures one fleet of many vehicles, which several processes simulate in real time, over UDP.

    python benchmarks/fleet_scale.py                                  # 500 vehicles in 10 networks, 5 processes; 30 s
    python benchmarks/fleet_scale.py --vehicles 20 --processes 2 --networks 2 --seconds 3   # a short check

Each process simulates some of the networks, with hovering copters that send the states of a client at 4 Hz. The figures
are the processor time of all processes, the delay of each simulation behind real time, and the age of positions. They
are written to bench-fleet.json.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import statistics
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from scale import RATES, hovering
from stopwatch import Stopwatch

import aerokit
from aerokit.sim import SimulatorServer
from aerokit.transport import create_link

FIRST_PORT = 14700
MAX_DELAY_S = 0.1
"""Maximum delay of a simulation behind real time."""
WARM_UP_S = 3.0


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print and write the results; with ``--serve``, run one of the simulating processes."""
    options = _parser().parse_args(arguments)
    if options.serve:
        print(json.dumps(asyncio.run(_serve(options.serve, options.vehicles, options.seconds))))
        return 0
    figures = asyncio.run(_measure(options.vehicles, options.processes, options.networks, options.seconds))
    for name, value in figures.items():
        print(f"{name}: {value}")
    options.output.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    return 0


# ----------------------------------------------------------------------------------- one simulator


async def _serve(ports: Sequence[int], vehicles_per_network: int, seconds: float) -> Mapping[str, float]:
    """Simulate a network of vehicles on each port.

    Return the share of a core, the maximum delay of a timer, and the delay of the simulation behind real time.
    """
    networks = []
    vehicles = []
    for _ in ports:
        network = [hovering("copter", system_id) for system_id in range(1, vehicles_per_network + 1)]
        networks.append(network)
        vehicles += network
    links = [create_link(f"udpout:127.0.0.1:{port}") for port in ports]
    timer_delays: list[float] = []
    async with SimulatorServer(vehicles, links, vehicles_on=networks) as server:
        loop = asyncio.get_running_loop()
        stopwatch = Stopwatch()
        simulated_at_start = server.now
        end = loop.time() + seconds
        while loop.time() < end:
            due = loop.time() + 0.05
            await asyncio.sleep(0.05)
            timer_delays.append(loop.time() - due)
        real_s = stopwatch.real_s
        share = stopwatch.cpu_s / real_s
        simulated_s = min(vehicle.now for vehicle in vehicles) - simulated_at_start
    return {"share": share, "latest_s": max(timer_delays), "behind_s": max(0.0, real_s - simulated_s)}


# ------------------------------------------------------------------------------------- the fleet


async def _measure(count: int, processes: int, networks: int, seconds: float) -> dict[str, Any]:
    """Start the simulating processes, and measure one fleet of their vehicles."""
    vehicles_per_network = count // networks
    ports = [FIRST_PORT + number for number in range(networks)]
    duration_s = WARM_UP_S + seconds + 5.0 + 0.02 * count  # opening the fleet takes longer with more vehicles
    children = []
    for number in range(processes):
        children.append(_start_simulator(ports[number::processes], vehicles_per_network, duration_s))
    try:
        fleet_figures = await _measure_fleet(ports, vehicles_per_network, seconds)
        reports = [json.loads(await asyncio.to_thread(_output_of, child)) for child in children]
    finally:
        for child in children:
            child.kill()
            child.wait()
    return {
        "vehicles": vehicles_per_network * networks,
        "processes": processes,
        **fleet_figures,
        "simulators_share": [round(report["share"], 3) for report in reports],
        "simulators_behind_s": round(max(report["behind_s"] for report in reports), 3),
        "in_real_time": all(report["behind_s"] < MAX_DELAY_S for report in reports),
    }


def _start_simulator(ports: Sequence[int], vehicles_per_network: int, seconds: float) -> subprocess.Popen[str]:
    options = ["--vehicles", str(vehicles_per_network), "--seconds", str(seconds), "--serve", *map(str, ports)]
    return subprocess.Popen([sys.executable, __file__, *options], stdout=subprocess.PIPE, text=True)


def _output_of(child: subprocess.Popen[str]) -> str:
    output, _ = child.communicate()
    return output


async def _measure_fleet(ports: Sequence[int], vehicles_per_network: int, seconds: float) -> dict[str, Any]:
    addresses = {f"network{port - FIRST_PORT}": f"udpin:127.0.0.1:{port}" for port in ports}
    count = vehicles_per_network * len(ports)
    opening = Stopwatch()
    async with aerokit.fleet(
        addresses, count=count, timeout=60, rates=RATES, min_distance_m=0.5, on_too_close="report"
    ) as fleet:
        opened_in_s = opening.real_s
        await asyncio.sleep(WARM_UP_S)
        ages: list[float] = []
        stopwatch = Stopwatch()
        for _ in range(max(1, round(2 * seconds))):
            await asyncio.sleep(0.5)
            ages += [vehicle.position.age for vehicle in fleet.vehicles.values()]
        share = stopwatch.cpu_s / stopwatch.real_s
        states = {member.state.value for member in fleet}
    return {
        "opened_in_s": round(opened_in_s, 2),
        "client_share": round(share, 3),
        "position_age_median_s": round(statistics.median(ages), 3),
        "position_age_worst_s": round(max(ages), 3),
        "states": sorted(states),
    }


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--vehicles", type=int, default=500, help="number of vehicles (500)")
    parser.add_argument("--processes", type=int, default=5, help="number of simulating processes (5)")
    parser.add_argument("--networks", type=int, default=10, help="number of networks, each with a UDP port (10)")
    parser.add_argument("--seconds", type=float, default=30.0, help="duration of the measurement (30)")
    parser.add_argument("--serve", type=int, nargs="+", metavar="PORT", help=argparse.SUPPRESS)
    parser.add_argument("--output", type=Path, default=Path("bench-fleet.json"), help="default: bench-fleet.json")
    return parser


if __name__ == "__main__":
    sys.exit(main())
