"""Generates ``sync/twins.py``: blocking twins of the classes of the asynchronous API.

Fleets are in ``sync/fleet_twins.py`` and components in ``sync/component_twins.py``, which most programs do not import.

    python -m aerokit.sync.generator            # write the files
    python -m aerokit.sync.generator --check    # compare; exit code 1 if they differ

The twin of a coroutine method awaits it on the loop; the twin of a plain method calls it there. If the class of a
return value has a twin, the value is wrapped in it. ``originals.py`` lists the classes. Arguments, defaults and
docstrings are copied; annotations are imported from the modules that the original class imports them from.
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
from typing import TYPE_CHECKING, Literal, get_origin

from aerokit.sync.originals import TWINS, ClassMember, Twin, decorators_of, function_node, imports_of, members_of

if TYPE_CHECKING:
    from collections.abc import Sequence

WIDTH = 120  # the line length of `ruff format`; the output has its style


def outer_name(annotation: ast.expr | None) -> str:
    """Return the name of a type without its subscript: ``list`` for ``list[int]``.

    Other expressions have the name "".
    """
    while isinstance(annotation, ast.Subscript):
        annotation = annotation.value
    return annotation.id if isinstance(annotation, ast.Name) else ""


def without_none(annotation: ast.expr | None) -> ast.expr | None:
    """Return the annotation without ``| None``; None if it has no such part."""
    if isinstance(annotation, ast.BinOp) and isinstance(annotation.op, ast.BitOr):
        last = annotation.right
        return annotation.left if isinstance(last, ast.Constant) and last.value is None else None
    return None


def forwarded_arguments(node: ast.FunctionDef | ast.AsyncFunctionDef) -> list[str]:
    """Return the arguments with which a twin calls the original function, without ``self``."""
    positional = [argument.arg for argument in (*node.args.posonlyargs, *node.args.args)]
    positional = [argument for argument in positional if argument != "self"]
    var_positional = [f"*{node.args.vararg.arg}"] if node.args.vararg else []
    keyword_only = [f"{argument.arg}={argument.arg}" for argument in node.args.kwonlyargs]
    var_keyword = [f"**{node.args.kwarg.arg}"] if node.args.kwarg else []
    return positional + var_positional + keyword_only + var_keyword


def source_of(node: ast.expr) -> str:
    text = ast.unparse(node)
    return text if '"' in text else text.replace("'", '"')


def render_call(function: str, arguments: Sequence[str], indent: str = "        ") -> str:
    """Return the source of a call, on several lines if it is too long for one."""
    line = f"{function}({', '.join(arguments)})"
    if len(indent) + len(line) < WIDTH:  # One column is left free for a comma.
        return line
    return f"{function}(\n{_lines(arguments, indent + '    ')}{indent})"


def render_function(
    node: ast.FunctionDef | ast.AsyncFunctionDef, returns: ast.expr | None, text: str | None, body: str
) -> str:
    return_annotation = "" if returns is None else f" -> {source_of(returns)}"
    signature = f"    def {node.name}({', '.join(arguments_of(node.args))}){return_annotation}:\n"
    if len(signature) > WIDTH + 1:  # `signature` includes the line end, WIDTH does not.
        signature = f"    def {node.name}(\n"
        signature += _lines(arguments_of(node.args), "        ") + f"    ){return_annotation}:\n"
    return f"{signature}{render_docstring(text)}        {body}\n"


def arguments_of(arguments: ast.arguments) -> list[str]:
    """Return the source of each argument of a definition."""
    positional = [*arguments.posonlyargs, *arguments.args]
    no_defaults: list[ast.expr | None] = [None] * (len(positional) - len(arguments.defaults))
    # Only the last positional arguments have defaults.
    defaults = [*no_defaults, *arguments.defaults]
    texts = [_argument(argument, default) for argument, default in zip(positional, defaults, strict=True)]
    if arguments.vararg is not None:
        texts.append("*" + _argument(arguments.vararg, None))
    elif arguments.kwonlyargs:
        texts.append("*")
    for argument, default in zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True):
        texts.append(_argument(argument, default))
    if arguments.kwarg is not None:
        texts.append("**" + _argument(arguments.kwarg, None))
    return texts


def _lines(arguments: Sequence[str], indent: str) -> str:
    """Return the arguments on one line if they fit, otherwise on a line each."""
    line = indent + ", ".join(arguments)
    if len(line) <= WIDTH:
        return f"{line}\n"
    lines = ""
    for argument in arguments:
        # Like ruff, break a line that is too long before `| None`.
        head, separator, tail = argument.rpartition(" | None")
        if separator and len(indent) + len(argument) + 1 > WIDTH:
            argument = f"{head}\n{indent}{separator.lstrip()}{tail}"
        lines += f"{indent}{argument},\n"
    return lines


def _argument(argument: ast.arg, default: ast.expr | None) -> str:
    annotation = "" if argument.annotation is None else f": {source_of(argument.annotation)}"
    equals = " = " if annotation else "="
    return f"{argument.arg}{annotation}" + ("" if default is None else f"{equals}{source_of(default)}")


def render_docstring(text: str | None, indent: str = "        ") -> str:
    if not text:
        return ""
    lines = text.splitlines()
    if len(lines) == 1:
        return f'{indent}"""{lines[0]}"""\n'
    body = "".join(f"{indent}{line}\n" if line else "\n" for line in lines[1:])
    return f'{indent}"""{lines[0]}\n{body}{indent}"""\n'


FILES = {name: Path(__file__).with_name(f"{name}.py") for name in ("twins", "fleet_twins", "component_twins")}

# Base classes of generated classes (twins) whose type parameter is the asynchronous class: ``TwinOf[Vehicle]``.
GENERIC_BASES = ("TwinOf", "BlockTwin", "SelectionTwin")

# Maps each generated file to the functions whose result is entered by ``async with``, such as ``connect``.
FUNCTIONS: dict[str, tuple[str, ...]] = {
    "twins": ("aerokit.connection.opening.open_connection", "aerokit.vehicle.connect.connect"),
    "fleet_twins": ("aerokit.fleets.opening.fleet",),
    "component_twins": ("aerokit.onboard.opening.component",),
}

# Maps each generated file to the function (module, name) that makes a ``with`` block from an ``async with`` block.
OPENERS = {
    "twins": ("aerokit.sync.blocks", "opened"),
    "fleet_twins": ("aerokit.sync.fleet_blocks", "opened_fleet"),
    "component_twins": ("aerokit.sync.component_blocks", "opened_component"),
}

# Modules of base classes that are not in blocks.py.
BASE_MODULES = {"SelectionTwin": "fleet_blocks", "FleetTwin": "fleet_blocks", "ComponentTwin": "component_blocks"}

HEAD = '''# Generated by aerokit.sync.generator from the asynchronous classes: do not edit.
# ruff: noqa: A002, B008, F401, RUF100 - names and defaults are those of the originals; strings use some imports
# pyright: reportIncompatibleMethodOverride=false, reportGeneralTypeIssues=false
"""The blocking classes of :mod:`aerokit.sync`.

Methods, arguments, errors and documentation are those of the asynchronous classes.

Methods block, properties never do. Objects can be used from any thread. ``aio`` is the asynchronous object, for code
that runs on the loop. Functions passed as arguments (``on_progress``, predicates) run on the loop's thread.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, TypeVar

'''


@dataclass
class Page:
    """A generated file, and its imports."""

    name: str = "twins"
    run_time_imports: set[tuple[str, str]] = field(default_factory=set)
    typing_imports: set[tuple[str, str]] = field(default_factory=set)

    def __post_init__(self) -> None:
        self._import_sources: dict[str, tuple[str, str]] = {}  # imported name → (source module, name in it)
        self._twins = {twin.name for twin in TWINS}
        self._page_of_other_twins = {twin.name: twin.page for twin in TWINS if twin.page != self.name}

    def import_names_in(self, node: ast.AST | None, modules: tuple[str, ...], *, at_run_time: bool = False) -> None:
        """Add imports for the names in an expression, for type checkers only unless ``at_run_time`` is true.

        A name that none of ``modules`` imports is defined in the first of them.
        """
        if node is None:
            return
        for part in ast.walk(node):
            text = part.value if isinstance(part, ast.Constant) and isinstance(part.value, str) else None
            if isinstance(part, ast.Name):
                self._import_name(part.id, modules, at_run_time)
            # In an annotation, a text that is a name is a forward reference.
            elif text is not None and text.isidentifier() and not at_run_time:
                self._import_name(text, modules, at_run_time)

    def _import_name(self, name: str, modules: tuple[str, ...], at_run_time: bool) -> None:
        if self._page_of_other_twins.get(name) == "twins":
            self.run_time_imports.add(("aerokit.sync.twins", name))
            return
        if name in self._twins or name in TYPE_VARIABLES or hasattr(builtins, name):
            return
        imports = (imports_of(module) for module in modules)
        origin = next((imported[name] for imported in imports if name in imported), (modules[0], name))
        _, original_name = origin  # "" if `name` is an imported module
        # If several modules export a name, it is always imported from the module that was found first.
        origin = self._import_sources.setdefault(original_name or name, origin)
        if at_run_time:
            self.run_time_imports.add(origin)
        else:
            self.typing_imports.add(origin)

    def import_literals_in(self, node: ast.AST | None, module: str) -> None:
        """Import the Literals of an annotation at run time, because ``checked`` needs their values."""
        if node is None:
            return
        for part in ast.walk(node):
            if not isinstance(part, ast.Name):
                continue
            origin_module, origin_name = imports_of(module).get(part.id, (module, part.id))
            if origin_module.startswith("aerokit."):
                imported = getattr(importlib.import_module(origin_module), origin_name, None)
                if get_origin(imported) is Literal:
                    self.run_time_imports.add((origin_module, origin_name))

    def wrapped_in_twin(self, expression: str, returns: ast.expr | None) -> str:
        """Return the expression or, if its type has a twin, the expression that creates the twin."""
        optional_name = outer_name(without_none(returns))
        if optional_name in self._twins:
            return f"None if {expression} is None else {optional_name}(self._loop, {expression})"
        name = outer_name(returns)
        return f"{name}(self._loop, {expression})" if name in self._twins else expression

    def render_member(self, twin: Twin, member: ClassMember) -> str:
        """Return the source of a member of a twin, and add the imports that it needs."""
        self.import_names_in(member.returns, member.module)
        node = member.node
        if node is None or not {"property", "cached_property"}.isdisjoint(decorators_of(node)):
            return self._property_twin(twin, member)
        named_arguments = (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)
        for argument in (*named_arguments, node.args.vararg, node.args.kwarg):
            self.import_names_in(argument.annotation if argument else None, member.module)
        for default in (*node.args.defaults, *node.args.kw_defaults):
            self.import_names_in(default, member.module, at_run_time=True)
        arguments = forwarded_arguments(node)
        if "contextmanager" in decorators_of(node):
            return self._render_context_manager(node, member, arguments)
        called = f"self.aio.{member.name}"
        if member.name not in twin.direct:
            # The loop calls the method: `self._loop.run(self.aio.arm, …)`.
            arguments = [called, *arguments]
            called = "self._loop.run" if isinstance(node, ast.AsyncFunctionDef) else "self._loop.call"
        if outer_name(node.returns) in self._twins:
            result = render_call(called, arguments, "            ")
            body = render_call(f"return {outer_name(node.returns)}", ["self._loop", result])
        else:
            returns_none = isinstance(node.returns, ast.Constant) and node.returns.value is None
            body = render_call(called if returns_none else f"return {called}", arguments)
        return render_function(node, node.returns, member.text, body)

    def _render_context_manager(
        self, node: ast.FunctionDef | ast.AsyncFunctionDef, member: ClassMember, arguments: Sequence[str]
    ) -> str:
        self.typing_imports.add(("contextlib", "AbstractContextManager"))
        yielded = node.returns.slice if isinstance(node.returns, ast.Subscript) else ast.Constant(None)
        returns = ast.Subscript(ast.Name("AbstractContextManager"), yielded)
        block = f"self.aio.{member.name}({', '.join(arguments)})"
        if outer_name(yielded) in self._twins:
            body = f"return self._twin_block({outer_name(yielded)}, {block})"
        else:
            body = f"return self._block({block})"
        return render_function(node, returns, member.text, body)

    def _property_twin(self, twin: Twin, member: ClassMember) -> str:
        name = member.name
        read = f"self.aio.{name}"
        if name in twin.read_on_loop:
            read = f"self._loop.call(lambda: {read})"
        wrapped = self.wrapped_in_twin(read, member.returns)
        if name in twin.parts:
            wrapped = f'self._part("{name}", {outer_name(member.returns)})'
        # A property that returns a new twin is cached, so that each access returns the same object.
        decorator = "property" if wrapped == read or name in twin.parts else "cached_property"
        if member.returns is None:
            raise ValueError(f"the type of {twin.name}.{name} is not annotated")
        signature = f"    @{decorator}\n    def {name}(self) -> {source_of(member.returns)}:\n"
        return f"{signature}{render_docstring(member.text)}        return {wrapped}\n"


TYPE_VARIABLES = {"ItemT": '"Message | Event"', "MessageT": '"Message"', "SetpointT": "", "MeasurementT": "", "T": ""}


def generate(name: str = "twins") -> str:
    """Return the source of one of `FILES`."""
    page = Page(name)
    twins = [twin for twin in TWINS if twin.page == name]
    classes = [_class(page, twin) for twin in twins]
    functions = [_opener(page, path) for path in FUNCTIONS[name]]
    _add_common_imports(page, twins)
    variables = TYPE_VARIABLES if name == "twins" else {}
    # Imports in HEAD that this file does not use are left out.
    head = HEAD if variables else HEAD.replace("import TYPE_CHECKING, TypeVar", "import TYPE_CHECKING")
    if "@cached_property" not in "".join(classes):
        head = head.replace("from functools import cached_property\n", "")
    head += _import_lines(page.run_time_imports, "") + "\nif TYPE_CHECKING:\n"
    head += _import_lines(page.typing_imports, "    ") + "\n"
    exports = [*(twin.name for twin in twins), *(path.rpartition(".")[2] for path in FUNCTIONS[name])]
    head += "__all__ = [\n" + "".join(f'    "{export}",\n' for export in sorted(exports)) + "]\n"
    head += "\n" if variables else ""
    for variable, bound in variables.items():
        head += f'{variable} = TypeVar("{variable}"{f", bound={bound}" if bound else ""})\n'
    return head + "\n\n" + "\n\n".join([*classes, *functions])


def _add_common_imports(page: Page, twins: Sequence[Twin]) -> None:
    """Add the imports that the file needs besides those that `_class` and `_opener` have added."""
    page.run_time_imports |= {(f"aerokit.sync.{BASE_MODULES.get(twin.base, 'blocks')}", twin.base) for twin in twins}
    page.run_time_imports |= {OPENERS[page.name], ("aerokit._internal.arguments", "checked")}
    for path in FUNCTIONS[page.name]:
        module, _, function_name = path.rpartition(".")
        page.run_time_imports.add((module, f"{function_name} as {function_name}_async"))
    generic_twins = [twin for twin in twins if twin.base in GENERIC_BASES]
    page.typing_imports |= {(twin.module, f"{twin.name} as Async{twin.name}") for twin in generic_twins}
    page.typing_imports |= {("aerokit.mavlink.message", "Message"), ("aerokit.events", "Event")}
    page.typing_imports -= page.run_time_imports


def _class(page: Page, twin: Twin) -> str:
    original = getattr(importlib.import_module(twin.module), twin.name)
    base = f"{twin.base}[{twin.parameter}]" if twin.parameter else twin.base
    if base in GENERIC_BASES:
        base += f'["Async{twin.name}"]'
    if twin.inherits:
        base += f", {twin.inherits}"
    text = render_docstring(inspect.getdoc(original), "    ")
    members = "\n".join(page.render_member(twin, member) for member in members_of(twin))
    definition = f"class {twin.name}({base}):\n{text}"
    return f"{definition}\n{members}" if members else definition


def _opener(page: Page, path: str) -> str:
    """Return the source of the blocking version of a function such as ``connect``."""
    module, _, name = path.rpartition(".")
    node = function_node(module, name)
    for argument in (*node.args.args, *node.args.kwonlyargs, node.args.vararg):
        page.import_names_in(argument.annotation if argument else None, (module,))
        page.import_literals_in(argument.annotation if argument else None, module)
    for default in (*node.args.defaults, *node.args.kw_defaults):
        page.import_names_in(default, (module,), at_run_time=True)
    assert isinstance(node.returns, ast.Subscript)
    twin_name = ast.unparse(node.returns.slice)
    parameters = _lines(arguments_of(node.args), "    ")
    arguments = [argument.lstrip("*") for argument in forwarded_arguments(node)]
    _, opener = OPENERS[page.name]
    call = render_call(opener, [twin_name, f"{name}_async", *arguments], "    ")
    text = (ast.get_docstring(node) or "").replace("``async with``", "``with``")
    return f"@checked\ndef {name}(\n{parameters}) -> {twin_name}:\n{render_docstring(text, '    ')}    return {call}\n"


def _import_lines(names: set[tuple[str, str]], indent: str) -> str:
    """Return import statements in the order that ruff requires."""
    parts: list[str] = []
    for is_ours in (False, True):
        modules = {module for module, _ in names if module.startswith("aerokit") == is_ours}
        plain = [f"{indent}import {module}\n" for module in sorted(modules) if (module, "") in names]
        from_imports = [_from_lines(module, names, indent) for module in sorted(modules)]
        parts.append("".join([*plain, *from_imports]))
    return "\n".join(part for part in parts if part)


def _from_lines(module: str, names: set[tuple[str, str]], indent: str) -> str:
    imported = sorted((name for name_module, name in names if name_module == module and name), key=_by_kind)
    plain_names = [name for name in imported if " as " not in name]
    # As in ruff's format, each name with "as" has its own statement. Each key is the first name of its statement.
    statements = {name: f"{indent}from {module} import {name}\n" for name in imported if name not in plain_names}
    if plain_names:
        statement = f"{indent}from {module} import {', '.join(plain_names)}\n"
        if len(statement) > WIDTH + 1:  # `statement` includes the line end, WIDTH does not.
            lines = "".join(f"{indent}    {name},\n" for name in plain_names)
            statement = f"{indent}from {module} import (\n{lines}{indent})\n"
        statements[plain_names[0]] = statement
    return "".join(statements[name] for name in sorted(statements, key=_by_kind))


def _by_kind(name: str) -> tuple[bool, bool, str]:
    """Return the sort key of ruff's import order: constants, then classes, then functions."""
    return not name.isupper(), name[0].islower(), name.lower()


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m aerokit.sync.generator")
    parser.add_argument("--check", action="store_true", help="compare with the committed files, write nothing")
    is_check = parser.parse_args(arguments).check
    exit_code = 0
    for name, file in FILES.items():
        text = generate(name)
        if not is_check:
            file.write_text(text, encoding="utf-8", newline="\n")
        elif not file.is_file() or file.read_text(encoding="utf-8") != text:
            sys.stdout.write(f"differs: sync/{file.name}; python -m aerokit.sync.generator writes it\n")
            exit_code = 1
    return exit_code


if __name__ == "__main__":
    sys.exit(main())
