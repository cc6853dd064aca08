"""``LinkQuestions``: the time of each vehicle, asked over each link to it, and the answers; over a new link also which
hardware it is.

https://mavlink.io/en/services/timesync.html, https://mavlink.io/en/messages/common.html#AUTOPILOT_VERSION
"""

from __future__ import annotations

import logging
import math
from typing import TYPE_CHECKING

from aerokit.connection.components import HardwareId
from aerokit.events import HeardTwice
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd, MavComponent

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from aerokit.connection.bus import Bus
    from aerokit.connection.multilink.link_choice import Candidate, LinkChoice
    from aerokit.mavlink.frame import Frame
    from aerokit.mavlink.message import Message
    from aerokit.transport.link import Peer

logger: logging.Logger = logging.getLogger("aerokit")

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
    """Asks twice a second, over a costly link that is not in use once in five; ``send(message, peer)`` sends.

    What is answered goes into the choices; that somebody else answers is told once, until it is so no more.
    """

    def __init__(
        self,
        names: Sequence[str],
        choices: Mapping[int, LinkChoice],
        bus: Bus,
        send: Callable[[Message, Peer], object],
    ) -> None:
        self._names, self._choices, self._bus, self._send = names, choices, bus, send
        self._under_way: dict[int, tuple[int, int, float]] = {}  # ts1 → system, link, asked at
        self._asked_at: dict[tuple[int, int], float] = {}
        self._left, self._left_at = UNWANTED_HZ, 0.0
        self._doubts_told: set[tuple[int, int]] = set()
        bus.want(m.Timesync, m.AutopilotVersion)

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
        number = int(now * 1e9) // 1000 * 1000 + (system_id * len(self._names) + candidate.link) % 1000
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

    def is_answer(self, frame: Frame, link: int) -> bool:
        """Whether this TIMESYNC answers one of our questions, which is noted; over whatever link it came."""
        message = self._bus.dialect.decode(frame)
        if not isinstance(message, m.Timesync) or not message.tc1 or message.ts1 not in self._under_way:
            return False
        now = frame.received_at
        round_trip_s = self._round_trip_of(message, frame.system_id, link, now)
        choice = self._choices.get(frame.system_id)
        if round_trip_s is not None and choice is not None and link in choice.candidates:
            choice.note_answer(link, now - round_trip_s / 2, message.tc1 / 1e9, round_trip_s, now)
            self._tell_doubt(frame, choice.candidates[link])
        return True

    def note_hardware(self, frame: Frame, link: int) -> None:
        """Whatever came over a link: if it tells the hardware id, that is noted."""
        if frame.message_id != m.AutopilotVersion.ID or frame.component_id != _AUTOPILOT:
            return
        choice, message = self._choices.get(frame.system_id), self._bus.dialect.decode(frame)
        if isinstance(message, m.AutopilotVersion) and choice is not None and link in choice.candidates:
            choice.note_hardware(link, HardwareId.of(message))
            for candidate in choice.candidates.values():
                self._tell_doubt(frame, candidate)

    def _has_left(self, now: float) -> bool:
        self._left = min(UNWANTED_HZ, self._left + UNWANTED_HZ * (now - self._left_at))
        self._left_at = now
        if self._left < 1:
            return False
        self._left -= 1
        return True

    def _round_trip_of(self, answer: m.Timesync, system_id: int, link: int, now: float) -> float | None:
        """Seconds since the question; None when it was asked of somebody else, or over another link."""
        if self._under_way.get(answer.ts1, (0, 0, 0.0))[:2] != (system_id, link):
            return None
        return max(0.0, now - self._under_way.pop(answer.ts1)[2])

    def _tell_doubt(self, frame: Frame, candidate: Candidate) -> None:
        key = frame.system_id, candidate.link
        if not candidate.is_doubted:
            self._doubts_told.discard(key)
        elif key not in self._doubts_told:
            self._doubts_told.add(key)
            logger.warning(
                "another vehicle speaks as system %d over %s: its %s is another one; it is not listened to",
                frame.system_id,
                self._names[candidate.link],
                "hardware id (AUTOPILOT_VERSION)" if candidate.is_other_hardware else "clock",
            )
            self._bus.publish(HeardTwice(frame.received_at, frame.system_id, frame.component_id))
