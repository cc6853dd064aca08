"""Waits for the end of operations, and fails as soon as an operation can no longer succeed."""

from __future__ import annotations

import asyncio
import math
from typing import TYPE_CHECKING, Any

from aerokit._internal import geo
from aerokit._internal.arguments import check_range
from aerokit.errors import HeartbeatTimeout, InvalidArgument, OperationRejected, OperationTimeout
from aerokit.mavlink.enums import MavFrame, MavLandedState, MavSeverity, MavType, MavVtolState
from aerokit.position import Position
from aerokit.vehicle.state.telemetry import altitude_amsl, height_above_home

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from typing_extensions import Self

    from aerokit.connection.cells import StateCell
    from aerokit.vehicle.session.session import VehicleSession

POLL_INTERVAL_S = 0.25
"""The state is evaluated at least this often (in seconds), even while the vehicle is silent."""

MAX_SILENCE_S = 10.0
"""Default number of seconds without a heartbeat after which an operation fails."""

POSITION_MAX_AGE_S = 2.0
"""Maximum age in seconds of a position that counts as the vehicle's present position."""

STALL_TIMEOUT_S, STALL_DISTANCE_M = 12.0, 0.3
"""A vehicle that moves less than STALL_DISTANCE_M within STALL_TIMEOUT_S seconds counts as not moving."""

FALL_SINK_M_S = 3.0
"""Speed from which a descent is considered a fall; autopilots descend at 1.5 m/s by default."""

FALL_EVIDENT_S = 0.5
"""After falling for this time, a vehicle sinks faster than ``FALL_SINK_M_S``, even with air resistance."""

HIT_GROUND = "the vehicle hit the ground"
"""Beginning of each clause about an impact."""

FALL_STOP_S = 1.5
"""A vehicle on the ground has fallen if it came to rest at most this many seconds after a fast descent."""


async def await_progress(
    session: VehicleSession,
    operation: str,
    *,
    is_done: Callable[[], bool],
    failure_reason: Callable[[], str | None],
    describe: Callable[[], str],
    timeout: float | None,
    max_silence_s: float | None = MAX_SILENCE_S,
    held_for: float = 0.0,
    stall_reason: Callable[[], str | None] | None = None,
    at_positions: bool = True,
) -> None:
    """Return when ``is_done()`` has been true for ``held_for`` seconds.

    The functions are called at least every ``POLL_INTERVAL_S``, and whenever the mode, the arming or the landed state
    changes; with ``at_positions`` also at each new position. ``operation`` is the name for error texts.

    Raises:
        OperationRejected: ``failure_reason()`` returned a reason why the operation cannot succeed.
        HeartbeatTimeout: the vehicle was silent for ``max_silence_s`` seconds (None: silence is ignored).
        OperationTimeout: ``timeout`` seconds have passed, or ``stall_reason()`` reports that the vehicle does not move;
            the error text includes ``describe()``.
        ConnectionClosed, LinkLost: the connection or the vehicle's `async with` block ended.
    """
    started = session.connection.now()
    telemetry = session.telemetry
    cells: list[StateCell[Any]] = [telemetry.mode, telemetry.armed, telemetry.landed_state]
    if at_positions:
        cells.append(telemetry.position)
    done_since: float | None = None
    with ChangeSignal(session, *cells) as changes:
        while True:
            now = session.connection.now()
            session.end.raise_if_ended()
            if not is_done():
                done_since = None
            elif done_since is None:
                done_since = now
            if done_since is not None and now - done_since >= held_for:
                return
            if reason := failure_reason():
                reason += _height_when_disarmed(session)
                raise OperationRejected(f"{operation}: {reason}", reasons=_reasons(session, reason, started))
            if max_silence_s is not None and session.watch.silent_for_s > max_silence_s:
                raise HeartbeatTimeout(f"{operation}: the vehicle is silent; {session.describe_link()}")
            if timeout is not None and now - started >= timeout:
                raise OperationTimeout(
                    f"{operation}: not done within {timeout:g} s; {describe()}; {session.describe_link()}"
                )
            stall = None if stall_reason is None else stall_reason()
            if stall:
                raise OperationTimeout(f"{operation}: {stall}; {describe()}; {session.describe_link()}")
            await changes.next(POLL_INTERVAL_S)


def _reasons(session: VehicleSession, reason: str, since: float) -> tuple[str, ...]:
    texts = session.telemetry.texts_since(since)
    is_impact = reason.startswith(HIT_GROUND)  # Informational texts do not explain why the vehicle hit the ground.
    return tuple(text.text for text in texts if not is_impact or text.severity < MavSeverity.INFO)


def _height_when_disarmed(session: VehicleSession) -> str:
    height_m = height_above_home(session.telemetry)
    is_falling = session.telemetry.is_confirmed_disarmed and height_m is not None and height_m > 1.0
    return f" {height_m:.1f} m above home" if is_falling else ""


class ChangeSignal:
    """Wakes a waiter when any of these cells changes, or the session ends."""

    def __init__(self, session: VehicleSession, *cells: StateCell[Any], every_arrival: bool = False) -> None:
        self._session, self._cells, self._every_arrival = session, cells, every_arrival
        self._changed = asyncio.Event()
        self._detach_callbacks: list[Callable[[], None]] = []

    def __enter__(self) -> Self:
        wake = self._changed.set
        detach_cells = [cell.observe(lambda *_: wake(), every_arrival=self._every_arrival) for cell in self._cells]
        self._detach_callbacks = [*detach_cells, self._session.end.on_end(lambda _: wake())]
        return self

    def __exit__(self, *_: object) -> None:
        for detach in self._detach_callbacks:
            detach()

    async def next(self, at_most_s: float) -> None:
        """Wait for the next change, at most ``at_most_s`` seconds."""
        self._changed.clear()
        # No cancel scope is used, because on Python 3.10 an expiring scope swallows a cancellation in the same
        # iteration of the event loop.
        timer = asyncio.get_running_loop().call_later(at_most_s, self._changed.set)
        try:
            await self._changed.wait()
        finally:
            timer.cancel()


class StallDetector:
    """Detects that a vehicle does not move although it has accepted an order to move.

    ``STALL_TIMEOUT_S`` leaves the vehicle time to turn or to spool up first. Without recent positions, the detector
    reports nothing.
    """

    def __init__(self, session: VehicleSession) -> None:
        self._session = session
        # The place where the vehicle stands still, and the time at which it arrived there.
        self._place: Position | None = None
        self._there_since = -math.inf
        # The highest place and the fastest descent so far, for the error text.
        self._max_altitude_m = -math.inf
        self._max_sink_m_s = 0.0
        self._sank_fast_at = -math.inf

    @property
    def follows_fast_descent(self) -> bool:
        """True if the vehicle stands still, and sank fast right before that."""
        return self._place is not None and self._there_since - self._sank_fast_at <= FALL_STOP_S

    def __call__(self, timeout_s: float = STALL_TIMEOUT_S) -> str | None:
        """Return an error text if the vehicle has not moved for ``timeout_s`` seconds, otherwise None."""
        now, cell = self._session.connection.now(), self._session.telemetry.position
        here = cell.latest
        if here is None or cell.age > POSITION_MAX_AGE_S:
            self._place = None
        elif self._place is None or _approximate_distance_m(here, self._place) > STALL_DISTANCE_M:
            self._place, self._there_since = here, now
            self._record_descent(here)
        elif now - self._there_since >= timeout_s:
            still_for_s, descent = now - self._there_since, self._describe_descent(here)
            return f"the vehicle has not moved for {still_for_s:.0f} s{descent}"
        return None

    def _record_descent(self, here: Position) -> None:
        velocity = self._session.telemetry.velocity.latest
        if here.altitude_amsl_m is not None:
            self._max_altitude_m = max(self._max_altitude_m, here.altitude_amsl_m)
        sink_m_s = 0.0 if velocity is None else velocity.down_m_s
        self._max_sink_m_s = max(self._max_sink_m_s, sink_m_s)
        if sink_m_s >= FALL_SINK_M_S:
            self._sank_fast_at = self._there_since

    def _describe_descent(self, here: Position) -> str:
        altitude_m = here.altitude_amsl_m
        if altitude_m is None or self._max_sink_m_s < FALL_SINK_M_S:
            return ""
        descended_m = self._max_altitude_m - altitude_m
        text = f", after it descended {descended_m:.1f} m at up to {self._max_sink_m_s:.1f} m/s"
        return text if descended_m > 1.0 else ""


def is_on_wings(session: VehicleSession) -> bool:
    vtol_state = session.telemetry.vtol_state.latest
    if vtol_state:  # Only a VTOL reports a state other than MAV_VTOL_STATE_UNDEFINED (0).
        return vtol_state == MavVtolState.FW
    return session.vehicle_type == MavType.FIXED_WING


# A vehicle circles a place if it has flown HALF_CIRCLE_DEG around it, and its largest distance was at most
# CIRCLE_DISTANCE_RATIO times its smallest. A straight flight past a place keeps this ratio only for 80°.
CIRCLE_DISTANCE_RATIO, HALF_CIRCLE_DEG = 1.3, 180.0
# Closer to a place than this, a vehicle is about to arrive, and does not count as circling.
MIN_CIRCLE_RADIUS_M = 20.0
# A plane that circles a place counts as arrived within this height above or below it.
CIRCLE_HEIGHT_M = 20.0


class CircleDetector:
    """Detects that a plane circles a place. A plane cannot stop, so this counts as its arrival.

    A copter or boat never counts as circling: it could stop at the place, so if it circles the place, it has missed it.

    Every radius from `MIN_CIRCLE_RADIUS_M` counts. It is not compared with the radius in the vehicle's parameters,
    because planes fly larger circles at high speed or altitude, or to limit their bank angle.
    """

    def __init__(self, session: VehicleSession) -> None:
        self._session = session
        self._min_m = self._max_m = 0.0  # smallest and largest distance since the turn began; 0 before any turn
        self._bearing_deg = 0.0
        self._turned_deg = 0.0  # angle by which the bearing from the place has changed, positive clockwise
        self._circle_radius_m = -math.inf  # −inf until the first half circle is complete

    def circles(self, place: Position) -> bool:
        """Record the vehicle's position. Return True if it is a plane that circles ``place`` at about its altitude."""
        here = self._session.telemetry.position.latest
        if here is None or not is_on_wings(self._session):
            return False
        coordinates = place.latitude_deg, place.longitude_deg, here.latitude_deg, here.longitude_deg
        distance_m, bearing_deg = geo.distance_m(*coordinates), geo.bearing_deg(*coordinates)
        self._min_m, self._max_m = min(self._min_m, distance_m), max(self._max_m, distance_m)
        if self._min_m < MIN_CIRCLE_RADIUS_M or self._max_m > CIRCLE_DISTANCE_RATIO * self._min_m:
            self._min_m = self._max_m = distance_m
            self._turned_deg = 0.0
        else:
            self._turned_deg += math.remainder(bearing_deg - self._bearing_deg, 360.0)
        self._bearing_deg = bearing_deg
        if abs(self._turned_deg) >= HALF_CIRCLE_DEG:
            self._circle_radius_m = self._max_m
        is_on_circle = distance_m <= CIRCLE_DISTANCE_RATIO * self._circle_radius_m
        return is_on_circle and abs(VehiclePosition.height_above(here, place)) <= CIRCLE_HEIGHT_M


def _approximate_distance_m(here: Position, place: Position) -> float:
    """Return the horizontal distance, exact to one per cent, plus the vertical distance."""
    # An exact distance takes ten times as long to compute.
    north_m = (here.latitude_deg - place.latitude_deg) * _METRES_PER_DEGREE
    east_at_equator_m = math.remainder(here.longitude_deg - place.longitude_deg, 360.0) * _METRES_PER_DEGREE
    horizontal_m = math.hypot(north_m, east_at_equator_m * math.cos(math.radians(here.latitude_deg)))
    if here.altitude_amsl_m is None or place.altitude_amsl_m is None:
        return horizontal_m
    return horizontal_m + abs(here.altitude_amsl_m - place.altitude_amsl_m)


_METRES_PER_DEGREE = 111_132.0
"""Mean length of one degree of latitude."""

MAX_METRES_PER_DEGREE = 112_000
"""Upper limit in metres for one degree of latitude, or of longitude at the equator."""

MAX_DISTANCE_M = 100_000.0
"""A place farther away than this counts as a mistake, unless the caller raises the limit.

Typical mistakes are swapped coordinates and a lost sign.
"""


CIRCLE_MARGIN = 1.3
"""A vehicle that was ordered to circle counts as arrived within this multiple of the ordered radius."""


class VehiclePosition:
    """Distances and altitudes from the vehicle's reported position."""

    def __init__(self, session: VehicleSession) -> None:
        self._telemetry, self._autopilot = session.telemetry, session.autopilot
        # Radius of the circle that the vehicle was ordered to fly; 0 if it was not ordered to circle.
        self._circle_radius_m = 0.0
        session.telemetry.mode.observe(lambda *_: self.record_circle_radius(0.0))

    def record_circle_radius(self, radius_m: float) -> None:
        # ArduPlane keeps this radius for further places until it leaves GUIDED.
        self._circle_radius_m = radius_m

    @property
    def arrival_radius_m(self) -> float:
        """Distance from the target at which the vehicle counts as arrived."""
        return max(self._autopilot.arrival_radius_m, CIRCLE_MARGIN * self._circle_radius_m)

    def distance_to(self, target: Position) -> float:
        """Return the distance to ``target`` in metres; infinite while the position is unknown.

        The distance is three-dimensional if the vehicle's position and the target have an altitude of the same kind.
        Otherwise it is measured along the ground.
        """
        here = self._telemetry.position.latest
        if here is None:
            return math.inf
        along_ground_m = geo.distance_m(
            here.latitude_deg, here.longitude_deg, target.latitude_deg, target.longitude_deg
        )
        return math.hypot(along_ground_m, self.height_above(here, target))

    def is_at(self, place: Position, circle: CircleDetector) -> bool:
        """Return True if the vehicle has reached ``place``. ``circle`` detects a plane that circles it."""
        return circle.circles(place) or self.remaining_distance(place) <= self.arrival_radius_m

    def check_reach(
        self, name: str, places: Iterable[Position | None], max_distance_m: float, *, are_items: bool = False
    ) -> None:
        """Raise InvalidArgument for a place farther away than ``max_distance_m``.

        While the vehicle's position is unknown, all places are accepted. ``name`` is the caller's argument, for error
        texts. With ``are_items``, the places are those of mission items, None for an item without a place.
        """
        check_range("max_distance_m", max_distance_m, 0, math.inf, above=True)
        here = self._telemetry.position.latest
        if here is None:
            return
        for index, place in enumerate(places):
            if place is None:
                continue
            degrees = abs(place.latitude_deg - here.latitude_deg) + abs(place.longitude_deg - here.longitude_deg)
            # The upper limit of the distance is compared first, because the exact distance is slow to compute and a
            # mission may have thousands of places.
            max_possible_m = degrees * MAX_METRES_PER_DEGREE + abs(self.height_above(here, place))
            if max_possible_m < max_distance_m:
                continue
            distance_m = self.distance_to(place)
            if distance_m > max_distance_m:
                where = f"{name}, item {index}" if are_items else name
                raise InvalidArgument(
                    f"{where} = {place.latitude_deg:.7f}, {place.longitude_deg:.7f} is not allowed: the place is"
                    f" {distance_m:,.0f} m away, more than max_distance_m = {max_distance_m:,.0f}; nothing was sent."
                    " Pass a greater max_distance_m to allow this place"
                )

    def remaining_distance(self, target: Position) -> float:
        """Return the distance to ``target`` in metres; for ground vehicles the horizontal one."""
        if self._autopilot.is_surface_vehicle:  # The altitude of such a vehicle has no fixed origin.
            return self.distance_to(Position(target.latitude_deg, target.longitude_deg))
        return self.distance_to(target)

    @staticmethod
    def height_above(here: Position, target: Position) -> float:
        """Return how many metres ``here`` is above ``target``; 0 without altitudes of the same kind."""
        for here_m, target_m in (
            (here.altitude_relative_m, target.altitude_relative_m),
            (here.altitude_amsl_m, target.altitude_amsl_m),
        ):
            if here_m is not None and target_m is not None:
                return here_m - target_m
        return 0.0

    def was_received_since(self, started: float) -> bool:
        position = self._telemetry.position
        return position.updated_at >= started and position.age <= POSITION_MAX_AGE_S

    def altitude_relative(self) -> float:
        """Return the altitude above home in metres; −inf while unknown."""
        altitude = height_above_home(self._telemetry)
        return -math.inf if altitude is None else altitude

    def altitude_amsl(self) -> float:
        """Return the altitude above mean sea level in metres; −inf while unknown."""
        altitude = altitude_amsl(self._telemetry)
        return -math.inf if altitude is None else altitude

    def home_altitude(self) -> float:
        """Return home's altitude above mean sea level in metres. Raises ValueUnknownError if it is unknown."""
        return self._telemetry.home.value.altitude_amsl_m

    def global_target(self, target: Position, name: str = "target") -> tuple[int, int, float, MavFrame]:
        """Convert a target to latitude and longitude in 1e-7 degrees, altitude in metres, and frame of the altitude.

        If the target has both altitudes, the relative one counts. If it has none, the vehicle's present altitude
        counts. ``name`` is the caller's argument, for error texts.
        """
        relative_m, amsl_m = target.altitude_relative_m, target.altitude_amsl_m
        if relative_m is None and amsl_m is None:
            relative_m = self._telemetry.position.fresh(POSITION_MAX_AGE_S).altitude_relative_m
        is_relative = relative_m is not None
        altitude = relative_m if relative_m is not None else amsl_m
        if altitude is None:
            raise InvalidArgument(
                f"{name} = {target} is not allowed: the {name} has no altitude, and the vehicle's altitude above home"
                f" is unknown; give the {name} altitude_relative_m or altitude_amsl_m"
            )
        check_range("altitude", altitude, -12_000, 100_000)
        # PX4 accepts only altitudes above mean sea level, so home must be known.
        if is_relative and not self.accepts_relative_altitude:
            altitude += self.home_altitude()
            is_relative = False
        frame = MavFrame.GLOBAL_RELATIVE_ALT_INT if is_relative else MavFrame.GLOBAL_INT
        return round(target.latitude_deg * 1e7), round(target.longitude_deg * 1e7), altitude, frame

    def with_sent_altitude(self, target: Position) -> Position:
        """Return the target with the altitude that aerokit sends; see :meth:`global_target`.

        PX4 gets an altitude above mean sea level. It keeps this altitude when it later corrects the altitude of home,
        as it does in the first two minutes of a flight (HomePosition.cpp).
        """
        if target.altitude_relative_m is None or self.accepts_relative_altitude:
            return target
        altitude_m = self.home_altitude() + target.altitude_relative_m
        return target.replace(altitude_relative_m=None, altitude_amsl_m=altitude_m)

    def with_amsl_altitude(self, target: Position) -> Position:
        """Return the target with its altitude above mean sea level, which needs a known home; otherwise unchanged.

        Call this when the vehicle has just accepted the target. ArduPilot also converts the altitude at this time, and
        keeps it when home moves later (ArduCopter/mode_guided.cpp, set_destination; GCS_MAVLink_Plane.cpp,
        handle_command_int_do_reposition).
        """
        position, home = self._telemetry.position, self._telemetry.home
        home_m = None if home.latest is None else home.latest.altitude_amsl_m
        if position.latest is not None and position.updated_at > home.updated_at:  # `home` may be outdated.
            amsl_m, relative_m = position.latest.altitude_amsl_m, position.latest.altitude_relative_m
            if amsl_m is not None and relative_m is not None:
                home_m = amsl_m - relative_m
        if target.altitude_relative_m is None or home_m is None:
            return target
        return target.replace(altitude_relative_m=None, altitude_amsl_m=home_m + target.altitude_relative_m)

    def command_int_place(self, target: Position, name: str = "target") -> dict[str, Any]:
        """Return the target as arguments of a COMMAND_INT; see :meth:`global_target`."""
        latitude, longitude, altitude, frame = self.global_target(target, name)
        return {"frame": frame, "x": latitude, "y": longitude, "z": altitude}

    def is_on_ground(self) -> bool:
        landed = self._telemetry.landed_state
        can_fly = self._autopilot.mode_for("take_off", is_vtol=self._telemetry.is_vtol) is not None
        return can_fly and landed.latest == MavLandedState.ON_GROUND and landed.age <= POSITION_MAX_AGE_S

    def check_flying(self, operation: str) -> None:
        """Raise OperationRejected if the vehicle is disarmed or on the ground."""
        if not self._telemetry.is_armed:
            raise OperationRejected(f"{operation}: the vehicle is not armed; nothing was sent")
        if self.is_on_ground():
            raise OperationRejected(
                f"{operation}: the vehicle is on the ground: call take_off() first; nothing was sent"
            )

    @property
    def accepts_relative_altitude(self) -> bool:
        return self._autopilot.reposition is None or self._autopilot.reposition.relative_altitude
