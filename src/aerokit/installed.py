"""Whether what is installed as ``aerokit`` is this library alone.

PyPI has another project of this name, for compressible flow. Its files go to the same folder as ours, so that
installing both leaves a mixture of which neither may work.
"""

from __future__ import annotations

import os

__all__ = ["complaint"]

_OTHERS = ("aero", "engine", "stability")
"""Packages that only the other project has: ``aerokit.aero`` and so on."""


def complaint(folder: str, *, is_ours: bool = True) -> str | None:
    """What is wrong with the files in the folder of the package, and what to do; None: nothing.

    ``is_ours`` says whether the package's ``__init__`` was this library's.
    """
    others = [name for name in _OTHERS if os.path.isfile(os.path.join(folder, name, "__init__.py"))]
    if is_ours and not others:
        return None
    found = f"aerokit.{others[0]}" if others else "its __init__.py"
    return (
        f"files of another project called aerokit ({found}) are mixed into this one in {folder}:"
        " run pip uninstall aerokit aerokit-mavlink, then pip install aerokit-mavlink, the one for drones"
    )
