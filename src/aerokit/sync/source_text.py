"""Pieces of source text for `generator.py`: functions, arguments, docstrings."""

from __future__ import annotations

import ast
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["WIDTH", "arguments_of", "call", "docstring", "forwarded", "function", "optional", "outer"]

WIDTH = 100
"""Of a line."""


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


def call(function: str, arguments: Sequence[str]) -> str:
    """A call, in lines that are not too long."""
    line = f"{function}({', '.join(arguments)})"
    if len(line) < WIDTH:
        return line
    return f"{function}(\n" + "".join(f"            {each},\n" for each in arguments) + "        )"


def function(
    node: ast.FunctionDef | ast.AsyncFunctionDef, returns: ast.expr | None, text: str | None, body: str
) -> str:
    """A method whose body is one statement."""
    gives = "" if returns is None else f" -> {ast.unparse(returns)}"
    line = f"    def {node.name}({ast.unparse(node.args)}){gives}:\n"
    if len(line) > WIDTH:
        line = f"    def {node.name}(\n"
        line += "".join(f"        {each},\n" for each in arguments_of(node.args)) + f"    ){gives}:\n"
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


def _argument(each: ast.arg, default: ast.expr | None) -> str:
    kind = "" if each.annotation is None else f": {ast.unparse(each.annotation)}"
    value = "" if default is None else f"{' = ' if kind else '='}{ast.unparse(default)}"
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
