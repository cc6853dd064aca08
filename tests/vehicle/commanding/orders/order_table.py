"""Every order of docs/reliability.md: how it is given, where, and the modes that it may bring about."""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable
from typing import Any

import anyio
from call_table import CALLS, Row, north

import aerokit
from aerokit import missions
from aerokit.mavlink.enums import MavCmd
from aerokit.vehicle.external.values import TargetMeasurement

Give = Callable[[aerokit.Vehicle], Awaitable[object]]


async def _fly_setpoints(vehicle: aerokit.Vehicle) -> None:
    async with vehicle.guided.velocity() as stream:
        await stream.fly(aerokit.VelocitySetpoint(north_m_s=1.0), 6.0)


async def _fly_body_rates(vehicle: aerokit.Vehicle) -> None:
    async with vehicle.guided.attitude_rate() as stream:
        await stream.fly(aerokit.AttitudeRateSetpoint(), 6.0)


async def _fly_trajectory(vehicle: aerokit.Vehicle) -> None:
    place = aerokit.TrajectorySetpoint(5.0, 0.0, -10.0, north_m_s=0.5)
    async with vehicle.guided.trajectory(place) as stream:
        await stream.fly(place, 6.0)


async def _follow(vehicle: aerokit.Vehicle) -> None:
    target = north(vehicle, 12.0)
    async with vehicle.follow(lambda: target, distance_m=4) as following:
        await following.fly(6.0)


async def _fly_by_sticks(vehicle: aerokit.Vehicle) -> None:
    async with vehicle.sticks() as sticks:
        await sticks.move(aerokit.StickInput(forward=0.3), 6.0)


async def upload(vehicle: aerokit.Vehicle) -> None:
    here = vehicle.position.value
    places = [here.offset(north_m=20.0 * number) for number in range(1, 4)]
    items = [missions.waypoint(place.latitude_deg, place.longitude_deg, altitude_relative_m=20) for place in places]
    mission = missions.Mission(items)
    await vehicle.mission.upload(mission, method="items")


def _gimbal_up(vehicle: aerokit.Vehicle) -> Awaitable[object]:
    return vehicle.command(MavCmd.DO_SET_SERVO, 9, 1500)


async def _control_gimbal(vehicle: aerokit.Vehicle) -> None:
    async with vehicle.gimbal.control():
        await anyio.sleep(5.0)


async def _turn_gimbal(vehicle: aerokit.Vehicle) -> None:
    async with vehicle.gimbal.rates(-2.0, 3.0) as stream:
        await stream.turn(-2.0, 3.0, 5.0)


async def _post_place(vehicle: aerokit.Vehicle) -> None:
    place = north(vehicle, 12.0)
    x, y = round(place.latitude_deg * 1e7), round(place.longitude_deg * 1e7)
    with vehicle.posted("motion", modes=(vehicle.autopilot.find_mode("GUIDED"),)) as order:
        await order.command_int(MavCmd.DO_REPOSITION, -1, 1, frame=6, x=x, y=y, z=10)


def _set(name: tuple[str, str]) -> Give:
    async def give(vehicle: aerokit.Vehicle) -> Any:
        which = name[vehicle.autopilot.name == "PX4"]
        return await vehicle.parameters.set(which, 7.0)

    return give


def _calibrate(name: str, **options: Any) -> Give:
    async def give(vehicle: aerokit.Vehicle) -> None:
        with anyio.move_on_after(40.0):  # nobody turns the simulated vehicle
            async for _ in getattr(vehicle.calibrate, name)(**options):
                pass

    return give


CALIBRATION = int(MavCmd.PREFLIGHT_CALIBRATION)
SET_MODE = int(MavCmd.DO_SET_MODE)
PITCHYAW = int(MavCmd.DO_GIMBAL_MANAGER_PITCHYAW)
REPOSITION = int(MavCmd.DO_REPOSITION)
ARM = int(MavCmd.COMPONENT_ARM_DISARM)
RTL, LAND = int(MavCmd.NAV_RETURN_TO_LAUNCH), int(MavCmd.NAV_LAND)
REBOOT = int(MavCmd.PREFLIGHT_REBOOT_SHUTDOWN)

ROWS = (
    *(call.order for call in CALLS.values() if call.order is not None),
    Row(
        "calibrate.compass",
        _calibrate("compass"),
        int(MavCmd.DO_START_MAG_CAL),
        place="ground",
        steers=False,
        ends_later=True,
        on=("ardupilot",),
    ),
    Row(
        "calibrate.compass",
        _calibrate("compass"),
        CALIBRATION,
        place="ground",
        steers=False,
        ends_later=True,
        on=("px4",),
    ),
    *(
        Row(f"calibrate.{name}", _calibrate(name), CALIBRATION, place="ground", steers=False, ends_later=True)
        for name in ("accelerometer", "barometer", "gyroscope", "level")
    ),
    Row(
        "calibrate.escs",
        _calibrate("escs", intent="propellers are removed"),
        CALIBRATION,
        place="ground",
        steers=False,
        ends_later=True,
        on=("px4",),
    ),
    Row(
        "set_mode",
        lambda v: v.set_mode("LOITER"),
        SET_MODE,
        modes=(("LOITER",), ("LOITER",)),
        on=("ardupilot",),
    ),
    Row("set_mode", lambda v: v.set_mode("LAND"), SET_MODE, modes=(("LAND",), ("LAND",)), on=("px4",)),
    Row("hold", lambda v: v.hold(), REPOSITION, modes=(("BRAKE",), ("LOITER",)), on=("px4",)),
    Row(
        "go_to",
        lambda v: v.go_to(north(v, 12.0), timeout=30),
        REPOSITION,
        modes=(("GUIDED", "BRAKE"), ("LOITER", "OFFBOARD")),
        holds=True,
    ),
    Row(
        "go_to from another mode",
        lambda v: v.go_to(north(v, 12.0), timeout=30),
        REPOSITION,
        place="air, flown by hand",
        modes=(("GUIDED", "BRAKE"), ("LOITER", "OFFBOARD")),
        holds=True,
    ),
    Row(
        "orbit",
        lambda v: v.orbit(north(v, 12.0), radius_m=6, speed_m_s=3, timeout=30),
        SET_MODE,
        modes=(("GUIDED", "BRAKE"), ()),
        holds=True,
        on=("ardupilot",),
    ),
    Row(
        "orbit",
        lambda v: v.orbit(north(v, 12.0), radius_m=6, speed_m_s=3, timeout=30),
        int(MavCmd.DO_ORBIT),
        modes=((), ("ORBIT", "LOITER")),
        holds=True,
        on=("px4",),
    ),
    Row(
        "figure_eight",
        lambda v: v.figure_eight(north(v, 12.0), major_radius_m=8, minor_radius_m=4, speed_m_s=3, timeout=30),
        SET_MODE,
        modes=(("GUIDED", "BRAKE"), ("OFFBOARD", "LOITER")),
        holds=True,
    ),
    Row(
        "loiter",
        lambda v: v.loiter(north(v, 12.0), duration_s=2, timeout=30),
        REPOSITION,
        modes=(("GUIDED", "BRAKE"), ("LOITER",)),
        holds=True,
    ),
    Row("follow", _follow, SET_MODE, modes=(("GUIDED", "BRAKE"), ("OFFBOARD", "LOITER")), holds=True),
    Row(
        "take_off",
        lambda v: v.take_off(6.0, timeout=30),
        int(MavCmd.NAV_TAKEOFF),
        place="armed",
        modes=(("GUIDED", "BRAKE"), ("TAKEOFF", "LOITER")),
        holds=True,
    ),
    Row(
        "set_heading",
        lambda v: v.set_heading(45.0, relative=True, timeout=15),
        int(MavCmd.CONDITION_YAW),
        modes=(("GUIDED",), ("LOITER",)),
        on=("ardupilot",),
    ),
    Row(
        "set_heading with a direction",
        lambda v: v.set_heading(-200.0, relative=True, timeout=15),
        int(MavCmd.CONDITION_YAW),
        modes=(("GUIDED",), ()),
        on=("ardupilot",),
    ),
    Row(
        "guided.velocity",
        _fly_setpoints,
        SET_MODE,
        modes=(("GUIDED", "BRAKE"), ("OFFBOARD", "LOITER")),
        holds=True,
    ),
    Row(
        "guided.attitude_rate",
        _fly_body_rates,
        SET_MODE,
        modes=(("GUIDED", "BRAKE"), ("OFFBOARD", "LOITER")),
        holds=True,
    ),
    Row(
        "guided.trajectory",
        _fly_trajectory,
        SET_MODE,
        modes=(("GUIDED", "BRAKE"), ("OFFBOARD", "LOITER")),
        holds=True,
    ),
    Row(
        "sticks",
        _fly_by_sticks,
        SET_MODE,
        modes=(("LOITER", "BRAKE"), ("POSCTL", "LOITER")),
        holds=True,
    ),
    Row(
        "land_on",
        lambda v: v.land_on(lambda: TargetMeasurement(0.1, 0.1, 5.0, is_level=True), timeout=60),
        SET_MODE,
        modes=((), ("PRECLAND",)),
        on=("px4",),  # ArduPilot needs PLND_ENABLED = 1.
    ),
    Row(
        "external.set_wind",
        lambda v: v.external.set_wind(3.0, 90.0),
        int(MavCmd.EXTERNAL_WIND_ESTIMATE),
        steers=False,
    ),
    Row(
        "mission.start",
        lambda v: v.mission.start(),
        int(MavCmd.MISSION_START),
        place="air, with a mission",
        modes=(("AUTO", "BRAKE"), ("MISSION", "LOITER")),
        holds=True,
        on=("ardupilot",),
    ),
    Row(
        "mission.start",
        lambda v: v.mission.start(),
        SET_MODE,
        place="air, with a mission",
        modes=(("AUTO", "BRAKE"), ("MISSION", "LOITER")),
        holds=True,
        on=("px4",),
    ),
    Row(
        "mission.pause",
        lambda v: v.mission.pause(),
        SET_MODE,
        place="air, on its mission",
        modes=(("BRAKE",), ("LOITER",)),
    ),
    Row(
        "mission.resume",
        lambda v: v.mission.resume(),
        SET_MODE,
        place="air, with a mission",
        modes=(("AUTO", "BRAKE"), ("MISSION", "LOITER")),
        holds=True,
    ),
    Row(
        "mission.set_current",
        lambda v: v.mission.set_current(1),
        int(MavCmd.DO_SET_MISSION_CURRENT),
        place="air, on its mission",
        steers=False,
    ),
    Row(
        "gimbal.point",
        lambda v: v.gimbal.point(-45.0, 90.0, wait=False),
        PITCHYAW,
        steers=False,
    ),
    Row("gimbal.neutral", lambda v: v.gimbal.neutral(), PITCHYAW, steers=False, on=("ardupilot",)),
    Row(
        "gimbal.look_at",
        lambda v: v.gimbal.look_at(north(v, 50.0)),
        int(MavCmd.DO_SET_ROI_LOCATION),
        steers=False,
    ),
    Row(
        "gimbal.control",
        _control_gimbal,
        int(MavCmd.DO_GIMBAL_MANAGER_CONFIGURE),
        steers=False,
        ends_later=True,
        on=("ardupilot",),
    ),
    Row("gimbal.rates", _turn_gimbal, PITCHYAW, steers=False, ends_later=True, on=("ardupilot",)),
    Row("gimbal.release", lambda v: v.gimbal.release(), int(MavCmd.DO_MOUNT_CONTROL), steers=False),
    Row("posted", _post_place, REPOSITION, modes=(("GUIDED",), ("LOITER",)), on=("ardupilot",)),
    Row("command", _gimbal_up, int(MavCmd.DO_SET_SERVO), steers=False, on=("ardupilot",)),
    Row("command return", lambda v: v.command(RTL), RTL, modes=(("RTL",), ("RTL",))),
    Row("command land", lambda v: v.command(LAND), LAND, modes=(("LAND",), ("LAND",))),
    Row(
        "command reposition, twice at most",
        lambda v: v.command(REPOSITION, -1, 1, 0, *(math.nan,) * 4, retries=1),
        REPOSITION,
        modes=((), ("LOITER", "OFFBOARD")),
        on=("px4",),
    ),
    Row("command arm", lambda v: v.command(ARM, 1), ARM, place="ground", steers=False),
    Row("parameters.set", _set(("WP_YAW_BEHAVIOR", "NAV_ACC_RAD")), 0, steers=False),
    Row("mission.upload", upload, 0, steers=False),
)
