"""What a flight looks like on a terminal: a line for everything that happens, and a summary."""

from __future__ import annotations

import asyncio
import contextlib
import os
import sys
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import anyio

from aerokit import events
from aerokit.errors import AerokitError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from aerokit.position import Position
    from aerokit.vehicle.vehicle import Vehicle

__all__ = ["FlightReport"]

WARNING = 4
WAITING_S = 5.0
"""After so long without news there is a line that says what is waited for or where it is."""


class FlightReport:
    """Prints what is said and what the vehicle says, and follows where it is."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._vehicle = vehicle
        self._started = self._last_line = vehicle.connection.now()
        self._highest_m = self._fastest_m_s = self._flown_m = 0.0
        self._before: Position | None = None

    def say(self, text: str) -> None:
        """Print a line with the time and the altitude; a reader who has gone does not end the flight."""
        here = self._vehicle.position.latest
        altitude = None if here is None else here.altitude_relative_m
        height = "     -" if altitude is None else f"{round(altitude, 1) + 0.0:6.1f}"
        self._last_line = self._vehicle.connection.now()
        self._print(f"{self._last_line - self._started:6.1f} s {height} m  {text}")

    @asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Print the vehicle's texts and modes, and a sign of life, while the block lasts."""
        detach = self._vehicle.position.observe(self._on_position)
        tasks = [asyncio.create_task(each) for each in (self._print_events(), self._print_signs_of_life())]
        try:
            yield
        finally:
            detach()
            for task in tasks:
                task.cancel()
            with anyio.CancelScope(shield=True):
                await asyncio.gather(*tasks, return_exceptions=True)

    def print_summary(self, record: str) -> None:
        """Print what was flown, how well the vehicle was heard, and what is left in the batteries."""
        vehicle = self._vehicle
        received, lost = vehicle.connection.counts(vehicle.system_id)
        seconds = vehicle.connection.now() - self._started
        version = vehicle.version.latest
        self._print(
            f"\n{vehicle.autopilot.firmware} {version or 'of unknown version'}, {seconds:.0f} s:"
            f" flown {self._flown_m:.0f} m, up to {self._highest_m:.1f} m high and {self._fastest_m_s:.1f} m/s fast"
        )
        for battery in vehicle.batteries.latest or ():
            self._print(
                f"battery {battery.id}: {_number(battery.voltage_v, 'V')},"
                f" {_number(battery.remaining_percent, '%')} left"
            )
        self._print(f"{received} frames received, {lost} lost; recorded in {record}")

    # ---------------------------------------------------------------------------------- inside

    async def _print_events(self) -> None:
        with (
            self._vehicle.subscribe(events.StatusTextReceived, events.ModeChanged, capacity=100) as news,
            contextlib.suppress(AerokitError),
        ):
            async for event in news:
                if isinstance(event, events.ModeChanged):
                    self.say(f"  mode {event.after}")
                elif isinstance(event, events.StatusTextReceived):
                    self.say(f"  {'! ' if event.severity <= WARNING else ''}{event.text}")

    async def _print_signs_of_life(self) -> None:
        vehicle = self._vehicle
        while vehicle.connection.is_open:
            await anyio.sleep(WAITING_S / 5)
            if vehicle.connection.now() - self._last_line < WAITING_S:
                continue
            missing = [] if vehicle.is_armed else vehicle.missing_for_flight()
            if missing:
                self.say(f"  still missing: {'; '.join(missing)}")
            else:
                self.say(f"  {vehicle.mode_name}, {vehicle.ground_speed_m_s.latest or 0.0:.1f} m/s")

    def _on_position(self, before: Position | None, position: Position) -> None:
        if self._before is not None:
            self._flown_m += position.distance_to(self._before)
        self._before = position
        self._highest_m = max(self._highest_m, position.altitude_relative_m or 0.0)
        self._fastest_m_s = max(self._fastest_m_s, self._vehicle.ground_speed_m_s.latest or 0.0)

    def _print(self, text: str) -> None:
        try:
            print(text, flush=True)
        except BrokenPipeError:
            sys.stdout = open(os.devnull, "w")  # noqa: SIM115 - for the rest of the program


def _number(value: float | None, unit: str) -> str:
    return "unknown" if value is None else f"{value:.4g} {unit}"
