"""``BrokerAddress``: a broker of MQTT, and who publishes there: ``"mqtt://10.0.0.5:1883/north/alpha"``."""

from __future__ import annotations

from typing import NoReturn
from urllib.parse import unquote, urlsplit

from aerokit.errors import InvalidArgument
from aerokit.links.address import host_and_port
from aerokit.links.zenoh_keys import Place, check_name
from aerokit.snapshot import Snapshot

__all__ = ["PORTS", "BrokerAddress", "parse_broker"]

PORTS: dict[str, int] = {"mqtt": 1883, "mqtts": 8883}
"""Scheme → the port where such brokers listen."""


class BrokerAddress(Snapshot):
    """A broker, and who publishes there; what is printed of it has no user and no password."""

    scheme: str
    """"mqtt", or "mqtts" by TLS."""
    host: str
    port: int
    place: Place
    user: str | None = None
    password: str | None = None

    def __str__(self) -> str:
        return f"{self.scheme}://{host_and_port(self.host, self.port)}/{self.place.fleet}/{self.place.name}"

    def __repr__(self) -> str:
        return f"<{self}>"


def parse_broker(text: str, *schemes: str) -> BrokerAddress:
    """Read an address; ``schemes`` are those that are allowed, none: all.

    Raises:
        InvalidArgument: it is none. What was given is not repeated in there where it may have a password.
    """
    allowed = schemes or tuple(PORTS)

    def fail(reason: str) -> NoReturn:
        shown = f"{scheme}://…" if "@" in text else text
        raise InvalidArgument(
            f"address = {shown!r} is not allowed: {reason}, as in"
            f" {allowed[0]}://10.0.0.5:{PORTS[allowed[0]]}/fleet/alpha (% and @ : / ? # in a password: %25, %40 …)"
        )

    scheme = text.partition("://")[0].strip().lower() if "://" in text else "…"
    if scheme not in allowed:
        if "@" in text:
            scheme = "…"
        fail(f"it begins with none of {', '.join(f'{each}://' for each in allowed)}")
    try:
        parts = urlsplit(text.strip())
        host, port = parts.hostname, parts.port
    except ValueError:
        fail("host and port cannot be read")
    if not host or port == 0:
        fail("host or port is missing")
    if parts.query or parts.fragment:
        fail("it has options, and there are none")
    fleet, _, name = parts.path.strip("/").partition("/")
    try:
        place = Place(check_name("fleet", fleet), check_name("name", name))
    except InvalidArgument:
        fail("fleet and name are up to 63 letters, digits, '_', '.' and '-', a letter or digit first")
    user, password = (None if each is None else unquote(each) for each in (parts.username, parts.password))
    return BrokerAddress(scheme, host, port or PORTS[scheme], place, user, password)
