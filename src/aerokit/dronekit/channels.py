"""``Channels``: the vehicle's RC input. ``ChannelsOverride``: values that replace it."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import ItemsView, Iterable, KeysView, Mapping, ValuesView
from operator import attrgetter
from typing import TYPE_CHECKING, Any, NoReturn

from aerokit.dronekit.classic_connection import MAVLINK_1_CHANNELS, MAX_CHANNELS, RELEASE_UPPER
from aerokit.dronekit.core import core_of
from aerokit.dronekit.exceptions import APIException
from aerokit.dronekit.privates import Python2Mapping
from aerokit.errors import InvalidArgument
from aerokit.mavlink.messages import RcChannels, RcChannelsOverride, RcChannelsRaw

if TYPE_CHECKING:
    from aerokit.dronekit.core import VehicleCore

MIN_CHANNELS = 8
MAX_MICROSECONDS = 0xFFFF
NO_CHANNEL = 0xFFFF  # value of a channel that does not exist, in RC_CHANNELS and RC_CHANNELS_RAW
NUMBERS = tuple(str(number) for number in range(1, MAX_CHANNELS + 1))
ALL_VALUES = attrgetter(*(f"chan{number}_raw" for number in NUMBERS))
FIRST_VALUES = attrgetter(*(f"chan{number}_raw" for number in NUMBERS[:MIN_CHANNELS]))
MISSING: Any = object()


class _ChannelDict(dict[Any, Any], Python2Mapping[Any]):
    """A dict of channels, whose keys are numbers as strings or integers.

    ``keys()``, ``values()`` and ``items()`` are views of a copy, because messages change the dict at any time.
    """

    def __getitem__(self, channel: str | int) -> Any:
        return super().__getitem__(str(channel))

    def __contains__(self, channel: object) -> bool:
        return super().__contains__(str(channel))

    def get(self, channel: str | int, default: Any = None) -> Any:
        return super().get(str(channel), default)

    def items(self) -> ItemsView[str, Any]:  # type: ignore[override]
        return self.copy().items()

    def keys(self) -> KeysView[str]:  # type: ignore[override]
        return self.copy().keys()

    def values(self) -> ValuesView[Any]:  # type: ignore[override]
        return self.copy().values()

    @classmethod
    def fromkeys(cls, channels: Iterable[Any], value: Any = None) -> dict[Any, Any]:
        # Return a plain dict, because this class cannot be created without a vehicle.
        return dict.fromkeys(channels, value)


def _unsupported(name: str) -> Any:
    def refuse(*_: object, **__: object) -> NoReturn:
        raise TypeError(f"{name} is not supported on Channels object")

    refuse.__name__, refuse.__doc__ = name, "Raises TypeError: channels are read only."
    return refuse


class Channels(_ChannelDict):
    """RC input of the autopilot, overrides included: microseconds by number (``'1'`` or 1). Read only.

    The values come from RC_CHANNELS and RC_CHANNELS_RAW. All values of a message are stored at once. A channel is None
    if it does not exist or was not received. Set :attr:`overrides` to change channels.

    There are :attr:`count` channels: eight at first, 16 once an RC_CHANNELS_RAW with channels 9 to 16 has arrived.
    """

    def __init__(self, vehicle: VehicleCore, count: int) -> None:
        super().__init__()
        self._core = core = core_of(vehicle)
        self._count = 0
        self._changing = threading.Lock()  # held while the number of channels or their values change
        self._overrides = ChannelsOverride(vehicle)
        self._set_count(count)
        core.on(RcChannels, self._on_channels)
        core.on(RcChannelsRaw, self._on_raw)

    @property
    def count(self) -> int:
        """Number of channels. Programs can set it to 8 to 18; other numbers raise ValueError."""
        return self._count

    @count.setter
    def count(self, count: int) -> None:
        if not MIN_CHANNELS <= count <= MAX_CHANNELS:
            raise InvalidArgument(f"count = {count!r} is not allowed: it must be {MIN_CHANNELS} to {MAX_CHANNELS}")
        with self._changing:
            self._set_count(count)
            for number in NUMBERS[count:]:
                dict.pop(self, number, None)

    @property
    def overrides(self) -> ChannelsOverride:
        """Overridden channels, see :class:`ChannelsOverride`. Assigning a mapping replaces all of them."""
        return self._overrides

    @overrides.setter
    def overrides(self, overrides: Mapping[Any, float | None]) -> None:
        self._overrides._replace(overrides)

    # --------------------------------------------------------------------------------- private

    # The base class declares the methods below with other types, so the assignments are hidden from type checkers.
    if not TYPE_CHECKING:
        __setitem__, __delitem__, __ior__ = map(_unsupported, ("__setitem__", "__delitem__", "__ior__"))
        clear, pop, popitem = map(_unsupported, ("clear", "pop", "popitem"))
        setdefault, update = map(_unsupported, ("setdefault", "update"))

    def _on_channels(self, message: RcChannels) -> None:
        self._store(0, ALL_VALUES(message))

    def _on_raw(self, message: RcChannelsRaw) -> None:
        first_index = message.port * 8  # Each message has the eight channels of one port.
        if self._count < first_index + 8 <= MAX_CHANNELS:
            with self._changing:
                self._set_count(first_index + 8)
        self._store(first_index, FIRST_VALUES(message))

    def _store(self, first_index: int, received: tuple[int, ...]) -> None:
        """Store the values of consecutive channels, from number ``first_index + 1`` on."""
        with self._changing:
            numbers = NUMBERS[first_index : self._count]
            values = (None if value == NO_CHANNEL else value for value in received)
            # One call, so that other threads see all new values or none.
            dict.update(self, dict(zip(numbers, values, strict=False)))
        self._core.listeners.notify("channels", self)

    def _set_count(self, count: int) -> None:
        self._count = count
        self._overrides.count = count
        dict.update(self, {number: self.get(number) for number in NUMBERS[:count]})


class ChannelsOverride(_ChannelDict):
    """Overridden channels: microseconds by number. Each change is sent at once, as RC_CHANNELS_OVERRIDE.

    Set a channel to 1000–2000 (any 16-bit value is sent). To release it to the radio, set it to None or 0, or delete
    it. An invalid channel (KeyError) or value (ValueError) changes and sends nothing.

    Each change releases all channels from 1 to 8 that are not in this dict, even if another program overrides them.
    Channels above 8 that this program has not overridden are left as they are.

    **Nothing is repeated**: the vehicle ends overrides when it receives none for a while (ArduPilot: RC_OVERRIDE_TIME,
    3 s), so that a hanging program loses control. To keep an override, set it several times a second. All channels are
    released when the connection ends (``connect(release_overrides=)``), unless the process is killed. ArduPilot accepts
    overrides only from the system id in its parameter MAV_GCS_SYSID (255, like ``connect(source_system=)``).
    """

    def __init__(self, vehicle: VehicleCore) -> None:
        super().__init__()
        self._core = core_of(vehicle)
        self.count = MIN_CHANNELS
        """Number of channels that can be overridden."""
        self._released: set[str] = set()  # released channels; every message releases those above 8 again
        self._changing = threading.RLock()  # held while a change is checked and its message is sent

    def __setitem__(self, channel: str | int, value: float | None) -> None:
        self._change({channel: value})

    def __delitem__(self, channel: str | int) -> None:
        self.pop(channel)

    def __ior__(self, other: Any) -> ChannelsOverride:  # type: ignore[misc]
        self.update(other)
        return self

    def update(self, *others: Any, **more: Any) -> None:
        """Override these channels with one message; other overrides stay."""
        self._change(dict(*others, **more))

    def clear(self) -> None:
        """Release all channels with one message."""
        self._replace({})

    def pop(self, channel: str | int, default: Any = MISSING) -> Any:
        """Release a channel and return its value.

        If the channel is not overridden, return ``default``, or raise KeyError without a default.
        """
        with self._changing:
            if channel in self:
                value = self[channel]
                self._change({channel: None})
                return value
        if default is MISSING:
            raise KeyError(str(channel))
        return default

    def popitem(self) -> tuple[str, int]:
        """Release the channel that was overridden last; KeyError if none is overridden."""
        with self._changing:
            if not self:
                raise KeyError("no channel is overridden")
            last_channel = list(self)[-1]
            return last_channel, self.pop(last_channel)

    def setdefault(self, channel: str | int, default: Any = None) -> Any:
        """Override a channel unless it is already overridden; return the value of its override."""
        with self._changing:
            if channel not in self:
                self._change({channel: default})
            return self.get(channel)

    def _replace(self, overrides: Mapping[Any, float | None]) -> None:
        with self._changing:
            self._apply(self._checked(overrides))

    def _change(self, overrides: Mapping[Any, float | None]) -> None:
        with self._changing:
            self._apply({**self.copy(), **self._checked(overrides)})

    def _apply(self, overrides: dict[str, int]) -> None:
        """Replace all overrides. A value of 0 releases its channel."""
        active = {channel: value for channel, value in overrides.items() if value}
        # Channels that were released earlier are released again, because the first message may have been lost.
        released = (self._released | self.keys()) - active.keys()
        self._send(active, released)  # This may raise, so the dict changes only afterwards.
        for channel in self.keys() - active.keys():
            dict.pop(self, channel)
        dict.update(self, active)
        self._released = released

    def _checked(self, overrides: Mapping[Any, float | None]) -> dict[str, int]:
        """Return microseconds by channel number. A value of 0 releases the channel."""
        checked: dict[str, int] = {}
        for channel, value in overrides.items():
            number = int(channel)
            if not 1 <= number <= self.count:
                raise KeyError(f"Invalid channel index {channel}")
            checked[str(number)] = _checked_value(number, value)
        return checked

    def _send(self, active: dict[str, int], released: set[str]) -> None:
        aio = self._core.check_link()
        if aio.connection.mavlink_version == 1 and any(int(channel) > MAVLINK_1_CHANNELS for channel in active):
            raise APIException("channels above 8 need MAVLink 2, and this vehicle uses MAVLink 1")
        # 0 releases channels 1 to 8 and leaves higher channels unchanged; RELEASE_UPPER releases higher channels.
        values = [active.get(number, 0) for number in NUMBERS]
        for channel in released:
            if int(channel) > MAVLINK_1_CHANNELS:
                values[int(channel) - 1] = RELEASE_UPPER
        self._core.send(RcChannelsOverride(self._core.target_system, 0, *values))


def _checked_value(number: int, value: Any) -> int:
    """Return a channel's value in microseconds. A value of 0 releases the channel."""
    if value is None:
        return 0
    with contextlib.suppress(TypeError, ValueError, OverflowError):
        microseconds = round(value)  # round() accepts floats and numpy numbers.
        if 0 <= microseconds <= MAX_MICROSECONDS:
            return int(microseconds)
    raise InvalidArgument(
        f"channel {number} = {value!r} is not allowed: expected 0 to {MAX_MICROSECONDS} microseconds (usually"
        " 1000 to 2000), or None, which releases the channel"
    )
