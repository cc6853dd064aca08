"""``aerokit sim``: simulated vehicles for other programs."""

from __future__ import annotations

import asyncio
import inspect
import shlex
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from aerokit.apps.cli.arguments import (
    EACH_ITS_OWN,
    add_vehicle_kind,
    address_or_form,
    count,
    each_with_its_own,
    home,
    number,
    parameter,
    picture,
    place_of,
    system_id,
    wind,
)
from aerokit.apps.cli.completers import assignments, offer
from aerokit.apps.cli.output import add_json, tell
from aerokit.apps.cli.terminal import on_interrupt
from aerokit.apps.cli.vehicle_command import add_signing_key
from aerokit.sim import SimulatedVehicle, SimulatorServer, Wind
from aerokit.sim.kinds import wait_longer
from aerokit.sim.local_frame import HOME
from aerokit.transport import create_link
from aerokit.transport.address import parse_address

if TYPE_CHECKING:
    import argparse
    from collections.abc import Sequence

    from aerokit.sim.track import Track


def simulated_vehicle(name: str, **options: Any) -> SimulatedVehicle:
    """A vehicle of a kind of `aerokit.sim.kinds`, just switched on; ``options`` are its class's.

    InvalidArgument when it has no such option or parameter. ``boot_text`` is for those that have one.
    """
    from aerokit.errors import InvalidArgument
    from aerokit.sim.kinds import kind_class, simulated

    taken = _options_of(kind_class(name))
    if "boot_text" not in taken:
        options.pop("boot_text", None)
    for option in options:
        if option not in taken:
            raise InvalidArgument(f"the simulated {name} has no {option}")
    return simulated(name, **options)


def simulated_fleet(
    name: str,
    count: int,
    *,
    system_id: int = 1,
    home: tuple[float, float, float] | None = None,
    spacing_m: float = 5.0,
    seed: int = 0,
    **options: Any,
) -> list[SimulatedVehicle]:
    """Vehicles side by side eastwards from ``home``, or `aerokit.sim.HOME`; system ids and seeds count up.

    The name of a .tlog file gives the one vehicle of that recording, to which nothing else applies.
    """
    from aerokit.errors import InvalidArgument
    from aerokit.sim.local_frame import HOME, GlobalPoint, LocalFrame

    if name.endswith(".tlog"):
        return [_recorded(name, count)]
    if system_id + count - 1 > 255:
        raise InvalidArgument(f"{count} vehicles from system id {system_id} on: the last would be above 255")
    home = home or HOME
    frame = LocalFrame(GlobalPoint(round(home[0] * 1e7), round(home[1] * 1e7), home[2]))
    places = [frame.to_global(0.0, number * spacing_m, 0.0) for number in range(count)]
    return [
        simulated_vehicle(
            name,
            home=(place.latitude_e7 / 1e7, place.longitude_e7 / 1e7, home[2]),
            system_id=system_id + number,
            seed=seed + number,
            **options,
        )
        for number, place in enumerate(places)
    ]


def _recorded(path: str, count: int) -> SimulatedVehicle:
    from aerokit.errors import InvalidArgument
    from aerokit.sim.recorded import RecordedVehicle

    if count != 1:
        raise InvalidArgument(f"{path} is one vehicle; count = {count}")
    return RecordedVehicle(path)


def _options_of(kind: type) -> set[str]:
    """What its constructor takes, with what it passes on to those of its bases."""
    names: set[str] = set()
    for cls in kind.__mro__:
        if "__init__" not in vars(cls):
            continue
        parameters = inspect.signature(vars(cls)["__init__"]).parameters.values()
        names |= {parameter.name for parameter in parameters}
        if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
            break
    return names


CLIENTS_USE = {"tcpin": "tcp", "udpout": "udpin", "udpbcast": "udpin", "udpin": "udpout", "zenohin": "zenoh"}
"""What a client writes where the simulator writes this."""


def add_arguments(command: argparse.ArgumentParser) -> None:
    """The arguments of the command."""
    command.set_defaults(run=run_sim)
    kinds = "copter, plane, rover, sub (ArduPilot), px4, px4_plane; or a recording, flight.tlog (copter)"
    add_vehicle_kind(command, kinds)
    command.add_argument(
        "addresses",
        nargs="*",
        type=address_or_form,
        default=[EACH_ITS_OWN],
        metavar="ADDRESS",
        help="where to serve them, one or several: udpout:127.0.0.1:14550, udpin:0.0.0.0:14550, tcpin:0.0.0.0:5760,"
        " /dev/ttyUSB0,57600, pty (a pseudo-terminal), pty:/tmp/ttyV0. All vehicles are on each address; but a form"
        " gives each its own: pty:/tmp/ttyV{n}, udpout:127.0.0.1:{14550+n}; n counts from 0, id is the system id"
        f" ({EACH_ITS_OWN})",
    )
    command.add_argument("--count", type=count, default=1, metavar="N", help="so many, 1 to 250 (1)")
    command.add_argument(
        "--speedup", type=number(0.1, 100), default=1.0, metavar="X", help="times real time (1)"
    )
    command.add_argument(
        "--system-id", type=system_id, default=1, metavar="ID", help="MAVLink system id of the first (1)"
    )
    command.add_argument(
        "--home",
        type=home,
        default=HOME,
        metavar="LAT,LON,ALT",
        help=f"of the first, degrees and metres above the sea ({','.join(map(str, HOME))})",
    )
    command.add_argument(
        "--spacing", type=number(0, 1000), default=5.0, metavar="M", help="metres between them, eastwards (5)"
    )
    command.add_argument("--seed", type=int, default=0, help="of the noise of the first (0)")
    _add_conditions(command)


def _add_conditions(command: argparse.ArgumentParser) -> None:
    parameters = command.add_argument(
        "--parameter",
        action="append",
        type=parameter,
        default=[],
        dest="parameters",
        metavar="NAME=VALUE",
        help="other than its default, several times if need be: MNT1_TYPE=1 fits a gimbal to the copter",
    )
    offer(parameters, assignments)
    command.add_argument(
        "--wind",
        type=wind,
        metavar="NORTH,EAST[,GUSTS]",
        help="where the air goes in m/s, and how much it changes: -3,0 (no wind)",
    )
    command.add_argument(
        "--battery", type=number(0, 100), metavar="PERCENT", help="charge at the start (100)"
    )
    command.add_argument(
        "--boot-time", type=number(0, 600), metavar="S", help="simulated seconds until it is ready to arm"
    )
    add_signing_key(command, "has been set up on them before; ArduPilot's first port needs no signatures")
    command.add_argument(
        "--duration",
        type=number(0.1, 1e6),
        metavar="S",
        help="simulated seconds, then it ends (until Ctrl-C)",
    )
    command.add_argument(
        "--picture",
        type=picture,
        metavar="FILE",
        help="of the true tracks, at the end: .svg, or .png with Pillow",
    )
    add_json(command)


async def run_sim(options: argparse.Namespace) -> int:
    """Serve them until interrupted, or for as long as was asked."""
    vehicles = _fleet(options)
    wait_longer(vehicles, options.speedup, leave=dict(options.parameters))
    tracks = _tracks(vehicles, options.picture)
    server = _server(vehicles, options.addresses, options.speedup)
    stop = asyncio.Event()
    with on_interrupt(stop.set):
        async with server:
            _tell(server, options)
            with suppress(asyncio.TimeoutError):
                await asyncio.wait_for(stop.wait(), options.duration and options.duration / options.speedup)
    tell(options, "stopped", {}, "stopped")
    if options.picture is not None:
        from aerokit.sim.picture import save_picture

        save_picture(tracks, options.picture)
        record = {"file": options.picture, "what": "track", "count": len(tracks)}
        tell(options, "saved", record, f"track in {options.picture}")
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
        for place, group in enumerate(groups):
            links.append(create_link(place_of(address, place, group[0].system_id)))
            vehicles_on.append(group)
    return SimulatorServer(vehicles, links, speedup=speedup, vehicles_on=vehicles_on)


def _tell(server: SimulatorServer, options: argparse.Namespace) -> None:
    for address, vehicles in zip(server.addresses, server.vehicles_on, strict=True):
        record = {
            "system_ids": [vehicle.system_id for vehicle in vehicles],
            "address": address,
            "speedup": options.speedup,
        }
        text = f"{_systems(vehicles)} on {address}, {options.speedup:g} times real time"
        tell(options, "simulated", record, text)
    if not options.json:
        print(
            f"try: aerokit demo --connect {_client_address(server.addresses[0], options.addresses[0])}",
            flush=True,
        )


def _systems(vehicles: Sequence[SimulatedVehicle]) -> str:
    first, last = vehicles[0].system_id, vehicles[-1].system_id
    return f"system {first}" if first == last else f"systems {first} to {last}"


def _client_address(address: str, as_given: str) -> str:
    """How a client on this machine reaches it; serial ports have another end."""
    scheme, _, place = address.partition(":")
    if scheme == "zenohin":
        return shlex.quote(f"{CLIENTS_USE[scheme]}:{place}{_network_of_clients(as_given)}")
    if scheme == "pty":
        return place
    if scheme not in CLIENTS_USE:
        return "the other end of the serial line"
    return f"{CLIENTS_USE[scheme]}:{place.replace('0.0.0.0', '127.0.0.1')}"


def _network_of_clients(address: str) -> str:
    """What clients say behind their address: to connect where this one listens, or to where it is connected."""
    where = parse_address(place_of(address, 0, 1))
    endpoints, config = where.option("listen") or where.option("connect"), where.option("config")
    options = [f"connect={endpoints.replace('0.0.0.0', '127.0.0.1')}"] if endpoints else []
    options += [f"config={config}"] if config else []
    return f"?{'&'.join(options)}" if options else ""
