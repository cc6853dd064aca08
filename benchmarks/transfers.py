"""Parameters, missions and files through a lossy link: aerokit, pymavlink, MAVSDK and DroneKit against one vehicle.

    python benchmarks/transfers.py                        # everything, half an hour; writes bench-transfers.json
    python benchmarks/transfers.py parameters --loss 0.2  # these tasks, this loss
    python benchmarks/transfers.py --quick                # small and without loss: a check that it runs

Each transfer has a new client process and a new vehicle process (``bad_vehicle.py``), so that transfers are
independent. A seed determines the numbers of the lost frames for every library. The time is that of the transfer call
of a connected client, and the transferred content is compared with the expected one. Figures are medians over the
seeds.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import socket
import statistics
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import table
from content import FULL, LIMIT_S, QUICK, Sizes, file_content, mission_items
from table import Row

__all__ = ["rows"]

HERE = Path(__file__).resolve().parent
CONNECT_S = 60.0
DELAY_S = 0.01
LOSSES = (0.0, 0.05, 0.2)
SEEDS = (1, 2, 3)
DRONEKIT = os.environ.get("AEROKIT_DRONEKIT_PYTHON", sys.executable)
"""Interpreter that has DroneKit, by default this one."""


@dataclass(frozen=True)
class Contender:
    """A library and one of its transfer methods."""

    name: str
    library: str
    method: str = "auto"

    @property
    def python(self) -> str:
        return DRONEKIT if self.library == "dronekit" else sys.executable


AEROKIT = Contender("aerokit", "aerokit")
MAVSDK = Contender("MAVSDK", "mavsdk")
CLASSIC = Contender("DroneKit", "dronekit")
MAVFTP = Contender("pymavlink mavftp", "pymavlink", "mavftp")

CONTENDERS: dict[str, tuple[Contender, ...]] = {
    "parameters": (
        AEROKIT,
        Contender("aerokit by list", "aerokit", "list"),
        MAVFTP,
        Contender("pymavlink by list", "pymavlink", "list"),
        MAVSDK,
        CLASSIC,
    ),
    **dict.fromkeys(
        ("mission_upload", "mission_download"),
        (
            AEROKIT,
            Contender("aerokit by items", "aerokit", "items"),
            Contender("pymavlink mavwp", "pymavlink", "items"),
            MAVSDK,
            CLASSIC,
        ),
    ),
    **dict.fromkeys(("file_download", "file_upload"), (AEROKIT, MAVFTP, MAVSDK)),
}
TASKS = tuple(CONTENDERS)


@dataclass(frozen=True)
class Outcome:
    """Result of one library, one task and one loss rate: the seconds of each seed, and failures."""

    task: str
    loss: float
    contender: Contender
    seconds: tuple[float, ...]
    failures: tuple[str, ...]

    @property
    def median(self) -> float:
        return statistics.median(self.seconds) if self.seconds else LIMIT_S

    def __str__(self) -> str:
        if not self.failures:
            return f"{self.median:.2f}"
        return "failed" if not self.seconds else f"{self.median:.2f}, {len(self.failures)} failed"


def rows(quick: bool = False) -> list[Row]:
    """Measure a row for each task, loss and peer: ``transfer_parameters_loss_5_mavsdk``."""
    if quick:
        outcomes = measure(TASKS, (0.0,), (1,), QUICK, libraries=("aerokit", "pymavlink"))
    else:
        outcomes = measure(TASKS, LOSSES, SEEDS, FULL)
    return as_rows(outcomes)


def measure(
    tasks: Sequence[str],
    losses: Sequence[float],
    seeds: Sequence[int],
    sizes: Sizes,
    *,
    delay_s: float = DELAY_S,
    libraries: Sequence[str] | None = None,
    report: Callable[[str], object] = lambda text: None,
) -> list[Outcome]:
    """Run all tasks with all libraries, in turns; libraries that are not installed are omitted."""
    installed = [name for name in libraries or ("aerokit", "pymavlink", "mavsdk", "dronekit") if _is_installed(name)]
    outcomes = []
    for task in tasks:
        for loss in losses:
            for contender in CONTENDERS[task]:
                if contender.library in installed:
                    outcome = _outcome(task, loss, contender, seeds, sizes, delay_s)
                    outcomes.append(outcome)
                    report(f"{task}, {loss:.0%} loss, {contender.name}: {outcome} {'; '.join(outcome.failures)}")
    return outcomes


def as_rows(outcomes: Sequence[Outcome]) -> list[Row]:
    """Return rows that compare aerokit with each of the other libraries. A failure counts as the maximum time."""
    rows = []
    for own in outcomes:
        if own.contender is not AEROKIT:
            continue
        for peer in outcomes:
            if (peer.task, peer.loss) == (own.task, own.loss) and peer.contender.library != "aerokit":
                rows.append(_row(own, peer))
    return rows


def printed(outcomes: Sequence[Outcome]) -> str:
    """Return a Markdown table with a line for each task and loss."""
    lines = []
    for task in dict.fromkeys(outcome.task for outcome in outcomes):
        names = [contender.name for contender in CONTENDERS[task]]
        lines += ["", f"| {task.replace('_', ' ')} | {' | '.join(names)} |", "|---" * (len(names) + 1) + "|"]
        for loss in dict.fromkeys(outcome.loss for outcome in outcomes):
            cells = {}
            for outcome in outcomes:
                if outcome.task == task and outcome.loss == loss:
                    cells[outcome.contender.name] = str(outcome)
            if cells:
                lines.append(f"| {loss:.0%} loss | {' | '.join(cells.get(name, '–') for name in names)} |")
    return "\n".join(lines)


def _row(own: Outcome, peer: Outcome) -> Row:
    name = f"transfer_{own.task}_loss_{own.loss * 100:.0f}_{peer.contender.library}"
    if peer.contender.method != "auto":
        name += f"_{peer.contender.method}"
    peer_s = max(peer.median, LIMIT_S) if peer.failures else peer.median
    ratio = 0.0 if own.failures else peer_s / own.median
    row = table.row(name, own.median, peer_s, peer.contender.name, unit="s", ratio=ratio, aim=1.0)
    row["aerokit"] = round(own.median, 3)
    row["peer"] = round(peer_s, 3)
    if own.failures or peer.failures:
        row["failures"] = {"aerokit": list(own.failures), "peer": list(peer.failures)}
    return row


# ------------------------------------------------------------------------------------- one transfer


def _outcome(
    task: str, loss: float, contender: Contender, seeds: Sequence[int], sizes: Sizes, delay_s: float
) -> Outcome:
    seconds = []
    failures = []
    for seed in seeds:
        with TemporaryDirectory() as folder:
            try:
                seconds.append(_transfer(task, loss, contender, seed, sizes, delay_s, Path(folder)))
            except _FailedError as error:
                failures.append(str(error))
    return Outcome(task, loss, contender, tuple(seconds), tuple(failures))


class _FailedError(Exception):
    """The transfer did not end, or the transferred content is wrong."""


def _transfer(
    task: str, loss: float, contender: Contender, seed: int, sizes: Sizes, delay_s: float, folder: Path
) -> float:
    (folder / "in.bin").write_bytes(file_content(sizes.file_bytes))
    port = _free_port()
    size = sizes.items if task.startswith("mission") else sizes.file_bytes
    with _vehicle(task, port, loss, seed, delay_s, size, folder) as vehicle:
        script = HERE / f"client_{contender.library}.py"
        command = [contender.python, str(script), task, contender.method, str(port), str(size), str(folder)]
        seconds = _run_client(command, folder)
        _dump(vehicle, folder)
    _check(task, contender, sizes, folder)
    return seconds


def _run_client(command: list[str], folder: Path) -> float:
    try:
        completed = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=LIMIT_S + CONNECT_S)
    except subprocess.TimeoutExpired:
        raise _FailedError(f"not finished after {LIMIT_S:.0f} s") from None
    try:
        outcome = json.loads(completed.stdout.splitlines()[-1])
    except (IndexError, ValueError):
        _, _, last_line = completed.stderr.strip().rpartition("\n")
        raise _FailedError(last_line[:200] or "ended without a result") from None
    if "error" in outcome:
        raise _FailedError(f"{outcome['error']} (after {outcome['seconds']:.1f} s)")
    if outcome["seconds"] > LIMIT_S:
        raise _FailedError(f"not finished after {LIMIT_S:.0f} s")
    return float(outcome["seconds"])


def _check(task: str, contender: Contender, sizes: Sizes, folder: Path) -> None:
    """Compare the transferred content with the expected one."""
    if task == "parameters":
        expected = json.loads((folder / "vehicle-parameters.json").read_text())
        _check_parameters(json.loads((folder / "out.json").read_text()), expected)
    elif task.startswith("mission"):
        path = folder / ("vehicle.json" if task == "mission_upload" else "out.json")
        _check_mission(json.loads(path.read_text()), sizes.items, contender)
    else:
        path = folder / ("vehicle.bin" if task == "file_upload" else "out.bin")
        if not path.exists() or path.read_bytes() != file_content(sizes.file_bytes):
            raise _FailedError("the content of the file is wrong")


def _check_parameters(received: dict[str, float], expected: dict[str, float]) -> None:
    if set(received) != set(expected):
        raise _FailedError(f"{len(set(expected) - set(received))} of {len(expected)} parameters are missing")
    wrong = []
    for name, value in expected.items():
        if not math.isclose(received[name], value, rel_tol=1e-6, abs_tol=1e-6):
            wrong.append(name)
    if wrong:
        raise _FailedError(f"{len(wrong)} parameters have wrong values: {wrong[:3]}")


def _check_mission(received: list[list[float]], count: int, contender: Contender) -> None:
    expected = mission_items(count)
    if len(received) != len(expected):
        raise _FailedError(f"{len(received)} items instead of {len(expected)}")
    # DroneKit uses MISSION_ITEM, whose coordinates are 32-bit floats with errors of up to 1.5 m.
    max_error = 200 if contender.library == "dronekit" else 0
    for index, (item, expected_item) in enumerate(zip(received, expected, strict=True)):
        # The frame is not compared, because it may change to the equivalent frame of the other message.
        command, _, *params, x, y, z = item
        expected_command, _, *expected_params, expected_x, expected_y, expected_z = expected_item
        is_same = (command, params, z) == (expected_command, expected_params, expected_z)
        is_near = max(abs(x - expected_x), abs(y - expected_y)) <= max_error
        if not (is_same and is_near):
            raise _FailedError(f"item {index} is {item} instead of {list(expected_item)}")


@contextmanager
def _vehicle(
    task: str, port: int, loss: float, seed: int, delay_s: float, size: int, folder: Path
) -> Iterator[subprocess.Popen[str]]:
    script = str(HERE / "bad_vehicle.py")
    command = [sys.executable, script, task, str(port), str(loss), str(seed), str(delay_s), str(size)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        _read_answer(process, "ready")
        yield process
    finally:
        process.terminate()
        process.communicate()


def _dump(vehicle: subprocess.Popen[str], folder: Path) -> None:
    assert vehicle.stdin is not None
    vehicle.stdin.write(f"dump {folder}\n")
    vehicle.stdin.flush()
    _read_answer(vehicle, "dumped")


def _read_answer(vehicle: subprocess.Popen[str], word: str) -> None:
    if vehicle.stdout is None or vehicle.stdout.readline().strip() != word:
        raise RuntimeError("the simulated vehicle has failed")


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        _, port = probe.getsockname()
        return int(port)


def _is_installed(library: str) -> bool:
    python = DRONEKIT if library == "dronekit" else sys.executable
    alias = "import collections, collections.abc; collections.MutableMapping = collections.abc.MutableMapping; "
    return subprocess.run([python, "-c", f"{alias}import {library}"], capture_output=True).returncode == 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure the requested parts, print and write the results."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("tasks", nargs="*", metavar="TASK", help=", ".join(TASKS))
    parser.add_argument("--loss", type=float, action="append", help="share of frames lost in each direction, 0 to 1")
    parser.add_argument("--seeds", type=int, default=len(SEEDS), help="number of runs of each transfer")
    parser.add_argument("--delay", type=float, default=DELAY_S, help="delay in each direction in seconds")
    parser.add_argument("--library", action="append", help="aerokit, pymavlink, mavsdk or dronekit (all)")
    parser.add_argument("--quick", action="store_true", help="small and without loss, to check that everything runs")
    parser.add_argument("--output", type=Path, default=Path("bench-transfers.json"))
    options = parser.parse_args(arguments)
    if not set(options.tasks) <= set(TASKS):
        parser.error(f"the tasks are {', '.join(TASKS)}")
    outcomes = measure(
        options.tasks or TASKS,
        options.loss or ((0.0,) if options.quick else LOSSES),
        range(1, (1 if options.quick else options.seeds) + 1),
        QUICK if options.quick else FULL,
        delay_s=options.delay,
        libraries=options.library,
        report=lambda text: print(text, file=sys.stderr, flush=True),
    )
    measured_rows = as_rows(outcomes)
    print(printed(outcomes))
    missed = [row["name"] for row in measured_rows if table.is_missed(row)]
    print(f"\nMISSED: {', '.join(missed)}" if missed else "\naerokit is the fastest in every row")
    table.write(measured_rows, options.output)
    return 0


if __name__ == "__main__":
    sys.exit(main())
