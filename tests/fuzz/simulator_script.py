"""Interprets bytes as a script for a simulated vehicle: messages, commands, parameters, plans, noise, time.

The bytes choose, and the grammar makes most choices valid. A fuzzer that had to find checksums and target ids would
never get past the framer.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable

from aerokit.mavlink import STANDARD, Framer, Message
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd
from aerokit.mavlink.frame import MAGIC_V2, x25
from aerokit.sim.parameters import SimParameters
from aerokit.sim.vehicle import SimulatedVehicle

__all__ = ["Script", "play"]

COMMANDS = sorted(MavCmd)
_F32 = struct.Struct("<f")
NUMBERS = (
    *(0.0, -0.0, 1.0, -1.0, 2.0, 3.0, 4.0, 5.0, 7.0, 10.0, 16.0, 20.0, 33.0, 50.0, 76.0, 100.0, 180.0, 255.0),
    *(0.5, 1e-30, 1e9, -1e9, 1e30, -1e30, 3.4e38, -3.4e38, 21196.0, 65535.0, 2147483647.0, -2147483648.0),
    *(47.397742, 8.545594, 473977420.0, 85455940.0, 4294967296.0, 16777217.0, math.nan, math.inf, -math.inf),
)
MAX_WAIT_S = 20.0
_SENDER = (255, 190)


def wire_offsets(message_class: type[Message]) -> dict[str, int]:
    """Return the offset of each field in a payload."""
    base = [field for field in message_class.FIELDS if not field.extension]
    base.sort(key=lambda field: -_size(field.type))
    offsets, at = {}, 0
    for field in (*base, *(field for field in message_class.FIELDS if field.extension)):
        offsets[field.name] = at
        at += _size(field.type) * (field.array_length or 1)
    return offsets


def _size(kind: str) -> int:
    return 1 if kind == "char" else {"float": 4, "double": 8}.get(kind) or int(kind.strip("uint_")) // 8


def framed(message_id: int, payload: bytes, sequence: int) -> bytes:
    """Return a MAVLink 2 frame of a ground station with any payload."""
    payload = payload.rstrip(b"\0") or b"\0"
    header = bytes((len(payload), 0, 0, sequence & 0xFF, *_SENDER)) + message_id.to_bytes(3, "little")
    crc = x25(header + payload + STANDARD.extras[message_id])
    return bytes((MAGIC_V2,)) + header + payload + crc.to_bytes(2, "little")


class Script:
    """Reads choices from the bytes; zeros after their end."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    @property
    def has_more(self) -> bool:
        return self._at < len(self._data)

    def byte(self) -> int:
        self._at += 1
        return self._data[self._at - 1] if self._at <= len(self._data) else 0

    def take(self, count: int) -> bytes:
        self._at += count
        return self._data[self._at - count : self._at].ljust(count, b"\0")

    def number(self) -> float:
        """A known troublesome number, or any 32 bits."""
        code = self.byte()
        if code < 200:
            return NUMBERS[code % len(NUMBERS)]
        return float(_F32.unpack(self.take(4))[0]) if code < 230 else float(code - 230)

    def whole(self, low: int, high: int) -> int:
        number = self.number()
        return max(low, min(high, int(number))) if math.isfinite(number) else low


class _Player:
    def __init__(self, vehicle: SimulatedVehicle, script: Script) -> None:
        self.vehicle, self.script = vehicle, script
        self.now, self.sequence = vehicle.now, 0
        self.ids = sorted(vehicle.handlers)
        self.components = sorted({1, *(component.component_id for component in vehicle.components)})
        self.steps: tuple[Callable[[], None], ...] = (
            *(self._wait, self._noise, self._command, self._command, self._command_int),
            *(self._message, self._message, self._message_of_numbers, self._parameter, self._plan),
        )

    def step(self) -> None:
        self.steps[self.script.byte() % len(self.steps)]()
        self.vehicle.take_outbox()

    def wait(self, seconds: float) -> None:
        self.now = max(self.now, self.vehicle.now) + seconds
        self.vehicle.step(self.now)

    def deliver(self, data: bytes) -> None:
        self.now = max(self.now, self.vehicle.now)
        self.vehicle.receive(data, self.now)

    def send(self, message: Message) -> None:
        self._send(message.ID, message.encode())

    def _say_with(self, message_class: Callable[..., Message], *fields: float) -> None:
        self.send(message_class(*fields))

    def _send(self, message_id: int, payload: bytes) -> None:
        self.sequence += 1
        self.deliver(framed(message_id, payload, self.sequence))

    def _wait(self) -> None:
        self.wait(self.script.byte() ** 2 / 255**2 * MAX_WAIT_S)

    def _noise(self) -> None:
        self.deliver(self.script.take(self.script.byte()))

    def _target(self) -> tuple[int, int]:
        return self.vehicle.system_id, self.components[self.script.byte() % len(self.components)]

    def _command(self) -> None:
        command = COMMANDS[int.from_bytes(self.script.take(2), "little") % len(COMMANDS)]
        numbers = [self.script.number() for _ in range(7)]
        self.send(m.CommandLong(*self._target(), command, 0, *numbers))

    def _command_int(self) -> None:
        command = COMMANDS[int.from_bytes(self.script.take(2), "little") % len(COMMANDS)]
        numbers = [self.script.number() for _ in range(4)]
        head = (*self._target(), self.script.byte(), command, 0, 0)
        self._say_with(m.CommandInt, *head, *numbers, *self._place())

    def _place(self) -> tuple[int, int, float]:
        x, y = (self.script.whole(-(1 << 31), (1 << 31) - 1) for _ in range(2))
        return x, y, self.script.number()

    def _message(self) -> None:
        """Any bytes in a message that the vehicle processes, mostly with its own ids."""
        message_class = STANDARD[self.ids[self.script.byte() % len(self.ids)]]
        self._send_to_it(message_class, bytearray(self.script.take(self.script.byte() % (message_class.LENGTH + 1))))

    def _message_of_numbers(self) -> None:
        """The same, with known troublesome numbers."""
        message_class = STANDARD[self.ids[self.script.byte() % len(self.ids)]]
        payload = bytearray(message_class.LENGTH)
        offsets = wire_offsets(message_class)
        for field in message_class.FIELDS:
            if not field.array_length and field.type == "float":
                _F32.pack_into(payload, offsets[field.name], self.script.number())
            else:
                size = _size(field.type)
                bits = self.script.whole(-(1 << 31), (1 << 32) - 1) % (1 << 8 * size)
                payload[offsets[field.name] : offsets[field.name] + size] = bits.to_bytes(size, "little")
        self._send_to_it(message_class, payload)

    def _send_to_it(self, message_class: type[Message], payload: bytearray) -> None:
        payload.extend(bytes(message_class.LENGTH - len(payload)))
        offsets = wire_offsets(message_class)
        for name, target in zip(("target_system", "target_component"), self._target(), strict=True):
            if name in offsets:
                payload[offsets[name]] = target
        self._send(message_class.ID, bytes(payload))

    def _parameter(self) -> None:
        parameters = getattr(self.vehicle, "parameters", None)
        names = getattr(parameters, "names", ())
        number = int.from_bytes(self.script.take(2), "little")
        if not names:
            return
        name = names[number % len(names)]
        kind = parameters.type(name) if isinstance(parameters, SimParameters) else 9
        value = self.script.number()
        if kind == 6 and not hasattr(self.vehicle, "guided") and math.isfinite(value):  # PX4 expects int32 bits.
            (value,) = _F32.unpack(struct.pack("<i", max(-(1 << 31), min((1 << 31) - 1, int(value)))))
        try:
            self.send(m.ParamSet(self.vehicle.system_id, 1, name, value, kind))
        except OverflowError:
            return

    def _plan(self) -> None:
        """A complete upload of some items, and perhaps a mission start."""
        kind, count = self.script.byte() % 3, self.script.byte() % 6
        target = (self.vehicle.system_id, 1)
        self.send(m.MissionCount(*target, count, kind))
        for seq in range(count):
            command = self._plan_command(kind)
            frame = self.script.byte() % 22
            numbers = [self.script.number() for _ in range(4)]
            head = (*target, seq, frame, command, 0, self.script.byte() & 1)
            self._say_with(m.MissionItemInt, *head, *numbers, *self._place(), kind)
            self.wait(0.05)

    def _plan_command(self, kind: int) -> int:
        choice = self.script.byte()
        if kind == 1:
            return 5000 + choice % 6
        return 5100 if kind == 2 else COMMANDS[choice % len(COMMANDS)]


def play(vehicle: SimulatedVehicle, data: bytes, max_steps: int = 60) -> None:
    """Run the script, and check that the vehicle survives and sends only valid frames."""
    player = _Player(vehicle, Script(data))
    for _ in range(max_steps):
        if not player.script.has_more:
            break
        player.step()
    player.wait(3.0)
    framer = Framer()
    framer.receive(vehicle.take_outbox(), 0.0)
    assert framer.statistics.bad_bytes == 0, framer.statistics
