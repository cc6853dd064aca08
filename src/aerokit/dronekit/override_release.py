"""``OverrideRelease``: gives overridden RC channels back to the radio when the connection ends."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from aerokit.errors import AerokitError
from aerokit.mavlink.messages import RcChannelsOverride

if TYPE_CHECKING:
    from aerokit.mavlink.message import Message
    from aerokit.runtime.connection import Connection

__all__ = ["CHANNELS_OF_MAVLINK_1", "RELEASE_UPPER", "OverrideRelease"]

IGNORE = 0xFFFF
RELEASE = 0
RELEASE_UPPER = 0xFFFE
"""Gives a channel above 8 back to the radio; 0 leaves it alone."""
CHANNELS_OF_MAVLINK_1 = 8
CHANNELS = 18
COPIES = 3
"""A release is not acknowledged, so it is sent more than once: frames get lost."""


class OverrideRelease:
    """The channels that this connection overrides, by target, and the messages that end that.

    https://mavlink.io/en/messages/common.html#RC_CHANNELS_OVERRIDE
    """

    is_wanted: bool

    def __init__(self) -> None:
        self.is_wanted = True
        self._overridden: dict[tuple[int, int], set[int]] = {}

    def note_sent(self, message: Message) -> None:
        """Take the channels of an RC_CHANNELS_OVERRIDE that was sent; other messages mean nothing."""
        if not isinstance(message, RcChannelsOverride):
            return
        target = message.target_system, message.target_component
        overridden = self._overridden.setdefault(target, set())
        for channel in range(1, CHANNELS + 1):
            value = getattr(message, f"chan{channel}_raw")
            is_upper = channel > CHANNELS_OF_MAVLINK_1
            if value == (RELEASE_UPPER if is_upper else RELEASE):
                overridden.discard(channel)
            elif value not in (IGNORE, RELEASE):
                overridden.add(channel)

    def send(self, connection: Connection) -> None:
        """Give back what is overridden, if that is wanted (loop thread). Never raises."""
        for (system, component), channels in self._overridden.items():
            if self.is_wanted and channels:
                values = [_released(channel, channel in channels) for channel in range(1, CHANNELS + 1)]
                message = RcChannelsOverride(system, component, *values)
                with contextlib.suppress(AerokitError):  # the link is gone
                    for _ in range(COPIES):
                        connection.send(message)


def _released(channel: int, is_overridden: bool) -> int:
    if channel > CHANNELS_OF_MAVLINK_1:
        return RELEASE_UPPER if is_overridden else 0
    return RELEASE if is_overridden else IGNORE
