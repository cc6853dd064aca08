"""The blocking twin's calls: those of `call_table` that are one call, as they are; the others written for it."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from types import FunctionType
from typing import Any

from calibration_calls import CALIBRATIONS_BLOCKING
from call_stage import Stage
from call_table import CALLS, KEY
from camera_calls import BLOCKING
from component_calls import COMPONENTS_BLOCKING
from device_calls import BLOCKING_DEVICES
from rtk_calls import RTK_BLOCKING
from stream_calls import STREAMS_BLOCKING

import aerokit.sync
from aerokit import (
    AccelerationSetpoint,
    AttitudeRateSetpoint,
    AttitudeSetpoint,
    BodyVelocitySetpoint,
    LocalPositionSetpoint,
    PositionSetpoint,
    Signing,
    TrajectorySetpoint,
    VelocitySetpoint,
    messages,
)
from aerokit.mavlink.enums import MavCmd
from aerokit.sync import twins

__all__ = ["blocking_calls", "blocking_names"]

Do = Callable[[Any], object]

CLASSES: tuple[type, ...] = (
    twins.Vehicle,
    twins.Guided,
    twins.StickStream,
    twins.External,
    twins.MeasurementStream,
    twins.Gimbal,
    twins.Component,
    twins.Settings,
    twins.Gimbals,
    twins.FollowStream,
    twins.GimbalControl,
    twins.GimbalRates,
    twins.CalibrationControl,
    twins.Calibration,
    twins.Rtk,
    twins.NtripClient,
    twins.Camera,
    twins.PostedOrder,
    twins.SetpointStream,
    twins.Parameters,
    twins.Transaction,
    twins.MissionControl,
    twins.FenceControl,
    twins.RallyControl,
    twins.Files,
    twins.Logs,
    twins.Actuators,
    twins.Gripper,
    twins.Winch,
    twins.Shell,
    twins.StateCell,
    twins.Subscription,
    twins.Connection,
)
CLOSING = frozenset({"Vehicle.close", "Connection.close"})
"""At the end of every test."""


def blocking_names() -> Iterator[str]:
    """Public functions of the twin that have to do with its loop."""
    yield from ("connect", "open_connection")
    for cls in CLASSES:
        for name in dir(cls):
            function = inspect.getattr_static(cls, name)
            if not name.startswith("_") and isinstance(function, FunctionType):
                code = inspect.unwrap(function).__code__
                if {"_loop", "_block", "_twin_block"} & set(code.co_names) and f"{cls.__name__}.{name}" not in CLOSING:
                    yield f"{cls.__name__}.{name}"


def _connect(stage: Any) -> None:
    with aerokit.sync.connect(stage.address):
        pass


def _open_connection(stage: Any) -> None:
    with aerokit.sync.open_connection(stage.address):
        pass


def _stream(kind: str, setpoint: Callable[[Stage], Any]) -> Do:
    def do(stage: Any) -> None:
        with getattr(stage.vehicle.guided, kind)(setpoint(stage)) as stream:
            stream.fly(setpoint(stage), 0.1)

    return do


def _set(stage: Any) -> None:
    with stage.vehicle.guided.velocity() as stream:
        stream.set(VelocitySetpoint(north_m_s=1.0))


def _temporarily(stage: Any) -> None:
    with stage.vehicle.parameters.temporarily({stage.parameter: stage.other_value()}):
        stage.vehicle.parameters.get(stage.parameter)


def _transaction(stage: Any) -> None:
    with stage.vehicle.parameters.transaction() as transaction:
        transaction.set(stage.parameter, stage.other_value())


def _transaction_of_many(stage: Any) -> None:
    with stage.vehicle.parameters.transaction() as transaction:
        transaction.set_many({stage.parameter: stage.other_value()})


def _subscribe(stage: Any) -> None:
    with stage.vehicle.subscribe(messages.Attitude) as attitudes:
        next(attitudes)


def _get(stage: Any) -> None:
    with stage.vehicle.subscribe(messages.Attitude) as attitudes:
        attitudes.get(timeout=5)
        attitudes.get_nowait()


def _subscribe_to_connection(stage: Any) -> None:
    with stage.vehicle.connection.subscribe(messages.Heartbeat) as heartbeats:
        next(heartbeats)
        heartbeats.close()


def _follow(kind: str) -> Do:
    def do(stage: Any) -> None:
        values = getattr(stage.vehicle.position, kind)()
        next(values)
        next(values)

    return do


def _clear(name: str) -> Do:
    def do(stage: Any) -> None:
        getattr(stage.vehicle, name).upload(getattr(stage, name)())
        getattr(stage.vehicle, name).clear()

    return do


def _resume(stage: Any) -> None:
    stage.vehicle.mission.pause()
    stage.vehicle.mission.resume()


def _directory(stage: Any) -> None:
    path = stage.new_name()
    stage.vehicle.files.make_directory(path)
    stage.vehicle.files.remove_directory(path)


def _post(stage: Any) -> None:
    with stage.vehicle.posted("arm", armed=True) as order:
        order.command(MavCmd.COMPONENT_ARM_DISARM, 1)
        order.wait_confirmed(2)


def _post_mode(stage: Any) -> None:
    mode = stage.vehicle.autopilot.find_mode("LOITER")
    with stage.vehicle.posted("mode", modes=(mode,)) as order:
        order.set_mode(mode, timeout=2)


def _post_place(stage: Any) -> None:
    place = stage.target()
    x, y = round(place.latitude_deg * 1e7), round(place.longitude_deg * 1e7)
    with stage.vehicle.posted("motion") as order:
        order.command_int(MavCmd.DO_REPOSITION, -1, 1, frame=6, x=x, y=y, z=10)


def _in_control(do: Callable[[Any], object]) -> Do:
    def control(stage: Any) -> None:
        with stage.vehicle.gimbal.control() as block:
            do(block)

    return control


def _until_lost(stage: Any) -> None:
    """Wait until the other thread ends the wait."""
    with stage.vehicle.gimbal.control() as block:
        claim = messages.CommandLong(1, 1, MavCmd.DO_GIMBAL_MANAGER_CONFIGURE, 0, 254, 190, -1, -1, 0, 0, 0)
        stage.vehicle.send(claim)
        block.until_lost()


def _turn(stage: Any) -> None:
    with stage.vehicle.gimbal.rates() as stream:
        stream.set(-1.0, 0.0)
        stream.turn(-5.0, 5.0, 0.1)


def _rate(stage: Any) -> None:
    with stage.vehicle.rate(messages.RawImu, 5.0):
        pass


def _streams(stage: Any) -> None:
    with stage.vehicle.streams(5.0):
        pass


def _follow_target(stage: Any) -> None:
    place = stage.vehicle.position.value
    with stage.vehicle.follow(lambda: place, bearing_deg=180) as following:
        following.fly(0.5)


WRITTEN: dict[str, Do] = {
    "Vehicle.transition_to": lambda s: s.vehicle.transition_to("fixed_wing"),
    "Vehicle.follow": _follow_target,
    "FollowStream.fly": _follow_target,
    "Gimbal.control": _in_control(lambda _: None),
    "GimbalControl.raise_if_taken": _in_control(lambda block: block.raise_if_taken()),
    "GimbalControl.until_lost": _until_lost,
    "Gimbal.rates": _turn,
    "GimbalRates.set": _turn,
    "GimbalRates.turn": _turn,
    "Gimbals.get": lambda s: s.vehicle.gimbals.get(1),
    "connect": _connect,
    "open_connection": _open_connection,
    "Vehicle.wait_ready": lambda s: s.vehicle.wait_ready(timeout=0.5),
    "Vehicle.setup_signing": lambda s: s.vehicle.setup_signing(Signing(KEY)),
    "Vehicle.subscribe": _subscribe,
    "Vehicle.rate": _rate,
    "Vehicle.streams": _streams,
    "Vehicle.message": lambda s: s.vehicle.message(messages.ScaledPressure),
    "Vehicle.describe_link": lambda s: s.vehicle.describe_link(),
    "Vehicle.texts_since": lambda s: s.vehicle.texts_since(0.0),
    "Vehicle.missing_for_flight": lambda s: s.vehicle.missing_for_flight(),
    "Vehicle.send": lambda s: s.vehicle.send(messages.Ping(0, 0, 0, 0)),
    "Vehicle.note_sent": lambda s: s.vehicle.note_sent(messages.Ping(0, 0, 0, 0)),
    "Vehicle.posted": _post,
    "PostedOrder.command": _post,
    "PostedOrder.command_int": _post_place,
    "PostedOrder.set_mode": _post_mode,
    "PostedOrder.wait_confirmed": _post,
    "Guided.velocity": _stream("velocity", lambda _: VelocitySetpoint(north_m_s=1.0)),
    "Guided.body_velocity": _stream("body_velocity", lambda _: BodyVelocitySetpoint(forward_m_s=1.0)),
    "Guided.acceleration": _stream("acceleration", lambda _: AccelerationSetpoint(north_m_s2=0.2)),
    "Guided.local_position": _stream("local_position", lambda _: LocalPositionSetpoint(3, 3, -6)),
    "Guided.position": _stream("position", lambda s: PositionSetpoint(s.target())),
    "Guided.attitude": _stream("attitude", lambda _: AttitudeSetpoint(0, 2, 0, thrust=0.5)),
    "SetpointStream.fly": _stream("velocity", lambda _: VelocitySetpoint(north_m_s=1.0)),
    "Guided.attitude_rate": _stream("attitude_rate", lambda _: AttitudeRateSetpoint(pitch_deg_s=1.0)),
    "Guided.trajectory": _stream("trajectory", lambda _: TrajectorySetpoint(3, 3, -6)),
    "SetpointStream.set": _set,
    "Parameters.temporarily": _temporarily,
    "Parameters.transaction": _transaction,
    "Transaction.set": _transaction,
    "Transaction.set_many": _transaction_of_many,
    "MissionControl.clear": _clear("mission"),
    "MissionControl.resume": _resume,
    "MissionControl.wait_finished": lambda s: s.vehicle.mission.wait_finished(timeout=1),
    "FenceControl.clear": _clear("fence"),
    "RallyControl.clear": _clear("rally"),
    "Files.remove_directory": _directory,
    "StateCell.changes": _follow("changes"),
    "StateCell.updates": _follow("updates"),
    "StateCell.wait_until": lambda s: s.vehicle.position.wait_until(lambda _: True, held_for=0.1),
    "Subscription.get": _get,
    "Subscription.get_nowait": _get,
    "Subscription.close": _subscribe_to_connection,
    "Connection.subscribe": _subscribe_to_connection,
    "Connection.send": lambda s: s.vehicle.connection.send(messages.Ping(0, 0, 0, 0)),
    "Connection.counts": lambda s: s.vehicle.connection.counts(1),
    "Connection.discard_unsent": lambda s: s.vehicle.connection.discard_unsent(),
}


def blocking_calls() -> dict[str, Do]:
    """Return the calls by name; coroutine functions of the other table have no twin."""
    shared = {name: call.do for name, call in CALLS.items() if not inspect.iscoroutinefunction(call.do)}
    given = (
        *(WRITTEN, BLOCKING, COMPONENTS_BLOCKING, BLOCKING_DEVICES, CALIBRATIONS_BLOCKING, RTK_BLOCKING),
        STREAMS_BLOCKING,
    )
    return shared | {name: do for calls in given for name, do in calls.items()}
