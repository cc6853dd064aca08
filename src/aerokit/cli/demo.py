"""``aerokit demo``: take off, fly a square, come back, land, and say how it went."""

from __future__ import annotations

from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import anyio

from aerokit.cli.interrupt import on_interrupt
from aerokit.cli.report import FlightReport
from aerokit.cli.signing import signing_of
from aerokit.cli.vehicles import simulated_vehicle
from aerokit.errors import AerokitError, NotSupported, OperationRejected
from aerokit.mavlink.enums import MavLandedState
from aerokit.vehicle.connect import connect

if TYPE_CHECKING:
    import argparse
    from collections.abc import AsyncIterator, Awaitable, Callable

    from aerokit.vehicle.vehicle import Vehicle

__all__ = ["run_demo"]

DONE, FAILED, INTERRUPTED = 0, 1, 130
CORNERS = (("north-west", 1, 0), ("north-east", 1, 1), ("south-east", 0, 1), ("south-west", 0, 0))
"""Of the square: its name, and how many sides north and east of the start it is."""
READY_TIMEOUT_S = 120.0


async def run_demo(options: argparse.Namespace) -> int:
    """Fly the demonstration; 0 when the vehicle is back on the ground."""
    interruptible = _Interruptible()
    with on_interrupt(interruptible.interrupt):
        code = await interruptible.run(lambda: _connect_and_fly(options, interruptible))
    if code is None:
        print("interrupted")
        return INTERRUPTED
    return code


async def _connect_and_fly(options: argparse.Namespace, interruptible: _Interruptible) -> int:
    async with _address(options) as address:
        print(f"connecting to {address}", flush=True)
        async with connect(
            address,
            system_id=options.system_id,
            baud=options.baud,
            record=options.record,
            signing=signing_of(options) if options.connect else None,
        ) as vehicle:
            report = FlightReport(vehicle)
            async with report.running():
                code = await _Flight(vehicle, report, interruptible).fly(options.altitude, options.side)
            report.print_summary(options.record)
    return code


@asynccontextmanager
async def _address(options: argparse.Namespace) -> AsyncIterator[str]:
    """The address of the vehicle; without one, of a simulated copter that lives as long as the block."""
    if options.connect is not None:
        yield options.connect
        return
    from aerokit.sim import open_simulator
    from aerokit.sim.patience import wait_longer

    vehicle = simulated_vehicle(options.vehicle)
    wait_longer([vehicle], options.speedup)
    async with open_simulator(vehicle, "tcpin:127.0.0.1:0", speedup=options.speedup) as simulator:
        address = simulator.addresses[0].replace("tcpin", "tcp")
        print(f"simulated {options.vehicle}, {options.speedup:g} times real time, on {address}", flush=True)
        yield address


class _Interruptible:
    """Runs functions that Ctrl-C ends; each Ctrl-C ends the innermost one only."""

    def __init__(self) -> None:
        self._scopes: list[anyio.CancelScope] = []

    def interrupt(self) -> None:
        if self._scopes:
            self._scopes[-1].cancel()

    async def run(self, function: Callable[[], Awaitable[int]]) -> int | None:
        """What the function gives, None when it was interrupted."""
        scope = anyio.CancelScope()
        with scope:
            self._scopes.append(scope)
            try:
                return await function()
            finally:
                self._scopes.remove(scope)
        return None


class _Flight:
    """The square, and what is done when it is interrupted or fails."""

    def __init__(self, vehicle: Vehicle, report: FlightReport, interruptible: _Interruptible) -> None:
        self._vehicle, self._say, self._interruptible = vehicle, report.say, interruptible
        self._is_ours = False  # armed by us; what somebody else flies is not ours to land

    async def fly(self, altitude_m: float, side_m: float) -> int:
        """Fly it, come down whatever happens, and return the exit code."""
        try:
            code = await self._interruptible.run(lambda: self._fly_square(altitude_m, side_m))
        except AerokitError as error:
            self._say(f"failed: {error}")
            if self._is_ours:
                await self._come_down_after_failure(error)
            return FAILED
        if code is None:
            self._say(f"interrupted, {self._vehicle.describe_now()}")
            if self._is_ours:
                await self._come_down()
            return INTERRUPTED
        return code

    async def _fly_square(self, altitude_m: float, side_m: float) -> int:
        await self._take_off(altitude_m)
        start = self._vehicle.position.value.replace(altitude_relative_m=altitude_m, altitude_amsl_m=None)
        for name, north, east in CORNERS:
            await self._vehicle.go_to(start.offset(north_m=north * side_m, east_m=east * side_m))
            self._say(f"at the {name} corner")
        await self._land()
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
        if not vehicle.is_surely_disarmed:
            now = vehicle.describe_now()
            raise OperationRejected(f"it is left to whoever armed it ({now}); nothing was sent")
        self._is_ours = True
        await vehicle.arm()
        self._say(f"armed; taking off to {altitude_m:g} m")
        await vehicle.take_off(altitude_m)
        self._say("at altitude; flying the square")

    async def _land(self) -> int:
        self._say("landing")
        await self._vehicle.land()
        self._say("on the ground; waiting for the motors to stop")
        await self._vehicle.armed.wait_until(lambda armed: not armed, timeout=30)
        self._say("disarmed")
        return DONE

    # ---------------------------------------------------------------------- when it went wrong

    async def _come_down_after_failure(self, error: AerokitError) -> None:
        """Whoever changed the mode, a pilot or a failsafe, keeps the vehicle.

        Holding and landing are our own after an answer that did not come; not when an order ended because of the mode.
        """
        vehicle, autopilot = self._vehicle, self._vehicle.autopilot
        ours = [autopilot.mode_for("take_off"), autopilot.mode_for("setpoint")]
        if type(error) is not OperationRejected:
            ours += [autopilot.mode_for("hold"), autopilot.mode_for("land")]
        if vehicle.is_armed and vehicle.mode_name not in [mode.name for mode in ours if mode is not None]:
            self._say(f"left to whoever put it into {vehicle.mode_name}: {vehicle.describe_now()}")
            return
        await self._come_down()

    async def _come_down(self) -> None:
        """Land, or switch off what stands on the ground; a second Ctrl-C leaves it to itself."""
        try:
            if await self._interruptible.run(self._end_flight) is None:
                self._say(f"interrupted again: left {self._vehicle.describe_now()}")
        except AerokitError as error:
            self._say(f"it could not be landed: {error}")
            self._say(f"left {self._vehicle.describe_now()}")

    async def _end_flight(self) -> int:
        vehicle = self._vehicle
        if not vehicle.is_armed:
            return DONE
        if vehicle.landed_state.latest == MavLandedState.ON_GROUND:
            self._say("on the ground and armed; disarming")
            await vehicle.disarm()
            return DONE
        self._say("landing here; Ctrl-C again to leave it to itself")
        return await self._land()
