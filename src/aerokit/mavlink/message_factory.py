"""``MessageFactory``: pymavlink's message factory with a configurable send function."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import TYPE_CHECKING, Any

from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega

from aerokit.errors import InvalidArgument

if TYPE_CHECKING:  # pymavlink's own annotations are stricter than its behaviour.

    class _MAVLink:
        total_packets_sent: int
        send_callback: Callable[..., object] | None
        send_callback_args: tuple[Any, ...] | None
        send_callback_kwargs: dict[str, Any] | None

        def __init__(self, file: object, source_system: int, source_component: int) -> None: ...
else:
    _MAVLink = ardupilotmega.MAVLink


class MessageFactory(_MAVLink):
    """Provides ``<message>_encode(…)``, which returns a pymavlink message, and ``<message>_send(…)`` for every message.

    The messages are those of pymavlink's ardupilotmega dialect for MAVLink 2, and further messages of the program's
    dialect (``mavutil.mavlink``). Strings may be ``str`` or bytes. Values are only checked on sending.

    To send with aerokit, create the factory with ``MessageFactory(lambda message: vehicle.send(from_pymavlink(message,
    vehicle.system_id)), 255, 0)``. `from_pymavlink` also rounds numbers for integer fields.
    """

    seq: int
    total_packets_sent: int
    """Number of messages sent, modulo 256. The link has its own sequence numbers."""

    def __init__(self, connection_send: Callable[[Any], object], source_system: int, source_component: int) -> None:
        """Create a factory that passes messages to ``connection_send(message)``."""
        super().__init__(None, source_system, source_component)
        self._connection_send = connection_send

    def send(self, mavmsg: Any, force_mavlink1: bool = False) -> None:
        """Send a message. If ``connection_send`` raises, the message is not counted.

        ``force_mavlink1`` is ignored, because the link uses the version that the vehicle supports.
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
                return function.__get__(self)  # The function of pymavlink's class is bound to this object.
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")


def _accept_text(encode: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap an ``…_encode`` method of pymavlink, which accepts only bytes, so that it accepts `str` for text fields."""

    @wraps(encode)
    def encode_text(self: MessageFactory, *args: Any, **kwargs: Any) -> Any:
        converted_args = [_as_bytes(value) for value in args]
        converted_kwargs = {name: _as_bytes(value) for name, value in kwargs.items()}
        try:
            return encode(self, *converted_args, **converted_kwargs)
        except AttributeError:
            raise InvalidArgument(f"{encode.__name__}: the value of a text field must be str or bytes") from None

    return encode_text


def _as_bytes(value: Any) -> Any:
    if isinstance(value, str):
        return value.encode()
    return bytes(value) if isinstance(value, (bytearray, memoryview)) else value


def _patch_text_encoders(factory: Any) -> None:
    for message_class in ardupilotmega.mavlink_map.values():
        if "char" in message_class.fieldtypes:
            name = f"{message_class.msgname.lower()}_encode"
            setattr(factory, name, _accept_text(getattr(factory, name)))


_patch_text_encoders(MessageFactory)
