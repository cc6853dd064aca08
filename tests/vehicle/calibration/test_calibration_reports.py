"""PX4's ``[cal]`` texts: exactly the formats of its firmware."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aerokit.vehicle.calibration.values import SIDES, parse_report
from aerokit.vehicle.calibration.values import CalibrationPose as Pose

WITH_POSES = ("pending", "detected", "side done", "side progress", "already done")
KINDS = {"started", "done", "failed", "cancelled", "progress", *WITH_POSES}


@pytest.mark.parametrize(
    ("text", "kind", "progress", "poses"),
    [
        ("[cal] calibration started: 2 gyro", "started", None, ()),
        ("[cal] calibration done: mag", "done", None, ()),
        ("[cal] calibration failed: reading sensor", "failed", None, ()),
        ("[cal] calibration cancelled", "cancelled", None, ()),
        ("[cal] progress <0>", "progress", 0.0, ()),
        ("[cal] progress <17>", "progress", 0.17, ()),
        ("[cal] pending: back up", "pending", None, (Pose.NOSE_UP, Pose.BACK)),
        ("[cal] front orientation detected", "detected", None, (Pose.NOSE_DOWN,)),
        ("[cal] down side done, rotate to a different side", "side done", None, (Pose.LEVEL,)),
        ("[cal] left side already completed", "already done", None, (Pose.LEFT,)),
        ("[cal] up side calibration: progress <3>", "side progress", None, (Pose.BACK,)),
        ("[cal] Rotate vehicle", "text", None, ()),
    ],
)
def test_each_format_is_parsed(text: str, kind: str, progress: float | None, poses: tuple[Pose, ...]) -> None:
    report = parse_report(text)
    assert report is not None
    assert (report.kind, report.progress, report.poses) == (kind, progress, poses)


@pytest.mark.parametrize(
    "text", ["calibration done: mag", "[cal]", "[CAL] progress <5>", " [cal] progress <5>", "[cal] progress <101>"]
)
def test_other_text_is_no_report(text: str) -> None:
    assert parse_report(text) is None


@pytest.mark.parametrize(
    "text",
    ["progress <5>x", "progress <-5>", "pending:", "pending: sideways", "error orientation detected", "calibration"],
)
def test_damaged_report_is_only_an_instruction(text: str) -> None:
    report = parse_report(f"[cal] {text}")
    assert report is not None
    assert (report.kind, report.progress, report.poses) == ("text", None, ())


@given(st.integers(0, 100), st.lists(st.sampled_from(sorted(SIDES)), min_size=1, max_size=6, unique=True))
def test_progress_and_poses_are_kept(percent: int, sides: list[str]) -> None:
    report, pending = parse_report(f"[cal] progress <{percent}>"), parse_report(f"[cal] pending: {' '.join(sides)}")
    assert report is not None
    assert pending is not None
    assert report.progress == percent / 100
    assert pending.poses == tuple(SIDES[side] for side in sides)


@given(st.text(max_size=50))
def test_any_text_is_parsed_without_error(text: str) -> None:
    for received in (text, f"[cal] {text}"):
        report = parse_report(received)
        if report is not None and report.kind in KINDS:
            assert received.startswith("[cal] ")
            assert report.progress is None or 0 <= report.progress <= 1
            assert (report.kind in WITH_POSES) == bool(report.poses)
