"""``CommandArbiter``: which orders of the program stand; a pilot or a failsafe comes before all of them."""

from __future__ import annotations

import itertools
import math
from collections import deque
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from aerokit.errors import CommandRejected, OperationRejected
from aerokit.vehicle.commanding.order import OVERRULED, Order, SentCommand

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Sequence

    from aerokit.autopilots import Mode
    from aerokit.vehicle.commanding.order import Subject, Topic
    from aerokit.vehicle.state.telemetry import Telemetry

MODE_GRACE_S = 3.0
"""How long HEARTBEAT, at 1 Hz, may lag behind an accepted command that changes the mode."""
FIRST_HEARTBEAT_S = 1.5
"""So long after an order to arm was accepted a HEARTBEAT, at 1 Hz, may still tell what was before."""
KNOWN_S = 2.5
"""What a vehicle does is known while its last HEARTBEAT is not older: two may be missing. No failsafe of ArduPilot or
PX4 that minds a silent ground station acts sooner (FS_GCS_TIMEOUT 5 s, COM_DL_LOSS_T 10 s)."""
OWN_MODES_S = 10.0
"""A mode that the program ordered so long ago may be told only now: that is nobody who takes over."""

STEERING, ACTION = "steering", "action"
"""Topics of each order that steers, and of those among them that an action gives, or a command of the program."""


def is_first_told(disarmed_told_at: float, accepted_at: float) -> bool:
    """Whether a vehicle that arms does so by an order to arm that it accepted then.

    Told to be disarmed again after that, it was armed by somebody else.
    """
    return disarmed_told_at <= accepted_at + FIRST_HEARTBEAT_S


class CommandArbiter:
    """Keeps the orders of one vehicle, says which is the newest about its topics, and tells each what HEARTBEAT says.

    Every order of the program passes here, waited for or not: flights, set-points, devices, fleets, classic programs.
    """

    arming_orders: int

    def __init__(self, now: Callable[[], float], telemetry: Telemetry) -> None:
        self._now, self._telemetry = now, telemetry
        self.newest: Order | None = None
        """The last order that steers and that an action or a command of the program has given."""
        self.arming_orders = 0
        """How many orders to arm or disarm were sent."""
        self.mode_is_in_doubt: bool = False
        """An order that changes the mode is out and its end is not known: the mode told may be about to change."""
        self.mode_settles_at: float = -math.inf
        """Until then HEARTBEAT may tell the mode of an order that was given up."""
        self._any_mode_until = self._arming_accepted_at = self._disarmed_told_at = -math.inf
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
        """The newest order about this that was not withdrawn."""
        order = self._latest.get(topic)
        while order is not None and order.is_withdrawn:
            order = order.before
        return order

    def _is_newest(self, order: Order) -> bool:
        newest = (self.latest(topic) for topic in order.ended_by)
        return not order.is_withdrawn and all(each is None or each.number <= order.number for each in newest)

    def _register(self, order: Order, topics: Iterable[Topic]) -> None:
        self._latest.update(dict.fromkeys(topics, order))

    def overrule(self, topics: Iterable[Topic]) -> None:
        """A newer order about these is given, which nobody waits for: what was posted about them ends."""
        topics = tuple(topics)
        self._ordered_since_disarmed.update(topics)
        self._register(Order(self._now(), next(self._numbers), self._is_newest), topics)

    def of_device(self, topic: Topic, *, may_be_withdrawn: bool = False) -> Order:
        """A new order about a device: those before end, and count again if it is withdrawn."""
        order = Order(self._now(), next(self._numbers), self._is_newest, ended_by=(topic,))
        order.before = self.latest(topic) if may_be_withdrawn else None
        self._register(order, (topic,))
        return order

    # ------------------------------------------------------------------------------- steering

    def order(self, *modes: Mode, subjects: Iterable[Subject] = ("mode", "motion")) -> Order:
        """A new order that steers, and may bring about these modes: the one before ends, and what was posted about
        these subjects.
        """
        self._tell_steering()
        self._modes_ordered.extend((self._now(), mode.custom_mode) for mode in modes)
        if self._posted_modes():
            self.doubt_mode()
        was_flown = self.is_flown_by_program
        order = self._watching(modes, (STEERING,), self._end_flights(modes))
        order.was_flown_before = was_flown
        order.is_given = self._steers()
        self._register(order, (*subjects, STEERING, ACTION))
        self._ordered_since_disarmed.update(subjects)
        self.newest = order
        self._orders = [order]
        return order

    def order_of_the_programs_own(
        self, subjects: Iterable[Subject] = ("mode", "motion"), *, modes: Collection[Mode] = ()
    ) -> Order:
        """The program sends one by itself; without ``modes``, any mode that follows may be its effect."""
        if not modes:
            self._any_mode_until = self._now() + MODE_GRACE_S
        return self.order(*modes, subjects=subjects)

    def on_steering(self, callback: Callable[[], None]) -> None:
        """Have this called before each new order that steers."""
        self._on_steering.append(callback)

    def _tell_steering(self) -> None:
        for callback in self._on_steering:
            callback()

    def note_reboot(self) -> None:
        """The vehicle has rebooted: all orders end."""
        for order in (*self._orders, *self._posted):
            order.note_reboot()
        self._ordered_since_disarmed.clear()
        self._armed_by_program, self._armed_at = None, math.inf

    # ---------------------------------------------------------------- orders beside it, in blocks

    @contextmanager
    def aside(self, of: Order | None = None, *, ends_flight: bool = False) -> Iterator[Order]:
        """An order that does not steer (speed, home, arming …), or one command ``of`` an order to a device.

        Raises:
            OperationRejected: a newer order to the device was given since.
        """
        if of is not None and not of.is_newest:
            raise OperationRejected(f"{OVERRULED}; the rest of the order was not sent")
        modes = () if self.newest is None else self.newest.modes
        order = self._watching(modes, (ACTION, *(() if of is None else of.ended_by)), ends_flight)
        self._orders.append(order)
        try:
            yield order
        finally:
            self._orders = [each for each in self._orders if each is not order]

    @contextmanager
    def post(
        self, subjects: Sequence[Subject], *, modes: Collection[Mode] = (), armed: bool | None = None
    ) -> Iterator[Order]:
        """An order that others may follow before it is answered, for the time of the block.

        A newer one about the first of its subjects ends it. It ends what was posted about any of them before, and if
        it steers, the order of an action.
        """
        is_steering = "arm" not in subjects[:1]
        if is_steering:
            self._tell_steering()
            if self.newest is not None:
                self.newest.expect(modes)
        self._note_arming(armed)
        now = self._now()
        recent = {mode for at, mode in self._modes_ordered if at > now - OWN_MODES_S}
        self._modes_ordered.extend((now, mode.custom_mode) for mode in modes)
        order = self._new(
            modes,
            subjects[:1],
            recent,
            armed=armed,
            ends_flight=self._end_flights(modes) or armed is False,
            minds_mode=armed is not False,
            minds_disarming=subjects[0] == "motion",
            settles_by_change=True,
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
        """Watch what becomes of one command of this order, for the time of the block; see :class:`SentCommand`."""
        sent = SentCommand(
            order,
            mode_now=self._telemetry.mode.latest,
            armed_now=self._telemetry.armed.latest,
            modes=modes,
            armed=armed,
            is_done=is_done,
        )
        if order.armed is None:  # one that was posted to arm has ended those before already
            self._note_arming(armed)
        self._sent.append(sent)
        try:
            yield sent
            self._note_accepted(armed)
        finally:
            self._sent.remove(sent)

    def note_own_arming(self, armed: bool) -> None:
        """The program has sent an order to arm or disarm, and nobody waits for its answer."""
        self._note_arming(armed)
        self._note_accepted(armed)

    def _note_accepted(self, armed: bool | None) -> None:
        """An order to arm was accepted, or its effect told; HEARTBEAT may tell it later."""
        if armed:
            self._arming_accepted_at = self._now()

    def _note_arming(self, armed: bool | None) -> None:
        if armed is None:
            return
        self.arming_orders += 1
        self.overrule(("arm",))
        for sent in self._sent:
            sent.note_newer(armed)

    # --------------------------------------------------------------------------------- doubts

    @property
    def is_flown_by_program(self) -> bool:
        """Whether the armed vehicle does what this program has ordered.

        The program has armed it, or has given an order that steers since somebody else did, and nobody else has taken
        it from that.
        """
        order = self.current
        if order is not None and order.was_refused:
            return order.was_flown_before
        return order is not None and not order.taken_by and not order.failsafe

    @property
    def current(self) -> Order | None:
        """The program's order since the vehicle was armed: its newest that steers, or the one that armed it."""
        newest = self.newest
        return newest if newest is not None and newest.given_at >= self._armed_at else self._armed_by_program

    def forgive_failsafe(self) -> None:
        """The program orders the vehicle again: a failsafe that is over, or was active then, does not count."""
        for order in (self.newest, self._armed_by_program):
            if order is not None:
                order.forgive_failsafe()

    @property
    def is_obeyed(self) -> bool:
        """Whether the vehicle may still do something that the program has ordered: it was armed by it and has not been
        disarmed since, or it steers and nobody else has taken it from that.
        """
        order, about = self.newest, self._ordered_since_disarmed
        # of an order without modes, such as a command of the program's own, it is not known what it brings about
        is_taken = order is not None and order.modes and order.taken_by and order.is_newest
        return "arm" in about if is_taken else bool(about)

    @property
    def is_known(self) -> bool:
        """Whether the vehicle has told lately what it does."""
        return self._telemetry.armed.age <= KNOWN_S

    @contextmanager
    def changing_mode(self) -> Iterator[None]:
        """Until the vehicle's answer is known, which it is not when this is cancelled or times out, trust no mode.

        A refusal leaves the doubt about an order before: that one may still come into force.
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
        """An order that changes the mode is out and nobody waits for what comes of it."""
        self.mode_is_in_doubt = True
        self.mode_settles_at = self._now() + MODE_GRACE_S

    # --------------------------------------------------------------------------------- inside

    def _watching(
        self, modes: Collection[Mode], ended_by: Sequence[Topic], ends_flight: bool = False
    ) -> Order:
        before, mode = self.newest, self._telemetry.mode.latest
        is_under_way = before is not None and mode is not None and before.is_own(mode)
        is_unsettled = is_under_way or self.mode_is_in_doubt or self._now() < self.mode_settles_at
        expected = before.modes if is_unsettled and before is not None else ()
        return self._new(
            modes,
            ended_by,
            {each.custom_mode for each in (*expected, *self._posted_modes())},
            settles_at=self.mode_settles_at,
            any_until=self._any_mode_until,
            ends_flight=ends_flight,
        )

    def _new(
        self, modes: Collection[Mode], ended_by: Sequence[Topic], expected: Collection[int], **rules: Any
    ) -> Order:
        """An order that judges what is told from now on."""
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
        """Whether these are modes to land or to return in."""
        autopilot, is_vtol = self._telemetry.autopilot, self._telemetry.is_vtol
        ends = {autopilot.mode_for("land", is_vtol=is_vtol), autopilot.mode_for("return", is_vtol=is_vtol)}
        numbers = {each.custom_mode for each in ends if each is not None}
        return bool(modes) and {each.custom_mode for each in modes} <= numbers

    def _posted_modes(self) -> tuple[Mode, ...]:
        """What was posted may still bring these about, also when it has been overruled."""
        return tuple(mode for each in self._posted if not each.has_worked for mode in each.modes)

    def _steers(self) -> bool:
        """Whether the vehicle is in a mode of the newest order, and nobody has taken it from that."""
        order, mode = self.newest, self._telemetry.mode.latest
        return (
            order is not None
            and mode is not None
            and order.is_own(mode)
            and not order.taken_by
            and not order.failsafe
        )

    def _on_mode(self, _: Mode | None, mode: Mode) -> None:
        followers: tuple[Order | SentCommand, ...] = (*self._watched(), *self._sent)
        for each in followers:
            each.note_mode(mode, self._telemetry.mode.updated_at)

    def _on_state(self, _: int | None, state: int) -> None:
        for order in self._watched():
            order.note_state(state)

    def _on_armed(self, before: bool | None, armed: bool) -> None:
        if before and not armed:
            self._ordered_since_disarmed.clear()
        if armed and not before:
            self._note_armed_anew()
        if not armed:
            self._disarmed_told_at = self._telemetry.armed.updated_at
        followers: tuple[Order | SentCommand, ...] = (*self._watched(), *self._sent)
        for each in followers:
            each.note_armed(armed, self._telemetry.armed.updated_at)

    def _note_armed_anew(self) -> None:
        self._armed_at = self._telemetry.armed.updated_at
        is_under_way = any(sent.arms for sent in self._sent) or any(order.armed for order in self._posted)
        is_accepted = math.isfinite(self._arming_accepted_at)
        is_first = is_first_told(self._disarmed_told_at, self._arming_accepted_at)
        newest = self.newest
        modes = () if newest is None or newest.taken_by else newest.modes
        is_ordered = is_under_way or (is_accepted and is_first)
        self._armed_by_program = self._watching(modes, ()) if is_ordered else None

    def _watched(self) -> tuple[Order, ...]:
        own = () if self._armed_by_program is None else (self._armed_by_program,)
        return (*own, *self._orders, *self._posted)
