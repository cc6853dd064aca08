"""How parameters come: all of them in the background, and ahead of them the one that somebody waits for."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

import anyio

from aerokit.dronekit.weakly import weakly
from aerokit.errors import AerokitError, ConnectionClosed, ParameterRejected
from aerokit.parameters import Parameter

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.dronekit.core import Core
    from aerokit.parameters import ParameterTable
    from aerokit.vehicle.parameters.access import DownloadMethod
    from aerokit.vehicle.vehicle import Vehicle as AsyncVehicle

__all__ = ["ParameterReading"]

VERSION_S = 1.0
"""How long to wait for the vehicle to say whether it has the list as a file."""
PATIENCE_S = 30.0
"""Until then the one who waits has given up."""
AGAIN_S = 1.0
"""How long after a failure the next attempt may begin."""


class ParameterReading:
    """The download begins when the vehicle is found. A failure is logged once, as a warning.

    Whoever waits for it then has it tried again and again; nobody else does.
    """

    def __init__(self, core: Core, take_all: Callable[[ParameterTable], None]) -> None:
        self._core, self._take_all = core, take_all
        self.is_complete = False
        """Whether the whole list has come since the connection was made; it stays true when the vehicle reboots."""
        self._ended: asyncio.Event | None = None
        self._has_warned = False

    def begin(self) -> None:
        """Begin the download, unless it is under way or done (loop thread)."""
        if self._ended is None and not self.is_complete:
            self._ended = asyncio.Event()
            aio, take = self._core.aio, weakly(self._take_all)
            fail, end = weakly(self._warn), weakly(self._end)
            self._core.background(lambda: _download(aio, take, fail, end))

    def seek(self) -> None:
        """As :meth:`begin`, from any thread; silent when the connection is closed."""
        with contextlib.suppress(AerokitError):
            self._core.handler.orders.post(self.begin)

    async def find(self, name: str) -> None:
        """Return when the parameter has come, by itself or with the list, or when it is certain that there is none."""
        if self.is_complete:
            await self._read(name)
            return
        async with anyio.create_task_group() as group:

            async def read() -> None:
                if await self._read(name):
                    group.cancel_scope.cancel()

            group.start_soon(read)
            await self._until_complete()
            group.cancel_scope.cancel()

    # ------------------------------------------------------------------------------- inside

    async def _until_complete(self) -> None:
        while not self.is_complete:
            self.begin()
            if self._ended is not None:
                await self._ended.wait()

    def _end(self) -> None:
        ended, self._ended = self._ended, None
        if ended is not None:
            ended.set()

    def _warn(self, error: AerokitError) -> None:
        if not self._has_warned:
            self._has_warned = True
            self._core.logger.warning("the parameters could not be downloaded: %s", error)

    async def _read(self, name: str) -> bool:
        """Ask for one parameter, under all its names; says whether the vehicle has given it, or said it has none.

        Silence about it is no proof while the list is on its way.
        """
        from aerokit.parameters.renames import other_names

        names = (name, *other_names(name))
        access = self._core.aio.parameters._access
        try:
            answers = (await access.read(names, PATIENCE_S, are_doubtful=True)).values()
        except AerokitError:
            return False
        return any(isinstance(each, Parameter) for each in answers) or all(
            isinstance(each, ParameterRejected) and each.code is not None for each in answers
        )


async def _download(
    vehicle: AsyncVehicle,
    take: Callable[[ParameterTable], None],
    fail: Callable[[AerokitError], None],
    end: Callable[[], None],
) -> None:
    """Nobody's but the loop's: it does not keep the vehicle of a program that has dropped it."""
    try:
        take(await vehicle.parameters.download(method=await _method(vehicle)))
    except ConnectionClosed:
        return
    except AerokitError as error:
        fail(error)
        await anyio.sleep(AGAIN_S)
    finally:
        end()


async def _method(vehicle: AsyncVehicle) -> DownloadMethod:
    """A vehicle that does not say what it can is not waited for long."""
    version = vehicle.telemetry.version
    with anyio.move_on_after(VERSION_S):
        await version.wait_until(lambda _: True)
    return "auto" if version.is_known else "list"
