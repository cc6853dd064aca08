"""Keys and messages between a server and its clients on a zenoh network.

```text
aerokit/FLEET/NAME/from/all      frames of the server to all clients (read access)
aerokit/FLEET/NAME/from/CLIENT   frames of the server to one client
aerokit/FLEET/NAME/beacon        JSON, twice a second: the server's clock, and the client that has control
aerokit/FLEET/NAME/refused/CLIENT   JSON: a command of this client was refused
aerokit/FLEET/NAME/to/CLIENT     frames of one client to the server (write access)
aerokit/FLEET/NAME/alive/EPOCH   liveliness token of a server
aerokit/FLEET/NAME/client/CLIENT liveliness token of a client
aerokit/FLEET/NAME/state/1/STATE JSON: typed state of the vehicle with this system id, for programs in other languages
```

Payloads of ``from`` and ``to`` are complete MAVLink frames, with a stamp as attachment.
"""

from __future__ import annotations

import json
import re
import struct

from aerokit._internal.values import Snapshot
from aerokit.errors import InvalidArgument

VERSION = 1
"""Protocol version. Messages of other versions are ignored."""

ControlMode = str
"""Control that a client requests: "free" (if no client has it), "take" (in any case), "never" (read only)."""

CONTROL_MODES: tuple[ControlMode, ...] = ("free", "take", "never")

_ALL_CLIENTS = "all"
_MAX_CLOCK_S = 2.0**48
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,62}")
_STAMP = struct.Struct(">BBIIII")  # version, control mode, epoch, beacon, nonce, sequence
_SEND_TIME = struct.Struct(">BIQ")  # version, epoch, milliseconds on the sender's clock


def check_name(argument: str, name: str) -> str:
    """Return ``name`` if it may be part of a key. Raises InvalidArgument if not.

    ``argument`` is the argument's name for the error text.
    """
    if argument == "client" and name == _ALL_CLIENTS:
        raise InvalidArgument(f"client = {name!r} is not allowed: this name stands for all clients")
    if not _NAME.fullmatch(name):
        raise InvalidArgument(
            f"{argument} = {name!r} is not allowed: a name has up to 63 letters, digits, '_', '.' and '-', and begins"
            " with a letter or digit"
        )
    return name


class KeySpace(Snapshot):
    """Zenoh keys that the server ``name`` in the fleet ``fleet`` and its clients use."""

    fleet: str
    name: str

    @property
    def root(self) -> str:
        return f"aerokit/{self.fleet}/{self.name}"

    @property
    def to_all_clients(self) -> str:
        return self.from_server(_ALL_CLIENTS)

    @property
    def beacon(self) -> str:
        return f"{self.root}/beacon"

    def from_server(self, client: str) -> str:
        return f"{self.root}/from/{client}"

    def to_server(self, client: str = "*") -> str:
        return f"{self.root}/to/{client}"

    def notices(self, client: str) -> str:
        return f"{self.root}/refused/{client}"

    def server_token(self, epoch: int | None = None) -> str:
        """Return the key of a liveliness token. Without an epoch, it is a pattern for all runs."""
        return f"{self.root}/alive/{'*' if epoch is None else format(epoch, '08x')}"

    def client_token(self, client: str = "*") -> str:
        return f"{self.root}/client/{client}"

    def state(self, name: str) -> str:
        """Return the key of a state, e.g. of "1/position". The name "**" stands for all states."""
        return f"{self.root}/state/{name}"


class Beacon(Snapshot):
    """Message that the process beside the vehicle sends twice a second, with the time of its clock."""

    epoch: int
    """Random number of this run of the server."""
    number: int
    """Number of this beacon, counted from 1."""
    clock_s: float
    """Time on the server's clock, in seconds."""
    lease_holder: str | None = None
    """Client that has control; None if no client has it."""

    def encode(self) -> bytes:
        fields = {"version": VERSION, "epoch": self.epoch, "number": self.number, "clock_s": self.clock_s}
        return json.dumps({**fields, "holder": self.lease_holder}, separators=(",", ":")).encode()

    @classmethod
    def decode(cls, data: bytes) -> Beacon | None:
        fields = _decode_object(data)
        epoch, number, holder = fields.get("epoch"), fields.get("number"), fields.get("holder")
        clock = fields.get("clock_s")
        if not (_is_u32(epoch) and _is_u32(number) and isinstance(clock, (int, float))):
            return None
        if not abs(clock) < _MAX_CLOCK_S:  # This also refuses infinity and NaN, with which data would never be late.
            return None
        return cls(epoch, number, float(clock), holder if isinstance(holder, str) else None)  # type: ignore[arg-type]


class Stamp(Snapshot):
    """Zenoh attachment of each datagram from a client. Has the number of the last beacon that the client received."""

    epoch: int
    beacon: int
    nonce: int
    """Random number of the client's link."""
    sequence: int
    """Number of the datagram, counted from 1."""
    mode: ControlMode = "free"

    def encode(self) -> bytes:
        mode = CONTROL_MODES.index(self.mode)
        return _STAMP.pack(VERSION, mode, self.epoch, self.beacon, self.nonce, self.sequence)

    @classmethod
    def decode(cls, data: bytes) -> Stamp | None:
        if len(data) != _STAMP.size:
            return None
        version, mode, epoch, beacon, nonce, sequence = _STAMP.unpack(data)
        if version != VERSION or mode >= len(CONTROL_MODES):
            return None
        return cls(epoch, beacon, nonce, sequence, CONTROL_MODES[mode])


class RefusalNotice(Snapshot):
    """Message from a server to a client whose command it refused."""

    message: str
    """Name of the MAVLink message, e.g. "COMMAND_LONG"."""
    reason: str
    """Text that explains the refusal."""
    lease_holder: str | None = None
    """Client that has control, if this is why the command was refused; otherwise None."""
    answer: bytes = b""
    """Frames by which a vehicle would reject the command: COMMAND_ACK or MISSION_ACK, and STATUSTEXT."""
    count: int = 1
    """Refused messages since the last notice."""
    nonce: int | None = None
    """Nonce of the refused stamp; other programs with the same client name ignore the notice. None: for all."""

    def encode(self) -> bytes:
        fields = {
            "version": VERSION,
            "event": "order_refused",
            "message": self.message,
            "reason": self.reason,
            "holder": self.lease_holder,
            "answer": self.answer.hex(),
            "count": self.count,
            "nonce": self.nonce,
        }
        return json.dumps(fields).encode()

    @classmethod
    def decode(cls, data: bytes) -> RefusalNotice | None:
        fields = _decode_object(data)
        if fields.get("event") != "order_refused":
            return None
        message, reason, holder = fields.get("message"), fields.get("reason"), fields.get("holder")
        if not (isinstance(message, str) and isinstance(reason, str)):
            return None
        try:
            answer = bytes.fromhex(str(fields.get("answer", "")))
        except ValueError:
            return None
        count, nonce = fields.get("count"), fields.get("nonce")
        return cls(
            message,
            reason,
            holder if isinstance(holder, str) else None,
            answer,
            count if _is_u32(count) else 1,  # type: ignore[arg-type]
            nonce if _is_u32(nonce) else None,  # type: ignore[arg-type]
        )


class SendTime(Snapshot):
    """Zenoh attachment of each datagram from the server."""

    epoch: int
    clock_s: float

    def encode(self) -> bytes:
        return _SEND_TIME.pack(VERSION, self.epoch, int(self.clock_s * 1000))

    @classmethod
    def decode(cls, data: bytes) -> SendTime | None:
        if len(data) != _SEND_TIME.size:
            return None
        version, epoch, milliseconds = _SEND_TIME.unpack(data)
        return cls(epoch, milliseconds / 1000) if version == VERSION else None


def _decode_object(data: bytes) -> dict[str, object]:
    """Return the members of a JSON object whose ``version`` is `VERSION`. Empty for any other data."""
    try:
        fields = json.loads(data)
    except (ValueError, RecursionError):
        return {}
    return fields if isinstance(fields, dict) and fields.get("version") == VERSION else {}


def _is_u32(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**32
