"""Messages of a vehicle: listening to what comes, making and sending one's own."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from aerokit.dronekit.core import VehicleCore
from aerokit.dronekit.message_listeners import MessageListener, MessageListeners

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.dronekit.master import MessageFactory

__all__ = ["MessageMethods"]


class MessageMethods(VehicleCore):
    """What the vehicle says, as objects of pymavlink; and to the vehicle whatever pymavlink can make."""

    _message_listeners: MessageListeners

    def add_message_listener(self, name: str, fn: MessageListener) -> None:
        """Have ``fn(vehicle, name, message)`` called for every message of this name (``'*'``: every message).

        Messages are objects of pymavlink. Attributes hold what the message says by the time it is called.
        """
        self._message_listeners.add(name, fn)

    def remove_message_listener(self, name: str, fn: MessageListener) -> None:
        """Call it no more; silent when it does not listen."""
        self._message_listeners.remove(name, fn)

    def on_message(
        self, name: str | list[str] | tuple[str, ...]
    ) -> Callable[[MessageListener], MessageListener]:
        """Decorate a message listener with the name, or the list of names, of messages it listens to."""

        def decorate(fn: MessageListener) -> MessageListener:
            for each in (name,) if isinstance(name, str) else name:
                self.add_message_listener(each, fn)
            return fn

        return decorate

    def notify_message_listeners(self, name: str, msg: Any) -> None:
        """Call the listeners of a message, as if it had come; returns when they have run."""
        self._message_listeners.notify(name, msg)

    @property
    def message_factory(self) -> MessageFactory:
        """Makes pymavlink messages: ``vehicle.message_factory.command_long_encode(…)``, for :meth:`send_mavlink`."""
        return self._handler.master.mav

    def send_mavlink(self, message: Any) -> None:
        """Send a message made by :attr:`message_factory`, by pymavlink or of ``aerokit.messages``, once.

        ``target_system`` becomes this vehicle's, in the message itself; ``target_component`` stays. Never blocks.

        Raises:
            LocalProtocolError: a ValueError; a field is wrong. Nothing was sent.
            APIException: the link is down.
        """
        from aerokit.mavlink.from_pymavlink import from_pymavlink

        self._dk.check_link()
        target = self._dk.target_system
        self._handler.send(from_pymavlink(message, target), to=target)
