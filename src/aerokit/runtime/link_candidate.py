"""``Candidate``: one of several links to a system: how good it is, and whether it was shown to lead to that system.

Sans-IO: what is heard, measured and asked comes in with its time.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from aerokit.runtime.hardware_id import HardwareId

__all__ = ["PROOFS", "PROVEN_BY_COPIES", "SILENT_S", "UNNAMED_AFTER", "Candidate"]

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
