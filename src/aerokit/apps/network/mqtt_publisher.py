"""``mqtt_publisher``: typed state at a broker of MQTT, by paho-mqtt on the program's event loop."""

from __future__ import annotations

import asyncio
import ssl
from typing import TYPE_CHECKING, Any

from aerokit._internal.arguments import checked
from aerokit._internal.async_block import async_block
from aerokit.apps.network.broker import CONNECT_TIMEOUT_S, BrokerLink, parse_broker, publisher_over
from aerokit.errors import LinkOpenError
from aerokit.transport.link import needed
from aerokit.transport.sockets import discard_unsent
from aerokit.transport.zenoh.session import opened_in_a_thread

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from aerokit.apps.network.broker import BrokerAddress
    from aerokit.apps.network.publisher import Publisher

KEEPALIVE_S = 5
"""The broker is asked for a sign of life so often; without one until the next time the line is lost."""
LOOK_AFTER_S = 1.0


class MqttLink(BrokerLink):
    """One connection to a broker, of MQTT 3.1.1: it publishes with QoS 0, and nothing is kept for later."""

    def __init__(self, where: BrokerAddress) -> None:
        super().__init__(where)
        self._client: Any = None
        self._timer: asyncio.TimerHandle | None = None
        self._answered: asyncio.Future[str] | None = None
        self._is_up = False  # the broker has taken it
        self._alive = where.place.root + "/alive"

    async def _connect(self) -> None:
        mqtt = needed(self.address, "paho.mqtt.client", "paho-mqtt", "mqtt")
        where, loop = self._where, asyncio.get_running_loop()
        client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2, reconnect_on_failure=False)
        client.connect_timeout = CONNECT_TIMEOUT_S
        client.will_set(self._alive, b"offline", retain=True)
        if where.user is not None:
            client.username_pw_set(where.user, where.password)
        self._answered = loop.create_future()

        def work() -> Any:  # looks the name up, connects, shakes hands: all of it blocks
            if where.scheme == "mqtts":
                client.tls_set_context(ssl.create_default_context())
            client.connect(where.host, where.port, KEEPALIVE_S)
            return client

        try:
            await opened_in_a_thread(work, _cut)
        except OSError as error:
            raise self._refused(error) from error
        if (sock := client.socket()) is None:
            raise LinkOpenError(f"cannot open {self.address}: the broker closed the connection")
        self._client = client
        client.on_connect, client.on_disconnect = self._on_connect, self._on_disconnect
        client.on_socket_close = self._on_socket_close
        loop.add_reader(sock, self._read, client, sock)
        self._look_after(client)
        # wait_for may swallow a cancellation
        await asyncio.wait((self._answered,), timeout=CONNECT_TIMEOUT_S)
        if self._answered.done():
            refusal = self._answered.result()
        else:
            refusal = f"no answer within {CONNECT_TIMEOUT_S:g} s (is it a broker of MQTT?)"
        if not refusal and client.socket() is None:
            refusal = "the broker closed the connection"
        if refusal:
            raise LinkOpenError(f"cannot open {self.address}: {refusal}")
        self._is_up = True
        client.publish(self._alive, b"online", retain=True)

    def _send_waiting(self) -> None:
        client = self._client
        while client is self._client is not None and self._waiting and not client.want_write():
            name = next(iter(self._waiting))
            client.publish(self._where.place.state(name), self._waiting.pop(name))
        if client is self._client is not None and client.want_write() and (sock := client.socket()):
            asyncio.get_running_loop().add_writer(sock, self._go_on, client, sock)

    def _go_on(self, client: Any, sock: Any) -> None:
        client.loop_write()
        if client is self._client and not client.want_write():
            asyncio.get_running_loop().remove_writer(sock)
            self._send_waiting()

    def _read(self, client: Any, sock: Any) -> None:
        try:
            client.loop_read()
            while client.socket() is sock and isinstance(sock, ssl.SSLSocket) and sock.pending():
                client.loop_read()
        except Exception as error:  # paho 2.1 raises whatever a malformed packet makes it run into
            _cut(client)
            self._on_disconnect(client, None, None, f"it sent no MQTT: {error}", None)

    def _look_after(self, client: Any) -> None:
        client.loop_misc()  # asks for signs of life, and closes without one
        if client is self._client:
            self._timer = asyncio.get_running_loop().call_later(LOOK_AFTER_S, self._look_after, client)

    def _on_connect(self, _client: Any, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        self._answer(f"the broker refuses: {reason}" if reason.is_failure else "")

    def _on_disconnect(self, _client: Any, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        self._answer("the broker closed the connection")
        if self._is_up:
            self._lose(f"the connection to the broker has ended ({reason})")

    def _on_socket_close(self, client: Any, _data: Any, sock: Any) -> None:
        loop = asyncio.get_running_loop()
        loop.remove_reader(sock)
        loop.remove_writer(sock)
        if client is self._client:  # lost: what the system holds must not arrive when the network is back
            discard_unsent(sock)

    def _answer(self, text: str) -> None:
        if self._answered is not None and not self._answered.done():
            self._answered.set_result(text)

    def _release(self) -> None:
        client, self._client = self._client, None
        self._waiting.clear()
        if self._timer is not None:
            self._timer.cancel()
        if client is not None and client.socket() is not None:
            if client.is_connected() and not client.want_write():
                client.publish(self._alive, b"offline", retain=True)
                client.disconnect()
            _cut(client)
        self._released.set()


def _cut(client: Any) -> None:
    """Close what is still open, without a goodbye."""
    sock = client.socket()
    if sock is not None:
        if client.on_socket_close is not None:
            client.on_socket_close(client, None, sock)
            client.on_socket_close = None
        discard_unsent(sock)
        sock.close()


@checked
@async_block
async def mqtt_publisher(address: str) -> AsyncIterator[Publisher]:
    """Connect to a broker of MQTT for the time of the block.

    States go to the topics ``aerokit/FLEET/NAME/state/…``, with QoS 0 and not retained. ``aerokit/FLEET/NAME/alive``
    is retained: "online", and "offline" after the block or when the broker misses this program. A connection that is
    lost is opened again; what is put meanwhile is dropped. The event loop must know ``add_reader``: on Windows only
    ``asyncio.SelectorEventLoop`` does.

    Args:
        address: ``"mqtt://10.0.0.5:1883/fleet/alpha"``, ``"mqtt://user:password@…"``; ``mqtts`` by TLS (port 8883).

    Returns:
        What :func:`publishing` takes.

    Raises:
        InvalidArgument: this is no address of a broker of MQTT.
        LinkOpenError: the broker cannot be reached or refuses, or paho-mqtt is not installed.
    """
    where = parse_broker(address, "mqtt", "mqtts")
    async with publisher_over(lambda: MqttLink(where)) as publisher:
        yield publisher
