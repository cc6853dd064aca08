"""``Claim``: what a second peer has to show before it is taken for a component that was elsewhere."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

if TYPE_CHECKING:
    from aerokit.mavlink.frame import Frame

__all__ = ["Claim", "boot_time_ms"]

# Message id → where its time_boot_ms begins in a frame's body: SYSTEM_TIME, ATTITUDE, ATTITUDE_QUATERNION,
# LOCAL_POSITION_NED, GLOBAL_POSITION_INT.
_BOOT_TIME_AT = {2: 17, 30: 9, 31: 9, 32: 9, 33: 9}


class Claim:
    """One peer's, to one (system id, component id), judged by its first frame after the last one of who had the place.

    While that one is silent nobody gets a second chance, so that numbers cannot be tried out.
    """

    ENOUGH: ClassVar[int] = 3

    __slots__ = ("_clock_is_right", "_expected", "_follows", "frames", "is_refusal_told", "is_told")

    def __init__(self) -> None:
        self._expected: int | None = None
        self._follows: bool | None = None
        self._clock_is_right: bool | None = None
        self.frames = 0
        """So many came since the other one was heard last."""
        self.is_told = self.is_refusal_told = False

    def hear(self, frame: Frame, evidence: tuple[int, bool | None, bool | None]) -> None:
        """One more frame: how far the other one has come, and whether number and clock go on there (None: unknown)."""
        expected, follows, clock_is_right = evidence
        if expected != self._expected:
            self._expected, self.frames, self.is_refusal_told = expected, 0, False
            self._follows, self._clock_is_right = follows, None
        self.frames += 1
        if clock_is_right is not None and self._clock_is_right is not False:
            self._clock_is_right = clock_is_right

    @property
    def goes_on(self) -> bool:
        """Whether it goes on where the other one stopped."""
        return self._follows is not False and self._clock_is_right is True

    @property
    def may_go_on(self) -> bool:
        """Whether it may yet turn out to."""
        return self._follows is not False and self._clock_is_right is not False


def boot_time_ms(frame: Frame) -> int | None:
    """The sender's time since boot that a frame tells, in milliseconds; None if its message has none."""
    begin = _BOOT_TIME_AT.get(frame.message_id)
    return None if begin is None else int.from_bytes(frame.body[begin : begin + 4], "little")
