"""Interfaces and base classes of the parts of a simulated ArduPilot: vehicle, flight modes, motors.

The parts do not import the class of the vehicle. They use the vehicle and each other through these interfaces.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from typing import Any, ClassVar, Protocol, TypeVar

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavFrame, MavSeverity
from aerokit.sim.ardupilot.kinds import BootTimeline, Kind
from aerokit.sim.ardupilot.mission_lists import CommandList
from aerokit.sim.autopilot import SimulatedAutopilot
from aerokit.sim.channel import Channel
from aerokit.sim.commands import rotated
from aerokit.sim.missions import MissionStore
from aerokit.sim.motion import Ned

RC_ROLL, RC_PITCH, RC_THROTTLE, RC_YAW = range(4)
"""Indices of the RC channels of the sticks, in ArduPilot's default RCMAP."""
SUB_PITCH, SUB_ROLL, SUB_FORWARD, SUB_LATERAL = 0, 1, 4, 5
"""Indices of the RC channels of ArduSub that have another meaning than in other firmwares."""

HostT = TypeVar("HostT", bound="ArduPilotHost")


class ArduPilotMode:
    """Base of the flight modes. Optional operations do nothing or are refused, unless a subclass overrides them."""

    number: int
    name: str
    needs_position: bool = True
    needs_mission: bool = False
    has_manual_throttle: bool = False
    can_arm: bool = True
    arms_with_raised_throttle: bool = False
    can_change_speed: bool = False
    speed: float
    """Speed to fly or drive at, in m/s. Only modes with `can_change_speed` have it."""
    refused_because: str = "init failed"
    """Reason that a status text gives when `enter` returns False."""
    returns_on_path: bool = False
    """True for SMART_RTL, which returns along the recorded path."""
    notices_landing: bool = True
    """True if the land detector may declare the vehicle landed in this mode."""
    is_landing: bool = False
    is_taking_off: bool = False
    is_available: bool = True
    """False for a mode that the simulation always refuses."""
    entry_texts: tuple[str, ...] = ()
    """Status texts that are sent when the mode is entered or refused, with the severity `entry_severity`."""
    entry_severity: int = MavSeverity.INFO

    def __init__(self, vehicle: Any) -> None:
        self.vehicle = vehicle
        self._place: Ned | None = None  # place to go to or to circle; None without one

    def enter(self, *, force: bool) -> bool:
        """Send the entry texts and start the mode. Return False to refuse the mode.

        With ``force``, a subclass may accept a mode that cannot run yet. The vehicle forces a mode while it is
        disarmed.
        """
        for text in self.entry_texts:
            self.vehicle.send_text(self.entry_severity, text)
        return self.is_available

    def leave(self) -> None: ...

    def update(self, dt: float) -> None:
        """Set the targets of motors and motion for the next ``dt`` seconds."""

    def take_off(self, altitude_m: float, *, must_navigate: bool) -> bool:
        """Climb to an altitude above home. Return False if the mode does not support take-off by command.

        With ``must_navigate``, also return False if the mode cannot hold its horizontal position.
        """
        return False

    def pause(self) -> bool:
        """Stop at the current place. Return False if the mode cannot be paused at present."""
        return False

    def resume(self) -> bool:
        return False

    @property
    def destination(self) -> Ned | None:
        return self._place


class GuidedMode(ArduPilotMode):
    """Base of the modes GUIDED, which follow set-points. The vehicle registers the handlers of set-point messages."""

    @property
    def is_active(self) -> bool:
        return self.vehicle.mode is self

    def go_to(self, position: Ned) -> None:
        """Go to a point of the world frame and stay there."""
        raise NotImplementedError

    def on_local_target(self, message: m.SetPositionTargetLocalNed, _: Channel, /) -> None:
        raise NotImplementedError

    def on_global_target(self, message: m.SetPositionTargetGlobalInt, _: Channel, /) -> None:
        raise NotImplementedError

    def on_attitude_target(self, message: m.SetAttitudeTarget, _: Channel, /) -> None:
        raise NotImplementedError


def variant(
    make_mode: Callable[[HostT], ArduPilotMode], number: int, name: str, **traits: Any
) -> Callable[[HostT], ArduPilotMode]:
    """Return a factory that calls ``make_mode`` and sets the number, the name and the attributes in ``traits``."""

    def make_variant(host: HostT) -> ArduPilotMode:
        mode = make_mode(host)
        mode.number = number
        mode.name = name
        for trait, value in traits.items():
            assert hasattr(mode, trait), trait
            setattr(mode, trait, value)
        return mode

    return make_variant


class ConditionTimer:
    """Measures the time since a condition became true."""

    def __init__(self) -> None:
        self._since: float | None = None

    def seconds(self, condition: bool, now: float) -> float:
        """Return the seconds since ``condition`` became true, or 0 while it is false."""
        if not condition:
            self._since = None
        elif self._since is None:
            self._since = now
        return 0.0 if self._since is None else now - self._since

    def reset(self) -> None:
        self._since = None


_ARMING_DELAY_S = 2.0
_SPOOL_UP_S = 1.3
_SPOOL_DOWN_S = 1.1
_HOVER_THROTTLE, _IDLE_THROTTLE = 0.36, 0.05
_STOPPED_PWM, _IDLE_PWM, _FULL_PWM = 1000, 1100, 2000


class ArduPilotMotors:
    """Arming delay, spool-up and power consumption of the motors of a quadrotor.

    ``spool`` is 0 for idle or stopped motors and 1 for motors that can lift. It rises while ``spool_up_requested``.
    """

    ELECTRONICS_A: ClassVar[float] = 0.08
    """Current of the electronics while armed."""
    AMPERES_AT_FULL: ClassVar[float] = 78.0

    def __init__(self, vehicle: Any) -> None:
        self.vehicle = vehicle
        self.is_armed: bool = False
        self.armed_at: float = -math.inf
        self.disarmed_at: float = -math.inf
        self.may_turn: bool = False  # True once the arming delay is over.
        self.spool_up_requested: bool = False
        self.spool: float = 0.0
        self.throttle: float = 0.0  # From 0 to 1. VFR_HUD reports the throttle in percent.

    @property
    def can_lift(self) -> bool:
        return self.is_armed and self.spool >= 1.0

    @property
    def is_idle(self) -> bool:
        return self.spool <= 0.0

    @property
    def current_a(self) -> float:
        electronics_a = self.ELECTRONICS_A if self.is_armed else 0.0
        return electronics_a + abs(self.throttle) * self.AMPERES_AT_FULL

    @property
    def pwm(self) -> int:
        if not (self.is_armed and self.may_turn):
            return _STOPPED_PWM
        return round(_IDLE_PWM + 20 * self.spool + self.throttle * (_FULL_PWM - _IDLE_PWM) * 1.3)

    def set_armed(self, *, armed: bool) -> None:
        if self.is_armed and not armed:
            self.disarmed_at = self.vehicle.now
        self.is_armed = armed
        self.armed_at = self.vehicle.now
        self.may_turn = self.spool_up_requested = False
        self.spool = self.throttle = 0.0

    def update(self, dt: float, *, landed: bool) -> None:
        self.may_turn = self.is_armed and self.vehicle.now - self.armed_at >= _ARMING_DELAY_S
        if self.may_turn and self.spool_up_requested:
            if self.spool < 1.0:
                self.spool = min(1.0, self.spool + dt / _SPOOL_UP_S)
        else:
            self.spool = max(0.0, self.spool - dt / _SPOOL_DOWN_S)
        if landed or not self.is_armed:
            self.throttle = _IDLE_THROTTLE * self.spool
        else:
            self.throttle = min(1.0, _HOVER_THROTTLE * self.vehicle.motion.thrust_share)


# The following classes are the interfaces through which the parts of a vehicle use each other.


class ArduPilotNavigationHost(Protocol):
    home: Ned | None
    home_is_locked: bool
    flags: int | None
    fix_type: int
    is_gps_detected: bool
    is_healthy: bool

    @property
    def uses_external_navigation(self) -> bool: ...
    @property
    def has_position(self) -> bool: ...
    @property
    def has_attitude(self) -> bool: ...
    @property
    def altitude_above_home(self) -> float: ...
    def set_home(self, point: Ned, *, lock: bool) -> None: ...
    def world(self, local: Ned) -> Ned: ...


class ArduPilotMissionHost(Protocol):
    nav_index: int

    @property
    def is_running(self) -> bool: ...
    @property
    def is_present(self) -> bool: ...
    def set_current(self, index: int) -> bool: ...
    def on_disarmed(self) -> None: ...
    def on_cleared(self) -> None: ...
    def message(self, seq: int | None = None) -> m.MissionCurrent: ...


class ArduPilotMissionsHost(MissionStore, Protocol):
    commands: CommandList


class ArduPilotRadioHost(Protocol):
    def __getitem__(self, index: int, /) -> int: ...
    @property
    def is_receiving(self) -> bool: ...
    def override(self, pulses: Mapping[int, int]) -> None: ...


class ArduPilotFenceHost(Protocol):
    def update(self) -> None: ...
    def on_armed(self) -> None: ...
    def on_disarmed(self) -> None: ...
    def reason_not_to_arm(self) -> str | None: ...


RELATIVE_FRAMES = frozenset({MavFrame.GLOBAL_RELATIVE_ALT, MavFrame.GLOBAL_RELATIVE_ALT_INT})
TERRAIN_FRAMES = frozenset({MavFrame.GLOBAL_TERRAIN_ALT, MavFrame.GLOBAL_TERRAIN_ALT_INT})
ABSOLUTE_FRAMES = frozenset({MavFrame.GLOBAL, MavFrame.GLOBAL_INT})


class ArduPilotHost(SimulatedAutopilot):
    """Interface of a simulated ArduPilot for its modes, failsafes and other parts. `ArduPilotVehicle` implements it."""

    KIND: ClassVar[Kind]
    """The kind of firmware, which selects the parameter table."""
    FIRMWARE: ClassVar[str]
    """Firmware name in the banner."""
    FRAME: ClassVar[str | None] = None
    """Text about the airframe in the banner, or None to send no such text."""
    GIT_HASH: ClassVar[bytes] = b"5ae20c17"

    timeline: BootTimeline
    uid: bytes
    motors: ArduPilotMotors
    mode: ArduPilotMode
    guided: GuidedMode
    ground_station_seen_at: float
    """Time of the last heartbeat, RC override or MANUAL_CONTROL of the ground station MAV_GCS_SYSID; NaN before."""
    is_initialised: bool
    is_landed: bool
    navigation: ArduPilotNavigationHost
    mission: ArduPilotMissionHost
    missions: ArduPilotMissionsHost
    fence: ArduPilotFenceHost
    rc: ArduPilotRadioHost

    @property
    def is_armed(self) -> bool:
        return self.motors.is_armed

    @property
    def home_or_ground(self) -> Ned:
        """Home, or the power-on location while home is not set."""
        return self.navigation.home or (0.0, 0.0, self.motion.ground_down)

    @property
    def altitude_m(self) -> float:
        """Metres above home."""
        return self.navigation.altitude_above_home

    def set_mode(self, number: int) -> bool:
        """Change the mode, broadcast a heartbeat and return True. If the mode is refused, send a text."""
        raise NotImplementedError

    def available_modes(self) -> list[m.AvailableModes]:
        raise NotImplementedError

    def send_home(self, channel: Channel | None = None) -> None:
        """Send GPS_GLOBAL_ORIGIN if the origin is set, and HOME_POSITION if home is set."""
        self.send_built(m.GpsGlobalOrigin.ID, channel)
        self.send_built(m.HomePosition.ID, channel)

    def local_point(self, target: m.SetPositionTargetLocalNed, body_frames: Collection[int]) -> Ned:
        """Convert the position of a local set-point to the world frame.

        In LOCAL_NED, the position is relative to the estimator's origin, and in other frames to the vehicle's place. In
        ``body_frames``, it is also rotated by the vehicle's heading.
        """
        offset, motion = (target.x, target.y, target.z), self.motion
        if target.coordinate_frame == MavFrame.LOCAL_NED:
            return self.navigation.world(offset)
        if target.coordinate_frame in body_frames:
            offset = rotated(offset, motion.yaw)
        north, east, down = offset
        return (motion.north + north, motion.east + east, motion.down + down)

    def send_banner(self) -> None:
        """Send texts with firmware version, board id and frame."""
        self.info(f"{self.FIRMWARE} V{self.version} ({self.GIT_HASH.decode()})")
        self.info(self.uid.hex()[:32])
        if self.FRAME is not None:
            self.info(self.FRAME)

    def world_point(self, latitude_e7: int, longitude_e7: int, altitude: float, frame: int) -> Ned | None:
        """Convert a global position to the world frame. Return None for invalid values or an unknown frame."""
        is_place = abs(latitude_e7) <= 900_000_000 and abs(longitude_e7) <= 1_800_000_000
        if not is_place or not math.isfinite(altitude):
            return None
        north, east = self.frame.to_local(latitude_e7, longitude_e7)
        if frame in RELATIVE_FRAMES:
            _, _, home_down = self.home_or_ground
            return (north, east, home_down - altitude)
        if frame in TERRAIN_FRAMES:
            return (north, east, self.motion.ground_down - altitude)
        if frame in ABSOLUTE_FRAMES:
            return (north, east, self.frame.origin.altitude_m - altitude)
        self.info(f"Unknown mavlink coordinate frame {frame}")
        return None
