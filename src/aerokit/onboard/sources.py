"""Measurements that a component sends to an autopilot: obstacles, traffic, landing targets, GNSS corrections."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit.errors import InvalidArgument
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import AdsbAltitudeType, AdsbFlags, LandingTargetType, MavFrame
from aerokit.protocols.rtcm import fragments, rtcm_messages

if TYPE_CHECKING:
    from aerokit.onboard.host import ComponentHost
    from aerokit.position import Position

MAX_DISTANCES = 72
_NOT_MEASURED = 0xFFFF


@checks_arguments
class ComponentSources:
    """Sends measurements as this component. Each call sends one measurement, in one message to all programs."""

    def __init__(self, host: ComponentHost) -> None:
        self._host = host
        self._rtcm_sequence = 0

    def _time_us(self) -> int:
        return round(self._host.connection.unix_time() * 1e6)

    def send_obstacles(
        self,
        distances_m: Sequence[float | None],
        *,
        increment_deg: float,
        first_deg: float = 0.0,
        min_m: float,
        max_m: float,
        sensor_type: int = 0,
    ) -> None:
        """Send the distances to obstacles around the vehicle, clockwise as seen from above (OBSTACLE_DISTANCE).

        Args:
            distances_m: at most 72 distances in metres. None means that there was no measurement, infinity that nothing
                is in range.
            increment_deg: angle between two distances, above 0.
            first_deg: direction of the first distance in degrees, clockwise from the nose.
            min_m: minimum range of the sensor, 0 to 655 m.
            max_m: maximum range of the sensor, at most 655 m.
            sensor_type: MAV_DISTANCE_SENSOR: 0 laser, 1 ultrasound, 2 infrared, 3 radar.

        Raises:
            InvalidArgument: a value is out of range.
            ConnectionClosed, LinkLost: the connection has ended.
        """
        if not 0 < len(distances_m) <= MAX_DISTANCES:
            raise InvalidArgument(f"distances_m has {len(distances_m)} values; 1 to {MAX_DISTANCES} are allowed")
        if not 0 <= min_m < max_m <= 655:  # The fields have 16 bits, for centimetres.
            raise InvalidArgument(
                f"min_m, max_m = {min_m}, {max_m} are not allowed: both must be 0 to 655, and min_m below max_m"
            )
        check_range("increment_deg", increment_deg, 0, 360, above=True)
        nothing_in_range = round(max_m * 100) + 1  # In OBSTACLE_DISTANCE, max_distance + 1 means no obstacle.
        values = [_centimetres(distance, nothing_in_range) for distance in distances_m]
        values += [_NOT_MEASURED] * (MAX_DISTANCES - len(values))
        self._send(
            m.ObstacleDistance(
                time_usec=self._time_us(),
                sensor_type=sensor_type,
                distances=values,
                increment=min(255, round(increment_deg)),  # an older field of 8 bits; receivers use `increment_f`
                min_distance=round(min_m * 100),
                max_distance=round(max_m * 100),
                increment_f=increment_deg,
                angle_offset=first_deg,
                frame=MavFrame.BODY_FRD,
            )
        )

    def send_traffic(
        self,
        icao: int,
        position: Position,
        *,
        callsign: str = "",
        heading_deg: float | None = None,
        speed_m_s: float | None = None,
        climb_m_s: float | None = None,
        squawk: int | None = None,
        emitter_type: int = 0,
        age_s: int = 0,
    ) -> None:
        """Report an aircraft that a receiver has detected (ADSB_VEHICLE). None means that a value is unknown.

        Args:
            icao: ICAO address, 0 to 16777215.
            position: position, with the altitude above mean sea level if known.
            callsign: at most 8 characters.
            heading_deg: course over ground from north, 0 to 360.
            speed_m_s: horizontal speed, 0 to 655.
            climb_m_s: vertical speed, positive up, -327 to 327.
            squawk: transponder code, 0 to 7777.
            emitter_type: ADSB_EMITTER_TYPE.
            age_s: seconds since the last contact, 0 to 255.

        Raises:
            InvalidArgument: a value is out of range.
            ConnectionClosed, LinkLost: the connection has ended.
        """
        flags = AdsbFlags.VALID_COORDS
        altitude = position.altitude_amsl_m
        for value, flag in (
            (altitude, AdsbFlags.VALID_ALTITUDE),
            (heading_deg, AdsbFlags.VALID_HEADING),
            (speed_m_s, AdsbFlags.VALID_VELOCITY),
            (climb_m_s, AdsbFlags.VERTICAL_VELOCITY_VALID),
            (squawk, AdsbFlags.VALID_SQUAWK),
            (callsign or None, AdsbFlags.VALID_CALLSIGN),
        ):
            if value is not None:
                flags |= flag
        if len(callsign) > 8:
            raise InvalidArgument(f"callsign = {callsign!r} is not allowed: it must have at most 8 characters")
        self._send(
            m.AdsbVehicle(
                icao,
                lat=round(position.latitude_deg * 1e7),
                lon=round(position.longitude_deg * 1e7),
                altitude_type=AdsbAltitudeType.GEOMETRIC,
                altitude=round((altitude or 0.0) * 1000),
                heading=round((heading_deg or 0.0) * 100),
                hor_velocity=round((speed_m_s or 0.0) * 100),
                ver_velocity=round((climb_m_s or 0.0) * 100),
                callsign=callsign,
                emitter_type=emitter_type,
                tslc=age_s,
                flags=int(flags),
                squawk=squawk or 0,
            )
        )

    def send_landing_target(
        self, right_deg: float, down_deg: float, distance_m: float, *, target_number: int = 0
    ) -> None:
        """Send the direction and distance of a landing beacon relative to the vehicle's body (LANDING_TARGET).

        Args:
            right_deg: angle from straight down to the right, -90 to 90.
            down_deg: angle from straight down towards the tail, -90 to 90. The tail is at the bottom of the camera's
                image.
            distance_m: distance to the beacon in metres, 0 or more.
            target_number: number of the beacon, 0 to 255.

        Raises:
            InvalidArgument: a value is out of range.
            ConnectionClosed, LinkLost: the connection has ended.
        """
        check_range("right_deg", right_deg, -90, 90)
        check_range("down_deg", down_deg, -90, 90)
        if not 0 <= distance_m < math.inf:
            raise InvalidArgument(f"distance_m = {distance_m} is not allowed: it must be 0 or more, and finite")
        self._send(
            m.LandingTarget(
                time_usec=self._time_us(),
                target_num=target_number,
                frame=MavFrame.BODY_FRD,
                angle_x=math.radians(right_deg),
                angle_y=math.radians(down_deg),
                distance=distance_m,
                size_x=0.0,  # 0 means that the size is unknown.
                size_y=0.0,
                type=LandingTargetType.LIGHT_BEACON,
            )
        )

    def send_corrections(self, rtcm: bytes) -> None:
        """Send GNSS corrections (RTCM 3) in GPS_RTCM_DATA messages.

        Args:
            rtcm: complete RTCM messages of at most 720 bytes each.

        Raises:
            InvalidArgument: a message is incomplete, damaged or too long; nothing was sent.
            ConnectionClosed, LinkLost: the connection has ended.
        """
        for message in rtcm_messages(rtcm):
            for piece in fragments(message, self._rtcm_sequence):
                self._send(piece)
            self._rtcm_sequence += 1

    def _send(self, message: m.ObstacleDistance | m.AdsbVehicle | m.LandingTarget | m.GpsRtcmData) -> None:
        self._host.connection.raise_if_ended()
        self._host.send(message)


def _centimetres(distance_m: float | None, nothing_in_range: int) -> int:
    if distance_m is None or math.isnan(distance_m):
        return _NOT_MEASURED
    if distance_m < 0:
        raise InvalidArgument(f"distances_m contains {distance_m}, but each distance must be 0 or more, or None")
    return nothing_in_range if math.isinf(distance_m) else min(nothing_in_range, round(distance_m * 100))
