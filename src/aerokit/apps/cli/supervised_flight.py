"""Base class of commands that arm and fly a vehicle, with the handling of failures and Ctrl-C."""

from __future__ import annotations

import asyncio
import os
import shlex
import sys
from abc import ABC, abstractmethod
from collections import deque
from contextlib import asynccontextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import anyio

from aerokit import events
from aerokit.apps.cli.output import DONE, INTERRUPTED, MAX_UNPRINTED, MISSION_TEXT, can_print, emit, plain_text
from aerokit.apps.readiness import arms_but_cannot_fly_text, readiness
from aerokit.errors import (
    AerokitError,
    CommandRejected,
    CommandTimeout,
    HeartbeatTimeout,
    OperationRejected,
    OperationTimeout,
)
from aerokit.events import SILENT_AFTER_S
from aerokit.logs.flights.recording import ClockComparison, is_real_time
from aerokit.mavlink.messages import GlobalPositionInt
from aerokit.vehicle.commanding.cleanup import ARM_WATCH_S
from aerokit.vehicle.commanding.ground import IMPACT_M_S
from aerokit.vehicle.commanding.progress import HIT_GROUND
from aerokit.vehicle.state.telemetry import is_reported_on_ground

if TYPE_CHECKING:
    import argparse
    from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
    from typing import Literal

    from aerokit.apps.cli.terminal import InterruptStack
    from aerokit.autopilots.modes import Mode
    from aerokit.position import Position
    from aerokit.vehicle.state.movement import Velocity
    from aerokit.vehicle.vehicle import Vehicle

    Purpose = Literal["mission", "hold", "land", "return", "take_off", "setpoint"]

INTERRUPT_ACTIONS: dict[str, str] = {
    "return": "returning to launch",
    "land": "landing here",
    "hold": "holding here",
    "nothing": "no command is sent",
}
"""Maps choices of ``--on-interrupt`` to the texts that are printed when they are performed."""
_AUTO_DISARM_TIMEOUT_S = 30.0
_WARNING_SEVERITY = 4
# If nothing was printed for this time, a status line is printed.
_STATUS_INTERVAL_S = 5.0
_MIN_STEP_M = 1.0


class SupervisedFlight(ABC):
    """Arms and flies a vehicle, and brings it to a safe state after a failure or Ctrl-C.

    It never commands a vehicle that was armed before the flight, or that another party has put into another mode.
    """

    _prints_reasons = True  # False if the command prints the error with all reasons at its end

    def __init__(self, vehicle: Vehicle, report: FlightReport, interrupts: InterruptStack, on_interrupt: str) -> None:
        self._vehicle = vehicle
        self._interrupts = interrupts
        self._report = report
        self._print = report.print_line
        self._on_interrupt = on_interrupt
        self.has_sent_arm_command: bool = False
        """True once this program has sent an arm command, even if the vehicle has refused it."""
        self._may_arm_late = False  # True while the result of a sent arm command is unknown
        self._modes_armed_in: set[str] = set()
        self._has_changed_mode = False  # True once a command of this program has changed the mode after arming
        self._has_left_mode = False  # True once the armed vehicle was in a mode that is not in `_modes_armed_in`

    async def fly(self) -> int:
        """Perform the flight, and return the exit code.

        After an error or Ctrl-C, make the vehicle safe. Then raise the error again.
        """
        try:
            code = await self._interrupts.run(self._fly)
        except Exception as error:
            # All errors are caught, because a vehicle that this program has armed must not stay armed on the ground.
            text = plain_text(error)
            if not self._prints_reasons:  # the reasons follow the first line of the text
                text = text.partition("\n")[0].removesuffix("; still missing:")
            self._print(f"failed: {text}")
            if HIT_GROUND in str(error):
                self._report.record_impact()
            if self.has_sent_arm_command:
                await self._make_safe(partial(self._after_failure, error))
            raise
        if code is None:
            self._print(f"interrupted, {self._vehicle.describe_now()}")
            if self.has_sent_arm_command:
                await self._make_safe(self._after_interrupt)
            return INTERRUPTED
        return code

    @abstractmethod
    async def _fly(self) -> int: ...

    @abstractmethod
    def _our_purposes(self) -> tuple[Purpose, ...]:
        """Return the purposes (such as "mission") of the modes in which this program has control."""

    def _check_disarmed(self) -> None:
        now = self._vehicle.describe_now()
        if self._vehicle.heartbeat_age > SILENT_AFTER_S:
            raise HeartbeatTimeout(f"cannot check whether the vehicle is armed ({now}); nothing was started")
        if not self._vehicle.is_confirmed_disarmed:
            raise OperationRejected(f"the vehicle was armed by another party ({now}); nothing was started")

    async def _arm(self) -> None:
        self._check_disarmed()
        # Recorded before the command is sent, because the result of the command may remain unknown.
        self.has_sent_arm_command = True
        self._may_arm_late = True
        self._modes_armed_in.add(self._vehicle.mode_name)  # `arm` may change the mode, so both modes are recorded
        try:
            await self._vehicle.arm()
        except CommandRejected:
            self._may_arm_late = False
            raise
        self._may_arm_late = False
        self._modes_armed_in.add(self._vehicle.mode_name)
        self._vehicle.mode.observe(self._on_mode)

    def _on_mode(self, _: Mode | None, mode: Mode) -> None:
        self._has_left_mode = self._has_left_mode or mode.name not in self._modes_armed_in

    async def _wait_disarmed_on_ground(self) -> None:
        if is_reported_on_ground(self._vehicle.telemetry):
            with suppress(OperationTimeout):
                await self._vehicle.armed.wait_until(lambda armed: not armed, timeout=_AUTO_DISARM_TIMEOUT_S)

    async def _make_safe(self, action: Callable[[], Awaitable[int]]) -> None:
        """Run an action that makes the vehicle safe. After an error or another Ctrl-C, send no further commands."""
        try:
            if await self._interrupts.run(action) is None:
                self._print(f"interrupted again; no further commands: vehicle {self._vehicle.describe_now()}")
        except AerokitError as error:
            self._print(f"failed again: {plain_text(error)}")
            advice = "; take over, or command it from another ground station" if self._vehicle.is_armed else ""
            self._print(f"no further commands: vehicle {self._vehicle.describe_now()}{advice}")

    async def _after_failure(self, error: Exception) -> int:  # subclasses use the error
        """Make the vehicle safe after an error. The exit code is not used."""
        vehicle = self._vehicle
        if vehicle.is_confirmed_disarmed:
            await self._watch_late_arming()
        elif self._is_armed_on_ground and self._is_in_our_mode:
            await self._disarm()
        else:
            # A vehicle in the air is left to its pilot or its failsafes.
            self._print(f"no command is sent: vehicle {vehicle.describe_now()}")
        return DONE

    async def _after_interrupt(self) -> int:
        """Disarm a vehicle on the ground. In the air, perform the action of ``--on-interrupt``.

        No command is sent if this program no longer has control.
        """
        vehicle = self._vehicle
        action = self._on_interrupt
        if vehicle.is_confirmed_disarmed:
            await self._watch_late_arming()
            return DONE
        if not self._still_has_control():
            return DONE
        if self._is_armed_on_ground and action != "nothing":
            try:
                await self._disarm()
            except (OperationRejected, CommandTimeout) as error:
                # The vehicle may have taken off after it reported its landed state.
                self._print(f"disarming failed: {plain_text(error)}")
            if vehicle.is_confirmed_disarmed or not self._still_has_control():
                return DONE
            # Disarming has failed, so the vehicle gets the command for a flying vehicle.
        text = INTERRUPT_ACTIONS[action]
        self._print(text if action == "nothing" else f"{text}; Ctrl-C exits at once")
        try:
            if action == "return":
                await vehicle.return_to_launch(timeout=None)
            elif action == "land":
                await vehicle.land(timeout=None)
            elif action == "hold":
                await vehicle.hold()
        except CommandRejected as error:
            # If the action fails (autopilots refuse to return without a position), the vehicle is told to hold instead.
            if action == "hold" or not self._still_has_control():
                raise
            self._print(f"{text} failed: {plain_text(error)}; {INTERRUPT_ACTIONS['hold']} instead")
            await vehicle.hold()
        if action in ("return", "land"):
            await self._wait_disarmed_on_ground()
        self._print(vehicle.describe_now())
        return DONE

    async def _watch_late_arming(self) -> None:
        """Stay connected while an arm command may still take effect.

        If the vehicle arms, wait up to 30 s until it is disarmed again.
        """
        if not self._may_arm_late:
            return
        self._print(
            f"the arm command may still take effect: waiting {ARM_WATCH_S:g} s to disarm the vehicle if it arms;"
            " press Ctrl-C again to exit now"
        )
        armed = self._vehicle.armed
        with suppress(OperationTimeout):
            # If the vehicle arms, a background task of `Vehicle.arm` disarms it again.
            await armed.wait_until(bool, timeout=ARM_WATCH_S)
            await armed.wait_until(lambda is_armed: not is_armed, timeout=_AUTO_DISARM_TIMEOUT_S)
        self._print(self._vehicle.describe_now())

    async def _disarm(self) -> None:
        self._print("on the ground and armed; disarming")
        await self._vehicle.disarm()
        self._print("disarmed")

    def _still_has_control(self) -> bool:
        """Return True if this program still has control. Otherwise, print why no command is sent."""
        if not self._is_in_our_mode:
            self._print(
                "no command is sent, because the vehicle itself or another party changed the mode to"
                f" {self._vehicle.mode_name}: {self._vehicle.describe_now()}"
            )
        return self._is_in_our_mode

    @property
    def _is_armed_on_ground(self) -> bool:
        return self._vehicle.is_armed and is_reported_on_ground(self._vehicle.telemetry)

    @property
    def _is_in_our_mode(self) -> bool:
        vehicle = self._vehicle
        has_only_armed = not (self._has_changed_mode or self._has_left_mode)
        if has_only_armed and vehicle.mode_name in self._modes_armed_in:
            return self._is_armed_on_ground  # This program has not taken off: in the air, a pilot flies.
        modes = [vehicle.autopilot.mode_for(purpose, is_vtol=vehicle.is_vtol) for purpose in self._our_purposes()]
        return vehicle.mode_name in [mode.name for mode in modes if mode is not None]


class FlightReport:
    """Prints the progress of a flight and the vehicle's status texts, and measures the track.

    ``speedup`` is the speed of the simulation, 1.0 for a real vehicle. Printed durations are simulated time.
    """

    def __init__(self, vehicle: Vehicle, options: argparse.Namespace, speedup: float) -> None:
        self._vehicle = vehicle
        self._options = options
        self.speedup: float = speedup
        self._clocks = ClockComparison()
        # These times are of this computer's clock. The clock of a simulated vehicle may run faster.
        self._armed_at: float | None = None
        self._armed_s = 0.0
        self._fast_sink_at: float | None = None  # when the vehicle last descended at IMPACT_M_S or faster
        self._impact_s: float | None = None  # seconds from arming to an impact on the ground
        self._started_at = vehicle.connection.now()
        self._last_line_at = self._started_at
        self._highest_m = 0.0
        self._fastest_m_s = 0.0
        self._flown_m = 0.0
        self._previous_position: Position | None = None
        # Arguments of `emit` that wait until the output accepts them, oldest first.
        self._unprinted: deque[tuple[str, Mapping[str, object], str]] = deque(maxlen=MAX_UNPRINTED)
        self.prints_status: bool = True
        """True if status lines are printed when there is no other output. Set it to False during questions."""

    def print_line(self, text: str) -> None:
        cell = self._vehicle.position
        is_recent = max(self._vehicle.heartbeat_age, cell.age) <= SILENT_AFTER_S
        position = cell.latest if is_recent else None
        altitude = None if position is None else position.altitude_relative_m
        height = "     -" if altitude is None else f"{round(altitude, 1) + 0.0:6.1f}"  # + 0.0 converts -0.0 to 0.0
        self._last_line_at = self._vehicle.connection.now()
        seconds = self.speedup * (self._last_line_at - self._started_at)
        record = {"seconds": seconds, "altitude_relative_m": altitude, "text": text.strip()}
        self._emit("flight", record, f"{seconds:6.1f} s {height} m  {text}")

    @asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        detachments = [
            self._vehicle.position.observe(self._on_position),
            self._vehicle.armed.observe(self._on_armed),
            self._vehicle.velocity.observe(self._on_velocity, every_arrival=True),
        ]
        tasks = [
            asyncio.create_task(coroutine)
            for coroutine in (self._print_events(), self._print_status(), self._compare_clocks())
        ]
        try:
            yield
        finally:
            for detach in detachments:
                detach()
            for task in tasks:
                task.cancel()
            with anyio.CancelScope(shield=True):
                await asyncio.wait(tasks)  # asyncio itself logs the error of a task that has failed

    def record_impact(self) -> None:
        if self._impact_s is None and self._armed_at is not None:
            # The impact is detected after the vehicle has lain still. It happened at the end of the last fast descent.
            impact_at = self._vehicle.connection.now() if self._fast_sink_at is None else self._fast_sink_at
            self._impact_s = self._armed_s + impact_at - self._armed_at

    def print_summary(self, recorded_in: str | None = None) -> None:
        vehicle = self._vehicle
        received, lost = vehicle.connection.counts(vehicle.system_id)
        # The clock of a vehicle reveals a simulation that this program has not started itself.
        measured_speed = self._clocks.speed
        is_unknown_simulation = self.speedup == 1.0 and not is_real_time(measured_speed)
        speed = measured_speed if is_unknown_simulation else self.speedup
        seconds = speed * (vehicle.connection.now() - self._started_at)
        self._add_armed_time()
        version = vehicle.version.latest
        batteries = vehicle.batteries.latest or ()
        record = {
            "system_id": vehicle.system_id,
            "firmware": vehicle.autopilot.firmware,
            "version": None if version is None else str(version),
            "seconds": seconds,
            "armed_seconds": speed * self._armed_s,
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
            f"\n{vehicle.autopilot.firmware} {version or '(unknown version)'},"
            f" {self._describe_armed(speed)}:"
            f" flown {self._flown_m:.0f} m, max height {self._highest_m:.1f} m,"
            f" max ground speed {self._fastest_m_s:.1f} m/s",
            *(
                f"battery {battery.id + 1}: {_number_text(battery.voltage_v, 'V')},"
                f" {_number_text(battery.remaining_percent, '%')} left"
                for battery in batteries
            ),
        ]
        frames = f"{received} frames received, {lost} lost"
        if recorded_in:
            # A report of an earlier flight is replaced only with --force.
            force = "--force " if Path(recorded_in).with_suffix(".html").exists() else ""
            lines.append(f"{frames}; recorded in {recorded_in}")
            lines.append(f"next: aerokit report {force}{shlex.quote(recorded_in)}")
        else:
            lines += [frames, "next time: --record FILE.tlog records the flight for `aerokit report FILE.tlog`"]
        self._emit("flight_summary", record, "\n".join(lines), may_block=True)  # may block, because the flight is over

    def _describe_armed(self, speed: float) -> str:
        """Return "armed for 47 s", with notes on an impact and on the speed of a simulation.

        ``speed`` is the vehicle's seconds per real second.
        """
        notes = []
        if self._impact_s is not None:
            notes.append(f"{_duration_text(speed * self._impact_s)} until the impact")
        if self.speedup != 1.0:
            notes.append(f"simulated in {_duration_text(self._armed_s)}, {speed:g}x")
        elif speed != 1.0:
            factor = f"{round(speed, 1):g}"
            notes.append(f"a simulation at {factor} times real speed: {_duration_text(self._armed_s)} on this clock")
        return f"armed for {_duration_text(speed * self._armed_s)}" + (f" ({'; '.join(notes)})" if notes else "")

    def _on_armed(self, _: bool | None, is_armed: bool) -> None:
        self._add_armed_time()
        self._armed_at = self._vehicle.connection.now() if is_armed else None

    def _add_armed_time(self) -> None:
        """Add the time since arming to the seconds armed. Does nothing if the vehicle is disarmed."""
        if self._armed_at is not None:
            self._armed_s += self._vehicle.connection.now() - self._armed_at
            self._armed_at = None

    async def _compare_clocks(self) -> None:
        with self._vehicle.subscribe(GlobalPositionInt, capacity=100) as messages, suppress(AerokitError):
            async for message in messages:
                self._clocks.compare(self._vehicle.connection.now(), message.time_boot_ms)

    async def _print_events(self) -> None:
        with (
            self._vehicle.subscribe(events.StatusTextReceived, events.ModeChanged, capacity=100) as messages,
            suppress(AerokitError),
        ):
            async for event in messages:
                if isinstance(event, events.ModeChanged):
                    self.print_line(f"  mode {event.after}")
                elif isinstance(event, events.StatusTextReceived) and not MISSION_TEXT.match(event.text):
                    is_warning = event.severity <= _WARNING_SEVERITY and not self._is_about_mode(event.text)
                    self.print_line(f"  {'! ' if is_warning else ''}{event.text}")

    def _is_about_mode(self, text: str) -> bool:
        """Return True for a text like "Arm: AUTO mode not armable"."""
        # `Vehicle.arm` solves this problem without the user: it changes the mode and arms again.
        autopilot = self._vehicle.autopilot
        mode = self._vehicle.mode_name
        return mode in autopilot.armable_by_option and autopilot.arming_reason(text) == f"{mode} mode not armable"

    async def _print_status(self) -> None:
        connection = self._vehicle.connection
        while connection.is_open:
            await anyio.sleep(_STATUS_INTERVAL_S / 5)
            is_due = connection.now() - self._last_line_at >= _STATUS_INTERVAL_S
            if self.prints_status and is_due:
                self.print_line(f"  {self._status_text()}")

    def _status_text(self) -> str:
        vehicle = self._vehicle
        if vehicle.heartbeat_age > SILENT_AFTER_S:
            position = vehicle.position.latest
            height = None if position is None else position.altitude_relative_m
            height_text = "" if height is None else f" at {height:.1f} m"
            seconds = self.speedup * vehicle.heartbeat_age
            return f"silent for {seconds:.0f} s; last received: {vehicle.mode_name}{height_text}"
        if not vehicle.is_armed:
            checks = readiness(vehicle, changes_mode=True)
            if checks.against_arming:  # "cannot arm yet: …" or "not known whether it arms: …"
                yet = " yet" if checks.is_known else ""
                return f"{checks.prefix}{yet}: {'; '.join([*checks.against_arming, *checks.against_flight])}"
            if checks.against_flight:
                return f"{arms_but_cannot_fly_text(vehicle)}: {'; '.join(checks.against_flight)}"
        speed = vehicle.ground_speed_m_s
        speed_text = f"{speed.value:.1f} m/s" if speed.age <= SILENT_AFTER_S else "speed unknown"
        return f"{vehicle.mode_name}, {speed_text}"

    def _on_velocity(self, _: Velocity | None, velocity: Velocity) -> None:
        if velocity.down_m_s >= IMPACT_M_S:
            self._fast_sink_at = self._vehicle.velocity.updated_at

    def _on_position(self, _: Position | None, position: Position) -> None:
        if not self._vehicle.is_armed:
            self._previous_position = None
            return
        # As in reports, the distance is measured between positions at least a metre apart.
        step_m = 0.0 if self._previous_position is None else position.distance_to(self._previous_position)
        if self._previous_position is None or step_m >= _MIN_STEP_M:
            self._flown_m += step_m
            self._previous_position = position
        self._highest_m = max(self._highest_m, position.altitude_relative_m or 0.0)
        self._fastest_m_s = max(self._fastest_m_s, self._vehicle.ground_speed_m_s.latest or 0.0)

    def _emit(self, kind: str, record: Mapping[str, object], text: str, *, may_block: bool = False) -> None:
        self._unprinted.append((kind, record, text))
        try:
            while self._unprinted and (may_block or can_print()):
                emit(self._options, *self._unprinted.popleft())
        except OSError:
            sys.stdout = open(os.devnull, "w")  # noqa: SIM115 - used until the process ends


def _duration_text(seconds: float) -> str:
    minutes, remaining_s = divmod(round(seconds), 60)
    return f"{minutes} min {remaining_s:02} s" if minutes else f"{remaining_s} s"


def _number_text(value: float | None, unit: str) -> str:
    return "unknown" if value is None else f"{value:.4g} {unit}"
