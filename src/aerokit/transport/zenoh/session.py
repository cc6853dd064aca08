"""zenoh sessions: configured by an address's options, opened and closed without blocking the event loop."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar

from aerokit._internal.values import Snapshot
from aerokit.errors import InvalidArgument, LinkOpenError
from aerokit.transport.link import BaseLink, import_optional

ItemT = TypeVar("ItemT")

MAX_QUEUED = 2048
"""Maximum number of calls that wait for a blocked event loop. A further call replaces the oldest."""

_MAX_PER_ITERATION = 256  # maximum number of calls in one loop iteration, so that other tasks can run


class LoopQueue:
    """Queue from other threads to the event loop: ``post(call)`` in any thread runs ``call()`` on the loop.

    At most ``limit`` calls wait. A further call replaces the oldest, which is counted as dropped. The loop is woken
    once for all waiting calls.
    """

    def __init__(self, limit: int = MAX_QUEUED) -> None:
        self.dropped: int = 0
        """Number of dropped calls."""
        self._loop = asyncio.get_running_loop()
        self._limit = limit
        self._waiting: deque[Callable[[], object]] = deque()
        self._is_closed = False
        self._is_scheduled = False  # True while a call of `_drain` is pending
        self._lock = threading.Lock()  # protects all of these attributes

    def post(self, call: Callable[[], object]) -> None:
        """Add a call. Never blocks or raises. Does nothing after :meth:`close`."""
        with self._lock:
            if self._is_closed:
                return
            if len(self._waiting) >= self._limit:
                self._waiting.popleft()
                self.dropped += 1
            self._waiting.append(call)
            if self._is_scheduled:
                return
            self._is_scheduled = True
        with contextlib.suppress(RuntimeError):  # The loop may be closed.
            self._loop.call_soon_threadsafe(self._drain)

    def close(self) -> None:
        with self._lock:
            self._is_closed = True
            self._waiting.clear()

    def _drain(self) -> None:
        for _ in range(_MAX_PER_ITERATION):
            with self._lock:
                if not self._waiting:
                    self._is_scheduled = False
                    return
                call = self._waiting.popleft()
            try:
                call()
            except BaseException:
                self._loop.call_soon(self._drain)  # The other calls must run although this one failed.
                raise
        self._loop.call_soon(self._drain)


async def open_in_thread(work: Callable[[], ItemT], close: Callable[[ItemT], object] = lambda _: None) -> ItemT:
    """Run ``work()`` in a thread and return what it opens.

    A thread cannot be stopped. After a cancellation, the result is passed to ``close`` as soon as it is available.
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


MAX_PAYLOAD_BYTES = 65535
"""Maximum payload; larger payloads are ignored. Both sides send single frames or the frames of one datagram."""

_CONNECT_FAILED = "Unable to connect to any of"

# zenoh 1.6 formats endpoints as "[tcp/a:1]", other versions as "[Single(tcp/a:1)]".
_ENDPOINTS = re.compile(r"[a-z]+/[^\s,()\[\]]+")

_TX = "transport/link/tx/queue"

# By default, zenoh waits for a millisecond before it drops data of a put(). The wait would block the event loop.
_DROP_AT_ONCE = (f"{_TX}/congestion_control/drop/wait_before_drop", 0)

_DEFAULT_SETTINGS = (
    # Maximum number of waiting batches of up to 64 KB. Four are enough for a burst of 1000 frames. The number is small,
    # because data in the queue of a broken connection arrives late.
    (f"{_TX}/size/data", 4),
    (f"{_TX}/size/real_time", 4),
    ("transport/shared_memory/enabled", False),  # The memory pool, which is for large messages, would take 16 MB.
)


class NetworkOptions(Snapshot):
    """Connection to a zenoh network. Empty values use the defaults of zenoh or of the configuration file."""

    connect: tuple[str, ...] = ()
    """Endpoints of routers and peers: "tcp/192.168.1.5:7447", "tls/…", "quic/…"."""
    listen: tuple[str, ...] = ()
    """Endpoints to listen on."""
    mode: str = ""
    """Mode: "peer" or "client"; "": client if endpoints are given in `connect` only, otherwise peer."""
    config: str = ""
    """zenoh configuration file (JSON5): TLS, access control, queues."""

    @property
    def scouts(self) -> bool:
        """True if no endpoints are given: peers are then discovered by multicast, unless the file disables it."""
        return not (self.connect or self.listen)


class NetworkLink(BaseLink):
    """Common base of both sides of a zenoh link: a session, its declarations, and a timer."""

    def __init__(self, address: str) -> None:
        super().__init__(address)
        self._session: Any = None  # None while the link is not open
        self._declared: list[Any] = []  # references to all declarations, which would end when garbage-collected
        self._queue: LoopQueue | None = None  # passes calls of zenoh's threads to the loop
        self._timer: asyncio.TimerHandle | None = None

    def _now(self) -> float:
        return asyncio.get_running_loop().time()

    def _on_release(self, session: Any) -> None:
        """Release the session's objects. ``session`` is None if none is open."""
        raise NotImplementedError

    def _release(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        if self._queue is not None:
            self._queue.close()
        session, self._session = self._session, None
        self._timer = self._queue = None
        self._declared = []
        self._on_release(session)
        if session is not None:
            close_session(session, self._released.set)


async def open_session(address: str, options: NetworkOptions, declare: Callable[[Any, Any], object]) -> Any:
    """Open a session in a thread, and call ``declare(zenoh, session)`` there, because declarations may block.

    Raises:
        LinkOpenError: zenoh is not installed, or the session could not be opened.
        InvalidArgument: the configuration is wrong.
    """
    zenoh = import_optional(address, "zenoh", "eclipse-zenoh", "zenoh")
    config = _config(zenoh, address, options)

    def work() -> Any:
        session = zenoh.open(config)
        try:
            declare(zenoh, session)
        except BaseException:
            session.close()
            raise
        return session

    with zenoh_errors(address, zenoh):
        return await open_in_thread(work, close_session)


@contextlib.contextmanager
def zenoh_errors(address: str, zenoh: Any) -> Iterator[None]:
    """Convert zenoh's errors to LinkOpenError."""
    try:
        yield
    except zenoh.ZError as error:
        raise LinkOpenError(f"cannot open {address}: {_reason(error)}") from None


def close_session(session: Any, closed: Callable[[], object] = lambda: None) -> None:
    """Close a session on a thread, and then call ``closed()``."""

    def work() -> None:
        with contextlib.suppress(Exception):  # The session is closed even if close() raises.
            session.close()

    try:  # Closing may block.
        future = asyncio.get_running_loop().run_in_executor(None, work)
    except RuntimeError:  # The loop is closed or closing.
        work()
        closed()
    else:
        future.add_done_callback(lambda _: closed())


def payload_of(sample: Any) -> bytes:
    return bytes(sample.payload.to_bytes())


def attachment_of(sample: Any) -> bytes:
    attachment = sample.attachment
    return b"" if attachment is None else bytes(attachment.to_bytes())


def _config(zenoh: Any, address: str, options: NetworkOptions) -> Any:
    try:
        config = zenoh.Config.from_file(options.config) if options.config else zenoh.Config()
    except zenoh.ZError as error:
        raise InvalidArgument(f"{address}: config={options.config} cannot be used: {_reason(error)}") from error
    try:
        for key, value in _settings(options):
            config.insert_json5(key, json.dumps(value))
    except zenoh.ZError as error:
        raise InvalidArgument(f"{address}: zenoh does not accept the options: {_reason(error)}") from error
    defaults = () if options.config else _DEFAULT_SETTINGS  # A configuration file replaces the default settings.
    for key, value in (_DROP_AT_ONCE, *defaults):
        with contextlib.suppress(zenoh.ZError):  # Some versions of zenoh do not know the option.
            config.insert_json5(key, json.dumps(value))
    return config


def _settings(options: NetworkOptions) -> Iterable[tuple[str, object]]:
    if options.mode or not options.config:  # Without `mode`, a configuration file determines the mode.
        is_client = bool(options.connect) and not options.listen
        yield "mode", options.mode or ("client" if is_client else "peer")
    if options.connect:
        yield "connect/endpoints", list(options.connect)
    if options.listen:
        yield "listen/endpoints", list(options.listen)
    if not options.config and not options.scouts:
        yield "scouting/multicast/enabled", False
        yield "scouting/delay", 0  # By default, opening a session waits for peers to be discovered.
        if not options.listen:
            yield "listen/endpoints", []  # By default, a peer listens on all interfaces.


def _reason(error: Exception) -> str:
    description, _, _ = str(error).partition(" at /")  # The location in zenoh's source follows.
    text = description.strip().rstrip("!.") or type(error).__name__
    if text.startswith(_CONNECT_FAILED):
        endpoints = ", ".join(_ENDPOINTS.findall(text)) or text
        return f"cannot connect to {endpoints} (is a router or peer running there, and is this its address?)"
    return text.replace(": [", ": ")
