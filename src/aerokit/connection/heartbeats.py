"""HEARTBEAT: classification of senders, our own heartbeat, and the state of a link or vehicle."""

from __future__ import annotations

import logging
import math
from typing import TYPE_CHECKING

from aerokit._internal.formatting import short_repr
from aerokit._internal.values import Snapshot
from aerokit.connection.cells import Source
from aerokit.errors import InvalidArgument
from aerokit.events import (
    SILENT_AFTER_S,
    ComponentFound,
    HeartbeatPaused,
    HeartbeatResumed,
    LinkState,
    LinkStateChanged,
    VehicleFound,
)
from aerokit.mavlink.enums import MavAutopilot, MavState, MavType
from aerokit.mavlink.messages import Heartbeat

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.connection.bus import Bus
    from aerokit.connection.cells import StateCell
    from aerokit.events import Event

NON_AUTOPILOT_TYPES = frozenset(
    (
        MavType.GCS,
        MavType.ONBOARD_CONTROLLER,
        MavType.GIMBAL,
        MavType.ADSB,
        MavType.CAMERA,
        MavType.CHARGING_STATION,
        MavType.FLARM,
        MavType.SERVO,
        MavType.ODID,
        MavType.BATTERY,
        MavType.PARACHUTE,
        MavType.LOG,
        MavType.OSD,
        MavType.IMU,
        MavType.GPS,
        MavType.WINCH,
        MavType.ILLUMINATOR,
        MavType.GRIPPER,
    )
)
"""MAV_TYPE values of components that are not autopilots."""


def is_autopilot(heartbeat: Heartbeat) -> bool:
    # Some components set autopilot GENERIC instead of INVALID, so the type is checked as well.
    return heartbeat.autopilot != MavAutopilot.INVALID and heartbeat.type not in NON_AUTOPILOT_TYPES


def discovery_event(
    heartbeat: Heartbeat, at: float, system_id: int, component_id: int
) -> VehicleFound | ComponentFound:
    if is_autopilot(heartbeat):
        return VehicleFound(at, system_id, component_id, heartbeat.type, heartbeat.autopilot)
    return ComponentFound(at, system_id, component_id, heartbeat.type)


BLOCKING_MAX_IDLE_S = 60.0
"""In the blocking API, heartbeats pause after this many seconds without a call. Programs rarely sleep longer."""

logger: logging.Logger = logging.getLogger("aerokit")


class OwnHeartbeat(Snapshot):
    """Settings of the HEARTBEAT that aerokit sends at 1 Hz (https://mavlink.io/en/services/heartbeat.html).

    A vehicle's ground station failsafe acts when heartbeats stop. Heartbeats therefore pause when the program seems to
    hang, i.e. when it has been inactive for ``fed_within_s`` seconds (infinity: never).

    In :mod:`aerokit.sync` and :mod:`aerokit.dronekit`, each call of aerokit counts as activity, and the default (None)
    is 60 s. In asyncio, only ``feed()`` counts. The default there is infinity, because a blocked loop sends nothing
    anyway.

    ``type`` is a MAV_TYPE: 6 for a ground station (GCS), 18 for a companion computer (ONBOARD_CONTROLLER).
    """

    type: int = MavType.GCS.value
    fed_within_s: float | None = None

    def _check(self) -> None:
        if not isinstance(self.type, int) or not 0 <= self.type <= 255:
            raise InvalidArgument(f"type = {short_repr(self.type)} is not allowed: it must be a MAV_TYPE (0 to 255)")
        limit = self.fed_within_s
        if limit is not None and not (isinstance(limit, (int, float)) and limit >= 1):
            raise InvalidArgument(f"fed_within_s = {short_repr(limit)} is not allowed: it must be at least 1, or None")


class ActivityMonitor:
    """Tracks when the program last called aerokit. Thread-safe; ``clock`` returns seconds."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock, self._fed_at = clock, clock()
        self.pending_calls: set[object] = set()
        """Calls that the program is waiting for. While there are pending calls, the program is not idle."""

    def feed(self) -> None:
        self._fed_at = self._clock()

    @property
    def idle_s(self) -> float:
        """Seconds since the last activity. 0 while a call is pending."""
        return 0.0 if self.pending_calls else self._clock() - self._fed_at


class HeartbeatWatchdog:
    """Decides each second whether our heartbeat is sent, and publishes an event when heartbeats pause or continue."""

    def __init__(self, settings: OwnHeartbeat, clock: Callable[[], float], publish: Callable[[Event], None]) -> None:
        self.message: Heartbeat = Heartbeat(
            settings.type,
            MavAutopilot.INVALID,
            base_mode=0,
            custom_mode=0,
            system_status=MavState.ACTIVE,
            mavlink_version=3,
        )
        self.activity: ActivityMonitor = ActivityMonitor(clock)
        self._limit_s = settings.fed_within_s  # None if heartbeats never pause
        self._clock, self._publish = clock, publish
        self._paused_at: float | None = None  # None while heartbeats are sent

    def watch(self, activity: ActivityMonitor, default_limit_s: float) -> None:
        """Pause heartbeats while ``activity`` is idle for longer than the settings allow.

        ``default_limit_s`` is the limit if the settings have none.
        """
        self.activity = activity
        if self._limit_s is None:
            self._limit_s = default_limit_s

    def should_send(self) -> bool:
        idle_s = self.activity.idle_s
        limit_s = math.inf if self._limit_s is None else self._limit_s
        now = self._clock()
        if idle_s <= limit_s:
            if self._paused_at is not None:
                self._publish(HeartbeatResumed(now, system_id=0, paused_s=now - self._paused_at))
                logger.warning("the program is active again: heartbeats are sent again")
                self._paused_at = None
            return True
        if self._paused_at is None:
            self._paused_at = now
            self._publish(HeartbeatPaused(now, system_id=0, idle_s=idle_s))
            logger.warning(
                "the program has not called aerokit for %.0f s (in asyncio: connection.feed()): heartbeats are paused,"
                " so that the vehicle's ground station failsafe can act (set the limit by"
                " connect(heartbeat=OwnHeartbeat(fed_within_s=…)))",
                idle_s,
            )
        return False


class LinkStateTracker:
    """Sets CONNECTED, SILENT or LOST in a cell and publishes changes as events. Times are on the loop's clock."""

    _active_at: float  # set by record_activity()

    def __init__(self, cell: StateCell[LinkState], bus: Bus, *, system_id: int, component_id: int = 0) -> None:
        self._cell, self._bus = cell, bus
        self._source = Source(system_id, component_id, "link")
        self._frames = 0  # number of frames at the last update

    def record_activity(self, at: float) -> None:
        """Record that something was received, which makes the state CONNECTED."""
        self._active_at = at
        if self._cell.latest is not LinkState.CONNECTED:
            self._set(LinkState.CONNECTED, at)

    def update(self, now: float, frames: int) -> None:
        """Update the state. ``frames`` is the total number of frames received."""
        if frames != self._frames:
            self._frames = frames
            self.record_activity(now)
        else:
            self.check(now)

    def check(self, now: float) -> None:
        """Set SILENT if nothing was received for ``SILENT_AFTER_S``."""
        if self._cell.latest is LinkState.CONNECTED and now - self._active_at > SILENT_AFTER_S:
            self._set(LinkState.SILENT, now)

    def mark_lost(self, now: float, *, publish: bool = True) -> None:
        """Set LOST. Use ``publish=False`` if the program itself closed the link."""
        self._set(LinkState.LOST, now, publish=publish)

    def _set(self, state: LinkState, now: float, *, publish: bool = True) -> None:
        before = self._cell.latest
        if before is not state:
            self._cell.set(state, self._source)
            if before is not None and publish:  # The first state is no change.
                self._bus.publish(LinkStateChanged(now, self._source.system_id, before, state))
