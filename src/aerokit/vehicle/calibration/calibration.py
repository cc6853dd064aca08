"""``CalibrationControl``: the calibrations of a vehicle, and ``Calibration``: the steps of one."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Literal

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
"""Confirms that the motors may turn."""


class Calibration(AsyncIterator["CalibrationStep"]):
    """The steps of a calibration: iterate with ``async for``. The last step has the ``result``.

    The calibration starts with the first step. Leaving the loop, in any way, cancels it on the vehicle, as does the end
    of the vehicle's block. ArduPilot cannot cancel ``accelerometer``; a warning says so. Others that no vehicle cancels
    (level, barometer, ArduPilot's gyroscope and airspeed, PX4's ESCs) end in seconds.

    Iterating raises:
        OperationRejected: the calibration failed, or was cancelled by another party, with the vehicle's texts as
            reasons; or the vehicle is armed, or not known to be disarmed.
        NotSupported: the vehicle has no such sensor or calibration. Nothing was sent.
        CommandRejected: the vehicle refused to start.
        CommandTimeout: the vehicle did not answer.
        OperationTimeout: the vehicle reported nothing for two minutes, or its result was lost.
        HeartbeatTimeout: the vehicle was silent for 10 s.
        BusyError: another calibration of this vehicle is in progress. Nothing was sent.
        ConnectionClosed, LinkLost: the connection has ended.
    """

    def __init__(self, run: CalibrationRun, steps: AsyncGenerator[CalibrationStep, None]) -> None:
        self._run, self._steps = run, steps
        self._loop: asyncio.AbstractEventLoop | None = None
        self._is_over = False

    def __aiter__(self) -> Calibration:
        return self

    async def __anext__(self) -> CalibrationStep:
        if self._is_over:
            raise StopAsyncIteration
        self._loop = asyncio.get_running_loop()
        try:
            return await self._steps.__anext__()
        except BaseException:
            self._is_over = True
            self._run.abandon()
            raise

    async def cancel(self) -> None:
        """Cancel the calibration; returns when the vehicle has confirmed it.

        Does nothing if the calibration has not started or has ended.

        Raises:
            NotSupported: the vehicle cannot cancel it.
            OperationTimeout: the vehicle did not confirm it.
        """
        self._is_over = True
        await self._steps.aclose()
        if self._run.is_running:
            self._run.abandon()
            await self._run.wait_cancelled()

    def __del__(self) -> None:
        # ``break`` leaves a loop without telling the iterator. The blocking twin drops it on another thread.
        if getattr(self, "_loop", None) is not None and not self._is_over:
            with suppress(RuntimeError):  # the loop is closed
                self._loop.call_soon_threadsafe(_abandon, self._run, self._steps)  # type: ignore[union-attr]


def _abandon(run: CalibrationRun, steps: AsyncGenerator[CalibrationStep, None]) -> None:
    run.abandon()
    run.session.background.start(steps.aclose, "aerokit calibration")


@checks_arguments
class CalibrationControl:
    """Calibrates the vehicle's sensors: ``async for step in vehicle.calibrate.compass(): …``.

    Each method returns the steps. Print ``step.instruction``, show ``step.pose``; where ``step.needs_confirmation`` is
    true, the calibration waits until the loop continues. See docs/how-to/calibration.md. Only one calibration runs at a
    time, on a disarmed vehicle.
    """

    def __init__(self, context: VehicleContext, parameters: Callable[[], Parameters]) -> None:
        self._context, self._parameters = context, parameters
        self._runs: list[CalibrationRun] = []

    def compass(self) -> Calibration:
        """Calibrate all compasses, while the vehicle is turned about all axes.

        ArduPilot reports progress and fitness of each compass, and must reboot afterwards. PX4 wants up to six poses,
        turned about the vertical in each.
        """
        return self._start("compass", procedures.ardupilot_compass, 0, 1)

    def accelerometer(self) -> Calibration:
        """Calibrate the accelerometers in six poses.

        ArduPilot waits for a confirmation in each pose, and must reboot afterwards. PX4 detects poses, in any order.
        """
        return self._start("accelerometer", procedures.ardupilot_accelerometer, 0, 0, 0, 0, 1)

    def gyroscope(self) -> Calibration:
        """Calibrate the gyroscopes, while the vehicle stands still."""
        return self._start("gyroscope", _acknowledged("keep the vehicle still"), 1)

    def level(self) -> Calibration:
        """Calibrate which attitude is level, while the vehicle stands level and still."""
        return self._start("level", _acknowledged("place the vehicle level and keep it still"), 0, 0, 0, 0, 2)

    def barometer(self) -> Calibration:
        """Calibrate the barometer: ArduPilot by the present pressure, PX4 by the altitude of the GPS."""
        return self._start("barometer", _acknowledged("shelter the vehicle from wind"), 0, 0, 1)

    def airspeed(self) -> Calibration:
        """Calibrate the airspeed sensors: sheltered from wind first; on PX4, blow into the front afterwards."""
        return self._start("airspeed", procedures.ardupilot_airspeed, 0, 0, 0, 0, 0, 2)

    def radio(self) -> Calibration:
        """Calibrate the remote control: writes RCn_MIN, RCn_MAX and RCn_TRIM of each channel that was moved.

        Both confirmations are needed: when all sticks and switches were at their ends, and when the sticks are centred.
        """
        return self._start("radio", procedures.radio_by_channels, px4=procedures.radio_by_channels)

    def escs(self, *, intent: EscIntent) -> Calibration:
        """Calibrate the ESCs. **Remove the propellers**, because the motors get full throttle.

        PX4 does it at once, while you connect the battery. ArduCopter does it at the next boot: the last step says so.

        Args:
            intent: ``"propellers are removed"``.

        Raises:
            InvalidArgument: the intent is another text. Nothing was sent.
        """
        return self._start("escs", procedures.ardupilot_escs, 0, 0, 0, 0, 0, 0, 1)

    def _start(
        self, sensor: str, ardupilot: Procedure, *params: float, px4: Procedure = procedures.by_texts
    ) -> Calibration:
        """Prepare a calibration. PX4 gets ``params`` in its command, as does ArduPilot in its simplest procedures."""
        run = CalibrationRun(self._context, sensor, self._runs, self._parameters)
        is_px4 = self._context.session.autopilot.calibration_protocol == "texts"
        return Calibration(run, (px4 if is_px4 else ardupilot)(run, *params))


def _acknowledged(instruction: str) -> Procedure:
    return partial(procedures.acknowledged, instruction=instruction)
