"""The steps of each calibration, on ArduPilot and on PX4."""

from __future__ import annotations

import asyncio
import math
from collections import deque
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING

import anyio

from aerokit.errors import AerokitError, NotSupported, OperationTimeout, ParameterRejected
from aerokit.mavlink.enums import AccelcalVehiclePos, MagCalStatus, MavCmd, MavResult, MavState
from aerokit.mavlink.messages import CommandLong, MagCalProgress, MagCalReport
from aerokit.vehicle.calibration.run import CancelCommand, logger
from aerokit.vehicle.calibration.values import CalibrationPose, CompassFit, parse_report

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator

    from aerokit.vehicle.calibration.run import CalibrationRun
    from aerokit.vehicle.calibration.values import CalibrationReport, CalibrationStep

CANCEL_ALL = CancelCommand(MavCmd.PREFLIGHT_CALIBRATION, (0, 0, 0, 0, 0, 0, 0))
ALL_COMPASSES = 0  # In the commands' bit masks of compasses, 0 selects all of them.
REPORT_HZ = 4.0
# Value of ESC_CALIBRATION with which ArduCopter calibrates the ESCs at its next boot.
CALIBRATE_AT_BOOT = 3
# PX4 sends the text with the result after HEARTBEAT has stopped reporting CALIBRATING. The text counts as lost after
# this many seconds.
END_GRACE_S = 3.0
# Maximum seconds for restoring a parameter, because a cancelled call must end within two seconds.
RESTORE_TIMEOUT_S = 1.5
# ArduPilot repeats its request for a pose every second until it receives our confirmation. After the confirmation, the
# same request is ignored for this many seconds, because ArduPilot may have sent it before the confirmation arrived.
POSE_REPEAT_S = 2.0
POSES = {
    AccelcalVehiclePos.LEVEL: CalibrationPose.LEVEL,
    AccelcalVehiclePos.LEFT: CalibrationPose.LEFT,
    AccelcalVehiclePos.RIGHT: CalibrationPose.RIGHT,
    AccelcalVehiclePos.NOSEDOWN: CalibrationPose.NOSE_DOWN,
    AccelcalVehiclePos.NOSEUP: CalibrationPose.NOSE_UP,
    AccelcalVehiclePos.BACK: CalibrationPose.BACK,
}
ACCELEROMETER_CANNOT_CANCEL = (
    "ArduPilot cannot cancel it: it waits for the next pose, and cannot be armed, until it reboots"
)


async def px4_by_status_texts(run: CalibrationRun, *params: float) -> AsyncGenerator[CalibrationStep, None]:
    """Yield the steps that PX4's ``[cal]`` status texts report. PX4 detects the poses itself."""
    await run.begin(CANCEL_ALL)
    telemetry, now = run.session.telemetry, run.session.connection.now
    reports: deque[CalibrationReport] = deque()
    ended_at = math.inf  # when the vehicle left the state CALIBRATING
    with ExitStack() as cleanup:

        def on_text(text: str) -> None:
            if report := parse_report(text):  # Texts that are not about a calibration are ignored.
                reports.append(report)

        def on_status(previous: int | None, status: int) -> None:
            nonlocal ended_at
            if MavState.CALIBRATING in (previous, status):
                ended_at = math.inf if status == MavState.CALIBRATING else now()

        def has_ended_silently() -> bool:
            return now() - ended_at > END_GRACE_S

        # Without `every_arrival`, a text that equals the previous one would not be reported.
        cleanup.callback(telemetry.status_text.observe(lambda _, text: on_text(text.text), every_arrival=True))
        # Observed rather than read by `has_ended_silently`, which is not called while the program handles a step.
        cleanup.callback(telemetry.system_status.observe(on_status))

        await run.start(*params)
        step = run.new_step(0.0, "keep the vehicle still")
        yield step
        while True:
            await run.wait(lambda: reports or has_ended_silently())
            if not reports:
                run.finish()
                raise OperationTimeout(
                    f"{run.call_name}: the vehicle has ended the calibration, but its status text with the result was"
                    f" lost; {run.session.describe_link()}"
                )
            report = reports.popleft()
            if report.kind in ("failed", "cancelled"):
                run.finish()
                raise run.failure(f"the vehicle reports: {report.text}")
            if report.kind == "done":
                yield run.result()
                return
            next_step = _step_after(step, report)
            if next_step != step:
                step = next_step
                yield step


def _step_after(step: CalibrationStep, report: CalibrationReport) -> CalibrationStep:
    if report.kind == "progress":
        return step.replace(progress=report.progress)
    if report.kind == "pending":
        instruction = "place the vehicle in one of the remaining poses and keep it still"
        return step.replace(instruction=instruction, pose=report.poses[0], remaining=report.poses)
    if report.kind == "detected":
        return step.replace(instruction=report.text, pose=report.poses[0])
    if report.kind == "side done":
        remaining = tuple(pose for pose in step.remaining if pose not in report.poses)
        return step.replace(instruction=report.text, pose=next(iter(remaining), None), remaining=remaining)
    if report.kind in ("text", "already done"):
        return step.replace(instruction=report.text)
    return step  # "started" and "side progress" do not change the step.


async def ardupilot_single_command(
    run: CalibrationRun, *params: float, instruction: str
) -> AsyncGenerator[CalibrationStep, None]:
    """Run a calibration that is one command, with the acknowledgement as the result."""
    run.check_ready()
    yield run.new_step(None, instruction)
    await run.begin(cancel=None)
    await run.start(*params)
    yield run.result()


async def ardupilot_airspeed(run: CalibrationRun, *_: float) -> AsyncGenerator[CalibrationStep, None]:
    run.check_ready()
    if await _read_parameter(run, "ARSPD_TYPE") == 0:
        raise run.failure("no airspeed sensor is enabled (ARSPD_TYPE is 0); nothing was sent")
    # param3 = 1 calibrates the barometer and, in the same step, the airspeed sensors.
    async for step in ardupilot_single_command(run, 0, 0, 1, instruction="cover the airspeed sensor against wind"):
        yield step


async def ardupilot_escs(run: CalibrationRun, *_: float) -> AsyncGenerator[CalibrationStep, None]:
    run.check_ready()
    old_value = await _read_parameter(run, "ESC_CALIBRATION")
    yield run.new_step(None, "remove the propellers, then continue", needs_confirmation=True)
    await run.begin(cancel=None)
    try:
        await run.parameters().set("ESC_CALIBRATION", CALIBRATE_AT_BOOT)
    except ParameterRejected:  # The vehicle refused, so there is nothing to restore.
        raise
    except BaseException:  # The vehicle may have set the value, although the call failed or was cancelled.
        await _restore_parameter(run, "ESC_CALIBRATION", old_value)
        raise
    finally:
        run.finish()
    yield run.result("disconnect the battery, then connect it: the ESCs are calibrated at boot", reboot_due=True)


async def _restore_parameter(run: CalibrationRun, name: str, value: float) -> None:
    with anyio.CancelScope(shield=True), anyio.move_on_after(RESTORE_TIMEOUT_S), suppress(AerokitError):
        if run.context.arbiter.is_state_recent:  # Nothing is sent to a silent vehicle.
            await run.parameters().set(name, value)
            return
    logger.warning(
        "%s was left early, and %s may not have been restored to %g: set it, or the motors get full throttle at boot",
        run.call_name,
        name,
        value,
    )


async def _read_parameter(run: CalibrationRun, name: str) -> float:
    """Return the parameter's value. Raises NotSupported if the vehicle has no such parameter."""
    try:
        return (await run.parameters().read(name)).value
    except ParameterRejected:
        firmware = run.session.autopilot.firmware
        raise NotSupported(f"{run.call_name}: this {firmware} vehicle has no parameter {name}") from None


async def ardupilot_compass(run: CalibrationRun, *_: float) -> AsyncGenerator[CalibrationStep, None]:
    await run.begin(CancelCommand(MavCmd.DO_CANCEL_MAG_CAL, (ALL_COMPASSES,)))
    percents: dict[int, int] = {}  # progress in percent by number of the compass
    reports: dict[int, MagCalReport] = {}  # final report by number of the compass
    has_news = asyncio.Event()  # set when a report or a changed progress has arrived
    compass_mask = 0  # Bit i is set if compass i is being calibrated.

    def on_message(message: MagCalProgress | MagCalReport) -> None:
        nonlocal compass_mask
        if not run.is_from_autopilot(message):
            return
        compass_mask |= message.cal_mask
        if isinstance(message, MagCalReport):
            reports[message.compass_id] = message
        elif percents.get(message.compass_id) == message.completion_pct:
            return  # The same progress again is not a change.
        else:
            percents[message.compass_id] = message.completion_pct
        has_news.set()

    def is_complete() -> bool:
        compasses = [number for number in range(8) if compass_mask >> number & 1]
        return bool(compasses) and all(number in reports for number in compasses)

    with ExitStack() as cleanup:
        retry = autosave = delay_s = autoreboot = 0
        await run.start(ALL_COMPASSES, retry, autosave, delay_s, autoreboot, command=MavCmd.DO_START_MAG_CAL)
        session = run.session
        for message_type in (MagCalProgress, MagCalReport):
            cleanup.callback(session.connection.bus.attach(message_type, on_message, system_id=session.system_id))
            cleanup.callback(session.rates.request(message_type, REPORT_HZ, is_optional=True))
        instruction = "turn the vehicle slowly in all directions, about each of its axes"
        yield run.new_step(0.0, instruction)
        while not is_complete():
            await run.wait(has_news.is_set, timeout_text="no compass reported progress")
            has_news.clear()
            progress = min(percents.values(), default=0) / 100
            yield run.new_step(progress, instruction)
    failures = [
        f"compass {report.compass_id} {_status_name(report.cal_status)} (fitness {report.fitness:.1f} mgauss)"
        for report in reports.values()
        if report.cal_status != MagCalStatus.SUCCESS
    ]
    if failures:
        raise run.failure(f"{'; '.join(failures)}; the previous calibration is kept")
    await run.command(MavCmd.DO_ACCEPT_MAG_CAL, ALL_COMPASSES)
    fits = tuple(
        CompassFit(report.compass_id, report.fitness, (report.ofs_x, report.ofs_y, report.ofs_z))
        for _, report in sorted(reports.items())
    )
    yield run.result(reboot_due=True, compasses=fits)


def _status_name(status: int) -> str:
    try:
        return MagCalStatus(status).name.lower().replace("_", " ")
    except ValueError:
        return f"status {status}"


async def ardupilot_accelerometer(run: CalibrationRun, *params: float) -> AsyncGenerator[CalibrationStep, None]:
    await run.begin(cancel=None, cannot_cancel_reason=ACCELEROMETER_CANNOT_CANCEL)
    requests: deque[int] = deque()
    confirmed_pose, confirmed_at = 0, -math.inf
    now = run.session.connection.now

    def on_request(message: CommandLong) -> None:
        if not run.is_from_autopilot(message):  # A companion computer may confirm poses by the same command.
            return
        is_repeated = message.param1 == confirmed_pose and now() - confirmed_at < POSE_REPEAT_S
        # ArduPilot also reports the result by this command: `param1` is then SUCCESS or FAILED instead of a pose.
        if message.command == MavCmd.ACCELCAL_VEHICLE_POS and not is_repeated:
            requests.append(int(message.param1))

    with ExitStack() as cleanup:
        await run.start(*params)
        # Attach the handler only now, because ArduPilot broadcasts the result of an earlier calibration until this one
        # starts.
        cleanup.callback(run.session.connection.bus.attach(CommandLong, on_request, system_id=run.session.system_id))
        while True:
            await run.wait(lambda: requests)
            request = requests.pop()
            requests.clear()  # All requests before the newest one are obsolete.
            if request == AccelcalVehiclePos.SUCCESS:
                yield run.result(reboot_due=True)
                return
            if request == AccelcalVehiclePos.FAILED:
                run.finish()
                raise run.failure("the calibration failed; keep the vehicle still in each pose")
            if request in POSES:
                pose = POSES[AccelcalVehiclePos(request)]
                remaining = tuple(POSES.values())[request - 1 :]  # POSES has the order of ArduPilot's requests.
                text = f"place the vehicle {pose.value}, keep it still, then continue"
                yield run.new_step((request - 1) / len(POSES), text, pose, remaining, needs_confirmation=True)
                await run.wait(lambda: run.context.arbiter.is_state_recent)  # Do not send to a silent vehicle.
                await run.command(MavCmd.ACCELCAL_VEHICLE_POS, request)
                confirmed_pose, confirmed_at = request, now()
                # ArduPilot has repeated its request until it received the confirmation. The repetitions are obsolete.
                requests.clear()


MIN_CHANNELS, MIN_TRAVEL_US = 4, 300
CHANNELS_TIMEOUT_S = 5.0
# RCn_MIN must be between the first two values, RCn_MAX between the last two (RC_Channel.cpp, PX4 rc_params).
LOWEST_US, MIDDLE_US, HIGHEST_US = 800, 1500, 2200
# ArduPilot executes the commands that begin and end the calibration of the radio, but answers UNSUPPORTED
# (GCS_Common.cpp, _handle_command_preflight_calibration).
RADIO_COMMAND_RESULTS = (MavResult.UNSUPPORTED,)


async def radio_by_channels(run: CalibrationRun, *_: float) -> AsyncGenerator[CalibrationStep, None]:
    run.check_ready()
    channels = run.session.telemetry.cells["rc_channels"]
    lows: dict[int, int] = {}  # the shortest pulse of each channel in µs
    highs: dict[int, int] = {}  # the longest pulse of each channel in µs
    with ExitStack() as cleanup:
        cleanup.enter_context(run.session.streaming("rc_channels"))

        async def wait_channels() -> None:
            previous_update = channels.updated_at  # Only later stick positions count.
            await run.wait(
                lambda: channels.updated_at > previous_update,
                CHANNELS_TIMEOUT_S,
                "no RC_CHANNELS was received: is a receiver connected?",
            )

        await wait_channels()
        if not _pulses(channels.latest):
            raise run.failure("the receiver reports no channels; switch the transmitter on; nothing was sent")
        await run.begin(CANCEL_ALL)
        # With param4 = 1, ArduPilot refuses to arm until it receives the command with param4 = 0 (CANCEL_ALL).
        await run.command(MavCmd.PREFLIGHT_CALIBRATION, 0, 0, 0, 1, accepts=RADIO_COMMAND_RESULTS)

        def on_channels(value: object) -> None:
            for number, pulse in _pulses(value).items():
                lows[number] = min(pulse, lows.get(number, pulse))
                highs[number] = max(pulse, highs.get(number, pulse))

        cleanup.callback(channels.observe(lambda _, value: on_channels(value), every_arrival=True))
        # Each `yield` returns when the person has confirmed the step.
        yield run.new_step(
            0.0, "move all sticks and switches to all their ends, then continue", needs_confirmation=True
        )
        yield run.new_step(
            0.5, "center the sticks, with the throttle at its lowest, then continue", needs_confirmation=True
        )
        await wait_channels()
        trims = _pulses(channels.latest)
    moved = [number for number in lows if highs[number] - lows[number] >= MIN_TRAVEL_US]
    if len(moved) < MIN_CHANNELS:
        raise run.failure(f"only {len(moved)} channels moved by {MIN_TRAVEL_US} µs or more; nothing was written")
    # A missing trim counts as 0, which `_radio_parameters` refuses.
    ranges = {number: (lows[number], trims.get(number, 0), highs[number]) for number in moved}
    values = _radio_parameters(run, ranges)
    async with run.parameters().transaction() as transaction:
        await transaction.set_many(values)
    await run.command(CANCEL_ALL.command, *CANCEL_ALL.params, accepts=RADIO_COMMAND_RESULTS)
    yield run.result(f"{len(moved)} channels were calibrated")


def _radio_parameters(run: CalibrationRun, ranges: dict[int, tuple[int, int, int]]) -> dict[str, float]:
    """Check the lowest, center and highest pulse of each channel, and return them as parameters."""
    values: dict[str, float] = {}
    for number, (low, trim, high) in ranges.items():
        is_ordered = LOWEST_US <= low <= trim <= high <= HIGHEST_US
        spans_middle = low < MIDDLE_US < high
        if not is_ordered or not spans_middle:
            raise run.failure(
                f"channel {number} ranges from {low} to {high} µs with a center of {trim} µs; its minimum must be from"
                f" {LOWEST_US} to {MIDDLE_US} µs, its maximum from {MIDDLE_US} to {HIGHEST_US} µs, and its center"
                " between them; nothing was written"
            )
        values |= {f"RC{number}_MIN": low, f"RC{number}_MAX": high, f"RC{number}_TRIM": trim}
    return values


def _pulses(value: object) -> dict[int, int]:
    """Map channel numbers, from 1, to pulse widths in µs. Channels that are not received are left out."""
    pulses: tuple[int | None, ...] = getattr(value, "channels_us", ())
    return {number: pulse for number, pulse in enumerate(pulses, 1) if pulse}
