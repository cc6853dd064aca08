"""What a flight mode of any simulated ArduPilot can be asked; each kind of vehicle has modes of its own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, TypeVar

from aerokit.missions import MissionItem
from aerokit.sim.local_frame import Ned


class VehicleMode:
    """One object per vehicle and mode; the answers here are "no" and "nothing"."""

    number: int
    name: str
    needs_position: bool = True
    needs_mission: bool = False
    has_manual_throttle: bool = False
    can_arm: bool = True
    arms_with_raised_throttle: bool = False
    can_change_speed: bool = False
    refused_because: str = "init failed"
    """What is said when `enter` refuses."""
    returns_on_path: bool = False
    """Whether it drives back on the path that is recorded otherwise."""
    notices_landing: bool = True
    """Whether it leaves a vehicle on the ground still enough to be taken for landed."""
    is_landing: bool = False
    is_taking_off: bool = False

    def enter(self, *, force: bool) -> bool:
        """Start; False refuses. ``force`` when the vehicle is disarmed and anything goes."""
        return True

    def leave(self) -> None:
        """Another mode takes over."""

    def update(self, dt: float) -> None:
        """Tell motors and motion what to do for the next ``dt`` seconds."""

    def take_off(self, altitude_m: float, *, must_navigate: bool) -> bool:
        """Climb to metres above home; False when this mode does not take off by command."""
        return False

    def pause(self) -> bool:
        """Stop where it is; False when there is nothing to pause."""
        return False

    def resume(self) -> bool:
        return False

    def go_to(self, position: Ned) -> None:
        """Go to a point of the world and stay there; only the guided mode can."""
        raise NotImplementedError

    @property
    def destination(self) -> Ned | None:
        return None


class AutoMode(Protocol):
    """The mode that carries the mission out; it is one of the vehicle's modes. See `MissionFlyer`."""

    may_lift_off: bool
    is_paused: bool

    def disarmed(self) -> None:
        """The motors have stopped."""
        ...

    def start_command(self, index: int, item: MissionItem) -> bool:
        """Begin a command; False when it cannot be done."""
        ...

    def is_complete(self, index: int, item: MissionItem) -> bool:
        """Whether a command is done."""
        ...

    def end_mission(self) -> None:
        """There is nothing more to do."""
        ...


HostT = TypeVar("HostT")


def variant(
    make: Callable[[HostT], VehicleMode], number: int, name: str, **traits: Any
) -> Callable[[HostT], VehicleMode]:
    """A row of a table of modes: one that behaves as another, under a name and with traits of its own."""

    def build(host: HostT) -> VehicleMode:
        mode = make(host)
        mode.number, mode.name = number, name
        for trait, value in traits.items():
            assert hasattr(mode, trait), trait
            setattr(mode, trait, value)
        return mode

    return build
