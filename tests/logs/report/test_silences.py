"""Silences of the vehicle, ends in the air and sped-up simulations in recordings, as the report describes them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import anyio
import pytest

import aerokit
from aerokit import messages as m
from aerokit.logs.flights import FlightLog, failsafes, read_flight
from aerokit.logs.flights.flight import FailsafeEvidence, Silence
from aerokit.logs.report.sections import failsafe_section
from aerokit.logs.report.silences import ground_station_failsafe
from aerokit.logs.report.statistics import statistics_of, summary
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.message import Message
from aerokit.mavlink.tlog import TlogWriter
from aerokit.testing import open_flight, run_virtual


def summary_of(flight: FlightLog) -> str:
    return "\n".join(summary(flight, statistics_of(flight)))


def recorded(path: Path, act: Callable[[Any, Any], Any], kind: str = "copter", **options: Any) -> FlightLog:
    """Record a flight at 20 m, in which ``act(flight, vehicle)`` is awaited."""

    async def fly() -> None:
        async with (
            open_flight(kind, connect=False, seed=1, **options) as flight,
            aerokit.connect(flight.link, record=path) as vehicle,
        ):
            await vehicle.wait_ready()
            await vehicle.arm()
            await vehicle.take_off(20)
            await act(flight, vehicle)

    run_virtual(fly())
    return read_flight(path)


@pytest.fixture(scope="module")
def silent(tmp_path_factory: pytest.TempPathFactory) -> FlightLog:
    """A vehicle that is silent for the last ten seconds of the recording."""

    async def fall_silent(flight: Any, vehicle: Any) -> None:
        await vehicle.parameters.read("FS_GCS_ENABLE")
        await anyio.sleep(5)
        flight.faults.go_silent()
        await anyio.sleep(10.5)

    parameters = {"FS_GCS_ENABLE": 5}
    return recorded(tmp_path_factory.mktemp("silent") / "silent.tlog", fall_silent, parameters=parameters)


def test_silence_at_the_end_is_in_summary(silent: FlightLog) -> None:
    (silence,) = silent.silences
    assert silence.is_recorded
    assert silence.ends_s == silent.duration_s
    assert silence.ends_s - silence.begins_s == pytest.approx(10, abs=1.1)
    text = summary_of(silent)
    assert text.startswith("Nothing was received from the vehicle for ")
    assert "on, until the log ends; it was last 20.0 m above home in GUIDED." in text.splitlines()[0]
    assert "If the vehicle also lost the ground station, it reacts as configured: FS_GCS_ENABLE = 5 (lands)" in text
    assert "20.0 m above home in GUIDED, " in text
    assert "s before the end: the rest of the flight, and with it a landing or a crash, was not recorded" in text


def test_loss_curve_of_silence_reaches_end_of_log(silent: FlightLog) -> None:
    (silence,), link = silent.silences, silent.link
    rows = [row for row, time_s in enumerate(link.times) if time_s > silence.begins_s + 1]
    assert [link["lost_percent"][row] for row in rows] == [100.0] * len(rows)
    assert link.times[-1] == pytest.approx(silent.duration_s)
    share = 100 * (silence.ends_s - silence.begins_s) / (silent.armed[0][1] - silent.armed[0][0])
    assert statistics_of(silent).lost_percent == pytest.approx(share, abs=4)


def test_short_silence_names_state_after_it(tmp_path: Path) -> None:
    async def pause(flight: Any, vehicle: Any) -> None:
        flight.faults.go_silent(6)
        await anyio.sleep(11)
        await vehicle.land()

    flight = recorded(tmp_path / "pause.tlog", pause)
    first, second, *_ = summary_of(flight).splitlines()
    assert first.startswith("Nothing was received from the vehicle for 6 s from ")
    assert first.endswith(" Afterwards it was 20.0 m above home in GUIDED.")
    assert second.endswith(
        "because the log does not contain FS_GCS_ENABLE; look at FS_GCS_ENABLE, FS_GCS_TIMEOUT, FS_OPTIONS."
    )


def test_pauses_of_recording_are_no_certain_silences() -> None:
    flight = FlightLog(Path("pause.tlog"), ends_at=60.0, armed=[(0.0, 60.0)])
    flight.silences = [Silence(5.0, 9.0, False), Silence(10.0, 20.0, False)]
    assert summary_of(flight).startswith(
        "The log contains no message of the vehicle for 10 s from 0:10.0 on, and in 1 shorter gap: the vehicle was"
        " silent, the recording paused, or its clock was set forward."
    )
    assert "lost ground station" not in summary_of(flight)


def test_silence_of_disarmed_vehicle_is_not_mentioned() -> None:
    flight = FlightLog(Path("ground.tlog"), ends_at=60.0, armed=[(30.0, 60.0)])
    flight.silences = [Silence(10.0, 20.0, True)]
    assert "Nothing was received" not in summary_of(flight)
    flight.silences = [Silence(30.0 + at, 34.0 + at, True) for at in (0.0, 5.0, 10.0, 15.0, 20.0)]
    assert summary_of(flight).count("Nothing was received") == 3
    assert "The log has 2 more silences of the vehicle." in summary_of(flight)


def test_recording_without_silence_mentions_none(tmp_path: Path) -> None:
    async def land(flight: Any, vehicle: Any) -> None:
        await vehicle.land()

    flight = recorded(tmp_path / "land.tlog", land)
    assert flight.silences == []
    assert statistics_of(flight).lost_percent == 0
    assert "Nothing was received" not in summary_of(flight)


@pytest.mark.parametrize(
    ("vehicle", "name", "value", "text"),
    [
        ("PX4 1.15", "NAV_DLL_ACT", 2, "NAV_DLL_ACT = 2 (returns to launch)."),
        ("ArduPlane 4.6", "FS_GCS_ENABL", 1, "FS_GCS_ENABL = 1."),
        ("ArduPlane 4.6", "FS_GCS_ENABL", 0, "FS_GCS_ENABL = 0 (continues: the failsafe is off)."),
        ("ArduPlane 4.6", "FS_LONG_ACTN", 1, "look at FS_GCS_ENABL, FS_LONG_ACTN, FS_LONG_TIMEOUT."),
        ("Autopilot", "FS_GCS_ENABLE", 1, "How the vehicle reacts to a lost ground station is unknown."),
    ],
)
def test_reaction_to_lost_ground_station_is_of_firmware(vehicle: str, name: str, value: float, text: str) -> None:
    flight = FlightLog(Path("log.tlog"), vehicle=vehicle, parameters={name: value})
    assert ground_station_failsafe(flight, 0.0).endswith(text)


def test_failsafe_without_reaction_names_parameters_to_read() -> None:
    flight = FlightLog(Path("log.tlog"), autopilot="ArduPilot", ends_at=60.0, armed=[(0.0, 60.0)])
    flight.failsafe_evidence = [FailsafeEvidence(at, "battery", "text: Battery 1 Failsafe") for at in (30.0, 50.0)]
    text = summary_of(flight)
    assert "No failsafe was reported" not in text
    assert "2 warnings without a recorded reaction: Battery at 0:30.0 (text: Battery 1 Failsafe); Battery at" in text
    assert "parameters that decide on the reaction: BATT_FS_LOW_ACT, BATT_FS_CRT_ACT." in text
    first, second = (" ".join(failsafe.context) for failsafe in failsafes(flight))
    assert "parameters to look at, which the log does not contain: BATT_LOW_VOLT, " in first
    assert "parameters" not in second
    assert "BAT_LOW_THR" not in text
    assert "the log contains no parameters" in failsafe_section(flight).explanation
    flight.parameters["BATT_FS_LOW_ACT"] = 0.0
    assert "The log does not contain" not in summary_of(flight)
    assert failsafe_section(flight).explanation.endswith("and the parameters that configure it.")


def test_old_height_says_nothing_about_end_of_log(tmp_path: Path) -> None:
    """The vehicle was on the ground a minute before the end, and the log has no later position."""
    path, encoder = tmp_path / "log.tlog", FrameEncoder(1, 1)
    with TlogWriter(path) as writer:
        place = m.GlobalPositionInt(0, 470_000_000, 80_000_000, 500_000, 0, 0, 0, 50, 0)
        writer.write(encoder.encode(place), 1.7e9)
        for second in range(60):
            writer.write(encoder.encode(m.Heartbeat(2, 3, 209, 4, 4, 3)), 1.7e9 + second)
    assert "vehicle is armed in GUIDED: the rest of the flight" in " ".join(read_flight(path).notes)


@pytest.mark.exhaustive
def test_log_of_vehicle_on_ground_says_nothing_about_rest(tmp_path: Path) -> None:
    async def land(flight: Any, vehicle: Any) -> None:
        await vehicle.land()

    flight = recorded(tmp_path / "land.tlog", land, kind="px4")
    assert not [note for note in flight.notes if "was not recorded" in note]


def test_sped_up_recording_has_simulated_times(tmp_path: Path) -> None:
    """A fall of 3 s at 20 times the speed, recorded in 0.15 s."""
    path, encoder = tmp_path / "fast.tlog", FrameEncoder(1, 1)
    with path.open("wb") as file:
        writer = TlogWriter(file)
        for step in range(600):
            seconds = step / 10
            height_m = 40.0 if seconds < 30 else max(0.0, 40.0 - 4.9 * (seconds - 30) ** 2)
            sink_m_s = 9.8 * (seconds - 30) if 0.0 < height_m < 40.0 else 0.0
            place = (int(seconds * 1000), 470000000, 80000000, 0, int(height_m * 1000), 0, 0, int(sink_m_s * 100), 0)
            messages: list[Message] = [m.GlobalPositionInt(*place)]
            messages += [m.Heartbeat(2, 3, 217, 4, 4, 3)] if step % 10 == 0 else []
            for message in messages:
                writer.write(encoder.encode(message), 1_700_000_000 + seconds / 20)
    flight = read_flight(path)
    assert flight.duration_s == pytest.approx(60, abs=0.5)
    assert flight.speed == pytest.approx(20, rel=0.01)
    text = summary_of(flight)
    assert text.startswith("Fall: from 40.0 m, 27.")
    assert "at 0:32.9 (descent since 0:30." in text
    assert "60 s armed" in text.replace("1 min armed", "60 s armed")
    assert "all times and durations in this report are simulated; the recording took 3 s" in text


def heartbeats(path: Path, rows: list[tuple[float, int]], armed: bool = True) -> FlightLog:
    """Write a log of heartbeats at these times: of the vehicle (1) and of a ground station (255)."""
    vehicle, station = FrameEncoder(1, 1), FrameEncoder(255, 190)
    with TlogWriter(path) as writer:
        for time_s, system_id in rows:
            raw = (
                vehicle.encode(m.Heartbeat(2, 3, 209 if armed else 81, 4, 4, 3))
                if system_id == 1
                else station.encode(m.Heartbeat(6, 8, 0, 0, 4, 3))
            )
            writer.write(raw, 1.7e9 + time_s)
    return read_flight(path)


@pytest.mark.parametrize(
    ("other_times", "is_recorded"), [([63.5], False), ([6.0, 7.0, 8.0, 63.5], True), (range(5, 64), True)]
)
def test_silence_is_recorded_only_while_others_are_received(
    other_times: list[float], is_recorded: bool, tmp_path: Path
) -> None:
    """A recording that continues after a pause may begin with another system's message."""
    rows = [(float(second), 1) for second in (*range(5), *range(64, 70))]
    rows += [(float(time_s), 255) for time_s in other_times]
    (silence,) = heartbeats(tmp_path / "log.tlog", sorted(rows)).silences
    assert silence.is_recorded is is_recorded


def test_clock_set_back_shortens_no_times(tmp_path: Path) -> None:
    times = [*range(60), *range(30, 50)]
    flight = heartbeats(tmp_path / "log.tlog", [(float(time_s), 1) for time_s in times])
    ((begin_s, end_s),) = flight.armed
    assert (begin_s, end_s) == pytest.approx((0.0, 78.0), abs=1.0)
    assert flight.duration_s == pytest.approx(78.0, abs=1.0)
    assert "the recording's clock was set back by 29 s, 59 s after the log began" in " ".join(flight.notes)


def test_clippings_are_counted_across_reboot() -> None:
    flight = FlightLog(Path("log.tlog"), ends_at=60.0, armed=[(0.0, 60.0)])
    for time_s, clips in enumerate([40.0, 42.0, 0.0, 0.0, 3.0]):
        flight.vibration.add(time_s, 1.0, 1.0, 1.0, clips)
    assert statistics_of(flight).clips == 5


def test_sleep_of_recording_computer_is_no_simulation(tmp_path: Path) -> None:
    """aerokit's clock stands still while the computer sleeps, the vehicle's does not."""
    path, encoder = tmp_path / "log.tlog", FrameEncoder(1, 1)
    with TlogWriter(path) as writer:
        for second in range(120):
            boot_s = second + (600 if second >= 60 else 0)
            writer.write(encoder.encode(m.Heartbeat(2, 3, 209, 4, 4, 3)), 1.7e9 + second)
            writer.write(encoder.encode(m.Attitude(boot_s * 1000, 0, 0, 0, 0, 0, 0)), 1.7e9 + second)
    flight = read_flight(path)
    assert flight.speed == 1.0
    assert "by the vehicle's clock, 600 s are missing in this recording" in " ".join(flight.notes)


@pytest.mark.parametrize("time_s", [2e9, -50_000.0])
def test_one_record_of_another_time_changes_no_times(time_s: float, tmp_path: Path) -> None:
    times = [*range(29), time_s, *range(30, 60)]
    flight = heartbeats(tmp_path / "log.tlog", [(float(second), 1) for second in times])
    assert flight.duration_s == pytest.approx(59.0, abs=0.1)
    assert flight.armed == [(0.0, flight.duration_s)]
    assert "1 messages are damaged and were skipped" in flight.notes


def test_clock_set_by_hours_is_no_damage(tmp_path: Path) -> None:
    """A clock that was set, and a long pause, have several records of the new time."""
    for name, later, duration_s in (("forward", 7200, 7290.0), ("back", -7200, 108.0)):
        times = [*range(29), *range(later, later + 100, 10)]
        flight = heartbeats(tmp_path / f"{name}.tlog", [(float(time_s), 1) for time_s in times])
        assert flight.duration_s == pytest.approx(duration_s, abs=0.1)
        assert not any("damaged" in note for note in flight.notes)


def test_pauses_before_first_message_do_not_count_as_silence(tmp_path: Path) -> None:
    rows = [(float(time_s), 255) for time_s in (0, 20, 40, *range(60, 75))]
    rows += [(float(time_s), 1) for time_s in (*range(50, 60), *range(75, 80))]
    (silence,) = heartbeats(tmp_path / "log.tlog", sorted(rows)).silences
    assert silence.is_recorded
