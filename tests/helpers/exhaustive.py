"""Long tables of rows: the default run takes a sample of them, `nox -s exhaustive` the others.

The marker ``exhaustive`` is deselected by pyproject.toml; ``pytest -m ""`` runs everything.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest

__all__ = ["exhaustive", "sampled"]


def exhaustive(row: Any) -> Any:
    """A row for ``parametrize`` that the default run leaves out."""
    values, marks, name = row if hasattr(row, "marks") else ((row,), (), None)
    return pytest.param(*values, marks=[*marks, pytest.mark.exhaustive], id=name)


def sampled(rows: Iterable[Any], every: int) -> list[Any]:
    """Rows for ``parametrize``: the default run takes the first of each ``every``."""
    return [exhaustive(row) if place % every else row for place, row in enumerate(rows)]
