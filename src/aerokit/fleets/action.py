"""``CommonAction``: one action of many vehicles: each with its own end, and a policy for failures."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from fnmatch import fnmatchcase
from functools import partial
from typing import TYPE_CHECKING, Any

import anyio

from aerokit._internal.wording import shown
from aerokit.connection.bus import Bus
from aerokit.connection.tasks import Background
from aerokit.errors import (
    AerokitError,
    HeartbeatTimeout,
    InvalidArgument,
    OperationRejected,
    OperationTimeout,
)
from aerokit.fleets.events import PolicyCarriedOut, PolicyOrdered
from aerokit.fleets.members import MemberState
from aerokit.fleets.policy import Failure, FleetResult

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from aerokit.connection.connection import Connection
    from aerokit.fleets.events import FleetEvent
    from aerokit.fleets.members import Member
    from aerokit.fleets.policy import PolicyOrder, Rules
    from aerokit.missions.mission import Mission
    from aerokit.vehicle.vehicle import Vehicle

Act = "Callable[[Member], Awaitable[Any]]"


class CommonAction:
    """Done once. ``is_safe``: it ends a flight (hold, land, return), so that nobody is stopped for another's failure.

    ``holds_if_cancelled``: whether those that have done it already are told to hold, too, when it is cancelled.
    """

    what: str

    def __init__(
        self,
        crew: Crew,
        what: str,
        members: Iterable[Member],
        act: Callable[[Member], Awaitable[Any]],
        *,
        timeout: float | None = None,
        stagger_s: float | None = None,
        is_safe: bool = False,
        holds_if_cancelled: bool = True,
    ) -> None:
        self._crew, self.what, self._act = crew, what, act
        self._timeout, self._stagger_s = timeout, stagger_s or 0.0
        self._is_safe, self._holds_if_cancelled = is_safe, holds_if_cancelled
        everybody = list(members)
        for each in everybody:
            each.look()
        self._members = [each for each in everybody if each.takes_orders]
        self._left_out = {
            each.name: f"{each.state.value}: {each.why}" for each in everybody if not each.takes_orders
        }
        self._outcomes: dict[str, Any] = {}
        self._failed: dict[str, Exception] = {}
        self._stopped: dict[str, Exception] = {}
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._orders: dict[str, PolicyOrder] = {}
        self._because: tuple[int, str] | None = None
        self._errors_of_orders: dict[str, str] = {}
        self._obeying = 0
        self._is_deciding = False
        self._is_over = asyncio.Event()
        self.mistake: Exception | None = None
        """One of the program's function, or of its policy: ``run`` raises it at the end."""

    async def run(self) -> FleetResult:
        """Do it with all of them at once, and return when each has done it, failed, or was stopped."""
        if not self._members:
            return self.so_far()
        tasks = Background(self._on_mistake)
        self._crew.under_way.append(self)
        try:
            for number, member in enumerate(self._members):
                tasks.start(
                    partial(self._one, member, number * self._stagger_s), f"aerokit {self.what} {member.name}"
                )
            await self._is_over.wait()
        except BaseException:
            if self._holds_if_cancelled:
                self._hold_the_finished()
            raise
        finally:
            self._crew.under_way.remove(self)
            await tasks.aclose()
        if self.mistake is not None:
            self._hold_the_finished()
            raise self.mistake
        return self.so_far()

    @property
    def orders(self) -> dict[str, str]:
        """What the policy has ordered, by member's name; empty: nobody has failed, or all go on."""
        return dict(self._orders)

    @property
    def under_way(self) -> tuple[str, ...]:
        """The names of those that are doing it just now."""
        return tuple(
            each.name
            for each in self._members
            if each.name in self._tasks and each.name not in (*self._failed, *self._stopped)
        )

    def note_fallen_out(self, member: Member) -> None:
        """It is lost, or somebody else has it."""
        if member not in self._members or member.name in (*self._failed, *self._stopped):
            return
        kind = HeartbeatTimeout if member.state is MemberState.LOST else OperationRejected
        self._fail(member, kind(f"{self.what}: {member.name} is {member.state.value}: {member.why}"))

    # ------------------------------------------------------------------------------------ one of them

    async def _one(self, member: Member, delay_s: float) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._tasks[member.name] = task
        try:
            if member.name in self._stopped:
                return
            if delay_s:
                await anyio.sleep(delay_s)
            if not member.takes_orders:
                raise OperationRejected(f"{self.what}: {member.name} is {member.state.value}: {member.why}")
            value = await self._limited(member)
        except AerokitError as error:
            if member.name not in self._stopped:
                self._fail(member, error)
        except asyncio.CancelledError:
            if member.name not in self._stopped and member.name not in self._failed:
                raise
        else:
            if member.name not in self._stopped and member.name not in self._failed:
                self._outcomes[member.name] = value
                member.note_done()
        finally:
            del self._tasks[member.name]
            self._look_whether_over()

    async def _limited(self, member: Member) -> Any:
        if self._timeout is None:
            return await self._act(member)
        with anyio.move_on_after(self._timeout):
            return await self._act(member)
        raise OperationTimeout(f"{self.what}: {member.name} has not done it within {self._timeout:g} s")

    def _fail(self, member: Member, error: Exception) -> None:
        if member.name in self._failed:
            return
        self._failed[member.name] = self._outcomes[member.name] = error
        member.note_failed(self.what, error)
        if self._is_safe or self._because is not None or self._is_deciding or self._crew.is_over:
            return
        self._is_deciding = True  # who else has failed is only found out by looking at them
        try:
            self._apply_policy(member, error)
        finally:
            self._is_deciding = False

    # ---------------------------------------------------------------------------------- the others

    def _apply_policy(self, failed: Member, error: Exception) -> None:
        for each in self._members:
            each.look()
        others = [each for each in self._members if each.name not in self._failed]
        able = [each for each in others if each.takes_orders]
        failure = Failure(failed.name, failed.group, self.what, error, tuple(each.name for each in able))
        orders: dict[str, PolicyOrder]
        try:
            orders = self._crew.rules.decide(failure)
        except Exception as mistake:  # of the program's function: in doubt nobody flies on
            self.mistake = self.mistake or mistake
            orders = dict.fromkeys(failure.others, "hold")
        if not orders:
            return
        self._because = (failed.vehicle.system_id, failed.name)
        self._stop(failed)
        left_alone = {each.name: each.why for each in others if not each.takes_orders}
        for each in able:
            order = orders.get(each.name)
            if order is None:
                continue
            if not each.is_flown_by_program:
                is_disarmed = each.vehicle.is_surely_disarmed
                left_alone[each.name] = "it is disarmed" if is_disarmed else "this program does not fly it"
            else:
                self._orders[each.name] = order
            if each.name in self._orders or each.name not in self._outcomes:
                self._note_stopped(each, failed, self._orders.get(each.name))
        self._crew.tell(
            PolicyOrdered(self._crew.now(), *self._because, self.what, dict(self._orders), left_alone)
        )
        self._obeying = len(self._orders)
        for each in able:
            if each.name in self._orders:
                self._crew.background.start(
                    partial(self._obey, each, self._orders[each.name]), f"aerokit policy {each.name}"
                )
        # what is under way ends after the order that overrules it is given: so it is no order of its own to hold
        asyncio.get_running_loop().call_soon(self._stop_all, [each for each in able if each.name in orders])
        if not self._orders:
            self._told_carried_out()

    def _note_stopped(self, member: Member, failed: Member, order: PolicyOrder | None) -> None:
        told = f"; it was told to {order}" if order else ""
        error = OperationRejected(f"{self.what}: stopped because {failed.name} has failed{told}")
        self._stopped[member.name] = self._outcomes[member.name] = error

    def _stop_all(self, members: Iterable[Member]) -> None:
        for each in members:
            self._stop(each)

    def _stop(self, member: Member) -> None:
        task = self._tasks.get(member.name)
        if task is not None and task is not asyncio.current_task():
            task.cancel()

    async def _obey(self, member: Member, order: PolicyOrder) -> None:
        try:
            await _give(member, order)
        except AerokitError as error:
            self._errors_of_orders[member.name] = str(error)
            member.look()
        finally:
            self._obeying -= 1
            if not self._obeying:
                self._told_carried_out()
                self._look_whether_over()

    def _told_carried_out(self) -> None:
        assert self._because is not None
        self._crew.tell(
            PolicyCarriedOut(
                self._crew.now(), *self._because, self.what, dict(self._orders), dict(self._errors_of_orders)
            )
        )

    def _hold_the_finished(self) -> None:
        """Those that are under way hold by the cancellation of their own action."""
        for each in self._members:
            if (
                each.is_flown_by_program
                and each.name in self._outcomes
                and each.name not in (*self._failed, *self._stopped)
            ):
                self._crew.background.start(partial(_give_quietly, each), f"aerokit hold {each.name}")

    # ---------------------------------------------------------------------------------------- inside

    def _look_whether_over(self) -> None:
        if not self._tasks and not self._obeying and len(self._outcomes) == len(self._members):
            self._is_over.set()

    def _on_mistake(self, error: Exception) -> None:
        """Something else than an error of ours: a mistake in the program's function."""
        self.mistake = self.mistake or error
        self._is_over.set()

    def so_far(self) -> FleetResult:
        """What became of those that have come to their ends."""
        names = [each.name for each in self._members]
        in_order = {name: self._outcomes[name] for name in names if name in self._outcomes}
        return FleetResult(
            self.what, in_order, failed=self._failed, stopped=self._stopped, left_out=self._left_out
        )


async def _give(member: Member, order: PolicyOrder) -> None:
    vehicle = member.vehicle
    if order == "land":
        await vehicle.land()
    elif order == "return":
        await vehicle.return_to_launch()
    else:
        await vehicle.hold()


async def _give_quietly(member: Member) -> None:
    try:
        await _give(member, "hold")
    except AerokitError as error:
        member.note_failed("hold", error)


class Crew:
    """Made for one block of a fleet, and over with it."""

    def __init__(
        self,
        members: Iterable[Member],
        networks: Mapping[str, Connection],
        rules: Rules,
        now: Callable[[], float],
        on_mistake: Callable[[Exception], None],
        min_distance_m: float | None = None,
    ) -> None:
        self.members: dict[str, Member] = {each.name: each for each in members}
        self.networks: dict[str, Connection] = dict(networks)
        self.rules: Rules = rules
        self.now: Callable[[], float] = now
        self.min_distance_m: float | None = min_distance_m
        self.bus: Bus = Bus()
        self.background: Background = Background(on_mistake)
        self.under_way: list[CommonAction] = []
        self.missions: dict[str, Mission] = {}
        """Those that all who were given one have taken."""
        self.is_over: bool = False

    def start(self) -> None:
        """Begin to watch all members."""
        for each in self.members.values():
            each.watch(self.tell, self._on_fallen_out)

    async def aclose(self) -> None:
        """Watch and order nobody any more."""
        self.is_over = True
        for each in self.members.values():
            each.stop_watching()
        await self.background.aclose()

    def tell(self, event: FleetEvent) -> None:
        """Tell who listens."""
        self.bus.publish(event)

    def matching(self, *patterns: str) -> list[str]:
        """The names of members that one of these names or patterns (``"north/*"``) means, each once.

        Raises:
            InvalidArgument: one of them means nobody.
        """
        found: dict[str, None] = {}
        for pattern in patterns:
            names = [name for name in self.members if name == pattern or fnmatchcase(name, pattern)]
            if not names:
                raise InvalidArgument(
                    f"{shown(pattern)} is no member of this fleet: {', '.join(self.members) or 'it is empty'}"
                )
            found.update(dict.fromkeys(names))
        return list(found)

    def _on_fallen_out(self, member: Member) -> None:
        for each in tuple(self.under_way):
            each.note_fallen_out(member)


ENDS_FLIGHTS = ("hold", "land", "return_to_launch", "disarm", "mission.pause")
"""Actions that end a flight: nobody is stopped in them because another one has failed."""

FLIES_NOBODY = ("arm", "wait_ready", "upload")


class FleetPart:
    """Some or all members of a fleet."""

    def __init__(self, crew: Crew, names: tuple[str, ...] | None) -> None:
        self._crew, self._names = crew, names

    @property
    def members(self) -> Mapping[str, Member]:
        """Name → member, in the order in which they were named or heard."""
        members = self._crew.members
        return dict(members) if self._names is None else {name: members[name] for name in self._names}

    @property
    def vehicles(self) -> Mapping[str, Vehicle]:
        """Name → vehicle."""
        return {name: member.vehicle for name, member in self.members.items()}

    def __len__(self) -> int:
        return len(self.members)

    def __iter__(self) -> Iterator[Member]:
        return iter(self.members.values())

    async def _run(
        self,
        what: str,
        act: Callable[[Member], Awaitable[Any]],
        *,
        timeout: float | None = None,
        stagger_s: float | None = None,
        names: tuple[str, ...] | None = None,
    ) -> FleetResult:
        members = [each for each in self if names is None or each.name in names]
        is_safe = what in ENDS_FLIGHTS
        return await CommonAction(
            self._crew,
            what,
            members,
            act,
            timeout=timeout,
            stagger_s=stagger_s,
            is_safe=is_safe,
            holds_if_cancelled=not is_safe and what not in FLIES_NOBODY,
        ).run()
