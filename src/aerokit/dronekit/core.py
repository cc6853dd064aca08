"""``VehicleCore``: the connection underneath a classic vehicle, as all its parts use it.

``_dk_``: names that no subclass in the classic style takes for its own things.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

from aerokit.dronekit.exceptions import APIException, TimeoutError  # noqa: A004 - DroneKit's name
from aerokit.dronekit.observers import HasObservers
from aerokit.errors import AerokitError, LocalProtocolError, OperationTimeout

if TYPE_CHECKING:
    import concurrent.futures
    from collections.abc import Awaitable, Callable
    from contextlib import ExitStack

    from aerokit.dronekit.mavlink import MAVConnection
    from aerokit.mavlink.message import Message
    from aerokit.runtime.background import Background
    from aerokit.vehicle.vehicle import Vehicle as AsyncVehicle

__all__ = ["VehicleCore"]


class VehicleCore(HasObservers):
    """What is sent, waited for and listened to by way of the asynchronous vehicle, once there is one."""

    def __init__(self, handler: MAVConnection) -> None:
        super().__init__(handler.listener_thread)
        self._handler = handler
        self._logger = logging.getLogger("dronekit")
        self._autopilot_logger = logging.getLogger("autopilot")
        self._dk_aio: AsyncVehicle | None = None
        self._dk_heartbeat_limit: float = 0.0
        self._dk_message_handlers: list[tuple[type[Message], Callable[[Any], None], bool]] = []
        self._dk_starters: list[Callable[[ExitStack], None]] = []
        self._dk_tasks: Background | None = None

    @property
    def _dk_target_system(self) -> int:
        return self._handler.target_system

    @property
    def _dk_vehicle(self) -> AsyncVehicle:
        if self._dk_aio is None:
            raise APIException("the vehicle is not connected yet: call initialize()")
        return self._dk_aio

    def _dk_on(self, message_type: type[Message], handler: Callable[[Any], None]) -> None:
        self._dk_message_handlers.append((message_type, handler, True))

    def _dk_on_any_component(self, message_type: type[Message], handler: Callable[[Any], None]) -> None:
        self._dk_message_handlers.append((message_type, handler, False))

    def _dk_at_start(self, function: Callable[[ExitStack], None]) -> None:
        self._dk_starters.append(function)

    def _dk_background(self, function: Callable[[], Awaitable[None]]) -> None:
        if self._dk_tasks is not None:
            self._dk_tasks.start(function, f"dronekit {getattr(function, '__name__', 'task')}")

    def _dk_check_link(self) -> AsyncVehicle:
        """The asynchronous vehicle, if it can be talked to."""
        aio = self._dk_vehicle
        if self._handler.is_closed:
            raise APIException("the vehicle was closed")
        try:
            aio.connection.raise_if_ended()
        except AerokitError as error:
            raise APIException(str(error)) from error
        age = aio.heartbeat_age
        if self._dk_heartbeat_limit and age > self._dk_heartbeat_limit:
            raise APIException(f"no heartbeat of the vehicle for {age:.0f} s")
        return aio

    def _dk_run(self, function: Callable[..., Awaitable[Any]], *args: Any, **kwargs: Any) -> Any:
        self._dk_check_link()
        try:
            return self._handler.loop.run(function, *args, **kwargs)
        except LocalProtocolError:
            raise
        except OperationTimeout as error:
            raise TimeoutError(str(error)) from error
        except AerokitError as error:
            raise APIException(str(error)) from error

    def _dk_order(
        self, kind: str, function: Callable[..., Awaitable[object]], *args: Any, **kwargs: Any
    ) -> concurrent.futures.Future[None]:
        self._dk_check_link()
        try:
            return self._handler.orders.give(kind, function, *args, **kwargs)
        except AerokitError as error:
            raise APIException(str(error)) from error

    def _dk_send(self, message: Message) -> None:
        self._dk_check_link()
        self._handler.send(message)

    def _dk_pause(self, seconds: float) -> None:
        """Sleep, unless the vehicle is closed meanwhile."""
        self._handler.wait_closed(seconds)
