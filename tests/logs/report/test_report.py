"""Reports are parsed: their content, missing data, and escaping of hostile logs."""

from __future__ import annotations

import base64
import hashlib
import json
import math
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import anyio
import pytest

import aerokit
from aerokit import messages as m
from aerokit.apps.cli import main
from aerokit.logs.flights import FlightLog, TimeSeries, failsafes, read_flight
from aerokit.logs.flights.flight import FailsafeEvidence, LoggedText, ModeChange, Waypoint
from aerokit.logs.report import report_html
from aerokit.logs.report.charts import drawn_points, rows_to_draw
from aerokit.logs.report.formatting import clock_text, distance_text, duration_text
from aerokit.logs.report.statistics import statistics_of, summary
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import MavCmd, MavFrame
from aerokit.mavlink.tlog import TlogWriter
from aerokit.position import Position
from aerokit.testing import open_flight, run_virtual

pytest.importorskip("plotly")

RECORDINGS = Path(__file__).parents[2] / "recordings"
HOSTILE = "<script>alert(1)</script><img src=x onerror=alert(2)>"
HOSTILE_TEXTS = (
    HOSTILE,
    "\"' onmouseover='alert(3)' x=\"",
    "</script><svg onload=alert(4)>",
    "\x1b[31mred\x1b[0m\x07\x08\x7f\x85 bell",
    "\u202egnirts sdrawkcab\u2066 bidi\u200f",
    "colour:mode0",
    "&lt;b&gt; &amp; {{7*7}} ${7*7}",
)


class Page(HTMLParser):
    """Parses a page into tags, scripts, addresses and text."""

    def __init__(self, path: Path) -> None:
        super().__init__(convert_charrefs=True)
        self.tags: list[str] = []
        self.handlers: list[str] = []
        self.addresses: list[str] = []
        self.scripts: list[str] = []
        self.text = ""
        self._script: dict[str, str | None] | None = None
        self.data: dict[str, Any] = {}
        self.html = path.read_text(encoding="utf-8")
        self.feed(self.html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.handlers += [name for name, _ in attrs if name.startswith("on")]
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href")]
        self._script = dict(attrs) if tag == "script" else None
        if tag == "script":
            self.scripts.append("")

    def handle_endtag(self, tag: str) -> None:
        if tag == "script" and self._script is not None:
            if self._script.get("id") == "charts":
                self.data = json.loads(self.scripts.pop())
            self._script = None

    @property
    def charts(self) -> dict[str, Any]:
        return self.data["charts"]  # type: ignore[no-any-return]

    def handle_data(self, data: str) -> None:
        if self._script is not None:
            self.scripts[-1] += data
        else:
            self.text += data + "\n"


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Record a simulated flight with a low battery; return the recording and the true track."""
    path = tmp_path_factory.mktemp("flown") / "flight.tlog"
    parameters = {"BATT_FS_LOW_ACT": 2, "FENCE_ENABLE": 1, "FENCE_TYPE": 2, "FENCE_RADIUS": 150}

    async def fly() -> dict[str, Any]:
        async with open_flight("copter", connect=False, seed=3, parameters=parameters) as flight:
            async with aerokit.connect(flight.link, record=path) as vehicle:
                await vehicle.wait_ready()
                for name in parameters:
                    await vehicle.parameters.read(name)
                await vehicle.arm()
                await vehicle.take_off(20)
                await vehicle.go_to(vehicle.position.value.offset(north_m=60, east_m=30))
                flight.faults.set_battery(12)
                await anyio.sleep(60)
            return {"path": path, "track": flight.track, "journal": flight.journal}

    return run_virtual(fly())


@pytest.fixture(scope="module")
def page(flown: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> Page:
    target = tmp_path_factory.mktemp("report") / "flight.html"
    assert main(["report", str(flown["path"]), "-o", str(target)]) == 0
    return Page(target)


def test_recorded_flight_matches_simulation(flown: dict[str, Any]) -> None:
    flight, track = read_flight(flown["path"]), flown["track"]
    assert [change.name for change in flight.modes] == track.modes
    ((begin, end),) = flight.armed
    assert end - begin == pytest.approx(track.armed_s, abs=1.5)
    assert max(flight.track["altitude_relative_m"]) == pytest.approx(track.max_altitude_m, abs=0.5)
    (failsafe,) = failsafes(flight)
    assert (failsafe.kind, failsafe.acted) == ("battery", True)
    assert failsafe.reaction.startswith("mode GUIDED → RTL")
    status_text = next(text for text in flown["journal"].texts if "is low" in text.text)
    assert any(status_text.text in evidence.text for evidence in failsafe.evidence)
    assert any("67 m from home" in fact for fact in failsafe.context)
    assert any("BATT_FS_LOW_ACT = 2" in fact for fact in failsafe.context)


def test_report_has_summary_and_charts(page: Page, flown: dict[str, Any]) -> None:
    track = flown["track"]
    assert f"max height {track.max_altitude_m:.1f} m above home" in page.text
    assert "1 failsafe: Battery at" in page.text
    assert "GUIDED → RTL" in page.text
    traces = {trace["name"]: trace for trace in page.charts["map"]["traces"]}
    assert {"STABILIZE", "GUIDED", "RTL", "home", "failsafe", "fence"} <= traces.keys()
    assert (max(traces["fence"]["x"]), max(traces["fence"]["y"])) == pytest.approx((150, 150), abs=0.2)
    assert (traces["failsafe"]["x"][0], traces["failsafe"]["y"][0]) == pytest.approx((30, 60), abs=2)
    farthest = max((x**2 + y**2) ** 0.5 for x, y in zip(traces["RTL"]["x"], traces["RTL"]["y"], strict=True))
    assert farthest == pytest.approx(track.max_distance_m, abs=1)
    heights = page.charts["heights"]["traces"][-1]["y"]
    assert max(heights) == pytest.approx(track.max_altitude_m, abs=0.5)
    drawn = set(re.findall(r'data-chart="([^"]+)"', page.html))
    assert drawn == page.charts.keys()


def test_report_loads_nothing_and_allows_two_scripts(page: Page) -> None:
    assert all(address.startswith("#") for address in page.addresses)
    assert not {"link", "iframe", "object", "embed", "img", "base", "form"} & set(page.tags)
    assert not page.handlers
    policy = re.search(r'http-equiv="Content-Security-Policy" content="([^"]+)"', page.html)
    assert policy is not None
    assert "default-src 'none'" in policy[1]
    allowed = re.findall(r"'sha256-([^']+)'", policy[1])
    hashes = [base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in page.scripts]
    assert allowed == hashes
    assert "unsafe-inline" not in policy[1].split("script-src")[1].split(";")[0]


@pytest.fixture
def hostile_log(tmp_path: Path) -> Path:
    # On Linux, a name may also have bytes that are no text.
    path, encoder = tmp_path / f"{HOSTILE.replace('/', '')[:40]}\u202e\udcff.tlog", FrameEncoder(1, 1)
    with TlogWriter(path) as writer:
        for i in range(30):
            for message in (
                m.Heartbeat(2, 3, 81 + 128 * (i > 3), 0xFFFF_FFF0 + i // 10, 4, 3),
                *(m.Statustext(2, text[:50]) for text in HOSTILE_TEXTS),
                m.Statustext(1, f"Battery failsafe {HOSTILE}"[:50]),
                m.ParamValue("<b>&\"'</script>", float(i), 9, 1, 0),
                m.ParamValue("\u202e\x1b[1m'\"><i>", float(i), 9, 1, 0),
                m.ParamValue("FENCE_ENABLE", 1.0, 9, 1, 0),
                m.ParamValue("FENCE_TYPE", [2.0, math.nan, math.inf][i % 3], 9, 1, 0),
                m.ParamValue("FENCE_RADIUS", [math.inf, 1e38, -1.0][i % 3], 9, 1, 0),
                m.Attitude(i, math.inf, math.nan, -3e38, 0, 0, 0),
                m.Vibration(i, math.inf, 3e38, math.nan, 0, 0, 0),
                m.EkfStatusReport(0, math.nan, math.inf, -math.inf, 3e38, 0, 0),
                m.GlobalPositionInt(i, 470000000 + i, 80000000, 500000, 1000 * i, 0, 0, 0, 0),
                m.MissionItemInt(1, 1, 0, 3, 60000, 0, 1, 0, 0, 0, 0, 470000000, 80000000, float("nan")),
            ):
                writer.write(encoder.encode(message), 1_700_000_000 + i)
    return path


def test_hostile_log_text_is_escaped(hostile_log: Path, tmp_path: Path) -> None:
    target = tmp_path / "out.html"
    for arguments in ([str(hostile_log)], [str(hostile_log), str(hostile_log)]):
        assert main(["report", *arguments, "-o", str(target), "--force"]) == 0
        page = Page(target)
        assert HOSTILE[:30] in page.text
        assert page.tags.count("script") == 3
        assert not page.handlers
        assert not {"img", "b", "i", "svg"} & set(page.tags)
        unprintable = {each for each in page.text if not each.isprintable() and each != "\n"}
        assert not unprintable
        texts = json.dumps(page.data)
        assert "alert" not in texts
        assert "</" not in target.read_text().split('id="charts">')[1].split("</script>")[0]
    assert '"charts":{}' not in target.read_text()


def test_missing_data_is_stated(tmp_path: Path) -> None:
    path, encoder, target = tmp_path / "bare.tlog", FrameEncoder(1, 1), tmp_path / "bare.html"
    with TlogWriter(path) as writer:
        for i in range(5):
            writer.write(encoder.encode(m.Heartbeat(2, 3, 81, 0, 3, 3)), 1_700_000_000 + i)
    assert main(["report", str(path), "-o", str(target)]) == 0
    page = Page(target)
    assert "No arming was logged in 4 s." in page.text
    for missing in (
        *(
            "The log contains no positions.",
            "The log contains no battery data.",
            "The log contains no vibration levels.",
        ),
        *("The log contains no attitude.", "The log contains no parameters.", "The log contains no texts."),
        *("The log contains no estimator data.", "The log contains no GNSS data."),
    ):
        assert missing in page.text
    assert page.charts.keys() == {"lost", "received"}


def test_two_flights_are_compared(flown: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target, other = tmp_path / "both.html", RECORDINGS / "px4-quad.tlog"
    assert main(["report", str(flown["path"]), str(other), "-o", str(target), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["type"] == "report"
    highest = [statistics["max_height_m"] for statistics in result["statistics"]]
    page = Page(target)
    assert f"{highest[0]:.1f}\n{highest[1]:.1f}\n{highest[1] - highest[0]:+.1f}" in page.text
    assert [trace["name"] for trace in page.charts["both-height"]["traces"]] == ["A", "B"]
    east = [x for trace in page.charts["maps"]["traces"] for x in trace["x"] if x is not None]
    least, greatest = page.charts["maps"]["layout"]["xaxis"]["range"]
    assert (least < min(east), greatest > max(east)) == (True, True)
    assert "COM_LOW_BAT_ACT" in page.text
    assert "missing" in page.text
    assert "Failsafes of A" in page.text


def test_existing_report_needs_force(flown: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = Path(shutil.copy(flown["path"], tmp_path))
    target = log.with_suffix(".html")
    target.write_text("mine")
    assert main(["report", str(log)]) == 6
    assert "--force" in capsys.readouterr().err
    assert target.read_text() == "mine"
    assert main(["report", str(log), "-o", str(log), "--force"]) == 2
    assert main(["report", str(tmp_path / "none.tlog")]) == 6
    assert main(["report", str(log), "--force"]) == 0
    assert target.read_text().startswith("<!doctype html>")
    assert sorted(each.name for each in tmp_path.iterdir()) == ["flight.html", "flight.tlog"]


def test_report_opens_browser_with_option_only(
    flown: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    target = tmp_path / "a b.html"
    assert main(["report", str(flown["path"]), "-o", str(target)]) == 0
    assert opened == []
    assert main(["report", str(flown["path"]), "-o", str(target), "--force", "--open"]) == 0
    assert opened == [target.as_uri()]


def test_downsampling_keeps_peaks_and_gaps() -> None:
    columns = TimeSeries("value")
    for i in range(100_000):
        columns.add(
            i / 10,
            1000.0 if i == 54_321 else -7.0 if i == 77_777 else float("nan") if 30_000 < i < 40_000 else i % 3,
        )
    times, values = drawn_points(columns, "value")
    assert len(times) <= 2100
    assert values[times.index(5432.1)] == 1000.0
    assert min(value for value in values if value is not None) == -7.0
    assert None in values
    assert all(value is None for time, value in zip(times, values, strict=True) if 3001 < time < 3999)
    assert rows_to_draw(columns["value"][:3]) == [0, 1, 2]


@pytest.mark.parametrize(
    ("result", "expected"),
    [
        (clock_text(187.46), "3:07.5"),
        (clock_text(59.96), "1:00.0"),
        (duration_text(47.2), "47 s"),
        (duration_text(725), "12 min 5 s"),
        (duration_text(3600 + 180), "1 h 3 min"),
        (distance_text(9.94), "9.9 m"),
        (distance_text(3440), "3.4 km"),
    ],
)
def test_numbers_are_formatted_for_reading(result: str, expected: str) -> None:
    assert result == expected


@pytest.fixture
def chromium() -> str:
    found = shutil.which("chromium") or shutil.which("chromium-browser")
    if found is None:
        pytest.skip("no Chromium here")
    return found


def browse(chromium: str, target: Path, *options: str) -> str:
    """Open a page without a network, and return what the browser prints."""
    return subprocess.run(
        [
            *(chromium, "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run"),
            *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
            *(f"--user-data-dir={target.parent / 'browser'}", "--host-resolver-rules=MAP * ~NOTFOUND"),
            *("--virtual-time-budget=4000", "--window-size=900,7000", *options, target.as_uri()),
        ],
        capture_output=True,
        text=True,
        timeout=100,
        check=True,
    ).stdout


@pytest.mark.exhaustive
def test_offline_browser_draws_all_charts(page: Page, chromium: str, tmp_path: Path) -> None:
    target = tmp_path / "page.html"
    target.write_text(page.html, encoding="utf-8")
    dumped = browse(chromium, target, "--dump-dom")
    assert dumped.count('class="main-svg"') >= len(page.charts)
    titles = {title.lower() for title in re.findall('data-title="([^"]*)"', dumped)}  # older Plotly writes "png"
    assert titles == {"download plot as a png", "pan", "reset axes", "zoom"}, "no button uploads the chart"
    assert len(re.findall(r'class="chart[^"]* js-plotly-plot"', dumped)) == len(page.charts)


ZOOM = """
setTimeout(function () {
  const places = Array.from(document.querySelectorAll("[data-chart]"));
  const range = (place) => place.dataset.chart + "=" + place.layout.xaxis.range.map(Math.round);
  Plotly.relayout(places[3], { "xaxis.range[0]": 20, "xaxis.range[1]": 30 }).then(function () {
    setTimeout(function () { document.body.dataset.ranges = places.map(range).join(" "); }, 500);
  });
}, 1500);
"""


@pytest.mark.exhaustive
def test_timelines_zoom_together_in_browser(page: Page, chromium: str, tmp_path: Path) -> None:
    target = tmp_path / "page.html"
    html = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", page.html)
    target.write_text(html.replace("</body>", f"<script>{ZOOM}</script></body>"), encoding="utf-8")
    dumped = browse(chromium, target, "--dump-dom")
    found = re.search(r'data-ranges="([^"]*)"', dumped)
    assert found is not None
    ranges = dict(each.split("=") for each in found[1].split())
    assert ranges.pop("map") != "20,30"
    assert len(ranges) == len(page.charts) - 1 > 10
    assert set(ranges.values()) == {"20,30"}


@pytest.mark.exhaustive
def test_printed_report_has_few_pages(chromium: str, tmp_path: Path) -> None:
    """Also for a long log, because content that cannot be read on paper is not printed."""
    flight = read_flight(RECORDINGS / "ardupilot-copter.tlog")
    flight.texts = [LoggedText(i / 10, 6, f"text {i}") for i in range(1000)]
    flight.modes = [ModeChange(i / 3, f"MODE{i % 5}") for i in range(300)]
    flight.parameters = {f"PARAMETER_{i}": float(i) for i in range(1349)}
    flight.failsafe_evidence = [FailsafeEvidence(10.0 * i, "battery", f"low {i}") for i in range(500)]
    flight.armed, flight.ends_at = [(0.0, 5000.0)], flight.begins_at + 5000.0
    target = tmp_path / "page.html"
    target.write_text(report_html(flight), encoding="utf-8")
    browse(chromium, target, f"--print-to-pdf={tmp_path / 'page.pdf'}")
    pages = len(re.findall(rb"/Type\s*/Page\b", (tmp_path / "page.pdf").read_bytes()))
    assert 2 <= pages <= 8


def test_unknown_log_suffix_raises_first(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "px4.html"
    page.write_text("mine")
    for more in ([], ["--force"]):
        assert main(["report", str(page), *more]) == 6
        assert "px4.html is not a flight log; supported suffixes: .tlog, .bin, .ulg" in capsys.readouterr().err
    assert page.read_text() == "mine"


def test_summary_of_unarmed_log_mentions_no_flight(tmp_path: Path) -> None:
    flight = FlightLog(tmp_path / "ground.bin", ends_at=4.0, autopilot="ArduPilot", home=Position(47.0, 8.0, 500.0))
    flight.add_mode(0.0, "STABILIZE")
    flight.mission = [Waypoint(0, 16, 47.0, 8.0, 500.0, 0)]
    flight.receiver(0).add(0.0, 3, 10, 0.8, 1.0)
    flight.receiver(0).add(1.0, 6, 10, 0.8, 1.0)
    flight.receiver(0).add(2.0, 42, 10, 0.8, 1.0)
    flight.texts = [LoggedText(1.0, None, "hello"), LoggedText(2.0, 3, "bad")]
    for east in range(3):
        flight.track.add(float(east), 47.0, 8.0 + east * 1e-4, 500.0, 0.0)
    target = tmp_path / "ground.html"
    target.write_text(report_html(flight), encoding="utf-8")
    page = Page(target)
    assert "No arming was logged in 4 s." in page.text
    assert "\nIn STABILIZE (4 s)." in page.text
    assert "Flown in" not in page.text
    assert "No mission: the only item is home" in page.text
    assert "0:01.0\n—\nhello" in page.text
    assert "0:02.0\nerror\nbad" in page.text
    axis = page.charts["gps-fix_type"]["layout"]["yaxis"]
    assert (axis["tickvals"], axis["ticktext"]) == ([3, 6, 42], ["3D", "RTK fixed", "42"])
    least, greatest = page.charts["map"]["layout"]["xaxis"]["range"]
    assert least <= -1
    assert 16.1 < greatest < 17  # 15.2 m of track, and 1 m


@pytest.mark.parametrize(("autopilot", "labels"), [("ArduPilot", ["home", "0", "1"]), ("PX4", ["0", "1", "2"])])
def test_mission_table_numbers_items_and_omits_unknown_altitudes(
    autopilot: str, labels: list[str], tmp_path: Path
) -> None:
    nan = math.nan
    flight = FlightLog(tmp_path / "flight.tlog", ends_at=4.0, autopilot=autopilot, home=Position(47.0, 8.0, 500.0))
    flight.track.add(0.0, 47.0, 8.0, 500.0, 0.0)
    flight.mission = [
        Waypoint(0, MavCmd.NAV_WAYPOINT, 47.0, 8.0, 0.0, MavFrame.GLOBAL),
        Waypoint(1, MavCmd.NAV_TAKEOFF, nan, nan, 10.0, MavFrame.GLOBAL_RELATIVE_ALT),
        Waypoint(2, MavCmd.NAV_RETURN_TO_LAUNCH, nan, nan, 0.0, MavFrame.MISSION),
    ]
    target = tmp_path / "flight.html"
    target.write_text(report_html(flight), encoding="utf-8")
    page = Page(target)
    take_off, back = f"{labels[1]}\nNAV_TAKEOFF\n10.0 m", f"{labels[2]}\nNAV_RETURN_TO_LAUNCH\n—"
    assert f"{labels[0]}\nNAV_WAYPOINT\n47.000000, 8.000000\n0.0 m" in page.text
    assert take_off in page.text
    assert back in page.text
    names = [trace["name"] for trace in page.charts["map"]["traces"]]
    assert ("mission" in names) == (autopilot == "PX4"), "home is not an item on the map"


def test_link_section_explains_lost_messages(tmp_path: Path, page: Page) -> None:
    flight = FlightLog(tmp_path / "px4.ulg", ends_at=4.0, autopilot="PX4")
    flight.link.add(0.0, 1.0, float("nan"))
    target = tmp_path / "px4.html"
    target.write_text(report_html(flight), encoding="utf-8")
    explanation = "Messages that the autopilot did not receive, by its own count"
    assert explanation in Page(target).text
    assert explanation not in page.text


def test_modes_of_less_than_half_a_second_are_not_listed() -> None:
    flight = FlightLog(Path("x.tlog"), ends_at=60.0, armed=[(10.0, 50.0)])
    flight.modes = [ModeChange(0.0, "STABILIZE"), ModeChange(10.3, "AUTO"), ModeChange(40.0, "RTL")]
    sentences = "\n".join(summary(flight, statistics_of(flight)))
    assert "Flown in AUTO (30 s), RTL (10 s)." in sentences


def test_way_between_armed_spans_is_not_flown() -> None:
    flight = FlightLog(Path("x.tlog"), ends_at=60.0, armed=[(0.0, 10.0), (30.0, 40.0)], home=Position(47.0, 8.0))
    places = {0.0: 47.0, 10.0: 47.0, 20.0: math.nan, 30.0: math.nan, 35.0: 47.01, 40.0: 47.01}
    for time_s, latitude in places.items():
        flight.track.add(time_s, latitude, 8.0, math.nan, math.nan)
    assert statistics_of(flight).distance_m == 0.0


def test_context_of_failsafe_omits_unknown_satellite_values() -> None:
    flight = FlightLog(Path("x.tlog"), ends_at=60.0, armed=[(0.0, 60.0)])
    flight.receiver(0).add(19.0, 3.0, math.nan, math.nan, math.nan)
    flight.failsafe_evidence = [FailsafeEvidence(20.0, "gps", "text: GPS Glitch")]
    (failsafe,) = failsafes(flight)
    assert "receiver 1: fix type 3" in failsafe.context


def test_reported_action_without_mode_change_is_reaction() -> None:
    flight = FlightLog(Path("x.tlog"), ends_at=60.0, armed=[(0.0, 60.0)])
    flight.failsafe_evidence = [FailsafeEvidence(20.0, "battery", "text: Failsafe activated", is_action=True)]
    (failsafe,) = failsafes(flight)
    assert (failsafe.acted, failsafe.reaction) == (True, "the autopilot reported an action")
