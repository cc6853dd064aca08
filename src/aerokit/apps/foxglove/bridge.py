"""``foxglove_bridge``: the vehicles of a connection, live in the Foxglove viewer."""

from __future__ import annotations

import asyncio
import math
from fnmatch import fnmatchcase
from importlib import import_module
from typing import TYPE_CHECKING, Any

import anyio

from aerokit._internal.arguments import checked
from aerokit._internal.async_block import async_block
from aerokit.connection.tasks import Background
from aerokit.errors import InvalidArgument, LinkOpenError
from aerokit.logs.convert import topics
from aerokit.logs.convert.topics import Topic
from aerokit.transport.sockets import is_free
from aerokit.vehicle.connect import vehicles_on
from aerokit.vehicle.vehicle import overview

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterable, Mapping

    from aerokit.connection.connection import Connection
    from aerokit.mavlink.message import Message
    from aerokit.vehicle.vehicle import Vehicle

HIGHEST_RATE_HZ = 100.0
WAITING_MESSAGES = 512
"""For one viewer; the SDK then drops the oldest, so a slow one sees the newest and keeps nobody waiting."""
CLOSE_S = 2.0
"""So long the end of a bridge waits at most until its port is closed."""
_LINK_EVERY_S = 1.0


class FoxgloveBridge:
    """A server for the viewer, while its block lasts; made by :func:`foxglove_bridge`."""

    def __init__(self, server: Any, vehicles: Mapping[int, Vehicle], host: str) -> None:
        self._server = server
        self.vehicles = vehicles
        """System id → vehicle: those that are shown."""
        self.port: int = server.port
        """The TCP port it listens on."""
        self.url: str = f"ws://{f'[{host}]' if ':' in host else host}:{self.port}"
        """What is entered in the viewer, under "Open connection"."""


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
    """Show every vehicle that is heard on a connection to the Foxglove viewer, for the time of the block.

    Nothing that a viewer does reaches a vehicle. Every topic tells its newest value, ``rate_hz`` times a second at
    most, and nothing at all while nobody looks at it; docs/convert.md lists the topics. Whoever can reach the port
    sees everything: it has no password.

    The server is foxglove-sdk's. It listens and sends on two threads of its own, which begin with the first bridge of
    a process; with the block the server and its sockets end, the idle threads when the process does.

    Args:
        connection: of :func:`aerokit.open_connection`.
        host: the address to listen on; ``"0.0.0.0"`` is all of this computer's.
        port: the TCP port, 0 to 65535; 0 takes one that is free.
        rate_hz: of each topic at most, above 0 to 100.
        messages: names of MAVLink messages that are shown as they come, too; ``*`` and ``?`` stand for anything:
            ``["GPS_*"]``.
        rates: message class → Hz, asked of each vehicle, as by :func:`aerokit.connect`; ``{}`` asks for nothing.
        on_found: called with each new vehicle, in the loop.

    Raises:
        InvalidArgument: an argument is wrong, or no message has such a name.
        LinkOpenError: the port cannot be listened on.
        ConnectionClosed, LinkLost: the connection has ended.
        ModuleNotFoundError: foxglove-sdk is not installed.
    """
    if not 0 < rate_hz <= HIGHEST_RATE_HZ:
        raise InvalidArgument(f"rate_hz = {rate_hz} is not allowed: above 0, at most {HIGHEST_RATE_HZ:g}")
    if not 0 <= port <= 65535:
        raise InvalidArgument(f"port = {port} is not allowed: 0 to 65535")
    kinds = _message_types(connection, messages)
    shown = _Shown(connection)
    server = _serve(shown, host, port)
    tasks, detach = Background(connection.fail), connection.attach(kinds, shown.hear)
    try:
        async with vehicles_on(connection, rates=rates, on_found=on_found) as vehicles:
            tasks.start(lambda: _repeat(lambda: shown.publish(vehicles), 1 / rate_hz))
            try:
                yield FoxgloveBridge(server, vehicles, host)
            finally:
                await tasks.aclose()
    finally:
        for each in detach:
            each()
        shown.close()
        await _stop(server, host)


def _message_types(connection: Connection, patterns: Iterable[str]) -> list[type[Message]]:
    found: dict[int, type[Message]] = {}
    for pattern in patterns:
        matching = [each for each in connection.bus.dialect if fnmatchcase(each.NAME, pattern.upper())]
        if not matching:
            raise InvalidArgument(f"no message of this connection's dialect is called {pattern!r}")
        found.update({each.ID: each for each in matching})
    return list(found.values())


def _serve(shown: _Shown, host: str, port: int) -> Any:
    try:
        return import_module("foxglove").start_server(
            name="aerokit",
            host=host,
            port=port,
            context=shown.context,
            server_listener=_Listener(asyncio.get_running_loop(), shown),
            message_backlog_size=WAITING_MESSAGES,
        )
    except RuntimeError as error:
        raise LinkOpenError(f"viewers cannot be served on {host} port {port}: {error}") from None


async def _stop(server: Any, host: str) -> None:
    """Have the server stop, and wait for it: its own thread closes the socket, a moment after ``stop`` has returned."""
    port = server.port
    server.stop()
    with anyio.move_on_after(CLOSE_S, shield=True):
        while not await is_free(host, port):  # noqa: ASYNC110 - the SDK tells nobody
            await anyio.sleep(0.005)


async def _repeat(action: Callable[[], None], every_s: float) -> None:
    while True:
        action()
        await asyncio.sleep(every_s)


class _Listener:
    """Hears of viewers, on threads of the SDK."""

    def __init__(self, loop: asyncio.AbstractEventLoop, shown: _Shown) -> None:
        self._loop, self._shown = loop, shown

    def on_subscribe(self, client: Any, channel: Any) -> None:
        """Somebody looks at a topic: what is known of it already is told again."""
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._shown.tell_again, channel.topic)

    def on_unsubscribe(self, client: Any, channel: Any) -> None:
        """Nothing: topics that nobody looks at are not worked out."""


class _Shown:
    """What the viewers are told: a channel for each topic, and when the value came that was told last."""

    def __init__(self, connection: Connection) -> None:
        self._sdk = import_module("foxglove")
        self.context = self._sdk.Context()
        self._connection = connection
        self._wall_at_0 = connection.unix_time() - connection.now()
        self._channels: dict[str, Any] = {}
        self._told: dict[str, float] = {}
        self._map = topics.MapFrame()
        self._heard: dict[tuple[int, int, int], Message] = {}

    def tell_again(self, topic: str) -> None:
        """Another one looks at it: its present value is news. Texts were told, and are read from above."""
        if not topic.endswith("/log"):
            self._told.pop(topic, None)

    def hear(self, message: Message) -> None:
        """Keep the newest message of each kind and sender."""
        frame = message.received_frame
        if frame is not None:
            self._heard[frame.system_id, frame.component_id, message.ID] = message

    def publish(self, vehicles: Mapping[int, Vehicle]) -> None:
        """Tell the viewers all that is newer than what they were told last."""
        for system_id, vehicle in vehicles.items():
            self._publish_states(system_id, vehicle)
            self._publish_place(system_id, vehicle)
            self._publish_texts(system_id, vehicle)
        for (system_id, component_id, _), message in self._heard.items():
            assert message.received_frame is not None
            at, kind = message.received_frame.received_at, type(message)
            name = topics.raw_topic_name(system_id, component_id, kind)
            if self._is_news(name, at, lambda: topics.raw_topic(system_id, component_id, kind)):  # noqa: B023
                self._tell(name, at, topics.raw_fields(message))

    def close(self) -> None:
        """Take all topics away from the viewers."""
        for channel in self._channels.values():
            channel.close()
        self._channels.clear()

    def _publish_states(self, system_id: int, vehicle: Vehicle) -> None:
        for state, cell in vehicle.telemetry.cells.items():
            at, value, name = cell.updated_at, cell.latest, topics.vehicle_topic(system_id, state)
            if value is None:
                continue
            if self._is_news(name, at, lambda: topics.state_topic(system_id, state, value)):  # noqa: B023
                self._tell(name, at, topics.state_fields(value))
        name, now = topics.vehicle_topic(system_id, "link"), self._connection.now()
        if now - self._told.get(name, -_LINK_EVERY_S) >= _LINK_EVERY_S:
            link = overview(vehicle)["link"]
            if self._is_news(name, now, lambda: topics.state_topic(system_id, "link", link)):
                self._tell(name, now, link)

    def _publish_place(self, system_id: int, vehicle: Vehicle) -> None:
        place, attitude = vehicle.position.latest, vehicle.attitude.latest
        if place is None:
            return
        at = vehicle.position.updated_at
        moved_at = max(at, vehicle.attitude.updated_at)
        location, transform, pose = (
            topics.vehicle_topic(system_id, what) for what in ("location", "transform", "pose")
        )
        if self._is_news(location, at, lambda: Topic(location, topics.LOCATION_FIX)):
            heading, velocity = vehicle.heading_deg.latest, vehicle.velocity.latest
            self._tell(location, at, topics.location_fix(self._unix(at), system_id, place, heading, velocity))
        metres = self._map.east_north_up_m(place)
        if self._is_news(transform, moved_at, lambda: Topic(transform, topics.FRAME_TRANSFORM)):
            fields = topics.frame_transform(self._unix(moved_at), system_id, metres, attitude)
            self._tell(transform, moved_at, fields)
        if self._is_news(pose, moved_at, lambda: Topic(pose, topics.POSE_IN_FRAME)):
            self._tell(pose, moved_at, topics.pose_in_frame(self._unix(moved_at), metres, attitude))

    def _publish_texts(self, system_id: int, vehicle: Vehicle) -> None:
        name = topics.vehicle_topic(system_id, "log")
        told = self._told.get(name, -math.inf)
        for text in vehicle.telemetry.texts_since(told):
            if text.at > told and self._is_news(name, text.at, lambda: Topic(name, topics.LOG)):
                self._tell(name, text.at, topics.log_entry(self._unix(text.at), system_id, text))

    def _is_news(self, name: str, at: float, topic: Callable[[], Topic]) -> bool:
        """Whether somebody looks at a topic who was not told this yet; a topic is there from its first value on."""
        channel = self._channels.get(name)
        if channel is None:
            channel = self._channels[name] = self._sdk.Channel(
                name, schema=dict(topic().schema), message_encoding="json", context=self.context
            )
        if not channel.has_sinks():
            self._told.pop(name, None)
            return False
        return at > self._told.get(name, -math.inf)

    def _tell(self, name: str, at: float, fields: Mapping[str, Any]) -> None:
        self._told[name] = at
        self._channels[name].log(topics.encoded(fields), log_time=topics.nanoseconds(self._unix(at)))

    def _unix(self, at: float) -> float:
        """UTC of this computer when something came that came at this time of the loop."""
        return self._wall_at_0 + at
