"""Says what was heard on a link on which the wanted vehicle was not found."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from aerokit.mavlink.messages import Heartbeat
    from aerokit.runtime.connection import Connection

__all__ = ["is_autopilot", "no_vehicle_reason"]

MAV_TYPE_GCS = 6
MAV_AUTOPILOT_INVALID = 8


def is_autopilot(heartbeat: Heartbeat) -> bool:
    """Whether it comes from an autopilot: not from a ground station, a gimbal, a camera or an ADS-B receiver."""
    return heartbeat.autopilot != MAV_AUTOPILOT_INVALID and heartbeat.type != MAV_TYPE_GCS


def no_vehicle_reason(connection: Connection, wanted_system: int | None) -> str:
    """Say what was heard on a link on which no vehicle was found."""
    return _Diagnosis(connection, wanted_system).text()


class _Diagnosis:
    """Looks at the counters of a connection from the least that can be heard to the most."""

    def __init__(self, connection: Connection, wanted_system: int | None) -> None:
        self._wanted = wanted_system
        self._heard = connection.heard
        statistics = list(connection.statistics())
        self._bytes = sum(each.bytes for each in statistics)
        self._frames = sum(each.frames for each in statistics)
        self._bad_crcs = sum(each.bad_crcs for each in statistics)
        self._unknown = sum(each.unknown_ids for each in statistics)

    def text(self) -> str:
        if not self._bytes:
            return "not a single byte was heard: is the vehicle on, and is it sending to this address?"
        if not self._frames:
            return self._without_frames()
        if not self._heard:
            return f"{self._frames} frames were heard, but no HEARTBEAT among them"
        return self._without_vehicle()

    def _without_frames(self) -> str:
        if self._unknown:
            return (
                f"{self._bytes} bytes were heard with {self._unknown} frames of an unknown dialect and none of this"
                " one: pass dialect=Dialect.from_xml(...)"
            )
        if self._bad_crcs:
            return (
                f"{self._bytes} bytes were heard with {self._bad_crcs} damaged frames and no good one:"
                " a noisy link, or another dialect?"
            )
        return f"{self._bytes} bytes were heard, but no MAVLink frame: wrong baud rate, or another protocol?"

    def _without_vehicle(self) -> str:
        autopilots = sorted({system for (system, _), beat in self._heard.items() if is_autopilot(beat)})
        if autopilots:
            names = ", ".join(map(str, autopilots))
            return f"vehicles with other system ids were heard: {names} (wanted: {self._wanted})"
        names = ", ".join(f"{system}/{component}" for system, component in sorted(self._heard))
        if all(beat.type == MAV_TYPE_GCS for beat in self._heard.values()):
            return f"only ground stations were heard ({names})"
        return f"only components that are no autopilot were heard ({names})"
