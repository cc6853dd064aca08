"""``ParameterCache``: parameter lists on disk, one file a vehicle, current as long as the vehicle's hash says so."""

from __future__ import annotations

import contextlib
import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from aerokit.parameters import Parameter, ParameterTable, ParameterType

if TYPE_CHECKING:
    from aerokit.autopilots.version import AutopilotVersion

__all__ = ["ParameterCache", "default_directory"]

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
