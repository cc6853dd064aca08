"""Falls and hard landings in logs, and descents that are neither."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path

import anyio
import pytest

import aerokit
from aerokit.apps.cli import main
from aerokit.logs.flights import read_flight
from aerokit.logs.flights.failsafes import evidence_in_texts
from aerokit.logs.flights.falls import falls
from aerokit.logs.flights.flight import FlightLog, LoggedText
from aerokit.logs.report.statistics import fall_measurements, findings
from aerokit.testing import open_flight, run_virtual

ARMED_S, DISARMED_S = 1.0, 40.0


def descending(
    sink_m_s: Callable[[float], float],
    *,
    end_s: float = 60.0,
    ground_m: float = 0.0,
    texts: tuple[str, ...] = (),
    disarmed_s: float = DISARMED_S,
) -> FlightLog:
    """Return a flight that hovers at 30 m, sinks from second 10 on with ``sink_m_s(height)``, and stops at
    ``ground_m``.
    """
    flight = FlightLog(Path("flight.tlog"), ends_at=end_s, armed=[(ARMED_S, min(disarmed_s, end_s))])
    height_m = 30.0
    for step in range(int(end_s * 10)):
        is_above = height_m > ground_m
        down_m_s = sink_m_s(height_m) if step >= 100 and is_above else 0.0
        flight.track.add(step / 10, 47.0, 8.0, math.nan, height_m)
        flight.velocity.add(step / 10, 0.0, 0.0, down_m_s)
        height_m = max(height_m - down_m_s / 10, ground_m) if is_above else height_m
    flight.texts += [LoggedText(12.0, 2, text) for text in texts]
    return flight


def free_fall(height_m: float) -> float:
    return math.sqrt(2 * 9.81 * (30.1 - height_m)) + 0.5


def test_free_fall_is_named_with_height_and_speed() -> None:
    (fall,) = falls(descending(free_fall))
    assert (fall.title, fall.has_impact, fall.reasons) == ("Fall", True, ())
    assert fall.height_m == pytest.approx(30.0, abs=0.5)
    assert fall.sink_m_s == pytest.approx(24.3, abs=1.5)
    assert fall.begins_s == pytest.approx(10.0, abs=0.2)


@pytest.mark.parametrize(
    "flight",
    [
        descending(lambda height_m: 1.5),
        descending(lambda height_m: 4.5 if height_m > 3 else 0.6),
        descending(lambda height_m: 8.0, ground_m=10.0, end_s=20.0),  # the log ends in a hover
    ],
    ids=["landing", "fast descent, slow landing", "stop in the air"],
)
def test_controlled_descent_is_no_fall(flight: FlightLog) -> None:
    assert falls(flight) == []


def test_stop_before_landing_is_no_fall() -> None:
    flight = descending(lambda height_m: 8.0, ground_m=10.0)
    for row, time_s in enumerate(flight.track.times):
        if time_s > 30:  # lands afterwards, before it is disarmed
            flight.track["altitude_relative_m"][row] = max(10.0 - (time_s - 30), 0.0)
    assert falls(flight) == []


def test_touchdown_below_six_m_s_is_hard_landing() -> None:
    (fall,) = falls(descending(lambda height_m: 4.5))
    assert (fall.title, fall.sink_m_s) == ("Hard landing", 4.5)


def test_fall_of_vehicle_that_stays_armed_is_found() -> None:
    (fall,) = falls(descending(free_fall, end_s=600.0, disarmed_s=590.0))
    assert (fall.title, fall.has_impact) == ("Fall", True)
    assert falls(descending(free_fall, end_s=600.0, disarmed_s=600.0)) == [fall]


def test_measurements_of_fall_are_those_of_the_descent() -> None:
    flight = descending(free_fall)
    (fall,) = falls(flight)
    assert fall_measurements(flight, fall) == []
    for step in range(600):
        is_falling = fall.begins_s <= step / 10 < fall.time_s - 0.1
        flight.air.add(step / 10, 0.0, 100.0 if is_falling else 40.0)
        flight.attitude.add(step / 10, 62.0 if is_falling else 0.0, 0.0, 0.0)
        flight.attitude_target.add(step / 10, 0.0, 0.0, 0.0)
    assert fall_measurements(flight, fall) == [
        "throttle 100 % (before: 40 %), so look at motors, propellers and battery",
        "tilt up to 62°",
        "attitude up to 62° off its set-point, so look at the attitude charts",
    ]
    assert findings(flight)[1].startswith("Measured in the descent: throttle 100 % (before: 40 %), so")


def test_measurements_of_fall_without_power_name_the_current() -> None:
    flight = descending(free_fall)
    (fall,) = falls(flight)
    for step in range(60):
        is_falling = fall.begins_s <= step / 2 < fall.time_s
        flight.air.add(step / 2, 0.0, (9.0 if step % 2 else 1.0) if is_falling else 36.0)
        flight.battery(0).add(step / 2, 12.0, 1.0 if is_falling else 28.0, math.nan, math.nan)
        flight.attitude.add(step / 2, 3.0, 0.0, 0.0)
        flight.attitude_target.add(step / 2, math.nan, math.nan, 0.0)
    assert fall_measurements(flight, fall) == [
        "throttle 1 to 9 % (before: 36 %)",
        "tilt up to 3°",
        "battery current 1 A (before: 28 A), so look at what stopped the motors: ESCs, their supply, a command",
    ]


def falling_with_outputs(*pulses_us: float) -> list[str]:
    """Return the measurements of a fall with these motor outputs, and a camera's servo that does not move."""
    flight = descending(free_fall)
    (fall,) = falls(flight)
    unused = [math.nan] * (7 - len(pulses_us))
    for step in range(120):
        time_s = step / 2
        now_us = pulses_us if fall.begins_s <= time_s < fall.time_s else (1500.0,) * len(pulses_us)
        motors = (1000.0,) * len(pulses_us) if time_s < ARMED_S else now_us
        flight.outputs.add(time_s, *motors, 1900.0, *unused)
    return fall_measurements(flight, fall)


def test_measurements_of_fall_have_motor_outputs() -> None:
    assert falling_with_outputs(1100.0, 1150.0, 1100.0, 1120.0) == ["motor outputs 1100 to 1150 µs (before: 1500 µs)"]


def test_unequal_motor_outputs_name_the_motor() -> None:
    assert falling_with_outputs(1500.0, 1950.0, 1500.0, 1050.0) == [
        "unequal motor outputs 1050 to 1950 µs (before: 1500 µs): output 2 at 1950 µs, output 4 at 1050 µs, so look at"
        " the motor of output 2"
    ]


@pytest.mark.exhaustive
def test_measurements_of_px4_fall_name_the_motors(tmp_path: Path) -> None:
    log = tmp_path / "crash.tlog"

    async def crash() -> None:
        async with (
            open_flight("px4", connect=False, seed=1) as flight,
            aerokit.connect(flight.link, record=log) as vehicle,
        ):
            await vehicle.wait_ready()
            await vehicle.arm()
            await vehicle.take_off(30)
            await anyio.sleep(6)
            flight.faults.fail_motor()
            await anyio.sleep(20)

    run_virtual(crash())
    first, second, *_ = findings(read_flight(log))
    assert first.startswith("Fall: from 30.0 m, 17.0 m/s")
    assert ", so look at what stopped the motors: ESCs, their supply, a command; tilt up to " in second
    assert re.search(r"motor outputs 1\d\d\d to 1\d\d\d µs \(before: 1\d\d\d µs\)", second)


def test_hover_for_minutes_after_fast_descent_is_no_fall() -> None:
    assert falls(descending(lambda height_m: 8.0, ground_m=10.0, end_s=600.0, disarmed_s=590.0)) == []


def test_crash_text_of_firmware_makes_hard_landing_a_fall() -> None:
    (fall,) = falls(descending(lambda height_m: 4.5, texts=("Crash: Disarming: AngErr=82>30, Accel=1.2<3.0",)))
    assert fall.title == "Fall"
    assert fall.reasons == ("text: Crash: Disarming: AngErr=82>30, Accel=1.2<3.0",)


def test_fall_to_the_end_of_the_log_has_no_impact() -> None:
    (fall,) = falls(descending(free_fall, end_s=12.2))
    assert (fall.title, fall.has_impact) == ("Fall", False)
    assert fall.time_s == pytest.approx(12.1)


def test_log_without_sink_rates_has_no_falls() -> None:
    flight = descending(free_fall)
    flight.velocity = FlightLog(flight.path).velocity
    assert falls(flight) == []


@pytest.mark.sampled(2)
@pytest.mark.parametrize("is_disarmed", [False, True], ids=["motor", "disarmed"])
def test_report_of_crash_begins_and_ends_with_fall(
    is_disarmed: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "crash.tlog"

    async def crash() -> None:
        async with (
            open_flight("copter", connect=False, seed=1) as flight,
            aerokit.connect(flight.link, record=log) as vehicle,
        ):
            await vehicle.wait_ready()
            await vehicle.arm()
            await vehicle.take_off(30)
            if is_disarmed:
                await vehicle.disarm(force=True)
            else:
                flight.faults.fail_motor()
            await anyio.sleep(20)

    run_virtual(crash())
    assert main(["report", str(log)]) == 0
    first, *_, last = capsys.readouterr().out.splitlines()
    assert first.startswith(("Fall: from 28.7 m, 16.8 m/s at the ground", "Fall: from 28.8 m, 16.8 m/s at the ground"))
    assert ("disarmed in the air" in first) is is_disarmed
    assert last.endswith(f"; {first[:-1]}")
    html = log.with_suffix(".html").read_text(encoding="utf-8")
    assert f'<p class="finding">{first}</p>' in html
    assert "No failsafe was reported" in html
    assert "max ground speed" in html
    assert '"name":"fall"' in html.replace('": "', '":"')
    assert '"name":"failsafe"' not in html.replace('": "', '":"')


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ("Crash: Disarming: AngErr=82>30, Accel=1.2<3.0", "crash"),
        ("Radio Failsafe - Disarming", "radio"),
        ("Arming: Radio failsafe on", None),
        ("PreArm: Battery failsafe", None),
        ("Battery 1 is low, warming up", "battery"),
        ("Descent failed", None),
        ("ESC 2 failure", "motor"),
        ("Yaw source lost", None),
        ("RC1 lost", "radio"),
    ],
)
def test_failsafe_texts_have_their_kind_arming_texts_none(text: str, kind: str | None) -> None:
    evidence = evidence_in_texts([LoggedText(1.0, 2, text)])
    assert [item.kind for item in evidence] == ([] if kind is None else [kind])


def test_gap_of_velocities_after_fast_descent_is_no_fall() -> None:
    """The log does not show how the descent ended: the vehicle may have landed slowly."""
    flight = descending(lambda height_m: 4.5)
    kept = FlightLog(flight.path)
    for row, time_s in enumerate(flight.velocity.times):
        if not 14.0 < time_s < 30.0:
            kept.velocity.add(time_s, 0.0, 0.0, flight.velocity["down_m_s"][row])
    flight.velocity = kept.velocity
    assert falls(flight) == []
