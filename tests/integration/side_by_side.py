"""Seeded programs of random calls, and their effects on a vehicle, for comparing two vehicles.

``python tests/integration/side_by_side.py --vehicle path/to/arducopter --seeds 0-30`` runs them on a binary and on
the simulated vehicle, and lists the differences. `test_any_side_by_side` runs a few on simulated vehicles.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import math
import random
import re
import sys
from collections import defaultdict
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

import anyio
from any_vehicle import Choice, served
from vehicle_kinds import KINDS

from aerokit import Position, Vehicle, connect
from aerokit import messages as m
from aerokit.errors import AerokitError, CommandRejected
from aerokit.mavlink.enums import CopterMode, MavCmd, MavFrame, MavResult
from aerokit.missions import Mission, land, take_off, waypoint
from aerokit.sim import simulated_link
from aerokit.sim.kinds import scale_timeouts, simulated
from aerokit.testing import run_virtual

__all__ = ["Call", "Step", "differences", "program", "run_choice", "run_simulated"]

CALLS = 25
ANSWER_S = 1.5
"""Ours; how long a raw command is waited for."""
QUIET_S, MOVING_S = 3.0, 45.0
"""The vehicle's: between two calls, and until it has come to rest."""
FLIES_BY_ITSELF = ("AUTO", "RTL", "SMART_RTL", "LAND", "MISSION", "TAKEOFF")
BY_ITSELF_S = 150.0
CALM_S = 4
"""The vehicle's, on end: it is noticed to have landed, and disarms, in that time."""
ON_GROUND = 1
C = MavCmd
NAN = math.nan

RAW: tuple[tuple[float, ...], ...] = (
    (31999,), (C.NAV_WAYPOINT,), (C.NAV_LAND,), (C.NAV_RETURN_TO_LAUNCH,), (C.NAV_LOITER_UNLIM,),
    (C.NAV_TAKEOFF, 0, 0, 0, NAN, NAN, NAN, 8), (C.NAV_TAKEOFF,), (C.NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, -5),
    (C.CONDITION_YAW, 90, 20, 1, 0), (C.CONDITION_YAW, 400), (C.DO_CHANGE_SPEED, 1, 3, -1), (C.DO_CHANGE_SPEED, 1, -1),
    (C.DO_REPOSITION, -1, 1), (C.DO_REPOSITION, -1, 0), (C.DO_SET_HOME, 1), (C.REQUEST_MESSAGE, 65000),
    (C.REQUEST_MESSAGE, 148), (C.REQUEST_MESSAGE, 242), (C.REQUEST_MESSAGE, 30), (C.SET_MESSAGE_INTERVAL, 60000, 1e6),
    (C.GET_MESSAGE_INTERVAL, 30), (C.GET_MESSAGE_INTERVAL, 60000), (C.GET_HOME_POSITION,), (C.PREFLIGHT_STORAGE, 1),
    (C.PREFLIGHT_STORAGE, 0), (C.DO_FLIGHTTERMINATION, 0), (C.MISSION_START,), (C.DO_PAUSE_CONTINUE, 0),
    (C.DO_PAUSE_CONTINUE, 1), (C.DO_PAUSE_CONTINUE, 5), (C.DO_ORBIT, 10, 2, 0, NAN, NAN, NAN, NAN), (C.DO_FOLLOW, 1),
    (C.NAV_GUIDED_ENABLE, 1), (C.DO_FENCE_ENABLE, 1), (C.DO_FENCE_ENABLE, 0), (C.DO_GRIPPER, 1, 1),
    (C.DO_SET_RELAY, 0, 1), (C.DO_SET_SERVO, 9, 1500), (C.DO_DIGICAM_CONTROL,), (C.IMAGE_START_CAPTURE,),
    (C.IMAGE_STOP_CAPTURE,), (C.SET_CAMERA_MODE,), (C.SET_CAMERA_ZOOM,), (C.DO_MOUNT_CONTROL,), (C.DO_SET_ROI_NONE,),
    (C.DO_GIMBAL_MANAGER_PITCHYAW,), (C.DO_GIMBAL_MANAGER_CONFIGURE,), (C.REQUEST_AUTOPILOT_CAPABILITIES, 1),
    (C.DO_JUMP_TAG, 1), (C.DO_SET_MISSION_CURRENT, 0), (C.DO_SET_MISSION_CURRENT, 99), (C.DO_AUX_FUNCTION, 300, 2),
    (C.REQUEST_STORAGE_INFORMATION, 1, 1), (C.VIDEO_START_CAPTURE,), (C.DO_VTOL_TRANSITION, 4),
    (C.DO_SET_STANDARD_MODE, 6), (C.DO_SET_STANDARD_MODE, 99), (C.SET_EKF_SOURCE_SET, 1), (C.DO_SET_MODE, 1, 99),
    (C.DO_SET_MODE, 0, 4), (C.DO_AUTOTUNE_ENABLE, 0), (C.DO_WINCH,), (C.RUN_PREARM_CHECKS,),
    (C.DO_MOTOR_TEST, 1, 0, 5, 1), (C.DO_MOTOR_TEST, 1, 0, 500, 1), (C.DO_ENGINE_CONTROL,), (C.CONTROL_HIGH_LATENCY, 0),
    (C.DO_LAND_START,), (C.COMPONENT_ARM_DISARM, 1), (C.COMPONENT_ARM_DISARM, 0), (C.COMPONENT_ARM_DISARM, 5),
    (C.COMPONENT_ARM_DISARM, 1, 21196), (C.DO_SEND_BANNER,), (C.PREFLIGHT_REBOOT_SHUTDOWN, 0), (C.DO_SPRAYER, 0),
    (C.DO_SET_REVERSE, 0), (C.DO_CHANGE_ALTITUDE, 30, 3), (C.DO_SET_SAFETY_SWITCH_STATE, 1), (C.BATTERY_RESET, 1, 90),
    (C.ACTUATOR_TEST, 0, 1, 0, 0, 101), (C.PREFLIGHT_UAVCAN, 1), (C.START_RX_PAIR,), (C.STORAGE_FORMAT, 1, 1),
    (C.CAN_FORWARD, 0), (C.DO_INVERTED_FLIGHT, 1),
)  # fmt: skip
"""Commands with their params; those that are absent are 0."""
# Frames for ArduPilot only: most builds of PX4 ignore the frame, and the simulated PX4 accepts only GLOBAL_INT.
FRAMES = (0, 1, 3, 5, 6, 10, 11, 99)
WITH_A_PLACE = (
    C.DO_REPOSITION,
    C.DO_SET_ROI_LOCATION,
    C.NAV_TAKEOFF,
    C.COMPONENT_ARM_DISARM,
    31999,
)
# Parameters of ArduPilot, and of PX4.
PARAMETERS = {
    True: (("RTL_ALT", 2000.0), ("WPNAV_SPEED", 500.0), ("FENCE_ALT_MAX", 90.0), ("NO_SUCH_NAME", 1.0),
           ("SIM_GPS1_ENABLE", 0.0), ("SIM_GPS1_ENABLE", 1.0), ("FS_OPTIONS", 0.0), ("RTL_ALT", 1500.0)),
    False: (("MIS_TAKEOFF_ALT", 5.0), ("COM_DISARM_LAND", 3.0), ("RTL_RETURN_ALT", 20.0), ("NO_SUCH_NAME", 1.0)),
}  # fmt: skip
# Modes that are not used in the air: with the throttle stick down, the copter falls or does what is not simulated.
NEEDS_STICKS = frozenset(
    ("STABILIZE", "ACRO", "DRIFT", "SPORT", "FLIP", "THROW", "TURTLE", "ZIGZAG", "SYSTEMID", "AUTOTUNE", "GUIDED_NOGPS")
)  # fmt: skip
COPTER_MODES = tuple(mode.name for mode in CopterMode)
PX4_MODES = (
    "MANUAL",
    "ALTCTL",
    "POSCTL",
    "ACRO",
    "STABILIZED",
    "OFFBOARD",
    "TAKEOFF",
    "LOITER",
    "MISSION",
    "RTL",
    "LAND",
)
NOT_COMPARED = re.compile(
    r"PreArm: |EKF|SIM Hit ground|GPS \d|Field Elevation|AHRS: |\[logger\]|Mission: |PERF|Preflight Fail|Ardu|Frame: "
    r"|\S{20,}$|SmartRTL deactivated|Reached command"
)
"""Texts that come by themselves, now and then."""


@dataclass(frozen=True)
class Call:
    """One call, by the name of a function in `DOING`, with its arguments."""

    name: str
    arguments: tuple[object, ...] = ()

    def __str__(self) -> str:
        what = list(self.arguments)
        if self.name in ("command", "command_int"):
            with suppress(ValueError):
                what[0] = MavCmd(int(what[0])).name  # type: ignore[call-overload]
        return f"{self.name}({', '.join(map(str, what))})"


@dataclass(frozen=True)
class Step:
    """Result of a call; the state is that of the vehicle at rest afterwards."""

    call: str
    result: str
    mode: str
    armed: bool
    landed: bool
    texts: tuple[str, ...]


def program(kind: str, seed: int, calls: int = CALLS) -> list[Call]:
    """Random calls, the same for the same seed."""
    rng = random.Random(f"{kind} {seed}")
    is_ardupilot = KINDS[kind].is_ardupilot
    modes = COPTER_MODES if is_ardupilot else PX4_MODES

    def one() -> Call:
        draw = rng.random()
        if draw < 0.30:
            return Call("command", rng.choice(RAW))
        if draw < 0.38:
            place = (rng.choice((0, 20, -20)), rng.choice((0, 15)), rng.choice((8, 12, 500, -3)))
            frame = rng.choice(FRAMES) if is_ardupilot else MavFrame.GLOBAL_INT
            return Call("command_int", (rng.choice(WITH_A_PLACE), int(frame), *place))
        if draw < 0.41:
            return Call("command_to", (rng.choice((0, 99, 154)), rng.choice((C.DO_SEND_BANNER, 31999, C.DO_SET_HOME))))
        if draw < 0.53:
            return Call("set_mode", (rng.choice(modes),))
        if draw < 0.60:
            return Call("parameter", rng.choice(PARAMETERS[is_ardupilot]))
        if draw < 0.64:
            return Call("mission", (rng.choice((0, 2, 4)),))
        name = rng.choices(
            ("arm", "take_off", "go_to", "hold", "land", "return_to_launch", "disarm", "set_speed", "set_heading",
             "start_mission"),
            (4, 5, 3, 2, 2, 2, 1, 1, 1, 2),
        )[0]  # fmt: skip
        arguments = {
            "take_off": (rng.choice((6, 10)),),
            "go_to": (rng.choice((20, -15)), rng.choice((0, 10)), rng.choice((8, 12))),
            "set_speed": (rng.choice((2, 5)),),
            "set_heading": (rng.choice((0, 90, 200)),),
        }
        return Call(name, arguments.get(name, ()))

    up = [Call("set_mode", ("GUIDED",))] if is_ardupilot else []
    up += [Call("arm"), Call("take_off", (rng.choice((6, 10)),))]
    begin = up if rng.random() < 0.6 else []
    return [*begin, *(one() for _ in range(calls - len(begin)))]


class _Runner:
    """Runs the calls on a vehicle; ``speedup`` is the speed of its time relative to ours."""

    def __init__(self, vehicle: Vehicle, speedup: float) -> None:
        self.vehicle, self._scale = vehicle, 1.0 / speedup
        here = vehicle.position.value
        self._here = here
        self._texts: list[str] = []
        vehicle.status_text.observe(lambda _, text: self._texts.append(text.text), every_arrival=True)
        self._doing: dict[str, Callable[..., Awaitable[object]]] = {
            "command": self._command, "command_int": self._command_int, "command_to": self._command_to,
            "set_mode": self._set_mode, "parameter": self._parameter, "mission": self._mission, "go_to": self._go_to,
            "take_off": lambda altitude: vehicle.take_off(altitude, timeout=self.seconds(60)),
            "land": lambda: vehicle.land(timeout=self.seconds(120)),
            "return_to_launch": lambda: vehicle.return_to_launch(timeout=self.seconds(200)),
            "arm": vehicle.arm, "disarm": vehicle.disarm, "hold": vehicle.hold, "set_speed": vehicle.set_speed,
            "set_heading": lambda degrees: vehicle.set_heading(degrees, timeout=self.seconds(40)),
            "start_mission": vehicle.mission.start,
        }  # fmt: skip

    def seconds(self, theirs: float) -> float:
        """Convert to seconds of our time, with a margin for a slow machine."""
        return theirs * self._scale + 5.0

    async def step(self, call: Call) -> Step:
        """Run one call, wait until the vehicle is at rest, and return the result."""
        self._texts.clear()
        result = "cancelled"
        with anyio.move_on_after(self.seconds(300)):
            result = await self._result_of(call)
        await self._rest()
        vehicle = self.vehicle
        landed = vehicle.landed_state.latest == ON_GROUND
        return Step(str(call), result, vehicle.mode.value.name, vehicle.is_armed, landed, self._texts_without_numbers())

    async def _result_of(self, call: Call) -> str:
        try:
            answer = await self._doing[call.name](*call.arguments)
        except CommandRejected as error:
            result = error.result
            name = MavResult(result).name if result in list(MavResult) else str(result)
            return f"{type(error).__name__} {name}"
        except AerokitError as error:
            return type(error).__name__
        return answer if isinstance(answer, str) else "done"

    async def _rest(self) -> None:
        vehicle, wait = self.vehicle, anyio.sleep
        began, has_flown, calm = anyio.current_time(), False, 0
        await wait(QUIET_S * self._scale)
        while vehicle.is_armed:
            has_flown |= vehicle.landed_state.latest != ON_GROUND
            by_itself = has_flown and vehicle.mode.value.name in FLIES_BY_ITSELF
            if anyio.current_time() - began > (BY_ITSELF_S if by_itself else MOVING_S) * self._scale:
                break
            climb, speed = vehicle.climb_m_s.latest or 0.0, vehicle.ground_speed_m_s.latest or 0.0
            changes = vehicle.landed_state.latest in (3, 4)
            calm = calm + 1 if abs(climb) < 0.15 and speed < 0.3 and not changes and not by_itself else 0
            if calm > CALM_S:
                return
            await wait(self._scale)
        await wait(QUIET_S * self._scale)

    def _texts_without_numbers(self) -> tuple[str, ...]:
        texts = (re.sub(r"-?\d+(\.\d+)?", "#", text.strip()) for text in self._texts if not NOT_COMPARED.match(text))
        return tuple(sorted(set(texts)))

    # ------------------------------------------------------------------------------------- calls

    async def _command(self, command: int, *params: float) -> None:
        await self.vehicle.command(int(command), *params, retries=0, attempt_timeout=ANSWER_S)

    async def _command_to(self, component_id: int, command: int) -> None:
        await self.vehicle.command(int(command), 1, component_id=component_id, retries=0, attempt_timeout=ANSWER_S)

    async def _command_int(self, command: int, frame: int, north: float, east: float, z: float) -> None:
        there = self._here.offset(north_m=north, east_m=east)
        x, y = round(there.latitude_deg * 1e7), round(there.longitude_deg * 1e7)
        params = (-1, 1, 0, NAN) if command == C.DO_REPOSITION else ()
        await self.vehicle.command_int(
            int(command), *params, frame=frame, x=x, y=y, z=z, retries=0, attempt_timeout=ANSWER_S
        )

    async def _set_mode(self, name: str) -> str | None:
        if name in NEEDS_STICKS and self.vehicle.landed_state.latest != ON_GROUND:
            return "left out in the air"
        await self.vehicle.set_mode(name)
        return None

    async def _parameter(self, name: str, value: float) -> str:
        written = await self.vehicle.parameters.set(name, value)
        return f"{written.outcome} {written.value:g}"

    async def _mission(self, waypoints: int) -> str:
        items, corner = [], (self._here.latitude_deg, self._here.longitude_deg)
        for number in range(waypoints):
            there = self._here.offset(north_m=15.0 * (1 + number % 2), east_m=10.0 * (number // 2))
            items.append(waypoint(there.latitude_deg, there.longitude_deg, altitude_relative_m=10.0))
        await self.vehicle.mission.upload(
            Mission([take_off(*corner, altitude_relative_m=10.0), *items, land(*corner)] if items else [])
        )
        return "done"

    async def _go_to(self, north: float, east: float, altitude: float) -> None:
        there = self._here.offset(north_m=north, east_m=east)
        target = Position(there.latitude_deg, there.longitude_deg, altitude_relative_m=altitude)
        await self.vehicle.go_to(target, timeout=self.seconds(60))


async def run(vehicle: Vehicle, calls: list[Call], speedup: float) -> list[Step]:
    """Run the calls one after another. PX4 receives heartbeats more often than its 2.5 s limit at any speed."""
    idle = ("DISARM_DELAY", 0.0) if vehicle.autopilot.home_is_item_0 else ("COM_DISARM_PRFLT", -1.0)
    await vehicle.parameters.set(*idle)  # off: a real vehicle takes longer to come to rest
    steps: list[Step] = []
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(_beat, vehicle, 1.0 / speedup)
        runner = _Runner(vehicle, speedup)
        steps = [await runner.step(call) for call in calls]
        tasks.cancel_scope.cancel()
    return steps


async def _beat(vehicle: Vehicle, interval_s: float) -> None:
    while True:
        vehicle.send(m.Heartbeat(6, 8, 0, 0, 4, 3))
        await anyio.sleep(interval_s)


def run_simulated(kind: str, seed: int, speedup: float = 1.0, calls: int = CALLS) -> list[Step]:
    """Run the calls on a simulated vehicle, on virtual time."""

    async def main() -> list[Step]:
        latitude, longitude, altitude, heading = KINDS[kind].home
        there = simulated(kind, home=(latitude, longitude, altitude), heading_deg=heading)
        scale_timeouts([there], speedup)
        async with simulated_link(there, speedup=speedup, latency_s=0.005) as link, connect(link) as vehicle:
            await vehicle.wait_ready(timeout=120)
            return await run(vehicle, program(kind, seed, calls), speedup)

    return run_virtual(main())


async def run_choice(choice: Choice, seed: int, calls: int = CALLS) -> list[Step]:
    """Run on the vehicle of the options: a binary, or an address."""
    async with served(choice) as address, connect(address, timeout=60) as vehicle:
        await vehicle.wait_ready(timeout=choice.seconds(120))
        return await run(vehicle, program(choice.kind.name, seed, calls), choice.speedup)


def differences(real: list[Step], ours: list[Step]) -> list[str]:
    """Compare line by line, up to the first step that ends in different states."""
    found = []
    for number, (one, other) in enumerate(zip(real, ours, strict=True)):
        for what in ("result", "texts", "mode", "armed", "landed"):
            there, here = getattr(one, what), getattr(other, what)
            if there != here:
                found.append(f"{number:2} {one.call}: {what} real {there}, simulated {here}")
        if (one.mode, one.armed, one.landed) != (other.mode, other.armed, other.landed):
            found.append(f"{number:2} from here on their states differ")
            break
    return found


def main() -> int:
    """For the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--vehicle", required=True, help="a binary")
    parser.add_argument("--kind", choices=KINDS, default="copter")
    parser.add_argument("--seeds", default="0-9", help="FIRST-LAST")
    parser.add_argument("--speedup", type=float, default=5.0)
    parser.add_argument("--calls", type=int, default=CALLS)
    parser.add_argument("--keep", type=Path, help="folder for what both did, as JSON")
    options = parser.parse_args()
    first, last = map(int, options.seeds.split("-"))
    choice = Choice(options.vehicle, KINDS[options.kind], options.speedup, False)
    by_call: dict[str, list[int]] = defaultdict(list)
    for seed in range(first, last + 1):
        ours = run_simulated(options.kind, seed, options.speedup, options.calls)
        try:
            real = asyncio.run(run_choice(choice, seed, options.calls))
        except AerokitError as error:
            print(f"seed {seed}: {type(error).__name__}: {error}", flush=True)
            continue
        found = differences(real, ours)
        print(f"seed {seed}: {len(found)} differences", *found, sep="\n  ", flush=True)
        for line in found:
            by_call[line[3:]].append(seed)
        if options.keep:
            options.keep.mkdir(exist_ok=True)
            both = {"real": [asdict(row) for row in real], "ours": [asdict(own) for own in ours]}
            (options.keep / f"{options.kind}-{seed}.json").write_text(json.dumps(both, indent=1))
    print("\nAll of them:")
    for line, seeds in sorted(by_call.items(), key=lambda entry: -len(entry[1])):
        print(f"{len(seeds):3} × {line}  (seeds {', '.join(map(str, seeds[:5]))})")
    return 0


if __name__ == "__main__":
    sys.exit(main())
