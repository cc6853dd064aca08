"""Reads a mission, a fence or rally points item by item."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from aerokit._internal.values import Snapshot
from aerokit.errors import MissionTimeout
from aerokit.mavlink.enums import MavMissionResult
from aerokit.mavlink.messages import (
    MissionAck,
    MissionCount,
    MissionItem,
    MissionItemInt,
    MissionRequest,
    MissionRequestInt,
    MissionRequestList,
)
from aerokit.missions.wire import from_wire
from aerokit.protocols.exchange import ranges
from aerokit.protocols.missions import (
    BUSY_AGAIN_S,
    BUSY_S,
    FORGOTTEN_S,
    MissionExchange,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from aerokit.mavlink.message import Message
    from aerokit.missions.item import MissionItem as Item

__all__ = ["Downloaded", "MissionDownload"]

MAX_RESTARTS = 8
EARLIEST_ANSWER = 0.8
"""Of a round trip: what comes earlier is no answer to the request."""


class Downloaded(Snapshot):
    """The items as they came, how many there are in all, what the vehicle calls them (0: it gives no ``opaque_id``)."""

    items: tuple[Item, ...]
    count: int
    opaque_id: int


class MissionDownload(MissionExchange[Downloaded]):
    """MISSION_REQUEST_LIST, then every item, then our MISSION_ACK.

    ``window`` is how many requests are under way: 1 for PX4, which gives up (ERROR) when an item is asked for that is
    neither the next one nor the one before; ArduPilot answers any request, so that only what is missing is asked for
    again. With ``only``, no others than these are asked for.
    """

    expects: tuple[type[Message], ...] = (MissionCount, MissionItemInt, MissionItem, MissionAck)

    # from start() on
    _list_at: float
    _heard_at: float

    def __init__(
        self,
        target_system: int,
        target_component: int,
        *,
        window: int,
        only: Sequence[int] | None = None,
        gives_int: bool = True,
        **options: Any,
    ) -> None:
        super().__init__(target_system, target_component, **options)
        self._window, self._gives_int = window, gives_int
        self._only = only
        self._wanted: Sequence[int] = ()
        self._items: dict[int, Item] = {}
        self._count: int | None = None
        self._opaque_id = 0
        self._next = 0
        self._asked_at: dict[int, float] = {}
        self._askings: dict[int, int] = {}
        self._busy_until: float | None = None
        self._restarts = 0

    def start(self, now: float) -> None:
        """Ask how many there are."""
        self._begin(now)
        self._heard_at = now
        self._ask_list(now)

    def receive(self, message: Message, now: float) -> None:
        """Take the count or an item."""
        if not self._is_ours(message):
            return
        if isinstance(message, MissionCount):
            self._heard_at = now
            self._take_count(message, now)
        elif isinstance(message, (MissionItemInt, MissionItem)):
            self._heard_at = now
            self._take_item(message, now)
        elif isinstance(message, MissionAck):
            self._take_ack(message.type, now)

    def expire(self, now: float) -> None:
        """Ask again for what is overdue, or give up."""
        if self._is_out_of_patience(now):
            self._give_up(now)
        elif self._count is None:
            self._attempt += 1
            self._ask_list(now)
        elif now - self._heard_at >= FORGOTTEN_S:
            self._begin_anew(now)
        else:
            for seq in [seq for seq in self._asked_at if self._due_at(seq) <= now]:
                self._ask(seq, now)
            self._wait_for_items(now)

    def link_changed(self, now: float) -> None:
        """PX4 gives items over the port that was asked for their number; what is there already is kept."""
        if self._count is not None and not self.done:
            self._ask_anew(now)

    # --------------------------------------------------------------------------------- answers

    def _take_count(self, message: MissionCount, now: float) -> None:
        opaque_id = message.opaque_id
        if self._count is None:
            if self._attempt == 1 and not self._restarts and self._window > 1:  # PX4 repeats it by itself
                self.round_trip.measured(now - self._list_at)
            if not opaque_id or opaque_id != self._opaque_id:
                self._items.clear()
        elif message.count == self._count and opaque_id == self._opaque_id:
            return  # PX4 repeats it until the first item is asked for
        else:  # another mission than the one begun with
            self._items.clear()
            self._forget_requests()
        self._count, self._opaque_id, self._busy_until = message.count, opaque_id, None
        self._wanted = (
            range(self._count) if self._only is None else [n for n in self._only if n < message.count]
        )
        self._move(now, len(self._items), len(self._wanted))
        self._go_on(now)

    def _take_item(self, item: MissionItemInt | MissionItem, now: float) -> None:
        if self._count is None or item.seq not in self._asked_at:
            return
        if self._askings[item.seq] == 1:
            self.round_trip.measured(now - self._asked_at[item.seq])
        del self._asked_at[item.seq]
        self._items[item.seq] = from_wire(item)
        self._move(now, len(self._items), len(self._wanted))  # also what was read before: it answers
        self._go_on(now)

    def _take_ack(self, result: int, now: float) -> None:
        if result == MavMissionResult.DENIED:
            self._wait_while_busy(result, now)
        elif result == MavMissionResult.ERROR:
            if now - self._list_at >= EARLIEST_ANSWER * (self.round_trip.smoothed_s or 0.0):
                self._begin_anew(
                    now
                )  # else it is about something sent before, a repeated item of an upload perhaps
        elif result not in (
            MavMissionResult.ACCEPTED,
            MavMissionResult.INVALID_SEQUENCE,  # MISSION_COUNT comes with it and tells the new number
            MavMissionResult.OPERATION_CANCELLED,  # an earlier upload's end
        ):
            self._reject(result)

    def _wait_while_busy(self, result: int, now: float) -> None:
        """ArduPilot gives nothing away while it receives; an upload nobody goes on with ends after 8 s."""
        if self._busy_until is None:
            self._busy_until = now + BUSY_S
        if now + BUSY_AGAIN_S > self._busy_until:
            self._reject(result)
            return
        self._forget_requests()
        self._count = None
        self._moved_at = now  # it answers: that is no silence
        self.deadline = now + BUSY_AGAIN_S

    def _begin_anew(self, now: float) -> None:
        """PX4 has given up; what is there already is kept, but has to be asked for in sequence again."""
        if self._restarts >= MAX_RESTARTS:
            self._reject(MavMissionResult.ERROR)
            return
        self._restarts += 1
        self._ask_anew(now)

    def _ask_anew(self, now: float) -> None:
        self._forget_requests()
        self._count, self._attempt, self._heard_at = None, 1, now
        self._ask_list(now)

    def _forget_requests(self) -> None:
        self._asked_at.clear()
        self._askings.clear()
        self._next = 0

    # -------------------------------------------------------------------------------- requests

    def _go_on(self, now: float) -> None:
        if len(self._items) >= len(self._wanted):
            self._end()
            return
        while self._next < len(self._wanted) and len(self._asked_at) < self._window:
            seq = self._wanted[self._next]
            if self._window == 1 or seq not in self._items:
                self._ask(seq, now)
            self._next += 1
        self._wait_for_items(now)

    def _ask(self, seq: int, now: float) -> None:
        kind = MissionRequestInt if self._gives_int else MissionRequest
        self._outbox.append(kind(self.target_system, self.target_component, seq, self.mission_type))
        self._asked_at[seq] = now
        self._askings[seq] = self._askings.get(seq, 0) + 1

    def _ask_list(self, now: float) -> None:
        self._outbox.append(MissionRequestList(self.target_system, self.target_component, self.mission_type))
        self._list_at = now
        self._wait(now)

    def _due_at(self, seq: int) -> float:
        return self._asked_at[seq] + self._timeout_s(self._askings[seq])

    def _wait_for_items(self, now: float) -> None:
        if self._asked_at:
            self.deadline: float | None = max(now, min(self._due_at(seq) for seq in self._asked_at))

    # ------------------------------------------------------------------------------------ end

    def _end(self) -> None:
        # twice: PX4 takes no upload before it has heard one of them, or 5 s have passed
        self._outbox += [self._ack(MavMissionResult.ACCEPTED)] * (2 if self._window == 1 else 1)
        items = tuple(self._items[seq] for seq in self._wanted)
        self._finish(Downloaded(items, self._count or 0, self._opaque_id))

    def _give_up(self, now: float) -> None:
        self._outbox += self.cancellation()
        missing = [seq for seq in self._wanted if seq not in self._items]
        what = "it did not say how many there are" if self._count is None else f"missing: {ranges(missing)}"
        self._fail(
            MissionTimeout(
                f"{self.kind}: the vehicle fell silent during the download: {what}"
                f" ({now - self._moved_at:.1f} s)",
                missing=tuple(seq - self.offset for seq in missing if seq >= self.offset),
            )
        )
