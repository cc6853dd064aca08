"""``aerokit sim``: simulated vehicles for other programs."""

from __future__ import annotations

import asyncio
import shlex
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any, NamedTuple

import anyio

from aerokit.apps.cli.arguments import (
    DEFAULT_SIM_ADDRESS,
    add_conditions,
    add_number,
    add_vehicle_kind,
    address_or_template,
    conditions,
    count,
    expand_address,
    home,
    is_address_template,
    picture,
    system_id,
)
from aerokit.apps.cli.connecting import add_signing_key
from aerokit.apps.cli.output import add_json, emit
from aerokit.apps.cli.terminal import on_interrupt
from aerokit.errors import InvalidArgument
from aerokit.mavlink.enums import MavComponent, MavType
from aerokit.sim import ExtraComponent, SimulatedCamera, SimulatedGimbal, SimulatedVehicle, SimulatorServer
from aerokit.sim.kinds import scale_timeouts, simulated
from aerokit.sim.motion import HOME, GlobalPoint, LocalFrame
from aerokit.transport import create_link
from aerokit.transport.address import parse_address

if TYPE_CHECKING:
    import argparse
    from collections.abc import AsyncIterator, Callable, Iterable, Sequence

    from aerokit.sim import AttachableComponent
    from aerokit.testing.track import Track

# Maps schemes of a simulator's address to the schemes with which a client connects.
_CLIENT_SCHEMES = {
    "tcpin": "tcp",
    "udpout": "udpin",
    "udpbcast": "udpin",
    "udpin": "udpout",
    "zenohin": "zenoh",
}

# A simulator knows its own end of a serial line, but not the device that a client opens.
_SERIAL_LINE_PLACEHOLDER = "the other end of the serial line"


def simulated_fleet(
    name: str,
    count: int,
    *,
    system_id: int = 1,
    home: tuple[float, float, float] | None = None,
    spacing_m: float = 5.0,
    seed: int = 0,
    components: Callable[[], Iterable[AttachableComponent]] = tuple,
    **options: Any,
) -> list[SimulatedVehicle]:
    """Create ``count`` vehicles with consecutive system ids and seeds, in a row eastwards from ``home``.

    ``components`` makes the components of one vehicle. ``name`` is the kind of vehicle or the path of a recording. For
    a recording, ``count`` must be 1, and the other arguments are ignored.
    """
    if name.endswith(".tlog"):
        return [_recorded(name, count)]
    if name.startswith("px4"):
        options.pop("boot_text", None)  # PX4 sends no text at boot.
    last_id = system_id + count - 1
    if last_id > 255:
        raise InvalidArgument(
            f"{count} vehicles from system id {system_id} need ids up to {last_id}; the maximum is 255"
        )
    latitude_deg, longitude_deg, altitude_m = home or HOME
    frame = LocalFrame(GlobalPoint(round(latitude_deg * 1e7), round(longitude_deg * 1e7), altitude_m))
    homes = [frame.to_global(north=0.0, east=number * spacing_m, down=0.0) for number in range(count)]
    return [
        simulated(
            name,
            home=(vehicle_home.latitude_e7 / 1e7, vehicle_home.longitude_e7 / 1e7, altitude_m),
            system_id=system_id + number,
            seed=seed + number,
            components=components(),
            **options,
        )
        for number, vehicle_home in enumerate(homes)
    ]


def _recorded(path: str, count: int) -> SimulatedVehicle:
    from aerokit.testing.recorded import RecordedVehicle

    if count != 1:
        raise InvalidArgument(f"count = {count} is not allowed: the recording {path} has only one vehicle")
    return RecordedVehicle(path)


def add_arguments(command: argparse.ArgumentParser) -> None:
    command.set_defaults(run=run_sim)
    kinds = "copter, plane, rover, sub (ArduPilot), px4, px4_plane; or a recording: flight.tlog (default: copter)"
    add_vehicle_kind(command, kinds)
    command.add_argument(
        "addresses",
        nargs="*",
        type=address_or_template,
        default=[DEFAULT_SIM_ADDRESS],
        metavar="ADDRESS",
        help="one or more addresses: udpout:127.0.0.1:14550, udpin:0.0.0.0:14550, tcpin:0.0.0.0:5760,"
        " /dev/ttyUSB0,57600, pty (a pseudo-terminal), pty:/tmp/ttyV0. Each address serves all vehicles; a template"
        " gives each vehicle its own address: pty:/tmp/ttyV{n}, udpout:127.0.0.1:{14550+n}; n counts from 0, id is"
        f" the system id (default: {DEFAULT_SIM_ADDRESS})",
    )
    command.add_argument(
        "--count", type=count, default=1, metavar="N", help="number of vehicles, 1 to 250 (default: 1)"
    )
    add_number(command, "--speedup", 0.1, 100, "X", "simulation speed factor", default=1.0)
    command.add_argument(
        "--system-id", type=system_id, default=1, metavar="ID", help="system id of the first vehicle (default: 1)"
    )
    command.add_argument(
        "--home",
        type=home,
        default=HOME,
        metavar="LAT,LON,ALT",
        help=f"home of the first vehicle, in degrees and metres above sea level ({','.join(map(str, HOME))})",
    )
    add_number(command, "--spacing", 0, 1000, "M", "eastward distance between vehicles in metres", default=5.0)
    command.add_argument("--seed", type=int, default=0, help="random seed of the first vehicle (default: 0)")
    _add_devices(command)
    add_conditions(command)
    add_number(command, "--boot-time", 0, 600, "S", "simulated seconds until the vehicle is ready to arm")
    add_signing_key(command, "signing key of the vehicles; ArduPilot's first port accepts unsigned messages too")
    add_number(command, "--duration", 0.1, 1e6, "S", "stop after S simulated seconds (default: at Ctrl-C)")
    command.add_argument(
        "--picture",
        type=picture,
        metavar="FILE",
        help="image of the true tracks, written at the end: .svg, or .png with Pillow",
    )
    add_json(command)


class _DeviceOption(NamedTuple):
    """An option that adds a device to each vehicle. ``make`` takes the number of the device, counted from 0."""

    max_count: int
    make: Callable[[int], AttachableComponent]
    description: str


_DEVICES: dict[str, _DeviceOption] = {
    "camera": _DeviceOption(6, lambda number: SimulatedCamera(100 + number), "camera (component 100 to 105)"),
    "gimbal": _DeviceOption(
        6, lambda number: SimulatedGimbal(170 + number if number else 154), "gimbal (component 154, 171 to 175)"
    ),
    "companion": _DeviceOption(
        4,
        lambda number: ExtraComponent(MavComponent.ONBOARD_COMPUTER + number, MavType.ONBOARD_CONTROLLER),
        "companion computer (component 191 to 194), which sends heartbeats",
    ),
}


def _add_devices(command: argparse.ArgumentParser) -> None:
    for name, device in _DEVICES.items():
        command.add_argument(
            f"--{name}",
            action="count",
            default=0,
            help=f"fit each vehicle with a {device.description}; repeatable, up to {device.max_count}",
        )


def _devices(options: argparse.Namespace) -> list[AttachableComponent]:
    components = []
    for name, device in _DEVICES.items():
        count = getattr(options, name)
        if count > device.max_count:
            raise InvalidArgument(f"--{name} is given {count} times, but a vehicle has at most {device.max_count}")
        components += [device.make(number) for number in range(count)]
    return components


async def run_sim(options: argparse.Namespace) -> None:
    vehicles = _fleet(options)
    scale_timeouts(vehicles, options.speedup, leave=dict(options.parameters))
    tracks = _tracks(vehicles, options.picture)
    server = _server(vehicles, options.addresses, options.speedup)
    stop = asyncio.Event()
    with on_interrupt(stop.set):
        async with server, injecting_faults(vehicles, options):
            _emit_addresses(server, options)
            real_duration_s = None if options.duration is None else options.duration / options.speedup
            with anyio.move_on_after(real_duration_s):
                await stop.wait()
    emit(options, "stopped", {}, "stopped")
    if options.picture is not None:
        from aerokit.testing.picture import save_picture

        save_picture(tracks, options.picture)
        record = {"file": options.picture, "what": "track", "count": len(tracks)}
        emit(options, "saved", record, f"track written to {options.picture}")


@asynccontextmanager
async def injecting_faults(vehicles: Sequence[SimulatedVehicle], options: argparse.Namespace) -> AsyncIterator[None]:
    injecting = asyncio.create_task(_inject_faults(vehicles, options))
    try:
        yield
    finally:
        injecting.cancel()


async def _inject_faults(vehicles: Sequence[SimulatedVehicle], options: argparse.Namespace) -> None:
    loop = asyncio.get_running_loop()
    started_at = loop.time()
    for name, value, at_s in sorted(options.faults, key=lambda fault: fault.at_s):
        await asyncio.sleep(started_at + at_s / options.speedup - loop.time())
        for vehicle in vehicles:
            if isinstance(value, list):
                getattr(vehicle.faults, name).extend(value)
            else:
                setattr(vehicle.faults, name, value)
        begin = f"{at_s:g} s" if at_s else "from the start"
        emit(options, "fault", {"name": name, "value": value, "seconds": at_s}, f"{begin}: fault {name}")


def _fleet(options: argparse.Namespace) -> list[SimulatedVehicle]:
    arguments = conditions(options)
    if options.boot_time is not None:
        arguments["boot_time_s"] = options.boot_time
    if options.signing_key is not None:
        arguments["signing_key"] = options.signing_key
    return simulated_fleet(
        options.vehicle,
        options.count,
        system_id=options.system_id,
        home=options.home,
        spacing_m=options.spacing,
        seed=options.seed,
        boot_text=True,
        components=lambda: _devices(options),
        **arguments,
    )


def _tracks(vehicles: Sequence[SimulatedVehicle], picture: str | None) -> list[Track]:
    if picture is None:
        return []
    from aerokit.testing.track import record_track

    return [record_track(vehicle) for vehicle in vehicles]


def _server(vehicles: Sequence[SimulatedVehicle], addresses: Sequence[str], speedup: float) -> SimulatorServer:
    links = []
    vehicles_on = []
    for address in addresses:
        # An address template becomes one link for each vehicle, any other address one link for all.
        groups = [[vehicle] for vehicle in vehicles] if is_address_template(address) else [list(vehicles)]
        for index, group in enumerate(groups):
            links.append(create_link(expand_address(address, index, group[0].system_id)))
            vehicles_on.append(group)
    return SimulatorServer(vehicles, links, speedup=speedup, vehicles_on=vehicles_on)


def _emit_addresses(server: SimulatorServer, options: argparse.Namespace) -> None:
    for address, vehicles in zip(server.addresses, server.vehicles_on, strict=True):
        record = {
            "system_ids": [vehicle.system_id for vehicle in vehicles],
            "address": address,
            "speedup": options.speedup,
        }
        # Without --json, the addresses that serve the same vehicles are printed together on one line.
        shared = []
        for other_address, other_vehicles in zip(server.addresses, server.vehicles_on, strict=True):
            if other_vehicles == vehicles:
                shared.append(other_address)
        text = f"{_systems(vehicles)} on {' and '.join(shared)}, speed {options.speedup:g}x"
        emit(options, "simulated", record, text if address == shared[0] else None)
    if not options.json:
        first_vehicle, *further_vehicles = server.vehicles_on[0]
        argument = expand_address(options.addresses[0], number=0, system_id=first_vehicle.system_id)
        client = _client_address(server.addresses[0], argument)
        system_option = f" --system-id {first_vehicle.system_id}" if further_vehicles else ""
        print(f"try: aerokit demo --connect {client}{system_option}", flush=True)
        if client != _SERIAL_LINE_PLACEHOLDER:
            print(f"or:  aerokit status {client}, aerokit monitor {client}, aerokit serve {client}", flush=True)


def _systems(vehicles: Sequence[SimulatedVehicle]) -> str:
    first_id = vehicles[0].system_id
    last_id = vehicles[-1].system_id
    return f"system {first_id}" if first_id == last_id else f"systems {first_id} to {last_id}"


def _client_address(address: str, argument: str) -> str:
    """Return the address with which a client on this machine connects to the simulator's link.

    ``address`` is the address of the open link, ``argument`` the address given on the command line. The result for a
    serial line is a placeholder, because the device at its other end is unknown.
    """
    scheme, _, location = address.partition(":")
    if scheme == "zenohin":
        return shlex.quote(f"{_CLIENT_SCHEMES[scheme]}:{location}{_zenoh_options(argument)}")
    if scheme == "pty":
        return location
    if scheme not in _CLIENT_SCHEMES:
        return _SERIAL_LINE_PLACEHOLDER
    return f"{_CLIENT_SCHEMES[scheme]}:{location.replace('0.0.0.0', '127.0.0.1')}"


def _zenoh_options(address: str) -> str:
    """Return the query part of a client's zenoh address."""
    parsed = parse_address(address)
    endpoints = parsed.option("listen") or parsed.option("connect")
    config = parsed.option("config")
    options = []
    if endpoints:
        options.append(f"connect={endpoints.replace('0.0.0.0', '127.0.0.1')}")
    if config:
        options.append(f"config={config}")
    return f"?{'&'.join(options)}" if options else ""
