"""Using ``await``, ``with`` or ``async with`` wrongly raises an error with the right form; nothing stays open."""

from __future__ import annotations

import re
import threading
from pathlib import Path
from typing import Any

import pytest
from served_copter import served_copter

import aerokit
import aerokit.sync
from aerokit.errors import InvalidArgument

ASYNCHRONOUS: dict[str, Any] = {"connect": aerokit.connect, "open_connection": aerokit.open_connection}
BLOCKING: dict[str, Any] = {
    "connect": aerokit.sync.connect,
    "open_connection": aerokit.sync.open_connection,
}


def threads() -> list[str]:
    """Return the running threads. Threads whose start a Ctrl-C interrupted stay in ``threading``'s list."""
    return [thread.name for thread in threading.enumerate() if thread.name.startswith("aerokit") and thread.is_alive()]


@pytest.mark.anyio
@pytest.mark.parametrize("name", ASYNCHRONOUS)
async def test_awaiting_asynchronous_connect_raises(name: str) -> None:
    opened: Any = ASYNCHRONOUS[name]("udpin:127.0.0.1:0")
    with pytest.raises(TypeError) as caught:
        await opened
    assert str(caught.value) == (
        f"{name}(…) does not support `await`: write `async with {name}(…) as …:` in an async function, or use"
        " aerokit.sync in a program without async"
    )


@pytest.mark.parametrize("name", ASYNCHRONOUS)
def test_asynchronous_connect_with_plain_with_raises(name: str) -> None:
    opened: Any = ASYNCHRONOUS[name]("udpin:127.0.0.1:0")
    with pytest.raises(TypeError) as caught, opened:
        pass
    assert str(caught.value) == (
        f"{name}(…) does not support `with`: write `async with {name}(…) as …:` in an async function, or use"
        " aerokit.sync in a program without async"
    )


@pytest.mark.parametrize("name", ASYNCHRONOUS)
def test_asynchronous_connect_without_asyncio_raises(name: str) -> None:
    """The coroutine is run without asyncio, as trio would do."""
    opened: Any = ASYNCHRONOUS[name]("udpin:127.0.0.1:0")
    with pytest.raises(InvalidArgument, match=rf"{name}\(…\) requires asyncio, and .* use aerokit.sync") as caught:
        opened.__aenter__().send(None)
    assert caught.value.__suppress_context__


def test_classifiers_list_asyncio_only() -> None:
    project = (Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8")
    frameworks = set(re.findall(r'"Framework :: (\w+)"', project))
    assert frameworks == {"AsyncIO", "Pytest"}


@pytest.mark.parametrize("name", ASYNCHRONOUS)
def test_asynchronous_connect_used_before_entering_raises(name: str) -> None:
    opened: Any = ASYNCHRONOUS[name]("udpin:127.0.0.1:0")
    with pytest.raises(AttributeError) as caught:
        opened.wait_ready()
    assert str(caught.value) == (
        f"{name}(…) has no 'wait_ready' before it is opened; write `async with {name}(…) as …:`"
    )
    assert not hasattr(opened, "__len__")


def misuse(word: str, opened: Any) -> Any:
    """Return a coroutine that misuses the block in the way named by ``word``."""

    async def wait() -> None:
        await opened

    async def enter() -> None:
        async with opened:
            pass

    return wait() if word == "await" else enter()


@pytest.mark.parametrize("word", ["await", "async with"])
@pytest.mark.parametrize("name", BLOCKING)
def test_blocking_connect_with_await_or_async_with_raises(name: str, word: str) -> None:
    with served_copter() as address:
        coroutine = misuse(word, BLOCKING[name](address))
        with pytest.raises(TypeError) as caught:
            coroutine.send(None)
    assert str(caught.value) == (
        f"aerokit.sync.{name}(…) does not support `{word}`: write `with aerokit.sync.{name}(…) as …:`, or"
        f" `async with aerokit.{name}(…) as …:` in an async function; the connection was closed"
    )
    assert not threads()
