"""Sampling of long tables: the default run tests some rows, `nox -s exhaustive` the others.

The marker ``exhaustive`` is deselected in pyproject.toml; ``pytest -m ""`` runs everything.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest

__all__ = ["exhaustive", "sampled"]


def exhaustive(row: Any) -> Any:
    """Create a row for ``parametrize`` that the default run skips."""
    values, marks, name = row if hasattr(row, "marks") else ((row,), (), None)
    return pytest.param(*values, marks=[*marks, pytest.mark.exhaustive], id=name)


def sampled(rows: Iterable[Any], every: int) -> list[Any]:
    """Create rows for ``parametrize``. The default run tests one of ``every`` rows."""
    return [exhaustive(row) if place % every else row for place, row in enumerate(rows)]
