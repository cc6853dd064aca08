"""Why a link could not be opened: the system's own error is the context, for programs that look for its class."""

from __future__ import annotations

import asyncio
import errno
import importlib
import os
import re
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import aerokit.sync
from aerokit import open_connection
from aerokit.errors import LinkOpenError

pytestmark = pytest.mark.skipif(os.name != "posix", reason="other systems have other errors")

SOURCES = Path(__file__).parents[2] / "src"
SerialException: type[OSError] = importlib.import_module("serial").SerialException


@pytest.fixture
def anyio_backend() -> tuple[str, dict[str, Any]]:
    return "asyncio", {}


@pytest.fixture
def taken() -> Iterator[dict[str, int]]:
    """Ports that are bound but not served."""
    with socket.socket() as tcp, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        tcp.bind(("127.0.0.1", 0))
        udp.bind(("127.0.0.1", 0))
        yield {"tcp": tcp.getsockname()[1], "udp": udp.getsockname()[1]}


def no_such_host(*args: object, **options: object) -> None:
    raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")


CASES: list[tuple[str, type[BaseException], int | None]] = [
    ("tcp:127.0.0.1:{tcp}", ConnectionRefusedError, errno.ECONNREFUSED),
    ("tcp:no-such-host.invalid:5760", socket.gaierror, socket.EAI_NONAME),
    ("tcp:192.0.2.1:9?timeout=0.01", OSError, None),  # TimeoutError, or no route
    ("tcpin:127.0.0.1:{tcp}", OSError, errno.EADDRINUSE),
    ("tcpin:no-such-host.invalid:5760", socket.gaierror, socket.EAI_NONAME),
    ("udpin:127.0.0.1:{udp}", OSError, errno.EADDRINUSE),
    ("udpout:no-such-host.invalid:14550", socket.gaierror, socket.EAI_NONAME),
    ("udpbcast:no-such-host.invalid:14550", socket.gaierror, socket.EAI_NONAME),
    ("/dev/ttyNoSuchPort,57600", SerialException, errno.ENOENT),
    ("serial://{folder}", SerialException, errno.EISDIR),
    ("serial://{file}", SerialException, errno.ENOTTY),
    ("replay:{folder}/missing.tlog", FileNotFoundError, errno.ENOENT),
]


@pytest.mark.anyio
@pytest.mark.parametrize("reconnect", [False, True], ids=["once", "reconnect"])
@pytest.mark.parametrize(("address", "kind", "number"), CASES, ids=[case[0] for case in CASES])
async def test_context_is_the_system_error(
    address: str,
    kind: type[BaseException],
    number: int | None,
    reconnect: bool,
    taken: dict[str, int],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if kind is socket.gaierror:
        monkeypatch.setattr(socket, "getaddrinfo", no_such_host)
    file = tmp_path / "file"
    file.write_bytes(b"")
    where = address.format(**taken, folder=tmp_path, file=file)
    with pytest.raises(LinkOpenError, match="cannot open ") as caught:
        async with open_connection(where, reconnect=reconnect):
            pytest.fail("not open")
    context = caught.value.__context__
    assert isinstance(context, kind)
    assert not isinstance(context, LinkOpenError)
    if number is not None:
        assert caught.value.errno == number


@pytest.mark.anyio
async def test_device_vanishes_while_opening(monkeypatch: pytest.MonkeyPatch) -> None:
    pyserial, termios = importlib.import_module("serial"), importlib.import_module("termios")

    def vanish(*args: object, **options: object) -> None:
        raise termios.error(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(pyserial, "Serial", vanish)
    with pytest.raises(LinkOpenError, match=os.strerror(errno.EIO)) as caught:
        async with open_connection("/dev/ttyACM0"):
            pytest.fail("not open")
    assert caught.value.errno == errno.EIO
    assert isinstance(caught.value.__context__, SerialException)
    assert isinstance(caught.value.__context__.__context__, termios.error)


PROGRAMS = {
    "sync": "import aerokit.sync\nwith aerokit.sync.connect({address!r}) as vehicle:\n    pass\n",
    "sync connection": "import aerokit.sync\nopened = aerokit.sync.open_connection({address!r})\n",
    "classic": "import aerokit.dronekit\nvehicle = aerokit.dronekit.connect({address!r})\n",
    "async": """
import asyncio, aerokit
async def main():
    async with aerokit.connect({address!r}) as vehicle:
        pass
asyncio.run(main())
""",
}
FOREIGN = re.compile(rf'  File "{re.escape(os.path.dirname(asyncio.__file__))}.*\n.*\n( +\^+\n)?')


@pytest.mark.sampled(9)
@pytest.mark.parametrize("address", ["udpin:127.0.0.1:{udp}", "/dev/no-such-device", "no/such/file.tlog"])
@pytest.mark.parametrize("program", PROGRAMS.values(), ids=PROGRAMS)
def test_traceback_of_failed_open_is_short(program: str, address: str, taken: dict[str, int], tmp_path: Path) -> None:
    """At most ten lines, apart from asyncio's own."""
    file = tmp_path / "program.py"
    file.write_text(program.format(address=address.format(**taken)), encoding="utf-8")
    ended = subprocess.run(
        [sys.executable, file],
        env={**os.environ, "PYTHONPATH": str(SOURCES)},
        capture_output=True,
        text=True,
        check=False,
        timeout=200,
    )
    shown = FOREIGN.sub("", ended.stderr)
    assert "cannot open " in shown.splitlines()[-1]
    assert len(shown.splitlines()) <= 10, ended.stderr


def test_error_passes_the_blocking_twin(taken: dict[str, int]) -> None:
    for opened in (aerokit.sync.connect, aerokit.sync.open_connection):
        with pytest.raises(LinkOpenError) as caught:
            opened("tcp:127.0.0.1:{tcp}".format(**taken), reconnect=True)
        assert isinstance(caught.value.__context__, ConnectionRefusedError)
