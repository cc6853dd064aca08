"""What the generated twins are made of: how each is opened, entered, iterated and left."""

from __future__ import annotations

import contextlib
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Generic, NoReturn, TypeVar

from aerokit._internal.async_block import ReadOnly
from aerokit.errors import ConnectionClosed
from aerokit.sync.loop_thread import Held, LoopThread
from aerokit.vehicle.connect import tell_how_it_is_left

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterator
    from contextlib import AbstractAsyncContextManager, AbstractContextManager
    from types import TracebackType

    from typing_extensions import Self

    from aerokit.connection.bus import Subscription  # noqa: F401 - named in the base classes below
    from aerokit.connection.cells import Changes, StateCell  # noqa: F401
    from aerokit.connection.connection import Connection
    from aerokit.events import VehicleFound
    from aerokit.fleets.formations import Following
    from aerokit.vehicle.camera.capture import Capture
    from aerokit.vehicle.camera.part import CameraBlock
    from aerokit.vehicle.camera.shooting import PhotoInterval
    from aerokit.vehicle.commanding.guided import SetpointStream
    from aerokit.vehicle.gimbal.control import GimbalControl
    from aerokit.vehicle.gimbal.gimbal import Gimbals  # noqa: F401
    from aerokit.vehicle.gimbal.rates import GimbalRates
    from aerokit.vehicle.parameters.transaction import Temporarily, Transaction
    from aerokit.vehicle.parameters.writing import ParameterWrite
    from aerokit.vehicle.vehicle import Vehicle


class BlockingBlock:
    """A base of what :mod:`aerokit.sync` opens. Nobody else would close it then, so it is closed first."""

    _opened_by: str
    """The function that makes one."""

    def close(self) -> None:
        """End it; idempotent."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    if not TYPE_CHECKING:  # type checkers know that they are not there

        def __await__(self) -> NoReturn:
            self._misused("await")

        async def __aenter__(self) -> NoReturn:
            self._misused("async with")

        async def __aexit__(self, *_: object) -> None:
            """Never: it cannot be entered so. Python looks for it first."""

    def _misused(self, word: str) -> NoReturn:
        self.close()
        name = self._opened_by
        raise TypeError(
            f"aerokit.sync.{name}(…) blocks, and is not for `{word}`: write `with aerokit.sync.{name}(…) as …:`, or"
            f" `async with aerokit.{name}(…) as …:` in an async function; what was opened is closed again"
        )


A = TypeVar("A")

T = TypeVar("T")

EnteredT = TypeVar("EnteredT")

LeftT = TypeVar(
    "LeftT",
    bound="CameraBlock | Following | GimbalControl | GimbalRates | PhotoInterval | SetpointStream[Any]",
)

BlockT = TypeVar("BlockT", bound="Temporarily | Transaction")

TwinT = TypeVar("TwinT", bound="ConnectionTwin | VehicleTwin")


class TwinOf(ReadOnly, Generic[A]):
    """A twin: the loop that it calls, and the asynchronous object that it stands for."""

    def __init__(self, loop: LoopThread, aio: A) -> None:
        self._loop, self._aio = loop, aio

    @property
    def aio(self) -> A:
        """The asynchronous object, for code that runs on the loop."""
        self._loop.feed()
        return self._aio

    @contextmanager
    def _block(self, block: AbstractContextManager[T]) -> Iterator[T]:
        """Enter and leave a block of the loop's."""
        entered = self._loop.enter_at_once(block)
        try:
            yield entered
        finally:
            with contextlib.suppress(ConnectionClosed):
                self._loop.call(block.__exit__, None, None, None)

    @contextmanager
    def _twin_block(
        self, twin: Callable[[LoopThread, T], EnteredT], block: AbstractContextManager[T]
    ) -> Iterator[EnteredT]:
        """A block that gives something that has a twin."""
        with self._block(block) as entered:
            yield twin(self._loop, entered)


class CellTwin(TwinOf["StateCell[T]"], Generic[T]):
    """Reading takes a snapshot on the caller's thread: it neither talks to the vehicle nor waits for the loop."""

    def __repr__(self) -> str:
        return repr(self.aio)

    def __bool__(self) -> bool:
        return bool(self.aio)  # which says what to write instead

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            if name.startswith("_"):  # as copy asks for them before anything is made
                raise AttributeError(name)
            return getattr(self.aio, name)  # which says what was perhaps meant


class ChangesTwin(TwinOf["Changes[T]"], Generic[T]):
    """An iterator."""

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> T:
        return self._loop.run(self.aio.__anext__)


def _next_of(loop: LoopThread, items: AsyncIterator[T]) -> T:
    """The next one; StopIteration at their end: StopAsyncIteration cannot leave a coroutine."""

    async def read() -> tuple[T, ...]:
        try:
            return (await items.__anext__(),)
        except StopAsyncIteration:
            return ()

    found = loop.run(read)
    if not found:
        raise StopIteration
    return found[0]


class SubscriptionTwin(TwinOf["Subscription[T]"], Generic[T]):
    """Registered on entry of its ``with``, gone at its exit; an iterator."""

    def __enter__(self) -> Self:
        self._loop.enter_at_once(self.aio)
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        with contextlib.suppress(ConnectionClosed):  # then it has been closed already
            self._loop.call(self.aio.close)

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> T:
        return _next_of(self._loop, self.aio)


class BlockTwin(TwinOf[LeftT]):
    """What holds while its ``with`` lasts."""

    def __enter__(self) -> Self:
        self._loop.enter(self.aio)
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._loop.run(self.aio.__aexit__, exc_type, exc, traceback)


class StreamTwin(BlockTwin["SetpointStream[T]"], Generic[T]):
    """Set-points are sent while its ``with`` lasts."""


class GimbalsTwin(TwinOf["Gimbals"], Generic[T]):
    """They are found by their ids; an iterable of ``T``, the twin of a gimbal."""

    if TYPE_CHECKING:  # generated

        @property
        def ids(self) -> tuple[int, ...]:
            """Of those that were heard of."""
            raise NotImplementedError

        def get(self, device_id: int) -> T:
            """The gimbal of this id."""
            raise NotImplementedError

    def __getitem__(self, device_id: int) -> T:
        return self.get(device_id)

    def __iter__(self) -> Iterator[T]:
        return iter([self.get(each) for each in self.ids])

    def __len__(self) -> int:
        return len(self.ids)


class PhotoIntervalTwin(BlockTwin["PhotoInterval"]):
    """Pictures are taken while its ``with`` lasts; an iterator over them."""

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Capture:
        return _next_of(self._loop, self.aio)


class ToItsEndTwin(TwinOf[BlockT]):
    """Its ``with`` is left to the end, whatever comes: a Ctrl-C does not leave half of it."""

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._loop.run_to_its_end(self.aio.__aexit__, exc_type, exc, traceback)


class TemporarilyTwin(ToItsEndTwin["Temporarily"]):
    """Its ``with`` gives the results of the writes; the values before are put back, whatever comes."""

    def __enter__(self) -> dict[str, ParameterWrite]:
        return self._loop.enter(self.aio)


class TransactionTwin(ToItsEndTwin["Transaction"]):
    """Taken back at the end of its ``with`` if an error leaves it, whatever comes."""

    def __enter__(self) -> Self:
        self._loop.enter(self.aio)
        return self


class ConnectionTwin(TwinOf["Connection"], BlockingBlock):
    """A context manager; the loop's thread ends with it if it was opened for it."""

    _opened_by = "open_connection"

    def __init__(self, loop: LoopThread, aio: Connection, held: Held[Connection] | None = None) -> None:
        super().__init__(loop, aio)
        self._held = held

    def vehicles(self) -> Iterator[VehicleFound]:
        """Each autopilot once: those that were heard already, then those that will be, until the connection ends.

        Raises:
            ConnectionClosed, LinkLost: the connection ended.
        """
        found = self.aio.vehicles()
        try:
            while True:
                yield self._loop.run(found.__anext__)
        finally:
            with contextlib.suppress(ConnectionClosed):
                self._loop.run(found.aclose)

    def close(self) -> None:
        """End it, its link, its loop and its thread; idempotent. Calls that wait raise ConnectionClosed.

        The connection of a vehicle that was connected by an address is closed with the vehicle.
        """
        if self._held is not None:
            try:
                self._held.close()
            finally:
                self._loop.close()


class VehicleTwin(TwinOf["Vehicle"], BlockingBlock):
    """A context manager. The connection that it is on is closed with it if it was opened for it."""

    _opened_by = "connect"

    def __init__(self, loop: LoopThread, held: Held[Vehicle], *, owns_loop: bool) -> None:
        super().__init__(loop, held.value)
        self._held, self._owns_loop = held, owns_loop

    def _part(self, name: str, twin: Callable[[LoopThread, Any], T]) -> T:
        """A part, made on the loop's thread when it is first read. No lock: what runs there may read it, too."""
        key = f"_part_{name}"
        if key not in vars(self):

            def read() -> Any:
                return getattr(self.aio, name)

            try:
                original = read() if self._loop.is_current else self._loop.call(read)
            except ConnectionClosed:
                original = read()  # nothing runs there any more
            vars(self).setdefault(key, twin(self._loop, original))
        made: T = vars(self)[key]
        return made

    def close(self) -> None:
        """Let the vehicle go: link, loop and thread end, calls that wait raise ConnectionClosed. Idempotent.

        Nothing is sent: a vehicle in the air goes on with what it does. A connection that was handed in stays open.
        """
        try:
            self._held.close()
        finally:
            if self._owns_loop:
                self._loop.close()

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        was_told = self.aio.is_told_to_hold
        self.close()
        if exc is not None and not was_told:  # the loop's side knows of no exception
            tell_how_it_is_left(self.aio)

    def __repr__(self) -> str:
        return repr(self.aio).removesuffix(">") + ", blocking>"


def opened(
    twin: type[TwinT],
    open_async: Callable[..., AbstractAsyncContextManager[Any]],
    address: Any,
    **options: Any,
) -> TwinT:
    """Open a block on a loop of its own, or on that of the connection that is given as the address."""
    is_connection = isinstance(address, ConnectionTwin)
    loop = address._loop if is_connection else LoopThread()
    try:
        held: Held[Any] = loop.hold_open(open_async(address.aio if is_connection else address, **options))
    except BaseException:
        if not is_connection:
            loop.close()
        raise
    if not is_connection:
        connection: Connection = getattr(held.value, "connection", held.value)
        connection._prove_life_by(loop.proof)
    if issubclass(twin, VehicleTwin):
        return twin(loop, held, owns_loop=not is_connection)
    return twin(loop, held.value, held)
