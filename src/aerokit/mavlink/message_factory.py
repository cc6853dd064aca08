"""``MessageFactory``: pymavlink's maker of messages, whose ``…_send`` send by whatever a program gives it."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import TYPE_CHECKING, Any

from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega

from aerokit.errors import InvalidArgument

if TYPE_CHECKING:  # its own types are stricter than what is taken here

    class _MAVLink:
        total_packets_sent: int
        send_callback: Callable[..., object] | None
        send_callback_args: tuple[Any, ...] | None
        send_callback_kwargs: dict[str, Any] | None

        def __init__(self, file: object, source_system: int, source_component: int) -> None: ...
else:
    _MAVLink = ardupilotmega.MAVLink


class MessageFactory(_MAVLink):
    """Has ``<message>_encode(…)``, which returns a message of pymavlink, and ``<message>_send(…)`` for every message.

    The messages are those of pymavlink's ardupilotmega dialect for MAVLink 2; those that only the dialect of the
    program has (``mavutil.mavlink``) are made by that. Values are checked when the message is sent, not before:
    texts may be ``str`` or bytes, and numbers for integer fields are rounded, by :func:`from_pymavlink`:
    ``MessageFactory(lambda message: vehicle.send(from_pymavlink(message, vehicle.system_id)), 255, 0)``.
    """

    seq: int
    total_packets_sent: int
    """How many messages it has sent, 0..255, then from 0 again; the link counts by itself."""

    def __init__(
        self, connection_send: Callable[[Any], object], source_system: int, source_component: int
    ) -> None:
        """Make one whose messages go to ``connection_send(message)``; the ids are for programs to read."""
        super().__init__(None, source_system, source_component)
        self._connection_send = connection_send

    def send(self, mavmsg: Any, force_mavlink1: bool = False) -> None:
        """Send a message; what cannot be sent raises what ``connection_send`` raises, and is not counted.

        ``force_mavlink1`` means nothing: the link speaks the version that the vehicle understands.
        """
        self._connection_send(mavmsg)
        self.seq = (self.seq + 1) % 256
        self.total_packets_sent += 1
        if self.send_callback is not None:
            self.send_callback(mavmsg, *(self.send_callback_args or ()), **(self.send_callback_kwargs or {}))

    def __getattr__(self, name: str) -> Any:
        if name.endswith(("_encode", "_send")):
            dialect: Any = mavutil.mavlink
            function = getattr(dialect.MAVLink, name, None)
            if function is not None:
                return function.__get__(self)
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")


def _taking_text(encode: Callable[..., Any]) -> Callable[..., Any]:
    """Pymavlink takes bytes only."""

    @wraps(encode)
    def encode_text(self: MessageFactory, *args: Any, **kwargs: Any) -> Any:
        given = [_as_bytes(value) for value in args]
        named = {name: _as_bytes(value) for name, value in kwargs.items()}
        try:
            return encode(self, *given, **named)
        except AttributeError:
            raise InvalidArgument(f"{encode.__name__}: a text must be str or bytes") from None

    return encode_text


def _as_bytes(value: Any) -> Any:
    if isinstance(value, str):
        return value.encode()
    return bytes(value) if isinstance(value, (bytearray, memoryview)) else value


def _take_text_in(factory: Any) -> None:
    for message_class in ardupilotmega.mavlink_map.values():
        if "char" in message_class.fieldtypes:
            name = f"{message_class.msgname.lower()}_encode"
            setattr(factory, name, _taking_text(getattr(factory, name)))


_take_text_in(MessageFactory)
