"""``ParameterStore``: what is known of a vehicle's parameters, kept up to date by every PARAM_VALUE."""

from __future__ import annotations

import contextlib
import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from aerokit.events import ParameterChanged
from aerokit.mavlink.messages import ParamValue
from aerokit.parameters import Parameter, ParameterTable, ParameterType
from aerokit.parameters.encoding import parameter_of
from aerokit.parameters.pack import HASH_NAME
from aerokit.parameters.parameter import MOST_PARAMETERS, same_value
from aerokit.protocols.parameter_list import updated

if TYPE_CHECKING:
    from aerokit.autopilots.telemetry import AutopilotVersion
    from aerokit.connection.bus import Detach
    from aerokit.vehicle.session.transfers import Transfers

UNDER_WAY_S = 1.0


class ParameterStore:
    """Name → parameter. Publishes :class:`ParameterChanged` when a value that was known becomes another one."""

    updates: int

    def __init__(self, transfers: Transfers) -> None:
        self._transfers = transfers
        self._known: dict[str, Parameter] = {}
        self._table: ParameterTable | None = ParameterTable()
        self.is_complete: bool = False
        """Whether the whole list has come since the vehicle started."""
        self.updates = 0
        """Counts the values that have come in messages."""
        self.count: int | None = None
        """How many there are by the last message; the vehicle may show and hide some at any time."""
        self._updated_at: dict[str, int] = {}
        self._replaced: dict[str, tuple[int | float, float]] = {}

    @property
    def table(self) -> ParameterTable:
        """All that is known, as a value."""
        if self._table is None:
            self._table = ParameterTable(self._known.values())
        return self._table

    @property
    def bytewise(self) -> bool:
        """How integers travel."""
        transfers = self._transfers
        return transfers.autopilot.encodes_parameters_bytewise(transfers.known_capabilities)

    def get(self, name: str) -> Parameter | None:
        """What is known of one of them."""
        return self._known.get(name)

    def __contains__(self, name: object) -> bool:
        return name in self._known

    def distrust(self, name: str, value: float) -> None:
        """This value has just been replaced: a message that still tells it was under way, and does not count.

        ArduPilot answers PARAM_SET at once, but reads up to a tenth of a second after it looked the value up.
        """
        self._replaced[name] = value, self._transfers.connection.now() + UNDER_WAY_S

    def trust(self, name: str) -> None:
        """Take whatever comes: it is being written."""
        self._replaced.pop(name, None)

    def distrusted(self, name: str) -> int | float | None:
        """The value that it had a moment ago."""
        value, until = self._replaced.get(name, (0, 0.0))
        return value if self._transfers.connection.now() < until else None

    def attach(self) -> Detach:
        """Begin to listen."""
        transfers = self._transfers
        return transfers.connection.bus.attach(ParamValue, self._take, system_id=transfers.system_id)

    def forget(self) -> None:
        """The vehicle has started anew: nothing is known."""
        self._known.clear()
        self._updated_at.clear()
        self._replaced.clear()
        self._table, self.is_complete, self.count = None, False, None

    def replace(self, table: ParameterTable, *, since: int) -> None:
        """Take a whole list that was begun when ``updates`` was ``since``; messages that came later are newer."""
        newer = {name for name, at in self._updated_at.items() if at > since}
        before, self._known = self._known, {}
        for name, parameter in table.items():
            known = before.get(name)
            if known is not None and name in newer:
                parameter = updated(parameter, known, self.bytewise)
            self._known[name] = parameter
        for name in newer - self._known.keys():
            self._known[name] = before[name]
        self._table = None
        self.is_complete = True
        for name, parameter in self._known.items():
            self._publish(before.get(name), parameter)

    def _take(self, message: ParamValue) -> None:
        frame = message.received_frame
        if frame is None or frame.component_id != self._transfers.component_id:
            return
        if message.param_id == HASH_NAME or not message.param_id:
            return
        told = parameter_of(message, self.bytewise)
        known, old = self._known.get(told.name), self.distrusted(told.name)
        if known is None and len(self._known) >= MOST_PARAMETERS:
            return
        if known is not None and old is not None and same_value(told.value, old):
            return
        after = told if known is None else updated(known, told, self.bytewise)
        self._known[told.name], self._table = after, None
        self.updates += 1
        self.count = message.param_count
        self._updated_at[told.name] = self.updates
        self._publish(known, after)

    def _publish(self, before: Parameter | None, after: Parameter) -> None:
        if before is None or same_value(before.value, after.value):
            return
        transfers = self._transfers
        transfers.connection.bus.publish(
            ParameterChanged(
                transfers.connection.now(),
                transfers.system_id,
                after.name,
                before.value,
                after.value,
                transfers.component_id,
            )
        )


FORMAT = 1


def default_directory() -> Path:
    """Where caches of this user are kept: ``~/.cache/aerokit/parameters`` and its like on other systems.

    ``XDG_CACHE_HOME`` goes first where it is an absolute path (https://specifications.freedesktop.org/basedir-spec).
    """
    given = os.environ.get("XDG_CACHE_HOME", "")
    if os.path.isabs(given):
        base = Path(given)
    elif sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = Path.home() / ".cache"
    return base / "aerokit" / "parameters"


class ParameterCache:
    """The lists of vehicles in one directory. A file that cannot be read or written is as none."""

    def __init__(self, directory: str | os.PathLike[str] | None = None) -> None:
        self.directory: Path = default_directory() if directory is None else Path(directory)

    def load(self, vehicle: str, hash_: int) -> ParameterTable | None:
        """The list of this vehicle, if the one on disk has this hash."""
        try:
            content = json.loads(self._path(vehicle).read_text(encoding="utf-8"))
            if (content["format"], content["vehicle"], content["hash"]) != (FORMAT, vehicle, hash_):
                return None
            return ParameterTable(_parameter(row, i) for i, row in enumerate(content["parameters"]))
        except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError):
            return None

    def save(self, vehicle: str, hash_: int, table: ParameterTable) -> None:
        """Keep a list; a reader never sees half of it."""
        rows = [[each.name, each.value, int(each.type), each.default] for each in table.values()]
        content = {"format": FORMAT, "vehicle": vehicle, "hash": hash_, "parameters": rows}
        path = self._path(vehicle)
        beside = path.with_suffix(f".{os.getpid()}.tmp")
        with contextlib.suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            beside.write_text(json.dumps(content), encoding="utf-8")
            beside.replace(path)

    def _path(self, vehicle: str) -> Path:
        return self.directory / f"{vehicle}.json"


def vehicle_key(autopilot: str, system_id: int, version: AutopilotVersion | None) -> str:
    """What a vehicle's file is called: its hardware's id, or else its system id, and its firmware."""
    unit = f"uid-{version.uid:016x}" if version is not None and version.uid else f"system-{system_id}"
    firmware = "unknown" if version is None else f"{version.firmware}-{version.git_hash}"
    kept = (each if each.isalnum() or each in "-." else "_" for each in f"{autopilot}-{unit}-{firmware}")
    return "".join(kept)


def _parameter(row: list[Any], index: int) -> Parameter:
    name, value, type_, default = row
    if not isinstance(name, str) or not isinstance(value, (int, float)):
        raise ValueError("not a parameter")
    kind = ParameterType(type_)
    return Parameter(name, int(value) if kind.is_integer else float(value), kind, default, index)
