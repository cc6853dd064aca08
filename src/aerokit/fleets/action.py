"""``FleetAction``: one action executed by several members at once, with a policy for failures."""

from __future__ import annotations

import asyncio
import enum
import math
from collections.abc import Awaitable, Callable, Mapping
from fnmatch import fnmatchcase
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import anyio

from aerokit._internal.formatting import short_repr
from aerokit.connection.bus import Bus
from aerokit.connection.tasks import BackgroundTasks
from aerokit.errors import (
    AerokitError,
    ConnectionClosed,
    HeartbeatTimeout,
    InvalidArgument,
    OperationRejected,
    OperationTimeout,
)
from aerokit.fleets.events import PolicyApplied, PolicyCompleted
from aerokit.fleets.members import MemberState
from aerokit.fleets.policy import FleetResult, MemberFailure
from aerokit.vehicle.commanding.arbiter import STEERING

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from aerokit.connection.connection import Connection
    from aerokit.fleets.events import FleetEvent
    from aerokit.fleets.members import Member
    from aerokit.fleets.policy import PolicyOrder, PolicyRules
    from aerokit.fleets.separation import Deconfliction
    from aerokit.missions.item import MissionItem
    from aerokit.missions.mission import Mission
    from aerokit.vehicle.commanding.order import Order
    from aerokit.vehicle.vehicle import Vehicle


FLEET_CLOSED = "the fleet's block has ended"

START_TOLERANCE_S = 0.001
"""By how much the delay between the starts of two members may be shorter than ``stagger_s``."""


class ActionKind(enum.Enum):
    """Effect of an action on the flight of its members.

    After a new action of kind ENDS_FLIGHT or MOVES, older actions send nothing more to its members.
    """

    ENDS_FLIGHT = enum.auto()
    """Makes the flight safer (hold, land, return): a member's failure does not stop the others."""
    MOVES = enum.auto()
    """Flies the members somewhere, or changes how they fly."""
    ARMS = enum.auto()
    """Only arms. A newer action prevents a member from arming only if the newer action is of the kind ENDS_FLIGHT."""
    ON_GROUND = enum.auto()
    """Does not move members. If an action of this kind, ARMS or ENDS_FLIGHT is cancelled, its members do not hold."""
    OTHER = enum.auto()
    """Any other action, for example a function of the program."""


KINDS = {
    **dict.fromkeys(("hold", "land", "return_to_launch", "disarm", "mission.pause"), ActionKind.ENDS_FLIGHT),
    **dict.fromkeys(("take_off", "go_to", "form", "show", "set_mode", "set_heading"), ActionKind.MOVES),
    **dict.fromkeys(("orbit", "loiter", "figure_eight", "land_on"), ActionKind.MOVES),
    **dict.fromkeys(("mission.start", "mission.resume"), ActionKind.MOVES),
    **dict.fromkeys(("wait_ready", "upload"), ActionKind.ON_GROUND),
    "arm": ActionKind.ARMS,
}
"""Kinds of the built-in actions by name; all others are OTHER."""


class _SentOrders(NamedTuple):
    """Orders that this program has sent to a member until some time."""

    newest: Order | None  # the newest order that moves the vehicle
    command_count: int  # number of disarm commands; for an action that arms, number of arm commands


class FleetAction:
    """One run of an action.

    Args:
        context: context of the fleet.
        name: name of the action in results, events and errors.
        members: members that run the action; unavailable members are skipped.
        execute: coroutine function that is called with each available member.
        timeout: seconds for each member; None: no limit.
        stagger_s: delay in seconds between the starts of consecutive members.
        kind: effect on the flight. If an action of the kind MOVES or OTHER is cancelled, or if a function of the
            program raises an error in it, members that have already finished the action are told to hold.
        corridors: plan with a delay for each member, and a limit for how late a member may start; None: no such plan.
    """

    def __init__(
        self,
        context: FleetContext,
        name: str,
        members: Iterable[Member],
        execute: Callable[[Member], Awaitable[Any]],
        *,
        timeout: float | None = None,
        stagger_s: float | None = None,
        kind: ActionKind = ActionKind.OTHER,
        corridors: Deconfliction | None = None,
    ) -> None:
        self.name: str = name
        self._context, self._execute, self._timeout = context, execute, timeout
        self._stagger_s = stagger_s or 0.0
        self._kind, self._corridors = kind, corridors
        self._moves_members = kind in (ActionKind.ENDS_FLIGHT, ActionKind.MOVES)
        self._newer_actions: list[FleetAction] = []  # newer actions that move members
        requested = list(members)
        for member in requested:
            member.refresh()
        self._members = [member for member in requested if member.is_available]
        # Each member's orders before this action. An entry is removed when any action starts the member.
        self._orders_before = {member.name: self._orders_of(member) for member in self._members}
        self._skipped = {member.name: member.status for member in requested if not member.is_available}
        # The keys of these dictionaries are names of members. An outcome is the returned value or the error.
        self._outcomes: dict[str, Any] = {}
        self._final_orders: dict[str, object] = {}  # `FleetContext.newest_orders` when the member finished
        self._failed: dict[str, Exception] = {}
        self._stopped: dict[str, Exception] = {}
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._policy_orders: dict[str, PolicyOrder] = {}
        self._policy_cause: Member | None = None  # the failed member for which the policy was applied
        self._policy_order_errors: dict[str, str] = {}
        self._pending_policy_orders = 0  # number of policy orders that have not ended
        self._last_start_at = -math.inf  # when the last member started
        self._undecided: list[Member] = []  # failed members that the policy has not considered yet
        self._finished = asyncio.Event()
        # An error in a function of the program, which is not an AerokitError. `run` raises it at the end.
        self.program_error: Exception | None = None
        # The action that was created later is the newer one, whichever runs first.
        if self._moves_members:
            for action in context.actions:
                action._newer_actions.append(self)
            context.newest_moves.update(dict.fromkeys((member.name for member in self._members), self))
        context.actions[self] = None

    async def run(self) -> FleetResult:
        """Execute the action with all members concurrently, until every member has finished, failed or was stopped."""
        tasks = BackgroundTasks(self._on_program_error)
        try:
            if self._context.is_closed:
                raise ConnectionClosed(f"{self.name}: {FLEET_CLOSED}")
            if not self._members:
                return self.result_so_far()
            delays_s = {} if self._corridors is None else self._corridors.delays_s
            for index, member in enumerate(self._members):
                delay_s = index * self._stagger_s + delays_s.get(member.name, 0.0)
                tasks.start(partial(self._run_member, member, delay_s), f"aerokit {self.name} {member.name}")
            await self._finished.wait()
        except BaseException:
            self._hold_finished_members()
            raise
        finally:
            self._context.actions.pop(self, None)
            await tasks.aclose()
        if self.program_error is not None:
            self._hold_finished_members()
            # Let the tasks that order the holds run, before the error leaves the `async with` block of the fleet.
            await asyncio.sleep(0)
            raise self.program_error
        return self.result_so_far()

    @property
    def policy_orders(self) -> dict[str, str]:
        return dict(self._policy_orders)

    @property
    def active_names(self) -> tuple[str, ...]:
        return tuple(
            member.name
            for member in self._members
            if member.name in self._tasks and not self._has_failed_or_stopped(member)
        )

    def result_so_far(self) -> FleetResult:
        names = [member.name for member in self._members]
        # The outcomes have the order of the members, not the order in which the members have finished.
        outcomes = {name: self._outcomes[name] for name in names if name in self._outcomes}
        result = FleetResult(self.name, outcomes, failed=self._failed, stopped=self._stopped, skipped=self._skipped)
        result._final_orders = dict(self._final_orders)
        return result

    def close(self) -> None:
        """Fail the members that still execute the action, and cancel their tasks."""
        for member in self._members:
            if member.name not in self._outcomes:
                self._record_failure(member, ConnectionClosed(f"{self.name}: {FLEET_CLOSED}"))
                self._cancel_tasks_of([member])

    def on_member_unavailable(self, member: Member) -> None:
        if member not in self._members or self._has_failed_or_stopped(member):
            return
        error_class = HeartbeatTimeout if member.state is MemberState.LOST else OperationRejected
        self._record_failure(member, error_class(f"{self.name}: {member.name} is {member.status}"))

    # --------------------------------------------------------------------------------- one member

    async def _run_member(self, member: Member, delay_s: float) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._tasks[member.name] = task
        try:
            if self._has_failed_or_stopped(member):  # The failure or the stop came before this task.
                return
            await self._wait_to_start(member, delay_s)
            value = await self._execute_in_time(member)
        except AerokitError as error:
            if member.name not in self._stopped:
                self._record_failure(member, error)
        except asyncio.CancelledError:
            # This class cancels the tasks of failed and stopped members. Other cancellations come from outside.
            if not self._has_failed_or_stopped(member):
                raise
        else:
            if not self._has_failed_or_stopped(member):
                self._outcomes[member.name] = value
                # `FleetContext.newest_orders` returns this value while no newer action moves the member. An action that
                # was created meanwhile therefore counts as a newer order.
                self._final_orders[member.name] = _newest_order(member), self
                member.record_success()
        finally:
            del self._tasks[member.name]
            self._check_finished()

    async def _wait_to_start(self, member: Member, delay_s: float) -> None:
        """Wait until the member may start. Raises OperationRejected or HeartbeatTimeout if it must not start."""
        orders_before = self._orders_before.get(member.name) or self._orders_of(member)
        is_overruled = False
        if self._moves_members or self._kind is ActionKind.ARMS:  # All other kinds are checked only after a delay.
            # A landing without a delay is sent even if there is a newer action, because that action may fail.
            has_newer_action = not self._ends_flight and self._has_newer_action(member)
            is_overruled = has_newer_action or self._has_order_since(member, orders_before)
        remaining_s = delay_s
        while remaining_s > START_TOLERANCE_S and not is_overruled:
            await self._wait(member, remaining_s)
            is_overruled = self._has_order_since(member, orders_before) or self._has_newer_action(member)
            # After a blocked event loop, the delays of several members may end at once. Each member then waits until
            # `stagger_s` after the last start.
            remaining_s = self._last_start_at + self._stagger_s - self._context.now()
        if is_overruled:
            raise OperationRejected(
                f"{self.name}: {member.name} got a newer order before it started; nothing was sent to it"
            )
        self._last_start_at = self._context.now()
        # Other actions that still wait to start this member must not take this action's order for a newer one.
        for action in self._context.actions:
            action._orders_before.pop(member.name, None)
        if not member.is_available:
            raise OperationRejected(f"{self.name}: {member.name} is {member.status}")

    async def _wait(self, member: Member, delay_s: float) -> None:
        """Wait ``delay_s`` seconds, then for a recent HEARTBEAT. Raises the errors of `_wait_to_start`."""
        connection, name = member.vehicle.connection, member.name
        began_at, absences = connection.now(), member.absences
        await anyio.sleep(delay_s)
        await member.vehicle._sender.await_recent_state()
        if connection._slept_since(began_at) > 0:
            raise OperationRejected(f"{self.name}: the computer slept before {name} started; no order was sent")
        member.refresh()
        if not member.is_available:
            raise OperationRejected(f"{self.name}: {name} is {member.status}")
        # A landing is sent even to a member that was unavailable during the wait.
        if member.absences > absences and not self._ends_flight:
            raise OperationRejected(f"{self.name}: {name} was unavailable while it waited to start; no order was sent")
        late_s = connection.now() - began_at - delay_s
        if self._corridors is not None and late_s > self._corridors.slack_s:
            raise OperationRejected(f"{self.name}: {name} would start {late_s:.1f} s late, so it stays where it is")

    def _has_failed_or_stopped(self, member: Member) -> bool:
        return member.name in self._failed or member.name in self._stopped

    def _has_newer_order(self, member: Member) -> bool:
        """Return True if a newer action moves the member, or the program has told it to land or return."""
        # An action of kind OTHER is a function of the program, which may itself have ordered the landing.
        may_be_own_landing = not self._moves_members and member.name not in self._outcomes
        return (_is_ending_flight(member) and not may_be_own_landing) or self._has_newer_action(member)

    def _has_newer_action(self, member: Member) -> bool:
        """Return True if a newer action of the fleet moves the member or has moved it."""
        # An action that arms is overruled only by newer actions that end the flight, such as a landing.
        return any(
            member in action._members and not action._has_failed_or_stopped(member)
            for action in self._newer_actions
            if action._ends_flight or self._kind is not ActionKind.ARMS
        )

    @property
    def _ends_flight(self) -> bool:
        return self._kind is ActionKind.ENDS_FLIGHT

    def _orders_of(self, member: Member) -> _SentOrders:
        arbiter = member.vehicle._arbiter
        is_arming = self._kind is ActionKind.ARMS
        commands = arbiter.arm_commands_sent if is_arming else arbiter.disarm_commands_sent
        return _SentOrders(_newest_order(member), commands)

    def _has_order_since(self, member: Member, orders_before: _SentOrders) -> bool:
        """Return True if the program has told the member to land, return or disarm after ``orders_before``.

        For an action that arms, commands to arm count instead of those to disarm.
        """
        newest, command_count = self._orders_of(member)
        must_land = newest is not orders_before.newest and _is_ending_flight(member)
        # A command to disarm does not prevent a landing, because a vehicle in the air refuses to disarm.
        return must_land or (not self._ends_flight and command_count > orders_before.command_count)

    async def _execute_in_time(self, member: Member) -> Any:
        if self._timeout is None:
            return await self._execute(member)
        with anyio.move_on_after(self._timeout):
            return await self._execute(member)
        raise OperationTimeout(f"{self.name}: {member.name} has not finished within {self._timeout:g} s")

    def _record_failure(self, member: Member, error: Exception) -> None:
        """Record that a member failed, and ask the policy for orders to the other members."""
        if member.name in self._failed:
            return
        self._failed[member.name] = error
        self._outcomes[member.name] = error
        member.record_failure(self.name, error)
        # The program flies a released member separately, so its failure does not concern the others.
        if self._ends_flight or self._context.is_closed or member.state is MemberState.RELEASED:
            return
        self._undecided.append(member)
        # `_apply_policy` refreshes the other members, which can call this method again. The outer call then handles
        # the new failure.
        if len(self._undecided) > 1:
            return
        while self._undecided:
            if self._policy_cause is None:  # The failure policy gives orders only once in an action.
                self._apply_policy(self._undecided[0])
            del self._undecided[0]

    # ------------------------------------------------------------------------------ other members

    def _apply_policy(self, failed: Member) -> None:
        """Ask the policy about the other members. Stop those for which it has an order, and send them the orders."""
        for member in self._members:
            member.refresh()
        others = [member for member in self._members if member.name not in self._failed]
        available = [member for member in others if member.is_available]
        names = tuple(member.name for member in available)
        failure = MemberFailure(failed.name, failed.group, self.name, self._failed[failed.name], others=names)
        orders = self._decide(failure)
        if not orders:
            return
        self._policy_cause = failed
        self._cancel_tasks_of([failed])
        skipped = {member.name: member.reason for member in others if not member.is_available}
        affected = [member for member in available if member.name in orders]
        for member in affected:
            reason = self._reason_to_skip(member)
            if reason:
                skipped[member.name] = reason
            else:
                self._policy_orders[member.name] = orders[member.name]
            has_finished = member.name in self._outcomes
            if not (reason and has_finished):  # A finished member that gets no order keeps its outcome.
                self._set_stopped(member, failed, self._policy_orders.get(member.name))
        now, system_id = self._context.now(), failed.vehicle.system_id
        self._context.publish(
            PolicyApplied(now, system_id, failed.name, action=self.name, orders=self.policy_orders, skipped=skipped)
        )
        self._send_policy_orders()
        # The running actions are cancelled one loop iteration later. By then, the policy's orders have superseded those
        # of the actions, so that the cancelled actions do not send a hold.
        asyncio.get_running_loop().call_soon(self._cancel_tasks_of, affected)
        if not self._policy_orders:
            self._publish_completed()

    def _reason_to_skip(self, member: Member) -> str:
        """Return why the policy must not send the member an order; an empty string if it may."""
        if self._has_newer_order(member):
            return "it has a newer order"
        if member.is_flown_by_program:
            return ""
        return "it is disarmed" if member.vehicle.is_confirmed_disarmed else "this program does not fly it"

    def _send_policy_orders(self) -> None:
        self._pending_policy_orders = len(self._policy_orders)
        for name, order in self._policy_orders.items():
            send = partial(self._send_order, self._context.members[name], order)
            task = self._context.background.start(send, f"aerokit policy {name}")
            if task is not None:  # The callback runs even if the task is cancelled before it begins.
                task.add_done_callback(partial(self._on_order_end, name))

    def _decide(self, failure: MemberFailure) -> dict[str, PolicyOrder]:
        try:
            return self._context.rules.decide(failure)
        except Exception as error:
            self.program_error = self.program_error or error
            return dict.fromkeys(failure.others, "hold")

    def _set_stopped(self, member: Member, failed: Member, order: PolicyOrder | None) -> None:
        order_text = f"; the policy ordered {member.name} to {order}" if order else ""
        error = OperationRejected(f"{self.name}: stopped because {failed.name} failed{order_text}")
        self._stopped[member.name] = error
        self._outcomes[member.name] = error

    def _cancel_tasks_of(self, members: Iterable[Member]) -> None:
        for member in members:
            task = self._tasks.get(member.name)
            if task is not None and task is not asyncio.current_task():
                task.cancel()

    async def _send_order(self, member: Member, order: PolicyOrder) -> None:
        try:
            if order == "land":
                await member.vehicle.land()
            elif order == "return":
                await member.vehicle.return_to_launch()
            else:
                await member.vehicle.hold()
        except BaseException as error:
            self._policy_order_errors[member.name] = str(error) or type(error).__name__
            if not isinstance(error, AerokitError):
                raise
            member.refresh()  # the order may have failed because of a lost link or a takeover

    def _on_order_end(self, name: str, task: asyncio.Task[None]) -> None:
        if task.cancelled():
            self._policy_order_errors.setdefault(name, "the fleet was closed")
        self._pending_policy_orders -= 1
        if not self._pending_policy_orders:
            self._publish_completed()
            self._check_finished()

    def _publish_completed(self) -> None:
        failed = self._policy_cause
        assert failed is not None
        now, system_id, errors = self._context.now(), failed.vehicle.system_id, dict(self._policy_order_errors)
        self._context.publish(
            PolicyCompleted(now, system_id, failed.name, action=self.name, orders=self.policy_orders, errors=errors)
        )

    def _hold_finished_members(self) -> None:
        if self._kind not in (ActionKind.MOVES, ActionKind.OTHER):
            return
        # Members that still execute the action hold when it is cancelled. Members that have finished it need an order.
        for member in self._members:
            has_finished = member.name in self._outcomes and not self._has_failed_or_stopped(member)
            needs_hold = has_finished and member.is_flown_by_program and not self._has_newer_order(member)
            if needs_hold:
                self._context.hold(member, f"aerokit hold {member.name}")

    def _check_finished(self) -> None:
        if not self._tasks and not self._pending_policy_orders and len(self._outcomes) == len(self._members):
            self._finished.set()

    def _on_program_error(self, error: Exception) -> None:
        self.program_error = self.program_error or error
        self._finished.set()


def _newest_order(member: Member) -> Order | None:
    """Return the newest order of this program that moves the vehicle."""
    return member.vehicle._arbiter.latest(STEERING)


def _is_ending_flight(member: Member) -> bool:
    """Return True if the newest order of this program is to land or return, and the member is not taken over."""
    newest = _newest_order(member)
    # It does not matter whether the block that gave the order has ended: the vehicle still executes the order.
    return newest is not None and newest.ends_flight and newest.is_newest and not newest.takeover_reason


class FleetContext:
    """State that the parts of one fleet share, as long as the ``async with aerokit.fleet(...)`` block runs."""

    def __init__(
        self,
        members: Iterable[Member],
        networks: Mapping[str, Connection],
        rules: PolicyRules,
        now: Callable[[], float],
        on_error: Callable[[Exception], None],
        min_distance_m: float | None = None,
    ) -> None:
        self.members: dict[str, Member] = {member.name: member for member in members}
        self.networks: dict[str, Connection] = dict(networks)
        self.rules: PolicyRules = rules
        self.now: Callable[[], float] = now
        self.min_distance_m: float | None = min_distance_m
        self.bus: Bus = Bus()
        self.background: BackgroundTasks = BackgroundTasks(on_error)
        self.actions: dict[FleetAction, None] = {}  # those that have not ended, the newest last
        self.newest_moves: dict[str, FleetAction] = {}  # the newest action that moves each member
        self.missions: dict[str, Mission] = {}  # by member name; empty unless the last upload succeeded for all
        # By member name: the vehicle's items after the last upload; None if they are unknown.
        self.uploaded_items: dict[str, Sequence[MissionItem] | None] = {}
        # The missions of the newest upload. Empty if another upload, which began earlier, ended later and may have
        # replaced one of them.
        self.newest_upload: Mapping[str, Mission] = {}
        self.is_closed: bool = False

    def start(self) -> None:
        for member in self.members.values():
            member.start_monitoring(self.publish, self._on_member_unavailable)

    async def aclose(self) -> None:
        self.is_closed = True
        for member in self.members.values():
            member.stop_monitoring()
        for action in tuple(self.actions):  # The vehicles may stay connected, so the actions would continue.
            action.close()
        await self.background.aclose()

    def publish(self, event: FleetEvent) -> None:
        self.bus.publish(event)

    def newest_orders(self, member: Member) -> tuple[object, object]:
        """Return a value that changes whenever the program orders the member to move."""
        # An action that moves the member counts as an order from its start on, because its order follows later.
        return _newest_order(member), self.newest_moves.get(member.name)

    def hold(self, member: Member, task_name: str) -> None:
        """Order a member to hold, without waiting for it."""

        async def hold() -> None:
            try:
                await member.vehicle.hold()
            except AerokitError as error:
                member.record_failure("hold", error)

        self.background.start(hold, task_name)

    def matching(self, *patterns: str) -> list[str]:
        """Return the names of the members that match a name or a pattern such as ``north/*``.

        Raises InvalidArgument if a pattern matches no member.
        """
        matching: dict[str, None] = {}  # an ordered set
        for pattern in patterns:
            names = [name for name in self.members if name == pattern or fnmatchcase(name, pattern)]
            if not names:
                raise InvalidArgument(
                    f"no fleet member matches {short_repr(pattern)}; members: {', '.join(self.members) or 'none'}"
                )
            matching.update(dict.fromkeys(names))
        return list(matching)

    def _on_member_unavailable(self, member: Member) -> None:
        for action in tuple(self.actions):
            action.on_member_unavailable(member)


class SelectionBase:
    """Base class of a selection: its members, and the execution of actions by all of them."""

    def __init__(self, context: FleetContext, names: tuple[str, ...] | None) -> None:
        self._context, self._names = context, names

    @property
    def members(self) -> Mapping[str, Member]:
        """Maps names to members, in the order in which the program gave them or their vehicles were found."""
        members = self._context.members
        return dict(members) if self._names is None else {name: members[name] for name in self._names}

    @property
    def vehicles(self) -> Mapping[str, Vehicle]:
        """Maps names to vehicles."""
        return {name: member.vehicle for name, member in self.members.items()}

    def _check_members(self, argument: str, names: Iterable[str]) -> None:
        members = self.members
        for name in names:
            if name not in members:
                raise InvalidArgument(f"{argument}: {short_repr(name)} is not a member; members: {', '.join(members)}")

    @staticmethod
    def _check_available(member: Member, action: str, consequence: str) -> None:
        member.refresh()
        if not member.is_available:
            raise OperationRejected(f"{action}: {member.name} is {member.status}; {consequence}")

    def _check_not_ordered_since(self, orders: Mapping[str, object], action: str, consequence: str) -> None:
        """Raise OperationRejected if `newest_orders` of a member has changed."""
        for name, order in orders.items():
            if self._context.newest_orders(self._context.members[name]) != order:
                raise OperationRejected(f"{action}: {name} got a newer order meanwhile; {consequence}")

    def __len__(self) -> int:
        return len(self.members)

    def __iter__(self) -> Iterator[Member]:
        return iter(self.members.values())

    async def _run(
        self,
        name: str,
        execute: Callable[[Member], Awaitable[Any]],
        *,
        timeout: float | None = None,
        stagger_s: float | None = None,
        names: tuple[str, ...] | None = None,
        is_function: bool = False,
        corridors: Deconfliction | None = None,
    ) -> FleetResult:
        members = [member for member in self if names is None or member.name in names]
        # A function of the program may have the name of a built-in action.
        kind = ActionKind.OTHER if is_function else KINDS.get(name, ActionKind.OTHER)
        return await FleetAction(
            self._context, name, members, execute, timeout=timeout, stagger_s=stagger_s, kind=kind, corridors=corridors
        ).run()
