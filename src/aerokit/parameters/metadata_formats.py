"""The four metadata files: ArduPilot's XML and JSON, PX4's XML and JSON.

They are told apart by their first character and their outermost names. Numbers that are none are left out, as
generators write "0 10" and "-1,1" by hand; a file of another kind raises ValueError, SyntaxError or KeyError.
"""

from __future__ import annotations

import json
import reprlib
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

from defusedxml import ElementTree as DefusedXml

from aerokit.parameters.metadata import ParameterMetadata
from aerokit.parameters.number_text import parse_number

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

__all__ = ["parse"]

_BITS = range(64)


def parse(data: bytes) -> list[ParameterMetadata]:
    """What the file says of each parameter, in its order."""
    if data.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<"):
        root = DefusedXml.fromstring(data, forbid_dtd=True)
        if root.tag == "paramfile":
            return list(_ardupilot_xml(root))
        if root.tag == "parameters":
            return list(_px4_xml(root))
        raise ValueError(f"its outermost element is <{root.tag}>")
    content = json.loads(data.decode("utf-8-sig"))
    if not isinstance(content, dict):
        raise ValueError("its outermost value is no object")
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
                param.attrib["name"].rpartition(":")[2],
                short_description=param.get("humanName", ""),
                description=param.get("documentation", ""),
                unit=fields.get("Units", ""),
                minimum=low,
                maximum=high,
                increment=_number(fields.get("Increment")),
                values=_named((each.get("code"), each.text) for each in param.iter("value")),
                bitmask=_bits((each.get("code"), each.text) for each in param.iter("bit")),
                reboot_required=_is_true(fields.get("RebootRequired")),
                group=group.get("name", ""),
                category=param.get("user", ""),
                read_only=_is_true(fields.get("ReadOnly")),
                volatile=_is_true(fields.get("Volatile")),
            )


def _ardupilot_json(content: Mapping[str, Any]) -> Iterator[ParameterMetadata]:
    for group, parameters in content.items():
        if group == "json":  # the version of the format
            continue
        for name, fields in parameters.items():
            limits = fields.get("Range", {})
            yield ParameterMetadata(
                name,
                short_description=_text(fields["DisplayName"]),
                description=_text(fields.get("Description", "")),
                unit=_text(fields.get("Units", "")),
                minimum=_number(limits.get("low")),
                maximum=_number(limits.get("high")),
                increment=_number(fields.get("Increment")),
                values=_named(fields.get("Values", {}).items()),
                bitmask=_bits(fields.get("Bitmask", {}).items()),
                reboot_required=_is_true(fields.get("RebootRequired")),
                group=group,
                category=_text(fields.get("User", "")),
                read_only=_is_true(fields.get("ReadOnly")),
                volatile=_is_true(fields.get("Volatile")),
            )


def _range(text: str) -> tuple[float | None, float | None]:
    bounds = text.replace(",", " ").split()
    return (_number(bounds[0]), _number(bounds[1])) if len(bounds) == 2 else (None, None)


# ------------------------------------------------------------------------------------------- PX4


def _px4_xml(root: Element) -> Iterator[ParameterMetadata]:
    for group in root.iter("group"):
        for param in group.iter("parameter"):
            is_boolean = _is_true(param.get("boolean"))
            values = _named((each.get("code"), each.text) for each in param.iter("value"))
            yield ParameterMetadata(
                param.attrib["name"],
                short_description=param.findtext("short_desc", ""),
                description=param.findtext("long_desc", "").strip(),
                unit=param.findtext("unit", ""),
                minimum=_number(param.findtext("min")),
                maximum=_number(param.findtext("max")),
                increment=_number(param.findtext("increment")),
                default=_number(param.get("default")),
                values=values or ({0: "Disabled", 1: "Enabled"} if is_boolean else values),
                bitmask=_bits((each.get("index"), each.text) for each in param.iter("bit")),
                reboot_required=_is_true(param.findtext("reboot_required")),
                decimal_places=_whole(param.findtext("decimal")),
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
        minimum=_number(entry.get("min")),
        maximum=_number(entry.get("max")),
        increment=_number(entry.get("increment")),
        default=_number(entry.get("default")),
        values=_named((each["value"], each["description"]) for each in entry.get("values", ())),
        bitmask=_bits((each["index"], each["description"]) for each in entry.get("bitmask", ())),
        reboot_required=bool(entry.get("rebootRequired", False)),
        decimal_places=_whole(entry.get("decimalPlaces")),
        group=_text(entry.get("group", "")),
        category=_text(entry.get("category", "")),
        volatile=bool(entry.get("volatile", False)),
    )


# --------------------------------------------------------------------------------------- pieces


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError(f"{reprlib.repr(value)} is no text")
    return value


def _whole(value: Any) -> int | None:
    number = _number(value)
    return int(number) if number is not None and number == int(number) else None


def _number(value: Any) -> int | float | None:
    if not isinstance(value, (int, float, str)):
        return None
    try:
        return parse_number(str(value).strip())
    except ValueError:
        return None


def _named(pairs: Iterable[tuple[Any, Any]]) -> Mapping[float, str]:
    numbers = ((_number(code), str(text or "").strip()) for code, text in pairs)
    return {number: text for number, text in numbers if number is not None}


def _bits(pairs: Iterable[tuple[Any, Any]]) -> Mapping[int, str]:
    return {int(bit): text for bit, text in _named(pairs).items() if bit in _BITS}


def _is_true(text: str | None) -> bool:
    return text is not None and text.strip().lower() in ("true", "1")
