"""Writes MCAP files for Foxglove, with the topics of ``aerokit bridge foxglove`` and the records of the log."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from aerokit.logs.convert import topics
from aerokit.logs.convert.topics import Topic
from aerokit.mavlink.dialect import STANDARD

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from aerokit.logs.flights.records import LogReader, LogRecord

_POSE_STATES = frozenset(("position", "attitude"))


class McapWriter:
    """Writes a log as ``.mcap``, with a message for each record, and one for each state that the record changes."""

    def __init__(self, path: Path, log: LogReader) -> None:
        self._log = log
        writer_class = import_module("mcap.writer").Writer  # raises ModuleNotFoundError before the file is open
        self._file = path.open("wb")
        self._writer = writer_class(self._file)
        self._writer.start(profile="", library="aerokit")
        self._channels: dict[str, int] = {}
        self._schemas: dict[bytes, int] = {}
        self._latest: dict[int, dict[str, Any]] = {}  # by system id: the latest value of each state
        self._map_positions: dict[int, tuple[float, float, float]] = {}  # by system id: metres east, north and up
        self._map_frame = topics.MapFrame()
        self.written: int = 0

    def write(self, record: LogRecord) -> None:
        message, system_id = record.message, record.system_id
        if message is not None:
            message_class = STANDARD[message.ID]
            name = topics.raw_topic_name(system_id, record.component_id, message_class)
            self._put(
                record.unix_s,
                name,
                topics.raw_fields(message),
                lambda: topics.raw_topic(system_id, record.component_id, message_class),
            )
        else:
            name = f"/log/{record.table}"
            self._put(record.unix_s, name, topics.state_fields(record.fields), lambda: self._record_topic(record))
        if record.states:
            self._write_states(record)

    def close(self) -> None:
        self._writer.finish()
        self._file.close()

    def discard(self) -> None:
        self._file.close()

    def _write_states(self, record: LogRecord) -> None:
        system_id, unix_s = record.system_id, record.unix_s
        latest = self._latest.setdefault(system_id, {})
        for state, value in record.states:
            latest[state] = value
            name = topics.vehicle_topic(system_id, state)
            self._put(
                unix_s,
                name,
                topics.state_fields(value),
                lambda: topics.state_topic(system_id, state, value),  # noqa: B023 - called in this iteration
            )
            if state == "status_text":
                fields = topics.log_entry(unix_s, system_id, value)
                self._put_foxglove(unix_s, system_id, "log", fields, topics.LOG)
        # A pose has a position and an attitude, so a new pose is written if the record changes at least one of them.
        changed_pose_states = {state for state, _ in record.states} & _POSE_STATES
        position, attitude = latest.get("position"), latest.get("attitude")
        if not changed_pose_states or position is None:
            return
        if "position" in changed_pose_states:
            heading, velocity = latest.get("heading_deg"), latest.get("velocity")
            fix = topics.location_fix(unix_s, system_id, position, heading, velocity)
            self._put_foxglove(unix_s, system_id, "location", fix, topics.LOCATION_FIX)
            self._map_positions[system_id] = self._map_frame.east_north_up_m(position)
        map_position = self._map_positions[system_id]  # stored with the vehicle's first position
        transform = topics.frame_transform(unix_s, system_id, map_position, attitude)
        self._put_foxglove(unix_s, system_id, "transform", transform, topics.FRAME_TRANSFORM)
        pose = topics.pose_in_frame(unix_s, map_position, attitude)
        self._put_foxglove(unix_s, system_id, "pose", pose, topics.POSE_IN_FRAME)

    def _put_foxglove(
        self, unix_s: float, system_id: int, short_name: str, fields: Mapping[str, Any], schema: Mapping[str, Any]
    ) -> None:
        name = topics.vehicle_topic(system_id, short_name)
        self._put(unix_s, name, fields, lambda: Topic(name, schema))

    def _put(self, unix_s: float, name: str, fields: Mapping[str, Any], make_topic: Callable[[], Topic]) -> None:
        channel = self._channels.get(name)
        if channel is None:
            channel = self._register(make_topic())
            self._channels[name] = channel
        time_ns = topics.nanoseconds(unix_s)
        self._writer.add_message(channel, time_ns, topics.encoded(fields), time_ns)
        self.written += 1

    def _register(self, topic: Topic) -> int:
        """Register a channel for the topic, and return the channel's id."""
        data = topics.encoded(topic.schema)
        schema = self._schemas.get(data)
        if schema is None:
            schema = self._writer.register_schema(topic.schema_name, "jsonschema", data)
            self._schemas[data] = schema
        return int(self._writer.register_channel(topic.name, "json", schema))

    def _record_topic(self, record: LogRecord) -> Topic:
        properties = {
            column.field: {"type": "string" if column.kind == "str" else "number", "description": column.name}
            for column in self._log.columns(record)
        }
        title = f"log.{record.table}"
        return Topic(f"/log/{record.table}", {"title": title, "type": "object", "properties": properties})
