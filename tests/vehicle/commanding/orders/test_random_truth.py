"""Random calls on a bad link, with a pilot, moved homes and reboots: what a call reports is true of the simulation."""

from __future__ import annotations

import math
import random
import re
from collections.abc import Awaitable, Callable
from typing import Any, NamedTuple

import anyio
import pytest
from flight_harness import now
from test_orders import SEEDS

import aerokit
from aerokit import Position
from aerokit.errors import AerokitError, OperationTimeout
from aerokit.missions import Mission, return_to_launch, waypoint
from aerokit.sim import SimulatedCopter, SimulatedPx4, SimulatedRover, simulated_link
from aerokit.sim.px4 import modes as px4_modes
from aerokit.testing import FaultModel, FaultyLink, run_virtual
from aerokit.testing.track import true_point

KINDS: dict[str, Any] = {"copter": SimulatedCopter, "px4": SimulatedPx4, "rover": SimulatedRover}
PARAMETERS = {"copter": "FENCE_ALT_MAX", "px4": "MPC_XY_CRUISE", "rover": "CRUISE_SPEED"}
PILOT_MODES = {"copter": (2, 5, 16), "px4": (px4_modes.POSITION, px4_modes.ALTITUDE), "rover": (0, 4)}
ORDERED_MODES = {
    "copter": ("GUIDED", "LOITER", "RTL", "LAND"),
    "px4": ("LOITER", "RTL", "LAND", "POSCTL"),
    "rover": ("GUIDED", "HOLD", "RTL"),
}
HOLD_MODES = {"copter": "BRAKE", "px4": "LOITER", "rover": "HOLD"}
MAX_CALL_S = 400.0
REPORT_S = 4.0
"""A call may report a state that is this many seconds old: HEARTBEAT has 1 Hz, and some of them are lost or late."""
SAMPLE_S = 0.1

Call = Callable[[], Awaitable[None]]


class TrueState(NamedTuple):
    """State of the simulation at one time. Metres are counted from the place where it was switched on."""

    at: float
    armed: bool
    mode: str
    north_m: float
    east_m: float
    up_m: float
    home: tuple[float, float, float]
    heading_deg: float

    def distance_m(self, north_m: float, east_m: float) -> float:
        return math.hypot(self.north_m - north_m, self.east_m - east_m)


class History:
    """The states of a simulated vehicle, ten times a second."""

    def __init__(self, simulated: Any) -> None:
        self._simulated = simulated
        self._states: list[TrueState] = []
        simulated.on_power_on(self._start)

    def _start(self) -> None:
        self.record()
        self._simulated.every(SAMPLE_S, self.record)

    def since(self, at: float) -> list[TrueState]:
        self.record()
        return [state for state in self._states if state.at >= at - SAMPLE_S]

    def recent(self, called_at: float) -> list[TrueState]:
        """Return the states since the call that it may report."""
        return self.since(max(called_at, now() - REPORT_S))

    def record(self) -> None:
        simulated, point, motion = self._simulated, true_point(self._simulated), self._simulated.motion
        home = simulated.home if isinstance(simulated, SimulatedPx4) else simulated.navigation.home
        place = (motion.north, motion.east, -motion.down)
        heading_deg = math.degrees(motion.yaw) % 360
        self._states.append(TrueState(now(), point.armed, point.mode, *place, home or (0.0, 0.0, 0.0), heading_deg))


class CheckedCalls:
    """Calls of one vehicle. Each compares what it reports with the simulation."""

    def __init__(self, kind: str, simulated: Any, vehicle: aerokit.Vehicle, rng: random.Random) -> None:
        self._kind, self._simulated, self._vehicle, self._rng = kind, simulated, vehicle, rng
        self.history = History(simulated)

    def next_call(self) -> Call:
        """Choose a call, usually one that is possible in the present state."""
        state, is_rover = self.history.since(now())[-1], self._kind == "rover"
        if self._rng.random() < 0.8:
            if not state.armed:
                return self.arm
            if state.up_m < 1.0 and not is_rover:
                return self.take_off
        calls: list[Call] = [self.arm, self.disarm, self.set_mode, self.hold, self.go_to, self.go_to, self.fly_mission]
        if not is_rover:
            calls += [self.land, self.take_off, self.set_heading]
        return self._rng.choice(calls)

    def other_call(self) -> Call:
        return self._rng.choice((self.set_home, self.set_home, self.set_parameter))

    async def arm(self) -> None:
        called_at = now()
        await self._vehicle.arm(mode="GUIDED" if self._kind == "copter" else None)
        assert any(state.armed for state in self.history.recent(called_at))

    async def disarm(self) -> None:
        called_at = now()
        await self._vehicle.disarm()
        assert any(not state.armed for state in self.history.recent(called_at))

    async def set_mode(self) -> None:
        called_at, mode = now(), self._rng.choice(ORDERED_MODES[self._kind])
        await self._vehicle.set_mode(mode)
        assert mode in {state.mode for state in self.history.since(called_at)}

    async def hold(self) -> None:
        called_at = now()
        await self._vehicle.hold()
        assert HOLD_MODES[self._kind] in {state.mode for state in self.history.since(called_at)}

    async def take_off(self) -> None:
        called_at, altitude_m = now(), self._rng.uniform(5, 20)
        await self._vehicle.take_off(altitude_m)
        # If an earlier take-off is still in progress, the vehicle may be higher than `altitude_m`.
        errors_m = [self._height_error_m(state, altitude_m, called_at) for state in self.history.recent(called_at)]
        assert max(errors_m) > -1.5

    async def land(self) -> None:
        called_at = now()
        await self._rng.choice((self._vehicle.land, self._vehicle.return_to_launch))()
        assert min(state.up_m for state in self.history.recent(called_at)) < 0.3

    async def go_to(self) -> None:
        called_at, altitude_m, target = now(), self._rng.uniform(8, 20), self._random_place()

        def is_there(state: TrueState, radius_m: float) -> bool:
            error_m = 0.0 if self._kind == "rover" else self._height_error_m(state, altitude_m, called_at)
            return abs(error_m) < 4 and state.distance_m(*self._local(target)) < radius_m

        try:
            await self._vehicle.go_to(target.replace(altitude_relative_m=altitude_m), timeout=60)
        except OperationTimeout as error:
            if "has not moved" in str(error) and is_there(self.history.since(now())[-1], 1.0):
                raise AssertionError("the vehicle has arrived") from error
            raise
        assert any(is_there(state, 4.0) for state in self.history.recent(called_at))

    async def set_heading(self) -> None:
        called_at, heading_deg = now(), self._rng.uniform(0, 359)
        await self._vehicle.set_heading(heading_deg, timeout=20)
        errors = [math.remainder(state.heading_deg - heading_deg, 360) for state in self.history.recent(called_at)]
        assert min(map(abs, errors)) < 8

    async def fly_mission(self) -> None:
        places = [self._random_place() for _ in range(self._rng.randint(1, 4))]
        items = [waypoint(place, altitude_relative_m=15) for place in places]
        ending = [return_to_launch()] if self._rng.random() < 0.5 else []
        await self._vehicle.mission.upload(Mission([*items, *ending]))
        started_at = now()
        await self._vehicle.mission.start()
        await self._vehicle.mission.wait_finished(timeout=200)
        flown = self.history.since(started_at)
        assert min(state.distance_m(*self._local(places[-1])) for state in flown) < 6
        if ending:
            assert min(state.distance_m(*state.home[:2]) for state in self.history.recent(started_at)) < 6

    async def set_home(self) -> None:
        called_at, home = now(), self._vehicle.home.value
        place = self._random_place().replace(altitude_amsl_m=home.altitude_amsl_m + self._rng.uniform(-2, 10))
        await self._vehicle.set_home(place)
        north_m, east_m = self._local(place)
        homes = [state.home for state in self.history.since(called_at)]
        assert min(math.hypot(north - north_m, east - east_m) for north, east, _ in homes) < 6

    async def set_parameter(self) -> None:
        value = self._rng.uniform(10, 12)
        await self._vehicle.parameters.set(PARAMETERS[self._kind], value)
        assert self._simulated.parameters[PARAMETERS[self._kind]] == pytest.approx(value)

    def check_error(self, error: AerokitError, called_at: float) -> None:
        """Check what an error says about the vehicle."""
        text, states = str(error), self.history.since(called_at - REPORT_S)
        for mode in re.findall(r"mode changed to (\w+)", text):
            assert mode in {state.mode for state in states}, text
        assert "the vehicle disarmed" not in text or not all(state.armed for state in states), text
        if still := re.search(r"has not moved for (\d+) s", text):
            path = self.history.since(now() - float(still[1]))[:-5]
            assert max(state.distance_m(path[0].north_m, path[0].east_m) for state in path) < 3, text

    def _height_error_m(self, state: TrueState, altitude_m: float, called_at: float) -> float:
        """Return the height above the ordered altitude, which was above one of the homes since the order."""
        homes_m = {-state.home[2] for state in self.history.since(called_at - 1.0)}
        return min((state.up_m - home_m - altitude_m for home_m in homes_m), key=abs)

    def _local(self, place: Position) -> tuple[float, float]:
        local: tuple[float, float] = self._simulated.frame.to_local(
            round(place.latitude_deg * 1e7), round(place.longitude_deg * 1e7)
        )
        return local

    def _random_place(self) -> Position:
        here = self._vehicle.position.value
        place = Position(here.latitude_deg, here.longitude_deg)
        return place.offset(north_m=self._rng.uniform(-30, 30), east_m=self._rng.uniform(-30, 30))


def random_model(rng: random.Random) -> FaultModel:
    return FaultModel(
        loss=rng.choice((0.0, 0.02, 0.1, 0.25)),
        duplication=rng.choice((0.0, 0.1)),
        reordering=rng.choice((0.0, 0.0, 0.1)),
        delay_s=rng.choice((0.0, 0.05, 0.3)),
        jitter_s=rng.choice((0.0, 0.1)),
    )


def disturb(kind: str, simulated: Any, rng: random.Random) -> None:
    """Let a pilot change the mode or disarm, or reboot the vehicle."""
    chance, is_px4 = rng.random(), kind == "px4"
    if chance < 0.6:
        mode = rng.choice(PILOT_MODES[kind])
        simulated.switch_to(mode) if is_px4 else simulated.set_mode(mode)
    elif chance < 0.9:
        simulated.arming.disarm("pilot") if is_px4 else simulated.arming.disarm(force=False)
    else:
        simulated.restart()


async def _fly(kind: str, seed: int) -> None:
    rng = random.Random(seed)
    simulated = KINDS[kind](boot_time_s=1.0)
    model = random_model(rng)
    async with simulated_link(simulated) as link:
        faulty = FaultyLink(link, model, seed=seed)
        async with aerokit.connect(faulty, system_id=simulated.system_id) as vehicle:
            await vehicle.wait_ready(timeout=120)
            if kind == "copter":
                simulated.rc[2] = 1500  # With the throttle stick in the middle, a copter that is taken over stays up.
            calls = CheckedCalls(kind, simulated, vehicle, rng)

            async def interrupt() -> None:
                if rng.random() < 0.5:
                    disturb(kind, simulated, rng)
                    calls.history.record()  # A call may change the mode before the next sample.
                    return
                faulty.incoming.model = FaultModel(loss=1.0)
                faulty.outgoing.model = rng.choice((faulty.incoming.model, model))
                await anyio.sleep(rng.uniform(0.5, 10))
                faulty.incoming.model = faulty.outgoing.model = model

            async def call_randomly(next_call: Callable[[], Call], count: int) -> None:
                for _ in range(count):
                    called_at, call = now(), next_call()
                    try:
                        with anyio.fail_after(MAX_CALL_S):  # Every call ends, whatever happens to the link.
                            with anyio.move_on_after(rng.choice((None, None, None, rng.uniform(0, 10)))):
                                await call()
                    except AerokitError as error:
                        calls.check_error(error, called_at)
                    await anyio.sleep(rng.choice((0.0, 0.0, rng.uniform(0, 8))))

            async with anyio.create_task_group() as tasks:
                tasks.start_soon(call_randomly, calls.next_call, 14)
                tasks.start_soon(call_randomly, lambda: rng.choice((calls.other_call(), interrupt)), rng.randint(0, 8))


@pytest.mark.sampled(4)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(4 * SEEDS))
def test_random_calls_report_truth_on_bad_links(seed: int, kind: str) -> None:
    run_virtual(_fly(kind, seed))
