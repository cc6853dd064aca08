"""Runs the Python blocks of README.md and docs/ as a reader who copies them would.

A block shows all its imports and runs in a namespace of its own. ``await`` and ``async with`` may be at the top level,
as in a notebook. The fence may have a title after ``python``:

- ``title="continued"``: the block continues in the namespace of the previous block;
- ``title="test_x.py"``: pytest runs the file;
- ``title="x.py"``: the block runs, and later blocks of the page can import the file.

On pages that link to `VEHICLE_RULE`, a connected ``vehicle`` is provided to blocks that do not create one. `ADDRESS`
leads to a simulated copter: in memory on virtual time, or on a socket for blocking programs. Blocks that import one of
`UNAVAILABLE_PACKAGES` are only compiled.
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
import threading
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
from device_calls import FITTED
from served_copter import served_copter

import aerokit
from aerokit import SigningKey
from aerokit.sim import SimulatedCamera, SimulatedComponent, SimulatedCopter, SimulatedPx4, SimulatorServer
from aerokit.testing import run_virtual
from aerokit.transport import Link, create, create_link, memory_link_pair
from aerokit.transport.address import LinkAddress

ROOT = Path(__file__).parents[2]
VEHICLE_RULE = "docs/how-to/index.md#how-to-read-the-code"
"""Link to the section that defines ``vehicle`` as connected."""
ADDRESS = "udpin:0.0.0.0:14550"
NETWORK = "zenoh://"
"""Addresses with this prefix lead to the simulated copter, too."""
UNAVAILABLE_PACKAGES = frozenset({
    "dronekit", "fastapi", "mavros_msgs", "mavsdk", "geographic_msgs", "geometry_msgs", "rclpy", "rospy",
    "sensor_msgs", "std_msgs", "std_srvs",
})  # fmt: skip
"""Packages of other libraries and host programs, which the tests do not install."""
FILES = {"flight.tlog": ROOT / "tests" / "recordings" / "ardupilot-copter.tlog"}
"""Files in the working directory of the blocks."""
PASSPHRASE = "a long passphrase"
"""Passphrase of the vehicle's key, if a block connects with ``signing=``."""
VIDEO = "video.mp4"
"""URI of the simulated camera's stream."""
SPEEDUP = 40.0

FENCE = re.compile(r"^(?P<indent> *)```(?P<info>[^`\n]*)\n(?P<body>.*?)^(?P=indent)```$", re.DOTALL | re.MULTILINE)
TITLE = re.compile(r'title="([^"]*)"')


@dataclass(frozen=True)
class Block:
    """One block of a page."""

    page: Path
    line: int
    """Line of the opening fence, from 1."""
    language: str
    title: str
    body: str

    @property
    def is_for_pytest(self) -> bool:
        return self.title.startswith("test_") and self.title.endswith(".py")

    def compiled(self) -> Any:
        """Compile the block; tracebacks have the line numbers of the page."""
        source = "\n" * self.line + self.body
        flags = ast.PyCF_ALLOW_TOP_LEVEL_AWAIT
        return compile(source, str(self.page), "exec", flags=flags, dont_inherit=True)

    @property
    def tree(self) -> ast.Module:
        return ast.parse(self.body)


Chain = Sequence[Block]
"""A block and the blocks that continue it."""


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


# ------------------------------------------------------------------------------------ analysing blocks


def imported(chain: Chain) -> set[str]:
    """Return the modules that a chain imports, and their parent packages."""
    names: set[str] = set()
    for node in (node for block in chain for node in ast.walk(block.tree)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return names | {name[:at] for name in names for at, letter in enumerate(name) if letter == "."}


def free_names(chain: Chain) -> set[str]:
    """Return the names that a chain reads and never binds."""
    read: set[str] = set()
    bound = {"__name__", "__file__", *dir(builtins)}
    for node in (node for block in chain for node in ast.walk(block.tree)):
        if isinstance(node, ast.Name):
            (read if isinstance(node.ctx, ast.Load) else bound).add(node.id)
        elif isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            bound.add(node.name)
        elif isinstance(node, ast.arg):
            bound.add(node.arg)
        elif isinstance(node, (ast.Import, ast.ImportFrom)):
            bound |= {(alias.asname or alias.name).partition(".")[0] for alias in node.names}
        elif isinstance(node, (ast.ExceptHandler, ast.MatchAs, ast.MatchStar)) and node.name:
            bound.add(node.name)
    return read - bound


def needs_vehicle(chain: Chain) -> bool:
    return "vehicle" in free_names(chain)


def is_runnable(chain: Chain) -> bool:
    return not imported(chain) & UNAVAILABLE_PACKAGES


def has_vehicle_rule(page: Path) -> bool:
    """Return True if the page links to `VEHICLE_RULE` or contains it."""
    targets = re.findall(r"\]\(([^)\s]*#[^)\s]*)\)", page.read_text(encoding="utf-8"))
    linked = {normpath(page.parent / target) if target[0] != "#" else f"{page}{target}" for target in targets}
    return str(ROOT / VEHICLE_RULE) in linked or page == ROOT / VEHICLE_RULE.partition("#")[0]


# ------------------------------------------------------------------------------------ running


def run(chain: Chain, folder: Path) -> None:
    """Run a chain in a folder that contains only `FILES`; its exceptions propagate."""
    for name, source in FILES.items():
        shutil.copyfile(source, folder / name)
    if "aerokit.video" in imported(chain):
        _make_video(folder / VIDEO)
    code = [block.compiled() for block in chain]
    if not is_runnable(chain):
        return
    if chain[0].is_for_pytest:
        _run_pytest(chain[0], folder)
    elif imported(chain) & {"aerokit.sync", "aerokit.dronekit"}:
        with served_copter(speedup=SPEEDUP) as address, _address_opens(lambda: create_link(address)):
            _run_plain(code)
    elif any(block.co_flags & inspect.CO_COROUTINE for block in code) or needs_vehicle(chain):
        run_virtual(_run_async(code, chain))
    else:
        with patch.object(asyncio, "run", lambda main: run_virtual(_with_simulation(main, chain))):
            _run_plain(code)


def _run_plain(code: Sequence[Any]) -> None:
    names = {"__name__": "__main__"}
    for block in code:
        exec(block, names)


async def _run_async(code: Sequence[Any], chain: Chain) -> None:
    names: dict[str, Any] = {"__name__": "__main__"}

    async def main() -> None:
        async with AsyncExitStack() as stack:
            if needs_vehicle(chain):
                names["vehicle"] = await stack.enter_async_context(aerokit.connect(ADDRESS))
            for block in code:
                awaited = eval(block, names)
                if inspect.iscoroutine(awaited):
                    await awaited

    await _with_simulation(main(), chain)


async def _with_simulation(main: Coroutine[Any, Any, Any], chain: Chain) -> Any:
    """Await ``main`` while `ADDRESS` opens links to simulated vehicles, a new link each time."""
    text = "\n".join(block.body for block in chain)
    openings = text.count(ADDRESS) + text.count(f'"{NETWORK}')
    pairs = [memory_link_pair() for _ in range(max(openings, 1) + needs_vehicle(chain))]
    nears = iter([near for near, _ in pairs])
    async with SimulatorServer(_simulated_vehicles(text), [far for _, far in pairs]):
        with _address_opens(lambda: next(nears), thread=threading.get_ident()), _web_server_stops():
            return await main


def _simulated_vehicles(text: str) -> list[SimulatedCopter] | list[SimulatedPx4]:
    """Return the vehicles that a text uses, with camera, gimbal and devices if it names them."""
    if any(name in text for name in (".shell()", "logs.stream", "inject_failure")):
        return [SimulatedPx4(boot_time_s=0.0)]
    components: list[SimulatedComponent] = []
    if "camera" in text or "component(100)" in text:
        components.append(SimulatedCamera(streams=[VIDEO], capabilities=SimulatedCamera.ALL_CAPABILITIES))
    first = SimulatedCopter(boot_time_s=0.0, components=components)
    if "signing=" in text:
        first = SimulatedCopter(boot_time_s=0.0, signing_key=SigningKey.from_passphrase(PASSPHRASE))
    for name, value in FITTED.items() if "actuators" in text or "winch" in text else ():
        first.parameters[name] = value
    if "gimbal" in text:
        first.parameters["MNT1_TYPE"] = 1.0
    if "system_id=2" not in text:
        return [first]
    return [first, SimulatedCopter(system_id=2, boot_time_s=0.0)]


@contextmanager
def _address_opens(make: Any, thread: int | None = None) -> Iterator[None]:
    """Let `ADDRESS` open links that ``make`` returns, in all threads or in one."""
    original = create._create_udp

    def udp(where: LinkAddress, peers: Any) -> Link:
        is_address = f"{where.kind}:{where.host}:{where.port}" == ADDRESS
        is_here = thread in (None, threading.get_ident())
        link: Link = make() if is_address and is_here else original(where, peers)
        return link

    with patch.object(create, "_create_udp", udp), patch.object(create, "_create_zenoh", lambda _: make()):
        yield


@contextmanager
def _web_server_stops() -> Iterator[None]:
    """Stop a web server after a second."""

    async def serve(self: uvicorn.Server) -> None:
        await asyncio.sleep(1)

    with patch.object(uvicorn.Server, "serve", serve):
        yield


def _run_pytest(block: Block, folder: Path) -> None:
    """Run pytest in this process, because importing everything in another one takes a second."""
    files = {before.title for before in blocks(block.page) if before.title.endswith(".py")}
    modules = [name.removesuffix(".py") for name in files]
    for before in blocks(block.page):  # earlier files of the page
        if before.line <= block.line and before.title in files:
            (folder / before.title).write_text(before.body, encoding="utf-8")
    disabled = ("aerokit", "xdist", "cacheprovider", "asyncio", "faulthandler", "timeout")
    options = [*(f"no:{name}" for name in disabled), "aerokit.testing.plugin"]
    arguments = [word for option in options for word in ("-p", option)]
    shadowed = {name: sys.modules.pop(name) for name in modules if name in sys.modules}
    with patch.object(sys, "path", [*sys.path]):
        code = pytest.main(
            [*arguments, f"--rootdir={folder}", "--assert=plain", "-W", "error", "-q", "-s", block.title]
        )
    for name in modules:
        sys.modules.pop(name, None)
    sys.modules.update(shadowed)
    assert code == 0, f"{block.page.name}, line {block.line}: pytest exits with {code}"


def _make_video(path: Path) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for _ in range(10):
            container.mux(stream.encode(av.VideoFrame(64, 48, "yuv420p")))
        container.mux(stream.encode())
