"""Calls of CalibrationControl that succeed, and calls that fail."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any

import anyio
from call_stage import Stage, armed, grounded
from provoked import Do, Provocation, Table, Trouble, ignored, later, lost, refused, stops_sending

from aerokit.errors import NotSupported
from aerokit.mavlink.enums import MavCmd
from aerokit.vehicle.calibration.calibration import Calibration, EscIntent

__all__ = ["CALIBRATIONS", "CALIBRATIONS_AWAITED", "CALIBRATIONS_BLOCKING"]

NAMES = ("compass", "accelerometer", "gyroscope", "level", "barometer")
ESCS: EscIntent = "propellers are removed"


def _turn_quickly(stage: Stage) -> None:
    if stage.is_px4:
        stage.simulated.calibration.side_s = 0.1  # type: ignore[union-attr]
    else:
        stage.simulated.calibrations.compasses.turning_time_s = 1.0  # type: ignore[union-attr]


def _all_steps(name: str) -> Do:
    async def run(stage: Stage) -> None:
        _turn_quickly(stage)
        async for _ in getattr(stage.vehicle.calibrate, name)():
            pass

    return run


async def _escs(stage: Stage) -> None:
    async for _ in stage.vehicle.calibrate.escs(intent=ESCS):
        pass


async def _radio(stage: Stage) -> None:
    channels: Any = stage.simulated.rc  # type: ignore[union-attr]
    async for step in stage.vehicle.calibrate.radio():
        if step.progress == 0.0:
            for pulse in (1100, 1900, 1500):
                for index in (0, 1, 3, 5):
                    channels[index] = pulse
                await anyio.sleep(0.7)


async def _cancel(stage: Stage) -> None:
    calibration = stage.vehicle.calibrate.compass()
    await calibration.__anext__()
    await calibration.cancel()


async def _refused_airspeed(stage: Stage) -> None:
    """The simulated copter has no airspeed sensor."""
    try:
        async for _ in stage.vehicle.calibrate.airspeed():
            pass
    except NotSupported:
        pass


def _blocking(name: str) -> Callable[[Any], object]:
    def run(stage: Any) -> None:
        for _ in getattr(stage.vehicle.calibrate, name)():
            break

    return run


def _blocking_escs(stage: Any) -> None:
    for _ in stage.vehicle.calibrate.escs(intent=ESCS):
        break


def _blocking_cancel(stage: Any) -> None:
    calibration = stage.vehicle.calibrate.compass()
    next(calibration)
    calibration.cancel()


CALIBRATIONS_BLOCKING: dict[str, Callable[[Any], object]] = {
    **{
        f"CalibrationControl.{name}": _blocking(name)
        for name in ("compass", "gyroscope", "level", "barometer", "radio")
    },
    # ArduPilot cannot cancel the accelerometer calibration, and the copter has no airspeed sensor.
    "CalibrationControl.accelerometer": lambda s: s.vehicle.calibrate.accelerometer(),
    "CalibrationControl.airspeed": lambda s: s.vehicle.calibrate.airspeed(),
    "CalibrationControl.escs": _blocking_escs,
    "Calibration.cancel": _blocking_cancel,
}
CALIBRATIONS_AWAITED: dict[str, tuple[Do, tuple[str, ...]]] = {
    **{f"CalibrationControl.{name}": (_all_steps(name), ("ardupilot", "px4")) for name in NAMES},
    "CalibrationControl.airspeed": (_refused_airspeed, ("ardupilot",)),
    "CalibrationControl.radio": (_radio, ("ardupilot",)),
    "CalibrationControl.escs": (_escs, ("ardupilot",)),
    "Calibration.cancel": (_cancel, ("ardupilot", "px4")),
}


def _during(trouble: Trouble, **options: Any) -> Provocation:
    """Create a provocation whose disturbance happens during a compass calibration."""

    async def run(stage: Stage) -> None:
        async for _ in stage.vehicle.calibrate.compass():
            pass

    return later(run, trouble, place=grounded, **options)


async def _second(stage: Stage) -> None:
    first: Calibration = stage.vehicle.calibrate.compass()
    await first.__anext__()
    try:
        await stage.vehicle.calibrate.level().__anext__()
        await _all_steps("level")(stage)
    finally:
        await first.cancel()


async def _wrong_intent(stage: Stage) -> None:
    wrong: Any = "yes"
    stage.vehicle.calibrate.escs(intent=wrong)


async def _cancel_accelerometer(stage: Stage) -> None:
    calibration = stage.vehicle.calibrate.accelerometer()
    await calibration.__anext__()
    await calibration.cancel()


async def _cancel_silent(stage: Stage) -> None:
    calibration = stage.vehicle.calibrate.compass()
    await calibration.__anext__()
    stops_sending(stage)
    await calibration.cancel()


def _lose_result(stage: Stage) -> None:
    simulated: Any = stage.simulated
    simulated.send_text = lambda *_: None


_gyroscope: Callable[[Stage], Awaitable[object]] = _all_steps("gyroscope")
CALIBRATIONS: Table = {
    ("Calibration", "OperationRejected"): Provocation(_gyroscope, armed),
    ("Calibration", "NotSupported"): Provocation(lambda s: s.vehicle.calibrate.airspeed().__anext__(), grounded),
    ("Calibration", "CommandRejected"): Provocation(_gyroscope, grounded, refused(MavCmd.PREFLIGHT_CALIBRATION)),
    ("Calibration", "CommandTimeout"): Provocation(_gyroscope, grounded, ignored(MavCmd.PREFLIGHT_CALIBRATION)),
    ("Calibration", "OperationTimeout"): Provocation(
        _all_steps("barometer"), grounded, _lose_result, on="px4", alone=True
    ),
    ("Calibration", "HeartbeatTimeout"): _during(stops_sending),
    ("Calibration", "BusyError"): Provocation(_second, grounded),
    ("Calibration", "ConnectionClosed"): _during(lambda s: s.vehicle.connection.close(), alone=True),
    ("Calibration", "LinkLost"): _during(lost, alone=True),
    ("Calibration.cancel", "NotSupported"): Provocation(_cancel_accelerometer, grounded, alone=True),
    ("Calibration.cancel", "OperationTimeout"): Provocation(_cancel_silent, grounded, alone=True),
    ("CalibrationControl.escs", "InvalidArgument"): Provocation(_wrong_intent),
}
