"""``vehicle.version`` and ``vehicle.capabilities``: what the firmware is, and what it understands."""

from __future__ import annotations

from typing import Any

__all__ = ["Capabilities", "Version"]

STABLE = 255
RELEASE_TYPES = ("dev", "alpha", "beta", "rc")
AUTOPILOTS = {3: "APM:", 12: "PX4"}
VEHICLES = {1: "Plane", 2: "Copter", 10: "Rover"}
"""MAV_AUTOPILOT and MAV_TYPE as DroneKit's programs know them: others have their number in the text."""


class Version:
    """A firmware version: printed, it is for example ``APM:Copter-4.6.1`` or ``PX4Copter-1.15.0-beta2``.

    Args:
        raw_version: flight_sw_version of AUTOPILOT_VERSION, one byte each for ``major``, ``minor``, ``patch`` and
            ``release``; None when it is not known, then all four are None.
        autopilot_type: MAV_AUTOPILOT of the heartbeat, or None.
        vehicle_type: MAV_TYPE of the heartbeat, or None.
    """

    major: int | Any
    minor: int | Any
    patch: int | Any
    release: int | Any

    def __init__(self, raw_version: int | None, autopilot_type: int | None, vehicle_type: int | None) -> None:
        self.raw_version = raw_version
        self.autopilot_type = autopilot_type
        self.vehicle_type = vehicle_type
        self.major = self.minor = self.patch = self.release = None
        if raw_version is not None:
            self.major, self.minor, self.patch, self.release = (raw_version & 0xFFFFFFFF).to_bytes(4, "big")

    def is_stable(self) -> bool:
        """Whether it is a release, not one of the versions before."""
        return bool(self.release == STABLE)

    def release_version(self) -> int | None:
        """23 for rc23; 0 for a release, None when the version is not known."""
        if self.release is None:
            return None
        return 0 if self.is_stable() else int(self.release % 64)

    def release_type(self) -> str | None:
        """``'dev'``, ``'alpha'``, ``'beta'`` or ``'rc'``, which releases say, too; None when it is not known."""
        return None if self.release is None else RELEASE_TYPES[self.release >> 6]

    def __str__(self) -> str:
        autopilot = AUTOPILOTS.get(self.autopilot_type or 0, "UnknownAutoPilot")
        vehicle = VEHICLES.get(self.vehicle_type or 0, f"UnknownVehicleType{self.vehicle_type}")
        return f"{autopilot}{vehicle}-{self.major}.{self.minor}.{self.patch}{self._suffix()}"

    def __repr__(self) -> str:
        return str(self)

    def _suffix(self) -> str:
        if self.release is None:
            return "UnknownReleaseType"
        return "" if self.is_stable() else f"-{self.release_type()}{self.release_version()}"


class Capabilities:
    """What the autopilot understands, a bool each (MAV_PROTOCOL_CAPABILITY); all False while it is not known."""

    def __init__(self, capabilities: int | None) -> None:
        bits = capabilities or 0
        self.mission_float = bool(bits & 1)
        self.param_float = bool(bits & 1 << 1)
        self.mission_int = bool(bits & 1 << 2)
        self.command_int = bool(bits & 1 << 3)
        self.param_union = bool(bits & 1 << 4)
        self.ftp = bool(bits & 1 << 5)
        self.set_attitude_target = bool(bits & 1 << 6)
        self.set_attitude_target_local_ned = bool(bits & 1 << 7)
        self.set_altitude_target_global_int = bool(bits & 1 << 8)
        self.terrain = bool(bits & 1 << 9)
        self.set_actuator_target = bool(bits & 1 << 10)
        self.flight_termination = bool(bits & 1 << 11)
        self.compass_calibration = bool(bits & 1 << 12)

    def __repr__(self) -> str:
        known = [name for name, value in vars(self).items() if value]
        return f"Capabilities({', '.join(known)})"
