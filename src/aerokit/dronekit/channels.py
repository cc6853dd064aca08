"""``Channels`` and ``ChannelsOverride``: what the RC receiver hears, and what is put in its place."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import ItemsView, Iterable, KeysView, Mapping, ValuesView
from operator import attrgetter
from typing import TYPE_CHECKING, Any, NoReturn

from aerokit.dronekit.core import core_of
from aerokit.dronekit.exceptions import APIException
from aerokit.dronekit.line import RELEASE_UPPER
from aerokit.dronekit.privates import Python2Mapping
from aerokit.errors import InvalidArgument
from aerokit.mavlink.messages import RcChannels, RcChannelsOverride, RcChannelsRaw

if TYPE_CHECKING:
    from aerokit.dronekit.core import VehicleCore

FEWEST, MOST = 8, 18
UNUSED = 0xFFFF
"""In RC_CHANNELS: there is no such channel. In an override: leave the channel as it is."""
NUMBERS = tuple(str(number) for number in range(1, MOST + 1))
ALL_VALUES = attrgetter(*(f"chan{number}_raw" for number in NUMBERS))
FIRST_VALUES = attrgetter(*(f"chan{number}_raw" for number in NUMBERS[:FEWEST]))
MISSING: Any = object()


class _ChannelDict(dict[Any, Any], Python2Mapping[Any]):
    """Channels by number, as a text or an integer."""

    def __getitem__(self, channel: str | int) -> Any:
        return super().__getitem__(str(channel))

    def __contains__(self, channel: object) -> bool:
        return super().__contains__(str(channel))

    def get(self, channel: str | int, default: Any = None) -> Any:
        """The value of a channel, or ``default``."""
        return super().get(str(channel), default)

    def items(self) -> ItemsView[str, Any]:  # type: ignore[override]
        """Pairs of number and value as they are at this moment."""
        return self.copy().items()

    def keys(self) -> KeysView[str]:  # type: ignore[override]
        """The numbers, as texts, at this moment."""
        return self.copy().keys()

    def values(self) -> ValuesView[Any]:  # type: ignore[override]
        """The values at this moment."""
        return self.copy().values()

    @classmethod
    def fromkeys(cls, channels: Iterable[Any], value: Any = None) -> dict[Any, Any]:
        """A plain dictionary with these keys."""
        return dict.fromkeys(channels, value)


def _refused(name: str) -> Any:
    """A method that the channels do not have: they are the vehicle's to change."""

    def refuse(*_: object, **__: object) -> NoReturn:
        raise TypeError(f"{name} is not supported on Channels object")

    refuse.__name__, refuse.__doc__ = name, "Raises TypeError: channels are the vehicle's to change."
    return refuse


class Channels(_ChannelDict):
    """What the autopilot hears on its RC channels, overrides included: microseconds by number (``'1'`` or 1).

    Filled by RC_CHANNELS and RC_CHANNELS_RAW; None is a channel that it has not told yet, or that it does not have.
    One message changes all values at once. Eight channels, 16 after RC_CHANNELS_RAW has told of more, or
    :attr:`count`. Read only, except for :attr:`overrides`.
    """

    def __init__(self, vehicle: VehicleCore, count: int) -> None:
        super().__init__()
        self._core = core = core_of(vehicle)
        self._count = 0
        self._changing = threading.Lock()
        self._overrides = ChannelsOverride(vehicle)
        self._grow(count)
        core.on(RcChannels, self._on_channels)
        core.on(RcChannelsRaw, self._on_raw)

    @property
    def count(self) -> int:
        """How many channels are here. Set it to more than 8, at most 18 (else ValueError), to have those too."""
        return self._count

    @count.setter
    def count(self, count: int) -> None:
        if not FEWEST <= count <= MOST:
            raise InvalidArgument(f"count = {count!r} is not allowed: {FEWEST} to {MOST}")
        with self._changing:
            self._grow(count)
            for number in NUMBERS[count:]:
                dict.pop(self, number, None)

    @property
    def overrides(self) -> ChannelsOverride:
        """The channels that are overridden, see :class:`ChannelsOverride`. Assigning a mapping replaces all of them."""
        return self._overrides

    @overrides.setter
    def overrides(self, overrides: Mapping[Any, float | None]) -> None:
        self._overrides._replace(overrides)

    # ------------------------------------------------------------------------- not for programs

    if not TYPE_CHECKING:  # a checker believes that a dictionary can be changed
        __setitem__, __delitem__, __ior__ = map(_refused, ("__setitem__", "__delitem__", "__ior__"))
        clear, pop, popitem = map(_refused, ("clear", "pop", "popitem"))
        setdefault, update = map(_refused, ("setdefault", "update"))

    def _on_channels(self, message: RcChannels) -> None:
        self._take(0, ALL_VALUES(message))

    def _on_raw(self, message: RcChannelsRaw) -> None:
        first = message.port * FEWEST
        if self._count < first + FEWEST <= MOST:
            with self._changing:
                self._grow(first + FEWEST)
        self._take(first, FIRST_VALUES(message))

    def _take(self, first: int, heard: tuple[int, ...]) -> None:
        """Channels ``first + 1`` and so on, as far as there are so many here."""
        with self._changing:
            numbers = NUMBERS[first : self._count]
            values = (None if value == UNUSED else value for value in heard)
            dict.update(self, dict(zip(numbers, values, strict=False)))  # readers see all of it or nothing
        self._core.listeners.tell("channels", self)

    def _grow(self, count: int) -> None:
        self._count = self._overrides.count = count
        dict.update(self, {number: self.get(number) for number in NUMBERS[:count]})


class ChannelsOverride(_ChannelDict):
    """Channels that are overridden: microseconds by number. Each change is sent at once, as RC_CHANNELS_OVERRIDE.

    Set a channel to 1000–2000 (whatever fits into 16 bits is sent), and to None or 0, or delete it, to give it back
    to the radio. Channels that are not in here are the radio's; those above 8 are left as others have set them.
    KeyError for a channel that is none, ValueError for a value that is none: nothing was changed or sent.

    **Nothing is repeated**: a vehicle takes a channel back on its own when it has heard nothing for a while
    (ArduPilot: RC_OVERRIDE_TIME, 3 s), which is what makes it safe that a program may hang. A program that keeps a
    stick pressed sets it again, several times a second. All channels are given back when the connection ends
    (``connect(release_overrides=)``), unless the process is killed. ArduPilot listens only to the ground station it
    belongs to (``connect(source_system=)`` and MAV_GCS_SYSID, 255).
    """

    def __init__(self, vehicle: VehicleCore) -> None:
        super().__init__()
        self._core = core_of(vehicle)
        self.count = FEWEST
        """How many channels there are to override."""
        self._given_back: set[str] = set()
        self._changing = threading.RLock()

    def __setitem__(self, channel: str | int, value: float | None) -> None:
        self._change({channel: value})

    def __delitem__(self, channel: str | int) -> None:
        self.pop(channel)

    def __ior__(self, other: Any) -> ChannelsOverride:  # type: ignore[misc]
        self.update(other)
        return self

    def update(self, *others: Any, **more: Any) -> None:
        """Override these channels too, by one message."""
        self._change(dict(*others, **more))

    def clear(self) -> None:
        """Give all channels back to the radio, by one message."""
        self._replace({})

    def pop(self, channel: str | int, default: Any = MISSING) -> Any:
        """Give a channel back to the radio and return its value; ``default``, or KeyError, if it is not overridden."""
        with self._changing:
            if channel in self:
                value = self[channel]
                self._change({channel: None})
                return value
        if default is MISSING:
            raise KeyError(str(channel))
        return default

    def popitem(self) -> tuple[str, int]:
        """Give the channel that was overridden last back to the radio; KeyError if none is."""
        with self._changing:
            if not self:
                raise KeyError("no channel is overridden")
            channel = list(self)[-1]
            return channel, self.pop(channel)

    def setdefault(self, channel: str | int, default: Any = None) -> Any:
        """Override a channel unless it is overridden; the value that it has then."""
        with self._changing:
            if channel not in self:
                self._change({channel: default})
            return self.get(channel)

    def _replace(self, overrides: Mapping[Any, float | None]) -> None:
        with self._changing:
            self._become(self._checked(overrides))

    def _change(self, changes: Mapping[Any, float | None]) -> None:
        with self._changing:
            self._become({**self.copy(), **self._checked(changes)})

    def _become(self, wanted: dict[str, int]) -> None:
        """Send first: what cannot be sent changes nothing here."""
        active = {channel: value for channel, value in wanted.items() if value}
        given_back = (self._given_back | self.keys()) - active.keys()
        self._send(active, given_back)
        for channel in self.keys() - active.keys():
            dict.pop(self, channel)
        dict.update(self, active)
        self._given_back = given_back

    def _checked(self, overrides: Mapping[Any, float | None]) -> dict[str, int]:
        """By number as a text; 0 gives a channel back."""
        checked: dict[str, int] = {}
        for channel, value in overrides.items():
            number = int(channel)
            if not 1 <= number <= self.count:
                raise KeyError(f"Invalid channel index {channel}")
            checked[str(number)] = _checked_value(number, value)
        return checked

    def _send(self, active: dict[str, int], given_back: set[str]) -> None:
        aio = self._core.check_link()
        if aio.connection.mavlink_version == 1 and any(int(channel) > FEWEST for channel in active):
            raise APIException("channels above 8 cannot be overridden: this vehicle speaks MAVLink 1")
        values = [active.get(number, 0) for number in NUMBERS]
        for channel in given_back:
            if int(channel) > FEWEST:
                values[int(channel) - 1] = RELEASE_UPPER
        self._core.send(RcChannelsOverride(self._core.target_system, 0, *values))


def _checked_value(number: int, value: Any) -> int:
    """Microseconds, 0 to give the channel back; InvalidArgument, a ValueError, names the channel."""
    if value is None:
        return 0
    with contextlib.suppress(TypeError, ValueError, OverflowError):
        microseconds = round(value)  # numpy's numbers too, and what a controller works out
        if 0 <= microseconds <= UNUSED:
            return int(microseconds)
    raise InvalidArgument(
        f"channel {number} = {value!r} is not allowed: microseconds, 1000 to 2000 as a rule; None gives it back"
    )
