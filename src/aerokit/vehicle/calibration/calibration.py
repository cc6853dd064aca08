"""``CalibrationControl`` starts the calibrations of a vehicle; ``Calibration`` iterates over the steps of one."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Literal

import anyio

from aerokit._internal.arguments import checks_arguments
from aerokit.vehicle.calibration import procedures
from aerokit.vehicle.calibration.run import CalibrationRun

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Callable

    from aerokit.vehicle.calibration.values import CalibrationStep
    from aerokit.vehicle.commanding.context import VehicleContext
    from aerokit.vehicle.parameters.parameters import Parameters

    Procedure = Callable[..., AsyncGenerator[CalibrationStep, None]]

__all__ = ["Calibration", "CalibrationControl", "EscIntent"]

EscIntent = Literal["propellers are removed"]
"""Text with which the caller confirms that the motors may turn."""


class Calibration(AsyncIterator["CalibrationStep"]):
    """The steps of a calibration: iterate with ``async for``. The last step has the ``result``.

    The calibration starts with the first step. Leaving the loop before the last step, or leaving the vehicle's
    ``async with`` block, cancels the calibration on the vehicle. ArduPilot cannot cancel ``accelerometer``, and aerokit
    then logs a warning. The other calibrations that a vehicle cannot cancel (level, barometer, ArduPilot's gyroscope
    and airspeed, PX4's ESCs) end in seconds.

    Iterating raises:
        OperationRejected: the calibration failed, or another ground station cancelled it (``reasons`` has the vehicle's
            status texts); or the vehicle is armed, or not known to be disarmed.
        NotSupported: the vehicle has no such sensor or calibration. Nothing was sent.
        CommandRejected: the vehicle refused to start.
        CommandTimeout: the vehicle did not answer.
        OperationTimeout: the vehicle reported nothing for two minutes, or its status text with the result was lost.
        HeartbeatTimeout: the vehicle was silent for 10 s.
        BusyError: another calibration of this vehicle is in progress. Nothing was sent.
        ConnectionClosed, LinkLost: the connection has ended.
    """

    def __init__(self, run: CalibrationRun, steps: AsyncGenerator[CalibrationStep, None]) -> None:
        self._run, self._steps = run, steps
        # The event loop of the iteration; None before the first step.
        self._loop: asyncio.AbstractEventLoop | None = None
        self._is_over = False
        # `_lock` is held while a task waits for the next step. `_wait_scope` is the scope in which that task waits.
        self._lock = asyncio.Lock()
        self._wait_scope: anyio.CancelScope | None = None

    def __aiter__(self) -> Calibration:
        return self

    async def __anext__(self) -> CalibrationStep:
        if self._is_over:
            raise StopAsyncIteration
        self._loop = asyncio.get_running_loop()  # `__del__` needs it, and may run on another thread.
        try:
            async with self._lock:
                with anyio.CancelScope() as self._wait_scope:
                    return await self._steps.__anext__()
        except BaseException:  # No step follows. `abandon` does nothing if the calibration has ended on the vehicle.
            self._is_over = True
            self._run.abandon()
            raise
        raise StopAsyncIteration  # `cancel` has ended the wait for the step.

    async def cancel(self) -> None:
        """Cancel the calibration, and return when the vehicle has confirmed the end.

        Sends nothing if the calibration has not started or has ended. The iterator ends in any case, also for a task
        that is waiting for the next step.

        Raises:
            NotSupported: the vehicle cannot cancel this calibration.
            OperationTimeout: the vehicle did not confirm the end.
        """
        self._is_over = True
        if self._wait_scope is not None:
            self._wait_scope.cancel()
        async with self._lock:  # The task that was waiting has left the generator.
            await self._steps.aclose()
        if self._run.is_running:
            self._run.abandon()
            await self._run.wait_cancelled()

    def __del__(self) -> None:
        # A loop that is left by `break` does not call the iterator, so the iterator cancels the calibration when it is
        # deleted. In the blocking API, another thread may delete it.
        is_started = getattr(self, "_loop", None) is not None  # If `__init__` failed, there is no such attribute.
        if is_started and not self._is_over:
            with suppress(RuntimeError):  # The event loop may be closed.
                self._loop.call_soon_threadsafe(_abandon, self._run, self._steps)  # type: ignore[union-attr]


def _abandon(run: CalibrationRun, steps: AsyncGenerator[CalibrationStep, None]) -> None:
    run.abandon()
    run.session.background.start(steps.aclose, "aerokit calibration")


@checks_arguments
class CalibrationControl:
    """Calibrates the vehicle's sensors: ``async for step in vehicle.calibrate.compass(): …``.

    Each method returns an iterator over the steps. Show ``step.instruction`` and ``step.pose`` to the person at the
    vehicle. If ``step.needs_confirmation`` is true, the calibration waits until your loop asks for the next step. The
    vehicle must be disarmed, and only one calibration runs at a time. See docs/how-to/calibration.md.
    """

    def __init__(self, context: VehicleContext, parameters: Callable[[], Parameters]) -> None:
        self._context, self._parameters = context, parameters
        self._runs: list[CalibrationRun] = []

    def compass(self) -> Calibration:
        """Calibrate all compasses, while a person turns the vehicle about all its axes.

        ArduPilot reports progress and fitness of each compass, and must be rebooted afterwards. PX4 asks for up to six
        poses, and for a turn about the vertical axis in each.
        """
        return self._prepare("compass", procedures.ardupilot_compass, command_param=2)

    def accelerometer(self) -> Calibration:
        """Calibrate the accelerometers in six poses.

        ArduPilot waits for a confirmation in each pose, and must be rebooted afterwards. PX4 detects the poses itself,
        in any order.
        """
        return self._prepare("accelerometer", procedures.ardupilot_accelerometer, command_param=5)

    def gyroscope(self) -> Calibration:
        """Calibrate the gyroscopes, while the vehicle stands still."""
        return self._prepare("gyroscope", _single_command("keep the vehicle still"), command_param=1)

    def level(self) -> Calibration:
        """Calibrate the level attitude, while the vehicle stands level and still."""
        procedure = _single_command("place the vehicle level and keep it still")
        return self._prepare("level", procedure, command_param=5, param_value=2)

    def barometer(self) -> Calibration:
        """Calibrate the barometer.

        ArduPilot uses the present pressure as the pressure on the ground; PX4 uses the GPS altitude.
        """
        return self._prepare("barometer", _single_command("shelter the vehicle from wind"), command_param=3)

    def airspeed(self) -> Calibration:
        """Calibrate the airspeed sensors. Shelter them from wind. PX4 later asks a person to blow into the tube."""
        return self._prepare("airspeed", procedures.ardupilot_airspeed, command_param=6, param_value=2)

    def radio(self) -> Calibration:
        """Calibrate the remote control: write RCn_MIN, RCn_MAX and RCn_TRIM of each channel that was moved.

        Two steps need a confirmation: one after all sticks and switches were moved to their ends, one after the sticks
        were centered, with the throttle at its lowest.
        """
        return self._prepare("radio", procedures.radio_by_channels, px4=procedures.radio_by_channels)

    def escs(self, *, intent: EscIntent) -> Calibration:
        """Calibrate the ESCs. **Remove the propellers**, because the motors get full throttle.

        PX4 calibrates at once, while a person connects the battery. ArduCopter calibrates at its next boot; the last
        step asks the person to reconnect the battery.

        Args:
            intent: must be ``"propellers are removed"``, so that the motors are never started by mistake.

        Raises:
            InvalidArgument: the intent is another text. Nothing was sent.
        """
        # The decorator `checks_arguments` has refused every other intent.
        return self._prepare("escs", procedures.ardupilot_escs, command_param=7)

    def _prepare(
        self,
        sensor: str,
        ardupilot: Procedure,
        *,
        px4: Procedure = procedures.px4_by_status_texts,
        command_param: int = 0,
        param_value: float = 1,
    ) -> Calibration:
        """Return a calibration that has not started yet.

        ``command_param`` is the number (from 1) of the MAV_CMD_PREFLIGHT_CALIBRATION parameter that is set to
        ``param_value``; 0 if the procedure needs no parameters.
        """
        run = CalibrationRun(self._context, sensor, self._runs, self._parameters)
        is_px4 = self._context.session.autopilot.calibration_protocol == "texts"
        procedure = px4 if is_px4 else ardupilot
        params: tuple[float, ...] = ()
        if command_param:
            params_before = (0,) * (command_param - 1)
            params = (*params_before, param_value)
        return Calibration(run, procedure(run, *params))


def _single_command(instruction: str) -> Procedure:
    return partial(procedures.ardupilot_single_command, instruction=instruction)
