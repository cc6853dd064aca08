"""``zenoh:``: a program that talks with the vehicle behind a name of a zenoh network, as if by radio."""

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
from aerokit.transport.link import HelmListener, Peer
from aerokit.transport.zenoh.control_lease import Ears, refusals_in
from aerokit.transport.zenoh.keys import WISHES, Beacon, Place, Told, Wish, check_name, read_sent_at
from aerokit.transport.zenoh.session import (
    MOST_BYTES,
    Handover,
    NetworkLink,
    NetworkOptions,
    attachment_of,
    open_session,
    payload_of,
)

OPEN_TIMEOUT_S = 5.0
"""Seconds that `ZenohConnect.open` waits for the vehicle side by default."""

LOST_AFTER_S = 15.0
"""A vehicle side that was not heard for so long is lost, whatever the network says of it."""

_LOOK_EVERY_S = 0.25


class ZenohConnect(NetworkLink):
    """``zenoh:`` is a client of one vehicle side (`ZenohListen`), which is found by its name.

    The vehicle side's end is a lost link, and so is its silence once the network has noticed it, or for `LOST_AFTER_S`.
    What is written while its beacons do not come is dropped: an order is never late (docs/network.md).

    Args:
        fleet: its name, up to 63 letters, digits, ``_``, ``.`` and ``-``.
        name: of the vehicle side in the fleet.
        options: how this program is connected to the network.
        client: who this program is, unlike all others on the network; "": the name of this computer and a number.
        wish: "free": it has the helm when it orders and nobody else has it; "take": it takes it once it is open;
            "never": nothing but questions is let through.
        open_timeout_s: seconds that opening waits for the vehicle side, above 0.

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
        wish: Wish = "free",
        open_timeout_s: float = OPEN_TIMEOUT_S,
    ) -> None:
        super().__init__(f"zenoh://{check_name('fleet', fleet)}/{check_name('name', name)}")
        if wish not in WISHES:
            raise InvalidArgument(f"helm = {wish!r} is not allowed: {', '.join(WISHES)}")
        self.client: str = check_name("client", client or _own_name())
        """Who we are, to the others: the name that has the helm."""
        self._place = Place(fleet, name)
        self._options = options or NetworkOptions()
        self._open_timeout_s = open_timeout_s
        self._wants_helm = wish == "take"
        self._ears = Ears(random.getrandbits(32), "never" if wish == "never" else "free")
        self._alive: set[str] = set()  # keys of vehicle sides that the network knows
        self._publisher: Any = None
        self._first_beacon = asyncio.Event()

    @property
    def helm(self) -> str | None:
        """Who has the helm, as the vehicle side told last; None: nobody."""
        return self._ears.helm

    @property
    def late_frames(self) -> int:
        """Datagrams and beacons of the vehicle side that came more than 2 s late, and were not listened to."""
        return self._ears.late

    def write(self, data: bytes, peer: Peer = None) -> None:
        """See `Link.write`; drops what could not be proven to be from now."""
        if self._publisher is not None:
            self._put(bytes(data), self._wish_now())

    # ---------------------------------------------------------------------------------- opening and closing

    async def _connect(self) -> None:
        self._first_beacon.clear()
        self._handover = Handover(_call)
        with anyio.move_on_after(self._open_timeout_s):
            self._session = await open_session(
                self.address, self._options, partial(self._declare, self._handover)
            )
            self._released.clear()
            await self._first_beacon.wait()
            self._look_later()
            return
        if self._session is None:
            raise LinkOpenError(f"cannot open {self.address}: no network within {self._open_timeout_s:g} s")
        raise LinkOpenError(f"cannot open {self.address}: {self._who_is_there()}")

    def _declare(self, handover: Handover[Callable[[], object]], zenoh: Any, session: Any) -> None:
        """On a thread, as are the callbacks."""

        def hear(take: Callable[[bytes, bytes, bool], object]) -> Callable[[Any], None]:
            def called(sample: Any) -> None:
                is_put, payload = sample.kind == zenoh.SampleKind.PUT, payload_of(sample)
                if len(payload) <= MOST_BYTES:
                    handover.post(partial(take, payload, attachment_of(sample), is_put))

            return called

        def hear_alive(sample: Any) -> None:
            is_put = sample.kind == zenoh.SampleKind.PUT
            handover.post(partial(self._hear_alive, str(sample.key_expr), is_put))

        place, client = self._place, self.client
        frames, liveliness = hear(self._hear_frames), session.liveliness()
        self._declared = [
            session.declare_subscriber(place.everybody, frames),
            session.declare_subscriber(place.from_vehicle(client), frames),
            session.declare_subscriber(place.told(client), hear(self._hear_told)),
            session.declare_subscriber(place.beacon, hear(self._hear_beacon)),
            # all of the fleet: for the text of the error when the name is not there
            liveliness.declare_subscriber(Place(place.fleet, "*").alive(), hear_alive, history=True),
            liveliness.declare_token(place.client(client)),
        ]
        self._publisher = session.declare_publisher(
            place.to_vehicle(client), congestion_control=zenoh.CongestionControl.DROP
        )

    def _leave(self, session: Any) -> None:
        self._publisher = None

    # ---------------------------------------------------------------------------------- what comes in

    def _hear_frames(self, data: bytes, attachment: bytes, _is_put: bool) -> None:
        sent = read_sent_at(attachment)
        if sent is not None and self._ears.hears(*sent, self._now()):
            self._deliver(data)

    def _hear_beacon(self, data: bytes, attachment: bytes, is_put: bool) -> None:
        if not is_put:
            sent = read_sent_at(attachment)
            if sent is not None and sent[0] == self._ears.epoch:
                self._ears.forget()
                self._lose("the vehicle side was closed")
            return
        beacon = Beacon.decode(data)
        if beacon is None or not self._ears.hear_beacon(beacon, self._now()):
            return
        self._first_beacon.set()
        if self._wants_helm:
            self._wants_helm = beacon.helm != self.client
            self._put(b"", self._wish_now())

    def _hear_told(self, data: bytes, _attachment: bytes, _is_put: bool) -> None:
        told = Told.decode(data)
        if told is None:
            return
        self._drop(told.count)
        if isinstance(self._receiver, HelmListener):
            self._receiver.order_refused(told.message, told.reason, told.helm, refusals_in(told.answer))

    def _hear_alive(self, key: str, is_alive: bool) -> None:
        (self._alive.add if is_alive else self._alive.discard)(key)

    # ---------------------------------------------------------------------------------- what goes out

    def _wish_now(self) -> Wish | None:
        return "take" if self._wants_helm else None

    def _put(self, data: bytes, wish: Wish | None) -> None:
        stamp = self._ears.stamp(self._now(), wish)
        if stamp is None:
            self._drop(1)
            return
        try:
            self._publisher.put(data, attachment=stamp.encode())
        except Exception:  # zenoh's own: the session has ended
            self._drop(1)

    # ---------------------------------------------------------------------------------- is it there?

    def _now(self) -> float:
        return asyncio.get_running_loop().time()

    def _look_later(self) -> None:
        self._timer = asyncio.get_running_loop().call_later(_LOOK_EVERY_S, self._look)

    def _look(self) -> None:
        ears, now = self._ears, self._now()
        if ears.epoch is not None and ears.is_silent(now):
            if self._place.alive(ears.epoch) not in self._alive:
                self._lose("the vehicle side has gone")
                return
            if now - ears.heard_at > LOST_AFTER_S:
                self._lose(f"nothing has come from the vehicle side for {LOST_AFTER_S:g} s")
                return
        self._look_later()

    def _who_is_there(self) -> str:
        names = sorted({key.split("/")[2] for key in self._alive})
        place = self._place
        if place.name in names:
            return (
                f"{place.name} is on the network, but nothing was heard of it for {self._open_timeout_s:g} s"
            )
        others = f" (there are: {', '.join(names)})" if names else " (nobody else either)"
        return f"nobody is called {place.name} in the fleet {place.fleet}{others}"


def _own_name() -> str:
    host = re.sub(r"[^A-Za-z0-9_-]", "-", socket.gethostname()).strip("-_")[:40] or "client"
    return f"{host}-{os.getpid()}-{random.getrandbits(16):04x}"


def _call(what: Callable[[], object]) -> object:
    return what()
