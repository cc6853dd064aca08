"""The tree of errors in docs/how-to/errors.md is that of the classes."""

from __future__ import annotations

import builtins
from pathlib import Path

from aerokit import errors

PAGE = Path(__file__).parent.parent / "docs" / "how-to" / "errors.md"


def branch(cls: type[BaseException], depth: int = 0) -> list[str]:
    """A class, with the built-in errors that it is, too, and below it those that are of its kind."""
    builtin = [base.__name__ for base in cls.__bases__ if base.__module__ == builtins.__name__]
    also = f" ({', '.join(builtin)})" if builtin and cls is not errors.AerokitError else ""
    below = [each for each in (getattr(errors, name) for name in errors.__all__) if each.__bases__[0] is cls]
    lines = [f"{'  ' * depth}{cls.__name__}{also}"]
    return lines + [line for each in below for line in branch(each, depth + 1)]


def test_tree_of_errors_is_that_of_the_classes() -> None:
    tree = branch(errors.AerokitError)
    assert "\n".join(tree) in PAGE.read_text(encoding="utf-8")
    assert len(tree) == len(errors.__all__)


def test_errors_of_files_and_streams_are_no_arguments_and_no_refusals() -> None:
    assert not issubclass(errors.FileFormatError, errors.InvalidArgument)
    assert not issubclass(errors.SetpointStreamStopped, errors.OperationRejected)
