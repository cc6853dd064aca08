"""``Keepers``: the vehicle objects of a fleet, opened and let go all at once."""

from __future__ import annotations

import asyncio
from functools import partial
from typing import TYPE_CHECKING

from aerokit.fleets.finding import telling_who_is_missing
from aerokit.runtime.background import Background, to_its_end
from aerokit.vehicle.connect import connect

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from types import TracebackType

    from aerokit.mavlink.message import Message
    from aerokit.runtime.connection import Connection
    from aerokit.vehicle.vehicle import Vehicle

__all__ = ["Keepers"]


class _CutShort(Exception):
    """The fleet's block was left by an exception: each vehicle's own is left like that, too."""


class Keepers:
    """A task for each vehicle, in whose block it is connected: so all are let go at once, not one after another."""

    def __init__(self, timeout: float, rates: Mapping[type[Message], float] | None) -> None:
        self._timeout, self._rates = timeout, rates
        self._tasks = Background(self._on_mistake)
        self._open: dict[int, tuple[str, Vehicle]] = {}
        self._error: Exception | None = None
        self._news = asyncio.Event()
        self._leave = asyncio.Event()
        self._is_cut_short = False
        self._running = 0
        self._all_left = asyncio.Event()

    async def keep(self, systems: Sequence[tuple[str, Connection, int]]) -> list[tuple[str, Vehicle]]:
        """Connect to all of them: network, connection and system id each. The vehicles, in the same order."""
        for number, (network, connection, system_id) in enumerate(systems):
            self._running += 1
            self._tasks.start(partial(self._keep, number, network, connection, system_id))
        with telling_who_is_missing(self._timeout, lambda: f"nothing is heard of {self._missing(systems)}"):
            while len(self._open) < len(systems) and self._error is None:
                self._news.clear()
                await self._news.wait()
        if self._error is not None:
            raise self._error
        return [self._open[number] for number in range(len(systems))]

    def _missing(self, systems: Sequence[tuple[str, Connection, int]]) -> str:
        return ", ".join(
            f"{network}/{system_id}"
            for number, (network, _, system_id) in enumerate(systems)
            if number not in self._open
        )

    async def leave(
        self,
        kind: type[BaseException] | None = None,
        error: BaseException | None = None,
        traceback: TracebackType | None = None,
    ) -> None:
        """Let all of them go, as the block of the fleet is left."""
        self._is_cut_short = error is not None
        self._leave.set()
        if self._running and len(self._open) == self._running:
            await to_its_end(self._wait_until_all_left())
        await self._tasks.aclose()

    async def _wait_until_all_left(self) -> None:
        await self._all_left.wait()

    async def _keep(self, number: int, network: str, connection: Connection, system_id: int) -> None:
        try:
            async with connect(
                connection, system_id=system_id, timeout=self._timeout, rates=self._rates
            ) as vehicle:
                self._open[number] = (network, vehicle)
                self._news.set()
                await self._leave.wait()
                if self._is_cut_short:
                    raise _CutShort
        except _CutShort:
            pass
        finally:
            self._running -= 1
            if not self._running:
                self._all_left.set()

    def _on_mistake(self, error: Exception) -> None:
        self._error = self._error or error
        self._news.set()
