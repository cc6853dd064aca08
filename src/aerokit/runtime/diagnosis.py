"""Says what was heard on a link on which the wanted vehicle was not found."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.mavlink.enums import MavType
from aerokit.runtime.components import is_autopilot

if TYPE_CHECKING:
    from aerokit.runtime.connection import Connection

__all__ = ["no_vehicle_reason"]

NOISE_BYTES = 500
"""In so many bytes of noise there is about a tenth of a place that looks like a damaged frame."""
SOME = 5


def no_vehicle_reason(connection: Connection, wanted_system: int | None) -> str:
    """Say what was heard on a link on which no vehicle was found."""
    return _Diagnosis(connection, wanted_system).text()


class _Diagnosis:
    """Looks at the counters of a connection from the least that can be heard to the most."""

    def __init__(self, connection: Connection, wanted_system: int | None) -> None:
        self._wanted = wanted_system
        self._heard = connection.heard
        self._signatures = connection.describe_signatures()
        statistics = list(connection.statistics())
        self._bytes = sum(each.bytes for each in statistics)
        self._frames = sum(each.frames for each in statistics)
        self._bad_crcs = sum(each.bad_crcs for each in statistics)
        self._bad_bytes = sum(each.bad_bytes for each in statistics)
        self._unknown = sum(each.unknown_ids for each in statistics)
        self._unknown_messages = {number for each in statistics for number in each.unknown_messages}
        self._systems = {system for each in statistics for system, _ in each.sources}

    def text(self) -> str:
        if not self._bytes:
            return "not a single byte was heard: is the vehicle on, and is it sending to this address?"
        if not self._frames:
            return self._without_frames()
        if not self._heard:
            return self._without_heartbeats()
        return self._without_vehicle()

    def _without_frames(self) -> str:
        """Noise has a few places that look like frames: what is said rests on most of the bytes."""
        heard = f"{self._bytes} bytes were heard"
        if self._unknown and 2 * self._bad_bytes < self._bytes:
            numbers = ", ".join(map(str, sorted(self._unknown_messages)[:SOME]))
            return (
                f"{heard} with {self._unknown} frames of an unknown dialect (messages {numbers}) and none of this one:"
                " pass dialect=Dialect.from_xml(...)"
            )
        if self._bad_crcs * NOISE_BYTES > self._bytes:
            return f"{heard} with {self._bad_crcs} damaged frames and no good one: a noisy link, or another dialect?"
        return f"{heard}, but no MAVLink frame: wrong baud rate, or another protocol?"

    def _without_heartbeats(self) -> str:
        heard = f"{self._frames} frames were heard"
        if self._signatures:
            return f"{heard}; {self._signatures}"
        if not any(self._systems):
            return f"{heard}, all of system id 0, which is nobody's: give the vehicle an id of 1 to 255"
        return f"{heard}, but no HEARTBEAT among them"

    def _without_vehicle(self) -> str:
        autopilots = sorted({system for (system, _), beat in self._heard.items() if is_autopilot(beat)})
        if autopilots:
            names = ", ".join(map(str, autopilots))
            return f"vehicles with other system ids were heard: {names} (wanted: {self._wanted})"
        names = ", ".join(f"{system}/{component}" for system, component in sorted(self._heard))
        if all(beat.type == MavType.GCS for beat in self._heard.values()):
            return f"only ground stations were heard ({names})"
        return f"only components that are no autopilot were heard ({names})"
