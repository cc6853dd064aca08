"""``mqtt_publisher``: vehicle state at an MQTT broker, with paho-mqtt on the program's event loop."""

from __future__ import annotations

import asyncio
import errno
import ssl
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote, urlsplit

from aerokit._internal.arguments import checked
from aerokit._internal.async_block import async_block
from aerokit._internal.values import Snapshot
from aerokit.apps.network.publisher import Publisher
from aerokit.connection.tasks import run_shielded
from aerokit.errors import InvalidArgument, LinkOpenError
from aerokit.transport.address import host_and_port
from aerokit.transport.link import BaseLink, import_optional, link_open_error
from aerokit.transport.reconnecting import ReconnectingLink
from aerokit.transport.sockets import discard_on_close
from aerokit.transport.zenoh.keys import KeySpace, check_name
from aerokit.transport.zenoh.session import open_in_thread

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from aerokit.errors import LinkLost
    from aerokit.transport.link import Peer

PORTS: dict[str, int] = {"mqtt": 1883, "mqtts": 8883}
"""Maps a scheme to its default port."""
CONNECT_TIMEOUT_S = 5.0
MAX_WAITING = 32_768
"""Maximum number of unsent values; enough for all states of 255 vehicles."""
KEEPALIVE_S = 5
"""MQTT keep-alive in seconds. The connection is lost if the broker does not answer a ping within this time."""
# Interval in seconds at which paho's loop_misc() is called, which sends pings and detects missing answers.
_POLL_INTERVAL_S = 1.0


class BrokerAddress(Snapshot):
    """Address of a broker, with the names of the fleet and the vehicle whose states are published.

    ``str`` and ``repr`` omit user and password.
    """

    scheme: str
    """``"mqtt"``, or ``"mqtts"`` for TLS."""
    host: str
    port: int
    key_space: KeySpace
    user: str | None = None
    password: str | None = None

    def __str__(self) -> str:
        return f"{self.scheme}://{host_and_port(self.host, self.port)}/{self.key_space.fleet}/{self.key_space.name}"

    def __repr__(self) -> str:
        return f"<{self}>"


def parse_broker(text: str) -> BrokerAddress:
    """Parse the address of a broker.

    Raises InvalidArgument if the address is invalid; the error text never shows a password.
    """
    scheme = text.partition("://")[0].strip().lower() if "://" in text else "…"

    def error(reason: str) -> InvalidArgument:
        shown_address = f"{scheme}://…" if "@" in text else text  # without the password
        return InvalidArgument(
            f"address = {shown_address!r} is not allowed: {reason}; expected"
            " mqtt://10.0.0.5:1883/fleet/alpha (% and @ : / ? # in a password: %25, %40 …)"
        )

    if scheme not in PORTS:
        if "@" in text:
            scheme = "…"  # not shown, because it may be a part of a password
        raise error(f"the scheme is not {' or '.join(f'{name}://' for name in PORTS)}")
    try:
        parts = urlsplit(text.strip())
        host, port = parts.hostname, parts.port
    except ValueError:
        raise error("host and port cannot be parsed") from None
    if not host:
        raise error("the host is missing")
    if port == 0:
        raise error("the port must not be 0")
    if parts.query or parts.fragment:
        raise error("MQTT addresses have no options")
    fleet, _, name = parts.path.strip("/").partition("/")
    try:
        key_space = KeySpace(check_name("fleet", fleet), check_name("name", name))
    except InvalidArgument:
        raise error(
            "fleet and name must be up to 63 letters, digits, '_', '.' and '-', starting with a letter or digit"
        ) from None
    user = None if parts.username is None else unquote(parts.username)
    password = None if parts.password is None else unquote(parts.password)
    return BrokerAddress(scheme, host, port or PORTS[scheme], key_space, user, password)


class MqttLink(BaseLink):
    """One connection to an MQTT 3.1.1 broker. It publishes with QoS 0.

    The ``peer`` of :meth:`write` is the name of a state. While the broker accepts no data, the newest value of each
    state is buffered. These values are discarded when the connection ends.
    """

    def __init__(self, broker: BrokerAddress) -> None:
        super().__init__(str(broker))
        self._broker = broker
        self._unsent: dict[str, bytes] = {}
        self._client: Any = None
        self._timer: asyncio.TimerHandle | None = None
        self._connect_result: asyncio.Future[str] | None = None  # why the broker refuses; "" for success
        self._is_accepted = False  # True when the broker has accepted the connection
        self._alive_topic = broker.key_space.root + "/alive"

    def write(self, data: bytes, peer: Peer = None) -> None:
        """Send a value, or buffer it until the broker accepts data.

        A value is dropped if the link is closed or the buffer is full.
        """
        name = str(peer)
        replaces_unsent = name in self._unsent
        has_room = replaces_unsent or len(self._unsent) < MAX_WAITING
        if self._receiver is None or not has_room:
            self._count_dropped(1)
            return
        if replaces_unsent:
            self._count_dropped(1)
        self._unsent[name] = data
        self._send_unsent()

    def _open_error(self, error: OSError) -> LinkOpenError:
        is_refused = error.errno == errno.ECONNREFUSED
        hint = "nothing listens there; is the broker running, and is this its port?" if is_refused else ""
        return link_open_error(self.address, error, hint)

    async def _connect(self) -> None:
        mqtt = import_optional(self.address, "paho.mqtt.client", "paho-mqtt", "mqtt")
        broker = self._broker
        loop = asyncio.get_running_loop()
        client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2, reconnect_on_failure=False)
        client.connect_timeout = CONNECT_TIMEOUT_S
        client.will_set(self._alive_topic, b"offline", retain=True)
        if broker.user is not None:
            client.username_pw_set(broker.user, broker.password)
        self._connect_result = loop.create_future()

        def connect() -> Any:  # runs on a thread, because resolving the name, connecting and the TLS handshake block
            if broker.scheme == "mqtts":
                client.tls_set_context(ssl.create_default_context())
            client.connect(broker.host, broker.port, KEEPALIVE_S)
            return client

        try:
            await open_in_thread(connect, _close_socket)
        except OSError as error:
            raise self._open_error(error) from error
        if (sock := client.socket()) is None:
            raise LinkOpenError(f"cannot open {self.address}: the broker closed the connection")
        self._client = client
        client.on_connect = self._on_connect
        client.on_disconnect = self._on_disconnect
        client.on_socket_close = self._on_socket_close
        loop.add_reader(sock, self._read, client, sock)
        self._poll(client)
        # Not `wait_for` or `move_on_after`: on Python 3.10 they can lose a cancellation at the time-out.
        await asyncio.wait((self._connect_result,), timeout=CONNECT_TIMEOUT_S)
        refusal = f"no answer within {CONNECT_TIMEOUT_S:g} s (is it an MQTT broker?)"
        if self._connect_result.done():
            refusal = self._connect_result.result()
        if not refusal and client.socket() is None:
            refusal = "the broker closed the connection"
        if refusal:
            raise LinkOpenError(f"cannot open {self.address}: {refusal}")
        self._is_accepted = True
        client.publish(self._alive_topic, b"online", retain=True)

    def _send_unsent(self) -> None:
        client = self._client
        # publish() may detect that the connection is lost, and call _on_disconnect(), which resets self._client.
        while self._client is not None and self._unsent and not client.want_write():
            name = next(iter(self._unsent))
            client.publish(self._broker.key_space.state(name), self._unsent.pop(name))
        if self._client is not None and client.want_write():
            sock = client.socket()
            if sock:
                asyncio.get_running_loop().add_writer(sock, self._continue_writing, client, sock)

    def _continue_writing(self, client: Any, sock: Any) -> None:
        client.loop_write()
        if client is self._client and not client.want_write():
            asyncio.get_running_loop().remove_writer(sock)
            self._send_unsent()

    def _read(self, client: Any, sock: Any) -> None:
        try:
            client.loop_read()
            # The event loop does not report data that TLS has decrypted already, because that data has left the socket.
            while client.socket() is sock and isinstance(sock, ssl.SSLSocket) and sock.pending():
                client.loop_read()
        except Exception as error:  # paho 2.1 raises arbitrary errors for malformed packets
            _close_socket(client)
            self._on_connection_end(f"malformed MQTT packet: {error}")

    def _poll(self, client: Any) -> None:
        # paho sends pings and detects missing answers here.
        client.loop_misc()
        if client is self._client:
            self._timer = asyncio.get_running_loop().call_later(_POLL_INTERVAL_S, self._poll, client)

    def _on_connect(self, _client: Any, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        self._finish_connecting(f"the broker refuses: {reason}" if reason.is_failure else "")

    def _on_disconnect(self, _client: Any, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        self._on_connection_end(reason)

    def _on_connection_end(self, reason: object) -> None:
        self._finish_connecting("the broker closed the connection")
        if self._is_accepted:
            self._lose(f"the connection to the broker has ended ({reason})")

    def _on_socket_close(self, client: Any, _data: Any, sock: Any) -> None:
        loop = asyncio.get_running_loop()
        loop.remove_reader(sock)
        loop.remove_writer(sock)
        # If the connection was lost, its unsent data must not arrive when the network is back.
        if client is self._client:
            discard_on_close(sock)

    def _finish_connecting(self, refusal: str) -> None:
        """End the wait of `_connect`. ``refusal`` is "" for success."""
        if self._connect_result is not None and not self._connect_result.done():
            self._connect_result.set_result(refusal)

    def _release(self) -> None:
        client, self._client = self._client, None
        self._unsent.clear()
        if self._timer is not None:
            self._timer.cancel()
        if client is not None and client.socket() is not None:
            can_send_now = client.is_connected() and not client.want_write()
            if can_send_now:
                client.publish(self._alive_topic, b"offline", retain=True)
                client.disconnect()
            _close_socket(client)
        self._released.set()


def _close_socket(client: Any) -> None:
    """Close the socket, and discard what is not sent. Without DISCONNECT, the broker itself publishes "offline"."""
    sock = client.socket()
    if sock is not None:
        if client.on_socket_close is not None:  # paho calls it only if paho itself closes the socket
            client.on_socket_close(client, None, sock)
            client.on_socket_close = None
        discard_on_close(sock)
        sock.close()


class _NullReceiver:
    """Ignores received data and lost connections. `ReconnectingLink` logs the latter."""

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        pass

    def link_lost(self, error: LinkLost) -> None:
        pass


class _LinkPublisher(Publisher):
    def __init__(self, link: ReconnectingLink) -> None:
        self._link = link

    def __repr__(self) -> str:
        return f"<publisher on {self._link.address}>"

    def put(self, name: str, data: bytes) -> None:
        self._link.write(data, name)


@checked
@async_block
async def mqtt_publisher(address: str) -> AsyncIterator[Publisher]:
    """Connect to an MQTT broker while the block lasts.

    FLEET and NAME are the last two parts of the address, for example ``fleet`` and ``alpha`` in
    ``mqtt://10.0.0.5:1883/fleet/alpha``. States are published to ``aerokit/FLEET/NAME/state/…`` (QoS 0, not retained).
    ``aerokit/FLEET/NAME/alive`` is retained. It is "online" within the block, and "offline" after the block or after
    the broker has lost the connection. A lost connection is reopened; values published meanwhile are dropped. The event
    loop must support ``add_reader``; on Windows, only ``asyncio.SelectorEventLoop`` does.

    Args:
        address: ``"mqtt://HOST:PORT/FLEET/NAME"`` or ``"mqtt://user:password@…"``; with ``mqtts`` instead of ``mqtt``
            for TLS (port 8883).

    Returns:
        A publisher for :func:`publishing`.

    Raises:
        InvalidArgument: the address is invalid.
        LinkOpenError: the broker cannot be reached or refuses the connection, or paho-mqtt is not installed.
    """
    broker = parse_broker(address)
    link = ReconnectingLink(lambda: MqttLink(broker))
    await link.open(_NullReceiver())
    try:
        yield _LinkPublisher(link)
    finally:
        link.close()
        await run_shielded(link.wait_closed())
