"""Calls of sticks, external measurements and precision landing, for the tables of calls and of documented errors."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import anyio
from call_stage import Place, Stage, airborne
from provoked import Do, Provocation, Table, later, pilot, refused, stops_sending

from aerokit import ActuatorSetpoint, StickInput, TrajectorySetpoint
from aerokit.autopilots.base import Autopilot
from aerokit.mavlink.enums import MavCmd

__all__ = ["STREAMS_AWAITED", "STREAMS_BLOCKING", "stream_provocations"]

BlockingDo = Callable[[Any], object]
TRAJECTORY = TrajectorySetpoint(0, 0, -5)
ACTUATORS = ActuatorSetpoint((0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 0.0))


def _nothing(_: Stage) -> None:
    pass


def _old_version(stage: Stage) -> None:
    """PX4 1.13 obeys actuator controls; on ArduPilot only the class is changed, and the vehicle ignores them."""
    autopilot: Any = stage.vehicle.autopilot
    autopilot.actuators_until = (99, 0)
    if stage.is_px4:
        stage.simulated.version = "1.13.3"


async def _actuators(stage: Stage) -> None:
    async with stage.vehicle.guided.actuators(ACTUATORS) as stream:
        await stream.fly(ACTUATORS, 0.3)


async def _sticks(stage: Stage) -> None:
    async with stage.vehicle.sticks() as sticks:
        await sticks.move(StickInput(forward=0.3), 0.7)


STREAMS_AWAITED: dict[str, tuple[Do, Place, Callable[[Stage], None]]] = {
    "Guided.actuators": (_actuators, airborne, _old_version),
    "Vehicle.sticks": (_sticks, airborne, _nothing),
    "StickStream.move": (_sticks, airborne, _nothing),
}


def _blocking_actuators(stage: Any) -> None:
    stage.vehicle.aio.autopilot.actuators_until = (99, 0)
    with stage.vehicle.guided.actuators(ACTUATORS) as stream:
        stream.fly(ACTUATORS, 0.1)


def _blocking_sticks(stage: Any) -> None:
    with stage.vehicle.sticks() as sticks:
        sticks.set(StickInput())
        sticks.move(StickInput(forward=0.1), 0.1)


STREAMS_BLOCKING: dict[str, BlockingDo] = {
    "Guided.actuators": _blocking_actuators,
    "Vehicle.sticks": _blocking_sticks,
    "StickStream.set": _blocking_sticks,
    "StickStream.move": _blocking_sticks,
}


def _now(function: Callable[[Stage], object]) -> Do:
    async def do(stage: Stage) -> object:
        return function(stage)

    return do


async def _enter(stage: Stage, sticks: StickInput | None = None) -> None:
    async with stage.vehicle.sticks(sticks):
        pass


async def _enter_twice(stage: Stage) -> None:
    async with stage.vehicle.sticks(), stage.vehicle.sticks():
        pass


async def _let_expire(stage: Stage, then: Callable[[Any], object]) -> None:
    async with stage.vehicle.sticks() as sticks:
        await anyio.sleep(1.0)
        then(sticks)


async def _set_wrong(stage: Stage) -> None:
    async with stage.vehicle.sticks() as sticks:
        sticks.set(StickInput(forward=2.0))


async def _move(stage: Stage, sticks: StickInput) -> None:
    async with stage.vehicle.sticks() as stream:
        await stream.move(sticks, 5.0)


def _no_sticks(stage: Stage) -> None:
    autopilot: Any = stage.vehicle.autopilot
    autopilot.sticks = Autopilot.sticks


def _no_setpoints(stage: Stage) -> None:
    autopilot: Any = stage.vehicle.autopilot
    autopilot.setpoints = Autopilot.setpoints


def _other_station(stage: Stage) -> None:
    stage.simulated.parameters["MAV_GCS_SYSID"] = 254.0


def stream_provocations() -> Table:
    """Return the provoked errors of the streams."""
    stopped, mode = "SetpointStreamStopped", MavCmd.DO_SET_MODE
    wrong = StickInput(forward=2.0)
    return {
        ("Guided.actuators", "NotSupported"): Provocation(_now(lambda s: s.vehicle.guided.actuators(ACTUATORS))),
        ("Guided.attitude_rate", "NotSupported"): Provocation(
            _now(lambda s: s.vehicle.guided.attitude_rate()), before=_no_setpoints, alone=True
        ),
        ("Guided.trajectory", "NotSupported"): Provocation(
            _now(lambda s: s.vehicle.guided.trajectory(TRAJECTORY)), before=_no_setpoints, alone=True
        ),
        ("Vehicle.sticks", "InvalidArgument"): Provocation(_now(lambda s: s.vehicle.sticks(mode="NONE"))),
        ("StickStream", "BusyError"): Provocation(_enter_twice, airborne),
        ("StickStream", "CommandRejected"): Provocation(_enter, airborne, refused(mode)),
        ("StickStream", "InvalidArgument"): Provocation(lambda s: _enter(s, wrong), airborne),
        ("StickStream", "NotSupported"): Provocation(_enter, airborne, _no_sticks, alone=True),
        ("StickStream", "OperationRejected"): Provocation(_enter, airborne, _other_station, alone=True),
        ("StickStream", "ParameterTimeout"): Provocation(_enter, airborne, stops_sending),
        ("StickStream", stopped): Provocation(lambda s: _let_expire(s, lambda _: None), airborne),
        ("StickStream.set", stopped): Provocation(
            lambda s: _let_expire(s, lambda sticks: sticks.set(StickInput())), airborne
        ),
        ("StickStream.set", "InvalidArgument"): Provocation(_set_wrong, airborne),
        ("StickStream.move", "InvalidArgument"): Provocation(lambda s: _move(s, wrong), airborne),
        ("StickStream.move", stopped): later(lambda s: _move(s, StickInput()), pilot, 3.0),
    }
