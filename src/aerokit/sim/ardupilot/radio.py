"""The pilot's radio, and what RC_CHANNELS_OVERRIDE puts in its place."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

from aerokit.mavlink import messages as m
from aerokit.sim.vehicle import sender_of

if TYPE_CHECKING:
    from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle
    from aerokit.sim.channel import Channel

__all__ = ["Radio"]

_AT_REST = (1500, 1500, 1000, 1500, 1800, 1000, 1000, 1800)
_OVERRIDABLE, _CHANNELS = 16, 18
_NO_PULSES, _LOW_THROTTLE = 1, 2
"""SIM_RC_FAIL."""
_THROTTLE, _LOW_THROTTLE_PWM = 2, 950
_SAME_AS_BEFORE, _RELEASE_UPPER = 0xFFFF, 0xFFFE


class Radio:
    """What the vehicle hears: ``radio[2]`` is the throttle, in microseconds, overridden or not.

    Setting an item moves a stick or switch of the transmitter, of which there are eight.
    """

    def __init__(self, vehicle: ArduPilotVehicle) -> None:
        self._vehicle = vehicle
        self._sticks: list[int] = list(_AT_REST)
        self._overrides: dict[int, tuple[int, float]] = {}

    def __len__(self) -> int:
        return len(self._sticks)

    def __getitem__(self, index: int) -> int:
        if index in self._overrides:
            value, since = self._overrides[index]
            if value and self._vehicle.now - since < self._override_time():
                return value
        if index == _THROTTLE and self._failure == _LOW_THROTTLE:
            return _LOW_THROTTLE_PWM
        return self._sticks[index] if index < len(self._sticks) else 0

    def __setitem__(self, index: int, value: int) -> None:
        self._sticks[index] = value

    def __iter__(self) -> Iterator[int]:
        return (self[index] for index in range(len(self._sticks)))

    @property
    def channels(self) -> tuple[int, ...]:
        """All 18 that RC_CHANNELS has; those that nobody sends are 0."""
        if not self._overrides and self._failure != _LOW_THROTTLE:
            return (*self._sticks, *(0,) * (_CHANNELS - len(self._sticks)))
        return tuple(self[index] for index in range(_CHANNELS))

    @property
    def is_heard(self) -> bool:
        """Whether there are pulses: of the transmitter, or of RC_CHANNELS_OVERRIDE in its place."""
        vehicle = self._vehicle
        if not (vehicle.faults.rc_lost or self._failure == _NO_PULSES):
            return True
        limit = vehicle.now - self._override_time()
        return any(value and since > limit for value, since in self._overrides.values())

    def override(self, pulses: Mapping[int, int]) -> None:
        """Put these in the place of channels, from 0, as long as RC_OVERRIDE_TIME says; 0 gives one back."""
        for index, value in pulses.items():
            self._overrides[index] = (value, self._vehicle.now)

    @property
    def _failure(self) -> float:
        return self._vehicle.parameters.get("SIM_RC_FAIL", 0.0)

    def release_overrides(self) -> None:
        """Forget what was overridden, as a lost ground station makes the vehicle do."""
        self._overrides.clear()

    def listen(self) -> None:
        """Hear RC_CHANNELS_OVERRIDE."""
        self._vehicle.on(m.RcChannelsOverride, self._on_override)

    def reset(self) -> None:
        """Forget what was overridden, as a reboot does."""
        self._overrides.clear()

    def _override_time(self) -> float:
        """Seconds for which an override holds; below 0 means for ever."""
        seconds = self._vehicle.parameters["RC_OVERRIDE_TIME"]
        return math.inf if seconds < 0 else seconds

    def _on_override(self, override: m.RcChannelsOverride, _: Channel) -> None:
        """Only of the vehicle's own ground station. 0 leaves channels above 8 as they are, and releases the others."""
        vehicle = self._vehicle
        if sender_of(override)[0] != vehicle.parameters["MAV_GCS_SYSID"]:
            return
        vehicle.failsafes.ground_station_seen_at = vehicle.now
        for index in range(_OVERRIDABLE):
            value = getattr(override, f"chan{index + 1}_raw")
            if value == _SAME_AS_BEFORE or (value == 0 and index >= len(self._sticks)):
                continue
            if value == _RELEASE_UPPER and index >= len(self._sticks):
                value = 0
            self._overrides[index] = (value, vehicle.now)
