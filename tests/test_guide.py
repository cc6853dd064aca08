"""Every block of Python in docs/guide.md runs."""

from __future__ import annotations

import asyncio
import pathlib
import re
import textwrap
from typing import Any

import pytest
from served_copter import served_copter

import aerokit
import aerokit.sync
from aerokit import Dialect, enums, errors, events, messages
from aerokit.sim import SimulatedCopter, open_simulator, simulated_link
from aerokit.testing import run_virtual

GUIDE = (pathlib.Path(__file__).parent.parent / "docs" / "guide.md").read_text(encoding="utf-8")
ADDRESS = '"udpin:0.0.0.0:14550"'
BLOCKS = [
    pytest.param(kind.strip(), body, id=f"{number}{kind.replace(' ', '-')}")
    for number, (kind, body) in enumerate(re.findall(r"^```python(.*?)\n(.*?)^```$", GUIDE, re.DOTALL | re.M))
    if kind != " norun"  # needs packages that are not here
]
NAMES: dict[str, Any] = {
    "Dialect": Dialect,
    "SimulatedCopter": SimulatedCopter,
    "aerokit": aerokit,
    "asyncio": asyncio,
    "enums": enums,
    "errors": errors,
    "events": events,
    "messages": messages,
    "open_simulator": open_simulator,
    "pathlib": pathlib,
    "pytest": pytest,
    "run_virtual": run_virtual,
    "simulated_link": simulated_link,
}


def run_async(body: str) -> None:
    """Run a block inside a coroutine; ``vehicle`` is connected unless the block connects by itself."""
    names = dict(NAMES)
    code = "async def block(link, vehicle):\n" + textwrap.indent(body.replace(ADDRESS, "link"), "    ")
    exec(compile(code, "docs/guide.md", "exec"), names)

    async def main() -> None:
        copters = [SimulatedCopter(system_id=number, boot_time_s=0.0) for number in (1, 2)]
        async with simulated_link(copters if "system_id=2" in body else copters[0]) as link:
            if ADDRESS in body:
                await names["block"](link, None)
            else:
                async with aerokit.connect(link) as vehicle:
                    await names["block"](link, vehicle)

    run_virtual(main())


@pytest.mark.parametrize(("kind", "body"), BLOCKS)
def test_block(kind: str, body: str, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    if kind == "sync":
        with served_copter() as address:
            exec(compile(body.replace(ADDRESS, repr(address)), "docs/guide.md", "exec"), dict(NAMES))
    elif kind == "virtual":
        exec(compile(body, "docs/guide.md", "exec"), dict(NAMES))
    else:
        run_async(body)
