"""Cancellation, exceptions and lost links: nothing hangs, no tasks remain, flying members hold."""

from __future__ import annotations

import asyncio
from typing import Any

import anyio
import pytest
from fleet_stage import Stage, open_stage
from flight_harness import attached_sinks, now, waiting_on_cells

from aerokit.connection.opening import open_connection
from aerokit.errors import ConnectionClosed, LinkLost, OperationRejected, SetpointStreamStopped
from aerokit.fleets.events import PolicyApplied, PolicyCompleted
from aerokit.fleets.formation import Formation, Offset
from aerokit.fleets.members import Member, MemberState
from aerokit.fleets.opening import fleet
from aerokit.mavlink.enums import MavCmd
from aerokit.missions import Mission, land, take_off
from aerokit.sim import SimulatedCopter
from aerokit.transport import memory_link_pair
from aerokit.vehicle.vehicle import Vehicle

pytestmark = pytest.mark.anyio


def north(by_m: float) -> Any:
    return lambda member: member.vehicle.position.value.offset(north_m=by_m)


async def test_fleet_exit_during_action_makes_members_hold() -> None:
    flying: asyncio.Task[Any] | None = None
    async with open_stage(3) as stage:
        await stage.take_off()
        flying = asyncio.create_task(stage.fleet.go_to(north(300)))
        await anyio.sleep(3)
        copters = stage.copters
        assert not flying.done()
    result = await asyncio.wait_for(flying, 5)
    assert len(result.failed) == 3
    assert {copter.mode.name for copter in copters.values()} == {"BRAKE"}


async def test_exit_of_fleet_of_vehicles_ends_actions() -> None:
    async with open_stage(3) as stage:
        await stage.take_off()
        async with fleet(dict(zip("abc", stage.fleet.vehicles.values(), strict=True))) as inner:
            flying = asyncio.create_task(inner["a"].go_to(north(300)))

            async def follow() -> None:
                async with inner.following(Formation({"c": Offset(-10)}, "north"), leader="b") as following:
                    await following.wait_stopped()

            followed = asyncio.create_task(follow())
            await anyio.sleep(3)
        assert list((await asyncio.wait_for(flying, 1)).failed) == ["a"]
        with pytest.raises(SetpointStreamStopped, match="the fleet's block has ended"):
            await asyncio.wait_for(followed, 1)
        await anyio.sleep(2)
        assert stage.modes == {"north/1": "BRAKE", "north/2": "GUIDED", "north/3": "BRAKE"}
        with pytest.raises(ConnectionClosed):
            await inner.land()


async def test_fleet_exit_at_policy_ends_action() -> None:
    async with open_stage(3) as stage:
        await stage.take_off()
        copters = stage.copters
        flying = asyncio.create_task(stage.fleet.go_to(north(300)))
        await anyio.sleep(3)
        with stage.fleet.events(PolicyApplied) as events:
            stage.pilot_takes("north/1")
            await events.get(20)
    result = await asyncio.wait_for(flying, 5)
    assert (set(result.failed), set(result.stopped)) == ({"north/1"}, {"north/2", "north/3"})
    assert [copter.mode.name for copter in copters.values()] == ["LOITER", "BRAKE", "BRAKE"]


async def test_link_lost_while_members_are_searched_raises() -> None:
    near, far = memory_link_pair()
    async with open_connection(far) as other:
        asyncio.get_running_loop().call_later(3.0, other.close)
        began = now()
        with pytest.raises(LinkLost):
            async with fleet(near):
                raise AssertionError
        assert now() - began < 5.0


async def test_function_error_that_ends_block_holds_finished_members() -> None:
    async def fly(member: Member) -> None:
        if member.name == "north/1":
            await member.vehicle.go_to(north(5)(member))
        else:
            await anyio.sleep(30)
            raise KeyError("mine")

    stages = []
    with pytest.raises(KeyError, match="mine"):
        async with open_stage(2) as stage:
            stages.append(stage)
            await stage.take_off()
            await stage.fleet.do(fly)
    assert stages[0].modes_ordered("north/1") == ["BRAKE"]


async def test_exception_in_block_propagates_and_members_hold_concurrently() -> None:
    began = 0.0
    copters: list[SimulatedCopter] = []
    flying: list[asyncio.Task[Any]] = []
    with pytest.raises(KeyError, match="mine"):
        async with open_stage(4) as stage:
            await stage.take_off()
            copters += stage.copters.values()
            flying.append(asyncio.create_task(stage.fleet.go_to(north(300))))
            await anyio.sleep(3)
            began = now()
            raise KeyError("mine")
    assert now() - began < 2.5  # concurrently, not one by one
    await asyncio.wait(flying, timeout=1)
    assert [copter.mode.name for copter in copters] == ["BRAKE"] * 4


async def test_lost_link_loses_its_members_and_others_hold() -> None:
    async with open_stage(2, networks=("north", "south")) as stage:
        await stage.take_off()

        async def pull() -> None:
            await anyio.sleep(3)
            stage.wires["south"].lose()

        pulling = asyncio.create_task(pull())
        result = await stage.fleet.go_to(north(300))
        await pulling
        assert set(result.failed) == {"south/1", "south/2"}
        assert set(result.stopped) == {"north/1", "north/2"}
        assert stage.modes["north/1"] == stage.modes["north/2"] == "BRAKE"
        assert stage.fleet.members["south/2"].state is MemberState.LOST
        assert stage.fleet.members["south/1"].reason
        (await stage.fleet.land()).raise_for_errors()


async def test_cancellation_during_policy_lets_landings_continue() -> None:
    async with open_stage(3, on_error="land_others") as stage:
        await stage.take_off()
        stage.copters["north/1"].faults.silent = True
        with anyio.move_on_after(8) as scope:
            await stage.fleet.go_to(north(300))
        assert scope.cancelled_caught
        await anyio.sleep(2)
        assert stage.mode_of("north/2") == stage.mode_of("north/3") == "LAND"  # a landing continues
        await anyio.sleep(30)
        assert stage.copters["north/2"].motion.is_on_ground


@pytest.mark.sampled(3)
@pytest.mark.parametrize("after_s", [0.001, 0.3, 4.0])
async def test_cancelled_action_leaves_no_tasks_or_subscriptions(after_s: float) -> None:
    async with open_stage(3) as stage:
        await stage.take_off()
        vehicles = list(stage.fleet.vehicles.values())
        connection = vehicles[0].connection
        for vehicle in vehicles:
            _ = vehicle.mission, vehicle.guided, vehicle.parameters, vehicle.gimbal
        await stage.fleet.hold()
        await anyio.sleep(3)
        line = Formation.line(["north/2", "north/3"], 8.0, frame="north")

        async def follow() -> None:
            async with stage.fleet.following(line, leader="north/1"):
                await anyio.sleep(20)

        async def wait(member: Member) -> bool:
            await anyio.sleep(20)
            return True

        for action in (
            lambda: stage.fleet.go_to(north(100)),
            lambda: stage.fleet.set_mode("LOITER"),
            lambda: stage.fleet.barrier(lambda _: False),
            lambda: stage.fleet.do(wait, stagger_s=1.0),
            follow,
        ):
            before = attached_sinks(connection), [waiting_on_cells(vehicle) for vehicle in vehicles]
            tasks = len(asyncio.all_tasks())
            started = now()
            with anyio.move_on_after(after_s):
                await action()
            assert now() - started <= after_s + 2.0
            await anyio.sleep(20)
            assert (attached_sinks(connection), [waiting_on_cells(vehicle) for vehicle in vehicles]) == before
            assert len(asyncio.all_tasks()) == tasks
            assert not stage.fleet._context.actions
        assert all(member.is_available for member in stage.fleet)


async def test_exception_in_function_propagates_and_others_hold() -> None:
    async with open_stage(2) as stage:
        await stage.take_off()

        async def wrong(member: Member) -> None:
            if member.name == "north/2":
                await anyio.sleep(2)
                raise ZeroDivisionError
            await member.vehicle.go_to(member.vehicle.position.value.offset(north_m=300))

        with pytest.raises(ZeroDivisionError):
            await stage.fleet.do(wrong)
        await anyio.sleep(2)
        assert stage.mode_of("north/1") == "BRAKE"


async def test_concurrent_actions_newest_order_wins() -> None:
    async with open_stage(2, on_error="continue_others") as stage:
        await stage.take_off()
        first = asyncio.create_task(stage.fleet.go_to(north(300)))
        await anyio.sleep(3)
        second = await stage.fleet["north/1"].hold()
        assert second.is_complete
        await anyio.sleep(1)
        assert stage.modes == {"north/1": "BRAKE", "north/2": "GUIDED"}
        first.cancel()
        with pytest.raises(asyncio.CancelledError):
            await first
        await anyio.sleep(2)
        assert stage.modes == {"north/1": "BRAKE", "north/2": "BRAKE"}
        assert stage.fleet.members["north/1"].is_available


@pytest.mark.parametrize(
    ("policy", "action", "mode"), [("hold_others", "land", "LAND"), ("land_others", "hold", "BRAKE")]
)
async def test_policy_of_older_action_overrules_no_newer_action(policy: str, action: str, mode: str) -> None:
    """A landing of the fleet ends a flight to targets. This is a failure of the flight, whose policy orders nothing."""
    async with open_stage(3, on_error=policy) as stage:
        await stage.take_off()
        older = asyncio.create_task(stage.fleet.go_to(north(300)))
        await anyio.sleep(5)
        assert (await getattr(stage.fleet, action)()).is_complete
        assert not (await older).is_complete
        assert {name: stage.modes_ordered(name) for name in stage.copters} == {name: [mode] for name in stage.copters}


@pytest.mark.parametrize("policy", ["hold_others", "land_others"])
async def test_policy_does_not_stop_landings_of_vehicles(policy: str) -> None:
    async with open_stage(3, on_error=policy) as stage:
        await stage.take_off()
        older = asyncio.create_task(stage.fleet.go_to(north(300)))
        await anyio.sleep(5)
        await asyncio.gather(*(vehicle.land() for vehicle in stage.fleet.vehicles.values()))  # None raises an error.
        assert not (await older).is_complete
        assert {name: stage.modes_ordered(name) for name in stage.copters} == {name: ["LAND"] for name in stage.copters}


async def test_policy_does_not_stop_posted_landings() -> None:
    async with open_stage(3) as stage:
        await stage.take_off()
        older = asyncio.create_task(stage.fleet.go_to(north(300)))
        await anyio.sleep(5)
        mode = stage.fleet.vehicles["north/1"].autopilot.find_mode("LAND")

        async def post_landing(vehicle: Vehicle) -> None:
            with vehicle.posted("mode", modes=(mode,)) as posted:
                await posted.set_mode(mode)

        await asyncio.gather(*map(post_landing, stage.fleet.vehicles.values()))
        assert not (await older).is_complete
        assert {name: stage.modes_ordered(name) for name in stage.copters} == {name: ["LAND"] for name in stage.copters}


async def test_failure_of_released_member_stops_no_others() -> None:
    async with open_stage(3) as stage:
        await stage.take_off()
        flight = asyncio.create_task(stage.fleet.go_to(north(30), stagger_s=3))
        await anyio.sleep(5)
        for name in ("north/2", "north/3"):  # north/2 is on its way, north/3 has not started.
            stage.fleet.release(name)
        await stage.fleet.vehicles["north/2"].hold()
        result = await flight
        assert (set(result.failed), set(result.stopped)) == ({"north/2", "north/3"}, set())
        assert stage.modes_ordered("north/1") == stage.modes_ordered("north/3") == []


async def flight_with_one_arrival(stage: Stage) -> asyncio.Task[Any]:
    """Begin a flight of two members: north/1 is at its target already, and north/2 flies 300 m."""
    await stage.take_off()
    places = {name: vehicle.position.value for name, vehicle in stage.fleet.vehicles.items()}
    targets = {"north/1": places["north/1"], "north/2": places["north/2"].offset(north_m=300)}
    flight = asyncio.create_task(stage.fleet.go_to(targets))
    await anyio.sleep(5)
    return flight


async def test_cancelled_action_does_not_end_newer_orbit() -> None:
    async with open_stage(2) as stage:
        older = await flight_with_one_arrival(stage)
        center = stage.fleet.vehicles["north/1"].position.value.offset(north_m=15)
        orbit = asyncio.create_task(stage.fleet["north/1"].do("orbit", center, radius_m=15))
        await anyio.sleep(2)
        older.cancel()
        await anyio.sleep(2)
        assert not orbit.done()
        assert stage.modes == {"north/1": "GUIDED", "north/2": "BRAKE"}


async def test_cancelled_action_holds_no_member_with_newer_order() -> None:
    async with open_stage(2) as stage:
        older = await flight_with_one_arrival(stage)
        landing = asyncio.create_task(stage.fleet["north/1"].land())
        await anyio.sleep(2)
        older.cancel()
        assert (await landing).is_complete
        assert stage.modes_ordered("north/1") == ["LAND"]


async def test_following_entered_twice_raises() -> None:
    async with open_stage(2) as stage:
        await stage.take_off()
        following = stage.fleet.following(Formation.line(["north/2"], 8.0, frame="north"), leader="north/1")
        async with following:
            pass
        with pytest.raises(Exception, match="entered only once"):
            async with following:
                raise AssertionError
        stage.pilot_takes("north/1")
        await anyio.sleep(2)
        with pytest.raises(OperationRejected, match="the leader north/1 is taken over"):
            stage.fleet.following(Formation.line(["north/2"], 8.0), leader="north/1")


async def test_program_error_in_upload_orders_no_hold(monkeypatch: pytest.MonkeyPatch) -> None:
    async with open_stage(2) as stage:
        await stage.take_off()
        broken = stage.fleet.vehicles["north/2"]

        async def upload(*_: Any, **__: Any) -> None:
            await anyio.sleep(5)
            raise ZeroDivisionError

        monkeypatch.setattr(broken.mission, "upload", upload)
        with pytest.raises(ZeroDivisionError):
            await stage.fleet.upload(dict.fromkeys(stage.copters, Mission([take_off(altitude_relative_m=8), land()])))
        await anyio.sleep(3)
        assert not stage.orders_to("north/1")


async def test_policy_orders_cancelled_by_fleet_exit_are_errors() -> None:
    completed: list[PolicyCompleted] = []
    async with open_stage(2, on_error="land_others") as stage:
        await stage.take_off()
        stage.fleet._context.bus.attach_event(PolicyCompleted, completed.append)
        stage.copters["north/1"].faults.refuse(MavCmd.DO_REPOSITION)
        flying = asyncio.create_task(stage.fleet.go_to(north(300)))
        await anyio.sleep(3)
        assert stage.mode_of("north/2") == "LAND"
    assert [list(event.errors) for event in completed] == [["north/2"]]
    await asyncio.wait([flying], timeout=1)
