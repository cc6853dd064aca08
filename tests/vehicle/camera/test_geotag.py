"""Positions in CSV and JPEG files, as other programs read them."""

from __future__ import annotations

import csv
import io
import warnings
from pathlib import Path

import pytest
from PIL import Image

from aerokit import Position
from aerokit.errors import AerokitError, FileFormatError, InvalidArgument
from aerokit.sim.components.captures import GREY_JPEG
from aerokit.vehicle.camera import capture as geotag
from aerokit.vehicle.camera.capture import Capture, captures_csv, geotag_file, geotagged, write_captures

PLACE = Position(-35.3632621, 149.1652374, altitude_amsl_m=634.25, altitude_relative_m=50.0)
CAPTURE = Capture(
    100,
    7,
    True,
    12.0,
    1_790_000_000.75,
    PLACE,
    (1.0, 0.0, 0.0, 0.0),
    1.5,
    -90.0,
    271.25,
    "mftp:///DCIM/A.JPG",
)


def degrees(parts: tuple[float, float, float]) -> float:
    return float(parts[0]) + float(parts[1]) / 60 + float(parts[2]) / 3600


def test_geotag_writes_position_time_and_direction() -> None:
    tagged = geotagged(GREY_JPEG, CAPTURE)
    with Image.open(io.BytesIO(tagged)) as image:
        exif = image.getexif()
        gps, more = exif.get_ifd(0x8825), exif.get_ifd(0x8769)
    assert (gps[1], gps[3]) == ("S", "E")
    assert degrees(gps[2]) == pytest.approx(35.3632621, abs=1e-7)
    assert degrees(gps[4]) == pytest.approx(149.1652374, abs=1e-7)
    assert (gps[5], float(gps[6])) == (b"\0", 634.25)
    assert (gps[16], float(gps[17])) == ("T", 271.25)
    assert gps[29] == "2026:09:21"
    assert [float(number) for number in gps[7]] == pytest.approx([14.0, 13.0, 20.75])
    assert more[0x9003] == "2026:09:21 14:13:20"
    assert more[0x9011] == "+00:00"
    assert float(more[0x9405]) == -90.0


def test_geotag_keeps_image_data() -> None:
    tagged = geotagged(GREY_JPEG, CAPTURE)
    assert tagged.endswith(GREY_JPEG[GREY_JPEG.index(b"\xff\xdb") :])
    with Image.open(io.BytesIO(GREY_JPEG)) as before, Image.open(io.BytesIO(tagged)) as after:
        assert before.tobytes() == after.tobytes()


def test_geotag_keeps_other_tags_and_replaces_position() -> None:
    text = io.BytesIO()
    exif = Image.Exif()
    exif[0x010F] = "Maker"
    exif.get_ifd(0x8769)[0x829D] = 2.8
    Image.new("RGB", (8, 8)).save(text, "JPEG", exif=exif, comment=b"kept")
    first = geotagged(text.getvalue(), CAPTURE)
    north = CAPTURE.replace(place=PLACE.replace(latitude_deg=10.5, altitude_amsl_m=-3.0))
    second = geotagged(first, north)
    with Image.open(io.BytesIO(second)) as image:
        found = image.getexif()
        assert found[0x010F] == "Maker"
        assert float(found.get_ifd(0x8769)[0x829D]) == pytest.approx(2.8)
        gps = found.get_ifd(0x8825)
        assert gps[1] == "N"
        assert degrees(gps[2]) == pytest.approx(10.5)
        assert (gps[5], float(gps[6])) == (b"\1", 3.0)
        assert image.info["comment"] == b"kept"
    assert second.count(b"Exif\0\0") == 1


def test_geotag_omits_unknown_values() -> None:
    bare = CAPTURE.replace(
        place=Position(0.5, -1.0), taken_at=None, roll_deg=None, pitch_deg=None, yaw_deg=None, quaternion=None
    )
    with Image.open(io.BytesIO(geotagged(GREY_JPEG, bare))) as image:
        exif = image.getexif()
        assert set(exif.get_ifd(0x8825)) == {0, 1, 2, 3, 4, 18}
        assert exif.get_ifd(0x8825)[3] == "W"
        assert 0x9003 not in exif.get_ifd(0x8769)
    with pytest.raises(InvalidArgument, match="capture 7 of camera 100 has no position"):
        geotagged(GREY_JPEG, CAPTURE.replace(place=None))


@pytest.mark.parametrize("wrong", [b"", b"\xff\xd8", b"PNG" * 20, GREY_JPEG[:30], b"\xff\xd8\xff\xe1\0\1" + bytes(9)])
def test_geotag_non_jpeg_is_file_format_error(wrong: bytes) -> None:
    with pytest.raises(FileFormatError, match=r"not a JPEG|JPEG is incomplete or malformed"):
        geotagged(wrong, CAPTURE)


@pytest.mark.parametrize("begin", [b"II*\0", b"XX*\0", b""])
def test_geotag_unreadable_exif_is_an_error(begin: bytes) -> None:
    body = b"Exif\0\0" + begin + b"\xff" * 40
    wrong = GREY_JPEG[:2] + b"\xff\xe1" + (len(body) + 2).to_bytes(2, "big") + body + GREY_JPEG[2:]
    with (
        warnings.catch_warnings(),
        pytest.raises(FileFormatError, match="cannot read the EXIF of this picture"),
    ):
        warnings.simplefilter("ignore")
        geotagged(wrong, CAPTURE)


def test_geotag_file_is_written_atomically(tmp_path: Path) -> None:
    picture, copy = tmp_path / "a.jpg", tmp_path / "b.jpg"
    picture.write_bytes(GREY_JPEG)
    geotag_file(picture, CAPTURE, to=copy)
    assert picture.read_bytes() == GREY_JPEG
    geotag_file(picture, CAPTURE)
    assert picture.read_bytes() == copy.read_bytes() == geotagged(GREY_JPEG, CAPTURE)
    with pytest.raises(FileNotFoundError):
        geotag_file(tmp_path / "none.jpg", CAPTURE)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.jpg", "b.jpg"]


def test_captures_csv_lists_captures(tmp_path: Path) -> None:
    lost = CAPTURE.replace(
        index=8,
        success=None,
        taken_at=None,
        place=None,
        roll_deg=None,
        pitch_deg=None,
        yaw_deg=None,
        file_url="",
    )
    write_captures(tmp_path / "list.csv", [CAPTURE, lost])
    text = (tmp_path / "list.csv").read_text()
    assert text == captures_csv([CAPTURE, lost])
    first, second = csv.DictReader(io.StringIO(text))
    assert first == {
        "file": "A.JPG", "camera": "100", "index": "7", "success": "1",
        "taken_at": "2026-09-21T14:13:20.750+00:00", "latitude_deg": "-35.3632621", "longitude_deg": "149.1652374",
        "altitude_amsl_m": "634.25", "altitude_relative_m": "50.0", "roll_deg": "1.5", "pitch_deg": "-90.0",
        "yaw_deg": "271.25",
    }  # fmt: skip
    assert {name for name, value in second.items() if value} == {"camera", "index"}


def test_geotag_without_pillow_names_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(_: str) -> None:
        raise ImportError

    monkeypatch.setattr(geotag, "import_module", missing)
    with pytest.raises(AerokitError, match=r"pip install aerokit-mavlink\[pictures\]"):
        geotagged(GREY_JPEG, CAPTURE)
