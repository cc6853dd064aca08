"""Sessions of zenoh: made from an address's options, opened and closed without keeping the loop waiting."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import threading
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any, Generic, TypeVar

from aerokit._internal.values import Snapshot
from aerokit.errors import InvalidArgument, LinkOpenError
from aerokit.transport.link import BaseLink, needed

ItemT = TypeVar("ItemT")

MOST_WAITING = 2048
"""So much waits for a loop that does not come round; then the oldest goes."""

_AT_ONCE = 256  # in one turn of the loop, before everybody else gets one


class Handover(Generic[ItemT]):
    """``post(item)`` from any thread calls ``take(item)`` on the loop; nothing is called after :meth:`close`.

    At most ``most`` items wait; the oldest are dropped then, and counted. The loop is woken once for all that wait.
    """

    dropped: int

    def __init__(self, take: Callable[[ItemT], object], most: int = MOST_WAITING) -> None:
        self.dropped = 0
        """Items that the loop was too slow for."""
        self._loop = asyncio.get_running_loop()
        self._take: Callable[[ItemT], object] | None = take
        self._most = most
        self._waiting: deque[ItemT] = deque()
        self._is_called = False
        self._lock = threading.Lock()

    def post(self, item: ItemT) -> None:
        """Hand over; never blocks, never raises."""
        with self._lock:
            if self._take is None:
                return
            if len(self._waiting) >= self._most:
                self._waiting.popleft()
                self.dropped += 1
            self._waiting.append(item)
            if self._is_called:
                return
            self._is_called = True
        with contextlib.suppress(RuntimeError):  # the loop is closed
            self._loop.call_soon_threadsafe(self._drain)

    def close(self) -> None:
        """What waits is forgotten."""
        with self._lock:
            self._take = None
            self._waiting.clear()

    def _drain(self) -> None:
        """A burst of what waits."""
        for _ in range(_AT_ONCE):
            with self._lock:
                take = self._take
                if take is None or not self._waiting:
                    self._is_called = False
                    return
                item = self._waiting.popleft()
            try:
                take(item)
            except BaseException:
                self._loop.call_soon(self._drain)  # the others are handed over all the same
                raise
        self._loop.call_soon(self._drain)


async def opened_in_a_thread(work: Callable[[], ItemT], close: Callable[[ItemT], object]) -> ItemT:
    """What ``work()`` opens, in a thread of the loop's; ``close`` it when nobody waits for it any more.

    A thread cannot be stopped: when this is cancelled, what it opens is closed as soon as it is there.
    """
    opening = asyncio.get_running_loop().run_in_executor(None, work)

    def close_later(opened: asyncio.Future[ItemT]) -> None:
        if not opened.cancelled() and opened.exception() is None:
            close(opened.result())

    try:
        return await asyncio.shield(opening)
    except asyncio.CancelledError:
        opening.add_done_callback(close_later)
        raise


MOST_BYTES = 65535
"""Nothing larger is listened to: either side sends single frames, or as many as are in a datagram."""

_NOBODY_THERE = "Unable to connect to any of"

_ENDPOINTS = re.compile(r"[a-z]+/[^\s,()\[\]]+")  # "[Single(tcp/a:1)]", by 1.6 "[tcp/a:1]"

_TX = "transport/link/tx/queue"

_NO_WAITING = (f"{_TX}/congestion_control/drop/wait_before_drop", 0)
"""What is thrown away keeps nobody waiting; else a put may keep the loop for a millisecond, each time."""

_SETTINGS = (
    # Batches, of 64 KB at most: a burst of 1000 frames fits, a broken connection holds back no more than these.
    (f"{_TX}/size/data", 4),
    (f"{_TX}/size/real_time", 4),
    ("transport/shared_memory/enabled", False),  # frames are small; a pool for large messages is 16 MB
)


class NetworkOptions(Snapshot):
    """How a program is connected to a zenoh network; what is "" or None is as zenoh, or its file, has it."""

    connect: tuple[str, ...] = ()
    """Endpoints of routers and peers: "tcp/192.168.1.5:7447", "tls/…", "quic/…"."""
    listen: tuple[str, ...] = ()
    """Endpoints to listen on."""
    mode: str = ""
    """"peer" or "client"; "": a client where there is somebody to connect to and nothing to listen on, else a peer."""
    config: str = ""
    """A configuration file of zenoh's own (JSON5): TLS, access control, queues."""

    @property
    def scouts(self) -> bool:
        """Whether it looks for others by multicast, unless the file says otherwise: when nobody is named."""
        return not (self.connect or self.listen)


class NetworkLink(BaseLink):
    """What both sides of a name have: a session, what is declared in it, and a timer."""

    def __init__(self, address: str) -> None:
        super().__init__(address)
        self._session: Any = None
        self._declared: list[Any] = []  # they end when they are forgotten
        self._handover: Handover[Callable[[], object]] | None = None
        self._timer: asyncio.TimerHandle | None = None

    def _leave(self, session: Any) -> None:
        """Forget what is made of the session, and say goodbye; None: there is no session any more."""
        raise NotImplementedError

    def _release(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        if self._handover is not None:
            self._handover.close()
        session, self._session = self._session, None
        self._timer = self._handover = None
        self._declared = []
        self._leave(session)
        if session is not None:
            close_session(session, self._released.set)


def zenoh_module(address: str) -> Any:
    """The module ``zenoh``; LinkOpenError with what to install when it is not there."""
    return needed(address, "zenoh", "eclipse-zenoh", "zenoh")


async def open_session(address: str, options: NetworkOptions, prepare: Callable[[Any, Any], object]) -> Any:
    """Open a session; then ``prepare(zenoh, session)`` in the same thread, where declaring may take its time.

    Raises:
        LinkOpenError: zenoh is not installed, or could not open it.
        InvalidArgument: the configuration is wrong.
    """
    zenoh = zenoh_module(address)
    config = _config(zenoh, address, options)

    def work() -> Any:
        session = zenoh.open(config)
        try:
            prepare(zenoh, session)
        except BaseException:
            session.close()
            raise
        return session

    try:
        return await opened_in_a_thread(work, lambda session: close_session(session, _nothing))
    except zenoh.ZError as error:
        raise LinkOpenError(f"cannot open {address}: {_reason(error)}") from None


def close_session(session: Any, closed: Callable[[], object]) -> None:
    """Close it in a thread of the loop's; ``closed()`` is called on the loop then."""

    def work() -> None:
        with contextlib.suppress(Exception):  # whatever it says, it is closed
            session.close()

    try:
        future = asyncio.get_running_loop().run_in_executor(None, work)
    except RuntimeError:  # the loop is closed, or on its way
        work()
        closed()
    else:
        future.add_done_callback(lambda _: closed())


def payload_of(sample: Any) -> bytes:
    """The bytes of a sample."""
    return bytes(sample.payload.to_bytes())


def attachment_of(sample: Any) -> bytes:
    """The bytes of its attachment; empty when it has none."""
    attachment = sample.attachment
    return b"" if attachment is None else bytes(attachment.to_bytes())


def _config(zenoh: Any, address: str, options: NetworkOptions) -> Any:
    try:
        config = zenoh.Config.from_file(options.config) if options.config else zenoh.Config()
    except zenoh.ZError as error:
        raise InvalidArgument(f"{address}: config={options.config}: {_reason(error)}") from error
    try:
        for key, value in _settings(options):
            config.insert_json5(key, json.dumps(value))
    except zenoh.ZError as error:
        raise InvalidArgument(f"{address}: {_reason(error)}") from error
    for key, value in (_NO_WAITING, *(_SETTINGS if not options.config else ())):
        with contextlib.suppress(zenoh.ZError):  # another version's
            config.insert_json5(key, json.dumps(value))
    return config


def _settings(options: NetworkOptions) -> Iterable[tuple[str, object]]:
    if options.mode or not options.config:
        is_client = bool(options.connect) and not options.listen
        yield "mode", options.mode or ("client" if is_client else "peer")
    if options.connect:
        yield "connect/endpoints", list(options.connect)
    if options.listen:
        yield "listen/endpoints", list(options.listen)
    if not options.config and not options.scouts:
        yield "scouting/multicast/enabled", False
        yield "scouting/delay", 0  # nobody is waited for who would be found so
        if not options.listen:
            yield "listen/endpoints", []


def _reason(error: Exception) -> str:
    """Without the place in zenoh's source."""
    text = str(error).split(" at /", 1)[0].strip().rstrip("!.") or type(error).__name__
    if text.startswith(_NOBODY_THERE):
        where = ", ".join(_ENDPOINTS.findall(text)) or text
        return (
            f"nobody can be reached at {where} (is a router or peer running there, and is this its address?)"
        )
    return text.replace(": [", ": ")


def _nothing() -> None:
    pass
