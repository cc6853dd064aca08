"""``HasObservers``: attributes whose changes a program can listen to."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from aerokit.dronekit.listener_thread import ListenerThread

__all__ = ["AttributeListener", "HasObservers", "ListenerT"]

logger = logging.getLogger("dronekit")

AttributeListener = Callable[[Any, str, Any], object]
"""``listener(object, attribute_name, value)``."""

ListenerT = TypeVar("ListenerT", bound=AttributeListener)

EVERY_NAME = "*"

_changing = threading.Lock()
"""Held while listeners are added and removed."""


class HasObservers:
    """An object with attributes that can be listened to.

    Listeners run on the vehicle's listener thread, in the order in which values came, those of a name before those
    of ``'*'``; they may block, raise, remove themselves and call whatever blocks. Without a listener thread they run
    on the thread that notifies.
    """

    def __init__(self, listener_thread: ListenerThread | None = None) -> None:
        self._dk_listener_thread = listener_thread
        self._attribute_listeners: dict[str, tuple[AttributeListener, ...]] = {}
        self._attribute_cache: dict[str, Any] = {}

    def add_attribute_listener(self, attr_name: str, observer: AttributeListener) -> None:
        """Have ``observer(self, attr_name, value)`` called when the attribute is updated.

        Sensor values are told with every message, states (``mode``, ``armed``, ``system_status``, ``ekf_ok``) when
        they change. ``'*'`` is every name. A listener that is there already is not added again; names are not checked,
        since programs tell of attributes of their own.
        """
        with _changing:
            present = self._attribute_listeners.get(attr_name, ())
            if observer in present:
                return
            self._attribute_listeners[attr_name] = (*present, observer)
            self._dk_stay()
        self._dk_review()

    def remove_attribute_listener(self, attr_name: str, observer: AttributeListener) -> None:
        """Call it no more. Silent when nobody listens to the name.

        Raises:
            ValueError: others listen to the name, but this one does not.
        """
        with _changing:
            present = self._attribute_listeners.get(attr_name)
            if present is None:
                return
            if observer not in present:
                raise ValueError(f"{observer!r} does not listen to {attr_name!r}")
            left = tuple(each for each in present if each != observer)
            if left:
                self._attribute_listeners[attr_name] = left
            else:
                del self._attribute_listeners[attr_name]
                self._dk_stay()
        self._dk_review()

    def on_attribute(self, name: str | list[str] | tuple[str, ...]) -> Callable[[ListenerT], ListenerT]:
        """Decorate a listener with the name, or the list of names, it listens to. It cannot be removed by name then."""

        def decorate(listener: ListenerT) -> ListenerT:
            for each in (name,) if isinstance(name, str) else name:
                self.add_attribute_listener(each, listener)
            return listener

        return decorate

    def notify_attribute_listeners(self, attr_name: str, value: Any, cache: bool = False) -> None:
        """Tell the listeners of an attribute its value; with ``cache`` only when it is not the one told before.

        Call it from message listeners for attributes of your own. Returns when the listeners have run.
        """
        if cache and self._dk_is_told(attr_name, value):
            return
        self._dk_note(attr_name)
        if attr_name in self._attribute_listeners or EVERY_NAME in self._attribute_listeners:
            if self._dk_listener_thread is None:
                self._dk_deliver(attr_name, value)
            else:
                self._dk_listener_thread.call(self._dk_deliver, attr_name, value)

    # ------------------------------------------------------------------------------- inside

    def _dk_tell(self, attr_name: str, value: Any, cache: bool = False) -> None:
        """As :meth:`notify_attribute_listeners` without waiting, for the loop thread."""
        if cache and self._dk_is_told(attr_name, value):
            return
        self._dk_note(attr_name)
        listeners = self._attribute_listeners
        if listeners and (attr_name in listeners or EVERY_NAME in listeners):
            if cache and self._dk_listener_thread is not None:
                self._dk_listener_thread.post(self._dk_deliver, attr_name, value)
            else:
                self._dk_offer(attr_name, value)

    def _dk_offer(self, attr_name: str, value: Any) -> None:
        """Have the listeners told of what comes again and again."""
        if self._dk_listener_thread is None:
            self._dk_deliver(attr_name, value)
        else:
            self._dk_listener_thread.offer(self._dk_deliver, attr_name, value)

    def _dk_is_told(self, attr_name: str, value: Any) -> bool:
        """Whether this was the last value told; if not, it is now."""
        if attr_name in self._attribute_cache and self._attribute_cache[attr_name] == value:
            return True
        self._attribute_cache[attr_name] = value
        return False

    def _dk_stay(self) -> None:
        """With listeners it stays, even when the program has dropped it."""
        if self._dk_listener_thread is not None:
            self._dk_listener_thread.keep(self, has_listeners=bool(self._attribute_listeners))

    def _dk_review(self) -> None:
        """Who listens to what has changed."""

    def _dk_note(self, attr_name: str) -> None:
        """An attribute has a value: what waits for it is told here."""

    def _dk_deliver(self, attr_name: str, value: Any) -> None:
        """Call the listeners, those that are there by now."""
        for name in (attr_name, EVERY_NAME):
            for listener in self._attribute_listeners.get(name, ()):
                try:
                    listener(self, attr_name, value)
                except (
                    BaseException
                ):  # sys.exit() too: it would end the callbacks of everybody, and nothing else
                    logger.exception("Exception in attribute handler for %s", attr_name)
