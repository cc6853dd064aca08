"""``vehicle.parameters``: the autopilot's parameters as a mapping of names to floats."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Iterator, MutableMapping
from typing import TYPE_CHECKING, Any

import anyio

from aerokit.dronekit.classic_connection import weak_callback
from aerokit.dronekit.core import core_of
from aerokit.dronekit.exceptions import APIException, TimeoutError  # noqa: A004 - DroneKit's name
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
from aerokit.parameters.parameter import MAX_PARAMETERS, number_of, same_value
from aerokit.vehicle.parameters.writing import resolve_known, warn_of_rename

if TYPE_CHECKING:
    from aerokit.dronekit.core import Core, VehicleCore
    from aerokit.parameters import ParameterTable, ParameterType
    from aerokit.vehicle.parameters.access import DownloadMethod
    from aerokit.vehicle.parameters.writing import ResolvedParameter
    from aerokit.vehicle.vehicle import Vehicle as AsyncVehicle

# How long to wait for AUTOPILOT_VERSION, which shows whether the parameters can be downloaded as a file.
VERSION_TIMEOUT_S = 1.0
READ_TIMEOUT_S = 30.0
RETRY_DELAY_S = 1.0

# Time-out of one attempt to set a parameter, in round trips of the link and in seconds; the longer time applies.
ATTEMPT_ROUND_TRIPS, MIN_ATTEMPT_TIMEOUT_S = 3, 1.0
LAST_ATTEMPT_SHARE = 0.5  # the attempt after the last retry has this share of the time-out

ROUNDING = 0.01  # ArduPilot adds this value before it truncates a number to an integer


class ParameterDownload:
    """Downloads the parameters after the vehicle has connected. Only the first failure is logged, as a warning.

    A failed download is repeated only while a program waits for parameters.
    """

    def __init__(self, core: Core, store_all: Callable[[ParameterTable], None]) -> None:
        self._core, self._store_all = core, store_all
        self.is_complete = False
        """True after a complete download. It stays True when the vehicle reboots."""
        self._ended: asyncio.Event | None = None  # set when the running download ends; None while none runs
        self._has_warned = False  # True once a failure was logged

    def begin(self) -> None:
        """Begin the download, on the loop."""
        if self._ended is None and not self.is_complete:
            self._ended = asyncio.Event()
            aio, on_success = self._core.aio, weak_callback(self._store_all)
            on_failure, on_ended = weak_callback(self._log_failure_once), weak_callback(self._on_ended)
            self._core.background(lambda: _download(aio, on_success, on_failure, on_ended))

    def request(self) -> None:
        """Begin the download, from any thread. Ignored after the connection is closed."""
        with contextlib.suppress(AerokitError):
            self._core.handler.calls.post(self.begin)

    async def wait_for(self, name: str) -> None:
        """Wait until the parameter is received, or reported as missing by the vehicle.

        Also returns if the connection ends, or if the vehicle does not answer after a complete download.
        """
        # A vehicle may leave a parameter out of the list, so it is requested once.
        if self.is_complete:
            await self._request(name)
            return
        async with anyio.create_task_group() as group:
            # Request the parameter besides the download of all parameters. The first success ends the wait.

            async def request() -> None:
                if await self._request(name):
                    group.cancel_scope.cancel()

            group.start_soon(request)
            await self._until_complete()
            group.cancel_scope.cancel()

    async def _until_complete(self) -> None:
        while not self.is_complete and self._core.aio.connection.is_open:
            self.begin()
            if self._ended is not None:
                await self._ended.wait()

    def _on_ended(self) -> None:
        ended, self._ended = self._ended, None
        if ended is not None:
            ended.set()

    def _log_failure_once(self, error: AerokitError) -> None:
        if not self._has_warned:
            self._has_warned = True
            self._core.logger.warning("the parameters could not be downloaded: %s", error)

    async def _request(self, name: str) -> bool:
        """Request a parameter under all its names. Return True if it was received or reported as missing."""
        from aerokit.parameters.renames import other_names

        names = (name, *other_names(name))
        try:
            answers = (await self._core.aio.parameters.probe(*names, idle_timeout_s=READ_TIMEOUT_S)).values()
        except AerokitError:
            return False  # A vehicle that is sending the list may ignore requests, so the parameter may exist.
        if any(isinstance(answer, Parameter) for answer in answers):
            return True
        # A rejection without a code means that the vehicle ignored the request.
        return all(isinstance(answer, ParameterRejected) and answer.code is not None for answer in answers)


async def _download(
    vehicle: AsyncVehicle,
    on_success: Callable[[ParameterTable], None],
    on_failure: Callable[[AerokitError], None],
    on_ended: Callable[[], None],
) -> None:
    try:
        # The callbacks hold only weak references to the classic `Vehicle`, so this task does not keep it in memory.
        on_success(await vehicle.parameters.download(method=await _download_method(vehicle)))
    except ConnectionClosed:
        return
    except AerokitError as error:
        on_failure(error)
        # `wait_for` starts a new download as soon as this one ends, so this pause limits the failing attempts.
        await anyio.sleep(RETRY_DELAY_S)
    finally:
        on_ended()


async def _download_method(vehicle: AsyncVehicle) -> DownloadMethod:
    version = vehicle.telemetry.version
    with anyio.move_on_after(VERSION_TIMEOUT_S):
        await version.wait_until(lambda _: True)
    # "auto" needs AUTOPILOT_VERSION to know if MAVFTP exists.
    return "auto" if version.is_known else "list"


class ParameterValues:
    """The parameters that the vehicle has reported; reboots do not clear them. One thread writes, any thread reads."""

    def __init__(self) -> None:
        self._parameters: dict[str, Parameter] = {}
        self._spelling_of_upper: dict[str, str] = {}  # only of names that are not in upper case

    def __len__(self) -> int:
        return len(self._parameters)

    def copy(self) -> dict[str, float]:
        return {name: float(parameter.value) for name, parameter in self._parameters.copy().items()}

    def find(self, name: str) -> ResolvedParameter | None:
        """Look up a parameter by an upper-case name, old or new."""
        if name not in self._parameters:
            name = self._spelling_of_upper.get(name, name)
        return resolve_known(name, self._parameters)

    def get(self, name: str) -> float | None:
        """Return the value of this upper-case name, or None. Does not try other names of the parameter."""
        parameter = self._parameters.get(name)
        return None if parameter is None else float(parameter.value)

    def store(self, parameter: Parameter) -> bool:
        """Store a parameter. Return True if a value was added or changed."""
        name = parameter.name
        previous = self._parameters.get(name)
        if previous is None and len(self._parameters) >= MAX_PARAMETERS:
            return False  # A sender can make up names, so their number is limited.
        if previous is None and name != name.upper():
            self._spelling_of_upper[name.upper()] = name
        self._parameters[name] = parameter
        return previous is None or not same_value(previous.value, parameter.value)


async def set_parameter(aio: AsyncVehicle, name: str, value: float, retries: int) -> AerokitError | None:
    """Set a parameter. Return None if the vehicle confirms the value, otherwise the error."""
    idle_timeout_s = (retries + LAST_ATTEMPT_SHARE) * _attempt_timeout_s(aio)
    try:
        parameter = aio.parameters.known(name) or await aio.parameters.read(name, idle_timeout_s=idle_timeout_s)
        # Values of integer parameters are truncated, as in ArduPilot.
        converted = convert_to_type(name, value, parameter.type)
        # If PARAM_SET is not answered, the value is requested. PARAM_SET is sent again only if the vehicle still
        # reports the old value.
        result = await aio.parameters.set(name, converted, idle_timeout_s=idle_timeout_s)
    except (InvalidArgument, ParameterRejected, ParameterTimeout) as error:
        return error
    if result.outcome == "clamped":
        return ParameterRejected(f"the vehicle set {result.value:g} instead", name=name)
    return None


async def set_once(aio: AsyncVehicle, name: str, value: float) -> None:
    """Like :func:`set_parameter` without retries, but raise the error."""
    failure = await set_parameter(aio, name, value, 0)
    if failure is not None:
        raise failure


def convert_to_type(name: str, value: float, type: ParameterType) -> int | float:  # noqa: A002
    if type.is_integer and isinstance(value, float) and abs(value) < float("inf"):
        rounding = -ROUNDING if value < 0 else ROUNDING
        value = int(value + rounding)
    return checked_value(name, value, type)


def _attempt_timeout_s(aio: AsyncVehicle) -> float:
    report = aio.link_quality.latest
    if report is None or report.round_trip_s is None:
        return MIN_ATTEMPT_TIMEOUT_S
    return max(MIN_ATTEMPT_TIMEOUT_S, ATTEMPT_ROUND_TRIPS * report.round_trip_s)


WAIT_TIMEOUT_S = 30.0


class Parameters(MutableMapping[str, float], Python2Mapping[float], HasObservers):
    """Maps names to values: ``vehicle.parameters['RTL_ALT']``, ``vehicle.parameters['RTL_ALT'] = 30``.

    Names are converted to upper case; values are floats. A parameter that ArduPilot has renamed has its old and its new
    name; values are converted, and a :class:`aerokit.parameters.ParameterRenamedWarning` is issued.

    All parameters are downloaded in the background after connecting, but not again after a reboot or a lost link.
    Changes that the vehicle reports are included. Reading a missing value requests only that value; iterating waits for
    the whole list. :func:`len` returns the number received so far.

    Listeners are called as ``listener(parameters, name, value)`` when a value is new or has changed. Methods that wait
    raise APIException while the link is down, and TimeoutError after 30 seconds.
    """

    def __init__(self, vehicle: VehicleCore) -> None:
        self._vehicle, self._core = vehicle, core_of(vehicle)
        core = self._core
        HasObservers.__init__(self, core.handler.listener_thread)
        self._values = ParameterValues()
        self._count = 0  # number of parameters according to the last PARAM_VALUE
        self._download = ParameterDownload(core, self._store_all)
        core.on(ParamValue, self._on_value)
        core.on_connected.append(self._start)
        core.ready.fetchers["parameters"] = self._download.request

    # ------------------------------------------------------------------------------- reading

    def __getitem__(self, name: str) -> float:
        value = self.get(name)
        if value is None:
            raise KeyError(_key_error_text(name.upper()) if isinstance(name, str) else name)
        return value

    def get(  # type: ignore[override]
        self, name: str, wait_ready: object = True, *, default: float | None = None
    ) -> float | None:
        """Return a value, or ``default`` if the vehicle has no such parameter.

        Unlike in a dict, the second argument is ``wait_ready``, not the default. With ``wait_ready`` false, nothing is
        requested: the result is the value if it is already known, otherwise ``default``.
        """
        value = self._values.get(name.upper()) if isinstance(name, str) else None
        if value is not None:
            return value
        resolved = self._find(name, waits=bool(wait_ready))
        if resolved is None:
            return default
        if resolved.renamed is not None:
            warn_of_rename(resolved.renamed)
        return float(resolved.as_requested(resolved.parameter).value)

    def __contains__(self, name: object) -> bool:
        return self._find(name) is not None

    def __len__(self) -> int:
        return len(self._values)

    def __iter__(self) -> Iterator[str]:
        if not self._download.is_complete:
            self.wait_ready()
        return iter(self._values.copy())

    def wait_ready(self, **kwargs: Any) -> None:
        """Wait until all parameters are received, like ``Vehicle.wait_ready``. Restarts a failed download."""
        self._vehicle.wait_ready("parameters", **kwargs)

    # ------------------------------------------------------------------------------- writing

    def __setitem__(self, name: str, value: float) -> None:
        self.set(name, value)

    def __delitem__(self, name: str) -> None:
        raise APIException("Cannot delete value from parameters list.")

    def set(self, name: str, value: float, retries: int = 3, wait_ready: bool = False) -> bool:
        """Set a parameter, and wait until the vehicle has confirmed it.

        Values of integer parameters are truncated. ``parameters[name] = value`` does the same.

        Args:
            name: in any case.
            value: any number.
            retries: how often the value is requested again if the vehicle does not answer: once a second, or less
                often on a slow link. With 0, the method returns False at once, and a failure is logged later.
            wait_ready: wait for the download of all parameters first, which is not necessary.

        Returns:
            True if the vehicle has confirmed the value. If not, the reason is logged as an error: no answer, unknown
            parameter, or a value that the vehicle or the parameter's type does not accept.

        Raises InvalidArgument, a ValueError, if the name is not a string or the value is not a number.
        """
        name, number = _upper_name(name), number_of(name, value)
        if wait_ready:
            self.wait_ready()
        vehicle_name, converted = name, number
        resolved = self._values.find(name)
        if resolved is not None:
            vehicle_name = resolved.name
            if resolved.renamed is not None:
                converted = resolved.renamed.to_vehicle(number)  # `set_parameter` converts it to an integer if needed.
                warn_of_rename(resolved.renamed)
        core = self._core
        if retries <= 0:
            core.order(f"parameter {vehicle_name}", set_once, core.aio, vehicle_name, converted)
            return False
        failure = core.run(set_parameter, core.aio, vehicle_name, converted, retries)
        if isinstance(failure, ParameterTimeout):
            core.logger.error("timeout setting parameter %s to %f", name, number)
        elif failure is not None:
            core.logger.error("could not set parameter %s to %f: %s", name, number, failure)
        return failure is None

    def on_attribute(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, attr_name: str | list[str] | tuple[str, ...]
    ) -> Callable[[ListenerT], ListenerT]:
        """Decorator: add a listener for one or several parameters, by name or list of names."""
        return super().on_attribute(attr_name)

    @staticmethod
    def _dk_normalized(attr_name: str) -> str:
        return attr_name.upper()

    def _find(self, name: object, *, waits: bool = True) -> ResolvedParameter | None:
        """Return a parameter, or None if it is unknown. With ``waits``, a parameter not yet received is requested."""
        if not isinstance(name, str):
            return None
        name = name.upper()
        has_all = self._has_all_values  # Read before `find`, because the last value may arrive during `find`.
        resolved = self._values.find(name)
        if resolved is None and waits:
            may_exist = not has_all and _is_valid_name(name)
            if may_exist:
                self._core.run(self._wait_for, name)
                resolved = self._values.find(name)
        return resolved

    @property
    def _has_all_values(self) -> bool:
        return self._download.is_complete and self._count <= len(self._values)

    async def _wait_for(self, name: str) -> None:
        with anyio.move_on_after(WAIT_TIMEOUT_S) as waiting:
            await self._download.wait_for(name)
        self._core.aio.connection.raise_if_ended()
        if waiting.cancelled_caught:
            raise TimeoutError(f"wait_ready experienced a timeout after {WAIT_TIMEOUT_S:.0f} seconds.")

    def known_values(self) -> dict[str, float]:
        """Return the known values without waiting."""
        return self._values.copy()

    def _start(self) -> None:
        self._core.aio.connection.bus.attach_event(ParameterChanged, weak_callback(self._on_changed))
        self._download.begin()

    def _on_value(self, message: ParamValue) -> None:
        # vehicle.aio.parameters has already processed this message, and has the value with the right type.
        self._count = message.param_count
        self._store(message.param_id)

    def _on_changed(self, event: ParameterChanged) -> None:
        # The event reports the values of all downloads, even of those that the program started with vehicle.aio.
        if event.system_id == self._core.target_system:
            self._store(event.name)

    def _store(self, name: str) -> None:
        parameter = self._core.aio.parameters.known(name)
        if parameter is not None and self._values.store(parameter):
            self._dk_listeners.notify(parameter.name.upper(), float(parameter.value), cache=True)

    def _store_all(self, table: ParameterTable) -> None:
        for name in table:
            self._store(name)
        self._download.is_complete = True
        self._core.listeners.notify("parameters", self)


def _upper_name(name: str) -> str:
    if not isinstance(name, str):
        raise InvalidArgument(f"parameter name = {name!r} is not a string")
    return name.upper()


def _key_error_text(name: str) -> str:
    from aerokit.parameters.renames import replacement_of

    replacement = replacement_of(name)
    return f"{name}: replaced by {replacement}" if replacement else name


def _is_valid_name(name: str) -> bool:
    try:
        check_name(name)
    except InvalidArgument:
        return False
    return True
