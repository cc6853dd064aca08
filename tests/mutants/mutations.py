"""Single changes of a source file: cosmic-ray's operators, and an operator that removes a statement."""

from __future__ import annotations

import ast
import difflib
from dataclasses import dataclass
from typing import Any

from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.operators import boolean_replacer as booleans
from cosmic_ray.operators import break_continue
from cosmic_ray.operators.operator import Example, Operator
from cosmic_ray.operators.provider import OperatorProvider
from cosmic_ray.operators.zero_iteration_for_loop import ZeroIterationForLoop

SWAPS = {
    "BinaryOperator": (
        "Add_Sub", "Sub_Add", "Mul_Div", "Div_Mul", "FloorDiv_Mul", "Mod_Add", "BitAnd_BitOr", "BitOr_BitAnd",
        "LShift_RShift", "RShift_LShift",
    ),
    "ComparisonOperator": (
        "Eq_NotEq", "NotEq_Eq", "Lt_LtE", "LtE_Lt", "Gt_GtE", "GtE_Gt", "Lt_Gt", "Gt_Lt", "LtE_Gt", "GtE_Lt",
        "Is_IsNot", "IsNot_Is",
    ),
    "UnaryOperator": ("Delete_USub", "Delete_Not"),
}  # fmt: skip
"""Each operator's opposite and its neighbour: the whole product of cosmic-ray is mostly noticed, and costs days."""


class RemoveStatement(Operator):  # type: ignore[misc]
    """Removes a call, an assignment to an object, a raise, a return or a continue."""

    def mutation_positions(self, node: Any) -> Any:
        if node.type == "simple_stmt" and _does_something(node.children[0]):
            yield node.start_pos, node.children[0].end_pos

    def mutate(self, node: Any, index: int) -> Any:
        return get_ast(f"{node.get_first_leaf().prefix}pass\n")

    @classmethod
    def examples(cls) -> Any:
        return (Example("send(order)\n", "pass\n"),)


def _does_something(statement: Any) -> bool:
    if statement.type == "expr_stmt":
        target, sign = statement.children[:2]
        plain = target.type in ("name", "testlist_star_expr")
        return not plain or (sign.type == "operator" and sign.value != "=")
    if statement.type == "keyword":
        return bool(statement.value in ("return", "continue"))
    return statement.type in ("atom_expr", "power", "raise_stmt", "del_stmt")


OPERATORS: dict[str, type[Operator]] = {
    **{
        name: OperatorProvider()[name]
        for kind, swaps in SWAPS.items()
        for name in (f"Replace{kind}_{swap}" for swap in swaps)
    },
    **{
        operator.__name__: operator
        for operator in (
            booleans.AddNot, booleans.ReplaceTrueWithFalse, booleans.ReplaceFalseWithTrue,
            booleans.ReplaceAndWithOr, booleans.ReplaceOrWithAnd, break_continue.ReplaceBreakWithContinue,
            break_continue.ReplaceContinueWithBreak, ZeroIterationForLoop, OperatorProvider()["NumberReplacer"],
            RemoveStatement,
        )
    },
}  # fmt: skip


@dataclass(frozen=True)
class Mutation:
    """One change of one file, by its operator and the operator's count."""

    path: str
    operator: str
    occurrence: int
    lines: tuple[int, ...]
    """Lines of the statement: the tests that run one of them run the change."""
    at_import: bool
    """True if it runs only at import: then any test may depend on it."""

    def apply(self, source: str) -> str | None:
        """Return the changed source; ``None`` if only an annotation changes, which is not executed."""
        changed = mutate_code(source, OPERATORS[self.operator](), self.occurrence)
        return changed if changed is not None and _runs_otherwise(source, changed) else None


def mutations_of(path: str, source: str) -> list[Mutation]:
    """Every change of the file."""
    counts, found = dict.fromkeys(OPERATORS, 0), list[Mutation]()
    statements, never_run = _statements(source), _for_type_checkers(source)
    for node in ast_nodes(get_ast(source)):
        for name, operator in OPERATORS.items():
            positions: Any = operator().mutation_positions(node)
            for (line, _), _ in positions:
                if not _is_marker(node) and line not in never_run:
                    found.append(Mutation(path, name, counts[name], *statements.get(line, ((line,), True))))
                counts[name] += 1
    return found


def _for_type_checkers(source: str) -> set[int]:
    """The lines below ``if TYPE_CHECKING``."""
    blocks = [
        node
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"
    ]
    return {line for block in blocks for line in range(block.lineno, (block.body[-1].end_lineno or 0) + 1)}


def _is_marker(node: Any) -> bool:
    """The star of keyword-only arguments, of unpacking, of an import."""
    return node.type == "operator" and node.value == "*" and node.parent.type not in ("term", "arith_expr")


def _statements(source: str) -> dict[int, tuple[tuple[int, ...], bool]]:
    """The lines of the innermost statement on each line, of a compound one its head; whether it runs at import."""
    found: dict[int, tuple[tuple[int, ...], bool]] = {}

    def visit(node: ast.AST, at_import: bool) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, (ast.stmt, ast.excepthandler)):
                body = getattr(child, "body", None)
                end = max(body[0].lineno - 1, child.lineno) if body else child.end_lineno or child.lineno
                lines = range(child.lineno, end + 1)
                found.update(dict.fromkeys(lines, (tuple(lines), at_import)))
            visit(child, at_import and not isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef)))

    visit(ast.parse(source), True)
    return found


def difference(before: str, after: str) -> tuple[str, str]:
    """Return the code before and after, in one line each."""
    changes = list(difflib.unified_diff(before.splitlines(), after.splitlines(), n=0))[3:]
    old, new = (" ".join(line[1:].strip() for line in changes if line[0] == sign) for sign in "-+")
    return old, new


class _WithoutAnnotations(ast.NodeTransformer):
    def visit_arg(self, node: ast.arg) -> ast.arg:
        return ast.arg(node.arg)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> ast.AST:
        none = ast.Constant(None)
        return ast.AnnAssign(node.target, none, node.value and self.visit(node.value), node.simple)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        node.returns = None
        return self.generic_visit(node)

    def visit_AsyncFunctionDef(self, node: ast.AsyncFunctionDef) -> ast.AST:
        node.returns = None
        return self.generic_visit(node)


def _runs_otherwise(before: str, after: str) -> bool:
    trees = (ast.dump(_WithoutAnnotations().visit(ast.parse(text))) for text in (before, after))
    return next(trees) != next(trees)
