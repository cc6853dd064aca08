"""Run-time checks of arguments: public methods reject values of a wrong type before they do anything.

Only calls that lead to a vehicle, a network or a link are checked, because a wrong value must not stop a command
half-way. Type checkers do not suffice: values come from keyboards, files and JSON, many programs run without a type
checker, and type checkers accept a timeout of 0, or one string where several names are expected. Other functions raise
Python's own errors.

The annotations define what is allowed. They are evaluated as text, so that the checks import nothing: a class of this
package is compared by name; a callable, mapping or iterable by its protocol. Parameters whose names denote a time must
be above zero. Methods check other ranges themselves.
"""

from __future__ import annotations

import ast
import inspect
import math
import os
from collections.abc import Callable, Iterable, Mapping
from functools import partial, wraps
from itertools import chain
from numbers import Integral, Real
from types import UnionType
from typing import Any, Literal, TypeVar, get_args, get_origin

from aerokit._internal.formatting import short_repr, with_article
from aerokit.errors import InvalidArgument, LinkOpenError

FunctionT = TypeVar("FunctionT", bound=Callable[..., Any])
ClassT = TypeVar("ClassT")

# A rule consists of a check and of a text that describes the valid values and completes "it must be …".
Check = Callable[[Any], bool]
Rule = tuple[Check, str]

# Maps an annotation to the check of its values, and to the description of valid values.
_SIMPLE_RULES: dict[str, Rule] = {
    "float": (lambda value: isinstance(value, Real), "a number"),
    "int": (lambda value: isinstance(value, Integral), "a whole number"),
    "bool": (lambda value: isinstance(value, bool), "True or False"),
    "str": (lambda value: isinstance(value, str), "a text"),
    "bytes": (lambda value: isinstance(value, (bytes, bytearray)), "bytes"),
    "None": (lambda value: value is None, "None"),
    "Callable": (callable, "a function"),
    "OnProgress": (callable, "a function"),
    "TargetSource": (
        lambda value: callable(value) or hasattr(value, "__aiter__"),
        "a function or an asynchronous iterable",
    ),
    "PeerFilter": (lambda _: True, "addresses and networks"),  # Links refuse a wrong filter themselves.
    "PathLike": (lambda value: isinstance(value, os.PathLike), "a path"),
}


def _is_above_zero(value: Any) -> bool:
    try:
        return isinstance(value, Real) and float(value) > 0
    except OverflowError:
        return False


# Like `_SIMPLE_RULES`, but for parameters that denote a time.
_SECONDS: dict[str, Rule] = {
    "float": (_is_above_zero, "a number of seconds above 0"),
    "float | None": (lambda value: value is None or _is_above_zero(value), "a number of seconds above 0, or None"),
}


def checks_arguments(cls: type[ClassT]) -> type[ClassT]:
    """Class decorator that checks the arguments of the class's own public methods.

    Inherited methods, static methods, class methods and properties are not checked. Durations must be above 0.
    """
    for name, member in list(vars(cls).items()):
        if not name.startswith("_") and inspect.isfunction(member):
            setattr(cls, name, checked(member, times_are_above_zero=True))
    return cls


def checked(function: FunctionT, *, times_are_above_zero: bool = False) -> FunctionT:
    """Decorator that raises InvalidArgument for arguments that do not fit their annotations.

    With ``times_are_above_zero``, times must be above 0.
    """
    rules = _Rules(inspect.unwrap(function), times_are_above_zero)
    if inspect.iscoroutinefunction(function):

        @wraps(function)
        async def checked_async(*args: Any, **kwargs: Any) -> Any:
            rules.check(args, kwargs)
            return await function(*args, **kwargs)

        return checked_async  # type: ignore[return-value]  # same signature

    @wraps(function)
    def checked_sync(*args: Any, **kwargs: Any) -> Any:
        rules.check(args, kwargs)
        try:
            return function(*args, **kwargs)
        except LinkOpenError as error:  # A traceback through the code of this library does not help a user.
            raise error.with_traceback(None) from error.__cause__

    return checked_sync  # type: ignore[return-value]  # same signature


class _Rules:
    """Rules for the arguments of one function, computed at its first call."""

    def __init__(self, function: Callable[..., Any], times_are_above_zero: bool) -> None:
        self._function, self._times_are_above_zero = function, times_are_above_zero
        self._by_name: dict[str, Rule] | None = None  # rules by parameter name; None before the first call
        self._positional: tuple[str, ...] = ()  # names of the positional parameters
        self._var_positional = ""  # name of the parameter ``*args``; "" if there is none

    def check(self, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> None:
        """Raise InvalidArgument if a value in a call of the function is not allowed."""
        rules = self._compute() if self._by_name is None else self._by_name
        names = self._positional
        if self._var_positional:
            names += (self._var_positional,) * (len(args) - len(names))
        # This loop runs for each message that a program sends or reads. To be fast, it copies nothing unless a value is
        # wrong.
        for name, value in chain(zip(names, args), kwargs.items()):  # noqa: B905 - Python rejects surplus arguments
            if name not in rules:
                continue
            is_allowed, _ = rules[name]
            if not is_allowed(value):
                call_arguments = {**dict(zip(names, args)), **kwargs}  # noqa: B905 - as above
                # In set(name=…, value=…), the argument `name` is a vehicle parameter, which the error should name.
                raise _error(rules[name], name, value, vehicle_parameter=call_arguments.get("name"))

    def _compute(self) -> dict[str, Rule]:
        parameters = inspect.signature(self._function).parameters.values()
        rules = {param.name: self._rule(param) for param in parameters if param.annotation is not param.empty}
        self._positional = tuple(param.name for param in parameters if param.kind is param.POSITIONAL_OR_KEYWORD)
        self._var_positional = next((param.name for param in parameters if param.kind is param.VAR_POSITIONAL), "")
        self._by_name = rules
        return rules

    def _rule(self, parameter: inspect.Parameter) -> Rule:
        if self._times_are_above_zero and _is_time(parameter):
            return _SECONDS[str(parameter.annotation)]
        return _rule(ast.parse(str(parameter.annotation), mode="eval").body, self._function.__globals__)


def _is_time(parameter: inspect.Parameter) -> bool:
    is_speed = parameter.name.endswith(("m_s", "deg_s"))
    has_time_name = parameter.name.endswith(("timeout", "_s")) and not is_speed
    return has_time_name and str(parameter.annotation) in _SECONDS


def _error(rule: Rule, argument: str, value: object, vehicle_parameter: object) -> InvalidArgument:
    """Create the error for an invalid argument.

    ``vehicle_parameter`` is "RTL_ALT" for ``set(name="RTL_ALT", value="abc")``. Other calls have none.
    """
    check, allowed = rule
    hint = _hint(check, value)
    if argument == "value" and isinstance(vehicle_parameter, str):
        return InvalidArgument(
            f"value = {short_repr(value)} of {vehicle_parameter[:40]} is not allowed: it must be {allowed}{hint}"
        )
    return InvalidArgument(f"{argument} = {short_repr(value)} is not allowed: it must be {allowed}{hint}")


def _hint(check: Check, value: object) -> str:
    """Return the hint to pass ``.value`` if a state cell was given in place of its value; else ""."""
    latest = getattr(value, "latest", None)
    return "; pass its .value" if latest is not None and check(latest) else ""


# ------------------------------------------------------------------------------------- annotations


def _rule(node: ast.expr, module_globals: Mapping[str, Any]) -> Rule:
    if isinstance(node, ast.BinOp):
        is_left, left_text = _rule(node.left, module_globals)
        is_right, right_text = _rule(node.right, module_globals)
        return (lambda value: is_left(value) or is_right(value)), f"{left_text} or {right_text}"
    # In our annotations, a constant is None or the `...` of tuple[X, ...]. The rule of `...` is not used.
    if isinstance(node, ast.Constant):
        return _SIMPLE_RULES["None"]
    if isinstance(node, ast.Subscript):
        return _generic_rule(_name_of(node.value), node.slice, module_globals)
    return _named_rule(_name_of(node), module_globals)


def _name_of(node: ast.expr) -> str:
    """Return the last part of a name: ``Path`` for ``pathlib.Path``. Other expressions have the name ""."""
    if isinstance(node, ast.Attribute):
        return node.attr
    return node.id if isinstance(node, ast.Name) else ""


def _named_rule(name: str, module_globals: Mapping[str, Any]) -> Rule:
    if name in _SIMPLE_RULES:
        return _SIMPLE_RULES[name]
    annotated = module_globals.get(name)
    if isinstance(annotated, type):
        return (lambda value: isinstance(value, annotated)), with_article(name)
    if get_origin(annotated) is Literal:
        choices = get_args(annotated)
        return partial(_is_one_of, choices), f"one of {', '.join(map(str, choices))}"
    if isinstance(annotated, UnionType):
        types = tuple(get_origin(member) or member for member in get_args(annotated))
        return (lambda value: isinstance(value, types)), " or ".join(allowed.__name__ for allowed in types)
    if name in ("Any", "object") or isinstance(annotated, TypeVar):
        return (lambda _: True), "anything"
    # The module imports this class only for type checking, so only the name of the class is known.
    return partial(_has_class_name, name), with_article(name)


def _generic_rule(name: str, inner: ast.expr, module_globals: Mapping[str, Any]) -> Rule:
    """Return the rule of the annotation ``name[inner]``."""
    if name in _SIMPLE_RULES:  # e.g. Callable[[int], None] or PathLike[str]
        return _SIMPLE_RULES[name]
    parts = inner.elts if isinstance(inner, ast.Tuple) else [inner]
    rules = [_rule(part, module_globals) for part in parts]
    if name == "type":
        class_names = _class_names(_name_of(parts[0]), module_globals)
        return partial(_is_class, class_names), f"a class{' of ' if class_names else ''}{' or '.join(class_names)}"
    if name == "Mapping":
        (is_key, key_text), (is_value, value_text) = rules
        return partial(_is_mapping, is_key, is_value), f"a mapping from {key_text} to {value_text}"
    if name in ("Iterable", "Sequence", "list", "tuple"):  # All items of our tuples have the same type.
        is_item, description = rules[0]
        return partial(_are_items, is_item), f"an iterable whose items are each {description}"
    return partial(_has_class_name, name), with_article(name)


def _class_names(name: str, module_globals: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the names of the classes that ``type[name]`` allows; empty if it allows any class."""
    annotated = module_globals.get(name)
    if not isinstance(annotated, TypeVar):
        return () if name == "Any" else (name,)
    bound = annotated.__bound__
    if bound is None:
        return ()
    if isinstance(bound, type):
        return (bound.__name__,)
    return tuple(bound.__forward_arg__.split(" | "))  # The bound is a string: TypeVar(…, bound="Event | Message").


def _is_one_of(choices: tuple[object, ...], value: object) -> bool:
    return isinstance(value, type(choices[0])) and value in choices


def _has_class_name(name: str, value: object) -> bool:
    return any(cls.__name__ == name for cls in type(value).__mro__)


def _is_class(names: tuple[str, ...], value: object) -> bool:
    """Return True if the value is a class with one of the names, or derived from one; any class if there are none."""
    if not isinstance(value, type):
        return False
    return not names or any(cls.__name__ in names for cls in value.__mro__)


def _is_mapping(is_key: Check, is_value: Check, value: object) -> bool:
    return isinstance(value, Mapping) and all(is_key(key) and is_value(value[key]) for key in value)


def _are_items(is_item: Check, value: object) -> bool:
    # A string is an iterable of characters, but no caller intends that.
    if isinstance(value, (str, bytes, bytearray)) or not isinstance(value, Iterable):
        return False
    if not isinstance(value, (list, tuple, set, frozenset)):
        return True  # The iterable may be an iterator, which checking its items would exhaust.
    return all(map(is_item, value))


def check_kind(name: str, value: object, expected_type: type) -> None:
    # If an argument is annotated with a type variable, its type is known only at run time.
    if not isinstance(value, expected_type):
        raise InvalidArgument(
            f"{name} = {short_repr(value)} is not allowed: it must be {with_article(expected_type.__name__)}"
        )


def check_range(name: str, value: float, minimum: float, maximum: float, *, above: bool = False) -> None:
    """Raise InvalidArgument unless ``value`` is between the limits.

    With ``above``, ``minimum`` itself is not allowed.
    """
    try:
        is_high_enough = value > minimum if above else value >= minimum
        is_allowed = is_high_enough and value <= maximum
    except TypeError:
        is_allowed = False
    if not is_allowed:
        allowed = f"above {minimum:g} and at most {maximum:g}" if above else f"{minimum:g} to {maximum:g}"
        raise InvalidArgument(f"{name} = {short_repr(value)} is not allowed: it must be {allowed}")


def check_finite(name: str, *values: float) -> None:
    for value in values:
        if not isinstance(value, (int, float)) or not math.isfinite(value):
            raise InvalidArgument(f"{name}: {value!r} is not a finite number")
