"""Position estimate of a simulated ArduPilot: GPS, estimator, origin and home, rally points, the path of SMART_RTL."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from aerokit.mavlink.enums import EkfStatusFlags as Ekf
from aerokit.mavlink.enums import GpsFixType, MavMissionType, MavSeverity
from aerokit.sim.ardupilot.external import ArduPilotExternal
from aerokit.sim.ardupilot.host import ArduPilotHost
from aerokit.sim.missions import distance_to_segment, dot_product, point_along, vector_between
from aerokit.sim.motion import GlobalPoint, LocalFrame, Ned

# These bits are plain integers, because every tick tests them and operators of enum flags are slow.
_ATTITUDE, _POS_HORIZ_ABS, _POS_VERT_ABS = map(int, (Ekf.ATTITUDE, Ekf.POS_HORIZ_ABS, Ekf.POS_VERT_ABS))
_DEAD_RECKONING = int(Ekf.ATTITUDE | Ekf.VELOCITY_VERT | Ekf.POS_VERT_ABS)
_ATTITUDE_ONLY = int(_DEAD_RECKONING | Ekf.VELOCITY_HORIZ | Ekf.CONST_POS_MODE)
_WITH_POSITION = int(
    _DEAD_RECKONING | Ekf.VELOCITY_HORIZ | Ekf.POS_HORIZ_REL | Ekf.POS_HORIZ_ABS
    | Ekf.PRED_POS_HORIZ_REL | Ekf.PRED_POS_HORIZ_ABS
)  # fmt: skip
_RELATIVE = int(_DEAD_RECKONING | Ekf.VELOCITY_HORIZ | Ekf.POS_HORIZ_REL | Ekf.PRED_POS_HORIZ_REL)
_EXTERNAL_NAVIGATION = 6  # value of EK3_SRC1_POSXY
_POSITION_TIMEOUT_S, _AIDING_TIMEOUT_S = 7.0, 15.0
_CHECK_INTERVAL_S = 0.1


class ArduPilotNavigation:
    """State of the GPS receiver and the estimator.

    The state depends on the boot timeline, ``faults.gps_lost``, SIM_GPS1_ENABLE and EK3_SRC1_POSXY. Positions are in
    the world frame, whose origin is the power-on location.
    """

    def __init__(self, vehicle: ArduPilotHost, external: ArduPilotExternal) -> None:
        self._vehicle, self._external = vehicle, external
        self.frame: LocalFrame = vehicle.frame
        self.flags: int | None = None  # EKF_STATUS_FLAGS; None until the estimator runs.
        self.fix_type: int = GpsFixType.NO_GPS
        self.is_gps_detected: bool = False
        self.is_healthy: bool = False
        self.origin: Ned | None = None
        self.home: Ned | None = None
        self.home_is_locked: bool = False
        self._gps_lost_at = math.nan  # NaN while GPS is good
        self._watches_gps = False  # True from the time at which the first fix is expected

    def start(self) -> None:
        timeline, call_later = self._vehicle.timeline, self._vehicle.call_later
        # The estimator reports its flags as uninitialised for the second half of its start.
        uninitialized_at = timeline.ready + 0.5 * (timeline.estimator_active - timeline.ready)
        call_later(uninitialized_at, lambda: self._set_flags(int(Ekf.UNINITIALIZED)))
        call_later(timeline.estimator_active, self._activate)
        call_later(timeline.tilt_aligned, lambda: self._report_cores("tilt alignment complete"))
        call_later(timeline.yaw_aligned, self._align)
        call_later(timeline.gps_detected, self._detect_gps)
        call_later(timeline.gps_fix, self._acquire_fix)
        call_later(timeline.origin_set, self._set_origin_when_possible)
        call_later(timeline.healthy, self._become_healthy)
        call_later(timeline.position_good, self._use_gps_when_possible)
        watch_at = min(timeline.yaw_aligned, timeline.gps_fix)
        call_later(watch_at, lambda: self._vehicle.every(_CHECK_INTERVAL_S, self._check))

    @property
    def has_position(self) -> bool:
        """True while the estimated position is good enough to navigate."""
        return self.flags is not None and self.flags & _POS_HORIZ_ABS != 0

    @property
    def gps_is_lost(self) -> bool:
        return self._vehicle.faults.gps_lost or not self._vehicle.parameters["SIM_GPS1_ENABLE"]

    @property
    def has_attitude(self) -> bool:
        return self.flags is not None and self.flags & _ATTITUDE != 0

    @property
    def has_altitude(self) -> bool:
        return self.flags is not None and self.flags & _POS_VERT_ABS != 0

    @property
    def position(self) -> GlobalPoint | None:
        if self.fix_type < GpsFixType.TYPE_3D_FIX and self.origin is None:
            return None
        return self.frame.to_global(*self._vehicle.motion.place)

    @property
    def altitude_above_home(self) -> float:
        """Metres above home, or above the ground while home is not set."""
        motion = self._vehicle.motion
        _, _, home_down = self._vehicle.home_or_ground
        return home_down - motion.down

    def local(self, point: Ned) -> Ned:
        """Convert a point of the world frame to the estimator's frame."""
        north, east, down = point
        origin_north, origin_east, origin_down = self.origin or (0.0, 0.0, 0.0)
        return (north - origin_north, east - origin_east, down - origin_down)

    def world(self, local: Ned) -> Ned:
        """Convert a point of the estimator's frame to the world frame."""
        north, east, down = local
        origin_north, origin_east, origin_down = self.origin or (0.0, 0.0, 0.0)
        return (north + origin_north, east + origin_east, down + origin_down)

    def set_home(self, point: Ned, *, lock: bool) -> None:
        """Set home and broadcast its position. With ``lock``, arming no longer moves home."""
        self.home = point
        self.home_is_locked = self.home_is_locked or lock
        self._vehicle.missions.commands.add_home()
        self._vehicle.call_later(0.0, self._vehicle.send_home)

    def set_origin(self, point: Ned) -> bool:
        """Set the estimator's origin. Return False if the origin is already set or the vehicle is still booting."""
        if self.origin is not None or not self._vehicle.is_initialised:
            return False
        self.origin = point
        self._report_cores("origin set")
        if self._vehicle.KIND != "sub":
            _, _, down = point
            self._vehicle.info(f"Field Elevation Set: {self.frame.origin.altitude_m - down:.0f}m")
        return True

    @property
    def uses_external_navigation(self) -> bool:
        return self._vehicle.parameters.get("EK3_SRC1_POSXY", 0.0) == _EXTERNAL_NAVIGATION

    def _check(self) -> None:
        self._check_external()
        if self._watches_gps:
            self._check_gps()

    def _check_external(self) -> None:
        if not self.uses_external_navigation or not self.has_attitude:
            return
        if self._external.navigation_age_s > _POSITION_TIMEOUT_S:
            self.flags = _ATTITUDE_ONLY
            return
        if self.flags == _ATTITUDE_ONLY:
            self._report_cores("is using external nav data")
        self.flags = _RELATIVE if self.origin is None else _WITH_POSITION
        if self.origin is not None and self.home is None:
            self._set_first_home()

    def _set_flags(self, flags: int) -> None:
        self.flags = flags

    def _report_cores(self, text: str) -> None:
        for core in (0, 1):
            self._vehicle.info(f"EKF3 IMU{core} {text}")

    def _activate(self) -> None:
        self.flags = 0
        self._report_cores("initialised")
        if not self._vehicle.timeline.uses_dcm_until_gps:
            self._vehicle.info("AHRS: EKF3 active")

    def _align(self) -> None:
        self.flags = _ATTITUDE_ONLY
        self._report_cores("MAG0 initial yaw alignment complete")

    def _detect_gps(self) -> None:
        if not self._vehicle.parameters.get("GPS1_TYPE", 1.0):
            return
        self.is_gps_detected = True
        self.fix_type = GpsFixType.NO_FIX
        self._vehicle.info("GPS 1: probing for u-blox at 230400 baud")
        self._vehicle.info("GPS 1: detected u-blox")

    def _acquire_fix(self) -> None:
        if self.is_gps_detected and not self.gps_is_lost:
            self.fix_type = GpsFixType.RTK_FIXED
            if self._vehicle.timeline.uses_dcm_until_gps:
                self._set_first_home()
        self._watches_gps = True

    def _set_origin_when_possible(self) -> None:
        if self.fix_type < GpsFixType.TYPE_3D_FIX:
            self._vehicle.call_later(1.0, self._set_origin_when_possible)
            return
        self.set_origin(self._vehicle.motion.place)
        if not self.home_is_locked:
            self._set_first_home()

    def _set_first_home(self) -> None:
        self.home = self._vehicle.motion.place
        self._vehicle.missions.commands.add_home()
        self._vehicle.send_home()

    def _become_healthy(self) -> None:
        self.is_healthy = True

    def _use_gps_when_possible(self) -> None:
        if self.flags == _WITH_POSITION:  # `_check_gps` has set the flags already.
            return
        has_fix = self.fix_type >= GpsFixType.TYPE_3D_FIX
        can_use_gps = has_fix and self.origin is not None and not self.uses_external_navigation
        if not can_use_gps:
            self._vehicle.call_later(1.0, self._use_gps_when_possible)
            return
        self.flags = _WITH_POSITION
        self._report_cores("is using GPS")
        if self._vehicle.timeline.uses_dcm_until_gps:
            self._vehicle.info("AHRS: EKF3 active")

    def _check_gps(self) -> None:
        if self.gps_is_lost or not self.is_gps_detected:
            self._follow_gps_loss()
        elif self.fix_type < GpsFixType.TYPE_3D_FIX:
            self._gps_lost_at = math.nan
            self.fix_type = GpsFixType.RTK_FIXED
            must_use_gps = not self.has_position and not self.uses_external_navigation
            if must_use_gps and self.origin is not None:
                self._use_gps_when_possible()

    def _follow_gps_loss(self) -> None:
        if math.isnan(self._gps_lost_at):
            self._gps_lost_at = self._vehicle.now
            self.fix_type = GpsFixType.NO_FIX
            return
        lost_for = self._vehicle.now - self._gps_lost_at
        if self.uses_external_navigation:  # External navigation provides the position, even without GPS.
            return
        if self.has_position and lost_for >= _POSITION_TIMEOUT_S:
            # On the ground, the estimator still knows the velocity.
            velocity_flag = Ekf.VELOCITY_HORIZ if self._vehicle.is_landed else 0
            self.flags = _DEAD_RECKONING | velocity_flag
        elif self.flags != _ATTITUDE_ONLY and lost_for >= _AIDING_TIMEOUT_S:
            self.flags = _ATTITUDE_ONLY
            self._report_cores("stopped aiding")


def best_return_place(vehicle: ArduPilotHost, home: Ned, *, is_allowed: Callable[[Ned], bool] = lambda _: True) -> Ned:
    """Return the place where RTL ends: the nearest allowed rally point at its own height, or home."""
    motion, parameters = vehicle.motion, vehicle.parameters
    points = (
        vehicle.world_point(int(item.x), int(item.y), item.z, item.frame)
        for item in vehicle.missions.items(MavMissionType.RALLY)
    )
    places = [point for point in points if point is not None and is_allowed(point)]
    if not places:
        return home
    nearest = min(places, key=motion.distance_to)
    distance = motion.distance_to(nearest)
    limit = parameters["RALLY_LIMIT_KM"] * 1000.0
    if limit > 0 and distance > limit:
        return home
    if parameters["RALLY_INCL_HOME"] and distance >= motion.distance_to(home):
        return home
    return nearest


# The firmware updates the path at 3 Hz. With 0.3 s, the update is due together with other timers, which saves time.
_PERIOD_S, _FAILURE_TIMEOUT_S, _LOW_SPACE_REPORT_INTERVAL_S = 0.3, 15.0, 10.0
_CLEAN_UP_AFTER_POINTS = 50
_LOW_SPACE_POINTS = 9
# Multiples of SRTL_ACCURACY. Points that bend the path by less than the bend tolerance are removed. Segments that come
# closer to each other than the loop tolerance are joined.
_BEND_TOLERANCE, _LOOP_TOLERANCE = 0.5, 0.99


class SmartPath:
    """Recorded path of SMART_RTL: at most SRTL_POINTS points, at least SRTL_ACCURACY metres apart.

    The path starts where the vehicle was armed or first had a position. If the position, or the space for another
    point, is missing for 15 s, the path is deactivated and SMART_RTL is refused.
    """

    def __init__(self, vehicle: ArduPilotHost) -> None:
        self._vehicle = vehicle
        self._points: list[Ned] = []
        self._cleaned_count = 0  # Number of points after the last simplification.
        self._good_at = -math.inf  # time of the last good position
        self._saved_at = -math.inf  # last time at which the path was not full
        self._warned_at = -math.inf
        self._is_started = False  # True after the first `reset`
        self.is_active: bool = False  # True while SMART_RTL is possible.

    def __len__(self) -> int:
        return len(self._points)

    def start(self) -> None:
        self._vehicle.every(_PERIOD_S, self.update)

    def reset(self) -> None:
        """Start a new path at the vehicle. Without a position, the path stays inactive."""
        parameters = self._vehicle.parameters
        self._points.clear()
        self._cleaned_count = 0
        self.is_active = False
        self._is_started = True
        is_disabled = parameters["SRTL_POINTS"] <= 0 or parameters["SRTL_ACCURACY"] <= 0
        if is_disabled:
            return
        if self._vehicle.navigation.has_position:
            self._points.append(self._vehicle.motion.place)
            self._good_at = self._vehicle.now
            self._saved_at = self._vehicle.now
            self.is_active = True

    def take_way_back(self) -> list[Ned]:
        """Return the simplified path, starting with its last point, and clear the recorded path."""
        accuracy = self._vehicle.parameters["SRTL_ACCURACY"]
        path = prune(simplify(self._points, _BEND_TOLERANCE * accuracy), _LOOP_TOLERANCE * accuracy)
        self._points.clear()
        self._cleaned_count = 0
        return path[::-1]

    def restore(self, way_back: Sequence[Ned]) -> None:
        """Replace the recorded points by ``way_back``, the part of the path from `take_way_back` that was not flown."""
        self._points[:] = list(way_back)[::-1]
        self._cleaned_count = len(self._points)

    def update(self) -> None:
        vehicle = self._vehicle
        if not self.is_active:
            if not self._is_started and vehicle.navigation.has_position:
                self.reset()
            return
        is_disarmed_copter = vehicle.KIND == "copter" and not vehicle.motors.is_armed  # Rovers always record.
        if vehicle.mode.returns_on_path or is_disarmed_copter:
            return
        if not vehicle.navigation.has_position:
            if vehicle.now - self._good_at > _FAILURE_TIMEOUT_S:
                self._deactivate("bad position")
            return
        self._good_at = vehicle.now
        if self._add(self._vehicle.motion.place):
            self._saved_at = vehicle.now
        elif vehicle.now - self._saved_at > _FAILURE_TIMEOUT_S:
            self._deactivate("buffer full")

    def _add(self, place: Ned) -> bool:
        """Record a place that is far enough from the last point. Return False if there is no space."""
        parameters = self._vehicle.parameters
        accuracy, maximum = parameters["SRTL_ACCURACY"], int(parameters["SRTL_POINTS"])
        if self._points and math.dist(self._points[-1], place) < accuracy:
            return True
        new_count = len(self._points) - self._cleaned_count
        if new_count >= _CLEAN_UP_AFTER_POINTS or len(self._points) >= maximum:
            self._points = simplify(self._points, _BEND_TOLERANCE * accuracy)
            if len(self._points) >= maximum - _LOW_SPACE_POINTS:
                self._points = prune(self._points, _LOOP_TOLERANCE * accuracy)
            self._cleaned_count = len(self._points)
        is_space_low = len(self._points) >= maximum - _LOW_SPACE_POINTS
        if is_space_low and self._vehicle.now - self._warned_at > _LOW_SPACE_REPORT_INTERVAL_S:
            self._warned_at = self._vehicle.now
            self._vehicle.info("SmartRTL Low on space!")
        if len(self._points) >= maximum:
            return False
        self._points.append(place)
        return True

    def _deactivate(self, reason: str) -> None:
        self.is_active = False
        self._vehicle.send_text(MavSeverity.WARNING, f"SmartRTL deactivated: {reason}")


def simplify(path: Sequence[Ned], tolerance: float) -> list[Ned]:
    """Return the path without those points that are within ``tolerance`` metres of the simplified path.

    This is the algorithm of Ramer, Douglas and Peucker.
    """
    if len(path) < 3:
        return list(path)
    distances = [distance_to_segment(point, path[0], path[-1]) for point in path[1:-1]]
    farthest = max(range(len(distances)), key=distances.__getitem__)
    if distances[farthest] <= tolerance:
        return [path[0], path[-1]]
    middle = farthest + 1  # `distances` begins with the second point of `path`.
    # Both halves contain the middle point, so `[:-1]` removes it from the first half.
    return simplify(path[: middle + 1], tolerance)[:-1] + simplify(path[middle:], tolerance)


def prune(path: Sequence[Ned], tolerance: float) -> list[Ned]:
    """Return the path without loops. A loop ends where two segments are within ``tolerance`` metres of each other."""
    points = list(path)
    first = 0
    while first < len(points) - 3:
        for last in range(len(points) - 2, first + 1, -1):  # The longest loop comes first.
            approach = _closest_approach(points[first], points[first + 1], points[last], points[last + 1])
            if approach is None:
                continue
            distance, midpoint = approach
            if distance < tolerance:
                points[first + 1 : last + 1] = [midpoint]
                break
        first += 1
    return points


def _closest_approach(start1: Ned, end1: Ned, start2: Ned, end2: Ned) -> tuple[float, Ned] | None:
    """Return (distance, midpoint) of two line segments, or None if they are parallel."""
    line1, line2, between = vector_between(start1, end1), vector_between(start2, end2), vector_between(start2, start1)
    dot11, dot12, dot22 = dot_product(line1, line1), dot_product(line1, line2), dot_product(line2, line2)
    dot1, dot2 = dot_product(line1, between), dot_product(line2, between)
    determinant = dot11 * dot22 - dot12 * dot12
    are_nearly_parallel = determinant < 1e-6 * max(dot11 * dot22, 1e-9)  # also True if a segment has no length
    if are_nearly_parallel:
        return None
    # Each share locates the nearest point on its segment, from 0 (start) to 1 (end). Limiting `share2` moves the
    # nearest point of the first segment, so `share1` is calculated again.
    share1 = max(0.0, min(1.0, (dot12 * dot2 - dot22 * dot1) / determinant))
    share2 = max(0.0, min(1.0, (dot12 * share1 + dot2) / dot22))
    share1 = max(0.0, min(1.0, (dot12 * share2 - dot1) / dot11))
    place1, place2 = point_along(start1, line1, share1), point_along(start2, line2, share2)
    return math.dist(place1, place2), point_along(place1, vector_between(place1, place2), 0.5)
