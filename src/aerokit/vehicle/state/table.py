"""Generates the table of all states in docs/states.md: ``python -m aerokit.vehicle.state.table > docs/states.md``."""

from __future__ import annotations

import ast
import re
import sys
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from aerokit.vehicle.state import states
from aerokit.vehicle.state.field import message_type

if TYPE_CHECKING:
    from aerokit.vehicle.state.field import MessageSource, StateField

HEAD = """# Vehicle state

Every state is a cell of the vehicle: `vehicle.position.value`, `.latest`, `.age`, `.source`, `.fresh(within=1)`,
`await vehicle.position.wait_until(…)`, `async for … in vehicle.position.changes()`. Values are in SI units and
degrees; their classes are in [vehicle/state](../src/aerokit/vehicle/state). The last column lists the messages that
report the state, the best source first, with the rates that aerokit requests unless you pass `connect(rates=…)`. "While
watched": only while your program waits for the state or follows its changes; reading it requests nothing.

| State | Type | What it is | Messages |
|---|---|---|---|
"""


def documentation() -> dict[str, tuple[str, str]]:
    """Return the type and the documentation of each state, as they are in states.py."""
    module = ast.parse(Path(states.__file__).read_text(encoding="utf-8"))
    (states_class,) = (node for node in module.body if isinstance(node, ast.ClassDef))
    type_and_text: dict[str, tuple[str, str]] = {}
    for declaration, next_node in pairwise(states_class.body):
        if isinstance(declaration, ast.AnnAssign) and isinstance(declaration.target, ast.Name):
            is_text = isinstance(next_node, ast.Expr) and isinstance(next_node.value, ast.Constant)
            text = str(next_node.value.value) if is_text else ""  # type: ignore[attr-defined]
            value_type = ast.unparse(declaration.annotation).removeprefix("StateField[").removesuffix("]")
            value_type = re.sub(r"\w+\.", "", value_type)  # The names of modules are left out.
            type_and_text[declaration.target.id] = (value_type, text)
    return type_and_text


def rendered() -> str:
    """Return the text of docs/states.md."""
    texts = documentation()
    return HEAD + "".join(_row(name, *texts[name], field) for name, field in states.STATES.items())


def _row(name: str, value_type: str, text: str, field: StateField[Any]) -> str:
    sources = ", ".join(f"{message_type(source.message).NAME}{_rate(source)}" for source in field.sources)
    return f"| `{name}` | `{value_type}` | {text.partition(' (')[0].rstrip('.')} | {sources} |\n"


def _rate(source: MessageSource[Any]) -> str:
    if source.watched_hz:
        return f" at {source.watched_hz:g} Hz while watched"
    return f" at {source.hz:g} Hz" if source.hz else ""


if __name__ == "__main__":
    sys.stdout.write(rendered())
