"""Parameter files of Mission Planner, MAVProxy and QGroundControl.

Mission Planner's lines are ``NAME,VALUE``, those of MAVProxy ``NAME    VALUE``. Both formats have ``#`` comments and no
types. QGroundControl has five columns separated by tabs: system, component, name, value, MAV_PARAM_TYPE
(https://docs.qgroundcontrol.com/master/en/qgc-dev-guide/file_formats/parameters.html). A file with a damaged line is
refused as a whole, because half a set of parameters is worse than no parameters.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Literal, NamedTuple

from aerokit._internal.files import read_bounded, write_atomically
from aerokit.errors import FileFormatError, InvalidArgument
from aerokit.parameters.encoding import number_text, parse_number
from aerokit.parameters.parameter import Parameter, ParameterType, check_name, checked_value
from aerokit.parameters.table import ParameterTable, ParameterValues, plain_values

FileFormat = Literal["missionplanner", "mavproxy", "qgroundcontrol"]
"""The program that defines the format."""

_AUTOPILOT = 1
_COLUMNS = "system id, component id, name, value and type with tabs between them"


class ParameterFile(Mapping[str, "int | float"]):
    """Content of a parameter file: maps names to values.

    A value is an int if it is written as a whole number. ``types`` are the types in the file (QGroundControl only),
    ``comments`` the lines that begin with ``#``, and ``component_id`` is the component that has these parameters.
    ``places`` maps names to their places for error texts: "mine.param, line 7".
    """

    def __init__(
        self,
        values: Mapping[str, int | float],
        *,
        format: FileFormat,  # noqa: A002
        types: Mapping[str, ParameterType] | None = None,
        comments: Iterable[str] = (),
        component_id: int | None = None,
        places: Mapping[str, str] | None = None,
    ) -> None:
        self._values = dict(values)
        self.format: FileFormat = format
        self.types: dict[str, ParameterType] = dict(types or {})
        self.comments: tuple[str, ...] = tuple(comments)
        self.component_id = component_id
        self.places: dict[str, str] = dict(places or {})

    def __getitem__(self, name: str) -> int | float:
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __repr__(self) -> str:
        return f"<ParameterFile: {len(self)} parameters ({self.format})>"

    def table(self) -> ParameterTable:
        """Convert to a table. Parameters without a type become REAL32."""
        return ParameterTable.from_values(self._values, self.types)


def read_parameter_file(path: str | os.PathLike[str], *, component_id: int | None = None) -> ParameterFile:
    """Read a parameter file of Mission Planner, MAVProxy or QGroundControl. The format is detected.

    If a QGroundControl file has several components, ``component_id`` selects one, by default the autopilot (1).

    Raises:
        FileFormatError: a line is damaged, a name appears twice or has more than 16 characters, a value is NaN, or the
            file has more than 16 MB. The text names the line.
        OSError: the file cannot be read.
    """
    try:
        text = read_bounded(path).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise FileFormatError(f"{os.fspath(path)} is not a parameter file: its content is not text (UTF-8)") from None
    return parse_parameter_file(text, os.fspath(path), component_id=component_id)


def parse_parameter_file(text: str, source: str = "parameters", *, component_id: int | None = None) -> ParameterFile:
    """Parse the text of a parameter file. Error texts begin with ``source``."""
    comments: list[str] = []
    lines: list[_Line] = []
    for number, line in enumerate(text.splitlines(), 1):
        content, hash_sign, comment = line.partition("#")
        if content.strip():
            lines.append(_Line(f"{source}, line {number}", content))
        elif hash_sign:
            comments.append(comment.strip())
    if not lines:
        raise FileFormatError(f"{source} contains no parameters")
    first_line = lines[0].text
    if "\t" in first_line and len(first_line.split()) > 2:  # The other formats have only name and value.
        return _parse_qgroundcontrol(lines, comments, source, component_id)
    return _parse_names_and_values(lines, comments)


def write_parameter_file(
    path: str | os.PathLike[str],
    values: ParameterValues,
    format: FileFormat = "missionplanner",  # noqa: A002
    *,
    comments: Iterable[str] = (),
    system_id: int = 1,
    component_id: int = _AUTOPILOT,
) -> None:
    """Write parameters to a file atomically, sorted by name, with the digits that a 32-bit float needs.

    ``system_id`` and ``component_id`` are only used in QGroundControl's format.

    Raises:
        InvalidArgument: a name or value cannot be sent; nothing was written.
        OSError: the file cannot be written.
    """
    text = parameter_file_text(values, format, comments=comments, system_id=system_id, component_id=component_id)
    write_atomically(path, text)


def parameter_file_text(
    values: ParameterValues,
    format: FileFormat = "missionplanner",  # noqa: A002
    *,
    comments: Iterable[str] = (),
    system_id: int = 1,
    component_id: int = _AUTOPILOT,
) -> str:
    """Format parameters as the text of a parameter file; see :func:`write_parameter_file`."""
    if format not in ("missionplanner", "mavproxy", "qgroundcontrol"):
        raise InvalidArgument(
            f"format = {format!r} is not allowed: it must be missionplanner, mavproxy or qgroundcontrol"
        )
    rows = sorted(_rows(values))  # The names are unique, so the rows are sorted by name.
    if not rows:
        raise InvalidArgument("there are no parameters to write")
    lines: list[str] = []
    for comment in comments:
        lines += [f"# {line}".rstrip() for line in comment.splitlines() or [""]]  # An empty comment becomes "#".
    if format == "qgroundcontrol":
        lines += ["# Vehicle-Id Component-Id Name Value Type"]
        lines += [f"{system_id}\t{component_id}\t{name}\t{value}\t{int(kind)}" for name, value, kind in rows]
    else:
        template = "{},{}" if format == "missionplanner" else "{:<16} {}"
        lines += [template.format(name, value) for name, value, _ in rows]
    return "\n".join(lines) + "\n"


# --------------------------------------------------------------------------------------- reading


class _Line(NamedTuple):
    place: str  # for error texts
    text: str


class _Row(NamedTuple):
    """A line of a QGroundControl file."""

    component_id: int
    name: str
    value: str
    type: ParameterType


def _parse_names_and_values(lines: list[_Line], comments: list[str]) -> ParameterFile:
    """Parse a file of Mission Planner or MAVProxy."""
    file = ParameterFile({}, format="missionplanner" if "," in lines[0].text else "mavproxy", comments=comments)
    for line in lines:
        fields = line.text.replace(",", " ").split()
        if len(fields) != 2:
            hint = _directive_hint(fields)
            raise FileFormatError(f"{line.place}: {line.text.strip()!r} is not NAME,VALUE or NAME VALUE{hint}")
        name, value_text = fields
        _add_value(file, line.place, name, value_text, ParameterType.REAL32)
    return file


def _parse_qgroundcontrol(
    lines: list[_Line], comments: list[str], source: str, component_id: int | None
) -> ParameterFile:
    """Parse a file of QGroundControl, and return the parameters of one component."""
    components: dict[int, ParameterFile] = {}
    for line in lines:
        row = _parse_columns(line)
        if row.component_id not in components:
            components[row.component_id] = ParameterFile(
                {}, format="qgroundcontrol", comments=comments, component_id=row.component_id
            )
        file = components[row.component_id]
        _add_value(file, line.place, row.name, row.value, row.type)
        file.types[row.name] = row.type
    return components[_select_component(component_id, components, source)]


def _parse_columns(line: _Line) -> _Row:
    fields = line.text.strip().split("\t")
    error = FileFormatError(f"{line.place}: {line.text.strip()!r} is not {_COLUMNS}")
    if len(fields) != 5:
        raise error
    system_id, component_id, name, value, type_number = fields
    # The length is limited, because int() raises a plain ValueError for a text of thousands of digits.
    if not all(text.isascii() and text.isdigit() and len(text) < 9 for text in (system_id, component_id, type_number)):
        raise error
    kind = int(type_number)
    if not 1 <= kind <= 10:
        raise FileFormatError(f"{line.place}: type {kind} is not a MAV_PARAM_TYPE (1 to 10)")
    return _Row(int(component_id), name.strip(), value.strip(), ParameterType(kind))


def _select_component(requested: int | None, components: Collection[int], source: str) -> int:
    """Return the requested component, by default the autopilot or the only one."""
    if requested is not None and requested in components:
        return requested
    if requested is None and _AUTOPILOT in components:
        return _AUTOPILOT
    if requested is None and len(components) == 1:
        return next(iter(components))
    present = ", ".join(str(component) for component in sorted(components))
    if requested is None:
        raise FileFormatError(f"{source} has several components: {present}; select one with component_id")
    raise FileFormatError(f"{source} has no parameters of component {requested}, only of: {present}")


def _add_value(file: ParameterFile, place: str, name: str, text: str, kind: ParameterType) -> None:
    """Add a parameter. Raises FileFormatError for an invalid value or a repeated name."""
    try:
        number = parse_number(text)
    except ValueError:
        raise FileFormatError(f"{place}: {name} = {text!r} is not a finite number") from None
    try:
        checked = checked_value(check_name(name), number, kind)
    except InvalidArgument as error:
        raise FileFormatError(f"{place}: {error}") from None
    if name in file:
        raise FileFormatError(f"{place}: {name} appears a second time")
    file._values[name] = checked if kind.is_integer else number  # A float keeps all its digits, as in the file.
    file.places[name] = place


def _directive_hint(fields: list[str]) -> str:
    # In ArduPilot's default files, lines are also `@include FILE` or `NAME VALUE @READONLY`.
    if any(field.startswith("@") for field in (*fields[:1], *fields[2:])):
        return " (@include and @READONLY in ArduPilot's default files are not supported)"
    return ""


# --------------------------------------------------------------------------------------- writing


def _rows(values: ParameterValues) -> Iterator[tuple[str, str, ParameterType]]:
    """Check the parameters, and yield name, formatted value and type of each."""
    file_types = values.types if isinstance(values, ParameterFile) else {}
    for name, number in plain_values(values).items():
        parameter = values[name]
        if isinstance(parameter, Parameter):
            kind = parameter.type
        elif name in file_types:
            kind = file_types[name]
        else:
            kind = ParameterType.INT32 if isinstance(number, int) else ParameterType.REAL32
        yield _writable(name), _value_text(name, number, kind), kind


def _writable(name: str) -> str:
    if any(character in check_name(name) for character in "#,"):
        raise InvalidArgument(f"parameter name = {name!r} cannot be written to a file: it has a # or a comma")
    return name


def _value_text(name: str, number: float, kind: ParameterType) -> str:
    checked = checked_value(name, number, kind)
    return repr(checked) if kind is ParameterType.REAL64 else number_text(checked)
