"""MISSION_SET_CURRENT until MISSION_CURRENT confirms it (https://mavlink.io/en/services/mission.html)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from aerokit.errors import OperationTimeout
from aerokit.mavlink.messages import MissionCurrent
from aerokit.mavlink.messages import MissionSetCurrent as SetCurrentMessage
from aerokit.protocols.transfer import Transfer

if TYPE_CHECKING:
    from aerokit.mavlink.message import Message
    from aerokit.protocols.command import Standing

__all__ = ["MissionSetCurrent"]

LOOK_S = 0.1
TOLD_EVERY_S = 1.0
"""MISSION_CURRENT is streamed at 1 Hz, and sent when it changes."""


class MissionSetCurrent(Transfer[None]):
    """There is no acknowledgement: PX4 sends MISSION_CURRENT when the item has changed, else at its next turn.

    ``told`` is the item that the vehicle told last: from the item wanted to the one after it, it flies on by itself.
    With a ``standing``, it is sent again only after a HEARTBEAT that came since, and while that is not against it.
    """

    expects: tuple[type[Message], ...] = (MissionCurrent,)

    # from start() on
    _sent_at: float

    def __init__(
        self,
        target_system: int,
        target_component: int,
        seq: int,
        told: int | None = None,
        *,
        standing: Standing | None = None,
        **options: Any,
    ) -> None:
        super().__init__(target_system, target_component, **options)
        self._seq = seq
        self._told = told
        self._standing = standing
        self._attempts = 0

    def start(self, now: float) -> None:
        """Send it."""
        self._begin(now)
        self._send(now)

    def receive(self, message: Message, now: float) -> None:
        """Take a MISSION_CURRENT; one that was under way may come first."""
        if not isinstance(message, MissionCurrent) or not self._is_from_target(message):
            return
        if message.seq == self._seq or self._has_passed(message.seq):
            self._finish(None)
        self._told = message.seq

    def expire(self, now: float) -> None:
        """Send it again, or give up."""
        end = "" if self._standing is None else self._standing.end
        if end or self._is_out_of_patience(now):
            told = "nothing" if self._told is None else f"item {self._told}"
            self._fail(
                OperationTimeout(
                    f"MISSION_SET_CURRENT {self._seq} was not confirmed in {now - self._started_at:.1f} s"
                    f" ({self._attempts} attempts); MISSION_CURRENT told {told} (numbers on the wire)"
                    + (f"; not sent again: {end}" if end else "")
                )
            )
        elif self._standing is not None and self._standing.told_at < self._sent_at:
            self.deadline = now + LOOK_S
        else:
            self._send(now)

    def _has_passed(self, seq: int) -> bool:
        """Whether it has gone to our item and run through it: not what flying on from where it was comes to."""
        told = self._told
        return told is not None and (told <= self._seq < seq or self._seq < seq < told)

    def _send(self, now: float) -> None:
        self._attempts += 1
        self._sent_at = now
        self._outbox.append(SetCurrentMessage(self.target_system, self.target_component, self._seq))
        left = self._started_at + self._patience_s - now
        self.deadline: float | None = now + min(
            max(self.round_trip.timeout_s(), TOLD_EVERY_S), max(left, 0.01)
        )
