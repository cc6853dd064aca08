"""Listeners to attributes and messages: ``Listeners`` and ``HasObservers``."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Callable
from functools import cache
from operator import attrgetter
from typing import TYPE_CHECKING, Any, TypeVar

from aerokit.errors import AerokitError

if TYPE_CHECKING:
    from aerokit.connection.bus import Detach
    from aerokit.dronekit.classic_connection import ClassicConnection
    from aerokit.dronekit.listener_thread import ListenerThread
    from aerokit.mavlink.frame import Frame
    from aerokit.transport.link import Peer

logger: logging.Logger = logging.getLogger("dronekit")

AttributeListener = Callable[[Any, str, Any], object]
"""Called as ``listener(object, name, value)``. The value is an attribute's value, or a message of pymavlink."""

ListenerT = TypeVar("ListenerT", bound=AttributeListener)

# A listener that is registered under this name is called for all attributes or messages.
EVERY_NAME = "*"

_registration_lock = threading.Lock()  # shared by all objects, for adding and removing listeners


class Listeners:
    """The listeners of an object, by the name of the attribute or message. Can be used from any thread.

    Listeners run one after the other on the listener thread or, without one, on the notifying thread. The listeners of
    a name run before those of ``'*'``. Listeners may block, raise exceptions and remove themselves. ``on_value(name)``
    is called for every value, with or without listeners.
    """

    kind = "attribute"  # the word for a name in log messages

    def __init__(
        self, owner: object, thread: ListenerThread | None, on_value: Callable[[str], None] | None = None
    ) -> None:
        self._owner, self._thread, self._on_value = owner, thread, on_value
        self.by_name: dict[str, tuple[AttributeListener, ...]] = {}
        self.last_values: dict[str, Any] = {}
        """The last values of attributes whose listeners are called only on changes."""

    def add(self, name: str, listener: AttributeListener) -> None:
        with _registration_lock:
            present = self.by_name.get(name, ())
            if listener in present:
                return
            self.by_name[name] = (*present, listener)
            self._update_kept_owner()

    def remove(self, name: str, listener: AttributeListener) -> None:
        with _registration_lock:
            present = self.by_name.get(name)
            if present is None:
                return
            if listener not in present:
                raise ValueError(f"{listener!r} does not listen to {name!r}")
            remaining = tuple(registered for registered in present if registered != listener)
            if remaining:
                self.by_name[name] = remaining
            else:
                del self.by_name[name]
                self._update_kept_owner()

    def has_listener(self, name: str) -> bool:
        return name in self.by_name or EVERY_NAME in self.by_name

    def notify(self, name: str, value: Any, cache: bool = False, *, waits: bool = False) -> None:
        """Call the listeners of a name with a value, on the listener thread.

        With ``waits``, wait for them, at most two seconds. With ``cache``, call them only if the value has changed.
        """
        if cache:
            if name in self.last_values and self.last_values[name] == value:
                return
            self.last_values[name] = value
        if self._on_value is not None:
            self._on_value(name)
        if not self.has_listener(name):
            return
        if self._thread is None:
            self.deliver(name, value)
        elif waits:
            self._thread.call(self.deliver, name, value)
        elif cache:  # With `cache`, each value is reported only once, so no report may be dropped.
            self._thread.post(self.deliver, name, value)
        else:
            self._thread.post_or_drop(self.deliver, name, value)

    def notify_attribute(self, name: str) -> None:
        """Call the listeners with the value of the owner's attribute, which is not read without listeners."""
        if self.has_listener(name):
            self.notify(name, attrgetter(name)(self._owner))
        elif self._on_value is not None:
            self._on_value(name)

    def deliver(self, attr_name: str, value: Any) -> None:
        for name in (attr_name, EVERY_NAME):
            for listener in self.by_name.get(name, ()):
                try:
                    listener(self._owner, attr_name, value)
                except BaseException:  # SystemExit would only end the listener thread.
                    logger.exception("Exception in %s handler for %s", self.kind, attr_name)

    def _update_kept_owner(self) -> None:
        # Listeners get the owner (a vehicle or its part) as an argument, so the owner must live as long as they do.
        if self._thread is not None:
            self._thread.keep_alive(self, has_listeners=bool(self.by_name))


def listener_decorator(
    add: Callable[[str, AttributeListener], object], name: str | list[str] | tuple[str, ...]
) -> Callable[[ListenerT], ListenerT]:
    """Return a decorator that adds a function as a listener of one or several names."""

    def decorate(listener: ListenerT) -> ListenerT:
        for attribute in (name,) if isinstance(name, str) else name:
            add(attribute, listener)
        return listener

    return decorate


class HasObservers:
    """An object with attributes that have listeners; see :class:`Listeners`."""

    def __init__(self, listener_thread: ListenerThread | None = None) -> None:
        self._dk_observe(Listeners(self, listener_thread))

    def _dk_observe(self, listeners: Listeners) -> None:
        self._dk_listeners = listeners
        self._attribute_listeners, self._attribute_cache = listeners.by_name, listeners.last_values

    @staticmethod
    def _dk_normalized(attr_name: str) -> str:
        """Return the name under which listeners of an attribute are stored. ``Parameters`` overrides this method."""
        return attr_name

    def add_attribute_listener(self, attr_name: str, observer: AttributeListener) -> None:
        """Call ``observer(self, attr_name, value)`` when the attribute is updated.

        Listeners of sensor values are called with every message. Listeners of states (``mode``, ``armed``,
        ``system_status``, ``ekf_ok``) and of parameters are called on changes. ``'*'`` stands for every name. A
        listener that is already registered is not added again. Names are not checked, because programs may define more
        attributes.
        """
        self._dk_listeners.add(self._dk_normalized(attr_name), observer)

    def remove_attribute_listener(self, attr_name: str, observer: AttributeListener) -> None:
        """Remove a listener. Ignored if the name has no listeners; ValueError if this listener is not among them."""
        self._dk_listeners.remove(self._dk_normalized(attr_name), observer)

    def on_attribute(self, name: str | list[str] | tuple[str, ...]) -> Callable[[ListenerT], ListenerT]:
        """Decorator: add a listener for one name or a list of names."""
        return listener_decorator(self.add_attribute_listener, name)

    def notify_attribute_listeners(self, attr_name: str, value: Any, cache: bool = False) -> None:
        """Call the listeners of an attribute; with ``cache``, only if the value has changed.

        Waits for the listeners, at most two seconds. Your program can announce its own attributes with this method,
        also from a listener.
        """
        self._dk_listeners.notify(self._dk_normalized(attr_name), value, cache, waits=True)


class MessageListeners(Listeners):
    """Message listeners of a vehicle, called on the listener thread. Adding the first listener imports pymavlink.

    Listeners get the messages of all components of the vehicle, and of other systems that are not vehicles, such as
    radios and ground stations.
    """

    kind = "message"

    def __init__(self, owner: object, handler: ClassicConnection) -> None:
        super().__init__(owner, handler.listener_thread)
        self._handler = handler
        self._detach_by_name: dict[str, Detach] = {}  # functions that end the subscription of each name
        self._is_started = False

    def add(self, name: str, listener: AttributeListener) -> None:
        _pymavlink()  # The import takes 60 ms, which would delay the first message.
        super().add(str(name), listener)
        self._attach_now()

    def remove(self, name: str, listener: AttributeListener) -> None:
        with contextlib.suppress(ValueError):
            super().remove(name, listener)
        self._attach_now()

    def start(self) -> None:
        """Start receiving. Called on the loop thread when the vehicle is connected."""
        self._is_started = True
        self._attach()

    def _attach_now(self) -> None:
        if not self._is_started:
            return
        if self._handler.loop.is_current:
            self._attach()
        else:
            with contextlib.suppress(AerokitError):  # The connection may be closed.
                # Blocks until attached, so that no message is missed after add() has returned.
                self._handler.loop.call(self._attach)

    def _attach(self) -> None:
        names = list(self.by_name.copy())
        if EVERY_NAME in names:
            names = [EVERY_NAME]
        for name in set(self._detach_by_name).difference(names):
            detach = self._detach_by_name.pop(name)
            detach()
        for name in names:
            if name not in self._detach_by_name:
                self._detach_by_name[name] = self._listen(name)

    def _listen(self, name: str) -> Detach:
        connection = self._handler.connection
        if name == EVERY_NAME:
            return connection.observe_frames(self._on_frame)
        try:
            message_type = connection.bus.dialect.by_name(name)
        except AerokitError:
            logger.warning("unknown message %s: its listener will never be called", name)
            return lambda: None
        return connection.bus.attach_frames(message_type, self._on_frame)

    def _on_frame(self, frame: Frame, peer: Peer = None) -> None:
        if not self._handler.is_of_another_vehicle(frame.system_id):
            self._handler.listener_thread.post_or_drop(self._deliver, frame)

    def _deliver(self, frame: Frame) -> None:
        message = message_of(frame)
        self.deliver(message.get_type(), message)


def message_of(frame: Frame) -> Any:
    """Convert a frame to a pymavlink message. Never raises."""
    mavutil, to_pymavlink = _pymavlink()
    # The program's dialect is used if it is a MAVLink 2 dialect.
    return to_pymavlink(frame, dialect=mavutil.mavlink, timestamp=time.time())


@cache
def _pymavlink() -> tuple[Any, Callable[..., Any]]:
    from pymavlink import mavutil

    from aerokit.mavlink.pymavlink import to_pymavlink

    return mavutil, to_pymavlink
