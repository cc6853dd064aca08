"""``Member``: one vehicle of a fleet, and how it stands with it."""

from __future__ import annotations

import asyncio
import enum
from functools import partial
from typing import TYPE_CHECKING

from aerokit.connection.tasks import Background, to_its_end
from aerokit.events import VehicleBack, VehicleSilent
from aerokit.fleets.events import MemberBack, MemberFailed, MemberLost, MemberTakenBack, MemberTakenOver
from aerokit.fleets.finding import telling_who_is_missing
from aerokit.mavlink.enums import MavState
from aerokit.vehicle.commanding.order import FAILSAFE_STATES, is_worse
from aerokit.vehicle.connect import connect

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from types import TracebackType
    from typing import Any

    from aerokit.connection.bus import Detach
    from aerokit.connection.connection import Connection
    from aerokit.fleets.events import FleetEvent
    from aerokit.mavlink.message import Message
    from aerokit.vehicle.vehicle import Vehicle

__all__ = ["Keepers", "Member", "MemberState"]


class MemberState(enum.Enum):
    """How it stands with a member."""

    IN = "in"
    """It takes part."""
    LOST = "lost"
    """It is not heard: nothing is ordered of it until it is heard again."""
    TAKEN_OVER = "taken over"
    """A pilot, a failsafe or another program has it: nothing is ordered of it until ``take_back``."""
    FAILED = "failed"
    """It has not done what was ordered last; it takes part in what is ordered next."""
    LEFT = "left"
    """The program has let it go: nothing is ordered of it until ``take_back``."""


class Member:
    """One vehicle of a fleet. ``why`` says in words how it came to its ``state``."""

    def __init__(self, name: str, network: str, vehicle: Vehicle, *, group: str = "", role: str = "") -> None:
        self.name: str = name
        """Unique in the fleet: ``"north/7"``, or as the program has called it."""
        self.network: str = network
        """The name of the connection that it is on."""
        self.vehicle: Vehicle = vehicle
        """For all that is not done in common."""
        self.group: str = group
        """The group that it is in; empty: none."""
        self.role: str = role
        """What it does in it, in the program's words; empty: none."""
        self.state: MemberState = MemberState.IN
        """How it stands with it."""
        self.why: str = ""
        """How it came to that, in words; empty while it is IN."""
        self._lost_at = 0.0
        self._taken_back: tuple[object, object] | None = None
        self._forgiven_state: int | None = None
        """The failsafe that was active when the program took it back."""
        self._detach: list[Detach] = []
        self._tell: Callable[[FleetEvent], None] = lambda _: None
        self._on_fallen_out: Callable[[Member], None] = lambda _: None

    @property
    def takes_orders(self) -> bool:
        """Whether it may be ordered something: it is heard, and nobody else flies it."""
        return self.state in (MemberState.IN, MemberState.FAILED)

    @property
    def is_flown_by_program(self) -> bool:
        """Whether it flies by what this program has ordered: only then a policy, or a watch, may stop it."""
        return self.takes_orders and self.vehicle.is_flown_by_program

    def __repr__(self) -> str:
        return f"<Member {self.name} {self.state.value}{f': {self.why}' if self.why else ''}>"

    # ------------------------------------------------------------------------------- by the fleet

    def watch(self, tell: Callable[[FleetEvent], None], on_fallen_out: Callable[[Member], None]) -> None:
        """Begin to listen; ``on_fallen_out`` is called when it is lost or taken over."""
        self._tell, self._on_fallen_out = tell, on_fallen_out
        vehicle, bus = self.vehicle, self.vehicle.connection.bus
        later = partial(self._soon, self.look)
        self._detach = [
            bus.attach_event(VehicleSilent, self._on_silent),
            bus.attach_event(VehicleBack, self._on_back),
            vehicle.mode.observe(later),
            # Each HEARTBEAT, though nothing has changed: it tells more than the CURRENT_MODE before it.
            vehicle.armed.observe(later, every_arrival=True),
            vehicle.connection.on_end(self._on_end),
        ]
        if vehicle.is_silent:
            self._lose(vehicle.describe_link())
        self.look()  # others may have flown it before

    def stop_watching(self) -> None:
        """Listen no more."""
        for detach in self._detach:
            detach()
        self._detach = []

    def look(self) -> None:
        """Find out whether it is gone, or somebody else has it by now."""
        if self._detach and not self.vehicle.connection.is_open:
            self._lose(f"its link has gone, {self.vehicle.describe_link()}")
        if self.takes_orders and self._detach and (why := self._who_has_it()):
            self._change(MemberState.TAKEN_OVER, why)
            self._tell(MemberTakenOver(*self._when(), why))
            self._on_fallen_out(self)

    def note_failed(self, action: str, error: Exception) -> None:
        """It has not done its part."""
        self.look()
        if self.takes_orders:
            self._change(MemberState.FAILED, str(error))
        self._tell(MemberFailed(*self._when(), action, str(error)))

    def note_done(self) -> None:
        """It has done its part."""
        if self.state is MemberState.FAILED:
            self._change(MemberState.IN, "")

    def take_back(self) -> None:
        """The program orders it again: what somebody else has done until now does not count."""
        self._taken_back = self._who_steers()
        self._forgiven_state = self.vehicle.system_status.latest
        self.vehicle._arbiter.forgive_failsafe()
        if self.vehicle.is_silent:
            self._lost_at = self.vehicle.connection.now()
            self._change(MemberState.LOST, self.vehicle.describe_link())
        elif self.state is not MemberState.IN:
            self._change(MemberState.IN, "")
            self._tell(MemberTakenBack(*self._when()))

    def leave(self, why: str) -> None:
        """The program orders it no more."""
        self._change(MemberState.LEFT, why)

    # --------------------------------------------------------------------------------- inside

    def _who_has_it(self) -> str:
        vehicle = self.vehicle
        if vehicle.is_surely_disarmed:  # on the ground there is nothing to take over
            return ""
        state = vehicle.system_status.latest
        if state not in FAILSAFE_STATES:
            self._forgiven_state = None
        elif state is not None and is_worse(state, self._forgiven_state):
            return f"it is under a failsafe (MAV_STATE {MavState(state).name})"
        has_ended_mission = "mission" in vars(vehicle) and vehicle.mission.explains_mode
        if has_ended_mission or self._who_steers() == self._taken_back:
            return ""
        is_others = vehicle.is_armed and vehicle._arbiter.current is None
        return vehicle.taken_over or ("somebody else has armed it" if is_others else "")

    def _who_steers(self) -> tuple[object, object]:
        return self.vehicle._arbiter.newest, self.vehicle.mode.latest

    def _soon(self, function: Callable[[], None], *_: Any) -> None:
        """After all of the HEARTBEAT has been read: who landed disarms and changes its mode in the same one."""
        asyncio.get_running_loop().call_soon(function)

    def _on_silent(self, event: VehicleSilent) -> None:
        if event.system_id == self.vehicle.system_id:
            self._lose(f"no heartbeat for {event.silent_for_s:.1f} s")

    def _on_end(self, error: Exception) -> None:
        self._lose(str(error))

    def _lose(self, why: str) -> None:
        if not self.takes_orders:
            return
        self._lost_at = self.vehicle.connection.now()
        self._change(MemberState.LOST, why)
        self._tell(MemberLost(*self._when(), why))
        self._on_fallen_out(self)

    def _on_back(self, event: VehicleBack) -> None:
        if event.system_id == self.vehicle.system_id:  # its HEARTBEAT is being read just now
            self._soon(self._come_back)

    def _come_back(self) -> None:
        if self.state is not MemberState.LOST or not self._detach:
            return
        if why := self._who_has_it():
            self._change(MemberState.TAKEN_OVER, why)
            self._tell(MemberTakenOver(*self._when(), why))
        else:
            self._change(MemberState.IN, "")
            self._tell(MemberBack(*self._when(), self.vehicle.connection.now() - self._lost_at))

    def _change(self, state: MemberState, why: str) -> None:
        self.state, self.why = state, why

    def _when(self) -> tuple[float, int, str]:
        return self.vehicle.connection.now(), self.vehicle.system_id, self.name


class _CutShort(Exception):
    """The fleet's block was left by an exception: each vehicle's own is left like that, too."""


class Keepers:
    """A task for each vehicle, in whose block it is connected: so all are let go at once, not one after another."""

    def __init__(self, timeout: float, rates: Mapping[type[Message], float] | None) -> None:
        self._timeout, self._rates = timeout, rates
        self._tasks = Background(self._on_mistake)
        self._open: dict[int, tuple[str, Vehicle]] = {}
        self._error: Exception | None = None
        self._news = asyncio.Event()
        self._leave = asyncio.Event()
        self._is_cut_short = False
        self._running = 0
        self._all_left = asyncio.Event()

    async def keep(self, systems: Sequence[tuple[str, Connection, int]]) -> list[tuple[str, Vehicle]]:
        """Connect to all of them: network, connection and system id each. The vehicles, in the same order."""
        for number, (network, connection, system_id) in enumerate(systems):
            self._running += 1
            self._tasks.start(partial(self._keep, number, network, connection, system_id))
        with telling_who_is_missing(self._timeout, lambda: f"nothing is heard of {self._missing(systems)}"):
            while len(self._open) < len(systems) and self._error is None:
                self._news.clear()
                await self._news.wait()
        if self._error is not None:
            raise self._error
        return [self._open[number] for number in range(len(systems))]

    def _missing(self, systems: Sequence[tuple[str, Connection, int]]) -> str:
        return ", ".join(
            f"{network}/{system_id}"
            for number, (network, _, system_id) in enumerate(systems)
            if number not in self._open
        )

    async def leave(
        self,
        kind: type[BaseException] | None = None,
        error: BaseException | None = None,
        traceback: TracebackType | None = None,
    ) -> None:
        """Let all of them go, as the block of the fleet is left."""
        self._is_cut_short = error is not None
        self._leave.set()
        if self._running and len(self._open) == self._running:
            await to_its_end(self._wait_until_all_left())
        await self._tasks.aclose()

    async def _wait_until_all_left(self) -> None:
        await self._all_left.wait()

    async def _keep(self, number: int, network: str, connection: Connection, system_id: int) -> None:
        try:
            async with connect(
                connection, system_id=system_id, timeout=self._timeout, rates=self._rates
            ) as vehicle:
                self._open[number] = (network, vehicle)
                self._news.set()
                await self._leave.wait()
                if self._is_cut_short:
                    raise _CutShort
        except _CutShort:
            pass
        finally:
            self._running -= 1
            if not self._running:
                self._all_left.set()

    def _on_mistake(self, error: Exception) -> None:
        self._error = self._error or error
        self._news.set()
