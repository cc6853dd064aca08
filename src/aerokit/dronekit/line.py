"""``Line``: a link that is open until it is closed, with the threads of the classic API."""

from __future__ import annotations

import atexit
import functools
import logging
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from aerokit.dronekit.exceptions import classic_errors
from aerokit.dronekit.listener_thread import ListenerThread
from aerokit.dronekit.orders import Orders
from aerokit.dronekit.weakly import weakly
from aerokit.errors import AerokitError
from aerokit.runtime.components import is_autopilot

if TYPE_CHECKING:
    from aerokit.mavlink.message import Message
    from aerokit.runtime.connection import Connection
    from aerokit.sync.loop_thread import Held, LoopThread

__all__ = ["Line"]

logger, of_vehicles = logging.getLogger("dronekit.mavlink"), logging.getLogger("dronekit")

ORDERS_END_S = 2.0
"""How long closing waits for what was ordered a moment before to be answered."""


class Line:
    """An open connection, its event loop on a thread, and the thread of the program's callbacks."""

    def __init__(self, address: str, loop: LoopThread, held: Held[Connection], target_system: int) -> None:
        self.target_system = target_system
        """System id of the vehicle, 0 before it was heard."""
        self.listener_thread = ListenerThread()
        """Where the callbacks of the program run."""
        self.loop = loop
        """The event loop's thread."""
        self._held = held
        self.connection = held.value
        """The asynchronous connection, for code that runs on its loop."""
        self.orders = Orders(loop)
        """What was ordered without waiting."""
        self.knows_mavlink_2 = False
        """Whether the vehicle has said that it understands MAVLink 2, whichever version it speaks so far."""
        self.note_sent: Callable[[Message], None] = lambda message: None
        """Is told what has been sent, on the loop's thread: what steers is a newer order."""
        self.vehicle: Any = None
        """The vehicle of this connection, once there is one."""
        self._is_closed = threading.Event()
        self._closing = threading.Lock()
        self._at_close: list[Callable[[], object]] = []
        self._at_exit = weakly(self.close)
        atexit.register(self._at_exit)
        loop.when_dropped(
            functools.partial(_let_go, address, self._at_exit, self.listener_thread, self._at_close)
        )

    def send(self, message: Message, *, to: int | None = None) -> None:
        """Send a message, in the order of the calls; from any thread, never blocks.

        Raises:
            LocalProtocolError: a field is out of range; nothing was sent.
            APIException: the connection is closed.
        """
        message.encode()  # so that what is wrong with it is told to who made it
        with classic_errors():
            self.connection.raise_if_ended()
            self.orders.post(self._send, message, to)

    def _send(self, message: Message, to: int | None) -> None:
        try:
            self.connection.send(message, to=to)
            self.note_sent(message)
        except AerokitError as error:
            logger.warning("%s was not sent: %s", message.NAME, error)

    def close(self) -> None:
        """Wait shortly for the answers to what was ordered, then close the link and end the threads.

        Idempotent; from any thread, callbacks included, at the interpreter's exit and after the link was lost.
        """
        with self._closing:
            if self._is_closed.is_set():
                return
            self._is_closed.set()
        atexit.unregister(self._at_exit)
        try:
            self.orders.wait(ORDERS_END_S)
        finally:
            self.listener_thread.stop()
            try:
                self._held.close()
            finally:
                self.loop.close()
            self.listener_thread.join()
            for function in self._at_close:
                function()

    def on_close(self, function: Callable[[], object]) -> None:
        """Have a function called when the connection is closed."""
        self._at_close.append(function)

    def wait_closed(self, timeout: float) -> bool:
        """Wait at most ``timeout`` seconds for the connection to be closed by the program; says whether it is."""
        return self._is_closed.wait(timeout)

    @property
    def is_closed(self) -> bool:
        """Whether it was closed by the program."""
        return self._is_closed.is_set()

    def is_of_another_vehicle(self, system_id: int) -> bool:
        """Whether this system has an autopilot of its own and is not the connected vehicle."""
        heard = self.connection.heard
        return system_id != self.target_system and any(
            source[0] == system_id and is_autopilot(heartbeat) for source, heartbeat in heard.items()
        )

    def follow_version(self, heartbeat: Message) -> None:
        """Speak the version of MAVLink that the vehicle speaks: old firmware knows no other one (loop thread)."""
        frame = heartbeat.received_frame
        if frame is not None:
            version = 2 if self.knows_mavlink_2 else frame.version
            if version != self.connection.mavlink_version:
                self.connection.mavlink_version = version


def _let_go(
    address: str,
    at_exit: Callable[[], None],
    listener_thread: ListenerThread,
    at_close: list[Callable[[], object]],
) -> None:
    """On the loop, which ends then: nobody can reach the connection any more, or has anything called by it."""
    of_vehicles.warning("the vehicle at %s is closed: the program has dropped it without close()", address)
    atexit.unregister(at_exit)
    listener_thread.stop()
    for function in at_close:
        function()
