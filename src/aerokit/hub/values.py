"""What programs give to a hub and read from it: `Endpoint`, `EndpointStatistics`, `HubEvent`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Literal

from aerokit._internal.values import Snapshot
from aerokit._internal.wording import shown
from aerokit.errors import InvalidArgument
from aerokit.transport.address import parse_address
from aerokit.transport.link import Link

if TYPE_CHECKING:
    from aerokit.mavlink.signing import Signing
    from aerokit.transport.sockets import Peers


class Endpoint(Snapshot):
    """One link of a hub, and what may pass.

    Raises:
        InvalidArgument: a field is wrong. Names of messages are checked when the hub takes it.
    """

    address: str | Link
    """A connection string, ``"tcpin:0.0.0.0:5760"``, or a link that is not open yet; a link is not opened again when it
    is lost."""
    name: str = ""
    """What to call it; empty: its address."""
    only: tuple[str, ...] = ()
    """Messages that go out here, as patterns: ``("HEARTBEAT", "GPS_*")``; none: all."""
    block: tuple[str, ...] = ()
    """Messages that do not go out here."""
    rates: Mapping[str, float] = {}
    """Message → at most so many a second from each sender, above 0, at most 1000 Hz. What is for one is not thinned."""
    read_only: bool = False
    """Whether nothing that comes from here is passed on, not even heartbeats: its programs can only look on."""
    signing: Signing | None = None
    """Signs what goes out here; what comes in without its signature is refused. Inside, frames have no signature."""
    peers: Peers | None = None
    """IP addresses and networks that are listened to: udpin, udpbcast, tcpin. None: all."""
    baud: int = 57600
    """Of a serial link whose address names none, bits per second."""
    patient: bool = False
    """Whether the hub begins without it when it cannot be opened, and tries until it can: a server that comes later."""

    def _check(self) -> None:
        if not isinstance(self.address, (str, Link)):
            raise _not_allowed("address", self.address, "a connection string or a link")
        if isinstance(self.address, str):
            parse_address(self.address)
        elif self.peers is not None:
            raise InvalidArgument("peers = … is not allowed with a link: give them to the link")
        elif self.patient:
            raise InvalidArgument("patient = True is not allowed with a link, which can be opened once only")
        for field in ("only", "block"):
            patterns = getattr(self, field)
            if isinstance(patterns, str) or not _are_texts(patterns):
                raise _not_allowed(field, patterns, "several names of messages, a tuple for example")
        if not isinstance(self.rates, Mapping) or not _are_texts(self.rates):
            raise _not_allowed("rates", self.rates, "names of messages and Hz: {'ATTITUDE': 5}")
        for hz in self.rates.values():
            if isinstance(hz, bool) or not isinstance(hz, (int, float)):
                raise _not_allowed("rates", self.rates, "names of messages and Hz: {'ATTITUDE': 5}")
        if isinstance(self.baud, bool) or not isinstance(self.baud, int) or self.baud <= 0:
            raise _not_allowed("baud", self.baud, "a whole number above 0")
        if not isinstance(self.name, str):
            raise _not_allowed("name", self.name, "a text")


def _are_texts(values: object) -> bool:
    return isinstance(values, Iterable) and all(isinstance(each, str) for each in values)


def _not_allowed(field: str, value: object, allowed: str) -> InvalidArgument:
    return InvalidArgument(f"{field} = {shown(value)} is not allowed: {allowed}")


class EndpointStatistics(Snapshot):
    """What has come and gone by one endpoint since it was added."""

    name: str
    address: str
    """With the real port where the system chose one."""
    is_open: bool
    """Whether frames can pass; False while a lost link is being opened again."""
    peers: int
    """Clients, senders, or the one other side."""
    frames_in: int
    """Good frames, refused and doubled ones among them."""
    bytes_in: int
    frames_out: int
    bytes_out: int
    """As written; what the link could not get rid of is in ``dropped["link"]``, in writes."""
    lost: int
    """Frames that the numbers of its senders say were lost on the way here."""
    bad_bytes: int
    """Bytes that were in no good frame."""
    waiting: int
    """Frames that wait because the link takes no more."""
    dropped: Mapping[str, int]
    """Why → how many frames. On the way in: ``no_route`` (for somebody who was never heard), ``duplicate``, ``loop``
    (it went round), ``read_only``, ``refused`` (signature), ``foreign`` (another peer speaks as an autopilot that is
    heard), ``secret`` (SETUP_SIGNING), ``unknown`` (no message of the dialect, from nobody known). On the way out:
    ``late`` (orders), ``queue_full``, ``superseded``, ``thinned`` (telemetry), ``away``, ``unsignable``, ``link``."""
    systems: tuple[tuple[int, int], ...]
    """(system id, component id) of everybody who was heard here."""


HubEventKind = Literal[
    "opened",
    "lost",
    "restored",
    "removed",
    "client_joined",
    "client_left",
    "stalled",
    "drained",
    "order_dropped",
    "refused",
    "heard_twice",
    "moved",
    "turned_away",
    "loop",
    "mistake",
]


class HubEvent(Snapshot):
    """Something that happened to an endpoint."""

    at_s: float
    """On the event loop's clock."""
    endpoint: str
    """Its name."""
    kind: HubEventKind
    """``opened``; ``lost`` and ``restored``: its link; ``removed``; ``client_joined`` and ``client_left``: of a
    server (``tcpin:``), where clients connect; ``stalled`` and ``drained``: what is written does
    not leave, and does again; ``order_dropped``: an order had waited too long, or met a full queue or a link that went;
    ``refused``: the first frame that a key did not fit, for each reason; ``heard_twice``: an autopilot is heard from a
    second peer or endpoint; ``moved``: it is reached there now; ``turned_away``: no place is left for a new peer;
    ``loop``: what this hub has passed on comes back; ``mistake``: one inside aerokit."""
    text: str
    """In words."""
