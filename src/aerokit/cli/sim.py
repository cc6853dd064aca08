"""``aerokit sim``: simulated vehicles for other programs."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from aerokit.cli.interrupt import on_interrupt
from aerokit.cli.places import each_with_its_own, place_of
from aerokit.cli.vehicles import simulated_fleet
from aerokit.links import create_link
from aerokit.sim import SimulatedVehicle, SimulatorServer, Wind
from aerokit.sim.patience import wait_longer

if TYPE_CHECKING:
    import argparse
    from collections.abc import Sequence

    from aerokit.sim.track import Track

__all__ = ["run_sim"]

CLIENTS_USE = {"tcpin": "tcp", "udpout": "udpin", "udpbcast": "udpin", "udpin": "udpout"}
"""What a client writes where the simulator writes this."""


async def run_sim(options: argparse.Namespace) -> int:
    """Serve them until interrupted, or for as long as was asked."""
    vehicles = _fleet(options)
    wait_longer(vehicles, options.speedup, leave=dict(options.parameters))
    tracks = _tracks(vehicles, options.picture)
    server = _server(vehicles, options.addresses, options.speedup)
    stop = asyncio.Event()
    with on_interrupt(stop.set):
        async with server:
            _tell(server, options.speedup)
            with suppress(asyncio.TimeoutError):
                await asyncio.wait_for(stop.wait(), options.duration and options.duration / options.speedup)
    print("stopped")
    if options.picture is not None:
        from aerokit.sim.picture import save_picture

        save_picture(tracks, options.picture)
        print(f"track in {options.picture}")
    return 0


def _fleet(options: argparse.Namespace) -> list[SimulatedVehicle]:
    given: dict[str, Any] = {
        "battery_percent": options.battery,
        "boot_time_s": options.boot_time,
        "signing_key": options.signing_key,
        "wind": None if options.wind is None else Wind(*options.wind),
    }
    return simulated_fleet(
        options.vehicle,
        options.count,
        system_id=options.system_id,
        home=options.home,
        spacing_m=options.spacing,
        seed=options.seed,
        boot_text=True,
        parameters=dict(options.parameters),
        **{name: value for name, value in given.items() if value is not None},
    )


def _tracks(vehicles: Sequence[SimulatedVehicle], picture: str | None) -> list[Track]:
    if picture is None:
        return []
    from aerokit.sim.picture import check_picture
    from aerokit.sim.track import record_track

    check_picture(picture)
    return [record_track(vehicle) for vehicle in vehicles]


def _server(
    vehicles: Sequence[SimulatedVehicle], addresses: Sequence[str], speedup: float
) -> SimulatorServer:
    """A form of addresses gives each vehicle a link of its own; any other address has all of them."""
    links, vehicles_on = [], []
    for address in addresses:
        groups = [[vehicle] for vehicle in vehicles] if each_with_its_own(address) else [list(vehicles)]
        for number, group in enumerate(groups):
            links.append(create_link(place_of(address, number, group[0].system_id)))
            vehicles_on.append(group)
    return SimulatorServer(vehicles, links, speedup=speedup, vehicles_on=vehicles_on)


def _tell(server: SimulatorServer, speedup: float) -> None:
    for address, vehicles in zip(server.addresses, server.vehicles_on, strict=True):
        print(f"{_systems(vehicles)} on {address}, {speedup:g} times real time")
    print(f"try: aerokit demo --connect {_client_address(server.addresses[0])}", flush=True)


def _systems(vehicles: Sequence[SimulatedVehicle]) -> str:
    first, last = vehicles[0].system_id, vehicles[-1].system_id
    return f"system {first}" if first == last else f"systems {first} to {last}"


def _client_address(address: str) -> str:
    """How a client on this machine reaches it; serial ports have another end."""
    scheme, _, place = address.partition(":")
    if scheme == "pty":
        return place
    if scheme not in CLIENTS_USE:
        return "the other end of the serial line"
    return f"{CLIENTS_USE[scheme]}:{place.replace('0.0.0.0', '127.0.0.1')}"
