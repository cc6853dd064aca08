"""``parse_address``: connection strings of DroneKit and pymavlink, and URLs."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Literal, NamedTuple

from aerokit._internal.formatting import did_you_mean
from aerokit._internal.values import Snapshot
from aerokit.errors import InvalidArgument

if TYPE_CHECKING:
    from collections.abc import Callable

LinkKind = Literal["udpin", "udpout", "udpbcast", "tcp", "tcpin", "serial", "replay", "pty", "zenoh", "zenohin"]

ACCEPTED_FORMS = """\
  127.0.0.1:14550  udp:0.0.0.0:14550  udpin:0.0.0.0:14550  udp://:14550   listen for UDP
  udpout:192.168.1.12:14550  udpout://192.168.1.12:14550                  send UDP to one host
  udpbcast:192.168.1.255:14550                                            broadcast, then use the peer that answers
  tcp:127.0.0.1:5760  tcp://127.0.0.1:5760  tcpout:127.0.0.1:5760         connect by TCP
  tcpin:0.0.0.0:5760                                                      wait for TCP clients
  /dev/ttyACM0  /dev/ttyUSB0,57600  COM14  COM14,115200                   serial port, with its baud rate
  serial:///dev/ttyUSB0:57600  serial://COM3:57600?rtscts=1               the same, with flow control
  flight.tlog  replay:flight.tlog?speed=2  file:///logs/flight.tlog       replay a recording
  pty  pty:/tmp/ttyV0                                                     a pseudo-terminal, and a name for it
  zenoh://fleet/alpha  zenoh://fleet/alpha?connect=tcp/10.0.0.5:7447      a vehicle on a zenoh network, by name
  zenohin://fleet/alpha?listen=tcp/0.0.0.0:7447                           serve that name, for clients of zenoh:
  IPv6 addresses need brackets: udpin:[::1]:14550"""
"""Accepted forms of a connection string, for error messages and help texts."""


class LinkAddress(Snapshot):
    """A parsed connection string. ``str()`` returns its canonical form, which parses to the same value."""

    kind: LinkKind
    host: str = ""
    """Name or IP address without brackets; "0.0.0.0" for listening without a host."""
    port: int = 0
    """1 to 65535. 0 is allowed for listening: the system then chooses the port."""
    device: str = ""
    """Serial port, e.g. "/dev/ttyACM0" or "COM14"."""
    baud: int | None = None
    """Bits per second; None if not given."""
    path: str = ""
    """Path of a recording or of a pseudo-terminal's symbolic link, or the zenoh name "fleet/name"; "" if not given."""
    options: tuple[tuple[str, str], ...] = ()
    """(name, value) pairs sorted by name: ``rtscts``, ``costly`` ("1"), ``speed``, ``timeout`` (s), options of zenoh.
    """

    def __str__(self) -> str:
        query = "&".join(f"{key}={_quote_option(value)}" for key, value in self.options)
        return self._without_options() + (f"?{query}" if query else "")

    def option(self, name: str) -> str | None:
        """Return the value of an option, or None if it is not given."""
        return dict(self.options).get(name)

    def _without_options(self) -> str:
        if self.kind == "serial":
            baud = "" if self.baud is None else f":{self.baud}"
            return f"serial://{_quote_device(self.device)}{baud}"
        if self.kind == "replay":
            # In replay://…, the first two slashes do not belong to the path. A path that begins with two slashes
            # therefore gets two more.
            slashes = "//" if self.path.startswith("//") else ""
            return f"replay:{slashes}{_quote(self.path)}"
        if self.kind == "pty":
            return f"pty:{self.path}" if self.path else "pty"
        if self.kind in ("zenoh", "zenohin"):
            return f"{self.kind}://{self.path}"
        return f"{self.kind}:{host_and_port(self.host, self.port)}"


def parse_address(text: str) -> LinkAddress:
    """Parse a connection string.

    ``host:port`` and ``udp:host:port`` are UDP links that listen, as in DroneKit and pymavlink. In
    forms with a scheme, except ``pty:``, percent-encoded characters of devices and paths are decoded.

    Raises:
        InvalidArgument: the string is wrong; the text has the reason and the accepted forms.
    """
    return _Parser(text).parse()


def host_and_port(host: str, port: int) -> str:
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


Options = dict[str, str]

_CHOICES = {"mode": ("peer", "client"), "control": ("free", "take", "never")}

_CASE_SENSITIVE = ("connect", "listen", "config", "client")

_PYMAVLINK_ONLY = ("uds", "unix", "mcast", "ws", "wss", "wsserver", "csv")

_ENDPOINT = re.compile(r"[a-z][a-z0-9_-]*/[^/].*", re.IGNORECASE | re.DOTALL)

# A scheme has at least two characters, because a single letter is a Windows drive.
_SCHEME = re.compile(r"([a-z][a-z0-9_+.-]+):(.*)", re.IGNORECASE | re.DOTALL)

_URL = re.compile(r"([a-z][a-z0-9_+.-]*)://(.*)", re.IGNORECASE | re.DOTALL)

_RECORDING = re.compile(r".*\.tlog(\?[^/\\]*)?", re.IGNORECASE | re.DOTALL)

_DATAFLASH = re.compile(r".*\.(bin|log|px4log|ulg)", re.IGNORECASE | re.DOTALL)

# Addresses with a missing colon: ``udp//:14550``, ``tcp/127.0.0.1:5760``, ``127.0.0.1/14550``.
_WITHOUT_COLON = re.compile(r"([^/\\:.~,][^/\\:]*)(//+|/(?=([^/\\]*:)?\d+$))")

_COM_PORT = re.compile(r"com\d+([,:].*)?", re.IGNORECASE)

_COM_COLON_BAUD = re.compile(r"(com\d+):(.*)", re.IGNORECASE)

_COLON_BAUD = re.compile(r"(.*):(\d+)", re.DOTALL | re.ASCII)

_HOST = re.compile(r"[^\s\[\]/\\?#:,@]+")

_YES_AND_NO = {
    "1": True,
    "true": True,
    "yes": True,
    "on": True,
    "0": False,
    "false": False,
    "no": False,
    "off": False,
}


class _Parser:
    """Parses one connection string. Its errors name the whole string and the reason."""

    def __init__(self, text: str) -> None:
        self.text = text

    def parse(self) -> LinkAddress:
        text = self.text.strip()
        if not text:
            raise self.error("it is empty")
        if "\0" in text:
            raise self.error("it contains a NUL character")
        if text.lower() == "pty" or text.lower().startswith("pty:"):  # The rest is a path, without any options.
            return LinkAddress("pty", path=text[len("pty:") :])
        scheme, after_scheme = self.split_scheme(text)
        if scheme in _SCHEMES:
            return self.parse_with_scheme(scheme, after_scheme)
        if scheme:
            raise self.scheme_error(scheme)
        return self.parse_bare(text)

    def split_scheme(self, text: str) -> tuple[str, str]:
        """Return the scheme in lower case, and the text after it. The scheme may be empty."""
        if match := _URL.fullmatch(text):
            return match[1].lower(), match[2]
        match = _SCHEME.fullmatch(text)
        # Without "//", only a known word is a scheme. Any other word may be a host.
        if match and match[1].lower() in (*_SCHEMES, *_PYMAVLINK_ONLY, "http", "https", "ftp"):
            return match[1].lower(), match[2]
        return "", text

    def parse_with_scheme(self, scheme: str, after_scheme: str) -> LinkAddress:
        kind = _SCHEMES[scheme]
        target, _, query = after_scheme.partition("?")
        if scheme == "file" and re.match(r"/[a-z]:[/\\]", target, re.IGNORECASE):
            target = target[1:]  # In file:///C:/…, the slash before a Windows drive is not part of the path.
        return _KINDS[kind].parse(self, kind, target, self.parse_options(kind, query))

    def parse_bare(self, text: str) -> LinkAddress:
        """Parse a recording, a serial port, or host:port to listen on."""
        if _RECORDING.fullmatch(text):
            end = text.lower().rindex(".tlog") + len(".tlog")
            options = self.parse_options("replay", text[end + 1 :])
            return self.parse_replay("replay", text[:end], options, has_scheme=False)
        if _DATAFLASH.fullmatch(text):
            raise self.error("this is a log in the autopilot's own format, not a MAVLink recording (.tlog)")
        if match := _WITHOUT_COLON.match(text):
            raise self.missing_colon_error(match[1].lower(), match[0], text)
        if _COM_PORT.fullmatch(text) or "\\" in text or "/" in text:
            return self.parse_serial("serial", text, {}, has_scheme=False)
        if ":" not in text:
            raise self.error("it is neither host:port nor the path of a serial port or of a .tlog file")
        before_port, _, _ = text.rpartition(":")
        has_unknown_scheme = text.count(":") > 1 and not text.startswith("[") and not _is_ipv6(before_port)
        if has_unknown_scheme:  # e.g. "upd:127.0.0.1:14550"
            raise self.scheme_error(text.partition(":")[0])
        return self.parse_network("udpin", text, {})

    def parse_network(self, kind: LinkKind, text: str, options: Options) -> LinkAddress:
        """Parse ``host:port``."""
        text = text.removesuffix("/")
        if text.startswith("["):
            host, bracket, tail = text[1:].partition("]")
            if not bracket or not _is_ipv6(host):
                raise self.error(f"{text!r} does not start with an IPv6 address in brackets")
        else:
            host, colon, port = text.rpartition(":")
            if not colon:  # Without a colon, rpartition() returns the whole text as the last part.
                host, port = text, ""
            tail = colon + port
            if _is_ipv6(host):
                raise self.error("an IPv6 address needs brackets, as in [::1]:14550")
            if text.isdigit():  # The text is only a port, e.g. in "udpin:14550".
                raise self.error(f"the host is missing; write {kind}:127.0.0.1:{text}")
        if not host and _KINDS[kind].listens:
            host = "0.0.0.0"
        if not host:
            raise self.error("the host is missing")
        if kind == "udpbcast" and _is_ipv6(host):
            raise self.error("broadcast exists in IPv4 only")
        if not _is_ipv6(host) and not _HOST.fullmatch(host):
            raise self.error(f"{host!r} is not a host")
        return LinkAddress(kind, host=host, port=self.parse_port(kind, tail), options=tuple(sorted(options.items())))

    def parse_zenoh(self, kind: LinkKind, text: str, options: Options) -> LinkAddress:
        """Parse ``fleet/name``."""
        from aerokit.transport.zenoh.keys import check_name  # imported here because few addresses need it

        for key in ("connect", "listen"):
            for endpoint in filter(None, options.get(key, "").split(",")):
                if not _ENDPOINT.fullmatch(endpoint):
                    raise self.error(f"{key}={endpoint} is not a zenoh endpoint such as tcp/10.0.0.5:7447")
        fleet, slash, name = text.removesuffix("/").partition("/")
        if not slash:
            raise self.error(f"the name of the vehicle is missing; write it as in {kind}://fleet/alpha")
        try:
            check_name("the fleet", fleet)
            check_name("the name", name)
            if "client" in options:
                check_name("client", options["client"])
        except InvalidArgument as error:
            raise self.error(str(error)) from None
        return LinkAddress(kind, path=f"{fleet}/{name}", options=tuple(sorted(options.items())))

    def parse_port(self, kind: LinkKind, tail: str) -> int:
        """Parse ``:port``, the text after a host."""
        if tail in ("", ":"):
            raise self.error("the port is missing")
        if not tail.startswith(":"):
            raise self.error(f"expected :port after the host, got {tail!r}")
        port = self.parse_whole_number("the port", tail[1:])
        min_port = 0 if _KINDS[kind].listens else 1
        if not min_port <= port <= 65535:
            raise self.error(f"the port {port} is out of range ({min_port} to 65535)")
        return port

    def parse_serial(self, kind: LinkKind, text: str, options: Options, *, has_scheme: bool = True) -> LinkAddress:
        # In an address without a scheme, only the name of a COM port may be followed by a colon and the baud rate.
        # Other names may contain colons themselves.
        colon_baud = _COLON_BAUD if has_scheme else _COM_COLON_BAUD
        baud_text: str | None
        if "," in text:
            device, _, baud_text = text.partition(",")
        elif match := colon_baud.fullmatch(text):
            device, baud_text = match[1], match[2]
        else:
            device, baud_text = text, None
        baud_text = options.pop("baud", baud_text)
        device = _unquote(device) if has_scheme else device
        if not device.strip("/"):
            raise self.error("the serial port is missing")
        baud = None if baud_text is None else self.parse_whole_number("the baud rate", baud_text)
        if baud == 0:
            raise self.error("the baud rate is 0")
        return LinkAddress(kind, device=device, baud=baud, options=tuple(sorted(options.items())))

    def parse_replay(self, kind: LinkKind, path: str, options: Options, *, has_scheme: bool = True) -> LinkAddress:
        path = _unquote(path) if has_scheme else path
        if not path.strip():
            raise self.error("the path of the recording is missing")
        return LinkAddress(kind, path=path, options=tuple(sorted(options.items())))

    def parse_options(self, kind: LinkKind, query: str) -> Options:
        options: Options = {}
        allowed = _KINDS[kind].options
        for assignment in filter(None, query.split("&")):
            key, _, value = assignment.partition("=")
            key = key.strip().lower()
            if key not in allowed:
                names = ", ".join(allowed) or "none"
                suggestion = did_you_mean(key, allowed)
                raise self.error(f"{key!r} is not an option of {kind} links (they have: {names}){suggestion}")
            if key in _CASE_SENSITIVE:
                options[key] = _unquote(value.strip())
                if not options[key]:
                    raise self.error(f"{key}= is empty")
            else:
                options[key] = self.checked_option(key, value.strip().lower())
        # Options with their default values are left out, so that equal links have equal addresses.
        defaults = (("rtscts", "0"), ("costly", "0"), ("speed", "1"))
        return {key: value for key, value in options.items() if (key, value) not in defaults}

    def checked_option(self, key: str, value: str) -> str:
        if key == "baud":  # `parse_serial` checks the number.
            return value
        if key in _CHOICES:
            if value not in _CHOICES[key]:
                raise self.error(f"{key}={value} is not one of {', '.join(_CHOICES[key])}")
            return value
        if key in ("rtscts", "costly"):
            if value not in _YES_AND_NO:
                raise self.error(f"{key}={value} must be 1 (yes) or 0 (no)")
            return str(int(_YES_AND_NO[value]))
        try:
            number = float("inf" if value == "max" else value)
        except ValueError:
            number = math.nan
        if not number > 0 or (key == "timeout" and math.isinf(number)):
            raise self.error(f"{key}={value} is not a number above 0")
        return repr(number).removesuffix(".0")

    def parse_whole_number(self, what: str, text: str) -> int:
        if not (text.isascii() and text.isdigit() and len(text) <= 9):
            raise self.error(f"{what} {text!r} is not a whole number")
        return int(text)

    def missing_colon_error(self, scheme: str, matched: str, text: str) -> InvalidArgument:
        if scheme not in _SCHEMES:
            return self.error(f"it is neither host:port nor the path of a serial port{did_you_mean(scheme, _SCHEMES)}")
        return self.error(f"a colon is missing: write {scheme}://{text[len(matched) :]}")

    def scheme_error(self, scheme: str) -> InvalidArgument:
        reason = "unknown kind of link"
        if scheme in _PYMAVLINK_ONLY:
            reason = "supported by pymavlink, not by aerokit; a program can pass a Link object instead"
        return self.error(f"{scheme}: {reason}{did_you_mean(scheme, _SCHEMES)}")

    def error(self, reason: str) -> InvalidArgument:
        shown = re.sub(r"(//[^/@:]*):.*@", r"\1:…@", self.text)  # hides the password in a broker's URL
        return InvalidArgument(f"{shown!r} is not a link address: {reason}. Accepted:\n{ACCEPTED_FORMS}")


def _is_ipv6(text: str) -> bool:
    if ":" not in text:
        return False
    import ipaddress  # imported here, like urllib below, because few addresses need it

    try:
        ipaddress.IPv6Address(text)
    except ValueError:
        return False
    return True


def _quote(text: str) -> str:
    """Percent-encode only ``%``, ``?`` and white space."""
    from urllib.parse import quote

    return re.sub(r"[%?\s]", lambda match: quote(match[0], safe=""), text)


def _quote_option(text: str) -> str:
    return _quote(text).replace("&", "%26")


def _unquote(text: str) -> str:
    from urllib.parse import unquote

    return unquote(text)


def _quote_device(device: str) -> str:
    """Like `_quote`, but also encode what separates a baud rate."""
    # A comma, or a colon before digits at the end, separates a baud rate.
    return re.sub(r":(?=[0-9]+$)", "%3A", _quote(device).replace(",", "%2C"))


class _Kind(NamedTuple):
    """How the addresses of one kind of link are parsed."""

    schemes: tuple[str, ...]
    parse: Callable[[_Parser, LinkKind, str, Options], LinkAddress]
    """Parses what follows the scheme, without the options."""
    options: tuple[str, ...] = ("costly",)
    listens: bool = False


_NETWORK = ("connect", "listen", "mode", "config")
_KINDS: dict[LinkKind, _Kind] = {
    "udpin": _Kind(("udp", "udpin"), _Parser.parse_network, listens=True),
    "udpout": _Kind(("udpout",), _Parser.parse_network),
    "udpbcast": _Kind(("udpbcast",), _Parser.parse_network),
    "tcp": _Kind(("tcp", "tcpout"), _Parser.parse_network, ("timeout", "costly")),
    "tcpin": _Kind(("tcpin",), _Parser.parse_network, listens=True),
    "serial": _Kind(("serial",), _Parser.parse_serial, ("baud", "rtscts", "costly")),
    "replay": _Kind(("replay", "file"), _Parser.parse_replay, ("speed",)),
    "zenoh": _Kind(("zenoh",), _Parser.parse_zenoh, (*_NETWORK, "client", "control", "timeout", "costly")),
    "zenohin": _Kind(("zenohin",), _Parser.parse_zenoh, (*_NETWORK, "costly")),
}
_SCHEMES: dict[str, LinkKind] = {scheme: kind for kind, row in _KINDS.items() for scheme in row.schemes}
