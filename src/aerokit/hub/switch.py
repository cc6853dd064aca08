"""``Switch``: forwards frames from the port at which they arrive to the batches of other ports."""

from __future__ import annotations

import asyncio
import time
from operator import attrgetter
from typing import TYPE_CHECKING

from aerokit.connection.loop_watch import LoopWatch
from aerokit.hub.message_rules import ORDER_MAX_AGE_S, TargetFields
from aerokit.hub.port import MAX_JOINED_BYTES
from aerokit.hub.routing import Router

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.connection.frame_observers import Recording
    from aerokit.hub.port import Port
    from aerokit.hub.routing import ForwardingPlan
    from aerokit.mavlink.dialect import Dialect
    from aerokit.mavlink.frame import Frame
    from aerokit.mavlink.framer import Framer

# Full links are polled. The interval doubles, up to the maximum, after each poll in which no link accepted data.
MIN_POLL_INTERVAL_S = 0.01
MAX_POLL_INTERVAL_S = 0.08

# If a port receives more frames than this at once, the collected frames are written immediately.
MAX_BURST_FRAMES = 256

_HEARTBEAT_ID = 0

_message_id = attrgetter("message_id")


class Switch:
    """Forwards frames between ports, on one event loop.

    The frames that a link reads at once are collected for each port and written together: at the call of
    `BurstListener.burst_ended` if the link calls it, otherwise in the next loop iteration.
    """

    def __init__(self, dialect: Dialect, on_error: Callable[[Port, Exception], object]) -> None:
        self._loop = asyncio.get_running_loop()
        self._clock = self._loop.time
        self._unix_epoch_s = time.time() - self._clock()  # seconds since 1970 at loop time 0
        self._targets = TargetFields(dialect)
        self.router: Router[Port] = Router(self._targets, lambda port, message_id: port.min_interval(message_id))
        self.router.on_autopilot = _write_single_frames
        self._on_error = on_error
        self._loop_watch = LoopWatch(
            on_blocked=lambda _: None,
            on_slept=lambda _: self._drop_queued_orders(),
            on_caught_up=self._exclude_pause,
        )
        self._loop_watch.start()
        self.recording: Recording | None = None
        """Recording of every forwarded frame."""
        self._ports_to_flush: list[Port] = []  # ports with a batch to write
        self._is_scheduled = False  # True while a call of `flush` is pending
        # Ports with waiting frames; the keys are used as a set that keeps its order.
        self._queueing_ports: dict[Port, None] = {}
        self._timer: asyncio.TimerHandle | None = None  # None while no port has waiting frames
        self._poll_interval_s = MIN_POLL_INTERVAL_S

    def unix_time(self) -> float:
        """Return the time in seconds since 1970. It never jumps."""
        # Later corrections of the system time are ignored. This does no harm, because `Signing` uses the newest
        # received time stamp if that is later.
        return self._unix_epoch_s + self._clock()

    def add(self, port: Port) -> None:
        port.ingress = self.router.add(port)

    def remove(self, port: Port) -> None:
        self._queueing_ports.pop(port, None)
        ingress, port.ingress = port.ingress, None
        if ingress is not None:
            self.router.remove(ingress)
        port.close()

    def close(self) -> None:
        self._loop_watch.close()
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._ports_to_flush.clear()
        self._queueing_ports.clear()

    def arrival_time(self, now: float) -> float:
        """Return the earliest time at which data that is read now may have arrived; after a pause, before ``now``."""
        # The data may have waited in a socket since the loop last ran, or while the computer was suspended.
        watch = self._loop_watch
        return watch.arrival_time(now) if now > watch.late_after else now

    def _exclude_pause(self, paused_s: float) -> None:
        # Nothing was read during the pause, so it does not count as silence of the senders.
        now = self._clock()
        self.router.exclude_pause(now, paused_s)
        for guard in {port.guard for port in self.router.ports if port.guard is not None}:
            guard.exclude_pause(now, paused_s)

    def _drop_queued_orders(self) -> None:
        # After the computer was suspended, the commands that wait for full links are too old.
        for port in self._queueing_ports:
            port.drop_orders()

    def receive(
        self, port: Port, framer: Framer, frames: list[Frame], data: bytes | None, now: float, arrived_at: float
    ) -> None:
        """Forward frames received at a port.

        ``data`` has the received bytes; None if they are not exactly the bytes of these frames. If it is given, the
        frames may be forwarded in one piece.
        """
        ingress = port.ingress  # A listener may remove the port during the checks below.
        if ingress is None or port.is_read_only:  # `ingress` is None if the port was removed.
            if port.guard is not None:
                for frame in frames:
                    port.guard.admits(frame, framer, port.peer)  # The guard must record the ids of each peer.
            port.counters.dropped["read_only"] += len(frames)
            return
        out_of_order = framer.late
        if self._must_check(port, frames):
            received_count = len(frames)
            frames, out_of_order = self._admitted(port, framer, frames)
            if port.signer is not None or len(frames) != received_count:
                data = None  # The received bytes contain more than the frames to forward.
        if now - arrived_at > ORDER_MAX_AGE_S:
            frames = self._without_late(port, frames, arrived_at)
            data = None
        plans = self.router.route_all(ingress, frames, arrived_at, out_of_order)
        is_forwarded = data is not None and self.recording is None and self._forward_together(plans, data)
        if not is_forwarded:
            for frame, plan in zip(frames, plans, strict=True):
                self._forward(port, frame.raw, plan, now)
        if self._ports_to_flush:
            if len(frames) > MAX_BURST_FRAMES:
                self.flush()
            elif not (self._is_scheduled or port.reports_bursts):  # A reported burst is flushed when it ends.
                self._is_scheduled = True
                self._loop.call_soon(self.flush)

    def _must_check(self, port: Port, frames: list[Frame]) -> bool:
        if port.signer is not None:
            return True
        guard = port.guard
        return guard is not None and (guard.has_several_peers or _HEARTBEAT_ID in map(_message_id, frames))

    def flush(self) -> None:
        self._is_scheduled = False
        if not self._ports_to_flush:
            return
        ports, self._ports_to_flush = self._ports_to_flush, []
        unix_time = self.unix_time()
        for port in ports:
            if port.batch:
                try:
                    port.flush(unix_time)
                except Exception as error:  # For example, signing has failed. Other ports must continue.
                    self._on_error(port, error)

    def _admitted(self, port: Port, framer: Framer, frames: list[Frame]) -> tuple[list[Frame], list[Frame]]:
        """Check signatures and ids. Return the accepted frames, and those of them that arrived out of order."""
        admitted: list[Frame] = []
        out_of_order: list[Frame] = []
        signer, guard, peer = port.signer, port.guard, port.peer
        for received in frames:
            frame = received if signer is None else signer.verify(received, self.unix_time())
            if frame is None:
                continue
            # The guard must see every heartbeat. If there is only one peer, its other frames need no check.
            must_check = guard is not None and (guard.has_several_peers or frame.message_id == _HEARTBEAT_ID)
            if guard is not None and must_check and not guard.admits(frame, framer, peer):
                port.counters.dropped["foreign"] += 1
                continue
            admitted.append(frame)
            if received in framer.late:
                out_of_order.append(frame)
        return admitted, out_of_order

    def _without_late(self, port: Port, frames: list[Frame], arrived_at: float) -> list[Frame]:
        remaining = []
        for frame in frames:
            if self._targets.expires(frame.message_id):
                port.drop_late(frame, self._targets.target_of(frame), arrived_at)
            else:
                remaining.append(frame)
        return remaining

    def _forward_together(self, plans: list[ForwardingPlan[Port]], data: bytes) -> bool:
        """Forward ``data`` in one write, if all ports permit it. Return True if the data was forwarded."""
        outs = plans[0].outs
        for plan in plans:
            if plan.outs is not outs or not plan.is_plain:
                return False
        # Several frames are written in one piece only if they are short enough and every port permits it.
        if len(plans) > 1 and not (len(data) <= MAX_JOINED_BYTES and all(out.joins_frames for out in outs)):
            return False
        for out in outs:
            if not out.batch and out.must_queue():  # A full port queues frames one by one.
                return False
        for out in outs:
            if not out.batch:
                self._ports_to_flush.append(out)
            out.batch.append(data)
            out.counters.frames_out += len(plans) - 1  # `flush` counts each piece of the batch as one frame.
        return True

    def _forward(self, port: Port, raw: bytes, plan: ForwardingPlan[Port], now: float) -> None:
        for out in plan.outs:
            if out.batch:
                out.batch.append(raw)
            else:
                self._send_or_queue(out, raw, plan, now)
        if plan.rate_limited:
            self._forward_limited(raw, plan, now)
        elif plan.reason:
            port.counters.dropped[plan.reason] += 1
        if self.recording is not None and not plan.reason:
            self.recording.write(raw, now)

    def _send_or_queue(self, out: Port, raw: bytes, plan: ForwardingPlan[Port], now: float) -> None:
        if out.ingress is None:
            return  # The port was removed after the frame was routed.
        if out.must_queue():
            out.enqueue(raw, plan, now)
            if out not in self._queueing_ports:
                self._queueing_ports[out] = None
                if self._timer is None:
                    self._poll_interval_s = MIN_POLL_INTERVAL_S
                    self._timer = self._loop.call_later(MIN_POLL_INTERVAL_S, self._poll)
        else:
            out.batch.append(raw)
            self._ports_to_flush.append(out)

    def _forward_limited(self, raw: bytes, plan: ForwardingPlan[Port], now: float) -> None:
        for out, interval_s in plan.rate_limited:
            if out.passes_rate_limit(plan.key, interval_s, now):
                if out.batch:
                    out.batch.append(raw)
                else:
                    self._send_or_queue(out, raw, plan, now)

    def _poll(self) -> None:
        now, unix_time = self._clock(), self.unix_time()
        self._timer = None
        self._poll_interval_s = min(2 * self._poll_interval_s, MAX_POLL_INTERVAL_S)
        for port in tuple(self._queueing_ports):
            frames_out_before = port.counters.frames_out
            try:
                port.drain(now, unix_time)
            except Exception as error:
                self._on_error(port, error)
            if port.counters.frames_out > frames_out_before:
                self._poll_interval_s = MIN_POLL_INTERVAL_S
            if not port.waiting:
                self._queueing_ports.pop(port, None)  # The port may have been removed because a write failed.
        if self._queueing_ports:
            self._timer = self._loop.call_later(self._poll_interval_s, self._poll)


def _write_single_frames(port: Port) -> None:
    port.writes_single_frames = True
