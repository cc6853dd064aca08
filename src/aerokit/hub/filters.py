"""``Filters``: which messages go out of an endpoint, and how often."""

from __future__ import annotations

from fnmatch import fnmatchcase
from typing import TYPE_CHECKING

from aerokit.errors import InvalidArgument
from aerokit.wording import did_you_mean

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from aerokit.mavlink.dialect import Dialect

__all__ = ["ANSWERS", "MOST_HZ", "Filters"]

ANSWERS = frozenset(
    (
        "COMMAND_ACK", "PARAM_VALUE", "PARAM_EXT_VALUE", "PARAM_EXT_ACK", "MISSION_ACK", "MISSION_COUNT",
        "MISSION_ITEM", "MISSION_ITEM_INT", "MISSION_REQUEST", "MISSION_REQUEST_INT", "FILE_TRANSFER_PROTOCOL",
        "LOG_ENTRY", "LOG_DATA", "AUTOPILOT_VERSION", "TIMESYNC", "PING", "STATUSTEXT",
    )
)  # fmt: skip
"""Answers and parts of transfers, of which some name no target: a rate for ``"*"`` does not mean them."""

MOST_HZ = 1000.0
"""The highest rate that can be asked for."""


class Filters:
    """Names of messages as patterns: ``"GPS_*"``; only those of ``only``, if there are any, without those of ``block``.

    ``rates`` are the highest ones, in Hz, for each sender; of several patterns that fit, the first counts. For
    `ANSWERS` only their own names do.

    Raises:
        InvalidArgument: a pattern fits no message of the dialect, or a rate is not in 0…1000.
    """

    def __init__(
        self,
        dialect: Dialect,
        only: Iterable[str] = (),
        block: Iterable[str] = (),
        rates: Mapping[str, float] | None = None,
    ) -> None:
        self._dialect = dialect
        self._only, self._block, self._rates = tuple(only), tuple(block), dict(rates or {})
        self._periods: dict[int, float | None] = {}
        for field, patterns in (("only", self._only), ("block", self._block), ("rates", self._rates)):
            for pattern in patterns:
                self._check(field, pattern)
        for pattern, hz in self._rates.items():
            if not 0 < hz <= MOST_HZ:
                raise InvalidArgument(
                    f"rates: {pattern} = {hz:g} Hz is not allowed: above 0, at most {MOST_HZ:g}"
                )

    def period(self, message_id: int) -> float | None:
        """None: the message does not go out; 0: it does; else once in so many seconds at most."""
        if not (self._only or self._block or self._rates):
            return 0.0
        if message_id not in self._dialect.rows:
            return None if self._only else 0.0
        if message_id not in self._periods:
            self._periods[message_id] = self._period(self._dialect[message_id].NAME)
        return self._periods[message_id]

    def _period(self, name: str) -> float | None:
        if self._only and not any(fnmatchcase(name, each) for each in self._only):
            return None
        if any(fnmatchcase(name, each) for each in self._block):
            return None
        fitting = (hz for each, hz in self._rates.items() if fnmatchcase(name, each))
        hz = self._rates.get(name) if name in ANSWERS else next(fitting, None)
        return 0.0 if hz is None else 1 / hz

    def _check(self, field: str, pattern: str) -> None:
        names = [each.NAME for each in self._dialect]
        if not any(fnmatchcase(name, pattern) for name in names):
            raise InvalidArgument(
                f"{field} = {pattern!r} fits no message of the dialect {self._dialect.name!r}"
                f"{did_you_mean(pattern, names)}"
            )
