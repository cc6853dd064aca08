"""`vehicle.gimbal` and regions of interest: commands and messages by firmware; on virtual time."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import anyio
import pytest
from flight_harness import Flight, Wire, in_the_air, open_flight

import aerokit
from aerokit import Position
from aerokit import messages as m
from aerokit.connection.cells import Source
from aerokit.errors import (
    CommandRejected,
    CommandTimeout,
    InvalidArgument,
    OperationRejected,
    OperationTimeout,
)
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import MavCmd, MavResult, MavRoi
from aerokit.mavlink.message import Message
from aerokit.sim import SimulatedCopter, SimulatedGimbal, SimulatedPx4, SimulatedVehicle, simulated_link
from aerokit.sim.commands import CommandHandler

pytestmark = pytest.mark.anyio

PITCHYAW, MOUNT = MavCmd.DO_GIMBAL_MANAGER_PITCHYAW, MavCmd.DO_MOUNT_CONTROL
CONFIGURE, ROI = MavCmd.DO_GIMBAL_MANAGER_CONFIGURE, MavCmd.DO_SET_ROI
UNSUPPORTED, DENIED = MavResult.UNSUPPORTED, MavResult.DENIED


def with_gimbal() -> SimulatedCopter:
    copter = SimulatedCopter(boot_time_s=0.0)
    copter.parameters["MNT1_TYPE"] = 1.0
    return copter


def place(flight: Flight, **altitudes: float) -> Position:
    home = flight.vehicle.home.value
    return Position(home.latitude_deg + 0.001, home.longitude_deg, **altitudes)


def params(message: Message) -> tuple[int, ...]:
    fields: Any = message
    return tuple(round(getattr(fields, f"param{number}")) for number in (1, 2, 3, 7))


async def test_gimbal_points_and_reports_attitude() -> None:
    async with in_the_air(copter=with_gimbal()) as flight:
        gimbal = flight.vehicle.gimbal
        await gimbal.point(-45.0, 90.0, wait=False)
        reported = await gimbal.attitude.wait_until(
            lambda attitude: abs((attitude.pitch_deg or 0.0) + 45) < 1, timeout=5
        )
        assert reported.yaw_deg == pytest.approx(90, abs=2)
        assert gimbal.attitude.source == Source(1, 1, "GIMBAL_DEVICE_ATTITUDE_STATUS")
        (command,) = flight.wire.commands(PITCHYAW)
        assert (command.target_component, command.param5) == (1, 28)  # type: ignore[union-attr]
        await gimbal.release()
        (released,) = flight.wire.commands(MOUNT)
        assert params(released)[-1] == 3


@pytest.mark.parametrize(
    "autopilot", [with_gimbal, partial(SimulatedPx4, boot_time_s=0.0, parameters={"MNT_MODE_IN": 4.0})]
)
async def test_attitude_is_requested_while_awaited(
    autopilot: Callable[[], SimulatedVehicle],
) -> None:
    vehicle_there = autopilot()
    async with simulated_link(vehicle_there) as link, aerokit.connect(link) as vehicle:
        stream = m.GimbalDeviceAttitudeStatus.ID
        before = vehicle_there.channels[0].streams.interval(stream)
        await vehicle.gimbal.attitude.wait_until(lambda _: True, timeout=5)
        async for _ in vehicle.gimbal.attitude.updates():
            if vehicle_there.channels[0].streams.interval(stream) == pytest.approx(0.25):
                break
        with pytest.raises(OperationTimeout):
            await vehicle.gimbals[1].attitude.wait_until(lambda _: False, timeout=3)
        await anyio.sleep(2)
        assert vehicle_there.channels[0].streams.interval(stream) in (0.25, before)


async def test_attitude_request_ends_with_the_last_watcher() -> None:
    copter = with_gimbal()
    async with simulated_link(copter) as link, aerokit.connect(link) as vehicle:
        await vehicle.gimbal.attitude.wait_until(lambda _: True, timeout=5)
        await anyio.sleep(2)
        assert copter.channels[0].streams.interval(m.GimbalDeviceAttitudeStatus.ID) == 0.0


async def test_point_with_roll_uses_mount_command() -> None:
    async with in_the_air(copter=with_gimbal()) as flight:
        await flight.vehicle.set_heading(90.0, tolerance_deg=1.0)
        flight.wire.clear()
        await flight.vehicle.gimbal.point(-45.0, 80.0, roll_deg=5.0, wait=False)
        (command,) = flight.wire.commands(MOUNT)
        assert params(command) == pytest.approx((-45, 5, -10, 2), abs=2)
        assert not flight.wire.commands(PITCHYAW)


async def test_denied_order_claims_control_until_release() -> None:
    async with open_flight() as flight:
        flight.copter.faults.refuse(PITCHYAW, DENIED)
        with pytest.raises(CommandRejected):
            await flight.vehicle.gimbal.point(-45.0, 0.0, wait=False)
        assert [len(flight.wire.commands(command)) for command in (PITCHYAW, CONFIGURE)] == [2, 1]
        # -1 leaves the secondary controller as it is; 0 would remove another station's secondary control.
        own_ids = (255, flight.vehicle.connection.source_component)
        assert params(flight.wire.commands(CONFIGURE)[0])[:3] == (*own_ids, -1)
        flight.copter.faults.refuse(MOUNT, MavResult.ACCEPTED)
        flight.copter.faults.refuse(CONFIGURE, MavResult.ACCEPTED)
        for _ in range(2):
            await flight.vehicle.gimbal.release()
        assert [params(command)[:3] for command in flight.wire.commands(CONFIGURE)[1:]] == [(-3, -3, -1)]


async def test_release_refused_by_mount_still_releases_control() -> None:
    async with open_flight() as flight:
        flight.copter.faults.refuse(PITCHYAW, DENIED)
        with pytest.raises(CommandRejected):
            await flight.vehicle.gimbal.point(-45.0, 0.0, wait=False)
        flight.wire.clear()
        for command in (MOUNT, CONFIGURE):
            flight.copter.faults.refuse(command, DENIED)
        with pytest.raises(CommandRejected):
            await flight.vehicle.gimbal.release()
        flight.copter.faults.refuse(CONFIGURE, MavResult.ACCEPTED)
        for _ in range(2):  # The first release of control was refused, so it is sent again, but only once.
            with pytest.raises(CommandRejected):
                await flight.vehicle.gimbal.release()
        assert [params(command)[:2] for command in flight.wire.commands(CONFIGURE)] == [(-3, -3)] * 2


async def test_mount_angles_wait_for_unknown_heading() -> None:
    async with open_flight(with_gimbal(), rates={}) as flight:
        await flight.vehicle.gimbal.point(-45.0, 80.0, roll_deg=5.0, wait=False)
        heading = flight.vehicle.attitude.value.yaw_deg
        (command,) = flight.wire.commands(MOUNT)
        assert params(command)[2] == pytest.approx(math.remainder(80 - heading, 360), abs=2)
        flight.copter.faults.lose(m.Attitude, times=99)
        await anyio.sleep(6.0)  # The known heading is too old now.
        with pytest.raises(OperationTimeout, match="the vehicle's heading"):
            await flight.vehicle.gimbal.point(-45.0, 80.0, roll_deg=5.0, wait=False)
        await flight.vehicle.gimbal.point(-45.0, 80.0, roll_deg=5.0, frame="vehicle", wait=False)
        assert [params(command)[2] for command in flight.wire.commands(MOUNT)[1:]] == [80]


async def test_mount_configure_superseded_is_not_sent() -> None:
    async with open_flight() as flight:
        for command in (PITCHYAW, MOUNT):
            flight.copter.faults.refuse(command, UNSUPPORTED)

        async def point() -> None:
            with pytest.raises(OperationRejected, match="another order was given"):
                await flight.vehicle.gimbal.point(-45.0, 0.0, roll_deg=5.0, frame="vehicle", wait=False)

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(point)
            await anyio.sleep(0.1)
            await flight.vehicle.gimbal.release()
        assert [message.mount_mode for message in flight.wire.all(m.MountConfigure)] == [3]


async def test_old_firmware_gets_mount_messages() -> None:
    async with open_flight() as flight:
        for command in (PITCHYAW, MOUNT):
            flight.copter.faults.refuse(command, UNSUPPORTED)
        for _ in range(2):
            await flight.vehicle.gimbal.point(-45.5, 90.0, wait=False)
        assert [len(flight.wire.commands(command)) for command in (PITCHYAW, MOUNT)] == [1, 1]
        control = flight.wire.all(m.MountControl)
        assert [(message.input_a, message.input_b, message.input_c) for message in control] == [(-4550, 0, 9000)] * 2
        assert [message.mount_mode for message in flight.wire.all(m.MountConfigure)] == [2, 2]


async def test_standalone_gimbal_is_reported_and_first_one_wins() -> None:
    copter = SimulatedCopter(boot_time_s=0.0, components=[SimulatedGimbal(171), SimulatedGimbal(154)])
    async with open_flight(copter) as flight:
        attitude = flight.vehicle.gimbal.attitude
        await attitude.wait_until(lambda _: True, timeout=3)
        await anyio.sleep(1.0)
        assert attitude.source is not None
        assert attitude.source.component_id == 154
        assert attitude.value.pitch_deg == 0.0


async def test_mount_attitude_is_used_until_a_gimbal_reports() -> None:
    async with open_flight() as flight:
        attitude, deliver = flight.vehicle.gimbal.attitude, flight.wire.deliver
        heading = (await flight.vehicle.attitude.wait_until(lambda _: True, timeout=5)).yaw_deg
        deliver(FrameEncoder(1, 1).encode(m.MountOrientation(0, 1.0, -30.0, 10.0)))
        assert attitude.value.pitch_deg == -30.0
        assert attitude.value.yaw_deg == pytest.approx((heading + 10.0) % 360.0, abs=0.1)
        deliver(FrameEncoder(1, 154).encode(m.GimbalDeviceAttitudeStatus(0, 0, 0, 32, (1, 0, 0, 0), 0, 0, 0, 0)))
        assert attitude.value.pitch_deg == 0.0
        deliver(FrameEncoder(1, 1).encode(m.MountOrientation(0, 1.0, -40.0, 10.0)))
        assert attitude.value.pitch_deg == 0.0


async def test_reboot_clears_gimbal_state() -> None:
    async with open_flight(with_gimbal()) as flight:
        vehicle = flight.vehicle
        with vehicle.rate(m.GimbalDeviceAttitudeStatus, 10.0):
            await vehicle.gimbal.attitude.wait_until(lambda _: True, timeout=5)
        flight.copter.reboot(0.5)
        await vehicle.home.wait_until(lambda _: not vehicle.gimbal.attitude.is_known, timeout=20)


@pytest.mark.parametrize("wrong", [math.nan, math.inf, 361.0])
async def test_angles_out_of_range_are_refused(wrong: float, grounded: Flight) -> None:
    gimbal = grounded.vehicle.gimbal
    for pitch, yaw, roll in ((wrong, 0.0, 0.0), (0.0, wrong, 0.0), (0.0, 0.0, wrong)):
        with pytest.raises(InvalidArgument, match=r"_deg = .* is not allowed"):
            await gimbal.point(pitch, yaw, roll_deg=roll)
    assert not [command for kind in (PITCHYAW, MOUNT) for command in grounded.wire.commands(kind)]


# ------------------------------------------------------------------------------------------------ regions of interest


@pytest.mark.parametrize("result", [UNSUPPORTED, MavResult.COMMAND_LONG_ONLY])
async def test_old_firmware_gets_legacy_roi_command(flying: Flight, result: int) -> None:
    flying.copter.faults.refuse(MavCmd.DO_SET_ROI_LOCATION, result)
    flying.copter.faults.refuse(MavCmd.DO_SET_ROI_NONE, UNSUPPORTED)
    home = flying.vehicle.home.value.altitude_amsl_m
    await flying.vehicle.look_at(place(flying, altitude_relative_m=10.0))
    await flying.vehicle.look_at(place(flying, altitude_amsl_m=home + 20.0))
    assert len(flying.wire.commands(MavCmd.DO_SET_ROI_LOCATION)) == 1
    above, sea = flying.wire.commands(ROI)
    assert (params(above)[-1], params(sea)[-1]) == (10, 20)
    assert above.param1 == sea.param1 == MavRoi.LOCATION
    await flying.vehicle.stop_looking()
    assert params(flying.wire.commands(ROI)[-1]) == (0, 0, 0, 0)


async def test_unanswered_command_int_roi_has_no_legacy_fallback(flying: Flight) -> None:
    flying.copter.faults.ignore(MavCmd.DO_SET_ROI_LOCATION)
    with pytest.raises(CommandTimeout):
        await flying.vehicle.look_at(place(flying, altitude_relative_m=10.0))
    assert not flying.wire.commands(ROI)
    flying.vehicle.capabilities.forget()
    await flying.vehicle.look_at(place(flying, altitude_relative_m=10.0))
    assert len(flying.wire.commands(ROI)) == 1


async def test_px4_roi_uses_amsl_altitude() -> None:
    async with simulated_link(SimulatedPx4(boot_time_s=1.0)) as link:
        wire = Wire(link)
        async with aerokit.connect(wire) as vehicle:
            await vehicle.wait_ready()
            home = vehicle.home.value
            target = Position(home.latitude_deg, home.longitude_deg, altitude_relative_m=5.0)
            await vehicle.look_at(target)
            command: Any = wire.commands(MavCmd.DO_SET_ROI_LOCATION)[0]
            assert (command.frame, command.z) == (5, pytest.approx(home.altitude_amsl_m + 5.0))
            await vehicle.look_at(home)
            command = wire.commands(MavCmd.DO_SET_ROI_LOCATION)[-1]
            assert (command.frame, command.z) == (5, pytest.approx(home.altitude_amsl_m))


class WithoutCommandInt(SimulatedCopter):
    """Firmware that supports setting home by COMMAND_LONG only."""

    def make_commands(self) -> dict[int, CommandHandler]:
        commands = super().make_commands()
        knows = commands[MavCmd.DO_SET_HOME]
        commands[MavCmd.DO_SET_HOME] = lambda command: knows(command) if command.is_long else UNSUPPORTED
        return commands


async def test_set_home_without_command_int() -> None:
    async with in_the_air(copter=WithoutCommandInt(boot_time_s=0.0)) as flight:
        wanted = place(flight, altitude_amsl_m=flight.vehicle.home.value.altitude_amsl_m)
        await flight.vehicle.set_home(wanted)
        assert flight.vehicle.home.value.position.distance_to(wanted) < 1.0  # precision of a 32-bit float
        kinds = [type(command) for command in flight.wire.commands(MavCmd.DO_SET_HOME)]
        assert kinds == [m.CommandInt, m.CommandLong]


async def test_set_home_px4_uses_global_frame() -> None:
    async with simulated_link(SimulatedPx4(boot_time_s=1.0)) as link, aerokit.connect(link) as vehicle:
        await vehicle.wait_ready()
        home = vehicle.home.value.position
        there = home.offset(north_m=50.0)
        wanted = Position(there.latitude_deg, there.longitude_deg, altitude_amsl_m=vehicle.home.value.altitude_amsl_m)
        await vehicle.set_home(wanted)
        assert vehicle.home.value.position.distance_to(wanted) < 0.1


async def test_denial_of_another_station_claims_no_control() -> None:
    async with in_the_air(copter=with_gimbal()) as flight:
        flight.copter.faults.ignore(PITCHYAW, times=1)
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(partial(flight.vehicle.gimbal.point, -10.0, 0.0, wait=False))
            await anyio.sleep(0.1)
            flight.copter.send(m.CommandAck(PITCHYAW, DENIED, 0, 0, 254, 190))
            await anyio.sleep(0.1)
            assert flight.vehicle._session.commands.last_result(PITCHYAW) is None
        await flight.vehicle.gimbal.point(-20.0, 0.0, wait=False)
        assert not flight.wire.commands(CONFIGURE)


@pytest.mark.parametrize("newer", ["stop_looking", "go_to"])
async def test_legacy_roi_is_not_sent_after_newer_order(newer: str) -> None:
    async with in_the_air() as flight:
        vehicle, target = flight.vehicle, place(flight, altitude_relative_m=5.0)
        flight.copter.faults.ignore(MavCmd.DO_SET_ROI_LOCATION)
        flight.copter.send(m.AutopilotVersion(1, 0, 0, 0, 0, b"", b"", b"", 0, 0, 0))
        await anyio.sleep(0.5)

        async def look() -> None:
            with pytest.raises(OperationRejected, match="another order was given"):
                await vehicle.look_at(target)

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(look)
            await anyio.sleep(0.3)
            if newer == "go_to":
                await vehicle.go_to(vehicle.position.value.offset(north_m=20.0))
            else:
                await vehicle.stop_looking()
        assert len(flight.wire.commands(MavCmd.DO_SET_ROI_LOCATION)) == 1
        assert not flight.wire.commands(ROI)


async def test_unsupported_command_is_tried_again_after_reboot() -> None:
    """E.g. a mount that is enabled from the next boot on."""
    async with open_flight(copter=with_gimbal()) as flight:
        vehicle, sent = flight.vehicle, flight.wire.commands
        await vehicle.wait_ready()
        flight.copter.faults.refuse(PITCHYAW, UNSUPPORTED, times=1)
        await vehicle.gimbal.point(-10.0, 0.0, wait=False)
        assert (len(sent(PITCHYAW)), len(sent(MOUNT))) == (1, 1)
        await vehicle.reboot()
        await vehicle.gimbal.point(-20.0, 0.0, wait=False)
        assert (len(sent(PITCHYAW)), len(sent(MOUNT))) == (2, 1)
