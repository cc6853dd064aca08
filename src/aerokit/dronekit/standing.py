"""Which orders may be sent again when no answer comes: not those that others have overruled since."""

from __future__ import annotations

import contextlib
import itertools
import math
import time
from collections import deque
from typing import TYPE_CHECKING, Any

from aerokit.errors import CommandTimeout
from aerokit.mavlink.messages import Heartbeat
from aerokit.runtime.components import is_autopilot

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator

    from aerokit.mavlink.message import Message
    from aerokit.mavlink.messages import CommandAck
    from aerokit.vehicle.vehicle import Vehicle

__all__ = ["Given", "Standing", "until_answered"]

ARMED = 128
OWN_MODES_S = 10.0
"""A mode that the program ordered so long ago may be told only now: that is nobody who takes over."""
CHANGES_BY_COMMAND: dict[int, tuple[str, ...]] = {
    **dict.fromkeys((20, 21, 84, 85, 185, 252, 300), ("mode", "motion")),
    **dict.fromkeys((16, 17, 18, 19, 22, 34, 192, 193), ("motion",)),
    176: ("mode", "motion"),
    400: ("arm",),
}
"""MAV_CMD → what a program changes that sends it by itself."""
CHANGES_BY_MESSAGE: dict[str, tuple[str, ...]] = {
    "SET_MODE": ("mode", "motion"),
    **dict.fromkeys(
        (
            "SET_ATTITUDE_TARGET",
            "SET_POSITION_TARGET_LOCAL_NED",
            "SET_POSITION_TARGET_GLOBAL_INT",
            "MISSION_SET_CURRENT",
        ),
        ("motion",),
    ),
}
GUIDED_ITEM = (2, 3)
"""MISSION_ITEM.current of one that is flown to at once."""


class Given:
    """The orders that a program has given so far: the newest of those about ``mode``, ``motion`` and ``arm`` counts."""

    def __init__(self) -> None:
        self._numbers = itertools.count(1)
        self._newest: dict[str, int] = {}
        self._modes: deque[tuple[float, int]] = deque(maxlen=16)

    def order(
        self, subject: str, *overruled: str, mode: int | None = None, armed: bool | None = None
    ) -> Standing:
        """A new one, which overrules the older ones about ``subject`` and ``overruled``; from any thread.

        ``mode`` (HEARTBEAT.custom_mode) and ``armed`` are its effects.
        """
        number = self._note((subject, *overruled))
        own_modes = {each for at, each in tuple(self._modes) if at > time.monotonic() - OWN_MODES_S}
        if mode is not None:
            self._modes.append((time.monotonic(), mode))
        return Standing(lambda: self._newest[subject] == number, own_modes, mode, armed)

    def note(self, message: Message) -> None:
        """The program sends a message by itself."""
        subjects = CHANGES_BY_MESSAGE.get(message.NAME, ())
        fields: Any = message
        if message.NAME in ("COMMAND_LONG", "COMMAND_INT"):
            subjects = CHANGES_BY_COMMAND.get(int(fields.command), ())
        elif message.NAME in ("MISSION_ITEM", "MISSION_ITEM_INT") and fields.current in GUIDED_ITEM:
            subjects = ("motion",)
        if subjects:
            self._note(subjects)

    def _note(self, subjects: tuple[str, ...]) -> int:
        number = next(self._numbers)
        for subject in subjects:
            self._newest[subject] = number
        return number


class Standing:
    """Whether one order still stands: its effect has not been told yet, no newer one overrules it, and nobody else,
    a pilot or a failsafe, has changed the mode since.
    """

    def __init__(
        self, is_newest: Callable[[], bool], own_modes: set[int], mode: int | None, armed: bool | None
    ) -> None:
        self._is_newest, self._own_modes = is_newest, own_modes
        self._mode, self._armed = mode, armed
        self._told: tuple[int, bool] | None = None
        self.is_done = False
        """Whether HEARTBEAT has told its effect: a change to it."""
        self._is_taken_over = False
        self.told_at = -math.inf
        """When HEARTBEAT came last."""

    def holds(self) -> bool:
        """Whether it may be sent again."""
        return not self.end

    @property
    def end(self) -> str:
        """Why it may not be sent again, as a clause; empty while it may."""
        if self.is_done:
            return "its effect was told"
        if not self._is_newest():
            return "a newer order was given meanwhile"
        return "the vehicle was put into another mode meanwhile" if self._is_taken_over else ""

    @contextlib.contextmanager
    def watching(self, vehicle: Vehicle) -> Iterator[None]:
        """Look at the vehicle's heartbeats for the time of the block (loop thread)."""
        latest = vehicle.connection.heard.get((vehicle.system_id, vehicle.component_id))
        if latest is not None and is_autopilot(latest):
            self._told = _state(latest)

        def take(heartbeat: Heartbeat) -> None:
            frame = heartbeat.received_frame
            if frame is not None and frame.component_id == vehicle.component_id and is_autopilot(heartbeat):
                self.told_at = frame.received_at
                self._take(*_state(heartbeat))

        detach = vehicle.connection.bus.attach(Heartbeat, take, system_id=vehicle.system_id)
        try:
            yield
        finally:
            detach()

    def _take(self, mode: int, armed: bool) -> None:
        before, self._told = self._told, (mode, armed)
        if before is None:
            return
        if before[0] != mode:
            if mode == self._mode:
                self.is_done = True
            elif self._armed is not False and mode not in self._own_modes:
                self._is_taken_over = True
        if before[1] != armed and armed is self._armed:
            self.is_done = True


async def until_answered(sending: Awaitable[CommandAck], standing: Standing) -> None:
    """Await a command of an order: its answer, or that its effect was told.

    Raises:
        CommandRejected: the vehicle refused.
        CommandTimeout: there was no answer; the text says so when it was not sent again for a reason.
    """
    try:
        await sending
    except CommandTimeout:
        if not standing.is_done:
            raise


def _state(heartbeat: Heartbeat) -> tuple[int, bool]:
    return heartbeat.custom_mode, bool(heartbeat.base_mode & ARMED)
