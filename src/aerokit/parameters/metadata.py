"""Parameter metadata: descriptions, units, ranges, names of values and bits.

Vehicles send little metadata. :func:`load_metadata` reads the files of both autopilots:

- ArduPilot: ``apm.pdef.xml`` or ``apm.pdef.json`` from ``https://autotest.ardupilot.org/Parameters/ArduCopter/`` (or
  ``ArduPlane``, ``Rover``, ``ArduSub``, ``AntennaTracker``, ``Blimp``). The files of each release are in
  https://github.com/ArduPilot/ParameterRepository (``Copter-4.6/apm.pdef.json`` …).
- PX4: ``parameters.json.xz`` from the vehicle itself by MAVFTP (COMPONENT_METADATA names its general metadata, which
  names this file: ``mftp://etc/extras/parameters.json.xz``), or ``build/<target>/parameters.json``,
  ``parameters.json.xz`` and ``parameters.xml`` where the firmware was built.

https://mavlink.io/en/services/component_information.html

The format is recognised by the first character and the outermost names. Invalid numbers are ignored, because the files
contain hand-written ranges such as "0 10" and "-1,1".
"""

from __future__ import annotations

import json
import math
import os
import reprlib
from collections.abc import Iterable, Iterator, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from defusedxml import ElementTree as DefusedXml

from aerokit._internal.files import decompress, read_bounded
from aerokit._internal.values import Snapshot
from aerokit.errors import FileFormatError, InvalidArgument
from aerokit.parameters.encoding import number_or_none

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

_NO_VALUES: Mapping[float, str] = MappingProxyType({})

_NO_BITS: Mapping[int, str] = MappingProxyType({})


class ParameterMetadata(Snapshot):
    """Metadata of one parameter. Fields that the file does not define are None or empty.

    ``values`` maps single values to names, ``bitmask`` maps bits (numbered from 0) to names. ``minimum`` and
    ``maximum`` are recommendations; vehicles also accept other values. A ``volatile`` parameter is changed by the
    vehicle itself.
    """

    name: str
    short_description: str = ""
    description: str = ""
    unit: str = ""
    minimum: float | None = None
    maximum: float | None = None
    increment: float | None = None
    default: float | None = None
    values: Mapping[float, str] = _NO_VALUES
    bitmask: Mapping[int, str] = _NO_BITS
    reboot_required: bool = False
    decimal_places: int | None = None
    group: str = ""
    category: str = ""
    read_only: bool = False
    volatile: bool = False

    def describe(self, value: float) -> str:
        """Describe a value by its name, by the names of its bits, or as a number with its unit."""
        if value in self.values:
            return self.values[value]
        is_whole = 0 <= value < math.inf and value == int(value)
        if self.bitmask and is_whole:
            bits = [bit for bit in range(64) if int(value) >> bit & 1]
            return ", ".join(self.bitmask.get(bit, f"bit {bit}") for bit in bits) or "none"
        return f"{value:g} {self.unit}".rstrip()

    def problem(self, value: float) -> str | None:
        """Return the reason why a value is not recommended; None if it is recommended."""
        if self.read_only:
            return f"{self.name} can only be read"
        low, high = self.minimum, self.maximum
        is_inside = (low is None or value >= low) and (high is None or value <= high)
        has_range = low is not None or high is not None
        # If a range or bits are documented as well, the documented values do not exclude others.
        allows_other_values = has_range or not self.values or bool(self.bitmask)
        if value in self.values or (is_inside and allows_other_values):
            return None
        if not has_range:
            documented = ", ".join(f"{number:g} {text}" for number, text in self.values.items())
            return f"{self.name} = {value:g} is not a documented value: {documented}"
        lowest, highest = ("" if limit is None else f"{limit:g}" for limit in (low, high))
        return f"{self.name} = {value:g} is not in {lowest}..{highest} {self.unit}".rstrip()

    def __hash__(self) -> int:
        return hash(self.name)


class Metadata(Mapping[str, ParameterMetadata]):
    """Maps names to :class:`ParameterMetadata`, for one vehicle type and version.

    If a name occurs twice, the first definition counts.
    """

    __slots__ = ("_by_name",)

    def __init__(self, parameters: Iterable[ParameterMetadata] = ()) -> None:
        self._by_name: dict[str, ParameterMetadata] = {}
        for parameter in parameters:
            self._by_name.setdefault(parameter.name, parameter)

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
        """Names of the parameters that the vehicle changes itself. PX4's hash ignores them."""
        return frozenset(parameter.name for parameter in self._by_name.values() if parameter.volatile)

    def reboot_required(self, names: Iterable[str]) -> tuple[str, ...]:
        """Return the names of parameters whose changes take effect only after a reboot."""
        return tuple(name for name in names if name in self and self[name].reboot_required)

    def check(self, name: str, value: float) -> None:
        """Raise :class:`InvalidArgument` if the value is NaN, or outside the recommended range or values."""
        if math.isnan(value):
            raise InvalidArgument(f"{name} = {value!r} is not a number")
        problem = self[name].problem(value) if name in self else None
        if problem:
            raise InvalidArgument(problem)


def load_metadata(path: str | os.PathLike[str]) -> Metadata:
    """Read a metadata file of ArduPilot or PX4, XML or JSON, compressed (``.xz``) or not.

    If a parameter is defined several times, for different frame types, the first definition counts.

    Raises:
        FileFormatError: the file is not a metadata file, or has more than 16 MB (decompressed).
        OSError: the file cannot be read.
    """
    return parse_metadata(read_bounded(path), os.fspath(path))


def parse_metadata(data: bytes, source: str = "metadata") -> Metadata:
    """Parse the content of a metadata file. Error texts begin with ``source``."""
    try:
        parameters = _parse(decompress(data, source))
    except FileFormatError:
        raise
    except (ValueError, SyntaxError, TypeError, AttributeError, LookupError, RecursionError) as error:
        raise FileFormatError(
            f"{source} is not an apm.pdef.xml, apm.pdef.json, parameters.xml or parameters.json: {error}"
        ) from None
    if not parameters:
        raise FileFormatError(f"{source} defines no parameters")
    return Metadata(parameters)


_BITS = range(64)


def _parse(data: bytes) -> list[ParameterMetadata]:
    byte_order_mark = b"\xef\xbb\xbf"
    if data.lstrip(byte_order_mark + b" \t\r\n").startswith(b"<"):
        root = DefusedXml.fromstring(data, forbid_dtd=True)
        if root.tag == "paramfile":
            return list(_ardupilot_xml(root))
        if root.tag == "parameters":
            return list(_px4_xml(root))
        raise ValueError(f"its root element is <{root.tag}>")
    content = json.loads(data.decode("utf-8-sig"))
    if not isinstance(content, dict):
        raise ValueError("its content is not a JSON object")
    if isinstance(content.get("parameters"), list):
        return [_px4_entry(entry) for entry in content["parameters"]]
    return list(_ardupilot_json(content))


# ------------------------------------------------------------------------------------- ArduPilot
def _ardupilot_xml(root: Element) -> Iterator[ParameterMetadata]:
    for group in root.iter("parameters"):
        for param in group.iter("param"):
            fields = {field.get("name", ""): field.text or "" for field in param.iter("field")}
            low, high = _range(fields.get("Range", ""))
            yield ParameterMetadata(
                param.attrib["name"].rpartition(":")[2],  # without the vehicle type in "ArduCopter:RTL_SPEED"
                short_description=param.get("humanName", ""),
                description=param.get("documentation", ""),
                unit=fields.get("Units", ""),
                minimum=low,
                maximum=high,
                increment=number_or_none(fields.get("Increment")),
                values=_names_by_number((value.get("code"), value.text) for value in param.iter("value")),
                bitmask=_names_by_bit((bit.get("code"), bit.text) for bit in param.iter("bit")),
                reboot_required=_is_true(fields.get("RebootRequired")),
                group=group.get("name", ""),
                category=param.get("user", ""),
                read_only=_is_true(fields.get("ReadOnly")),
                volatile=_is_true(fields.get("Volatile")),
            )


def _ardupilot_json(content: Mapping[str, Any]) -> Iterator[ParameterMetadata]:
    for group, parameters in content.items():
        if group == "json":  # This entry is the version of the format.
            continue
        for name, fields in parameters.items():
            limits = fields.get("Range", {})
            yield ParameterMetadata(
                name,
                short_description=_text(fields["DisplayName"]),
                description=_text(fields.get("Description", "")),
                unit=_text(fields.get("Units", "")),
                minimum=number_or_none(limits.get("low")),
                maximum=number_or_none(limits.get("high")),
                increment=number_or_none(fields.get("Increment")),
                values=_names_by_number(fields.get("Values", {}).items()),
                bitmask=_names_by_bit(fields.get("Bitmask", {}).items()),
                reboot_required=_is_true(fields.get("RebootRequired")),
                group=group,
                category=_text(fields.get("User", "")),
                read_only=_is_true(fields.get("ReadOnly")),
                volatile=_is_true(fields.get("Volatile")),
            )


def _range(text: str) -> tuple[float | None, float | None]:
    bounds = text.replace(",", " ").split()
    if len(bounds) != 2:
        return None, None
    low, high = bounds
    return number_or_none(low), number_or_none(high)


# ------------------------------------------------------------------------------------------- PX4
def _px4_xml(root: Element) -> Iterator[ParameterMetadata]:
    for group in root.iter("group"):
        for param in group.iter("parameter"):
            values: Mapping[float, str] = _names_by_number(
                (value.get("code"), value.text) for value in param.iter("value")
            )
            if not values and _is_true(param.get("boolean")):
                values = {0: "Disabled", 1: "Enabled"}
            yield ParameterMetadata(
                param.attrib["name"],
                short_description=param.findtext("short_desc", ""),
                description=param.findtext("long_desc", "").strip(),
                unit=param.findtext("unit", ""),
                minimum=number_or_none(param.findtext("min")),
                maximum=number_or_none(param.findtext("max")),
                increment=number_or_none(param.findtext("increment")),
                default=number_or_none(param.get("default")),
                values=values,
                bitmask=_names_by_bit((bit.get("index"), bit.text) for bit in param.iter("bit")),
                reboot_required=_is_true(param.findtext("reboot_required")),
                decimal_places=_int_or_none(param.findtext("decimal")),
                group=group.get("name", ""),
                category=param.get("category", "Standard"),
                volatile=_is_true(param.get("volatile")),
            )


def _px4_entry(entry: Mapping[str, Any]) -> ParameterMetadata:
    return ParameterMetadata(
        _text(entry["name"]),
        short_description=_text(entry.get("shortDesc", "")),
        description=_text(entry.get("longDesc", "")).strip(),
        unit=_text(entry.get("units", "")),
        minimum=number_or_none(entry.get("min")),
        maximum=number_or_none(entry.get("max")),
        increment=number_or_none(entry.get("increment")),
        default=number_or_none(entry.get("default")),
        values=_names_by_number((value["value"], value["description"]) for value in entry.get("values", ())),
        bitmask=_names_by_bit((bit["index"], bit["description"]) for bit in entry.get("bitmask", ())),
        reboot_required=bool(entry.get("rebootRequired", False)),
        decimal_places=_int_or_none(entry.get("decimalPlaces")),
        group=_text(entry.get("group", "")),
        category=_text(entry.get("category", "")),
        volatile=bool(entry.get("volatile", False)),
    )


# --------------------------------------------------------------------------------------- pieces
def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError(f"{reprlib.repr(value)} is not text")
    return value


def _int_or_none(value: Any) -> int | None:
    number = number_or_none(value)
    return int(number) if number is not None and number == int(number) else None


def _names_by_number(pairs: Iterable[tuple[Any, Any]]) -> Mapping[float, str]:
    numbers = ((number_or_none(code), str(text or "").strip()) for code, text in pairs)
    return {number: text for number, text in numbers if number is not None}


def _names_by_bit(pairs: Iterable[tuple[Any, Any]]) -> Mapping[int, str]:
    return {int(bit): text for bit, text in _names_by_number(pairs).items() if bit in _BITS}


def _is_true(text: str | None) -> bool:
    return text is not None and text.strip().lower() in ("true", "1")
