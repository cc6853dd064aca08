"""What every simulated vehicle is made of: a clock that is fed, channels, timers, status texts, faults.

Nothing here knows an event loop. ``now`` is simulated seconds, given by the caller, never going back.
Whatever happens in between happens at its own instant and in the same order however large the steps are, so
the same calls with the same seed always give the same bytes.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass
from heapq import heappop, heappush
from random import Random
from typing import Any, Protocol

from aerokit.mavlink.enums import MavAutopilot, MavModeFlag, MavSeverity, MavState, MavType
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import Heartbeat, Statustext
from aerokit.sim.channel import Channel
from aerokit.sim.faults import Faults
from aerokit.sim.journal import Journal

TICK_S = 0.02
"""Motion, modes and failsafes run at 50 Hz while anything moves."""

_TEXT_SIZE = 50
Handler = Callable[[Any, Channel], None]


class Component(Protocol):
    """Another MAVLink component on this vehicle's links: `ExtraComponent`, or a device of `aerokit.sim.components`."""

    @property
    def component_id(self) -> int:
        """Its MAV_COMPONENT."""
        ...

    def join(self, vehicle: SimulatedVehicle) -> None:
        """Called once by the vehicle that it is given to."""
        ...


@dataclass(frozen=True)
class ExtraComponent:
    """A component that shows up with a heartbeat once a second, and says and hears nothing else."""

    component_id: int
    type: int = MavType.GIMBAL
    autopilot: int = MavAutopilot.INVALID
    system_id: int | None = None
    """None: of the vehicle's own system."""
    base_mode: int = MavModeFlag(0)
    custom_mode: int = 0
    system_status: int = MavState.ACTIVE

    def join(self, vehicle: SimulatedVehicle) -> None:
        """Send heartbeats from the vehicle's next start on."""
        heartbeat = Heartbeat(
            self.type, self.autopilot, self.base_mode, self.custom_mode, self.system_status, 3
        )
        system_id = vehicle.system_id if self.system_id is None else self.system_id
        sender = (system_id, self.component_id)
        vehicle.when_powered_on(lambda: vehicle.every(1.0, lambda: vehicle.send(heartbeat, sender=sender)))


class SimulatedVehicle:
    """The sans-IO frame of a vehicle; a subclass says what it hears, what it streams and how it moves.

    `receive` and `step` take the time, `take_outbox` gives the bytes; `next_due` says when `step` has
    something to do. They speak for the first channel; `open_channel` gives more, one for each link.
    """

    def __init__(
        self, *, system_id: int, component_id: int, seed: int, components: Iterable[Component]
    ) -> None:
        self.system_id = system_id
        self.component_id = component_id
        self.faults: Faults = Faults()
        self.rng: Random = random.Random(seed)
        self.now: float = 0.0
        """Simulated seconds of the latest thing that happened."""
        self.booted_at: float = math.nan
        """When it was switched on or last rebooted."""
        self.components: tuple[Component, ...] = tuple(components)
        self.journal: Journal | None = None
        """What it hears and says is written down here if somebody wants it."""
        self.handlers: dict[int, Handler] = {}
        """Message id → what is done with such a message."""
        self._overheard: dict[int, list[Handler]] = {}
        self._timers: list[tuple[float, int, Callable[[], None]]] = []
        self._timer_count = 0
        self._ticks_from = self._next_tick = math.inf
        self._ticks_done = 0
        self._text_id = 0
        self._is_on = False
        self._at_power_on: list[Callable[[], None]] = []
        self.channels: list[Channel] = []
        self._channel = self.open_channel()
        for component in self.components:
            component.join(self)

    def open_channel(self, *, version: int = 2) -> Channel:
        """Another port with its own stream rates; ``version`` is the MAVLink version it speaks."""
        channel = Channel(self.system_id, self.component_id, self.handlers, version=version)
        self.channels.append(channel)
        if self._is_on:
            self.start_channel(channel)
        return channel

    def receive(self, data: bytes, now: float, peer: Hashable = None, channel: Channel | None = None) -> None:
        """Hear bytes from somebody. What they cause is in the outbox afterwards."""
        self.step(now)
        channel = self._channel if channel is None else channel
        if self.faults.frozen or self.faults.silent or not self._is_on:
            return
        messages = channel.messages(data, now, peer)
        for message in messages:
            if sender_of(message) != (self.system_id, self.component_id):
                self._handle(message, channel)
        if messages:
            self.step(now)

    def step(self, now: float) -> None:
        """Let everything happen that is due up to ``now``."""
        if not self._is_on and math.isnan(self.booted_at):
            self.now = now
            self.power_on()
        if self.faults.frozen:
            self._skip_to(now)
            return
        while (due := self.next_due) <= now:
            if due > self.now:
                self.now = due
            self._happen(due)
        if now > self.now:
            self.now = now

    @property
    def next_due(self) -> float:
        """The time at which ``step`` has something to do; infinity while nothing is planned."""
        if not self._is_on and math.isnan(self.booted_at):
            return self.now
        if self.faults.frozen:
            return self.now + TICK_S  # nothing happens, but time is to be followed
        due = self._next_tick
        if self._timers and self._timers[0][0] < due:
            due = self._timers[0][0]
        for channel in self.channels:
            if (stream := channel.streams.next_due) < due:
                due = stream
        return due

    def take_outbox(self) -> bytes:
        """Everything the first channel wants to send, in order."""
        return self._channel.take_outbox()

    @property
    def uptime(self) -> float:
        """Seconds since it was switched on or rebooted, as ``time_boot_ms`` counts them."""
        return self.now - self.booted_at

    @property
    def time_boot_ms(self) -> int:
        """For the messages."""
        return int((self.now - self.booted_at) * 1000.0) & 0xFFFFFFFF

    @property
    def time_boot_us(self) -> int:
        """For the messages."""
        return int((self.now - self.booted_at) * 1e6)

    def power_on(self) -> None:
        """Start booting now."""
        self.booted_at = self.now
        self._is_on = True
        self.boot()
        for channel in self.channels:
            self.start_channel(channel)
        for action in self._at_power_on:
            action()

    def when_powered_on(self, action: Callable[[], None]) -> None:
        """Do something at every start, after a reboot too; at once when it is on already."""
        self._at_power_on.append(action)
        if self._is_on:
            action()

    def reboot(self, silence_s: float) -> None:
        """Go silent at once, forget rates and timers, and boot anew after ``silence_s`` seconds."""
        self._is_on = False
        self._timers.clear()
        self.set_ticking(False)
        for channel in self.channels:
            channel.reset()
        self.call_at(self.now + silence_s, self.power_on)

    def boot(self) -> None:
        """What this kind of vehicle does when it is switched on."""
        raise NotImplementedError

    def start_channel(self, channel: Channel) -> None:
        """What a port sends without being asked."""
        raise NotImplementedError

    def build(self, message_id: int) -> Message | None:
        """The message to be streamed now; None when the vehicle has nothing to say."""
        raise NotImplementedError

    def tick(self, dt: float) -> None:
        """Move on by one tick."""
        raise NotImplementedError

    def call_at(self, when: float, action: Callable[[], None]) -> None:
        """Do something at a time; a reboot forgets it."""
        self._timer_count += 1
        heappush(self._timers, (when, self._timer_count, action))

    def call_later(self, delay: float, action: Callable[[], None]) -> None:
        """Do something after ``delay`` seconds; a reboot forgets it."""
        self.call_at(self.now + delay, action)

    def every(self, interval: float, action: Callable[[], None], *, first: float | None = None) -> None:
        """Do something again and again, until a reboot."""
        start = self.now + (interval if first is None else first)
        boot = self.booted_at
        count = 0

        def again() -> None:
            nonlocal count
            count += 1
            if boot == self.booted_at:
                self.call_at(start + count * interval, again)
            action()

        self.call_at(start, again)

    def set_ticking(self, ticking: bool) -> None:
        """Run ``tick`` at 50 Hz from now on, or not."""
        if ticking == (self._ticks_from != math.inf):
            return
        self._ticks_from, self._ticks_done = (self.now, 1) if ticking else (math.inf, 0)
        self._next_tick = self._ticks_from + self._ticks_done * TICK_S

    def _happen(self, due: float) -> None:
        if self._next_tick <= due:
            self._ticks_done += 1
            self._next_tick = self._ticks_from + self._ticks_done * TICK_S
            self.tick(TICK_S)
        while self._timers and self._timers[0][0] <= due:
            heappop(self._timers)[2]()
        for channel in self.channels:
            if channel.streams.next_due <= due:
                for message_id in channel.streams.take_due(due):
                    message = self.build(message_id)
                    if message is not None:
                        self.send(message, channel)

    def _skip_to(self, now: float) -> None:
        """Frozen: whatever was due is late, as in a program that hung."""
        late = now - self.now
        if late <= 0:
            return
        self.now = now
        self._timers = [(when + late, count, action) for when, count, action in self._timers]
        self._ticks_from += late
        self._next_tick = self._ticks_from + self._ticks_done * TICK_S
        for channel in self.channels:
            channel.streams.postpone(late)

    def on(self, message_class: type[Message], handler: Handler) -> None:
        """Hear such messages from now on, when they are for this vehicle."""
        self.handlers[message_class.ID] = handler

    def overhear(self, message_class: type[Message], handler: Handler) -> None:
        """Hear such messages whoever they are for, besides what the vehicle does with them."""
        self._overheard.setdefault(message_class.ID, []).append(handler)
        self.handlers.setdefault(message_class.ID, _do_nothing)

    def is_for_me(self, message: Message) -> bool:
        """Whether a message is addressed to this component or to everybody."""
        system, component = getattr(message, "target_system", 0), getattr(message, "target_component", 0)
        return system in (0, self.system_id) and component in (0, self.component_id)

    def send(
        self, message: Message, channel: Channel | None = None, sender: tuple[int, int] | None = None
    ) -> None:
        """Send on one channel, or on all; faults may stop it after it got its sequence number."""
        for port in self.channels if channel is None else (channel,):
            data = port.encode(message, sender)
            if not self._is_lost(message):
                port.write(data)

    def send_built(self, message_id: int, channel: Channel | None = None) -> None:
        """Send what would be streamed now, if there is such a message."""
        message = self.build(message_id)
        if message is not None:
            self.send(message, channel)

    def send_text(self, severity: int, text: str) -> None:
        """Send a STATUSTEXT on every channel; a text of more than 50 characters goes out in chunks."""
        text = text.encode("ascii", "replace").decode()
        if len(text) <= _TEXT_SIZE:
            self._note_text(severity, text)
            self.send_parts([Statustext(severity, text, 0, 0)])
            return
        self._text_id = self._text_id % 0xFFFF + 1
        self.send_chunks(severity, text, self._text_id)

    def send_chunks(self, severity: int, text: str, text_id: int) -> None:
        """Send STATUSTEXTs of one id; only a chunk that is not full ends the text."""
        self._note_text(severity, text)
        chunks = [text[start : start + _TEXT_SIZE] for start in range(0, len(text) + 1, _TEXT_SIZE)]
        self.send_parts([Statustext(severity, chunk, text_id, number) for number, chunk in enumerate(chunks)])

    def send_parts(self, chunks: list[Statustext]) -> None:
        """Send a text, in one part or several."""
        for chunk in chunks:
            self.send(chunk)

    def info(self, text: str) -> None:
        """Send a text of severity INFO."""
        self.send_text(MavSeverity.INFO, text)

    def _handle(self, message: Message, channel: Channel) -> None:
        handler = self.handlers.get(message.ID)
        for overhear in self._overheard.get(message.ID, ()):
            overhear(message, channel)
        if handler is None or not self.is_for_me(message):
            return
        if self.faults.drop_incoming > 0:
            self.faults.drop_incoming -= 1
            return
        if self.faults.loss_incoming > 0.0 and self.rng.random() < self.faults.loss_incoming:
            return
        if self.journal is not None:
            self.journal.heard(self.now, message)
        handler(message, channel)

    def _note_text(self, severity: int, text: str) -> None:
        if self.journal is not None:
            self.journal.said(self.now, severity, text)

    def _is_lost(self, message: Message) -> bool:
        faults = self.faults
        if faults.silent or (faults.heartbeats_stopped and message.ID == Heartbeat.ID):
            return True
        if faults.lost_messages and faults.loses(message):
            return True
        if faults.drop_outgoing > 0:
            faults.drop_outgoing -= 1
            return True
        return faults.loss > 0.0 and self.rng.random() < faults.loss


def _do_nothing(_message: Message, _channel: Channel) -> None:
    pass


def sender_of(message: Message) -> tuple[int, int]:
    """System and component id of who sent a received message; zeros for one that was not received."""
    frame = message.received_frame
    return (0, 0) if frame is None else (frame.system_id, frame.component_id)
