"""Attributes whose changes a program can listen to: ``Listeners``, and ``HasObservers``, who has some."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from operator import attrgetter
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from aerokit.dronekit.listener_thread import ListenerThread

__all__ = ["EVERY_NAME", "AttributeListener", "HasObservers", "ListenerT", "Listeners", "decorator_of"]

logger = logging.getLogger("dronekit")

AttributeListener = Callable[[Any, str, Any], object]
"""``listener(object, attribute_name, value)``."""

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
        """Tell a value; with ``cache`` only when it is not the one told before.

        Waits for nobody, and may be dropped when it comes again anyway; with ``waits`` it returns when the listeners
        have run.
        """
        if cache and self._is_told(name, value):
            return
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

    def _is_told(self, name: str, value: Any) -> bool:
        """Whether this was the last value told; if not, it is now."""
        if name in self.told and self.told[name] == value:
            return True
        self.told[name] = value
        return False

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

    def add_attribute_listener(self, attr_name: str, observer: AttributeListener) -> None:
        """Have ``observer(self, attr_name, value)`` called when the attribute is updated.

        Sensor values are told with every message, states (``mode``, ``armed``, ``system_status``, ``ekf_ok``) when
        they change. ``'*'`` is every name. A listener that is there already is not added again; names are not checked,
        since programs tell of attributes of their own.
        """
        self._dk_listeners.add(attr_name, observer)

    def remove_attribute_listener(self, attr_name: str, observer: AttributeListener) -> None:
        """Call it no more. Silent when nobody listens to the name.

        Raises:
            ValueError: others listen to the name, but this one does not.
        """
        self._dk_listeners.remove(attr_name, observer)

    def on_attribute(self, name: str | list[str] | tuple[str, ...]) -> Callable[[ListenerT], ListenerT]:
        """Decorate a listener with the name, or the list of names, it listens to. It cannot be removed by name then."""
        return decorator_of(self.add_attribute_listener, name)

    def notify_attribute_listeners(self, attr_name: str, value: Any, cache: bool = False) -> None:
        """Tell the listeners of an attribute its value; with ``cache`` only when it is not the one told before.

        Call it from message listeners for attributes of your own. Returns when the listeners have run.
        """
        self._dk_listeners.tell(attr_name, value, cache, waits=True)
