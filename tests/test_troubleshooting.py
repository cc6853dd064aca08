"""docs/troubleshooting.md cannot rot: each text that it quotes is in the sources, or is provoked here."""

from __future__ import annotations

import ast
import asyncio
import builtins
import errno
import functools
import os
import re
import types
import warnings
from pathlib import Path

import pytest
from for_each import for_each

import aerokit
from aerokit import enums, errors
from aerokit.apps.cli.output import NotInstalled
from aerokit.sim import SimulatedCopter, simulated_link
from aerokit.testing import run_virtual
from aerokit.transport import memory_link_pair

ROOT = Path(__file__).parent.parent
PAGE = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
WITHOUT_BLOCKS = re.sub(r"^```.*?^```$", "", PAGE, flags=re.DOTALL | re.MULTILINE)
BLOCKS = re.findall(r"^```text\n(.*?)^```$", PAGE, flags=re.DOTALL | re.MULTILINE)
HEADINGS = re.findall(r"^### (`.*`)$", PAGE, flags=re.MULTILINE)
NOT_QUOTED = ("await ", "python ", "pip ", "aerokit ", "sudo ", "ss ", ". ")
"""How a span of code begins that is typed, and not printed by anything."""
LONG = 4
"""A span of so many words is a text that somebody has read; shorter ones are names."""
PRINTS_NO_ERRORS = (
    "mavlink/messages",
    "mavlink/enums",
    "sim/",
    "dronekit/",
    "logs/convert/",
    "apps/serve/",
    "testing/",
    "sync/twins",
    "sync/fleet_twins",
)
SAYS_ENOUGH = 10
"""So many letters of a quoted text have to stand in one piece somewhere."""


def quoted() -> list[str]:
    spans = [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", WITHOUT_BLOCKS)]
    long = [span for span in spans if len(span.split()) >= LONG and not span.startswith(NOT_QUOTED)]
    return list(dict.fromkeys([heading.strip("`") for heading in HEADINGS] + long))


@functools.cache
def literals() -> str:
    """What the sources can print, a line for each text between what varies."""
    found: set[str] = set()
    source = ROOT / "src" / "aerokit"
    for path in source.rglob("*.py"):
        if not str(path.relative_to(source).as_posix()).startswith(PRINTS_NO_ERRORS):
            for node in ast.walk(ast.parse(path.read_bytes())):
                if isinstance(node, ast.Constant) and isinstance(node.value, str):
                    found |= set(re.split(r"%[sdr]", node.value))
    return "\n".join(sorted(found))


@functools.cache
def pythons() -> tuple[str, ...]:
    """What Python and the system print by themselves, provoked."""
    texts = [os.strerror(number) for number in (errno.EADDRINUSE, errno.EACCES, errno.ENOENT)]
    for provoke in (lambda: types.ModuleType("aerokit").connect, lambda: compile("await x", "x.py", "exec")):
        with pytest.raises((AttributeError, SyntaxError)) as raised:
            provoke()
        texts.append(str(raised.value))

    async def arm() -> None:
        """Never awaited."""

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        _ = arm()
        del _
    return *texts, *(str(each.message) for each in caught)


def is_said(piece: str) -> bool:
    return piece in literals() or any(piece in text for text in pythons())


def test_the_page_has_headings_and_blocks() -> None:
    assert len(HEADINGS) > 60
    assert len(BLOCKS) == len(provoked())


@for_each("text", quoted())
def test_a_quoted_text_is_in_the_sources(text: str) -> None:
    pieces = [piece.strip(" ") for part in text.split("…") for piece in pieces_of(part)]
    missing = [piece for piece in pieces if piece and not is_said(piece)]
    assert not missing, f"nothing prints {missing}"
    assert max(map(len, pieces)) >= SAYS_ENOUGH or text == "… is not allowed: …", "it could be anything"


def pieces_of(part: str) -> list[str]:
    """A part as it is, or, where the sources put it together, in pieces."""
    if is_said(part.strip(" ")):
        return [part]
    return re.split(r"\(|\)|: |, |MAV_CMD_", part)


def error_classes() -> list[str]:
    return [*errors.__all__, NotInstalled.__name__]


@for_each("name", error_classes())
def test_each_class_of_errors_is_on_the_page(name: str) -> None:
    assert re.search(rf"\b{name}\b", PAGE)


def test_what_is_called_a_class_of_errors_is_one() -> None:
    named = set(re.findall(r"\b[A-Z][A-Za-z]+(?:Error|Timeout|Rejected|Failed)\b", PAGE))
    assert named <= {*error_classes(), *dir(builtins)}


# ---------------------------------------------------------------------------- blocks, whole errors


@functools.cache
def provoked() -> tuple[str, ...]:
    """The errors of the page, provoked on simulated vehicles."""
    return *run_virtual(nobody_is_heard()), *run_virtual(on_the_ground()), *run_virtual(in_the_air())


def told(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"


async def nobody_is_heard() -> list[str]:
    near, _ = memory_link_pair()
    with pytest.raises(errors.ConnectFailed) as failed:
        async with aerokit.connect(near):
            pass
    return [told(failed.value)]


async def on_the_ground() -> list[str]:
    copter = SimulatedCopter(boot_time_s=3.0)
    async with simulated_link(copter) as link, aerokit.connect(link) as vehicle:
        with pytest.raises(errors.OperationTimeout) as not_ready:
            await vehicle.wait_ready(timeout=2)
        await vehicle.wait_ready()
        copter.faults.ignore(enums.MavCmd.DO_SET_HOME)
        with pytest.raises(errors.CommandTimeout) as unanswered:
            await vehicle.command(enums.MavCmd.DO_SET_HOME, 1)
        copter.faults.silent = True
        await asyncio.sleep(3)
        with pytest.raises(errors.StaleValueError) as stale:
            vehicle.position.fresh(within=1)
        copter.faults.silent = False
        copter.faults.prearm_failures.append("Compass not healthy")
        await asyncio.sleep(10)
        with pytest.raises(errors.CommandRejected) as refused:
            await vehicle.arm()
    return [told(each.value) for each in (not_ready, unanswered, stale, refused)]


async def in_the_air() -> list[str]:
    async with simulated_link(SimulatedCopter(boot_time_s=0.0)) as link, aerokit.connect(link) as vehicle:
        await vehicle.wait_ready()
        await vehicle.arm()
        await vehicle.take_off(10)
        with pytest.raises(errors.SetpointStreamStopped) as stopped:
            async with vehicle.guided.velocity() as stream:
                stream.set(aerokit.VelocitySetpoint(north_m_s=1))
                await asyncio.sleep(2)
        await vehicle.land()
    return [told(stopped.value)]


@pytest.mark.parametrize("block", BLOCKS)
def test_a_whole_error_comes_as_it_is_shown(block: str) -> None:
    wanted = ".*".join(map(re.escape, block.strip().split("…")))
    assert any(re.fullmatch(wanted, text, flags=re.DOTALL) for text in provoked()), "\n".join(provoked())
