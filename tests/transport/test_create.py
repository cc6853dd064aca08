from __future__ import annotations

from typing import get_args

import pytest

from aerokit.errors import InvalidArgument
from aerokit.transport import (
    Link,
    PtyLink,
    Replay,
    SerialLink,
    TcpConnect,
    TcpListen,
    UdpBroadcast,
    UdpConnect,
    UdpListen,
    ZenohConnect,
    ZenohListen,
    create_link,
    parse_address,
)
from aerokit.transport.address import LinkKind

LINKS: list[tuple[str, type[Link], str]] = [
    ("127.0.0.1:14550", UdpListen, "udpin:127.0.0.1:14550"),
    ("udp://:14540", UdpListen, "udpin:0.0.0.0:14540"),
    ("udpout:[::1]:14550", UdpConnect, "udpout:[::1]:14550"),
    ("udpbcast:10.0.0.255:14550", UdpBroadcast, "udpbcast:10.0.0.255:14550"),
    ("tcpout://127.0.0.1:5760?timeout=3", TcpConnect, "tcp:127.0.0.1:5760"),
    ("tcpin::5760", TcpListen, "tcpin:0.0.0.0:5760"),
    ("/dev/ttyACM0", SerialLink, "serial:///dev/ttyACM0:921600"),
    ("/dev/ttyACM0,57600", SerialLink, "serial:///dev/ttyACM0:57600"),
    ("serial://COM3?rtscts=1", SerialLink, "serial://COM3:921600?rtscts=1"),
    ("flight.tlog", Replay, "replay:flight.tlog"),
    ("zenoh://north/alpha?control=never&client=me", ZenohConnect, "zenoh://north/alpha"),
    ("zenohin:north/alpha?listen=tcp/127.0.0.1:0", ZenohListen, "zenohin://north/alpha"),
    ("pty:/tmp/ttyV0", PtyLink, "pty:/tmp/ttyV0"),
    ("replay:flight.tlog?speed=max", Replay, "replay:flight.tlog?speed=inf"),
]


@pytest.mark.parametrize(("address", "kind", "named"), LINKS, ids=[address for address, _, _ in LINKS])
def test_each_address_makes_its_link(address: str, kind: type[Link], named: str) -> None:
    link = create_link(address, baud=921600)
    assert type(link) is kind
    assert link.address == named
    assert create_link(parse_address(address), baud=921600).address == named
    link.close()


def test_all_kinds_are_in_table() -> None:
    missing = set(get_args(LinkKind)) - {parse_address(address).kind for address, _, _ in LINKS}
    assert not missing, f"add these kinds to LINKS, and to create_link: {missing}"


def test_wrong_address_shows_the_accepted_forms() -> None:
    with pytest.raises(InvalidArgument, match="Accepted:"):
        create_link("udpin:0.0.0.0")
