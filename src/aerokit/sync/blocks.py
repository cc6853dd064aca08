"""Base classes of the generated blocking twins: how each is opened, entered, iterated and closed."""

from __future__ import annotations

import contextlib
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Generic, NoReturn, TypeAlias, TypeVar

from aerokit._internal.async_block import ReadOnly
from aerokit.errors import ConnectionClosed
from aerokit.sync.loop_thread import LoopThread, OpenContext
from aerokit.vehicle.connect import warn_if_left_flying

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterator
    from contextlib import AbstractAsyncContextManager, AbstractContextManager

    from typing_extensions import Self

    from aerokit.connection.bus import Subscription  # noqa: F401 - named in the base classes below
    from aerokit.connection.cells import Changes, StateCell  # noqa: F401
    from aerokit.connection.connection import Connection
    from aerokit.events import VehicleFound
    from aerokit.fleets.formation import Following
    from aerokit.vehicle.calibration.calibration import Calibration  # noqa: F401
    from aerokit.vehicle.calibration.values import CalibrationStep  # noqa: F401
    from aerokit.vehicle.camera.capture import Capture  # noqa: F401
    from aerokit.vehicle.camera.link import CameraBlock
    from aerokit.vehicle.camera.photos import PhotoInterval
    from aerokit.vehicle.commanding.follow import FollowStream
    from aerokit.vehicle.commanding.guided import SetpointStream
    from aerokit.vehicle.commanding.sticks import StickStream
    from aerokit.vehicle.devices.shell import Shell
    from aerokit.vehicle.external.streams import MeasurementStream
    from aerokit.vehicle.files.log_stream import LogStream
    from aerokit.vehicle.gimbal.control import GimbalControl
    from aerokit.vehicle.gimbal.gimbal import Gimbals  # noqa: F401
    from aerokit.vehicle.gimbal.rates import GimbalRates
    from aerokit.vehicle.parameters.transaction import TemporaryParameters, Transaction
    from aerokit.vehicle.parameters.writing import ParameterWrite
    from aerokit.vehicle.rtk.ntrip import NtripClient
    from aerokit.vehicle.vehicle import Vehicle  # noqa: F401

    Block: TypeAlias = (
        CameraBlock
        | Following
        | FollowStream
        | GimbalControl
        | GimbalRates
        | LogStream
        | MeasurementStream[Any]
        | NtripClient
        | PhotoInterval
        | SetpointStream[Any]
        | Shell
        | StickStream
    )


class BlockingContext:
    """Base of the objects that ``connect`` and the other functions of :mod:`aerokit.sync` open.

    Using one with ``await`` or ``async with`` closes it and raises TypeError.
    """

    _opened_by: str  # name of the function that opens this object

    def close(self) -> None:
        """Close the object. Idempotent."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(self, exc_type: Any, exc: Any, traceback: Any) -> None:
        self.close()

    if not TYPE_CHECKING:  # Hidden from type checkers, so that they report `await` and `async with` as errors.

        def __await__(self) -> NoReturn:
            self._misused("await")

        async def __aenter__(self) -> NoReturn:
            self._misused("async with")

        async def __aexit__(self, *_: object) -> None:
            """Not called. It must exist, because Python looks it up before it calls ``__aenter__``."""

    def _misused(self, word: str) -> NoReturn:
        self.close()
        name = self._opened_by
        raise TypeError(
            f"aerokit.sync.{name}(…) does not support `{word}`: write `with aerokit.sync.{name}(…) as …:`, or"
            f" `async with aerokit.{name}(…) as …:` in an async function; the connection was closed"
        )


AsyncT = TypeVar("AsyncT")

T = TypeVar("T")

EnteredT = TypeVar("EnteredT")

IteratorT = TypeVar("IteratorT", bound="AsyncIterator[Any]")

ItemT = TypeVar("ItemT")

BlockT = TypeVar("BlockT", bound="Block")

ShieldedT = TypeVar("ShieldedT", bound="TemporaryParameters | Transaction")

TwinT = TypeVar("TwinT", bound="ConnectionTwin | VehicleTwin")


class TwinOf(ReadOnly, Generic[AsyncT]):
    """Blocking twin of an asynchronous object. It calls the object's methods on the loop thread."""

    def __init__(self, loop: LoopThread, aio: AsyncT) -> None:
        self._loop = loop
        self._aio = aio

    @property
    def aio(self) -> AsyncT:
        """The asynchronous object, for code that runs on the loop."""
        self._loop.feed()
        return self._aio

    @contextmanager
    def _block(self, block: AbstractContextManager[T]) -> Iterator[T]:
        """Enter and exit a synchronous context manager on the loop."""
        entered = self._loop.enter_sync(block)
        try:
            yield entered
        finally:
            with contextlib.suppress(ConnectionClosed):  # If the loop has ended, there is nothing left to exit.
                self._loop.call(block.__exit__, None, None, None)

    @contextmanager
    def _twin_block(
        self, twin: Callable[[LoopThread, T], EnteredT], block: AbstractContextManager[T]
    ) -> Iterator[EnteredT]:
        with self._block(block) as entered:
            yield twin(self._loop, entered)


class CellTwin(TwinOf["StateCell[T]"], Generic[T]):
    """Twin of a state cell. Reading takes a snapshot on the caller's thread, without waiting for the loop."""

    def __repr__(self) -> str:
        return repr(self.aio)

    def __bool__(self) -> bool:
        return bool(self.aio)  # `aio` raises a TypeError with a hint.

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            if name.startswith("_"):  # `copy.copy` reads such names before `self.aio` exists.
                raise AttributeError(name)
            return getattr(self.aio, name)  # `aio` raises an AttributeError with a suggestion.

        def __getitem__(self, key: object) -> Any:
            return self.aio[key]  # `aio` raises a TypeError with a suggestion.


class IteratorTwin(TwinOf[IteratorT], Generic[IteratorT, ItemT]):
    """Twin of an asynchronous iterator over items."""

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> ItemT:
        items = self.aio

        # At the end of the iteration, the coroutine returns an empty tuple, because a coroutine cannot raise
        # StopAsyncIteration.
        async def read() -> tuple[ItemT, ...]:
            try:
                return (await items.__anext__(),)
            except StopAsyncIteration:
                return ()

        item_or_nothing = self._loop.run(read)
        if not item_or_nothing:
            raise StopIteration
        (item,) = item_or_nothing
        return item


class ChangesTwin(IteratorTwin["Changes[T]", T], Generic[T]):
    """Blocking iterator over the values of a cell."""


class SubscriptionTwin(IteratorTwin["Subscription[T]", T], Generic[T]):
    """Iterator over received items; subscribed while its ``with`` block runs."""

    def __enter__(self) -> Self:
        self._loop.enter_sync(self.aio)
        return self

    def __exit__(self, exc_type: Any, exc: Any, traceback: Any) -> None:
        with contextlib.suppress(ConnectionClosed):  # A closed connection has closed the subscription, too.
            self._loop.call(self.aio.close)


class BlockTwin(TwinOf[BlockT]):
    """Twin of an object that is active while its ``with`` block runs."""

    def __enter__(self) -> Self:
        self._loop.enter(self.aio)
        return self

    def __exit__(self, exc_type: Any, exc: Any, traceback: Any) -> None:
        exit_block: Any = self.aio.__aexit__  # The type is Any, because each class names its parameters differently.
        self._loop.run_exit(exit_block, exc_type, exc, traceback)


class StreamTwin(BlockTwin["SetpointStream[T]"], Generic[T]):
    """Twin of a stream that sends set-points while its ``with`` block runs."""


class MeasurementTwin(BlockTwin["MeasurementStream[T]"], Generic[T]):
    """Twin of a stream of measurements that is open while its ``with`` block runs."""


class GimbalsTwin(TwinOf["Gimbals"], Generic[T]):
    """Gimbals by device id; ``T`` is the twin of a gimbal."""

    if TYPE_CHECKING:  # The generated twin defines these members.

        @property
        def ids(self) -> tuple[int, ...]:
            raise NotImplementedError

        def get(self, device_id: int) -> T:
            raise NotImplementedError

    def __getitem__(self, device_id: int) -> T:
        return self.get(device_id)

    def __iter__(self) -> Iterator[T]:
        return iter([self.get(device_id) for device_id in self.ids])

    def __len__(self) -> int:
        return len(self.ids)


class CalibrationTwin(IteratorTwin["Calibration", "CalibrationStep"]):
    """Iterator over the steps of a calibration. Leaving the ``for`` loop cancels the calibration on the vehicle."""


class PhotoIntervalTwin(BlockTwin["PhotoInterval"], IteratorTwin["PhotoInterval", "Capture"]):
    """Takes pictures while its ``with`` block runs. Iterating over it yields the pictures."""


class LogStreamTwin(BlockTwin["LogStream"], IteratorTwin["LogStream", bytes]):
    """A flight log while PX4 writes it. Iterating over it yields its bytes."""


class ShieldedBlockTwin(TwinOf[ShieldedT]):
    """Twin of a block whose exit cannot be interrupted by Ctrl-C."""

    def __exit__(self, exc_type: Any, exc: Any, traceback: Any) -> None:
        try:
            self._loop.run_shielded(self.aio.__aexit__, exc_type, exc, traceback)
        except ConnectionClosed as error:
            from aerokit.vehicle.parameters.transaction import abandon

            abandon(self.aio, error, exc)


class TemporarilyTwin(ShieldedBlockTwin["TemporaryParameters"]):
    """Block that sets parameters; ``as`` gives the results. Its exit restores the previous values."""

    def __enter__(self) -> dict[str, ParameterWrite]:
        return self._loop.enter(self.aio)


class TransactionTwin(ShieldedBlockTwin["Transaction"]):
    """Block of parameter changes, which are undone if the block raises."""

    def __enter__(self) -> Self:
        self._loop.enter(self.aio)
        return self


class ConnectionTwin(TwinOf["Connection"], BlockingContext):
    """Connection as a context manager, which also ends the loop thread that was started for it."""

    _opened_by = "open_connection"

    def __init__(self, loop: LoopThread, aio: Connection, context: OpenContext[Connection] | None = None) -> None:
        super().__init__(loop, aio)
        self._context = context

    def vehicles(self) -> Iterator[VehicleFound]:
        """Yield each autopilot once, until the connection ends: first the known autopilots, then new ones.

        Raises:
            ConnectionClosed, LinkLost: the connection ended.
        """
        discoveries = self.aio.vehicles()
        try:
            while True:  # The end of the connection raises an exception, which ends this loop.
                yield self._loop.run(discoveries.__anext__)
        finally:
            with contextlib.suppress(ConnectionClosed):
                self._loop.run(discoveries.aclose)

    def close(self) -> None:
        """Close the connection and end the loop thread. Idempotent. Waiting calls raise ConnectionClosed.

        A connection that ``connect`` opened for a vehicle closes with the vehicle.
        """
        if self._context is not None:
            try:
                self._context.close()
            finally:
                self._loop.close()


class OpenedTwin(TwinOf[T], BlockingContext):
    """Twin of an object whose context is open on a loop thread. Closing it ends the thread, unless it is shared."""

    def __init__(self, loop: LoopThread, context: OpenContext[T], *, owns_loop: bool) -> None:
        super().__init__(loop, context.value)
        self._context = context
        self._owns_loop = owns_loop

    def close(self) -> None:
        """Close the context and end the loop thread. Idempotent."""
        try:
            self._context.close()
        finally:
            if self._owns_loop:
                self._loop.close()


class VehicleTwin(OpenedTwin["Vehicle"]):
    """Vehicle as a context manager, which also closes the connection that was opened for it."""

    _opened_by = "connect"

    def _part(self, name: str, twin: Callable[[LoopThread, Any], T]) -> T:
        """Return the blocking twin of an attribute of the vehicle, such as ``parameters``.

        The first access reads the attribute on the loop's thread; the twin is then stored.
        """
        # No lock is used, because code on the loop's thread reads parts, too, and must not wait. If two threads create
        # a part at the same time, setdefault() keeps one of them.
        key = f"_part_{name}"
        if key not in vars(self):

            def read() -> Any:
                return getattr(self.aio, name)

            try:
                original = read() if self._loop.is_current else self._loop.call(read)
            except ConnectionClosed:
                original = read()  # The loop's thread has ended, so this thread may use the vehicle.
            vars(self).setdefault(key, twin(self._loop, original))
        part: T = vars(self)[key]
        return part

    def close(self) -> None:
        """Disconnect: close the link and end the loop thread. Idempotent. Waiting calls raise ConnectionClosed.

        Sends nothing: a vehicle in the air continues what it does. A connection passed to ``connect`` stays open.
        """
        super().close()

    def __exit__(self, exc_type: Any, exc: Any, traceback: Any) -> None:
        is_hold_pending = self.aio.is_hold_pending
        self.close()
        # The asynchronous context would log this warning, but `close` exits it without the exception.
        if exc is not None and not is_hold_pending:
            warn_if_left_flying(self.aio)

    def __repr__(self) -> str:
        return repr(self.aio).removesuffix(">") + ", blocking>"


def opened(
    twin: type[TwinT], open_async: Callable[..., AbstractAsyncContextManager[Any]], address: Any, **options: Any
) -> TwinT:
    """Open a context on a new loop thread; if ``address`` is a connection, on the connection's loop thread."""
    is_connection = isinstance(address, ConnectionTwin)
    loop: LoopThread | None = None
    try:
        loop = address._loop if is_connection else LoopThread()
        async_address = address.aio if is_connection else address
        context: OpenContext[Any] = loop.open_context(open_async(async_address, **options))
    except BaseException as error:
        if loop is not None and not is_connection:
            loop.close()
        if isinstance(error, KeyboardInterrupt):  # The traceback inside this library would not help the user.
            raise error.with_traceback(None) from error.__cause__
        raise
    if not is_connection:
        # A vehicle has the attribute `connection`. Without it, the value is the connection itself.
        connection: Connection = getattr(context.value, "connection", context.value)
        connection._use_activity_monitor(loop.activity)
    if issubclass(twin, VehicleTwin):
        return twin(loop, context, owns_loop=not is_connection)
    return twin(loop, context.value, context)
