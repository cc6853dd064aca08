"""What a vehicle side and its clients say to each other on a zenoh network, and on which keys.

```text
aerokit/FLEET/NAME/from/all      frames of the vehicle side to everybody     who may see
aerokit/FLEET/NAME/from/CLIENT   frames of the vehicle side to one client
aerokit/FLEET/NAME/beacon        JSON twice a second: the vehicle side's clock, and who has the helm
aerokit/FLEET/NAME/told/CLIENT   JSON: an order of this client was refused
aerokit/FLEET/NAME/to/CLIENT     frames of one client to the vehicle side    who may order
aerokit/FLEET/NAME/alive/EPOCH   liveliness token of a vehicle side
aerokit/FLEET/NAME/client/CLIENT liveliness token of a client
aerokit/FLEET/NAME/state/1/STATE JSON: typed state of the vehicle with this system id, for programs in other languages
```

Payloads of ``from`` and ``to`` are whole MAVLink frames; what is said of them stands in the attachment.
"""

from __future__ import annotations

import json
import re
import struct

from aerokit._internal.values import Snapshot
from aerokit.errors import InvalidArgument

VERSION = 1
"""Of everything here: what bears another one is not listened to."""

Wish = str
"""What a client wants of the helm: "free" (have it if it is free), "take" (have it now), "never"."""

WISHES: tuple[Wish, ...] = ("free", "take", "never")

_EVERYBODY = "all"
_LONGEST_CLOCK_S = 2.0**48
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,62}")
_STAMP = struct.Struct(">BBIIII")  # version, wish, epoch, beacon, nonce, sequence
_SENT = struct.Struct(">BIQ")  # version, epoch, milliseconds on the sender's clock


def check_name(what: str, name: str) -> str:
    """A name that may stand in a key: letters, digits, ``_``, ``.``, ``-``, at most 63, the first no sign.

    A client must not be called "all".

    Raises:
        InvalidArgument: it may not.
    """
    if what == "client" and name == _EVERYBODY:
        raise InvalidArgument(f"client = {name!r} is not allowed: it is the key of what is for all of them")
    if not _NAME.fullmatch(name):
        raise InvalidArgument(
            f"{what} = {name!r} is not allowed: up to 63 letters, digits, '_', '.' and '-', a letter or digit first"
        )
    return name


class Place(Snapshot):
    """Whose frames they are: the vehicle, or the vehicles, ``name`` of the fleet ``fleet``."""

    fleet: str
    name: str

    @property
    def root(self) -> str:
        """What all its keys begin with."""
        return f"aerokit/{self.fleet}/{self.name}"

    @property
    def everybody(self) -> str:
        """Frames of the vehicle side to all clients."""
        return self.from_vehicle(_EVERYBODY)

    @property
    def beacon(self) -> str:
        """The vehicle side's :class:`Beacon`."""
        return f"{self.root}/beacon"

    def from_vehicle(self, client: str) -> str:
        """Frames of the vehicle side to one client."""
        return f"{self.root}/from/{client}"

    def to_vehicle(self, client: str = "*") -> str:
        """Frames of a client, or of any."""
        return f"{self.root}/to/{client}"

    def told(self, client: str) -> str:
        """What the vehicle side tells a client: :class:`Told`."""
        return f"{self.root}/told/{client}"

    def alive(self, epoch: int | None = None) -> str:
        """The liveliness token of a vehicle side, or of any."""
        return f"{self.root}/alive/{'*' if epoch is None else format(epoch, '08x')}"

    def client(self, client: str = "*") -> str:
        """The liveliness token of a client, or of any."""
        return f"{self.root}/client/{client}"

    def state(self, name: str) -> str:
        """The JSON of a state: "1/position"; "**" is any of any vehicle."""
        return f"{self.root}/state/{name}"


class Beacon(Snapshot):
    """What a vehicle side says twice a second: that it is there, and what its clock shows."""

    epoch: int
    """Of this vehicle side: a number drawn when it began, so that its successor is not taken for it."""
    number: int
    """Counted from 1."""
    clock_s: float
    """Seconds on its own clock."""
    helm: str | None = None
    """The client that has the helm."""

    def encode(self) -> bytes:
        """As JSON."""
        fields = {"version": VERSION, "epoch": self.epoch, "number": self.number, "clock_s": self.clock_s}
        return json.dumps({**fields, "helm": self.helm}, separators=(",", ":")).encode()

    @classmethod
    def decode(cls, data: bytes) -> Beacon | None:
        """From JSON; None for what is none."""
        fields = _object(data)
        epoch, number, helm = fields.get("epoch"), fields.get("number"), fields.get("helm")
        clock = fields.get("clock_s")
        if not (_is_u32(epoch) and _is_u32(number) and isinstance(clock, (int, float))):
            return None
        if (
            not abs(clock) < _LONGEST_CLOCK_S
        ):  # of infinity and of what is no number nothing could ever be late
            return None
        return cls(epoch, number, float(clock), helm if isinstance(helm, str) else None)  # type: ignore[arg-type]


class Stamp(Snapshot):
    """The attachment of what a client sends: which beacon it heard last."""

    epoch: int
    beacon: int
    nonce: int
    """Drawn by the client's link when it was opened."""
    sequence: int
    """Counted by the link from 1."""
    wish: Wish = "free"

    def encode(self) -> bytes:
        """18 bytes."""
        wish = WISHES.index(self.wish)
        return _STAMP.pack(VERSION, wish, self.epoch, self.beacon, self.nonce, self.sequence)

    @classmethod
    def decode(cls, data: bytes) -> Stamp | None:
        """None for what is no stamp."""
        if len(data) != _STAMP.size:
            return None
        version, wish, epoch, beacon, nonce, sequence = _STAMP.unpack(data)
        if version != VERSION or wish >= len(WISHES):
            return None
        return cls(epoch, beacon, nonce, sequence, WISHES[wish])


class Told(Snapshot):
    """What a vehicle side tells a client whose order it has refused."""

    message: str
    """The MAVLink message, "COMMAND_LONG"."""
    reason: str
    """As a clause."""
    helm: str | None = None
    """Who has the helm, when that is the reason."""
    answer: bytes = b""
    """A frame that a vehicle would answer, for whoever waits for one: COMMAND_ACK, MISSION_ACK."""
    count: int = 1
    """So many were refused since this was last told."""

    def encode(self) -> bytes:
        """As JSON; the answer in hexadecimal digits."""
        fields = {"version": VERSION, "told": "order_refused", "message": self.message, "reason": self.reason}
        rest = {"helm": self.helm, "answer": self.answer.hex(), "count": self.count}
        return json.dumps({**fields, **rest}).encode()

    @classmethod
    def decode(cls, data: bytes) -> Told | None:
        """From JSON; None for what is none."""
        fields = _object(data)
        if fields.get("told") != "order_refused":
            return None
        message, reason, helm = fields.get("message"), fields.get("reason"), fields.get("helm")
        try:
            answer = bytes.fromhex(str(fields.get("answer", "")))
        except ValueError:
            return None
        count = fields.get("count")
        return cls(
            str(message),
            str(reason),
            helm if isinstance(helm, str) else None,
            answer,
            count if _is_u32(count) else 1,  # type: ignore[arg-type]
        )


def sent_at(epoch: int, clock_s: float) -> bytes:
    """The attachment of what a vehicle side sends: when, on its own clock."""
    return _SENT.pack(VERSION, epoch, int(clock_s * 1000))


def read_sent_at(data: bytes) -> tuple[int, float] | None:
    """Epoch and seconds; None for what is no such attachment."""
    if len(data) != _SENT.size:
        return None
    version, epoch, milliseconds = _SENT.unpack(data)
    return (epoch, milliseconds / 1000) if version == VERSION else None


def _object(data: bytes) -> dict[str, object]:
    try:
        fields = json.loads(data)
    except (ValueError, RecursionError):
        return {}
    return fields if isinstance(fields, dict) and fields.get("version") == VERSION else {}


def _is_u32(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**32
