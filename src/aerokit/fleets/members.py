"""``Member``: one vehicle of a fleet, and its state in the fleet."""

from __future__ import annotations

import asyncio
import enum
from typing import TYPE_CHECKING

from aerokit.events import VehicleRecovered, VehicleSilent
from aerokit.fleets.events import MemberBack, MemberFailed, MemberLost, MemberReclaimed, MemberTakenOver
from aerokit.mavlink.enums import MavState
from aerokit.vehicle.commanding.order import FAILSAFE_STATES, is_worse_failsafe

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.connection.bus import Detach
    from aerokit.fleets.events import FleetEvent
    from aerokit.vehicle.vehicle import Vehicle

__all__ = ["Member", "MemberState"]


class MemberState(enum.Enum):
    """State of a member in its fleet."""

    ACTIVE = "active"
    """The member takes part in actions."""
    LOST = "lost"
    """The member's heartbeats stopped, or its link closed. The fleet sends it no orders until its heartbeats return."""
    TAKEN_OVER = "taken over"
    """A pilot, a failsafe or another program controls the member. The fleet sends it no orders until ``reclaim``."""
    FAILED = "failed"
    """The member failed in its last action. It takes part in the next action."""
    RELEASED = "released"
    """The program released the member. The fleet sends it no orders until ``reclaim``."""


class Member:
    """One vehicle of a fleet."""

    def __init__(self, name: str, network: str, vehicle: Vehicle, *, group: str = "", role: str = "") -> None:
        self.name: str = name
        """Name of the member, unique in the fleet: ``"north/7"``, or a name that the program gave."""
        self.network: str = network
        """Name of the network to which the vehicle belongs."""
        self.vehicle: Vehicle = vehicle
        """The vehicle object, for calls that concern this member only."""
        self.group: str = group
        """The member's group, or an empty string."""
        self.role: str = role
        """The member's role, or an empty string."""
        self.state: MemberState = MemberState.ACTIVE
        """The member's state in the fleet."""
        self.reason: str = ""
        """The reason for this state; empty in the state ACTIVE."""
        self.absences: int = 0
        """How often the member became unavailable."""
        self._lost_at = 0.0  # when the member was lost
        # The vehicle's newest order and its mode at the time of `reclaim`. The member does not count as taken over
        # until one of them changes.
        self._control_when_reclaimed: tuple[object, object] | None = None
        # MAV_STATE at the time of `reclaim`. If it was a failsafe, this failsafe does not count as a takeover.
        self._ignored_failsafe: int | None = None
        self._detachments: list[Detach] = []
        self._publish: Callable[[FleetEvent], None] = lambda _: None
        self._on_unavailable: Callable[[Member], None] = lambda _: None

    @property
    def is_available(self) -> bool:
        """True while the fleet can send orders to the member: it is neither lost, taken over nor released."""
        return self.state in (MemberState.ACTIVE, MemberState.FAILED)

    @property
    def is_flown_by_program(self) -> bool:
        """True while the member flies because this program ordered it to.

        Failure policies and the distance monitor send orders only to members for which this is True.
        """
        return self.is_available and self.vehicle.is_flown_by_program

    @property
    def status(self) -> str:
        """The member's state and its reason as text, such as ``"lost: no heartbeat for 5.0 s"``."""
        return f"{self.state.value}: {self.reason}"

    def __repr__(self) -> str:
        return f"<Member {self.name} {self.status if self.reason else self.state.value}>"

    # ------------------------------------------------------------------- called by the fleet

    def start_monitoring(self, publish: Callable[[FleetEvent], None], on_unavailable: Callable[[Member], None]) -> None:
        """Start updating the member's state. ``on_unavailable`` is called when the member is lost or taken over."""
        self._publish, self._on_unavailable = publish, on_unavailable
        vehicle, bus = self.vehicle, self.vehicle.connection.bus
        self._detachments = [
            bus.attach_event(VehicleSilent, self._on_silent),
            bus.attach_event(VehicleRecovered, self._on_recovered),
            vehicle.mode.observe(self._refresh_soon),
            # Observe every HEARTBEAT, because its MAV_STATE may change while mode and arming stay the same.
            vehicle.armed.observe(self._refresh_soon, every_arrival=True),
            vehicle.connection.on_end(lambda error: self._set_lost(str(error))),
        ]
        if vehicle.is_silent:
            self._set_lost(vehicle.describe_link())
        self.refresh()  # another program or a pilot may already control the vehicle

    def stop_monitoring(self) -> None:
        """Stop updating the member's state."""
        for detach in self._detachments:
            detach()
        self._detachments = []

    def refresh(self) -> None:
        """Update the state now, because the link may have closed or a pilot may have taken over."""
        if not self._is_monitored:
            return
        if not self.vehicle.connection.is_open:
            self._set_lost(f"its link is closed, {self.vehicle.describe_link()}")
        if self.is_available and (reason := self._takeover_reason()):
            self._set_taken_over(reason)
            self._on_unavailable(self)  # `_set_lost` above calls `_on_unavailable` itself.

    def record_failure(self, action: str, error: Exception) -> None:
        """Set the state to FAILED if the member is available, and publish :class:`MemberFailed` in any case."""
        self.refresh()
        if self.is_available:
            self._set_state(MemberState.FAILED, str(error))
        self._publish(MemberFailed(*self._event_fields(), action, str(error)))

    def record_success(self) -> None:
        """Set the state to ACTIVE if it is FAILED."""
        if self.state is MemberState.FAILED:
            self._set_state(MemberState.ACTIVE, "")

    def reclaim(self) -> None:
        """Set the state to ACTIVE, or to LOST if the vehicle is silent.

        The vehicle's present mode and failsafe no longer count as a takeover.
        """
        self._control_when_reclaimed = self._current_control()
        self._ignored_failsafe = self.vehicle.system_status.latest
        self.vehicle._arbiter.clear_failsafe()
        if self.vehicle.is_silent:
            self._lost_at = self.vehicle.connection.now()
            self._set_state(MemberState.LOST, self.vehicle.describe_link())
        elif self.state is not MemberState.ACTIVE:
            self._set_state(MemberState.ACTIVE, "")
            self._publish(MemberReclaimed(*self._event_fields()))

    def release(self, reason: str) -> None:
        """Set the state to RELEASED."""
        self._set_state(MemberState.RELEASED, reason)

    # --------------------------------------------------------------------------------- private

    @property
    def _is_monitored(self) -> bool:
        return bool(self._detachments)

    def _takeover_reason(self) -> str:
        """Return why the member counts as taken over; an empty string if it does not."""
        vehicle = self.vehicle
        state = vehicle.system_status.latest
        if state not in FAILSAFE_STATES:
            self._ignored_failsafe = None  # The ignored failsafe has ended, so the next one counts again.
        if vehicle.is_confirmed_disarmed:  # a disarmed vehicle does not fly, so there is no control to take over
            self._control_when_reclaimed = None  # If another party arms the vehicle later, that is a takeover.
            return ""
        # A failsafe that was active at `reclaim` is ignored until it gets worse.
        if state is not None and is_worse_failsafe(state, self._ignored_failsafe):
            return f"it is in a failsafe (MAV_STATE {MavState(state).name})"
        uses_missions = "mission" in vars(vehicle)  # vehicle.mission is created at its first use
        if uses_missions and vehicle.mission.explains_mode:  # the mode changed because the mission has ended
            return ""
        if self._current_control() == self._control_when_reclaimed:
            return ""
        if vehicle.taken_over:
            return vehicle.taken_over
        has_no_order = vehicle._arbiter.current is None
        return "this program did not arm it" if vehicle.is_armed and has_no_order else ""

    def _current_control(self) -> tuple[object, object]:
        return self.vehicle._arbiter.newest, self.vehicle.mode.latest

    def _refresh_soon(self, *_: object) -> None:
        # The refresh waits until the whole HEARTBEAT is processed. After a landing, one HEARTBEAT reports a mode change
        # and disarming, and a mode change of a disarmed vehicle is no takeover.
        asyncio.get_running_loop().call_soon(self.refresh)

    def _on_silent(self, event: VehicleSilent) -> None:
        if event.system_id == self.vehicle.system_id:
            self._set_lost(f"no heartbeat for {event.silent_for_s:.1f} s")

    def _on_recovered(self, event: VehicleRecovered) -> None:
        if event.system_id == self.vehicle.system_id:
            # The call waits until the HEARTBEAT that ended the silence is processed.
            asyncio.get_running_loop().call_soon(self._set_active_again)

    def _set_lost(self, reason: str) -> None:
        if not self.is_available:
            return
        self._lost_at = self.vehicle.connection.now()
        self._set_state(MemberState.LOST, reason)
        self._publish(MemberLost(*self._event_fields(), reason))
        self._on_unavailable(self)

    def _set_active_again(self) -> None:
        if self.state is not MemberState.LOST or not self._is_monitored:
            return
        if reason := self._takeover_reason():
            self._set_taken_over(reason)
        else:
            self._set_state(MemberState.ACTIVE, "")
            self._publish(MemberBack(*self._event_fields(), self.vehicle.connection.now() - self._lost_at))

    def _set_taken_over(self, reason: str) -> None:
        self._set_state(MemberState.TAKEN_OVER, reason)
        self._publish(MemberTakenOver(*self._event_fields(), reason))

    def _set_state(self, state: MemberState, reason: str) -> None:
        self.state, self.reason = state, reason
        if not self.is_available:
            self.absences += 1

    def _event_fields(self) -> tuple[float, int, str]:
        return self.vehicle.connection.now(), self.vehicle.system_id, self.name
