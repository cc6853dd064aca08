"""Texts quoted in docs/troubleshooting.md occur in the sources, or are provoked here."""

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
PAGE_WITHOUT_BLOCKS = re.sub(r"^```.*?^```$", "", PAGE, flags=re.DOTALL | re.MULTILINE)
BLOCKS = re.findall(r"^```text\n(.*?)^```$", PAGE, flags=re.DOTALL | re.MULTILINE)
HEADINGS = re.findall(r"^### (`.*`)$", PAGE, flags=re.MULTILINE)
CODE_PREFIXES = ("await ", "python ", "pip ", "aerokit ", "sudo ", "ss ", ". ")
"""Prefixes of code spans that a user types. They are not quoted texts."""
MIN_WORDS = 4
"""Code spans with this many words are quoted texts; shorter ones are names."""
MIN_PIECE_LENGTH = 10
"""A quoted text has a continuous piece of at least this length in the sources."""
DIRECTORIES_WITHOUT_ERRORS = (
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


def quoted_texts() -> list[str]:
    spans = [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", PAGE_WITHOUT_BLOCKS)]
    long = [span for span in spans if len(span.split()) >= MIN_WORDS and not span.startswith(CODE_PREFIXES)]
    return list(dict.fromkeys([heading.strip("`") for heading in HEADINGS] + long))


@functools.cache
def source_strings() -> str:
    """Return all string literals of the sources, split at placeholders, one per line."""
    found: set[str] = set()
    source = ROOT / "src" / "aerokit"
    for path in source.rglob("*.py"):
        if not str(path.relative_to(source).as_posix()).startswith(DIRECTORIES_WITHOUT_ERRORS):
            for node in ast.walk(ast.parse(path.read_bytes())):
                if isinstance(node, ast.Constant) and isinstance(node.value, str):
                    found |= set(re.split(r"%[sdr]", node.value))
    return "\n".join(sorted(found))


VEHICLE_TEXTS = ("mode not armable",)
"""Texts that the autopilot itself prints (AP_Arming_Copter.cpp)."""


@functools.cache
def python_texts() -> tuple[str, ...]:
    """Return the texts of Python and of the system that the page quotes."""
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
    return *texts, *VEHICLE_TEXTS, *(str(warning.message) for warning in caught)


def is_printed(piece: str) -> bool:
    return piece in source_strings() or any(piece in text for text in python_texts())


def test_page_has_headings_and_provoked_blocks() -> None:
    assert len(HEADINGS) > 60
    assert len(BLOCKS) == len(provoked_errors())


@pytest.mark.exhaustive
@for_each("text", quoted_texts())
def test_quoted_text_occurs_in_sources(text: str) -> None:
    pieces = [piece.strip(" ") for part in text.split("…") for piece in pieces_of(part)]
    missing = [piece for piece in pieces if piece and not is_printed(piece)]
    assert not missing, f"nothing prints {missing}"
    assert max(map(len, pieces)) >= MIN_PIECE_LENGTH or text == "… is not allowed: …", "too short to be checked"


def pieces_of(part: str) -> list[str]:
    """Split a part that the sources build from several strings."""
    if is_printed(part.strip(" ")):
        return [part]
    return re.split(r"\(|\)|: |, |MAV_CMD_", part)


def error_classes() -> list[str]:
    return [*errors.__all__, NotInstalled.__name__]


@for_each("name", error_classes())
def test_error_class_is_on_page(name: str) -> None:
    assert re.search(rf"\b{name}\b", PAGE)


def test_error_classes_on_page_exist() -> None:
    named = set(re.findall(r"\b[A-Z][A-Za-z]+(?:Error|Timeout|Rejected|Failed)\b", PAGE))
    assert named <= {*error_classes(), *dir(builtins)}


# ---------------------------------------------------------------------------- blocks with whole errors


@functools.cache
def provoked_errors() -> tuple[str, ...]:
    """Return the errors of the page's blocks, provoked on simulated vehicles."""
    return (
        *run_virtual(errors_without_vehicle()),
        *run_virtual(errors_on_ground()),
        *run_virtual(errors_in_air()),
    )


def traceback_line(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"


async def errors_without_vehicle() -> list[str]:
    near, _ = memory_link_pair()
    with pytest.raises(errors.ConnectFailed) as failed:
        async with aerokit.connect(near):
            pass
    return [traceback_line(failed.value)]


async def errors_on_ground() -> list[str]:
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
    return [traceback_line(raised.value) for raised in (not_ready, unanswered, stale, refused)]


async def errors_in_air() -> list[str]:
    async with simulated_link(SimulatedCopter(boot_time_s=0.0)) as link, aerokit.connect(link) as vehicle:
        await vehicle.wait_ready()
        await vehicle.arm()
        await vehicle.take_off(10)
        with pytest.raises(errors.SetpointStreamStopped) as stopped:
            async with vehicle.guided.velocity() as stream:
                stream.set(aerokit.VelocitySetpoint(north_m_s=1))
                await asyncio.sleep(2)
        await vehicle.land()
    return [traceback_line(stopped.value)]


@pytest.mark.parametrize("block", BLOCKS)
def test_block_shows_error_as_raised(block: str) -> None:
    wanted = ".*".join(map(re.escape, block.strip().split("…")))
    assert any(re.fullmatch(wanted, text, flags=re.DOTALL) for text in provoked_errors()), "\n".join(provoked_errors())
