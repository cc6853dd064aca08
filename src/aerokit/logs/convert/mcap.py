"""MCAP for the Foxglove viewer: the topics that ``aerokit bridge foxglove`` serves live, and the log's own entries."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from aerokit.logs.convert import topics
from aerokit.logs.convert.topics import Topic
from aerokit.mavlink.dialect import STANDARD

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from aerokit.logs.flights.entries import Entry, Log

_MOVES = frozenset(("position", "attitude"))


class McapFile:
    """Writes a log as ``.mcap``; one message of a topic for each entry that told it."""

    def __init__(self, path: Path, log: Log) -> None:
        self._log = log
        self._file = path.open("wb")
        self._writer = import_module("mcap.writer").Writer(self._file)
        self._writer.start(profile="", library="aerokit")
        self._channels: dict[str, int] = {}
        self._schemas: dict[bytes, int] = {}
        self._latest: dict[int, dict[str, Any]] = {}
        self._map = topics.MapFrame()
        self.written: int = 0

    def take(self, entry: Entry) -> None:
        """Write what an entry of the log tells."""
        message, system_id = entry.message, entry.system_id
        if message is not None:
            kind = STANDARD[message.ID]
            name = topics.raw_topic_name(system_id, entry.component_id, kind)
            self._put(
                entry.unix_s,
                name,
                topics.raw_fields(message),
                lambda: topics.raw_topic(system_id, entry.component_id, kind),
            )
        else:
            name = f"/log/{entry.table}"
            self._put(entry.unix_s, name, topics.state_fields(entry.fields), lambda: self._own_topic(entry))
        if entry.states:
            self._take_states(entry)

    def close(self) -> None:
        """End the file."""
        self._writer.finish()
        self._file.close()

    def abandon(self) -> None:
        """Close it as it is: nobody will read it."""
        self._file.close()

    def _take_states(self, entry: Entry) -> None:
        system_id, unix_s = entry.system_id, entry.unix_s
        latest = self._latest.setdefault(system_id, {})
        for state, value in entry.states:
            latest[state] = value
            name = topics.vehicle_topic(system_id, state)
            make = lambda: topics.state_topic(system_id, state, value)  # noqa: E731, B023
            self._put(unix_s, name, topics.state_fields(value), make)
            if state == "status_text":
                fields = topics.log_entry(unix_s, system_id, value)
                self._put_known(unix_s, system_id, "log", fields, topics.LOG)
        moved = {state for state, _ in entry.states} & _MOVES
        place, attitude = latest.get("position"), latest.get("attitude")
        if not moved or place is None:
            return
        if "position" in moved:
            heading, velocity = latest.get("heading_deg"), latest.get("velocity")
            fix = topics.location_fix(unix_s, system_id, place, heading, velocity)
            self._put_known(unix_s, system_id, "location", fix, topics.LOCATION_FIX)
            latest["metres"] = self._map.east_north_up_m(place)
        metres = latest["metres"]
        transform = topics.frame_transform(unix_s, system_id, metres, attitude)
        self._put_known(unix_s, system_id, "transform", transform, topics.FRAME_TRANSFORM)
        pose = topics.pose_in_frame(unix_s, metres, attitude)
        self._put_known(unix_s, system_id, "pose", pose, topics.POSE_IN_FRAME)

    def _put_known(
        self, unix_s: float, system_id: int, what: str, fields: Mapping[str, Any], schema: Mapping[str, Any]
    ) -> None:
        name = topics.vehicle_topic(system_id, what)
        self._put(unix_s, name, fields, lambda: Topic(name, schema))

    def _put(self, unix_s: float, name: str, fields: Mapping[str, Any], make: Callable[[], Topic]) -> None:
        channel = self._channels.get(name)
        if channel is None:
            channel = self._channels[name] = self._register(make())
        at = topics.nanoseconds(unix_s)
        self._writer.add_message(channel, at, topics.encoded(fields), at)
        self.written += 1

    def _register(self, topic: Topic) -> int:
        data = topics.encoded(topic.schema)
        schema = self._schemas.get(data)
        if schema is None:
            schema = self._writer.register_schema(topic.schema_name, "jsonschema", data)
            self._schemas[data] = schema
        return int(self._writer.register_channel(topic.name, "json", schema))

    def _own_topic(self, entry: Entry) -> Topic:
        kinds = {"str": "string"}
        properties = {
            column.field: {"type": kinds.get(column.kind, "number"), "description": column.name}
            for column in self._log.columns(entry)
        }
        title = f"log.{entry.table}"
        return Topic(f"/log/{entry.table}", {"title": title, "type": "object", "properties": properties})
