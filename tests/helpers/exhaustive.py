"""Rows that the default run skips; `nox -s exhaustive` tests them.

The marker ``exhaustive`` is deselected in pyproject.toml; ``pytest -m ""`` runs everything. The marker ``sampled(n)``
(conftest.py) sets it for many similar rows.
"""

from __future__ import annotations

from typing import Any

import pytest

__all__ = ["exhaustive"]


def exhaustive(row: Any) -> Any:
    """Create a row for ``parametrize`` that the default run skips."""
    values, marks, name = row if hasattr(row, "marks") else ((row,), (), None)
    return pytest.param(*values, marks=[*marks, pytest.mark.exhaustive], id=name)
