"""``LinkChoice``: over which of several links a system is spoken to, and whom it is believed to be behind the others.

Sans-IO: what is heard, measured and asked comes in with its time.

Sans-IO: what is heard, measured and asked comes in with its time.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.connection.multilink.vehicle_clock import VehicleClock

if TYPE_CHECKING:
    from aerokit.connection.components import HardwareId

SILENT_S = 1.0
"""Of a link over which questions are answered twice a second."""

QUIET_S = 2.5
"""Of a link over which little may come: two heartbeats are missing."""

PROOFS = 3
"""So many times in a row must the clock be the same before a second link is believed to lead to the same vehicle."""

UNNAMED_AFTER = 3
"""Who has told the time so often since the question for the hardware id, and not the id, does not tell it."""

MOST_QUESTIONS = 20

PROVEN_BY_COPIES = 3
"""So many frames must have come over it and over the link in use."""


class Candidate:
    """One link to one system."""

    def __init__(self, link: int, *, is_costly: bool, now: float) -> None:
        self.link = link
        self.is_costly = is_costly
        self.heard_at: float = now
        self.answered_at: float = -math.inf
        self.shared_at: float = -math.inf
        self.is_there: bool = True
        self.is_stalled: bool = False
        self.loss: float | None = None
        """Share of frames lost, 0 to 1, over the last seconds; None: not known yet."""
        self.round_trip_s: float | None = None
        """None: nothing was answered yet."""
        self.is_proven: bool = False
        self.was_proven: bool = False
        """Whether it was proven before the vehicle rebooted or its clock was doubted."""
        self.is_doubted: bool = False
        """Whether somebody else speaks in this system's name there."""
        self.hardware: HardwareId | None = None
        """What was told over it; None: nothing yet."""
        self.is_other_hardware: bool = False
        """Whether that is another one's than the vehicle's: neither its clock nor copies outweigh it."""
        self._asked_hardware = self._times_since = 0
        self._agreed = self._disagreed = self._copies = 0
        self._counted = (0, 0)

    def note_counts(self, received: int, lost: int, now: float) -> None:
        """So many frames came over it in all, and so many did not."""
        before, self._counted = self._counted, (received, lost)
        if received > before[0]:
            self.heard_at = now
        came, missing = received - before[0], max(0, lost - before[1])
        if came > 0 or missing:
            share = missing / (max(came, 0) + missing)
            weight = 1 - 0.85 ** (max(came, 0) + missing)  # the last dozen of frames counts most
            self.loss = share if self.loss is None else self.loss + weight * (share - self.loss)

    def note_round_trip(self, seconds: float, now: float) -> None:
        """A question was answered over it."""
        self.answered_at = self.heard_at = now
        before = self.round_trip_s
        self.round_trip_s = seconds if before is None else 0.7 * before + 0.3 * seconds

    def note_clock(self, is_the_same: bool, *, may_prove: bool) -> None:
        """The time that is told over it is the vehicle's, or another one's."""
        if is_the_same:
            self._agreed, self._disagreed = self._agreed + 1, 0
        else:
            self._agreed, self._disagreed = 0, self._disagreed + 1
        if self._agreed >= PROOFS and may_prove and not self.is_other_hardware:
            self.is_proven, self.is_doubted = True, False
        elif self._disagreed >= PROOFS:
            self._doubt()

    def note_copy(self, now: float) -> None:
        """The same frame came over it and over the link in use."""
        self.shared_at = now
        self._copies += 1
        if self._copies >= PROVEN_BY_COPIES and not self.is_other_hardware:
            self.is_proven, self.is_doubted = True, False

    def forget_proof(self) -> None:
        """The vehicle has rebooted: what was shown of its clock does not count any more."""
        self.was_proven = self.was_proven or self.is_proven
        self.is_proven = self.is_other_hardware = False
        self.hardware = None
        self._asked_hardware = self._times_since = 0
        self._agreed = self._disagreed = self._copies = 0

    def ask_hardware(self) -> bool:
        """Whether to ask for its hardware id now, as well as for its time."""
        if (
            self.hardware is not None
            or self.answered_at == -math.inf
            or self._asked_hardware >= MOST_QUESTIONS
        ):
            return False
        self._asked_hardware += 1
        return True

    @property
    def may_tell_hardware(self) -> bool:
        """Whether it was asked for its hardware id, and the answer may still come."""
        return self._asked_hardware > 0 and self._times_since < UNNAMED_AFTER

    def note_hardware(self, *, is_another: bool) -> None:
        """It and the vehicle have told their hardware ids."""
        if is_another:
            self._doubt()
            self.was_proven = False
        elif self.is_other_hardware:
            self.is_doubted = False
        self.is_other_hardware = is_another

    def note_time(self) -> None:
        """It has told its time, so that it could have told its hardware id."""
        if self._asked_hardware:
            self._times_since += 1

    def forgive_clock(self) -> None:
        """The vehicle's clock has stood still: that this link told another time meanwhile is no evidence."""
        self._disagreed = 0

    def _doubt(self) -> None:
        self.was_proven = self.was_proven or self.is_proven
        self.is_proven, self.is_doubted = False, True

    def is_alive(self, now: float) -> bool:
        """Whether something comes over it, and what is written leaves."""
        answers = now - self.answered_at <= 2 * QUIET_S
        silent_after_s = SILENT_S if answers and not self.is_costly else QUIET_S
        return self.is_there and not self.is_stalled and now - self.heard_at <= silent_after_s

    def why_not(self) -> str:
        """Why it is not used any more."""
        if self.is_other_hardware:
            return "another vehicle"
        return "lost" if not self.is_there else "stalled" if self.is_stalled else "silent"

    @property
    def cost_s(self) -> float:
        """How long an order and its answer take, with what is lost on the way."""
        loss = min(0.9, self.loss or 0.0)
        return ((0.1 if self.round_trip_s is None else self.round_trip_s) + 0.05) / (1 - loss) ** 2


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
