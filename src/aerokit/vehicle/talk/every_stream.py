"""``every_stream``: asking for all that a vehicle streams, and asking again when it does not come."""

from __future__ import annotations

import asyncio
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING

import anyio

from aerokit.mavlink import messages as m
from aerokit.runtime.background import Background
from aerokit.runtime.events import Event, LinkChosen, LinkRestored, VehicleBack, VehicleRebooted
from aerokit.vehicle.checks import check_range

if TYPE_CHECKING:
    from collections.abc import Iterator

    from aerokit.mavlink.message import Message
    from aerokit.vehicle.talk.talk import Talk

__all__ = ["every_stream"]

EVERY_GROUP = EVERY_COMPONENT = 0
COMES_WITHIN_S = 3.0
LONGEST_S = 60.0
STREAMED: tuple[type[Message], ...] = (m.Attitude, m.GlobalPositionInt, m.SysStatus, m.VfrHud, m.GpsRawInt)
NEEDED = (
    "attitude",
    "position",
    "ground_speed_m_s",
    "gps",
    "sensors",
    "local_position",
    "estimator",
    "rc_channels",
)
"""States that every vehicle should stream."""


@contextmanager
def every_stream(talk: Talk, rate_hz: float) -> Iterator[None]:
    """See ``Vehicle.streams``."""
    check_range("rate_hz", rate_hz, 0, 1000, above=True)
    tasks = Background(talk.connection.fail)
    with ExitStack() as ends:
        if talk.autopilot.stream_groups:
            heard = _Heard(talk, ends)
            tasks.start(lambda: _keep_asking(talk, rate_hz, heard), "aerokit streams")
        else:
            tasks.start(lambda: _want_missing(talk, rate_hz, ends), "aerokit streams")
        try:
            yield
        finally:
            tasks.cancel()


async def _keep_asking(talk: Talk, rate_hz: float, heard: _Heard) -> None:
    patience_s = COMES_WITHIN_S
    rate = max(1, round(rate_hz))
    while True:
        talk.send(m.RequestDataStream(talk.system_id, EVERY_COMPONENT, EVERY_GROUP, rate, 1))
        heard.forget()
        with anyio.move_on_after(patience_s):
            await heard.is_to_be_asked.wait()
            patience_s = COMES_WITHIN_S
            continue
        patience_s = min(2 * patience_s, LONGEST_S)
        if heard.something:
            await heard.is_to_be_asked.wait()
            patience_s = COMES_WITHIN_S


async def _want_missing(talk: Talk, rate_hz: float, ends: ExitStack) -> None:
    await anyio.sleep(COMES_WITHIN_S)
    telemetry = talk.telemetry
    missing = [name for name in NEEDED if not telemetry.cells[name].is_known]
    for message_type in dict.fromkeys(each for name in missing for each in telemetry.required_messages(name)):
        ends.callback(talk.rates.want(message_type, rate_hz))


class _Heard:
    """Whether streamed messages have come, and whether streams are to be asked for again."""

    def __init__(self, talk: Talk, ends: ExitStack) -> None:
        self.something = False
        self.is_to_be_asked = asyncio.Event()
        self._system_id = talk.system_id
        bus = talk.connection.bus
        for message_type in STREAMED:
            ends.callback(bus.attach(message_type, self._on_message, system_id=talk.system_id))
        for event_type in (LinkChosen, LinkRestored, VehicleBack, VehicleRebooted):
            ends.callback(bus.attach_event(event_type, self._on_event))

    def forget(self) -> None:
        self.something, self.is_to_be_asked = False, asyncio.Event()

    def _on_message(self, message: Message) -> None:
        self.something = True

    def _on_event(self, event: Event) -> None:
        if event.system_id in (0, self._system_id):
            self.is_to_be_asked.set()
