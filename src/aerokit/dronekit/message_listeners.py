"""Messages of a vehicle: listening to what comes, as pymavlink's objects, making and sending one's own."""

from __future__ import annotations

import contextlib
import logging
from typing import TYPE_CHECKING, Any

from aerokit.dronekit.core import VehicleCore
from aerokit.dronekit.observers import EVERY_NAME, AttributeListener, Listeners, decorator_of
from aerokit.errors import AerokitError

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.dronekit.master import MessageFactory
    from aerokit.dronekit.mavlink import MAVConnection
    from aerokit.links.link import Peer
    from aerokit.mavlink.frame import Frame
    from aerokit.runtime.bus import Detach

__all__ = ["MessageListener", "MessageListeners", "MessageMethods"]

logger = logging.getLogger("dronekit")

MessageListener = AttributeListener
"""``listener(vehicle, message_name, message)``; the message is pymavlink's."""


class MessageListeners(Listeners):
    """The message listeners of one vehicle, called on its listener thread. pymavlink is imported for the first message.

    They hear what the vehicle's system says, every component of it, and what comes from radios, ground stations and
    the like; not what other vehicles on the link say.
    """

    kind = "message"

    def __init__(self, owner: object, handler: MAVConnection) -> None:
        super().__init__(owner, handler.listener_thread)
        self._handler = handler
        self._detach: dict[str, Detach] = {}
        self._is_started = False

    def add(self, name: str, listener: MessageListener) -> None:
        """Have it called for every message of this name, or for every message (``'*'``); not twice."""
        super().add(str(name), listener)
        self._attach_now()

    def remove(self, name: str, listener: MessageListener) -> None:
        """Call it no more; silent when it does not listen."""
        with contextlib.suppress(ValueError):
            super().remove(name, listener)
        self._attach_now()

    def start(self) -> None:
        """The vehicle was found: hear what comes from now on (loop thread)."""
        self._is_started = True
        self._attach()

    def _attach_now(self) -> None:
        """Wait for it, so that whatever comes once a listener was added is heard."""
        if not self._is_started:
            return
        if self._handler.loop.is_current:
            self._attach()
        else:
            with contextlib.suppress(AerokitError):  # the connection is closed: nothing will come
                self._handler.loop.call(self._attach)

    def _attach(self) -> None:
        """Hear what is listened to: everything, or the messages of these names."""
        names = self.by_name.copy()
        wanted = [EVERY_NAME] if EVERY_NAME in names else list(names)
        for name in set(self._detach).difference(wanted):
            self._detach.pop(name)()
        for name in wanted:
            if name not in self._detach:
                self._detach[name] = self._listen(name)

    def _listen(self, name: str) -> Detach:
        connection = self._handler.connection
        if name == EVERY_NAME:
            return connection.tap(self._take)
        try:
            message_type = connection.bus.dialect.by_name(name)
        except AerokitError:
            logger.warning("there is no message %s: its listener will never be called", name)
            return lambda: None
        return connection.bus.attach_frames(message_type, self._take)

    def _take(self, frame: Frame, peer: Peer = None) -> None:
        if not self._handler.is_of_another_vehicle(frame.system_id):
            self._handler.listener_thread.offer(self._deliver, frame)

    def _deliver(self, frame: Frame) -> None:
        from aerokit.dronekit.pymavlink_messages import message_of

        message = message_of(frame)
        if message is not None:
            self.deliver(message.get_type(), message)


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
        return decorator_of(self.add_message_listener, name)

    def notify_message_listeners(self, name: str, msg: Any) -> None:
        """Call the listeners of a message, as if it had come; returns when they have run."""
        self._message_listeners.tell(name, msg, waits=True)

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
