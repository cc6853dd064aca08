"""Interfaces between the modules of a simulated PX4.

`Px4Host` declares the vehicle, and the protocols declare its modules. The modules use these interfaces because they
cannot import `Px4Vehicle`, which imports the modules.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Protocol

from aerokit.mavlink.enums import MavFrame
from aerokit.missions import MissionItem
from aerokit.sim.autopilot import SimulatedAutopilot
from aerokit.sim.motion import Ned
from aerokit.sim.px4.modes import Px4Mode


class Px4SticksInterface(Protocol):
    roll: float
    pitch: float
    yaw: float
    throttle: float

    @property
    def are_fresh(self) -> bool: ...
    @property
    def are_wanted(self) -> bool: ...


class Px4ArmingInterface(Protocol):
    armed_at: float
    is_terminated: bool

    def disarm(self, by: str, *, force: bool = False) -> bool: ...
    def terminate(self) -> None: ...
    def report_changes(self) -> None: ...


class Px4FenceInterface(Protocol):
    def on_uploaded(self) -> None: ...
    def allows(self, place: Ned) -> bool: ...


class Px4FailsafesInterface(Protocol):
    @property
    def fence(self) -> Px4FenceInterface: ...
    @property
    def acts(self) -> bool: ...
    def arming_obstacles(self) -> list[str]: ...


class Px4FlightInterface(Protocol):
    target: Ned
    heading: float | None
    speed_m_s: float

    @property
    def descent_speed_m_s(self) -> float: ...
    @property
    def top_speed_m_s(self) -> float: ...
    def stay_here(self) -> None: ...
    def fly_to_target(self) -> None: ...
    def descend(self) -> None: ...


class Px4MissionInterface(Protocol):
    current: int

    @property
    def wants_up(self) -> bool: ...
    def enter(self) -> None: ...
    def update(self) -> None: ...
    def on_replaced(self, current: int) -> None: ...
    def forget_reached(self) -> None: ...
    def set_current(self, seq: int) -> None: ...


class Px4MissionsInterface(Protocol):
    @property
    def commands(self) -> Sequence[MissionItem]: ...
    def items(self, mission_type: int) -> Sequence[MissionItem]: ...
    def item(self, mission_type: int, seq: int) -> MissionItem | None: ...
    def on_item_changed(self, seq: int) -> None: ...


class Px4OffboardInterface(Protocol):
    @property
    def wants_up(self) -> bool: ...
    def fly(self) -> None: ...


class Px4ExternalInterface(Protocol):
    @property
    def target(self) -> tuple[float, float] | None: ...


class Px4Host(SimulatedAutopilot):
    """A simulated PX4 as its modules see it. `Px4Vehicle` implements this interface."""

    VEHICLE_TYPE: ClassVar[int]

    home: Ned
    mode: Px4Mode
    intended_mode: Px4Mode
    mode_after_landing: Px4Mode
    is_ready: bool
    is_armed: bool
    is_landed: bool
    is_in_failsafe: bool
    sticks: Px4SticksInterface
    arming: Px4ArmingInterface
    failsafes: Px4FailsafesInterface
    flight: Px4FlightInterface
    mission: Px4MissionInterface
    missions: Px4MissionsInterface
    offboard: Px4OffboardInterface
    external: Px4ExternalInterface

    @property
    def altitude_m(self) -> float:
        """Metres above home."""
        _, _, home_down = self.home
        return home_down - self.motion.down

    def place_of(self, item: MissionItem) -> Ned:
        """Return the position of a stored item of a mission, fence or list of rally points."""
        north, east = self.frame.to_local(round(item.x), round(item.y))
        _, _, home_down = self.home
        is_absolute = item.frame in (MavFrame.GLOBAL, MavFrame.GLOBAL_INT)
        down_at_zero_altitude = self.frame.origin.altitude_m if is_absolute else home_down
        return (north, east, down_at_zero_altitude - item.z)

    @property
    def has_position(self) -> bool:
        raise NotImplementedError

    def can_run(self, mode: Px4Mode) -> bool:
        raise NotImplementedError

    def change_mode(self, mode: Px4Mode) -> bool:
        raise NotImplementedError

    def switch_to(self, mode: Px4Mode) -> None:
        raise NotImplementedError

    def leave_ground(self) -> None:
        """Called when the vehicle takes off."""
        raise NotImplementedError

    def on_armed(self) -> None:
        """Called after arming."""
        raise NotImplementedError

    def on_disarmed(self) -> None:
        """Called after disarming."""
        raise NotImplementedError

    def on_sticks_moved(self, distance: float) -> None:
        """Called with the distance by which a stick has moved. 2 is the distance from end to end."""
        raise NotImplementedError
