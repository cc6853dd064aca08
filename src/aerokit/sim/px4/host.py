"""What the parts of a simulated PX4 use of the vehicle that they belong to.

`Px4Host` lies below all parts: none of them imports the vehicle, which is made of them. Of each other they see the
protocols here.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Protocol

from aerokit.missions import MissionItem
from aerokit.sim.autopilot import SimulatedAutopilot
from aerokit.sim.battery import Battery
from aerokit.sim.channel import Channel
from aerokit.sim.local_frame import LocalFrame, Ned
from aerokit.sim.motion import Motion
from aerokit.sim.parameters import Parameters
from aerokit.sim.px4.modes import Px4Mode


class SticksPart(Protocol):
    """The pilot's sticks."""

    roll: float
    pitch: float
    yaw: float
    throttle: float

    @property
    def are_fresh(self) -> bool: ...

    @property
    def are_wanted(self) -> bool: ...


class ArmingPart(Protocol):
    """Arming and disarming."""

    since: float
    is_terminated: bool

    def disarm(self, by: str, *, force: bool = False) -> bool: ...

    def terminate(self) -> None: ...


class FencePart(Protocol):
    """Where it may be."""

    def uploaded(self) -> None: ...

    def allows(self, place: Ned) -> bool: ...


class FailsafesPart(Protocol):
    """What watches over the flight."""

    @property
    def fence(self) -> FencePart: ...

    @property
    def acts(self) -> bool: ...

    def arming_reasons(self) -> list[str]: ...


class TextLinksPart(Protocol):
    """Which links get texts."""

    def hear_station(self, channel: Channel) -> None: ...


class FlightPart(Protocol):
    """The navigator."""

    target: Ned
    heading: float | None
    speed_m_s: float

    @property
    def top_speed_m_s(self) -> float: ...

    def stay_here(self) -> None: ...

    def go(self) -> None: ...

    def descend(self) -> None: ...


class MissionPart(Protocol):
    """The mission mode."""

    current: int

    @property
    def wants_up(self) -> bool: ...

    def enter(self) -> None: ...

    def update(self) -> None: ...

    def replaced(self, current: int) -> None: ...

    def forget_reached(self) -> None: ...

    def set_current(self, seq: int) -> None: ...


class MissionsPart(Protocol):
    """What is stored of mission, fence and rally points."""

    @property
    def commands(self) -> Sequence[MissionItem]: ...

    def items(self, mission_type: int) -> Sequence[MissionItem]: ...

    def item(self, mission_type: int, seq: int) -> MissionItem | None: ...

    def count(self, mission_type: int) -> int: ...

    def item_changed(self, seq: int) -> None: ...


class OffboardPart(Protocol):
    """Set-points of a program."""

    @property
    def wants_up(self) -> bool: ...

    def fly(self) -> None: ...


class Px4Host(SimulatedAutopilot):
    """What every PX4 has, as far as its parts need it; `Px4Vehicle` puts them together."""

    VEHICLE_TYPE: ClassVar[int]

    parameters: Parameters
    """By name; they survive a reboot."""
    frame: LocalFrame
    battery: Battery
    motion: Motion
    home: Ned
    mode: Px4Mode
    intended_mode: Px4Mode
    mode_after_landing: Px4Mode
    is_ready: bool
    is_armed: bool
    is_landed: bool
    is_in_failsafe: bool
    sticks: SticksPart
    arming: ArmingPart
    failsafes: FailsafesPart
    text_links: TextLinksPart
    flight: FlightPart
    mission: MissionPart
    missions: MissionsPart
    offboard: OffboardPart

    @property
    def altitude_m(self) -> float:
        """Metres above home."""
        return self.home[2] - self.motion.down

    @property
    def has_position(self) -> bool:
        """Whether the estimator has a global position."""
        raise NotImplementedError

    def can_run(self, mode: Px4Mode) -> bool:
        """Whether the mode has what it needs: sticks, a mission, set-points, a position."""
        raise NotImplementedError

    def change_mode(self, mode: Px4Mode) -> bool:
        """What a user asks for: anything while disarmed, only what can run while armed; LAND always."""
        raise NotImplementedError

    def switch_to(self, mode: Px4Mode) -> None:
        """Change the mode, whoever wants it; only the next heartbeat tells."""
        raise NotImplementedError

    def leave_ground(self) -> None:
        """The land detector sees a take-off."""
        raise NotImplementedError

    def armed(self) -> None:
        """It was armed just now."""
        raise NotImplementedError

    def disarmed(self) -> None:
        """It was disarmed just now."""
        raise NotImplementedError

    def sticks_moved(self, size: float) -> None:
        """Somebody takes the sticks (COM_RC_STICK_OV per cent) in a mode that flies by itself (COM_RC_OVERRIDE)."""
        raise NotImplementedError
