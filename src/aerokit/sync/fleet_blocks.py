"""What the twins of fleets are made of, beside ``blocks.py``."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from aerokit.errors import InvalidArgument
from aerokit.sync.blocks import BlockingBlock, ConnectionTwin, TwinOf, VehicleTwin
from aerokit.sync.loop_thread import Held, LoopThread
from aerokit.sync.twins import Vehicle
from aerokit.vehicle.connect import tell_how_it_is_left

if TYPE_CHECKING:
    from contextlib import AbstractAsyncContextManager
    from types import TracebackType

    from aerokit.fleets.fleet import Fleet as AsyncFleet
    from aerokit.fleets.fleet import Selection as AsyncSelection
    from aerokit.fleets.members import Member

T = TypeVar("T")
SelectionT = TypeVar("SelectionT", bound="AsyncSelection")
FleetT = TypeVar("FleetT", bound="FleetTwin")


class _Lent(Generic[T]):
    """In the place of what is held: the fleet lets its vehicles go."""

    def __init__(self, value: T) -> None:
        self.value = value

    def close(self) -> None:
        """Nothing: it goes with the fleet."""


class SelectionTwin(TwinOf[SelectionT]):
    """Vehicles by their names are blocking ones; members are as they are: ``member.vehicle`` is for the loop."""

    @cached_property
    def vehicles(self) -> Mapping[str, Vehicle]:
        """Name → vehicle."""
        return {name: _vehicle(self._loop, each) for name, each in self.aio.vehicles.items()}

    def __len__(self) -> int:
        return len(self.aio)

    def __iter__(self) -> Iterator[Member]:
        return iter(self.aio)

    def __repr__(self) -> str:
        return repr(self.aio)


def _vehicle(loop: LoopThread, vehicle: Any) -> Vehicle:
    lent: Any = _Lent(vehicle)
    return Vehicle(loop, lent, owns_loop=False)


class FleetTwin(TwinOf["AsyncFleet"], BlockingBlock):
    """What a fleet has beside a selection: a context manager. What was opened for it is closed with it."""

    _opened_by = "fleet"

    def __init__(self, loop: LoopThread, held: Held[AsyncFleet], *, owns_loop: bool) -> None:
        super().__init__(loop, held.value)
        self._held, self._owns_loop = held, owns_loop

    def __contains__(self, name: object) -> bool:
        return name in self.aio.members

    def close(self) -> None:
        """Let all of them go; calls that wait raise ConnectionClosed. Idempotent.

        Nothing is sent: who is in the air goes on with what it does. What was handed in stays open.
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
        left = [each for each in self.aio.vehicles.values() if not each.is_told_to_hold]
        self.close()
        if exc is not None:  # the loop's side knows of no exception
            for each in left:
                tell_how_it_is_left(each)


def opened_fleet(
    twin: type[FleetT],
    open_async: Callable[..., AbstractAsyncContextManager[Any]],
    sources: tuple[Any, ...],
    **options: Any,
) -> FleetT:
    """Open a fleet on a loop of its own, or on that of what is given: connections and vehicles, by name or not."""
    given = [
        each for source in sources for each in (source.values() if isinstance(source, Mapping) else (source,))
    ]
    loops = {each._loop for each in given if isinstance(each, (ConnectionTwin, VehicleTwin))}
    if len(loops) > 1:
        raise InvalidArgument(
            "sources: these were opened apart, each on a loop of its own: open one connection for them"
        )
    loop = next(iter(loops), None) or LoopThread()
    try:
        held: Held[Any] = loop.hold_open(open_async(*map(_original, sources), **options))
    except BaseException:
        if not loops:
            loop.close()
        raise
    for connection in held.value._crew.networks.values():
        connection._prove_life_by(loop.proof)
    return twin(loop, held, owns_loop=not loops)


def _original(source: Any) -> Any:
    if isinstance(source, Mapping):
        return {name: _original(each) for name, each in source.items()}
    return source.aio if isinstance(source, TwinOf) else source
