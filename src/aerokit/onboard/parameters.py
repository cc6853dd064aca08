"""``ComponentParameters``: typed parameters with ranges and metadata, served by PARAM and PARAM_EXT."""

from __future__ import annotations

import asyncio
import inspect
import json
import logging
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from aerokit._internal.arguments import checks_arguments
from aerokit._internal.files import read_text, write_atomically
from aerokit.errors import FileFormatError, InvalidArgument
from aerokit.mavlink.enums import MavParamError, MavParamExtType, MavSeverity, ParamAck
from aerokit.parameters import Parameter, ParameterMetadata, ParameterType, check_name
from aerokit.parameters.encoding import UNKNOWN_INDEX, value_message, value_of
from aerokit.parameters.parameter import checked_setting, setting_value, settings_equal, to_float32
from aerokit.protocols.servers.host import sender_of
from aerokit.protocols.servers.parameters import ExtendedParameterServer, ParameterProtocolServer

if TYPE_CHECKING:
    from aerokit.mavlink import messages as m
    from aerokit.onboard.host import ComponentHost
    from aerokit.protocols.servers.host import Channel

logger: logging.Logger = logging.getLogger("aerokit")

LIST_RATE_HZ = 200.0
MAX_COMPONENT_PARAMETERS = 1000
MAX_LISTS = 8
"""Maximum number of lists that a component sends at once; it ignores further requests."""

ParameterValue = int | float | str
OnSet = Callable[[ParameterValue], object]

_TYPES: dict[type, MavParamExtType] = {
    int: MavParamExtType.INT32,
    float: MavParamExtType.REAL32,
    str: MavParamExtType.CUSTOM,
}


class _Row:
    """One parameter: its metadata, type, default, value, and the function that may refuse a value."""

    def __init__(self, metadata: ParameterMetadata, type_: MavParamExtType, default: ParameterValue) -> None:
        self.metadata = metadata
        self.type = type_
        self.default = default
        self.value = default
        self.on_set: OnSet | None = None


@checks_arguments
class ComponentParameters(Mapping[str, ParameterValue]):
    """Parameters of a component, a mapping of names to values. Other programs read and set them by MAVLink.

    PARAM serves numbers, PARAM_EXT numbers and strings. A value that is out of range, of another type, or refused by
    ``on_set`` is not stored. PARAM_ERROR or PARAM_EXT_ACK then reports the reason to the sender.
    """

    def __init__(self, host: ComponentHost, path: Path | None, *, bytewise: bool) -> None:
        self._host, self._path = host, path
        self._rows: dict[str, _Row] = {}
        self._numeric_names: list[str] = []  # names of parameters that are numbers; PARAM_VALUE carries no strings
        self._stored: dict[str, Any] = _read_stored(path)  # values that were in the file at the start
        self._is_dirty = False  # True if the file does not contain the last change
        self._save_task: asyncio.Task[None] | None = None  # None while the file is not being written
        self._param_server = _ParameterServer(host, self, bytewise=bytewise)
        self._param_ext_server: _ExtendedServer | None = None
        self._has_camera_settings = False

    def add(
        self,
        name: str,
        default: int | float | str,
        *,
        minimum: float | None = None,
        maximum: float | None = None,
        unit: str = "",
        description: str = "",
        values: Mapping[float, str] | None = None,
        read_only: bool = False,
        reboot_required: bool = False,
        on_set: Callable[..., object] | None = None,
    ) -> None:
        """Add a parameter with the type of ``default``: int (32 bits), float (32 bits) or str (128 bytes).

        Args:
            name: 1 to 16 ASCII characters without spaces.
            default: value until another program or :meth:`set` changes it. A value in the parameters file takes
                precedence.
            minimum: minimum of a number; None means the minimum of the type.
            maximum: maximum of a number; None means the maximum of the type.
            unit: unit for the metadata, such as ``"m/s"``.
            description: description for the metadata.
            values: maps each allowed number to its name; other numbers are refused.
            read_only: True if only this program can change it.
            reboot_required: True if a change takes effect only after a reboot; reported in the metadata.
            on_set: plain function, called on the event loop with a value that another program sets, before the value is
                stored. To refuse the value, this function raises InvalidArgument.

        Raises:
            InvalidArgument: the name is invalid or in use, the default or ``on_set`` is not allowed, or the component
                already has 1000 parameters.
        """
        self._check_addition(name, default, on_set)
        metadata = ParameterMetadata(
            name,
            short_description=description,
            unit=unit,
            minimum=_rounded_limit(minimum, default),
            maximum=_rounded_limit(maximum, default),
            default=None if isinstance(default, str) else default,
            values={} if values is None else dict(values),
            reboot_required=reboot_required,
            read_only=read_only,
        )
        row = _Row(metadata, _TYPES[type(default)], default)
        row.default = self._checked(row, default)
        row.value = row.default
        row.on_set = on_set
        if name in self._stored and not read_only:
            try:
                row.value = self._checked(row, self._stored[name])
            except InvalidArgument as error:
                logger.warning("%s: the default is used instead of the stored value: %s", self._path, error)
        self._rows[name] = row
        if row.type != MavParamExtType.CUSTOM:
            self._numeric_names.append(name)
        # Create the server only when the first parameter is added, because a component without parameters may use
        # PARAM_EXT for the settings of a camera.
        if self._param_ext_server is None:
            self._param_ext_server = _ExtendedServer(self._host, self)

    def _forbid_parameters(self) -> None:
        """Refuse :meth:`add` from now on. Raise InvalidArgument if there are parameters already."""
        # The settings of a camera definition need PARAM_EXT for themselves.
        if self._rows:
            raise InvalidArgument("a component cannot have both parameters and the settings of a camera definition")
        self._has_camera_settings = True

    def _check_addition(self, name: str, default: object, on_set: Callable[..., object] | None) -> None:
        if inspect.iscoroutinefunction(on_set):
            raise InvalidArgument("on_set must be a plain function, because the value is answered at once")
        check_name(name)
        if self._has_camera_settings:
            raise InvalidArgument("a component cannot have both parameters and the settings of a camera definition")
        if name in self._rows:
            raise InvalidArgument(f"this component already has a parameter {name}")
        if len(self._rows) >= MAX_COMPONENT_PARAMETERS:
            raise InvalidArgument(f"a component has at most {MAX_COMPONENT_PARAMETERS} parameters")
        if isinstance(default, bool) or type(default) not in _TYPES:
            raise InvalidArgument(
                f"default = {default!r} of {name} is not allowed: it must be an int, a float or a str"
            )

    def set(self, name: str, value: int | float | str) -> None:
        """Change a value, and announce it to other programs. ``on_set`` is not called.

        Raises:
            InvalidArgument: there is no such parameter, or the value is not allowed.
        """
        row = self._row(name)
        self._store(row, self._checked(row, value))
        if name in self._numeric_names:
            self._param_server.send(name, self._numeric_names.index(name), None)

    def metadata(self, name: str) -> ParameterMetadata:
        """Return unit, range and description of a parameter; raise InvalidArgument if there is no such parameter."""
        return self._row(name).metadata

    def __getitem__(self, name: str) -> ParameterValue:
        return self._rows[name].value

    def __iter__(self) -> Iterator[str]:
        return iter(self._rows)

    def __len__(self) -> int:
        return len(self._rows)

    def _row(self, name: str) -> _Row:
        if name not in self._rows:
            raise InvalidArgument(
                f"this component has no parameter {name!r}; it has: {', '.join(self._rows) or 'none'}"
            )
        return self._rows[name]

    def _checked(self, row: _Row, value: object) -> ParameterValue:
        metadata, name = row.metadata, row.metadata.name
        if isinstance(value, bool):
            raise InvalidArgument(f"{name} = {value!r} is not allowed: a parameter cannot be a bool")
        checked = checked_setting(name, value, row.type)
        if isinstance(checked, str):
            return checked
        if isinstance(checked, bytes):
            raise InvalidArgument(f"{name} = {value!r} is not allowed: it must be a text")
        if metadata.values and checked not in metadata.values:
            raise InvalidArgument(
                f"{name} = {checked} is not allowed: it must be one of {', '.join(map(str, metadata.values))}"
            )
        # Leave out two checks of `problem`. The allowed values were checked above, and this program may change
        # read-only parameters.
        problem = metadata.replace(read_only=False, values={}).problem(checked)
        if problem is not None:
            raise InvalidArgument(problem)
        return checked

    def _refusal(self, row: _Row, value: object, type_: int) -> _Refusal | None:
        """Return the reason if a value of another program must not be stored, otherwise None."""
        if row.metadata.read_only:
            return _Refusal(MavParamError.READ_ONLY, ParamAck.FAILED)
        if type_ != row.type:
            return _Refusal(MavParamError.TYPE_MISMATCH, ParamAck.VALUE_UNSUPPORTED)
        try:
            checked = self._checked(row, value)
            if row.on_set is not None:
                row.on_set(checked)  # The program's function refuses a value by an exception.
        except InvalidArgument as error:
            self._host.send_text(MavSeverity.WARNING, str(error))
            return _Refusal(MavParamError.VALUE_OUT_OF_RANGE, ParamAck.VALUE_UNSUPPORTED)
        except Exception as error:
            self._host.report_error(row.metadata.name, error)
            return _Refusal(MavParamError.VALUE_OUT_OF_RANGE, ParamAck.FAILED)
        return None

    def _store(self, row: _Row, value: ParameterValue) -> bool:
        """Store an allowed value. Return False if it is the present value."""
        if settings_equal(row.value, value):
            return False
        row.value = value
        if self._path is not None:
            self._is_dirty = True
            if self._save_task is None:  # A running task writes the file again.
                self._save_task = asyncio.get_running_loop().create_task(self._save(self._path))
        return True

    def _file_text(self) -> str:
        values = {name: row.value for name, row in self._rows.items() if not row.metadata.read_only}
        return json.dumps({**self._stored, **values}, indent=1) + "\n"

    async def _save(self, path: Path) -> None:
        try:
            while self._is_dirty:
                self._is_dirty = False
                write = partial(write_atomically, path, self._file_text())
                # A thread writes the file, because memory cards are slow.
                await asyncio.get_running_loop().run_in_executor(None, write)
        except OSError as error:
            self._is_dirty = True
            logger.error("the parameters of the component could not be saved: %s", error)
            self._host.send_text(MavSeverity.ERROR, f"parameters could not be saved: {error.strerror or error}")
        finally:
            self._save_task = None

    async def aclose(self) -> None:
        """Wait until the file contains the last change. A failed write is tried once more."""
        if self._save_task is not None:
            await self._save_task
        if self._is_dirty and self._path is not None:
            self._save_task = asyncio.get_running_loop().create_task(self._save(self._path))
            await self._save_task

    def json(self) -> bytes:
        """Return the parameter metadata file (https://mavlink.io/en/services/component_information.html)."""
        rows = [row for row in self._rows.values() if row.type != MavParamExtType.CUSTOM]
        return json.dumps({"version": 1, "parameters": [_metadata_entry(row) for row in rows]}).encode()


class _Refusal(NamedTuple):
    """Reason why a value is not stored: a MAV_PARAM_ERROR, and the PARAM_ACK for the extended protocol."""

    error: MavParamError
    ack: ParamAck


class _ParameterServer(ParameterProtocolServer):
    """PARAM server of a component. It encodes values bytewise or casts them to float.

    A refused PARAM_SET is answered with PARAM_ERROR, and with PARAM_VALUE (the unchanged value) for clients that do not
    know PARAM_ERROR. Texts do not fit into PARAM_VALUE, and are left out.
    """

    def __init__(self, host: ComponentHost, parameters: ComponentParameters, *, bytewise: bool) -> None:
        self._parameters, self._bytewise = parameters, bytewise
        super().__init__(host, self, list_rate_hz=LIST_RATE_HZ)

    @property
    def names(self) -> list[str]:
        return self._parameters._numeric_names

    def value_message(self, name: str, index: int) -> m.ParamValue:
        row = self._parameters._rows[name]
        assert isinstance(row.value, (int, float))
        position = None if index == UNKNOWN_INDEX else index
        parameter = Parameter(name, row.value, ParameterType(row.type), index=position)
        return value_message(parameter, len(self.names), bytewise=self._bytewise)

    def _on_list(self, request: m.ParamRequestList, channel: Channel) -> None:
        if channel in self._lists or len(self._lists) < MAX_LISTS:
            self.start_list(channel)

    def _on_read(self, request: m.ParamRequestRead, channel: Channel) -> None:
        name, index = request.param_id, request.param_index
        if not self.send_requested(name, index, channel):
            unknown_name = name if index < 0 else ""
            self.send_error(sender_of(request), unknown_name, index, MavParamError.DOES_NOT_EXIST, channel)

    def _on_set(self, request: m.ParamSet, channel: Channel) -> None:
        name, names, parameters = request.param_id, self.names, self._parameters
        if name not in names:
            self.send_error(sender_of(request), name, -1, MavParamError.DOES_NOT_EXIST, channel)
            return
        row = parameters._rows[name]
        value = value_of(request, bytewise=self._bytewise)
        # If values are cast to float, the received type is ignored: ArduPilot's clients send all values as REAL32.
        refusal = parameters._refusal(row, value, request.param_type if self._bytewise else row.type)
        if refusal is not None:
            self.send_error(sender_of(request), name, names.index(name), refusal.error, channel)
            self.send(name, names.index(name), channel)
            return
        is_changed = parameters._store(row, parameters._checked(row, value))
        # A changed value is sent to all programs.
        self.send(name, names.index(name), None if is_changed else channel)


class _ExtendedServer(ExtendedParameterServer):
    """PARAM_EXT server of a component, including texts."""

    def __init__(self, host: ComponentHost, parameters: ComponentParameters) -> None:
        self._rows, self._parameters = parameters._rows, parameters
        super().__init__(host, self)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self._rows)

    def value(self, name: str) -> tuple[ParameterValue, int]:
        return self._rows[name].value, self._rows[name].type

    def __contains__(self, name: object) -> bool:
        return name in self._rows

    def set(self, name: str, data: bytes, kind: int) -> int:
        row, value = self._rows[name], setting_value(data, kind)
        if isinstance(row.value, str) and value == b"":  # An empty text and empty bytes are the same on the wire.
            value = ""
        refusal = self._parameters._refusal(row, value, kind)
        if refusal is not None:
            return refusal.ack
        self._parameters._store(row, self._parameters._checked(row, value))
        return ParamAck.ACCEPTED


def _rounded_limit(limit: float | None, default: ParameterValue) -> float | None:
    # Values are rounded to 32 bits. Limits are rounded as well, because a rounded value may be beyond the exact limit.
    return to_float32(limit) if limit is not None and isinstance(default, float) else limit


def _metadata_entry(row: _Row) -> dict[str, Any]:
    metadata = row.metadata
    entry: dict[str, Any] = {
        "name": metadata.name,
        "type": "Int32" if row.type == MavParamExtType.INT32 else "Float",
        "default": row.default,
        "shortDesc": metadata.short_description or metadata.name,
        "units": metadata.unit,
        "min": metadata.minimum,
        "max": metadata.maximum,
        "rebootRequired": metadata.reboot_required,
        "values": [{"value": value, "description": text} for value, text in metadata.values.items()],
    }
    return {key: value for key, value in entry.items() if value not in (None, "", [])}


def _read_stored(path: Path | None) -> dict[str, Any]:
    if path is None or not path.exists():
        return {}
    try:
        content = json.loads(read_text(path))
    except ValueError as error:
        raise FileFormatError(f"{path} is not a parameter file: {error}") from None
    if not isinstance(content, dict):
        raise FileFormatError(f"{path} is not a parameter file: its content is not a JSON object")
    return content
