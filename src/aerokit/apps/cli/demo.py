"""``aerokit demo``: take off, fly a square, land, and print a summary."""

from __future__ import annotations

from contextlib import AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING

from aerokit.apps.cli.arguments import add_faults, add_number, add_system_id, add_vehicle_kind, writable_file
from aerokit.apps.cli.connecting import SIGNING_KEY_VARIABLE, add_address, add_signing_key, connect_to, signing_of
from aerokit.apps.cli.flight_recording import record_parameters, record_to_end
from aerokit.apps.cli.output import DONE, FAILED, INTERRUPTED, add_json, emit, new_recording
from aerokit.apps.cli.sim import injecting_faults
from aerokit.apps.cli.supervised_flight import FlightReport, SupervisedFlight
from aerokit.apps.cli.terminal import InterruptStack, on_interrupt
from aerokit.errors import AerokitError, InvalidArgument, NotSupported, OperationRejected

if TYPE_CHECKING:
    import argparse
    from collections.abc import AsyncIterator

    from aerokit.apps.cli.supervised_flight import Purpose
    from aerokit.vehicle.vehicle import Vehicle

# The corners of the square: name, and offset north and east of the start in multiples of the side.
_CORNERS = (("north-west", 1, 0), ("north-east", 1, 1), ("south-east", 0, 1), ("south-west", 0, 0))
_READY_TIMEOUT_S = 120.0
_DEFAULT_LOG = "demo.tlog"


def add_arguments(command: argparse.ArgumentParser) -> None:
    command.set_defaults(run=run_demo)
    add_address(command, "--connect", what="vehicle to fly: ", default_text="a simulated one")
    add_vehicle_kind(command, "copter or plane with ArduPilot, px4 or px4_plane (default: copter)")
    add_faults(command)
    add_number(command, "--altitude", 1, 500, "M", "altitude above home in metres", default=10.0)
    add_number(command, "--side", 1, 5000, "M", "side of the square in metres", default=20.0)
    command.add_argument(
        "--record",
        type=writable_file,
        default=_DEFAULT_LOG,
        metavar="FILE",
        help=f"record all messages (default: {_DEFAULT_LOG}; an existing file is kept as demo.1.tlog)",
    )
    add_number(command, "--speedup", 0.1, 100, "X", "simulation speed factor", default=5.0)
    add_system_id(command)
    add_signing_key(command, f"signing key of the --connect vehicle (${SIGNING_KEY_VARIABLE})")
    add_json(command)


async def run_demo(options: argparse.Namespace) -> int:
    if options.connect is not None and options.faults:
        raise InvalidArgument("--fault works with the simulated vehicle only: remove --connect, or remove --fault")
    interrupts = InterruptStack()
    with on_interrupt(interrupts.interrupt):
        code = await interrupts.run(lambda: _connect_and_fly(options, interrupts))
    if code is None:
        emit(options, "interrupted", {}, "interrupted")
        return INTERRUPTED
    return code


async def _connect_and_fly(options: argparse.Namespace, interrupts: InterruptStack) -> int:
    async with _address(options) as address, AsyncExitStack() as stack:
        emit(options, "connecting", {"address": address}, f"connecting to {address}")
        stack.enter_context(new_recording(options.record))
        signing = signing_of(options) if options.connect else None
        is_real = options.connect is not None
        vehicle = await stack.enter_async_context(
            connect_to(options, address, changes_vehicle=is_real, record=options.record, signing=signing)
        )
        report = FlightReport(vehicle, options, speedup=1.0 if is_real else options.speedup)
        async with report.running():
            flight = _SquareFlight(vehicle, report, interrupts)
            code = await flight.fly_square(options.altitude, options.side)
            if flight.has_sent_arm_command:
                await record_to_end(vehicle, interrupts, report.print_line, report.speedup)
        report.print_summary(options.record)
    return code


@asynccontextmanager
async def _address(options: argparse.Namespace) -> AsyncIterator[str]:
    """Yield the address of the vehicle.

    Without ``--connect``, a vehicle is simulated while the block lasts.
    """
    if options.connect is not None:
        yield options.connect
        return
    from aerokit.sim import open_simulator
    from aerokit.sim.kinds import scale_timeouts, simulated

    vehicle = simulated(options.vehicle)
    scale_timeouts([vehicle], options.speedup)
    async with open_simulator(vehicle, "tcpin:127.0.0.1:0", speedup=options.speedup) as simulator:
        address = simulator.addresses[0].replace("tcpin", "tcp")
        text = f"simulated {options.vehicle} on {address}, speed {options.speedup:g}x"
        record = {"system_ids": [vehicle.system_id], "address": address, "speedup": options.speedup}
        emit(options, "simulated", record, text)
        async with injecting_faults([vehicle], options):
            yield address


class _SquareFlight(SupervisedFlight):
    """A flight along a square. After an interrupt or a failure, the vehicle lands, unless another party has control."""

    def __init__(self, vehicle: Vehicle, report: FlightReport, interrupts: InterruptStack) -> None:
        super().__init__(vehicle, report, interrupts, "land")
        self._was_overruled = False  # True if another party's mode change has ended the flight along the square

    async def fly_square(self, altitude_m: float, side_m: float) -> int:
        self._altitude_m = altitude_m
        self._side_m = side_m
        try:
            return await self.fly()
        except AerokitError:  # the error is already printed
            return FAILED

    async def _fly(self) -> int:
        await self._take_off(self._altitude_m)
        start = self._vehicle.position.value.replace(altitude_relative_m=self._altitude_m, altitude_amsl_m=None)
        for name, north, east in _CORNERS:
            await self._vehicle.go_to(start.offset(north_m=north * self._side_m, east_m=east * self._side_m))
            self._print(f"reached the {name} corner")
        self._print("landing")
        await self._vehicle.land()
        self._print("landed; waiting until the vehicle disarms")
        await self._vehicle.armed.wait_until(lambda armed: not armed, timeout=30)
        self._print("disarmed")
        return DONE

    async def _take_off(self, altitude_m: float) -> None:
        vehicle = self._vehicle
        self._print(f"found {vehicle.autopilot.firmware}, system {vehicle.system_id}; waiting until it is ready")
        # Check before arming that the autopilot can take off. This sends nothing, and works with any altitude of home.
        if vehicle.autopilot.take_off(altitude_m, home_altitude_amsl_m=0.0, is_vtol=vehicle.is_vtol) is None:
            raise NotSupported(f"demo: {vehicle.autopilot.firmware} cannot take off")
        await record_parameters(vehicle, self._print)
        await vehicle.wait_ready(timeout=_READY_TIMEOUT_S)
        home = vehicle.home.value
        self._print(f"ready, home is {home.latitude_deg:.6f}, {home.longitude_deg:.6f}; arming")
        await self._arm()
        self._print(f"armed; taking off to {altitude_m:g} m")
        await vehicle.take_off(altitude_m)
        self._has_changed_mode = True  # from now on, a mode change by another party ends this program's control
        self._print("at altitude; flying the square")

    def _our_purposes(self) -> tuple[Purpose, ...]:
        # After a mode change by another party, a mode to hold or to land may be that party's.
        return ("take_off", "setpoint") if self._was_overruled else ("take_off", "setpoint", "hold", "land")

    async def _after_failure(self, error: Exception) -> int:
        self._was_overruled = type(error) is OperationRejected
        return await self._after_interrupt()
