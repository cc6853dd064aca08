"""The parts of simulated vehicles see hosts below them: the simulator has no circle of imports, types included."""

from __future__ import annotations

import ast
from graphlib import TopologicalSorter
from pathlib import Path

SOURCE = Path(__file__).parents[2] / "src"


def test_the_simulator_has_no_circle_of_imports() -> None:
    trees = {
        ".".join(path.relative_to(SOURCE).with_suffix("").parts).removesuffix(".__init__"): ast.parse(
            path.read_text(encoding="utf-8")
        )
        for path in (SOURCE / "aerokit" / "sim").rglob("*.py")
    }
    graph: dict[str, set[str]] = {}
    for module, tree in trees.items():
        graph[module] = set()
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module:
                graph[module] |= {f"{node.module}.{alias.name}" for alias in node.names} & trees.keys()
                graph[module] |= {node.module} & trees.keys() - {module}
    TopologicalSorter(graph).prepare()
