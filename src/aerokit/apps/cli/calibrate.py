"""``aerokit calibrate``: guides a person through a calibration."""

from __future__ import annotations

import sys
import textwrap
from typing import TYPE_CHECKING

import anyio
import anyio.lowlevel

from aerokit.apps.cli.arguments import add_system_id
from aerokit.apps.cli.connecting import add_link, connect_to, signing_of
from aerokit.apps.cli.output import DONE, INTERRUPTED, emit
from aerokit.apps.cli.terminal import CLEAR_LINE, on_interrupt, wait_for_enter
from aerokit.connection.opening import OBSERVER_SYSTEM_ID
from aerokit.errors import InvalidArgument, NotSupported, OperationTimeout
from aerokit.vehicle.calibration.values import CalibrationPose

if TYPE_CHECKING:
    import argparse

    from aerokit.vehicle.calibration.calibration import Calibration
    from aerokit.vehicle.calibration.values import CalibrationStep
    from aerokit.vehicle.vehicle import Vehicle

_SENSORS = ("compass", "accelerometer", "gyroscope", "level", "airspeed", "barometer", "radio", "escs")
_BAR_WIDTH = 30
_CANCEL_TIMEOUT_S = 20.0

_GROUND = "    ~~~~~~~~~~~~~~~~~~~~~~~~~~~~"
# Poses whose pictures show the vehicle from behind. The other pictures show its right side.
_FROM_BEHIND = (CalibrationPose.LEFT, CalibrationPose.RIGHT)
PICTURES: dict[CalibrationPose, str] = {
    CalibrationPose.LEVEL: r"""
          ----+----     ----+----
              |   _______   |
              '--[_______]>-'   nose
                  /     \
""",
    CalibrationPose.BACK: r"""
                  \_____/
              .--[_______]>-.   nose
              |             |
          ----+----     ----+----
""",
    CalibrationPose.NOSE_DOWN: r"""
                 _       |
                | |------+   tail
              ==| |      |
       feet     | |
              ==| |      |
                |_|------+
                 V       |   nose
""",
    CalibrationPose.NOSE_UP: r"""
             |       A       nose
             +------| |
             |      | |==
                    | |      feet
             |      | |==
             +------|_|
             |               tail
""",
    CalibrationPose.LEFT: r"""
              |
              +--.       right
              |  |_
                 |_|==   feet
              |  |
              +--'       left
""",
    CalibrationPose.RIGHT: r"""
                         |
              left    .--+
                     _|  |
             feet  ==|_|
                      |  |
              right   '--+
""",
}


def add_arguments(command: argparse.ArgumentParser) -> None:
    command.add_argument("sensor", choices=_SENSORS, help="what to calibrate")
    add_link(command)
    add_system_id(command)
    command.add_argument(
        "--propellers-removed", action="store_true", help="for escs: confirms that no propeller is mounted"
    )
    command.set_defaults(run=_run)


async def _run(options: argparse.Namespace) -> int:
    if options.sensor == "escs" and not options.propellers_removed:
        raise InvalidArgument("escs: the motors get full throttle; remove the propellers and add --propellers-removed")
    async with connect_to(
        options,
        options.address,
        changes_vehicle=True,
        source_system=OBSERVER_SYSTEM_ID,
        rates={},
        signing=signing_of(options),
    ) as vehicle:
        return await _guide(options, _calibration(vehicle, options.sensor))


def _calibration(vehicle: Vehicle, sensor: str) -> Calibration:
    if sensor == "escs":
        return vehicle.calibrate.escs(intent="propellers are removed")
    calibration: Calibration = getattr(vehicle.calibrate, sensor)()
    return calibration


async def _guide(options: argparse.Namespace, calibration: Calibration) -> int:
    """Show the steps of a calibration until it ends.

    Ctrl-C cancels the calibration on the vehicle.
    """
    display = Display(options)
    scope = anyio.CancelScope()
    with on_interrupt(scope.cancel):
        with scope:
            async for step in calibration:
                display.show(step)
                if step.needs_confirmation and not await wait_for_enter():
                    scope.cancel()
                    await anyio.lowlevel.checkpoint()  # a cancellation takes effect here, before the next step
        if scope.cancelled_caught:  # the calibration still runs on the vehicle
            return await _cancel(options, calibration)
    return DONE


async def _cancel(options: argparse.Namespace, calibration: Calibration) -> int:
    problem = ""
    try:
        with anyio.fail_after(_CANCEL_TIMEOUT_S):
            await calibration.cancel()
    except (NotSupported, OperationTimeout) as error:
        problem = str(error)
    except TimeoutError:  # raised by `fail_after`, without a text
        problem = f"it did not confirm within {_CANCEL_TIMEOUT_S:g} s"
    text = f"not cancelled on the vehicle: {problem}" if problem else "cancelled on the vehicle"
    record = {"sensor": options.sensor, "is_cancelled": not problem, "text": text}
    emit(options, "calibration_cancelled", record, f"{options.sensor}: {text}")
    return INTERRUPTED


class Display:
    """Prints the steps of a calibration. A step takes at most 80 columns and 24 lines."""

    def __init__(self, options: argparse.Namespace) -> None:
        self._options = options
        self._shown: tuple[CalibrationPose | None, str] = (None, "")

    def show(self, step: CalibrationStep) -> None:
        if step.result is not None:
            self._show_result(step)
            return
        record = step.to_dict()
        del record["result"]
        shown_pose, shown_instruction = self._shown
        self._shown = step.pose, step.instruction
        text = None  # if neither pose nor instruction has changed, the step only reports progress
        if step.pose is not shown_pose:
            text = "\n".join(lines_of(step))
        elif step.instruction != shown_instruction:
            text = "\n".join(lines_of(step.replace(pose=None)))  # without the picture
        emit(self._options, "calibration_step", record, text)
        if not self._options.json and step.progress is not None and sys.stdout.isatty():
            print(f"{CLEAR_LINE}{bar(step.progress)}", end="\r", flush=True)

    def _show_result(self, step: CalibrationStep) -> None:
        assert step.result is not None
        result = step.result
        fits = [f"  compass {fit.compass}: fitness {fit.fitness_mgauss:.1f} mgauss" for fit in result.compasses]
        reboot = ["  reboot the vehicle before the next flight"] if result.reboot_due else []
        record = {"sensor": step.sensor, "text": step.instruction, **result.to_dict()}
        text = "\n".join((f"{step.sensor}: {step.instruction}", *fits, *reboot))
        emit(self._options, "calibration_result", record, text)


def lines_of(step: CalibrationStep) -> list[str]:
    lines = []
    if step.pose is not None:
        view = "seen from behind" if step.pose in _FROM_BEHIND else "seen from the right side"
        next_poses = ", ".join(pose.value for pose in step.remaining if pose is not step.pose)
        lines = ["", f"  {step.pose.value.upper()} ({view})", *PICTURES[step.pose].strip("\n").splitlines(), _GROUND]
        if next_poses:
            lines.append(f"  then: {next_poses}")
    # An instruction may be a STATUSTEXT of the vehicle, which may be long.
    instruction = textwrap.wrap(step.instruction, 76, max_lines=3, placeholder=" ...")
    return [*lines, *(f"  {line}" for line in instruction)]


def bar(progress: float) -> str:
    filled = round(progress * _BAR_WIDTH)
    return f"  [{'#' * filled}{'-' * (_BAR_WIDTH - filled)}] {100 * progress:3.0f} %"
