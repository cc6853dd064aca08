"""Wire diaries: what went over the wire in a test, and when. A change of either shows, though no line of the test asks.

Written down are, on virtual time, every message that a connection sends and every event; of every exchange with a
vehicle what it sends and until when it waits. ``wire_diaries.json`` keeps a digest of each diary; `nox -s diaries`
writes it anew after a change that is meant, and names the tests. What has changed: run the tests with pytest's
``--diaries FOLDER`` before and after it, and compare the folders.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import platform
import re
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache, wraps
from pathlib import Path
from typing import Any

import pytest

from aerokit.connection import connection
from aerokit.connection.bus import Bus
from aerokit.events import Event
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.message import Message
from aerokit.protocols.exchange import Exchange
from aerokit.testing.clock import VirtualClockLoop

KEPT = Path(__file__).with_name("wire_diaries.json")
WRITTEN_WITH = (
    f"Python {'.'.join(platform.python_version_tuple()[:2])}, {platform.system()}, {platform.machine()}"
)
"""Elsewhere the last digit of a sine may be another one."""
DIARY = pytest.StashKey["Diary"]()
ADDRESS = re.compile(r" at 0x[0-9a-f]+")


class Diary:
    """What happened in one test: (number of the loop, milliseconds, text); without a loop, in order of writing."""

    def __init__(self) -> None:
        self._entries: list[tuple[int, int, str]] = []
        self._loops = 0
        self._loop: weakref.ref[VirtualClockLoop] | None = None

    def write(self, text: str) -> None:
        try:
            loop: asyncio.AbstractEventLoop = asyncio.get_running_loop()
        except RuntimeError:
            self._entries.append((self._loops, len(self._entries), text))
            return
        if isinstance(loop, VirtualClockLoop):
            if self._loop is None or self._loop() is not loop:
                self._loops, self._loop = self._loops + 1, weakref.ref(loop)
            self._entries.append((self._loops, round(loop.time() * 1000), text))

    def text(self) -> str:
        """One line each; what happens at the same time, in alphabetical order."""
        return "\n".join(f"{at} {text}" for _, at, text in sorted(self._entries))

    def digest(self) -> str:
        return hashlib.sha256(self.text().encode()).hexdigest()[:8] if self._entries else ""


@contextmanager
def written(diary: Diary) -> Iterator[None]:
    """Everything is written into this diary."""

    class Encoder(FrameEncoder):
        def encode(self, message: Message, now: float = 0.0) -> bytes:
            diary.write(f"{message.NAME} {message.encode().hex()}")
            return super().encode(message, now)

    publish, take_outbox = Bus.publish, Exchange.take_outbox

    @wraps(publish)
    def tell(self: Bus, event: Event) -> None:
        diary.write(ADDRESS.sub("", repr(event)))
        publish(self, event)

    @wraps(take_outbox)
    def take(self: Exchange[Any]) -> list[Message]:
        outbox = take_outbox(self)
        sent = " ".join(f"{each.NAME} {each.encode().hex()}" for each in outbox)
        until = "done" if self.done else f"until {self.deadline or 0:.3f}"
        diary.write(f"{type(self).__name__} {until} {sent}")
        return outbox

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(connection, "FrameEncoder", Encoder)
        patch.setattr(Bus, "publish", tell)
        patch.setattr(Exchange, "take_outbox", take)
        yield


@cache
def kept() -> dict[str, str]:
    """Test → digest, where they were written on a machine like this one."""
    diaries = json.loads(KEPT.read_text()) if KEPT.exists() else {}
    return diaries.get("digests", {}) if diaries.get("written with") == WRITTEN_WITH else {}


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--diaries", type=Path, help="a folder to write what went over the wire in each test")
    parser.addoption("--reversed", action="store_true", help="the last test first")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.getoption("--reversed"):
        items.reverse()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """With its fixtures: they connect."""
    with written(item.stash.setdefault(DIARY, Diary())):
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> Iterator[None]:
    """The test ends well, and what went over the wire is what it always was."""
    result = yield
    diary, test = pyfuncitem.stash[DIARY], pyfuncitem.nodeid.removeprefix("tests/")
    folder = pyfuncitem.config.getoption("--diaries")
    if getattr(
        pyfuncitem.obj, "is_hypothesis_test", False
    ):  # its examples are those of the installed version
        return result
    if folder is not None:
        (folder / hashlib.sha256(test.encode()).hexdigest()[:16]).write_text(f"{test}\n{diary.text()}")
    elif kept().get(test, diary.digest()) != diary.digest():
        pytest.fail(
            f"something else went over the wire than before: {Path(__file__).name} tells how to see what"
        )
    return result
