"""Calls of sticks, external measurements and precision landing, for the tables of calls and of documented errors."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import anyio
from call_stage import Place, Stage, airborne, anywhere, grounded
from provoked import Do, Provocation, Table, ignored, later, no_modes, pilot, refused, stops_sending

from aerokit import ActuatorSetpoint, Position, StickInput, TrajectorySetpoint
from aerokit.autopilots.base import Autopilot
from aerokit.mavlink.enums import MavCmd
from aerokit.mavlink.messages import SetGpsGlobalOrigin
from aerokit.vehicle.external.values import (
    FlowMeasurement,
    GpsMeasurement,
    ObstaclePoints,
    ObstacleSectors,
    OdometryMeasurement,
    PoseMeasurement,
    RangeMeasurement,
    SpeedMeasurement,
    TargetMeasurement,
)
from aerokit.vehicle.state.movement import Attitude

__all__ = ["ARDUPILOT_STREAMS", "STREAMS_AWAITED", "STREAMS_BLOCKING", "stream_provocations"]

BlockingDo = Callable[[Any], object]
ORIGIN = Position(47.0, 8.0, 500.0)
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


MEASUREMENTS: dict[str, Any] = {
    "odometry": OdometryMeasurement((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)),
    "vision_position": PoseMeasurement(0.0, 0.0, 0.0, Attitude(0.0, 0.0, 0.0)),
    "vision_speed": SpeedMeasurement(0.0, 0.0, 0.0),
    "motion_capture": PoseMeasurement(0.0, 0.0, 0.0, Attitude(0.0, 0.0, 0.0)),
    "gps": GpsMeasurement(47.0, 8.0, 500.0),
    "obstacles": ObstacleSectors((1.0,), 0.1, 10.0),
    "obstacle_points": ObstaclePoints(((1.0, 0.0, 0.0),), 0.1, 10.0),
    "range_finder": RangeMeasurement(1.0, 0.1, 10.0),
    "landing_target": TargetMeasurement(1.0, 0.0, 5.0),
    "optical_flow": FlowMeasurement(0.0, 0.0, 0.1),
}
ARDUPILOT_STREAMS = ("External.gps", "External.obstacle_points")
PARAMETERS: dict[bool, dict[str, float]] = {
    False: {
        "VISO_TYPE": 1.0,
        "GPS1_TYPE": 14.0,
        "PRX1_TYPE": 2.0,
        "RNGFND1_TYPE": 10.0,
        "FLOW_TYPE": 5.0,
        "PLND_ENABLED": 1.0,
        "PLND_TYPE": 1.0,
    },
    True: {"EKF2_EV_CTRL": 15.0, "EKF2_OF_CTRL": 1.0},
}
"""Parameters that the measurements need, by whether the vehicle is a PX4."""


def _read_measurements(stage: Stage) -> None:
    stage.simulated.parameters.change(PARAMETERS[stage.is_px4])


def _supply(kind: str) -> Do:
    async def do(stage: Stage) -> None:
        async with getattr(stage.vehicle.external, kind)() as stream:
            for _ in range(3):
                stream.send(MEASUREMENTS[kind])
                await anyio.sleep(0.1)

    return do


async def _set_origin(stage: Stage) -> None:
    """Set the present origin on ArduPilot, which keeps it, and a new one on PX4."""
    present = stage.vehicle.origin.value
    await stage.vehicle.external.set_origin(present.offset(north_m=100.0) if stage.is_px4 else present)


def see_ground(stage: Stage) -> TargetMeasurement:
    """Return a target straight below."""
    return TargetMeasurement(0.1, 0.0, 5.0, is_level=True)


async def _land_on(stage: Stage) -> None:
    await stage.vehicle.land_on(lambda: see_ground(stage))


STREAMS_AWAITED: dict[str, tuple[Do, Place, Callable[[Stage], None]]] = {
    "Guided.actuators": (_actuators, airborne, _old_version),
    "Vehicle.sticks": (_sticks, airborne, _nothing),
    "StickStream.move": (_sticks, airborne, _nothing),
    **{f"External.{kind}": (_supply(kind), anywhere, _read_measurements) for kind in MEASUREMENTS},
    "External.set_wind": (lambda s: s.vehicle.external.set_wind(5.0, 270.0), anywhere, _nothing),
    "External.set_origin": (_set_origin, grounded, _nothing),
    "Vehicle.land_on": (_land_on, airborne, _read_measurements),
}


def _blocking_actuators(stage: Any) -> None:
    stage.vehicle.aio.autopilot.actuators_until = (99, 0)
    with stage.vehicle.guided.actuators(ACTUATORS) as stream:
        stream.fly(ACTUATORS, 0.1)


def _blocking_sticks(stage: Any) -> None:
    with stage.vehicle.sticks() as sticks:
        sticks.set(StickInput())
        sticks.move(StickInput(forward=0.1), 0.1)


def _blocking_supply(kind: str) -> BlockingDo:
    def do(stage: Any) -> None:
        with getattr(stage.vehicle.external, kind)() as stream:
            stream.send(MEASUREMENTS[kind])

    return do


STREAMS_BLOCKING: dict[str, BlockingDo] = {
    "Guided.actuators": _blocking_actuators,
    "Vehicle.sticks": _blocking_sticks,
    "StickStream.set": _blocking_sticks,
    "StickStream.move": _blocking_sticks,
    **{f"External.{kind}": _blocking_supply(kind) for kind in MEASUREMENTS},
    "Vehicle.land_on": lambda s: s.vehicle.land_on(
        lambda: TargetMeasurement(0.1, 0.0, 5.0), acquire_timeout=0.2, timeout=0.5
    ),
    "External.set_wind": lambda s: s.vehicle.external.set_wind(5.0, 270.0),
    "External.set_origin": lambda s: s.vehicle.external.set_origin(s.vehicle.origin.value),
    "MeasurementStream.send": _blocking_supply("odometry"),
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


async def _supply_wrong(stage: Stage) -> None:
    async with stage.vehicle.external.odometry() as stream:
        stream.send(MEASUREMENTS["odometry"].replace(quality=101))


async def _supply_after_end(stage: Stage) -> None:
    async with stage.vehicle.external.odometry() as stream:
        stage.vehicle.connection.close()
        stream.send(MEASUREMENTS["odometry"])


async def _supply_target_blindly(stage: Stage) -> None:
    async with stage.vehicle.external.landing_target() as stream:
        stage.simulated.faults.silent = True
        await anyio.sleep(0.5)
        assert stage.vehicle.telemetry.local_position.is_known  # decodes what was received
        stage.vehicle.telemetry.local_position.forget()
        stream.send(MEASUREMENTS["landing_target"])


async def _supply_outside(stage: Stage) -> None:
    stage.vehicle.external.odometry().send(MEASUREMENTS["odometry"])


def _accepts_nothing(stage: Stage) -> None:
    autopilot: Any = stage.vehicle.autopilot
    autopilot.external = Autopilot.external


def _ignores_origin(stage: Stage) -> None:
    stage.simulated.handlers.pop(SetGpsGlobalOrigin.ID)


def _measurements() -> Table:
    wind = MavCmd.EXTERNAL_WIND_ESTIMATE
    supply, send = _supply("odometry"), "MeasurementStream.send"

    async def set_wind(stage: Stage, speed: float = 5.0) -> None:
        await stage.vehicle.external.set_wind(speed, 270.0)

    async def set_origin(stage: Stage, place: Position = ORIGIN) -> None:
        await stage.vehicle.external.set_origin(place, timeout=2.0)

    return {
        ("External.set_wind", "InvalidArgument"): Provocation(lambda s: set_wind(s, -1.0)),
        ("External.set_wind", "CommandRejected"): Provocation(set_wind, before=refused(wind)),
        ("External.set_wind", "CommandTimeout"): Provocation(set_wind, before=ignored(wind)),
        ("External.set_origin", "InvalidArgument"): Provocation(lambda s: set_origin(s, Position(0.0, 0.0))),
        ("External.set_origin", "OperationRejected"): Provocation(set_origin, grounded),
        ("External.set_origin", "OperationTimeout"): Provocation(
            set_origin, grounded, _ignores_origin, on="px4", alone=True
        ),
        ("MeasurementStream", "NotSupported"): Provocation(supply, before=_accepts_nothing, alone=True),
        ("MeasurementStream", "OperationRejected"): Provocation(supply),
        ("MeasurementStream", "ParameterTimeout"): Provocation(supply, before=stops_sending),
        (send, "InvalidArgument"): Provocation(_supply_wrong, before=_read_measurements, alone=True),
        (send, "ConnectionClosed"): Provocation(_supply_after_end, before=_read_measurements, alone=True),
        (send, "SetpointStreamStopped"): Provocation(_supply_outside),
        (send, "ValueUnknownError"): Provocation(_supply_target_blindly, grounded, _read_measurements, on="px4"),
    }


def _landings() -> Table:
    def land(stage: Stage, **options: Any) -> Any:
        return stage.vehicle.land_on(lambda: see_ground(stage), **options)

    def unseen(stage: Stage) -> Any:
        return stage.vehicle.land_on(lambda: None, acquire_timeout=1.0)

    def ready(trouble: Callable[[Stage], object]) -> Callable[[Stage], None]:
        def prepare(stage: Stage) -> None:
            _read_measurements(stage)
            trouble(stage)

        return prepare

    name, mode = "Vehicle.land_on", MavCmd.DO_SET_MODE
    return {
        (name, "InvalidArgument"): Provocation(lambda s: land(s, rate_hz=0.0), airborne),
        (name, "NotSupported"): Provocation(land, airborne, no_modes, alone=True),
        (name, "CommandRejected"): Provocation(land, airborne, ready(refused(mode)), alone=True),
        (name, "CommandTimeout"): later(land, stops_sending, 0.2, before=ready(ignored(mode)), alone=True),
        (name, "OperationRejected"): Provocation(land, airborne),
        (name, "HeartbeatTimeout"): later(land, stops_sending, 3.0, before=_read_measurements, alone=True),
        (name, "OperationTimeout"): Provocation(unseen, airborne, _read_measurements, alone=True),
        (name, "ParameterTimeout"): Provocation(land, airborne, stops_sending),
    }


def stream_provocations() -> Table:
    """Return the provoked errors of the streams."""
    return _sticks_and_setpoints() | _measurements() | _landings()


def _sticks_and_setpoints() -> Table:
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
