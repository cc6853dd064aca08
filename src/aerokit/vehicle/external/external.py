"""`External`: measurements, origin and wind that a program supplies to the vehicle's estimator."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit.errors import InvalidArgument, OperationRejected, OperationTimeout
from aerokit.mavlink.enums import MavCmd
from aerokit.mavlink.messages import GpsGlobalOrigin, SetGpsGlobalOrigin
from aerokit.vehicle.external.encoding import MeasurementEncoder
from aerokit.vehicle.external.streams import MeasurementStream, TimesyncAnswers
from aerokit.vehicle.external.values import (
    FlowMeasurement,
    GpsMeasurement,
    ObstaclePoints,
    ObstacleSectors,
    OdometryMeasurement,
    PoseMeasurement,
    RangeMeasurement,
    SpeedMeasurement,
    TargetMeasurement,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.autopilots.external import ExternalKind
    from aerokit.mavlink.message import Message
    from aerokit.position import Position
    from aerokit.vehicle.commanding.context import VehicleContext
    from aerokit.vehicle.commanding.streams import Probe
    from aerokit.vehicle.external.streams import MeasurementT

__all__ = ["External"]

# A reported origin may differ from the given one by this many metres, because ArduPilot and PX4 round it.
ORIGIN_TOLERANCE_M = 1.0
POLL_INTERVAL_S = 0.5


@checks_arguments
class External:
    """Supplies the vehicle with measurements: ``async with vehicle.external.odometry() as stream: stream.send(…)``.

    ``rate_hz`` (above 0, at most 400) is the maximum rate at which measurements are sent. A measurement older than
    ``valid_for_s`` is dropped. Time stamps are on the event loop's clock. While a stream is open, aerokit answers the
    vehicle's TIMESYNC requests with this clock.
    """

    def __init__(self, context: VehicleContext, probe: Probe) -> None:
        self._context, self._session, self._probe = context, context.session, probe
        self._encode = MeasurementEncoder(context.session)
        self._timesync_answers = TimesyncAnswers(context.session)

    def odometry(self, *, rate_hz: float = 30.0, valid_for_s: float = 0.2) -> MeasurementStream[OdometryMeasurement]:
        """Supply pose and velocity (ODOMETRY). Needs VISO_TYPE 1 to 3 on ArduPilot, EKF2_EV_CTRL above 0 on PX4."""
        return self._stream("odometry", OdometryMeasurement, self._encode.odometry, rate_hz, valid_for_s)

    def vision_position(self, *, rate_hz: float = 30.0, valid_for_s: float = 0.2) -> MeasurementStream[PoseMeasurement]:
        """Supply a pose (VISION_POSITION_ESTIMATE).

        Needs VISO_TYPE 1 to 3 on ArduPilot, EKF2_EV_CTRL above 0 on PX4.
        """
        return self._stream("vision_position", PoseMeasurement, self._encode.vision_position, rate_hz, valid_for_s)

    def vision_speed(self, *, rate_hz: float = 30.0, valid_for_s: float = 0.2) -> MeasurementStream[SpeedMeasurement]:
        """Supply a velocity (VISION_SPEED_ESTIMATE; for PX4 ODOMETRY without a pose)."""
        return self._stream("vision_speed", SpeedMeasurement, self._encode.vision_speed, rate_hz, valid_for_s)

    def motion_capture(self, *, rate_hz: float = 50.0, valid_for_s: float = 0.2) -> MeasurementStream[PoseMeasurement]:
        """Supply a pose from motion capture (ATT_POS_MOCAP; for PX4 VISION_POSITION_ESTIMATE)."""
        return self._stream("motion_capture", PoseMeasurement, self._encode.motion_capture, rate_hz, valid_for_s)

    def gps(self, *, rate_hz: float = 5.0, valid_for_s: float = 0.5) -> MeasurementStream[GpsMeasurement]:
        """Supply positions from a satellite receiver (GPS_INPUT). Only ArduPilot reads them: set GPS1_TYPE to 14."""
        return self._stream("gps", GpsMeasurement, self._encode.gps, rate_hz, valid_for_s)

    def obstacles(self, *, rate_hz: float = 10.0, valid_for_s: float = 0.5) -> MeasurementStream[ObstacleSectors]:
        """Supply distances around the vehicle (OBSTACLE_DISTANCE).

        Set PRX1_TYPE to 2 on ArduPilot, CP_DIST above 0 on PX4.
        """
        return self._stream("obstacles", ObstacleSectors, self._encode.obstacles, rate_hz, valid_for_s)

    def obstacle_points(self, *, rate_hz: float = 10.0, valid_for_s: float = 0.5) -> MeasurementStream[ObstaclePoints]:
        """Supply positions of obstacles (OBSTACLE_DISTANCE_3D). Only ArduPilot reads them: set PRX1_TYPE to 2."""
        return self._stream("obstacle_points", ObstaclePoints, self._encode.obstacle_points, rate_hz, valid_for_s)

    def range_finder(self, *, rate_hz: float = 20.0, valid_for_s: float = 0.2) -> MeasurementStream[RangeMeasurement]:
        """Supply a distance (DISTANCE_SENSOR).

        On ArduPilot, set RNGFND1_TYPE to 10, and RNGFND1_ORIENT to the direction of the sensor.
        """
        return self._stream("range_finder", RangeMeasurement, self._encode.range_finder, rate_hz, valid_for_s)

    def landing_target(
        self, *, rate_hz: float = 20.0, valid_for_s: float = 0.3
    ) -> MeasurementStream[TargetMeasurement]:
        """Supply the position of a landing target (LANDING_TARGET). On ArduPilot, set PLND_ENABLED and PLND_TYPE to 1.

        ``vehicle.land_on`` opens this stream itself and lands the vehicle.
        """
        return self._stream("landing_target", TargetMeasurement, self._encode.landing_target, rate_hz, valid_for_s)

    def optical_flow(self, *, rate_hz: float = 30.0, valid_for_s: float = 0.2) -> MeasurementStream[FlowMeasurement]:
        """Supply optical flow (OPTICAL_FLOW; for PX4 OPTICAL_FLOW_RAD).

        On ArduPilot, set FLOW_TYPE to 5. On PX4, set EKF2_OF_CTRL to 1.
        """
        return self._stream("optical_flow", FlowMeasurement, self._encode.optical_flow, rate_hz, valid_for_s)

    async def set_wind(
        self,
        speed_m_s: float,
        direction_deg: float,
        *,
        speed_accuracy_m_s: float = 1.0,
        direction_accuracy_deg: float = 15.0,
    ) -> None:
        """Supply an estimate of the wind (MAV_CMD_EXTERNAL_WIND_ESTIMATE). Wait until the vehicle acknowledges it.

        No message reports whether the vehicle uses the estimate. ArduPilot uses it in its simpler estimator (DCM), PX4
        in EKF2.

        Args:
            speed_m_s: horizontal speed, 0 to 100.
            direction_deg: direction that the wind comes from, 0 to 360 clockwise from north.
            speed_accuracy_m_s: one standard deviation, 0 to 100.
            direction_accuracy_deg: one standard deviation, 0 to 180.

        Raises:
            InvalidArgument: a value is out of range. Nothing was sent.
            CommandRejected: the vehicle refused, or does not support the command.
            CommandTimeout: there was no acknowledgement.
        """
        check_range("speed_m_s", speed_m_s, 0, 100)
        check_range("direction_deg", direction_deg, 0, 360)
        check_range("speed_accuracy_m_s", speed_accuracy_m_s, 0, 100)
        check_range("direction_accuracy_deg", direction_accuracy_deg, 0, 180)
        params = (speed_m_s, speed_accuracy_m_s, direction_deg, direction_accuracy_deg)
        await self._context.sender.auxiliary_command(MavCmd.EXTERNAL_WIND_ESTIMATE, *params)

    async def set_origin(self, origin: Position, *, timeout: float = 10.0) -> None:
        """Set the origin of the estimator's local frame, and wait until GPS_GLOBAL_ORIGIN reports it.

        A vehicle without GPS needs the origin to compute global positions. SET_GPS_GLOBAL_ORIGIN has no acknowledgement
        and is sent once. Returns at once if the vehicle has this origin already. If you cancel the call, the vehicle
        may still have accepted the origin.

        Args:
            origin: latitude, longitude and altitude above mean sea level.
            timeout: seconds to wait until the vehicle reports the origin.

        Raises:
            InvalidArgument: the origin has no altitude above mean sea level. Nothing was sent.
            OperationRejected: ArduPilot has another origin and keeps it until a reboot. Nothing was sent.
            OperationTimeout: the vehicle did not report the origin in time.
        """
        if origin.altitude_amsl_m is None:
            raise InvalidArgument(
                "origin.altitude_amsl_m = None is not allowed: the origin needs an altitude above mean sea level"
            )
        session, present_origin = self._session, self._session.telemetry.origin.latest
        if present_origin is not None:
            if _are_close(present_origin, origin):
                return
            if session.autopilot.external.origin_is_final:
                raise OperationRejected(
                    f"set_origin: {session.autopilot.firmware} has the origin {present_origin}, and keeps it until a"
                    " reboot"
                )
        latitude, longitude = round(origin.latitude_deg * 1e7), round(origin.longitude_deg * 1e7)
        altitude_mm = round(origin.altitude_amsl_m * 1000)
        time_us = int(session.connection.now() * 1e6)
        session.send(SetGpsGlobalOrigin(session.system_id, latitude, longitude, altitude_mm, time_us))
        await self._await_origin(origin, timeout)

    async def _await_origin(self, origin: Position, timeout: float) -> None:
        cell, connection = self._session.telemetry.origin, self._session.connection
        deadline = connection.now() + timeout
        while (remaining_s := deadline - connection.now()) > 0:
            self._request_origin()
            wait_s = min(POLL_INTERVAL_S, remaining_s)
            with suppress(OperationTimeout):
                await cell.wait_until(lambda reported: _are_close(reported, origin), timeout=wait_s)
                return
        report = f"it last reported {cell.latest}" if cell.is_known else "it has reported no origin"
        raise OperationTimeout(f"set_origin: the vehicle did not report the origin within {timeout:g} s; {report}")

    def _request_origin(self) -> None:
        self._session.commands.send_unconfirmed(MavCmd.REQUEST_MESSAGE, GpsGlobalOrigin.ID)

    def _stream(
        self,
        kind: ExternalKind,
        value_type: type[MeasurementT],
        encode: Callable[[MeasurementT], tuple[Message, ...]],
        rate_hz: float,
        valid_for_s: float,
    ) -> MeasurementStream[MeasurementT]:
        return MeasurementStream(
            self._session, kind, value_type, encode, self._timesync_answers, self._probe, rate_hz, valid_for_s
        )


def _are_close(reported: Position, ordered: Position) -> bool:
    if reported.altitude_amsl_m is None or ordered.altitude_amsl_m is None:
        return False
    has_same_altitude = abs(reported.altitude_amsl_m - ordered.altitude_amsl_m) <= ORIGIN_TOLERANCE_M
    return has_same_altitude and reported.distance_to(ordered) <= ORIGIN_TOLERANCE_M
