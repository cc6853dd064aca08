"""Builds `aerokit._wire`, the compiled wire, where there is a C compiler; otherwise the wheel is pure Python.

With ``AEROKIT_PURE=1``, and on other Pythons than CPython with its GIL, nothing is compiled. A wheel for CPython serves
all versions from 3.10 (abi3).
"""

from __future__ import annotations

import os
import platform
import sysconfig
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class WireBuildHook(BuildHookInterface[Any]):
    """Compiles the extension into the wheel, or beside its source for an editable installation."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        has_gil = not sysconfig.get_config_var("Py_GIL_DISABLED")
        if os.environ.get("AEROKIT_PURE", "") not in ("", "0") or platform.python_implementation() != "CPython":
            return
        try:
            built = self._compiled() if has_gil else None
        except (Exception, SystemExit) as error:  # no compiler, no headers, no setuptools
            self.app.display_info(f"aerokit._wire is not built, aerokit uses its Python wire: {error}")
            return
        if built is None:
            return
        if version == "editable":
            target = Path(self.root, "src", "aerokit", built.name)
            target.with_suffix(".new").write_bytes(built.read_bytes())
            target.with_suffix(".new").replace(target)  # programs that use the old one keep it
            return
        build_data["force_include"][str(built)] = f"aerokit/{built.name}"
        build_data["pure_python"] = False
        build_data["tag"] = f"cp310-abi3-{sysconfig.get_platform().replace('-', '_').replace('.', '_')}"

    def _compiled(self) -> Path:
        from setuptools import Distribution, Extension

        self._folder = tempfile.TemporaryDirectory()  # until the wheel is written
        folder = self._folder.name
        extension = Extension(
            "aerokit._wire",
            [str(Path(self.root, "src", "aerokit", "_wire.c"))],
            define_macros=[("Py_LIMITED_API", "0x030A0000")],
            py_limited_api=True,
        )
        command: Any = Distribution({"ext_modules": [extension]}).get_command_obj("build_ext")
        command.build_lib, command.build_temp = folder, os.path.join(folder, "objects")
        command.ensure_finalized()
        command.run()
        (built,) = Path(folder, "aerokit").iterdir()
        return built
