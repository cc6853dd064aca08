"""Every transfer: its preparation, call and check, its ideal duration, and its maximum number of messages."""

from __future__ import annotations

import random
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass
from typing import Any

import anyio
import ideals
from bad_link import Program, Radio, Work
from ideals import Ideal

from aerokit.errors import FileTimeout, MissionTimeout, ParameterTimeout
from aerokit.missions import Fence, FenceCircle, FencePolygon, Mission, RallyPoints, rally_point, waypoint
from aerokit.missions.compare import ItemStorage
from aerokit.position import Position
from aerokit.sim import SimulatedCopter
from aerokit.sim.logs import SimulatedLog
from aerokit.sim.parameters import stored_value
from aerokit.vehicle.files.logs import LogMethod

REAL32 = 9
NO_ANSWER = ("no answer to", "was not answered", "no MISSION_COUNT was received")
HOLES = (ParameterTimeout, MissionTimeout, FileTimeout)


@dataclass(frozen=True)
class Sizes:
    """Size of the transfer."""

    parameters: int | None
    """None: as many as the real vehicle has."""
    writes: int
    items: int
    file_bytes: int
    log_bytes: int


TINY = Sizes(parameters=80, writes=15, items=15, file_bytes=5_000, log_bytes=4_000)
SMALL = Sizes(parameters=200, writes=30, items=30, file_bytes=12_000, log_bytes=9_000)
REAL = Sizes(parameters=None, writes=100, items=200, file_bytes=200_000, log_bytes=60_000)


@dataclass(frozen=True)
class Case:
    """One transfer. ``check`` raises AssertionError when the content is not exact."""

    name: str
    work: Callable[[Program, Sizes], Awaitable[Any]]
    check: Callable[[Any, SimulatedCopter, Sizes], None]
    ideal: Callable[[SimulatedCopter, Sizes], Ideal]
    pieces: Callable[[SimulatedCopter, Sizes], int]
    """Number of parts that can get lost, for the limit of messages."""
    prepare: Callable[[SimulatedCopter, Sizes], None] = lambda copter, sizes: None
    """Content of the vehicle."""
    before: Work | None = None
    """Preparation, while the radio is good."""

    def most_messages(self, copter: SimulatedCopter, sizes: Sizes, *, link_dies: bool = False) -> int:
        """At 30 % loss each way half of all attempts fail; in ten seconds of silence there are some twenty attempts."""
        return 40 + (20 if link_dies else 6) * self.pieces(copter, sizes)


def make_copter(case: Case, sizes: Sizes, radio: Radio) -> SimulatedCopter:
    """A copter with the data to be transferred, and the real rate of its port."""
    copter = SimulatedCopter(
        boot_time_s=0.0,
        parameter_count=sizes.parameters,
        logs=[SimulatedLog(sizes.log_bytes, 1_789_990_000 + n) for n in range(LOGS)],
        link_bytes_per_s=radio.port_bytes_per_s,
    )
    case.prepare(copter, sizes)
    return copter


def leftovers(copter: SimulatedCopter) -> Iterator[str]:
    """State that the vehicle still keeps for a disconnected client."""
    if copter.ftp.open_sessions:
        yield f"{copter.ftp.open_sessions} FTP sessions"
    if copter.missions.transfer_is_open:
        yield "a mission transfer"
    if copter.storage.logs.is_busy:
        yield "a log transfer"
    if copter.storage.parameters.running_lists:
        yield "a parameter list"


def names_what_is_missing(error: Exception | None) -> bool:
    """A typed error that names the missing parts, or the request if the parts are not known yet."""
    if not isinstance(error, HOLES):
        return False
    return bool(error.missing) or any(words in str(error) for words in NO_ANSWER)


# ---------------------------------------------------------------------------------------- parameters


async def know_parameters(program: Program) -> None:
    await program.vehicle.parameters.download()


def values_of(copter: SimulatedCopter) -> dict[str, float]:
    return {name: copter.parameters[name] for name in copter.parameters}


def check_parameters(table: Any, copter: SimulatedCopter, sizes: Sizes) -> None:
    assert table.values_by_name() == values_of(copter)


def changes(copter: SimulatedCopter, sizes: Sizes) -> dict[str, float]:
    """Values other than the vehicle's, for parameters that take any."""
    names = [name for name in copter.parameters if copter.parameters.type(name) == REAL32]
    return {name: stored_value(copter.parameters[name] + 0.5, REAL32) for name in names[: sizes.writes]}


async def set_many(program: Program, sizes: Sizes) -> Any:
    wanted = changes(program.simulated, sizes)
    return wanted, await program.vehicle.parameters.set_many(wanted)


async def upload_parameters(program: Program, sizes: Sizes) -> Any:
    wanted = changes(program.simulated, sizes)
    return wanted, await program.vehicle.parameters.upload(wanted, method="ftp")


def check_writes(value: Any, copter: SimulatedCopter, sizes: Sizes) -> None:
    wanted, results = value
    for result in results.values():
        if result.error is not None:
            raise result.error
    assert {name: copter.parameters[name] for name in wanted} == wanted


def pack_size(copter: SimulatedCopter) -> int:
    file = copter.files.open("@PARAM/param.pck?withdefaults=1")
    size = 0
    while data := file.read(size, 239):
        size += len(data)
    return size


def blocks(size: int) -> int:
    return -(-size // ideals.FTP_DATA)


def burst_rate(copter: SimulatedCopter) -> float:
    return 1.0 / copter.ftp.burst_interval_s


def read_pack(copter: SimulatedCopter) -> Ideal:
    return ideals.file_read(pack_size(copter), blocks_per_second=burst_rate(copter))


PARAMETERS = [
    Case(
        "parameter list",
        lambda program, sizes: program.vehicle.parameters.download(method="list"),
        check_parameters,
        lambda copter, sizes: ideals.parameter_list(
            len(copter.parameters), per_second=copter.storage.parameters.list_rate_hz
        ),
        lambda copter, sizes: len(copter.parameters),
    ),
    Case(
        "param.pck download",
        lambda program, sizes: program.vehicle.parameters.download(method="ftp"),
        check_parameters,
        lambda copter, sizes: read_pack(copter),
        lambda copter, sizes: blocks(pack_size(copter)),
    ),
    Case(
        "parameter writes",
        set_many,
        check_writes,
        lambda copter, sizes: ideals.parameter_writes(sizes.writes),
        lambda copter, sizes: sizes.writes,
        before=know_parameters,
    ),
    Case(
        "param.pck upload",
        upload_parameters,
        check_writes,
        # After the upload of the file, each parameter is read to see whether the vehicle has accepted it.
        lambda copter, sizes: ideals.file_write(16 * sizes.writes) + ideals.parameter_reads(sizes.writes),
        lambda copter, sizes: blocks(pack_size(copter)) + 2 * sizes.writes,
        before=know_parameters,
    ),
]

# ------------------------------------------------------------------------------------------ missions


def mission(sizes: Sizes) -> Mission:
    return Mission([waypoint(47.0 + n * 1e-4, 8.5, altitude_relative_m=20 + n % 50) for n in range(sizes.items)])


def fence(sizes: Sizes) -> Fence:
    corners = [Position(47.0 + n * 1e-4, 8.5 + (n % 2) * 1e-4) for n in range(min(sizes.items, 60))]
    return Fence(polygons=[FencePolygon(corners)], circles=[FenceCircle(Position(47.5, 8.6), 100.0, inclusion=False)])


def rally(sizes: Sizes) -> RallyPoints:
    return RallyPoints([rally_point(47.0 + n * 1e-3, 8.5, altitude_relative_m=30) for n in range(min(sizes.items, 20))])


PLANS: dict[str, Callable[[Sizes], Any]] = {"mission": mission, "fence": fence, "rally": rally}


def items_of(kind: str, sizes: Sizes) -> list[Any]:
    return list(PLANS[kind](sizes).to_items(home_is_item_0=kind == "mission"))


def hold(kind: str) -> Callable[[SimulatedCopter, Sizes], None]:
    """The vehicle has it already."""
    number = list(PLANS).index(kind)

    def prepare(copter: SimulatedCopter, sizes: Sizes) -> None:
        assert copter.missions.replace(number, items_of(kind, sizes)) == 0

    return prepare


def upload_plan(kind: str, method: str) -> Callable[[Program, Sizes], Awaitable[Any]]:
    return lambda program, sizes: getattr(program.vehicle, kind).upload(PLANS[kind](sizes), method=method)


def download_plan(kind: str, method: str) -> Callable[[Program, Sizes], Awaitable[Any]]:
    return lambda program, sizes: getattr(program.vehicle, kind).download(method=method)


def check_vehicle_holds(kind: str) -> Callable[[Any, SimulatedCopter, Sizes], None]:
    plan_type: Any = {"mission": Mission, "fence": Fence, "rally": RallyPoints}[kind]
    number = list(PLANS).index(kind)

    def check(_: Any, copter: SimulatedCopter, sizes: Sizes) -> None:
        held = plan_type.from_items(copter.missions.items(number), home_is_item_0=kind == "mission")
        assert PLANS[kind](sizes).differences(held, ItemStorage.ARDUPILOT) == ()

    return check


def check_plan(kind: str) -> Callable[[Any, SimulatedCopter, Sizes], None]:
    def check(plan: Any, copter: SimulatedCopter, sizes: Sizes) -> None:
        assert PLANS[kind](sizes).differences(plan, ItemStorage.ARDUPILOT) == ()

    return check


def read_plan(kind: str, copter: SimulatedCopter, sizes: Sizes) -> Ideal:
    size = 10 + 38 * len(items_of(kind, sizes))
    return ideals.file_read(size, blocks_per_second=burst_rate(copter))


def plan_cases(kind: str) -> Iterator[Case]:
    """Uploads and downloads, by items and as a file; an upload is read back."""

    def count(copter: SimulatedCopter, sizes: Sizes) -> int:
        return 2 * len(items_of(kind, sizes))

    yield Case(
        f"{kind} upload by items",
        upload_plan(kind, "items"),
        check_vehicle_holds(kind),
        lambda copter, sizes: ideals.items_written(len(items_of(kind, sizes))) + read_plan(kind, copter, sizes),
        count,
    )
    yield Case(
        f"{kind} download by items",
        download_plan(kind, "items"),
        check_plan(kind),
        lambda copter, sizes: ideals.items_read(len(items_of(kind, sizes))),
        count,
        hold(kind),
    )
    yield Case(
        f"{kind} upload as a file",
        upload_plan(kind, "ftp"),
        check_vehicle_holds(kind),
        lambda copter, sizes: ideals.file_write(10 + 38 * len(items_of(kind, sizes))) + read_plan(kind, copter, sizes),
        count,
    )
    yield Case(
        f"{kind} download as a file",
        download_plan(kind, "ftp"),
        check_plan(kind),
        # The checksum and the count show that the file is not a mixture of two plans.
        lambda copter, sizes: read_plan(kind, copter, sizes) + ideals.checksum() + ideals.items_read(0),
        count,
        hold(kind),
    )


# ------------------------------------------------------------------------------------ files and logs

FOLDER, DOWNLOADED, UPLOADED = "/APM/many", "/APM/down.bin", "/APM/up.bin"
FILES_IN_FOLDER = 60
LOGS = 3


def content(size: int) -> bytes:
    return random.Random(size).randbytes(size)


def put_file(copter: SimulatedCopter, sizes: Sizes) -> None:
    copter.files.put(DOWNLOADED, content(sizes.file_bytes))


def put_folder(copter: SimulatedCopter, sizes: Sizes) -> None:
    for number in range(FILES_IN_FOLDER):
        copter.files.put(f"{FOLDER}/file-{number:04}.txt", bytes(number))


def check_download(data: Any, copter: SimulatedCopter, sizes: Sizes) -> None:
    assert data == content(sizes.file_bytes)


def check_upload(_: Any, copter: SimulatedCopter, sizes: Sizes) -> None:
    assert copter.files.get(UPLOADED) == content(sizes.file_bytes)


def check_folder(entries: Any, copter: SimulatedCopter, sizes: Sizes) -> None:
    assert [(entry.name, entry.size) for entry in entries] == copter.files.entries(FOLDER)


def pages(copter: SimulatedCopter, sizes: Sizes) -> int:
    return -(-sum(len(f"F{name}\t{size}\0") for name, size in copter.files.entries(FOLDER)) // 220)


async def know_logs(program: Program) -> None:
    program.known = await program.vehicle.logs.list()
    await anyio.sleep(2.0)


def check_logs(entries: Any, copter: SimulatedCopter, sizes: Sizes) -> None:
    assert [(entry.id, entry.size, entry.time_utc.timestamp()) for entry in entries] == [
        (number, log.size, log.time_utc) for number, log in enumerate(copter.storage.logs.logs, start=1)
    ]


def read_log(method: LogMethod) -> Callable[[Program, Sizes], Awaitable[Any]]:
    async def work(program: Program, sizes: Sizes) -> Any:
        return await program.vehicle.logs.read(program.known[1], method=method)

    return work


def check_log(data: Any, copter: SimulatedCopter, sizes: Sizes) -> None:
    assert data == copter.storage.logs.logs[1].make()


FILES = [
    Case(
        "file download",
        lambda program, sizes: program.vehicle.files.read(DOWNLOADED),
        check_download,
        lambda copter, sizes: ideals.file_read(sizes.file_bytes, blocks_per_second=burst_rate(copter)),
        lambda copter, sizes: blocks(sizes.file_bytes),
        put_file,
    ),
    Case(
        "file upload",
        lambda program, sizes: program.vehicle.files.write(UPLOADED, content(sizes.file_bytes)),
        check_upload,
        lambda copter, sizes: ideals.file_write(sizes.file_bytes) + ideals.checksum(),
        lambda copter, sizes: blocks(sizes.file_bytes),
    ),
    Case(
        "directory list",
        lambda program, sizes: program.vehicle.files.list(FOLDER),
        check_folder,
        lambda copter, sizes: ideals.directory(pages(copter, sizes)),
        pages,
        put_folder,
    ),
]

LOG_CASES = [
    Case(
        "log list",
        lambda program, sizes: program.vehicle.logs.list(),
        check_logs,
        lambda copter, sizes: ideals.log_list(LOGS, per_second=copter.storage.logs.rate_hz),
        lambda copter, sizes: LOGS,
    ),
    Case(
        "log download by messages",
        read_log("log"),
        check_log,
        lambda copter, sizes: ideals.log_read(sizes.log_bytes, blocks_per_second=copter.storage.logs.rate_hz),
        lambda copter, sizes: -(-sizes.log_bytes // 90),
        before=know_logs,
    ),
    Case(
        "log download as a file",
        read_log("ftp"),
        check_log,
        # The directory is read first, to find the name of the log's file.
        lambda copter, sizes: (
            ideals.directory(1) + ideals.file_read(sizes.log_bytes, blocks_per_second=burst_rate(copter))
        ),
        lambda copter, sizes: blocks(sizes.log_bytes),
        before=know_logs,
    ),
]

CASES = [*PARAMETERS, *(case for kind in PLANS for case in plan_cases(kind)), *FILES, *LOG_CASES]
