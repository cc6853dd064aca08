"""MAVSDK flies the vehicle by its plugins: param, mission_raw (the one for both autopilots), action, telemetry."""

# pyright: reportMissingImports=false
from __future__ import annotations

import asyncio
import sys
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any, TypeVar

from mavsdk.asyncio import ComponentType, Configuration, Mavsdk
from mavsdk.asyncio.plugins.action import ActionAsync
from mavsdk.asyncio.plugins.mission_raw import MissionRawAsync
from mavsdk.asyncio.plugins.param import ParamAsync
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync
from mavsdk.exceptions import MavsdkError
from mavsdk.plugins.mission_raw import MissionItem
from steps import ALTITUDE_M, PARAMETERS, Steps, mission

T = TypeVar("T")


async def command_until_accepted(action: Callable[[], Awaitable[T]]) -> T:
    """Repeat until the vehicle is ready for it."""
    refusal: MavsdkError | None = None
    for _ in range(60):
        try:
            return await action()
        except MavsdkError as error:
            refusal = error
            await asyncio.sleep(0.5)
    sys.exit(f"refused again and again: {refusal}")


async def until(values: AsyncIterator[T], condition: Callable[[T], bool], timeout: float = 90.0) -> T:
    """The first of these values that fulfils a condition."""

    async def find() -> T:
        async for value in values:
            if condition(value):
                return value
        raise EOFError

    return await asyncio.wait_for(find(), timeout)


def raw_items(kind: str) -> list[Any]:
    return [
        MissionItem(
            number, item.frame, item.command, int(number == 0), 1, item.hold_s, 0.0, 0.0, 0.0,
            round(item.latitude * 1e7), round(item.longitude * 1e7), item.altitude_m, 0,
        )
        for number, item in enumerate(mission(kind))
    ]  # fmt: skip


async def fly(kind: str, port: int) -> None:
    steps = Steps()
    mavsdk = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
    await mavsdk.add_any_connection(f"udpin://127.0.0.1:{port}")
    system = None
    while system is None:  # until MAX_DURATION_S of fly.py
        system = await mavsdk.first_autopilot(timeout_s=30.0)
    steps.done("connect")
    param, raw = ParamAsync(system), MissionRawAsync(system)
    action, telemetry = ActionAsync(system), TelemetryAsync(system)

    found = await param.get_all_params()
    count = len(found.int_params) + len(found.float_params) + len(found.custom_params)
    assert count >= PARAMETERS[kind], count
    steps.done("parameters", count)

    items = raw_items(kind)
    await command_until_accepted(lambda: raw.upload_mission(items))
    steps.done("upload", len(items))
    back = await raw.download_mission()
    assert [item.command for item in back] == [item.command for item in items], back
    assert [item.x for item in back[1:]] == [item.x for item in items[1:]], back
    steps.done("download", len(back))

    await telemetry.set_rate_position(5.0)  # ArduPilot streams no position unasked, and MAVSDK does not ask
    if kind == "px4":  # With ArduPilot, real or simulated, MAVSDK's health reports only the home position.
        await until(telemetry.subscribe_health_all_ok(), bool)
    await command_until_accepted(lambda: action.set_takeoff_altitude(ALTITUDE_M))
    await command_until_accepted(action.arm)
    await until(telemetry.subscribe_armed(), bool)
    steps.done("arm")
    await command_until_accepted(action.takeoff)
    there = await until(telemetry.subscribe_position(), lambda position: position.relative_altitude_m > ALTITUDE_M - 1)
    steps.done("take off", f"{there.relative_altitude_m:.1f} m")
    await command_until_accepted(raw.start_mission)
    await until(telemetry.subscribe_position(), near_the_end(kind))
    steps.done("fly")
    await action.land()
    await until(telemetry.subscribe_armed(), lambda armed: not armed)
    steps.done("land")


def near_the_end(kind: str) -> Callable[[Any], bool]:
    """Return True if a position is within about 3 m of the last waypoint."""
    last = mission(kind)[-1]
    return lambda here: (
        abs(here.latitude_deg - last.latitude) < 3e-5 and abs(here.longitude_deg - last.longitude) < 3e-5
    )


if __name__ == "__main__":
    asyncio.run(fly(sys.argv[1], int(sys.argv[2])))
