"""``Claim``: what a second peer has to show before it is taken for a component that was elsewhere."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from aerokit.mavlink.frame import Frame

__all__ = ["Claim", "boot_time_ms"]

# Message id → where its time_boot_ms begins in a frame's body: SYSTEM_TIME, ATTITUDE, ATTITUDE_QUATERNION,
# LOCAL_POSITION_NED, GLOBAL_POSITION_INT.
_BOOT_TIME_AT = {2: 17, 30: 9, 31: 9, 32: 9, 33: 9}


ENOUGH = 3


class Claim:
    """One peer's, to one (system id, component id), judged by its first frame after the last one of who had the place.

    While that one is silent nobody gets a second chance, so that numbers cannot be tried out.
    """

    __slots__ = (
        "_clock_is_right",
        "_expected",
        "_follows",
        "_frames",
        "_since",
        "is_refusal_told",
        "is_told",
    )

    def __init__(self) -> None:
        self._expected: int | None = None
        self._follows: bool | None = None
        self._clock_is_right: bool | None = None
        self._frames, self._since = 0, 0.0  # since the other one was heard last
        self.is_told: bool = False
        self.is_refusal_told: bool = False

    def hear(self, frame: Frame, evidence: tuple[int, bool | None, bool | None]) -> None:
        """One more frame: how far the other one has come, and whether number and clock go on there (None: unknown)."""
        expected, follows, clock_is_right = evidence
        if expected != self._expected:
            self._expected = expected
            self._frames = 0
            self.is_refusal_told = False
            self._follows, self._clock_is_right, self._since = follows, None, frame.received_at
        self._frames += 1
        if clock_is_right is not None and self._clock_is_right is not False:
            self._clock_is_right = clock_is_right

    @property
    def goes_on(self) -> bool:
        """Whether it goes on where the other one stopped."""
        return self._follows is not False and self._clock_is_right is True

    def has_replaced(self, now: float, rate: float) -> bool:
        """Whether it goes on, for as long as the other one, at so many frames a second, sends three frames in."""
        return self.goes_on and self._frames >= ENOUGH and (now - self._since) * rate >= ENOUGH

    @property
    def may_go_on(self) -> bool:
        """Whether it may yet turn out to."""
        return self._follows is not False and self._clock_is_right is not False


def boot_time_ms(frame: Frame) -> int | None:
    """The sender's time since boot that a frame tells, in milliseconds; None if its message has none."""
    begin = _BOOT_TIME_AT.get(frame.message_id)
    return None if begin is None else int.from_bytes(frame.body[begin : begin + 4], "little")
