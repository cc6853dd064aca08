"""``await``, ``with``, ``async with`` where another one of them belongs: the error says which; nothing stays open."""

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
    """Those that run: another test's that Ctrl-C had kept from starting are in ``threading``'s list for ever."""
    return [
        each.name for each in threading.enumerate() if each.name.startswith("aerokit") and each.is_alive()
    ]


@pytest.mark.anyio
@pytest.mark.parametrize("name", ASYNCHRONOUS)
async def test_the_asynchronous_one_is_not_awaited(name: str) -> None:
    opened: Any = ASYNCHRONOUS[name]("udpin:127.0.0.1:0")
    with pytest.raises(TypeError) as caught:
        await opened
    assert str(caught.value) == (
        f"{name}(…) is not for `await`: write `async with {name}(…) as …:` in an async function, or take aerokit.sync"
        " for a program without async"
    )


@pytest.mark.parametrize("name", ASYNCHRONOUS)
def test_the_asynchronous_one_is_not_for_with(name: str) -> None:
    opened: Any = ASYNCHRONOUS[name]("udpin:127.0.0.1:0")
    with pytest.raises(TypeError) as caught, opened:
        pass
    assert str(caught.value) == (
        f"{name}(…) is not for `with`: write `async with {name}(…) as …:` in an async function, or take aerokit.sync"
        " for a program without async"
    )


@pytest.mark.parametrize("name", ASYNCHRONOUS)
def test_the_asynchronous_one_without_asyncio_says_what_to_do(name: str) -> None:
    """As trio runs a coroutine."""
    opened: Any = ASYNCHRONOUS[name]("udpin:127.0.0.1:0")
    with pytest.raises(
        InvalidArgument, match=rf"{name}\(…\) runs on asyncio, and .* use aerokit.sync"
    ) as caught:
        opened.__aenter__().send(None)
    assert caught.value.__suppress_context__


def test_classifiers_name_no_loop_but_asyncio() -> None:
    project = (Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8")
    frameworks = set(re.findall(r'"Framework :: (\w+)"', project))
    assert frameworks == {"AsyncIO", "Pytest"}


@pytest.mark.parametrize("name", ASYNCHRONOUS)
def test_the_asynchronous_one_is_not_used_before_it_is_entered(name: str) -> None:
    opened: Any = ASYNCHRONOUS[name]("udpin:127.0.0.1:0")
    with pytest.raises(AttributeError) as caught:
        opened.wait_ready()
    assert str(caught.value) == (
        f"{name}(…) has no 'wait_ready': it is not open yet; write `async with {name}(…) as …:`"
    )
    assert not hasattr(opened, "__len__")


def misuse(word: str, opened: Any) -> Any:
    """A coroutine that does so."""

    async def wait() -> None:
        await opened

    async def enter() -> None:
        async with opened:
            pass

    return wait() if word == "await" else enter()


@pytest.mark.parametrize("word", ["await", "async with"])
@pytest.mark.parametrize("name", BLOCKING)
def test_the_blocking_one_is_for_with(name: str, word: str) -> None:
    with served_copter() as address:
        coroutine = misuse(word, BLOCKING[name](address))
        with pytest.raises(TypeError) as caught:
            coroutine.send(None)
    assert str(caught.value) == (
        f"aerokit.sync.{name}(…) blocks, and is not for `{word}`: write `with aerokit.sync.{name}(…) as …:`, or"
        f" `async with aerokit.{name}(…) as …:` in an async function; what was opened is closed again"
    )
    assert not threads()
