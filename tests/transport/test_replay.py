from __future__ import annotations

import asyncio
import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from link_harness import Recorder, each_loop

from aerokit.errors import InvalidArgument, LinkOpenError
from aerokit.mavlink.tlog import TlogWriter
from aerokit.testing import run_virtual
from aerokit.transport import Replay, replay

START = 1_700_000_000.0


def frame(number: int) -> bytes:
    """A MAVLink 1 frame by its shape; a replay looks at nothing else."""
    return bytes([0xFE, 1, number % 256, 1, 1, 0, number % 251, 0, 0])


def recording(folder: Path, times: Sequence[float]) -> Path:
    path = folder / "flight.tlog"
    with TlogWriter(path) as writer:
        for number, when in enumerate(times):
            writer.write(frame(number), START + when)
    return path


def replay_times(path: Path, speed: float | None) -> list[float]:
    """Arrival time of each frame on the loop's clock, and of the end."""

    async def main() -> list[float]:
        loop, recorder = asyncio.get_running_loop(), Recorder()
        times: list[float] = []
        recorder.at_each_piece = lambda data, peer: times.append(loop.time())
        link = Replay(path, speed)
        await link.open(recorder)
        error = await recorder.until_lost()
        assert f"end of recording after {len(times)} frames" in str(error)
        assert [data for data, _ in recorder.pieces] == [frame(number) for number in range(len(times))]
        await link.wait_closed()
        return [*times, loop.time()]

    return run_virtual(main())


@pytest.mark.parametrize("speed", [1.0, 2.0, 0.5])
def test_frames_keep_the_recorded_pace(tmp_path: Path, speed: float) -> None:
    times = [0.0, 0.1, 0.1, 0.5, 2.0]
    came = replay_times(recording(tmp_path, times), speed)
    assert came == pytest.approx([when / speed for when in [*times, 2.0]], abs=1e-5)


@pytest.mark.parametrize("speed", [None, math.inf])
def test_unlimited_speed_takes_no_time(tmp_path: Path, speed: float | None) -> None:
    assert set(replay_times(recording(tmp_path, range(300)), speed)) == {0.0}


def test_long_gaps_and_backward_clocks_do_not_stop_replay(tmp_path: Path) -> None:
    gap = replay.MAX_GAP_S
    came = replay_times(recording(tmp_path, [0.0, 1.0, 1e6, 1e6 + 1, 50.0, 51.0]), 1.0)
    assert came[:-1] == pytest.approx([0.0, 1.0, 1.0 + gap, 2.0 + gap, 2.0 + gap, 3.0 + gap], abs=1e-5)


def test_empty_recording_ends_at_once(tmp_path: Path) -> None:
    assert replay_times(recording(tmp_path, []), 1.0) == [0.0]


@each_loop
async def test_other_tasks_run_during_fast_replay(tmp_path: Path) -> None:
    recorder, loop, observed = Recorder(), asyncio.get_running_loop(), list[int]()

    def look() -> None:
        observed.append(len(recorder.pieces))
        if not recorder.losses:
            loop.call_soon(look)

    link = Replay(recording(tmp_path, range(1000)), None)
    await link.open(recorder)
    look()
    await recorder.until_lost()
    steps = [after - before for before, after in itertools.pairwise(observed)]
    assert max(steps) <= replay.MAX_FRAMES_PER_ITERATION
    assert len(recorder.pieces) == link.frames == 1000


@each_loop
async def test_replay_closed_inside_callback_delivers_nothing(tmp_path: Path) -> None:
    link, recorder = Replay(recording(tmp_path, range(5)), None), Recorder()
    recorder.at_each_piece = lambda data, peer: link.close()
    await link.open(recorder)
    await recorder.until_data(frame(0))
    await asyncio.sleep(0)
    await link.wait_closed()
    assert recorder.data == frame(0)
    assert recorder.losses == []


@each_loop
async def test_closing_before_first_frame_closes_the_file(tmp_path: Path) -> None:
    link, recorder = Replay(recording(tmp_path, range(5))), Recorder()
    await link.open(recorder)
    link.close()
    await link.wait_closed()
    await asyncio.sleep(0)
    assert recorder.pieces == []


@each_loop
async def test_writes_are_ignored_and_counted(tmp_path: Path) -> None:
    link = Replay(recording(tmp_path, range(5)))
    await link.open(Recorder())
    link.write(b"x")
    link.write(b"y", peer="anybody")
    assert (link.ignored_writes, link.dropped_writes) == (2, 0)
    link.close()


@each_loop
async def test_missing_file_is_an_error(tmp_path: Path) -> None:
    link = Replay(tmp_path / "no.tlog")
    with pytest.raises(LinkOpenError, match=r"cannot open replay:.*no\.tlog: No such file"):
        await link.open(Recorder())


def test_file_failing_later_is_a_lost_link(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(path: object) -> object:
        yield START, frame(0)
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(replay, "read_tlog", failing)

    async def main() -> str:
        recorder = Recorder()
        await Replay(tmp_path / "flight.tlog").open(recorder)
        return str(await recorder.until_lost())

    assert "reading the recording failed: Input/output error" in run_virtual(main())


@pytest.mark.parametrize("speed", [0.0, -1.0, math.nan])
def test_speed_must_be_above_zero(speed: float) -> None:
    with pytest.raises(InvalidArgument, match="is not allowed: it must be above 0"):
        Replay("flight.tlog", speed)


def test_address_has_the_speed() -> None:
    assert Replay("flight.tlog").address == "replay:flight.tlog"
    assert Replay("flight.tlog", 2.0).address == "replay:flight.tlog?speed=2"
    assert Replay("flight.tlog", None).address == "replay:flight.tlog?speed=inf"


def test_closed_between_frames_has_no_timer(tmp_path: Path) -> None:
    async def main() -> float:
        link = Replay(recording(tmp_path, [0.0, 1000.0]), 1.0)
        await link.open(Recorder())
        await asyncio.sleep(0.1)
        link.close()
        await link.wait_closed()
        left = asyncio.all_tasks() - {asyncio.current_task()}
        assert not left
        loop: Any = asyncio.get_running_loop()
        return len([timer for timer in loop._scheduled if not timer.cancelled()])

    assert run_virtual(main()) == 0
