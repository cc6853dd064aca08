"""Flights of real firmware: the cells' values are plausible, and agree with pymavlink at the end.

Uses the recordings in ``../shared/traces`` if present, else the project's own, which contain the essential parts of two
of these flights; a flight in neither is skipped.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega
from recorded import recording

from aerokit.mavlink import STANDARD, Framer, read_tlog
from aerokit.position import Position
from aerokit.vehicle.state.telemetry import Telemetry

SYSTEM_IDS = {"ardupilot-copter": 1, "ardupilot-plane": 2, "ardupilot-rover": 3, "px4-quad": 1}


@dataclass
class Flight:
    """A recorded flight, played into cells."""

    telemetry: Telemetry
    modes: list[str] = field(default_factory=list)
    armed: list[bool] = field(default_factory=list)
    landed: list[int] = field(default_factory=list)
    positions: list[Position] = field(default_factory=list)
    missing: list[tuple[str, ...]] = field(default_factory=list)
    prearm: list[bool | None] = field(default_factory=list)
    last_frames: dict[str, bytes] = field(default_factory=dict)

    @property
    def highest_m(self) -> float:
        return max(p.altitude_relative_m for p in self.positions if p.altitude_relative_m is not None)

    @property
    def farthest_m(self) -> float:
        return max(self.positions[0].distance_to(position) for position in self.positions[::10])

    @property
    def texts(self) -> list[str]:
        return [text.text for text in self.telemetry.texts_since(-math.inf)]


@pytest.fixture(scope="module")
def flights() -> Callable[[str], Flight]:
    """Plays each recording once."""
    played: dict[str, Flight] = {}

    def flight(name: str) -> Flight:
        if name not in played:
            played[name] = play(name)
        return played[name]

    return flight


def play(name: str) -> Flight:
    path, now = recording(f"{name}.tlog"), [0.0]
    telemetry = Telemetry(lambda: now[0], system_id=SYSTEM_IDS[name])
    flight = Flight(telemetry)
    watch(flight)
    framer = Framer()
    framer.wanted = telemetry.handles
    for now[0], raw in read_tlog(path):
        for frame in framer.receive(raw, now[0]):
            if telemetry.accepts(frame):
                message = STANDARD.decode(frame)
                telemetry.receive(message)
                flight.last_frames[message.NAME] = frame.raw
    return flight


def watch(flight: Flight) -> None:
    telemetry = flight.telemetry
    telemetry.mode.observe(lambda _, mode: flight.modes.append(mode.name))
    telemetry.armed.observe(lambda _, armed: flight.armed.append(armed))
    telemetry.landed_state.observe(lambda _, state: flight.landed.append(int(state)))
    telemetry.position.observe(lambda _, position: flight.positions.append(position))
    telemetry.estimator.observe(lambda _, health: note(flight.missing, health.missing))
    telemetry.sensors.observe(lambda _, sensors: note(flight.prearm, sensors.prearm_checks_pass))


def note(items: list[Any], item: Any) -> None:
    if not items or items[-1] != item:
        items.append(item)


Flights = Callable[[str], Flight]


# ------------------------------------------------------------------------- events during the flight


def test_copter(flights: Flights) -> None:
    flight = flights("ardupilot-copter")
    assert flight.modes == ["STABILIZE", "GUIDED", "RTL"]
    assert flight.armed == [False, True, False]
    assert flight.landed == [1, 2, 1]
    assert flight.highest_m == pytest.approx(15.0, abs=0.2)  # 10 m, then RTL climbs to its 15 m
    assert flight.farthest_m == pytest.approx(50.0, abs=1.0)
    assert flight.missing[-2:] == [("absolute horizontal position",), ()]
    assert flight.prearm == [False, True]
    assert flight.positions[0].altitude_amsl_m == pytest.approx(584.1, abs=0.1)
    assert str(flight.telemetry.version.value) == "4.7.0-dev (21910f24)"
    assert {"ArduPilot Ready", "Arming motors", "Disarming motors"} <= set(flight.texts)


@pytest.mark.exhaustive
def test_plane(flights: Flights) -> None:
    flight = flights("ardupilot-plane")
    assert flight.modes == ["INITIALISING", "MANUAL", "AUTO"]
    assert flight.armed == [False, True, False]
    assert flight.landed == [1, 2, 1]
    assert flight.highest_m == pytest.approx(70, abs=2)
    assert flight.farthest_m < 2000  # The plane reported a place near 0° N 0° E before its first fix.
    assert flight.telemetry.air_speed_m_s.is_known


def test_rover(flights: Flights) -> None:
    flight = flights("ardupilot-rover")
    assert flight.modes == ["INITIALISING", "MANUAL", "GUIDED", "HOLD"]
    assert flight.armed == [False, True, False]
    assert not flight.telemetry.landed_state.is_known
    assert flight.farthest_m == pytest.approx(50, abs=2)


def test_px4(flights: Flights) -> None:
    flight = flights("px4-quad")
    assert flight.modes == ["LOITER", "TAKEOFF", "LOITER", "MISSION", "RTL", "LOITER"]
    assert flight.armed == [False, True, False]
    assert flight.landed == [1, 3, 2, 4, 1]
    assert flight.highest_m == pytest.approx(30, abs=0.5)
    assert flight.missing[-1] == ()
    assert flight.prearm == [False, True]
    telemetry = flight.telemetry
    assert telemetry.sensors.value.blocks_arming == ()
    assert telemetry.version.value.firmware == "1.17.0-alpha"
    assert telemetry.batteries.value[0].voltage_v == pytest.approx(15.3)
    assert telemetry.mission_reached.value == 3
    reasons = [telemetry.autopilot.arming_reason(text) for text in flight.texts]
    assert [reason for reason in reasons if reason] == ["heading estimate not stable"]


# ---------------------------------------------------------------------------- comparison with pymavlink


def theirs(flight: Flight) -> dict[str, Any]:
    """Return the last message of each kind as decoded by pymavlink, except for kinds that pymavlink lacks."""

    def decoded() -> Iterator[tuple[str, Any]]:
        for name, raw in flight.last_frames.items():
            parser = ardupilotmega.MAVLink(None)
            parser.robust_parsing = True
            for message in parser.parse_buffer(raw) or []:
                if message.get_type() == name:
                    yield name, message

    return dict(decoded())


@pytest.mark.parametrize("name", SYSTEM_IDS)
def test_last_values_match_pymavlink(flights: Flights, name: str) -> None:
    flight = flights(name)
    telemetry, last = flight.telemetry, theirs(flight)
    fix = last["GLOBAL_POSITION_INT"]
    position, velocity = telemetry.position.value, telemetry.velocity.value
    assert (position.latitude_deg, position.longitude_deg) == pytest.approx((fix.lat / 1e7, fix.lon / 1e7))
    assert position.altitude_relative_m == pytest.approx(fix.relative_alt / 1000)
    assert (velocity.north_m_s, velocity.down_m_s) == pytest.approx((fix.vx / 100, fix.vz / 100))
    gps, receiver = last["GPS_RAW_INT"], telemetry.gps.value[0]
    assert receiver.satellites == gps.satellites_visible
    assert receiver.hdop == pytest.approx(gps.eph / 100)
    hud = last["VFR_HUD"]
    assert telemetry.ground_speed_m_s.value == pytest.approx(hud.groundspeed)
    assert telemetry.throttle_percent.value == hud.throttle
    battery = last["BATTERY_STATUS"]
    assert telemetry.batteries.value[0].voltage_v == pytest.approx(battery.voltages[0] / 1000)
    assert telemetry.sensors.value.healthy == last["SYS_STATUS"].onboard_control_sensors_health
    assert telemetry.servo_outputs.value.outputs_us[0] == last["SERVO_OUTPUT_RAW"].servo1_raw


@pytest.mark.parametrize("name", ["ardupilot-copter", "ardupilot-plane", "ardupilot-rover"])
def test_ardupilot_last_attitude_matches_pymavlink(flights: Flights, name: str) -> None:
    flight = flights(name)
    attitude, theirs_ = flight.telemetry.attitude.value, theirs(flight)["ATTITUDE"]
    assert attitude.roll_deg == pytest.approx(math.degrees(theirs_.roll))
    assert attitude.yaw_rate_deg_s == pytest.approx(math.degrees(theirs_.yawspeed))


def test_px4_last_attitude_matches_pymavlink(flights: Flights) -> None:
    quaternion = theirs(flights("px4-quad"))["ATTITUDE_QUATERNION"]
    telemetry = flights("px4-quad").telemetry
    assert telemetry.attitude.source is not None
    if telemetry.attitude.source.message == "ATTITUDE_QUATERNION":
        ours = telemetry.attitude.value.quaternion
        expected = (quaternion.q1, quaternion.q2, quaternion.q3, quaternion.q4)
        cosine = sum(mine * its for mine, its in zip(ours, expected, strict=True))
        assert abs(cosine) == pytest.approx(1)  # q and −q are the same attitude


@pytest.mark.parametrize("name", SYSTEM_IDS)
def test_known_cells_have_source(flights: Flights, name: str) -> None:
    telemetry = flights(name).telemetry
    for cell in telemetry.cells.values():
        if cell.is_known:
            assert cell.source is not None
            assert (cell.source.system_id, cell.source.component_id) == (SYSTEM_IDS[name], 1)
