"""What a camera definition file says of a camera's settings: types, ranges, options, and what excludes what.

https://mavlink.io/en/services/camera_def.html
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator, Mapping
from itertools import islice
from types import MappingProxyType
from typing import TYPE_CHECKING

from aerokit._internal.files import LARGEST_FILE, read_bounded, too_large, unpacked
from aerokit._internal.values import Snapshot
from aerokit._internal.wording import did_you_mean, shown
from aerokit.errors import FileFormatError, InvalidArgument
from aerokit.mavlink.enums import MavParamExtType
from aerokit.parameters.encoding import parse_number
from aerokit.parameters.setting import SettingValue, checked_setting, setting_key, settings_equal

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

Values = Mapping[str, SettingValue]
"""What is known of a camera's settings, by name."""

TYPES = {
    "bool": MavParamExtType.UINT8,
    "uint8": MavParamExtType.UINT8,
    "int8": MavParamExtType.INT8,
    "uint16": MavParamExtType.UINT16,
    "int16": MavParamExtType.INT16,
    "uint32": MavParamExtType.UINT32,
    "int32": MavParamExtType.INT32,
    "uint64": MavParamExtType.UINT64,
    "int64": MavParamExtType.INT64,
    "float": MavParamExtType.REAL32,
    "double": MavParamExtType.REAL64,
    "string": MavParamExtType.CUSTOM,
    "custom": MavParamExtType.CUSTOM,
}
"""The file's names; ``string`` is not in the standard, but in files of cameras."""
OPERATORS = ("!=", ">=", "<=", "=", ">", "<")
SHOWN_OPTIONS = 20
LONGEST_NAME = 16
"""Characters of a setting's name on the wire."""
LARGEST_DEFINITION, MOST_ELEMENTS = 1 << 20, 20_000
"""Bytes and elements of a file: real ones have some 50 kB and 1,000. Reading more would hold up the event loop."""


class SettingRange(Snapshot):
    """While an option is chosen and ``condition`` holds, ``setting`` takes nothing but these ``options``.

    ``condition`` are tests of settings, such as ``CAM_EXPMODE=1``, between AND and OR; empty is always.
    """

    setting: str
    condition: str
    options: tuple[SettingOption, ...]


class SettingOption(Snapshot):
    """One of the values that a setting can have. While it is chosen, the settings that it ``excludes`` mean nothing."""

    name: str
    value: SettingValue
    excludes: tuple[str, ...] = ()
    ranges: tuple[SettingRange, ...] = ()


class SettingDefinition(Snapshot):
    """What the file says of one setting; None and empty where it says nothing.

    ``type`` is the file's word (``"bool"``, ``"uint32"``, ``"float"`` …), ``wire_type`` its MAV_PARAM_EXT_TYPE.
    ``updates`` are settings that the camera may change when this one changes. Without ``is_control`` a program should
    show no control for it: there is a better one. ``step`` binds whole numbers; of others it is advice.
    """

    name: str
    type: str
    wire_type: int
    description: str = ""
    default: SettingValue | None = None
    minimum: int | float | None = None
    maximum: int | float | None = None
    step: int | float | None = None
    options: tuple[SettingOption, ...] = ()
    updates: tuple[str, ...] = ()
    is_control: bool = True
    read_only: bool = False
    write_only: bool = False

    def typed(self, value: SettingValue) -> SettingValue:
        """A value that the camera told: ``True`` or ``False`` where the file says that it is one of them."""
        return bool(value) if self.type == "bool" and not isinstance(value, (str, bytes)) else value

    def option_of(self, value: SettingValue) -> SettingOption | None:
        """The option that stands for a value."""
        return next((each for each in self.options if settings_equal(each.value, value)), None)


class CameraDefinition(Snapshot):
    """A definition file: who made the camera, its settings by name, and texts in other languages by locale."""

    vendor: str
    model: str
    version: int
    settings: Mapping[str, SettingDefinition]
    translations: Mapping[str, Mapping[str, str]] = MappingProxyType({})

    def __hash__(self) -> int:
        return hash((self.vendor, self.model, self.version))

    def __repr__(self) -> str:
        return f"<CameraDefinition of {self.vendor} {self.model}: {len(self.settings)} settings>"

    def localized(self, locale: str) -> CameraDefinition:
        """The same with descriptions and names of options in another language, ``"de_DE"`` or ``"de"``.

        What is not translated stays as it is; all of it when the file does not have the language.
        """
        found = self.translations.get(locale)
        if found is None:
            language = locale.partition("_")[0]
            alike = (name for name in self.translations if name.partition("_")[0] == language)
            found = self.translations.get(next(alike, ""))
        if not found:
            return self
        settings = {name: _translated(each, found) for name, each in self.settings.items()}
        return self.replace(settings=MappingProxyType(settings))

    # ------------------------------------------------------------------------------ what excludes what

    def rulers(self, name: str) -> tuple[str, ...]:
        """The settings whose values decide what another one can be now."""
        found: dict[str, None] = {}
        for ruler in self.settings.values():
            for option in ruler.options:
                if name in option.excludes:
                    found[ruler.name] = None
                for each in option.ranges:
                    if each.setting == name:
                        found[ruler.name] = None
                        found.update(
                            (test[0], None) for test in _tests(each.condition) if test[0] in self.settings
                        )
        return tuple(each for each in found if each != name)

    def excluded_by(self, name: str, values: Values) -> tuple[str, ...]:
        """What makes a setting mean nothing now, as texts: ``CAM_EXPMODE = Auto``; empty when nothing does."""
        return tuple(
            f"{ruler.name} = {option.name}"
            for ruler, option in self._chosen(values)
            if name in option.excludes and ruler.name != name
        )

    def options(self, name: str, values: Values) -> tuple[SettingOption, ...]:
        """The options that a setting has now; empty when any value in its range may be set."""
        return self._options(name, values)[0]

    def _options(self, name: str, values: Values) -> tuple[tuple[SettingOption, ...], list[str]]:
        """The same, and what restricts them."""
        own = self.settings.get(name)
        options = () if own is None else own.options
        reasons: list[str] = []
        left: frozenset[object] = frozenset()
        for ruler, option in self._chosen(values):
            for each in option.ranges:
                if each.setting == name and ruler.name != name and _holds(each.condition, values):
                    allowed = each.options
                    if reasons:  # each of several has its say
                        allowed = tuple(one for one in allowed if setting_key(one.value) in left)
                    options, left = allowed, frozenset(setting_key(one.value) for one in allowed)
                    reasons.append(f"{ruler.name} = {option.name}")
        return options, reasons

    def _chosen(self, values: Values) -> Iterator[tuple[SettingDefinition, SettingOption]]:
        """Each setting whose value is known with the option that it has."""
        for name, definition in self.settings.items():
            option = definition.option_of(values[name]) if name in values else None
            if option is not None:
                yield definition, option

    # ----------------------------------------------------------------------------------------- checks

    def checked(self, name: str, value: object, values: Values) -> SettingValue:
        """The value that is to be sent for a value, or for the name of an option, while the others are as told.

        Raises :class:`InvalidArgument` where the setting can only be read, is excluded now, or does not take it.
        """
        own = self.settings[name]
        if own.read_only:
            raise InvalidArgument(f"{name} = {shown(value)} is not allowed: it can only be read")
        reasons = self.excluded_by(name, values)
        if reasons:
            raise InvalidArgument(
                f"{name} = {shown(value)} is not allowed now: excluded by {', '.join(reasons)}"
            )
        options, restricted_by = self._options(name, values)
        if options or restricted_by:
            return _among(own, value, options, restricted_by)
        return _in_range(own, value)


def load_definition(path: str | os.PathLike[str]) -> CameraDefinition:
    """Read a definition file of a camera, compressed (``.xz``) or not.

    Raises :class:`FileFormatError` when it is none, or has more than 1 MB (unpacked, too) or 20,000 elements, OSError
    when it cannot be read. Of a setting that stands there twice the first counts; numbers and conditions that are none
    are left out.
    """
    return parse_definition(read_bounded(path), os.fspath(path))


def parse_definition(data: bytes, source: str = "camera definition") -> CameraDefinition:
    """The same of bytes; ``source`` is their name in errors."""
    from xml.etree.ElementTree import ParseError

    from defusedxml import ElementTree as DefusedXml

    try:
        if len(data) > LARGEST_FILE:
            raise too_large(source)
        content = unpacked(data, source)
        if len(content) > LARGEST_DEFINITION:
            raise FileFormatError(
                f"{source} has more than {LARGEST_DEFINITION >> 10} kB: that is no camera definition"
            )
        root = DefusedXml.fromstring(content, forbid_dtd=True)
    except FileFormatError:
        raise
    except (ParseError, LookupError, ValueError) as error:
        raise FileFormatError(f"{source} is no camera definition: {error!r}") from None
    if root.tag != "mavlinkcamera":
        raise FileFormatError(
            f"{source} is no camera definition: its outermost element is <{root.tag[:100]}>"
        )
    if next(islice(root.iter(), MOST_ELEMENTS, None), None) is not None:
        raise FileFormatError(
            f"{source} has more than {MOST_ELEMENTS} elements: that is no camera definition"
        )
    found = _Reader(root).definition()
    if not found.settings:
        raise FileFormatError(f"{source} describes no settings")
    return found


# ------------------------------------------------------------------------------------------ values


def _among(
    own: SettingDefinition, value: object, options: tuple[SettingOption, ...], restricted_by: list[str]
) -> SettingValue:
    by_name = {each.name: each.value for each in options}
    if isinstance(value, str) and value in by_name:
        return by_name[value]
    if not isinstance(value, str) or own.wire_type == MavParamExtType.CUSTOM:
        wanted = checked_setting(own.name, value, own.wire_type)
        for each in options:
            if settings_equal(each.value, wanted):
                return each.value
    now = f" while {', '.join(restricted_by)}" if restricted_by else ""
    names = ", ".join(f"{name!r} ({shown(known)})" for name, known in list(by_name.items())[:SHOWN_OPTIONS])
    more = f" and {len(by_name) - SHOWN_OPTIONS} more" if len(by_name) > SHOWN_OPTIONS else ""
    raise InvalidArgument(
        f"{own.name} = {shown(value)} is not allowed{now}: {names or 'nothing'}{more}{did_you_mean(value, by_name)}"
    )


def _in_range(own: SettingDefinition, value: object) -> SettingValue:
    number = checked_setting(own.name, value, own.wire_type)
    if isinstance(number, (str, bytes)):
        return number
    if own.type == "bool":
        if number not in (0, 1):
            raise InvalidArgument(f"{own.name} = {shown(value)} is not allowed: True or False")
        return bool(number)
    low, high, step = own.minimum, own.maximum, own.step
    is_below = low is not None and number < low and not settings_equal(number, low)
    is_above = high is not None and number > high and not settings_equal(number, high)
    if is_below or is_above:
        bounds = f"{'' if low is None else f'{low:g}'}..{'' if high is None else f'{high:g}'}"
        raise InvalidArgument(f"{own.name} = {shown(value)} is not allowed: {bounds}")
    if isinstance(number, int) and isinstance(step, int) and step > 1:
        first = low if isinstance(low, int) else 0
        if (number - first) % step:
            raise InvalidArgument(
                f"{own.name} = {shown(value)} is not allowed: {first}, {first + step}, {first + 2 * step} …"
            )
    return number


# -------------------------------------------------------------------------------------- conditions


def _tests(condition: str) -> list[tuple[str, str, str, str]]:
    """Setting, operator, value, and whether it has to hold AND the tests before, or OR; ValueError when it is none."""
    tests = []
    joiner, words = "AND", list[str]()
    for word in (*condition.split(), "AND") if condition else ():
        if word not in ("AND", "OR"):
            words.append(word)
            continue
        text = "".join(words)
        operator = next((each for each in OPERATORS if each in text), None)
        if operator is None:
            raise ValueError(f"{condition!r} is no condition")
        name, _, value = text.partition(operator)
        tests.append((name, operator, value, joiner))
        joiner, words = word, []
    return tests


def _holds(condition: str, values: Values) -> bool:
    """From left to right; a test of a setting that is not known does not hold."""
    result = True
    for name, operator, value, joiner in _tests(condition):
        holds = name in values and _is_so(values[name], operator, value)
        result = (result and holds) if joiner == "AND" else (result or holds)
    return result


def _is_so(value: SettingValue, operator: str, text: str) -> bool:
    if isinstance(value, (str, bytes)):
        return settings_equal(value, text) == (operator == "=") if operator in ("=", "!=") else False
    wanted = _number(text)
    if wanted is None:
        return False
    is_equal = settings_equal(value, wanted)
    if operator in ("=", "!="):
        return is_equal == (operator == "=")
    is_right = value > wanted if operator[0] == ">" else value < wanted
    return is_equal if is_equal and operator.endswith("=") else is_right and not is_equal


# ----------------------------------------------------------------------------------------- the file


class _Reader:
    """What stands in the elements; what makes no sense is left out."""

    def __init__(self, root: Element) -> None:
        self._root = root
        nodes = list(root.iterfind("parameters/parameter"))
        self._types = {node.get("name", ""): TYPES.get(node.get("type", "")) for node in reversed(nodes)}

    def definition(self) -> CameraDefinition:
        """All of it."""
        root, head = self._root, self._root.find("definition")
        settings: dict[str, SettingDefinition] = {}
        for node in root.iterfind("parameters/parameter"):
            found = self._setting(node)
            if found is not None:
                settings.setdefault(found.name, found)
        return CameraDefinition(
            vendor=_text(None if head is None else head.find("vendor")),
            model=_text(None if head is None else head.find("model")),
            version=_whole("" if head is None else head.get("version", "")),
            settings=MappingProxyType(settings),
            translations=MappingProxyType(
                {
                    node.get("name", ""): MappingProxyType(
                        {
                            each.get("original", ""): each.get("translated", "")
                            for each in node.iterfind("strings")
                        }
                    )
                    for node in root.iterfind("localization/locale")
                }
            ),
        )

    def _setting(self, node: Element) -> SettingDefinition | None:
        name, kind = node.get("name", ""), node.get("type", "")
        if not _is_name(name) or kind not in TYPES:
            return None
        wire_type = TYPES[kind]
        default = _value(node.get("default"), wire_type)
        return SettingDefinition(
            name,
            kind,
            wire_type,
            description=_text(node.find("description")),
            default=bool(default) if kind == "bool" and default is not None else default,
            minimum=_number(node.get("min")),
            maximum=_number(node.get("max")),
            step=_number(node.get("step")),
            options=tuple(self._options(node.iterfind("options/option"), wire_type)),
            updates=tuple(filter(_is_name, _texts(node.iterfind("updates/update")))),
            is_control=node.get("control", "1") not in ("0", "false"),
            read_only=node.get("readonly", "0") in ("1", "true"),
            write_only=node.get("writeonly", "0") in ("1", "true"),
        )

    def _options(self, nodes: Iterable[Element], wire_type: int) -> Iterator[SettingOption]:
        for node in nodes:
            value = _value(node.get("value"), wire_type)
            if value is not None:
                yield SettingOption(
                    node.get("name", ""),
                    value,
                    excludes=tuple(_texts(node.iterfind("exclusions/exclude"))),
                    ranges=tuple(self._ranges(node.iterfind("parameterranges/parameterrange"))),
                )

    def _ranges(self, nodes: Iterable[Element]) -> Iterator[SettingRange]:
        for node in nodes:
            setting = node.get("parameter", "")
            wire_type = self._types.get(setting)
            condition = " ".join(node.get("condition", "").split())
            try:
                _holds(condition, {})
            except ValueError:
                continue
            if wire_type is not None:
                found = (
                    (each.get("name", ""), _value(each.get("value"), wire_type))
                    for each in node.iterfind("roption")
                )
                options = tuple(SettingOption(name, value) for name, value in found if value is not None)
                yield SettingRange(setting, condition, options)


def _text(node: Element | None) -> str:
    return "" if node is None else " ".join((node.text or "").split())


def _texts(nodes: Iterable[Element]) -> Iterator[str]:
    return filter(None, map(_text, nodes))


def _is_name(name: str) -> bool:
    """Whether a setting can be called so on the wire."""
    return name.isascii() and name.isprintable() and 0 < len(name) <= LONGEST_NAME


def _number(text: str | None) -> int | float | None:
    try:
        number = None if text is None else parse_number(text.strip())
        return None if number is None or not math.isfinite(number) else number
    except (ValueError, OverflowError):  # of more digits than a float holds, too
        return None


def _whole(text: str) -> int:
    number = _number(text)
    return number if isinstance(number, int) else 0


def _value(text: str | None, wire_type: int) -> SettingValue | None:
    value: object = text if wire_type == MavParamExtType.CUSTOM else _number(text)
    try:
        return None if value is None else checked_setting("", value, wire_type)
    except InvalidArgument:
        return None


def _translated(setting: SettingDefinition, texts: Mapping[str, str]) -> SettingDefinition:
    def translated(option: SettingOption) -> SettingOption:
        ranges = tuple(each.replace(options=tuple(map(translated, each.options))) for each in option.ranges)
        return option.replace(name=texts.get(option.name, option.name), ranges=ranges)

    return setting.replace(
        description=texts.get(setting.description, setting.description),
        options=tuple(map(translated, setting.options)),
    )
