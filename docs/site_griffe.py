"""Griffe extension that completes the data of mkdocstrings.

- Defaults are shown as values: ``timeout: float = 10.0`` instead of the name of a constant.
- Constructors that only the library calls are omitted: `Vehicle` is created by `connect`.
- The examples of `EXAMPLES` are added to their entries, and entries with an example come first in their class.
"""

from __future__ import annotations

import importlib
import inspect
import re
from enum import Enum
from functools import cached_property
from typing import Any

import griffe
from site_reference import EXAMPLE, EXAMPLES, Listing

SECTION = re.compile(r"^(Args|Raises|Returns|Yields|Attributes|Example|Examples|Note|Warning):", re.MULTILINE)
"""A heading of a Google-style docstring."""
PLAIN = {int, float, str, bool}
MAX_VALUE = 60
"""Maximum length of a default value; a longer one is shown as the name of its constant."""
INTERNAL_PACKAGES = ("aerokit.mavlink.messages", "aerokit.mavlink.enums", "aerokit.messages", "aerokit.enums")
"""Packages of generated code, whose signatures contain no constants."""


class ReferenceExtension(griffe.Extension):
    """Completes signatures and docstrings of the package for the reference."""

    @cached_property
    def listing(self) -> Listing:
        return Listing()

    def on_package(self, *, pkg: griffe.Module, loader: griffe.GriffeLoader, **kwargs: Any) -> None:
        if pkg.path != "aerokit":
            return
        self._complete(pkg)
        examples = {}
        for number, example in enumerate(EXAMPLE.finditer(EXAMPLES.read_text(encoding="utf-8"))):
            item = self._object(pkg, example["name"])
            _add_example(item, example["code"])
            examples[item.path] = number
        for entry in self.listing.entries.values():
            cls = _target(pkg[entry.path.removeprefix("aerokit.")])
            if isinstance(cls, griffe.Class):
                is_created_by_library = not entry.is_imported or self._needs_internals(cls)
                cls.extra["aerokit"]["is_created_by_library"] = is_created_by_library
                _arrange_members(cls, self.listing.inherited(entry), examples)

    def _object(self, pkg: griffe.Module, name: str) -> griffe.Object:
        """Return the object of a heading: ``connect``, ``Vehicle.arm``, ``missions.waypoint``."""
        entry, member = self.listing.find(name)
        found = pkg[entry.path.removeprefix("aerokit.")]
        found = found.all_members[member] if member else found
        return _target(found)

    def _complete(self, holder: griffe.Object) -> None:
        """Complete the functions, classes and modules of a module or class."""
        for member in list(holder.members.values()):
            if member.is_alias or member.path in INTERNAL_PACKAGES:
                continue
            if isinstance(member, griffe.Function):
                _show_values(member)
            elif isinstance(member, griffe.Attribute):
                _show_value(member)
            elif isinstance(member, (griffe.Class, griffe.Module)):
                self._complete(member)

    def _needs_internals(self, cls: griffe.Class) -> bool:
        """Return True if the constructor takes objects of classes that the reference does not have."""
        init = _target(cls.all_members["__init__"]) if "__init__" in cls.all_members else None
        if not isinstance(init, griffe.Function):
            return False
        for parameter in init.parameters:
            annotation = parameter.annotation
            names = annotation.iterate(flat=True) if isinstance(annotation, griffe.Expr) else ()
            for name in names:
                path = name.canonical_path if isinstance(name, griffe.ExprName) else ""
                if path.startswith("aerokit.") and path not in self._classes and _is_class(path):
                    return True
        return False

    @cached_property
    def _classes(self) -> set[str]:
        return self.listing.classes()


def _target(item: griffe.Object | griffe.Alias) -> griffe.Object:
    return item.final_target if isinstance(item, griffe.Alias) else item


def _arrange_members(cls: griffe.Class, inherited: list[str], examples: dict[str, int]) -> None:
    """Add inherited members, and sort all: those with an example first, then by base class, then by line."""
    members: dict[str, tuple[Any, int]] = {}
    for rank, base in enumerate([cls, *cls.mro()]):
        for name, member in base.members.items():
            if base is cls or name in inherited:
                members.setdefault(name, (member, rank))

    def position(name: str) -> tuple[int, int, int]:
        member, rank = members[name]
        return examples.get(_target(member).path, len(examples)), rank, member.lineno or 0

    names = sorted(members, key=position)
    cls.members.clear()
    for number, name in enumerate(names):
        member, rank = members[name]
        if rank:
            cls.members[name] = griffe.Alias(name, member, lineno=number, parent=cls)
        else:
            cls.members[name] = member
            if not member.is_alias:
                member.lineno = number


def _is_class(path: str) -> bool:
    return inspect.isclass(_imported(path))


def _imported(path: str) -> Any:
    """Return the object at a path, or None if there is none at run time."""
    names = path.split(".")
    for length in range(len(names) - 1, 0, -1):
        try:
            found: Any = importlib.import_module(".".join(names[:length]))
        except ImportError:
            continue
        for name in names[length:]:
            found = getattr(found, name, None)
        return found
    return None


def _add_example(item: griffe.Object, code: str) -> None:
    """Add an example to a docstring, before its sections."""
    block = f"```python\n{code.strip()}\n```"
    text = item.docstring.value if item.docstring else ""
    section = SECTION.search(text)
    at = section.start() if section else len(text)
    value = f"{text[:at].rstrip()}\n\n{block}\n\n{text[at:]}".strip()
    if item.docstring:
        item.docstring.value = value
    else:
        item.docstring = griffe.Docstring(value, parent=item)


def _show_values(function: griffe.Function) -> None:
    """Replace constants in the defaults of a function by their values."""
    for parameter in function.parameters:
        if isinstance(parameter.default, (griffe.ExprName, griffe.ExprAttribute)):
            parameter.default = _value_of(parameter.default) or parameter.default


def _show_value(attribute: griffe.Attribute) -> None:
    if isinstance(attribute.value, (griffe.ExprName, griffe.ExprAttribute)):
        attribute.value = _value_of(attribute.value) or attribute.value


def _value_of(expression: griffe.ExprName | griffe.ExprAttribute) -> str | None:
    """Return a number, text, enum member or short tuple as Python code; None for anything else."""
    value = _imported(expression.canonical_path)
    if isinstance(value, Enum):
        return f"{type(value).__name__}.{value.name}"
    is_plain = type(value) in PLAIN or (isinstance(value, tuple) and {type(item) for item in value} <= PLAIN)
    return repr(value) if is_plain and len(repr(value)) <= MAX_VALUE else None
