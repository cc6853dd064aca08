"""``Actuators``: servos, relays, actuators, landing gear, lights, the motor test and the parachute."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal

import anyio

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit._internal.async_block import ReadOnly
from aerokit.errors import CommandRejected, InvalidArgument, OperationRejected
from aerokit.mavlink.enums import MavCmd, MavComponent, MavLandedState, MotorTestThrottleType, ParachuteAction
from aerokit.vehicle.commanding.progress import await_progress
from aerokit.vehicle.commanding.simple_orders import Argument, Effect, SimpleOrder

if TYPE_CHECKING:
    from aerokit.mavlink.messages import IlluminatorStatus, RelayStatus, ServoOutputRaw
    from aerokit.vehicle.commanding.context import VehicleContext

__all__ = ["Actuators"]

SpinIntent = Literal["spin motor"]
ReleaseIntent = Literal["release parachute"]

MAX_MOTOR_TEST_S = 3.0
"""PX4 ends a motor test after at most 3 s (Commander.cpp, handleCommandActuatorTest)."""
TEST_END_TIMEOUT_S = 4.0
PARACHUTE_TIMEOUT_S = 3.0
ACTUATORS = 6
ALL_GEARS = -1
OUTPUTS_PER_MESSAGE = 16


def _has_pulse(message: ServoOutputRaw, number: int, pulse_us: int) -> bool:
    port, index = divmod(number - 1, OUTPUTS_PER_MESSAGE)
    return message.port == port and getattr(message, f"servo{index + 1}_raw") == pulse_us


def _is_switched(message: RelayStatus, number: int, on: bool) -> bool:
    return bool(message.on >> number & 1) == on


def _is_lit(message: IlluminatorStatus, on: bool) -> bool:
    return bool(message.enable) == on


SERVO = Argument("number", 1, 32)
RELAY = Argument("number", 0, 15)
PULSE = Argument("pulse_us", 500, 2500)
COUNT = Argument("count", 1, 1000)
PERIOD = Argument("period_s", 0, 60, above=True)
ON = Argument("on", 0, 1)
GEAR_DOWN, GEAR_UP = 0, 1
SERVO_EFFECT = Effect("ServoOutputRaw", _has_pulse)
RELAY_EFFECT = Effect("RelayStatus", _is_switched)
LIGHT_EFFECT = Effect("IlluminatorStatus", _is_lit)
GEAR = (ALL_GEARS, Argument("up", 0, 1))
PARACHUTE_ACTION = (Argument("action", 0, 2),)
SET_SERVO = SimpleOrder("set_servo", MavCmd.DO_SET_SERVO, (SERVO, PULSE), SERVO_EFFECT, missing_on=("PX4",))
REPEAT_SERVO = SimpleOrder("repeat_servo", MavCmd.DO_REPEAT_SERVO, (SERVO, PULSE, COUNT, PERIOD), missing_on=("PX4",))
SET_RELAY = SimpleOrder("set_relay", MavCmd.DO_SET_RELAY, (RELAY, ON), RELAY_EFFECT, missing_on=("PX4",))
REPEAT_RELAY = SimpleOrder("repeat_relay", MavCmd.DO_REPEAT_RELAY, (RELAY, COUNT, PERIOD), missing_on=("PX4",))
LANDING_GEAR = SimpleOrder("landing_gear", MavCmd.AIRFRAME_CONFIGURATION, GEAR, missing_on=("PX4", "Rover", "ArduSub"))
LIGHTS = SimpleOrder("set_lights", MavCmd.ILLUMINATOR_ON_OFF, (ON,), LIGHT_EFFECT, missing_on=("PX4", "ArduPilot"))
PARACHUTE = SimpleOrder("parachute", MavCmd.DO_PARACHUTE, PARACHUTE_ACTION, missing_on=("PX4", "Rover", "ArduSub"))
MOTOR_TEST = SimpleOrder("test_motor", MavCmd.DO_MOTOR_TEST, missing_on=("PX4",))
PERCENT = MotorTestThrottleType.THROTTLE_PERCENT


@checks_arguments
class Actuators(ReadOnly):
    """Outputs of the vehicle other than its flight controls: ``vehicle.actuators``.

    ArduPilot has servos, relays, landing gear and a parachute; PX4 has actuators. If you cancel a call, the vehicle may
    still have executed the order.
    """

    def __init__(self, context: VehicleContext) -> None:
        self._context = context

    async def set_servo(self, number: int, pulse_us: int) -> None:
        """Set the pulse width of a servo output, and return when SERVO_OUTPUT_RAW reports it (MAV_CMD_DO_SET_SERVO).

        ArduPilot only. The output must have no function, or pass a stick through (SERVOn_FUNCTION 0, 1, 51 to 66).

        Args:
            number: output, 1 to 32.
            pulse_us: pulse width in microseconds, 500 to 2500.

        Raises:
            InvalidArgument: a value is out of range. Nothing was sent.
            NotSupported: the firmware does not support the command. Nothing was sent.
            CommandRejected: the vehicle refused, for example because the output has another function.
            CommandTimeout: there was no acknowledgement.
            OperationRejected: your program gave a newer order for this output.
            OperationTimeout: SERVO_OUTPUT_RAW still reports another pulse width.
        """
        await SET_SERVO.send(self._context, number, pulse_us, topic=("servo", number))

    async def repeat_servo(self, number: int, pulse_us: int, *, count: int, period_s: float) -> None:
        """Move a servo ``count`` times to a pulse width and back to its trim (MAV_CMD_DO_REPEAT_SERVO).

        ArduPilot only. Returns when ArduPilot has acknowledged the command, because no message reports the end of the
        cycles. ArduPilot repeats one output at a time: the next order of this kind replaces the previous one. The
        command is never sent twice, because a second one would start the cycles again.

        Args:
            number: output, 1 to 32, as for :meth:`set_servo`.
            pulse_us: pulse width in microseconds, 500 to 2500.
            count: number of cycles, 1 to 1000.
            period_s: seconds from one pulse to the next, above 0, at most 60.

        Raises:
            InvalidArgument, NotSupported, CommandRejected, CommandTimeout: as for ``set_servo``.
        """
        await REPEAT_SERVO.send(self._context, number, pulse_us, count, period_s, topic=("servo", number))

    async def set_relay(self, number: int, on: bool) -> None:
        """Switch a relay, and return when RELAY_STATUS reports it (MAV_CMD_DO_SET_RELAY).

        ArduPilot only. ArduPilot refuses a relay that has no pin. With firmware before 4.5, which has no RELAY_STATUS,
        the call returns at the acknowledgement. Raises as :meth:`set_servo`.

        Args:
            number: relay from 0 (RELAY1_PIN) to 15.
            on: the new state.
        """
        await SET_RELAY.send(self._context, number, on, topic=("relay", number))

    async def repeat_relay(self, number: int, *, count: int, period_s: float) -> None:
        """Switch a relay to its other state and back, ``count`` times (MAV_CMD_DO_REPEAT_RELAY).

        ArduPilot only. Returns when ArduPilot has acknowledged the command. The command is never sent twice. Raises as
        :meth:`repeat_servo`.

        Args:
            number: relay from 0 to 15.
            count: number of cycles, 1 to 1000.
            period_s: seconds of one cycle, above 0, at most 60.
        """
        await REPEAT_RELAY.send(self._context, number, count, period_s, topic=("relay", number))

    async def set_actuator(self, number: int, value: float) -> None:
        """Set one actuator (1 to 6) to a value from −1 to 1. Raises as :meth:`set_actuators`."""
        check_range("number", number, 1, ACTUATORS)
        await self.set_actuators(*(value if index == number else None for index in range(1, ACTUATORS + 1)))

    async def set_actuators(self, *values: float | None) -> None:
        """Set up to six actuators (MAV_CMD_DO_SET_ACTUATOR).

        PX4 only; for ArduPilot use ``set_servo``. The first value sets the outputs with the function "Peripheral via
        Actuator Set 1" (PWM_MAIN_FUNCn is 301), the sixth value those with "… Set 6" (306). Returns when PX4 has
        acknowledged, because no message reports the values. PX4 acknowledges even if no output has the function.
        Raises as :meth:`repeat_servo`.

        Args:
            values: one to six values, −1 to 1; None leaves an actuator as it is.
        """
        if not 1 <= len(values) <= ACTUATORS or all(value is None for value in values):
            raise InvalidArgument(f"values = {values!r} is not allowed: pass 1 to {ACTUATORS} values, not all None")
        for value in values:
            if value is not None:
                check_range("values", value, -1, 1)
        params = [math.nan if value is None else float(value) for value in values]
        params += [math.nan] * (ACTUATORS - len(params))
        first_set = 0  # index of the set: actuators 1 to 6
        order = SimpleOrder("set_actuators", MavCmd.DO_SET_ACTUATOR, (*params, first_set), missing_on=("ArduPilot",))
        await order.send(self._context, topic="actuators")

    async def raise_landing_gear(self) -> None:
        """Retract the landing gear (MAV_CMD_AIRFRAME_CONFIGURATION); returns at the acknowledgement.

        ArduCopter and ArduPlane only. No message reports the position of the gear. ArduPilot accepts the order even if
        there is no landing gear (LGR_ENABLE), and even while the vehicle stands on its gear.

        Raises:
            NotSupported: the firmware (PX4, Rover or Sub) does not support the command. Nothing was sent.
            OperationRejected: the vehicle is disarmed, or last reported that it is on the ground. Nothing was sent.
            CommandRejected: the vehicle refused.
            CommandTimeout: there was no acknowledgement.
        """
        LANDING_GEAR.check_supported(self._context)
        telemetry = self._context.session.telemetry
        # An old report is sufficient, because a vehicle on the ground stands on its gear until it reports a take-off.
        # A vehicle that reports nothing gets the order.
        if telemetry.landed_state.latest == MavLandedState.ON_GROUND or telemetry.is_confirmed_disarmed:
            raise OperationRejected("raise_landing_gear: the vehicle is disarmed or on the ground; nothing was sent")
        await LANDING_GEAR.send(self._context, GEAR_UP, topic="landing gear")

    async def lower_landing_gear(self) -> None:
        """Deploy the landing gear; returns at the acknowledgement.

        Raises:
            NotSupported, CommandRejected, CommandTimeout: as for ``raise_landing_gear``.
        """
        await LANDING_GEAR.send(self._context, GEAR_DOWN, topic="landing gear")

    async def set_lights(self, on: bool, *, component_id: int = MavComponent.ILLUMINATOR) -> None:
        """Switch an illuminator, and return when ILLUMINATOR_STATUS reports it (MAV_CMD_ILLUMINATOR_ON_OFF).

        Only for lights that are MAVLink components, because ArduPilot and PX4 do not support the command. Switch lights
        on an output of ArduPilot by ``set_servo`` or ``set_relay``. Raises as :meth:`set_servo`.

        Args:
            on: the new state.
            component_id: component id of the light, 1 to 255; MAV_COMP_ID_ILLUMINATOR is 243.
        """
        check_range("component_id", component_id, 1, 255)
        await LIGHTS.send(self._context, on, topic=("lights", component_id), component_id=component_id)

    async def test_motor(self, number: int, *, throttle_percent: float, duration_s: float, intent: SpinIntent) -> None:
        """Spin one motor of a disarmed vehicle, and return when it has stopped; remove the propellers first.

        ArduPilot: MAV_CMD_DO_MOTOR_TEST. PX4: MAV_CMD_ACTUATOR_TEST, if COM_MOT_TEST_EN is 1. The command is sent once,
        because a second one would spin the motor again.

        The motor stops after ``duration_s``. If the call is cancelled or fails while the motor may turn, aerokit orders
        the motor to stop at once. ArduCopter reports armed during the test, and the call returns when it reports
        disarmed. PX4 reports nothing about the test, so the call returns after ``duration_s``.

        Args:
            number: 1 to 12. ArduCopter counts motors clockwise from the front; PX4 uses the number of the output
                function (Motor 1).
            throttle_percent: 0 to 100.
            duration_s: seconds, above 0, at most 3.
            intent: must be ``"spin motor"``, so that a motor test is never started by mistake.

        Raises:
            InvalidArgument: a value is out of range, or the intent is another text. Nothing was sent.
            OperationRejected: the vehicle is armed, or not known to be disarmed (nothing was sent); or your program
                started another motor test.
            CommandRejected: the vehicle refused (not landed, safety switch, COM_MOT_TEST_EN).
            CommandTimeout: there was no acknowledgement; the motor may have turned.
            OperationTimeout: the vehicle still reports armed four seconds after the end of the test.
        """
        check_range("number", number, 1, 12)
        check_range("throttle_percent", throttle_percent, 0, 100)
        check_range("duration_s", duration_s, 0, MAX_MOTOR_TEST_S, above=True)
        session, arbiter = self._context.session, self._context.arbiter
        start: tuple[float, ...]
        stop: tuple[float, ...]
        # On ArduPilot, a test with throttle 0 for 0 s ends a running test. On PX4, a test of 0 s releases the output.
        if MOTOR_TEST.is_supported(session.autopilot):
            command = MavCmd.DO_MOTOR_TEST
            motor_count = 1
            start = (number, PERCENT, throttle_percent, duration_s, motor_count)
            stop = (number, PERCENT, 0, 0, motor_count)
        else:
            command = MavCmd.ACTUATOR_TEST
            unused = (0, 0)
            start = (throttle_percent / 100, duration_s, *unused, number)
            stop = (math.nan, 0, *unused, number)
        session.check_disarmed("test_motor", is_state_recent=arbiter.is_state_recent)
        # On ArduPilot, a new test ends the test of another motor.
        order = arbiter.device_order("motor test" if command == MavCmd.DO_MOTOR_TEST else f"motor test {number}")
        spins_until = order.given_at + duration_s  # the earliest possible end of the test
        try:
            await SimpleOrder("test_motor", command, start).send(self._context, device_order=order)
            await anyio.sleep(duration_s)
            armed, ended_at = session.telemetry.armed, session.connection.now()
            await await_progress(
                session,
                "test_motor",
                is_done=lambda: armed.latest is False and armed.updated_at > ended_at,
                failure_reason=lambda: None if order.is_newest else "another motor test was started",
                describe=lambda: "the vehicle still reports armed",
                timeout=TEST_END_TIMEOUT_S,
            )
        except CommandRejected:  # The motor does not turn, so it need not be stopped.
            raise
        except BaseException:
            # Send the stop command only while the test runs. Afterwards it would start another test, which arms the
            # motors.
            is_spinning = session.connection.now() < spins_until
            can_send = arbiter.is_state_recent and session.connection.is_open
            if is_spinning and order.is_newest and can_send:
                session.commands.send_unconfirmed(command, *stop)
            raise

    async def release_parachute(self, *, intent: ReleaseIntent) -> None:
        """Release the parachute and stop the motors; return when ArduPilot reports the release (MAV_CMD_DO_PARACHUTE).

        **The vehicle falls.** ArduCopter and ArduPlane only. ArduPilot accepts the command and then refuses the release
        by a status text if the vehicle is on the ground or below CHUTE_ALT_MIN, or if the parachute is disabled.

        Args:
            intent: must be ``"release parachute"``, so that the parachute is never released by mistake.

        Raises:
            InvalidArgument: the intent is another text. Nothing was sent.
            NotSupported: the firmware (PX4, Rover or Sub) does not support the command. Nothing was sent.
            OperationRejected: the vehicle refused after the acknowledgement; ``reasons`` has its status texts.
            CommandRejected: the vehicle refused.
            CommandTimeout: there was no acknowledgement.
            OperationTimeout: no status text reported the release.
        """
        # The decorator `checks_arguments` has refused every other intent.
        await PARACHUTE.send_until_text(
            self._context,
            ParachuteAction.RELEASE,
            topic="parachute",
            is_done=lambda text, _: text.startswith("Parachute: Released"),
            # A text that `is_done` accepts ends the wait. All other texts about the parachute are refusals.
            is_refusal=lambda text: text.startswith("Parachute: "),
            timeout=PARACHUTE_TIMEOUT_S,
        )

    async def enable_parachute(self, enabled: bool = True) -> None:
        """Allow or forbid the release of the parachute until the next reboot (MAV_CMD_DO_PARACHUTE).

        ArduCopter and ArduPlane only. Returns at the acknowledgement.

        Args:
            enabled: False forbids the release, even by a failsafe.

        Raises:
            NotSupported, CommandRejected, CommandTimeout: as for ``release_parachute``.
        """
        action = ParachuteAction.ENABLE if enabled else ParachuteAction.DISABLE
        await PARACHUTE.send(self._context, action, topic="parachute")
