"""What is known about parameters beside their values: descriptions, units, ranges, names of values and of bits.

Vehicles tell little of it; it comes in files, and :func:`load_metadata` reads those of both autopilots:

- ArduPilot: ``apm.pdef.xml`` or ``apm.pdef.json`` from ``https://autotest.ardupilot.org/Parameters/ArduCopter/``
  (``ArduPlane``, ``Rover``, ``ArduSub``, ``AntennaTracker``, ``Blimp``); of each release from
  https://github.com/ArduPilot/ParameterRepository (``Copter-4.6/apm.pdef.json`` …).
- PX4: ``parameters.json.xz`` from the vehicle itself by MAVFTP (COMPONENT_METADATA names its general metadata, which
  names this file: ``mftp://etc/extras/parameters.json.xz``), or ``build/<target>/parameters.json``,
  ``parameters.json.xz`` and ``parameters.xml`` where the firmware was built.

https://mavlink.io/en/services/component_information.html
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator, Mapping
from types import MappingProxyType

from aerokit.errors import FileFormatError, InvalidArgument
from aerokit.snapshot import Snapshot
from aerokit.whole_file import read_bounded, unpacked

__all__ = ["Metadata", "ParameterMetadata", "load_metadata", "parse_metadata"]

_NOTHING: Mapping[float, str] = MappingProxyType({})
_NO_BITS: Mapping[int, str] = MappingProxyType({})


class ParameterMetadata(Snapshot):
    """What is known about one parameter; None and empty where the file says nothing.

    ``values`` names single values, ``bitmask`` bits (by number, from 0). ``minimum`` and ``maximum`` are what its
    authors recommend; vehicles take other values, too. A ``volatile`` one is changed by the vehicle itself.
    """

    name: str
    short_description: str = ""
    description: str = ""
    unit: str = ""
    minimum: float | None = None
    maximum: float | None = None
    increment: float | None = None
    default: float | None = None
    values: Mapping[float, str] = _NOTHING
    bitmask: Mapping[int, str] = _NO_BITS
    reboot_required: bool = False
    decimal_places: int | None = None
    group: str = ""
    category: str = ""
    read_only: bool = False
    volatile: bool = False

    def describe(self, value: float) -> str:
        """A value in words: its name, the names of its bits, or the number with its unit."""
        if value in self.values:
            return self.values[value]
        if self.bitmask and 0 <= value < math.inf and value == int(value):
            bits = [bit for bit in range(64) if int(value) >> bit & 1]
            return ", ".join(self.bitmask.get(bit, f"bit {bit}") for bit in bits) or "none"
        return f"{value:g} {self.unit}".rstrip()

    def complaint(self, value: float) -> str | None:
        """Why the value is not one that the authors recommend, or None."""
        if self.read_only:
            return f"{self.name} can only be read"
        low, high = self.minimum, self.maximum
        inside = (low is None or value >= low) and (high is None or value <= high)
        if value in self.values or inside:
            return None
        bounds = f"{'' if low is None else f'{low:g}'}..{'' if high is None else f'{high:g}'}"
        return f"{self.name} = {value:g} is not in {bounds} {self.unit}".rstrip()

    def __hash__(self) -> int:
        return hash(self.name)


class Metadata(Mapping[str, ParameterMetadata]):
    """Name → :class:`ParameterMetadata`, of one vehicle type and version; of several with a name the first counts."""

    __slots__ = ("_by_name",)

    def __init__(self, parameters: Iterable[ParameterMetadata] = ()) -> None:
        self._by_name: dict[str, ParameterMetadata] = {}
        for each in parameters:
            self._by_name.setdefault(each.name, each)

    def __getitem__(self, name: str) -> ParameterMetadata:
        return self._by_name[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._by_name)

    def __len__(self) -> int:
        return len(self._by_name)

    def __repr__(self) -> str:
        return f"<Metadata of {len(self)} parameters>"

    @property
    def volatile(self) -> frozenset[str]:
        """Names of the parameters that the vehicle changes by itself; PX4's hash leaves them out."""
        return frozenset(each.name for each in self._by_name.values() if each.volatile)

    def reboot_required(self, names: Iterable[str]) -> tuple[str, ...]:
        """Those of the names whose change takes effect at the next start only."""
        return tuple(name for name in names if name in self and self[name].reboot_required)

    def check(self, name: str, value: float) -> None:
        """Raise :class:`InvalidArgument` for a value outside the recommended range; unknown names pass."""
        if math.isnan(value):
            raise InvalidArgument(f"{name} = {value!r} is not a number")
        complaint = self[name].complaint(value) if name in self else None
        if complaint:
            raise InvalidArgument(complaint)


def load_metadata(path: str | os.PathLike[str]) -> Metadata:
    """Read a file of either autopilot, XML or JSON, compressed (``.xz``) or not; see above for where they are.

    Raises :class:`FileFormatError` when it is none of these or has more than 16 MB (unpacked, too),
    OSError when it cannot be read. Of a parameter that stands in the file several times, for frame types that do not
    exist together, the first counts.
    """
    return parse_metadata(read_bounded(path), os.fspath(path))


def parse_metadata(data: bytes, source: str = "metadata") -> Metadata:
    """The same of bytes; ``source`` is their name in errors."""
    from aerokit.parameters import metadata_formats

    try:
        found = metadata_formats.parse(unpacked(data, source))
    except FileFormatError:
        raise
    except (ValueError, SyntaxError, TypeError, AttributeError, LookupError, RecursionError) as error:
        raise FileFormatError(
            f"{source} is no apm.pdef.xml, apm.pdef.json, parameters.xml or parameters.json: {error}"
        ) from None
    if not found:
        raise FileFormatError(f"{source} describes no parameters")
    return Metadata(found)
