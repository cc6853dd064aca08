"""The clocks of vehicles, measured by TIMESYNC (https://mavlink.io/en/services/timesync.html)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import anyio

from aerokit._internal.values import Snapshot
from aerokit.errors import OperationTimeout
from aerokit.mavlink.messages import Timesync

if TYPE_CHECKING:
    from aerokit.vehicle.vehicle import Vehicle

__all__ = ["ClockOffset", "measure_clock"]

ASK_EVERY_S = 0.1
ANSWER_S = 2.0


class ClockOffset(Snapshot):
    """A vehicle's clock against ours: it shows ``offset_s`` more than the loop's clock.

    Known to within half of ``round_trip_s``, the shortest of ``answers`` round trips.
    """

    offset_s: float
    round_trip_s: float
    answers: int

    def to_ours(self, vehicle_time_s: float) -> float:
        """A time on the vehicle's clock, on ours."""
        return vehicle_time_s - self.offset_s


async def measure_clock(vehicle: Vehicle, *, questions: int = 8) -> ClockOffset:
    """Ask a vehicle for its time several times, and believe the quickest answer: it waited least on its way.

    Raises:
        OperationTimeout: none of the questions was answered.
        ConnectionClosed, LinkLost: the connection ended.
    """
    connection = vehicle.connection
    asked: dict[int, float] = {}
    found: list[tuple[float, float]] = []

    def hear(message: Timesync) -> None:
        frame = message.received_frame
        sent_at = asked.pop(message.ts1, None)
        if frame is None or sent_at is None or message.tc1 == 0 or frame.component_id != vehicle.component_id:
            return
        round_trip_s = frame.received_at - sent_at
        found.append((round_trip_s, message.tc1 / 1e9 - (sent_at + round_trip_s / 2)))

    detach = connection.bus.attach(Timesync, hear, system_id=vehicle.system_id)
    try:
        for _ in range(questions):
            now = connection.now()
            ours = int(now * 1e9) | 1  # the link's own questions are other ones
            asked[ours] = now
            connection.send(Timesync(0, ours), to=vehicle.system_id)
            await anyio.sleep(ASK_EVERY_S)
        give_up_at = connection.now() + ANSWER_S
        while asked and not found and connection.now() < give_up_at:
            connection.raise_if_ended()
            await anyio.sleep(ASK_EVERY_S)
    finally:
        detach()
    if not found:
        raise OperationTimeout(f"TIMESYNC was not answered; {vehicle.describe_link()}")
    round_trip_s, offset_s = min(found)
    return ClockOffset(offset_s, round_trip_s, len(found))
