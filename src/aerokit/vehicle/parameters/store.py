"""``ParameterStore``: the last known parameters of a vehicle, kept current by every PARAM_VALUE."""

from __future__ import annotations

import contextlib
import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from aerokit.events import LinkRestored, ParameterChanged
from aerokit.mavlink.messages import ParamValue
from aerokit.parameters import Parameter, ParameterTable, ParameterType
from aerokit.parameters.encoding import parameter_of
from aerokit.parameters.pack import HASH_NAME
from aerokit.parameters.parameter import MAX_PARAMETERS, same_value
from aerokit.protocols.parameter_list import merge_update

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.autopilots.telemetry import AutopilotVersion
    from aerokit.connection.bus import Detach
    from aerokit.vehicle.session.transfers import Transfers

# Seconds in which messages with the previous value may still arrive after a write.
STALE_VALUE_S = 1.0


class StaleValue(NamedTuple):
    """Value of a parameter before its last write, and the time until which messages with this value are ignored."""

    value: int | float
    ignored_until: float


class ParameterStore:
    """The known parameters by name. Publishes :class:`ParameterChanged` when a known value changes."""

    def __init__(self, transfers: Transfers, read_later: Callable[[str, float], None]) -> None:
        self._transfers = transfers
        self._read_later = read_later  # schedules a background read of a parameter at a given time
        self._known: dict[str, Parameter] = {}
        # The known parameters as a table, built when it is needed; None after a change.
        self._table: ParameterTable | None = ParameterTable()
        # True once the whole list has arrived since the vehicle started, and since the link was last reopened.
        self.is_complete: bool = False
        # Increased by each value that arrives in a message, and by each reboot.
        self.updates: int = 0
        self._updates_at_forget = 0  # value of `updates` after the last call of `forget`
        # Number of parameters according to the last message. ArduPilot may show and hide parameters at any time.
        self.count: int | None = None
        # Maps each name to the value of `updates` at the last message with this parameter.
        self._last_updates: dict[str, int] = {}
        self._stale: dict[str, StaleValue] = {}
        self._was_bytewise = False  # value of `bytewise` when the last message was decoded

    @property
    def table(self) -> ParameterTable:
        if self._table is None:
            self._table = ParameterTable(self._known.values())
        return self._table

    @property
    def bytewise(self) -> bool:
        """True if integers are sent as bytes instead of converted to float."""
        transfers = self._transfers
        return transfers.autopilot.encodes_parameters_bytewise(transfers.known_capabilities)

    def get(self, name: str) -> Parameter | None:
        return self._known.get(name)

    def __contains__(self, name: object) -> bool:
        return name in self._known

    def set_stale(self, name: str, value: float) -> None:
        """For ``STALE_VALUE_S`` seconds, ignore messages with this value, which the parameter had before a write."""
        # ArduPilot answers PARAM_SET at once, but PARAM_REQUEST_READ up to 0.1 s after it read the value. An answer
        # with the old value may therefore arrive after the confirmation of the write. Another station may instead have
        # restored the old value, so the parameter is read after each ignored message.
        self._stale[name] = StaleValue(value, self._transfers.connection.now() + STALE_VALUE_S)

    def clear_stale(self, name: str) -> None:
        """Undo `set_stale` before a new write, which may set the parameter to the same value again."""
        self._stale.pop(name, None)

    def stale_value(self, name: str) -> StaleValue | None:
        """Return the value that `set_stale` has set, or None if there is none or its time is over."""
        stale = self._stale.get(name)
        return stale if stale is not None and self._transfers.connection.now() < stale.ignored_until else None

    def attach(self) -> list[Detach]:
        transfers, bus = self._transfers, self._transfers.connection.bus
        return [
            bus.attach(ParamValue, self._on_param_value, system_id=transfers.system_id),
            bus.attach_event(LinkRestored, self._on_link_restored),
            transfers.version_cell.observe(lambda _, __: self._on_version()),
        ]

    def forget(self) -> None:
        self.updates += 1
        self._updates_at_forget = self.updates
        self._known.clear()
        self._last_updates.clear()
        self._stale.clear()
        self._table = None
        self.is_complete = False
        self.count = None

    def replace(self, table: ParameterTable, *, updates_before: int) -> None:
        """Replace all parameters by a downloaded list.

        ``updates_before`` is the value of ``updates`` when the list was requested. Messages that arrived later take
        precedence over the list. If the vehicle has rebooted since, the list is ignored.
        """
        # If the vehicle has rebooted since the request, it may have other values.
        if updates_before < self._updates_at_forget:
            return
        newer_names = {name for name, last_update in self._last_updates.items() if last_update > updates_before}
        old, self._known = self._known, {}
        for name, parameter in table.items():
            if name in old and name in newer_names:
                parameter = merge_update(parameter, old[name], self.bytewise)
            self._known[name] = parameter
        for name in newer_names - self._known.keys():
            self._known[name] = old[name]
        self._table = None
        self.is_complete = True
        for name, parameter in self._known.items():
            self._publish(old.get(name), parameter)

    def _on_link_restored(self, event: LinkRestored) -> None:
        # Messages about changes were missed, and the link may lead to another vehicle.
        self.is_complete = False

    def _on_version(self) -> None:
        # The capabilities may show that the known integers were decoded in the wrong way.
        if self._known and self.bytewise != self._was_bytewise:
            self.forget()

    def _on_param_value(self, message: ParamValue) -> None:
        frame = message.received_frame
        if frame is None or frame.component_id != self._transfers.component_id:
            return
        if message.param_id in ("", HASH_NAME):
            return  # The hash is sent like a parameter, but is not one.
        bytewise = self._was_bytewise = self.bytewise
        received = parameter_of(message, bytewise)
        name, old = received.name, self._known.get(received.name)
        if old is None and len(self._known) >= MAX_PARAMETERS:
            return  # A faulty vehicle may send new names without end.
        stale = self.stale_value(name)
        has_changed = old is not None and not same_value(received.value, old.value)
        if has_changed and stale is not None:
            # This message is from before the last write, or another station has written the parameter.
            self._read_later(name, stale.ignored_until)
            if same_value(received.value, stale.value):
                return
        new = received if old is None else merge_update(old, received, bytewise)
        self._known[name] = new
        self._table = None
        self.updates += 1
        self.count = message.param_count
        self._last_updates[name] = self.updates
        self._publish(old, new)

    def _publish(self, old: Parameter | None, new: Parameter) -> None:
        if old is None or same_value(old.value, new.value):
            return
        transfers, now = self._transfers, self._transfers.connection.now()
        event = ParameterChanged(now, transfers.system_id, new.name, old.value, new.value, transfers.component_id)
        transfers.connection.bus.publish(event)


CACHE_FORMAT = 1


def default_directory() -> Path:
    """Return the directory of the cache: ``~/.cache/aerokit/parameters``, or its equivalent on other systems."""
    xdg_cache_home = os.environ.get("XDG_CACHE_HOME", "")
    # An absolute path in this variable takes precedence (https://specifications.freedesktop.org/basedir-spec).
    if os.path.isabs(xdg_cache_home):
        base = Path(xdg_cache_home)
    elif sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = Path.home() / ".cache"
    return base / "aerokit" / "parameters"


class ParameterCache:
    """Cached parameter lists of vehicles in one directory. Files that cannot be read or written are ignored."""

    def __init__(self, directory: str | os.PathLike[str] | None = None) -> None:
        self.directory: Path = default_directory() if directory is None else Path(directory)

    def load(self, vehicle: str, hash_: int) -> ParameterTable | None:
        try:
            content = json.loads(self._path(vehicle).read_text(encoding="utf-8"))
            if (content["format"], content["vehicle"], content["hash"]) != (CACHE_FORMAT, vehicle, hash_):
                return None
            return ParameterTable(_parameter(row, i) for i, row in enumerate(content["parameters"]))
        except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError):
            return None  # The file is missing, unreadable or damaged.

    def save(self, vehicle: str, hash_: int, table: ParameterTable) -> None:
        """Replace the cached list of a vehicle atomically. If the file cannot be written, do nothing."""
        rows = [[param.name, param.value, int(param.type), param.default] for param in table.values()]
        content = {"format": CACHE_FORMAT, "vehicle": vehicle, "hash": hash_, "parameters": rows}
        path = self._path(vehicle)
        temporary = path.with_suffix(f".{os.getpid()}.tmp")
        with contextlib.suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                temporary.write_text(json.dumps(content), encoding="utf-8")
                temporary.replace(path)
            finally:
                temporary.unlink(missing_ok=True)

    def _path(self, vehicle: str) -> Path:
        return self.directory / f"{vehicle}.json"


def vehicle_key(autopilot: str, system_id: int, version: AutopilotVersion | None) -> str:
    # Without a hardware id, the system id identifies the vehicle.
    unit = f"uid-{version.uid:016x}" if version is not None and version.uid else f"system-{system_id}"
    firmware = "unknown" if version is None else f"{version.firmware}-{version.git_hash}"
    key = f"{autopilot}-{unit}-{firmware}"
    return "".join(char if char.isalnum() or char in "-." else "_" for char in key)


def _parameter(row: list[Any], index: int) -> Parameter:
    name, value, type_, default = row
    is_default_valid = default is None or isinstance(default, (int, float))
    if not isinstance(name, str) or not isinstance(value, (int, float)) or not is_default_valid:
        raise ValueError("the row has no name, no number, or a default that is no number")
    kind = ParameterType(type_)
    return Parameter(name, int(value) if kind.is_integer else float(value), kind, default, index)
