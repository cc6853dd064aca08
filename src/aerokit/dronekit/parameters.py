"""``vehicle.parameters``: the autopilot's parameters as a mapping of names to floats."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Iterator, MutableMapping
from typing import TYPE_CHECKING, Any

import anyio

from aerokit.dronekit.core import core_of
from aerokit.dronekit.exceptions import APIException, TimeoutError  # noqa: A004 - DroneKit's name
from aerokit.dronekit.line import weakly
from aerokit.dronekit.observers import HasObservers, ListenerT
from aerokit.dronekit.privates import Python2Mapping
from aerokit.errors import (
    AerokitError,
    ConnectionClosed,
    InvalidArgument,
    ParameterRejected,
    ParameterTimeout,
)
from aerokit.events import ParameterChanged
from aerokit.mavlink.messages import ParamValue
from aerokit.parameters import Parameter, check_name, checked_value
from aerokit.parameters.parameter import MOST_PARAMETERS, number_of, same_value
from aerokit.vehicle.parameters.writing import found_among, warn_of_rename

if TYPE_CHECKING:
    from aerokit.dronekit.core import Core, VehicleCore
    from aerokit.parameters import ParameterTable, ParameterType
    from aerokit.vehicle.parameters.access import DownloadMethod
    from aerokit.vehicle.parameters.writing import Found
    from aerokit.vehicle.vehicle import Vehicle as AsyncVehicle

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
            self._core.handler.calls.post(self.begin)

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


READY_S = 30.0
"""How long reading waits."""


class Parameters(MutableMapping[str, float], Python2Mapping[float], HasObservers):
    """Name → value: ``vehicle.parameters['RTL_ALT']``, ``vehicle.parameters['RTL_ALT'] = 30``.

    Names are upper-cased, values are floats. The list is downloaded in the background from the moment at which the
    vehicle was found, and stays valid through reboots and lost links; every change that the vehicle tells of is taken.
    Reading a value that has not come yet asks the vehicle for that one, so it seldom waits for the whole list;
    iterating does, :func:`len` tells how many have come. A value that is known is read without waiting.

    Names from before and after ArduPilot renamed a parameter are taken by both, and values converted, with a warning.
    Listeners get ``(parameters, name, value)``, when a value has changed or has come for the first time. What waits
    raises APIException while the link is down, and TimeoutError after 30 seconds.
    """

    def __init__(self, vehicle: VehicleCore) -> None:
        self._vehicle, self._core = vehicle, core_of(vehicle)
        core = self._core
        HasObservers.__init__(self, core.handler.listener_thread)
        self._values = ParameterValues()
        self._count = 0
        """How many there are by the last message."""
        self._reading = ParameterReading(core, self._take_all)
        core.on(ParamValue, self._on_value)
        core.at_start.append(self._start)
        core.ready.seekers["parameters"] = self._reading.seek

    # ------------------------------------------------------------------------------- reading

    def __getitem__(self, name: str) -> float:
        value = self.get(name)
        if value is None:
            raise KeyError(_described(name.upper()) if isinstance(name, str) else name)
        return value

    def get(  # type: ignore[override]
        self, name: str, wait_ready: object = True, *, default: float | None = None
    ) -> float | None:
        """Return a value; ``default`` when the vehicle has no such parameter.

        The second argument is no default: false, it is what is known now that counts, and nothing is waited for.
        """
        if isinstance(name, str) and (value := self._values.get(name.upper())) is not None:
            return value
        found = self._find(name, waits=bool(wait_ready))
        if found is None:
            return default
        if found.renamed is not None:
            warn_of_rename(found.renamed)
        return float(found.in_terms_asked(found.parameter).value)

    def __contains__(self, name: object) -> bool:
        return self._find(name) is not None

    def __len__(self) -> int:
        return len(self._values)

    def __iter__(self) -> Iterator[str]:
        if not self._reading.is_complete:
            self.wait_ready()
        return iter(self._values.copy())

    def wait_ready(self, **kwargs: Any) -> None:
        """Wait until all parameters are there, as ``Vehicle.wait_ready``. A download that has failed is begun again."""
        self._vehicle.wait_ready("parameters", **kwargs)

    # ------------------------------------------------------------------------------- writing

    def __setitem__(self, name: str, value: float) -> None:
        self.set(name, value)

    def __delitem__(self, name: str) -> None:
        raise APIException("Cannot delete value from parameters list.")

    def set(self, name: str, value: float, retries: int = 3, wait_ready: bool = False) -> bool:
        """Set a parameter, and wait until the vehicle has confirmed it.

        An integer parameter takes a number without its fraction. ``parameters[name] = value`` does the same.

        Args:
            name: any case.
            value: any number.
            retries: how often it is sent again to a vehicle that does not answer, and how many seconds are waited.
                0 does not wait: it is confirmed in the background, and the result is False.
            wait_ready: whether to wait for the download of all parameters first; there is no need to.

        Returns:
            Whether the vehicle holds the value now. If not, the reason is logged as an error: no answer, no such
            parameter, a value that the vehicle or the parameter's type does not take.

        InvalidArgument, a ValueError: the name is no text, or the value no number.
        """
        name, number = _upper(name), number_of(name, value)
        if wait_ready:
            self.wait_ready()
        found = self._values.find(name)
        own, told = name if found is None else found.name, number
        if found is not None and found.renamed is not None:
            told = found.renamed.to_vehicle(number)  # not rounded: integers are made of fractions in one way
            warn_of_rename(found.renamed)
        core = self._core
        if retries <= 0:
            core.order(f"parameter {own}", set_parameter, core.aio, own, told, 0)
            return False
        failure = core.run(set_parameter, core.aio, own, told, retries)
        if isinstance(failure, ParameterTimeout):
            core.logger.error("timeout setting parameter %s to %f", name, number)
        elif failure is not None:
            core.logger.error("could not set parameter %s to %f: %s", name, number, failure)
        return failure is None

    def on_attribute(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, attr_name: str | list[str] | tuple[str, ...]
    ) -> Callable[[ListenerT], ListenerT]:
        """Decorate a listener with the name, or the list of names, of parameters. It cannot be removed by name then."""
        return super().on_attribute(attr_name)

    @staticmethod
    def _dk_spelled(attr_name: str) -> str:
        return attr_name.upper()

    def _find(self, name: object, *, waits: bool = True) -> Found | None:
        """Waited for if need be; None when the vehicle has no such parameter."""
        if not isinstance(name, str):
            return None
        name = name.upper()
        is_settled = self._is_settled  # before looking: the list may come meanwhile
        known = self._values.find(name)
        if known is None and waits and not is_settled and _is_possible(name):
            self._core.run(self._wait_for, name)
            known = self._values.find(name)
        return known

    @property
    def _is_settled(self) -> bool:
        """Whether the vehicle has nothing but what is known: the whole list has come, and is as long as it says."""
        return self._reading.is_complete and self._count <= len(self._values)

    async def _wait_for(self, name: str) -> None:
        with anyio.move_on_after(READY_S) as waiting:
            await self._reading.find(name)
        if waiting.cancelled_caught:
            raise TimeoutError(f"wait_ready experienced a timeout after {READY_S:.0f} seconds.")

    def known_values(self) -> dict[str, float]:
        """What is known now, without waiting."""
        return self._values.copy()

    def _start(self) -> None:
        self._core.aio.connection.bus.attach_event(ParameterChanged, weakly(self._on_changed))
        self._reading.begin()

    def _on_value(self, message: ParamValue) -> None:
        """The table underneath has taken it already: there, integers are what they are."""
        self._count = message.param_count
        self._take(message.param_id)

    def _on_changed(self, event: ParameterChanged) -> None:
        """Also by a download that a program has begun by itself."""
        if event.system_id == self._core.target_system:
            self._take(event.name)

    def _take(self, name: str) -> None:
        told = self._core.aio.parameters.known(name)
        if told is not None and self._values.take(told):
            self._dk_listeners.tell(told.name.upper(), float(told.value), cache=True)

    def _take_all(self, table: ParameterTable) -> None:
        for name in table:
            self._take(name)
        self._reading.is_complete = True
        self._core.listeners.tell("parameters", self)


def _upper(name: str) -> str:
    if not isinstance(name, str):
        raise InvalidArgument(f"parameter name = {name!r} is no text")
    return name.upper()


def _described(name: str) -> str:
    from aerokit.parameters.renames import replacement_of

    replaced = replacement_of(name)
    return f"{name}: replaced by {replaced}" if replaced else name


def _is_possible(name: str) -> bool:
    try:
        check_name(name)
    except InvalidArgument:
        return False
    return True
