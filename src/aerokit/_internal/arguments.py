"""``checks_arguments``: public methods refuse an argument of a wrong type before they do anything.

Only what leads to a vehicle, a network or a link is checked: values come from keyboards, files and JSON, programs run
without a type checker, and a wrong one must not stop an order half-way. Nor do type checkers see an empty time-out or
a text where several names are meant. Reading logs, arithmetic with places and the like have Python's own errors.

What is allowed is what the annotations say; they are read as text, so that nothing is imported for it. A class of ours
is known by its name, callables, mappings and iterables by what they can do. What is called a time by its name is above
zero. Other ranges, and whatever else a method knows better, are its own business.
"""

from __future__ import annotations

import ast
import inspect
import os
from collections.abc import Callable, Iterable, Mapping
from functools import partial, wraps
from numbers import Integral, Real
from types import UnionType
from typing import Any, Literal, TypeVar, get_args, get_origin

from aerokit._internal.wording import one, shown
from aerokit.errors import InvalidArgument, LinkOpenError

FunctionT = TypeVar("FunctionT", bound=Callable[..., Any])

ClassT = TypeVar("ClassT")

Check = Callable[[Any], bool]
"""Whether a value is allowed."""

Rule = tuple[Check, str]
"""The same, and what is allowed in words."""

_TEXTS = (str, bytes, bytearray)

_SIMPLE: dict[str, Rule] = {
    "float": (lambda value: isinstance(value, Real), "a number"),
    "int": (lambda value: isinstance(value, Integral), "a whole number"),
    "bool": (lambda value: isinstance(value, bool), "True or False"),
    "str": (lambda value: isinstance(value, str), "a text"),
    "bytes": (lambda value: isinstance(value, (bytes, bytearray)), "bytes"),
    "None": (lambda value: value is None, "None"),
    "Callable": (callable, "a function"),
    "OnProgress": (callable, "a function"),
    "Peers": (lambda _: True, "addresses and networks"),  # links know better, and say so
    "PathLike": (lambda value: isinstance(value, os.PathLike), "a path"),
}


def _is_above_zero(value: Any) -> bool:
    try:
        return isinstance(value, Real) and float(value) > 0
    except OverflowError:
        return False


_SECONDS: dict[str, Rule] = {
    "float": (_is_above_zero, "seconds above 0"),
    "float | None": (lambda value: value is None or _is_above_zero(value), "seconds above 0, or None"),
}


def checks_arguments(cls: type[ClassT]) -> type[ClassT]:
    """Have all public methods of a class check their arguments; InvalidArgument names the first wrong one."""
    for name, member in list(vars(cls).items()):
        if not name.startswith("_") and inspect.isfunction(member):
            setattr(cls, name, checked(member, times_are_above_zero=True))
    return cls


def checked(function: FunctionT, *, times_are_above_zero: bool = False) -> FunctionT:
    """The same of one function or method; a time of zero may mean there: do not wait."""
    rules = _Rules(inspect.unwrap(function), times_are_above_zero)
    if inspect.iscoroutinefunction(function):

        @wraps(function)
        async def awaiting(*args: Any, **kwargs: Any) -> Any:
            rules.check(args, kwargs)
            return await function(*args, **kwargs)

        return awaiting  # type: ignore[return-value]  # of the same signature

    @wraps(function)
    def calling(*args: Any, **kwargs: Any) -> Any:
        rules.check(args, kwargs)
        try:
            return function(*args, **kwargs)
        except LinkOpenError as error:  # where in here it came from says nothing to a program
            raise error.with_traceback(None) from error.__cause__

    return calling  # type: ignore[return-value]  # the same


class _Rules:
    """What the arguments of one function may be; worked out at its first call."""

    def __init__(self, function: Callable[..., Any], times_are_above_zero: bool) -> None:
        self._function, self._times_are_above_zero = function, times_are_above_zero
        self._by_name: dict[str, Rule] | None = None
        self._in_order: tuple[str, ...] = ()
        self._rest = ""

    def check(self, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> None:
        rules = self._read() if self._by_name is None else self._by_name
        for name, value in zip(self._in_order, args):  # noqa: B905 - too many of them are Python's to refuse
            if name in rules:
                _complain_unless(rules[name], name, value)
        if self._rest:
            for value in args[len(self._in_order) :]:
                _complain_unless(rules[self._rest], self._rest, value)
        for name, value in kwargs.items():
            if name in rules:
                _complain_unless(rules[name], name, value)

    def _read(self) -> dict[str, Rule]:
        parameters = inspect.signature(self._function).parameters.values()
        rules = {each.name: self._rule(each) for each in parameters if each.annotation is not each.empty}
        self._in_order = tuple(each.name for each in parameters if each.kind is each.POSITIONAL_OR_KEYWORD)
        self._rest = next((each.name for each in parameters if each.kind is each.VAR_POSITIONAL), "")
        self._by_name = rules
        return rules

    def _rule(self, parameter: inspect.Parameter) -> Rule:
        if self._times_are_above_zero and _is_time(parameter):
            return _SECONDS[str(parameter.annotation)]
        return _rule(ast.parse(str(parameter.annotation), mode="eval").body, self._function.__globals__)


def _is_time(parameter: inspect.Parameter) -> bool:
    """Seconds to wait, by its name: not metres or degrees a second."""
    name, is_speed = parameter.name, parameter.name.endswith(("m_s", "deg_s"))
    return str(parameter.annotation) in _SECONDS and name.endswith(("timeout", "_s")) and not is_speed


def _complain_unless(rule: Rule, name: str, value: object) -> None:
    check, allowed = rule
    if not check(value):
        raise InvalidArgument(f"{name} = {shown(value)} is not allowed: {allowed}")


# ------------------------------------------------------------------------------------- annotations
def _rule(node: ast.expr, names: Mapping[str, Any]) -> Rule:
    """What an annotation allows, and that in words."""
    if isinstance(node, ast.BinOp):
        (one, first), (other, second) = _rule(node.left, names), _rule(node.right, names)
        return (lambda value: one(value) or other(value)), f"{first} or {second}"
    if isinstance(node, ast.Constant):
        return _SIMPLE["None"]
    if isinstance(node, ast.Subscript):
        return _generic_rule(_name_of(node.value), node.slice, names)
    return _named_rule(_name_of(node), names)


def _name_of(node: ast.expr) -> str:
    return node.attr if isinstance(node, ast.Attribute) else node.id if isinstance(node, ast.Name) else ""


def _named_rule(name: str, names: Mapping[str, Any]) -> Rule:
    if name in _SIMPLE:
        return _SIMPLE[name]
    found = names.get(name)
    if isinstance(found, type):
        return (lambda value: isinstance(value, found)), one(name)
    if get_origin(found) is Literal:
        choices = get_args(found)
        return partial(_is_one_of, choices), f"one of {', '.join(map(str, choices))}"
    if isinstance(found, UnionType):
        kinds = tuple(get_origin(each) or each for each in get_args(found))
        return (lambda value: isinstance(value, kinds)), " or ".join(each.__name__ for each in kinds)
    if name in ("Any", "object") or isinstance(found, TypeVar):
        return _anything, "anything"
    return partial(_is_ours, name), one(name)


def _generic_rule(name: str, inner: ast.expr, names: Mapping[str, Any]) -> Rule:
    if name in _SIMPLE:  # Callable[[int], None], PathLike[str]
        return _SIMPLE[name]
    parts = inner.elts if isinstance(inner, ast.Tuple) else [inner]
    rules = [_rule(part, names) for part in parts]
    if name == "type":
        kinds = _class_names(_name_of(parts[0]), names)
        return partial(_is_class, kinds), f"a class{' of ' if kinds else ''}{' or '.join(kinds)}"
    if name == "Mapping":
        (of_keys, _), (of_values, words) = rules
        return partial(_is_mapping, of_keys, of_values), f"a mapping to {words} each"
    if name in ("Iterable", "Sequence", "list", "tuple"):
        return partial(_are, rules[0][0]), f"several, each {rules[0][1]}"
    return partial(_is_ours, name), one(name)


def _class_names(name: str, names: Mapping[str, Any]) -> tuple[str, ...]:
    """What a ``type[name]`` is a class of; nothing when any class will do."""
    found = names.get(name)
    if not isinstance(found, TypeVar):
        return () if name == "Any" else (name,)
    bound = found.__bound__
    if bound is None or isinstance(bound, type):
        return () if bound is None else (bound.__name__,)
    return tuple(bound.__forward_arg__.split(" | "))


def _anything(_value: object) -> bool:
    return True


def _is_one_of(choices: tuple[object, ...], value: object) -> bool:
    return isinstance(value, type(choices[0])) and value in choices


def _is_ours(name: str, value: object) -> bool:
    return any(each.__name__ == name for each in type(value).__mro__)


def _is_class(names: tuple[str, ...], value: object) -> bool:
    return isinstance(value, type) and (not names or any(each.__name__ in names for each in value.__mro__))


def _is_mapping(of_keys: Check, of_values: Check, value: object) -> bool:
    return isinstance(value, Mapping) and all(of_keys(key) and of_values(value[key]) for key in value)


def _are(of_each: Check, value: object) -> bool:
    """Texts have parts, too, and are never meant; what can be gone through once only is left alone."""
    if isinstance(value, _TEXTS) or not isinstance(value, Iterable):
        return False
    return not isinstance(value, (list, tuple, set, frozenset)) or all(map(of_each, value))


def check_kind(name: str, value: object, kind: type) -> None:
    """Raise InvalidArgument unless ``value`` is of that class: where type hints say "of the same kind" only."""
    if not isinstance(value, kind):
        raise InvalidArgument(f"{name} = {shown(value)} is not allowed: {one(kind.__name__)}")


def check_range(name: str, value: float, lowest: float, highest: float, *, above: bool = False) -> None:
    """Raise InvalidArgument unless ``value`` is from ``lowest`` (with ``above``: above it) to ``highest``."""
    try:
        is_allowed = lowest <= value <= highest and not (above and value == lowest)
    except TypeError:
        is_allowed = False
    if not is_allowed:
        begin = f"above {lowest:g}" if above else f"{lowest:g}"
        raise InvalidArgument(f"{name} = {shown(value)} is not allowed: {begin} to {highest:g}")
