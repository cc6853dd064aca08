"""``Helm``: who steers: the program's newest order, and a pilot or a failsafe before all orders."""

from __future__ import annotations

import itertools
import math
from collections import deque
from contextlib import contextmanager
from typing import TYPE_CHECKING

from aerokit.errors import CommandRejected
from aerokit.vehicle.commanding.order import Order, Sending
from aerokit.vehicle.commanding.posted import OWN_MODES_S, Posted

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Sequence

    from aerokit.autopilots import Mode
    from aerokit.vehicle.commanding.order import Subject
    from aerokit.vehicle.state.telemetry import Telemetry

__all__ = ["FIRST_HEARTBEAT_S", "KNOWN_S", "MODE_GRACE_S", "Helm"]

MODE_GRACE_S = 3.0
"""How long HEARTBEAT, at 1 Hz, may lag behind an accepted command that changes the mode."""
FIRST_HEARTBEAT_S = 1.5
"""So long after an order to arm was accepted a HEARTBEAT, at 1 Hz, may still tell what was before."""
KNOWN_S = 2.5
"""What a vehicle does is known while its last HEARTBEAT is not older: two may be missing. No failsafe of ArduPilot or
PX4 that minds a silent ground station acts sooner (FS_GCS_TIMEOUT 5 s, COM_DL_LOSS_T 10 s)."""


class Helm:
    """Keeps the orders of one vehicle, and tells each what HEARTBEAT says.

    An order ends when a newer one is given, and when the mode becomes one that it does not explain or the vehicle
    disarms: that is for good, also if the mode comes back.
    """

    arming_orders: int

    def __init__(self, now: Callable[[], float], telemetry: Telemetry) -> None:
        self._now, self._telemetry = now, telemetry
        self.newest: Order | None = None
        """The last order that steers."""
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
        self._sendings: list[Sending] = []
        self._posted: list[Posted] = []
        self._numbers = itertools.count(1)
        self._newest_about: dict[Subject, int] = {}
        self._ordered_since_disarmed: set[Subject] = set()
        self._modes_ordered: deque[tuple[float, int]] = deque(maxlen=16)
        self._on_new: list[Callable[[], None]] = []
        telemetry.mode.observe(self._on_mode, every_arrival=True)
        telemetry.system_status.observe(self._on_state, every_arrival=True)
        telemetry.armed.observe(self._on_armed, every_arrival=True)

    # ------------------------------------------------------------------------------- orders

    def order(self, *modes: Mode, subjects: Iterable[Subject] = ("mode", "motion")) -> Order:
        """A new order that steers, and may bring about these modes: the one before ends, and what was posted about
        these subjects.
        """
        for each in self._on_new:
            each()
        self.note_newer(subjects)
        self._modes_ordered.extend((self._now(), each.custom_mode) for each in modes)
        if self._posted_modes():
            self.doubt_mode()
        was_flown = self.is_flown_by_program
        order = self._new(modes, lambda order: order is self.newest, self._end_flights(modes))
        order.was_flown_before = was_flown
        order.is_given = self._steers()
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

    def note_reboot(self) -> None:
        """The vehicle has rebooted: all orders end."""
        orders: tuple[Order | Posted, ...] = (*self._orders, *self._posted)
        for order in orders:
            order.note_reboot()
        self._ordered_since_disarmed.clear()
        self._armed_by_program, self._armed_at = None, math.inf

    @contextmanager
    def aside(self, *, ends_flight: bool = False) -> Iterator[Order]:
        """An order that does not steer (speed, home, arming …), for the time of the block."""
        steering = self.newest
        modes = () if steering is None else steering.modes
        order = self._new(modes, lambda _: self.newest is steering, ends_flight)
        self._orders.append(order)
        try:
            yield order
        finally:
            self._orders = [each for each in self._orders if each is not order]

    def on_new(self, callback: Callable[[], None]) -> None:
        """Have this called before each new order that steers."""
        self._on_new.append(callback)

    @contextmanager
    def sending(
        self,
        order: Order,
        *,
        modes: Collection[Mode] = (),
        armed: bool | None = None,
        is_done: Callable[[], bool] = lambda: False,
    ) -> Iterator[Sending]:
        """Watch what becomes of one command of this order, for the time of the block; see :class:`Sending`."""
        sending = Sending(
            order,
            mode_now=self._telemetry.mode.latest,
            armed_now=self._telemetry.armed.latest,
            modes=modes,
            armed=armed,
            is_done=is_done,
        )
        self._note_arming(armed)
        self._sendings.append(sending)
        try:
            yield sending
            self._note_accepted(armed)
        finally:
            self._sendings.remove(sending)

    # --------------------------------------------------------------------------------- posted

    @contextmanager
    def posting(
        self, subjects: Sequence[Subject], *, modes: Collection[Mode] = (), armed: bool | None = None
    ) -> Iterator[Posted]:
        """An order about the first of these subjects that is given without waiting, for the time of the block.

        It ends what was posted about any of them before, and if it steers, the order of an action.
        """
        if "arm" not in subjects[:1]:
            for each in self._on_new:
                each()
            if self.newest is not None:
                self.newest.note_newer()
                self.newest.expect(modes)
        self._note_arming(armed)
        number, now = self.note_newer(subjects), self._now()
        own_modes = {mode for at, mode in self._modes_ordered if at > now - OWN_MODES_S}
        self._modes_ordered.extend((now, each.custom_mode) for each in modes)
        posted = Posted(
            lambda: self._newest_about[subjects[0]] == number,
            modes=modes,
            own_modes=own_modes,
            armed=armed,
            mode_now=self._telemetry.mode.latest,
            armed_now=self._telemetry.armed.latest,
            state_now=self._telemetry.system_status.latest,
            moves=subjects[0] == "motion",
            ends_flight=self._end_flights(modes),
        )
        self._posted.append(posted)
        try:
            yield posted
            self._note_accepted(armed)
        finally:
            self._posted.remove(posted)

    def note_newer(self, subjects: Iterable[Subject]) -> int:
        """A newer order about these is given: what was posted about them before ends; the number of it."""
        number = next(self._numbers)
        about = dict.fromkeys(subjects, number)
        self._newest_about.update(about)
        self._ordered_since_disarmed.update(about)
        return number

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
        self.note_newer(("arm",))
        for each in self._sendings:
            each.note_newer(armed)

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
        is_taken = order is not None and order.modes and order.taken_by and not order.is_overruled
        return "arm" in about if is_taken else bool(about)

    @property
    def is_known(self) -> bool:
        """Whether the vehicle has told lately what it does."""
        return self._telemetry.armed.age <= KNOWN_S

    @contextmanager
    def changing_mode(self) -> Iterator[None]:
        """Until the vehicle's answer is known, which it is not when this is cancelled or times out, trust no mode."""
        self.mode_is_in_doubt = True
        try:
            yield
        except CommandRejected:
            self.mode_is_in_doubt = False
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

    def _new(
        self, modes: Collection[Mode], is_newest: Callable[[Order], bool], ends_flight: bool = False
    ) -> Order:
        before, mode = self.newest, self._telemetry.mode.latest
        is_under_way = before is not None and mode is not None and before.is_own(mode)
        is_unsettled = is_under_way or self.mode_is_in_doubt or self._now() < self.mode_settles_at
        expected = before.modes if is_unsettled and before is not None else ()
        return Order(
            self._now(),
            mode_before=mode,
            modes=modes,
            expected=(*expected, *self._posted_modes()),
            armed_before=self._telemetry.armed.latest,
            state_before=self._telemetry.system_status.latest,
            is_newest=is_newest,
            settles_at=self.mode_settles_at,
            any_until=self._any_mode_until,
            ends_flight=ends_flight,
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
        for each in self._followers():
            each.note_mode(mode, self._telemetry.mode.updated_at)

    def _on_state(self, _: int | None, state: int) -> None:
        for each in self._followers():
            each.note_state(state)

    def _on_armed(self, before: bool | None, armed: bool) -> None:
        if before and not armed:
            self._ordered_since_disarmed.clear()
        if armed and not before:
            self._note_armed_anew()
        if not armed:
            self._disarmed_told_at = self._telemetry.armed.updated_at
        for each in self._followers():
            each.note_armed(armed, self._telemetry.armed.updated_at)

    def _note_armed_anew(self) -> None:
        self._armed_at = self._telemetry.armed.updated_at
        is_under_way = any(each.arms for each in self._sendings) or any(each.armed for each in self._posted)
        # Disarmed again after an order to arm was accepted, it was armed by somebody else.
        is_accepted = math.isfinite(self._arming_accepted_at)
        is_first = self._disarmed_told_at <= self._arming_accepted_at + FIRST_HEARTBEAT_S
        is_ordered = is_under_way or (is_accepted and is_first)
        newest = self.newest
        modes = () if newest is None or newest.taken_by else newest.modes
        self._armed_by_program = self._new(modes, lambda _: True) if is_ordered else None

    def _followers(self) -> tuple[Order | Sending | Posted, ...]:
        own = () if self._armed_by_program is None else (self._armed_by_program,)
        return (*own, *self._orders, *self._sendings, *self._posted)
