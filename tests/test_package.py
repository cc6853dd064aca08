"""The package: public names and import time."""

from __future__ import annotations

import hashlib
import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest
from for_each import for_each

import aerokit


@for_each("name", aerokit.__all__)
def test_public_names_are_importable(name: str) -> None:
    assert getattr(aerokit, name) is getattr(aerokit, name)
    assert name in dir(aerokit)


@for_each("name", ["", ".hub", ".missions", ".onboard", ".parameters", ".sync", ".testing", ".transport"])
def test_lazy_names_are_known_to_type_checkers(name: str) -> None:
    package = importlib.import_module(f"aerokit{name}")
    typed = set(re.findall(r" as (\w+)$", Path(str(package.__file__)).read_text(encoding="utf-8"), re.MULTILINE))
    differing = typed.symmetric_difference(package.__all__)
    assert not differing, f"write them in lazy_exports and in the imports above: {sorted(differing)}"


def test_unknown_name_raises_attribute_error() -> None:
    with pytest.raises(AttributeError, match=r"module 'aerokit' has no attribute 'conect'$"):
        getattr(aerokit, "conect")  # noqa: B009


@pytest.mark.parametrize(("name", "module"), [("AerokitError", "errors"), ("ModeChanged", "events")])
def test_name_of_submodule_is_suggested(name: str, module: str) -> None:
    with pytest.raises(AttributeError, match=rf"no attribute '{name}': did you mean aerokit\.{module}\.{name}\?$"):
        getattr(aerokit, name)


def test_import_is_lazy() -> None:
    program = "import sys, aerokit; bare = set(sys.modules); aerokit.connect; print('asyncio' in bare)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"


SOURCE = Path(aerokit.__file__).parent
LEAFLET_SHA256 = {
    "leaflet.js": "db49d009c841f5ca34a888c96511ae936fd9f5533e90d8b2c4d57596f4e5641a",
    "leaflet.css": "a7837102824184820dfa198d1ebcd109ff6d0ff9a2672a074b9a1b4d147d04c6",
    "LICENSE": "53e8dc25862014e4324741ca18fbe3611e11d42ef69f59f86ea8c5389647d4cb",
}
"""Files of the npm package leaflet 1.9.4."""


def test_leaflet_is_vendored_unchanged() -> None:
    folder = SOURCE / "apps" / "serve" / "static" / "vendor" / "leaflet"
    assert {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.iterdir()} == LEAFLET_SHA256


def mixed(folder: Path, init: str | None) -> Path:
    """Remains of the unrelated project named aerokit, installed before ours (None) or after it."""
    package = folder / "aerokit"
    package.mkdir()
    for path in SOURCE.iterdir():
        if path.name not in ("__pycache__", "__init__.py"):
            (package / path.name).symlink_to(path)
    (package / "__init__.py").write_text((SOURCE / "__init__.py").read_text() if init is None else init)
    (package / "aero").mkdir()
    (package / "aero" / "__init__.py").touch()
    return folder


def run(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-B", *arguments], capture_output=True, text=True, cwd=folder, check=False)


def test_other_aerokit_is_detected_at_import(tmp_path: Path) -> None:
    done = run(mixed(tmp_path, None), "-c", "import aerokit; aerokit.Position")
    assert done.returncode == 0
    assert "RuntimeWarning: files of another project called aerokit (aerokit.aero)" in done.stderr
    assert "pip uninstall aerokit aerokit-mavlink" in done.stderr


def test_command_line_detects_overwritten_package(tmp_path: Path) -> None:
    done = run(mixed(tmp_path, '__version__ = "1.5.0"\n'), "-m", "aerokit", "sim", "--help")
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("aerokit: files of another project")


def test_enums_and_messages_modules_are_lazy() -> None:
    code = (
        "import sys; from aerokit.enums import MavState; from aerokit.messages import Heartbeat; import aerokit;"
        " assert aerokit.enums.MavState is MavState; assert aerokit.messages.Heartbeat is Heartbeat;"
        " assert 'aerokit.mavlink.enums.development' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_connect_loads_only_required_modules() -> None:
    code = (
        "import sys, aerokit; aerokit.connect;"
        " print([name for name in ('serial', 'pymavlink', 'xml',"
        " 'aerokit.mavlink.messages.common_more', 'aerokit.mavlink.runtime_dialect') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_messages_are_imported_before_link_opens() -> None:
    code = """
import asyncio, sys
from aerokit.connection.opening import open_connection
from aerokit.errors import LinkOpenError
from aerokit.transport.link import memory_link_pair

link, _ = memory_link_pair()
async def refuse(receiver):
    print('aerokit.mavlink.messages.common_more' in sys.modules)
    raise LinkOpenError('as ordered')
link.open = refuse
async def main():
    try:
        async with open_connection(link):
            pass
    except LinkOpenError:
        pass
asyncio.run(main())
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "True\n"
