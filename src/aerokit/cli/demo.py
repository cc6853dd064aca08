"""``aerokit demo``: take off, fly a square, come back, land, and say how it went."""

from __future__ import annotations

import asyncio
import contextlib
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

from aerokit import events
from aerokit.vehicle.connect import connect
from aerokit.vehicle.values import Position

if TYPE_CHECKING:
    import argparse
    from collections.abc import AsyncIterator

    from aerokit.vehicle.vehicle import Vehicle

__all__ = ["run_demo"]

CORNERS = (("north", 1, 0), ("east", 1, 1), ("south", 0, 1), ("west", 0, 0))
WARNING = 4


async def run_demo(options: argparse.Namespace) -> int:
    """Fly the demonstration; 0 when the vehicle is back on the ground."""
    async with _address(options) as address:
        print(f"connecting to {address}")
        async with connect(
            address, system_id=options.system_id, baud=options.baud, record=options.record
        ) as vehicle:
            flight = _Flight(vehicle)
            async with flight.reporting():
                await flight.fly(options.altitude, options.side)
            flight.print_summary(options.record)
    return 0


@asynccontextmanager
async def _address(options: argparse.Namespace) -> AsyncIterator[str]:
    """The address of the vehicle; without one, of a simulated copter that lives as long as the block."""
    if options.connect is not None:
        yield options.connect
        return
    from aerokit.sim import SimulatedCopter, open_simulator

    async with open_simulator(SimulatedCopter(), "tcpin:127.0.0.1:0", speedup=options.speedup) as simulator:
        print(f"simulated copter, {options.speedup:g} times real time, on {simulator.addresses[0]}")
        yield simulator.addresses[0].replace("tcpin", "tcp")


class _Flight:
    """One flight with what is told of it."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._vehicle = vehicle
        self._started = vehicle.connection.now()
        self._highest_m = self._fastest_m_s = self._flown_m = 0.0
        self._before: Position | None = None

    async def fly(self, altitude_m: float, side_m: float) -> None:
        vehicle = self._vehicle
        self._say(
            f"found {vehicle.autopilot.firmware}, system {vehicle.system_id}; waiting until it is ready"
        )
        await vehicle.wait_ready()
        home = vehicle.home.value
        self._say(f"ready at {home.latitude_deg:.6f}, {home.longitude_deg:.6f}; arming")
        await self._leave_unarmable_mode()
        await vehicle.arm()
        self._say(f"armed; taking off to {altitude_m:g} m")
        await vehicle.take_off(altitude_m)
        start = vehicle.position.value.replace(altitude_relative_m=altitude_m, altitude_amsl_m=None)
        self._say("at altitude; flying the square")
        for name, north, east in CORNERS:
            await vehicle.go_to(start.offset(north_m=north * side_m, east_m=east * side_m))
            self._say(f"arrived at the corner {name}")
        self._say("landing")
        await vehicle.land()
        self._say("on the ground; waiting for the motors to stop")
        await vehicle.armed.wait_until(lambda armed: not armed, timeout=30)
        self._say("disarmed")

    async def _leave_unarmable_mode(self) -> None:
        """ArduPilot refuses to arm in LAND, where the flight before has left it."""
        vehicle = self._vehicle
        mode = vehicle.autopilot.mode_for("take_off")
        if mode is not None and vehicle.mode_name in vehicle.autopilot.unarmable_modes:
            await vehicle.set_mode(mode.name)

    @asynccontextmanager
    async def reporting(self) -> AsyncIterator[None]:
        """Print what the vehicle says, and follow where it is."""
        detach = self._vehicle.position.observe(self._on_position)
        task = asyncio.create_task(self._print_events())
        try:
            yield
        finally:
            detach()
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task

    async def _print_events(self) -> None:
        with self._vehicle.subscribe(events.StatusTextReceived, events.ModeChanged, capacity=100) as news:
            async for event in news:
                if isinstance(event, events.ModeChanged):
                    self._say(f"  mode {event.after}")
                else:
                    self._say(f"  {'! ' if event.severity <= WARNING else ''}{event.text}")

    def _on_position(self, before: Position | None, position: Position) -> None:
        if self._before is not None:
            self._flown_m += position.distance_to(self._before)
        self._before = position
        self._highest_m = max(self._highest_m, position.altitude_relative_m or 0.0)
        self._fastest_m_s = max(self._fastest_m_s, self._vehicle.ground_speed_m_s.latest or 0.0)

    def _say(self, text: str) -> None:
        vehicle = self._vehicle
        here = vehicle.position.latest
        altitude = here.altitude_relative_m if here is not None else None
        height = "     -" if altitude is None else f"{altitude:6.1f}"
        print(f"{vehicle.connection.now() - self._started:6.1f} s {height} m  {text}", flush=True)

    def print_summary(self, record: str) -> None:
        vehicle = self._vehicle
        received, lost = vehicle.connection.counts(vehicle.system_id)
        batteries = vehicle.batteries.latest or ()
        print(
            f"\nflown {self._flown_m:.0f} m, up to {self._highest_m:.1f} m high and {self._fastest_m_s:.1f} m/s fast"
            f"\n{received} frames received, {lost} lost; recorded in {record}"
        )
        for battery in batteries:
            print(
                f"battery {battery.id}: {_number(battery.voltage_v, 'V')}, {_number(battery.remaining_percent, '%')}"
            )


def _number(value: float | None, unit: str) -> str:
    return "unknown" if value is None else f"{value:.4g} {unit}"
