"""``OwnFlight``: a flight that a command arms for, and what becomes of the vehicle when it fails or is interrupted."""

from __future__ import annotations

import asyncio
import contextlib
import os
import sys
from abc import ABC, abstractmethod
from contextlib import asynccontextmanager, suppress
from functools import partial
from typing import TYPE_CHECKING

import anyio

from aerokit import events
from aerokit.apps.cli.output import DONE, INTERRUPTED, tell
from aerokit.errors import (
    AerokitError,
    CommandRejected,
    HeartbeatTimeout,
    OperationRejected,
    OperationTimeout,
)
from aerokit.events import SILENT_AFTER_S
from aerokit.mavlink.enums import MavLandedState
from aerokit.vehicle.commanding.cleanup import LATE_S

if TYPE_CHECKING:
    import argparse
    from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
    from typing import Literal

    from aerokit.apps.cli.terminal import Interruptible
    from aerokit.position import Position
    from aerokit.vehicle.vehicle import Vehicle

    Purpose = Literal["mission", "hold", "land", "return", "take_off", "setpoint"]

ON_INTERRUPT: dict[str, str] = {
    "return": "returning to launch",
    "land": "landing here",
    "hold": "holding here",
    "nothing": "it is left to itself",
}
"""What Ctrl-C may end a flight with, and what is said then."""

DISARMS_WITHIN_S = 30.0


class OwnFlight(ABC):
    """Arms a vehicle and flies it, and says what becomes of it.

    Nothing is ordered of a vehicle that was armed before, or whose mode somebody else has changed since.
    """

    def __init__(
        self, vehicle: Vehicle, report: FlightReport, interruptible: Interruptible, on_interrupt: str
    ) -> None:
        self._vehicle, self._say, self._interruptible = vehicle, report.say, interruptible
        self._on_interrupt = on_interrupt
        self.is_ours: bool = False
        """Whether it was told to arm by us."""
        self._may_arm_late = False  # the order to arm has not come to its end
        self._modes_armed_in: set[str] = set()
        self._has_started = False  # it has left the mode in which it was armed, by our order

    async def fly(self) -> int:
        """Fly it to its end, and return the exit code; what ends it otherwise is raised, once it is safe or left."""
        try:
            code = await self._interruptible.run(self._fly)
        except Exception as error:  # whatever it is, what stands armed by our doing is not left so
            self._say(f"failed: {error}")
            if self.is_ours:
                await self._come_to_rest(partial(self._after_failure, error))
            raise
        if code is None:
            self._say(f"interrupted, {self._vehicle.describe_now()}")
            if self.is_ours:
                await self._come_to_rest(self._after_interrupt)
            return INTERRUPTED
        return code

    @abstractmethod
    async def _fly(self) -> int:
        """All of it, as it should go; the exit code."""

    @abstractmethod
    def _our_purposes(self) -> tuple[Purpose, ...]:
        """In the modes for which it is flown by us, and by nobody else."""

    # ------------------------------------------------------------------------------ as it should go

    def _check_disarmed(self) -> None:
        now = self._vehicle.describe_now()
        if self._vehicle.heartbeat_age > SILENT_AFTER_S:
            raise HeartbeatTimeout(f"whether somebody has armed it is not known ({now}); nothing was started")
        if not self._vehicle.is_surely_disarmed:
            raise OperationRejected(f"it is left to whoever armed it ({now}); nothing was started")

    async def _arm(self) -> None:
        self._check_disarmed()
        self.is_ours = self._may_arm_late = True
        self._modes_armed_in.add(self._vehicle.mode_name)
        try:
            await self._vehicle.arm()
        except CommandRejected:
            self._may_arm_late = False
            raise
        self._may_arm_late = False
        self._modes_armed_in.add(self._vehicle.mode_name)

    async def _wait_disarmed_on_ground(self) -> None:
        if self._vehicle.landed_state.latest == MavLandedState.ON_GROUND:
            with suppress(OperationTimeout):
                await self._vehicle.armed.wait_until(lambda armed: not armed, timeout=DISARMS_WITHIN_S)

    # ---------------------------------------------------------------------------------- otherwise

    async def _come_to_rest(self, action: Callable[[], Awaitable[int]]) -> None:
        """A second Ctrl-C, and whatever fails now, leaves it to itself."""
        try:
            if await self._interruptible.run(action) is None:
                self._say(f"interrupted again: left {self._vehicle.describe_now()}")
        except AerokitError as error:
            self._say(f"that failed, too: {error}")
            self._say(f"left {self._vehicle.describe_now()}")

    async def _after_failure(self, error: Exception) -> int:
        """Switch off what stands on the ground by our doing; what flies is left to its mission, pilot or failsafe."""
        vehicle = self._vehicle
        if vehicle.is_surely_disarmed:
            await self._watch_late_arming()
        elif self._stands_armed and self._is_in_our_mode:
            await self._disarm()
        else:
            self._say(f"no order is given: left {vehicle.describe_now()}")
        return DONE

    async def _after_interrupt(self) -> int:
        """Switch off what stands on the ground; what flies does what Ctrl-C is to do, if it is flown by us."""
        vehicle, wanted = self._vehicle, self._on_interrupt
        if vehicle.is_surely_disarmed:
            await self._watch_late_arming()
            return DONE
        if not self._is_left_to_us():
            return DONE
        if self._stands_armed and wanted != "nothing":
            try:
                await self._disarm()
            except CommandRejected as error:  # it has left the ground since it told where it is
                self._say(f"it does not disarm: {error}")
            if vehicle.is_surely_disarmed or not self._is_left_to_us():
                return DONE
        self._say(
            ON_INTERRUPT[wanted] + ("" if wanted == "nothing" else "; Ctrl-C again to leave it to itself")
        )
        if wanted == "return":
            await vehicle.return_to_launch(timeout=None)
        elif wanted == "land":
            await vehicle.land(timeout=None)
        elif wanted == "hold":
            await vehicle.hold()
        if wanted in ("return", "land"):
            await self._wait_disarmed_on_ground()
        self._say(vehicle.describe_now())
        return DONE

    async def _watch_late_arming(self) -> None:
        """An order to arm that was given up may still arrive: while we are connected, it is disarmed then."""
        if not self._may_arm_late:
            return
        self._say(
            f"the order to arm may still be carried out: watched for {LATE_S:g} s, and disarmed if it arms;"
            " Ctrl-C again to leave it"
        )
        armed = self._vehicle.armed
        with suppress(OperationTimeout):
            await armed.wait_until(bool, timeout=LATE_S)
            await armed.wait_until(lambda armed: not armed, timeout=DISARMS_WITHIN_S)
        self._say(self._vehicle.describe_now())

    async def _disarm(self) -> None:
        self._say("on the ground and armed; disarming")
        await self._vehicle.disarm()
        self._say("disarmed")

    def _is_left_to_us(self) -> bool:
        if not self._is_in_our_mode:
            mode, now = self._vehicle.mode_name, self._vehicle.describe_now()
            self._say(f"left to whoever put it into {mode}: {now}")
        return self._is_in_our_mode

    @property
    def _stands_armed(self) -> bool:
        return self._vehicle.is_armed and self._vehicle.landed_state.latest == MavLandedState.ON_GROUND

    @property
    def _is_in_our_mode(self) -> bool:
        vehicle = self._vehicle
        if not self._has_started and vehicle.mode_name in self._modes_armed_in:
            return True
        mode_for, is_vtol = vehicle.autopilot.mode_for, vehicle.is_vtol
        modes = [mode_for(purpose, is_vtol=is_vtol) for purpose in self._our_purposes()]
        return vehicle.mode_name in [mode.name for mode in modes if mode is not None]


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
