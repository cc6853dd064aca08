"""What a flight looks like: a line for everything that happens, and a summary."""

from __future__ import annotations

import asyncio
import contextlib
import os
import sys
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import anyio

from aerokit import events
from aerokit.cli.output import tell
from aerokit.errors import AerokitError

if TYPE_CHECKING:
    import argparse
    from collections.abc import AsyncIterator, Mapping

    from aerokit.position import Position
    from aerokit.vehicle.vehicle import Vehicle

__all__ = ["FlightReport"]

WARNING = 4
WAITING_S = 5.0
"""After so long without news there is a line that says what is waited for or where it is."""


class FlightReport:
    """Prints what is said and what the vehicle says, and follows where it is."""

    def __init__(self, vehicle: Vehicle, options: argparse.Namespace) -> None:
        self._vehicle, self._options = vehicle, options
        self._started = self._last_line = vehicle.connection.now()
        self._highest_m = self._fastest_m_s = self._flown_m = 0.0
        self._before: Position | None = None
        self.shows_life: bool = True
        """Whether there are lines when there is no news; not while a question waits for its answer."""

    def say(self, text: str) -> None:
        """Print a line with time and altitude; a reader who has gone does not end the flight, nor a full disk."""
        here = self._vehicle.position.latest
        altitude = None if here is None else here.altitude_relative_m
        height = "     -" if altitude is None else f"{round(altitude, 1) + 0.0:6.1f}"
        self._last_line = self._vehicle.connection.now()
        seconds = self._last_line - self._started
        record = {"seconds": seconds, "altitude_relative_m": altitude, "text": text.strip()}
        self._tell("flight", record, f"{seconds:6.1f} s {height} m  {text}")

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

    def print_summary(self, recorded_in: str | None = None) -> None:
        """Print what was flown, how well the vehicle was heard, and what is left in the batteries."""
        vehicle = self._vehicle
        received, lost = vehicle.connection.counts(vehicle.system_id)
        seconds = vehicle.connection.now() - self._started
        version = vehicle.version.latest
        batteries = vehicle.batteries.latest or ()
        record = {
            "system_id": vehicle.system_id,
            "firmware": vehicle.autopilot.firmware,
            "version": None if version is None else str(version),
            "seconds": seconds,
            "flown_m": self._flown_m,
            "highest_m": self._highest_m,
            "fastest_m_s": self._fastest_m_s,
            "batteries": batteries,
            "frames_received": received,
            "frames_lost": lost,
            "armed": vehicle.is_armed,
            "mode": vehicle.mode_name,
            "recorded_in": recorded_in,
        }
        lines = [
            f"\n{vehicle.autopilot.firmware} {version or 'of unknown version'}, {seconds:.0f} s:"
            f" flown {self._flown_m:.0f} m, up to {self._highest_m:.1f} m high and {self._fastest_m_s:.1f} m/s fast",
            *(
                f"battery {battery.id}: {_number(battery.voltage_v, 'V')},"
                f" {_number(battery.remaining_percent, '%')} left"
                for battery in batteries
            ),
            f"{received} frames received, {lost} lost"
            + (f"; recorded in {recorded_in}" if recorded_in else ""),
        ]
        self._tell("flight_summary", record, "\n".join(lines))

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
            if not self.shows_life or vehicle.connection.now() - self._last_line < WAITING_S:
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

    def _tell(self, kind: str, record: Mapping[str, object], text: str) -> None:
        try:
            tell(self._options, kind, record, text)
        except OSError:
            sys.stdout = open(os.devnull, "w")  # noqa: SIM115 - for the rest of the program


def _number(value: float | None, unit: str) -> str:
    return "unknown" if value is None else f"{value:.4g} {unit}"
