"""Provocations of what actions, set-points, cells and connections promise to raise."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from typing import Any

import anyio
from call_stage import Stage, airborne, armed, grounded
from call_table import KEY
from provoked import (
    Do,
    Provocation,
    Table,
    accepted,
    ignored,
    later,
    lost,
    no_modes,
    pilot,
    refused,
    stops_sending,
)

import aerokit
from aerokit import BodyVelocitySetpoint, Position, PositionSetpoint, Signing, VelocitySetpoint, errors, messages
from aerokit.mavlink.enums import MavCmd
from aerokit.sim import SimulatedCopter, simulated_link
from aerokit.vehicle.commanding.setpoints import AttitudeSetpoint, LocalPositionSetpoint

__all__ = ["FLIGHT"]

P, Cmd = Provocation, MavCmd


def _method(name: str, *args: Any, **options: Any) -> Do:
    return lambda stage: getattr(stage.vehicle, name)(*args, **options)


def _stream_never(stage: Stage) -> None:
    with stage.vehicle.streams(0.0):
        pass


def _now(function: Callable[[Stage], object]) -> Do:
    """Wrap a call that does not wait."""

    async def do(stage: Stage) -> object:
        return function(stage)

    return do


def _go(stage: Stage, **options: Any) -> Any:
    return stage.vehicle.go_to(stage.target(), **options)


def _look_north(stage: Stage) -> Any:
    return stage.vehicle.look_at(stage.target().replace(altitude_amsl_m=None, altitude_relative_m=5.0))


async def _post(stage: Stage, subjects: list[Any], command: int = 400, **options: Any) -> None:
    with stage.vehicle.posted(*subjects, **options) as order:
        await order.command(command, 1)
        await order.wait_confirmed(2)


async def _post_int(stage: Stage, frame: int = 0) -> None:
    with stage.vehicle.posted("motion") as order:
        await order.command_int(Cmd.DO_SET_HOME, 0, frame=frame, x=1, y=1, z=1)


async def _post_overruled(stage: Stage, *, as_int: bool = False) -> None:
    with stage.vehicle.posted("motion") as order:
        stage.vehicle.send(messages.SetPositionTargetLocalNed(0, 1, 1, 1, 0x0DC7, *(0,) * 11))
        await (order.command_int(Cmd.DO_SET_HOME, frame=0) if as_int else order.command(Cmd.DO_SET_ROI_NONE))


async def _post_mode(stage: Stage, posted: str = "LOITER") -> None:
    mode = stage.vehicle.autopilot.find_mode("LOITER")
    with stage.vehicle.posted("mode", modes=(stage.vehicle.autopilot.find_mode(posted),)) as order:
        await order.set_mode(mode, timeout=2)


def _post_newer(stage: Stage) -> None:
    with stage.vehicle.posted("mode"), stage.vehicle.posted("arm", armed=False):
        pass


def _deny_arming(stage: Stage) -> None:
    own = stage.vehicle.connection.source_component
    stage.simulated.send(messages.CommandAck(400, 2, 0, 0, 255, own))


def _does_not_move(stage: Stage) -> None:
    stage.simulated.faults.motor_failed = True


def _obeys_nothing(stage: Stage) -> None:
    from aerokit.autopilots.base import Autopilot

    autopilot: Any = stage.vehicle.autopilot
    autopilot.setpoints = Autopilot.setpoints


def _old(stage: Stage) -> None:
    """MAVLink 1 on our side."""
    connection: Any = stage.vehicle.connection
    connection._encoder.version = 1


def _clear_state(name: str) -> Callable[[Stage], None]:
    def clear(stage: Stage) -> None:
        cell = getattr(stage.vehicle.telemetry, name)
        _ = cell.latest  # Decodes received messages, which a later read would decode after `forget`.
        cell.forget()

    return clear


def _order_to_arm(stage: Stage) -> None:
    stage.vehicle.send(messages.CommandLong(1, 1, Cmd.COMPONENT_ARM_DISARM, 0, 1, *[0.0] * 6))


def _order_to_land(stage: Stage) -> None:
    stage.vehicle.send(messages.CommandLong(1, 1, Cmd.NAV_LAND, 0, *[0.0] * 7))


def _actions() -> Table:
    reboot, arm, mode = Cmd.PREFLIGHT_REBOOT_SHUTDOWN, Cmd.COMPONENT_ARM_DISARM, Cmd.DO_SET_MODE
    command = _method("command", Cmd.DO_SET_HOME, 1)
    command_int = _method("command_int", Cmd.DO_SET_HOME, 1, frame=0)
    rows: Table = {
        ("Vehicle.command", "InvalidArgument"): P(_method("command", -1)),
        ("Vehicle.command", "CommandRejected"): P(command, before=refused(Cmd.DO_SET_HOME)),
        ("Vehicle.command", "CommandTimeout"): P(command, before=ignored(Cmd.DO_SET_HOME)),
        ("Vehicle.command_int", "InvalidArgument"): P(_method("command_int", 1, frame=999)),
        ("Vehicle.command_int", "CommandRejected"): P(command_int, before=refused(Cmd.DO_SET_HOME)),
        ("Vehicle.command_int", "CommandTimeout"): P(command_int, before=ignored(Cmd.DO_SET_HOME)),
        ("Vehicle.arm", "OperationRejected"): later(_method("arm"), pilot, 0.1, grounded, before=ignored(arm)),
        ("Vehicle.arm", "OperationTimeout"): P(_method("arm", timeout=1.5), grounded, accepted(arm)),
        ("Vehicle.arm", "HeartbeatTimeout"): later(
            _method("arm", timeout=30), stops_sending, 1.0, grounded, before=accepted(arm)
        ),
        ("Vehicle.disarm", "HeartbeatTimeout"): later(
            _method("disarm", timeout=30), stops_sending, 1.0, armed, before=accepted(arm)
        ),
        ("Vehicle.disarm", "OperationRejected"): later(
            _method("disarm"), _order_to_arm, 0.3, armed, before=accepted(arm)
        ),
        ("Vehicle.disarm", "CommandRejected"): P(_method("disarm"), airborne),
        ("Vehicle.disarm", "OperationTimeout"): P(_method("disarm", timeout=1.5), armed, accepted(arm)),
        ("Vehicle.reboot", "OperationRejected"): P(_method("reboot"), armed),
        ("Vehicle.reboot", "OperationTimeout"): P(_method("reboot", timeout=2), grounded, accepted(reboot)),
        ("Vehicle.reboot", "LinkLost"): later(_method("reboot"), lost, 0.05, grounded, alone=True),
        ("Vehicle.wait_ready", "OperationTimeout"): P(_method("wait_ready", timeout=0.05), before=_clear_state("home")),
        ("Vehicle.send", "InvalidArgument"): P(_now(lambda s: s.vehicle.send(messages.Ping(0, 0, 999, 0)))),
        ("Vehicle.send", "ConnectionClosed"): _ended(lambda s: s.vehicle.send(messages.Ping(0, 0, 0, 0))),
        ("Vehicle.send", "LinkLost"): _ended(lambda s: s.vehicle.send(messages.Ping(0, 0, 0, 0)), lost),
        ("Vehicle.subscribe", "InvalidArgument"): P(_now(lambda s: s.vehicle.subscribe())),
        ("Vehicle.streams", "InvalidArgument"): P(_now(_stream_never)),
        ("Vehicle.message", "InvalidArgument"): P(_now(lambda s: s.vehicle.message(messages.Attitude, rate_hz=5000))),
        ("Vehicle.setup_signing", "NotSupported"): P(_sign, grounded, _old, alone=True),
        ("Vehicle.setup_signing", "OperationRejected"): P(_sign, armed),
        ("Vehicle.setup_signing", "OperationTimeout"): P(_sign, grounded, stops_sending),
        ("Vehicle.setup_signing", "BusyError"): P(_sign_twice, grounded, stops_sending, alone=True),
        ("Vehicle.set_mode", "InvalidArgument"): P(_method("set_mode", "NONE")),
        ("Vehicle.set_heading", "InvalidArgument"): P(_method("set_heading", 999), airborne),
        ("Vehicle.set_home", "OperationRejected"): later(
            _method("set_home"), pilot, 0.3, before=ignored(Cmd.DO_SET_HOME)
        ),
        ("Vehicle.set_home", "OperationTimeout"): P(
            _method("set_home", timeout=1),
            before=lambda s: [accepted(command)(s) for command in (Cmd.DO_SET_HOME, Cmd.REQUEST_MESSAGE)],
        ),
        ("Vehicle.look_at", "ValueUnknownError"): P(_look_north, airborne, _clear_state("home"), on="px4"),
        ("Vehicle.look_at", "OperationRejected"): later(
            _look_north, pilot, 0.3, before=ignored(Cmd.DO_SET_ROI_LOCATION)
        ),
        ("Vehicle.stop_looking", "OperationRejected"): later(
            _method("stop_looking"), pilot, 0.3, before=ignored(Cmd.DO_SET_ROI_NONE)
        ),
        ("Vehicle.posted", "InvalidArgument"): P(lambda s: _post(s, [])),
        ("PostedOrder.command", "InvalidArgument"): P(lambda s: _post(s, ["arm"], -1, armed=True)),
        ("PostedOrder.command", "CommandRejected"): P(lambda s: _post(s, ["arm"], armed=True), grounded, refused(arm)),
        ("PostedOrder.command", "CommandTimeout"): P(lambda s: _post(s, ["arm"], armed=True), grounded, ignored(arm)),
        ("PostedOrder.command", "OperationRejected"): P(_post_overruled),
        ("PostedOrder.command_int", "OperationRejected"): P(lambda s: _post_overruled(s, as_int=True)),
        ("PostedOrder.command_int", "InvalidArgument"): P(lambda s: _post_int(s, 999)),
        ("PostedOrder.command_int", "CommandRejected"): P(_post_int, before=refused(Cmd.DO_SET_HOME)),
        ("PostedOrder.command_int", "CommandTimeout"): P(_post_int, grounded, ignored(Cmd.DO_SET_HOME)),
        ("PostedOrder.set_mode", "InvalidArgument"): P(lambda s: _post_mode(s, "GUIDED")),
        ("PostedOrder.set_mode", "CommandRejected"): P(_post_mode, before=refused(Cmd.DO_SET_MODE)),
        ("PostedOrder.set_mode", "CommandTimeout"): P(_post_mode, grounded, ignored(Cmd.DO_SET_MODE)),
        ("PostedOrder.set_mode", "OperationTimeout"): P(_post_mode, grounded, accepted(Cmd.DO_SET_MODE)),
        ("PostedOrder.wait_confirmed", "OperationTimeout"): P(
            lambda s: _post(s, ["arm"], armed=True), grounded, accepted(arm)
        ),
        ("PostedOrder.set_mode", "OperationRejected"): later(
            _post_mode, _post_newer, 0.5, grounded, before=accepted(Cmd.DO_SET_MODE)
        ),
        ("PostedOrder.wait_confirmed", "OperationRejected"): later(
            lambda s: _post(s, ["arm"], armed=True), _post_newer, 0.5, grounded, before=accepted(arm)
        ),
        ("PostedOrder.wait_confirmed", "CommandRejected"): later(
            lambda s: _post(s, ["arm"], armed=True), _deny_arming, 0.5, grounded, before=accepted(arm)
        ),
        ("Vehicle.set_heading", "ValueUnknownError"): P(
            _method("set_heading", 30, relative=True), airborne, _clear_state("heading_deg")
        ),
        ("Vehicle.set_heading", "HeartbeatTimeout"): later(
            _method("set_heading", 179, relative=True, rate_deg_s=1), stops_sending, 3.0
        ),
        ("Vehicle.go_to", "InvalidArgument"): P(_method("go_to", Position(0, 0, altitude_relative_m=9e9)), airborne),
        ("Vehicle.go_to", "ValueUnknownError"): P(_method("go_to", Position(0, 0)), airborne, _clear_state("position")),
        ("Vehicle.take_off", "InvalidArgument"): P(_method("take_off", -1)),
        ("Vehicle.take_off", "NotSupported"): P(_method("take_off", 5), armed, no_modes, alone=True),
        ("Vehicle.take_off", "OperationRejected"): P(_method("take_off", 5), grounded),
        ("Vehicle.take_off", "CommandRejected"): P(_method("take_off", 5), armed, refused(Cmd.NAV_TAKEOFF)),
        ("Vehicle.take_off", "CommandTimeout"): P(_method("take_off", 5), armed, ignored(Cmd.NAV_TAKEOFF)),
        ("Vehicle.take_off", "HeartbeatTimeout"): later(_method("take_off", 50), stops_sending, 1.0, armed),
        ("Vehicle.take_off", "OperationTimeout"): P(_method("take_off", 50, timeout=2), armed),
        ("Vehicle.take_off", "ValueUnknownError"): P(_method("take_off", 5), armed, _clear_state("home"), on="px4"),
    }
    rows |= _maneuvers()
    for name, do, repeated in (
        ("Vehicle.set_mode", _method("set_mode", "LOITER"), mode),
        ("Vehicle.hold", _method("hold"), mode),
        ("Vehicle.go_to", _go, Cmd.DO_REPOSITION),
        ("Vehicle.set_heading", _method("set_heading", 90, relative=True), Cmd.CONDITION_YAW),
        ("Vehicle.land", _method("land"), mode),
        ("Vehicle.return_to_launch", _method("return_to_launch"), mode),
    ):
        rows[name, "CommandRejected"] = P(do, airborne, refused(repeated))
        rows[name, "OperationRejected"] = later(do, pilot, 0.3, before=ignored(repeated))
        rows[name, "OperationTimeout"] = P(do, airborne, ignored(repeated))
    for name in ("land", "return_to_launch", "hold"):
        rows[f"Vehicle.{name}", "NotSupported"] = P(_method(name), airborne, no_modes, alone=True)
    rows["Vehicle.go_to", "CommandTimeout"] = P(_go, airborne, ignored(Cmd.DO_REPOSITION))
    rows["Vehicle.set_heading", "CommandTimeout"] = P(
        _method("set_heading", 180, relative=True), airborne, ignored(Cmd.CONDITION_YAW)
    )
    rows["Vehicle.set_heading", "OperationTimeout"] = P(
        _method("set_heading", 90, relative=True, timeout=0.2), airborne
    )
    for name in ("land", "return_to_launch"):
        rows[f"Vehicle.{name}", "HeartbeatTimeout"] = later(_method(name), stops_sending)
        rows[f"Vehicle.{name}", "OperationTimeout"] = P(_method(name, timeout=1), airborne)
    rows["Vehicle.go_to", "HeartbeatTimeout"] = later(_go, stops_sending)
    rows["Vehicle.go_to", "OperationTimeout"] = P(lambda s: _go(s, timeout=1), airborne)
    return rows


def _has_no_such_parameter(stage: Stage) -> None:
    autopilot: Any = stage.vehicle.autopilot
    autopilot.return_altitude_parameters = lambda **_: (("NOSUCH_ALT", 1.0),)


def _rover(stage: Stage) -> None:
    """A vehicle type that neither climbs nor has an airspeed."""
    autopilot: Any = stage.vehicle.autopilot
    autopilot.speed_types, autopilot.circles_by = frozenset(), None
    autopilot.return_altitude_parameters = lambda **_: ()


def _orbit(stage: Stage, **options: Any) -> Any:
    return stage.vehicle.orbit(stage.target(), radius_m=8, **options)


def _figure_eight(stage: Stage, **options: Any) -> Any:
    return stage.vehicle.figure_eight(stage.target(), major_radius_m=16, minor_radius_m=8, **options)


def _loiter(stage: Stage, **options: Any) -> Any:
    return stage.vehicle.loiter(stage.target(), **options)


def _following(stage: Stage, target: Position | None = None, **options: Any) -> Any:
    return stage.vehicle.follow(lambda: target, **options)


async def _follow(stage: Stage, *target: Position | None, **options: Any) -> None:
    place = target[0] if target else stage.home
    async with _following(stage, place, **options) as following:
        await following.fly(20)


async def _vtol_in_the_air(stage: Stage) -> None:
    await airborne(stage)
    stage.simulated.vtol_state = 3  # type: ignore[union-attr]
    await stage.vehicle.vtol_state.wait_until(lambda state: state == 3, timeout=5)


def _px4_pilot(stage: Stage) -> None:
    stage.simulated.switch_to((3, 0))  # type: ignore[union-attr]


def _maneuvers() -> Table:
    end, off = Cmd.DO_FLIGHTTERMINATION, Cmd.PREFLIGHT_REBOOT_SHUTDOWN
    terminate = _method("terminate", intent="terminate flight", timeout=2)
    patient = _method("terminate", intent="terminate flight", timeout=30)
    shut_down = _method("shutdown", intent="shut down", timeout=2)
    rows: Table = {
        ("Vehicle.terminate", "OperationRejected"): later(
            terminate, _order_to_land, 0.3, airborne, before=ignored(end)
        ),
        ("Vehicle.terminate", "HeartbeatTimeout"): later(patient, stops_sending, 0.3, before=accepted(end)),
        ("Vehicle.terminate", "OperationTimeout"): P(terminate, airborne, accepted(end)),
        ("Vehicle.shutdown", "NotSupported"): P(shut_down, grounded),
        ("Vehicle.shutdown", "OperationRejected"): P(shut_down, armed, on="px4"),
        ("Vehicle.shutdown", "OperationTimeout"): P(shut_down, grounded, accepted(off), on="px4"),
        ("Vehicle.set_airspeed", "NotSupported"): P(_method("set_airspeed", 15), before=_rover, alone=True),
        ("Vehicle.set_climb_speed", "NotSupported"): P(_method("set_climb_speed", 1), on="px4"),
        ("Vehicle.set_return_altitude", "InvalidArgument"): P(_method("set_return_altitude", 0)),
    }
    orbit, eight = Cmd.DO_ORBIT, Cmd.DO_SET_MODE
    for name, give, command, on in (
        ("Vehicle.orbit", _orbit, orbit, "px4"),
        ("Vehicle.figure_eight", _figure_eight, eight, "ardupilot"),
        ("Vehicle.loiter", _loiter, Cmd.DO_REPOSITION, "ardupilot"),
    ):
        rows[name, "CommandRejected"] = P(give, airborne, refused(command), on=on)
        rows[name, "CommandTimeout"] = P(give, airborne, ignored(command), on=on)
        rows[name, "OperationRejected"] = P(give, grounded)
        rows[name, "ValueUnknownError"] = P(give, airborne, _clear_state("position"), alone=True)
        rows[name, "HeartbeatTimeout"] = later(give, stops_sending, 3.0, alone=True)
        rows[name, "OperationTimeout"] = P(lambda s, give=give: give(s, timeout=1.5), airborne)  # type: ignore[misc]
    rows["Vehicle.figure_eight", "CommandTimeout"] = P(_figure_eight, airborne, ignored(eight))
    rows["Vehicle.orbit", "NotSupported"] = P(_orbit, airborne, _rover, alone=True)
    rows["Vehicle.figure_eight", "NotSupported"] = P(_figure_eight, airborne, _obeys_nothing, alone=True)
    rows["Vehicle.loiter", "NotSupported"] = P(lambda s: _loiter(s, radius_m=50))
    rows["Vehicle.follow", "InvalidArgument"] = P(_now(lambda s: _following(s, distance_m=-1)))
    rows["Vehicle.follow", "NotSupported"] = P(_now(_following), before=_obeys_nothing, alone=True)
    rows["FollowStream", "OperationRejected"] = P(_follow, grounded)
    rows["FollowStream", "OperationTimeout"] = P(lambda s: _follow(s, None), airborne)
    rows["FollowStream", "InvalidArgument"] = P(lambda s: _follow(s, s.home, height_m=5), airborne)
    rows["FollowStream", "SetpointStreamStopped"] = later(_follow, pilot, 2.0)
    rows["FollowStream.fly", "SetpointStreamStopped"] = later(_follow, pilot, 2.0)
    tune = _method("autotune")
    rows["Vehicle.autotune", "NotSupported"] = P(tune, airborne)
    rows["Vehicle.autotune", "OperationTimeout"] = P(_method("autotune", timeout=2), airborne, on="px4")
    rows["Vehicle.autotune", "OperationRejected"] = later(tune, _px4_pilot, 2.5, on="px4", alone=True)
    transition = Cmd.DO_VTOL_TRANSITION
    to_wings = _method("transition_to", "fixed_wing", timeout=30)
    rows["Vehicle.transition_to", "NotSupported"] = P(to_wings, airborne)
    for error, trouble in (("CommandRejected", refused(transition)), ("CommandTimeout", ignored(transition))):
        rows["Vehicle.transition_to", error] = P(to_wings, _vtol_in_the_air, trouble, on="px4", alone=True)
    in_transition: dict[str, Any] = {"place": _vtol_in_the_air, "on": "px4", "alone": True}
    in_transition["before"] = accepted(transition)
    rows["Vehicle.transition_to", "OperationTimeout"] = P(
        _method("transition_to", "fixed_wing", timeout=2), **in_transition
    )
    rows["Vehicle.transition_to", "HeartbeatTimeout"] = later(to_wings, stops_sending, 1.0, **in_transition)
    rows["Vehicle.transition_to", "OperationRejected"] = later(to_wings, _px4_pilot, 1.0, **in_transition)
    for name, args in (("return_altitude", ()), ("set_return_altitude", (20.0,))):
        call, do = f"Vehicle.{name}", _method(name, *args)
        rows[call, "NotSupported"] = P(do, before=_rover, alone=True)
        rows[call, "ParameterRejected"] = P(do, before=_has_no_such_parameter, on="px4", alone=True)
        rows[call, "ParameterTimeout"] = P(do, before=stops_sending, alone=True)
    return rows


def _sign(stage: Stage) -> Any:
    return stage.vehicle.setup_signing(Signing(KEY), timeout=1)


async def _sign_twice(stage: Stage) -> None:
    first = asyncio.ensure_future(_sign(stage))
    try:
        await asyncio.sleep(0)
        await _sign(stage)
    finally:
        first.cancel()


def _ended(function: Callable[[Stage], object], how: Callable[[Stage], None] | None = None) -> Provocation:
    """Call it after the connection has ended."""
    end = how or (lambda stage: stage.vehicle.connection.close())
    return P(_now(function), before=end, alone=True)


# ------------------------------------------------------------------------------ set-points, cells


async def _stop(stage: Stage, feed: Callable[[Any], Any]) -> None:
    """A stream that stopped because no set-points were supplied."""
    async with stage.vehicle.guided.velocity(valid_for_s=0.3) as stream:
        await anyio.sleep(1)
        await feed(stream)


async def _old_value(stage: Stage) -> object:
    await anyio.sleep(1.0)
    return stage.vehicle.version.fresh(0.5)


async def _set_too_much(stage: Stage) -> None:
    async with stage.vehicle.guided.velocity() as stream:
        stream.set(VelocitySetpoint(north_m_s=math.nan))


async def _set_after_the_end(stream: Any) -> None:
    stream.set(VelocitySetpoint())


async def _nothing(stream: Any) -> None:
    pass


async def _read(stage: Stage, *, entered: bool = True, **options: Any) -> None:
    subscription = stage.vehicle.subscribe(messages.Ping)
    if not entered:
        await subscription.get(timeout=1)
    with subscription:
        if not entered:
            subscription.close()
        await subscription.get(**options)


async def _read_closed(stage: Stage) -> None:
    with stage.vehicle.subscribe(messages.Ping) as subscription:
        pass
    await subscription.get()


async def _read_twice(stage: Stage) -> None:
    with stage.vehicle.subscribe(messages.Ping) as subscription:
        reader = asyncio.create_task(subscription.get())
        await asyncio.sleep(0)
        try:
            await subscription.get()
        finally:
            reader.cancel()


async def _read_overflowed(stage: Stage) -> None:
    with stage.vehicle.subscribe(messages.Heartbeat, overflow="error") as subscription:
        await anyio.sleep(3)
        await subscription.get()
        await subscription.get()


async def _wait_for_ever(stage: Stage) -> None:
    await stage.vehicle.mode.wait_until(lambda _: False)


def _parts() -> Table:
    guided = {
        "velocity": (),
        "body_velocity": (),
        "acceleration": (),
        "attitude": (AttitudeSetpoint(0, 0, 0, thrust=0.5),),
        "local_position": (LocalPositionSetpoint(0, 0, -5),),
        "position": (PositionSetpoint(Position(47, 8, altitude_relative_m=5)),),
    }
    rows: Table = {
        (f"Guided.{name}", "NotSupported"): P(
            _now(lambda s, name=name, args=args: getattr(s.vehicle.guided, name)(*args)),  # type: ignore[misc]
            before=_obeys_nothing,
            alone=True,
        )
        for name, args in guided.items()
    }
    stopped = "SetpointStreamStopped"
    return rows | {
        ("SetpointStream", stopped): P(lambda s: _stop(s, _nothing), airborne),
        ("SetpointStream.set", stopped): P(lambda s: _stop(s, _set_after_the_end), airborne),
        ("SetpointStream.set", "InvalidArgument"): P(_set_too_much, airborne),
        ("SetpointStream.set", "ValueUnknownError"): P(_set_body_velocity_without_heading, airborne),
        ("SetpointStream.fly", stopped): later(lambda s: _fly(s), pilot, 1.0),
        ("StateCell.fresh", "StaleValueError"): P(_old_value, grounded),
        ("StateCell.fresh", "ValueUnknownError"): P(
            _now(lambda s: s.vehicle.home.fresh(1)), before=_clear_state("home")
        ),
        ("StateCell.wait_until", "OperationTimeout"): P(
            lambda s: s.vehicle.mode.wait_until(lambda _: False, timeout=1)
        ),
        ("StateCell.wait_until", "ConnectionClosed"): later(
            _wait_for_ever, lambda s: s.vehicle.connection.close(), 0.1, alone=True
        ),
        ("StateCell.wait_until", "LinkLost"): later(_wait_for_ever, lost, 0.1, alone=True),
        ("Subscription.get", "OperationTimeout"): P(lambda s: _read(s, timeout=1)),
        ("Subscription.get", "SubscriptionOverflow"): P(_read_overflowed),
        ("Subscription.get", "BusyError"): P(_read_twice),
        ("Subscription.get", "InvalidArgument"): P(_read_closed),
        ("Subscription.get", "ConnectionClosed"): later(_read, lambda s: s.vehicle.connection.close(), 0.1, alone=True),
        ("Subscription.get", "LinkLost"): later(_read, lost, 0.1, alone=True),
    }


async def _set_body_velocity_without_heading(stage: Stage) -> None:
    async with stage.vehicle.guided.body_velocity() as stream:
        _clear_state("heading_deg")(stage)
        stream.set(BodyVelocitySetpoint(forward_m_s=1, yaw_deg=90))


async def _fly(stage: Stage) -> None:
    async with stage.vehicle.guided.velocity() as stream:
        await stream.fly(VelocitySetpoint(north_m_s=1), 5)


# ------------------------------------------------------------------------------------ connections


async def _connect(stage: Stage, link: Any = None, **options: Any) -> None:
    async with simulated_link(SimulatedCopter(boot_time_s=0.0)) as other:
        given = other if link is None else link
        async with aerokit.connect(given, **options):
            pass


async def _connect_and(stage: Stage, end: Callable[[Any], object]) -> None:
    """The connection ends while it is waited for the vehicle."""
    async with (
        simulated_link(SimulatedCopter(boot_time_s=0.0)) as link,
        aerokit.open_connection(link) as connection,
    ):
        asyncio.get_running_loop().call_later(0.5, end, connection)
        async with aerokit.connect(connection, system_id=77):
            pass


async def _open(stage: Stage, link: Any, **options: Any) -> None:
    async with aerokit.open_connection(link, **options):
        pass


async def _record_twice(stage: Stage) -> None:
    stage.vehicle.connection.record(stage.local())
    stage.vehicle.connection.record(stage.local())


async def _used(stage: Stage, *, now: bool) -> None:
    async with simulated_link(SimulatedCopter(boot_time_s=0.0)) as link:
        async with aerokit.open_connection(link):
            if now:
                await _open(stage, link)
        await _open(stage, link)


def _connections() -> Table:
    nowhere = "/nowhere/at/all.tlog"
    ping = messages.Ping(0, 0, 0, 0)
    rows: Table = {
        ("connect", "InvalidArgument"): P(lambda s: _connect(s, "udp:nowhere:port")),
        ("connect", "BusyError"): P(lambda s: _connect(s, s.vehicle.connection)),
        ("connect", "LinkOpenError"): P(lambda s: _connect(s, record=nowhere)),
        ("connect", "LinkLost"): P(
            lambda s: _connect_and(s, lambda connection: connection.link_lost(errors.LinkLost("unplugged")))
        ),
        ("connect", "ConnectionClosed"): P(lambda s: _connect_and(s, lambda connection: connection.close())),
        ("connect", "ConnectFailed"): P(lambda s: _connect(s, system_id=77, timeout=3)),
        ("open_connection", "InvalidArgument"): P(lambda s: _open(s, "nonsense:")),
        ("open_connection", "LinkOpenError"): P(lambda s: _open(s, "tcp:127.0.0.1:9")),
        ("open_connection", "BusyError"): P(lambda s: _used(s, now=True)),
        ("open_connection", "ConnectionClosed"): P(lambda s: _used(s, now=False)),
        ("Connection.check_types", "InvalidArgument"): P(_now(lambda s: s.vehicle.connection.check_types(()))),
        ("Connection.subscribe", "InvalidArgument"): P(_now(lambda s: s.vehicle.connection.subscribe())),
        ("Connection.record", "LinkOpenError"): P(_now(lambda s: s.vehicle.connection.record(nowhere))),
        ("Connection.record", "BusyError"): P(_record_twice, alone=True),
        ("Connection.send", "InvalidArgument"): P(
            _now(lambda s: s.vehicle.connection.send(messages.Ping(0, 0, 999, 0)))
        ),
        ("Connection.write_raw", "InvalidArgument"): P(_now(lambda s: s.vehicle.connection.write_raw(b"no"))),
    }
    frame = bytes.fromhex("fe0900ff00000000000006080003030000")
    for name, function in {
        "raise_if_ended": lambda s: s.vehicle.connection.raise_if_ended(),
        "send": lambda s: s.vehicle.connection.send(ping),
        "write_raw": lambda s: s.vehicle.connection.write_raw(frame),
        "record": lambda s: s.vehicle.connection.record(s.local()),
    }.items():
        rows[f"Connection.{name}", "ConnectionClosed"] = _ended(function)
        rows[f"Connection.{name}", "LinkLost"] = _ended(function, lost)
    for error, end in (("ConnectionClosed", lambda s: s.vehicle.connection.close()), ("LinkLost", lost)):
        rows["Connection.vehicles", error] = P(lambda s: anext(s.vehicle.connection.vehicles()), before=end, alone=True)
    return rows


FLIGHT: Table = {**_actions(), **_parts(), **_connections()}
