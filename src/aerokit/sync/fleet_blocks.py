"""Base classes of the generated twins of fleets."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from aerokit.errors import InvalidArgument
from aerokit.sync.blocks import ConnectionTwin, OpenedTwin, TwinOf, VehicleTwin
from aerokit.sync.loop_thread import LoopThread, OpenContext
from aerokit.sync.twins import Vehicle
from aerokit.vehicle.connect import warn_if_left_flying

if TYPE_CHECKING:
    from contextlib import AbstractAsyncContextManager

    from aerokit.fleets.fleet import Fleet as AsyncFleet  # noqa: F401
    from aerokit.fleets.fleet import Selection as AsyncSelection
    from aerokit.fleets.members import Member

T = TypeVar("T")
SelectionT = TypeVar("SelectionT", bound="AsyncSelection")
FleetT = TypeVar("FleetT", bound="FleetTwin")


class _Borrowed(Generic[T]):
    """Stands in for the OpenContext of a vehicle that belongs to a fleet. ``close`` does nothing."""

    def __init__(self, value: T) -> None:
        self.value = value

    def close(self) -> None:
        pass


class SelectionTwin(TwinOf[SelectionT]):
    """Twin of a selection of vehicles. ``vehicles`` has twins, but a member's ``vehicle`` is asynchronous."""

    @cached_property
    def vehicles(self) -> Mapping[str, Vehicle]:
        """Maps names to vehicles."""
        return {name: _vehicle(self._loop, vehicle) for name, vehicle in self.aio.vehicles.items()}

    def __len__(self) -> int:
        return len(self.aio)

    def __iter__(self) -> Iterator[Member]:
        return iter(self.aio)

    def __repr__(self) -> str:
        return repr(self.aio)


def _vehicle(loop: LoopThread, vehicle: Any) -> Vehicle:
    borrowed: Any = _Borrowed(vehicle)
    return Vehicle(loop, borrowed, owns_loop=False)


class FleetTwin(OpenedTwin["AsyncFleet"]):
    """Fleet as a context manager, which also closes the connections that were opened for it."""

    _opened_by = "fleet"

    def __contains__(self, name: object) -> bool:
        return name in self.aio.members

    def close(self) -> None:
        """Disconnect all vehicles. Idempotent. Waiting calls raise ConnectionClosed.

        Sends nothing: vehicles in the air continue what they do. Connections passed to ``fleet`` stay open.
        """
        super().close()

    def __exit__(self, exc_type: Any, exc: Any, traceback: Any) -> None:
        without_hold = [vehicle for vehicle in self.aio.vehicles.values() if not vehicle.is_hold_pending]
        self.close()
        # The asynchronous context would log this warning, but `close` exits it without the exception.
        if exc is not None:
            for vehicle in without_hold:
                warn_if_left_flying(vehicle)


def opened_fleet(
    twin: type[FleetT],
    open_async: Callable[..., AbstractAsyncContextManager[Any]],
    sources: tuple[Any, ...],
    **options: Any,
) -> FleetT:
    """Open a fleet on a new loop thread; if a source is a connection or vehicle, on its loop thread."""
    entries: list[Any] = []
    for source in sources:
        if isinstance(source, Mapping):
            entries += source.values()
        else:
            entries.append(source)
    loops = {entry._loop for entry in entries if isinstance(entry, (ConnectionTwin, VehicleTwin))}
    if len(loops) > 1:
        raise InvalidArgument(
            "sources: the connections run on different event loops; pass addresses, or open all vehicles on one"
            " connection"
        )
    owns_loop = not loops
    loop = LoopThread() if owns_loop else loops.pop()
    try:
        context: OpenContext[Any] = loop.open_context(open_async(*map(_original, sources), **options))
    except BaseException:
        if owns_loop:
            loop.close()
        raise
    for connection in context.value._context.networks.values():
        connection._use_activity_monitor(loop.activity)
    return twin(loop, context, owns_loop=owns_loop)


def _original(source: Any) -> Any:
    """Return the asynchronous object of a twin; another source unchanged. In a mapping, the values are converted."""
    if isinstance(source, Mapping):
        return {name: _original(entry) for name, entry in source.items()}
    return source.aio if isinstance(source, TwinOf) else source
