"""``LinkChoice``: over which of several links a system is spoken to, and whom it is believed to be behind the others.

Sans-IO: what is heard, measured and asked comes in with its time.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.runtime.link_candidate import Candidate
from aerokit.runtime.vehicle_clock import VehicleClock

if TYPE_CHECKING:
    from aerokit.runtime.hardware_id import HardwareId

__all__ = ["PATIENCE_S", "STEADY_S", "LinkChoice"]

SHARED_S = 5.0
"""Links have carried the same frames within this time: what comes over either is of one stream."""
ALIKE = 0.5
"""Another link must be better than by this factor before a good one is left for it."""
JITTER_S = 0.05
STEADY_S = 3.0
"""And for so long."""
PATIENCE_S = 10.0
"""So long at most it is waited for a moment in which no order is under way: set-points may come without end."""


class LinkChoice:
    """The links to one system, and the one in use.

    ``needs_proof`` is of systems with an autopilot: what comes over a second link is believed, and orders go there,
    only when it has shown to be the same vehicle, by its clock or by carrying the same frames. Who tells another
    hardware id than the vehicle is not the same, whatever its clock.
    """

    needs_proof: bool

    clock: VehicleClock

    def __init__(self, *, needs_proof: bool) -> None:
        self.needs_proof = needs_proof
        self.candidates: dict[int, Candidate] = {}
        self.clock = VehicleClock()
        self.hardware: HardwareId | None = None
        """The vehicle's, as it was told over the link that was in use then."""
        self._hardware_link = -1
        self.used: Candidate | None = None
        self.former: Candidate | None = None
        """The one before, until its answers have come."""
        self.changed_at: float = -math.inf
        self.fresh_after: float = -math.inf
        """What comes over the link in use before this time was sent before the last that came over the former one."""
        self._better: Candidate | None = None
        self._better_since = 0.0
        self._ordered_at = -math.inf

    def heard(self, link: int, now: float, *, is_costly: bool) -> Candidate:
        """A heartbeat came over a link."""
        candidate = self.candidates.get(link)
        if candidate is None:
            candidate = self.candidates[link] = Candidate(link, is_costly=is_costly, now=now)
        candidate.heard_at = now
        return candidate

    def begin_with(self, candidate: Candidate) -> None:
        """The first autopilot of this system was heard there, which is who has to be the same behind other links."""
        self.needs_proof = True
        if candidate is not self.used:
            self.used = None  # a camera's, for example
            self.candidates = {candidate.link: candidate}

    def note_answer(self, link: int, at: float, told_s: float, round_trip_s: float, now: float) -> None:
        """The system has told its time over a link; ``at`` is when, by our clock."""
        candidate = self.candidates[link]
        is_stale = self.used is not None and self.used.answered_at < candidate.answered_at
        candidate.note_round_trip(round_trip_s, now)
        if candidate is self.used:
            if not self.clock.note(at, told_s, round_trip_s):
                self._hardware_link = (
                    link  # another one may have been switched on in its place, and tells it there
                )
                for other in self.candidates.values():
                    other.forget_proof()
            elif not self.clock.is_steady:
                for other in self.candidates.values():
                    other.forgive_clock()
        else:
            candidate.note_time()
            agrees = self.clock.agrees(at, told_s, round_trip_s)
            if not agrees and is_stale:
                # The link in use may be dead, and the vehicle may have stood still or rebooted since.
                agrees = True if self._recognises(candidate, now) else None
            if agrees is not None:
                candidate.note_clock(agrees, may_prove=not self._waits_for_hardware(candidate))

    def note_hardware(self, link: int, told: HardwareId) -> None:
        """The system has told its hardware id over a link; over the one in use it is the vehicle's.

        Unless another link has told the vehicle's before: then the one in use leads to somebody else.
        """
        candidate = self.candidates[link]
        if told.is_told or candidate.hardware is None:
            candidate.hardware = told
        if candidate is self.used:
            self._adopt_hardware(candidate)
        for each in self.candidates.values():
            if self.hardware is not None and each.hardware is not None:
                each.note_hardware(is_another=self.hardware.contradicts(each.hardware))

    def may_be_used(self, candidate: Candidate) -> bool:
        """Whether what is behind it is the same system."""
        if candidate.is_other_hardware:
            return False
        return self.used in (None, candidate) or candidate.is_proven or not self.needs_proof

    def is_shared(self, candidate: Candidate, now: float) -> bool:
        """Whether it carries the frames that the link in use carries."""
        return now - candidate.shared_at <= SHARED_S

    def choose(self, now: float) -> str | None:
        """Look whether another link is to be used from now on; why, if so."""
        alive = sorted(
            (each for each in self.candidates.values() if self.may_be_used(each) and each.is_alive(now)),
            key=lambda each: (each.is_costly, each.cost_s),
        )
        if not alive:
            return None
        best, used = alive[0], self.used
        if used is None:
            return self._change(best, "first heard", now)
        if used not in alive:
            return self._change(best, used.why_not(), now)
        is_better = best.is_costly < used.is_costly or best.cost_s < ALIKE * used.cost_s
        if best is used or not is_better:
            self._better = None
        elif best is not self._better:
            self._better, self._better_since = best, now
        elif now - self._better_since >= STEADY_S and not self._must_wait(used, now):
            return self._change(best, "cheaper" if best.is_costly < used.is_costly else "better", now)
        return None

    def ordered(self, now: float) -> None:
        """An order is sent over the link in use now."""
        self._ordered_at = now

    def asks_hardware(self, candidate: Candidate, *, is_wanted: bool) -> bool:
        """Whether to ask over this link for the hardware id, together with the time.

        Over the one in use a vehicle object asks by itself (``is_wanted``).
        """
        if candidate is not self.used:
            return not candidate.is_proven and candidate.ask_hardware()
        return len(self.candidates) > 1 and not is_wanted and candidate.ask_hardware()

    def _recognises(self, candidate: Candidate, now: float) -> bool:
        """Whether its hardware id alone proves it: it was proven before the reboot, and is the only one alive."""
        is_same = (
            self.hardware is not None
            and candidate.hardware is not None
            and self.hardware.confirms(candidate.hardware)
        )
        alive = [each for each in self.candidates.values() if each.is_alive(now)]
        return candidate.was_proven and is_same and alive == [candidate]

    def _waits_for_hardware(self, candidate: Candidate) -> bool:
        is_known = self.hardware is not None and candidate.hardware is not None
        return candidate.may_tell_hardware and not is_known

    def _adopt_hardware(self, used: Candidate) -> None:
        told = used.hardware
        if told is None or not told.is_told:
            return
        if self.hardware is None or self._hardware_link == used.link or not self.hardware.contradicts(told):
            self.hardware, self._hardware_link = told, used.link

    def _must_wait(self, used: Candidate, now: float) -> bool:
        """An order may be under way over the link in use: it would arrive after what is ordered over the other one."""
        on_the_way_s = (used.round_trip_s or 0.0) + JITTER_S
        waited_s = now - self._better_since - STEADY_S
        return now - self._ordered_at <= on_the_way_s and waited_s <= PATIENCE_S

    def _change(self, to: Candidate, reason: str, now: float) -> str:
        former = self.used
        if former is not None:
            longer_s = ((to.round_trip_s or 0.0) - (former.round_trip_s or 0.0)) / 2
            self.fresh_after = former.heard_at + longer_s + JITTER_S
            # The one behind the other link is the same as was behind this one.
            former.is_proven = not former.is_other_hardware
        self.former, self.used, self.changed_at, self._better = former, to, now, None
        self._adopt_hardware(to)
        return reason
