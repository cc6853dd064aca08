"""Our own HEARTBEAT: what it says, and whether the program still proves that it lives."""

from __future__ import annotations

import logging
import math
from typing import TYPE_CHECKING

from aerokit._internal.values import Snapshot
from aerokit._internal.wording import shown
from aerokit.errors import InvalidArgument
from aerokit.events import HeartbeatPaused, HeartbeatResumed
from aerokit.mavlink.enums import MavAutopilot, MavState, MavType
from aerokit.mavlink.messages import Heartbeat

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.events import Event

BLOCKING_FED_WITHIN_S = 60.0
"""How long a blocking program may make no call before our heartbeat pauses. Longer than programs sleep in flight."""

logger: logging.Logger = logging.getLogger("aerokit")


class OwnHeartbeat(Snapshot):
    """The HEARTBEAT that we send at 1 Hz, and on what condition (https://mavlink.io/en/services/heartbeat.html).

    A vehicle takes whoever sends heartbeats for alive: its failsafe for a lost ground station acts when they stop. So
    they pause when the program hangs: ``fed_within_s`` seconds after its last call, or ``feed()``. None: 60 seconds in
    :mod:`aerokit.sync` and :mod:`aerokit.dronekit`, whose loop runs on a thread of its own; no limit in asyncio, where
    a blocked loop sends nothing anyway. Infinite: no limit. ``type`` is a MAV_TYPE: 6 for a ground station (GCS), 18
    for a companion computer (ONBOARD_CONTROLLER).
    """

    type: int = MavType.GCS.value
    fed_within_s: float | None = None

    def _check(self) -> None:
        if not isinstance(self.type, int) or not 0 <= self.type <= 255:
            raise InvalidArgument(f"type = {shown(self.type)} is not allowed: a MAV_TYPE, 0 to 255")
        limit = self.fed_within_s
        if limit is not None and not (isinstance(limit, (int, float)) and limit >= 1):
            raise InvalidArgument(f"fed_within_s = {shown(limit)} is not allowed: at least 1 second, or None")


class ProofOfLife:
    """When the program last showed that it runs. Any thread may feed it; ``clock`` gives seconds."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock, self._fed_at = clock, clock()
        self.waiting: set[object] = set()
        """The calls that the program waits for just now: it is where it means to be."""

    def feed(self) -> None:
        """The program runs."""
        self._fed_at = self._clock()

    @property
    def idle_s(self) -> float:
        """Seconds since it last showed that; 0 while it waits for a call."""
        return 0.0 if self.waiting else self._clock() - self._fed_at


class HeartbeatSwitch:
    """Decides each second whether our heartbeat is sent, and tells when that changes."""

    def __init__(
        self, settings: OwnHeartbeat, clock: Callable[[], float], publish: Callable[[Event], None]
    ) -> None:
        self.message: Heartbeat = Heartbeat(settings.type, MavAutopilot.INVALID, 0, 0, MavState.ACTIVE, 3)
        self.proof: ProofOfLife = ProofOfLife(clock)
        self._limit_s = settings.fed_within_s
        self._clock, self._publish = clock, publish
        self._paused_at: float | None = None

    def require(self, proof: ProofOfLife, fed_within_s: float) -> None:
        """The program is fed by calls from other threads; ``fed_within_s`` holds unless the program said a limit."""
        self.proof = proof
        self._limit_s = fed_within_s if self._limit_s is None else self._limit_s

    def is_on(self) -> bool:
        """Whether it is to be sent now."""
        idle_s, limit_s = self.proof.idle_s, math.inf if self._limit_s is None else self._limit_s
        now = self._clock()
        if idle_s <= limit_s:
            if self._paused_at is not None:
                self._publish(HeartbeatResumed(now, 0, now - self._paused_at))
                logger.warning("the program makes calls again: our heartbeat is sent again")
                self._paused_at = None
            return True
        if self._paused_at is None:
            self._paused_at = now
            self._publish(HeartbeatPaused(now, 0, idle_s))
            logger.warning(
                "the program has made no call for %.0f s: our heartbeat pauses, so that the vehicle's failsafe for a"
                " lost ground station can act (connect(heartbeat=OwnHeartbeat(fed_within_s=…)) sets the limit)",
                idle_s,
            )
        return False
