"""Runs the Python of the documentation: every block of README.md and docs/, as somebody who copies it would.

A block shows all its imports and is run in a namespace of its own; ``await`` and ``async with`` may stand at its top
level, as in a notebook. What the fence says behind ``python``:

- ``title="continued"``: goes on in the namespace of the block before it;
- ``title="test_x.py"``: a file for pytest, run by it;
- ``title="x.py"``: run, and kept as a file for what follows on the page.

``vehicle`` is given, connected, to blocks that do not make it, on pages that link to `THE_RULE`. `ADDRESS` leads to a
simulated copter: in memory and on virtual time, or on a socket for blocking programs. Blocks that import something of
`NOT_HERE` are compiled only.
"""

from __future__ import annotations

import ast
import asyncio
import builtins
import inspect
import re
import shutil
import sys
import textwrap
from collections.abc import Coroutine, Iterator, Sequence
from contextlib import AsyncExitStack, contextmanager
from dataclasses import dataclass
from os.path import normpath
from pathlib import Path
from typing import Any
from unittest.mock import patch

import av
import pytest
import uvicorn
from served_copter import served_copter

import aerokit
from aerokit import SigningKey
from aerokit.sim import SimulatedCamera, SimulatedComponent, SimulatedCopter, SimulatorServer
from aerokit.testing import run_virtual
from aerokit.transport import Link, create, create_link, memory_link_pair
from aerokit.transport.address import LinkAddress

ROOT = Path(__file__).parents[2]
THE_RULE = "docs/how-to/index.md#how-to-read-the-code"
"""Where it is said that ``vehicle`` is connected."""
ADDRESS = "udpin:0.0.0.0:14550"
NETWORK = "zenoh://"
"""What begins so leads there, too."""
NOT_HERE = frozenset({
    "dronekit", "fastapi", "mavros_msgs", "mavsdk", "geographic_msgs", "geometry_msgs", "rclpy", "rospy",
    "sensor_msgs", "std_msgs", "std_srvs",
})  # fmt: skip
"""Packages that the tests do not have, for code side by side and for host programs."""
FILES = {"flight.tlog": ROOT / "tests" / "recordings" / "ardupilot-copter.tlog"}
"""What is in the folder where the blocks run."""
PASSPHRASE = "a long passphrase"
"""Of the vehicle's key, where a block connects with ``signing=``."""
VIDEO = "video.mp4"
"""What the simulated camera streams."""
SPEEDUP = 40.0

FENCE = re.compile(
    r"^(?P<indent> *)```(?P<info>[^`\n]*)\n(?P<body>.*?)^(?P=indent)```$", re.DOTALL | re.MULTILINE
)
TITLE = re.compile(r'title="([^"]*)"')


@dataclass(frozen=True)
class Block:
    """One block of a page."""

    page: Path
    line: int
    """Of the fence, from 1."""
    language: str
    title: str
    body: str

    @property
    def is_for_pytest(self) -> bool:
        return self.title.startswith("test_") and self.title.endswith(".py")

    def compiled(self) -> Any:
        """Its code; tracebacks have the line of the page."""
        source = "\n" * self.line + self.body
        flags = ast.PyCF_ALLOW_TOP_LEVEL_AWAIT
        return compile(source, str(self.page), "exec", flags=flags, dont_inherit=True)

    @property
    def tree(self) -> ast.Module:
        return ast.parse(self.body)


Chain = Sequence[Block]
"""A block and those that continue it."""


def pages() -> list[Path]:
    return [
        ROOT / "README.md",
        *sorted((ROOT / "docs").rglob("*.md")),
    ]


def blocks(page: Path) -> list[Block]:
    text = page.read_text(encoding="utf-8")
    found = []
    for fence in FENCE.finditer(text):
        language, _, rest = fence["info"].strip().partition(" ")
        title = TITLE.search(rest)
        found.append(
            Block(
                page,
                text.count("\n", 0, fence.start()) + 1,
                language,
                title[1] if title else "",
                textwrap.dedent(fence["body"]),
            )
        )
    return found


def chains(page: Path) -> list[list[Block]]:
    found: list[list[Block]] = []
    for block in blocks(page):
        if block.language != "python":
            continue
        if block.title == "continued" and found:
            found[-1].append(block)
        else:
            found.append([block])
    return found


# ------------------------------------------------------------------------------------ what a block says


def imported(chain: Chain) -> set[str]:
    """The modules that a chain imports, with their packages: ``aerokit.sync`` is ``aerokit``, too."""
    names: set[str] = set()
    for node in (node for block in chain for node in ast.walk(block.tree)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return names | {name[:at] for name in names for at, letter in enumerate(name) if letter == "."}


def free_names(chain: Chain) -> set[str]:
    """The names that a chain reads and nowhere makes."""
    read: set[str] = set()
    made = {"__name__", "__file__", *dir(builtins)}
    for node in (node for block in chain for node in ast.walk(block.tree)):
        if isinstance(node, ast.Name):
            (read if isinstance(node.ctx, ast.Load) else made).add(node.id)
        elif isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            made.add(node.name)
        elif isinstance(node, ast.arg):
            made.add(node.arg)
        elif isinstance(node, (ast.Import, ast.ImportFrom)):
            made |= {(alias.asname or alias.name).partition(".")[0] for alias in node.names}
        elif isinstance(node, (ast.ExceptHandler, ast.MatchAs, ast.MatchStar)) and node.name:
            made.add(node.name)
    return read - made


def wants_given_vehicle(chain: Chain) -> bool:
    return "vehicle" in free_names(chain)


def is_here(chain: Chain) -> bool:
    return not imported(chain) & NOT_HERE


def tells_the_rule(page: Path) -> bool:
    """Whether the page links to `THE_RULE`, or has it."""
    targets = re.findall(r"\]\(([^)\s]*#[^)\s]*)\)", page.read_text(encoding="utf-8"))
    there = {normpath(page.parent / target) if target[0] != "#" else f"{page}{target}" for target in targets}
    return str(ROOT / THE_RULE) in there or page == ROOT / THE_RULE.partition("#")[0]


# ------------------------------------------------------------------------------------ running


def run(chain: Chain, folder: Path) -> None:
    """Run a chain in a folder that is empty but for `FILES`; raises what it raises."""
    for name, source in FILES.items():
        shutil.copyfile(source, folder / name)
    if "aerokit.video" in imported(chain):
        _make_video(folder / VIDEO)
    code = [block.compiled() for block in chain]
    if not is_here(chain):
        return
    if chain[0].is_for_pytest:
        _run_pytest(chain[0], folder)
    elif imported(chain) & {"aerokit.sync", "aerokit.dronekit"}:
        with served_copter(speedup=SPEEDUP) as address, _address_is(lambda: create_link(address)):
            _run_plain(code)
    elif any(each.co_flags & inspect.CO_COROUTINE for each in code) or wants_given_vehicle(chain):
        run_virtual(_run_in_a_loop(code, chain))
    else:
        with patch.object(asyncio, "run", lambda main: run_virtual(_on_stage(main, chain))):
            _run_plain(code)


def _run_plain(code: Sequence[Any]) -> None:
    names = {"__name__": "__main__"}
    for each in code:
        exec(each, names)


async def _run_in_a_loop(code: Sequence[Any], chain: Chain) -> None:
    names: dict[str, Any] = {"__name__": "__main__"}

    async def main() -> None:
        async with AsyncExitStack() as stack:
            if wants_given_vehicle(chain):
                names["vehicle"] = await stack.enter_async_context(aerokit.connect(ADDRESS))
            for each in code:
                awaited = eval(each, names)
                if inspect.iscoroutine(awaited):
                    await awaited

    await _on_stage(main(), chain)


async def _on_stage(main: Coroutine[Any, Any, Any], chain: Chain) -> Any:
    """Await what `ADDRESS` leads to simulated vehicles for; each time it is opened to a link of its own."""
    text = "\n".join(block.body for block in chain)
    named = text.count(ADDRESS) + text.count(f'"{NETWORK}')
    ends = [memory_link_pair() for _ in range(max(named, 1) + wants_given_vehicle(chain))]
    nears = iter([near for near, _ in ends])
    async with SimulatorServer(_vehicles_for(text), [far for _, far in ends]):
        with _address_is(lambda: next(nears)), _served_to_nobody():
            return await main


def _vehicles_for(text: str) -> list[SimulatedCopter]:
    """What a text needs: a second vehicle, a camera, a gimbal."""
    components: list[SimulatedComponent] = []
    if "camera" in text or "component(100)" in text:
        components.append(SimulatedCamera(streams=[VIDEO], capabilities=SimulatedCamera.ALL_CAPABILITIES))
    first = SimulatedCopter(boot_time_s=0.0, components=components)
    if "signing=" in text:
        first = SimulatedCopter(boot_time_s=0.0, signing_key=SigningKey.from_passphrase(PASSPHRASE))
    if "gimbal" in text:
        first.parameters["MNT1_TYPE"] = 1.0
    if "system_id=2" not in text:
        return [first]
    return [first, SimulatedCopter(system_id=2, boot_time_s=0.0)]


@contextmanager
def _address_is(make: Any) -> Iterator[None]:
    opened = create._udp

    def udp(where: LinkAddress, peers: Any) -> Link:
        is_ours = f"{where.kind}:{where.host}:{where.port}" == ADDRESS
        link: Link = make() if is_ours else opened(where, peers)
        return link

    with patch.object(create, "_udp", udp), patch.object(create, "_zenoh", lambda _: make()):
        yield


@contextmanager
def _served_to_nobody() -> Iterator[None]:
    """A web server would serve for ever."""

    async def serve(self: uvicorn.Server) -> None:
        await asyncio.sleep(1)

    with patch.object(uvicorn.Server, "serve", serve):
        yield


def _run_pytest(block: Block, folder: Path) -> None:
    """In this process, as the imports of another one take a second; what is imported stays imported."""
    files = {before.title for before in blocks(block.page) if before.title.endswith(".py")}
    modules = [name.removesuffix(".py") for name in files]
    for before in blocks(block.page):  # the files of the page that stand before it
        if before.line <= block.line and before.title in files:
            (folder / before.title).write_text(before.body, encoding="utf-8")
    left_out = ("aerokit", "xdist", "cacheprovider", "asyncio", "faulthandler", "timeout")
    options = [*(f"no:{name}" for name in left_out), "aerokit.testing.plugin"]
    words = [word for option in options for word in ("-p", option)]
    ours = {name: sys.modules.pop(name) for name in modules if name in sys.modules}  # tests of the same name
    with patch.object(sys, "path", [*sys.path]):
        code = pytest.main(
            [*words, f"--rootdir={folder}", "--assert=plain", "-W", "error", "-q", "-s", block.title]
        )
    for name in modules:
        sys.modules.pop(name, None)
    sys.modules.update(ours)
    assert code == 0, f"{block.page.name}, line {block.line}: pytest ends with {code}"


def _make_video(path: Path) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for _ in range(10):
            container.mux(stream.encode(av.VideoFrame(64, 48, "yuv420p")))
        container.mux(stream.encode())
