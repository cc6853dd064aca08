"""``zenohin:``: puts what a hub, a ground station or a companion has on a zenoh network, under a name."""

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
from aerokit.transport.zenoh.control_lease import BEACON_EVERY_S, Gate, Helm, Judge
from aerokit.transport.zenoh.keys import Beacon, Place, Stamp, Told, check_name, sent_at
from aerokit.transport.zenoh.session import (
    MOST_BYTES,
    Handover,
    NetworkLink,
    NetworkOptions,
    attachment_of,
    open_session,
    payload_of,
)

MAX_CLIENTS = 64
"""Further clients are not listened to."""

SILENT_AFTER_S = 30.0
"""When there are so many, one that nothing has come of for so long makes room."""

_SOONEST_S = 0.02  # after the last beacon, whoever comes
_RIVAL_WAIT_S = 2.5 * BEACON_EVERY_S

logger: logging.Logger = logging.getLogger("aerokit")


class ZenohListen(NetworkLink):
    """``zenohin:`` serves the clients (`ZenohConnect`) of one name; each is a peer, by its name.

    Losing one of them, all of them, or the network itself does not lose the link. What comes of a client and is not
    from now, or is an order although another one has the helm, is refused, counted, and the client is told.

    Args:
        fleet: its name, up to 63 letters, digits, ``_``, ``.`` and ``-``.
        name: of this vehicle side in the fleet; no other may have it.
        options: how this program is connected to the network.

    Raises:
        InvalidArgument: an argument is wrong.
    """

    def __init__(self, fleet: str, name: str, *, options: NetworkOptions | None = None) -> None:
        super().__init__(f"zenohin://{check_name('fleet', fleet)}/{check_name('name', name)}")
        self._place = Place(fleet, name)
        self._options = options or NetworkOptions()
        self._judge = Judge(random.getrandbits(32))
        self._helm = Helm()
        self._clients: dict[Peer, Gate] = {}
        self._refused = 0  # of clients that have gone
        self._zenoh: Any = None
        self._everybody: Any = None
        self._has_others = self._is_serving = False
        self._rival = asyncio.Event()
        self._beaten_at = 0.0

    @property
    def peers(self) -> tuple[Peer, ...]:
        """The clients that are there now."""
        return tuple(self._clients)

    @property
    def helm(self) -> str | None:
        """The client that has the helm; None: it is free."""
        return None if self._session is None else self._helm.holder(self._now())

    @property
    def late_datagrams(self) -> int:
        """Datagrams of clients that were refused because they were not proven to be from now."""
        return self._judge.late

    @property
    def refused_frames(self) -> int:
        """Frames of clients that were refused: late, or orders of somebody without the helm."""
        return self._refused + sum(gate.refused for gate in self._clients.values())

    def write(self, data: bytes, peer: Peer = None) -> None:
        """See `Link.write`; to everybody it is sent once, whoever listens."""
        if self._session is None or not self._is_serving:
            return
        attachment = sent_at(self._judge.epoch, self._now())
        if peer is None:
            self._try(lambda: self._everybody.put(bytes(data), attachment=attachment))
        elif peer in self._clients:
            self._put(self._place.from_vehicle(str(peer)), bytes(data), attachment)
        else:
            self._drop(1)

    def has_peer(self, peer: Peer) -> bool:
        """See `Link.has_peer`."""
        return peer in self._clients

    # ---------------------------------------------------------------------------------- opening and closing

    async def _connect(self) -> None:
        self._handover = Handover(_call)
        self._session = await open_session(
            self.address, self._options, partial(self._look_around, self._handover)
        )
        self._released.clear()
        if self._has_others:
            with anyio.move_on_after(_RIVAL_WAIT_S):
                await self._rival.wait()
                raise LinkOpenError(f"cannot open {self.address}: another program serves this name")
        self._is_serving = True
        self._serve(self._handover)
        self._beat()

    def _look_around(self, handover: Handover[Callable[[], object]], zenoh: Any, session: Any) -> None:
        """On a thread: is the name taken? A token alone may be that of a program that was killed just now."""

        def hear_beacon(sample: Any) -> None:
            payload = payload_of(sample)
            if len(payload) <= MOST_BYTES:
                handover.post(partial(self._hear_beacon, payload))

        self._zenoh = zenoh
        self._declared = [session.declare_subscriber(self._place.beacon, hear_beacon)]
        self._has_others = any(True for _ in session.liveliness().get(self._place.alive(), timeout=1.0))

    def _serve(self, handover: Handover[Callable[[], object]]) -> None:
        zenoh, session, place = self._zenoh, self._session, self._place

        def hear(sample: Any) -> None:
            client, payload = str(sample.key_expr).rpartition("/")[2], payload_of(sample)
            if len(payload) <= MOST_BYTES:
                handover.post(partial(self._hear, client, payload, attachment_of(sample)))

        def hear_client(sample: Any) -> None:
            client, is_put = str(sample.key_expr).rpartition("/")[2], sample.kind == zenoh.SampleKind.PUT
            handover.post(partial(self._greet if is_put else self._go, client))

        liveliness = session.liveliness()
        self._everybody = session.declare_publisher(
            place.everybody, congestion_control=zenoh.CongestionControl.DROP
        )
        self._declared += [
            session.declare_subscriber(place.to_vehicle(), hear),
            liveliness.declare_subscriber(place.client(), hear_client, history=True),
            liveliness.declare_token(place.alive(self._judge.epoch)),
        ]

    def _leave(self, session: Any) -> None:
        self._everybody = None
        self._clients.clear()
        if session is not None and self._is_serving:
            self._is_serving = False
            goodbye = sent_at(self._judge.epoch, 0.0)
            drop = self._zenoh.CongestionControl.DROP
            with contextlib.suppress(Exception):
                session.delete(self._place.beacon, congestion_control=drop, attachment=goodbye)

    # ---------------------------------------------------------------------------------- what comes in

    def _hear(self, client: str, data: bytes, attachment: bytes) -> None:
        gate, now = self._come(client), self._now()
        if gate is None:
            return
        gate.heard_at = now
        stamp, late = Stamp.decode(attachment), self._judge.late
        if not self._judge.accepts(client, stamp, now) or stamp is None:
            if self._judge.late > late:
                self._tell(client, gate.refuse_late(data, now))
            return
        if stamp.wish == "take":
            self._helm.take(client, now)
        passed, told = gate.receive(data, stamp.wish, now, stamp.nonce)
        self._tell(client, told)
        if passed:
            self._deliver(passed, client)

    def _come(self, client: str) -> Gate | None:
        gate = self._clients.get(client)
        if gate is None and len(self._clients) >= MAX_CLIENTS:
            self._forget_one_that_is_silent()
        if gate is None and len(self._clients) < MAX_CLIENTS:
            with contextlib.suppress(InvalidArgument):  # not a name: somebody else's key
                gate = self._clients[client] = Gate(check_name("client", client), self._helm)
                gate.heard_at = self._now()
        return gate

    def _forget_one_that_is_silent(self) -> None:
        """Whoever has put something and is no client, or whose end was not noticed, keeps nobody else away."""
        silent = min(self._clients, key=lambda each: self._clients[each].heard_at)
        if self._now() - self._clients[silent].heard_at > SILENT_AFTER_S:
            self._go(str(silent))

    def _greet(self, client: str) -> None:
        """It need not wait for the next beacon: it knows at once that we are there."""
        if self._come(client) is not None and self._timer is not None:
            self._timer.cancel()
            soon = max(0.0, self._beaten_at + _SOONEST_S - self._now())
            self._timer = asyncio.get_running_loop().call_later(soon, self._beat)

    def _go(self, client: str) -> None:
        gate = self._clients.pop(client, None)
        if gate is not None:
            self._refused += gate.refused
            self._helm.leave(client)

    def _hear_beacon(self, data: bytes) -> None:
        beacon = Beacon.decode(data)
        if beacon is None or beacon.epoch == self._judge.epoch or self._rival.is_set():
            return
        self._rival.set()
        if self._is_serving:
            logger.warning(
                "%s: another program serves this name, too; clients stay with theirs", self.address
            )

    # ---------------------------------------------------------------------------------- what goes out

    def _beat(self) -> None:
        """The beacon is what proves to clients that we are there, and to us that what they send is from now."""
        self._beaten_at = now = self._now()
        self._put(self._place.beacon, self._judge.beacon(now, self._helm.holder(now)).encode(), b"")
        self._timer = asyncio.get_running_loop().call_later(BEACON_EVERY_S, self._beat)

    def _tell(self, client: str, told: list[Told]) -> None:
        for each in told:
            self._put(self._place.told(client), each.encode(), b"")

    def _put(self, key: str, data: bytes, attachment: bytes) -> None:
        drop = self._zenoh.CongestionControl.DROP
        session = self._session
        if session is not None:
            self._try(lambda: session.put(key, data, congestion_control=drop, attachment=attachment))

    def _try(self, put: Callable[[], object]) -> None:
        try:
            put()
        except Exception:  # zenoh's own: the session has ended
            self._drop(1)

    def _now(self) -> float:
        return asyncio.get_running_loop().time()


def _call(what: Callable[[], object]) -> object:
    return what()
