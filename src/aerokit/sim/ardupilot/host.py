"""What the parts of a simulated ArduPilot use of the vehicle that they belong to.

`Host` lies below all parts: none of them imports the vehicle, which is made of them. Of each other they see the
protocols here.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar, Protocol

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavFrame
from aerokit.missions import MissionItem
from aerokit.sim.ardupilot.kinds import BootTimeline, Kind
from aerokit.sim.ardupilot.mission_lists import CommandList
from aerokit.sim.ardupilot.mode import VehicleMode
from aerokit.sim.ardupilot.motors import Motors
from aerokit.sim.autopilot import SimulatedAutopilot
from aerokit.sim.battery import Battery
from aerokit.sim.channel import Channel
from aerokit.sim.local_frame import GlobalPoint, LocalFrame, Ned
from aerokit.sim.missions import MissionStore
from aerokit.sim.motion import Motion
from aerokit.sim.parameters import Parameters

_RELATIVE = frozenset({MavFrame.GLOBAL_RELATIVE_ALT, MavFrame.GLOBAL_RELATIVE_ALT_INT})
_TERRAIN = frozenset({MavFrame.GLOBAL_TERRAIN_ALT, MavFrame.GLOBAL_TERRAIN_ALT_INT})
_ABSOLUTE = frozenset({MavFrame.GLOBAL, MavFrame.GLOBAL_INT})


class NavigationPart(Protocol):
    """What the vehicle knows of its place."""

    home: Ned | None

    @property
    def has_position(self) -> bool: ...

    @property
    def position(self) -> GlobalPoint | None: ...

    @property
    def altitude_above_home(self) -> float: ...


class ArmingPart(Protocol):
    """Checks, arming and disarming."""

    ARMED_TEXT: ClassVar[str]
    passes: bool

    def start(self) -> None: ...

    def reasons(self) -> list[str]: ...

    def report(self) -> None: ...

    def arm(self, *, force: bool = False) -> bool: ...

    def disarm(self, *, force: bool = True) -> bool: ...


class MissionPart(Protocol):
    """The place in the mission."""

    nav_index: int

    @property
    def is_being_flown(self) -> bool: ...

    def set_current(self, index: int) -> bool: ...

    def clear(self) -> None: ...

    def message(self, seq: int | None = None) -> m.MissionCurrent: ...


class MissionsPart(MissionStore, Protocol):
    """What is stored of missions, fence and rally points."""

    commands: CommandList


class RadioPart(Protocol):
    """The pilot's channels."""

    def override(self, pulses: Mapping[int, int]) -> None: ...


class FailsafesPart(Protocol):
    """When the ground station was heard last."""

    ground_station_seen_at: float


class FencePart(Protocol):
    """Looks where the vehicle is."""

    def update(self) -> None: ...


class CameraPart(Protocol):
    """Carries out what a mission wants of a camera."""

    def run(self, item: MissionItem) -> None: ...


class GimbalPart(Protocol):
    """Whether there is one."""

    @property
    def is_fitted(self) -> bool: ...


class Host(SimulatedAutopilot):
    """What every kind of ArduPilot has, as far as its parts need it; `ArduPilotVehicle` puts them together."""

    KIND: ClassVar[Kind]
    """Which table of parameters."""
    FIRMWARE: ClassVar[str]
    """As the banner has it."""
    FRAME: ClassVar[str | None] = None
    """What the banner says of the frame."""
    GIT_HASH: ClassVar[bytes] = b"5ae20c17"

    parameters: Parameters
    """By name; change them as a test needs it. They survive a reboot."""
    timeline: BootTimeline
    uid: bytes
    battery: Battery
    motion: Motion
    motors: Motors
    frame: LocalFrame
    """The world: metres north and east of where it was switched on."""
    mode: VehicleMode
    is_initialised: bool
    is_landed: bool
    navigation: NavigationPart
    arming: ArmingPart
    mission: MissionPart
    missions: MissionsPart
    failsafes: FailsafesPart
    fence: FencePart
    camera: CameraPart
    gimbal: GimbalPart
    rc: RadioPart

    @property
    def guided(self) -> VehicleMode:
        """Its mode for targets of a program."""
        raise NotImplementedError

    @property
    def is_armed(self) -> bool:
        """Whether the motors are armed."""
        return self.motors.is_armed

    @property
    def altitude_m(self) -> float:
        """Metres above home."""
        return self.navigation.altitude_above_home

    def set_mode(self, number: int) -> bool:
        """Change the mode if the vehicle may; says why not. A change is told by a heartbeat at once."""
        raise NotImplementedError

    def available_modes(self) -> list[m.AvailableModes]:
        """AVAILABLE_MODES, as ArduPilot numbers and names them."""
        raise NotImplementedError

    def announce_parameter(self, name: str) -> None:
        """Tell a parameter to everybody."""
        raise NotImplementedError

    def send_home(self, channel: Channel | None = None) -> None:
        """GPS_GLOBAL_ORIGIN and HOME_POSITION, as far as they are known."""
        self.send_built(m.GpsGlobalOrigin.ID, channel)
        self.send_built(m.HomePosition.ID, channel)

    def send_banner(self) -> None:
        """Firmware, hash and frame as texts."""
        self.info(f"{self.FIRMWARE} V{self.version} ({self.GIT_HASH.decode()})")
        self.info(self.uid.hex()[:32])
        if self.FRAME is not None:
            self.info(self.FRAME)

    def point(self, latitude_e7: int, longitude_e7: int, altitude: float, frame: int) -> Ned | None:
        """A place on the globe in the world's frame; None when it is none, or the frame is unknown."""
        valid = abs(latitude_e7) <= 900_000_000 and abs(longitude_e7) <= 1_800_000_000
        if not valid or not math.isfinite(altitude):
            return None
        north, east = self.frame.to_local(latitude_e7, longitude_e7)
        if frame in _RELATIVE:
            home = self.navigation.home
            return (north, east, (self.motion.ground_down if home is None else home[2]) - altitude)
        if frame in _TERRAIN:
            return (north, east, self.motion.ground_down - altitude)
        if frame in _ABSOLUTE:
            return (north, east, self.frame.origin.altitude_m - altitude)
        self.info(f"Unknown mavlink coordinate frame {frame}")
        return None
