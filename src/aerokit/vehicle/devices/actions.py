"""``DeviceActions``: tunes, status texts of the program, failure injection, grippers and winches of a vehicle."""

from __future__ import annotations

import re
from functools import cached_property
from typing import TYPE_CHECKING, Literal

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit._internal.formatting import short_repr
from aerokit.errors import InvalidArgument
from aerokit.mavlink.enums import FailureType, FailureUnit, MavCmd, MavSeverity
from aerokit.mavlink.messages import PlayTune, Statustext
from aerokit.vehicle.commanding.context import VehicleBase
from aerokit.vehicle.commanding.simple_orders import Argument, SimpleOrder
from aerokit.vehicle.state.status_text import CHUNK_LENGTH

if TYPE_CHECKING:
    from aerokit.vehicle.devices.actuators import Actuators
    from aerokit.vehicle.devices.gripper import Gripper
    from aerokit.vehicle.devices.shell import Shell
    from aerokit.vehicle.devices.winch import Winch

# fmt: off
FailingUnit = Literal[
    "gyro", "accel", "mag", "baro", "gps", "optical_flow", "vio", "distance_sensor", "airspeed", "battery", "motor",
    "servo", "avoidance", "rc_signal", "mavlink_signal",
]
FailureKind = Literal["ok", "off", "stuck", "garbage", "wrong", "slow", "delayed", "intermittent"]
Severity = Literal["emergency", "alert", "critical", "error", "warning", "notice", "info", "debug"]
# fmt: on
FailureIntent = Literal["inject failure"]
# The keys are the names without their first word: "gyro" for SENSOR_GYRO.
UNITS: dict[str, FailureUnit] = {unit.name.partition("_")[2].lower(): unit for unit in FailureUnit}
INJECT_FAILURE = SimpleOrder(
    "inject_failure",
    MavCmd.INJECT_FAILURE,
    (Argument("unit", 0, 255), Argument("kind", 0, 255), Argument("instance", 0, 16)),
    missing_on=("ArduPilot",),
)
TUNE = re.compile(r"[A-Ga-gLlMmNnOoPpSsTt0-9#+.<>\- ]+")
"""Characters allowed in a tune: those of QBASIC 1.1's PLAY statement, which ArduPilot and PX4 understand."""
TUNE_PART, MAX_TUNE = 30, 230
MAX_TEXT_BYTES = 1000


@checks_arguments
class DeviceActions(VehicleBase):
    """Devices and signals of a vehicle that do not control its flight."""

    @cached_property
    def actuators(self) -> Actuators:
        """Servos, relays, actuators, landing gear, lights, motor test, parachute."""
        from aerokit.vehicle.devices.actuators import Actuators

        return Actuators(self._context)

    def gripper(self, number: int = 1) -> Gripper:
        """Return one gripper of the vehicle: ``await vehicle.gripper().release()``.

        Args:
            number: 1 to 8. ArduPilot and PX4 support one gripper and ignore the number.

        Raises:
            InvalidArgument: the number is out of range.
        """
        from aerokit.vehicle.devices.gripper import NUMBER, Gripper

        NUMBER.check(number)
        return Gripper(self._context, number)

    def winch(self, number: int = 1, *, component_id: int | None = None) -> Winch:
        """Return one winch of the vehicle: ``await vehicle.winch().pay_out(5)``.

        Args:
            number: 1 to 255. ArduCopter supports one winch and ignores the number.
            component_id: component id of a winch that is a MAVLink component, 1 to 255 (MAV_COMP_ID_WINCH is 169).
                None: the autopilot's own winch.

        Raises:
            InvalidArgument: a number is out of range.
        """
        from aerokit.vehicle.devices.winch import Winch

        check_range("number", number, 1, 255)
        if component_id is not None:
            check_range("component_id", component_id, 1, 255)
        return Winch(self._context, number, component_id)

    def shell(self) -> Shell:
        """Open PX4's system shell for the duration of an ``async with`` block (SERIAL_CONTROL)."""
        from aerokit.vehicle.devices.shell import Shell

        return Shell(self._context)

    def play_tune(self, tune: str) -> None:
        """Play a tune on the vehicle's buzzer (PLAY_TUNE), for example ``"T200 L8 CEGO5C"``; returns at once.

        The message has no acknowledgement, and vehicles without a buzzer ignore it.

        Args:
            tune: notes in the format of QBASIC 1.1's PLAY statement, 1 to 230 characters: T tempo, L length, O octave,
                A to G notes, P pause.

        Raises:
            InvalidArgument: the tune is empty, too long, or contains other characters. Nothing was sent.
        """
        if not 1 <= len(tune) <= MAX_TUNE or not TUNE.fullmatch(tune):
            raise InvalidArgument(
                f"tune = {short_repr(tune)} is not allowed: it must be 1 to {MAX_TUNE} characters of QBASIC's"
                " PLAY statement"
            )
        tune1, tune2 = tune[:TUNE_PART], tune[TUNE_PART:]  # the two fields of the message
        self._session.send(PlayTune(self.system_id, self.component_id, tune1, tune2))

    def send_status_text(self, text: str, *, severity: Severity = "info") -> None:
        """Send a status text of your program to the vehicle and to other stations (STATUSTEXT); returns at once.

        There is no acknowledgement. ArduPilot writes the text to its flight log. A text of more than 50 bytes is sent
        in chunks.

        Args:
            text: 1 to 1000 bytes in UTF-8.
            severity: name of a MAV_SEVERITY in lower case.

        Raises:
            InvalidArgument: the text is empty or too long, or the severity is unknown. Nothing was sent.
        """
        data = text.encode()
        if not 1 <= len(data) <= MAX_TEXT_BYTES:
            raise InvalidArgument(f"text has {len(data)} bytes; 1 to {MAX_TEXT_BYTES} are allowed")
        self._last_text_id = self._last_text_id % 0xFFFF + 1  # a number from 1 to 65535
        text_id = 0 if len(data) <= CHUNK_LENGTH else self._last_text_id  # 0 means that the text has only one chunk.
        for chunk_number, chunk in enumerate(_chunks(text)):
            self._session.send(
                Statustext(severity=MavSeverity[severity.upper()], text=chunk, id=text_id, chunk_seq=chunk_number)
            )

    _last_text_id = 0  # Each vehicle begins with this value.

    async def inject_failure(
        self, unit: FailingUnit, kind: FailureKind, *, instance: int = 0, intent: FailureIntent
    ) -> None:
        """Make a part of the vehicle fail, to test how the vehicle reacts (MAV_CMD_INJECT_FAILURE).

        **The vehicle may crash.** Only PX4 supports this, and only if SYS_FAILURE_EN is 1. Returns when PX4 has
        acknowledged. PX4 then reports the failure by status texts and by the health of its sensors. ``kind="ok"`` ends
        the failure. The command is sent once.

        Args:
            unit: the part that fails (FAILURE_UNIT).
            kind: how it fails (FAILURE_TYPE).
            instance: number of the part from 1 to 16; 0 means all parts of this kind.
            intent: must be ``"inject failure"``, so that a failure is never injected by mistake.

        Raises:
            InvalidArgument: an argument is not allowed. Nothing was sent.
            NotSupported: the vehicle runs ArduPilot, whose simulation has SIM_ parameters instead. Nothing was sent.
            CommandRejected: SYS_FAILURE_EN is 0, or PX4 does not support this kind of failure of the part.
            CommandTimeout: there was no acknowledgement. PX4 sends none if it supports no failure of the part. If an
                acknowledgement was lost, the part may have failed.
        """
        # The decorator `checks_arguments` has refused every other intent.
        await INJECT_FAILURE.send(self._context, UNITS[unit], FailureType[kind.upper()], instance)


def _chunks(text: str) -> list[str]:
    """Split a text into chunks of at most 50 bytes, between characters."""
    chunks = [""]
    for character in text:
        if len((chunks[-1] + character).encode()) > CHUNK_LENGTH:
            # A receiver treats a chunk of less than 50 bytes as the last chunk, so this one is padded.
            chunks[-1] += " " * (CHUNK_LENGTH - len(chunks[-1].encode()))
            chunks.append("")
        chunks[-1] += character
    # The last of several chunks must have less than 50 bytes. A text of one chunk has the id 0, and needs no end mark.
    if len(chunks) > 1 and len(chunks[-1].encode()) == CHUNK_LENGTH:
        chunks.append("")
    return chunks
