"""Arguments of command handlers: read from the annotations of a function, and checked before each call."""

from __future__ import annotations

import inspect
import math
import types
from collections.abc import Callable
from contextlib import suppress
from enum import Enum
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

from aerokit._internal.formatting import short_repr
from aerokit._internal.values import Snapshot
from aerokit.errors import InvalidArgument

MAX_ARGUMENTS = 7


class Range(Snapshot):
    """Allowed values of a command's argument, both ends included: ``height_m: Annotated[float, Range(0, 50)]``."""

    minimum: float = -math.inf
    maximum: float = math.inf

    def _check(self) -> None:
        if not self.minimum <= self.maximum:
            raise InvalidArgument(f"Range({self.minimum!r}, {self.maximum!r}) is empty")


class Param(Snapshot):
    """Selects the command parameter, 1 to 7, for a handler's argument: ``speed_m_s: Annotated[float, Param(3)]``.

    By default, the arguments of a handler are the command's parameters in order.
    """

    number: int

    def _check(self) -> None:
        if not isinstance(self.number, int) or not 1 <= self.number <= MAX_ARGUMENTS:
            raise InvalidArgument(f"Param({short_repr(self.number)}) is not allowed: it must be 1 to 7")


class CommandArgument(Snapshot):
    """One argument of a command handler, with its type and allowed range."""

    name: str
    number: int
    type: Any
    is_optional: bool
    range: Range

    def convert(self, value: float) -> object:
        if not math.isfinite(value):
            if self.is_optional and math.isnan(value):  # NaN means that the parameter is missing.
                return None
            raise InvalidArgument(f"{self.name} = {value} is not allowed: it must be a finite number")
        # The texts below show nine digits, because fewer would not distinguish all 32-bit floats.
        if not self.range.minimum <= value <= self.range.maximum:
            low, high = self.range.minimum, self.range.maximum
            raise InvalidArgument(f"{self.name} = {value:.9g} is not allowed: it must be {low:g} to {high:g}")
        if self.type is float:
            return value
        if value != int(value):
            raise InvalidArgument(f"{self.name} = {value:.9g} is not allowed: it must be a whole number")
        if self.type is bool:
            if value not in (0, 1):
                raise InvalidArgument(f"{self.name} = {value:.9g} is not allowed: it must be 0 or 1")
            return bool(value)
        try:
            return self.type(int(value))
        except ValueError:
            raise InvalidArgument(
                f"{self.name} = {value:.9g} is not allowed: it must be a {self.type.__name__}"
            ) from None


def arguments_of(function: Callable[..., Any]) -> tuple[CommandArgument, ...]:
    """Return the arguments of a handler without the first one, which is the request.

    Raises InvalidArgument if the function is not allowed as a handler.
    """
    name = getattr(function, "__name__", repr(function))
    parameters = list(inspect.signature(function).parameters.values())
    if not parameters:
        raise InvalidArgument(f"{name}() must accept the request as its first argument")
    arguments = []
    for number, parameter in enumerate(parameters[1:], start=1):
        if parameter.kind not in (parameter.POSITIONAL_ONLY, parameter.POSITIONAL_OR_KEYWORD):
            raise InvalidArgument(
                f"{name}(): declare {parameter.name} as a positional argument, because the values are passed in order"
            )
        arguments.append(_argument(name, parameter.name, number, _hint(function, parameter)))
    return tuple(arguments)


def _hint(function: Callable[..., Any], parameter: inspect.Parameter) -> Any:
    """Return the annotation of one parameter, evaluated in the scope of its function."""
    inner = inspect.unwrap(getattr(function, "__func__", function))
    # get_type_hints would evaluate all annotations of the function. `holder` has only the annotation of this parameter.
    holder = types.SimpleNamespace(__annotations__={"hint": parameter.annotation})
    if not inspect.isfunction(inner):  # functools.partial, or an object with `__call__`
        raise InvalidArgument(f"{short_repr(inner)} is not allowed as a handler: it must be a function or a method")
    closure = {}
    for name, cell in zip(inner.__code__.co_freevars, inner.__closure__ or ()):  # noqa: B905 - equal lengths
        # ValueError: the variable has no value yet. The function's own name has none while it is being decorated.
        with suppress(ValueError):
            closure[name] = cell.cell_contents
    try:
        return get_type_hints(holder, inner.__globals__, closure, include_extras=True)["hint"]
    except NameError as error:
        raise InvalidArgument(
            f"the annotation of argument {parameter.name} of {inner.__name__}() cannot be evaluated: {error};"
            " define its types at module level"
        ) from None


def _argument(function_name: str, name: str, number: int, hint: Any) -> CommandArgument:
    allowed = Range()
    is_optional = False
    while (origin := get_origin(hint)) in (Annotated, Union, types.UnionType):  # These may be nested.
        if origin is Annotated:
            hint, *extras = get_args(hint)
            for extra in extras:
                if isinstance(extra, Range):
                    allowed = extra
                elif isinstance(extra, Param):
                    number = extra.number
        else:
            members = [member for member in get_args(hint) if member is not type(None)]
            is_optional = len(members) < len(get_args(hint))
            hint = members[0] if len(members) == 1 else None  # None is refused below.
    if hint not in (float, int, bool) and not _is_enum_of_integers(hint):
        raise InvalidArgument(
            f"{function_name}(): argument {name} must be annotated with float, int, bool or an enum of integers"
        )
    if number > MAX_ARGUMENTS:
        raise InvalidArgument(
            f"{function_name}(): argument {name} would be parameter {number}, but a command has seven parameters"
        )
    return CommandArgument(name, number, type=hint, is_optional=is_optional, range=allowed)


def _is_enum_of_integers(hint: Any) -> bool:
    members = list(hint) if isinstance(hint, type) and issubclass(hint, Enum) else []
    return bool(members) and all(isinstance(member.value, int) for member in members)
