"""Shows vehicles live in Foxglove: ``async with foxglove_bridge(connection): ...``.

Needs foxglove-sdk (``pip install 'aerokit-mavlink[foxglove]'``); see docs/convert.md. ``aerokit convert``
writes the same topics to an ``.mcap`` file.
"""

from __future__ import annotations

import asyncio
import math
from fnmatch import fnmatchcase
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Any

import anyio

from aerokit._internal.arguments import checked
from aerokit._internal.async_block import async_block
from aerokit.connection.tasks import BackgroundTasks
from aerokit.errors import InvalidArgument, LinkOpenError
from aerokit.logs.convert import topics
from aerokit.logs.convert.topics import Topic
from aerokit.transport.sockets import is_port_free
from aerokit.vehicle.connect import vehicles_on
from aerokit.vehicle.vehicle import overview

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterable, Mapping

    from aerokit.connection.connection import Connection
    from aerokit.mavlink.message import Message
    from aerokit.vehicle.vehicle import Vehicle

__all__ = ["FoxgloveBridge", "foxglove_bridge"]

MAX_RATE_HZ = 100.0
# Maximum number of messages that are queued for each viewer. If a queue is full, the SDK drops its oldest message.
_MAX_BACKLOG = 512
# How long to wait until the SDK has closed the port.
_PORT_CLOSE_TIMEOUT_S = 2.0
_LINK_INTERVAL_S = 1.0


class FoxgloveBridge:
    """A running server for Foxglove viewers. :func:`foxglove_bridge` yields it."""

    def __init__(self, server: Any, vehicles: Mapping[int, Vehicle], host: str) -> None:
        self._server = server
        self.vehicles = vehicles
        """Maps system ids to the vehicles that are shown."""
        self.port: int = server.port
        """TCP port on which the server listens."""
        self.url: str = f"ws://{f'[{host}]' if ':' in host else host}:{self.port}"
        """URL to enter in Foxglove, under "Open connection"."""


@checked
@async_block
async def foxglove_bridge(
    connection: Connection,
    *,
    host: str = "127.0.0.1",
    port: int = 8765,
    rate_hz: float = 10.0,
    messages: Iterable[str] = (),
    rates: Mapping[type[Message], float] | None = None,
    on_found: Callable[[Vehicle], object] | None = None,
) -> AsyncIterator[FoxgloveBridge]:
    """Serve the vehicles of a connection to Foxglove while the block lasts.

    Viewers cannot send anything to a vehicle. The newest value of a topic is sent at most ``rate_hz`` times a second,
    and only while a viewer subscribes to the topic; docs/convert.md lists the topics. There is no password: every
    client that can reach the port can see all data.

    foxglove-sdk runs the server on two threads, which start with the first bridge of the process. The server and its
    sockets are closed at the end of the block; the threads stay, idle, until the process ends.

    Args:
        connection: a connection from :func:`aerokit.open_connection`.
        host: address to listen on; ``"0.0.0.0"`` for all interfaces.
        port: TCP port, 0 to 65535; 0 for any free port.
        rate_hz: maximum rate of each topic, above 0, at most 100.
        messages: names of MAVLink messages to show without conversion; ``*`` and ``?`` are wildcards: ``["GPS_*"]``.
        rates: maps message classes to the rates in Hz that are requested from each vehicle, as in
            :func:`aerokit.connect`; ``{}`` requests nothing.
        on_found: called with each new vehicle, in the event loop.

    Raises:
        InvalidArgument: an argument is invalid, or no message matches a name in ``messages``.
        LinkOpenError: the server cannot listen on the port.
        ConnectionClosed, LinkLost: the connection has ended.
        ModuleNotFoundError: foxglove-sdk is not installed.
    """
    if not 0 < rate_hz <= MAX_RATE_HZ:
        raise InvalidArgument(f"rate_hz = {rate_hz} is not allowed: it must be above 0 and at most {MAX_RATE_HZ:g}")
    if not 0 <= port <= 65535:
        raise InvalidArgument(f"port = {port} is not allowed: it must be 0 to 65535")
    message_types = _message_types(connection, messages)
    channels = _TopicChannels(connection)
    server = _start_server(channels, host, port)
    tasks = BackgroundTasks(connection.fail)
    detachments = connection.attach(message_types, channels.on_message)
    try:
        async with vehicles_on(connection, rates=rates, on_found=on_found) as vehicles:
            tasks.start(lambda: _repeat(lambda: channels.publish(vehicles), 1 / rate_hz))
            try:
                yield FoxgloveBridge(server, vehicles, host)
            finally:
                await tasks.aclose()
    finally:
        for detach in detachments:
            detach()
        channels.close()
        await _stop_server(server, host)


def _message_types(connection: Connection, patterns: Iterable[str]) -> list[type[Message]]:
    """Return the messages whose names match a pattern.

    Raises InvalidArgument if a pattern matches no message of the connection's dialect.
    """
    by_id: dict[int, type[Message]] = {}
    for pattern in patterns:
        matching = [message for message in connection.bus.dialect if fnmatchcase(message.NAME, pattern.upper())]
        if not matching:
            raise InvalidArgument(f"messages: no message of the connection's dialect matches {pattern!r}")
        by_id.update({message.ID: message for message in matching})
    return list(by_id.values())


def _start_server(channels: _TopicChannels, host: str, port: int) -> Any:
    try:
        return import_module("foxglove").start_server(
            name="aerokit",
            host=host,
            port=port,
            context=channels.context,
            server_listener=_Listener(asyncio.get_running_loop(), channels),
            message_backlog_size=_MAX_BACKLOG,
        )
    except RuntimeError as error:
        raise LinkOpenError(f"cannot listen for Foxglove on {host}, port {port}: {error}") from None


async def _stop_server(server: Any, host: str) -> None:
    """Stop the server, and wait until its socket is closed."""
    # The SDK's thread closes the socket only some time after `stop` has returned.
    port = server.port
    server.stop()
    with anyio.move_on_after(_PORT_CLOSE_TIMEOUT_S, shield=True):
        while not await is_port_free(host, port):  # noqa: ASYNC110 - the SDK has no notification
            await anyio.sleep(0.005)


async def _repeat(action: Callable[[], None], interval_s: float) -> None:
    while True:
        action()
        await asyncio.sleep(interval_s)


class _Listener:
    """Receives the subscriptions of viewers. The SDK calls its methods on threads of the SDK."""

    def __init__(self, loop: asyncio.AbstractEventLoop, channels: _TopicChannels) -> None:
        self._loop, self._channels = loop, channels

    def on_subscribe(self, client: Any, channel: Any) -> None:
        # `publish` sends new values only, so the new viewer gets the current value here.
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._channels.send_again, channel.topic)

    def on_unsubscribe(self, client: Any, channel: Any) -> None:
        pass  # nothing to do, because publish() skips topics without viewers


class _TopicChannels:
    """The channels of all topics, and the time of the last value sent on each."""

    def __init__(self, connection: Connection) -> None:
        self._sdk = import_module("foxglove")
        self.context = self._sdk.Context()
        self._connection = connection
        self._unix_time_at_0 = connection.unix_time() - connection.now()
        self._channels: dict[str, Any] = {}
        self._sent_at: dict[str, float] = {}
        self._map_frame = topics.MapFrame()
        self._messages: dict[tuple[int, int, int], Message] = {}

    def send_again(self, topic: str) -> None:
        if not topic.endswith("/log"):  # otherwise the other viewers would get all status texts again
            self._sent_at.pop(topic, None)  # so that `publish` sends the current value

    def on_message(self, message: Message) -> None:
        frame = message.received_frame
        if frame is not None:
            self._messages[frame.system_id, frame.component_id, message.ID] = message

    def publish(self, vehicles: Mapping[int, Vehicle]) -> None:
        """Send all values that are newer than the last values sent."""
        for system_id, vehicle in vehicles.items():
            self._publish_states(system_id, vehicle)
            self._publish_location_and_pose(system_id, vehicle)
            self._publish_texts(system_id, vehicle)
        for (system_id, component_id, _), message in self._messages.items():
            assert message.received_frame is not None
            received_at = message.received_frame.received_at
            message_type = type(message)
            name = topics.raw_topic_name(system_id, component_id, message_type)
            make_topic = partial(topics.raw_topic, system_id, component_id, message_type)
            if self._must_send(name, received_at, make_topic):
                self._send(name, received_at, topics.raw_fields(message))

    def close(self) -> None:
        for channel in self._channels.values():
            channel.close()
        self._channels.clear()

    def _publish_states(self, system_id: int, vehicle: Vehicle) -> None:
        for state, cell in vehicle.telemetry.cells.items():
            value, topic_name = cell.latest, topics.vehicle_topic(system_id, state)
            if value is None:
                continue
            make_topic = partial(topics.state_topic, system_id, state, value)
            if self._must_send(topic_name, cell.updated_at, make_topic):
                self._send(topic_name, cell.updated_at, topics.state_fields(value))
        # The link's statistics change with every frame, so they are sent at an interval.
        name, now = topics.vehicle_topic(system_id, "link"), self._connection.now()
        if now - self._sent_at.get(name, -_LINK_INTERVAL_S) >= _LINK_INTERVAL_S:
            link = overview(vehicle)["link"]
            if self._must_send(name, now, lambda: topics.state_topic(system_id, "link", link)):
                self._send(name, now, link)

    def _publish_location_and_pose(self, system_id: int, vehicle: Vehicle) -> None:
        position, attitude = vehicle.position.latest, vehicle.attitude.latest
        if position is None:
            return
        position_at = vehicle.position.updated_at
        pose_at = max(position_at, vehicle.attitude.updated_at)
        location, transform, pose = (
            topics.vehicle_topic(system_id, name) for name in ("location", "transform", "pose")
        )
        if self._must_send(location, position_at, lambda: Topic(location, topics.LOCATION_FIX)):
            heading, velocity = vehicle.heading_deg.latest, vehicle.velocity.latest
            location_unix_s = self._to_unix_time(position_at)
            fix = topics.location_fix(location_unix_s, system_id, position, heading, velocity)
            self._send(location, position_at, fix)
        map_position, pose_unix_s = self._map_frame.east_north_up_m(position), self._to_unix_time(pose_at)
        if self._must_send(transform, pose_at, lambda: Topic(transform, topics.FRAME_TRANSFORM)):
            self._send(transform, pose_at, topics.frame_transform(pose_unix_s, system_id, map_position, attitude))
        if self._must_send(pose, pose_at, lambda: Topic(pose, topics.POSE_IN_FRAME)):
            self._send(pose, pose_at, topics.pose_in_frame(pose_unix_s, map_position, attitude))

    def _publish_texts(self, system_id: int, vehicle: Vehicle) -> None:
        name = topics.vehicle_topic(system_id, "log")
        sent_at = self._sent_at.get(name, -math.inf)
        for text in vehicle.telemetry.texts_since(sent_at):
            if text.at > sent_at and self._must_send(name, text.at, lambda: Topic(name, topics.LOG)):
                self._send(name, text.at, topics.log_entry(self._to_unix_time(text.at), system_id, text))

    def _must_send(self, name: str, updated_at: float, make_topic: Callable[[], Topic]) -> bool:
        """Return True if a topic has viewers, and its value is newer than the last value sent.

        The first call opens the topic's channel, because the type of the channel depends on the value.
        """
        channel = self._channels.get(name)
        if channel is None:
            channel = self._channels[name] = self._sdk.Channel(
                name, schema=dict(make_topic().schema), message_encoding="json", context=self.context
            )
        if not channel.has_sinks():
            self._sent_at.pop(name, None)  # so that the next viewer gets the current value
            return False
        return updated_at > self._sent_at.get(name, -math.inf)

    def _send(self, name: str, updated_at: float, fields: Mapping[str, Any]) -> None:
        self._sent_at[name] = updated_at
        self._channels[name].log(topics.encoded(fields), log_time=topics.nanoseconds(self._to_unix_time(updated_at)))

    def _to_unix_time(self, loop_time: float) -> float:
        return self._unix_time_at_0 + loop_time
