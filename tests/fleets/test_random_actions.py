"""Random actions of a fleet and orders of its members at once, with cancellations, faults, releases and a pilot."""

from __future__ import annotations

import asyncio
import math
import random
import re
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Any, get_args

import anyio
import pytest
from fleet_stage import HOME
from flight_harness import Wire, attached_sinks, now, speed_of, waiting_on_cells

from aerokit import messages as m
from aerokit.errors import AerokitError
from aerokit.fleets.events import MemberTakenOver, PolicyApplied, TooClose
from aerokit.fleets.fleet import Fleet, Selection
from aerokit.fleets.formation import Formation
from aerokit.fleets.members import Member
from aerokit.fleets.opening import fleet
from aerokit.fleets.policy import FleetResult, PolicyName
from aerokit.fleets.show import Show
from aerokit.mavlink.enums import CopterMode, MavCmd
from aerokit.missions import Mission, land, take_off, waypoint
from aerokit.position import Position
from aerokit.sim import SimulatedCopter, SimulatedPx4, simulated_link
from aerokit.sim.px4.modes import POSITION

pytestmark = pytest.mark.anyio

MAX_CALL_S, SETTLE_S, MAX_RETURN_S = 120.0, 25.0, 120.0
TAKEOVER_S = 2.0
"""Seconds until every order given to a member has noticed that its pilot took over."""
ENDING = {"land": "land", "return_to_launch": "return", "hold": "hold"}
"""Calls that end a flight, and what they order."""
COPTER_MODES = {"9": "land", "6": "return", "17": "hold"}
PX4_MODES = {"4.6": "land", "4.5": "return", "4.3": "hold"}
COMMANDS = (
    MavCmd.DO_SET_MODE,
    MavCmd.NAV_TAKEOFF,
    MavCmd.DO_REPOSITION,
    MavCmd.COMPONENT_ARM_DISARM,
    MavCmd.MISSION_START,
)
SETPOINTS = (m.SetPositionTargetLocalNed, m.SetPositionTargetGlobalInt)


def kind_of(message: m.CommandLong | m.CommandInt, modes: dict[str, str]) -> str:
    """Say what a command orders."""
    if message.command == MavCmd.DO_SET_MODE:
        number = f"{message.param2:g}" + (f".{message.param3:g}" if message.param3 else "")
        return modes.get(number, f"mode {number}")
    if message.command == MavCmd.COMPONENT_ARM_DISARM:
        return "arm" if message.param1 else "disarm"
    is_hold = isinstance(message, m.CommandLong) and math.isnan(message.param5)
    return "hold" if message.command == MavCmd.DO_REPOSITION and is_hold else MavCmd(message.command).name


@dataclass
class Call:
    """One call of the program, and what became of it. ``first`` and ``last`` are numbers of messages sent."""

    by: str  # fleet, vehicle, posted, or something else that gives no orders
    kind: str
    names: tuple[str, ...]
    begin: Callable[[], Awaitable[Any]]
    began_at: float = math.inf
    ended_at: float = math.inf
    first: int = 0
    last: int = 0
    is_cancelled: bool = False
    errors: dict[str, str] = field(default_factory=dict)
    armed: set[str] = field(default_factory=set)  # at the end of the call

    def has_succeeded(self, name: str) -> bool:
        return not self.is_cancelled and name not in self.errors

    def __str__(self) -> str:
        end = "cancelled" if self.is_cancelled else self.errors or "done"
        return f"{self.began_at:.2f} to {self.ended_at:.2f} {self.by} {self.kind} {', '.join(self.names)}: {end}"


class RandomFlight:
    """A fleet of copters and PX4s, two or three random calls, and what they do wrong."""

    def __init__(self, seed: int) -> None:
        self.rng = random.Random(seed)
        self.policy = self.rng.choice(get_args(PolicyName))
        self.simulated: dict[str, Any] = {}
        for number in range(self.rng.randint(2, 4)):
            kind = SimulatedPx4 if self.rng.random() < 0.4 else SimulatedCopter
            home = (HOME[0], HOME[1] + 10 * number / 75_300, HOME[2])
            self.simulated[f"north/{number + 1}"] = kind(system_id=number + 1, boot_time_s=0.0, home=home, seed=number)
        self.calls: list[Call] = []
        self.events: list[Any] = []
        self.released: dict[str, tuple[float, int]] = {}  # when, and the number of messages sent before
        self.pilots: dict[str, float] = {}
        self.faults: list[str] = []

    async def fly(self) -> None:
        rng = self.rng
        latency_s, min_distance_m = rng.choice((0.0, 0.0, 0.05, 0.2)), rng.choice((None, 3.0))
        async with simulated_link([*self.simulated.values()], latency_s=latency_s) as link:
            self.wire = Wire(link)
            options: dict[str, Any] = {"count": len(self.simulated), "min_distance_m": min_distance_m}
            async with fleet({"north": self.wire}, on_error=self.policy, **options) as self.fleet:
                await self.prepare(self.fleet)
                before = self.resources()
                await self.give_calls()
                await anyio.sleep(SETTLE_S)
                if self.resources() != before:  # A policy's return may continue after the fleet action that caused it.
                    await anyio.sleep(MAX_RETURN_S)
                if any(now > then for now, then in zip(self.resources(), before, strict=True)):
                    self.faults.append(f"left behind: {self.resources()}, before {before}")
                self.judge_events()
                for name in self.simulated:
                    self.judge(name)

    async def prepare(self, flown: Fleet) -> None:
        """Most fleets begin in the air, some with missions."""
        (await flown.wait_ready()).raise_for_errors()
        self.is_in_air = self.rng.random() < 0.6
        self.places = {name: vehicle.position.value for name, vehicle in flown.vehicles.items()}
        for vehicle in flown.vehicles.values():
            _ = vehicle.mission, vehicle.guided, vehicle.parameters
        if self.rng.random() < 0.3:
            await flown.upload(
                {
                    name: Mission(
                        [
                            take_off(place.latitude_deg, place.longitude_deg, altitude_relative_m=8),
                            waypoint(place.offset(north_m=20), altitude_relative_m=8),
                            land(place.latitude_deg, place.longitude_deg),
                        ]
                    )
                    for name, place in self.places.items()
                }
            )
        if self.is_in_air:
            (await flown.arm()).raise_for_errors()
            (await flown.take_off(8)).raise_for_errors()
            await anyio.sleep(3)
            self.places = {name: vehicle.position.value for name, vehicle in flown.vehicles.items()}
        for kind in (MemberTakenOver, PolicyApplied, TooClose):
            flown._context.bus.attach_event(kind, self.events.append)
        self.wire.clear()

    async def give_calls(self) -> None:
        rng, tasks = self.rng, []
        for _ in range(rng.randint(2, 3)):
            self.disturb()
            tasks.append(asyncio.ensure_future(self.give(self.random_call())))
            if delay_s := rng.choice((0.0, 0.0, rng.uniform(0, 0.1), rng.uniform(0, 1.5), rng.uniform(0, 8))):
                await anyio.sleep(delay_s)
        done, pending = await asyncio.wait(tasks, timeout=MAX_CALL_S)
        self.faults += [f"{task.exception()!r}" for task in done if task.exception()]
        self.faults += ["a call does not end"] * len(pending)
        for task in pending:
            task.cancel()

    def disturb(self) -> None:
        """Sometimes lose, delay or refuse the next command of one type to one vehicle, or its answer."""
        faults = self.rng.choice([*self.simulated.values()]).faults
        command, chance = self.rng.choice(COMMANDS), self.rng.random()
        if chance < 0.24:
            (faults.lose_ack, faults.ignore, faults.refuse)[int(chance / 0.08)](command, times=1)
        elif chance < 0.3:
            faults.delay_ack(command, 0.8, times=1)

    def resources(self) -> tuple[int, ...]:
        vehicles, actions = [*self.fleet.vehicles.values()], self.fleet._context.actions
        sinks = attached_sinks(vehicles[0].connection)
        return sinks, *map(waiting_on_cells, vehicles), len(asyncio.all_tasks()), len(actions)

    # ------------------------------------------------------------------------------------- calls

    def random_call(self) -> Call:
        rng, names = self.rng, [*self.simulated]
        if rng.random() < 0.4:
            names = sorted(rng.sample(names, rng.randint(1, len(names) - 1)))
        name, chance = rng.choice(names), rng.random()
        in_air = self.is_in_air
        if chance < 0.63:
            calls = self.fleet_calls(names)
            weights = (1, 1, 4, 3, 2, 2, 1, 1, 2, 1, 1, 3, 2) if in_air else (5, 3, 1, 1, 1, 1, 4, 3, 1, 1, 1, 0, 0)
            kind = rng.choices([*calls], weights)[0]
            return Call("fleet", kind, tuple(names), calls[kind])
        if chance < 0.84:
            calls = self.vehicle_calls(name)
            kind = rng.choices([*calls], (4, 2, 2, 1, 1, 2) if in_air else (2, 1, 1, 4, 2, 1))[0]
            return Call("vehicle", kind, (name,), calls[kind])
        if chance < 0.92:
            kind = rng.choice(("land", "return_to_launch", "arm", "disarm"))
            return Call("posted", kind, (name,), lambda: self.post(name, kind))
        if chance < 0.96 or not in_air:
            return Call("program", "release", (name,), lambda: self.release(name))
        return Call("pilot", "takes over", (name,), lambda: self.pilot_takes(name))

    def fleet_calls(self, names: list[str]) -> dict[str, Callable[[], Awaitable[Any]]]:
        chosen = Selection(self.fleet._context, tuple(names))
        stagger_s, north_m = self.rng.choice((None, None, 0.5, 2.0)), self.rng.choice((5, 60))
        targets = {name: self.places[name].offset(north_m=north_m) for name in names}
        swapped = {name: self.places[other] for name, other in zip(names, reversed(names), strict=True)}

        async def arm(member: Member) -> None:
            await member.vehicle.arm()
            await member.vehicle.take_off(5, timeout=20)

        async def fly_show() -> FleetResult:
            tracks = {name: [(0, 0, 10.0 * i, 8), (2, 2, 10.0 * i, 8)] for i, name in enumerate(names)}
            report = await chosen.fly_show(Show.from_points(tracks), Position(*HOME[:2]), start_in_s=1)
            return report.result

        async def follow() -> None:
            line = Formation.line(names[1:], 8.0, frame="north")
            async with chosen.following(line, leader=names[0]) as following:
                with anyio.move_on_after(6):
                    await following.wait_stopped()

        return {
            "arm": lambda: chosen.arm(stagger_s=stagger_s),
            "take_off": lambda: chosen.take_off(8, timeout=30, stagger_s=stagger_s),
            "go_to": lambda: chosen.go_to(targets, timeout=30, stagger_s=stagger_s),
            "land": lambda: chosen.land(timeout=60, stagger_s=stagger_s),
            "return_to_launch": lambda: chosen.return_to_launch(timeout=60, stagger_s=stagger_s),
            "hold": chosen.hold,
            "disarm": chosen.disarm,
            "function": lambda: chosen.do(arm, stagger_s=stagger_s),
            "show": fly_show,
            "start_missions": lambda: chosen.start_missions(stagger_s=stagger_s),
            "mission.pause": lambda: chosen.do("mission.pause"),
            "follow": follow,
            "swap": lambda: chosen.go_to(swapped, timeout=30),
        }

    def vehicle_calls(self, name: str) -> dict[str, Callable[[], Awaitable[Any]]]:
        vehicle = self.fleet.vehicles[name]
        return {
            "land": lambda: vehicle.land(timeout=60),
            "return_to_launch": lambda: vehicle.return_to_launch(timeout=60),
            "hold": vehicle.hold,
            "disarm": vehicle.disarm,
            "arm": vehicle.arm,
            "go_to": lambda: vehicle.go_to(self.places[name].offset(north_m=60), timeout=30),
        }

    async def post(self, name: str, kind: str) -> None:
        vehicle = self.fleet.vehicles[name]
        if kind in ("arm", "disarm"):
            with vehicle.posted("arm", armed=kind == "arm") as posted:
                await posted.command(MavCmd.COMPONENT_ARM_DISARM, float(kind == "arm"))
            return
        mode = vehicle.autopilot.mode_for("land" if kind == "land" else "return")
        assert mode is not None
        with vehicle.posted("mode", modes=(mode,)) as posted:
            await posted.set_mode(mode)

    async def release(self, name: str) -> None:
        self.released[name] = now(), len(self.wire.sent)
        self.fleet.release(name)
        if self.rng.random() < 0.3:
            await anyio.sleep(2)
            self.fleet.reclaim(name)
            self.released.pop(name, None)

    async def pilot_takes(self, name: str) -> None:
        self.pilots[name] = now()
        simulated = self.simulated[name]
        if isinstance(simulated, SimulatedCopter):
            simulated.rc[2] = 1500
            simulated.set_mode(CopterMode.LOITER)
        else:
            simulated.switch_to(POSITION)

    async def give(self, call: Call) -> None:
        gives_orders = call.by in ("fleet", "vehicle", "posted")
        seconds = self.rng.choice((None, None, None, 0.0, self.rng.uniform(0, 0.3), self.rng.uniform(0, 6)))
        if call.by == "fleet":
            call.names = tuple(name for name in call.names if self.fleet.members[name].is_available)
        call.began_at, call.first = now(), len(self.wire.sent)
        self.calls.append(call)
        result: object = None
        try:
            with anyio.move_on_after(seconds if gives_orders else None) as scope:
                result = await call.begin()
            call.is_cancelled = scope.cancelled_caught
            if isinstance(result, FleetResult):
                self.judge_result(result)
                failures = {**result.failed, **result.stopped, **result.skipped}
                call.errors = {name: str(error) for name, error in failures.items()}
        except AerokitError as error:
            call.errors = dict.fromkeys(call.names, str(error))
        call.ended_at, call.last = now(), len(self.wire.sent)
        call.armed = {name for name in call.names if self.fleet.vehicles[name].is_armed}

    # ------------------------------------------------------------------------------------ faults

    def judge_result(self, result: FleetResult) -> None:
        """An error names its own member, or the one that failed."""
        for name, error in {**result.failed, **result.stopped}.items():
            may_name = {name, *result.failed} if name in result.stopped else {name}
            if not set(re.findall(r"north/\d", str(error))) <= may_name:
                self.faults.append(f"the error of {name} is {error}")

    def judge_events(self) -> None:
        for event in self.events:
            if isinstance(event, MemberTakenOver):
                # PX4 enters a failsafe if the set-points end and the hold after the last one was refused.
                if event.member not in self.pilots and "in a failsafe" not in event.reason:
                    self.faults.append(f"nobody has taken over: {event}")
            elif isinstance(event, PolicyApplied) and any(
                name in self.released and event.at > self.released[name][0] for name in event.orders
            ):
                self.faults.append(f"a policy orders a released member: {event}")

    def judge(self, name: str) -> None:
        simulated, pilot_at = self.simulated[name], self.pilots.get(name)
        number, modes = simulated.system_id, PX4_MODES if isinstance(simulated, SimulatedPx4) else COPTER_MODES
        sent = [
            (index, at, "setpoint" if isinstance(message, SETPOINTS) else kind_of(message, modes))
            for index, (at, message) in enumerate(self.wire.sent)
            if isinstance(message, SETPOINTS)
            or (isinstance(message, (m.CommandLong, m.CommandInt)) and message.command in COMMANDS)
            if message.target_system == number
        ]
        calls = [call for call in self.calls if name in call.names and call.by in ("fleet", "vehicle", "posted")]
        late: list[tuple[int, float, str]] = []
        if pilot_at is not None:
            # A call of the vehicle, or a fleet call from before HEARTBEAT reports the pilot, takes the vehicle back.
            new = [call for call in calls if call.began_at >= pilot_at]
            if not any(call.by != "fleet" or call.began_at < pilot_at + TAKEOVER_S for call in new):
                late = [order for order in sent if order[1] > pilot_at + TAKEOVER_S and simulated.is_armed]
        elif calls:
            late = self.orders_after_newest(name, calls, sent)
        if name in self.released:
            at, first = self.released[name]
            if all(call.ended_at < at - 5 for call in calls):  # The hold of a cancelled call may be repeated.
                late += [order for order in sent if order[0] >= first]
        self.faults += [f"{name} got {order}" for order in late]
        if simulated.is_armed:
            self.judge_armed(name, calls)
        moves = {"land", "return_to_launch", "start_missions"} & {call.kind for call in calls}
        if (
            not moves
            and self.policy in ("hold_others", "continue_others")
            and pilot_at is None
            and speed_of(simulated) > 1
        ):
            self.faults.append(f"{name} moves in the end")

    def orders_after_newest(
        self, name: str, calls: list[Call], sent: list[tuple[int, float, str]]
    ) -> list[tuple[int, float, str]]:
        """Return the orders that undo the newest call, and add a fault if another order has ended this call."""
        newest = calls[-1]
        if any(call.kind == "function" and call.ended_at >= newest.began_at for call in calls[:-1]):
            return []  # The program's function may give orders after the newest call.
        is_ending = newest.kind in ENDING and (newest.by == "fleet" or newest.kind != "hold")
        error = newest.errors.get(name, "")
        is_protected = is_ending or (newest.by == "fleet" and newest.kind in ("go_to", "take_off"))
        is_held = any(isinstance(event, TooClose) for event in self.events)  # The distance monitor overrules any call.
        if is_protected and not is_held and re.search("another order was given|got a newer order", error):
            self.faults.append(f"the newest call was superseded: {newest}")
        if newest.kind == "disarm" and newest.by == "fleet" and newest.has_succeeded(name):
            return [order for order in sent if order[0] >= newest.last and order[2] != "disarm"]
        own = [index for index, _, kind in sent if index >= newest.first and kind == ENDING.get(newest.kind)]
        if not is_ending or not (own or newest.has_succeeded(name)):
            return []
        # A posted change of the mode ends no order to arm.
        allowed = (ENDING[newest.kind], "disarm", "arm" if newest.by == "posted" else "")
        since = own[0] if own else newest.last
        return [order for order in sent if order[0] > since and order[2] not in allowed]

    def judge_armed(self, name: str, calls: list[Call]) -> None:
        """A member is armed only if it was at first, or by an order that was neither cancelled nor overtaken."""
        causes = [number for number, call in enumerate(calls) if call.kind == "function" or self.has_armed(call, name)]
        if not causes and not self.is_in_air:
            self.faults.append(f"{name} is armed in the end")
        later = calls[max(causes, default=-1) + 1 :]
        self.faults += [
            f"{name} is armed after {call}" for call in later if call.kind == "disarm" and call.has_succeeded(name)
        ]

    @staticmethod
    def has_armed(call: Call, name: str) -> bool:
        return call.kind == "arm" and name in call.armed and (call.is_cancelled or call.has_succeeded(name))


@pytest.mark.sampled(15)
@pytest.mark.parametrize("seed", [*range(150), 344])
async def test_random_actions_of_fleet_and_members_break_no_rule(seed: int) -> None:
    flight = RandomFlight(seed)
    await flight.fly()
    assert not flight.faults, (flight.faults, flight.policy, [str(call) for call in flight.calls])
