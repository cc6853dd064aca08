"""``LinkQuestions``: the time of each vehicle, asked over each link to it, and the answers; over a new link also which
hardware it is.

https://mavlink.io/en/services/timesync.html, https://mavlink.io/en/messages/common.html#AUTOPILOT_VERSION
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd, MavComponent

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.links.link import Peer
    from aerokit.mavlink.message import Message
    from aerokit.runtime.link_candidate import Candidate
    from aerokit.runtime.link_choice import LinkChoice

__all__ = ["UNWANTED_HZ", "LinkQuestions"]

ASK_S = 0.5
ASK_COSTLY_S = 5.0
EARLY_S = 0.05
"""It is looked ten times a second."""
MOST_QUESTIONS = 256
UNWANTED_HZ = 40.0
"""So many questions a second go to systems without a vehicle object, all together: ids that somebody makes up must not
fill a slow radio."""

_AUTOPILOT = int(MavComponent.AUTOPILOT1)


class LinkQuestions:
    """Asks twice a second, over a costly link that is not in use once in five; ``send(message, peer)`` sends."""

    def __init__(self, links: int, send: Callable[[Message, Peer], object]) -> None:
        self._count, self._send = links, send
        self._under_way: dict[int, tuple[int, int, float]] = {}  # ts1 → system, link, asked at
        self._asked_at: dict[tuple[int, int], float] = {}
        self._left, self._left_at = UNWANTED_HZ, 0.0

    def ask(
        self,
        system_id: int,
        choice: LinkChoice,
        candidate: Candidate,
        peer: Peer,
        now: float,
        *,
        is_wanted: bool,
    ) -> None:
        """Ask, if it is time to; ``is_wanted``: a vehicle object stands for the system."""
        is_idle = candidate.is_costly and candidate is not choice.used
        is_new = not candidate.is_proven and not candidate.is_doubted
        period = ASK_COSTLY_S if is_idle and not is_new else ASK_S
        key = system_id, candidate.link
        if now - self._asked_at.get(key, -math.inf) < period - EARLY_S:
            return
        if not is_wanted and not self._has_left(now):
            return
        self._asked_at[key] = now
        # Our time in nanoseconds, and in its last digits what nobody else asks.
        number = int(now * 1e9) // 1000 * 1000 + (system_id * self._count + candidate.link) % 1000
        if number <= 0 or number in self._under_way:
            return
        if len(self._under_way) >= MOST_QUESTIONS:
            del self._under_way[next(iter(self._under_way))]
        self._under_way[number] = system_id, candidate.link, now
        self._send(m.Timesync(0, number, target_system=system_id, target_component=_AUTOPILOT), peer)
        if choice.asks_hardware(candidate, is_wanted=is_wanted):
            wanted = float(m.AutopilotVersion.ID)
            question = m.CommandLong(
                system_id, _AUTOPILOT, MavCmd.REQUEST_MESSAGE, 0, wanted, 0, 0, 0, 0, 0, 0
            )
            self._send(question, peer)

    def _has_left(self, now: float) -> bool:
        self._left = min(UNWANTED_HZ, self._left + UNWANTED_HZ * (now - self._left_at))
        self._left_at = now
        if self._left < 1:
            return False
        self._left -= 1
        return True

    def is_ours(self, message: Message | None) -> bool:
        """Whether it answers one of our questions, over whatever link it came."""
        return isinstance(message, m.Timesync) and message.tc1 != 0 and message.ts1 in self._under_way

    def round_trip_of(self, answer: m.Timesync, system_id: int, link: int, now: float) -> float | None:
        """Seconds since the question; None when it was asked of somebody else, or over another link."""
        if self._under_way.get(answer.ts1, (0, 0, 0.0))[:2] != (system_id, link):
            return None
        return max(0.0, now - self._under_way.pop(answer.ts1)[2])
