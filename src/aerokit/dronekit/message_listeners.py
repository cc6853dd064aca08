"""Who listens to which message: pymavlink objects for callbacks, made only when somebody listens."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from aerokit.dronekit.observers import EVERY_NAME, Listeners
from aerokit.errors import AerokitError

if TYPE_CHECKING:
    from aerokit.dronekit.mavlink import MAVConnection
    from aerokit.links.link import Peer
    from aerokit.mavlink.frame import Frame
    from aerokit.mavlink.message import Message
    from aerokit.runtime.bus import Detach

__all__ = ["MessageListener", "MessageListeners"]

logger = logging.getLogger("dronekit")

MessageListener = Callable[[Any, str, Any], object]
"""``listener(vehicle, message_name, message)``; the message is pymavlink's."""


class MessageListeners:
    """The message listeners of one vehicle, called on its listener thread. pymavlink is imported for the first of them.

    They hear what the vehicle's system says, every component of it, and what comes from radios, ground stations and
    the like; not what other vehicles on the link say.
    """

    def __init__(self, owner: object, handler: MAVConnection) -> None:
        self._handler = handler
        self._listeners = Listeners(
            owner, handler.listener_thread, on_change=self._attach_now, kind="message"
        )
        self._detach: dict[str, Detach] = {}
        self._is_started = False
        self._message_of: Callable[[Frame], Any]

    def add(self, name: str, listener: MessageListener) -> None:
        """Have it called for every message of this name, or for every message (``'*'``); not twice."""
        from aerokit.dronekit.pymavlink_messages import message_of

        self._message_of = message_of
        self._listeners.add(str(name), listener)

    def remove(self, name: str, listener: MessageListener) -> None:
        """Call it no more; silent when it does not listen."""
        with contextlib.suppress(ValueError):
            self._listeners.remove(name, listener)

    def notify(self, name: str, message: Any) -> None:
        """Call the listeners of a message: of its name, then of every message; returns when they have run."""
        self._handler.listener_thread.call(self._listeners.deliver, name, message)

    def start(self) -> None:
        """The vehicle was found: hear what comes from now on (loop thread)."""
        self._is_started = True
        self._attach()

    def _attach_now(self) -> None:
        """Wait for it, so that whatever comes once a listener was added is heard."""
        if self._handler.loop.is_current:
            if self._is_started:
                self._attach()
        elif self._is_started:
            with contextlib.suppress(AerokitError):  # the connection is closed: nothing will come
                self._handler.loop.call(self._attach)

    def _attach(self) -> None:
        """Hear what is listened to: everything, or the messages of these names."""
        names = self._listeners.by_name.copy()
        wanted = [EVERY_NAME] if EVERY_NAME in names else list(names)
        for name in set(self._detach).difference(wanted):
            self._detach.pop(name)()
        for name in wanted:
            if name not in self._detach:
                self._listen(name)

    def _listen(self, name: str) -> None:
        connection = self._handler.connection
        if name == EVERY_NAME:
            self._detach[name] = connection.tap(self._take_frame)
            return
        try:
            message_type = connection.bus.dialect.by_name(name)
        except AerokitError:
            logger.warning("there is no message %s: its listener will never be called", name)
            self._detach[name] = lambda: None
        else:
            self._detach[name] = connection.bus.attach(message_type, self._take)

    def _take(self, message: Message) -> None:
        if message.received_frame is not None:
            self._take_frame(message.received_frame, None)

    def _take_frame(self, frame: Frame, peer: Peer) -> None:
        if not self._handler.is_of_another_vehicle(frame.system_id):
            self._handler.listener_thread.offer(self._deliver, frame)

    def _deliver(self, frame: Frame) -> None:
        message = self._message_of(frame)
        if message is not None:
            self._listeners.deliver(message.get_type(), message)
