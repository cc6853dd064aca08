"""What a simulated ArduPilot knows of where it is: GPS, estimator, origin and home."""

from __future__ import annotations

import math
from collections.abc import Callable

from aerokit.mavlink.enums import EkfStatusFlags as Ekf
from aerokit.mavlink.enums import GpsFixType, MavMissionType
from aerokit.sim.ardupilot.host import Host
from aerokit.sim.local_frame import GlobalPoint, LocalFrame, Ned

# plain numbers: the operators of flags are slow, and these are looked at all the time
_ATTITUDE, _POS_HORIZ_ABS, _POS_VERT_ABS = map(int, (Ekf.ATTITUDE, Ekf.POS_HORIZ_ABS, Ekf.POS_VERT_ABS))
_ATTITUDE_ONLY = int(
    Ekf.ATTITUDE | Ekf.VELOCITY_HORIZ | Ekf.VELOCITY_VERT | Ekf.POS_VERT_ABS | Ekf.CONST_POS_MODE
)
_WITH_POSITION = int(
    Ekf.ATTITUDE
    | Ekf.VELOCITY_HORIZ
    | Ekf.VELOCITY_VERT
    | Ekf.POS_HORIZ_REL
    | Ekf.POS_HORIZ_ABS
    | Ekf.POS_VERT_ABS
    | Ekf.PRED_POS_HORIZ_REL
    | Ekf.PRED_POS_HORIZ_ABS
)
_DEAD_RECKONING = int(Ekf.ATTITUDE | Ekf.VELOCITY_VERT | Ekf.POS_VERT_ABS)
_GIVE_UP_S, _STOP_AIDING_S = 7.0, 15.0
_CHECK_S = 0.1


class Navigation:
    """Grows with the boot, suffers under ``faults.gps_lost`` and SIM_GPS1_ENABLE 0.

    Positions are kept in the world's frame (`frame`, around the place where the vehicle was created);
    ``origin`` and
    ``home`` are points of it, None until they are known.
    """

    def __init__(self, vehicle: Host, frame: LocalFrame) -> None:
        self._vehicle = vehicle
        self.frame = frame
        self.flags: int | None = None
        """EKF_STATUS_FLAGS; None while there is no estimator to ask."""
        self.fix_type: int = GpsFixType.NO_GPS
        self.is_gps_detected: bool = False
        self.is_healthy: bool = False
        self.origin: Ned | None = None
        self.home: Ned | None = None
        self.home_is_locked: bool = False
        self._lost_at = math.nan

    def start(self) -> None:
        """Follow the boot timeline from now on."""
        vehicle, line = self._vehicle, self._vehicle.timeline
        later = vehicle.call_later
        later(
            line.ready + 0.5 * (line.estimator_active - line.ready),
            lambda: self._set_flags(int(Ekf.UNINITIALIZED)),
        )
        later(line.estimator_active, self._activate)
        later(line.tilt_aligned, lambda: self._say_cores("tilt alignment complete"))
        later(line.yaw_aligned, self._align)
        later(line.gps_detected, self._detect_gps)
        later(line.gps_fix, self._get_fix)
        later(line.origin_set, self._set_origin)
        later(line.healthy, self._become_healthy)
        later(line.position_good, self._use_gps)

    @property
    def has_position(self) -> bool:
        """Whether the estimator has a position that is good enough to fly by."""
        return self.flags is not None and self.flags & _POS_HORIZ_ABS != 0

    @property
    def gps_is_lost(self) -> bool:
        return self._vehicle.faults.gps_lost or not self._vehicle.parameters["SIM_GPS1_ENABLE"]

    @property
    def has_attitude(self) -> bool:
        """Whether the estimator knows up from down."""
        return self.flags is not None and self.flags & _ATTITUDE != 0

    @property
    def has_altitude(self) -> bool:
        """Whether the estimator has a height."""
        return self.flags is not None and self.flags & _POS_VERT_ABS != 0

    @property
    def position(self) -> GlobalPoint | None:
        """Where the vehicle believes to be; None before the first fix."""
        if self.fix_type < GpsFixType.TYPE_3D_FIX and self.origin is None:
            return None
        motion = self._vehicle.motion
        return self.frame.to_global(*motion.place)

    @property
    def altitude_above_home(self) -> float:
        """Metres above home, or above the ground it was switched on while home is unknown."""
        reference = self._vehicle.motion.ground_down if self.home is None else self.home[2]
        return reference - self._vehicle.motion.down

    def local(self, point: Ned) -> Ned:
        """A point of the world, relative to the estimator's origin."""
        north, east, down = (0.0, 0.0, 0.0) if self.origin is None else self.origin
        return (point[0] - north, point[1] - east, point[2] - down)

    def world(self, local: Ned) -> Ned:
        """A point relative to the estimator's origin, in the world."""
        north, east, down = (0.0, 0.0, 0.0) if self.origin is None else self.origin
        return (local[0] + north, local[1] + east, local[2] + down)

    def set_home(self, point: Ned, *, lock: bool) -> None:
        """Make a point home and tell everybody."""
        self.home = point
        self.home_is_locked = self.home_is_locked or lock
        self._vehicle.missions.commands.add_home()
        self._vehicle.call_later(0.0, self._vehicle.send_home)

    def set_origin(self, point: Ned) -> bool:
        """Make a point the estimator's origin; False when it has one, or is not there yet."""
        if self.origin is not None or not self._vehicle.is_initialised:
            return False
        self.origin = point
        self._tell_origin()
        return True

    def _tell_origin(self) -> None:
        assert self.origin is not None
        self._say_cores("origin set")
        if self._vehicle.KIND != "sub":
            self._vehicle.info(f"Field Elevation Set: {self.frame.origin.altitude_m - self.origin[2]:.0f}m")

    def _set_flags(self, flags: int) -> None:
        self.flags = flags

    def _say_cores(self, text: str) -> None:
        for core in (0, 1):
            self._vehicle.info(f"EKF3 IMU{core} {text}")

    def _activate(self) -> None:
        self.flags = 0
        self._say_cores("initialised")
        if self._vehicle.timeline.estimator_leads_early:
            self._vehicle.info("AHRS: EKF3 active")

    def _align(self) -> None:
        self.flags = _ATTITUDE_ONLY
        self._say_cores("MAG0 initial yaw alignment complete")

    def _detect_gps(self) -> None:
        self.is_gps_detected = True
        self.fix_type = GpsFixType.NO_FIX
        self._vehicle.info("GPS 1: probing for u-blox at 230400 baud")
        self._vehicle.info("GPS 1: detected u-blox")

    def _get_fix(self) -> None:
        if not self.gps_is_lost:
            self.fix_type = GpsFixType.RTK_FIXED
            if not self._vehicle.timeline.estimator_leads_early:
                self._set_first_home()
        self._vehicle.every(_CHECK_S, self._watch_gps)

    def _set_origin(self) -> None:
        if self.fix_type < GpsFixType.TYPE_3D_FIX:
            self._vehicle.call_later(1.0, self._set_origin)
            return
        if self.origin is None:
            motion = self._vehicle.motion
            self.origin = motion.place
            self._tell_origin()
        if not self.home_is_locked:
            self._set_first_home()

    def _set_first_home(self) -> None:
        motion = self._vehicle.motion
        self.home = motion.place
        self._vehicle.missions.commands.add_home()
        self._vehicle.send_home()

    def _become_healthy(self) -> None:
        self.is_healthy = True

    def _use_gps(self) -> None:
        if self.origin is None or self.fix_type < GpsFixType.TYPE_3D_FIX:
            self._vehicle.call_later(1.0, self._use_gps)
            return
        self.flags = _WITH_POSITION
        self._say_cores("is using GPS")
        if not self._vehicle.timeline.estimator_leads_early:
            self._vehicle.info("AHRS: EKF3 active")

    def _watch_gps(self) -> None:
        now, lost = self._vehicle.now, self.gps_is_lost
        if lost and math.isnan(self._lost_at):
            self._lost_at, self.fix_type = now, GpsFixType.NO_FIX
        elif lost and self.has_position and now - self._lost_at >= _GIVE_UP_S:
            self.flags = _DEAD_RECKONING | (Ekf.VELOCITY_HORIZ if self._vehicle.is_landed else 0)
        elif lost and self.flags != _ATTITUDE_ONLY and now - self._lost_at >= _STOP_AIDING_S:
            self.flags = _ATTITUDE_ONLY
            self._say_cores("stopped aiding")
        elif not lost and self.fix_type < GpsFixType.TYPE_3D_FIX:
            self._lost_at, self.fix_type = math.nan, GpsFixType.RTK_FIXED
            if self.origin is not None and not self.has_position:
                self._use_gps()


def best_return_place(vehicle: Host, home: Ned, *, is_allowed: Callable[[Ned], bool] = lambda _: True) -> Ned:
    """The nearest rally point that is allowed, with its own height; home when there is none or it is to be preferred.

    Rally points farther than RALLY_LIMIT_KM are none (0 means that there is no limit). With RALLY_INCL_HOME home is one
    of the places.
    """
    here = (vehicle.motion.north, vehicle.motion.east)
    parameters = vehicle.parameters
    places = [place for place in _rally_points(vehicle) if is_allowed(place)]
    if not places:
        return home
    nearest = min(places, key=lambda place: math.dist(place[:2], here))
    distance, limit = math.dist(nearest[:2], here), parameters["RALLY_LIMIT_KM"] * 1000.0
    if limit > 0 and distance > limit:
        return home
    if parameters["RALLY_INCL_HOME"] and distance >= math.dist(home[:2], here):
        return home
    return nearest


def _rally_points(vehicle: Host) -> list[Ned]:
    points = (
        vehicle.point(int(item.x), int(item.y), item.z, item.frame)
        for item in vehicle.missions.items(MavMissionType.RALLY)
    )
    return [point for point in points if point is not None]
