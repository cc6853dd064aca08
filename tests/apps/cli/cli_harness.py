"""Commands on virtual time: their own coroutines, with a link in memory in place of the address."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import anyio

from aerokit.apps.cli.main import make_parser
from aerokit.apps.cli.output import exit_code, tell_error
from aerokit.errors import AerokitError
from aerokit.sim import SimulatedVehicle, simulated_link
from aerokit.testing import run_virtual
from aerokit.transport.link import Link

DOCUMENT = Path(__file__).parents[3] / "docs" / "command-line.md"
MISSION = """QGC WPL 110
0\t1\t0\t16\t0\t0\t0\t0\t47.397742\t8.545594\t488\t1
1\t0\t3\t22\t0\t0\t0\t0\t0\t0\t15\t1
2\t0\t3\t16\t0\t0\t0\t0\t47.398\t8.5456\t15\t1
3\t0\t3\t16\t0\t0\t0\t0\t47.398\t8.5460\t15\t1
4\t0\t3\t20\t0\t0\t0\t0\t0\t0\t0\t1
"""
HOME = (47.397742, 8.545594, 488.0)


async def run_on(link: Link | None, *arguments: str) -> int:
    """Run a command as ``main`` does, with this link as its address."""
    options = make_parser(arguments[0]).parse_args(arguments)
    if link is not None:
        setattr(options, "address" if hasattr(options, "address") else "connect", link)
    try:
        code: int = await options.run(options)
    except (AerokitError, OSError) as error:
        code = exit_code(error)
        tell_error(error, code, as_json=options.json)
    return code


def run_with(vehicles: SimulatedVehicle | Iterable[SimulatedVehicle], *commands: Iterable[str]) -> list[int]:
    """Run commands one after the other, each with a link of its own to the vehicles; their exit codes."""

    async def run() -> list[int]:
        codes = []
        for arguments in commands:
            async with simulated_link(vehicles) as link:
                codes.append(await run_on(link, *arguments))
        return codes

    return run_virtual(run())


def documented() -> Mapping[str, frozenset[str]]:
    """Type of record → its fields, by the table in docs/command-line.md."""
    rows = {}
    for line in DOCUMENT.read_text(encoding="utf-8").partition("## JSON")[2].splitlines():
        cells = [each.strip() for each in line.strip("|").split("|")]
        if line.startswith("| `"):
            rows[cells[0].strip("`")] = frozenset(each.strip(" `") for each in cells[2].split(",") if each)
    return rows


def records(text: str) -> list[dict[str, Any]]:
    """What was printed, each line checked against the table."""
    told = [json.loads(line) for line in text.splitlines()]
    rows = documented()
    for record in told:
        assert next(iter(record)) == "type"
        assert set(record) - {"type"} == rows[record["type"]], record
    return told


async def until(condition: Callable[[], object]) -> None:
    """Let virtual time pass until it holds."""
    while not condition():  # noqa: ASYNC110 - nobody else could say it
        await anyio.sleep(0.1)


def ctrl_c() -> None:
    """As the terminal does it."""
    signal.raise_signal(signal.SIGINT)
