"""The command protocol (https://mavlink.io/en/services/command.html): COMMAND_LONG or COMMAND_INT until COMMAND_ACK."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Protocol

from aerokit.errors import CommandRejected, CommandTimeout, InvalidArgument
from aerokit.mavlink.enums import MavCmd, MavResult
from aerokit.mavlink.messages import CommandAck, CommandInt, CommandLong
from aerokit.protocols.exchange import Exchange

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from aerokit.mavlink.message import Message

__all__ = [
    "ATTEMPTS",
    "SENT_ONCE",
    "CommandExchange",
    "Standing",
    "attempts_of",
    "command_int",
    "command_long",
    "command_name",
    "rejection",
    "result_name",
]

ATTEMPTS = 4
"""How often a command is sent that does the same when it is carried out twice."""

_ARM, _RELATIVE, _STEP = (0, 1.0), (3, 1.0), (0, 0.0)

SENT_ONCE: Mapping[int, tuple[str, tuple[int, float] | None]] = {
    MavCmd.COMPONENT_ARM_DISARM: ("arms a vehicle that a pilot has disarmed since", _ARM),
    MavCmd.CONDITION_YAW: ("turns on by the same angle", _RELATIVE),
    MavCmd.DO_REPEAT_RELAY: ("cycles the relay again", None),
    MavCmd.DO_REPEAT_SERVO: ("cycles the servo again", None),
    MavCmd.DO_DIGICAM_CONTROL: ("takes another picture, zooms another step", None),
    MavCmd.DO_SET_CAM_TRIGG_DIST: ("may take another picture at once", None),
    MavCmd.DO_MOTOR_TEST: ("spins the motor again", None),
    MavCmd.ACTUATOR_TEST: ("moves the actuator again", None),
    MavCmd.DO_AUTOTUNE_ENABLE: ("starts tuning anew", None),
    MavCmd.DO_SEND_SCRIPT_MESSAGE: ("gives the script the message again", None),
    MavCmd.DO_AUX_FUNCTION: ("carries out the function again", None),
    MavCmd.PREFLIGHT_CALIBRATION: ("calibrates again", None),
    MavCmd.PREFLIGHT_STORAGE: ("writes, reads or resets all parameters again", None),
    MavCmd.PREFLIGHT_REBOOT_SHUTDOWN: ("reboots again", None),
    MavCmd.START_RX_PAIR: ("starts pairing again", None),
    MavCmd.STORAGE_FORMAT: ("erases what was stored since", None),
    MavCmd.SET_CAMERA_ZOOM: ("zooms another step", _STEP),
    MavCmd.SET_CAMERA_FOCUS: ("focuses another step", _STEP),
    MavCmd.IMAGE_START_CAPTURE: ("takes another picture, or another series", None),
    MavCmd.VIDEO_START_CAPTURE: ("starts another file", None),
    MavCmd.LOGGING_START: ("starts another log", None),
    MavCmd.DO_START_MAG_CAL: ("calibrates again", None),
    MavCmd.FIXED_MAG_CAL_YAW: ("calibrates again", None),
    MavCmd.DO_WINCH: ("pays out the same length again", None),
    MavCmd.FLASH_BOOTLOADER: ("writes the bootloader again", None),
    MavCmd.PAYLOAD_CONTROL_DEPLOY: ("drops another payload", None),
}
"""MAV_CMD → what happens when it is carried out twice, and the parameter (its index, its value) that makes it so, if
that is not all of them. docs/reliability.md has the same table."""


def attempts_of(command: int, params: Sequence[float]) -> int:
    """How often it may be sent while it is not answered: once if a second time would do it again."""
    if command not in SENT_ONCE:
        return ATTEMPTS
    _, where = SENT_ONCE[command]
    return 1 if where is None or params[where[0]] == where[1] else ATTEMPTS


BROADCAST = 0

FLOAT32_MAX = 3.4028234663852886e38

ATTEMPT_TIMEOUT_S = 1.0

LOOK_S = 0.05
"""So often it is looked whether the vehicle has told what it does, once an order may be sent again."""

SOONEST = 0.75
"""After this part of ``attempt_timeout``: heartbeats come at 1 Hz, and none should be missed by a hair's breadth."""


class Standing(Protocol):
    """What has been heard of an order since it was sent, for whoever would send it again."""

    @property
    def end(self) -> str:
        """Why it must not be sent again, as a clause; empty while it may."""
        ...

    @property
    def told_at(self) -> float:
        """When the vehicle last told what it does (HEARTBEAT), on the clock of the exchange."""
        ...


def command_long(
    target_system: int, target_component: int, command: int, params: tuple[float, ...] = ()
) -> CommandLong:
    """Build a COMMAND_LONG; ``params`` are param1 to param7, missing ones are 0, NaN is allowed.

    Raises:
        InvalidArgument: more than seven parameters, not a number, infinite, or no target system.
    """
    _check_target(target_system, command)
    if len(params) > 7:
        raise InvalidArgument(f"{command_name(command)} takes at most 7 parameters, {len(params)} were given")
    return CommandLong(target_system, target_component, command, 0, *_checked_params(command, params, 7))


def command_int(
    target_system: int,
    target_component: int,
    command: int,
    params: tuple[float, ...] = (),
    *,
    frame: int,
    x: int,
    y: int,
    z: float,
) -> CommandInt:
    """Build a COMMAND_INT; ``params`` are param1 to param4, ``x`` and ``y`` latitude and longitude in 1e-7 degrees
    (or 1e-4 m in local frames), ``z`` the altitude in metres in ``frame`` (MAV_FRAME).

    Raises:
        InvalidArgument: more than four parameters, a value outside its type, or no target system.
    """
    _check_target(target_system, command)
    if len(params) > 4:
        raise InvalidArgument(
            f"{command_name(command)} as COMMAND_INT takes at most 4 parameters beside x, y, z"
        )
    for field, value in (("x", x), ("y", y)):
        if not isinstance(value, int) or not -(2**31) <= value < 2**31:
            raise InvalidArgument(
                f"{command_name(command)}: {field} = {value!r} is not an integer of 32 bits"
            )
    param1, param2, param3, param4 = _checked_params(command, params, 4)
    z = _checked_number(command, "z", z)
    return CommandInt(
        target_system, target_component, frame, command, 0, 0, param1, param2, param3, param4, x, y, z
    )


class CommandExchange(Exchange[CommandAck]):
    """Send one command until its result is known; ends with the COMMAND_ACK whose result is ACCEPTED.

    ``confirmation`` rises with each resend. IN_PROGRESS is no result: it extends the deadline by ``progress_timeout``
    and is reported to ``on_progress`` (0–100, None when the vehicle does not say). An ack for another ground station
    is not ours, nor is one of another component than the target; nor are the first ``answers_before_ours``: those to
    an earlier command of the same number that was abandoned. If they do not come after all, the command is sent
    again, and then every ack counts. ``answers_to_each``: how many acks the vehicle sends for each sending; the first
    one is the result.

    A question (no ``standing``) is sent again every ``attempt_timeout`` seconds. An order is sent again only right
    after the vehicle has told what it does, and only if that speaks neither of the order's effect nor of somebody
    else's: so never into a silence. ``attempts`` None: four, or one for an order that would be carried out twice
    (``repeatable.SENT_ONCE``); ``attempt_timeout`` None: one second, or four for such an order.

    ``is_sent``: it has been sent once, just before :meth:`start`.

    Raises from ``result()``:
        CommandRejected: any other result; the vehicle's reasons are added by those who see its status texts.
        CommandTimeout: ``attempts`` times ``attempt_timeout`` seconds without an ack.
    """

    expects: tuple[type[Message], ...] = (CommandAck,)

    # from start() on
    _started: float
    _sent_at: float

    def __init__(
        self,
        message: CommandLong | CommandInt,
        *,
        own_system: int,
        own_component: int,
        attempts: int | None = None,
        attempt_timeout: float | None = None,
        progress_timeout: float = 10.0,
        on_progress: Callable[[int | None], None] | None = None,
        answers_before_ours: int = 0,
        answers_to_each: int = 1,
        answers_within_s: float = 0.0,
        standing: Standing | None = None,
        is_sent: bool = False,
    ) -> None:
        super().__init__()
        is_order_once = False
        if attempts is None:
            attempts = ATTEMPTS if standing is None else attempts_of(message.command, _params_of(message))
            is_order_once = attempts == 1
        if attempt_timeout is None:
            attempt_timeout = ATTEMPT_TIMEOUT_S * (ATTEMPTS if is_order_once else 1)
        attempt_timeout = max(attempt_timeout, answers_within_s) if attempt_timeout > 0 else attempt_timeout
        if attempts < 1:
            raise InvalidArgument(f"attempts = {attempts} is not allowed: at least 1")
        for name, seconds in (("attempt_timeout", attempt_timeout), ("progress_timeout", progress_timeout)):
            if not seconds > 0:
                raise InvalidArgument(f"{name} = {seconds!r} is not allowed: above 0")
        self._message = message
        self._own = (own_system, own_component)
        self._attempts, self._attempt_timeout = attempts, attempt_timeout
        self._progress_timeout, self._on_progress = progress_timeout, on_progress
        self._answers_before_ours, self._answers_to_each = answers_before_ours, answers_to_each
        self._standing = standing
        self._is_sent = is_sent
        self._sent = 0
        self._answers = 0
        self._in_progress = False

    def start(self, now: float) -> None:
        """Send the command for the first time."""
        self._started = now
        self._send(now)
        if self._is_sent:
            self._outbox.clear()

    def receive(self, message: Message, now: float) -> None:
        """Take a COMMAND_ACK of the target; others are ignored."""
        if self.done or not isinstance(message, CommandAck) or not self._is_ours(message):
            return
        is_earlier = self._sent == 1 < self._attempts and self._answers < self._answers_before_ours
        self._answers += message.result != MavResult.IN_PROGRESS
        if is_earlier:
            return
        if message.result == MavResult.IN_PROGRESS:
            self._report_progress(message, now)
        elif message.result == MavResult.ACCEPTED:
            self._finish(message)
        else:
            self._fail(rejection(message.command, message.result))

    @property
    def answers_to_come(self) -> int:
        """Number of answers to this command that may still arrive; the next one of the same number must ignore them."""
        # Once the command was sent again every answer counts as its own, as in receive().
        earlier = self._answers_before_ours if self._sent == 1 else 0
        return max(0, self._sent * self._answers_to_each - max(0, self._answers - earlier))

    @property
    def answers(self) -> int:
        """Number of answers received, those to earlier commands of the same number included."""
        return self._answers

    def expire(self, now: float) -> None:
        """Send again, or give up after the last attempt or when a command in progress has gone silent."""
        if self.deadline is None or now < self.deadline:
            return
        if self._in_progress:
            self._fail(CommandTimeout(self._timeout_text(now)))
        elif self._standing is not None:
            self._expire_order(self._standing, now)
        elif self._sent < self._attempts:
            self._send(now)
        else:
            self._fail(CommandTimeout(self._timeout_text(now)))

    def _expire_order(self, standing: Standing, now: float) -> None:
        """Send it again if it still stands, as soon as the vehicle has told so; until its time is up."""
        until = self._started + self._attempts * self._attempt_timeout
        if standing.end:
            self._fail(CommandTimeout(f"{self._timeout_text(now)}; not sent again: {standing.end}"))
            return
        soonest = self._sent_at + SOONEST * self._attempt_timeout
        if self._sent < self._attempts and standing.told_at >= soonest:
            self._send(now)
            return
        if now >= until:
            self._fail(CommandTimeout(self._timeout_text(now) + self._why_not_again()))
        else:
            self.deadline = min(now + LOOK_S, until)

    def _why_not_again(self) -> str:
        if self._sent < self._attempts:
            return "; not sent again: the vehicle has not told since what it does"
        if self._attempts == 1 and attempts_of(self._message.command, _params_of(self._message)) == 1:
            return f"; never sent again: a second one {SENT_ONCE[self._message.command][0]}"
        return ""

    def _send(self, now: float) -> None:
        self._outbox.append(self._numbered(self._sent))
        self._sent += 1
        self._sent_at = now
        wait_s = self._attempt_timeout
        if self._standing is not None:
            wait_s = min(SOONEST * wait_s, ATTEMPT_TIMEOUT_S)
        self.deadline = now + wait_s

    def _numbered(self, confirmation: int) -> Message:
        """COMMAND_LONG counts its resends; COMMAND_INT has no field for it."""
        message = self._message
        if confirmation == 0 or not isinstance(message, CommandLong):
            return message
        fields = message.to_dict() | {"confirmation": min(confirmation, 255)}
        return CommandLong(**fields)

    def _is_ours(self, ack: CommandAck) -> bool:
        """Is it for this command and for us? Targets are 0 in acks of MAVLink 1 and of old firmwares."""
        own_system, own_component = self._own
        frame, component = ack.received_frame, self._message.target_component
        return (
            ack.command == self._message.command
            and (frame is None or component in (BROADCAST, frame.component_id))
            and ack.target_system in (BROADCAST, own_system)
            and ack.target_component in (BROADCAST, own_component)
        )

    def _report_progress(self, ack: CommandAck, now: float) -> None:
        self._in_progress = True
        self.deadline: float | None = now + self._progress_timeout
        if self._on_progress is not None:
            self._on_progress(ack.progress if 0 < ack.progress <= 100 else None)

    def _timeout_text(self, now: float) -> str:
        name, seconds = command_name(self._message.command), now - self._started
        if self._in_progress:
            return f"{name} was in progress, then nothing came for {self._progress_timeout:g} s"
        times = "once" if self._sent == 1 else f"{self._sent} times"
        return f"no COMMAND_ACK for {name}, sent {times} within {seconds:.1f} s"


def _params_of(message: CommandLong | CommandInt) -> tuple[float, ...]:
    return message.param1, message.param2, message.param3, message.param4


def rejection(command: int, result: int) -> CommandRejected:
    """The error that stands for this result."""
    text = f"{command_name(command)} was refused: {result_name(result)}{_HINTS.get(result, '')}"
    return CommandRejected(text, command=command, result=result)


def command_name(command: int) -> str:
    """``MAV_CMD_NAV_TAKEOFF`` for 22; ``MAV_CMD 12345`` for what the dialects do not know."""
    try:
        return f"MAV_CMD_{MavCmd(command).name}"
    except ValueError:
        return f"MAV_CMD {command}"


def result_name(result: int) -> str:
    """``DENIED`` for 2; ``MAV_RESULT 99`` for what the dialects do not know."""
    try:
        return MavResult(result).name
    except ValueError:
        return f"MAV_RESULT {result}"


_HINTS: dict[int, str] = {
    MavResult.TEMPORARILY_REJECTED: " (the vehicle says: not now, later perhaps)",
    MavResult.DENIED: " (the vehicle says: never with these parameters)",
    MavResult.UNSUPPORTED: " (this firmware does not know the command)",
    MavResult.COMMAND_LONG_ONLY: " (it has to be sent as COMMAND_LONG)",
    MavResult.COMMAND_INT_ONLY: " (it has to be sent as COMMAND_INT)",
    MavResult.COMMAND_UNSUPPORTED_MAV_FRAME: " (not in this frame; PX4 1.17 takes MAV_FRAME_GLOBAL_INT, 5, alone)",
}


def _check_target(target_system: int, command: int) -> None:
    if not 1 <= target_system <= 255:
        raise InvalidArgument(
            f"{command_name(command)}: target_system = {target_system} is not allowed: 1 to 255"
            " (0 would command every vehicle on the link)"
        )


def _checked_params(command: int, params: tuple[float, ...], count: int) -> list[float]:
    """The parameters as numbers, with zeros for the missing ones."""
    numbers = [0.0] * count
    for index, value in enumerate(params):
        if isinstance(value, (int, float)) and -FLOAT32_MAX <= value <= FLOAT32_MAX:
            numbers[index] = float(value)  # nearly always
        else:
            numbers[index] = _checked_number(command, f"param{index + 1}", value)
    return numbers


def _checked_number(command: int, field: str, value: float) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise InvalidArgument(f"{command_name(command)}: {field} = {value!r} is not a number") from None
    if math.isinf(number) or abs(number) > FLOAT32_MAX:
        raise InvalidArgument(f"{command_name(command)}: {field} = {value!r} does not fit into 32 bits")
    return number
