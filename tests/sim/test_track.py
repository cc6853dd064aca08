"""True tracks of simulated vehicles, and their pictures."""

from __future__ import annotations

import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest
from simulated_client import flying_copter, ready_copter

from aerokit.errors import AerokitError, InvalidArgument
from aerokit.sim import SimulatedPx4, SimulatedVehicle
from aerokit.testing.picture import check_picture, draw_svg, save_picture
from aerokit.testing.track import Track, record_track
from aerokit.testing.track_points import TrackPoint

SVG = "{http://www.w3.org/2000/svg}"


def flown_track() -> Track:
    copter, client = ready_copter()
    track = record_track(copter, interval_s=0.5)
    client.run(2.0)
    copter.motion.north, copter.motion.east, copter.motion.down = 30.0, 40.0, -12.0
    client.run(0.5)
    return track


def test_track_has_true_positions() -> None:
    track = flown_track()
    assert track.name == "system 1"
    assert [point.time_s for point in track[:4]] == pytest.approx([3.0, 3.5, 4.0, 4.5])
    north, east, up = track.local()[-1]
    assert (north, east) == pytest.approx((30, 40), abs=1.0)
    assert 11 < up < 12.5
    assert track.length_m == pytest.approx(51.4, abs=2.0)


def test_recording_does_not_change_the_bytes() -> None:
    def traffic(*, recorded: bool) -> list[object]:
        copter, client = flying_copter()
        if recorded:
            record_track(copter)
        client.run(3.0)
        return [(time, message) for time, message in client.received]

    assert traffic(recorded=True) == traffic(recorded=False)


def test_a_reboot_does_not_end_a_track() -> None:
    copter, client = ready_copter()
    track = record_track(copter)
    copter.restart()
    client.run(4.0)
    assert track.end.time_s > 6.5


def test_every_autopilot_has_a_track() -> None:
    px4 = SimulatedPx4()
    px4.step(0.0)
    track = record_track(px4)
    px4.step(1.0)
    assert len(track) == 11
    assert track.end.mode == "LOITER"


def test_vehicle_without_position_has_no_track() -> None:
    nowhere = SimulatedVehicle(system_id=1, component_id=1, seed=0, components=())
    with pytest.raises(InvalidArgument, match="no true position"):
        record_track(nowhere)


def test_speed_and_battery_are_in_the_track() -> None:
    copter, client = flying_copter()
    track = record_track(copter)
    copter.motion.velocity_north = 8.0
    client.run(3.0)
    assert 7.0 < track.max_speed_m_s < 8.0
    assert 0.05 < track.battery_used_percent < 2.0


def test_an_interval_must_be_above_0() -> None:
    with pytest.raises(InvalidArgument, match="interval_s"):
        record_track(SimulatedPx4(), interval_s=0)


# ------------------------------------------------------------------------------------------- pictures


def test_svg_has_two_lines_per_vehicle() -> None:
    tracks = [flown_track(), flown_track()]
    tracks[1].name = "system <2>"
    root = ElementTree.fromstring(draw_svg(tracks))
    lines = root.findall(f"{SVG}polyline")
    assert len(lines) == 4
    assert {line.get("stroke") for line in lines} == {"#1f77b4", "#d62728"}
    assert [text.text for text in root.iter(f"{SVG}text")][-2:] == ["system 1", "system <2>"]
    for line in lines:
        for place in (line.get("points") or "").split():
            x, y = (float(number) for number in place.split(","))
            assert 0 <= x <= 800
            assert 0 <= y <= 680


def test_map_has_equal_scale_in_both_axes() -> None:
    track = flown_track()
    first, place = track[0], track.home.offset(north_m=100)
    north = TrackPoint(9.0, place.latitude_deg, place.longitude_deg, 0.0, first.armed, first.mode)
    line = next(ElementTree.fromstring(draw_svg([Track(track.home, [first, north])])).iter(f"{SVG}polyline"))
    (x1, y1), (x2, y2) = (map(float, place.split(",")) for place in (line.get("points") or "").split())
    assert x1 == pytest.approx(x2, abs=0.2)
    assert y1 - y2 == pytest.approx(460 / 1.1, abs=1)


def test_picture_without_tracks_is_empty(tmp_path: Path) -> None:
    save_picture([], tmp_path / "empty.svg")
    assert ElementTree.parse(tmp_path / "empty.svg").getroot().tag == f"{SVG}svg"


def test_other_file_suffixes_are_refused() -> None:
    with pytest.raises(InvalidArgument, match=r"\.svg or \.png"):
        check_picture("track.jpeg")


def test_png_without_pillow_explains_the_installation(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "PIL.Image", None)
    with pytest.raises(AerokitError, match="pip install pillow"):
        save_picture([], tmp_path / "track.png")


def test_png_shows_the_same_as_svg(tmp_path: Path) -> None:
    from PIL import Image

    flown_track().save(tmp_path / "track.png")
    with Image.open(tmp_path / "track.png") as picture:
        assert picture.size == (800, 680)
        colours = {colour for _, colour in picture.convert("RGB").getcolors(1 << 20) or ()}
    assert {(255, 255, 255), (0x1F, 0x77, 0xB4), (0xDD, 0xDD, 0xDD)} <= colours
