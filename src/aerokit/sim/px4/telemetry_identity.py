"""What a simulated PX4 says of itself: version, card, flight, descriptions, remote identification."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavAutopilot, MavOdidUaType, MavType, StorageStatus
from aerokit.sim.px4.modes import custom_mode

if TYPE_CHECKING:
    from aerokit.mavlink.message import Message
    from aerokit.sim.px4.vehicle import SimulatedPx4

__all__ = ["IDENTITY_BUILDERS"]

_LIBRARY_HASH = b"\xa4C\x87s\xec\x08o="
_METADATA_URI, _METADATA_CRC = "mftp://etc/extras/component_general.json.xz", 2472443404
_CAPACITY_MIB, _USED_MIB = 258_019.6, 192_146.9
_REMOTE_ID_EPOCH = 1_546_300_800
"""2019-01-01, from which OPEN_DRONE_ID counts seconds."""
_ANYONE = bytes(20)


def _autopilot_version(px4: SimulatedPx4) -> m.AutopilotVersion:
    number, commit = px4.version_number, b"\0\0\0\xfd\xaf\xd6\xde\x59"
    return m.AutopilotVersion(
        px4.capabilities, number, number, 101854463, 1, commit, commit, bytes(8), 0, 0, 5283920058631409231
    )


def _protocol_version(_: SimulatedPx4) -> m.ProtocolVersion:
    return m.ProtocolVersion(200, 100, 203, bytes(8), _LIBRARY_HASH)


def _storage_information(px4: SimulatedPx4) -> m.StorageInformation:
    free = _CAPACITY_MIB - _USED_MIB
    return m.StorageInformation(
        px4.time_boot_ms, 1, 1, StorageStatus.READY, _CAPACITY_MIB, _USED_MIB, free, 0.0, 0.0
    )


def _flight_information(px4: SimulatedPx4) -> m.FlightInformation:
    armed_for = px4.now - px4.arming.since
    since = int((px4.unix_time - armed_for) * 1e6) if px4.is_armed else 0
    return m.FlightInformation(px4.time_boot_ms, since, 0 if px4.is_landed else since, 0)


def _component_metadata(px4: SimulatedPx4) -> m.ComponentMetadata:
    return m.ComponentMetadata(px4.time_boot_ms, _METADATA_CRC, _METADATA_URI)


def _component_information(px4: SimulatedPx4) -> m.ComponentInformation:
    return m.ComponentInformation(px4.time_boot_ms, _METADATA_CRC, _METADATA_URI, 0, "")


def _mag_cal_report(_: SimulatedPx4) -> m.MagCalReport:
    return m.MagCalReport(0, 0, 4, 0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0, 0, 1.0)


def _high_latency(px4: SimulatedPx4) -> m.HighLatency2:
    o = px4.motion
    place = px4.frame.to_global(o.north, o.east, o.down)
    heading = round(math.degrees(o.yaw) % 360.0 / 2)
    throttle, speed = round(px4.throttle * 100), min(255, round(o.ground_speed_m_s * 5))
    climb = max(-127, min(127, round(-o.velocity_down * 10)))
    return m.HighLatency2(
        px4.time_boot_ms,
        px4.VEHICLE_TYPE,
        MavAutopilot.PX4,
        custom_mode(px4.mode) >> 16,
        place.latitude_e7,
        place.longitude_e7,
        round(place.altitude_m),
        0,
        heading,
        0,
        0,
        throttle,
        0,
        0,
        speed,
        0,
        0,
        255,
        255,
        -128,
        climb,
        int(px4.battery.percent),
        px4.mission.current,
        0,
        -128,
        -128,
        -128,
    )


def _basic_id(px4: SimulatedPx4) -> m.OpenDroneIdBasicId:
    is_plane = px4.VEHICLE_TYPE == MavType.FIXED_WING
    kind = MavOdidUaType.AEROPLANE if is_plane else MavOdidUaType.HELICOPTER_OR_MULTIROTOR
    return m.OpenDroneIdBasicId(0, 0, _ANYONE, 1, kind, b"1006554d49534954414\0")


def _remote_location(px4: SimulatedPx4) -> m.OpenDroneIdLocation | None:
    if not px4.has_position:
        return None
    o = px4.motion
    place = px4.frame.to_global(o.north, o.east, o.down)
    course = round(math.degrees(math.atan2(o.velocity_east, o.velocity_north)) % 360.0) % 360 * 100
    return m.OpenDroneIdLocation(
        0,
        0,
        _ANYONE,
        1 if px4.is_landed else 2,
        course,
        round(o.ground_speed_m_s * 100),
        round(-o.velocity_down * 100),
        place.latitude_e7,
        place.longitude_e7,
        place.altitude_m,
        place.altitude_m,
        0,
        px4.altitude_m,
        12,
        5,
        0,
        3,
        65535.0,
        0,
    )


def _remote_system(px4: SimulatedPx4) -> m.OpenDroneIdSystem | None:
    if not px4.is_ready:
        return None
    home = px4.frame.to_global(*px4.home)
    seconds = max(0, int(px4.unix_time) - _REMOTE_ID_EPOCH)
    return m.OpenDroneIdSystem(
        0,
        0,
        _ANYONE,
        0,
        0,
        home.latitude_e7,
        home.longitude_e7,
        1,
        0,
        -1000.0,
        -1000.0,
        0,
        0,
        home.altitude_m,
        seconds,
    )


IDENTITY_BUILDERS: dict[int, Callable[[SimulatedPx4], Message | None]] = {
    m.AutopilotVersion.ID: _autopilot_version,
    m.MagCalReport.ID: _mag_cal_report,
    m.HighLatency2.ID: _high_latency,
    m.StorageInformation.ID: _storage_information,
    m.FlightInformation.ID: _flight_information,
    m.ProtocolVersion.ID: _protocol_version,
    m.ComponentInformation.ID: _component_information,
    m.ComponentMetadata.ID: _component_metadata,
    m.OpenDroneIdBasicId.ID: _basic_id,
    m.OpenDroneIdLocation.ID: _remote_location,
    m.OpenDroneIdSystem.ID: _remote_system,
}
"""Message id → what to send now, or None."""
