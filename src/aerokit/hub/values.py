"""Values of a hub's API: `Endpoint`, `EndpointStatistics`, `HubEvent`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Literal

from aerokit._internal.formatting import short_repr
from aerokit._internal.values import Snapshot
from aerokit.errors import InvalidArgument
from aerokit.transport.address import parse_address
from aerokit.transport.link import Link

if TYPE_CHECKING:
    from aerokit.mavlink.signing import Signing
    from aerokit.transport.sockets import PeerFilter


class Endpoint(Snapshot):
    """One link of a hub, with its filters.

    Raises:
        InvalidArgument: a field is invalid; the text names it. The hub checks message names when the endpoint is
            added.
    """

    address: str | Link
    """A connection string such as ``"tcpin:0.0.0.0:5760"``, or an unopened link.

    A lost link object is not reopened.
    """
    name: str = ""
    """Name of the endpoint; empty: its address."""
    only: tuple[str, ...] = ()
    """Patterns of messages that this endpoint sends, e.g. ``("HEARTBEAT", "GPS_*")``; empty: all."""
    block: tuple[str, ...] = ()
    """Patterns of messages that this endpoint does not send."""
    rates: Mapping[str, float] = {}
    """Maximum rate per sender in Hz by pattern, above 0 and at most 1000. Messages with a target are not limited."""
    read_only: bool = False
    """True to forward nothing that this endpoint receives, not even heartbeats."""
    signing: Signing | None = None
    """Key that signs frames sent here; frames received without its signature are refused.

    Frames inside the hub are not signed.
    """
    peers: PeerFilter | None = None
    """IP addresses and networks to accept, for udpin, udpbcast and tcpin; None: all."""
    baud: int = 57600
    """Bits per second of a serial link, if `address` does not give a baud rate."""
    retry_open: bool = False
    """True to start the hub even if this endpoint cannot be opened yet (a server that starts later), and to retry."""

    def _check(self) -> None:
        if not isinstance(self.address, (str, Link)):
            raise _not_allowed("address", self.address, "a connection string or a link")
        if isinstance(self.address, str):
            parse_address(self.address)
        elif self.peers is not None:
            raise InvalidArgument("peers = … is not allowed with a link object: pass them to the link")
        elif self.retry_open:
            raise InvalidArgument("retry_open = True is not allowed with a link object, which can be opened only once")
        for field in ("only", "block"):
            patterns = getattr(self, field)
            if isinstance(patterns, str) or not _are_texts(patterns):
                raise _not_allowed(field, patterns, "a tuple of message names")
        # A bool is an int for Python, but not a number here.
        has_names = isinstance(self.rates, Mapping) and _are_texts(self.rates)
        if not has_names or any(isinstance(hz, bool) or not isinstance(hz, (int, float)) for hz in self.rates.values()):
            raise _not_allowed("rates", self.rates, "a mapping of message names to Hz, such as {'ATTITUDE': 5}")
        if isinstance(self.baud, bool) or not isinstance(self.baud, int) or self.baud <= 0:
            raise _not_allowed("baud", self.baud, "a whole number above 0")
        if not isinstance(self.name, str):
            raise _not_allowed("name", self.name, "a text")


def _are_texts(values: object) -> bool:
    return isinstance(values, Iterable) and all(isinstance(value, str) for value in values)


def _not_allowed(field: str, value: object, allowed: str) -> InvalidArgument:
    return InvalidArgument(f"{field} = {short_repr(value)} is not allowed: it must be {allowed}")


class EndpointStatistics(Snapshot):
    """Counters of one endpoint since it was added."""

    name: str
    address: str
    """Address, with the actual port instead of 0."""
    is_open: bool
    """True while frames can pass; False while a lost link is being reopened."""
    peers: int
    """Number of clients or senders."""
    frames_in: int
    """Valid frames, including refused frames and duplicates."""
    bytes_in: int
    frames_out: int
    bytes_out: int
    """Bytes written; writes that the link dropped are counted in ``dropped["link"]``."""
    lost: int
    """Number of frames lost on the way from the peers to this endpoint, according to gaps in sequence numbers."""
    bad_bytes: int
    """Bytes outside valid frames."""
    waiting: int
    """Frames that wait because the link is full."""
    dropped: Mapping[str, int]
    """Number of dropped frames by reason.

    Reasons for received frames: ``no_route`` (unknown target), ``duplicate``, ``loop``, ``read_only``, ``refused``
    (signature), ``foreign`` (another peer has the ids of this autopilot), ``secret`` (SETUP_SIGNING), ``unknown``
    (message outside the dialect, from an unknown sender). Reasons for frames to send: ``late`` (commands),
    ``queue_full``, ``superseded``, ``rate_limited`` (telemetry), ``link_lost``, ``unsignable``, ``link``.
    """
    systems: tuple[tuple[int, int], ...]
    """(system id, component id) of all senders received here."""


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
    "duplicate_sender",
    "route_changed",
    "peer_rejected",
    "loop",
    "internal_error",
]


class HubEvent(Snapshot):
    """An event of one endpoint."""

    at_s: float
    """Event loop time of the event, in seconds."""
    endpoint: str
    """Name of the endpoint."""
    kind: HubEventKind
    """Kind of the event.

    - ``opened``, ``lost``, ``restored``, ``removed``: the link was opened, lost or reopened, or the endpoint removed
    - ``client_joined``, ``client_left``: a client of a server (``tcpin:``) has connected or disconnected
    - ``stalled``, ``drained``: written data does not leave, or leaves again
    - ``order_dropped``: a command waited too long, met a full queue, or its link was lost
    - ``refused``: a frame had no valid signature; reported once for each reason
    - ``duplicate_sender``: an autopilot's ids are also used by another peer or endpoint
    - ``route_changed``: a vehicle is reached by another peer or endpoint now
    - ``peer_rejected``: there is no room for a new peer
    - ``loop``: frames that this hub forwarded come back
    - ``internal_error``: an error inside aerokit
    """
    text: str
    """Description of the event for people."""
