"""Generates the modules of messages and enums from pymavlink's XML and additions.

pymavlink contains ArduPilot's fork of the standard. The XML files in the folder ``additions`` contain the definitions
of the standard that are missing in the fork. Where fork and additions differ in units, enums, values or deprecation,
the additions take precedence. Descriptions are taken from pymavlink if it has them. ArduPilot's own definitions are
kept.

    python -m aerokit.mavlink.generator            # write the modules
    python -m aerokit.mavlink.generator --check    # compare only; exit code 1 if the modules differ

The check is skipped if the committed modules were generated from the XML of a different pymavlink.

The output depends only on the XML, so a difference is a change of the standard, the additions or the generator.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import re
import sys
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from aerokit.errors import InvalidArgument
from aerokit.mavlink.definitions import (
    DialectDefinition,
    EntryDefinition,
    EnumDefinition,
    FieldDefinition,
    MessageDefinition,
    merged_enums,
    read_xml,
)
from aerokit.mavlink.rendering import render_enum_row, render_enum_stub, render_message

UNION_FOLDER = Path(__file__).parent / "additions"

# The standard's files. Each includes the previous one. A definition belongs to the first file that has it.
STANDARD_FILES = ("minimal", "standard", "common")

DefinedT = TypeVar("DefinedT", EnumDefinition, MessageDefinition)


def read_additions() -> list[DialectDefinition]:
    return [read_xml(UNION_FOLDER / f"{stem}.xml") for stem in ("minimal", "common", "development")]


def with_added_messages(
    messages: Sequence[MessageDefinition], additions: Sequence[DialectDefinition]
) -> list[MessageDefinition]:
    """Return the messages with those of ``additions``. A message in both gets the added fields and remarks."""
    merged = {message.id: message for message in messages}
    for added in (message for dialect in additions for message in dialect.messages):
        existing = merged.get(added.id)
        if existing is not None:
            added = _with_first_origin(replace(existing, fields=_merged_fields(existing, added)), added)
        merged[added.id] = added
    return list(merged.values())


def with_added_enums(enums: Sequence[EnumDefinition], additions: Sequence[DialectDefinition]) -> list[EnumDefinition]:
    """Return the enums with those of ``additions``. An enum in both gets the added entries and remarks."""
    merged = {enum.name: enum for enum in enums}
    for added in (enum for dialect in additions for enum in dialect.enums):
        existing = merged.get(added.name)
        if existing is not None:
            entries = _merged_entries(existing, added)
            # Keep the prefix, because the Python names of the existing entries depend on it.
            added = _with_first_origin(replace(existing, entries=entries, own_prefix=existing.prefix), added)
        merged[added.name] = added
    return list(merged.values())


def _with_first_origin(existing: DefinedT, added: DefinedT) -> DefinedT:
    """Return a copy of ``existing`` with the origin of either that comes first in `STANDARD_FILES`.

    If ``added`` has remarks, they replace those of ``existing``.
    """
    origin = min(
        existing.origin,
        added.origin,
        key=lambda stem: STANDARD_FILES.index(stem) if stem in STANDARD_FILES else len(STANDARD_FILES),
    )
    return replace(existing, origin=origin, remarks=added.remarks or existing.remarks)


def _merged_fields(existing: MessageDefinition, added: MessageDefinition) -> tuple[FieldDefinition, ...]:
    fields = {field.name: field for field in existing.fields}
    for field in added.fields:
        existing_field = fields.get(field.name)
        if existing_field is not None:
            # The added field replaces the units, enum and invalid value, even by empty ones.
            field = replace(existing_field, units=field.units, enum=field.enum, invalid=field.invalid)
        fields[field.name] = field
    return tuple(fields.values())


def _merged_entries(existing: EnumDefinition, added: EnumDefinition) -> tuple[EntryDefinition, ...]:
    by_name = {entry.name: entry for entry in existing.entries}
    merged = {entry.name: _merged_entry(by_name.get(entry.name, entry), entry) for entry in added.entries}
    for name, entry in by_name.items():
        merged.setdefault(name, entry)
    # Sorting is stable: if several names have the same value, the added names stay first.
    return tuple(sorted(merged.values(), key=lambda entry: entry.value))


def _merged_entry(existing: EntryDefinition, added: EntryDefinition) -> EntryDefinition:
    params = {number: (number, label, units, text) for number, label, units, text in (*existing.params, *added.params)}
    return replace(
        existing,
        value=added.value,
        params=tuple(params[number] for number in sorted(params)),
        remarks=added.remarks or existing.remarks,
    )


# Maps each module to the XML files whose definitions it contains.
MODULES: dict[str, tuple[str, ...]] = {
    "minimal": ("minimal",),
    "standard": ("standard",),
    "common": ("common",),
    "ardupilotmega": ("ardupilotmega", "uAvionix", "icarous", "loweheiser", "cubepilot", "csAirLink"),
    "development": ("development",),
}

# The messages of ``common.xml`` that most flights use. They are in ``common.py``, the other two hundred in
# ``common_more.py``. A program that uses none of the two hundred avoids the slow import of ``common_more``.
EVERYDAY = """
    Attitude AttitudeQuaternion AvailableModes BatteryStatus CommandAck CommandInt CommandLong CurrentMode
    DistanceSensor EstimatorStatus ExtendedSysState FileTransferProtocol Gps2Raw GpsGlobalOrigin GpsRawInt
    HomePosition LocalPositionNed MissionAck MissionClearAll MissionCount MissionCurrent MissionItemInt
    MissionItemReached MissionRequest MissionRequestInt MissionRequestList MissionSetCurrent MissionWritePartialList
    ParamError ParamRequestList ParamRequestRead ParamSet ParamValue PlayTune PowerStatus RcChannels
    RcChannelsOverride RcChannelsRaw RequestDataStream ServoOutputRaw SetAttitudeTarget SetMode
    SetPositionTargetGlobalInt SetPositionTargetLocalNed Statustext SysStatus SystemTime Timesync VfrHud Vibration
    WindCov
"""

COMMON_MORE = "common_more"

FOLDER = Path(__file__).parent

_MARK = "XML fingerprint: "

_HEADER = (
    "# Generated by aerokit.mavlink.generator from pymavlink's XML and additions/: do not edit.\n# " + _MARK + "{}\n"
)

_MESSAGES_HEAD = '''# Treat the classes as immutable; only the code in this file assigns their fields.
# mypy: disable-error-code="misc, assignment, override, method-assign"
# pyright: reportAttributeAccessIssue=false, reportIncompatibleMethodOverride=false
# pyright: reportIncompatibleVariableOverride=false, reportGeneralTypeIssues=false
"""Messages of ``{name}.xml``{more}: https://mavlink.io/en/messages/{name}.html."""

from __future__ import annotations

from struct import Struct
from typing import TYPE_CHECKING, ClassVar

from aerokit.mavlink.message import PACK_ERRORS, Message{helpers}

if TYPE_CHECKING:
    from collections.abc import Sequence

    from aerokit.mavlink.frame import Frame

_new = object.__new__

'''

_ENUMS_HEAD = '''# pyright: reportUnsupportedDunderAll=false
"""Enums of ``{name}.xml``{more}: https://mavlink.io/en/messages/{name}.html.

Enums are created on first access, because creating all of their two thousand members would double the import time.
Type checkers and editors read the stub file beside this one.
"""

from __future__ import annotations

from aerokit.mavlink.message import make_enum

_TABLE: dict[str, tuple[bool, str, tuple[tuple[str, int], ...]]] = {{
'''

_ENUMS_TAIL = """}

__all__ = [*_TABLE]


def __getattr__(name: str) -> type[int]:
    if name not in _TABLE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    enum = globals()[name] = make_enum(__name__, name, *_TABLE[name])
    return enum


def __dir__() -> list[str]:
    return sorted(set(globals()) | set(_TABLE))
"""

_LAZY_IMPORT = """
__all__ = [*_MODULES]


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
    return value


def __dir__() -> list[str]:
    return sorted(set(globals()) | set(_MODULES))
"""

_ENUMS_INIT_TEMPLATE = '''# pyright: reportUnsupportedDunderAll=false
"""Enums of the standard: ``MAV_CMD`` is `MavCmd`, ``MAV_CMD_NAV_TAKEOFF`` is ``MavCmd.NAV_TAKEOFF``.

Each is an ``IntEnum``, or an ``IntFlag`` if the standard marks it as a bitmask. Fields of messages are plain ``int``,
which compare equal to members. https://mavlink.io/en/messages/
"""

from __future__ import annotations

from importlib import import_module

_MODULES = {{
{rows}}}
'''

_MESSAGES_INIT_TEMPLATE = '''# pyright: reportUnsupportedDunderAll=false
"""Messages of the standard, one class each: ``GLOBAL_POSITION_INT`` is `GlobalPositionInt`.

Names, order and raw units of fields are those of the standard: https://mavlink.io/en/messages/

A module is imported when one of its messages is first used. `INDEX` has what is needed to verify frames without the
class: message id → (class, module, CRC_EXTRA, base length, length).
"""

from __future__ import annotations

from importlib import import_module

INDEX: dict[int, tuple[str, str, int, int, int]] = {{
{rows}}}

_MODULES = {{row[0]: row[1] for row in INDEX.values()}}
'''


def xml_folder() -> Path:
    """Return the folder with the XML files of the installed pymavlink."""
    spec = importlib.util.find_spec("pymavlink")
    if spec is None or not spec.submodule_search_locations:
        raise InvalidArgument("the package pymavlink, which contains MAVLink's XML files, is not installed")
    return Path(spec.submodule_search_locations[0]) / "dialects" / "v20"


def fingerprint(folder: Path | None = None) -> str:
    folder = folder or xml_folder()
    digest = hashlib.sha256()
    for stem in _stems():
        digest.update(b"".join((folder / f"{stem}.xml").read_bytes().splitlines()))
    return digest.hexdigest()[:16]


def generated_fingerprint() -> str:
    """Return the hash of the XML files from which the committed modules were generated."""
    match = re.search(_MARK + "([0-9a-f]+)", (FOLDER / "messages" / "__init__.py").read_text(encoding="utf-8"))
    return match[1] if match else ""


def definitions(folder: Path | None = None) -> tuple[list[MessageDefinition], list[EnumDefinition]]:
    folder = folder or xml_folder()
    dialects = [read_xml(folder / f"{stem}.xml") for stem in _stems()]
    additions = read_additions()
    messages = [message for dialect in dialects for message in dialect.messages]
    return with_added_messages(messages, additions), with_added_enums(merged_enums(dialects), additions)


def generate(folder: Path | None = None) -> dict[str, str]:
    """Return all generated files, as a mapping of paths below `aerokit.mavlink` to text."""
    messages, enums = definitions(folder)
    _check_unique(message.class_name for message in messages)
    _check_unique(enum.class_name for enum in enums)
    files: dict[str, str] = {}
    files["messages/__init__.py"], files["messages/__init__.pyi"] = _messages_init(messages)
    files["enums/__init__.py"], files["enums/__init__.pyi"] = _enums_init(enums)
    for module in (*MODULES, COMMON_MORE):
        module_messages = [message for message in messages if _module_of(message) == module]
        files[f"messages/{module}.py"] = _messages_module(module, module_messages)
    for module, stems in MODULES.items():
        module_enums = [enum for enum in enums if enum.origin in stems]
        files[f"enums/{module}.py"] = _enums_module(module, stems, module_enums)
        files[f"enums/{module}.pyi"] = _enums_stub(module, module_enums)
    header = _HEADER.format(fingerprint(folder))
    return {path: header + text for path, text in sorted(files.items())}


def differences(folder: Path | None = None) -> list[str]:
    """Return the paths of committed files that are missing, superfluous, or differ from the generated files."""
    files = generate(folder)
    present = {
        path.relative_to(FOLDER).as_posix()
        for package in ("messages", "enums")
        for path in (FOLDER / package).glob("*.py*")
    }
    different = {path for path, text in files.items() if path not in present or _read(path) != text}
    superfluous = present - set(files)
    return sorted(different | superfluous)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m aerokit.mavlink.generator", description=(__doc__ or "").partition("\n")[0]
    )
    parser.add_argument("--check", action="store_true", help="compare with the committed modules, write nothing")
    options = parser.parse_args(arguments)
    if not options.check:
        for path, text in generate().items():
            (FOLDER / path).parent.mkdir(exist_ok=True)
            (FOLDER / path).write_text(text, encoding="utf-8", newline="\n")
        return 0
    if fingerprint() != generated_fingerprint():
        sys.stdout.write("skipped: the XML of the installed pymavlink differs from that of the committed modules\n")
        return 0
    paths = differences()
    sys.stdout.writelines(f"differs: {path}\n" for path in paths)
    if not paths:
        sys.stdout.write("the committed modules are up to date\n")
    return 1 if paths else 0


# ------------------------------------------------------------------------------------------- files
def _stems() -> list[str]:
    return [stem for stems in MODULES.values() for stem in stems]


def _module_of(message: MessageDefinition) -> str:
    if message.origin == "common" and message.class_name not in EVERYDAY.split():
        return COMMON_MORE
    return next(module for module, stems in MODULES.items() if message.origin in stems)


def _read(path: str) -> str:
    return (FOLDER / path).read_text(encoding="utf-8")


def _other_files(stems: Sequence[str]) -> str:
    return f" (and {', '.join(stems[1:])})" if len(stems) > 1 else ""


def _messages_module(module: str, messages: Sequence[MessageDefinition]) -> str:
    text = "\n\n".join(render_message(message) for message in messages)
    helpers = "".join(f", {name}" for name in ("pack_bytes", "pack_items", "pack_text") if f"{name}(" in text)
    stems = MODULES.get(module, MODULES["common"])  # common_more.py has messages of the same XML files as common.py.
    head = _MESSAGES_HEAD.format(name=stems[0], more=_other_files(stems), helpers=helpers)
    if "Sequence[" not in text:
        head = head.replace("    from collections.abc import Sequence\n\n", "")
    return head + _render_dunder_all(message.class_name for message in messages) + "\n" + text


def _messages_init(messages: Sequence[MessageDefinition]) -> tuple[str, str]:
    rows = ""
    for message in sorted(messages, key=lambda message: message.id):
        numbers = f"{message.crc_extra}, {message.base_length}, {message.length}"
        rows += f'    {message.id}: ("{message.class_name}", "{_module_of(message)}", {numbers}),\n'
    names = {message.class_name: _module_of(message) for message in messages}
    stub = _reexports("messages", names) + "\nINDEX: dict[int, tuple[str, str, int, int, int]]\n"
    return _MESSAGES_INIT_TEMPLATE.format(rows=rows) + _LAZY_IMPORT, stub


def _enums_module(module: str, stems: Sequence[str], enums: Sequence[EnumDefinition]) -> str:
    rows = "".join(render_enum_row(enum) for enum in enums)
    return _ENUMS_HEAD.format(name=module, more=_other_files(stems)) + rows + _ENUMS_TAIL


def _enums_stub(module: str, enums: Sequence[EnumDefinition]) -> str:
    bases = sorted({"IntFlag" if enum.bitmask else "IntEnum" for enum in enums})
    head = f"from enum import {', '.join(bases)}\n\n" if bases else ""
    return head + _render_dunder_all(enum.class_name for enum in enums) + "\n" + "\n".join(map(render_enum_stub, enums))


def _enums_init(enums: Sequence[EnumDefinition]) -> tuple[str, str]:
    modules = {stem: module for module, stems in MODULES.items() for stem in stems}
    names = {enum.class_name: modules[enum.origin] for enum in enums}
    rows = "".join(f'    "{name}": "{module}",\n' for name, module in sorted(names.items()))
    return _ENUMS_INIT_TEMPLATE.format(rows=rows) + _LAZY_IMPORT, _reexports("enums", names)


def _reexports(package: str, names: dict[str, str]) -> str:
    """Render a stub that imports each name from its module."""
    stub = ""
    for module in sorted(set(names.values())):
        imports = "".join(f"    {name} as {name},\n" for name in sorted(names) if names[name] == module)
        stub += f"from aerokit.mavlink.{package}.{module} import (\n{imports})\n"
    return stub + "\n" + _render_dunder_all(sorted(names))


def _render_dunder_all(names: Iterable[str]) -> str:
    return "__all__ = [\n" + "".join(f'    "{name}",\n' for name in names) + "]\n"


def _check_unique(names: Iterable[str]) -> None:
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise InvalidArgument(f"two definitions would both have the name {name}")
        seen.add(name)


if __name__ == "__main__":
    sys.exit(main())
