"""Writes ``sync/twins.py``: each class of the asynchronous API once more, for programs without ``async``.

Those of fleets are in ``sync/fleet_twins.py``: who has one vehicle does not import them.

    python -m aerokit.sync.generator            # write it
    python -m aerokit.sync.generator --check    # compare: 0 the same, 1 different

Two rules make a member: a coroutine runs on the loop, and anything else is called there. What is returned and has a
twin is wrapped in it; what only reads is read where the program is. `originals.py` has the classes. Arguments,
defaults and docstrings are those of the originals; names in annotations are imported from where the original has them.
"""

from __future__ import annotations

import argparse
import ast
import builtins
import importlib
import inspect
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from aerokit.sync.originals import TWINS, Member, Twin, decorators_of, function_node, imports_of, members_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

WIDTH = 110
"""Of a line; what is written is as `ruff format` would have it."""


def outer(annotation: ast.expr | None) -> str:
    """The name in an annotation, without what is in brackets behind it."""
    while isinstance(annotation, ast.Subscript):
        annotation = annotation.value
    return annotation.id if isinstance(annotation, ast.Name) else ""


def optional(annotation: ast.expr | None) -> ast.expr | None:
    """What is in front of ``| None``, if that is how the annotation ends."""
    if isinstance(annotation, ast.BinOp) and isinstance(annotation.op, ast.BitOr):
        last = annotation.right
        return annotation.left if isinstance(last, ast.Constant) and last.value is None else None
    return None


def forwarded(node: ast.FunctionDef | ast.AsyncFunctionDef) -> list[str]:
    """The arguments as they are handed on, without ``self``."""
    positional = [each.arg for each in (*node.args.posonlyargs, *node.args.args)]
    positional = [each for each in positional if each != "self"]
    star = [f"*{node.args.vararg.arg}"] if node.args.vararg else []
    rest = [f"**{node.args.kwarg.arg}"] if node.args.kwarg else []
    return positional + star + [f"{each.arg}={each.arg}" for each in node.args.kwonlyargs] + rest


def source(node: ast.expr) -> str:
    """An expression as it is written, with double quotes."""
    text = ast.unparse(node)
    return text if '"' in text else text.replace("'", '"')


def call(function: str, arguments: Sequence[str], indent: str = "        ") -> str:
    """A call, one argument a line where it would be too long."""
    line = f"{function}({', '.join(arguments)})"
    if len(indent) + len(line) < WIDTH:  # a comma may follow
        return line
    return f"{function}(\n" + "".join(f"{indent}    {each},\n" for each in arguments) + f"{indent})"


def function(
    node: ast.FunctionDef | ast.AsyncFunctionDef, returns: ast.expr | None, text: str | None, body: str
) -> str:
    """A method whose body is one statement."""
    gives = "" if returns is None else f" -> {source(returns)}"
    line = f"    def {node.name}({', '.join(arguments_of(node.args))}){gives}:\n"
    if len(line) > WIDTH + 1:
        line = f"    def {node.name}(\n"
        line += _lines(arguments_of(node.args), "        ") + f"    ){gives}:\n"
    return f"{line}{docstring(text)}        {body}\n"


def arguments_of(arguments: ast.arguments) -> list[str]:
    """Each as it is written, with its default."""
    positional = [*arguments.posonlyargs, *arguments.args]
    lacking: list[ast.expr | None] = [None] * (len(positional) - len(arguments.defaults))
    found = [_argument(*each) for each in zip(positional, [*lacking, *arguments.defaults])]  # noqa: B905
    if arguments.vararg is not None:
        found.append("*" + _argument(arguments.vararg, None))
    elif arguments.kwonlyargs:
        found.append("*")
    found += [_argument(*each) for each in zip(arguments.kwonlyargs, arguments.kw_defaults)]  # noqa: B905
    return found + (["**" + _argument(arguments.kwarg, None)] if arguments.kwarg else [])


def _lines(arguments: Iterable[str], indent: str) -> str:
    """One argument a line; what is too long for one continues before its ``| None``."""
    lines = ""
    for each in arguments:
        if len(indent) + len(each) + 1 > WIDTH:
            head, none, tail = each.rpartition(" | None")
            each = f"{head}\n{indent}{none.lstrip()}{tail}"
        lines += f"{indent}{each},\n"
    return lines


def _argument(each: ast.arg, default: ast.expr | None) -> str:
    kind = "" if each.annotation is None else f": {source(each.annotation)}"
    value = "" if default is None else f"{' = ' if kind else '='}{source(default)}"
    return f"{each.arg}{kind}{value}"


def docstring(text: str | None, indent: str = "        ") -> str:
    """As it stands in the source; nothing for none."""
    if not text:
        return ""
    lines = text.splitlines()
    if len(lines) == 1:
        return f'{indent}"""{lines[0]}"""\n'
    body = "".join(f"{indent}{line}\n" if line else "\n" for line in lines[1:])
    return f'{indent}"""{lines[0]}\n{body}{indent}"""\n'


FILES = {name: Path(__file__).with_name(f"{name}.py") for name in ("twins", "fleet_twins")}
"""What is written: page → file."""

FILE = FILES["twins"]
"""The first of them."""

OF_ONE = ("TwinOf", "BlockTwin", "SelectionTwin")
"""Bases that are told whose twin it is."""

FUNCTIONS: dict[str, tuple[str, ...]] = {
    "twins": ("aerokit.connection.opening.open_connection", "aerokit.vehicle.connect.connect"),
    "fleet_twins": ("aerokit.fleets.opening.fleet",),
}
"""Blocks that are opened by a function, by pages."""

BLOCKS = {"SelectionTwin": "fleet_blocks", "FleetTwin": "fleet_blocks"}
"""Where bases are that are not in ``blocks.py``."""

HEAD = '''# Generated by aerokit.sync.generator from the asynchronous classes: do not edit.
# ruff: noqa: B008, F401, RUF100 - defaults are those of the originals; bases are named in texts
# pyright: reportIncompatibleMethodOverride=false
"""The classes of :mod:`aerokit.sync`: methods, arguments, errors and documentation of the asynchronous ones.

Methods block, properties never do. Any thread may use them. ``aio`` is the asynchronous object, for code that runs on
the loop; functions that are handed in (``on_progress``, predicates) run on the loop's thread.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, TypeVar

'''


# --------------------------------------------------------------------------------------- writing
@dataclass
class Page:
    """What is written, and what it has to import."""

    name: str = "twins"
    at_run_time: set[tuple[str, str]] = field(default_factory=set)
    for_types: set[tuple[str, str]] = field(default_factory=set)

    def __post_init__(self) -> None:
        self._homes: dict[str, tuple[str, str]] = {}
        self._twins = {each.name for each in TWINS}
        self._elsewhere = {each.name: each.page for each in TWINS if each.page != self.name}

    def need(self, node: ast.AST | None, modules: tuple[str, ...], *, at_run_time: bool = False) -> None:
        """Have the names in an expression of these modules imported."""
        for each in ast.walk(node) if node is not None else ():
            text = each.value if isinstance(each, ast.Constant) and isinstance(each.value, str) else None
            if isinstance(each, ast.Name):
                self._need_name(each.id, modules, at_run_time)
            elif text is not None and text.isidentifier() and not at_run_time:
                self._need_name(text, modules, at_run_time)

    def _need_name(self, name: str, modules: tuple[str, ...], at_run_time: bool) -> None:
        if name in self._elsewhere and self._elsewhere[name] == "twins":
            self.at_run_time.add(("aerokit.sync.twins", name))
            return
        if name in self._twins or name in TYPE_VARIABLES or hasattr(builtins, name):
            return
        where = next((found[name] for found in map(imports_of, modules) if name in found), (modules[0], name))
        where = self._homes.setdefault(where[1] or name, where)  # a name may be exported by two modules
        (self.at_run_time if at_run_time else self.for_types).add(where)

    def returned(self, expression: str, returns: ast.expr | None) -> str:
        """The expression, wrapped where what it gives has a twin."""
        name, maybe = outer(returns), outer(optional(returns))
        if maybe in self._twins:
            return f"None if {expression} is None else {maybe}(self._loop, {expression})"
        return f"{name}(self._loop, {expression})" if name in self._twins else expression

    def member(self, twin: Twin, member: Member) -> str:
        """The lines of one member."""
        self.need(member.returns, member.module)
        node, name = member.node, member.name
        if node is None or not {"property", "cached_property"}.isdisjoint(decorators_of(node)):
            return self._value(twin, member)
        those = (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)
        for argument in (*those, node.args.vararg, node.args.kwarg):
            self.need(argument.annotation if argument else None, member.module)
        for default in (*node.args.defaults, *node.args.kw_defaults):
            self.need(default, member.module, at_run_time=True)
        arguments = forwarded(node)
        if "contextmanager" in decorators_of(node):
            self.for_types.add(("contextlib", "AbstractContextManager"))
            inner = node.returns.slice if isinstance(node.returns, ast.Subscript) else ast.Constant(None)
            kind = ast.Subscript(ast.Name("AbstractContextManager"), inner)
            block = f"self.aio.{name}({', '.join(arguments)})"
            is_twin = outer(inner) in self._twins
            body = (
                f"return self._twin_block({outer(inner)}, {block})"
                if is_twin
                else f"return self._block({block})"
            )
            return function(node, kind, member.text, body)
        called = f"self.aio.{name}"
        if name not in twin.direct:
            run = "run" if isinstance(node, ast.AsyncFunctionDef) else "call"
            called, arguments = f"self._loop.{run}", [called, *arguments]
        if outer(node.returns) in self._twins:
            made = call(called, arguments, "            ")
            body = call(f"return {outer(node.returns)}", ["self._loop", made])
        else:
            is_none = isinstance(node.returns, ast.Constant) and node.returns.value is None
            body = call(called if is_none else f"return {called}", arguments)
        return function(node, node.returns, member.text, body)

    def _value(self, twin: Twin, member: Member) -> str:
        name, read = member.name, f"self.aio.{member.name}"
        if name in twin.called:
            read = f"self._loop.call(lambda: {read})"
        wrapped = self.returned(read, member.returns)
        if name in twin.parts:
            wrapped = f'self._part("{name}", {outer(member.returns)})'
        decorator = "property" if wrapped == read or name in twin.parts else "cached_property"
        if member.returns is None:
            raise ValueError(f"the type of {twin.name}.{name} is not annotated")
        kind = source(member.returns)
        return f"    @{decorator}\n    def {name}(self) -> {kind}:\n{docstring(member.text)}        return {wrapped}\n"


TYPE_VARIABLES = {
    "ItemT": '"Message | Event"',
    "MessageT": '"Message"',
    "SetpointT": "",
    "T": "",
}


# --------------------------------------------------------------------------------------- the page
def generate(name: str = "twins") -> str:
    """The text of ``sync/twins.py``, or of another page."""
    page, twins = Page(name), [each for each in TWINS if each.page == name]
    classes = [_class(page, twin) for twin in twins]
    functions = [_opener(page, path) for path in FUNCTIONS[name]]
    names = sorted((*(twin.name for twin in twins), *(path.rpartition(".")[2] for path in FUNCTIONS[name])))
    page.at_run_time |= {(f"aerokit.sync.{BLOCKS.get(twin.base, 'blocks')}", twin.base) for twin in twins}
    opener = (
        ("aerokit.sync.blocks", "opened")
        if name == "twins"
        else ("aerokit.sync.fleet_blocks", "opened_fleet")
    )
    page.at_run_time |= {opener, ("aerokit._internal.arguments", "checked")}
    page.for_types |= {
        (each.module, f"{each.name} as Async{each.name}") for each in twins if each.base in OF_ONE
    }
    variables = TYPE_VARIABLES if name == "twins" else {}
    page.for_types |= {("aerokit.mavlink.message", "Message"), ("aerokit.events", "Event")}
    for path in FUNCTIONS[name]:
        module, _, name = path.rpartition(".")
        page.at_run_time.add((module, f"{name} as {name}_async"))
    page.for_types -= page.at_run_time
    text = HEAD if variables else HEAD.replace("import TYPE_CHECKING, TypeVar", "import TYPE_CHECKING")
    if "@cached_property" not in "".join(classes):
        text = text.replace("from functools import cached_property\n", "")
    head = text + _import_lines(page.at_run_time, "") + "\nif TYPE_CHECKING:\n"
    head += _import_lines(page.for_types, "    ") + "\n"
    head += "__all__ = [\n" + "".join(f'    "{each}",\n' for each in names) + "]\n" + "\n" * bool(variables)
    for each, bound in variables.items():
        head += f'{each} = TypeVar("{each}"{f", bound={bound}" if bound else ""})\n'
    return head + "\n\n" + "\n\n".join([*classes, *functions])


def _class(page: Page, twin: Twin) -> str:
    original = getattr(importlib.import_module(twin.module), twin.name)
    base = f"{twin.base}[{twin.parameter}]" if twin.parameter else twin.base
    if base in OF_ONE:
        base += f'["Async{twin.name}"]'
    if twin.inherits:
        base += f", {twin.inherits}"
    text = docstring(inspect.getdoc(original), "    ")
    members = "\n".join(page.member(twin, each) for each in members_of(twin))
    return "\n".join([f"class {twin.name}({base}):\n{text}", *([members] if members else [])])


def _opener(page: Page, path: str) -> str:
    module, _, name = path.rpartition(".")
    node = function_node(module, name)
    for argument in (*node.args.args, *node.args.kwonlyargs, node.args.vararg):
        page.need(argument.annotation if argument else None, (module,))
    for default in (*node.args.defaults, *node.args.kw_defaults):
        page.need(default, (module,), at_run_time=True)
    assert isinstance(node.returns, ast.Subscript)
    kind = ast.unparse(node.returns.slice)
    lines = _lines(arguments_of(node.args), "    ")
    given = "".join(f"        {each.lstrip('*')},\n" for each in forwarded(node))
    opens = "opened" if page.name == "twins" else "opened_fleet"
    text = ast.get_docstring(node) or ""
    text = text.replace(
        "for the time of the ``async with`` block", "; use it in a ``with`` block, or close it"
    )
    return (
        f"@checked\ndef {name}(\n{lines}) -> {kind}:\n{docstring(text, '    ')}"
        f"    return {opens}(\n        {kind},\n        {name}_async,\n{given}    )\n"
    )


def _import_lines(names: set[tuple[str, str]], indent: str) -> str:
    """Sorted as ruff does: ours behind the standard library's, ``import x`` first, constants before classes."""
    parts: list[str] = []
    for is_ours in (False, True):
        modules = {module for module, _ in names if module.startswith("aerokit") == is_ours}
        plain = [f"{indent}import {module}\n" for module in sorted(modules) if (module, "") in names]
        parts.append("".join([*plain, *(_from_lines(module, names, indent) for module in sorted(modules))]))
    return "\n".join(part for part in parts if part)


def _from_lines(module: str, names: set[tuple[str, str]], indent: str) -> str:
    found = sorted((name for other, name in names if other == module and name), key=_by_kind)
    joined = [name for name in found if " as " not in name]
    lines = {name: f"{indent}from {module} import {name}\n" for name in found if name not in joined}
    if joined:
        line = f"{indent}from {module} import {', '.join(joined)}\n"
        if len(line) > WIDTH + 1:
            line = f"{indent}from {module} import (\n{_lines(joined, indent + '    ')}{indent})\n"
        lines[joined[0]] = line
    return "".join(lines[name] for name in sorted(lines, key=_by_kind))


def _by_kind(name: str) -> tuple[bool, bool, str]:
    """Constants, classes, others; each by the alphabet."""
    return not name.isupper(), name[0].islower(), name.lower()


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m aerokit.sync.generator")
    parser.add_argument("--check", action="store_true", help="compare with the committed file, write nothing")
    is_check, code = parser.parse_args(arguments).check, 0
    for name, file in FILES.items():
        text = generate(name)
        if not is_check:
            file.write_text(text, encoding="utf-8", newline="\n")
        elif not file.is_file() or file.read_text(encoding="utf-8") != text:
            sys.stdout.write(f"differs: sync/{file.name}; python -m aerokit.sync.generator writes it\n")
            code = 1
    return code


if __name__ == "__main__":
    sys.exit(main())
