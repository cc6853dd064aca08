"""Crossing paths, distances in flight, missions, formations, corrections."""

from __future__ import annotations

import asyncio
import math
from typing import Any

import anyio
import pytest
from fleet_stage import HOME, Stage, open_stage

from aerokit import messages as m
from aerokit.errors import (
    FleetError,
    InvalidArgument,
    LinkLost,
    OperationRejected,
    SetpointStreamStopped,
    ValueUnknownError,
)
from aerokit.fleets.events import FollowingStopped, PathsCompared, PolicyCompleted, TooClose
from aerokit.fleets.formation import Formation, Offset, follow_velocity
from aerokit.fleets.members import MemberState
from aerokit.fleets.opening import fleet
from aerokit.mavlink.enums import MavCmd
from aerokit.missions import Mission, land, region_of_interest, return_to_launch, take_off, waypoint
from aerokit.position import Position
from aerokit.protocols.rtcm import crc24q
from aerokit.sim import SimulatedPx4, simulated_link
from aerokit.sim.px4.modes import POSITION, custom_mode
from aerokit.testing.track import min_distance_m, record_track

pytestmark = pytest.mark.anyio


def swapped(stage: Stage) -> dict[str, Position]:
    here = {name: vehicle.position.value for name, vehicle in stage.fleet.vehicles.items()}
    one, other = here
    return {one: here[other], other: here[one]}


async def test_go_to_swapped_positions_flies_in_layers() -> None:
    async with open_stage(2, spacing_m=40, min_distance_m=5.0) as stage:
        await stage.take_off()
        tracks = [record_track(copter) for copter in stage.copters.values()]
        targets = swapped(stage)
        (await stage.fleet.go_to(targets)).raise_for_errors()
        assert min_distance_m(*tracks)[0] > 4.0
        for name, target in targets.items():
            assert stage.fleet.vehicles[name].distance_to(target) < 2
        (received,) = stage.events(PathsCompared)
        assert received.deconfliction.decision == "layers"
        assert "north/1 and north/2" in received.deconfliction.reason
        assert not stage.events(TooClose)


async def test_go_to_in_layers_lists_skipped_members() -> None:
    async with open_stage(3, spacing_m=40, min_distance_m=5.0) as stage:
        await stage.take_off()
        here = {name: vehicle.position.value for name, vehicle in stage.fleet.vehicles.items()}
        stage.fleet.release("north/3", "it films")
        targets = {"north/1": here["north/2"], "north/2": here["north/1"], "north/3": here["north/3"]}
        result = await stage.fleet.go_to(lambda member: targets[member.name])
        assert list(result) == ["north/1", "north/2"]
        assert result.skipped == {"north/3": "released: it films"}
        (received,) = stage.events(PathsCompared)
        assert received.deconfliction.decision == "layers"


async def test_go_to_refused_separation_sends_nothing() -> None:
    async with open_stage(2, spacing_m=40, min_distance_m=5.0) as stage:
        await stage.take_off()
        plan = stage.fleet.plan_separation(swapped(stage), by="refuse")
        assert plan.decision == "refused"
        with pytest.raises(OperationRejected, match=r"^go_to: .* come too close; nothing was sent$"):
            await stage.fleet.go_to(swapped(stage), separation=plan)
        onto = {"north/1": stage.fleet.vehicles["north/2"].position.value}
        with pytest.raises(OperationRejected, match="north/2"):
            await stage.fleet.go_to(onto)
        assert not stage.orders_to("north/1")
        with pytest.raises(InvalidArgument, match="speed_m_s"):
            stage.fleet.plan_separation(onto, by="corridors")


async def test_go_to_after_release_of_planned_member_sends_nothing() -> None:
    async with open_stage(2, spacing_m=40, min_distance_m=5.0) as stage:
        await stage.take_off()
        targets = swapped(stage)
        plan = stage.fleet.plan_separation(targets)
        stage.fleet.release("north/2", "it films")
        with pytest.raises(OperationRejected, match=r"north/2 became unavailable after .* planned; nothing was sent"):
            await stage.fleet.go_to(targets, separation=plan)
        assert not stage.orders_to("north/1")


async def test_go_to_after_obstacle_moved_into_plan_sends_nothing() -> None:
    async with open_stage(3, spacing_m=30, min_distance_m=5.0) as stage:
        await stage.take_off()
        here = {name: vehicle.position.value for name, vehicle in stage.fleet.vehicles.items()}
        targets = {name: here[name].offset(north_m=60) for name in ("north/1", "north/2")}
        plan = stage.fleet.plan_separation(targets)
        assert plan.decision == "clear"
        await stage.fleet.vehicles["north/3"].go_to(here["north/1"].offset(north_m=30))
        with pytest.raises(OperationRejected, match="planned for another place of north/3; nothing was sent"):
            await stage.fleet.go_to(targets, separation=plan)
        assert not stage.orders_to("north/1")


async def test_following_whose_entry_failed_is_not_running() -> None:
    async with open_stage(2) as stage:
        await stage.take_off()
        following = stage.fleet.following(Formation.line(["north/2"], 10), leader="north/1")
        stage.pilot_takes("north/1")
        await anyio.sleep(2)
        with pytest.raises(OperationRejected, match="the leader north/1 is taken over"):
            await following.__aenter__()
        assert not following.is_running


async def test_go_to_with_corridors_delays_starts() -> None:
    async with open_stage(2, spacing_m=30) as stage:
        await stage.take_off()
        one, other = (vehicle.position.value for vehicle in stage.fleet.vehicles.values())
        targets = {
            "north/1": one.offset(north_m=30, east_m=30),
            "north/2": other.offset(north_m=30, east_m=-30),
        }
        plan = stage.fleet.plan_separation(targets, min_distance_m=8, by="corridors", speed_m_s=5, slack_s=2)
        assert plan.decision == "corridors"
        assert plan.delays_s["north/2"] >= 3
        tracks = [record_track(copter) for copter in stage.copters.values()]
        (await stage.fleet.go_to(targets, separation=plan, speed_m_s=5)).raise_for_errors()
        assert min_distance_m(*tracks)[0] > 7


async def test_too_close_members_hold_if_program_flies_them() -> None:
    async with open_stage(3, spacing_m=20, min_distance_m=6.0) as stage:
        await stage.take_off()
        stage.pilot_takes("north/2")
        stage.clear()
        one = stage.fleet.vehicles["north/1"]
        with pytest.raises(OperationRejected, match="another order"):
            await one.go_to(stage.fleet.vehicles["north/3"].position.value)  # the vehicle's own go_to compares no paths
        await anyio.sleep(3)
        first = stage.events(TooClose)
        assert [(event.member, event.other, event.ordered) for event in first] == [("north/1", "north/2", ("north/1",))]
        assert first[0].distance_m < 6
        assert stage.modes == {"north/1": "BRAKE", "north/2": "LOITER", "north/3": "GUIDED"}
        assert stage.orders_to("north/2") == []


async def test_too_close_report_only_sends_no_orders() -> None:
    async with open_stage(2, spacing_m=20, min_distance_m=6.0, on_too_close="report") as stage:
        await stage.take_off()
        vehicle = stage.fleet.vehicles["north/1"]
        await vehicle.go_to(stage.fleet.vehicles["north/2"].position.value.offset(east_m=-3))
        await vehicle.go_to(vehicle.position.value.offset(east_m=-15))
        await vehicle.go_to(vehicle.position.value.offset(east_m=15))
        received = stage.events(TooClose)
        assert [frame.ordered for frame in received] == [(), ()]  # once for each approach
        assert stage.mode_of("north/2") == "GUIDED"


def mission_of(row: float) -> Mission:
    spot = Position(*HOME[:2]).offset(north_m=10 + row, east_m=row)
    return Mission(
        [
            take_off(altitude_relative_m=8),
            waypoint(spot.latitude_deg, spot.longitude_deg, altitude_relative_m=8),
            land(),
        ]
    )


async def test_missions_upload_and_start_together() -> None:
    async with open_stage(3) as stage:
        missions = {name: mission_of(10.0 * number) for number, name in enumerate(stage.copters)}
        with pytest.raises(OperationRejected, match=r"call upload\(\) first"):
            await stage.fleet.start_missions()
        (await stage.fleet.wait_ready()).raise_for_errors()
        (await stage.fleet.upload(missions)).raise_for_errors()
        with pytest.raises(OperationRejected, match="members not armed: north/1, north/2, north/3"):
            await stage.fleet.start_missions()
        (await stage.fleet.arm()).raise_for_errors()
        (await stage.fleet.start_missions()).raise_for_errors()
        starts = [
            at
            for name in stage.copters
            for at, command in stage.orders_to(name)
            if command.command == MavCmd.MISSION_START
        ]
        assert len(starts) == 3
        assert max(starts) - min(starts) < 0.5
        (await stage.fleet.wait_missions_finished(timeout=200)).raise_for_errors()
        assert all(copter.motion.is_on_ground for copter in stage.copters.values())
        assert all(member.state is MemberState.ACTIVE for member in stage.fleet)


async def test_start_missions_after_failed_upload_starts_none() -> None:
    async with open_stage(2, on_error="continue_others") as stage:
        missions = {name: mission_of(10.0 * number) for number, name in enumerate(stage.copters)}
        (await stage.fleet.wait_ready()).raise_for_errors()
        (await stage.fleet.upload(missions)).raise_for_errors()
        (await stage.fleet.arm()).raise_for_errors()
        stage.copters["north/2"].faults.silent = True
        changed = {name: mission_of(5 + 10.0 * number) for number, name in enumerate(stage.copters)}
        with pytest.raises(FleetError, match="north/2"):
            await stage.fleet.upload(changed)
        stage.copters["north/2"].faults.silent = False
        with pytest.raises(OperationRejected, match=r"the last upload failed, .* call upload\(\) first"):
            await stage.fleet.start_missions()
        assert all(copter.motion.is_on_ground for copter in stage.copters.values())


async def test_start_missions_after_concurrent_uploads_starts_newest_only() -> None:
    """The missions of both uploads lead to the same place, and were not compared with each other."""
    async with open_stage(2, min_distance_m=5.0) as stage:
        (await stage.fleet.wait_ready()).raise_for_errors()
        (await stage.fleet.arm()).raise_for_errors()
        uploads = [asyncio.create_task(stage.fleet.upload({name: mission_of(30)})) for name in stage.copters]
        for upload in uploads:
            await upload
        assert list(await stage.fleet.start_missions()) == ["north/2"]


async def test_upload_that_ends_after_newer_one_voids_it() -> None:
    async with open_stage(2) as stage:
        (climb, place, landing) = mission_of(10)
        long = Mission([climb, *[place] * 50, landing])
        older = asyncio.create_task(stage.fleet.upload(dict.fromkeys(stage.copters, long), max_concurrent=1))
        await anyio.sleep(0.01)
        await stage.fleet.upload({"north/2": mission_of(20)})
        await older
        with pytest.raises(OperationRejected, match="call upload"):
            await stage.fleet.start_missions()


async def test_upload_that_ends_during_newer_one_voids_it() -> None:
    async with open_stage(3) as stage:
        (climb, place, landing) = mission_of(10)
        older_missions = {"north/1": Mission([climb, *[place] * 50, landing]), "north/2": mission_of(10)}
        newer_missions = {"north/2": mission_of(20), "north/3": Mission([climb, *[place] * 200, landing])}
        older = asyncio.create_task(stage.fleet.upload(older_missions, max_concurrent=1))
        await anyio.sleep(0.01)
        newer = asyncio.create_task(stage.fleet.upload(newer_missions))
        await older
        assert not newer.done()
        await newer
        with pytest.raises(OperationRejected, match="call upload"):
            await stage.fleet.start_missions()


async def test_older_upload_that_replaces_nothing_voids_nothing() -> None:
    async with open_stage(2) as stage:
        (await stage.fleet.wait_ready()).raise_for_errors()
        (await stage.fleet.arm()).raise_for_errors()
        (climb, place, landing) = mission_of(10)
        long = Mission([climb, *[place] * 300, landing])
        older = asyncio.create_task(stage.fleet.upload({"north/2": mission_of(10), "north/1": long}))
        await anyio.sleep(0.01)
        await stage.fleet.upload({"north/2": mission_of(20)})
        assert not older.done()
        await older
        assert list(await stage.fleet.start_missions()) == ["north/2"]


@pytest.mark.parametrize("cause", ["upload", "reboot", "download"])
async def test_start_missions_after_plan_was_replaced_starts_none(cause: str) -> None:
    async with open_stage(2) as stage:
        (await stage.fleet.wait_ready()).raise_for_errors()
        await stage.fleet.upload({name: mission_of(10.0 * number) for number, name in enumerate(stage.copters)})
        vehicle = stage.fleet.vehicles["north/2"]
        if cause == "upload":
            await vehicle.mission.upload(mission_of(0))
        elif cause == "reboot":
            await vehicle.reboot()
            await vehicle.wait_ready()
        else:  # A download does not change the plan.
            await vehicle.mission.download(method="items")
        (await stage.fleet.arm()).raise_for_errors()
        if cause == "download":
            (await stage.fleet.start_missions()).raise_for_errors()
            return
        with pytest.raises(OperationRejected, match="mission of north/2 may have been replaced"):
            await stage.fleet.start_missions()
        assert all(copter.motion.is_on_ground for copter in stage.copters.values())


async def test_mission_replaced_during_upload_of_others_is_not_started() -> None:
    async with open_stage(2) as stage:
        (await stage.fleet.wait_ready()).raise_for_errors()
        (await stage.fleet.arm()).raise_for_errors()
        (climb, place, landing) = mission_of(10)
        long = Mission([climb, *[place] * 300, landing])
        upload = asyncio.create_task(stage.fleet.upload({"north/1": long, "north/2": mission_of(10)}))
        await anyio.sleep(0.01)
        await stage.fleet.vehicles["north/2"].mission.upload(mission_of(20))  # begins after the fleet's upload
        assert not upload.done()
        await upload
        with pytest.raises(OperationRejected, match="mission of north/2 may have been replaced"):
            await stage.fleet.start_missions()


async def test_mission_replaced_before_delayed_start_is_not_started() -> None:
    async with open_stage(2) as stage:
        (await stage.fleet.wait_ready()).raise_for_errors()
        await stage.fleet.upload({name: mission_of(10) for name in stage.copters})
        (await stage.fleet.arm()).raise_for_errors()
        start = asyncio.create_task(stage.fleet.start_missions(stagger_s=5.0))
        await anyio.sleep(2)
        await stage.fleet.vehicles["north/2"].mission.upload(mission_of(20))
        assert "replaced before its delayed start" in str((await start)["north/2"])
        assert stage.mode_of("north/2") != "AUTO"


async def test_mission_with_other_count_is_not_started() -> None:
    """Another station has replaced the plan over a link of its own, so that no MISSION_ACK arrives here."""
    async with open_stage(2) as stage:
        (await stage.fleet.wait_ready()).raise_for_errors()
        await stage.fleet.upload({name: mission_of(10) for name in stage.copters})
        (await stage.fleet.arm()).raise_for_errors()
        (climb, place, landing) = mission_of(10)
        replacement = Mission([climb, place, place, landing])
        stage.copters["north/2"].missions.replace(0, replacement.to_items(home_is_item_0=True))
        await anyio.sleep(2)
        with pytest.raises(OperationRejected, match="mission of north/2 may have been replaced"):
            await stage.fleet.start_missions()


async def test_px4_mission_with_other_id_is_not_started() -> None:
    px4s = [SimulatedPx4(system_id=system_id, boot_time_s=1.0, seed=system_id) for system_id in (1, 2)]
    async with simulated_link(px4s) as link, fleet({"south": link}, count=2) as both:
        (await both.wait_ready()).raise_for_errors()
        here = both.vehicles["south/2"].position.value

        def plan(altitude_m: float) -> Mission:
            return Mission([waypoint(here.latitude_deg, here.longitude_deg, altitude_relative_m=altitude_m)])

        await both.upload({name: plan(10) for name in both.vehicles})
        (await both.arm()).raise_for_errors()
        px4s[1].missions.store(0, plan(50).to_items())
        await anyio.sleep(2)
        with pytest.raises(OperationRejected, match="mission of south/2 may have been replaced"):
            await both.start_missions()


async def test_upload_conflicting_missions_is_rejected() -> None:
    async with open_stage(2, min_distance_m=5.0) as stage:
        (await stage.fleet.wait_ready()).raise_for_errors()
        with pytest.raises(OperationRejected, match="come too close"):
            await stage.fleet.upload({"north/1": mission_of(10), "north/2": mission_of(10)})
        (received,) = stage.events(PathsCompared)
        assert received.deconfliction.conflicts[0].distance_m == pytest.approx(0, abs=0.1)


async def test_compare_missions_counts_unlisted_conflicts() -> None:
    async with open_stage(4, min_distance_m=5.0) as stage:
        (await stage.fleet.wait_ready()).raise_for_errors()
        deconfliction = stage.fleet.compare_missions(dict.fromkeys(stage.copters, mission_of(10)))
        assert len(deconfliction.conflicts) == 6
        assert "and 3 more pairs come too close" in deconfliction.reason


async def test_formation_is_formed_and_kept_while_leader_moves() -> None:
    async with open_stage(4) as stage:
        await stage.take_off()
        names = ["north/2", "north/3", "north/4"]
        wedge = Formation.wedge(names, 8.0, frame="north")
        (await stage.fleet.form(wedge, leader="north/1")).raise_for_errors()
        leader = stage.fleet.vehicles["north/1"]
        here = leader.position.value
        for name in names:
            offset = wedge.offsets[name]
            place = here.offset(north_m=offset.north_m, east_m=offset.east_m)
            assert stage.fleet.vehicles[name].distance_to(place) < 2.5
        async with stage.fleet.following(wedge, leader="north/1") as following:
            await leader.go_to(here.offset(north_m=80), speed_m_s=5)
            await anyio.sleep(8)
            assert following.is_running
            assert all(following.error_m(name) < 1.5 for name in names)
        assert {stage.mode_of(name) for name in names} == {"BRAKE"}
        assert stage.mode_of("north/1") == "GUIDED"


@pytest.mark.parametrize("policy", ["hold_others", "land_others"])
async def test_following_leader_taken_over_makes_followers_hold(policy: str) -> None:
    async with open_stage(3, on_error=policy) as stage:
        await stage.take_off()
        line = Formation.line(["north/2", "north/3"], 8.0, frame="north")
        with pytest.raises(SetpointStreamStopped, match="the leader north/1 is taken over"):
            async with stage.fleet.following(line, leader="north/1") as following:
                await anyio.sleep(5)
                stage.pilot_takes("north/1")
                assert "LOITER" in await following.wait_stopped()
                await anyio.sleep(2)
                assert not following.is_running
        assert stage.modes == {"north/1": "LOITER", "north/2": "BRAKE", "north/3": "BRAKE"}


async def test_form_errors_name_action_and_member() -> None:
    async with open_stage(3, min_distance_m=5.0, on_error="continue_others") as stage:
        with pytest.raises(InvalidArgument, match="there are no groups"):
            stage.fleet.group("alpha")
        await stage.take_off()
        line = Formation.line(["north/2"], 8.0, frame="north")
        (done := await stage.fleet.form(line, leader="north/1")).raise_for_errors()
        assert done.action == "form"
        onto = Formation({"north/2": Offset(0.0, 20.0)})
        with pytest.raises(OperationRejected, match=r"^form: .*north/3.*nothing was sent"):
            await stage.fleet.form(onto, leader="north/1")  # north/3 occupies that place
        stage.copters["north/1"].faults.silent = True
        await anyio.sleep(2.5)
        with pytest.raises(ValueUnknownError, match=r"^north/1: position is"):
            await stage.fleet.form(line, leader="north/1")
        here = stage.fleet.vehicles["north/2"].position.value
        with pytest.raises(ValueUnknownError, match=r"^north/1: position is"):
            await stage.fleet.go_to({"north/1": here.offset(up_m=20)})
        with pytest.raises(ValueUnknownError, match=r"^north/1: position is"):
            await stage.fleet.go_to(lambda member: member.vehicle.position.fresh(1).offset(north_m=1))


async def test_following_leader_lost_makes_followers_hold() -> None:
    async with open_stage(2) as stage:
        await stage.take_off()
        line = Formation.line(["north/2"], 8.0, frame="north")
        with pytest.raises(SetpointStreamStopped, match="following has stopped"):
            async with stage.fleet.following(line, leader="north/1") as following:
                stage.copters["north/1"].faults.silent = True
                with anyio.fail_after(3):
                    await following.wait_stopped()
        await anyio.sleep(1)
        assert stage.mode_of("north/2") == "BRAKE"


async def test_following_raise_if_stopped_raises_after_leader_takeover() -> None:
    async with open_stage(3, on_error="continue_others") as stage:
        await stage.take_off()
        line = Formation.line(["north/2", "north/3"], 8.0, frame="north")
        async with stage.fleet.following(line, leader="north/1") as following:
            await anyio.sleep(3)
            following.raise_if_stopped()
            stage.pilot_takes("north/3")
            await anyio.sleep(0.1)
            stage.pilot_takes("north/1")
            with (
                pytest.raises(SetpointStreamStopped, match="the leader north/1 is taken over"),
                anyio.fail_after(3),
            ):
                while True:
                    following.raise_if_stopped()
                    await anyio.sleep(0.1)
        (received,) = stage.events(FollowingStopped)  # leaving the block does not raise again
        assert received.member == "north/1"
        assert "the leader north/1 is taken over: the mode changed to LOITER" in received.reason
        assert received.orders == {"north/2": "hold"}
        assert received.skipped == {"north/3": "taken over: the mode changed to LOITER"}
        assert stage.modes == {"north/1": "LOITER", "north/2": "BRAKE", "north/3": "LOITER"}


async def test_following_stopped_is_published_before_policy_completes() -> None:
    async with open_stage(3, on_error="land_others") as stage:
        await stage.take_off()
        line = Formation.line(["north/2", "north/3"], 8.0, frame="north")
        with pytest.raises(SetpointStreamStopped, match="north/3: "):
            async with stage.fleet.following(line, leader="north/1") as following:
                await anyio.sleep(3)
                stage.pilot_takes("north/3")
                with anyio.fail_after(3):
                    assert "north/3" in await following.wait_stopped()
        received = [event for event in stage.events() if isinstance(event, (FollowingStopped, PolicyCompleted))]
        assert len(received) == 1
        assert isinstance(received[0], FollowingStopped)
        assert received[0].orders == {"north/2": "land"}
        assert list(received[0].skipped) == ["north/3"]


async def test_following_block_exit_publishes_no_event() -> None:
    async with open_stage(2) as stage:
        await stage.take_off()
        line = Formation.line(["north/2"], 8.0, frame="north")
        async with stage.fleet.following(line, leader="north/1") as following:
            await anyio.sleep(3)
        following.raise_if_stopped()
        assert stage.events(FollowingStopped) == []
        assert await following.wait_stopped() == ""


async def test_following_policy_function_error_makes_followers_hold() -> None:
    def wrong(_: object) -> None:
        raise ZeroDivisionError("mine")

    async with open_stage(3, on_error=wrong) as stage:
        await stage.take_off()
        line = Formation.line(["north/2", "north/3"], 8.0, frame="north")
        with pytest.raises(SetpointStreamStopped, match="mine"):
            async with stage.fleet.following(line, leader="north/1") as following:
                await anyio.sleep(3)
                stage.pilot_takes("north/3")
                await following.wait_stopped()
        (received,) = stage.events(FollowingStopped)
        assert received.orders == {"north/2": "hold"}
        assert stage.mode_of("north/2") == "BRAKE"


async def test_following_continues_after_takeover_of_one_follower() -> None:
    async with open_stage(3, on_error="continue_others") as stage:
        await stage.take_off()
        line = Formation.line(["north/2", "north/3"], 8.0, frame="north")
        async with stage.fleet.following(line, leader="north/1") as following:
            await anyio.sleep(3)
            stage.pilot_takes("north/2")
            await anyio.sleep(3)
            assert following.is_running
            assert following.error_m("north/3") < 20
        assert stage.modes == {"north/1": "GUIDED", "north/2": "LOITER", "north/3": "BRAKE"}


async def test_invalid_formations_are_rejected() -> None:
    async with open_stage(2, min_distance_m=5.0) as stage:
        wrong: list[tuple[Formation, str, str]] = [
            (Formation({"north/9": Offset(10)}), "north/1", "north/9"),
            (Formation({"north/1": Offset(10)}), "north/1", "is the leader"),
            (Formation({"north/2": Offset(3)}), "north/1", "3.0 m apart"),
        ]
        for formation, leader, match in wrong:
            with pytest.raises(InvalidArgument, match=match):
                stage.fleet.following(formation, leader=leader)


def test_formation_offset_rotates_with_heading() -> None:
    ahead = Formation({"a": Offset(10, 2, 1)}, "heading")
    east = ahead.offset_of("a", 90.0)
    assert (east.north_m, east.east_m, east.up_m) == pytest.approx((-2, 10, 1))
    with pytest.raises(InvalidArgument, match="heading"):
        ahead.offset_of("a", None)
    assert follow_velocity((10, 0, 0), (1, 0, 0), gain=0.5, max_speed_m_s=100) == (6, 0, 0)
    assert math.hypot(*follow_velocity((100, 100, 0), (0, 0, 0), gain=1, max_speed_m_s=7)) == pytest.approx(7)


async def test_send_corrections_sends_once_per_link() -> None:
    async with open_stage(2, networks=("north", "south")) as stage:
        stage.clear()
        body = b"\xd3\x00\xc8" + bytes(range(200))
        message = body + crc24q(body).to_bytes(3, "big")
        assert stage.fleet.send_corrections(message) == 2
        for wire in stage.wires.values():
            sent = wire.all(m.GpsRtcmData)
            assert b"".join(message.data[: message.len] for message in sent) == message
            assert [message.flags & 7 for message in sent] == [0b001, 0b011]
        with pytest.raises(InvalidArgument, match="RTCM 3"):
            stage.fleet.send_corrections(b"")


@pytest.mark.exhaustive
async def test_px4_after_mission_end_is_not_taken_over() -> None:
    async with (
        simulated_link(
            [SimulatedPx4(system_id=system_id, boot_time_s=1.0, seed=system_id) for system_id in (1, 2)]
        ) as link,
        fleet({"south": link}, count=2) as both,
    ):
        (await both.wait_ready()).raise_for_errors()
        missions = {}
        for name, vehicle in both.vehicles.items():
            here = vehicle.position.value
            there = here.offset(north_m=20, east_m=10 * vehicle.system_id)
            missions[name] = Mission(
                [
                    take_off(here.latitude_deg, here.longitude_deg, altitude_relative_m=10),
                    waypoint(there.latitude_deg, there.longitude_deg, altitude_relative_m=10),
                    *([return_to_launch()] if name == "south/1" else []),
                ]
            )
        await both.upload(missions)
        (await both.arm()).raise_for_errors()
        (await both.start_missions()).raise_for_errors()
        (await both.wait_missions_finished(timeout=300)).raise_for_errors()
        await anyio.sleep(5)
        assert [vehicle.state for vehicle in both] == [MemberState.ACTIVE] * 2
        assert both.vehicles["south/2"].mode_name == "LOITER"
        (
            await both["south/2"].go_to(lambda member: member.vehicle.position.value.offset(north_m=10))
        ).raise_for_errors()
        (await both.land()).raise_for_errors()


@pytest.mark.exhaustive
async def test_px4_fleet_flies_and_detects_pilot() -> None:
    px4s = [SimulatedPx4(system_id=system_id, boot_time_s=1.0, seed=system_id) for system_id in (1, 2)]
    async with (
        simulated_link(px4s) as link,
        fleet({"south": link}, count=2, on_error="continue_others") as both,
    ):
        for order in (both.wait_ready(), both.arm(), both.take_off(10)):
            (await order).raise_for_errors()
        (await both.go_to(lambda member: member.vehicle.position.value.offset(north_m=20))).raise_for_errors()
        homes = {name: member.vehicle.home.value for name, member in both.members.items()}
        (await both.go_to(homes)).raise_for_errors()
        line = Formation.line(["south/2"], 10.0, frame="north")
        async with both.following(line, leader="south/1") as following:
            await anyio.sleep(20)
            assert following.error_m("south/2") < 1.5
        assert [vehicle.state for vehicle in both] == [MemberState.ACTIVE] * 2
        px4s[0].switch_to(POSITION)
        await anyio.sleep(2)
        (await both.land()).raise_for_errors()
        assert both.members["south/1"].state is MemberState.TAKEN_OVER


async def test_px4_mode_report_before_heartbeat_is_no_takeover() -> None:
    px4s = [SimulatedPx4(system_id=system_id, boot_time_s=1.0, seed=system_id) for system_id in (1, 2)]
    async with simulated_link(px4s) as link, fleet({"south": link}, count=2) as both:
        for order in (both.wait_ready(), both.arm(), both.take_off(6)):
            (await order).raise_for_errors()
        higher = both.vehicles["south/2"]
        await higher.go_to(higher.position.value.offset(up_m=6))

        async def report_mode() -> None:
            while px4s[0].is_armed:  # noqa: ASYNC110
                await anyio.sleep(0.01)
            updated_at = both.vehicles["south/1"].armed.updated_at
            px4s[0].send(m.CurrentMode(0, custom_mode(px4s[0].mode), custom_mode(px4s[0].mode)))
            await both.vehicles["south/1"].mode.wait_until(lambda mode: mode.name == "LOITER")
            assert both.vehicles["south/1"].armed.updated_at == updated_at, "no HEARTBEAT in between"

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(report_mode)
            (await both.land()).raise_for_errors()
        assert [vehicle.state for vehicle in both] == [MemberState.ACTIVE] * 2


async def test_takeover_between_layers_stops_others_there() -> None:
    async with open_stage(3, spacing_m=40, min_distance_m=5.0, on_error="continue_others") as stage:
        await stage.take_off()
        here = [vehicle.position.value for vehicle in stage.fleet.vehicles.values()]
        targets = dict(zip(stage.copters, (here[1], here[0], here[2].offset(north_m=20)), strict=True))

        async def take() -> None:
            await anyio.sleep(1)
            stage.pilot_takes("north/3")

        taking = asyncio.create_task(take())
        result = await stage.fleet.go_to(targets)
        await taking
        assert list(result.failed) == ["north/3"]
        for name in ("north/1", "north/2"):  # climbed, but not crossed
            assert stage.fleet.vehicles[name].distance_to(targets[name]) > 30
            assert stage.mode_of(name) == "GUIDED"


async def test_landing_between_layers_is_not_overruled_by_next_leg() -> None:
    async with open_stage(2, spacing_m=30, min_distance_m=6.0) as stage:
        await stage.take_off()
        flight = asyncio.create_task(stage.fleet.go_to(swapped(stage)))
        await anyio.sleep(2)  # One of the two vehicles has reached the altitude of its layer.
        low = min(stage.copters, key=lambda name: stage.fleet.vehicles[name].position.value.altitude_relative_m or 0.0)
        landing = asyncio.create_task(stage.fleet[low].land())
        with pytest.raises(OperationRejected, match=f"{low} got a newer order .*; the others stay at"):
            await flight
        assert (await landing).is_complete
        assert stage.modes_ordered(low) == ["LAND"]


async def test_target_or_mission_too_far_away_is_rejected() -> None:
    far = Position(-47.0, -81.0, altitude_relative_m=20.0)
    async with open_stage(2) as stage:
        await stage.take_off()
        near = stage.fleet.vehicles["north/1"].position.value.offset(north_m=20.0)
        with pytest.raises(InvalidArgument, match=r"targets\['north/2'\] = .*max_distance_m"):
            await stage.fleet.go_to({"north/1": near, "north/2": far})
        mission = Mission([waypoint(-47.0, -81.0, altitude_relative_m=20.0)])
        with pytest.raises(InvalidArgument, match=r"missions\['north/2'\], item 0 = .*max_distance_m"):
            await stage.fleet.upload({"north/2": mission})
        assert stage.orders_to("north/1") == stage.orders_to("north/2") == []


async def test_send_corrections_reaches_other_links_after_loss_of_one() -> None:
    async with open_stage(1, networks=("north", "south")) as stage:
        stage.clear()
        stage.wires["north"].lose()
        body = b"\xd3\x00\x04" + bytes(4)
        with pytest.raises(LinkLost, match="unplugged"):
            stage.fleet.send_corrections(body + crc24q(body).to_bytes(3, "big"))
        assert len(stage.wires["south"].all(m.GpsRtcmData)) == 1


async def test_wait_missions_finished_without_missions_is_rejected() -> None:
    async with open_stage(1) as stage:
        with pytest.raises(OperationRejected, match="had no mission for these members"):
            await stage.fleet.wait_missions_finished()


async def test_go_to_with_outdated_plan_sends_nothing() -> None:
    async with open_stage(3, spacing_m=20) as stage:
        await stage.take_off()
        fleet = stage.fleet
        here = {name: vehicle.position.value for name, vehicle in fleet.vehicles.items()}
        targets = {name: here[name].offset(north_m=10) for name in ("north/1", "north/2")}
        plan = fleet.plan_separation(targets, min_distance_m=5)
        assert plan.decision == "clear"
        await fleet.vehicles["north/1"].go_to(here["north/1"].offset(up_m=8))
        stage.clear()
        others = {**targets, "north/3": here["north/3"].offset(north_m=10)}
        elsewhere = {**targets, "north/2": here["north/2"].offset(north_m=14)}
        for wrong, match in (
            (targets, "north/1 has moved"),
            (others, "north/1 has moved"),
            ({"north/2": targets["north/2"]}, "north/1 became unavailable"),
        ):
            with pytest.raises(OperationRejected, match=f"go_to: {match}.*; nothing was sent"):
                await fleet.go_to(wrong, separation=plan)
        plan = fleet.plan_separation(targets, min_distance_m=5)
        for wrong, match in (
            (others, "the separation was planned without north/3"),
            (elsewhere, "the separation was planned for another target of north/2"),
        ):
            with pytest.raises(OperationRejected, match=f"go_to: {match}; nothing was sent"):
                await fleet.go_to(wrong, separation=plan)
        assert not any(map(stage.orders_to, stage.copters))


async def test_go_to_in_layers_staggers_starts() -> None:
    async with open_stage(2, spacing_m=40, min_distance_m=5.0) as stage:
        await stage.take_off()
        (await stage.fleet.go_to(swapped(stage), stagger_s=3)).raise_for_errors()
        first, second = (stage.orders_to(name)[0][0] for name in stage.copters)
        assert second - first == pytest.approx(3, abs=0.3)


async def test_formation_needs_recent_heading_of_leader(monkeypatch: pytest.MonkeyPatch) -> None:
    async with open_stage(2) as stage:
        await stage.take_off()
        leader = stage.copters["north/1"]
        send = leader.send

        def send_without_heading(message: Any, *arguments: Any) -> None:
            if isinstance(message, m.GlobalPositionInt):
                message = m.GlobalPositionInt(**message.to_dict() | {"hdg": 2**16 - 1})
            send(message, *arguments)

        monkeypatch.setattr(leader, "send", send_without_heading)
        leader.faults.lost_messages[m.VfrHud.ID] = 10_000
        line = Formation.line(["north/2"], 8.0)
        with pytest.raises(SetpointStreamStopped, match="north/1: heading_deg is"):
            async with stage.fleet.following(line, leader="north/1") as following:
                with anyio.fail_after(3):
                    await following.wait_stopped()
        await anyio.sleep(1)
        with pytest.raises(ValueUnknownError, match="north/1: heading_deg is"):
            await stage.fleet.form(line, leader="north/1")
        assert stage.mode_of("north/2") == "BRAKE"


async def test_compare_missions_includes_way_to_first_item() -> None:
    """Two copters side by side whose first waypoints are swapped."""
    async with open_stage(2, spacing_m=20, min_distance_m=5.0) as stage:
        (await stage.fleet.wait_ready()).raise_for_errors()
        here = [vehicle.position.value for vehicle in stage.fleet.vehicles.values()]

        def mission_to(place: Position) -> Mission:
            first = place.offset(north_m=40)
            return Mission([take_off(8), waypoint(first.latitude_deg, first.longitude_deg, altitude_relative_m=8)])

        straight = dict(zip(stage.copters, map(mission_to, here), strict=True))
        assert stage.fleet.compare_missions(straight).decision == "clear"
        crossing = dict(zip(stage.copters, map(mission_to, reversed(here)), strict=True))
        plan = stage.fleet.compare_missions(crossing)
        assert plan.decision == "refused"
        assert plan.conflicts[0].distance_m == pytest.approx(0, abs=0.2)
        # A copter on the ground climbs before it flies, so it passes above its neighbour.
        above = stage.fleet.compare_missions({"north/1": mission_to(here[1]), "north/2": Mission([take_off(20)])})
        assert above.decision == "clear"


async def test_upload_of_mission_through_hovering_member_is_refused() -> None:
    async with open_stage(3, spacing_m=20, min_distance_m=5.0) as stage:
        await stage.take_off(8)
        here = {name: vehicle.position.value for name, vehicle in stage.fleet.vehicles.items()}

        def mission_to(name: str) -> dict[str, Mission]:
            return {"north/1": Mission([waypoint(here[name], altitude_relative_m=8)])}

        with pytest.raises(OperationRejected, match=r"north/1 and north/2 \(.* come too close; nothing was sent"):
            await stage.fleet.upload(mission_to("north/3"))
        await stage.fleet.vehicles["north/2"].land()
        assert stage.fleet.compare_missions(mission_to("north/2")).decision == "clear"


async def test_compare_missions_ignores_regions_of_interest() -> None:
    async with open_stage(2, spacing_m=20, min_distance_m=5.0) as stage:
        (await stage.fleet.wait_ready()).raise_for_errors()
        other = stage.fleet.vehicles["north/2"].position.value
        looking = Mission([take_off(8), region_of_interest(other, altitude_relative_m=8)])
        there = Mission([take_off(8), waypoint(other, altitude_relative_m=8)])
        assert stage.fleet.compare_missions({"north/1": looking, "north/2": there}).decision == "clear"
