"""Base of all simulated vehicles: simulated time, channels, timers, status texts, faults.

A vehicle uses no event loop. The caller passes the time in simulated seconds, which must never decrease. The times and
the order of events do not depend on the step size. Equal calls with an equal seed produce equal bytes.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass
from heapq import heapify, heappop, heappush
from random import Random
from typing import Any, Protocol

from aerokit.mavlink.enums import MavAutopilot, MavModeFlag, MavSeverity, MavState, MavType
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import Heartbeat, Statustext, Timesync
from aerokit.protocols.servers.host import ServerHost
from aerokit.protocols.servers.host import sender_of as sender_of
from aerokit.sim.channel import NS_PER_S, Channel
from aerokit.sim.faults import Faults

TICK_S = 0.02
"""Interval in which motion and modes are updated while the vehicle moves. In steady flight, a tick is longer."""

_STEADY_TICKS = 6
MAX_TICK_S = _STEADY_TICKS * TICK_S
"""Duration of the longest tick, in steady flight."""

# Each ground station sends these messages all the time. They do not change what the vehicle does.
_MESSAGES_WITHOUT_TARGETS = (Heartbeat.ID, Timesync.ID)

_TEXT_SIZE = 50
Handler = Callable[[Any, Channel], None]


def _whole_ticks(seconds: float) -> int:
    # A tick that is incomplete only by a rounding error counts.
    return int(seconds / TICK_S + 1e-6)


class MessageHost(ServerHost, Protocol):
    """A vehicle or component as its protocol servers see it."""

    faults: Faults


class VehicleJournal(Protocol):
    """Interface of an object that records received messages and sent texts, such as `aerokit.testing.Journal`.

    Times are simulated seconds.
    """

    def on_text_sent(self, time_s: float, severity: int, text: str) -> None: ...

    def on_message_received(self, time_s: float, message: Message) -> None: ...


class AttachableComponent(Protocol):
    """A MAVLink component that can be added to a vehicle, such as `ExtraComponent` or `SimulatedCamera`."""

    @property
    def component_id(self) -> int:
        """MAV_COMPONENT."""
        ...

    def join(self, vehicle: SimulatedVehicle) -> None:
        """Add the component to a vehicle. The vehicle calls this method once."""
        ...


@dataclass(frozen=True)
class ExtraComponent:
    """A component that only sends a heartbeat once a second."""

    component_id: int
    type: int = MavType.GIMBAL
    autopilot: int = MavAutopilot.INVALID
    system_id: int | None = None
    """System id of the component. None selects the system id of the vehicle."""
    base_mode: int = MavModeFlag(0)
    custom_mode: int = 0
    system_status: int = MavState.ACTIVE

    def join(self, vehicle: SimulatedVehicle) -> None:
        """Send heartbeats from the next power-on onwards."""
        heartbeat = Heartbeat(
            self.type, self.autopilot, self.base_mode, self.custom_mode, self.system_status, mavlink_version=3
        )
        system_id = vehicle.system_id if self.system_id is None else self.system_id
        sender = (system_id, self.component_id)
        vehicle.on_power_on(lambda: vehicle.every(1.0, lambda: vehicle.send(heartbeat, sender=sender)))


class SimulatedVehicle:
    """Base of a simulated vehicle, which does no I/O. Subclasses define messages, streams and motion.

    Pass the present time to `receive` and `step`, and send the bytes that `take_outbox` returns. `next_due` is the time
    of the next event. The first link uses the first channel. Call `open_channel` for each further link.
    """

    def __init__(
        self, *, system_id: int, component_id: int, seed: int, components: Iterable[AttachableComponent]
    ) -> None:
        self.system_id = system_id
        self.component_id = component_id
        self.faults: Faults = Faults()
        self.rng: Random = random.Random(seed)
        self.now: float = 0.0
        """Simulated time of the latest event, in seconds."""
        self.booted_at: float = math.nan
        """Time of the power-on or last reboot."""
        self.components: tuple[AttachableComponent, ...] = tuple(components)
        self.journal: VehicleJournal | None = None
        self.handlers: dict[int, Handler] = {}
        """Handlers by message id."""
        self._observers: dict[int, list[Handler]] = {}
        # Heap of (due time, number, function, owner). The numbers keep the order of timers with the same due time.
        self._timers: list[tuple[float, int, Callable[[], None], object]] = []
        self._timer_count = 0
        self._first_tick_at = self._next_tick_at = math.inf  # infinity while the vehicle does not tick
        self._ticks_done = 0  # number of units of TICK_S that have passed since `_first_tick_at`
        self._text_id = 0  # id of the last STATUSTEXT that was split into several messages
        self.is_on: bool = False
        """False before the power-on and during a reboot."""
        self._at_power_on: list[Callable[[], None]] = []  # functions to call at each power-on
        self.channels: list[Channel] = []
        self._channel = self.open_channel()  # the first channel
        for component in self.components:
            component.join(self)

    def open_channel(self, *, version: int = 2) -> Channel:
        """Open another port, which has its own stream rates. ``version`` is the MAVLink version of the port."""
        channel = Channel(self.system_id, self.component_id, self.handlers, version=version)
        self.channels.append(channel)
        if self.is_on:
            self.start_channel(channel)
        return channel

    def receive(self, data: bytes, now: float, peer: Hashable = None, channel: Channel | None = None) -> None:
        """Process bytes from a peer, and put the replies into the outbox."""
        self.step(now)
        channel = self._channel if channel is None else channel
        if self.faults.frozen or self.faults.silent or not self.is_on:
            return
        messages = channel.messages(data, now, peer)
        if not messages:
            return
        # In steady flight, ticks are long. End the present tick before the messages change the targets, and make the
        # next tick short.
        may_change_targets = any(message.ID not in _MESSAGES_WITHOUT_TARGETS for message in messages)
        if may_change_targets:
            self._tick_until(now)
        for message in messages:
            if sender_of(message) != (self.system_id, self.component_id):
                self._handle(message, channel)
        if may_change_targets:
            self._schedule_tick(1)
        self.step(now)

    def step(self, now: float) -> None:
        """Run everything that is due up to ``now``."""
        if not self.is_on and math.isnan(self.booted_at):  # The vehicle was never switched on.
            self.now = now
            self.power_on()
        if self.faults.frozen:  # Nothing runs, but the time passes.
            self._skip_to(now)
            return
        while (due := self.next_due) <= now:
            self.now = max(due, self.now)
            self._run_due(due)
        self.now = max(now, self.now)

    @property
    def next_due(self) -> float:
        """Time of the next event; infinity if there is none."""
        if not self.is_on and math.isnan(self.booted_at):  # `step` must switch on the vehicle at once.
            return self.now
        if self.faults.frozen:
            return self.now + TICK_S  # `step` must be called even if nothing happens, because it advances the time.
        due = self._next_tick_at
        if self._timers:
            timer_due, _, _, _ = self._timers[0]
            if timer_due < due:
                due = timer_due
        for channel in self.channels:
            stream_due = channel.streams.next_due
            if stream_due < due:
                due = stream_due
        return due

    def take_outbox(self) -> bytes:
        """Return and clear the outbox of the first channel."""
        return self._channel.take_outbox()

    @property
    def uptime(self) -> float:
        """Seconds since the power-on or the last reboot. Messages contain this time as ``time_boot_ms``."""
        return self.now - self.booted_at

    @property
    def time_boot_ms(self) -> int:
        return int((self.now - self.booted_at) * 1000.0) & 0xFFFFFFFF

    @property
    def time_boot_us(self) -> int:
        return int((self.now - self.booted_at) * 1e6)

    def power_on(self) -> None:
        """Boot now."""
        self.booted_at = self.now
        self.is_on = True
        self.boot()
        for channel in self.channels:
            self.start_channel(channel)
        for action in self._at_power_on:
            action()

    def on_power_on(self, action: Callable[[], None]) -> None:
        """Call a function at each power-on and reboot. If the vehicle is on already, also call it immediately."""
        self._at_power_on.append(action)
        if self.is_on:
            action()

    def reboot(self, silence_s: float) -> None:
        """Stop sending, clear stream rates and timers, and boot again after ``silence_s`` seconds.

        Components have their own power supply and keep running, but the vehicle forwards none of their messages
        meanwhile.
        """
        self.is_on = False
        self.cancel_timers(owner=None)
        self.set_ticking(False)
        for channel in self.channels:
            channel.reset()
        self.call_at(self.now + silence_s, self.power_on)

    def boot(self) -> None:
        """Called at power-on. By default, does nothing."""

    def start_channel(self, channel: Channel) -> None:
        """Start the default streams of a port. By default, there are none."""

    def build(self, message_id: int) -> Message | None:
        """Return the current message of this id; None if there is none."""
        return None

    def tick(self, dt: float) -> None:
        """Advance the vehicle by ``dt`` seconds, which is TICK_S or, in steady flight, a multiple of TICK_S."""

    @property
    def is_steady(self) -> bool:
        """True while one long tick is as exact as several short ticks.

        A long tick lasts at most 0.12 s. It ends before the next message or timer.
        """
        return False

    def call_at(self, when: float, action: Callable[[], None], *, owner: object = None) -> None:
        """Call a function at a simulated time.

        ``owner`` is a component, or None for the vehicle. A reboot of the owner cancels the call.
        """
        self._timer_count += 1
        heappush(self._timers, (when, self._timer_count, action, owner))

    def cancel_timers(self, owner: object) -> None:
        """Cancel all calls that were scheduled for this owner."""
        self._timers = [timer for timer in self._timers if timer[-1] is not owner]  # The owner is the last value.
        heapify(self._timers)

    def call_later(self, delay: float, action: Callable[[], None]) -> None:
        """Call a function after ``delay`` simulated seconds. A reboot cancels the call."""
        self.call_at(self.now + delay, action)

    def every(self, interval: float, action: Callable[[], None], *, owner: object = None) -> None:
        """Call a function every ``interval`` seconds until the owner reboots. See `call_at`."""
        start = self.now + interval
        count = 0

        def repeat() -> None:
            nonlocal start, count
            late_s = self.now - (start + count * interval)
            if late_s > interval:  # The vehicle was frozen. Skip the missed calls.
                start += late_s
            count += 1
            # The next call is scheduled first, so that an action that reboots the vehicle cancels it.
            self.call_at(round((start + count * interval) * NS_PER_S) / NS_PER_S, repeat, owner=owner)
            action()

        self.call_at(start, repeat, owner=owner)

    def set_ticking(self, ticking: bool) -> None:
        """Start or stop the calls of `tick`. Their rate is 50 Hz, and in steady flight at least 8 Hz."""
        is_ticking = self._first_tick_at != math.inf
        if ticking == is_ticking:
            return
        if ticking:
            # Ticks are multiples of TICK_S since the boot, so that ticks, timers and streams are due at the same
            # instants.
            self._first_tick_at = self.booted_at + _whole_ticks(self.uptime) * TICK_S
        else:
            self._first_tick_at = math.inf
        self._ticks_done = 0
        self._schedule_tick(1)

    def _schedule_tick(self, ticks: int) -> None:
        """Schedule the next tick after this many intervals of TICK_S."""
        next_tick = self._first_tick_at + (self._ticks_done + ticks) * TICK_S
        self._next_tick_at = round(next_tick * NS_PER_S) / NS_PER_S if next_tick < math.inf else math.inf

    def _tick_until(self, now: float) -> None:
        """Call `tick` once for all ticks that are due at ``now``."""
        if now < self._first_tick_at:
            return
        ticks = _whole_ticks(now - self._first_tick_at) - self._ticks_done
        if ticks > 0:
            self._ticks_done += ticks
            self.tick(ticks * TICK_S)
            self._schedule_tick(_STEADY_TICKS if self.is_steady else 1)

    def _run_due(self, due: float) -> None:
        self._tick_until(due)
        while self._timers and self._timers[0][0] <= due:  # The time of a timer is its first value.
            _, _, action, _ = heappop(self._timers)
            action()
        for channel in self.channels:
            if channel.streams.next_due <= due:
                for message_id in channel.streams.take_due(due):
                    self.send_built(message_id, channel)

    def _skip_to(self, now: float) -> None:
        """Set the time to ``now``. All events are delayed by the skipped time, as in a program that has hung."""
        delay = now - self.now
        if delay <= 0:
            return
        self.now = now
        self._timers = [(when + delay, count, action, owner) for when, count, action, owner in self._timers]
        self._first_tick_at += delay
        self._schedule_tick(1)
        for channel in self.channels:
            channel.streams.postpone(delay)

    def on(self, message_class: type[Message], handler: Handler) -> None:
        """Handle messages of a class that are addressed to this vehicle."""
        self.handlers[message_class.ID] = handler

    def observe(self, message_class: type[Message], handler: Handler) -> None:
        """Call a handler for all messages of a class, with any address, in addition to the vehicle's own handler."""
        self._observers.setdefault(message_class.ID, []).append(handler)
        self.handlers.setdefault(message_class.ID, lambda _message, _channel: None)

    def is_addressed(self, message: Message) -> bool:
        """Return True if a message is addressed to this component or broadcast."""
        system, component = getattr(message, "target_system", 0), getattr(message, "target_component", 0)
        return system in (0, self.system_id) and component in (0, self.component_id)

    def send(self, message: Message, channel: Channel | None = None, sender: tuple[int, int] | None = None) -> None:
        """Send a message on one channel, or on all if None. A frame lost by `Faults` leaves a sequence gap."""
        ports = self.channels if channel is None else (channel,)
        for port in ports:
            data = port.encode(message, sender)
            if not self.faults.drops_outgoing(message, self.rng):
                port.write(data)

    def send_built(self, message_id: int, channel: Channel | None = None) -> None:
        """Build the message with this id and send it. Send nothing if `build` returns None."""
        message = self.build(message_id)
        if message is not None:
            self.send(message, channel)

    def send_text(self, severity: int, text: str) -> None:
        """Send a STATUSTEXT on every channel. A text of more than 50 characters is divided into chunks."""
        text = text.encode("ascii", "replace").decode()
        if len(text) > _TEXT_SIZE:
            self._text_id = self._text_id % 0xFFFF + 1  # 1 to 65535, because the id 0 means a text of one chunk.
            self.send_chunks(severity, text, self._text_id)
            return
        self._record_text(severity, text)
        self.send_parts([Statustext(severity, text, 0, 0)])

    def send_chunks(self, severity: int, text: str, text_id: int) -> None:
        """Record a text, and send it as STATUSTEXTs with a common id.

        The last chunk has fewer than 50 characters, which marks the end.
        """
        self._record_text(severity, text)
        chunks = [text[start : start + _TEXT_SIZE] for start in range(0, len(text) + 1, _TEXT_SIZE)]
        self.send_parts([Statustext(severity, chunk, text_id, number) for number, chunk in enumerate(chunks)])

    def send_parts(self, chunks: list[Statustext]) -> None:
        """Send the chunks of one text. A subclass may send them only to some channels."""
        for chunk in chunks:
            self.send(chunk)

    def info(self, text: str) -> None:
        """Send a text of severity INFO."""
        self.send_text(MavSeverity.INFO, text)

    def _handle(self, message: Message, channel: Channel) -> None:
        handler = self.handlers.get(message.ID)
        # Observers get all messages, even those for other vehicles and those that a fault drops.
        for observer in self._observers.get(message.ID, ()):
            observer(message, channel)
        if handler is None or not self.is_addressed(message):
            return
        if self.faults.drops_incoming(self.rng):
            return
        if self.journal is not None:
            self.journal.on_message_received(self.now, message)
        handler(message, channel)

    def _record_text(self, severity: int, text: str) -> None:
        if self.journal is not None:
            self.journal.on_text_sent(self.now, severity, text)
