"""The package itself: its public names, and what importing it costs."""

from __future__ import annotations

import subprocess
import sys

import pytest

import aerokit


@pytest.mark.parametrize("name", aerokit.__all__)
def test_every_public_name_is_there(name: str) -> None:
    assert getattr(aerokit, name) is getattr(aerokit, name)
    assert name in dir(aerokit)


def test_another_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="module 'aerokit' has no attribute 'conect'"):
        getattr(aerokit, "conect")  # noqa: B009


def test_import_loads_nothing_before_it_is_asked_for() -> None:
    program = "import sys, aerokit; bare = set(sys.modules); aerokit.connect; print('asyncio' in bare)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"
