"""Path distances and separation of routes: geometry without vehicles."""

from __future__ import annotations

import math
from itertools import accumulate, combinations, pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aerokit.errors import InvalidArgument
from aerokit.fleets.paths import (
    TOLERANCE,
    LocalPoint,
    Path,
    PathPoint,
    _clip,
    horizontal_distance,
    min_path_distance,
)
from aerokit.fleets.separation import (
    Route,
    find_conflicts,
    pairs_within,
    separate_by_altitude,
    separate_by_time,
    to_local_points,
)

metres = st.floats(-50, 50).map(lambda value: round(value, 2))
places = st.tuples(metres, metres, st.floats(0, 30).map(lambda value: round(value, 2)))


@st.composite
def paths(draw: st.DrawFn, name: str = "a") -> Path:
    count = draw(st.integers(1, 4))
    times = list(accumulate(draw(st.lists(st.floats(0.5, 20), min_size=count, max_size=count))))
    return Path(name, [PathPoint(at, *draw(places)) for at in times])


def place_at(path: Path, at_s: float) -> LocalPoint:
    """Position at a time, computed independently of the library."""
    points = list(path.points)
    if at_s <= points[0].t_s:
        return points[0].place
    for one, other in pairwise(points):
        if one.t_s <= at_s <= other.t_s and other.t_s > one.t_s:
            share = (at_s - one.t_s) / (other.t_s - one.t_s)
            return tuple(a + share * (b - a) for a, b in zip(one.place, other.place, strict=True))  # type: ignore[return-value]
    return points[-1].place


def fastest(path: Path) -> float:
    legs = pairwise(path.points)
    return max((math.dist(a.place, b.place) / (b.t_s - a.t_s) for a, b in legs if b.t_s - a.t_s > 1e-6), default=0.0)


@given(paths(), paths("b"))
def test_min_path_distance_matches_dense_sampling(one: Path, other: Path) -> None:
    begin, end = min(one.begins_at_s, other.begins_at_s), max(one.ends_at_s, other.ends_at_s)
    times = [begin + (end - begin) * number / 400 for number in range(401)]
    sampled = min(math.dist(place_at(one, at), place_at(other, at)) for at in times)
    found = min_path_distance(one, other, slack_s=0.0)
    assert found.distance_m <= sampled + 1e-6
    assert found.at_s == pytest.approx(found.other_at_s, abs=1e-6)
    step = (end - begin) / 400
    assert found.distance_m >= sampled - step * (fastest(one) + fastest(other)) - 1e-6


@given(paths(), paths("b"), st.floats(0.5, 10))
def test_min_path_distance_decreases_with_slack(one: Path, other: Path, slack: float) -> None:
    exact = min_path_distance(one, other, slack_s=0.0).distance_m
    loose = min_path_distance(one, other, slack_s=slack).distance_m
    never = min_path_distance(one, other).distance_m
    assert never <= loose + 1e-6 <= exact + 2e-6
    assert min_path_distance(other, one, slack_s=slack).distance_m == pytest.approx(loose, abs=1e-6)
    near = min_path_distance(one, other, slack_s=slack)
    assert abs(near.at_s - near.other_at_s) <= slack + 1e-6


@given(paths(), paths("b"), st.floats(1, 20))
def test_min_path_distance_below_m_keeps_the_verdict(one: Path, other: Path, below: float) -> None:
    exact, quick = min_path_distance(one, other), min_path_distance(one, other, below_m=below)
    assert (quick.distance_m < below) == (exact.distance_m < below)
    if exact.distance_m < below:
        assert quick.distance_m == pytest.approx(exact.distance_m, abs=1e-9)


def test_crossing_paths_conflict_only_at_the_same_time() -> None:
    one = Path.straight("a", (0, 0, 10), (100, 0, 10), 10)
    simultaneous = Path.straight("b", (50, -50, 10), (50, 50, 10), 10)
    later = Path.straight("b", (50, -50, 10), (50, 50, 10), 10, at_s=20)
    assert min_path_distance(one, simultaneous, slack_s=0.0).distance_m == pytest.approx(0, abs=1e-9)
    assert min_path_distance(one, later, slack_s=0.0).distance_m > 20
    assert min_path_distance(one, later).distance_m == pytest.approx(0, abs=1e-9)
    (conflict,) = find_conflicts([one, simultaneous], 5, slack_s=1)
    assert (conflict.name, conflict.other) == ("a", "b")
    assert conflict.at_s == pytest.approx(5, abs=1)
    assert find_conflicts([one, later], 5, slack_s=3) == ()


routes_of = st.lists(st.tuples(places, places), min_size=2, max_size=6).map(
    lambda many: [Route(str(number), start, target) for number, (start, target) in enumerate(many)]
)


@given(routes_of, st.lists(places, max_size=2), st.floats(1, 8))
def test_layers_keep_min_distance_at_any_speed(routes: list[Route], rest: list[LocalPoint], least: float) -> None:
    stationary = {f"rest {number}": place for number, place in enumerate(rest)}
    plan = separate_by_altitude(routes, stationary, least)
    rests = [Path(name, [PathPoint(0, *place)]) for name, place in stationary.items()]
    if plan.decision == "clear":
        phases = [[Path.straight(route.name, route.start, route.target, 1.0) for route in routes]]
    elif plan.decision == "layers":
        heights = plan.heights_m
        stages: list[list[tuple[str, LocalPoint, LocalPoint]]] = [[], [], []]
        for route in routes:
            over_start = (*route.start[:2], heights[route.name])
            over_target = (*route.target[:2], heights[route.name])
            for stage, way in zip(
                stages,
                ((route.start, over_start), (over_start, over_target), (over_target, route.target)),
                strict=True,
            ):
                stage.append((route.name, *way))
        phases = [[Path.straight(name, one, other, 1.0) for name, one, other in stage] for stage in stages]
    else:
        assert plan.decision == "refused"
        assert plan.reason
        return
    for phase in phases:
        for one, other in combinations(phase, 2):
            assert min_path_distance(one, other).distance_m >= least - 1e-6
        for one in phase:
            for other in rests:
                assert min_path_distance(one, other).distance_m >= least - 1e-6


@given(routes_of, st.floats(1, 8))
def test_corridors_keep_min_distance_within_slack(routes: list[Route], least: float) -> None:
    plan = separate_by_time(routes, {}, least, 5.0, slack_s=2.0, max_delay_s=60.0)
    if plan.decision == "corridors":
        timed = [
            Path.straight(route.name, route.start, route.target, 5.0, plan.delays_s[route.name]) for route in routes
        ]
        assert not find_conflicts(timed, least - 1e-6, slack_s=2.0)
    assert plan.decision in ("clear", "corridors", "refused")


def test_swapped_positions_need_layers_not_corridors() -> None:
    swap = [Route("a", (0, 0, 10), (60, 0, 10)), Route("b", (60, 0, 10), (0, 0, 10))]
    plan = separate_by_altitude(swap, {}, 5)
    assert plan.decision == "layers"
    assert sorted(plan.heights_m.values()) == [10, 15]
    assert "a and b (0.0 m) come too close" in plan.reason
    assert separate_by_altitude(swap, {}, 5, max_altitude_m=12).decision == "refused"
    assert separate_by_time(swap, {}, 5, 5.0, max_delay_s=60).decision == "refused"


def test_crossing_routes_get_delayed_starts() -> None:
    cross = [Route("a", (0, -50, 10), (0, 50, 10)), Route("b", (-50, 0, 10), (50, 0, 10))]
    plan = separate_by_time(cross, {}, 5, 10.0, slack_s=1.0)
    assert plan.decision == "corridors"
    assert plan.delays_s["a"] == 0
    assert 1 <= plan.delays_s["b"] <= 5


def test_corridors_start_with_vehicle_at_the_others_target() -> None:
    routes = [Route("a", (0, 0, 10), (50, 0, 10)), Route("b", (50, 0, 10), (100, 0, 10))]
    plan = separate_by_time(routes, {}, 5, 5.0, slack_s=1.0)
    assert plan.decision == "corridors"
    assert plan.delays_s["b"] == 0


def test_routes_avoid_stationary_vehicles() -> None:
    route = [Route("a", (0, 0, 10), (60, 0, 10))]
    assert separate_by_altitude(route, {"b": (30, 0, 10)}, 5).heights_m == {"a": 15}
    assert separate_by_altitude(route, {"b": (60, 1, 10)}, 5).decision == "refused"
    assert separate_by_altitude(route, {"b": (30, 0, 30)}, 5).decision == "clear"
    assert separate_by_time(route, {"b": (30, 0, 10)}, 5, 5.0, max_delay_s=10).decision == "refused"


@given(st.dictionaries(st.text("abcdef", min_size=1, max_size=3), places, max_size=20), st.floats(0.5, 40))
def test_pairs_within_matches_exhaustive_comparison(where: dict[str, LocalPoint], within: float) -> None:
    expected = {(one, other) for one, other in combinations(where, 2) if math.dist(where[one], where[other]) < within}
    assert {(one, other) for one, other, _ in pairs_within(where, within)} == expected


def test_to_local_points_returns_metres() -> None:
    from aerokit._internal import geo

    there = geo.offset(47.0, 8.0, 300.0, -400.0)
    local = to_local_points({"a": (47.0, 8.0, 1.0), "b": (*there, 11.0)})
    assert local["b"] == pytest.approx((300.0, -400.0, 11.0), abs=2.0)


def test_horizontal_distance_ignores_altitude() -> None:
    assert horizontal_distance(((0, 0, 0), (10, 0, 90)), ((5, -5, 40), (5, 5, 70))) == pytest.approx(0)


def test_invalid_paths_and_distances_are_rejected() -> None:
    with pytest.raises(InvalidArgument, match="min_distance_m"):
        separate_by_altitude([], {}, 0)
    with pytest.raises(InvalidArgument, match="speed_m_s"):
        Path.straight("a", (0, 0, 0), (1, 0, 0), 0)
    with pytest.raises(InvalidArgument, match="decrease at 0 s"):
        Path("a", [PathPoint(1, 0, 0, 0), PathPoint(0, 0, 0, 0)])
    with pytest.raises(InvalidArgument, match="has no points"):
        Path("a", [])
    with pytest.raises(InvalidArgument, match="finite"):
        PathPoint(math.nan, 0, 0, 0)


def test_clip_corners_stay_inside_within_tolerance() -> None:
    square = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]
    clipped = _clip(square, lambda s, t: (0.9 + 0.2 * s) * TOLERANCE)
    assert all(0 <= s <= 1 and 0 <= t <= 1 for s, t in clipped)


def test_altitude_limit_that_is_no_number_is_refused() -> None:
    with pytest.raises(InvalidArgument, match="max_altitude_m = nan"):
        separate_by_altitude([], {}, 5.0, max_altitude_m=math.nan)
