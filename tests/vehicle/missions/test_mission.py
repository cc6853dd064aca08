"""Flying a mission: start, pause, resume, wait, take-over by a pilot, progress."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from functools import partial
from typing import Any

import anyio
import pytest
from flight_harness import Flight, Px4Flight, now, open_flight, open_px4
from plan_flights import long_mission, near_home, short_mission

from aerokit import Vehicle, events
from aerokit import messages as m
from aerokit.connection.bus import Subscription
from aerokit.errors import (
    AerokitError,
    CommandRejected,
    HeartbeatTimeout,
    InvalidArgument,
    OperationRejected,
    OperationTimeout,
)
from aerokit.mavlink import FrameEncoder
from aerokit.mavlink.enums import (
    CopterMode,
    MavCmd,
    MavLandedState,
    MavMissionResult,
    MavMissionType,
    MavResult,
    MissionState,
)
from aerokit.missions import Mission, MissionItem
from aerokit.missions.actions import jump
from aerokit.missions.navigation import return_to_launch, waypoint
from aerokit.sim import SimulatedPx4
from aerokit.sim.ardupilot.mission_run import MissionRun
from aerokit.sim.px4 import modes as px4_modes

pytestmark = pytest.mark.anyio

AnyFlight = Flight | Px4Flight


@asynccontextmanager
async def armed(opened: Any, *ends: MissionItem) -> AsyncIterator[AnyFlight]:
    """Flight with a short mission uploaded, armed on the ground."""
    async with opened() as flight:
        await flight.vehicle.wait_ready()
        await flight.vehicle.mission.upload(short_mission(flight, *ends))
        if isinstance(flight, Flight):
            await flight.vehicle.set_mode("GUIDED")
        await flight.vehicle.arm()
        flight.wire.clear()
        yield flight


def landing() -> MissionItem:
    """A position that only ArduPilot accepts."""
    return MissionItem(MavCmd.NAV_LAND, 3)


def all_of(reported: Subscription[Any]) -> list[Any]:
    return list(iter(reported.get_nowait, None))


async def reaches(flight: AnyFlight, item: int) -> None:
    await flight.vehicle.mission.current.wait_until(lambda current: (current or 0) >= item, timeout=60)


# ------------------------------------------------------------------------------------ completion


@pytest.mark.parametrize("uploads_again", [True, False])
async def test_mission_of_earlier_program_is_flown_to_landing(uploads_again: bool) -> None:
    """The upload sends nothing, because PX4 has the plan already. Without an upload, its items are unknown."""
    px4 = SimulatedPx4(boot_time_s=1.0)
    async with open_px4(px4) as earlier:
        await earlier.vehicle.wait_ready()
        mission = short_mission(earlier, return_to_launch())
        await earlier.vehicle.mission.upload(mission)
    async with open_px4(px4) as flight:
        await flight.vehicle.wait_ready()
        await flight.vehicle.mission.progress.wait_until(lambda _: True)
        if uploads_again:
            await flight.vehicle.mission.upload(mission, only_changes=True)
        assert flight.wire.all(m.MissionItemInt) == []
        await flight.vehicle.arm()
        await flight.vehicle.mission.start()
        await flight.vehicle.mission.wait_finished(timeout=600)
        assert px4.is_landed


async def test_mission_replaced_by_another_station_is_flown_to_landing() -> None:
    """The number of items shows that the items of the last upload are no longer the vehicle's."""
    async with armed(open_px4, return_to_launch()) as flight:
        mission = flight.vehicle.mission
        cache = mission._context.caches[MavMissionType.MISSION]
        cache.set(short_mission(flight).to_items(), now())
        await mission.start()
        await mission.wait_finished(timeout=600)
        assert flight.vehicle.landed_state.value == MavLandedState.ON_GROUND


async def test_mission_with_another_id_is_flown_to_landing() -> None:
    """PX4 reports another id of the mission after another station has replaced it by one of the same length."""
    async with armed(open_px4, waypoint(*near_home(18), altitude_relative_m=4)) as flight:
        assert isinstance(flight, Px4Flight)
        flight.px4.missions.replace(MavMissionType.MISSION, short_mission(flight, return_to_launch()).to_items())
        await anyio.sleep(2.0)
        await flight.vehicle.mission.start()
        await flight.vehicle.mission.wait_finished(timeout=600)
        assert flight.vehicle.landed_state.value == MavLandedState.ON_GROUND


@pytest.mark.parametrize("station", [(254, 190), (255, 190)])
async def test_mission_accepted_from_another_station_is_finished_in_air(station: tuple[int, int]) -> None:
    """On a shared link, ArduPilot's answer to the other station, which may have our ids, shows a new mission."""
    async with armed(open_flight, return_to_launch()) as flight:
        assert isinstance(flight, Flight)
        replacement = short_mission(flight, waypoint(*near_home(18), altitude_relative_m=4))
        flight.copter.missions.replace(MavMissionType.MISSION, replacement.to_items(home_is_item_0=True))
        await anyio.sleep(2.0)  # Directly after the upload, the answer would be a duplicate of the upload's own.
        flight.wire.deliver(FrameEncoder(1, 1).encode(m.MissionAck(*station, MavMissionResult.ACCEPTED)))
        await flight.vehicle.mission.start()
        await flight.vehicle.mission.wait_finished(timeout=600)
        assert flight.vehicle.landed_state.value == MavLandedState.IN_AIR


async def test_unknown_mission_that_ends_in_air_is_finished_there() -> None:
    px4 = SimulatedPx4(boot_time_s=1.0)
    async with open_px4(px4) as earlier:
        await earlier.vehicle.wait_ready()
        await earlier.vehicle.mission.upload(short_mission(earlier))
    async with open_px4(px4) as flight:
        await flight.vehicle.wait_ready()
        await flight.vehicle.arm()
        await flight.vehicle.mission.start()
        await flight.vehicle.mission.wait_finished(timeout=600)
        assert not px4.is_landed
        assert flight.vehicle.mode_name == "LOITER"


@pytest.mark.parametrize("lost", range(4))
@pytest.mark.parametrize("are_items_known", [True, False])
async def test_mission_end_with_lost_reports_is_no_takeover(lost: int, are_items_known: bool) -> None:
    """HEARTBEAT reports the mode after the mission, but the MISSION_CURRENTs that report the end are lost."""
    async with armed(open_px4) as flight:
        assert isinstance(flight, Px4Flight)
        mission = flight.vehicle.mission
        if not are_items_known:
            mission._context.caches[MavMissionType.MISSION].forget(now())
        await mission.start()

        async def lose_reports_of_end() -> None:
            await reaches(flight, 2)
            while not flight.px4.mission.is_finished:  # noqa: ASYNC110
                await anyio.sleep(0.02)
            flight.px4.faults.lose(m.MissionCurrent, times=lost)

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(lose_reports_of_end)
            await mission.wait_finished(timeout=600)


async def test_px4_mission_that_ends_before_next_heartbeat_was_started() -> None:
    """The vehicle is at the last waypoint already."""
    async with armed(open_px4) as flight:
        mission = flight.vehicle.mission
        await mission.start()
        await mission.wait_finished(timeout=60)
        for _ in range(2):
            await anyio.sleep(3.0)
            await mission.start(2)
            await mission.wait_finished(timeout=5)
            assert flight.vehicle.mode_name == "LOITER"


async def test_px4_mission_of_a_second_has_finished() -> None:
    """No MISSION_CURRENT reports it as active, and one is lost when a report of completion counts again."""
    async with armed(open_px4) as flight:
        assert isinstance(flight, Px4Flight)
        mission = flight.vehicle.mission
        await mission.start()
        await mission.wait_finished(timeout=60)
        await flight.vehicle.go_to(flight.vehicle.position.value.offset(north_m=-4.0))
        starting = asyncio.ensure_future(mission.start(2))
        with flight.vehicle.subscribe(m.CommandAck) as acks:
            assert (await acks.get()).command == MavCmd.DO_SET_MODE
        lose_one = partial(flight.px4.faults.lose, m.MissionCurrent, times=1)
        lose_one()
        await starting
        asyncio.get_running_loop().call_later(2.5, lose_one)
        await mission.wait_finished(timeout=30)


@pytest.mark.parametrize("place", ["before_start", "on_the_way"])
async def test_px4_completed_take_off_does_not_finish_mission(place: str) -> None:
    """PX4 reports the mission as complete at the end of a take-off."""
    async with armed(open_px4) as flight:
        assert isinstance(flight, Px4Flight)
        mission = flight.vehicle.mission
        if place == "before_start":
            await flight.vehicle.take_off(10.0)
        else:
            await mission.start()
            await reaches(flight, 1)
            flight.px4.change_mode(px4_modes.TAKEOFF)  # by a pilot
        await mission.progress.wait_until(lambda progress: progress.state == MissionState.COMPLETE, timeout=30)
        with pytest.raises(OperationRejected, match="is in LOITER"):
            await mission.wait_finished(timeout=60)


@pytest.mark.parametrize("are_items_known", [True, False])
async def test_px4_mission_that_ends_with_jump_is_finished(are_items_known: bool) -> None:
    """The item before the DO_JUMP stays current."""
    async with armed(open_px4, jump(2, repeat=1)) as flight:
        assert isinstance(flight, Px4Flight)
        mission = flight.vehicle.mission
        if not are_items_known:  # Another station replaces the mission.
            first, *others = flight.px4.missions.lists[0]
            flight.px4.missions.store(0, [first.replace(param1=1.0), *others])
            await anyio.sleep(2.0)
        await mission.start()
        await mission.wait_finished(timeout=120)
        assert mission.current.value == mission.count.value - 2


async def test_px4_mission_of_disarmed_vehicle_is_not_started() -> None:
    """One HEARTBEAT reports the mode and the disarming, as after a landing while the program starts a mission."""
    async with armed(open_px4) as flight:
        assert isinstance(flight, Px4Flight)
        flight.px4.faults.lose(m.Heartbeat, times=2)
        flight.px4.faults.lose(m.CurrentMode, times=5)
        starting = asyncio.ensure_future(flight.vehicle.mission.start())
        while flight.px4.mode != px4_modes.MISSION:  # noqa: ASYNC110
            await anyio.sleep(0.01)
        flight.px4.arming.disarm("a pilot", force=True)
        with pytest.raises(OperationRejected, match="not started: the vehicle disarmed"):
            await starting


async def test_px4_old_completion_does_not_finish_mission_of_disarmed_vehicle() -> None:
    """The vehicle disarms right after the start, and still reports the completion of the previous flight."""
    async with armed(open_px4) as flight:
        assert isinstance(flight, Px4Flight)
        mission = flight.vehicle.mission
        starting = asyncio.ensure_future(mission.start())
        while flight.px4.mode != px4_modes.MISSION:  # noqa: ASYNC110
            await anyio.sleep(0.01)
        flight.px4.faults.lose(m.MissionCurrent, times=2)  # No MISSION_CURRENT reports the mission as active.
        await starting
        flight.px4.arming.disarm("a pilot", force=True)
        flight.px4.mission.is_finished = True
        with pytest.raises(OperationRejected, match="the vehicle is disarmed"):
            await mission.wait_finished(timeout=60)


async def test_px4_finished_mission_cannot_be_resumed() -> None:
    async with armed(open_px4) as flight:
        mission = flight.vehicle.mission
        await mission.start()
        await mission.wait_finished(timeout=60)
        await anyio.sleep(3.0)
        began = now()
        with pytest.raises(OperationRejected, match="does not fly its mission\n  - No valid mission available"):
            await mission.resume()
        assert now() - began < 1.0
        assert flight.vehicle.mode_name == "LOITER"


async def test_ardupilot_finished_mission_continues_only_when_resumed() -> None:
    """AP_Mission.cpp, set_current_cmd, stops a completed mission."""
    async with armed(open_flight) as flight:
        assert isinstance(flight, Flight)
        mission = flight.vehicle.mission
        await mission.start()
        await mission.wait_finished(timeout=60)
        end = flight.copter.motion.place
        await mission.set_current(1)
        await anyio.sleep(5.0)
        assert flight.vehicle.mode_name == "AUTO"
        assert flight.copter.motion.place == pytest.approx(end, abs=0.1)
        await mission.resume()
        await mission.wait_finished(timeout=60)
        assert mission.reached == 2


async def go_home(vehicle: Vehicle) -> None:
    await vehicle.go_to(vehicle.home.value.position)


async def fly_mission_again(vehicle: Vehicle) -> None:
    await vehicle.mission.start()


@pytest.mark.parametrize("order", [Vehicle.land, go_home, fly_mission_again])
async def test_px4_hold_at_mission_end_is_no_takeover(order: Callable[[Vehicle], Awaitable[None]]) -> None:
    """HEARTBEAT reports HOLD only after the program has given the next order, whose first transmission is lost."""
    async with armed(open_px4) as flight:
        assert isinstance(flight, Px4Flight)
        await flight.vehicle.mission.start()
        await reaches(flight, 2)
        while not flight.px4.mission.is_finished:  # noqa: ASYNC110
            await anyio.sleep(0.02)
        flight.px4.faults.lose(m.Heartbeat, times=1)
        flight.px4.faults.lose(m.CurrentMode, times=1)
        await flight.vehicle.mission.wait_finished(timeout=600)
        assert flight.vehicle.mode_name == "MISSION"
        for command in (MavCmd.DO_REPOSITION, MavCmd.DO_SET_MODE):
            flight.px4.faults.ignore(command, times=1)
        await order(flight.vehicle)


async def test_duplicate_ack_of_upload_keeps_items_known() -> None:
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        mission = flight.vehicle.mission
        await mission.upload(short_mission(flight))
        flight.wire.deliver(FrameEncoder(1, 1).encode(m.MissionAck(255, 190, MavMissionResult.ACCEPTED)))
        assert mission._context.caches[MavMissionType.MISSION].items is not None


@pytest.mark.parametrize("opened", [open_flight, open_px4])
async def test_landing_elsewhere_during_final_return_fails_mission(opened: Any) -> None:
    async with armed(opened, return_to_launch()) as flight:

        async def land_during_return() -> None:
            await reaches(flight, 3)
            if isinstance(flight, Flight):
                assert flight.copter.set_mode(CopterMode.LAND)
            else:
                assert flight.px4.change_mode(px4_modes.LAND)

        await flight.vehicle.mission.start()
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(land_during_return)
            with pytest.raises(OperationRejected, match=r"the mode changed to LAND, at item 3 of"):
                await flight.vehicle.mission.wait_finished(timeout=600)


@pytest.mark.sampled(3)
@pytest.mark.parametrize(
    ("opened", "end"),
    [(open_flight, None), (open_flight, landing()), (open_px4, None), (open_px4, return_to_launch())],
)
async def test_mission_from_takeoff_to_end(opened: Any, end: MissionItem | None) -> None:
    kinds = (events.MissionItemReached, events.MissionCurrentChanged, events.MissionFinished)
    async with armed(opened, *([] if end is None else [end])) as flight:
        vehicle, mission = flight.vehicle, flight.vehicle.mission
        with vehicle.subscribe(*kinds, capacity=50) as reported:
            await mission.start()
            await mission.wait_finished(timeout=200)
            if end is not None:
                assert vehicle.landed_state.value == 1 or not vehicle.is_armed
            await anyio.sleep(0.1)
            observed = all_of(reported)
        reached = [event.item for event in observed if isinstance(event, events.MissionItemReached)]
        assert reached == sorted(set(reached))
        assert reached[:2] == [0, 1]  # PX4 may leave out a later item.
        assert mission.reached == reached[-1]
        current = [event.after for event in observed if isinstance(event, events.MissionCurrentChanged)]
        assert [item for item in current if item][:2] == [1, 2]
        assert sum(isinstance(event, events.MissionFinished) for event in observed) == 1


@pytest.fixture
def without_mission_state(monkeypatch: pytest.MonkeyPatch) -> None:
    """ArduPilot before 4.3: MISSION_CURRENT has no mission state."""
    build = MissionRun.message

    def message(run: MissionRun, seq: int | None = None) -> m.MissionCurrent:
        current = build(run, seq)
        return m.MissionCurrent(current.seq, current.total, MissionState.UNKNOWN, current.mission_mode)

    monkeypatch.setattr(MissionRun, "message", message)


@pytest.mark.usefixtures("without_mission_state")
async def test_without_mission_state_last_item_is_the_end() -> None:
    async with armed(open_flight) as flight:
        mission = flight.vehicle.mission
        await mission.start()
        with pytest.raises(OperationTimeout):
            await mission.wait_finished(timeout=5)
        with flight.vehicle.subscribe(m.MissionItemReached) as reached:
            await mission.wait_finished(timeout=200)
        assert all_of(reached)[-1].seq == mission.count.value


@pytest.mark.usefixtures("without_mission_state")
async def test_without_mission_state_second_flight_is_waited_for() -> None:
    async with armed(open_flight) as flight:
        mission = flight.vehicle.mission
        await mission.start()
        await mission.wait_finished(timeout=60)
        await mission.start(1)
        with flight.vehicle.subscribe(m.MissionItemReached, capacity=9) as reached:
            await mission.wait_finished(timeout=60)
        assert [report.seq for report in all_of(reached)] == [2, 3]


async def test_px4_completion_reported_during_slow_start_is_ignored() -> None:
    async with armed(open_px4) as flight:
        assert isinstance(flight, Px4Flight)
        mission = flight.vehicle.mission
        await mission.start()
        await mission.wait_finished(timeout=60)
        flight.px4.faults.ignore(MavCmd.DO_SET_MODE, times=3)
        starting = asyncio.ensure_future(mission.start(1))
        with flight.vehicle.subscribe(m.CommandAck) as acks:
            assert (await acks.get()).command == MavCmd.DO_SET_MODE
        flight.px4.faults.lose(m.MissionCurrent, times=2)
        await starting
        started = now()
        await mission.wait_finished(timeout=60)
        assert now() - started > 2


async def test_landed_state_from_before_take_off_ends_no_mission() -> None:
    """PX4 reports completion when it begins to return; EXTENDED_SYS_STATE is lost from the arming on."""
    async with armed(open_px4, return_to_launch()) as flight:
        assert isinstance(flight, Px4Flight)
        flight.px4.faults.lose(m.ExtendedSysState, times=10**6)
        mission = flight.vehicle.mission
        await mission.start()
        await mission.wait_finished(timeout=200)
        assert flight.vehicle.is_confirmed_disarmed
        assert (flight.vehicle.position.value.altitude_relative_m or 0.0) < 1.0
        assert flight.vehicle.landed_state.age > 20.0
        assert "on the ground" not in flight.vehicle.describe_now()


async def test_wait_finished_continues_through_pause() -> None:
    async with armed(open_flight) as flight:
        mission = flight.vehicle.mission
        await mission.start()
        await reaches(flight, 1)
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(mission.wait_finished)
            await mission.pause()
            assert flight.vehicle.mode_name == "BRAKE"
            await anyio.sleep(5)
            assert mission.current.value == 1
            await mission.resume()
        assert mission.progress.value.state == 5
        await mission.start(1)  # from another task
        assert not mission._tracker.is_complete
        await mission.wait_finished(timeout=60)


async def test_wait_finished_continues_through_pause_at_once_after_resume() -> None:
    """The pause is ordered in the moment in which the mode is reported, before `resume` returns."""
    async with armed(open_flight) as flight:
        assert isinstance(flight, Flight)
        mission, pauses = flight.vehicle.mission, []

        def pause_at_once(_: Any, mode: Any) -> None:
            if mode.name == "AUTO":
                pauses.append(asyncio.create_task(mission.pause()))

        await mission.start()
        await reaches(flight, 1)
        await mission.pause()
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(mission.wait_finished)
            await anyio.sleep(1.0)
            detach = flight.vehicle.mode.observe(pause_at_once)
            flight.copter.faults.lose(m.Heartbeat, times=1)  # COMMAND_ACK arrives before HEARTBEAT reports the mode.
            await mission.resume()
            detach()
            await pauses[0]
            await anyio.sleep(30.0)
            assert flight.vehicle.mode_name == "BRAKE"
            await mission.resume()


async def test_pilot_mode_change_after_refused_pause_ends_wait_finished() -> None:
    async with armed(open_flight) as flight:
        assert isinstance(flight, Flight)
        mission = flight.vehicle.mission
        await mission.start()
        await reaches(flight, 1)
        flight.copter.faults.refuse(MavCmd.DO_SET_MODE, MavResult.DENIED)
        with pytest.raises(CommandRejected):
            await mission.pause()
        flight.pilot_takes_over(CopterMode.LOITER)
        with pytest.raises(OperationRejected, match="the mode changed to LOITER"):
            await mission.wait_finished(timeout=30)


async def test_refused_start_of_paused_mission_keeps_wait_finished() -> None:
    async with armed(open_flight) as flight:
        assert isinstance(flight, Flight)
        mission = flight.vehicle.mission
        await mission.start()
        await reaches(flight, 1)
        await mission.pause()
        waiting = asyncio.ensure_future(mission.wait_finished(timeout=60))
        flight.copter.faults.refuse(MavCmd.MISSION_START, times=1)
        with pytest.raises(CommandRejected):
            await mission.start(1)
        await anyio.sleep(5.0)
        await mission.resume()
        await waiting


async def test_pilot_after_resuming_paused_mission_ends_wait_finished() -> None:
    async with armed(open_flight) as flight:
        assert isinstance(flight, Flight)
        mission = flight.vehicle.mission
        await mission.start()
        await reaches(flight, 1)
        waiting = asyncio.ensure_future(mission.wait_finished())
        await mission.pause()
        flight.pilot_takes_over(CopterMode.AUTO)
        await anyio.sleep(3.0)
        assert not waiting.done()
        assert not flight.vehicle.is_flown_by_program
        flight.pilot_takes_over(CopterMode.LOITER)
        with pytest.raises(OperationRejected, match="the mode changed to LOITER"):
            await asyncio.wait_for(waiting, 30)


async def test_pause_at_last_item_is_not_end_of_mission() -> None:
    async with armed(open_flight, landing()) as flight:
        mission = flight.vehicle.mission
        await mission.start()
        await mission.current.wait_until(lambda item: item == mission.count.value - 1, timeout=100)
        await mission.pause()
        assert mission._tracker.is_at_last_item
        assert not mission.explains_mode


async def test_wait_finished_reports_fall_of_armed_vehicle() -> None:
    async with armed(open_flight) as flight:
        assert isinstance(flight, Flight)
        mission = flight.vehicle.mission
        await mission.start()
        await reaches(flight, 1)
        flight.copter.faults.motor_failed = True
        flight.wire.clear()
        started = now()
        with pytest.raises(OperationRejected, match=r"the vehicle hit the ground at 7\.\d m/s, at item 1 of"):
            await mission.wait_finished()
        assert now() - started < 8
        assert flight.vehicle.is_armed
        assert not flight.wire.commands(MavCmd.COMPONENT_ARM_DISARM)
        assert not flight.wire.commands(MavCmd.DO_SET_MODE)


@pytest.mark.parametrize("opened", [open_flight, open_px4])
async def test_wait_finished_reports_vehicle_that_does_not_move(opened: Any) -> None:
    async with armed(opened) as flight:
        simulated = flight.copter if isinstance(flight, Flight) else flight.px4
        simulated.faults.motor_failed = True  # before the take-off
        await flight.vehicle.mission.start()
        started = now()
        with pytest.raises(OperationTimeout, match=r"has not moved for 6\d s; at item 0 of"):
            await flight.vehicle.mission.wait_finished()
        assert now() - started < 75


@pytest.mark.exhaustive
async def test_wait_finished_continues_through_hold_of_minutes() -> None:
    async with armed(open_flight) as flight:
        mission = flight.vehicle.mission
        first, second, *_ = short_mission(flight)
        assert second.position is not None
        await mission.upload(Mission([first, waypoint(second.position, hold_s=80)]))
        await mission.start()
        started = now()
        await mission.wait_finished()
        assert now() - started > 80


@pytest.mark.exhaustive
async def test_wait_finished_continues_through_pause_of_minutes() -> None:
    async with armed(open_flight) as flight:
        mission = flight.vehicle.mission
        await mission.start()
        await reaches(flight, 1)
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(mission.wait_finished)
            await mission.pause()
            await anyio.sleep(80)
            await mission.resume()
        assert mission.progress.value.state == 5


async def test_px4_pause_resume_and_second_flight() -> None:
    async with armed(open_px4) as flight:
        mission = flight.vehicle.mission
        await mission.start()
        await reaches(flight, 1)
        await mission.pause()
        assert flight.vehicle.mode_name == "LOITER"
        await mission.resume()
        await mission.wait_finished(timeout=60)
        started = now()
        await mission.start(1)
        await mission.wait_finished(timeout=60)
        assert now() - started > 2  # the completion of the first flight did not count


async def test_set_current_changes_the_item() -> None:
    async with armed(open_flight) as flight:
        mission = flight.vehicle.mission
        await mission.set_current(2)
        await mission.current.wait_until(lambda current: current == 2, timeout=3)
        assert flight.wire.commands(MavCmd.DO_SET_MISSION_CURRENT)[0].param1 == 3
        await mission.start(0)
        assert flight.wire.commands(MavCmd.DO_SET_MISSION_CURRENT)[-1].param1 == 0  # resets the jump counts
        await mission.current.wait_until(lambda current: current == 0, timeout=3)
    async with armed(open_px4) as other:
        await other.vehicle.mission.set_current(2)
        assert other.vehicle.mission.current.value == 2
        assert other.wire.last(m.MissionSetCurrent).seq == 2
        assert not other.wire.commands(MavCmd.DO_SET_MISSION_CURRENT)


async def test_jump_targets_are_renumbered() -> None:
    async with armed(open_flight) as flight:
        vehicle = flight.vehicle
        await vehicle.mission.upload(Mission([*short_mission(flight), jump(1, repeat=1)]))
        with vehicle.subscribe(events.MissionItemReached, capacity=50) as reported:
            await vehicle.mission.start()
            await vehicle.mission.wait_finished(timeout=100)
            await anyio.sleep(0.1)
            assert [event.item for event in all_of(reported)] == [0, 1, 2, 1, 2]


async def test_repeated_item_is_reached_again() -> None:
    """PX4 reports each reached item several times; it counts again only if the vehicle approached it again."""
    async with armed(open_px4) as flight:
        mission = flight.vehicle.mission
        with flight.vehicle.subscribe(events.MissionItemReached, capacity=50) as reported:
            await mission.start()
            while (await reported.get(timeout=60)).item != 1:
                pass
            await mission.current.wait_until(lambda current: current == 2, timeout=5)
            await mission.set_current(1)
            assert (await reported.get(timeout=60)).item == 1
            assert (await reported.get(timeout=60)).item == 2


async def test_count_and_current_without_mission() -> None:
    async with open_flight() as flight:
        await flight.vehicle.mission.count.wait_until(lambda count: count == 0, timeout=5)
        assert flight.vehicle.mission.current.value is None
        await flight.vehicle.mission.upload(long_mission(5))
        assert flight.vehicle.mission.count.value == 5
        assert flight.vehicle.mission.reached is None
    async with open_px4() as other:
        await other.vehicle.mission.count.wait_until(lambda count: count == 0, timeout=5)
        assert other.vehicle.mission.current.value is None


# ---------------------------------------------------------------------------------- takeovers


async def test_pilot_mode_change_ends_wait_finished() -> None:
    async with armed(open_flight) as flight:
        assert isinstance(flight, Flight)
        mission = flight.vehicle.mission
        await mission.start()
        await reaches(flight, 1)
        flight.pilot_takes_over(CopterMode.LOITER)
        with pytest.raises(OperationRejected, match="the mode changed to LOITER, at item 1 of 3"):
            await mission.wait_finished(timeout=60)
        assert not flight.wire.mode_orders()


@pytest.mark.parametrize("opened", [open_flight, open_px4])
async def test_newer_order_ends_wait_finished(opened: Any) -> None:
    async with armed(opened) as flight:
        await flight.vehicle.mission.start()
        await reaches(flight, 1)
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(flight.vehicle.hold)
            with pytest.raises(OperationRejected, match="another order was given"):
                await flight.vehicle.mission.wait_finished()


async def test_wait_finished_without_start_is_rejected() -> None:
    async with armed(open_flight) as flight:
        with pytest.raises(OperationRejected, match="is not flying its mission but is in GUIDED"):
            await flight.vehicle.mission.wait_finished(timeout=20)
        with pytest.raises(OperationRejected, match="is not flying its mission but is in GUIDED; nothing was sent"):
            await flight.vehicle.mission.pause()


@pytest.mark.parametrize("opened", [open_flight, open_px4])
async def test_completion_of_replaced_mission_does_not_finish_next_one(opened: Any) -> None:
    async with armed(opened) as flight:
        mission = flight.vehicle.mission
        await mission.start()
        await mission.wait_finished(timeout=60)
        await mission.upload(short_mission(flight, waypoint(*near_home(24), altitude_relative_m=4)))
        with pytest.raises(OperationRejected if opened is open_px4 else OperationTimeout):
            await mission.wait_finished(timeout=20)
        await mission.start()
        await mission.wait_finished(timeout=60)
        assert mission.reached == 3


async def test_mission_that_pilot_starts_again_is_waited_for() -> None:
    """ArduCopter flies a complete mission again when the pilot selects AUTO (AP_Mission.cpp, resume)."""
    async with armed(open_flight) as flight:
        assert isinstance(flight, Flight)
        vehicle = flight.vehicle
        await vehicle.mission.start()
        await vehicle.mission.wait_finished(timeout=60)
        await vehicle.go_to(vehicle.home.value.position)
        flight.pilot_takes_over(CopterMode.AUTO)
        await vehicle.mode.wait_until(lambda mode: mode.name == "AUTO")
        await vehicle.mission.wait_finished(timeout=60)
        assert flight.copter.motion.north == pytest.approx(12.0, abs=2.5)


async def test_disarming_ends_wait_finished() -> None:
    async with armed(open_flight) as flight:
        await flight.vehicle.mission.start()
        await reaches(flight, 1)
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(lambda: flight.vehicle.disarm(force=True))
            with pytest.raises(OperationRejected, match="the vehicle hit the ground at"):
                await flight.vehicle.mission.wait_finished()


async def test_disarming_on_a_slope_does_not_finish_mission() -> None:
    """The vehicle stands on a hill, and the autopilot's crash check disarms it on its way to the last waypoint."""
    async with armed(open_flight) as flight:
        assert isinstance(flight, Flight)
        mission, motion = flight.vehicle.mission, flight.copter.motion
        await mission.start()
        await reaches(flight, mission.count.value - 1)
        motion.ground_down = motion.down
        asyncio.get_running_loop().call_later(2.0, flight.copter.arming.disarm)
        with pytest.raises(OperationRejected, match=r"the mission has not ended \(at item \d of"):
            await mission.wait_finished(timeout=60)


@pytest.mark.parametrize("opened", [open_flight, open_px4])
async def test_mission_that_ends_in_a_fall_is_not_finished(opened: Any) -> None:
    """The vehicle disarms during the landing or the return at its end."""
    async with opened() as flight:
        mission = flight.vehicle.mission
        await flight.vehicle.wait_ready()
        await mission.upload(short_mission(flight, return_to_launch()))
        await flight.vehicle.arm()
        await mission.start()
        async with anyio.create_task_group() as group:
            group.start_soon(disarm_in_return, flight)
            with pytest.raises(OperationRejected, match=r"disarmed in the air|hit the ground"):
                await mission.wait_finished(timeout=120)


async def disarm_in_return(flight: Any) -> None:
    is_px4 = not isinstance(flight, Flight)
    await flight.vehicle.mission.current.wait_until(lambda item: item == flight.vehicle.mission.count.value - 1)
    if is_px4:
        await flight.vehicle.mode.wait_until(lambda mode: mode.name == "RTL")
    await anyio.sleep(3.0)
    if is_px4:
        flight.px4.arming.disarm("test", force=True)
    else:
        flight.copter.arming.disarm()


async def test_wait_finished_silence_and_timeout() -> None:
    async with armed(open_flight) as flight:
        await flight.vehicle.mission.start()
        with pytest.raises(OperationTimeout, match=r"not done within 2 s; at item 0 of 3"):
            await flight.vehicle.mission.wait_finished(timeout=2)
        assert flight.vehicle.mode_name == "AUTO"  # the vehicle continues
        assert isinstance(flight, Flight)
        flight.copter.faults.silent = True
        with pytest.raises(HeartbeatTimeout):
            await flight.vehicle.mission.wait_finished()


async def test_cancelled_start_holds() -> None:
    async with armed(open_flight) as flight:
        assert isinstance(flight, Flight)
        flight.copter.faults.ignore(MavCmd.MISSION_START)
        with anyio.move_on_after(0.3):
            await flight.vehicle.mission.start()
        await anyio.sleep(2)
        assert CopterMode.BRAKE in flight.wire.mode_orders()


async def test_block_left_during_start_holds() -> None:
    async with armed(open_flight) as flight:
        assert isinstance(flight, Flight)
        flight.copter.faults.lose_ack(MavCmd.MISSION_START)
        start = asyncio.create_task(flight.vehicle.mission.start())
        await anyio.sleep(0.1)
    with pytest.raises(AerokitError):
        await start
    assert flight.copter.mode.number == CopterMode.BRAKE


@pytest.mark.parametrize("opened", [open_flight, open_px4])
async def test_start_is_refused_when_impossible(opened: Any) -> None:
    async with opened() as flight:
        await flight.vehicle.wait_ready()
        mission = flight.vehicle.mission
        await mission.upload(short_mission(flight))
        flight.wire.clear()
        with pytest.raises(OperationRejected, match=r"not armed: call arm\(\) first; nothing was sent"):
            await mission.start()
        with pytest.raises(OperationRejected, match="not armed"):
            await mission.resume()
        for item in (3, -1, True):
            with pytest.raises(InvalidArgument, match="0 to 2"):
                await mission.start(item)
            with pytest.raises(InvalidArgument, match="0 to 2"):
                await mission.set_current(item)
        assert not flight.wire.commands(MavCmd.MISSION_START)
        assert not flight.wire.commands(MavCmd.DO_SET_MODE)


async def test_refused_start_has_the_vehicles_reasons() -> None:
    async with armed(open_flight) as flight:
        await flight.vehicle.mission.clear()
        with pytest.raises(InvalidArgument, match="the vehicle's mission is empty: call upload") as caught:
            await flight.vehicle.mission.start()
        assert "item" not in str(caught.value)
        assert isinstance(flight, Flight)
        with pytest.raises(CommandRejected):
            await flight.vehicle.mission.resume()


async def test_active_mission_is_replaced_but_not_cleared() -> None:
    async with armed(open_flight) as flight:
        await flight.vehicle.mission.start()
        flight.wire.clear()
        await flight.vehicle.mission.upload(Mission([*short_mission(flight), return_to_launch()]))
        assert flight.wire.all(m.MissionCount)  # ArduPilot cannot clear an active mission to write it as a file.
        assert flight.vehicle.mission.count.value == 4
        assert flight.vehicle.mode_name == "AUTO"


async def test_item_number_is_unchecked_while_count_unknown() -> None:
    async with open_flight(rates={}) as flight:
        mission = flight.vehicle.mission
        assert not mission.count.is_known
        with pytest.raises(InvalidArgument, match="item = 65535 is not allowed: it must be 0 to 65534"):
            await mission.set_current(65535)
        with pytest.raises(CommandRejected):
            await mission.set_current(65534)


@pytest.mark.parametrize(("mode", "end"), [("AUTO", "BRAKE"), ("LOITER", "LOITER")])
async def test_cancelled_start_holds_only_vehicle_that_flies_its_mission(mode: str, end: str) -> None:
    """Another station flies the vehicle. In AUTO, the vehicle proceeds to the item before it gets MISSION_START."""
    async with open_flight(latency_s=0.2) as flight:
        await flight.take_off()
        await flight.vehicle.mission.upload(long_mission(40))
        flight.pilot_takes_over(CopterMode[mode])
        await anyio.sleep(2.0)
        with anyio.move_on_after(0.1) as scope:
            await flight.vehicle.mission.start(1)
        assert scope.cancelled_caught
        await anyio.sleep(4.0)
        assert flight.vehicle.mode_name == end
