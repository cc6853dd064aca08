"""The tree of errors in docs/how-to/errors.md equals the class hierarchy, and its first example prints names."""

from __future__ import annotations

import ast
import asyncio
import builtins
from pathlib import Path
from typing import Any

import pages
import pytest

from aerokit import errors

PAGE = Path(__file__).parent.parent / "docs" / "how-to" / "errors.md"


def branch(cls: type[BaseException], depth: int = 0) -> list[str]:
    """Return lines for a class, its built-in bases, and its subclasses below."""
    builtin = [base.__name__ for base in cls.__bases__ if base.__module__ == builtins.__name__]
    also = f" ({', '.join(builtin)})" if builtin and cls is not errors.AerokitError else ""
    below = [error for error in (getattr(errors, name) for name in errors.__all__) if error.__bases__[0] is cls]
    lines = [f"{'  ' * depth}{cls.__name__}{also}"]
    return lines + [line for subclass in below for line in branch(subclass, depth + 1)]


def test_error_tree_in_reference_matches_classes() -> None:
    tree = branch(errors.AerokitError)
    assert "\n".join(tree) in PAGE.read_text(encoding="utf-8")
    assert len(tree) == len(errors.__all__)


def test_first_example_prints_name_of_result(capsys: pytest.CaptureFixture[str]) -> None:
    class Vehicle:
        async def arm(self) -> None:
            raise errors.CommandRejected("refused", command=400, result=4, reasons=("Arm: Compass not healthy",))

    code: Any = compile(pages.blocks(PAGE)[0].body, str(PAGE), "exec", flags=ast.PyCF_ALLOW_TOP_LEVEL_AWAIT)
    asyncio.run(eval(code, {"vehicle": Vehicle()}))
    assert capsys.readouterr().out == "FAILED ('Arm: Compass not healthy',)\n"


def test_file_and_stream_errors_have_own_bases() -> None:
    assert not issubclass(errors.FileFormatError, errors.InvalidArgument)
    assert not issubclass(errors.SetpointStreamStopped, errors.OperationRejected)
