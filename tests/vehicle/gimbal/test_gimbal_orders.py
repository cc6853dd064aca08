"""`vehicle.gimbal` and `vehicle.gimbals`: orders return when reached, and go to the gimbal's manager."""

from __future__ import annotations

import asyncio
import math

import anyio
import pytest
from flight_harness import Flight, in_the_air, now, open_flight
from gimbal_stage import CONFIGURE, MOUNT, PITCHYAW, REQUEST, copter_with_mount, mounted, own_ids, with_gimbals

from aerokit import Position
from aerokit import messages as m
from aerokit.connection.cells import Source
from aerokit.errors import (
    AerokitError,
    BusyError,
    CommandRejected,
    CommandTimeout,
    HeartbeatTimeout,
    InvalidArgument,
    NotSupported,
    OperationRejected,
    OperationTimeout,
)
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import GimbalManagerFlags as Flags
from aerokit.mavlink.enums import MavCmd, MavMountMode, MavResult
from aerokit.sim import SimulatedCopter, SimulatedGimbal
from aerokit.sim.faults import CommandFault
from aerokit.vehicle.gimbal.discovery import MAX_GIMBALS
from aerokit.vehicle.gimbal.gimbal import Gimbal

pytestmark = pytest.mark.anyio

LEVEL, LOCKED = 12, 28


def degrees(gimbal: SimulatedGimbal) -> list[float]:
    return [math.degrees(angle) for angle in gimbal.angles()]


# ------------------------------------------------------------------------------------------- pointing


async def test_point_returns_when_reached() -> None:
    gimbal = SimulatedGimbal(slew_deg_s=30.0)
    async with with_gimbals(gimbal) as flight:
        began = now()
        await flight.vehicle.gimbal.point(-60.0, 90.0, tolerance_deg=1.0)
        assert now() - began == pytest.approx(3.0, abs=1.2)
        reported = flight.vehicle.gimbal.attitude.value
        assert reported.pitch_deg == pytest.approx(-60, abs=1)
        assert reported.yaw_deg == pytest.approx(90, abs=1)


async def test_point_without_wait_returns_when_accepted() -> None:
    async with with_gimbals(SimulatedGimbal(slew_deg_s=10.0)) as flight:
        began = now()
        await flight.vehicle.gimbal.point(-60.0, 90.0, wait=False)
        assert now() - began < 0.5


async def test_vehicle_frame_yaw_turns_with_the_vehicle() -> None:
    gimbal = SimulatedGimbal()
    async with in_the_air(copter=SimulatedCopter(boot_time_s=0.0, components=[gimbal])) as flight:
        await flight.vehicle.gimbal.point(-20.0, -30.0, frame="vehicle")
        await flight.vehicle.set_heading(90.0, tolerance_deg=1.0)
        assert degrees(gimbal)[1:] == pytest.approx([-20, -30], abs=0.5)
        await flight.vehicle.gimbal.point(-20.0, 60.0)
        assert flight.vehicle.gimbal.attitude.value.yaw_from_nose_deg == pytest.approx(-30, abs=4)
        flags = [int(command.param5) for command in flight.wire.commands(PITCHYAW)]  # type: ignore[union-attr]
        assert flags[0] == LEVEL
        assert flags[-1] == LOCKED


async def test_straight_down_ignores_yaw() -> None:
    async with with_gimbals(SimulatedGimbal()) as flight:
        await flight.vehicle.gimbal.point(-90.0, 123.0)


async def test_autopilot_attitude_is_requested_while_pointing() -> None:
    async with mounted() as flight:
        await flight.vehicle.gimbal.point(-45.0, 90.0)
        (command,) = flight.wire.commands(PITCHYAW)
        assert (command.target_component, command.param7) == (1, 0)  # type: ignore[union-attr]
        await anyio.sleep(1.0)
        asked = flight.wire.commands(MavCmd.SET_MESSAGE_INTERVAL)
        of_it = [request.param2 for request in asked if request.param1 == m.GimbalDeviceAttitudeStatus.ID]
        assert of_it == [200_000, 0]


async def test_point_from_north_without_default_rates_returns() -> None:
    async with open_flight(copter_with_mount(), rates={}) as flight:
        await flight.vehicle.gimbal.point(-20.0, 90.0)
        await anyio.sleep(6.0)  # The heading is too old now.
        flight.copter.send(attitude_of(1))
        await anyio.sleep(0.1)
        attitude = flight.vehicle.gimbal.attitude.value
        assert (attitude.yaw_deg, attitude.yaw_from_nose_deg) == (None, 0.0)


async def test_unreachable_angle_timeout_reports_attitude() -> None:
    async with with_gimbals(SimulatedGimbal(pitch_deg=(-45.0, 10.0))) as flight:
        with pytest.raises(OperationTimeout) as caught:
            await flight.vehicle.gimbal.point(-80.0, 0.0, timeout=4.0)
        assert "not reached within 4 s: the gimbal points to pitch -45.0" in str(caught.value)
        assert "expected pitch -80.0, yaw from north 0.0" in str(caught.value)


async def test_timeout_reports_device_errors() -> None:
    async with with_gimbals(SimulatedGimbal(attitude_rate_hz=0.0)) as flight:
        status = m.GimbalDeviceAttitudeStatus(0, 0, 0, 32, (1, 0, 0, 0), 0, 0, 0, 16)
        copter = flight.copter
        copter.every(0.2, lambda: copter.send(status, None, (1, 154)))
        with pytest.raises(OperationTimeout, match="its failures are POWER_ERROR"):
            await flight.vehicle.gimbal.point(-30.0, 0.0, timeout=3.0)


async def test_gimbal_without_attitude_times_out() -> None:
    async with open_flight() as flight:
        for command in (PITCHYAW, MOUNT):
            flight.copter.faults.refuse(command, MavResult.ACCEPTED)
        with pytest.raises(OperationTimeout, match="the gimbal does not report its attitude"):
            await flight.vehicle.gimbal.point(-45.0, 0.0, timeout=2.0)


async def test_attitude_before_the_order_does_not_count() -> None:
    gimbal = SimulatedGimbal()
    async with with_gimbals(gimbal) as flight:
        await flight.vehicle.gimbal.point(-10.0, 0.0)
        gimbal.faults.silent = True
        flight.copter.faults.refuse(PITCHYAW, MavResult.ACCEPTED)
        with pytest.raises(OperationTimeout, match="no COMMAND_ACK"):
            await flight.vehicle.gimbal.point(-10.0, 0.0, timeout=2.0)


async def test_newer_order_ends_earlier_wait() -> None:
    gimbal = SimulatedGimbal(slew_deg_s=10.0)
    async with with_gimbals(gimbal) as flight:
        ends: list[str] = []

        async def point() -> None:
            with pytest.raises(OperationRejected, match="another order was given"):
                await flight.vehicle.gimbal.point(-80.0, 0.0)
            ends.append("first")

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(point)
            await anyio.sleep(1.0)
            await flight.vehicle.gimbals[154].point(-20.0, 0.0, frame="vehicle")
            ends.append("second")
        assert ends == ["first", "second"]
        assert degrees(gimbal)[1] == pytest.approx(-20, abs=3)


async def test_denial_after_stale_acceptance_ends_wait() -> None:
    """The late acceptance of an earlier order arrives before the refusal of this one."""
    async with mounted() as flight:
        flight.copter.faults.commands[PITCHYAW] = CommandFault(refuse_with=MavResult.DENIED, delay_s=1.0)
        stale = m.CommandAck(PITCHYAW, MavResult.ACCEPTED, 0, 0, *own_ids(flight))
        asyncio.get_running_loop().call_later(0.1, flight.copter.send, stale)
        began = now()
        with pytest.raises(CommandRejected, match=r"accepted the command and then refused it.*DENIED"):
            await flight.vehicle.gimbal.point(-30.0, 0.0)
        assert now() - began < 2.0


async def test_late_denial_ends_only_the_newest_wait_of_a_manager() -> None:
    async with mounted() as flight:
        flight.copter.faults.refuse(PITCHYAW, MavResult.ACCEPTED)
        first, second = flight.vehicle.gimbals[1], flight.vehicle.gimbals[2]
        ends: dict[int, type[Exception]] = {}

        async def point(gimbal: Gimbal) -> None:
            try:
                await gimbal.point(-30.0, 0.0, timeout=6.0)
            except AerokitError as error:
                ends[gimbal.device_id] = type(error)

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(point, first)
            await anyio.sleep(1.0)
            tasks.start_soon(point, second)
            await anyio.sleep(3.0)
            flight.copter.send(m.CommandAck(PITCHYAW, MavResult.DENIED, 0, 0, *own_ids(flight)))
        assert ends == {2: CommandRejected, 1: OperationTimeout}


async def test_late_denial_and_newer_order_leave_older_wait() -> None:
    """The newer order claims control and forgets the denial; the answer to it takes longer than a check."""
    async with mounted() as flight:
        flight.copter.faults.refuse(PITCHYAW, MavResult.ACCEPTED)
        first, second = flight.vehicle.gimbals[1], flight.vehicle.gimbals[2]
        async with anyio.create_task_group() as tasks:

            async def point_first() -> None:
                with pytest.raises(OperationTimeout):
                    await first.point(-30.0, 0.0, timeout=6.0)

            tasks.start_soon(point_first)
            await anyio.sleep(1.0)
            denial = m.CommandAck(PITCHYAW, MavResult.DENIED, 0, 0, *own_ids(flight))
            asyncio.get_running_loop().call_later(3.0, flight.copter.send, denial)
            with pytest.raises(CommandRejected):
                await second.point(-30.0, 0.0, timeout=6.0)
            flight.copter.faults.commands[PITCHYAW] = CommandFault(refuse_with=MavResult.ACCEPTED, delay_s=0.7)
            with pytest.raises(OperationTimeout):
                await second.point(-40.0, 0.0, timeout=3.0)


async def test_second_copy_of_denial_does_not_end_wait() -> None:
    """The first copy made aerokit claim control and send the order again."""
    gimbal = SimulatedGimbal(slew_deg_s=30.0)
    async with with_gimbals(gimbal) as flight:
        gimbal.faults.refuse(PITCHYAW, times=1)
        copy = m.CommandAck(PITCHYAW, MavResult.DENIED, 0, 0, *own_ids(flight))
        asyncio.get_running_loop().call_later(1.0, gimbal.send, copy)
        await flight.vehicle.gimbal.point(-60.0, 0.0, tolerance_deg=1.0)


async def test_vehicle_roi_ends_gimbal_wait() -> None:
    async with in_the_air(copter=copter_with_mount()) as flight:
        flight.copter.faults.ignore(PITCHYAW, times=1)

        async def point() -> None:
            with pytest.raises((OperationRejected, OperationTimeout)):
                await flight.vehicle.gimbal.point(-80.0, 0.0)

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(point)
            await anyio.sleep(0.2)
            await flight.vehicle.look_at(flight.vehicle.position.value.offset(north_m=50.0))
        assert len(flight.wire.commands(PITCHYAW)) == 1


async def test_reboot_ends_pointing_wait() -> None:
    async with with_gimbals(SimulatedGimbal(slew_deg_s=1.0)) as flight:

        async def reboot() -> None:
            await anyio.sleep(1.0)
            flight.copter.reboot(0.5)

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(reboot)
            with pytest.raises(OperationRejected, match="the vehicle rebooted"):
                await flight.vehicle.gimbal.point(-80.0, 0.0, timeout=30.0)


async def test_silent_vehicle_ends_pointing_wait() -> None:
    async with with_gimbals(SimulatedGimbal(slew_deg_s=1.0)) as flight:

        async def stop_sending() -> None:
            await anyio.sleep(1.0)
            flight.copter.faults.silent = True

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(stop_sending)
            with pytest.raises(HeartbeatTimeout):
                await flight.vehicle.gimbal.point(-80.0, 0.0, timeout=40.0)


async def test_mode_change_does_not_end_pointing_wait() -> None:
    async with in_the_air(copter=copter_with_mount()) as flight:
        flight.copter.parameters["MNT1_PITCH_MIN"] = -90.0
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(flight.vehicle.set_mode, "LOITER")
            await flight.vehicle.gimbal.point(-45.0, 0.0)


# --------------------------------------------------------------------------------- neutral, retracted


@pytest.mark.parametrize(("name", "flag"), [("neutral", Flags.NEUTRAL), ("retract", Flags.RETRACT)])
async def test_neutral_returns_when_flagged_and_still(name: str, flag: int) -> None:
    gimbal = SimulatedGimbal(slew_deg_s=30.0)
    async with with_gimbals(gimbal) as flight:
        await flight.vehicle.gimbal.point(-60.0, 0.0, frame="vehicle")
        began = now()
        await getattr(flight.vehicle.gimbal, name)()
        assert 1.8 <= now() - began <= 4.0
        assert gimbal.flags == flag
        assert degrees(gimbal) == pytest.approx([0, 0, 0], abs=0.5)
        (command,) = flight.wire.commands(PITCHYAW)[-1:]
        assert math.isnan(command.param1)
        assert command.param5 == flag  # type: ignore[union-attr]


@pytest.mark.parametrize(("name", "mode"), [("neutral", MavMountMode.NEUTRAL), ("retract", MavMountMode.RETRACT)])
async def test_old_mount_neutral_uses_mount_mode(name: str, mode: int) -> None:
    async with mounted() as flight:
        flight.copter.faults.refuse(PITCHYAW, MavResult.UNSUPPORTED)
        await getattr(flight.vehicle.gimbal, name)()
        assert [command.param7 for command in flight.wire.commands(MOUNT)] == [mode]  # type: ignore[union-attr]
        await getattr(flight.vehicle.gimbal, name)(wait=False)
        assert len(flight.wire.commands(PITCHYAW)) == 1


async def test_neutral_requires_known_direction() -> None:
    async with with_gimbals(SimulatedGimbal(attitude_rate_hz=0.0)) as flight:
        copter, neutral = flight.copter, flight.vehicle.gimbal.neutral
        reported = attitude_of(0, (math.nan,) * 4)
        copter.every(0.2, lambda: copter.send(reported, None, (1, 154)))
        with pytest.raises(OperationTimeout):
            await neutral(timeout=3.0)
        reported = m.GimbalDeviceAttitudeStatus(0, 0, 0, Flags.NEUTRAL, reported.q, 0, 0, 0, 0)
        await neutral(timeout=3.0)


# --------------------------------------------------------------------------------------------- regions of interest


def place(flight: Flight, **metres: float) -> Position:
    return flight.vehicle.position.value.offset(**metres)


@pytest.mark.parametrize("kind", ["autopilot", "beside"])
async def test_look_at_tracks_until_stop_looking(kind: str) -> None:
    has_own_manager = kind == "beside"
    fitted = SimulatedCopter(boot_time_s=0.0, components=[SimulatedGimbal()])
    async with in_the_air(20.0, copter=fitted if has_own_manager else copter_with_mount()) as flight:
        vehicle = flight.vehicle
        await vehicle.gimbals.discover()
        async with vehicle.gimbal.control():
            target = place(flight, east_m=30.0, up_m=-20.0)
            await vehicle.gimbal.look_at(target)
            reported = vehicle.gimbal.attitude.value
            assert reported.yaw_deg == pytest.approx(90, abs=6)
            assert reported.pitch_deg == pytest.approx(-33.7, abs=6)
            await vehicle.gimbal.stop_looking()
        target_component = 154 if has_own_manager else 1
        for command in (MavCmd.DO_SET_ROI_LOCATION, MavCmd.DO_SET_ROI_NONE):
            (sent,) = flight.wire.commands(command)
            assert sent.target_component == target_component


async def test_look_at_system_follows_reported_position() -> None:
    async with in_the_air(20.0, copter=copter_with_mount()) as flight:
        there = place(flight, east_m=-40.0)
        x, y = round(there.latitude_deg * 1e7), round(there.longitude_deg * 1e7)
        assert there.altitude_amsl_m is not None
        reported = FrameEncoder(7, 1).encode(
            m.GlobalPositionInt(0, x, y, round(there.altitude_amsl_m * 1e3), 20000, 0, 0, 0, 0)
        )

        def report() -> None:
            flight.copter.receive(reported, flight.copter.now)
            flight.wire.deliver(reported)

        flight.copter.every(0.5, report)
        await flight.vehicle.gimbal.look_at_system(7)
        attitude = flight.vehicle.gimbal.attitude.value
        assert attitude.yaw_deg == pytest.approx(270, abs=6)
        assert attitude.pitch_deg == pytest.approx(0, abs=6)


async def test_look_at_unknown_system_times_out() -> None:
    async with in_the_air(copter=copter_with_mount()) as flight:
        with pytest.raises(OperationTimeout, match="the position of system 9 is unknown"):
            await flight.vehicle.gimbal.look_at_system(9, timeout=3.0)


async def test_only_first_autopilot_gimbal_supports_roi() -> None:
    async with in_the_air(copter=copter_with_mount()) as flight:
        second = flight.vehicle.gimbals[2]
        for order in (second.look_at(place(flight, east_m=9.0)), second.look_at_system(7)):
            with pytest.raises(NotSupported, match="first gimbal only"):
                await order
        assert not flight.wire.commands(MavCmd.DO_SET_ROI_LOCATION)


async def test_denied_roi_claims_control() -> None:
    gimbal = SimulatedGimbal()
    async with in_the_air(copter=SimulatedCopter(boot_time_s=0.0, components=[gimbal])) as flight:
        await flight.vehicle.gimbal.controllers.wait_until(lambda _: True, timeout=3)
        await flight.vehicle.gimbal.look_at(place(flight, east_m=30.0))
        assert gimbal.primary == (255, 190)
        assert len(flight.wire.commands(MavCmd.DO_SET_ROI_LOCATION)) == 2
        await flight.vehicle.gimbal.stop_looking()


async def test_roi_denied_by_autopilot_claims_nothing() -> None:
    async with in_the_air(copter=copter_with_mount()) as flight:
        flight.copter.faults.refuse(MavCmd.DO_SET_ROI_LOCATION, MavResult.DENIED)
        with pytest.raises(CommandRejected):
            await flight.vehicle.gimbal.look_at(place(flight, east_m=30.0))
        assert not flight.wire.commands(CONFIGURE)


# -------------------------------------------------------------------------------------------- limits


async def test_limits_apply_only_after_information() -> None:
    async with mounted() as flight:
        flight.vehicle.gimbal  # noqa: B018 - it begins to listen
        reported = m.GimbalManagerInformation(0, 0, 1, 0, 0, -0.1, 0.1, 0, 0)
        flight.wire.deliver(FrameEncoder(1, 1).encode(reported))
        await flight.vehicle.gimbal.point(-45.0, 0.0)


async def test_information_of_component_gimbal() -> None:
    async with with_gimbals(SimulatedGimbal(pitch_deg=(-80.0, 10.0))) as flight:
        reported = await flight.vehicle.gimbal.information()
        assert (reported.gimbal_device_id, reported.manager_component_id) == (154, 154)
        assert reported.pitch_deg == (-80.0, 10.0)
        assert (reported.vendor, reported.model, reported.firmware_version) == (
            "aerokit",
            "Simulated gimbal",
            "0.0.0",
        )
        assert reported.axes == ("roll", "pitch", "yaw")
        assert (reported.can_retract, reported.has_neutral, reported.can_point_at_location) == (
            True,
            True,
            True,
        )
        for pitch, roll in ((-85.0, 0.0), (20.0, 0.0), (0.0, 40.0)):
            with pytest.raises(InvalidArgument, match="is not allowed: gimbal 154 turns from"):
                await flight.vehicle.gimbal.point(pitch, 0.0, roll_deg=roll)
        assert not flight.wire.commands(PITCHYAW)
        await flight.vehicle.gimbal.point(-10, 0)
        with pytest.raises(OperationTimeout, match="its limits are pitch -80 to 10, yaw -180 to 180"):
            await flight.vehicle.gimbal.point(-10, 0, tolerance_deg=0.01, timeout=0.05)


async def test_information_of_autopilot_gimbal() -> None:
    async with mounted() as flight:
        reported = await flight.vehicle.gimbal.information()
        assert (reported.gimbal_device_id, reported.manager_component_id, reported.vendor) == (1, 1, "")
        assert (reported.pitch_deg, reported.yaw_deg) == ((-90.0, 20.0), (-180.0, 180.0))
        assert flight.vehicle.gimbals.ids == (1,)


async def test_second_information_call_needs_new_answer() -> None:
    gimbal = SimulatedGimbal(pitch_deg=(-80.0, 10.0))
    async with with_gimbals(gimbal) as flight:
        await flight.vehicle.gimbal.information()
        roll, _, yaw = gimbal.limits
        gimbal.limits = (roll, (math.radians(-50.0), 0.0), yaw)
        changed = await flight.vehicle.gimbal.information()
        assert changed.pitch_deg == (-50.0, 0.0)
        gimbal.faults.refuse(REQUEST, MavResult.FAILED)
        with pytest.raises(CommandRejected):
            await flight.vehicle.gimbal.information()


async def test_information_without_gimbal_is_rejected() -> None:
    async with open_flight() as flight:
        flight.copter.faults.refuse(REQUEST, MavResult.FAILED)
        with pytest.raises(CommandRejected):
            await flight.vehicle.gimbal.information()


@pytest.mark.parametrize("tolerance", [0.0, 46.0, math.nan])
async def test_tolerance_out_of_range_is_refused(tolerance: float, grounded: Flight) -> None:
    with pytest.raises(InvalidArgument, match="tolerance_deg"):
        await grounded.vehicle.gimbal.point(0, 0, tolerance_deg=tolerance)
    with pytest.raises(InvalidArgument, match="frame"):
        await grounded.vehicle.gimbal.point(0, 0, frame="sideways")  # type: ignore[arg-type]
    assert not grounded.wire.commands(PITCHYAW)


# ------------------------------------------------------------------------------------------- several


async def test_several_gimbals_are_discovered() -> None:
    one, two = SimulatedGimbal(154), SimulatedGimbal(171)
    copter = copter_with_mount(components=[one, two])
    async with open_flight(copter) as flight:
        gimbals = flight.vehicle.gimbals
        assert await gimbals.discover() == (1, 154, 171)
        assert len(gimbals) == 3
        assert [gimbal.device_id for gimbal in gimbals] == [1, 154, 171]
        await gimbals[171].point(-30.0, 0.0, frame="vehicle")
        assert (degrees(one)[1], degrees(two)[1]) == pytest.approx((0, -30), abs=3)
        await gimbals[1].point(-10.0, 0.0, frame="vehicle")
        assert gimbals[1].attitude.value.pitch_deg == pytest.approx(-10, abs=3)
        assert flight.vehicle.gimbal.device_id == 1
        to = [(command.target_component, command.param7) for command in flight.wire.commands(PITCHYAW)]  # type: ignore[union-attr]
        assert to == [(171, 171), (171, 171), (1, 1)]
        claimed = [command.target_component for command in flight.wire.commands(CONFIGURE)]
        assert claimed == [171]


async def test_first_gimbal_is_the_autopilots() -> None:
    async with open_flight(copter_with_mount(components=[SimulatedGimbal()])) as flight:
        await flight.vehicle.gimbals.discover()
        assert flight.vehicle.gimbal.attitude.source == Source(1, 154, "GIMBAL_DEVICE_ATTITUDE_STATUS")
        await flight.vehicle.gimbal.point(0.0, 0.0, frame="vehicle")
        assert flight.vehicle.gimbals[1].attitude.value.pitch_deg == pytest.approx(0, abs=3)
        assert [command.target_component for command in flight.wire.commands(PITCHYAW)] == [1]


async def test_undiscovered_gimbal_is_asked_for_its_manager() -> None:
    gimbal = SimulatedGimbal(172, attitude_rate_hz=0.0)
    async with open_flight(SimulatedCopter(boot_time_s=0.0, components=[gimbal])) as flight:
        reported = await flight.vehicle.gimbals.get(172).information()
        assert reported.manager_component_id == 172


async def test_autopilot_manages_component_gimbal() -> None:
    """PX4 with a MAVLink gimbal: the autopilot takes precedence over the gimbal as manager."""
    async with with_gimbals(SimulatedGimbal()) as flight:
        flight.wire.deliver(FrameEncoder(1, 1).encode(m.GimbalManagerStatus(0, 0, 154, 0, 0, 0, 0)))
        flight.copter.faults.refuse(PITCHYAW, MavResult.ACCEPTED)
        await flight.vehicle.gimbals[154].point(0.0, 0.0, frame="vehicle", wait=False)
        (command,) = flight.wire.commands(PITCHYAW)
        assert (command.target_component, command.param7) == (1, 154)  # type: ignore[union-attr]


async def test_number_of_gimbals_is_bounded() -> None:
    async with open_flight() as flight:
        flight.vehicle.gimbal  # noqa: B018 - it begins to listen
        for number in range(2, 200):
            message = m.GimbalDeviceAttitudeStatus(0, 0, 0, 32, (1, 0, 0, 0), 0, 0, 0, 0)
            flight.wire.deliver(FrameEncoder(1, number).encode(message))
        gimbals = flight.vehicle.gimbals
        assert len(gimbals) == MAX_GIMBALS
        with pytest.raises(BusyError):
            gimbals.get(250)
        assert len({id(gimbal) for gimbal in gimbals}) == MAX_GIMBALS
        assert gimbals.get(1) is gimbals.get(1)
    with pytest.raises(InvalidArgument):
        gimbals.get(0)


async def test_zero_device_id_is_first_autopilot_gimbal() -> None:
    async with open_flight() as flight:
        message = m.GimbalDeviceAttitudeStatus(0, 0, 0, 32, (1, 0, 0, 0), 0, 0, 0, 0)
        flight.wire.deliver(FrameEncoder(1, 1).encode(message))
        assert flight.vehicle.gimbals.ids == (1,)


def report(flight: Flight, component: int, message: object) -> None:
    flight.wire.deliver(FrameEncoder(1, component).encode(message))  # type: ignore[arg-type]


def attitude_of(number: int, q: tuple[float, ...] = (1, 0, 0, 0)) -> m.GimbalDeviceAttitudeStatus:
    return m.GimbalDeviceAttitudeStatus(0, 0, 0, 32, q, 0, 0, 0, 0, gimbal_device_id=number)


async def test_foreign_device_id_is_ignored() -> None:
    async with with_gimbals(SimulatedGimbal()) as flight:
        report(flight, 154, attitude_of(9))
        report(flight, 30, attitude_of(154, (0, 1, 0, 0)))
        assert flight.vehicle.gimbals.ids == (154,)
        assert flight.vehicle.gimbal.attitude.value.roll_deg == pytest.approx(0, abs=1)
        await flight.vehicle.gimbal.point(-20.0, 0.0, frame="vehicle")
        report(flight, 154, m.GimbalManagerInformation(0, 0, 9, 0, 0, 0, 0, 0, 0))
        report(flight, 191, m.GimbalManagerStatus(0, 0, 171, 0, 0, 0, 0))
        assert flight.vehicle.gimbals.ids == (154,)


async def test_device_ids_are_own_id_or_number() -> None:
    async with open_flight() as flight:
        flight.vehicle.gimbal  # noqa: B018 - it begins to listen
        for sender, number in ((1, 2), (30, 0), (40, 40), (50, 6), (171, 0)):
            report(flight, sender, attitude_of(number))
        assert flight.vehicle.gimbals.ids == (2, 30, 40, 6, 171)


async def test_gone_gimbal_is_no_longer_first() -> None:
    one, two = SimulatedGimbal(154), SimulatedGimbal(171)
    async with with_gimbals(one, two) as flight:
        vehicle = flight.vehicle
        await anyio.sleep(3.0)
        one.faults.silent = True
        await anyio.sleep(9.0)
        assert vehicle.gimbals.ids == (154, 171)
        await anyio.sleep(3.0)
        assert vehicle.gimbals.ids == (171, 154)
        assert [gimbal.device_id for gimbal in vehicle.gimbals] == [171, 154]
        await vehicle.gimbal.point(-20.0, 0.0, frame="vehicle")
        assert degrees(two)[1] == pytest.approx(-20, abs=3)
        source = vehicle.gimbal.attitude.source
        assert source is not None
        assert source.component_id == 171
        one.faults.silent = False
        await anyio.sleep(2.0)
        assert vehicle.gimbals.ids == (154, 171)


async def test_first_gimbal_is_kept_after_link_outage() -> None:
    one, two = SimulatedGimbal(154), SimulatedGimbal(171)
    async with with_gimbals(one, two) as flight:
        await anyio.sleep(12.0)
        for simulated in (flight.copter, one, two):
            simulated.faults.silent = True
        await anyio.sleep(15.0)
        report(flight, 171, attitude_of(0))
        assert flight.vehicle.gimbals.ids == (154, 171)
        two.faults.silent = flight.copter.faults.silent = False
        await anyio.sleep(3.0)
        assert flight.vehicle.gimbals.ids == (154, 171)


async def test_gimbal_in_use_stays_first() -> None:
    one, two = SimulatedGimbal(154), SimulatedGimbal(171)
    async with with_gimbals(one, two) as flight:
        await flight.vehicle.gimbals[171].point(-30.0, 0.0, frame="vehicle")
        one.faults.refuse(PITCHYAW, MavResult.ACCEPTED)
        asyncio.get_running_loop().call_later(1.0, setattr, one.faults, "silent", True)
        with pytest.raises(OperationTimeout):
            await flight.vehicle.gimbal.point(-30.0, 0.0, frame="vehicle", timeout=20.0)


async def test_foreign_status_does_not_redirect_orders() -> None:
    async with with_gimbals(SimulatedGimbal()) as flight:
        report(flight, 191, m.GimbalManagerStatus(0, 0, 154, 9, 9, 0, 0))
        assert flight.vehicle.gimbal.controllers.value.primary != (9, 9)
        report(flight, 191, m.GimbalManagerInformation(0, 0, 154, 0, 0, 0, 0, 0, 0))
        await flight.vehicle.gimbal.point(-20.0, 0.0, frame="vehicle")
        assert {command.target_component for command in flight.wire.commands(PITCHYAW)} == {154}


@pytest.mark.parametrize("number", [0, 30])
async def test_gimbal_of_any_id_manages_itself(number: int) -> None:
    async with open_flight() as flight:
        gimbals = flight.vehicle.gimbals
        report(flight, 30, attitude_of(number))
        report(flight, 30, m.GimbalManagerStatus(0, 0, number, 0, 0, 0, 0))
        report(flight, 191, m.GimbalManagerInformation(0, 0, 30, 0, 0, 0, 0, 0, 0))
        with pytest.raises(CommandTimeout):
            await gimbals[30].point(0.0, 0.0, wait=False)
        assert {command.target_component for command in flight.wire.commands(PITCHYAW)} == {30}


async def test_gone_manager_is_replaced() -> None:
    gimbal = SimulatedGimbal()
    async with with_gimbals(gimbal) as flight:
        gimbal.faults.silent = True
        status = m.GimbalManagerStatus(0, 0, 154, 9, 9, 0, 0)
        await anyio.sleep(9.0)
        report(flight, 191, status)
        assert flight.vehicle.gimbal.controllers.value.primary == (0, 0)
        await anyio.sleep(3.0)
        report(flight, 191, status)
        assert flight.vehicle.gimbal.controllers.value.primary == (9, 9)


async def test_manager_with_information_takes_precedence() -> None:
    async with open_flight() as flight:
        vehicle = flight.vehicle
        vehicle.gimbal  # noqa: B018 - it begins to listen
        report(flight, 154, attitude_of(0))
        report(flight, 191, m.GimbalManagerStatus(0, 0, 154, 1, 1, 0, 0))
        assert vehicle.gimbal.controllers.value.primary == (1, 1)
        report(flight, 192, m.GimbalManagerInformation(0, 0, 154, 0, 0, 0, 0, 0, 0))
        report(flight, 192, m.GimbalManagerStatus(0, 0, 154, 2, 2, 0, 0))
        report(flight, 191, m.GimbalManagerStatus(0, 0, 154, 1, 1, 0, 0))
        assert vehicle.gimbal.controllers.value.primary == (2, 2)
        report(flight, 1, m.GimbalManagerStatus(0, 0, 154, 3, 3, 0, 0))
        report(flight, 192, m.GimbalManagerStatus(0, 0, 154, 2, 2, 0, 0))
        assert vehicle.gimbal.controllers.value.primary == (3, 3)


@pytest.mark.parametrize("wrong", [math.inf, -math.inf, math.nan])
async def test_nan_attitude_is_unknown(wrong: float) -> None:
    async with open_flight() as flight:
        attitude = flight.vehicle.gimbal.attitude
        for place in range(4):
            report(flight, 154, attitude_of(0, tuple(wrong if place == index else 0.5 for index in range(4))))
            reported = attitude.value
            assert (reported.pitch_deg, reported.roll_deg, reported.yaw_deg, reported.yaw_from_nose_deg) == (None,) * 4


async def test_look_at_system_refuses_bool() -> None:
    async with mounted() as flight:
        with pytest.raises(InvalidArgument, match="system_id = True is not allowed: it must be 1 to 255"):
            await flight.vehicle.gimbal.look_at_system(True)
        assert not flight.wire.commands(MavCmd.DO_SET_ROI_SYSID)
