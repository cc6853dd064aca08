"""Camera definition files: types, ranges and options of a camera's settings, and their dependencies.

https://mavlink.io/en/services/camera_def.html
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator, Mapping
from itertools import islice
from types import MappingProxyType
from typing import TYPE_CHECKING

from aerokit._internal.files import MAX_FILE_SIZE, decompress, file_too_large, read_bounded
from aerokit._internal.formatting import did_you_mean, short_repr
from aerokit._internal.values import Snapshot
from aerokit.errors import FileFormatError, InvalidArgument
from aerokit.mavlink.enums import MavParamExtType
from aerokit.parameters.encoding import parse_number
from aerokit.parameters.parameter import SettingValue, checked_setting, setting_key, settings_equal

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

Values = Mapping[str, SettingValue]  # the known settings of a camera, by name

# Type names in files. ``string`` is not in the standard, but cameras use it.
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
OPERATORS = ("!=", ">=", "<=", "=", ">", "<")
MAX_SHOWN_OPTIONS = 20
MAX_NAME_LENGTH = 16
"""Maximum number of characters of a setting's name."""
# Real files have about 50 kB and 1,000 elements. Parsing much more would block the event loop.
MAX_DEFINITION_SIZE, MAX_ELEMENTS = 1 << 20, 20_000


class SettingRange(Snapshot):
    """A restriction of an option: while it is selected and ``condition`` holds, ``setting`` accepts only ``options``.

    ``condition`` has tests such as ``CAM_EXPMODE=1``, joined by AND and OR. An empty one always holds.
    """

    setting: str
    condition: str
    options: tuple[SettingOption, ...]


class SettingOption(Snapshot):
    """A value that a setting can have. While it is selected, the settings in ``excludes`` have no effect."""

    name: str
    value: SettingValue
    excludes: tuple[str, ...] = ()
    ranges: tuple[SettingRange, ...] = ()


class SettingDefinition(Snapshot):
    """Definition of one setting; None or empty for what the file does not define.

    ``type`` is the type name in the file (``"bool"``, ``"uint32"``, ``"float"`` …), ``wire_type`` the
    MAV_PARAM_EXT_TYPE. ``updates`` are settings that the camera may change together with this one. If ``is_control`` is
    False, a program should not display a control for it. ``step`` is enforced for whole numbers only.
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

    def convert(self, value: SettingValue) -> SettingValue:
        """Convert a value received from the camera: to ``bool`` if the setting has that type."""
        return bool(value) if self.type == "bool" and not isinstance(value, (str, bytes)) else value

    def option_of(self, value: SettingValue) -> SettingOption | None:
        """Return the option with this value, or None."""
        return next((option for option in self.options if settings_equal(option.value, value)), None)


class CameraDefinition(Snapshot):
    """A camera definition file: vendor and model, settings by name, and translations by locale."""

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
        """Return a copy with translated descriptions and option names, for example in ``"de_DE"`` or ``"de"``.

        Texts without a translation are unchanged.
        """
        found = self.translations.get(locale)
        if found is None:
            language = locale.partition("_")[0]
            alike = (name for name in self.translations if name.partition("_")[0] == language)
            found = self.translations.get(next(alike, ""))
        if not found:
            return self
        settings = {name: _translated(setting, found) for name, setting in self.settings.items()}
        return self.replace(settings=MappingProxyType(settings))

    # ---------------------------------------------------------------------------------- dependencies

    def dependencies(self, name: str) -> tuple[str, ...]:
        """Return the settings whose values restrict or exclude this one."""
        found: dict[str, None] = {}
        for setting in self.settings.values():
            for option in setting.options:
                if name in option.excludes:
                    found[setting.name] = None
                for restriction in option.ranges:
                    if restriction.setting == name:
                        found[setting.name] = None
                        tests = _tests(restriction.condition)
                        found.update((test[0], None) for test in tests if test[0] in self.settings)
        return tuple(other for other in found if other != name)

    def excluded_by(self, name: str, values: Values) -> tuple[str, ...]:
        """Return the selections that exclude a setting now, as texts such as ``CAM_EXPMODE = Auto``."""
        return tuple(
            f"{other.name} = {option.name}"
            for other, option in self._selected(values)
            if name in option.excludes and other.name != name
        )

    def options(self, name: str, values: Values) -> tuple[SettingOption, ...]:
        """Return the options that a setting has now; empty if any value in its range is allowed."""
        return self._options(name, values)[0]

    def _options(self, name: str, values: Values) -> tuple[tuple[SettingOption, ...], list[str]]:
        """Return the options, and the selections that restrict them."""
        own = self.settings.get(name)
        options = () if own is None else own.options
        reasons: list[str] = []
        keys: frozenset[object] = frozenset()
        for other, selected in self._selected(values):
            for restriction in selected.ranges:
                is_about_it = restriction.setting == name and other.name != name
                if is_about_it and _evaluate(restriction.condition, values):
                    allowed = restriction.options
                    if reasons:  # several restrictions apply together
                        allowed = tuple(option for option in allowed if setting_key(option.value) in keys)
                    options, keys = allowed, frozenset(setting_key(option.value) for option in allowed)
                    reasons.append(f"{other.name} = {selected.name}")
        return options, reasons

    def _selected(self, values: Values) -> Iterator[tuple[SettingDefinition, SettingOption]]:
        """Yield each setting with a known value, and its current option."""
        for name, definition in self.settings.items():
            option = definition.option_of(values[name]) if name in values else None
            if option is not None:
                yield definition, option

    # ----------------------------------------------------------------------------------------- checks

    def checked(self, name: str, value: object, values: Values) -> SettingValue:
        """Check a value, or the name of an option, given the other settings, and return the value to send.

        Raises:
            InvalidArgument: the setting is read-only, excluded now, or does not accept the value.
        """
        own = self.settings[name]
        if own.read_only:
            raise InvalidArgument(f"{name} = {short_repr(value)} is not allowed: it can only be read")
        reasons = self.excluded_by(name, values)
        if reasons:
            raise InvalidArgument(f"{name} = {short_repr(value)} is not allowed now: excluded by {', '.join(reasons)}")
        options, restricted_by = self._options(name, values)
        if options or restricted_by:
            return _check_option(own, value, options, restricted_by)
        return _check_range(own, value)


def load_definition(path: str | os.PathLike[str]) -> CameraDefinition:
    """Read a camera definition file, compressed (``.xz``) or not.

    If a setting is defined twice, the first definition counts. Invalid numbers and conditions are ignored.

    Raises:
        FileFormatError: the file is not a definition file, or has more than 1 MB (decompressed) or 20,000 elements.
        OSError: the file cannot be read.
    """
    return parse_definition(read_bounded(path), os.fspath(path))


def parse_definition(data: bytes, source: str = "camera definition") -> CameraDefinition:
    """Parse the content of a camera definition file. Errors begin with ``source``."""
    from xml.etree.ElementTree import ParseError

    from defusedxml import ElementTree as DefusedXml

    try:
        if len(data) > MAX_FILE_SIZE:
            raise file_too_large(source)
        content = decompress(data, source)
        if len(content) > MAX_DEFINITION_SIZE:
            raise FileFormatError(f"{source} is too large: more than {MAX_DEFINITION_SIZE >> 10} kB")
        root = DefusedXml.fromstring(content, forbid_dtd=True)
    except FileFormatError:
        raise
    except (ParseError, LookupError, ValueError) as error:
        raise FileFormatError(f"{source} is not a camera definition: {error!r}") from None
    if root.tag != "mavlinkcamera":
        raise FileFormatError(f"{source} is not a camera definition: its root element is <{root.tag[:100]}>")
    if next(islice(root.iter(), MAX_ELEMENTS, None), None) is not None:
        raise FileFormatError(f"{source} is too large: more than {MAX_ELEMENTS} elements")
    found = _Reader(root).definition()
    if not found.settings:
        raise FileFormatError(f"{source} defines no settings")
    return found


# ------------------------------------------------------------------------------------------ values


def _check_option(
    own: SettingDefinition, value: object, options: tuple[SettingOption, ...], restricted_by: list[str]
) -> SettingValue:
    by_name = {option.name: option.value for option in options}
    if isinstance(value, str) and value in by_name:
        return by_name[value]
    if not isinstance(value, str) or own.wire_type == MavParamExtType.CUSTOM:
        wanted = checked_setting(own.name, value, own.wire_type)
        for option in options:
            if settings_equal(option.value, wanted):
                return option.value
    now = f" while {', '.join(restricted_by)}" if restricted_by else ""
    shown = list(by_name.items())[:MAX_SHOWN_OPTIONS]
    names = ", ".join(f"{name!r} ({short_repr(known)})" for name, known in shown)
    more = f" and {len(by_name) - MAX_SHOWN_OPTIONS} more" if len(by_name) > MAX_SHOWN_OPTIONS else ""
    raise InvalidArgument(
        f"{own.name} = {short_repr(value)} is not allowed{now}: {names or 'nothing'}{more}"
        + did_you_mean(value, by_name)
    )


def _check_range(own: SettingDefinition, value: object) -> SettingValue:
    number = checked_setting(own.name, value, own.wire_type)
    if isinstance(number, (str, bytes)):
        return number
    if own.type == "bool":
        if number not in (0, 1):
            raise InvalidArgument(f"{own.name} = {short_repr(value)} is not allowed: True or False")
        return bool(number)
    low, high, step = own.minimum, own.maximum, own.step
    is_below = low is not None and number < low and not settings_equal(number, low)
    is_above = high is not None and number > high and not settings_equal(number, high)
    if is_below or is_above:
        bounds = f"{'' if low is None else f'{low:g}'}..{'' if high is None else f'{high:g}'}"
        raise InvalidArgument(f"{own.name} = {short_repr(value)} is not allowed: {bounds}")
    if isinstance(number, int) and isinstance(step, int) and step > 1:
        first = low if isinstance(low, int) else 0
        if (number - first) % step:
            raise InvalidArgument(
                f"{own.name} = {short_repr(value)} is not allowed: {first}, {first + step}, {first + 2 * step} …"
            )
    return number


# -------------------------------------------------------------------------------------- conditions


def _tests(condition: str) -> list[tuple[str, str, str, str]]:
    """Parse into (setting, operator, value, AND or OR with the tests before); ValueError for a malformed condition."""
    tests = []
    joiner, words = "AND", list[str]()
    for word in (*condition.split(), "AND") if condition else ():
        if word not in ("AND", "OR"):
            words.append(word)
            continue
        text = "".join(words)
        operator = next((candidate for candidate in OPERATORS if candidate in text), None)
        if operator is None:
            raise ValueError(f"{condition!r} is not a condition")
        name, _, value = text.partition(operator)
        tests.append((name, operator, value, joiner))
        joiner, words = word, []
    return tests


def _evaluate(condition: str, values: Values) -> bool:
    """Evaluate from left to right. A test of an unknown setting is False."""
    result = True
    for name, operator, value, joiner in _tests(condition):
        is_true = name in values and _compare(values[name], operator, value)
        result = (result and is_true) if joiner == "AND" else (result or is_true)
    return result


def _compare(value: SettingValue, operator: str, text: str) -> bool:
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
    """Reads the elements of a definition file, ignoring invalid ones."""

    def __init__(self, root: Element) -> None:
        self._root = root
        nodes = list(root.iterfind("parameters/parameter"))
        self._types = {node.get("name", ""): TYPES.get(node.get("type", "")) for node in reversed(nodes)}

    def definition(self) -> CameraDefinition:
        root, head = self._root, self._root.find("definition")
        settings: dict[str, SettingDefinition] = {}
        for node in root.iterfind("parameters/parameter"):
            found = self._setting(node)
            if found is not None:
                settings.setdefault(found.name, found)
        return CameraDefinition(
            vendor=_text(None if head is None else head.find("vendor")),
            model=_text(None if head is None else head.find("model")),
            version=_int_or_zero("" if head is None else head.get("version", "")),
            settings=MappingProxyType(settings),
            translations=MappingProxyType(
                {
                    node.get("name", ""): MappingProxyType(
                        {text.get("original", ""): text.get("translated", "") for text in node.iterfind("strings")}
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
                _evaluate(condition, {})
            except ValueError:
                continue
            if wire_type is not None:
                found = (
                    (option.get("name", ""), _value(option.get("value"), wire_type))
                    for option in node.iterfind("roption")
                )
                options = tuple(SettingOption(name, value) for name, value in found if value is not None)
                yield SettingRange(setting, condition, options)


def _text(node: Element | None) -> str:
    return "" if node is None else " ".join((node.text or "").split())


def _texts(nodes: Iterable[Element]) -> Iterator[str]:
    return filter(None, map(_text, nodes))


def _is_name(name: str) -> bool:
    return name.isascii() and name.isprintable() and 0 < len(name) <= MAX_NAME_LENGTH


def _number(text: str | None) -> int | float | None:
    try:
        number = None if text is None else parse_number(text.strip())
        return None if number is None or not math.isfinite(number) else number
    except (ValueError, OverflowError):  # also for more digits than a float can hold
        return None


def _int_or_zero(text: str) -> int:
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
        ranges = tuple(limit.replace(options=tuple(map(translated, limit.options))) for limit in option.ranges)
        return option.replace(name=texts.get(option.name, option.name), ranges=ranges)

    return setting.replace(
        description=texts.get(setting.description, setting.description),
        options=tuple(map(translated, setting.options)),
    )
