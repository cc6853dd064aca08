"""How parameters come and go: the list in the background, ahead of it what somebody waits for, and what is set."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

import anyio

from aerokit.dronekit.line import weakly
from aerokit.errors import (
    AerokitError,
    ConnectionClosed,
    InvalidArgument,
    ParameterRejected,
    ParameterTimeout,
)
from aerokit.parameters import Parameter, checked_value
from aerokit.parameters.parameter import MOST_PARAMETERS, same_value
from aerokit.vehicle.parameters.names import found_among

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.dronekit.core import Core
    from aerokit.parameters import ParameterTable, ParameterType
    from aerokit.vehicle.parameters.access import DownloadMethod
    from aerokit.vehicle.parameters.names import Found
    from aerokit.vehicle.vehicle import Vehicle as AsyncVehicle

__all__ = ["ParameterReading", "ParameterValues", "set_parameter"]

VERSION_S = 1.0
"""How long to wait for the vehicle to say whether it has the list as a file."""
PATIENCE_S = 30.0
"""Until then the one who waits has given up."""
AGAIN_S = 1.0
"""How long after a failure the next attempt may begin."""

TRY_S = 1.0
"""How long one attempt waits, unless the link is slower."""
LAST_TRY = 0.5
"""The share of that for the answer to the last one."""
ROUND_TRIPS = 3
ALMOST = 0.01
"""ArduPilot adds it before it cuts off the fraction."""


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
        """Ask for one parameter, under all its names; whether the vehicle has given it, or said that it has none.

        Silence about it is no proof while the list is on its way.
        """
        from aerokit.parameters.renames import other_names

        names = (name, *other_names(name))
        try:
            answers = (await self._core.aio.parameters.probe(*names, patience_s=PATIENCE_S)).values()
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


class ParameterValues:
    """What the vehicle has told, through reboots, too. One thread writes, any thread reads."""

    def __init__(self) -> None:
        self._known: dict[str, Parameter] = {}
        self._spelled: dict[str, str] = {}

    def __len__(self) -> int:
        return len(self._known)

    def copy(self) -> dict[str, float]:
        """Name → value as the vehicle spells and counts them, in a dict of the caller's own."""
        return {name: float(each.value) for name, each in self._known.copy().items()}

    def find(self, name: str) -> Found | None:
        """What is known of an upper-cased name."""
        known = self._known
        return found_among(name if name in known else self._spelled.get(name, name), known)

    def get(self, name: str) -> float | None:
        """The value of an upper-cased name, if it is the vehicle's own and known."""
        known = self._known.get(name)
        return None if known is None else float(known.value)

    def take(self, parameter: Parameter) -> bool:
        """One has come; says whether that is news."""
        name, before = parameter.name, self._known.get(parameter.name)
        if before is None and len(self._known) >= MOST_PARAMETERS:
            return False
        if before is None and name != name.upper():
            self._spelled[name.upper()] = name
        self._known[name] = parameter
        return before is None or not same_value(before.value, parameter.value)


async def set_parameter(aio: AsyncVehicle, name: str, value: float, retries: int) -> AerokitError | None:
    """Have the vehicle take a value; returns why it has not, None when it has confirmed it.

    A fraction given for an integer parameter is cut off, as by ArduPilot itself. A vehicle that answers nothing
    is sent PARAM_SET once, then asked what it has, for ``retries`` + 1 tries in all.
    """
    patience_s = (retries + LAST_TRY) * _try_s(aio)
    try:
        known = aio.parameters.known(name) or await aio.parameters.read(name, patience_s=patience_s)
        wanted = as_held(name, value, known.type)
        done = await aio.parameters.set(name, wanted, patience_s=patience_s)
    except (InvalidArgument, ParameterRejected, ParameterTimeout) as error:
        return error
    if done.outcome == "clamped":
        return ParameterRejected(f"the vehicle made it {done.value:g}", name=name)
    return None


def as_held(name: str, value: float, type: ParameterType) -> int | float:  # noqa: A002
    """The value as a parameter of that type holds it; InvalidArgument when it cannot."""
    if type.is_integer and isinstance(value, float) and abs(value) < float("inf"):
        value = int(value - ALMOST if value < 0 else value + ALMOST)
    return checked_value(name, value, type)


def _try_s(aio: AsyncVehicle) -> float:
    report = aio.link_quality.latest
    return max(TRY_S, ROUND_TRIPS * ((report and report.round_trip_s) or 0.0))
