"""Single changes of a source file: cosmic-ray's operators, and one of ours that takes a statement away."""

from __future__ import annotations

import ast
import difflib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import parso
from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.operators import boolean_replacer as booleans
from cosmic_ray.operators import break_continue
from cosmic_ray.operators.operator import Example, Operator
from cosmic_ray.operators.provider import OperatorProvider
from cosmic_ray.operators.zero_iteration_for_loop import ZeroIterationForLoop

SWAPS = (
    "ReplaceBinaryOperator_Add_Sub", "ReplaceBinaryOperator_Sub_Add", "ReplaceBinaryOperator_Mul_Div", "ReplaceBinaryOperator_Div_Mul",
    "ReplaceBinaryOperator_FloorDiv_Mul", "ReplaceBinaryOperator_Mod_Add", "ReplaceBinaryOperator_BitAnd_BitOr",
    "ReplaceBinaryOperator_BitOr_BitAnd", "ReplaceBinaryOperator_LShift_RShift", "ReplaceBinaryOperator_RShift_LShift",
    "ReplaceComparisonOperator_Eq_NotEq", "ReplaceComparisonOperator_NotEq_Eq", "ReplaceComparisonOperator_Lt_LtE",
    "ReplaceComparisonOperator_LtE_Lt", "ReplaceComparisonOperator_Gt_GtE", "ReplaceComparisonOperator_GtE_Gt",
    "ReplaceComparisonOperator_Lt_Gt", "ReplaceComparisonOperator_Gt_Lt", "ReplaceComparisonOperator_LtE_Gt", "ReplaceComparisonOperator_GtE_Lt",
    "ReplaceComparisonOperator_Is_IsNot", "ReplaceComparisonOperator_IsNot_Is", "ReplaceUnaryOperator_Delete_USub",
    "ReplaceUnaryOperator_Delete_Not",
)  # fmt: skip
"""Each operator's opposite and its neighbour: the whole product of cosmic-ray is mostly noticed, and costs days."""


class RemoveStatement(Operator):  # type: ignore[misc]
    """A call, a change of an object, a raise, a return or a continue that is gone: resends, checks, tables."""

    def mutation_positions(self, node: Any) -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
        if node.type == "simple_stmt" and _does_something(node.children[0]):
            yield node.start_pos, node.children[0].end_pos

    def mutate(self, node: Any, index: int) -> Any:
        return parso.parse(f"{node.get_first_leaf().prefix}pass\n")

    @classmethod
    def examples(cls) -> tuple[Example, ...]:
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
    **{name: OperatorProvider()[name] for name in SWAPS},
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
    """Of the statement: the tests that run one of them run the change."""

    def apply(self, source: str) -> str | None:
        """The changed source; ``None`` where only an annotation changes, which nobody runs."""
        changed = mutate_code(source, OPERATORS[self.operator](), self.occurrence)
        return changed if changed is not None and _runs_otherwise(source, changed) else None


def mutations_of(path: str, source: str) -> list[Mutation]:
    """Every change of the file."""
    counts, found = dict.fromkeys(OPERATORS, 0), list[Mutation]()
    statements = _statements(source)
    for node in ast_nodes(get_ast(source)):
        for name, operator in OPERATORS.items():
            for (line, _), _ in operator().mutation_positions(node):
                if not _is_marker(node):
                    found.append(Mutation(path, name, counts[name], statements.get(line, (line,))))
                counts[name] += 1
    return found


def _is_marker(node: Any) -> bool:
    """The star of keyword-only arguments, of unpacking, of an import."""
    return node.type == "operator" and node.value == "*" and node.parent.type not in ("term", "arith_expr")


def _statements(source: str) -> dict[int, tuple[int, ...]]:
    """The lines of the innermost statement on each line, of a compound one its head."""
    found: dict[int, tuple[int, ...]] = {}
    for node in ast.walk(ast.parse(source)):  # from the outside in
        if isinstance(node, ast.stmt):
            body = getattr(node, "body", None)
            end = max(body[0].lineno - 1, node.lineno) if body else node.end_lineno or node.lineno
            found |= dict.fromkeys(range(node.lineno, end + 1), tuple(range(node.lineno, end + 1)))
        elif isinstance(node, ast.excepthandler):
            found[node.lineno] = (node.lineno,)
    return found


def difference(before: str, after: str) -> tuple[str, str]:
    """What stood there and what stands there now, in one line each."""
    changes = list(difflib.unified_diff(before.splitlines(), after.splitlines(), n=0))[3:]
    old, new = (" ".join(line[1:].strip() for line in changes if line[0] == sign) for sign in "-+")
    return old, new


class _WithoutAnnotations(ast.NodeTransformer):
    def visit_arg(self, node: ast.arg) -> ast.arg:
        return ast.arg(node.arg)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> ast.AST:  # noqa: N802
        none = ast.Constant(None)
        return ast.AnnAssign(node.target, none, node.value and self.visit(node.value), node.simple)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:  # noqa: N802
        node.returns = None
        return self.generic_visit(node)

    def visit_AsyncFunctionDef(self, node: ast.AsyncFunctionDef) -> ast.AST:  # noqa: N802
        node.returns = None
        return self.generic_visit(node)


def _runs_otherwise(before: str, after: str) -> bool:
    trees = (ast.dump(_WithoutAnnotations().visit(ast.parse(text))) for text in (before, after))
    return next(trees) != next(trees)
