"""Shows: files, trajectories, deviations; a hundred simulated copters on one clock."""

from __future__ import annotations

import asyncio
import math
import os
from contextlib import AsyncExitStack
from itertools import pairwise
from pathlib import Path as FilePath
from typing import Any

import anyio
import pytest
from fleet_stage import HOME, open_stage
from flight_harness import block_loop
from hypothesis import given
from hypothesis import strategies as st

from aerokit import messages as m
from aerokit.errors import FileFormatError, FleetError, InvalidArgument, OperationRejected
from aerokit.fleets import show_flight
from aerokit.fleets.distances import LocalOrigin
from aerokit.fleets.members import Member
from aerokit.fleets.opening import fleet
from aerokit.fleets.paths import LocalPoint, Path, PathPoint
from aerokit.fleets.show import Show, state_at
from aerokit.fleets.show_flight import ClockOffset, TrackRecorder, max_relative_error, measure_clock, track_deviation
from aerokit.mavlink import FrameEncoder
from aerokit.position import Position
from aerokit.sim import SimulatedCopter, simulated_link
from aerokit.transport.link import Peer

pytestmark = pytest.mark.anyio

ORIGIN = Position(*HOME[:2])
FEW_STREAMS = {
    m.GlobalPositionInt: 4.0,
    m.ExtendedSysState: 1.0,
    m.SysStatus: 1.0,
    m.EkfStatusReport: 1.0,
}


def circle(
    north_m: float, east_m: float, seconds: int, radius_m: float = 3.0
) -> list[tuple[float, float, float, float]]:
    """A rising circle at about 1.5 m/s."""
    return [
        (
            number / 2,
            north_m + radius_m * math.sin(number / 4),
            east_m + radius_m * (1 - math.cos(number / 4)),
            8 + number / 20,
        )
        for number in range(2 * seconds + 1)
    ]


@pytest.mark.exhaustive
async def test_show_report_measures_deviation() -> None:
    async with open_stage(3) as stage:
        await stage.take_off(8)
        show = Show.from_points({name: circle(0, 10.0 * number, 12) for number, name in enumerate(stage.copters)})
        report = await stage.fleet.fly_show(show, ORIGIN)
        assert report.result.is_complete
        for name in stage.copters:
            error = report.tracks[name]
            assert error.samples > 40
            assert error.rms_m < error.max_m < 1.5
            assert error.lag_s is not None
            assert abs(error.lag_s) < 0.3
            assert report.clocks[name].answers == 8
        assert report.lag_spread_s is not None
        assert report.lag_spread_s < 0.05
        assert report.max_relative_error_m is not None
        assert report.max_relative_error_m < 0.3
        assert set(stage.modes.values()) == {"BRAKE"}


async def test_show_report_measures_lag() -> None:
    async with open_stage(2) as stage:
        await stage.take_off(8)
        show = Show.from_points(
            {
                "north/1": circle(0, 0, 10),
                "north/2": [(t + 1.0, n, e + 10, u) for t, n, e, u in circle(0, 0, 10)],
            }
        )
        report = await stage.fleet.fly_show(show, ORIGIN, lead_s=None)
        planned = Show.from_points({"north/1": circle(0, 0, 10), "north/2": circle(0, 10, 10)})
        assert report.tracks["north/1"].lag_s is not None
        assert planned.duration_s == 10
        assert 0.1 < report.tracks["north/1"].lag_s < 0.6


async def test_show_failure_applies_policy() -> None:
    async with open_stage(3, on_error="land_others") as stage:
        await stage.take_off(8)
        show = Show.from_points({name: circle(0, 10.0 * number, 20) for number, name in enumerate(stage.copters)})

        async def take() -> None:
            import anyio

            await anyio.sleep(15)
            stage.pilot_takes("north/2")

        taking = asyncio.create_task(take())
        report = await stage.fleet.fly_show(show, ORIGIN)
        await taking
        assert list(report.result.failed) == ["north/2"]
        assert stage.mode_of("north/2") == "LOITER"
        assert stage.copters["north/1"].motion.is_on_ground


async def test_invalid_show_is_rejected() -> None:
    async with open_stage(2, min_distance_m=5.0) as stage:
        await stage.take_off(8)
        stage.clear()
        near = Show.from_points({"north/1": circle(0, 0, 5), "north/2": circle(0, 3, 5)})
        with pytest.raises(OperationRejected, match=r"within 2\.\d m"):
            await stage.fleet.fly_show(near, ORIGIN)
        with pytest.raises(InvalidArgument, match="'x' is not a member"):
            await stage.fleet.fly_show(Show.from_points({"x": circle(0, 0, 5)}), ORIGIN)
        stage.copters["north/2"].faults.silent = True
        far = Show.from_points({"north/1": circle(0, 0, 5), "north/2": circle(0, 30, 5)})
        with pytest.raises(FleetError, match="did not answer TIMESYNC"):
            await stage.fleet.fly_show(far, ORIGIN)
        assert not stage.modes_ordered("north/2")


async def test_show_beside_member_without_track_is_refused() -> None:
    async with open_stage(3, min_distance_m=4.0) as stage:
        await stage.take_off(10)
        through = Show.from_points({"north/1": [(0, 0, 0, 10), (10, 0, 40, 10)]})
        with pytest.raises(OperationRejected, match=r"north/1 and north/2 come within .* nothing was sent"):
            await stage.fleet.fly_show(through, ORIGIN)
        assert not any(map(stage.orders_to, stage.copters))
        beside = Show.from_points({"north/1": [(0, 0, 0, 10), (2, -4, 0, 10)]})
        assert (await stage.fleet.fly_show(beside, ORIGIN)).result.is_complete


async def test_show_with_member_released_before_start_does_not_start() -> None:
    """The other tracks were compared with the track of this member, not with the place where it stays."""
    async with open_stage(2, min_distance_m=4.0) as stage:
        await stage.take_off(8)
        show = Show.from_points({name: circle(0, 10.0 * number, 6) for number, name in enumerate(stage.copters)})
        asyncio.get_running_loop().call_later(0.3, stage.fleet.release, "north/2")
        with pytest.raises(OperationRejected, match=r"north/2 is released.* the show was not started"):
            await stage.fleet.fly_show(show, ORIGIN)
        assert stage.orders_to("north/2") == []


@pytest.mark.parametrize("is_posted", [False, True])
async def test_show_does_not_overrule_landing_of_member_that_waits(is_posted: bool) -> None:
    async with open_stage(2) as stage:
        await stage.take_off(8)
        show = Show.from_points({"north/1": circle(0, 0, 6), "north/2": circle(100, 10, 6)})
        flying = asyncio.create_task(stage.fleet.fly_show(show, ORIGIN))
        await anyio.sleep(6)  # north/1 is at its first point, north/2 is not.
        vehicle = stage.fleet.vehicles["north/1"]

        async def land() -> None:
            if not is_posted:
                await vehicle.land()
                return
            mode = vehicle.autopilot.find_mode("LAND")
            with vehicle.posted("mode", modes=(mode,)) as posted:
                await posted.set_mode(mode)

        landing = asyncio.create_task(land())
        with pytest.raises(OperationRejected, match=r"north/1 got a newer order .*; the show was not started"):
            await flying
        await landing
        assert stage.modes_ordered("north/1") == ["LAND"]


async def test_show_does_not_overrule_landing_during_clock_measurement() -> None:
    async with open_stage(2) as stage:
        await stage.take_off(8)
        show = Show.from_points({"north/1": circle(0, 0, 6), "north/2": circle(0, 10, 6)})
        flying = asyncio.create_task(stage.fleet.fly_show(show, ORIGIN))
        await anyio.sleep(0.1)
        landing = asyncio.create_task(stage.fleet.vehicles["north/1"].land())
        with pytest.raises(OperationRejected, match=r"north/1 got a newer order .*; the show was not started"):
            await flying
        await landing
        assert stage.orders_to("north/2") == []


@pytest.mark.parametrize(("block_s", "is_late"), [(4.0, False), (5.8, True)])
async def test_show_member_that_would_join_late_holds(
    block_s: float, is_late: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The event loop is blocked from five seconds before the start on."""

    async def block_and_fly(member: Member, *args: Any, **options: Any) -> None:
        if member.name == "north/1":
            block_loop(block_s)
        await fly_track(member, *args, **options)

    fly_track = show_flight._fly_track
    monkeypatch.setattr(show_flight, "_fly_track", block_and_fly)
    async with open_stage(2, min_distance_m=4.0) as stage:
        await stage.take_off(8)
        show = Show.from_points({name: circle(0, 10.0 * number, 6) for number, name in enumerate(stage.copters)})
        result = (await stage.fleet.fly_show(show, ORIGIN)).result
        assert result.is_complete is not is_late
        for error in result.failed.values():
            assert "would join its track 1.0 s late, so it holds" in str(error)
        assert set(stage.modes.values()) == {"BRAKE"}


async def test_invalid_position_is_not_recorded() -> None:
    """Autopilots that have lost their position report 0°N 0°E."""
    async with open_stage(1) as stage:
        vehicle, wire = stage.fleet.vehicles["north/1"], stage.wires["north"]
        with TrackRecorder(vehicle, ClockOffset(0.0, 0.0, 1), LocalOrigin(ORIGIN, HOME[2]), 0.0) as recorder:
            for latitude_deg in (0.0, HOME[0]):
                position = m.GlobalPositionInt(
                    0, round(latitude_deg * 1e7), round(latitude_deg * 1e7), 0, 0, 0, 0, 0, 0
                )
                wire.deliver(FrameEncoder(1, 1).encode(position))
                assert recorder.has_position == (latitude_deg != 0)


async def fly_many(networks: int, of_each: int, seconds: int) -> None:
    """Fly ``networks * of_each`` copters; several networks keep the traffic of each small."""
    metre = 1 / 111_319.5
    places: dict[str, tuple[float, float]] = {}
    async with AsyncExitStack() as stack:
        links = {}
        for row in range(networks):
            name = f"row{row}"
            places |= {f"{name}/{number + 1}": (12.0 * row, 12.0 * number) for number in range(of_each)}
            copters = [
                SimulatedCopter(
                    system_id=number + 1,
                    boot_time_s=0.0,
                    seed=100 * row + number,
                    home=(
                        HOME[0] + 12 * row * metre,
                        HOME[1] + 12 * number * metre / math.cos(math.radians(HOME[0])),
                        HOME[2],
                    ),
                )
                for number in range(of_each)
            ]
            links[name] = await stack.enter_async_context(simulated_link(copters))
        async with fleet(links, count=networks * of_each, rates=FEW_STREAMS, min_distance_m=4.0) as many:
            (await many.wait_ready()).raise_for_errors()
            (await many.arm()).raise_for_errors()
            (await many.take_off(8)).raise_for_errors()
            show = Show.from_points({name: circle(*place, seconds) for name, place in places.items()})
            report = await many.fly_show(show, ORIGIN, rate_hz=4, start_in_s=1)
            report.result.raise_for_errors()
            assert max(track.max_m for track in report.tracks.values()) < 1.5
            assert max(track.rms_m for track in report.tracks.values()) < 0.6
            assert report.lag_spread_s is not None
            assert report.lag_spread_s < 0.1
            assert report.max_relative_error_m is not None
            assert report.max_relative_error_m < 0.5


@pytest.mark.exhaustive
async def test_show_with_a_hundred_copters() -> None:
    await fly_many(10, 10, int(os.environ.get("AEROKIT_SHOW_SECONDS", "6")))


# ----------------------------------------------------------------------------------- values and files


def test_show_file_round_trip(tmp_path: FilePath) -> None:
    show = Show.from_points({"a": [(0, 1, 2, 3), (1.5, 2, 2, 3)], 'b,"c': [(0, 5, 5, 5)]})
    for name in ("show.csv", "show.json"):
        show.save(tmp_path / name)
        assert Show.read(tmp_path / name) == show
    assert show.duration_s == 1.5
    assert show.top_speed_m_s("a") == pytest.approx(2 / 3)
    assert list(show.renamed({"a": "north/1", 'b,"c': "north/2"}).tracks) == ["north/1", "north/2"]
    with pytest.raises(InvalidArgument, match="names has no fleet member for these tracks: a"):
        show.renamed({'b,"c': "x"})
    with pytest.raises(InvalidArgument, match="names has the same fleet member for two tracks: x, x"):
        show.renamed({"a": "x", 'b,"c': "x", "not in the show": "y"})


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "line 1 must be name,t_s"),
        ("name,t_s,north_m,east_m,up_m\na,0,1,2\n", "line 2"),
        ("name,t_s,north_m,east_m,up_m\na,0,1,2,3\na,1,x,2,3\n", "line 3"),
        ("name,t_s,north_m,east_m,up_m\na,1,1,2,3\na,0,1,2,3\n", "decrease at 0 s"),
        ("name,t_s,north_m,east_m,up_m\na,0,nan,2,3\n", "finite"),
        ("name,t_s,north_m,east_m,up_m\na,1,1,2,3\na,1,5,2,3\n", "two positions"),
        ("name,t_s,north_m,east_m,up_m\n", "a show needs at least one"),
        ("name,t_s,north_m,east_m,up_m\na,0,1,2,3\n" + "a" * 200_000, "line 3: field larger than field limit"),
        ("{", "not JSON"),
        ('{"format": "other"}', "not a show"),
        ('{"format": "aerokit show", "version": 1}', 'the "tracks" of the show must be a JSON object'),
        ('{"format": "aerokit show", "version": 1, "tracks": {"a": [[0, 1]]}}', "track 'a'"),
        ('{"format": "aerokit show", "version": 1, "tracks": {"a": 5}}', "track 'a'"),
        (f'{{"format": "aerokit show", "version": 1, "tracks": {{"a": [[1{"0" * 400}, 0, 0, 0]]}}}}', "track 'a'"),
    ],
)
def test_show_damaged_file_error_has_location(text: str, match: str, tmp_path: FilePath) -> None:
    path = tmp_path / "show"
    path.write_text(text)
    with pytest.raises(FileFormatError, match=match):
        Show.read(path)


track = Path("a", [PathPoint(0, 0, 0, 10), PathPoint(10, 40, 0, 10), PathPoint(20, 40, 40, 20)])


@given(st.floats(-5, 25))
def test_state_at_velocity_matches_position_change(at_s: float) -> None:
    (before, speed), (after, _) = state_at(track, at_s), state_at(track, at_s + 1e-3)
    if not any(abs(at_s - point.t_s) < 2e-3 for point in track.points):
        moved = [(b - a) / 1e-3 for a, b in zip(before, after, strict=True)]
        assert moved == pytest.approx(list(speed), abs=1e-6)


@given(st.floats(-1, 1), st.tuples(*[st.floats(-0.2, 0.2)] * 3))
def test_track_deviation_distinguishes_lag_from_offset(lag_s: float, offset: LocalPoint) -> None:
    samples = [
        (
            number / 5,
            tuple(p + q for p, q in zip(state_at(track, number / 5 - lag_s)[0], offset, strict=True)),
        )
        for number in range(10, 90)
    ]
    error = track_deviation(track, samples)  # type: ignore[arg-type]
    assert error.lag_s == pytest.approx(lag_s, abs=0.12)
    assert error.samples == 80
    assert error.rms_m <= error.max_m + 1e-9
    standing = track_deviation(Path("a", [PathPoint(0, 0, 0, 0)]), [(1.0, (3.0, 4.0, 0.0))])
    assert (standing.max_m, standing.rms_m, standing.lag_s) == (5.0, 5.0, None)


def test_max_relative_error_compares_vectors_between_vehicles() -> None:
    other = track.replace(name="b")
    times = [tick / 2 for tick in range(41)]

    def shifted(by: float) -> list[tuple[float, LocalPoint]]:
        return [(at, (state_at(track, at)[0][0] + by, *state_at(track, at)[0][1:])) for at in times]

    paths = {"a": track, "b": other}
    assert max_relative_error(paths, {"a": shifted(1), "b": shifted(1)}, 20) == pytest.approx(0, abs=1e-9)
    assert max_relative_error(paths, {"a": shifted(1), "b": shifted(-0.5)}, 20) == pytest.approx(1.5)
    assert max_relative_error(paths, {"a": shifted(1)}, 20) is None
    assert all(one < after for one, after in pairwise(times))


async def test_clock_is_measured_beside_component_that_answers_first(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = FrameEncoder(1, 100)
    async with open_stage(1) as stage:
        wire, vehicle = stage.wires["north"], stage.fleet.vehicles["north/1"]
        sent_before = wire.write

        def write(data: bytes, peer: Peer = None) -> None:
            sent_before(data, peer)
            requests = wire.all(m.Timesync)
            wire.clear()
            for request in requests:
                wire.deliver(camera.encode(m.Timesync(5, request.ts1)))

        monkeypatch.setattr(wire, "write", write)
        offset = await measure_clock(vehicle)
        assert offset.answers == 8
        assert offset.offset_s == pytest.approx(stage.copters["north/1"].uptime - vehicle.connection.now(), abs=0.1)
