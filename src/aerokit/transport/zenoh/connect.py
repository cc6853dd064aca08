"""``zenoh:`` link: a client of the vehicle with a given name on a zenoh network."""

from __future__ import annotations

import asyncio
import os
import random
import re
import socket
from collections.abc import Callable
from functools import partial
from typing import Any

import anyio

from aerokit.errors import InvalidArgument, LinkOpenError
from aerokit.transport.link import OrderRefusalListener, Peer
from aerokit.transport.zenoh.control_lease import ServerTracker, rejection_frames
from aerokit.transport.zenoh.keys import (
    CONTROL_MODES,
    Beacon,
    ControlMode,
    KeySpace,
    RefusalNotice,
    SendTime,
    check_name,
)
from aerokit.transport.zenoh.session import (
    MAX_PAYLOAD_BYTES,
    LoopQueue,
    NetworkLink,
    NetworkOptions,
    attachment_of,
    open_session,
    payload_of,
)

OPEN_TIMEOUT_S = 5.0
"""Default time-out of `ZenohConnect.open`."""

LOST_AFTER_S = 15.0
"""The server counts as lost after this silence, even if the network still reports it as alive."""

_POLL_INTERVAL_S = 0.25


class ZenohConnect(NetworkLink):
    """``zenoh:`` link: a client of one server (`ZenohListen`), found by its name.

    The link is lost when the server closes, when it is silent and the network reports it gone, or after
    `LOST_AFTER_S` of silence. Data that is written while no beacons arrive from the server is dropped, so that no
    command arrives late (docs/network.md).

    Args:
        fleet: name of the fleet, up to 63 letters, digits, ``_``, ``.`` and ``-``.
        name: name of the server in the fleet.
        options: connection to the network.
        client: name of this program, unique on the network; "": the name of this computer and a number.
        control: "free" acquires control with the first command, if no other client has it. "take" takes control when
            the link opens. "never" is read only.
        open_timeout_s: time-out for finding the server, above 0.

    Raises:
        InvalidArgument: an argument is wrong.
    """

    def __init__(
        self,
        fleet: str,
        name: str,
        *,
        options: NetworkOptions | None = None,
        client: str = "",
        control: ControlMode = "free",
        open_timeout_s: float = OPEN_TIMEOUT_S,
    ) -> None:
        super().__init__(f"zenoh://{check_name('fleet', fleet)}/{check_name('name', name)}")
        if control not in CONTROL_MODES:
            raise InvalidArgument(f"control = {control!r} is not allowed: it must be 'free', 'take' or 'never'")
        self.client: str = check_name("client", client or _own_name())
        """Name of this client on the network."""
        self._keys = KeySpace(fleet, name)
        self._options = options or NetworkOptions()
        self._open_timeout_s = open_timeout_s
        self._nonce = random.getrandbits(32)  # distinguishes this link from others that use the same client name
        self._tracker = ServerTracker(self._nonce, control)
        self._server_tokens: set[str] = set()  # keys of the servers that are alive, as reported by the network
        self._publisher: Any = None  # None while the link is not open
        self._first_beacon = asyncio.Event()  # set once the server was found

    @property
    def lease_holder(self) -> str | None:
        """Client that has control, as last reported by the server; None: free."""
        return self._tracker.lease_holder

    @property
    def late_frames(self) -> int:
        """Number of datagrams and beacons dropped because they arrived more than 2 s late.

        A datagram may contain several MAVLink frames.
        """
        return self._tracker.late

    def write(self, data: bytes, peer: Peer = None) -> None:
        """See `Link.write`. Drops data while no beacons arrive from the server."""
        if self._publisher is not None:
            self._put(bytes(data))

    # ---------------------------------------------------------------------------------- opening and closing

    async def _connect(self) -> None:
        self._first_beacon.clear()
        self._queue = LoopQueue()
        with anyio.move_on_after(self._open_timeout_s):
            self._session = await open_session(self.address, self._options, partial(self._declare, self._queue))
            self._released.clear()
            await self._first_beacon.wait()
            self._schedule_poll()
            return
        # Only a time-out leads here, because the `with` block returns after a success.
        if self._session is None:
            reason = f"the zenoh network was not reached within {self._open_timeout_s:g} s"
            raise LinkOpenError(f"cannot open {self.address}: {reason}")
        raise LinkOpenError(f"cannot open {self.address}: {self._describe_missing()}")

    def _declare(self, queue: LoopQueue, zenoh: Any, session: Any) -> None:
        """Declare the subscribers, the token and the publisher. Runs on a thread of the executor."""

        # The callbacks run on threads of zenoh, so each of them posts its sample to the event loop.
        def callback_for(process: Callable[[bytes, bytes], object]) -> Callable[[Any], None]:
            def on_sample(sample: Any) -> None:
                payload = payload_of(sample)
                if len(payload) <= MAX_PAYLOAD_BYTES:
                    queue.post(partial(process, payload, attachment_of(sample)))

            return on_sample

        def on_beacon(sample: Any) -> None:
            is_deleted = sample.kind == zenoh.SampleKind.DELETE  # A server that closes deletes its beacon.
            callback_for(self._on_server_closed if is_deleted else self._on_beacon)(sample)

        def on_liveliness(sample: Any) -> None:
            is_alive = sample.kind == zenoh.SampleKind.PUT
            queue.post(partial(self._on_liveliness, str(sample.key_expr), is_alive))

        keys, client = self._keys, self.client
        on_frames = callback_for(self._on_frames)
        liveliness = session.liveliness()
        declared = [
            session.declare_subscriber(keys.to_all_clients, on_frames),
            session.declare_subscriber(keys.from_server(client), on_frames),
            session.declare_subscriber(keys.notices(client), callback_for(self._on_notice)),
            session.declare_subscriber(keys.beacon, on_beacon),
            # The servers of the whole fleet are tracked, because the error text for a wrong name lists them.
            liveliness.declare_subscriber(KeySpace(keys.fleet, "*").server_token(), on_liveliness, history=True),
            liveliness.declare_token(keys.client_token(client)),
        ]
        publisher = session.declare_publisher(keys.to_server(client), congestion_control=zenoh.CongestionControl.DROP)
        if queue is self._queue:  # False if this opening was cancelled while the thread was working.
            self._declared, self._publisher = declared, publisher

    def _on_release(self, session: Any) -> None:
        self._publisher = None

    # ---------------------------------------------------------------------------------- receiving

    def _on_frames(self, data: bytes, attachment: bytes) -> None:
        sent = SendTime.decode(attachment)
        if sent is not None and self._tracker.accepts(sent, self._now()):
            self._deliver(data)

    def _on_server_closed(self, _data: bytes, attachment: bytes) -> None:
        sent = SendTime.decode(attachment)
        if sent is not None and sent.epoch == self._tracker.epoch:
            self._tracker.reset()
            self._lose("the server was closed")

    def _on_beacon(self, data: bytes, _attachment: bytes) -> None:
        beacon = Beacon.decode(data)
        if beacon is None or not self._tracker.receive_beacon(beacon, self._now()):
            return
        self._first_beacon.set()
        if self._tracker.mode == "take":
            if beacon.lease_holder == self.client:
                self._tracker.mode = "free"
            # An empty datagram carries the requested mode: "take" until this client has control, then "free" once.
            self._put(b"")

    def _on_notice(self, data: bytes, _attachment: bytes) -> None:
        notice = RefusalNotice.decode(data)
        # The nonce tells programs with the same client name apart. A notice without a nonce is for all of them.
        if notice is None or notice.nonce not in (None, self._nonce):
            return
        self._count_dropped(notice.count)
        if isinstance(self._receiver, OrderRefusalListener):
            answers = rejection_frames(notice.answer)
            self._receiver.order_refused(notice.message, notice.reason, notice.lease_holder, answers)

    def _on_liveliness(self, key: str, is_alive: bool) -> None:
        if is_alive:
            self._server_tokens.add(key)
        else:
            self._server_tokens.discard(key)

    # ---------------------------------------------------------------------------------- sending

    def _put(self, data: bytes) -> None:
        """Send a datagram to the server, or drop it while no beacons arrive from there."""
        stamp = self._tracker.make_stamp(self._now())
        if stamp is None:
            self._count_dropped(1)
            return
        try:
            self._publisher.put(data, attachment=stamp.encode())
        except Exception:  # zenoh raises various errors after its session has ended.
            self._count_dropped(1)

    # ---------------------------------------------------------------------------------- supervision

    def _schedule_poll(self) -> None:
        self._timer = asyncio.get_running_loop().call_later(_POLL_INTERVAL_S, self._poll)

    def _poll(self) -> None:
        tracker, now = self._tracker, self._now()
        if tracker.epoch is not None and tracker.is_silent(now):
            # The end of the liveliness token shows a loss earlier than a long silence does.
            if self._keys.server_token(tracker.epoch) not in self._server_tokens:
                self._lose("the server has left the network")
                return
            if now - tracker.received_at > LOST_AFTER_S:
                self._lose(f"nothing was received from the server for {LOST_AFTER_S:g} s")
                return
        self._schedule_poll()

    def _describe_missing(self) -> str:
        names = sorted({key.split("/")[2] for key in self._server_tokens})  # A key is aerokit/FLEET/NAME/alive/EPOCH.
        keys = self._keys
        if keys.name in names:
            return f"{keys.name} is on the network, but sent nothing for {self._open_timeout_s:g} s"
        hint = f" (available: {', '.join(names)})" if names else " (the fleet is empty)"
        return f"no server named {keys.name} in the fleet {keys.fleet}{hint}"


def _own_name() -> str:
    host = re.sub(r"[^A-Za-z0-9_-]", "-", socket.gethostname()).strip("-_")[:40] or "client"
    return f"{host}-{os.getpid()}-{random.getrandbits(16):04x}"
