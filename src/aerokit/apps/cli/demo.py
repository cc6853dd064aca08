"""``aerokit demo``: take off, fly a square, come back, land, and say how it went."""

from __future__ import annotations

from contextlib import AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING

from aerokit.apps.cli.arguments import add_baud, add_vehicle_kind, address, number, system_id, writable_file
from aerokit.apps.cli.completers import addresses, offer
from aerokit.apps.cli.output import DONE, FAILED, INTERRUPTED, add_force, add_json, check_new, tell
from aerokit.apps.cli.own_flight import FlightReport, OwnFlight
from aerokit.apps.cli.sim import simulated_vehicle
from aerokit.apps.cli.terminal import Interruptible, on_interrupt
from aerokit.apps.cli.vehicle_command import ENVIRONMENT, add_signing_key, reached, signing_of
from aerokit.errors import AerokitError, NotSupported, OperationRejected

if TYPE_CHECKING:
    import argparse
    from collections.abc import AsyncIterator

    from aerokit.apps.cli.own_flight import Purpose
    from aerokit.vehicle.vehicle import Vehicle

CORNERS = (("north-west", 1, 0), ("north-east", 1, 1), ("south-east", 0, 1), ("south-west", 0, 0))
"""Of the square: its name, and how many sides north and east of the start it is."""
READY_TIMEOUT_S = 120.0
OWN_LOG = "demo.tlog"


def add_arguments(command: argparse.ArgumentParser) -> None:
    """The arguments of the command."""
    command.set_defaults(run=run_demo)
    place = command.add_argument(
        "--connect",
        type=address,
        metavar="ADDRESS",
        help="a vehicle: udpin:0.0.0.0:14550, tcp:127.0.0.1:5760, /dev/ttyACM0,57600 …",
    )
    offer(place, addresses)
    add_vehicle_kind(command, "copter, plane (ArduPilot), px4, px4_plane (copter)")
    command.add_argument(
        "--altitude", type=number(1, 500), default=10.0, metavar="M", help="metres above home (10)"
    )
    command.add_argument(
        "--side", type=number(1, 5000), default=20.0, metavar="M", help="side of the square in metres (20)"
    )
    command.add_argument(
        "--record",
        type=writable_file,
        metavar="FILE",
        help=f"telemetry log ({OWN_LOG}, which each demonstration replaces)",
    )
    add_force(command)
    command.add_argument(
        "--speedup", type=number(0.1, 100), default=5.0, metavar="X", help="of the simulated vehicle (5)"
    )
    command.add_argument("--system-id", type=system_id, metavar="ID", help="of the vehicle (the only one)")
    add_baud(command)
    add_signing_key(command, f"of the vehicle of --connect (${ENVIRONMENT})")
    add_json(command)


async def run_demo(options: argparse.Namespace) -> int:
    """Fly the demonstration; 0 when the vehicle is back on the ground."""
    if options.record is None:
        options.record = OWN_LOG
    else:
        check_new(options.record, options)
    interruptible = Interruptible()
    with on_interrupt(interruptible.interrupt):
        code = await interruptible.run(lambda: _connect_and_fly(options, interruptible))
    if code is None:
        tell(options, "interrupted", {}, "interrupted")
        return INTERRUPTED
    return code


async def _connect_and_fly(options: argparse.Namespace, interruptible: Interruptible) -> int:
    async with _address(options) as address, AsyncExitStack() as stack:
        tell(options, "connecting", {"address": address}, f"connecting to {address}")
        signing = signing_of(options) if options.connect else None
        is_somebodys = options.connect is not None
        vehicle = await stack.enter_async_context(
            reached(options, address, changes=is_somebodys, record=options.record, signing=signing)
        )
        report = FlightReport(vehicle, options)
        async with report.running():
            code = await _SquareFlight(vehicle, report, interruptible).fly_square(
                options.altitude, options.side
            )
        report.print_summary(options.record)
    return code


@asynccontextmanager
async def _address(options: argparse.Namespace) -> AsyncIterator[str]:
    """The address of the vehicle; without one, of a simulated copter that lives as long as the block."""
    if options.connect is not None:
        yield options.connect
        return
    from aerokit.sim import open_simulator
    from aerokit.sim.kinds import wait_longer

    vehicle = simulated_vehicle(options.vehicle)
    wait_longer([vehicle], options.speedup)
    async with open_simulator(vehicle, "tcpin:127.0.0.1:0", speedup=options.speedup) as simulator:
        address = simulator.addresses[0].replace("tcpin", "tcp")
        text = f"simulated {options.vehicle}, {options.speedup:g} times real time, on {address}"
        record = {"system_ids": [vehicle.system_id], "address": address, "speedup": options.speedup}
        tell(options, "simulated", record, text)
        yield address


class _SquareFlight(OwnFlight):
    """The square; it ends in landing, also when it is interrupted or fails."""

    def __init__(self, vehicle: Vehicle, report: FlightReport, interruptible: Interruptible) -> None:
        super().__init__(vehicle, report, interruptible, "land")
        self._was_left_by_mode = False  # an order of ours ended because of the mode

    async def fly_square(self, altitude_m: float, side_m: float) -> int:
        """Fly it, come down whatever happens, and return the exit code."""
        self._altitude_m, self._side_m = altitude_m, side_m
        try:
            return await self.fly()
        except AerokitError:  # it has been told
            return FAILED

    async def _fly(self) -> int:
        await self._take_off(self._altitude_m)
        start = self._vehicle.position.value.replace(
            altitude_relative_m=self._altitude_m, altitude_amsl_m=None
        )
        for name, north, east in CORNERS:
            await self._vehicle.go_to(start.offset(north_m=north * self._side_m, east_m=east * self._side_m))
            self._say(f"at the {name} corner")
        self._say("landing")
        await self._vehicle.land()
        self._say("on the ground; waiting for the motors to stop")
        await self._vehicle.armed.wait_until(lambda armed: not armed, timeout=30)
        self._say("disarmed")
        return DONE

    async def _take_off(self, altitude_m: float) -> None:
        vehicle = self._vehicle
        self._say(
            f"found {vehicle.autopilot.firmware}, system {vehicle.system_id}; waiting until it is ready"
        )
        if vehicle.autopilot.take_off(altitude_m, 0.0, is_vtol=vehicle.is_vtol) is None:
            raise NotSupported(f"the demonstration flies, and {vehicle.autopilot.firmware} cannot take off")
        await vehicle.wait_ready(timeout=READY_TIMEOUT_S)
        home = vehicle.home.value
        self._say(f"ready, home is {home.latitude_deg:.6f}, {home.longitude_deg:.6f}; arming")
        await self._arm()
        self._say(f"armed; taking off to {altitude_m:g} m")
        self._has_started = True  # whoever changes the mode from now on, a pilot for example, keeps it
        await vehicle.take_off(altitude_m)
        self._say("at altitude; flying the square")

    def _our_purposes(self) -> tuple[Purpose, ...]:
        """Holding and landing are our own after an answer that did not come; not when the mode ended an order."""
        return (
            ("take_off", "setpoint") if self._was_left_by_mode else ("take_off", "setpoint", "hold", "land")
        )

    async def _after_failure(self, error: Exception) -> int:
        self._was_left_by_mode = type(error) is OperationRejected
        return await self._after_interrupt()
