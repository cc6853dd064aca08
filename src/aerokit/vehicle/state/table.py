"""Generates the table of all states in docs/states.md: ``python -m aerokit.vehicle.state.table > docs/states.md``."""

from __future__ import annotations

import ast
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
    """Return type and documentation of each state by name, from the source."""
    (body,) = (
        node.body
        for node in ast.parse(Path(states.__file__).read_text(encoding="utf-8")).body
        if isinstance(node, ast.ClassDef)
    )
    found: dict[str, tuple[str, str]] = {}
    for node, below in pairwise(body):
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            is_text = isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant)
            text = str(below.value.value) if is_text else ""  # type: ignore[attr-defined]
            kind = ast.unparse(node.annotation).removeprefix("StateField[").removesuffix("]")
            found[node.target.id] = (kind, text)
    return found


def rendered() -> str:
    """Return the whole page."""
    texts = documentation()
    return HEAD + "".join(_row(name, *texts[name], field) for name, field in states.STATES.items())


def _row(name: str, kind: str, text: str, field: StateField[Any]) -> str:
    sources = ", ".join(f"{message_type(source.message).NAME}{_rate(source)}" for source in field.sources)
    return f"| `{name}` | `{kind}` | {text.partition(' (')[0].rstrip('.')} | {sources} |\n"


def _rate(source: MessageSource[Any]) -> str:
    if source.watched_hz:
        return f" at {source.watched_hz:g} Hz while watched"
    return f" at {source.hz:g} Hz" if source.hz else ""


if __name__ == "__main__":
    sys.stdout.write(rendered())
