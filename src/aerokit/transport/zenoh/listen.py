"""``zenohin:`` link: a server for clients on a zenoh network, which find it by its name."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import random
from collections.abc import Callable
from functools import partial
from typing import Any

import anyio

from aerokit.errors import InvalidArgument, LinkOpenError
from aerokit.transport.link import Peer
from aerokit.transport.zenoh.control_lease import (
    BEACON_INTERVAL_S,
    ClientFilter,
    ControlLease,
    FreshnessChecker,
)
from aerokit.transport.zenoh.keys import Beacon, KeySpace, RefusalNotice, SendTime, Stamp, check_name
from aerokit.transport.zenoh.session import (
    MAX_PAYLOAD_BYTES,
    LoopQueue,
    NetworkLink,
    NetworkOptions,
    attachment_of,
    open_in_thread,
    open_session,
    payload_of,
    zenoh_errors,
)

MAX_CLIENTS = 64
"""Maximum number of clients. A further client is ignored unless another was silent for `CLIENT_TIMEOUT_S`."""

CLIENT_TIMEOUT_S = 30.0
"""A client may be replaced by a new client after this silence."""

_MIN_BEACON_INTERVAL_S = 0.02
_BEACON_TIMEOUT_S = 2.5 * BEACON_INTERVAL_S
_TOKEN_QUERY_TIMEOUT_S = 1.0

logger: logging.Logger = logging.getLogger("aerokit")


class ZenohListen(NetworkLink):
    """``zenohin:`` link: serves the clients (`ZenohConnect`) that use its name. Each client is a peer.

    The link is not lost when clients or the network fail. Outdated datagrams are refused, and so are commands while
    another client has control. Refused frames are counted, and the client is notified.

    Args:
        fleet: name of the fleet, up to 63 letters, digits, ``_``, ``.`` and ``-``.
        name: unique name of this server in the fleet.
        options: connection to the network.

    Raises:
        InvalidArgument: an argument is wrong.
    """

    def __init__(self, fleet: str, name: str, *, options: NetworkOptions | None = None) -> None:
        super().__init__(f"zenohin://{check_name('fleet', fleet)}/{check_name('name', name)}")
        self._keys = KeySpace(fleet, name)
        self._options = options or NetworkOptions()
        self._freshness = FreshnessChecker(random.getrandbits(32))
        self._lease = ControlLease()
        self._clients: dict[Peer, ClientFilter] = {}
        self._refused = 0  # number of frames refused from clients that have left
        self._zenoh: Any = None  # the imported module; None before the opening
        self._publisher: Any = None  # sends to all clients; None while the link is not open
        self._may_have_conflict = False  # True if a liveliness token shows that the name may be in use
        self._is_serving = False  # True while clients are served
        self._name_conflict = asyncio.Event()  # set when another server sends a beacon under this name
        self._beacon_at = 0.0  # time of the last own beacon

    @property
    def peers(self) -> tuple[Peer, ...]:
        """Connected clients."""
        return tuple(self._clients)

    @property
    def lease_holder(self) -> str | None:
        """Client that has control; None: free."""
        return None if self._session is None else self._lease.holder(self._now())

    @property
    def late_datagrams(self) -> int:
        """Number of datagrams of clients that were refused as outdated."""
        return self._freshness.late

    @property
    def refused_frames(self) -> int:
        """Number of refused frames of clients: outdated frames, and commands without control."""
        return self._refused + sum(client.refused for client in self._clients.values())

    def write(self, data: bytes, peer: Peer = None) -> None:
        """See `Link.write`. Data for all clients is sent once."""
        if self._session is None or not self._is_serving:
            return
        attachment = SendTime(self._freshness.epoch, self._now()).encode()
        if peer is None:
            self._put_or_drop(lambda: self._publisher.put(bytes(data), attachment=attachment))
        elif peer in self._clients:
            self._put(self._keys.from_server(str(peer)), bytes(data), attachment)
        else:
            self._count_dropped(1)

    def has_peer(self, peer: Peer) -> bool:
        return peer in self._clients

    # ---------------------------------------------------------------------------------- opening and closing

    async def _connect(self) -> None:
        self._name_conflict.clear()
        self._queue = queue = LoopQueue()
        self._session = session = await open_session(self.address, self._options, partial(self._find_conflict, queue))
        self._released.clear()
        if self._may_have_conflict:
            with anyio.move_on_after(_BEACON_TIMEOUT_S):
                await self._name_conflict.wait()
                # Only a beacon leads here, because a time-out cancels wait() and ends the `with` block.
                raise LinkOpenError(f"cannot open {self.address}: another program has opened a server with this name")
        with zenoh_errors(self.address, self._zenoh):
            await open_in_thread(partial(self._serve, queue, session))
        self._is_serving = True
        self._send_beacon()

    def _find_conflict(self, queue: LoopQueue, zenoh: Any, session: Any) -> None:
        """Subscribe to beacons, and look for tokens of servers with this name. Runs on a thread of the executor."""

        def on_beacon(sample: Any) -> None:
            payload = payload_of(sample)
            if len(payload) <= MAX_PAYLOAD_BYTES:
                queue.post(partial(self._on_beacon, payload))

        self._zenoh = zenoh
        declared = [session.declare_subscriber(self._keys.beacon, on_beacon)]
        # A token alone does not prove that the name is in use, because the token of a killed program remains for a
        # while. A beacon proves it.
        tokens = session.liveliness().get(self._keys.server_token(), timeout=_TOKEN_QUERY_TIMEOUT_S)
        may_have_conflict = bool(list(tokens))
        if queue is self._queue:  # False if this opening was cancelled while the thread was working.
            self._declared, self._may_have_conflict = declared, may_have_conflict

    def _serve(self, queue: LoopQueue, session: Any) -> None:
        """Declare the subscribers, the publisher and the token. Runs on a thread of the executor."""
        zenoh, keys = self._zenoh, self._keys

        # The callbacks run on threads of zenoh, so they post to the event loop.
        def on_datagram(sample: Any) -> None:
            payload = payload_of(sample)
            if len(payload) <= MAX_PAYLOAD_BYTES:
                queue.post(partial(self._on_datagram, _client_of(sample), payload, attachment_of(sample)))

        def on_liveliness(sample: Any) -> None:
            has_joined = sample.kind == zenoh.SampleKind.PUT
            queue.post(partial(self._on_client_joined if has_joined else self._remove_client, _client_of(sample)))

        liveliness = session.liveliness()
        publisher = session.declare_publisher(keys.to_all_clients, congestion_control=zenoh.CongestionControl.DROP)
        declared = [
            session.declare_subscriber(keys.to_server(), on_datagram),
            liveliness.declare_subscriber(keys.client_token(), on_liveliness, history=True),
            liveliness.declare_token(keys.server_token(self._freshness.epoch)),
        ]
        if queue is self._queue:  # False if this opening was cancelled while the thread was working.
            self._publisher = publisher
            self._declared += declared

    def _on_release(self, session: Any) -> None:
        self._publisher = None
        self._clients.clear()
        if session is not None and self._is_serving:
            self._is_serving = False
            # The deletion of the beacon, with a send time of 0, tells clients that the server was closed.
            goodbye = SendTime(self._freshness.epoch, 0.0).encode()
            drop = self._zenoh.CongestionControl.DROP
            with contextlib.suppress(Exception):
                session.delete(self._keys.beacon, congestion_control=drop, attachment=goodbye)

    # ---------------------------------------------------------------------------------- receiving

    def _on_datagram(self, name: str, data: bytes, attachment: bytes) -> None:
        now = self._now()
        client = self._get_or_add_client(name)
        if client is None:
            return
        client.received_at = now
        stamp = Stamp.decode(attachment)
        is_fresh = self._freshness.is_fresh(stamp, now)
        if stamp is None or not is_fresh:  # Without a stamp, the datagram counts as late.
            self._send_notices(name, client.refuse_late(data, now), stamp)
            return
        # Do not tell the client that a duplicate or overtaken datagram was refused: the first copy or a newer datagram
        # was processed.
        if not self._freshness.is_new(name, stamp):
            return
        if stamp.mode == "take":
            self._lease.take(name, now)
        accepted, notices = client.receive(data, stamp.mode, now, stamp.nonce)
        self._send_notices(name, notices, stamp)
        if accepted:
            self._deliver(accepted, name)

    def _get_or_add_client(self, name: str) -> ClientFilter | None:
        """Return the client with this name, which is created if needed; None if there is no room for it."""
        client = self._clients.get(name)
        if client is None and len(self._clients) >= MAX_CLIENTS:
            self._remove_silent_client()
        if client is None and len(self._clients) < MAX_CLIENTS:
            with contextlib.suppress(InvalidArgument):  # A program other than aerokit may use an invalid name.
                client = self._clients[name] = ClientFilter(check_name("client", name), self._lease)
                client.received_at = self._now()
        return client

    def _remove_silent_client(self) -> None:
        # A client may have left although zenoh did not report the end of its token. It must not keep new clients out.
        oldest = min(self._clients, key=lambda name: self._clients[name].received_at)
        if self._now() - self._clients[oldest].received_at > CLIENT_TIMEOUT_S:
            self._remove_client(str(oldest))

    def _on_client_joined(self, name: str) -> None:
        # Send the next beacon earlier, because the new client waits for one.
        if self._get_or_add_client(name) is not None and self._timer is not None:
            self._timer.cancel()
            delay_s = max(0.0, self._beacon_at + _MIN_BEACON_INTERVAL_S - self._now())
            self._timer = asyncio.get_running_loop().call_later(delay_s, self._send_beacon)

    def _remove_client(self, name: str) -> None:
        client = self._clients.pop(name, None)
        if client is not None:
            self._refused += client.refused
            self._lease.release(name)

    def _on_beacon(self, data: bytes) -> None:
        beacon = Beacon.decode(data)
        if beacon is None or beacon.epoch == self._freshness.epoch:  # A beacon with this epoch is our own.
            return
        if self._name_conflict.is_set():  # Report a conflict only once.
            return
        self._name_conflict.set()
        if self._is_serving:
            logger.warning("%s: another program serves the same name; clients keep the first one", self.address)

    # ---------------------------------------------------------------------------------- sending

    def _send_beacon(self) -> None:
        self._beacon_at = now = self._now()
        self._put(self._keys.beacon, self._freshness.make_beacon(now, self._lease.holder(now)).encode(), b"")
        self._timer = asyncio.get_running_loop().call_later(BEACON_INTERVAL_S, self._send_beacon)

    def _send_notices(self, client: str, notices: list[RefusalNotice], stamp: Stamp | None) -> None:
        """Send notices about a datagram. Without its stamp, all programs with the client's name get them."""
        nonce = None if stamp is None else stamp.nonce
        for notice in notices:
            self._put(self._keys.notices(client), notice.replace(nonce=nonce).encode(), b"")

    def _put(self, key: str, data: bytes, attachment: bytes) -> None:
        drop = self._zenoh.CongestionControl.DROP
        session = self._session
        if session is not None:
            self._put_or_drop(lambda: session.put(key, data, congestion_control=drop, attachment=attachment))

    def _put_or_drop(self, put: Callable[[], object]) -> None:
        try:
            put()
        except Exception:  # zenoh raises various errors after its session has ended.
            self._count_dropped(1)


def _client_of(sample: Any) -> str:
    return str(sample.key_expr).rpartition("/")[2]
