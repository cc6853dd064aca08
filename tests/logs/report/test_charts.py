"""Drawn lines against the track, colours against colour vision, and the tables of long logs."""

from __future__ import annotations

import json
import math
import random
from collections.abc import Iterator, Sequence
from itertools import combinations, pairwise, product
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aerokit.logs.flights import FlightLog, failsafes
from aerokit.logs.flights.flight import FailsafeEvidence, LoggedText, TangentPlane
from aerokit.logs.report import report_html
from aerokit.logs.report.charts import (
    COLOURS,
    line_trace,
    mode_colours,
    timeline,
    timeline_shapes,
    track_parts,
    track_rows_to_draw,
)
from aerokit.logs.report.page import MAX_OPEN_ROWS, MAX_PRINTED_ROWS, Chart, Paragraphs, Section, Table, page
from aerokit.logs.report.sections import SECTIONS
from aerokit.logs.report.simplification import simplify
from aerokit.position import Position

Place = tuple[float, float]
SIDE_M, LAPS, POINTS_PER_SIDE = 50.0, 619, 10
NAN = math.nan


def distance(place: Place, start: Place, end: Place) -> float:
    """Return the distance of a place from a segment."""
    along = end[0] - start[0], end[1] - start[1]
    length = along[0] ** 2 + along[1] ** 2
    offset = place[0] - start[0], place[1] - start[1]
    share = (offset[0] * along[0] + offset[1] * along[1]) / length if length else 0.0
    share = min(max(share, 0.0), 1.0)
    return math.hypot(offset[0] - share * along[0], offset[1] - share * along[1])


def largest_distance(places: Sequence[Place], rows: Sequence[int]) -> float:
    """Return the largest distance of a known place from the part of the drawn line that replaces it."""
    found = 0.0
    for first, last in pairwise(rows):
        if math.isnan(places[first][0]) or math.isnan(places[last][0]):
            continue
        for place in places[first:last]:
            found = max(found, distance(place, places[first], places[last]))
    return found


coordinates = st.one_of(st.floats(-1e4, 1e4), st.sampled_from([0.0, 1.0, 50.0]))
lines = st.lists(st.one_of(st.tuples(coordinates, coordinates), st.just((NAN, NAN))), min_size=1, max_size=80).flatmap(
    lambda part: st.integers(1, 4).map(lambda times: part * times)
)


@given(lines, st.integers(2, 400), st.sampled_from([0.0, 0.1, 30.0]))
def test_no_point_is_farther_than_stated(places: list[Place], max_points: int, tolerance: float) -> None:
    rows, stated = simplify(places, max_points, tolerance)
    assert rows == sorted(set(rows))
    known = [row for row, place in enumerate(places) if not math.isnan(place[0])]
    # Each known row is drawn, or lies between two drawn rows without a gap.
    for row in known:
        before = max((drawn for drawn in rows if drawn <= row), default=None)
        after = min((drawn for drawn in rows if drawn >= row), default=None)
        assert before is not None
        assert after is not None
        assert not any(math.isnan(places[between][0]) for between in range(before, after + 1)) or before == after
    assert largest_distance(places, rows) <= stated + 1e-6
    assert stated <= tolerance or len(rows) >= max_points


def square(laps: int, noise_m: float = 0.05) -> list[Place]:
    seeded = random.Random(1)
    corners = [(0.0, 0.0), (SIDE_M, 0.0), (SIDE_M, SIDE_M), (0.0, SIDE_M), (0.0, 0.0)]
    return [
        (
            start[0] + (end[0] - start[0]) * step / POINTS_PER_SIDE + seeded.uniform(-noise_m, noise_m),
            start[1] + (end[1] - start[1]) * step / POINTS_PER_SIDE + seeded.uniform(-noise_m, noise_m),
        )
        for _ in range(laps)
        for start, end in pairwise(corners)
        for step in range(POINTS_PER_SIDE)
    ]


def outline_distance(place: Place) -> float:
    corners = [(0.0, 0.0), (SIDE_M, 0.0), (SIDE_M, SIDE_M), (0.0, SIDE_M), (0.0, 0.0)]
    return min(distance(place, start, end) for start, end in pairwise(corners))


def flight_of(places: Sequence[Place], tmp_path: Path, changes: int = 0) -> FlightLog:
    """Return a flight through metres north and east of home, one place a second."""
    flight = FlightLog(tmp_path / "square.tlog", ends_at=float(len(places)), home=Position(0.0, 8.0, 500.0))
    plane = TangentPlane(0.0, 8.0)
    for time_s, place in enumerate(places):
        flight.track.add(float(time_s), *plane.degrees(*place), 500.0, 10.0)
    for number in range(changes):
        flight.add_mode(len(places) * number / changes, f"MODE{number % 3}")
    flight.set_armed(0.0, True)
    flight.set_armed(float(len(places)), False)
    return flight


@pytest.mark.exhaustive
@pytest.mark.parametrize("changes", [0, 200])
def test_square_flown_619_times_stays_square(changes: int, tmp_path: Path) -> None:
    chart, note = track_parts(flight_of(square(LAPS), tmp_path, changes))
    assert isinstance(chart, Chart)
    drawn = [trace for trace in chart.traces if trace["mode"] == "lines"]
    assert len(drawn) == (3 if changes else 1)
    for trace in drawn:
        for start, end in pairwise(zip(trace["y"], trace["x"], strict=True)):
            if None in (*start, *end):
                continue
            for share in (0.0, 0.25, 0.5):
                between = [a + (b - a) * share for a, b in zip(start, end, strict=True)]
                assert outline_distance((between[0], between[1])) < 0.5
    assert isinstance(note, Paragraphs)
    stated = float(note.lines[0].split(" more than ")[1].split(" m ")[0])
    assert stated < 0.3
    rows, deviation = track_rows_to_draw(square(LAPS))
    assert largest_distance(square(LAPS), rows) <= deviation == pytest.approx(stated, abs=0.05)
    assert 4 * LAPS < len(rows) < 7000


def test_spiral_is_simplified_without_recursion() -> None:
    """Each outer turn is the farthest from the chord, so the halves of a split are as unequal as possible."""
    places = [(turn * math.cos(turn), turn * math.sin(turn)) for turn in (row / 50 for row in range(40_000))]
    rows, stated = simplify(places, 3000, 0.1)
    assert largest_distance(places, rows) <= stated + 1e-9 < 8.0


def test_all_mode_bands_and_failsafes_are_drawn(tmp_path: Path) -> None:
    flight = flight_of(square(100), tmp_path, changes=300)
    flight.failsafe_evidence = [FailsafeEvidence(10.0 * i, "battery", "low", True) for i in range(150)]
    shapes = timeline_shapes(flight)
    bands = [shape for shape in shapes if "fillcolor" in shape]
    assert sum(shape["path"].count("M") for shape in bands) == 300
    assert {shape["fillcolor"] for shape in bands} == set(mode_colours(flight).values())
    assert sum(shape["path"].count("M") for shape in shapes if shape not in bands) == len(failsafes(flight))
    assert len(failsafes(flight)) == 150


def test_timelines_have_one_range_with_margins(tmp_path: Path) -> None:
    flight = flight_of(square(10), tmp_path, changes=3)
    for time_s in (0.0, flight.duration_s):
        flight.battery(0).add(time_s, 16.0, 1.0, 1.0, 90.0)
        flight.attitude.add(time_s, 1.0, 2.0, 3.0)
    sections = [section for make in SECTIONS if (section := make(flight)) is not None]
    charts = [part for section in sections for part in section.parts if isinstance(part, Chart) and part.is_timeline]
    assert len(charts) > 5
    ranges = {tuple(chart.layout["xaxis"]["range"]) for chart in charts}
    ((begin, end),) = ranges
    assert begin < 0.0 < flight.duration_s < end
    assert (0.0 - begin, end - flight.duration_s) == pytest.approx((8.0, 8.0), abs=0.01)


@pytest.mark.parametrize(
    ("count", "tag"),
    [
        (MAX_OPEN_ROWS, ""),
        (MAX_OPEN_ROWS + 1, "<details>"),
        (MAX_PRINTED_ROWS + 1, '<details data-print="no">'),
    ],
)
def test_long_tables_are_collapsed(count: int, tag: str) -> None:
    section = Section("Texts", [Table(("a",), [("x",)] * count, "many & more")])
    html = page("title", [], [section], COLOURS)
    assert html.count("<details") == bool(tag)
    assert f"{tag}<summary>many &amp; more</summary>" in html or not tag
    assert html.count("<td>x</td>") == count


def test_many_failsafes_and_modes_are_collapsed(tmp_path: Path) -> None:
    flight = flight_of(square(50), tmp_path, changes=100)
    flight.failsafe_evidence = [FailsafeEvidence(10.0 * i, "battery", f"low {i}", True) for i in range(40)]
    flight.texts = [LoggedText(float(i), 6, f"text {i}") for i in range(500)]
    html = report_html(flight)
    for title in ("100 modes", "30 more", "500 texts"):
        assert f'<details data-print="no"><summary>{title}</summary>' in html
    assert "low 39" in html
    assert "; 35 more" in html  # in the summary


def test_batteries_have_the_same_names_everywhere(tmp_path: Path) -> None:
    """They count from 1, as in ArduPilot's "Battery 1 is low" and BATT2_MONITOR."""
    flight = flight_of(square(5), tmp_path)
    for number, time_s in product((0, 1), range(100)):
        flight.battery(number).add(float(time_s), 15.0, 2.0, 30.0, 50.0)
    flight.failsafe_evidence = [FailsafeEvidence(50.0, "battery", "Battery 1 is low")]
    (failsafe,) = failsafes(flight)
    assert [fact.split(":")[0] for fact in failsafe.context if fact.startswith("battery")] == [
        "battery 1",
        "battery 2",
    ]
    data = json.loads(report_html(flight).split('id="charts">')[1].split("</script>")[0])
    names = [
        [trace["name"] for trace in data["charts"][f"battery-{key}"]["traces"]] for key in ("voltage_v", "current_a")
    ]
    assert names == [["battery 1", "battery 2"]] * 2


def test_series_have_own_colours(tmp_path: Path) -> None:
    flight = flight_of(square(5), tmp_path, changes=3)
    traces = [line_trace(name, flight.track, "altitude_amsl_m") for name in ("a", "b")]
    chart = timeline(flight, "name", "m", traces)
    assert chart is not None
    assert [trace["line"]["color"] for trace in chart.traces] == ["colour:series0", "colour:series1"]


# Machado, Oliveira and Fernandes 2009, severity 1, for linear RGB: without red, green and blue cones.
CONE_LOSSES: dict[str, tuple[tuple[float, float, float], ...]] = {
    "none": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "protan": (
        (0.152286, 1.052583, -0.204868),
        (0.114503, 0.786281, 0.099216),
        (-0.003882, -0.048116, 1.051998),
    ),
    "deutan": (
        (0.367322, 0.860646, -0.227968),
        (0.280085, 0.672501, 0.047413),
        (-0.011820, 0.042940, 0.968881),
    ),
    "tritan": (
        (1.255528, -0.076749, -0.178779),
        (-0.078411, 0.930809, 0.147602),
        (0.004733, 0.691367, 0.303900),
    ),
}
CONES = (
    (0.41222147, 0.53633254, 0.05144599),
    (0.2119035, 0.68069954, 0.10739696),
    (0.08830246, 0.28171884, 0.6299787),
)
OPPONENTS = (
    (0.21045426, 0.79361779, -0.00407205),
    (1.9779985, -2.42859221, 0.45059371),
    (0.02590404, 0.78277177, -0.80867577),
)
# For comparison: the palette of Okabe and Ito has 0.076 with protan and deutan vision.
MIN_OKLAB_DISTANCE = 0.068


def linear(colour: str) -> list[float]:
    parts = [int(colour[at : at + 2], 16) / 255 for at in (1, 3, 5)]
    return [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]


def times(matrix: Sequence[Sequence[float]], vector: Sequence[float]) -> list[float]:
    return [sum(a * b for a, b in zip(row, vector, strict=True)) for row in matrix]


def oklab(rgb: Sequence[float]) -> list[float]:
    """Return coordinates in which distances are perceived differences (Ottosson 2020)."""
    lms = times(
        (
            (0.41222147, 0.53633254, 0.05144599),
            (0.2119035, 0.68069954, 0.10739696),
            (0.08830246, 0.28171884, 0.6299787),
        ),
        [min(max(part, 0.0), 1.0) for part in rgb],
    )
    return times(
        (
            (0.21045426, 0.79361779, -0.00407205),
            (1.9779985, -2.42859221, 0.45059371),
            (0.02590404, 0.78277177, -0.80867577),
        ),
        [part ** (1 / 3) for part in lms],
    )


def contrast(one: str, other: str) -> float:
    lights = sorted(0.2126 * r + 0.7152 * g + 0.0722 * b for r, g, b in (linear(one), linear(other)))
    return (lights[1] + 0.05) / (lights[0] + 0.05)


def palettes() -> Iterator[tuple[str, str, list[str]]]:
    for theme, kind in product(COLOURS, ("mode", "series")):
        yield theme, kind, [colour for name, colour in COLOURS[theme].items() if name.startswith(kind)]


@pytest.mark.parametrize(("theme", "kind", "palette"), list(palettes()))
@pytest.mark.parametrize("loss", CONE_LOSSES)
def test_palette_is_distinguishable_with_colour_blindness(theme: str, kind: str, palette: list[str], loss: str) -> None:
    seen = {colour: oklab(times(CONE_LOSSES[loss], linear(colour))) for colour in palette}
    nearest = min(combinations(palette, 2), key=lambda pair: math.dist(seen[pair[0]], seen[pair[1]]))
    assert math.dist(seen[nearest[0]], seen[nearest[1]]) > MIN_OKLAB_DISTANCE, nearest
    assert all(contrast(colour, COLOURS[theme]["paper"]) >= 3.0 for colour in palette)


def test_modes_and_series_share_no_colour() -> None:
    by_kind: dict[tuple[str, str], Any] = {(theme, kind): set(palette) for theme, kind, palette in palettes()}
    for theme in COLOURS:
        assert not by_kind[theme, "mode"] & by_kind[theme, "series"]
        assert len(by_kind[theme, "mode"]) == 8
