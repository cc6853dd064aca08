"""Errors documented in the docstrings of public functions: in ``Raises:`` and in prose."""

from __future__ import annotations

import inspect
import re

from public_surface import CLASSES, Member, members

from aerokit import errors

__all__ = ["documented"]

NAMES = {*errors.__all__, "OSError"}
AS_OTHERS = re.compile(
    r"(?:[Rr]aises\s+as|else\s+as|[Ee]rrors\s+as\s+for|errors\s+are\s+those\s+of|is\s+as\s+for|see)\s+:meth:`([\w.]+)`"
)
FOR_ALL = re.compile(
    r"(Every method (?:but ``\w+`` )?raises:|All methods take|Methods that send something take"
    r"|NotSupported is\s+raised for).*",
    re.DOTALL,
)
"""Errors that a class docstring documents for all its methods."""


def documented() -> set[tuple[str, str]]:
    """(call, error) for everything that is promised."""
    known = {member.qualified: member for member in members()}
    pairs = {(name, error) for name, member in known.items() for error in _of(member, known, set())}
    return pairs | {(cls.__name__, error) for cls in CLASSES for error in _of_class(cls)}


def _of(member: Member, known: dict[str, Member], visited: set[str]) -> set[str]:
    """Those named in the docstring, those of the functions it refers to, and those of all methods of its class."""
    visited.add(member.qualified)
    found = _named_in(member.docstring)
    if member.owner is not None and member.is_awaited and len(visited) == 1:
        takes = inspect.signature(member.function).parameters
        if "timeout" in takes or "initial" in takes:
            found |= _of_all_methods(member.owner)
    for name in AS_OTHERS.findall(member.docstring):
        other = known.get(name) or known[f"{member.qualified.partition('.')[0]}.{name}"]
        if other.qualified not in visited:
            found |= _of(other, known, visited)
    return found


def _of_all_methods(cls: type) -> set[str]:
    said = FOR_ALL.search(inspect.getdoc(cls) or "")
    return _named_in(said[0]) if said else set()


def _of_class(cls: type) -> set[str]:
    """Return the errors documented for the object itself, for entering and leaving it."""
    return _named_in(FOR_ALL.sub("", inspect.getdoc(cls) or ""))


def _named_in(text: str) -> set[str]:
    return NAMES & set(re.findall(r"\w+", text))
