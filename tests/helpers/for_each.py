"""`for_each`: a single test that checks many rows and reports every failed one."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterable
from typing import Any

import pytest

__all__ = ["for_each"]

MAX_LENGTH = 200
Check = Callable[..., None]


def for_each(names: str, rows: Iterable[Any]) -> Callable[[Check], Check]:
    """Run the decorated check for each row, as one test. Its failure lists all failed rows with their errors.

    Args:
        names: the argument, or the arguments separated by commas, that a row fills; others are fixtures.
        rows: values, or tuples of values if there are several names.
    """
    keys = [name.strip() for name in names.split(",")]

    def decorate(check: Check) -> Check:
        @functools.wraps(check)
        def test(**fixtures: Any) -> None:
            count, failures = 0, []
            for count, row in enumerate(rows, 1):  # noqa: B007 - the count is asked for afterwards
                values = dict(zip(keys, row if len(keys) > 1 else (row,), strict=True))
                try:
                    check(**values, **fixtures)
                except (Exception, pytest.fail.Exception) as error:
                    what = ", ".join(str(value)[:MAX_LENGTH] for value in values.values())
                    failures.append(f"{what}: {type(error).__name__}: {error}")
            assert count, "there are no cases to check"
            if failures:
                pytest.fail("\n".join((f"{len(failures)} of {count}:", *failures)), pytrace=False)

        signature = inspect.signature(check)
        own = [parameter for name, parameter in signature.parameters.items() if name not in keys]
        test.__signature__ = signature.replace(parameters=own)  # type: ignore[attr-defined]
        return test

    return decorate
