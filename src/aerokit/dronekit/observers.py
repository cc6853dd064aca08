"""Attributes and messages that a program can listen to: ``Listeners``, and ``HasObservers``, who has some."""

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
    from aerokit.dronekit.line import Line
    from aerokit.dronekit.listener_thread import ListenerThread
    from aerokit.mavlink.frame import Frame
    from aerokit.transport.link import Peer

logger: logging.Logger = logging.getLogger("dronekit")

AttributeListener = Callable[[Any, str, Any], object]
"""``listener(object, name, value)``: of an attribute; or of a message, which is pymavlink's."""

ListenerT = TypeVar("ListenerT", bound=AttributeListener)

EVERY_NAME = "*"
"""Who listens to it listens to all of them."""

_changing = threading.Lock()
"""Held while listeners are added and removed."""


class Listeners:
    """Who listens to which attribute, or message, of an object. Any thread may use it.

    Listeners run on the listener thread, in the order in which values came, those of a name before those of ``'*'``;
    they may block, raise, remove themselves and call whatever blocks. Without a listener thread they run on the thread
    that tells. ``on_value(name)`` is called for every value, whoever listens.
    """

    kind = "attribute"
    """What the log calls it."""

    def __init__(
        self, owner: object, thread: ListenerThread | None, on_value: Callable[[str], None] | None = None
    ) -> None:
        self._owner, self._thread, self._on_value = owner, thread, on_value
        self.by_name: dict[str, tuple[AttributeListener, ...]] = {}
        self.told: dict[str, Any] = {}
        """The last values of attributes that are told when they change."""

    def add(self, name: str, listener: AttributeListener) -> None:
        """Have it called; not twice."""
        with _changing:
            present = self.by_name.get(name, ())
            if listener in present:
                return
            self.by_name[name] = (*present, listener)
            self._stay()

    def remove(self, name: str, listener: AttributeListener) -> None:
        """Call it no more; ValueError when others listen to the name, but this one does not."""
        with _changing:
            present = self.by_name.get(name)
            if present is None:
                return
            if listener not in present:
                raise ValueError(f"{listener!r} does not listen to {name!r}")
            left = tuple(each for each in present if each != listener)
            if left:
                self.by_name[name] = left
            else:
                del self.by_name[name]
                self._stay()

    def heed(self, name: str) -> bool:
        """Whether somebody listens to this attribute."""
        return name in self.by_name or EVERY_NAME in self.by_name

    def tell(self, name: str, value: Any, cache: bool = False, *, waits: bool = False) -> None:
        """Tell a value; with ``cache`` only when it is not the one told before, else it may be dropped: it comes again.

        Waits for nobody, or, with ``waits``, until the listeners have run.
        """
        if cache:
            if name in self.told and self.told[name] == value:
                return
            self.told[name] = value
        if self._on_value is not None:
            self._on_value(name)
        if not self.heed(name):
            return
        thread = self._thread
        if thread is None:
            self.deliver(name, value)
        else:
            hand_over = thread.call if waits else thread.post if cache else thread.offer
            hand_over(self.deliver, name, value)

    def announce(self, name: str) -> None:
        """As :meth:`tell`; the value is the owner's attribute, which is read only when somebody listens."""
        if self.heed(name):
            self.tell(name, attrgetter(name)(self._owner))
        elif self._on_value is not None:
            self._on_value(name)

    def deliver(self, attr_name: str, value: Any) -> None:
        """Call the listeners, those that are there by now, where the caller is."""
        for name in (attr_name, EVERY_NAME):
            for listener in self.by_name.get(name, ()):
                try:
                    listener(self._owner, attr_name, value)
                except BaseException:
                    # sys.exit() too: it would end the callbacks of everybody, and nothing else
                    logger.exception("Exception in %s handler for %s", self.kind, attr_name)

    def _stay(self) -> None:
        """With listeners the owner stays, even when the program has dropped it."""
        if self._thread is not None:
            self._thread.keep(self, has_listeners=bool(self.by_name))


def decorator_of(
    add: Callable[[str, AttributeListener], object], name: str | list[str] | tuple[str, ...]
) -> Callable[[ListenerT], ListenerT]:
    """What adds the function it decorates under a name, or several."""

    def decorate(listener: ListenerT) -> ListenerT:
        for each in (name,) if isinstance(name, str) else name:
            add(each, listener)
        return listener

    return decorate


class HasObservers:
    """An object with attributes that can be listened to; see :class:`Listeners`."""

    def __init__(self, listener_thread: ListenerThread | None = None) -> None:
        self._dk_observe(Listeners(self, listener_thread))

    def _dk_observe(self, listeners: Listeners) -> None:
        self._dk_listeners = listeners
        self._attribute_listeners, self._attribute_cache = listeners.by_name, listeners.told

    @staticmethod
    def _dk_spelled(attr_name: str) -> str:
        """The name as it is listened to."""
        return attr_name

    def add_attribute_listener(self, attr_name: str, observer: AttributeListener) -> None:
        """Have ``observer(self, attr_name, value)`` called when the attribute is updated, or the parameter has changed.

        Sensor values are told with every message, states (``mode``, ``armed``, ``system_status``, ``ekf_ok``) when
        they change. ``'*'`` is every name. A listener that is there already is not added again; names are not checked,
        since programs tell of attributes of their own.
        """
        self._dk_listeners.add(self._dk_spelled(attr_name), observer)

    def remove_attribute_listener(self, attr_name: str, observer: AttributeListener) -> None:
        """Call it no more; ValueError when others listen to the name, but this one does not."""
        self._dk_listeners.remove(self._dk_spelled(attr_name), observer)

    def on_attribute(self, name: str | list[str] | tuple[str, ...]) -> Callable[[ListenerT], ListenerT]:
        """Decorate a listener with the name, or the list of names, it listens to. It cannot be removed by name then."""
        return decorator_of(self.add_attribute_listener, name)

    def notify_attribute_listeners(self, attr_name: str, value: Any, cache: bool = False) -> None:
        """Tell the listeners of an attribute its value; with ``cache`` only when it is not the one told before.

        Call it from message listeners for attributes of your own. Returns when the listeners have run.
        """
        self._dk_listeners.tell(self._dk_spelled(attr_name), value, cache, waits=True)


class MessageListeners(Listeners):
    """The message listeners of one vehicle, called on its listener thread. pymavlink is imported for the first of them.

    They hear what the vehicle's system says, every component of it, and what comes from radios, ground stations and
    the like; not what other vehicles on the link say.
    """

    kind = "message"

    def __init__(self, owner: object, handler: Line) -> None:
        super().__init__(owner, handler.listener_thread)
        self._handler = handler
        self._detach: dict[str, Detach] = {}
        self._is_started = False

    def add(self, name: str, listener: AttributeListener) -> None:
        """Have it called for every message of this name, or for every message (``'*'``); not twice."""
        _pymavlink()  # at its first message it would hold up all that comes for 60 ms
        super().add(str(name), listener)
        self._attach_now()

    def remove(self, name: str, listener: AttributeListener) -> None:
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
        message = message_of(frame)
        self.deliver(message.get_type(), message)


def message_of(frame: Frame) -> Any:
    """The frame's message in the program's dialect, ``mavutil.mavlink``, if that is one of MAVLink 2; never raises.

    ``_timestamp`` is the time of this call.
    """
    mavutil, to_pymavlink = _pymavlink()
    return to_pymavlink(frame, dialect=mavutil.mavlink, timestamp=time.time())


@cache
def _pymavlink() -> tuple[Any, Callable[..., Any]]:
    """Imported for the first listener to messages."""
    from pymavlink import mavutil

    from aerokit.mavlink.pymavlink import to_pymavlink

    return mavutil, to_pymavlink
