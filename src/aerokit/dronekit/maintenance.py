"""Calibrations, tunes and reboots: what a vehicle is asked on the ground."""

from __future__ import annotations

from typing import Any

from aerokit.dronekit.core import VehicleCore
from aerokit.dronekit.exceptions import APIException
from aerokit.errors import InvalidArgument
from aerokit.mavlink.enums import MavCmd
from aerokit.mavlink.messages import PlayTune
from aerokit.protocols.command import command_long

__all__ = ["Maintenance"]

CALIBRATION_S = 35.0
"""ArduPilot answers when it is done, after half a minute if the vehicle is not held still."""
REBOOT_S = 3.0
TUNE_SIZES = (30, 200)


class Maintenance(VehicleCore):
    """Orders for a vehicle on the ground. They return at once; a refusal is a warning of the logger ``dronekit``."""

    # -------------------------------------------------------------------------- calibrations

    def send_calibrate_gyro(self) -> None:
        """Calibrate the gyroscopes: keep the vehicle still."""
        self._dk_calibrate(MavCmd.PREFLIGHT_CALIBRATION, 1)

    def send_calibrate_magnetometer(self) -> None:
        """Calibrate the compasses: turn the vehicle about all axes until it says that it is done."""
        if self._dk.check_link().autopilot.calibrates_compasses_by_command:
            self._dk_calibrate(MavCmd.DO_START_MAG_CAL, 0, 1, 1)  # all compasses; retry; save by itself
        else:
            self._dk_calibrate(MavCmd.PREFLIGHT_CALIBRATION, 0, 1)

    def send_calibrate_vehicle_level(self) -> None:
        """Take the attitude of this moment for level."""
        self._dk_calibrate(MavCmd.PREFLIGHT_CALIBRATION, 0, 0, 0, 0, 2)

    def send_calibrate_barometer(self) -> None:
        """Take the pressure of this moment for altitude 0."""
        self._dk_calibrate(MavCmd.PREFLIGHT_CALIBRATION, 0, 0, 1)

    def send_calibrate_accelerometer(self, simple: bool = False) -> None:
        """Calibrate the accelerometers: in the six attitudes it asks for by texts, or, ``simple``, standing level."""
        self._dk_calibrate(MavCmd.PREFLIGHT_CALIBRATION, 0, 0, 0, 0, 4 if simple else 1)

    def _dk_calibrate(self, command: int, *params: float) -> None:
        self._dk.command(
            "calibration",
            command,
            *params,
            attempt_timeout=CALIBRATION_S,
            progress_timeout=CALIBRATION_S,
        )

    # --------------------------------------------------------------------------------- rest

    def play_tune(self, tune: str | bytes) -> None:
        """Play a tune on the vehicle's buzzer: notes as ``"AAAA"``, in the format of the autopilot (PLAY_TUNE).

        At most 230 characters of ASCII (else ValueError); ArduPilot plays the first 99. APIException: the link is down,
        or the vehicle speaks MAVLink 1, which has no such message.
        """
        text = _tune_text(tune)
        if self._dk.check_link().connection.mavlink_version == 1:
            raise APIException("play_tune needs MAVLink 2, which this vehicle does not speak")
        first = TUNE_SIZES[0]
        self._dk.send(PlayTune(self._dk.target_system, 0, text[:first], text[first:]))

    def reboot(self) -> None:
        """Reboot the autopilot. It is away for some seconds, and then boots anew. Refused while it is armed.

        Sent once: a lost answer is a warning, and the vehicle may have rebooted.
        """
        shutdown = MavCmd.PREFLIGHT_REBOOT_SHUTDOWN
        self._dk.command("reboot", shutdown, 1, attempt_timeout=REBOOT_S)

    def send_capabilities_request(self, vehicle: Any, name: str, m: Any) -> None:
        """Ask for AUTOPILOT_VERSION once. Has the arguments of a message listener, and uses none of them."""
        self._dk.check_link()
        self._dk.send(command_long(self._dk.target_system, 0, MavCmd.REQUEST_AUTOPILOT_CAPABILITIES, (1,)))

    def send_capabilties_request(self, vehicle: Any, name: str, m: Any) -> None:
        """As :meth:`send_capabilities_request`; this spelling was the first."""
        self.send_capabilities_request(vehicle, name, m)


def _tune_text(tune: str | bytes) -> str:
    try:
        text = tune.encode() if isinstance(tune, str) else tune
        notes = text.rstrip(b"\0").decode("ascii")
    except (UnicodeError, AttributeError):
        raise InvalidArgument(f"tune = {tune!r} is not allowed: a text of ASCII characters") from None
    if "\0" in notes or len(notes) > sum(TUNE_SIZES):
        raise InvalidArgument(
            f"tune of {len(notes)} characters is not allowed: at most {sum(TUNE_SIZES)}, none of them NUL"
        )
    return notes
