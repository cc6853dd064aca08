"""Addresses of several vehicles in one: ``udpout:127.0.0.1:{14550+n}``, ``pty:/tmp/ttyV{n}``."""

from __future__ import annotations

import re

__all__ = ["EACH_ITS_OWN", "each_with_its_own", "place_of"]

EACH_ITS_OWN = "tcpin:127.0.0.1:{5760+10n}"
"""As SITL numbers its instances: 5760, 5770, 5780 and so on."""

_FORM = re.compile(r"\{(?:(\d{1,5})\+)?(\d{0,3})(n|id)\}")


def each_with_its_own(address: str) -> bool:
    """Whether the address is a form, which gives each vehicle a link of its own."""
    return _FORM.search(address) is not None


def place_of(address: str, number: int, system_id: int) -> str:
    """The address of one vehicle: ``n`` counts from 0, ``id`` is its system id; ``{5760+10n}`` reckons with them."""

    def value(match: re.Match[str]) -> str:
        start, factor, name = match.groups()
        return str(int(start or 0) + int(factor or 1) * (number if name == "n" else system_id))

    return _FORM.sub(value, address)
