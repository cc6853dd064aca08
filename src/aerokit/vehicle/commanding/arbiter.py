"""``CommandArbiter``: tracks which orders of the program are valid. Pilots and failsafes take precedence over them."""

from __future__ import annotations

import itertools
import math
from collections import deque
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any

from aerokit.errors import CommandRejected, OperationRejected
from aerokit.protocols.command import MAX_HEARTBEAT_AGE_S
from aerokit.vehicle.commanding.order import REBOOTED, SUPERSEDED, Order, SentCommand
from aerokit.vehicle.session.watch import OTHER_BOOT

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Sequence

    from aerokit.autopilots import Mode
    from aerokit.vehicle.commanding.order import Subject, Topic
    from aerokit.vehicle.state.telemetry import Telemetry

MODE_GRACE_S = 3.0
"""Seconds by which HEARTBEAT (1 Hz) may lag behind an accepted command that changes the mode."""
ARM_HEARTBEAT_DELAY_S = 1.5
"""Seconds after an accepted arm command in which HEARTBEAT (1 Hz) may still report the previous state."""
MODE_MAX_AGE_S = MAX_HEARTBEAT_AGE_S
"""Maximum age in seconds of a HEARTBEAT that counts as the vehicle's present state."""
OWN_MODES_MAX_AGE_S = 10.0
"""For this many seconds after the program ordered a mode, a change to that mode does not count as a takeover."""

STEERING, ACTION = "steering", "action"
"""Topics of orders. All steering orders have STEERING, but only those of actions and raw commands have ACTION."""


def was_armed_by_order(disarmed_at: float, accepted_at: float) -> bool:
    """Return True if the arm order that the vehicle accepted at ``accepted_at`` has armed it.

    ``disarmed_at`` is the time of the last HEARTBEAT that reported disarmed.
    """
    # An accepted command takes effect within ARM_HEARTBEAT_DELAY_S. If the vehicle reports disarmed later, the command
    # had no effect, and another party has armed the vehicle afterwards.
    return disarmed_at <= accepted_at + ARM_HEARTBEAT_DELAY_S


class CommandArbiter:
    """Keeps the orders to one vehicle, updates them with each HEARTBEAT, and knows the newest order about each topic.

    Every order of the program is registered here, whether it comes from a flight action, a set-point, a device, a fleet
    or the DroneKit API.
    """

    def __init__(
        self,
        now: Callable[[], float],
        telemetry: Telemetry,
        slept_since: Callable[[float], float] = lambda _: 0.0,
        is_held_back: Callable[[], bool] = lambda: False,
    ) -> None:
        self._now, self._telemetry = now, telemetry
        # Returns True from a loss of the link until the vehicle's clock shows whether the reopened link leads to the
        # same boot of the same vehicle.
        self._is_held_back = is_held_back
        # Returns how many seconds the computer has slept since the given time.
        self.slept_since = slept_since
        self.newest: Order | None = None
        """The last steering order (an order about where to fly, or in which mode) of an action or a raw command."""
        self.arm_commands_sent: int = 0
        """Number of arm and disarm commands sent."""
        self.disarm_commands_sent: int = 0
        self.last_disarm_command_at: float = -math.inf
        """Time of the newest command to disarm."""
        self.last_arm_command: bool | None = None
        """True if the newest of these commands arms, False if it disarms; None before the first one."""
        self.mode_settles_at: float = -math.inf
        """Time until which HEARTBEAT may report the mode of an abandoned order."""
        self.mode_changed_at: float = -math.inf
        """Time at which the vehicle first reported its present mode."""
        # Until this time, any reported mode may be the effect of a raw command.
        self._any_mode_until = -math.inf
        self._arming_accepted_at = -math.inf
        self.last_disarmed_report_at: float = -math.inf
        """Time of the last HEARTBEAT that reported disarmed."""
        self.last_arming_at: float = -math.inf
        """Time at which HEARTBEAT last changed from disarmed to armed; infinite after a reboot."""
        # An order without commands, updated with each HEARTBEAT. It records whether a takeover or a failsafe has
        # occurred since the program armed the vehicle. None if another party has armed it.
        self._arming_order: Order | None = None
        # The last steering order, and the orders of `auxiliary_order` blocks in progress.
        self._orders_in_progress: list[Order] = []
        self._posted_orders: list[Order] = []  # orders whose `posted_order` block is active
        self._sent_commands: list[SentCommand] = []  # commands whose `sending` block is active
        # Modes that HEARTBEAT may still report although the order for them has ended, and the mode to which the vehicle
        # changes by itself after a mission. Each has the time at which it was added.
        self._unreported_modes: deque[tuple[float, Mode]] = deque(maxlen=16)
        self._order_numbers = itertools.count(1)
        self._open_mode_changes = 0  # how many `changing_mode` blocks are open
        self._doubted_change = 0  # sequence number of the last mode change with an unknown result
        self._confirmed_change = 0  # sequence number of the last mode change that was confirmed
        # The newest order about each topic, even if it was withdrawn or has ended.
        self._latest: dict[Topic, Order] = {}
        self._ordered_since_disarmed: set[Topic] = set()
        # The modes that the program ordered last: time of the order, and number in HEARTBEAT.custom_mode.
        self._ordered_modes: deque[tuple[float, int]] = deque(maxlen=16)
        self._steering_callbacks: list[Callable[[], None]] = []
        telemetry.mode.observe(self._on_mode, every_arrival=True)
        telemetry.system_status.observe(self._on_system_status, every_arrival=True)
        telemetry.armed.observe(self._on_armed, every_arrival=True)

    # ---------------------------------------------------------------------------------- topics

    def latest(self, topic: Topic) -> Order | None:
        """Return the newest order about this topic that was not withdrawn."""
        order = self._latest.get(topic)
        while order is not None and order.is_withdrawn:
            order = order.previous
        return order

    def _is_newest(self, order: Order) -> bool:
        latest_orders = (self.latest(topic) for topic in order.ending_topics)
        is_superseded = any(latest is not None and latest.number > order.number for latest in latest_orders)
        return not order.is_withdrawn and not is_superseded

    def is_replaced(self, order: Order) -> bool:
        """Return True if a newer order is about the same topic; a newer action alone does not replace other orders."""
        latest_orders = (self.latest(topic) for topic in order.ending_topics if topic != ACTION)
        return any(latest is not None and latest.number > order.number for latest in latest_orders)

    def _set_latest(self, order: Order, topics: Iterable[Topic]) -> None:
        self._latest.update(dict.fromkeys(topics, order))

    def supersede(self, topics: Iterable[Topic]) -> None:
        topics = tuple(topics)
        self._ordered_since_disarmed.update(topics)
        # The new order has no commands. As the newest order about these topics, it ends the posted ones.
        self._set_latest(self._new_order(), topics)

    def device_order(self, topic: Topic, *, may_be_withdrawn: bool = False) -> Order:
        """Create an order to a device, such as a gripper. The previous order to this device is no longer valid.

        With ``may_be_withdrawn``, `Order.withdraw` of the new order makes the previous one valid again.
        """
        order = self._new_order(ending_topics=(topic,))
        order.previous = self.latest(topic) if may_be_withdrawn else None
        self._set_latest(order, (topic,))
        return order

    @contextmanager
    def withdrawable_order(self, topic: Topic) -> Iterator[Order]:
        """Create an order about a device for a `with` block. If the block raises, the order is withdrawn."""
        order = self.device_order(topic, may_be_withdrawn=True)
        try:
            yield order
        except BaseException:
            # An order that was refused or not answered does not count, so the previous one is valid again
            # (docs/reliability.md).
            order.withdraw()
            raise
        order.commit()

    # ------------------------------------------------------------------------------- steering

    def order(
        self, *modes: Mode, subjects: Collection[Subject] = ("mode", "motion"), ends_flight: bool = False
    ) -> Order:
        """Create a steering order, which may change the mode to ``modes``. It supersedes the previous one.

        Orders of :meth:`posted_order` about ``subjects`` end, too. With ``ends_flight``, a failsafe does not end the
        new order.
        """
        self._notify_steering()
        self._ordered_modes.extend((self._now(), mode.custom_mode) for mode in modes)
        if self._unconfirmed_posted_modes():  # A posted order may change the mode later than this order does.
            self.doubt_mode()
        was_flown = self.is_flown_by_program
        if self.newest is not None:
            self._expect_late_effects(self.newest)
        ends_flight = ends_flight or self._all_end_flight(modes)
        order = self._new_order_expecting_late_modes(modes, (STEERING,), ends_flight=ends_flight)
        order.was_flown_before = was_flown
        # If this order replaces an order in progress, the vehicle may already be moving, or may do so soon.
        order.may_move = self._is_executing_newest()
        self._set_latest(order, (*subjects, STEERING, ACTION))
        self._ordered_since_disarmed.update(subjects)
        self.newest = order
        # Remove orders that have ended, so that HEARTBEATs no longer update them.
        self._orders_in_progress = [active for active in self._orders_in_progress if active.is_newest]
        for active in self._orders_in_progress:  # A change to the new order's modes is no takeover.
            active.accept_as_effects(modes, any_until=order.any_mode_until)
        self._orders_in_progress.append(order)
        return order

    def raw_order(self, subjects: Collection[Subject] = ("mode", "motion"), *, modes: Collection[Mode] = ()) -> Order:
        """Register a raw command of the program as a steering order.

        Without ``modes``, any mode that is reported soon afterwards may be the command's effect.
        """
        if not modes:
            self._any_mode_until = self._now() + MODE_GRACE_S
        return self.order(*modes, subjects=subjects)

    def has_ordered_mode(self, names: Collection[str]) -> bool:
        """Return True if the newest order about the mode since the vehicle disarmed was for one of these modes.

        An order from before the disarming does not count: it was for the last flight.
        """
        order = self.latest("mode") if "mode" in self._ordered_since_disarmed else None
        return order is not None and any(mode.name in names for mode in order.modes)

    def on_steering(self, callback: Callable[[], None]) -> None:
        """Register a callback that is called before each new steering order."""
        self._steering_callbacks.append(callback)

    def _notify_steering(self) -> None:
        for callback in self._steering_callbacks:
            callback()

    def on_reboot(self) -> None:
        reason = OTHER_BOOT if self._is_held_back() else REBOOTED
        for order in (*self._orders_in_progress, *self._posted_orders):
            order.takeover_reason = order.takeover_reason or reason
        self._ordered_since_disarmed.clear()
        self._arming_order = None
        self.last_arming_at = math.inf  # Until the vehicle arms again, `current` ignores all orders.
        self._arming_accepted_at = -math.inf

    # ------------------------------------------------------------------ other orders, in blocks

    @contextmanager
    def auxiliary_order(
        self, device_order: Order | None = None, *, ends_flight: bool = False, ends_with_actions: bool = True
    ) -> Iterator[Order]:
        """Create an order that does not say where to fly (speed, home, arming …).

        A newer action ends the order, unless ``ends_with_actions`` is False: for a command that is sent only once, and
        for one that stops or releases a device.

        With ``device_order``, the new order is a part of that order: a newer order about the same device ends both.
        Raises OperationRejected if ``device_order`` is not the newest one any more.
        """
        if device_order is not None and not device_order.is_newest:
            raise OperationRejected(f"{SUPERSEDED}; the rest of the order was not sent")
        # The vehicle may still change to the modes of the last steering order.
        modes = () if self.newest is None else self.newest.modes
        device_topics = () if device_order is None else device_order.ending_topics
        action_topics = (ACTION,) if ends_with_actions else ()
        order = self._new_order_expecting_late_modes(modes, (*action_topics, *device_topics), ends_flight=ends_flight)
        self._orders_in_progress.append(order)
        try:
            yield order
        finally:
            self._orders_in_progress = [active for active in self._orders_in_progress if active is not order]

    @contextmanager
    def posted_order(
        self, subjects: Sequence[Subject], *, modes: Collection[Mode] = (), armed: bool | None = None
    ) -> Iterator[Order]:
        """Create an order that the program does not wait for (`Vehicle.posted`), valid during the `with` block.

        The order is about the first of ``subjects``; a later order about the same subject ends it. The order itself
        ends earlier posted orders about any of ``subjects``. An order about "mode" or "motion" also ends the action in
        progress. The order may change the mode to ``modes``, and arms or disarms the vehicle if ``armed`` is not None.
        """
        first_subject = subjects[0]
        is_steering = first_subject != "arm"
        disarms = armed is False
        if is_steering:
            self._notify_steering()
            arming_order = () if self._arming_order is None else (self._arming_order,)
            for previous in (*arming_order, *self._orders_in_progress):
                if ACTION not in previous.ending_topics:  # A change to the new order's modes is no takeover.
                    previous.accept_as_effects(modes)
        if armed is not None:
            self.supersede_arm_commands(armed)
        now = self._now()
        since = now - OWN_MODES_MAX_AGE_S
        recent_modes = {custom_mode for ordered_at, custom_mode in self._ordered_modes if ordered_at > since}
        self._ordered_modes.extend((now, mode.custom_mode) for mode in modes)
        order = self._new_order(
            modes=modes,
            ending_topics=(first_subject,),
            expected=recent_modes,
            armed=armed,
            # An order to disarm stays valid after a mode change and during a failsafe.
            ends_flight=self._all_end_flight(modes) or disarms,
            ends_on_mode_change=not disarms,
            ends_on_disarm=first_subject == "motion",
            requires_mode_change=True,
        )
        self._set_latest(order, (*subjects, STEERING) if is_steering else subjects)
        self._ordered_since_disarmed.update(subjects)
        self._posted_orders.append(order)
        try:
            yield order
        finally:
            self._posted_orders.remove(order)
            self._expect_late_effects(order)
            order.is_closed = True

    @contextmanager
    def sending(
        self,
        order: Order,
        *,
        modes: Collection[Mode] = (),
        armed: bool | None = None,
        is_done: Callable[[], bool] = lambda: False,
    ) -> Iterator[SentCommand]:
        """Track one command of this order during a `with` block; see :class:`SentCommand`."""
        sent = SentCommand(
            order,
            mode_now=self._telemetry.mode.latest,
            armed_now=self._telemetry.armed.latest,
            modes=modes,
            armed=armed,
            is_done=is_done,
            slept_s=partial(self.slept_since, self._now()),
        )
        if order.armed is None and armed is not None:  # `posted_order` has already done this if `order.armed` is set.
            self.supersede_arm_commands(armed)
            order.arm_command_number = self.arm_commands_sent
        self._sent_commands.append(sent)
        sent_at = self._now()
        try:
            yield sent
            # The block has not raised, so the vehicle has accepted the command.
            order.was_refused = False  # The order's previous command may have been refused as unsupported.
            self._record_acceptance(armed, self._now())
        except CommandRejected:
            order.was_refused = True
            raise
        except BaseException as error:
            # The caller has abandoned the command, but the vehicle may have accepted it at once. Only a CommandTimeout
            # says if the command was not even sent.
            if getattr(error, "was_sent", True):
                self._record_acceptance(armed, sent_at)
            raise
        finally:
            self._sent_commands.remove(sent)
            order.command_ended_at = self._now()

    def record_own_arming(self, armed: bool) -> None:
        """Record that an arm or disarm command was sent without waiting for the acknowledgement."""
        self.supersede_arm_commands(armed)
        self._record_acceptance(armed, self._now())

    def _record_acceptance(self, armed: bool | None, accepted_at: float) -> None:
        if armed:
            # A newer command may have been accepted before this one was abandoned.
            self._arming_accepted_at = max(self._arming_accepted_at, accepted_at)

    def supersede_arm_commands(self, armed: bool) -> None:
        """Count a new order to arm or disarm. It ends earlier ones, which are then not sent again."""
        self.arm_commands_sent += 1
        self.last_arm_command = armed
        if not armed:
            self.disarm_commands_sent += 1
            self.last_disarm_command_at = self._now()
        self.supersede(("arm",))
        for sent in self._sent_commands:
            sent.on_newer_arm_command(armed)

    # ------------------------------------------------------------------------- certainty

    @property
    def is_arm_command_open(self) -> bool:
        """True while a command to arm awaits its acknowledgement."""
        return any(sent.arms for sent in self._sent_commands)

    @property
    def is_flown_by_program(self) -> bool:
        """True if the vehicle executes orders of this program, provided that it is armed."""
        order = self.current
        if order is None or order.takeover_reason or order.failsafe:
            return False
        # After a refusal, the vehicle continues its previous task.
        return order.was_flown_before if order.was_refused else True

    @property
    def current(self) -> Order | None:
        """The newest steering order since the vehicle armed. If there is none, ``_arming_order``."""
        newest = self.newest
        return newest if newest is not None and newest.given_at >= self.last_arming_at else self._arming_order

    def clear_failsafe(self) -> None:
        for order in (self.newest, self._arming_order):
            if order is not None:
                order.failsafe = ""

    @property
    def may_be_executing(self) -> bool:
        """True while the vehicle may still execute an order of the program."""
        order, topics = self.newest, self._ordered_since_disarmed
        # After a takeover, the vehicle executes no order of the program, except one that was posted after `order`
        # (`is_newest` is then False). If `order` has no modes, a mode change may be its effect and not a takeover.
        was_taken_over = order is not None and bool(order.takeover_reason) and bool(order.modes) and order.is_newest
        # After a takeover, a vehicle that the program has armed stays armed.
        return "arm" in topics if was_taken_over else bool(topics)

    @property
    def is_state_recent(self) -> bool:
        self.slept_since(self._now())  # If the computer has just slept, this call adds the time asleep to all ages.
        return self._telemetry.armed.age <= MODE_MAX_AGE_S and not self._is_held_back()

    @property
    def mode_is_in_doubt(self) -> bool:
        """True while the result of a mode change is unknown.

        A report from `mode_settles_at` or later shows the result, so that another party's change of the mode that
        follows is not taken for it.
        """
        is_settled = self._telemetry.mode.updated_at >= self.mode_settles_at
        is_doubted = self._doubted_change > self._confirmed_change and not is_settled
        return self._open_mode_changes > 0 or is_doubted or bool(self.late_modes())

    def settle_mode(self) -> None:
        """Record that the vehicle reports the mode that was ordered last."""
        self.mode_settles_at = -math.inf
        self._unreported_modes.clear()

    @contextmanager
    def changing_mode(self) -> Iterator[None]:
        """Distrust the reported mode during a `with` block in which a command changes the mode.

        If the block raises another error than CommandRejected, or is cancelled, the mode stays distrusted until a later
        change is confirmed.
        """
        change_number = next(self._order_numbers)
        self._open_mode_changes += 1  # A new order may begin another mode change before this one is confirmed.
        try:
            yield
        except CommandRejected:  # The vehicle has not changed the mode.
            raise
        except BaseException:
            self._doubt_change(change_number)
            raise
        else:
            self._confirmed_change = max(self._confirmed_change, change_number)
        finally:
            self._open_mode_changes -= 1

    def expect_late(self, mode: Mode) -> None:
        """Record that the vehicle has changed to this mode by itself. HEARTBEAT may report it late."""
        self._unreported_modes.append((self._now(), mode))

    def doubt_mode(self) -> None:
        """Distrust the reported mode until a later mode change is confirmed."""
        self._doubt_change(next(self._order_numbers))

    def _doubt_change(self, change_number: int) -> None:
        self._doubted_change = max(self._doubted_change, change_number)
        self.mode_settles_at = self._now() + MODE_GRACE_S

    # ------------------------------------------------------------------------------- internals

    def _new_order_expecting_late_modes(
        self, modes: Collection[Mode], ending_topics: Sequence[Topic], *, ends_flight: bool = False
    ) -> Order:
        """Create an order that is not ended by a late mode change, if an earlier order of this program has caused it.

        HEARTBEAT may report the mode of an earlier order, or the mode after a mission, only after the new order was
        given. Such a report does not count as a takeover; see ``expected`` of :class:`Order`.
        """
        newest, present_mode = self.newest, self._telemetry.mode.latest
        is_newest_in_progress = newest is not None and present_mode is not None and newest.may_cause(present_mode)
        may_mode_change = is_newest_in_progress or self.mode_is_in_doubt or self._now() < self.mode_settles_at
        newest_modes = newest.modes if may_mode_change and newest is not None else ()
        late_modes = self.late_modes()
        expected_modes = (*newest_modes, *late_modes, *self._unconfirmed_posted_modes())
        return self._new_order(
            modes=modes,
            ending_topics=ending_topics,
            expected={mode.custom_mode for mode in expected_modes},
            settles_at=self._now() + MODE_GRACE_S if late_modes else self.mode_settles_at,
            any_until=self._any_mode_until,
            ends_flight=ends_flight,
        )

    def _new_order(self, **options: Any) -> Order:
        return Order(
            given_at=self._now(),
            number=next(self._order_numbers),
            is_newest=self._is_newest,
            mode_before=self._telemetry.mode.latest,
            armed_before=self._telemetry.armed.latest,
            state_before=self._telemetry.system_status.latest,
            **options,
        )

    def _all_end_flight(self, modes: Collection[Mode]) -> bool:
        autopilot, is_vtol = self._telemetry.autopilot, self._telemetry.is_vtol
        ending_modes = {autopilot.mode_for("land", is_vtol=is_vtol), autopilot.mode_for("return", is_vtol=is_vtol)}
        ending_numbers = {mode.custom_mode for mode in ending_modes if mode is not None}
        return bool(modes) and {mode.custom_mode for mode in modes} <= ending_numbers

    def _unconfirmed_posted_modes(self) -> tuple[Mode, ...]:
        unconfirmed_orders = [order for order in self._posted_orders if not order.is_confirmed]
        return tuple(mode for order in unconfirmed_orders for mode in order.modes)

    def _expect_late_effects(self, order: Order) -> None:
        now, present_mode = self._now(), self._telemetry.mode.latest
        is_reported = present_mode is not None and order.may_cause(present_mode)
        is_recent = now - order.given_at < MODE_GRACE_S  # An order with several modes may change the mode once more.
        if order.is_effect_due and (is_recent or not is_reported):
            self._unreported_modes.extend((now, mode) for mode in order.modes if mode != present_mode)

    def late_modes(self) -> tuple[Mode, ...]:
        """Return the modes of ended orders and missions that HEARTBEAT may still report."""
        since = self._now() - MODE_GRACE_S
        return tuple(mode for added_at, mode in self._unreported_modes if added_at > since)

    def _is_executing_newest(self) -> bool:
        """Return True if the vehicle executes the newest order, or is about to: HEARTBEAT may report its mode late."""
        order, mode = self.newest, self._telemetry.mode.latest
        if order is None or order.takeover_reason or order.failsafe:
            return False
        is_mode_reported = mode is not None and order.may_cause(mode)
        return is_mode_reported or (order.may_move and order.is_effect_due and self._was_just_sent(order))

    def _was_just_sent(self, order: Order) -> bool:
        """Return True if a command of the order awaits its answer, or did so in the last three seconds."""
        is_awaiting_answer = any(sent.order is order for sent in self._sent_commands)
        return is_awaiting_answer or self._now() - order.command_ended_at < MODE_GRACE_S

    def _on_mode(self, mode_before: Mode | None, mode: Mode) -> None:
        if mode != mode_before:
            self.mode_changed_at = self._telemetry.mode.updated_at
        receivers: tuple[Order | SentCommand, ...] = (*self._active_orders(), *self._sent_commands)
        for receiver in receivers:
            receiver.on_mode(mode, self._telemetry.mode.updated_at)

    def _on_system_status(self, _: int | None, state: int) -> None:
        for order in self._active_orders():
            order.on_system_status(state)

    def _on_armed(self, armed_before: bool | None, armed: bool) -> None:
        if armed_before and not armed:
            self._ordered_since_disarmed.clear()
        if armed and not armed_before:
            self._on_arming()
        if not armed:
            self.last_disarmed_report_at = self._telemetry.armed.updated_at
        receivers: tuple[Order | SentCommand, ...] = (*self._active_orders(), *self._sent_commands)
        for receiver in receivers:
            receiver.on_armed(armed, self._telemetry.armed.updated_at)

    def _on_arming(self) -> None:
        """If the program has armed the vehicle, create the order that records takeovers and failsafes from now on."""
        self.last_arming_at = self._telemetry.armed.updated_at
        is_order_in_progress = self.is_arm_command_open or any(order.armed for order in self._posted_orders)
        accepted_at = self._arming_accepted_at
        is_effect_of_order = math.isfinite(accepted_at) and was_armed_by_order(
            self.last_disarmed_report_at, accepted_at
        )
        was_armed_by_program = is_order_in_progress or is_effect_of_order
        newest = self.newest
        modes = () if newest is None or newest.takeover_reason else newest.modes
        # Without `ending_topics`, no newer order ends this order.
        order = self._new_order_expecting_late_modes(modes, ending_topics=())
        self._arming_order = order if was_armed_by_program else None

    def _active_orders(self) -> tuple[Order, ...]:
        arm_order = () if self._arming_order is None else (self._arming_order,)
        return (*arm_order, *self._orders_in_progress, *self._posted_orders)
