"""Camera definition files: types, ranges and options of a camera's settings, and their dependencies.

https://mavlink.io/en/services/camera_def.html
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from itertools import islice
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

from aerokit._internal.files import MAX_FILE_SIZE, decompress, file_too_large, read_bounded
from aerokit._internal.formatting import did_you_mean, short_repr
from aerokit._internal.values import Snapshot
from aerokit.errors import FileFormatError, InvalidArgument
from aerokit.mavlink.enums import MavParamExtType
from aerokit.parameters.encoding import number_or_none
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
    """A restriction that an option imposes on another setting.

    While the option is selected and ``condition`` holds, ``setting`` accepts only ``options``.

    ``condition`` has tests such as ``CAM_EXPMODE=1``, joined by AND and OR. An empty condition always holds.
    """

    setting: str
    condition: str
    options: tuple[SettingOption, ...]


class SettingOption(Snapshot):
    """A value that a setting can have. While this option is selected, the settings in ``excludes`` have no effect."""

    name: str
    value: SettingValue
    excludes: tuple[str, ...] = ()
    ranges: tuple[SettingRange, ...] = ()


class SettingDefinition(Snapshot):
    """Definition of one setting. Fields that the file does not define are None or empty.

    ``type`` is the type name in the file (``"bool"``, ``"uint32"``, ``"float"`` …), and ``wire_type`` is the
    MAV_PARAM_EXT_TYPE. ``updates`` are settings that the camera may change together with this setting. If
    ``is_control`` is False, a program should not display a control for it. ``step`` is enforced for whole numbers only.
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
        """Convert a value received from the camera to a ``bool`` if the setting has this type."""
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
        texts = self.translations.get(locale)
        if texts is None:
            language = locale.partition("_")[0]
            same_language = (name for name in self.translations if name.partition("_")[0] == language)
            texts = self.translations.get(next(same_language, ""))
        if not texts:
            return self
        settings = {name: _translated(setting, texts) for name, setting in self.settings.items()}
        return self.replace(settings=MappingProxyType(settings))

    # ---------------------------------------------------------------------------------- dependencies

    def dependencies(self, name: str) -> tuple[str, ...]:
        """Return the settings whose values restrict or exclude this setting."""
        names: list[str] = []
        for setting in self.settings.values():
            for option in setting.options:
                if name in option.excludes:
                    names.append(setting.name)
                for restriction in option.ranges:
                    if restriction.setting == name:
                        names.append(setting.name)
                        tests = _parse_condition(restriction.condition)
                        names += [test.setting for test in tests if test.setting in self.settings]
        unique_names = dict.fromkeys(names)
        return tuple(dependency for dependency in unique_names if dependency != name)

    def excluded_by(self, name: str, values: Values) -> tuple[str, ...]:
        """Return the selected options that exclude a setting, for example ``("CAM_EXPMODE = Auto",)``."""
        return tuple(
            f"{setting.name} = {option.name}"
            for setting, option in self._selected(values)
            if name in option.excludes and setting.name != name
        )

    def options(self, name: str, values: Values) -> tuple[SettingOption, ...]:
        """Return the options that a setting has now; empty if every value in its range is allowed."""
        options, _ = self._options(name, values)
        return options

    def _options(self, name: str, values: Values) -> tuple[tuple[SettingOption, ...], list[str]]:
        """Return a setting's present options, and what restricts them, e.g. ``CAM_EXPMODE = Auto``."""
        options = self.settings[name].options if name in self.settings else ()
        reasons: list[str] = []
        for setting, selected in self._selected(values):
            if setting.name == name:  # The value of a setting does not limit its own options.
                continue
            for restriction in selected.ranges:
                if restriction.setting != name or not _evaluate(restriction.condition, values):
                    continue
                allowed = restriction.options
                if reasons:  # An earlier restriction applies as well, so only options that all of them allow remain.
                    previous_keys = {setting_key(option.value) for option in options}
                    allowed = tuple(option for option in allowed if setting_key(option.value) in previous_keys)
                options = allowed
                reasons.append(f"{setting.name} = {selected.name}")
        return options, reasons

    def _selected(self, values: Values) -> Iterator[tuple[SettingDefinition, SettingOption]]:
        """Yield each setting with a known value, and its current option."""
        for name, definition in self.settings.items():
            option = definition.option_of(values[name]) if name in values else None
            if option is not None:
                yield definition, option

    # ----------------------------------------------------------------------------------------- checks

    def checked(self, name: str, value: object, values: Values) -> SettingValue:
        """Check a value, or the name of an option, against the values of other settings, and return the value to send.

        Raises:
            InvalidArgument: the setting is read-only, excluded now, or does not accept the value.
        """
        setting = self.settings[name]
        if setting.read_only:
            raise InvalidArgument(f"{name} = {short_repr(value)} is not allowed: it can only be read")
        reasons = self.excluded_by(name, values)
        if reasons:
            raise InvalidArgument(
                f"{name} = {short_repr(value)} is not allowed now: the setting is excluded by {', '.join(reasons)}"
            )
        options, restricted_by = self._options(name, values)
        if options or restricted_by:
            return _check_option(setting, value, options, restricted_by)
        return _check_range(setting, value)


def load_definition(path: str | os.PathLike[str]) -> CameraDefinition:
    """Read a camera definition file, compressed (``.xz``) or not.

    If a setting is defined twice, the first definition counts. Invalid numbers and conditions are ignored.

    Raises:
        FileFormatError: the file is not a definition file, or has more than 1 MB (decompressed) or 20,000 elements.
        OSError: the file cannot be read.
    """
    return parse_definition(read_bounded(path), os.fspath(path))


def parse_definition(data: bytes, source: str = "camera definition") -> CameraDefinition:
    """Parse the content of a camera definition file. Error texts begin with ``source``."""
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
    has_more_elements = next(islice(root.iter(), MAX_ELEMENTS, None), None) is not None
    if has_more_elements:
        raise FileFormatError(f"{source} is too large: more than {MAX_ELEMENTS} elements")
    definition = _Reader(root).definition()
    if not definition.settings:
        raise FileFormatError(f"{source} defines no settings")
    return definition


# ------------------------------------------------------------------------------------------ values


def _check_option(
    setting: SettingDefinition, value: object, options: tuple[SettingOption, ...], restricted_by: list[str]
) -> SettingValue:
    by_name = {option.name: option.value for option in options}
    if isinstance(value, str) and value in by_name:
        return by_name[value]
    # A text that is not the name of an option is allowed only for the custom type.
    if not isinstance(value, str) or setting.wire_type == MavParamExtType.CUSTOM:
        wire_value = checked_setting(setting.name, value, setting.wire_type)
        for option in options:
            if settings_equal(option.value, wire_value):
                return option.value
    restriction = f" while {', '.join(restricted_by)}" if restricted_by else ""
    shown = list(by_name.items())[:MAX_SHOWN_OPTIONS]
    names = ", ".join(f"{name!r} ({short_repr(option_value)})" for name, option_value in shown)
    more = f" and {len(by_name) - MAX_SHOWN_OPTIONS} more" if len(by_name) > MAX_SHOWN_OPTIONS else ""
    one_of = "one of " if len(by_name) > 1 else ""
    allowed = f"it must be {one_of}{names}{more}" if names else "no value is allowed"
    raise InvalidArgument(
        f"{setting.name} = {short_repr(value)} is not allowed{restriction}: {allowed}" + did_you_mean(value, by_name)
    )


def _check_range(setting: SettingDefinition, value: object) -> SettingValue:
    number = checked_setting(setting.name, value, setting.wire_type)
    if isinstance(number, (str, bytes)):
        return number
    if setting.type == "bool":
        if number not in (0, 1):
            raise InvalidArgument(f"{setting.name} = {short_repr(value)} is not allowed: it must be True or False")
        return bool(number)
    low, high, step = setting.minimum, setting.maximum, setting.step
    # A value that equals a limit as a 32-bit float is allowed.
    is_below = low is not None and number < low and not settings_equal(number, low)
    is_above = high is not None and number > high and not settings_equal(number, high)
    if is_below or is_above:
        lowest, highest = ("" if limit is None else f"{limit:g}" for limit in (low, high))
        raise InvalidArgument(f"{setting.name} = {short_repr(value)} is not allowed: it must be {lowest}..{highest}")
    # An integer must be a multiple of the step, counted from the minimum.
    if isinstance(number, int) and isinstance(step, int) and step > 1:
        base = low if isinstance(low, int) else 0
        if (number - base) % step:
            raise InvalidArgument(
                f"{setting.name} = {short_repr(value)} is not allowed: it must be {base}, {base + step},"
                f" {base + 2 * step} …"
            )
    return number


# -------------------------------------------------------------------------------------- conditions


class _Test(NamedTuple):
    setting: str
    operator: str
    value: str
    joiner: str  # "AND" or "OR": combines the test with the result of all tests before it


def _parse_condition(condition: str) -> list[_Test]:
    """Parse a condition. Raises ValueError if it is malformed."""
    if not condition:
        return []
    tests = []
    joiner = "AND"
    words: list[str] = []
    for word in (*condition.split(), "AND"):  # The added AND ends the last test.
        if word not in ("AND", "OR"):
            words.append(word)
            continue
        text = " ".join(words)
        operator = next((candidate for candidate in OPERATORS if candidate in text), None)
        if operator is None:
            raise ValueError(f"{condition!r} is not a condition")
        name, _, value = text.partition(operator)
        tests.append(_Test(name.strip(), operator, value.strip(), joiner))
        joiner, words = word, []
    return tests


def _evaluate(condition: str, values: Values) -> bool:
    """Evaluate a condition from left to right. A test of an unknown setting is False."""
    result = True
    for test in _parse_condition(condition):
        is_true = test.setting in values and _compare(values[test.setting], test.operator, test.value)
        result = (result and is_true) if test.joiner == "AND" else (result or is_true)
    return result


def _compare(value: SettingValue, operator: str, text: str) -> bool:
    """Evaluate one test. Comparing a number with a text gives False."""
    operand = text if isinstance(value, (str, bytes)) else number_or_none(text)
    if operand is None:
        return False
    # Do not use ==, because a value sent as a 32-bit float differs a little from the decimal number in the file.
    is_equal = settings_equal(value, operand)
    if operator in ("=", "!="):
        return is_equal if operator == "=" else not is_equal
    if isinstance(value, (str, bytes)) or isinstance(operand, str):  # Texts have no order.
        return False
    if is_equal:
        return operator in (">=", "<=")
    return value > operand if operator in (">", ">=") else value < operand


# ----------------------------------------------------------------------------------------- the file


class _Reader:
    """Reads the elements of a definition file, ignoring invalid ones."""

    def __init__(self, root: Element) -> None:
        self._root = root
        nodes = list(root.iterfind("parameters/parameter"))
        # The order is reversed, so that the first definition counts if a setting is defined several times.
        self._types = {node.get("name", ""): TYPES.get(node.get("type", "")) for node in reversed(nodes)}

    def definition(self) -> CameraDefinition:
        root, head = self._root, self._root.find("definition")
        settings: dict[str, SettingDefinition] = {}
        for node in root.iterfind("parameters/parameter"):
            setting = self._setting(node)
            if setting is not None:
                settings.setdefault(setting.name, setting)  # the first definition counts
        translations: dict[str, Mapping[str, str]] = {}
        for node in root.iterfind("localization/locale"):
            texts = {text.get("original", ""): text.get("translated", "") for text in node.iterfind("strings")}
            translations[node.get("name", "")] = MappingProxyType(texts)
        return CameraDefinition(
            vendor=_text(None if head is None else head.find("vendor")),
            model=_text(None if head is None else head.find("model")),
            version=_int_or_zero("" if head is None else head.get("version", "")),
            settings=MappingProxyType(settings),
            translations=MappingProxyType(translations),
        )

    def _setting(self, node: Element) -> SettingDefinition | None:
        name, kind = node.get("name", ""), node.get("type", "")
        if not _is_name(name) or kind not in TYPES:
            return None
        wire_type = TYPES[kind]
        default = _parse_value(node.get("default"), wire_type)
        return SettingDefinition(
            name,
            kind,
            wire_type,
            description=_text(node.find("description")),
            default=bool(default) if kind == "bool" and default is not None else default,
            minimum=number_or_none(node.get("min")),
            maximum=number_or_none(node.get("max")),
            step=number_or_none(node.get("step")),
            options=tuple(self._options(node.iterfind("options/option"), wire_type)),
            updates=tuple(filter(_is_name, _texts(node.iterfind("updates/update")))),
            is_control=node.get("control", "1") not in ("0", "false"),
            read_only=node.get("readonly", "0") in ("1", "true"),
            write_only=node.get("writeonly", "0") in ("1", "true"),
        )

    def _options(self, nodes: Iterable[Element], wire_type: int) -> Iterator[SettingOption]:
        for node in nodes:
            value = _parse_value(node.get("value"), wire_type)
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
                _parse_condition(condition)
            except ValueError:
                continue
            if wire_type is not None:
                names_and_values = [
                    (option.get("name", ""), _parse_value(option.get("value"), wire_type))
                    for option in node.iterfind("roption")
                ]
                options = tuple(SettingOption(name, value) for name, value in names_and_values if value is not None)
                yield SettingRange(setting, condition, options)


def _text(node: Element | None) -> str:
    return "" if node is None else " ".join((node.text or "").split())


def _texts(nodes: Iterable[Element]) -> Iterator[str]:
    return filter(None, map(_text, nodes))


def _is_name(name: str) -> bool:
    return name.isascii() and name.isprintable() and 0 < len(name) <= MAX_NAME_LENGTH


def _int_or_zero(text: str) -> int:
    number = number_or_none(text)
    return number if isinstance(number, int) else 0


def _parse_value(text: str | None, wire_type: int) -> SettingValue | None:
    """Parse a value of this MAV_PARAM_EXT_TYPE. Return None if it does not fit."""
    value: object = text if wire_type == MavParamExtType.CUSTOM else number_or_none(text)
    try:
        return None if value is None else checked_setting("", value, wire_type)
    except InvalidArgument:
        return None


def _translated(setting: SettingDefinition, texts: Mapping[str, str]) -> SettingDefinition:
    """Translate the texts of a setting. ``texts`` maps original texts to translations."""

    def translated(option: SettingOption) -> SettingOption:
        ranges = tuple(
            restriction.replace(options=tuple(map(translated, restriction.options))) for restriction in option.ranges
        )
        return option.replace(name=texts.get(option.name, option.name), ranges=ranges)

    return setting.replace(
        description=texts.get(setting.description, setting.description),
        options=tuple(map(translated, setting.options)),
    )
