"""The command protocol (https://mavlink.io/en/services/command.html): a command and its COMMAND_ACK."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple, Protocol

from aerokit._internal.formatting import enum_name
from aerokit.errors import CommandRejected, CommandTimeout, InvalidArgument
from aerokit.mavlink.enums import MavCmd, MavResult
from aerokit.mavlink.messages import CommandAck, CommandInt, CommandLong
from aerokit.protocols.exchange import Exchange

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from aerokit.mavlink.message import Message

__all__ = [
    "MAX_ATTEMPTS",
    "UNREPEATABLE_COMMANDS",
    "CommandExchange",
    "OrderStatus",
    "allowed_attempts",
    "command_int",
    "command_long",
    "command_name",
    "rejection",
    "result_name",
]

MAX_ATTEMPTS = 4
"""Maximum number of transmissions of a command that may be repeated."""


class Repetition(NamedTuple):
    """Further effect of a repeated command.

    With a ``param`` (1 to 4), the command has this effect only if that parameter equals ``value``.
    """

    effect: str
    param: int | None = None
    value: float = 0.0


# Commands whose repetition has a further effect. docs/reliability.md has the same table.
UNREPEATABLE_COMMANDS: Mapping[int, Repetition] = {
    MavCmd.COMPONENT_ARM_DISARM: Repetition("arms a vehicle that a pilot has disarmed since", param=1, value=1),
    MavCmd.CONDITION_YAW: Repetition("turns by the same angle again", param=4, value=1),
    MavCmd.DO_REPEAT_RELAY: Repetition("cycles the relay again"),
    MavCmd.DO_REPEAT_SERVO: Repetition("cycles the servo again"),
    MavCmd.DO_DIGICAM_CONTROL: Repetition("takes another picture, zooms another step"),
    MavCmd.DO_SET_CAM_TRIGG_DIST: Repetition("may take another picture at once"),
    MavCmd.DO_MOTOR_TEST: Repetition("spins the motor again"),
    MavCmd.ACTUATOR_TEST: Repetition("moves the actuator again"),
    MavCmd.DO_AUTOTUNE_ENABLE: Repetition("restarts tuning"),
    MavCmd.DO_SEND_SCRIPT_MESSAGE: Repetition("sends the message to the script again"),
    MavCmd.DO_AUX_FUNCTION: Repetition("triggers the function again"),
    MavCmd.PREFLIGHT_CALIBRATION: Repetition("calibrates again"),
    MavCmd.PREFLIGHT_STORAGE: Repetition("writes, reads or resets all parameters again"),
    MavCmd.PREFLIGHT_REBOOT_SHUTDOWN: Repetition("reboots again"),
    MavCmd.DO_FLIGHTTERMINATION: Repetition("stops the motors of a flight that began meanwhile"),
    MavCmd.START_RX_PAIR: Repetition("starts pairing again"),
    MavCmd.STORAGE_FORMAT: Repetition("erases what was stored meanwhile"),
    MavCmd.SET_CAMERA_ZOOM: Repetition("zooms another step", param=1, value=0),
    MavCmd.SET_CAMERA_FOCUS: Repetition("focuses another step", param=1, value=0),
    MavCmd.IMAGE_START_CAPTURE: Repetition("takes another picture, or starts another series"),
    MavCmd.VIDEO_START_CAPTURE: Repetition("starts another file"),
    MavCmd.LOGGING_START: Repetition("starts another log"),
    MavCmd.DO_START_MAG_CAL: Repetition("calibrates again"),
    MavCmd.FIXED_MAG_CAL_YAW: Repetition("calibrates again"),
    MavCmd.DO_GRIPPER: Repetition("moves a gripper that another station has moved meanwhile"),
    MavCmd.DO_PARACHUTE: Repetition("releases a parachute that was disabled meanwhile", param=1, value=2),
    MavCmd.INJECT_FAILURE: Repetition("injects a failure again that was ended meanwhile"),
    MavCmd.DO_WINCH: Repetition("pays out the same length again"),
    MavCmd.FLASH_BOOTLOADER: Repetition("writes the bootloader again"),
    MavCmd.PAYLOAD_CONTROL_DEPLOY: Repetition("drops another payload"),
}


def allowed_attempts(command: int, params: Sequence[float]) -> int:
    """Return the maximum number of transmissions: 1 if a repetition would have a further effect, otherwise 4."""
    repetition = UNREPEATABLE_COMMANDS.get(command)
    if repetition is None:
        return MAX_ATTEMPTS
    has_effect = repetition.param is None or params[repetition.param - 1] == repetition.value
    return 1 if has_effect else MAX_ATTEMPTS


BROADCAST = 0

FLOAT32_MAX = 3.4028234663852886e38

ATTEMPT_TIMEOUT_S = 1.0

# A command with an `OrderStatus` is repeated only after a new HEARTBEAT. We check for one at this interval.
POLL_INTERVAL_S = 0.05

MAX_HEARTBEAT_AGE_S = 2.5
"""Maximum age in seconds of a HEARTBEAT that counts as the vehicle's present state.

Two HEARTBEATs may be lost. Ground-station failsafes act later (FS_GCS_TIMEOUT 5 s, COM_DL_LOSS_T 10 s). A HEARTBEAT may
be older when it is processed, if the event loop was blocked.
"""

# A HEARTBEAT triggers a repetition if it arrives after this fraction of ``attempt_timeout``. With a fraction of 1, a
# HEARTBEAT that arrives slightly early would not count, and the repetition would be late by a second.
MIN_RESEND_FRACTION = 0.75


class OrderStatus(Protocol):
    """Determines whether a command may be sent again."""

    @property
    def end(self) -> str:
        """Text that explains why the command must not be sent again; empty while it may be sent again."""
        ...

    @property
    def heartbeat_at(self) -> float:
        """Time of the last HEARTBEAT, on the clock of the exchange."""
        ...

    @property
    def heartbeat_name(self) -> str:
        """Name of this HEARTBEAT in error texts, e.g. ``"HEARTBEAT of component 100"``."""
        ...


def command_long(
    target_system: int, target_component: int, command: int, params: tuple[float, ...] = ()
) -> CommandLong:
    """Build a COMMAND_LONG. ``params`` are param1 to param7; missing ones are 0, and NaN is allowed.

    Raises:
        InvalidArgument: there are more than seven parameters, a parameter cannot be converted to a 32-bit float or is
            infinite, or ``target_system`` is 0.
    """
    _check_target(target_system, command)
    if len(params) > 7:
        raise InvalidArgument(f"{command_name(command)} takes at most 7 parameters, {len(params)} were given")
    confirmation = 0  # the first transmission
    return CommandLong(target_system, target_component, command, confirmation, *_checked_params(command, params, 7))


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
    """Build a COMMAND_INT.

    ``params`` are param1 to param4. ``x`` and ``y`` are latitude and longitude in 1e-7 degrees, or distances in 1e-4 m
    in local frames. ``z`` is in metres: the altitude in global frames, the z coordinate in local frames, which is
    positive down in NED frames. ``frame`` is a MAV_FRAME.

    Raises:
        InvalidArgument: there are more than four parameters, a parameter or ``z`` cannot be converted to a 32-bit float
            or is infinite, ``x`` or ``y`` is not a 32-bit integer, or ``target_system`` is 0.
    """
    _check_target(target_system, command)
    if len(params) > 4:
        raise InvalidArgument(f"{command_name(command)} as COMMAND_INT takes at most 4 parameters besides x, y, z")
    for field, value in (("x", x), ("y", y)):
        if not isinstance(value, int) or not -(2**31) <= value < 2**31:
            raise InvalidArgument(f"{command_name(command)}: {field} = {value!r} is not an integer of 32 bits")
    param1, param2, param3, param4 = _checked_params(command, params, 4)
    z = _checked_number(command, "z", z)
    return CommandInt(
        target_system, target_component, frame, command, current=0, autocontinue=0, param1=param1, param2=param2,
        param3=param3, param4=param4, x=x, y=y, z=z,
    )  # fmt: skip


class CommandExchange(Exchange[CommandAck]):
    """Sends one command, and repeats it until it is acknowledged. The result is the COMMAND_ACK with ACCEPTED.

    Without an ``order_status``, the command is repeated every ``attempt_timeout`` seconds. With an ``order_status``,
    each repetition waits for a new HEARTBEAT, so a silent vehicle gets none. Once ``order_status.end`` has a text, the
    exchange fails with that text instead of repeating the command.

    Acknowledgements to other ground stations, or from other components than the target, are ignored.

    Args:
        message: the command.
        own_system: our system id.
        own_component: our component id.
        attempts: maximum number of transmissions. None means 4, or 1 if a repetition would have a further effect
            (`allowed_attempts`).
        attempt_timeout: seconds for each attempt. None means 1 s, or 4 s if ``attempts=None`` allows one attempt.
        progress_timeout: seconds from an IN_PROGRESS until the command fails, unless another answer arrives.
        on_progress: called at each IN_PROGRESS with 1–100, or None if the vehicle does not report a percentage.
        earlier_acks: number of acknowledgements to ignore, because they belong to an earlier, abandoned command with
            the same MAV_CMD. No acknowledgement is ignored if ``attempts`` is 1, or once this command was repeated.
        acks_per_sending: number of acknowledgements that the vehicle sends for each transmission; the first one counts.
        min_timeout_s: lower limit of ``attempt_timeout``, for slow links.
        order_status: determines whether the command may be repeated; None if nothing prevents it.
        sent_by_caller: True if the caller makes the first transmission. The exchange only repeats the command.

    Raises from ``result()``:
        CommandRejected: the result is neither ACCEPTED nor IN_PROGRESS. The caller adds status texts of the vehicle.
        CommandTimeout: no acknowledgement arrived within ``attempts`` times ``attempt_timeout`` seconds, or before
            ``order_status`` ended the repetitions, or within ``progress_timeout`` seconds after an IN_PROGRESS.
    """

    expects: tuple[type[Message], ...] = (CommandAck,)

    # start() sets these attributes.
    _started_at: float
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
        earlier_acks: int = 0,
        acks_per_sending: int = 1,
        min_timeout_s: float = 0.0,
        order_status: OrderStatus | None = None,
        sent_by_caller: bool = False,
    ) -> None:
        super().__init__()
        default_timeout_s = ATTEMPT_TIMEOUT_S
        if attempts is None:
            attempts = allowed_attempts(message.command, _params_of(message))
            if attempts == 1:  # A command that must not be repeated waits as long as all attempts of another command.
                default_timeout_s *= MAX_ATTEMPTS
        if attempt_timeout is None:
            attempt_timeout = default_timeout_s
        if attempt_timeout > 0:  # Other values are refused below, and the error must show them unchanged.
            attempt_timeout = max(attempt_timeout, min_timeout_s)
        if attempts < 1:
            raise InvalidArgument(f"attempts = {attempts} is not allowed: it must be at least 1")
        for name, seconds in (("attempt_timeout", attempt_timeout), ("progress_timeout", progress_timeout)):
            if not seconds > 0:
                raise InvalidArgument(f"{name} = {seconds!r} is not allowed: it must be above 0")
        self._message = message
        self._own_ids = (own_system, own_component)
        self._attempts, self._attempt_timeout = attempts, attempt_timeout
        self._progress_timeout, self._on_progress = progress_timeout, on_progress
        self._earlier_acks, self._acks_per_sending = earlier_acks, acks_per_sending
        self._order_status = order_status
        self._sent_by_caller = sent_by_caller
        self._sent_count = 0  # number of transmissions, including a first one by the caller
        self._dropped_count = 0  # number of transmissions that no link accepted
        self.final_acks: int = 0
        """Number of acknowledgements received except IN_PROGRESS, including those to earlier, equal commands."""
        self._in_progress = False

    def start(self, now: float) -> None:
        self._started_at = now
        self._send(now)
        if self._sent_by_caller:  # `_send` has counted the transmission; the message itself must not be sent twice.
            self._outbox.clear()

    def receive(self, message: Message, now: float) -> None:
        """Process a COMMAND_ACK. Other messages are ignored."""
        if self.done or not isinstance(message, CommandAck) or not self._is_ours(message):
            return
        # The first `_earlier_acks` acknowledgements may belong to earlier commands, so they are ignored until the
        # command is repeated. A command with a single attempt ignores none, because it may get only one.
        may_ignore = self._transmitted_count == 1 and self._attempts > 1
        is_to_earlier_command = self._transmitted_count == 0 or (may_ignore and self.final_acks < self._earlier_acks)
        if message.result != MavResult.IN_PROGRESS:
            self.final_acks += 1
        if is_to_earlier_command:
            return
        if message.result == MavResult.IN_PROGRESS:
            self._report_progress(message, now)
        elif message.result == MavResult.ACCEPTED:
            self._finish(message)
        else:
            self._fail(rejection(message.command, message.result))

    @property
    def pending_acks(self) -> int:
        """Number of acknowledgements that may still arrive. The next command with this MAV_CMD must ignore them."""
        # Once the command was repeated, every acknowledgement counts as an answer to this command; see `receive`.
        ignored_acks = self._earlier_acks if self._transmitted_count <= 1 else 0
        own_acks = max(0, self.final_acks - ignored_acks)
        return max(0, self._transmitted_count * self._acks_per_sending - own_acks)

    def message_dropped(self) -> None:
        self._dropped_count += 1

    @property
    def error_of_ended_order(self) -> CommandTimeout | None:
        """The error for the caller if the order has ended, so that the command is not sent again; else None."""
        if self._order_status is None or not self._order_status.end:
            return None
        name, was_sent = command_name(self._message.command), self._transmitted_count > 0
        text = f"no COMMAND_ACK for {name} yet; not sent again" if was_sent else f"{name} was not sent"
        return CommandTimeout(f"{text}: {self._order_status.end}", was_sent=was_sent)

    def expire(self, now: float) -> None:
        """After the deadline, repeat the command. Fail after the last attempt, or if progress reports have stopped."""
        if self.deadline is None or now < self.deadline:
            return
        if self._in_progress:
            self._time_out(now)
        elif self._order_status is not None:
            self._repeat_order_or_fail(self._order_status, now)
        elif self._sent_count < self._attempts:
            self._send(now)
        else:
            self._time_out(now)

    def _repeat_order_or_fail(self, order_status: OrderStatus, now: float) -> None:
        if order_status.end:  # The order has ended; the text says why.
            self._time_out(now, f"; not sent again: {order_status.end}")
            return
        # The time is checked first: if the event loop was blocked, a recent HEARTBEAT must not cause a late repetition.
        give_up_at = self._started_at + self._attempts * self._attempt_timeout
        if now >= give_up_at:
            self._time_out(now, self._why_not_repeated(order_status))
            return
        # A HEARTBEAT after this time shows that the link to the vehicle works.
        min_heartbeat_at = max(self._sent_at + MIN_RESEND_FRACTION * self._attempt_timeout, now - MAX_HEARTBEAT_AGE_S)
        if self._sent_count < self._attempts and order_status.heartbeat_at >= min_heartbeat_at:
            self._send(now)
        else:
            self.deadline = min(now + POLL_INTERVAL_S, give_up_at)

    def _why_not_repeated(self, order_status: OrderStatus) -> str:
        if self._sent_count < self._attempts:
            return f"; not sent again: no {order_status.heartbeat_name} received since then"
        if self._attempts == 1 and allowed_attempts(self._message.command, _params_of(self._message)) == 1:
            repetition = UNREPEATABLE_COMMANDS[self._message.command]
            return f"; not sent again, because a repetition {repetition.effect}"
        return ""

    def _send(self, now: float) -> None:
        self._outbox.append(self._with_confirmation(self._sent_count))
        self._sent_count += 1
        self._sent_at = now
        wait_s = self._attempt_timeout
        if self._order_status is not None:
            # From this deadline on, `_repeat_order_or_fail` checks whether the command may be repeated.
            wait_s = min(MIN_RESEND_FRACTION * wait_s, ATTEMPT_TIMEOUT_S)
        self.deadline = now + wait_s

    def _with_confirmation(self, confirmation: int) -> Message:
        # COMMAND_LONG counts repetitions in the field `confirmation`. COMMAND_INT has no such field.
        message = self._message
        if confirmation == 0 or not isinstance(message, CommandLong):
            return message
        fields = message.to_dict() | {"confirmation": min(confirmation, 255)}
        return CommandLong(**fields)

    def _is_ours(self, ack: CommandAck) -> bool:
        # The caller passes only messages of the target system. The target fields are 0 (all) in MAVLink 1 and in
        # messages of old firmware.
        own_system, own_component = self._own_ids
        component = self._message.target_component
        frame = ack.received_frame
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

    @property
    def _transmitted_count(self) -> int:
        return self._sent_count - self._dropped_count

    def _time_out(self, now: float, why_not_repeated: str = "") -> None:
        was_sent = self._transmitted_count > 0
        text = self._timeout_text(now) + (why_not_repeated if was_sent else "")
        self._fail(CommandTimeout(text, was_sent=was_sent))

    def _timeout_text(self, now: float) -> str:
        name = command_name(self._message.command)
        if not self._transmitted_count:
            return f"{name} was not sent, because there was no usable link to the vehicle"
        if self._in_progress:
            return f"{name} was in progress, then no COMMAND_ACK for {self._progress_timeout:g} s"
        times = "once" if self._transmitted_count == 1 else f"{self._transmitted_count} times"
        return f"no COMMAND_ACK for {name}, sent {times} within {now - self._started_at:.1f} s"


def _params_of(message: CommandLong | CommandInt) -> tuple[float, ...]:
    return message.param1, message.param2, message.param3, message.param4


def rejection(command: int, result: int) -> CommandRejected:
    """Create the error for a MAV_RESULT other than ACCEPTED and IN_PROGRESS."""
    text = f"{command_name(command)} was refused: {result_name(result)}{_HINTS.get(result, '')}"
    return CommandRejected(text, command=command, result=result)


def command_name(command: int) -> str:
    """Return ``MAV_CMD_NAV_TAKEOFF`` for 22, or ``MAV_CMD 12345`` for an unknown number."""
    name = enum_name(MavCmd, command, unknown="")
    return f"MAV_CMD_{name}" if name else f"MAV_CMD {command}"


def result_name(result: int) -> str:
    """Return ``DENIED`` for 2, or ``MAV_RESULT 99`` for an unknown number."""
    return enum_name(MavResult, result, unknown=f"MAV_RESULT {result}")


_HINTS: dict[int, str] = {
    MavResult.TEMPORARILY_REJECTED: " (not at the moment; it may succeed later)",
    MavResult.DENIED: " (never with these parameters)",
    MavResult.UNSUPPORTED: " (this firmware does not know the command)",
    MavResult.COMMAND_LONG_ONLY: " (it must be sent as COMMAND_LONG)",
    MavResult.COMMAND_INT_ONLY: " (it must be sent as COMMAND_INT)",
    MavResult.COMMAND_UNSUPPORTED_MAV_FRAME: " (not in this frame; PX4 1.17 only supports MAV_FRAME_GLOBAL_INT, 5)",
}


def _check_target(target_system: int, command: int) -> None:
    if not 1 <= target_system <= 255:
        raise InvalidArgument(
            f"{command_name(command)}: target_system = {target_system} is not allowed: it must be 1 to 255"
            " (0 would command every vehicle on the link)"
        )


def _checked_params(command: int, params: tuple[float, ...], count: int) -> list[float]:
    """Convert the parameters to floats, and add zeros for missing parameters."""
    numbers = [_checked_number(command, f"param{number}", value) for number, value in enumerate(params, start=1)]
    return numbers + [0.0] * (count - len(numbers))


def _checked_number(command: int, field: str, value: float) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise InvalidArgument(f"{command_name(command)}: {field} = {value!r} is not a number") from None
    except OverflowError:  # an int beyond the range of float
        number = math.inf
    if math.isinf(number) or abs(number) > FLOAT32_MAX:  # NaN is allowed: many commands use it for "unchanged".
        raise InvalidArgument(f"{command_name(command)}: {field} = {value!r} is not a finite 32-bit float")
    return number
