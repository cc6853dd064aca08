"""Members whose orders wait (staggered starts, corridors) while the event loop is blocked or the computer sleeps."""

from __future__ import annotations

import asyncio
from itertools import pairwise

import anyio
import pytest
from fleet_stage import HOME, Stage, open_stage
from flight_harness import block_loop, suspend_computer

from aerokit.errors import HeartbeatTimeout, InvalidArgument, OperationRejected, SetpointStreamStopped
from aerokit.fleets.formation import Formation
from aerokit.fleets.members import Member
from aerokit.fleets.separation import Deconfliction
from aerokit.fleets.show import Show
from aerokit.mavlink.enums import MavCmd
from aerokit.position import Position
from aerokit.testing.track import min_distance_m, record_track

pytestmark = pytest.mark.anyio


async def ready_in_guided(stage: Stage) -> None:
    (await stage.fleet.wait_ready()).raise_for_errors()
    (await stage.fleet.set_mode("GUIDED")).raise_for_errors()
    stage.clear()


async def test_staggered_member_is_not_armed_after_computer_slept() -> None:
    async with open_stage(2) as stage:
        await ready_in_guided(stage)
        arming = asyncio.ensure_future(stage.fleet.arm(stagger_s=5))
        await anyio.sleep(2)
        suspend_computer(stage.fleet.vehicles["north/1"], 600.0)
        result = await arming
        assert isinstance(result.failed["north/2"], OperationRejected)
        assert "the computer slept" in str(result.failed["north/2"])
        assert not stage.orders_to("north/2")


async def test_staggered_member_is_not_armed_after_blocked_loop_without_heartbeat() -> None:
    async with open_stage(2) as stage:
        await ready_in_guided(stage)
        arming = asyncio.ensure_future(stage.fleet.arm(stagger_s=5))
        await anyio.sleep(2)
        for copter in stage.copters.values():
            copter.faults.silent = True
        block_loop(14.0)
        result = await arming
        assert isinstance(result.failed["north/2"], HeartbeatTimeout)
        assert not stage.orders_to("north/2")


async def test_staggered_members_start_apart_after_blocked_loop() -> None:
    async with open_stage(4) as stage:
        await ready_in_guided(stage)
        asyncio.get_running_loop().call_later(1.0, block_loop, 4.0)
        (await stage.fleet.arm(stagger_s=2)).raise_for_errors()
        starts = sorted(stage.orders_to(name)[0][0] for name in stage.copters)
        assert all(later - earlier > 1.99 for earlier, later in pairwise(starts))


async def test_staggered_member_that_was_lost_does_not_start() -> None:
    """It has failed, even if it is back before its start."""
    async with open_stage(3, on_error="continue_others") as stage:
        await stage.take_off()
        targets = {name: vehicle.position.value for name, vehicle in stage.fleet.vehicles.items()}
        flight = asyncio.create_task(stage.fleet.go_to(targets, stagger_s=10))
        await anyio.sleep(3)
        stage.copters["north/3"].faults.silent = True
        await anyio.sleep(6)
        stage.copters["north/3"].faults.silent = False
        assert list((await flight).failed) == ["north/3"]
        assert stage.orders_to("north/3") == []
        assert stage.fleet.members["north/3"].is_available


@pytest.mark.parametrize("by_fleet", [True, False])
async def test_staggered_arming_ends_when_program_disarms(by_fleet: bool) -> None:
    async with open_stage(3) as stage:
        await ready_in_guided(stage)
        arming = asyncio.create_task(stage.fleet.arm(stagger_s=5))
        await anyio.sleep(1)
        if by_fleet:
            await stage.fleet.disarm()
        else:
            await asyncio.gather(*(vehicle.disarm() for vehicle in stage.fleet.vehicles.values()))
        assert not (await arming).is_complete
        assert not any(copter.is_armed for copter in stage.copters.values())


@pytest.mark.parametrize("action", ["land", "hold"])
async def test_waiting_member_with_newer_order_does_not_start(action: str) -> None:
    async with open_stage(2, on_error="continue_others") as stage:
        await stage.take_off()
        targets = {name: vehicle.position.value for name, vehicle in stage.fleet.vehicles.items()}
        flight = asyncio.create_task(stage.fleet.go_to(targets, stagger_s=3))
        await anyio.sleep(1)
        newer = asyncio.create_task(getattr(stage.fleet["north/2"], action)())
        assert "got a newer order before it started" in str((await flight).failed["north/2"])
        assert (await newer).is_complete
        assert stage.modes_ordered("north/2") == ["LAND" if action == "land" else "BRAKE"]


async def test_newer_hold_ends_staggered_landing() -> None:
    async with open_stage(2) as stage:
        await stage.take_off()
        landing = asyncio.create_task(stage.fleet.land(stagger_s=3))
        await anyio.sleep(1)
        await stage.fleet["north/2"].hold()
        assert "got a newer order before it started" in str((await landing).failed["north/2"])
        assert stage.modes_ordered("north/2") == ["BRAKE"]


async def test_staggered_members_that_were_landing_before_start() -> None:
    async with open_stage(2) as stage:
        await stage.take_off()
        with anyio.move_on_after(2):
            await stage.fleet.land()
        assert stage.modes == dict.fromkeys(stage.copters, "LAND")
        targets = {name: vehicle.position.value for name, vehicle in stage.fleet.vehicles.items()}
        assert (await stage.fleet.go_to(targets, stagger_s=2)).is_complete


async def test_corridor_member_reclaimed_before_start_does_not_start() -> None:
    async with open_stage(3, min_distance_m=6.0, on_error="continue_others") as stage:
        targets = await crossing_targets(stage)
        plan = stage.fleet.plan_separation(targets, by="corridors", speed_m_s=5, slack_s=1)
        flight = asyncio.create_task(stage.fleet.go_to(targets, speed_m_s=5, separation=plan))
        delayed = max(plan.delays_s, key=lambda name: plan.delays_s[name])
        await anyio.sleep(plan.delays_s[delayed] / 3)
        stage.pilot_takes(delayed)
        await anyio.sleep(plan.delays_s[delayed] / 3)
        stage.fleet.reclaim(delayed)
        assert list((await flight).failed) == [delayed]
        assert stage.mode_of(delayed) == "LOITER"


async def crossing_targets(stage: Stage) -> dict[str, Position]:
    """Return targets on three paths of the same length that cross at their middles."""
    await stage.take_off()
    middle = stage.fleet.vehicles["north/2"]
    await middle.go_to(middle.position.value.offset(north_m=-12.4))
    stage.clear()
    offsets = {"north/1": (60.0, 60.0), "north/2": (84.8, 0.0), "north/3": (60.0, -60.0)}
    return {
        name: stage.fleet.vehicles[name].position.value.offset(north_m=north_m, east_m=east_m)
        for name, (north_m, east_m) in offsets.items()
    }


def plan_corridors(stage: Stage, targets: dict[str, Position]) -> Deconfliction:
    plan = stage.fleet.plan_separation(targets, min_distance_m=8, by="corridors", speed_m_s=5, slack_s=1)
    assert plan.delays_s == {"north/1": 0.0, "north/2": 3.0, "north/3": 6.0}
    return plan


async def test_member_late_in_its_corridor_does_not_start() -> None:
    """The event loop is blocked from the end of one delay to that of the other."""
    async with open_stage(3, spacing_m=30) as stage:
        targets = await crossing_targets(stage)
        plan = plan_corridors(stage, targets)
        tracks = [record_track(stage.copters[name]) for name in ("north/2", "north/3")]
        asyncio.get_running_loop().call_later(2.9, block_loop, 3.2)
        result = await stage.fleet.go_to(targets, separation=plan, speed_m_s=5)
        assert set(result.failed) == {"north/2"}
        assert "s late, so it stays" in str(result.failed["north/2"])
        assert min_distance_m(*tracks)[0] > 8
        assert not [order for _, order in stage.orders_to("north/2") if order.command == MavCmd.DO_REPOSITION]


async def test_stagger_with_corridors_is_refused() -> None:
    async with open_stage(3, spacing_m=30) as stage:
        targets = await crossing_targets(stage)
        with pytest.raises(InvalidArgument, match="stagger_s would change the delays of corridors"):
            await stage.fleet.go_to(targets, separation=plan_corridors(stage, targets), speed_m_s=5, stagger_s=3)
        assert not any(map(stage.orders_to, stage.copters))


async def test_corridors_at_another_speed_are_refused() -> None:
    async with open_stage(3, spacing_m=30) as stage:
        targets = await crossing_targets(stage)
        with pytest.raises(InvalidArgument, match="planned for 5 m/s; nothing was sent"):
            await stage.fleet.go_to(targets, separation=plan_corridors(stage, targets), speed_m_s=1.5)
        assert not any(map(stage.orders_to, stage.copters))


async def post_landing(stage: Stage, name: str) -> None:
    vehicle = stage.fleet.vehicles[name]
    mode = vehicle.autopilot.find_mode("LAND")
    with vehicle.posted("mode", modes=(mode,)) as posted:
        await posted.set_mode(mode)


@pytest.mark.parametrize("is_posted", [True, False])
@pytest.mark.parametrize("stagger_s", [None, 2.0])
async def test_landing_ordered_before_member_starts_is_not_overruled(is_posted: bool, stagger_s: float | None) -> None:
    """The tasks of a fleet action begin after its call, so the landing may be ordered before them."""
    async with open_stage(2, on_error="continue_others") as stage:
        await stage.take_off()
        targets = {name: vehicle.position.value for name, vehicle in stage.fleet.vehicles.items()}
        result, _ = await asyncio.gather(
            stage.fleet.go_to(targets, stagger_s=stagger_s),
            post_landing(stage, "north/2") if is_posted else stage.fleet.vehicles["north/2"].land(),
        )
        assert "got a newer order before it started" in str(result.failed["north/2"])
        assert stage.modes_ordered("north/2") == ["LAND"]


async def test_older_flight_of_same_moment_is_not_sent() -> None:
    async with open_stage(2, on_error="continue_others") as stage:
        await stage.take_off()
        targets = {name: vehicle.position.value for name, vehicle in stage.fleet.vehicles.items()}
        flight, hold = await asyncio.gather(stage.fleet.go_to(targets), stage.fleet["north/2"].hold())
        assert "got a newer order before it started" in str(flight.failed["north/2"])
        assert hold.is_complete
        assert [order.command for _, order in stage.orders_to("north/2")] == [MavCmd.DO_SET_MODE]


async def test_newer_flight_overrules_function_of_same_moment() -> None:
    async def land(member: Member) -> None:
        await member.vehicle.land()

    async with open_stage(2) as stage:
        await stage.take_off()
        targets = {name: vehicle.position.value for name, vehicle in stage.fleet.vehicles.items()}
        _, flight = await asyncio.gather(stage.fleet.do(land), stage.fleet.go_to(targets))
        assert flight.is_complete


async def test_newer_flight_overrules_landing_of_same_moment() -> None:
    async with open_stage(2) as stage:
        await stage.take_off()
        targets = {name: vehicle.position.value for name, vehicle in stage.fleet.vehicles.items()}
        _, flight = await asyncio.gather(stage.fleet.land(), stage.fleet.go_to(targets))
        assert flight.is_complete


async def test_staggered_arming_continues_during_change_of_mode() -> None:
    async with open_stage(3) as stage:
        await ready_in_guided(stage)
        results = await asyncio.gather(stage.fleet.arm(stagger_s=1), stage.fleet.set_mode("LOITER"))
        assert all(result.is_complete for result in results)
        assert all(copter.is_armed for copter in stage.copters.values())


async def test_function_named_arm_starts_after_program_armed_member() -> None:
    started: list[str] = []

    async def arm(member: Member) -> None:
        started.append(member.name)

    async with open_stage(2) as stage:
        await ready_in_guided(stage)
        action = asyncio.create_task(stage.fleet.do(arm, stagger_s=5))
        await anyio.sleep(1)
        await stage.fleet.vehicles["north/2"].arm()
        assert (await action).is_complete
        assert started == ["north/1", "north/2"]


async def test_waiting_function_does_not_start_after_program_disarmed() -> None:
    async def fly(member: Member) -> None:
        await member.vehicle.arm()

    async with open_stage(2) as stage:
        await ready_in_guided(stage)
        flight = asyncio.create_task(stage.fleet.do(fly, stagger_s=2))
        await anyio.sleep(1)
        await stage.fleet.vehicles["north/2"].disarm()
        assert "got a newer order before it started" in str((await flight).failed["north/2"])
        assert not stage.copters["north/2"].is_armed


async def test_show_does_not_overrule_newer_landing_that_waits() -> None:
    async with open_stage(2) as stage:
        await stage.take_off()
        show = Show.from_points({"north/2": [(0, 0, 10, 10), (4, 4, 10, 10)]})
        flight = asyncio.create_task(stage.fleet.fly_show(show, Position(*HOME[:2])))
        await anyio.sleep(0.1)
        landing = asyncio.create_task(stage.fleet.land(stagger_s=4))
        with pytest.raises(OperationRejected, match="got a newer order meanwhile; the show was not started"):
            await flight
        assert (await landing).is_complete
        assert stage.modes_ordered("north/2") == ["LAND"]


@pytest.mark.parametrize("by_fleet", [True, False])
async def test_following_does_not_overrule_landing_of_same_moment(by_fleet: bool) -> None:
    async with open_stage(2, on_error="continue_others") as stage:
        await stage.take_off()
        line = Formation.line(["north/2"], 8.0, frame="north")
        async with stage.fleet.following(line, leader="north/1") as following:
            await (stage.fleet if by_fleet else stage.fleet.vehicles["north/2"]).land()
            with pytest.raises(SetpointStreamStopped, match="north/2 got a newer order before it started"):
                following.raise_if_stopped()
        assert stage.modes_ordered("north/2") == ["LAND"]


async def test_following_left_at_once_is_no_running_action() -> None:
    """Its task is cancelled before it begins."""
    async with open_stage(2) as stage:
        await stage.take_off()
        async with stage.fleet.following(Formation.line(["north/2"], 8.0, frame="north"), leader="north/1"):
            pass
        assert not stage.fleet._context.actions
        assert not stage.orders_to("north/2")
