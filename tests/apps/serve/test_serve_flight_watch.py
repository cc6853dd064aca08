"""Crashes and automatic disarming, as the served state reports them."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from types import SimpleNamespace
from typing import Any

import anyio
import pytest
from serve_stage import Stage, open_stage

import aerokit
from aerokit.apps.serve.flight_watch import FlightWatch
from aerokit.mavlink.enums import MavLandedState, MavType
from aerokit.position import Position
from aerokit.sim import SimulatedPx4, simulated_link
from aerokit.vehicle.state.movement import Velocity

pytestmark = pytest.mark.anyio
STEP_S = 0.1


def state_of(stage: Stage) -> dict[str, Any]:
    return dict(json.loads(stage.app._served.snapshot())["vehicles"][0])


async def fly_up(stage: Stage, altitude_m: float = 10) -> None:
    assert (await stage.submit("arm")).status_code == 200
    assert (await stage.submit("take_off", {"altitude_m": altitude_m})).status_code == 200


async def fall(stage: Stage) -> None:
    stage.flight.copter.faults.motor_failed = True
    await anyio.sleep(6)


async def test_fall_while_hovering_is_reported_as_crash() -> None:
    async with open_stage() as stage:
        await fly_up(stage)
        stage.flight.copter.faults.motor_failed = True
        await anyio.sleep(1)
        assert state_of(stage)["crash"] is None
        await anyio.sleep(5)
        crash = state_of(stage)["crash"]
        assert crash["text"] == "the vehicle hit the ground at 11.4 m/s"
        age_s = stage.flight.vehicle.connection.unix_time() - crash["at_unix_s"]
        assert age_s == pytest.approx(4.2, abs=0.3)
        assert state_of(stage)["states"]["armed"]["value"] is True


async def test_only_crashed_vehicle_accepts_forced_disarm() -> None:
    async with open_stage() as stage:
        await fly_up(stage)
        refused = await stage.submit("disarm", {"force": True})
        assert (refused.status_code, refused.json()["error"]) == (409, "NotCrashed")
        assert "nothing was sent" in refused.json()["detail"]
        assert stage.flight.copter.is_armed
        await fall(stage)
        plain = await stage.submit("disarm")
        assert (plain.status_code, plain.json()["error"]) == (409, "CommandRejected")
        assert (await stage.submit("disarm", {"force": True})).status_code == 200
        assert state_of(stage)["states"]["armed"]["value"] is False
        assert state_of(stage)["crash"] is not None, "the vehicle still lies there"


async def test_forced_disarm_without_recent_velocity_is_refused() -> None:
    """HEARTBEATs go on, but the vehicle may have taken off since its last velocity."""
    async with open_stage() as stage:
        await fly_up(stage)
        await fall(stage)
        assert state_of(stage)["crash"] is not None
        await anyio.sleep(0.06)  # the next request gets a new snapshot
        stage.flight.vehicle.velocity._add_age(5.0)
        assert state_of(stage)["crash"] is None
        refused = await stage.submit("disarm", {"force": True})
        assert (refused.status_code, refused.json()["error"]) == (409, "NotCrashed")
        assert stage.flight.copter.is_armed


async def test_crash_ends_with_next_arming() -> None:
    async with open_stage() as stage:
        await fly_up(stage)
        await fall(stage)
        await stage.submit("disarm", {"force": True})
        stage.flight.copter.faults.motor_failed = False
        assert (await stage.submit("arm")).status_code == 200
        assert state_of(stage)["crash"] is None


@pytest.mark.parametrize("falls", [True, False])
async def test_px4_that_falls_has_crashed_but_not_one_that_lands(falls: bool) -> None:
    px4 = SimulatedPx4(boot_time_s=0.0)
    async with simulated_link([px4]) as link, aerokit.connect(link) as vehicle:
        await vehicle.wait_ready()
        watch = FlightWatch(vehicle)
        await vehicle.arm()
        await vehicle.take_off(10)
        px4.faults.motor_failed = falls
        if not falls:
            await vehicle.land()
        await anyio.sleep(12)
        assert (watch.crash is not None) is falls
        assert watch.disarming is None
        watch.close()


async def test_flight_with_fast_descent_is_no_crash() -> None:
    async with open_stage() as stage:
        copter = stage.flight.copter
        for name in ("WPNAV_SPEED_DN", "LAND_SPEED_HIGH"):
            assert name in copter.parameters
            copter.parameters[name] = 700
        await fly_up(stage, 60)
        here = stage.flight.vehicle.position.value
        sinks: list[float] = []
        velocity = stage.flight.vehicle.velocity
        stop = velocity.observe(lambda _, new: sinks.append(new.down_m_s), every_arrival=True)
        crashes: list[object] = []
        async with anyio.create_task_group() as group:

            async def watch() -> None:
                while True:
                    crashes.append(state_of(stage)["crash"])
                    await anyio.sleep(0.2)

            group.start_soon(watch)
            place = {"latitude_deg": here.latitude_deg, "longitude_deg": here.longitude_deg}
            assert (await stage.submit("go_to", {**place, "altitude_relative_m": 2})).status_code == 200
            await anyio.sleep(5)
            assert (await stage.submit("land")).status_code == 200
            await anyio.sleep(5)
            group.cancel_scope.cancel()
        stop()
        assert max(sinks) > 6
        assert set(crashes) == {None}


class FakeCell:
    """A state whose values and times the test sets."""

    def __init__(self, value: Any = None) -> None:
        self.latest, self.updated_at, self.age = value, 0.0, 0.0
        self.observers: list[Callable[[Any, Any], None]] = []

    def observe(self, callback: Callable[[Any, Any], None], *, every_arrival: bool = False) -> Callable[[], None]:
        self.observers.append(callback)
        return lambda: self.observers.remove(callback)

    def set(self, value: Any, at: float) -> None:
        before, self.latest, self.updated_at = self.latest, value, at
        for observer in tuple(self.observers):
            observer(before, value)


class FakeFlight:
    """A vehicle in the air whose vertical motion the test prescribes."""

    def __init__(self) -> None:
        self.now = 100.0
        self.home_m = 488.0
        self.velocity, self.position = FakeCell(), FakeCell()
        self.armed, self.landed_state = FakeCell(True), FakeCell(MavLandedState.IN_AIR)
        self.telemetry = SimpleNamespace(velocity=self.velocity, position=self.position)
        self.connection = SimpleNamespace(now=lambda: self.now, unix_time=lambda: 1e9 + self.now)
        self.autopilot = SimpleNamespace(vehicle_type=MavType.QUADROTOR, firmware="ArduCopter")
        self.parameters = SimpleNamespace(known=lambda name: None)
        self._session = self
        self.watch = FlightWatch(self)  # type: ignore[arg-type]

    def fly(self, path: Iterable[tuple[float, float]], north_m_s: float = 0.0) -> bool:
        """Report heights and sink rates ten times a second; return True if that was ever taken for a crash."""
        found = False
        for height_m, sink_m_s in path:
            self.now += STEP_S
            altitude_m = 488.0 + height_m
            relative_m = altitude_m - self.home_m
            self.position.set(Position(47.0, 8.0, altitude_m, altitude_relative_m=relative_m), self.now)
            self.velocity.set(Velocity(north_m_s, 0.0, sink_m_s), self.now)
            found = found or self.watch.crash is not None
        return found


def sinking(from_m: float, brake_m_s2: float, stop_m: float, top_m_s: float = 9.0) -> list[tuple[float, float]]:
    """Return heights and sink rates of a descent that brakes, stops at ``stop_m``, and hovers there for 12 s."""
    path, height_m, sink_m_s = [], from_m, top_m_s
    while sink_m_s > 0.0:
        is_braking = height_m - stop_m <= sink_m_s**2 / (2 * brake_m_s2)
        sink_m_s = max(0.0, sink_m_s - brake_m_s2 * STEP_S) if is_braking else sink_m_s
        height_m = max(stop_m, height_m - sink_m_s * STEP_S)
        path.append((height_m, sink_m_s))
    return path + [(stop_m, 0.0)] * 120


@pytest.mark.parametrize(
    ("brake_m_s2", "stop_m", "expected"),
    [
        pytest.param(4.0, 1.0, False, id="usual braking close to the ground"),
        pytest.param(9.0, 1.0, False, id="hard braking close to the ground"),
        pytest.param(15.0, 1.0, False, id="braking that the impact detector takes for an impact"),
        pytest.param(90.0, 30.0, False, id="sudden stop far above home"),
        pytest.param(90.0, 0.0, True, id="impact"),
    ],
)
def test_flying_vehicle_that_brakes_is_no_crash(brake_m_s2: float, stop_m: float, expected: bool) -> None:
    flight = FakeFlight()
    assert flight.fly(sinking(40 + stop_m, brake_m_s2, stop_m)) is expected
    assert bool(flight.watch._detector.describe()) is (brake_m_s2 > 4)


def test_vehicle_that_moves_on_after_impact_is_no_crash() -> None:
    fall = sinking(40, 90.0, 0.0)
    bounce = [(0.1, 0.0), (0.5, -2.5)] * 20
    assert not FakeFlight().fly([*fall[:-120], *bounce, *[(0.0, 0.0)] * 120])
    assert not FakeFlight().fly(fall, north_m_s=5.0), "a plane that slides or flies on"


def test_impact_on_hill_counts_once_vehicle_is_disarmed() -> None:
    flight, fall = FakeFlight(), sinking(70, 90.0, 30.0)
    assert not flight.fly(fall[:-90])
    flight.landed_state.set(MavLandedState.ON_GROUND, flight.now)
    flight.armed.set(False, flight.now)
    assert flight.fly([(30.0, 0.0)] * 3)


def test_fall_from_tree_is_crash() -> None:
    """The impact on the tree is still described when the vehicle hits the ground."""
    free_fall = [(20.0 - 4.9 * (STEP_S * step) ** 2, 9.8 * STEP_S * step) for step in range(1, 20)]
    flight = FakeFlight()
    assert not flight.fly([*sinking(40, 90.0, 20.0)[:-118], *free_fall])
    assert flight.fly([(0.0, 0.0)] * 40)


def test_jumping_height_after_impact_does_not_hide_crash() -> None:
    """PX4's estimate after a fall, measured in its simulator."""
    assert FakeFlight().fly([*sinking(40, 90.0, 0.0)[:-120], *[(0.0, 0.0), (1.1, 0.0), (0.0, 0.0), (-1.1, 0.0)] * 10])


def test_slow_landing_after_hard_braking_is_no_crash() -> None:
    flight, landing = FakeFlight(), [(2.0 - 0.05 * step, 0.5) for step in range(40)]
    assert not flight.fly([*sinking(42, 15.0, 2.0)[:-115], *landing])
    flight.landed_state.set(MavLandedState.ON_GROUND, flight.now)
    flight.armed.set(False, flight.now)
    assert not flight.fly([(0.0, 0.0)] * 40)


def test_landing_long_after_hard_braking_is_no_crash() -> None:
    flight = FakeFlight()
    assert not flight.fly(sinking(41, 15.0, 0.8))
    flight.landed_state.set(MavLandedState.ON_GROUND, flight.now)
    flight.armed.set(False, flight.now)
    assert not flight.fly([(0.0, 0.0)] * 100)


def test_crashed_vehicle_that_flies_again_is_no_longer_crashed() -> None:
    flight = FakeFlight()
    assert flight.fly(sinking(40, 90.0, 0.0))
    flight.fly([(0.3, -2.5), (0.8, -2.5)])
    assert not flight.fly([(1.0, 0.0)] * 50)


@pytest.mark.parametrize("reports_landed_state", [True, False])
def test_crashed_vehicle_that_takes_off_slowly_is_no_longer_crashed(reports_landed_state: bool) -> None:
    flight = FakeFlight()
    assert flight.fly(sinking(40, 90.0, 0.0))
    climb_m_s, seconds = (0.2, 3) if reports_landed_state else (0.5, 5)
    if reports_landed_state:
        flight.landed_state.set(MavLandedState.ON_GROUND, flight.now)
        flight.landed_state.set(MavLandedState.IN_AIR, flight.now)
    flight.fly([(climb_m_s * STEP_S * step, -climb_m_s) for step in range(10 * seconds)])
    assert not flight.fly([(climb_m_s * seconds, 0.0)] * 50)


def test_crash_is_kept_when_home_moves() -> None:
    """PX4 corrects the altitude of home in flight. With running motors, a crashed vehicle may report take-offs."""
    flight = FakeFlight()
    assert flight.fly(sinking(40, 90.0, 0.0))
    flight.landed_state.set(MavLandedState.ON_GROUND, flight.now)
    flight.landed_state.set(MavLandedState.IN_AIR, flight.now)
    flight.home_m -= 1.0
    flight.fly([(0.0, 0.0)] * 50)
    assert flight.watch.crash is not None


def test_crashed_vehicle_with_changing_landed_state_stays_crashed() -> None:
    """ArduCopter with running motors reports "on the ground" and "in the air" again and again, while it lies still."""
    flight = FakeFlight()
    assert flight.fly(sinking(40, 90.0, 0.0))
    for _ in range(3):
        flight.landed_state.set(MavLandedState.ON_GROUND, flight.now)
        flight.landed_state.set(MavLandedState.IN_AIR, flight.now)
        assert flight.fly([(0.0, 0.0)] * 50)


def test_crashed_vehicle_that_is_moved_for_a_second_stays_crashed() -> None:
    flight = FakeFlight()
    assert flight.fly(sinking(40, 90.0, 0.0))
    flight.fly([*[(0.0, -0.5)] * 10, (0.0, 0.0)] * 3)
    assert flight.watch.crash is not None


def test_old_landed_state_is_no_evidence_of_crash() -> None:
    flight = FakeFlight()
    flight.landed_state.set(MavLandedState.ON_GROUND, flight.now)
    flight.landed_state.age = 10.0
    assert not flight.fly(sinking(70, 90.0, 30.0))
    recent = FakeFlight()
    recent.landed_state.set(MavLandedState.ON_GROUND, recent.now)
    assert recent.fly(sinking(70, 90.0, 30.0))


async def test_automatic_disarming_is_reported_with_its_parameter() -> None:
    async with open_stage() as stage:
        await stage.flight.vehicle.parameters.read("DISARM_DELAY")
        assert state_of(stage)["unread"] == []
        assert (await stage.submit("arm")).status_code == 200
        await anyio.sleep(8)
        assert state_of(stage)["disarming"] is None
        await anyio.sleep(5)
        found = state_of(stage)["disarming"]
        assert (found["parameter"], found["delay_s"], found["is_automatic"]) == ("DISARM_DELAY", 10.0, True)
        assert found["armed_for_s"] == pytest.approx(10, abs=1.2)
        assert found["age_s"] == pytest.approx(3, abs=1.2)


async def test_early_disarming_by_pilot_is_not_called_automatic() -> None:
    async with open_stage() as stage:
        await stage.flight.vehicle.parameters.read("DISARM_DELAY")
        await stage.submit("arm")
        await anyio.sleep(3)
        stage.flight.copter.arming.disarm()
        await anyio.sleep(2)
        found = state_of(stage)["disarming"]
        assert (found["is_automatic"], found["armed_for_s"]) == (False, pytest.approx(3, abs=1))


def test_disarming_is_not_called_automatic_if_parameter_is_negative() -> None:
    """COM_DISARM_PRFLT = -1 switches PX4's automatic disarming off."""
    flight = FakeFlight()
    flight.autopilot.auto_disarm_parameter = "COM_DISARM_PRFLT"
    flight.parameters = SimpleNamespace(known=lambda name: SimpleNamespace(value=-1.0))
    flight.landed_state.set(MavLandedState.ON_GROUND, flight.now)
    for is_armed in (False, True, False):
        flight.armed.set(is_armed, flight.now)
        flight.now += 0.3
    found = flight.watch.disarming
    assert found is not None
    assert (found["delay_s"], found["is_automatic"]) == (-1.0, False)


async def test_ordered_disarming_and_landing_are_not_reported() -> None:
    async with open_stage() as stage:
        await stage.submit("arm")
        await stage.submit("disarm")
        await anyio.sleep(1)
        assert state_of(stage)["disarming"] is None
        await fly_up(stage)
        await stage.submit("land")
        await anyio.sleep(1)
        assert state_of(stage)["states"]["armed"]["value"] is False
        assert state_of(stage)["disarming"] is None
