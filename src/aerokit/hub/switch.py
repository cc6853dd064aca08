"""``Switch``: what every frame passes: from the framer of its port by a plan into the batches of others."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING

from aerokit.hub.routing import Router
from aerokit.hub.targets import Targets
from aerokit.mavlink.frame import MAGIC_V2

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.connection.frame_observers import Recording
    from aerokit.hub.port import Port
    from aerokit.hub.routing import Plan
    from aerokit.mavlink.dialect import Dialect
    from aerokit.mavlink.frame import Frame
    from aerokit.mavlink.framer import Framer

LOOK_EVERY_S = 0.01
"""So often a link that took no more is asked whether it does again; while none does, ever more rarely."""
LOOK_AT_LEAST_EVERY_S = 0.08
MOST_GATHERED = 256
"""What came in one piece and is more than that is written at once."""


class Switch:
    """Ports and the router between them, on one loop.

    What a link brings in one go is gathered for each port and written together: when the link says that this is all,
    or else on the loop's next turn. There is no timer.
    """

    def __init__(
        self,
        dialect: Dialect,
        gate: Callable[[Port, int], float | None],
        on_mistake: Callable[[Port, Exception], object],
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._clock = self._loop.time
        self._wall_at_0 = time.time() - self._clock()
        self.router: Router[Port] = Router(Targets(dialect), gate)
        self.router.on_vehicle = _write_one_by_one
        self._on_mistake = on_mistake
        self.recording: Recording | None = None
        """Gets every frame once."""
        self._dirty: list[Port] = []
        self._is_scheduled = False
        self._holding: dict[Port, None] = {}
        self._timer: asyncio.TimerHandle | None = None
        self._pause_s = LOOK_EVERY_S

    def unix_time(self) -> float:
        """Seconds since 1970, as the system had them at the beginning, gone on by the loop's clock."""
        return self._wall_at_0 + self._clock()

    def add(self, port: Port) -> None:
        """A port has come."""
        port.node = self.router.add(port)

    def remove(self, port: Port) -> None:
        """A port has gone."""
        self._holding.pop(port, None)
        node, port.node = port.node, None
        if node is not None:
            self.router.remove(node)
        port.close()

    def close(self) -> None:
        """Nothing more is written."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._dirty.clear()
        self._holding.clear()

    def take(self, port: Port, framer: Framer, frames: list[Frame], data: bytes, now: float) -> None:
        """Frames came in at a port, of ``data``, with which they may begin and end."""
        # This runs for every frame.
        node, guard, peer = port.node, port.guard, port.peer
        if node is None or port.is_mute:
            if guard is not None:
                for frame in frames:
                    guard.admits(frame, framer, peer)
            port.totals.dropped["read_only"] += len(frames)
            return
        late, route, recording, border = framer.late, self.router.route, self.recording, port.border
        size = len(data) - 3
        for frame in frames:
            is_late = bool(late) and frame in late
            if border is not None:
                admitted = border.admitted(frame, self.unix_time())
                if admitted is None:
                    continue
                frame = admitted
            if (
                guard is not None
                and (guard.is_shared or frame.message_id == 0)
                and not guard.admits(frame, framer, peer)
            ):
                port.totals.dropped["foreign"] += 1
                continue
            plan = route(node, frame, now, is_late)
            # Most datagrams are one frame: there is no need to put it together again.
            body = frame.body
            raw = data if len(body) == size and data[1:-2] == body and data[0] == MAGIC_V2 else frame.raw
            for out in plan.outs:
                if batch := out.batch:
                    batch.append(raw)
                else:
                    self._begin(out, raw, plan, now)
            if plan.thinned:
                self._thin(raw, plan, now)
            elif plan.reason:
                port.totals.dropped[plan.reason] += 1
            if recording is not None and plan.reason != "duplicate":
                recording.write(raw, now)
        if self._dirty:
            if len(frames) > MOST_GATHERED:
                self.flush()
            elif not (self._is_scheduled or port.tells_bursts):
                self._is_scheduled = True
                self._loop.call_soon(self.flush)

    def flush(self) -> None:
        """Write what was gathered."""
        self._is_scheduled = False
        if not self._dirty:
            return
        dirty, self._dirty = self._dirty, []
        unix_time = self.unix_time()
        for port in dirty:
            if port.batch:
                try:
                    port.flush(unix_time)
                except Exception as error:  # the time stamps of a key are used up: the others go on
                    self._on_mistake(port, error)

    # ------------------------------------------------------------------------------------ inside

    def _begin(self, out: Port, raw: bytes, plan: Plan[Port], now: float) -> None:
        """The first frame of a batch; or one that has to wait."""
        if out.must_hold():
            out.hold(raw, plan, now)
            if out not in self._holding:
                self._holding[out] = None
                if self._timer is None:
                    self._pause_s = LOOK_EVERY_S
                    self._timer = self._loop.call_later(LOOK_EVERY_S, self._look)
        else:
            out.batch.append(raw)
            self._dirty.append(out)

    def _thin(self, raw: bytes, plan: Plan[Port], now: float) -> None:
        for out, period_s in plan.thinned:
            if out.is_due(plan.key, period_s, now):
                if out.batch:
                    out.batch.append(raw)
                else:
                    self._begin(out, raw, plan, now)

    def _look(self) -> None:
        """Now and then while something waits for a link."""
        now, unix_time = self._clock(), self.unix_time()
        self._timer = None
        self._pause_s = min(2 * self._pause_s, LOOK_AT_LEAST_EVERY_S)
        for port in tuple(self._holding):
            before = port.totals.frames_out
            try:
                port.drain(now, unix_time)
            except Exception as error:
                self._on_mistake(port, error)
            if port.totals.frames_out > before:
                self._pause_s = LOOK_EVERY_S
            if not port.is_holding:
                del self._holding[port]
        if self._holding:
            self._timer = self._loop.call_later(self._pause_s, self._look)


def _write_one_by_one(port: Port) -> None:
    port.one_at_a_time = True
