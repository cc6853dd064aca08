"""Asking for data streams, and asking again when they do not come."""

from __future__ import annotations

import asyncio
from contextlib import ExitStack
from typing import TYPE_CHECKING

import anyio

from aerokit.mavlink import messages as m
from aerokit.runtime.events import Event, LinkRestored, VehicleBack, VehicleRebooted

if TYPE_CHECKING:
    from aerokit.mavlink.message import Message
    from aerokit.vehicle.vehicle import Vehicle

__all__ = ["request_streams"]

EVERY_STREAM = 0
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
"""State cells whose messages tell what DroneKit's attributes tell."""


async def request_streams(vehicle: Vehicle, rate: float) -> None:
    """Ask for all streams at ``rate`` Hz (REQUEST_DATA_STREAM), again after a reboot or a silence, and when none come.

    A vehicle that knows no such message (PX4) streams what it streams by itself; what is missing of it is asked for
    by MAV_CMD_SET_MESSAGE_INTERVAL.
    """
    if not vehicle.autopilot.stream_groups:
        await _request_missing(vehicle, rate)
        return
    with ExitStack() as ends:
        await _keep_asking(vehicle, rate, _Heard(vehicle, ends))


async def _keep_asking(vehicle: Vehicle, rate: float, heard: _Heard) -> None:
    patience_s = COMES_WITHIN_S
    while True:
        _request(vehicle, rate)
        heard.forget()
        with anyio.move_on_after(patience_s):
            await heard.is_to_be_asked.wait()
            patience_s = COMES_WITHIN_S
            continue
        patience_s = min(2 * patience_s, LONGEST_S)
        if heard.something:
            await heard.is_to_be_asked.wait()
            patience_s = COMES_WITHIN_S


def _request(vehicle: Vehicle, rate: float) -> None:
    vehicle.send(m.RequestDataStream(vehicle.system_id, 0, EVERY_STREAM, max(1, round(rate)), 1))


async def _request_missing(vehicle: Vehicle, rate: float) -> None:
    await anyio.sleep(COMES_WITHIN_S)
    missing = [name for name in NEEDED if not vehicle.telemetry.cells[name].is_known]
    required = vehicle.telemetry.required_messages
    with ExitStack() as rates:
        for message_type in dict.fromkeys(each for name in missing for each in required(name)):
            rates.enter_context(vehicle.rate(message_type, rate))
        await anyio.sleep_forever()


class _Heard:
    """Whether streamed messages have come, and whether streams are to be asked for again."""

    def __init__(self, vehicle: Vehicle, ends: ExitStack) -> None:
        self.something = False
        self.is_to_be_asked = asyncio.Event()
        bus = vehicle.connection.bus
        for message_type in STREAMED:
            ends.callback(bus.attach(message_type, self._on_message, system_id=vehicle.system_id))
        for event_type in (LinkRestored, VehicleBack, VehicleRebooted):
            ends.callback(bus.attach_event(event_type, self._on_event))
        self._system_id = vehicle.system_id

    def forget(self) -> None:
        self.something, self.is_to_be_asked = False, asyncio.Event()

    def _on_message(self, message: Message) -> None:
        self.something = True

    def _on_event(self, event: Event) -> None:
        if event.system_id in (0, self._system_id):
            self.is_to_be_asked.set()
