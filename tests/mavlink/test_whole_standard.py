"""The generated classes hold all of MAVLink's own definitions, if those are installed next to the project."""

from __future__ import annotations

from enum import IntEnum, IntFlag
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from aerokit.mavlink import STANDARD, enums, generator, messages
from aerokit.mavlink.definitions import DialectDefinition, EnumDefinition, merged_enums, read_xml

FOLDER = Path(__file__).parents[3] / "shared" / "definitions"
FILES = ("minimal", "standard", "common", "development")


@cache
def standard() -> tuple[DialectDefinition, ...]:
    if not FOLDER.is_dir():
        pytest.skip(f"MAVLink's own definitions are not in {FOLDER}")
    return tuple(read_xml(FOLDER / f"{name}.xml") for name in FILES)


@cache
def generated_enums() -> dict[str, EnumDefinition]:
    return {enum.name: enum for enum in generator.definitions()[1]}


@pytest.mark.parametrize("file", FILES)
def test_messages_match_standard(file: str) -> None:
    """Return ids, names, CRC_EXTRA and lengths, and order, names, types, units, enums and invalid values of fields."""
    for message in standard()[FILES.index(file)].messages:
        ours = STANDARD[message.id]
        assert (message.name, message.crc_extra) == (ours.NAME, ours.CRC_EXTRA)
        assert (message.base_length, message.length) == (ours.BASE_LENGTH, ours.LENGTH), message.name
        assert [(f.name, f.type, f.array_length, f.units, f.enum, f.invalid, f.extension) for f in ours.FIELDS] == [
            (f.attribute, f.type, f.array_length, f.units, f.enum, f.invalid, f.extension) for f in message.fields
        ], message.name
        assert ours.__module__.removesuffix("_more") == f"aerokit.mavlink.messages.{file}"
        assert getattr(messages, ours.__name__) is ours


def test_enums_match_standard() -> None:
    for enum in merged_enums(standard()):
        ours: Any = getattr(enums, enum.class_name)
        names = {entry.name: member for member, entry in generated_enums()[enum.name].members()}
        assert {name: int(ours[names[name]]) for name in (entry.name for entry in enum.entries)} == {
            entry.name: entry.value for entry in enum.entries
        }
        assert issubclass(ours, IntFlag if enum.bitmask else IntEnum)
        assert ours.__module__ == f"aerokit.mavlink.enums.{enum.origin}"


def test_command_parameters_match_standard() -> None:
    (ours,) = (enum for enum in generator.definitions()[1] if enum.name == "MAV_CMD")
    labels = {(e.name, p[0]): p[1:3] for e in ours.entries for p in e.params}
    for enum in merged_enums(standard()):
        if enum.name == "MAV_CMD":
            for entry in enum.entries:
                for index, label, units, _ in entry.params:
                    assert not (label or units) or labels[entry.name, index] == (label, units)


def test_standard_name_of_value_comes_first() -> None:
    assert enums.MavType(19).name == "VTOL_TAILSITTER_DUOROTOR"
    assert enums.MavType["VTOL_DUOROTOR"] is enums.MavType.VTOL_TAILSITTER_DUOROTOR


def test_new_entries_keep_member_names() -> None:
    names = set(enums.SerialControlDev.__members__)
    assert {"DEV_TELEM1", "DEV_TELEM4", "SERIAL0"} <= names
