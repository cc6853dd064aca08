"""Files of a failed test: recording, report, and picture with modes, failed point and limit."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from aerokit.logs.flights import read_flight
from aerokit.position import Position
from aerokit.testing.picture import draw_svg
from aerokit.testing.track import Track
from aerokit.testing.track_points import TrackPoint

pytest_plugins = ["pytester"]

FAILING = """
import pytest

async def test_one(flight):
    vehicle = flight.vehicle
    await vehicle.wait_ready()
    await vehicle.arm()
    await vehicle.take_off(10)
    flight.track.assert_stayed_below(5)

async def test_two(fleet):
    await fleet[1].vehicle.wait_ready()
    assert False

async def test_well(flight):
    await flight.vehicle.wait_ready()
"""


def run(pytester: pytest.Pytester, source: str, *arguments: str) -> pytest.RunResult:
    pytester.makepyfile(test_it=source)
    plugins = ("-p", "no:aerokit", "-p", "aerokit.testing.plugin", "-p", "no:asyncio", "-p", "no:xdist")
    return pytester.runpytest_inprocess(*plugins, "-p", "no:cacheprovider", "--assert=plain", *arguments)


@pytest.mark.exhaustive
def test_failed_test_saves_recording_and_report(pytester: pytest.Pytester) -> None:
    pytest.importorskip("plotly")
    result = run(pytester, FAILING, "--flight-pictures", "kept")
    result.assert_outcomes(failed=2, passed=1)
    result.stdout.fnmatch_lines(
        ["recording in kept*test_it.py-test_one.tlog", "report in kept*test_it.py-test_one.html"]
    )
    kept = pytester.path / "kept"
    assert sorted(path.name for path in kept.iterdir()) == [
        *("test_it.py-test_one.html", "test_it.py-test_one.svg", "test_it.py-test_one.tlog"),
        *("test_it.py-test_two.1.html", "test_it.py-test_two.2.html", "test_it.py-test_two.svg"),
        "test_it.py-test_two.tlog",
    ]
    flight = read_flight(kept / "test_it.py-test_one.tlog")
    assert [change.name for change in flight.modes] == ["STABILIZE", "GUIDED"]
    assert flight.modes[-1].reason == "ordered"  # The messages of the program are included.
    assert max(flight.track["altitude_relative_m"]) == pytest.approx(10, abs=1)
    assert read_flight(kept / "test_it.py-test_two.tlog", system_id=2).system_id == 2


def test_missing_report_extra_is_reported(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "plotly.offline", None)
    result = run(pytester, FAILING, "--flight-pictures", "kept", "-k", "test_one")
    result.stdout.fnmatch_lines(["recording in *.tlog", "no report: pip install 'aerokit-mavlink?report?'"])
    assert not list((pytester.path / "kept").glob("*.html"))


def test_nothing_is_recorded_by_default(pytester: pytest.Pytester) -> None:
    source = """
    import pytest
    async def test_it(flight):
        assert flight.recording is None
    def test_served(served_flight):
        assert served_flight.recording is None
    """
    run(pytester, source).assert_outcomes(passed=2)


HOME = Position(47.0, 8.0)


def flown() -> Track:
    """Return a track of 100 m to the north in ten seconds at 30 m, with a mode change halfway."""
    points = []
    for i in range(11):
        place = HOME.offset(north_m=10 * i)
        mode = "AUTO" if i < 5 else "RTL"
        points.append(TrackPoint(float(i), place.latitude_deg, place.longitude_deg, 30.0, True, mode, 10.0))
    return Track(HOME, points)


def test_picture_labels_mode_changes() -> None:
    svg = draw_svg([flown()])
    assert re.findall(r">(AUTO|RTL)<", svg) == ["AUTO", "RTL"] * 2  # On the map and in the profile.
    assert "failed" not in svg


def test_picture_shows_circle_and_failed_point(tmp_path: Path) -> None:
    track = flown()
    with pytest.raises(AssertionError):
        track.assert_stayed_within(60)
    assert track.failure is not None
    assert track.failure.point.time_s == 10.0
    svg = draw_svg([track])
    assert "failed here" in svg
    (circle,) = re.findall(r'<polyline points="([^"]+)"[^>]*stroke-dasharray', svg)
    ys = [float(place.split(",")[1]) for place in circle.split()]
    (track_line,) = (line for line in re.findall(r'<polyline points="([^"]+)"', svg)[1:2])  # The circle is drawn first.
    flown_ys = [float(place.split(",")[1]) for place in track_line.split()]
    metre = (flown_ys[0] - flown_ys[-1]) / 100
    assert (max(ys) - min(ys)) / 2 == pytest.approx(60 * metre, rel=0.01)
    assert flown_ys[-1] < min(ys)  # North of the circle.


def test_picture_shows_fence_and_altitude_limit() -> None:
    track = flown()
    corners = [HOME.offset(north_m=n, east_m=e) for n, e in ((-20, -20), (-20, 20), (55, 20), (55, -20))]
    with pytest.raises(AssertionError):
        track.assert_stayed_inside(corners)
    assert track.failure is not None
    assert track.failure.point.time_s == 6.0  # The first point outside.
    (fence,) = re.findall(r'<polyline points="([^"]+)"[^>]*stroke-dasharray', draw_svg([track]))
    assert len(fence.split()) == 5
    with pytest.raises(AssertionError):
        track.assert_stayed_below(20)
    (limit,) = re.findall(r'<polyline points="([^"]+)"[^>]*stroke-dasharray', draw_svg([track]))
    assert len({place.split(",")[1] for place in limit.split()}) == 1
