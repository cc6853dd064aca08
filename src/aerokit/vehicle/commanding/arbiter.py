"""``CommandArbiter``: tracks which orders of the program are valid. Pilots and failsafes take precedence over all."""

from __future__ import annotations

import itertools
import math
from collections import deque
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from aerokit.errors import CommandRejected, OperationRejected
from aerokit.vehicle.commanding.order import SUPERSEDED, Order, SentCommand

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Sequence

    from aerokit.autopilots import Mode
    from aerokit.vehicle.commanding.order import Subject, Topic
    from aerokit.vehicle.state.telemetry import Telemetry

MODE_GRACE_S = 3.0
"""Seconds by which HEARTBEAT (1 Hz) may lag behind an accepted command that changes the mode."""
ARM_HEARTBEAT_DELAY_S = 1.5
"""Seconds after an accepted arm command in which a HEARTBEAT (1 Hz) may still report the previous state."""
MODE_MAX_AGE_S = 2.5
"""Maximum age in seconds of a HEARTBEAT that counts as the vehicle's present state, so that two may be lost. The
ground-station failsafes of ArduPilot and PX4 act later (FS_GCS_TIMEOUT 5 s, COM_DL_LOSS_T 10 s).
"""
OWN_MODES_MAX_AGE_S = 10.0
"""Seconds in which a mode that the program ordered may still appear without counting as a takeover."""

STEERING, ACTION = "steering", "action"
"""Topics: STEERING of all steering orders, ACTION of steering orders that actions and raw commands give."""


def was_armed_by_order(disarmed_at: float, accepted_at: float) -> bool:
    """Return True if the vehicle was armed by the order that it accepted at ``accepted_at``.

    If the vehicle reported disarmed after that, another party armed it.
    """
    return disarmed_at <= accepted_at + ARM_HEARTBEAT_DELAY_S


class CommandArbiter:
    """Keeps the orders of one vehicle, determines the newest for each topic, and updates them with each HEARTBEAT.

    Every order of the program is registered here: flight actions, set-points, devices, fleets and classic scripts.
    """

    arming_orders: int

    def __init__(self, now: Callable[[], float], telemetry: Telemetry) -> None:
        self._now, self._telemetry = now, telemetry
        self.newest: Order | None = None
        """The last steering order given by an action or a raw command."""
        self.arming_orders = 0
        """Number of arm and disarm commands sent."""
        self.mode_is_in_doubt: bool = False
        """True while the result of a command that changes the mode is unknown: the reported mode may be about to
        change.
        """
        self.mode_settles_at: float = -math.inf
        """Until this time HEARTBEAT may report the mode of an abandoned order."""
        self._any_mode_until = self._arming_accepted_at = self._disarmed_at = -math.inf
        self._armed_at = -math.inf
        self._armed_by_program: Order | None = None
        self._orders: list[Order] = []
        self._posted: list[Order] = []
        self._sent: list[SentCommand] = []
        self._numbers = itertools.count(1)
        self._latest: dict[Topic, Order] = {}
        self._ordered_since_disarmed: set[Topic] = set()
        self._modes_ordered: deque[tuple[float, int]] = deque(maxlen=16)
        self._on_steering: list[Callable[[], None]] = []
        telemetry.mode.observe(self._on_mode, every_arrival=True)
        telemetry.system_status.observe(self._on_state, every_arrival=True)
        telemetry.armed.observe(self._on_armed, every_arrival=True)

    # ---------------------------------------------------------------------------------- topics

    def latest(self, topic: Topic) -> Order | None:
        """Return the newest order about this topic that was not withdrawn."""
        order = self._latest.get(topic)
        while order is not None and order.is_withdrawn:
            order = order.before
        return order

    def _is_newest(self, order: Order) -> bool:
        newest = (self.latest(topic) for topic in order.ended_by)
        return not order.is_withdrawn and all(newer is None or newer.number <= order.number for newer in newest)

    def _register(self, order: Order, topics: Iterable[Topic]) -> None:
        self._latest.update(dict.fromkeys(topics, order))

    def supersede(self, topics: Iterable[Topic]) -> None:
        """End the posted orders about these topics, because a newer order was given."""
        topics = tuple(topics)
        self._ordered_since_disarmed.update(topics)
        self._register(Order(self._now(), next(self._numbers), self._is_newest), topics)

    def of_device(self, topic: Topic, *, may_be_withdrawn: bool = False) -> Order:
        """Create an order about a device. It supersedes earlier ones, which become valid again if it is withdrawn."""
        order = Order(self._now(), next(self._numbers), self._is_newest, ended_by=(topic,))
        order.before = self.latest(topic) if may_be_withdrawn else None
        self._register(order, (topic,))
        return order

    # ------------------------------------------------------------------------------- steering

    def order(self, *modes: Mode, subjects: Iterable[Subject] = ("mode", "motion"), ends_flight: bool = False) -> Order:
        """Create a steering order that may lead to these modes.

        It supersedes the previous steering order, and posted orders about these subjects. A failsafe does not end an
        order with ``ends_flight``.
        """
        self._notify_steering()
        self._modes_ordered.extend((self._now(), mode.custom_mode) for mode in modes)
        if self._posted_modes():
            self.doubt_mode()
        was_flown = self.is_flown_by_program
        order = self._watching(modes, (STEERING,), ends_flight or self._end_flights(modes))
        order.was_flown_before = was_flown
        order.may_move = self._steers()
        self._register(order, (*subjects, STEERING, ACTION))
        self._ordered_since_disarmed.update(subjects)
        self.newest = order
        self._orders = [order]
        return order

    def raw_order(self, subjects: Iterable[Subject] = ("mode", "motion"), *, modes: Collection[Mode] = ()) -> Order:
        """Register a raw command of the program; without ``modes``, any mode that follows may be its effect."""
        if not modes:
            self._any_mode_until = self._now() + MODE_GRACE_S
        return self.order(*modes, subjects=subjects)

    def on_steering(self, callback: Callable[[], None]) -> None:
        """Register a callback that is called before each new steering order."""
        self._on_steering.append(callback)

    def _notify_steering(self) -> None:
        for callback in self._on_steering:
            callback()

    def on_reboot(self) -> None:
        """End all orders, because the vehicle has rebooted."""
        for order in (*self._orders, *self._posted):
            order.on_reboot()
        self._ordered_since_disarmed.clear()
        self._armed_by_program, self._armed_at = None, math.inf

    # ------------------------------------------------------------------ other orders, in blocks

    @contextmanager
    def auxiliary_order(self, of: Order | None = None, *, ends_flight: bool = False) -> Iterator[Order]:
        """Create an order that does not steer (speed, home, arming …), or a further one ``of`` an order to a device.

        Raises:
            OperationRejected: a newer order to the device was given.
        """
        if of is not None and not of.is_newest:
            raise OperationRejected(f"{SUPERSEDED}; the rest of the order was not sent")
        modes = () if self.newest is None else self.newest.modes
        order = self._watching(modes, (ACTION, *(() if of is None else of.ended_by)), ends_flight)
        self._orders.append(order)
        try:
            yield order
        finally:
            self._orders = [posted for posted in self._orders if posted is not order]

    @contextmanager
    def post(
        self, subjects: Sequence[Subject], *, modes: Collection[Mode] = (), armed: bool | None = None
    ) -> Iterator[Order]:
        """Create a posted order, valid for the duration of the block.

        A newer order about the first subject ends it. The posted order itself ends earlier posted orders about any of
        its subjects and, if it steers, the action in progress.
        """
        is_steering = "arm" not in subjects[:1]
        if is_steering:
            self._notify_steering()
            if self.newest is not None:
                self.newest.expect(modes)
        self._note_arming(armed)
        now = self._now()
        recent = {mode for at, mode in self._modes_ordered if at > now - OWN_MODES_MAX_AGE_S}
        self._modes_ordered.extend((now, mode.custom_mode) for mode in modes)
        order = self._new(
            modes,
            subjects[:1],
            recent,
            armed=armed,
            ends_flight=self._end_flights(modes) or armed is False,
            ends_on_mode_change=armed is not False,
            ends_on_disarm=subjects[0] == "motion",
            requires_mode_change=True,
        )
        self._register(order, (*subjects, STEERING) if is_steering else subjects)
        self._ordered_since_disarmed.update(subjects)
        self._posted.append(order)
        try:
            yield order
        finally:
            self._posted.remove(order)
            order.close()

    @contextmanager
    def sending(
        self,
        order: Order,
        *,
        modes: Collection[Mode] = (),
        armed: bool | None = None,
        is_done: Callable[[], bool] = lambda: False,
    ) -> Iterator[SentCommand]:
        """Track one command of this order for the duration of the block; see :class:`SentCommand`."""
        sent = SentCommand(
            order,
            mode_now=self._telemetry.mode.latest,
            armed_now=self._telemetry.armed.latest,
            modes=modes,
            armed=armed,
            is_done=is_done,
        )
        if order.armed is None:  # A posted order to arm has ended the earlier ones already.
            self._note_arming(armed)
        self._sent.append(sent)
        try:
            yield sent
            self._note_accepted(armed)
        finally:
            self._sent.remove(sent)

    def note_own_arming(self, armed: bool) -> None:
        """Record an arm or disarm command that was sent without waiting for its acknowledgement."""
        self._note_arming(armed)
        self._note_accepted(armed)

    def _note_accepted(self, armed: bool | None) -> None:
        """Record the time of an accepted arm command; HEARTBEAT may report its effect later."""
        if armed:
            self._arming_accepted_at = self._now()

    def _note_arming(self, armed: bool | None) -> None:
        if armed is None:
            return
        self.arming_orders += 1
        self.supersede(("arm",))
        for sent in self._sent:
            sent.on_newer_command(armed)

    # ------------------------------------------------------------------------- certainty

    @property
    def is_flown_by_program(self) -> bool:
        """True while the vehicle is armed and executes orders of this program.

        The program armed the vehicle, or has given a steering order since another party armed it; and there was no
        takeover since.
        """
        order = self.current
        if order is not None and order.was_refused:
            return order.was_flown_before
        return order is not None and not order.takeover_reason and not order.failsafe

    @property
    def current(self) -> Order | None:
        """The program's order since the vehicle was armed: the newest steering order, or the one that armed it."""
        newest = self.newest
        return newest if newest is not None and newest.given_at >= self._armed_at else self._armed_by_program

    def clear_failsafe(self) -> None:
        """Ignore a failsafe that is over, or was active before the program's new order."""
        for order in (self.newest, self._armed_by_program):
            if order is not None:
                order.clear_failsafe()

    @property
    def may_be_executing(self) -> bool:
        """True while the vehicle may still execute an order of the program.

        The program armed the vehicle, which was not disarmed since; or the program steers it, and there was no
        takeover.
        """
        order, about = self.newest, self._ordered_since_disarmed
        # The effect of an order without modes, such as a raw command, is unknown.
        is_taken = order is not None and order.modes and order.takeover_reason and order.is_newest
        return "arm" in about if is_taken else bool(about)

    @property
    def is_known(self) -> bool:
        """True while the last HEARTBEAT is recent enough to describe the vehicle's state."""
        return self._telemetry.armed.age <= MODE_MAX_AGE_S

    @contextmanager
    def changing_mode(self) -> Iterator[None]:
        """Distrust the reported mode until the vehicle's answer is known; a cancellation or time-out leaves it
        unknown.

        A refusal restores the previous doubt, because an earlier order may still take effect.
        """
        was_in_doubt, self.mode_is_in_doubt = self.mode_is_in_doubt, True
        try:
            yield
        except CommandRejected:
            self.mode_is_in_doubt = was_in_doubt
            raise
        except BaseException:
            self.doubt_mode()
            raise
        self.mode_is_in_doubt = False

    def doubt_mode(self) -> None:
        """Distrust the reported mode, because a command that changes it was sent without waiting for the result."""
        self.mode_is_in_doubt = True
        self.mode_settles_at = self._now() + MODE_GRACE_S

    # ------------------------------------------------------------------------------- internals

    def _watching(self, modes: Collection[Mode], ended_by: Sequence[Topic], ends_flight: bool = False) -> Order:
        before, mode = self.newest, self._telemetry.mode.latest
        is_under_way = before is not None and mode is not None and before.is_own(mode)
        is_unsettled = is_under_way or self.mode_is_in_doubt or self._now() < self.mode_settles_at
        expected = before.modes if is_unsettled and before is not None else ()
        return self._new(
            modes,
            ended_by,
            {mode.custom_mode for mode in (*expected, *self._posted_modes())},
            settles_at=self.mode_settles_at,
            any_until=self._any_mode_until,
            ends_flight=ends_flight,
        )

    def _new(
        self, modes: Collection[Mode], ended_by: Sequence[Topic], expected: Collection[int], **rules: Any
    ) -> Order:
        """Create an order that processes all reports from now on."""
        return Order(
            self._now(),
            next(self._numbers),
            self._is_newest,
            ended_by=ended_by,
            modes=modes,
            mode_before=self._telemetry.mode.latest,
            expected=expected,
            armed_before=self._telemetry.armed.latest,
            state_before=self._telemetry.system_status.latest,
            **rules,
        )

    def _end_flights(self, modes: Collection[Mode]) -> bool:
        """Return True if these are modes to land or to return in."""
        autopilot, is_vtol = self._telemetry.autopilot, self._telemetry.is_vtol
        ends = {autopilot.mode_for("land", is_vtol=is_vtol), autopilot.mode_for("return", is_vtol=is_vtol)}
        numbers = {mode.custom_mode for mode in ends if mode is not None}
        return bool(modes) and {mode.custom_mode for mode in modes} <= numbers

    def _posted_modes(self) -> tuple[Mode, ...]:
        """Modes that posted orders may still lead to, including superseded orders."""
        return tuple(mode for order in self._posted if not order.is_confirmed for mode in order.modes)

    def _steers(self) -> bool:
        """True while the vehicle is in a mode of the newest order and there was no takeover."""
        order, mode = self.newest, self._telemetry.mode.latest
        return (
            order is not None
            and mode is not None
            and order.is_own(mode)
            and not order.takeover_reason
            and not order.failsafe
        )

    def _on_mode(self, _: Mode | None, mode: Mode) -> None:
        followers: tuple[Order | SentCommand, ...] = (*self._watched(), *self._sent)
        for follower in followers:
            follower.on_mode(mode, self._telemetry.mode.updated_at)

    def _on_state(self, _: int | None, state: int) -> None:
        for order in self._watched():
            order.on_system_status(state)

    def _on_armed(self, before: bool | None, armed: bool) -> None:
        if before and not armed:
            self._ordered_since_disarmed.clear()
        if armed and not before:
            self._note_armed_anew()
        if not armed:
            self._disarmed_at = self._telemetry.armed.updated_at
        followers: tuple[Order | SentCommand, ...] = (*self._watched(), *self._sent)
        for follower in followers:
            follower.on_armed(armed, self._telemetry.armed.updated_at)

    def _note_armed_anew(self) -> None:
        self._armed_at = self._telemetry.armed.updated_at
        is_under_way = any(sent.arms for sent in self._sent) or any(order.armed for order in self._posted)
        is_accepted = math.isfinite(self._arming_accepted_at)
        is_first = was_armed_by_order(self._disarmed_at, self._arming_accepted_at)
        newest = self.newest
        modes = () if newest is None or newest.takeover_reason else newest.modes
        is_ordered = is_under_way or (is_accepted and is_first)
        self._armed_by_program = self._watching(modes, ()) if is_ordered else None

    def _watched(self) -> tuple[Order, ...]:
        own = () if self._armed_by_program is None else (self._armed_by_program,)
        return (*own, *self._orders, *self._posted)
