from __future__ import annotations

import contextlib
import string
from pathlib import Path
from typing import get_args

import pytest
from for_each import for_each
from hypothesis import given, settings
from hypothesis import strategies as st

from aerokit.errors import InvalidArgument
from aerokit.transport.address import ACCEPTED_FORMS, LinkAddress, LinkKind, parse_address


def udpin(host: str, port: int) -> LinkAddress:
    return LinkAddress("udpin", host=host, port=port)


def serial(device: str, baud: int | None = None, *, rtscts: bool = False) -> LinkAddress:
    return LinkAddress("serial", device=device, baud=baud, options=(("rtscts", "1"),) if rtscts else ())


def replay(path: str, speed: str | None = None) -> LinkAddress:
    return LinkAddress("replay", path=path, options=(("speed", speed),) if speed else ())


def zenoh(path: str, kind: LinkKind = "zenoh", **options: str) -> LinkAddress:
    return LinkAddress(kind, path=path, options=tuple(sorted(options.items())))


ACCEPTED: list[tuple[str, LinkAddress]] = [
    ("127.0.0.1:14550", udpin("127.0.0.1", 14550)),
    (" localhost:14550\n", udpin("localhost", 14550)),
    (":14550", udpin("0.0.0.0", 14550)),
    ("[::1]:14550", udpin("::1", 14550)),
    ("udp:127.0.0.1:14550", udpin("127.0.0.1", 14550)),
    ("udpin:0.0.0.0:0", udpin("0.0.0.0", 0)),
    ("UdpIn:[fe80::1%eth0]:14550", udpin("fe80::1%eth0", 14550)),
    ("udpin://0.0.0.0:14550", udpin("0.0.0.0", 14550)),
    ("udpin://0.0.0.0:14550/", udpin("0.0.0.0", 14550)),
    ("udp://:14540", udpin("0.0.0.0", 14540)),
    ("udpout:192.168.1.12:14550", LinkAddress("udpout", host="192.168.1.12", port=14550)),
    ("udpout://[::1]:14550", LinkAddress("udpout", host="::1", port=14550)),
    ("udpbcast:192.168.1.255:14550", LinkAddress("udpbcast", host="192.168.1.255", port=14550)),
    ("tcp:127.0.0.1:5760", LinkAddress("tcp", host="127.0.0.1", port=5760)),
    ("tcp://sitl.local:5760", LinkAddress("tcp", host="sitl.local", port=5760)),
    ("tcpout://127.0.0.1:5760", LinkAddress("tcp", host="127.0.0.1", port=5760)),
    ("tcpout:h:1?timeout=2.50", LinkAddress("tcp", host="h", port=1, options=(("timeout", "2.5"),))),
    ("tcpin:0.0.0.0:5760", LinkAddress("tcpin", host="0.0.0.0", port=5760)),
    ("tcpin://:5760", LinkAddress("tcpin", host="0.0.0.0", port=5760)),
    ("/dev/ttyACM0", serial("/dev/ttyACM0")),
    ("/dev/ttyACM0,57600", serial("/dev/ttyACM0", 57600)),
    ("/dev/by-path/pci-0:14.0-usb-0:1", serial("/dev/by-path/pci-0:14.0-usb-0:1")),
    ("/dev/by-path/pci-0:14.0-usb-0:1,9600", serial("/dev/by-path/pci-0:14.0-usb-0:1", 9600)),
    ("com14", serial("com14")),
    ("COM14,115200", serial("COM14", 115200)),
    ("COM14:115200", serial("COM14", 115200)),
    (r"\\.\COM14,115200", serial(r"\\.\COM14", 115200)),
    ("serial:///dev/ttyUSB0:57600", serial("/dev/ttyUSB0", 57600)),
    ("serial:/dev/ttyUSB0", serial("/dev/ttyUSB0")),
    ("serial:///dev/ttyUSB0,57600", serial("/dev/ttyUSB0", 57600)),
    ("serial://COM3:57600?rtscts=yes", serial("COM3", 57600, rtscts=True)),
    ("serial://COM3?baud=9600&rtscts=0", serial("COM3", 9600)),
    ("flight.tlog", replay("flight.tlog")),
    ("/logs/my flight.TLOG", replay("/logs/my flight.TLOG")),
    (r"C:\logs\flight.tlog", replay(r"C:\logs\flight.tlog")),
    ("flight.tlog?speed=2", replay("flight.tlog", "2")),
    ("replay:flight?speed=max", replay("flight", "inf")),
    ("replay:flight.tlog?speed=1", replay("flight.tlog")),
    ("file:///logs/my%20flight.tlog", replay("/logs/my flight.tlog")),
    ("file:///C:/logs/flight.tlog", replay("C:/logs/flight.tlog")),
    ("zenoh://north/alpha", zenoh("north/alpha")),
    ("zenoh:North/Alpha-2.b/", zenoh("North/Alpha-2.b")),
    (
        "ZENOH://north/alpha?connect=tcp/10.0.0.5:7447,tls/Host:7448&Control=TAKE&timeout=2.0",
        zenoh("north/alpha", connect="tcp/10.0.0.5:7447,tls/Host:7448", control="take", timeout="2"),
    ),
    (
        "zenohin://n/a?listen=tcp/[::]:7447?iface=eth0&mode=peer&config=/Etc/my%20%26%25file?.json5",
        zenoh("n/a", "zenohin", listen="tcp/[::]:7447?iface=eth0", mode="peer", config="/Etc/my &%file?.json5"),
    ),
]


@for_each("text, address", ACCEPTED)
def test_accepted(text: str, address: LinkAddress) -> None:
    assert parse_address(text) == address
    assert parse_address(str(address)) == address


@for_each("kind", get_args(LinkKind))
def test_kinds_are_all_documented(kind: str) -> None:
    page = Path(__file__).parents[2] / "docs" / "addresses.md"
    assert f"{kind}:" in ACCEPTED_FORMS, "add it to ACCEPTED_FORMS in address.py"
    assert f"`{kind}:" in page.read_text(encoding="utf-8"), "add it to the table in docs/addresses.md"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "it is empty"),
        (" \t", "it is empty"),
        ("zenoh://north", "the name of the vehicle is missing; write it as in zenoh://fleet/alpha"),
        ("zenoh:///alpha", "the fleet = '' is not allowed"),
        ("zenohin://north/a/b", "the name = 'a/b' is not allowed"),
        ("zenoh://north/*", "the name = '.' is not allowed"),
        ("zenoh://north/alpha?client=a/b", "client = 'a/b' is not allowed"),
        ("zenoh://north/alpha?control=mine", "control=mine is not one of free, take, never"),
        ("zenoh://north/alpha?mode=router", "mode=router is not one of peer, client"),
        ("zenoh://north/alpha?connect=", "connect= is empty"),
        (
            "zenoh://north/alpha?connect=10.0.0.5:7447",
            "connect=10.0.0.5:7447 is not a zenoh endpoint such as tcp/10",
        ),
        ("zenoh://north/alpha?connect=tcp/a:1,b:2", "connect=b:2 is not a zenoh endpoint"),
        (
            "zenohin://north/alpha?listen=http://0.0.0.0:7447",
            "listen=http://0.0.0.0:7447 is not a zenoh endpoint",
        ),
        ("zenohin://north/alpha?control=take", "'control' is not an option of zenohin links"),
        ("zenoh://north/alpha?timeout=0", "timeout=0 is not a number above 0"),
        ("udpin:a\0b:1", "NUL"),
        ("vehicle", "neither host:port nor the path"),
        ("14550", "neither host:port nor the path"),
        ("udpin:14550", "the host is missing; write udpin:127.0.0.1:14550"),
        ("udpin:0.0.0.0", "the port is missing"),
        ("udpin:0.0.0.0:", "the port is missing"),
        ("[::1]", "the port is missing"),
        ("[::1]14550", "expected :port after the host"),
        ("udpin:127.0.0.1:http", "the port 'http' is not a whole number"),
        ("udpin:127.0.0.1:-1", "the port '-1' is not a whole number"),
        ("udpin:127.0.0.1:٣", "is not a whole number"),
        ("udpin:127.0.0.1:65536", r"the port 65536 is out of range \(0 to 65535\)"),
        ("tcp:127.0.0.1:0", r"the port 0 is out of range \(1 to 65535\)"),
        ("tcp::5760", "the host is missing"),
        ("tcp:two words:5760", "'two words' is not a host"),
        ("tcp:127.0.0.1:5760:1", "'127.0.0.1:5760' is not a host"),
        ("tcp:[::1:5760", "does not start with an IPv6 address in brackets"),
        ("tcp:[localhost]:5760", "does not start with an IPv6 address in brackets"),
        ("udpbcast:[ff02::1]:14550", "broadcast exists in IPv4 only"),
        ("::1:14550", "needs brackets"),
        ("tcp:::1:5760", "needs brackets"),
        ("udpfoo:127.0.0.1:14550", "udpfoo: unknown kind of link"),
        ("udp//:14550", "a colon is missing: write udp://:14550."),
        ("UDPout//10.0.0.5:14550", "a colon is missing: write udpout://10.0.0.5:14550."),
        ("tcp/127.0.0.1:5760", "a colon is missing: write tcp://127.0.0.1:5760."),
        ("upd//:14550", r"nor the path of a serial port \(did you mean 'udp'\?\)"),
        ("127.0.0.1/14550", "it is neither host:port nor the path of a serial port"),
        ("serial//dev/ttyACM0", "a colon is missing"),
        ("bluetooth://x", "bluetooth: unknown kind of link"),
        ("https:x", "https: unknown kind of link"),
        ("mcast:", "supported by pymavlink, not by aerokit"),
        ("uds:/tmp/socket", "not by aerokit; a program can pass a Link object instead"),
        ("00000001.BIN", "a log in the autopilot's own format"),
        ("/dev/ttyACM0,", "the baud rate '' is not a whole number"),
        ("/dev/ttyACM0,fast", "the baud rate 'fast' is not a whole number"),
        ("COM3:fast", "the baud rate 'fast' is not a whole number"),
        ("serial:///dev/ttyACM0:0", "the baud rate is 0"),
        ("serial://", "the serial port is missing"),
        ("serial://COM3?rtscts=perhaps", r"must be 1 \(yes\)"),
        ("replay:", "the path of the recording is missing"),
        ("flight.tlog?speed=0", "is not a number above 0"),
        ("flight.tlog?speed=nan", "is not a number above 0"),
        ("flight.tlog?speed=fast", "is not a number above 0"),
        ("tcp:h:1?timeout=inf", "is not a number above 0"),
        ("udpin:0.0.0.0:14550?speed=2", "'speed' is not an option of udpin links"),
    ],
)
def test_refused_with_reason_and_accepted_forms(text: str, reason: str) -> None:
    with pytest.raises(InvalidArgument, match=reason) as caught:
        parse_address(text)
    assert "udpin:0.0.0.0:14550" in str(caught.value)
    assert "/dev/ttyUSB0,57600" in str(caught.value)


def test_options_by_name() -> None:
    assert parse_address("a.tlog?speed=2").option("speed") == "2"
    assert parse_address("a.tlog").option("speed") is None


texts = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), min_size=1, max_size=20)
hosts = (
    st.text(string.ascii_letters + string.digits + ".-", min_size=1, max_size=12)
    | st.ip_addresses().map(str)
    | st.just("fe80::1%eth0")
)
ascii_only = st.characters(max_codepoint=127)


def is_tidy(text: str) -> bool:
    return text == text.strip() != ""


speeds = st.floats(min_value=0, exclude_min=True).map(lambda number: repr(number).removesuffix(".0"))
bauds = st.none() | st.integers(1, 4_000_000)


@st.composite
def addresses(draw: st.DrawFn) -> LinkAddress:
    kinds: list[LinkKind] = ["udpin", "udpout", "udpbcast", "tcp", "tcpin", "serial", "replay", "zenoh", "zenohin"]
    kind = draw(st.sampled_from(kinds))
    if kind in ("zenoh", "zenohin"):
        path = draw(
            st.from_regex(r"[A-Za-z0-9][\w.-]{0,9}/[A-Za-z0-9][\w.-]{0,9}", fullmatch=True, alphabet=ascii_only)
        )
        given = draw(st.dictionaries(st.sampled_from(["connect", "listen", "config"]), texts.filter(is_tidy)))
        for key in given.keys() & {"connect", "listen"}:
            given[key] = "tcp/x" + given[key].replace(",", ",tcp/x")
        return zenoh(path, kind, **given)
    if kind == "serial":
        return serial(draw(texts.filter(lambda t: t.strip("/"))), draw(bauds), rtscts=draw(st.booleans()))
    if kind == "replay":
        speed = draw(st.none() | speeds.filter(lambda text: text != "1"))
        return replay(draw(texts.filter(str.strip)), speed)
    host = draw(hosts.filter(lambda text: kind != "udpbcast" or ":" not in text))
    return LinkAddress(kind, host=host, port=draw(st.integers(1, 65535)))


@pytest.mark.exhaustive
@settings(max_examples=100)
@given(addresses())
def test_canonical_string_parses_to_the_same(address: LinkAddress) -> None:
    assert parse_address(str(address)) == address


PIECES = (
    "udp: udpin: tcp:// zenoh: zenohin: north/alpha serial: file: replay: // / [ ] ::1 0.0.0.0 : , ? 14550 99999 "
    "speed= rtscts=1 & .tlog COM3 % %3 %20 \\ baud= - ٣"
)
pieces = st.sampled_from([*PIECES.split(), " "])


@settings(max_examples=100)
@given(st.lists(pieces, max_size=7).map("".join) | st.text(max_size=30))
def test_any_string_parses_or_raises_invalid_argument(text: str) -> None:
    address = None
    with contextlib.suppress(InvalidArgument):
        address = parse_address(text)
    assert address is None or parse_address(str(address)) == address
