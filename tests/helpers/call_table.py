"""Table of calls: one row for each public coroutine in `public_surface.awaited`, with its arguments and stage."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any

import anyio
from calibration_calls import CALIBRATIONS_AWAITED
from call_stage import DATA, Place, Stage, airborne, anywhere, armed, grounded, on_mission
from camera_beside import camera_of, settings_of
from camera_calls import AWAITED
from component_calls import COMPONENTS_AWAITED
from device_calls import BLOCKS, DEVICE_CALLS, DEVICES, DeviceCall, components_of, fit
from provoked import Do, Provocation, Table, ignored, refused
from rtk_calls import RTK_AWAITED
from stream_calls import ARDUPILOT_STREAMS, STREAMS_AWAITED

import aerokit
from aerokit import (
    AccelerationSetpoint,
    AttitudeRateSetpoint,
    AttitudeSetpoint,
    BodyVelocitySetpoint,
    LocalPositionSetpoint,
    PositionSetpoint,
    Signing,
    SigningKey,
    TrajectorySetpoint,
    VelocitySetpoint,
    messages,
)
from aerokit.connection.cells import Source
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import MavCmd, MavVtolState, SpeedType
from aerokit.sim import SimulatedCopter, SimulatedPx4, simulated_link
from aerokit.vehicle.components.settings import Settings

__all__ = ["CALLS", "Call", "Row", "north", "provocations"]

Give = Callable[[aerokit.Vehicle], Awaitable[object]]
COPTER, PX4 = ("ardupilot",), ("px4",)
BOTH = COPTER + PX4
KEY = SigningKey.from_passphrase("calls")


def _nothing(_: Stage) -> None:
    pass


@dataclass(frozen=True)
class Row:
    """One order in docs/reliability.md.

    ``place`` is the state of the vehicle before the order. ``modes`` are the modes that the order may lead to, on
    ArduCopter and on PX4. ``command`` is the MAV_CMD whose transmissions and answers are lost. ``steers`` is True if
    the order determines the path of the vehicle, ``holds`` if the vehicle must hold after the order is cancelled, and
    ``ends_later`` if the vehicle completes the order even then.
    """

    name: str
    give: Give
    command: int
    place: str = "air"
    modes: tuple[tuple[str, ...], tuple[str, ...]] = ((), ())
    steers: bool = True
    holds: bool = False
    ends_later: bool = False
    on: tuple[str, ...] = BOTH


@dataclass(frozen=True)
class Call:
    """One successful call, with the data for tests of its errors.

    ``before`` and ``after`` act on the simulated vehicle before and after each call. ``command`` is the MAV_CMD of the
    call: a refusal raises CommandRejected, a missing answer CommandTimeout. ``wrong`` is the same call with an invalid
    argument. ``order`` is the row of the call in the table of orders (`order_table`).
    """

    do: Callable[[Stage], Awaitable[object]]
    place: Place = anywhere
    on: tuple[str, ...] = BOTH
    before: Callable[[Stage], object] = _nothing
    after: Callable[[Stage], object] = _nothing
    command: int | None = None
    wrong: Do | None = None
    order: Row | None = None

    def provocations(self, name: str) -> Table:
        """Return the provocations of the errors that most calls document."""
        rows: Table = {}
        for error, trouble in (("CommandRejected", refused), ("CommandTimeout", ignored)):
            if self.command is not None:
                rows[name, error] = Provocation(self.do, self.place, trouble(self.command), on=self.on[0])
        if self.wrong is not None:
            rows[name, "InvalidArgument"] = Provocation(self.wrong, self.place, on=self.on[0])
        return rows


PLACES: dict[Place, str] = {airborne: "air", grounded: "ground", armed: "armed"}


def _action(
    name: str,
    give: Give,
    command: int,
    place: Place = airborne,
    *,
    wrong: Give | None = None,
    on: tuple[str, ...] = BOTH,
    after: Callable[[Stage], object] = _nothing,
    **order: Any,
) -> dict[str, Call]:
    """Create the call of an action that sends this command, with its row in the table of orders."""
    call = Call(
        lambda stage: give(stage.vehicle),
        place,
        on,
        after=after,
        command=command,
        wrong=None if wrong is None else lambda stage: wrong(stage.vehicle),
        order=Row(name, give, command, PLACES[place], on=on, **order),
    )
    return {f"Vehicle.{name}": call}


def _device(call: DeviceCall) -> Call:
    """Create the row of an order to a device of the autopilot."""
    give, wrong = call.give, call.wrong
    return Call(
        lambda stage: give(stage.vehicle),
        call.place,
        call.on,
        before=fit,
        command=call.command,
        wrong=None if wrong is None else lambda stage: wrong(stage.vehicle),
        order=Row(call.order, give, call.command, PLACES.get(call.place, "air"), on=call.on, steers=False),
    )


def provocations() -> Table:
    """Return the provocations of all calls."""
    return {key: row for name, call in CALLS.items() for key, row in call.provocations(name).items()}


def north(vehicle: aerokit.Vehicle, metres: float) -> aerokit.Position:
    return vehicle.position.value.offset(north_m=metres)


def _simulated(stage: Stage) -> SimulatedCopter | SimulatedPx4:
    return SimulatedPx4(boot_time_s=0.0) if stage.is_px4 else SimulatedCopter(boot_time_s=0.0)


async def _connect(stage: Stage) -> None:
    async with simulated_link(_simulated(stage)) as link, aerokit.connect(link) as vehicle:
        await vehicle.wait_ready()


async def _open_connection(stage: Stage) -> None:
    async with simulated_link(_simulated(stage)) as link, aerokit.open_connection(link):
        await anyio.sleep(1.5)


async def _not_ready(stage: Stage) -> None:
    await stage.vehicle.sensors.wait_until(lambda sensors: sensors.prearm_checks_pass is False, timeout=5)
    stage.simulated.faults.prearm_failures.clear()
    await stage.vehicle.wait_ready()


async def _subscribe(stage: Stage) -> None:
    with stage.vehicle.subscribe(messages.Attitude, rate_hz=20, capacity=4) as attitudes:
        async for _ in attitudes:
            break
        await attitudes.__anext__()


async def _subscribe_to_connection(stage: Stage) -> None:
    with stage.vehicle.connection.subscribe(messages.Heartbeat) as heartbeats:
        await heartbeats.__anext__()


async def _get(stage: Stage) -> None:
    with stage.vehicle.subscribe(messages.Attitude) as attitudes:
        await attitudes.get(timeout=5)


async def _changes(stage: Stage) -> None:
    changes = stage.vehicle.mode.changes()
    await changes.__anext__()
    with anyio.move_on_after(1.0):  # the mode does not change again
        await changes.__anext__()


async def _updates(stage: Stage) -> None:
    updates = stage.vehicle.mode.updates()
    for _ in range(2):
        await updates.__anext__()


def _stream(kind: str, setpoint: Callable[[Stage], Any]) -> Call:
    async def do(stage: Stage) -> None:
        async with getattr(stage.vehicle.guided, kind)(setpoint(stage)) as stream:
            await stream.fly(setpoint(stage), 0.7)

    return Call(do, airborne)


async def _fly(stage: Stage) -> None:
    async with stage.vehicle.guided.velocity() as stream:
        await stream.fly(VelocitySetpoint(north_m_s=1.0), 1.0)


async def _post_arm(stage: Stage) -> None:
    with stage.vehicle.posted("arm", armed=True) as order:
        await order.command(MavCmd.COMPONENT_ARM_DISARM, 1)
        await order.wait_confirmed(5)


async def _post_mode(stage: Stage) -> None:
    mode = stage.vehicle.autopilot.find_mode("LOITER")
    with stage.vehicle.posted("mode", modes=(mode,)) as order:
        await order.set_mode(mode)


async def _post_place(stage: Stage) -> None:
    place = stage.target()
    x, y = round(place.latitude_deg * 1e7), round(place.longitude_deg * 1e7)
    with stage.vehicle.posted("motion") as order:
        z = stage.vehicle.home.value.altitude_amsl_m + 10
        await order.command_int(MavCmd.DO_REPOSITION, -1, 1, 0, float("nan"), frame=5, x=x, y=y, z=z)


async def _temporarily(stage: Stage) -> None:
    async with stage.vehicle.parameters.temporarily({stage.parameter: stage.other_value()}):
        await anyio.sleep(0.5)


async def _transaction(stage: Stage) -> None:
    async with stage.vehicle.parameters.transaction() as transaction:
        await transaction.set(stage.parameter, stage.other_value())
        await anyio.sleep(0.5)


async def _transaction_of_many(stage: Stage) -> None:
    async with stage.vehicle.parameters.transaction() as transaction:
        await transaction.set_many({stage.parameter: stage.other_value()})


async def _mission_again(stage: Stage) -> None:
    await stage.vehicle.mission.pause()
    await stage.vehicle.mission.resume()


async def _fly_mission(stage: Stage) -> None:
    """Fly a mission to a single nearby place."""
    vehicle = stage.vehicle
    await vehicle.mission.upload(aerokit_mission(stage))
    await vehicle.mission.start()
    await vehicle.mission.wait_finished(timeout=60)


def aerokit_mission(stage: Stage) -> Any:
    """Return a mission to a single nearby place."""
    place = stage.vehicle.position.value.offset(north_m=6)
    from aerokit.missions import Mission, waypoint

    return Mission([waypoint(place.latitude_deg, place.longitude_deg, altitude_relative_m=6)])


async def _twice(stage: Stage, name: str) -> None:
    """Upload a plan, then clear it."""
    plan = getattr(stage.vehicle, name)
    await plan.upload(getattr(stage, name)())
    await plan.clear()


def _no_key(stage: Stage) -> None:
    """Remove a key that the vehicle may have accepted."""
    stage.simulated.signing.key = None
    stage.simulated.signing.load()
    stage.vehicle.connection.signing = None


async def _sign(stage: Stage) -> None:
    await stage.vehicle.setup_signing(Signing(KEY))


def _with_gimbal(stage: Stage) -> None:
    stage.simulated.parameters["MNT1_TYPE"] = 1.0


def _gimbal(do: Callable[[Any, Stage], Any], place: Place = anywhere) -> Call:
    return Call(lambda s: do(s.vehicle.gimbal, s), place, on=COPTER, before=_with_gimbal)


async def _in_control(gimbal: Any, _: Stage) -> None:
    async with gimbal.control():
        await gimbal.point(-30, 0)


async def _until_lost(gimbal: Any, stage: Stage) -> None:
    async with gimbal.control() as control:
        claim = messages.CommandLong(1, 1, MavCmd.DO_GIMBAL_MANAGER_CONFIGURE, 0, -2, -2, -1, -1, 0, 0, 0)
        stage.simulated.receive(FrameEncoder(254, 190).encode(claim), stage.simulated.now)
        await control.until_lost()


async def _turn(gimbal: Any, _: Stage) -> None:
    async with gimbal.rates() as stream:
        await stream.turn(-5, 5, 0.7)


def _with_camera(stage: Stage) -> None:
    camera_of(stage)
    settings_of(stage)


def _settings(do: Callable[[Settings], Awaitable[object]]) -> Call:
    return Call(lambda s: do(settings_of(s)), before=_with_camera)


def _fail_checks(stage: Stage) -> None:
    stage.simulated.faults.prearm_failures.append("Compass not healthy")


def _pass_checks(stage: Stage) -> None:
    stage.simulated.faults.prearm_failures.clear()


def _set_airspeed(vehicle: aerokit.Vehicle) -> Awaitable[object]:
    """The copter accepts an airspeed and changes its ground speed; only a plane has this call."""
    autopilot: Any = vehicle.autopilot
    autopilot.speed_types |= {SpeedType.AIRSPEED}
    return vehicle.set_airspeed(15)


async def _follow(stage: Stage) -> None:
    target = stage.target()
    async with stage.vehicle.follow(lambda: target, distance_m=5) as following:
        await following.fly(1.0)


def _make_vtol(stage: Stage) -> None:
    stage.simulated.vtol_state = int(MavVtolState.MC)  # type: ignore[union-attr]


def _unmake_vtol(stage: Stage) -> None:
    stage.simulated.vtol_state = 0  # type: ignore[union-attr]


async def _become_plane(stage: Stage) -> None:
    await stage.vehicle.vtol_state.wait_until(lambda state: state == MavVtolState.MC, timeout=5)
    await stage.vehicle.transition_to("fixed_wing")


async def _transition(vehicle: aerokit.Vehicle) -> None:
    """The vehicle of the order table is no VTOL, and does not answer."""
    vehicle.telemetry.vtol_state.set(int(MavVtolState.MC), Source(1, 1, "the test"))
    await vehicle.transition_to("fixed_wing")


def _undo_termination(stage: Stage) -> None:
    """A terminated PX4 flies again only after a restart, which would take long."""
    if isinstance(stage.simulated, SimulatedPx4):
        stage.simulated.arming.disarm("the test", force=True)
        stage.simulated.arming.is_terminated = stage.simulated.is_in_failsafe = False


def _switch_on(stage: Stage) -> None:
    if stage.simulated.now > 0 and not stage.simulated.is_on:
        stage.simulated.power_on()


CALLS: dict[str, Call] = {
    "connect": Call(_connect),
    "open_connection": Call(_open_connection),
    # ------------------------------------------------------------------------------------ Vehicle
    "Vehicle.wait_ready": Call(_not_ready, grounded, before=_fail_checks, after=_pass_checks),
    "Vehicle.why_not_armable": Call(lambda s: s.vehicle.why_not_armable(), grounded),
    "Vehicle.set_mode": Call(lambda s: s.vehicle.set_mode("LAND"), airborne),
    **_action("hold", lambda v: v.hold(), MavCmd.DO_SET_MODE, modes=(("BRAKE",), ("LOITER",))),
    **_action(
        "arm",
        lambda v: v.arm(),
        MavCmd.COMPONENT_ARM_DISARM,
        grounded,
        wrong=lambda v: v.arm(mode="NONE"),
        steers=False,
    ),
    **_action("disarm", lambda v: v.disarm(), MavCmd.COMPONENT_ARM_DISARM, armed, steers=False),
    "Vehicle.take_off": Call(lambda s: s.vehicle.take_off(5.0), armed),
    "Vehicle.go_to": Call(lambda s: s.vehicle.go_to(s.target(), speed_m_s=4, heading_deg=90), airborne),
    **_action("land", lambda v: v.land(), MavCmd.DO_SET_MODE, modes=(("LAND",), ("LAND",))),
    **_action(
        "return_to_launch",
        lambda v: v.return_to_launch(timeout=40),
        MavCmd.DO_SET_MODE,
        modes=(("RTL",), ("RTL",)),
    ),
    **_action(
        "set_speed",
        lambda v: v.set_speed(2.0),
        MavCmd.DO_CHANGE_SPEED,
        wrong=lambda v: v.set_speed(-1),
        steers=False,
    ),
    **_action(
        "set_airspeed",
        _set_airspeed,
        MavCmd.DO_CHANGE_SPEED,
        wrong=lambda v: v.set_airspeed(0),
        on=COPTER,
        steers=False,
    ),
    **_action(
        "set_climb_speed",
        lambda v: v.set_climb_speed(1.5),
        MavCmd.DO_CHANGE_SPEED,
        wrong=lambda v: v.set_climb_speed(-1),
        on=COPTER,
        steers=False,
    ),
    **_action("autotune", lambda v: v.autotune(), MavCmd.DO_AUTOTUNE_ENABLE, on=PX4, steers=False),
    "Vehicle.return_altitude": Call(lambda s: s.vehicle.return_altitude()),
    "Vehicle.set_return_altitude": Call(lambda s: s.vehicle.set_return_altitude(s.other_value() + 20)),
    "Vehicle.set_heading": Call(lambda s: s.vehicle.set_heading(60, relative=True), airborne),
    **_action(
        "set_home",
        lambda v: v.set_home(),
        MavCmd.DO_SET_HOME,
        wrong=lambda v: v.set_home(aerokit.Position(1, 1)),
        steers=False,
    ),
    **_action("look_at", lambda v: v.look_at(north(v, 50.0)), MavCmd.DO_SET_ROI_LOCATION, steers=False),
    **_action("stop_looking", lambda v: v.stop_looking(), MavCmd.DO_SET_ROI_NONE, steers=False),
    "Vehicle.orbit": Call(
        lambda s: s.vehicle.orbit(s.target(), radius_m=8, speed_m_s=4, turns=0.25),
        airborne,
        wrong=lambda s: s.vehicle.orbit(s.target(), radius_m=0),
    ),
    "Vehicle.figure_eight": Call(
        lambda s: s.vehicle.figure_eight(s.target(), major_radius_m=16, minor_radius_m=8, speed_m_s=4, rounds=0.5),
        airborne,
        wrong=lambda s: s.vehicle.figure_eight(s.target(), major_radius_m=16, minor_radius_m=9),
    ),
    "Vehicle.loiter": Call(
        lambda s: s.vehicle.loiter(s.target(), duration_s=2),
        airborne,
        command=MavCmd.DO_REPOSITION,
        wrong=lambda s: s.vehicle.loiter(turns=1),
    ),
    "Vehicle.follow": Call(_follow, airborne),
    "FollowStream.fly": Call(_follow, airborne),
    "Vehicle.transition_to": Call(
        _become_plane,
        airborne,
        on=PX4,
        before=_make_vtol,
        after=_unmake_vtol,
        command=MavCmd.DO_VTOL_TRANSITION,
        wrong=lambda s: s.vehicle.transition_to("tailsitter"),  # type: ignore[arg-type]
        order=Row("transition_to", _transition, MavCmd.DO_VTOL_TRANSITION, steers=False, on=PX4),
    ),
    **_action(
        "terminate",
        lambda v: v.terminate(intent="terminate flight"),
        MavCmd.DO_FLIGHTTERMINATION,
        armed,
        wrong=lambda v: v.terminate(intent="land"),  # type: ignore[arg-type]
        modes=((), ("TERMINATION",)),
        after=_undo_termination,
    ),
    **_action(
        "shutdown",
        lambda v: v.shutdown(intent="shut down"),
        MavCmd.PREFLIGHT_REBOOT_SHUTDOWN,
        grounded,
        wrong=lambda v: v.shutdown(intent="sleep"),  # type: ignore[arg-type]
        on=PX4,
        steers=False,
        after=_switch_on,
    ),
    **_action("reboot", lambda v: v.reboot(timeout=20), MavCmd.PREFLIGHT_REBOOT_SHUTDOWN, grounded, steers=False),
    "Vehicle.setup_signing": Call(_sign, grounded, after=_no_key),
    "Vehicle.command": Call(lambda s: s.vehicle.command(MavCmd.REQUEST_MESSAGE, messages.AutopilotVersion.ID)),
    "Vehicle.command_int": Call(
        lambda s: s.vehicle.command_int(MavCmd.REQUEST_MESSAGE, messages.AutopilotVersion.ID, frame=5)
    ),
    "Vehicle.subscribe": Call(_subscribe),
    # ------------------------------------------------------------------------------------- Guided
    "Guided.velocity": _stream("velocity", lambda _: VelocitySetpoint(north_m_s=1.0)),
    "Guided.body_velocity": _stream("body_velocity", lambda _: BodyVelocitySetpoint(forward_m_s=1.0)),
    "Guided.acceleration": _stream("acceleration", lambda _: AccelerationSetpoint(north_m_s2=0.2)),
    "Guided.local_position": _stream("local_position", lambda _: LocalPositionSetpoint(3, 3, -6)),
    "Guided.position": _stream("position", lambda s: PositionSetpoint(s.target())),
    "Guided.attitude": _stream("attitude", lambda _: AttitudeSetpoint(0, 2, 0, thrust=0.5)),
    "Guided.attitude_rate": _stream("attitude_rate", lambda _: AttitudeRateSetpoint(pitch_deg_s=1.0)),
    "Guided.trajectory": _stream("trajectory", lambda _: TrajectorySetpoint(3, 3, -6, north_m_s=0.1)),
    "SetpointStream.fly": Call(_fly, airborne),
    **{
        name: Call(do, place, COPTER if name in ARDUPILOT_STREAMS else BOTH, before=before)
        for name, (do, place, before) in STREAMS_AWAITED.items()
    },
    # ------------------------------------------------------------------------------------- Camera
    **{name: Call(do) for name, do in AWAITED.items()},
    # ------------------------------------------------------------------------------- calibration
    **{name: Call(do, grounded, on) for name, (do, on) in CALIBRATIONS_AWAITED.items()},
    # ------------------------------------------------------------------------------- corrections
    **{name: Call(do) for name, do in RTK_AWAITED.items()},
    # ------------------------------------------------------------------------------------ devices
    **{call.name: _device(call) for call in DEVICE_CALLS},
    **{name: Call(do, place, before=components_of) for name, (do, place) in DEVICES.items()},
    **{name: Call(do, place, on, before=fit) for name, (do, place, on) in BLOCKS.items()},
    # --------------------------------------------------------------------------------- components
    **{name: Call(do, before=_with_camera) for name, do in COMPONENTS_AWAITED.items()},
    # ------------------------------------------------------------------------------------- Gimbal
    "Gimbal.point": _gimbal(lambda g, _: g.point(-45, 90)),
    "Gimbal.neutral": _gimbal(lambda g, _: g.neutral()),
    "Gimbal.retract": _gimbal(lambda g, _: g.retract()),
    "Gimbal.look_at": _gimbal(lambda g, s: g.look_at(s.target()), airborne),
    "Gimbal.look_at_system": _gimbal(lambda g, _: g.look_at_system(9, wait=False)),
    "Gimbal.stop_looking": _gimbal(lambda g, _: g.stop_looking()),
    "Gimbal.release": _gimbal(lambda g, _: g.release()),
    "Gimbal.information": _gimbal(lambda g, _: g.information()),
    "Gimbal.control": _gimbal(_in_control),
    "Gimbal.rates": _gimbal(_turn),
    "Gimbals.discover": Call(lambda s: s.vehicle.gimbals.discover(timeout=1.0)),
    "GimbalControl.until_lost": _gimbal(_until_lost),
    "GimbalRates.turn": _gimbal(_turn),
    # -------------------------------------------------------------------------------- PostedOrder
    "PostedOrder.command": Call(_post_arm, grounded),
    "PostedOrder.command_int": Call(_post_place, airborne),
    "PostedOrder.set_mode": Call(_post_mode, grounded),
    "PostedOrder.wait_confirmed": Call(_post_arm, grounded),
    # --------------------------------------------------------------------------------- Parameters
    "Parameters.download": Call(lambda s: s.vehicle.parameters.download(refresh=True)),
    "Parameters.diff": Call(lambda s: s.vehicle.parameters.diff({s.parameter: 1.0})),
    "Parameters.changed_from_default": Call(lambda s: s.vehicle.parameters.changed_from_default(), on=COPTER),
    "Parameters.get": Call(lambda s: s.vehicle.parameters.get(s.parameter)),
    "Parameters.read": Call(lambda s: s.vehicle.parameters.read(s.parameter)),
    "Parameters.probe": Call(lambda s: s.vehicle.parameters.probe(s.parameter, "NOSUCH_PARAM")),
    "Parameters.set": Call(lambda s: s.vehicle.parameters.set(s.parameter, s.other_value())),
    "Parameters.set_many": Call(lambda s: s.vehicle.parameters.set_many({s.parameter: s.other_value()})),
    "Parameters.upload": Call(lambda s: s.vehicle.parameters.upload({s.parameter: s.other_value()})),
    "Settings.download": _settings(lambda s: s.download(refresh=True)),
    "Settings.get": _settings(lambda s: s.get("CAM_EV")),
    "Settings.read": _settings(lambda s: s.read("CAM_OWNER")),
    "Settings.set": _settings(lambda s: s.set("CAM_EXPMODE", 1)),
    "Settings.fetch_definition": _settings(lambda s: s.fetch_definition()),
    "Parameters.temporarily": Call(_temporarily),
    "Parameters.transaction": Call(_transaction),
    "Transaction.set": Call(_transaction),
    "Transaction.set_many": Call(_transaction_of_many),
    # ----------------------------------------------------------------------------------- missions
    "MissionControl.upload": Call(lambda s: s.vehicle.mission.upload(s.mission()), grounded),
    "MissionControl.download": Call(lambda s: s.vehicle.mission.download()),
    "MissionControl.clear": Call(lambda s: _twice(s, "mission"), grounded),
    "MissionControl.set_current": Call(lambda s: s.vehicle.mission.set_current(2), on_mission),
    "MissionControl.start": Call(lambda s: s.vehicle.mission.start(1), on_mission),
    "MissionControl.pause": Call(lambda s: s.vehicle.mission.pause(), on_mission),
    "MissionControl.resume": Call(_mission_again, on_mission),
    "MissionControl.wait_finished": Call(_fly_mission, airborne),
    "FenceControl.upload": Call(lambda s: s.vehicle.fence.upload(s.fence()), grounded),
    "FenceControl.download": Call(lambda s: s.vehicle.fence.download(), grounded),
    "FenceControl.clear": Call(lambda s: _twice(s, "fence"), grounded),
    "FenceControl.enable": Call(lambda s: s.vehicle.fence.enable(False), grounded, on=COPTER),
    "RallyControl.upload": Call(lambda s: s.vehicle.rally.upload(s.rally()), grounded),
    "RallyControl.download": Call(lambda s: s.vehicle.rally.download(), grounded),
    "RallyControl.clear": Call(lambda s: _twice(s, "rally"), grounded),
    # ------------------------------------------------------------------------------ files and logs
    "Files.is_supported": Call(lambda s: s.vehicle.files.is_supported()),
    "Files.read": Call(lambda s: s.vehicle.files.read(s.file)),
    "Files.download": Call(lambda s: s.vehicle.files.download(s.file, s.local())),
    "Files.list": Call(lambda s: s.vehicle.files.list(s.root)),
    "Files.crc32": Call(lambda s: s.vehicle.files.crc32(s.file)),
    "Files.write": Call(lambda s: s.vehicle.files.write(s.new_name(), DATA)),
    "Files.upload": Call(lambda s: s.vehicle.files.upload(s.local_file(), s.new_name())),
    "Files.truncate": Call(lambda s: s.vehicle.files.truncate(s.put(s.new_name()), 10), on=PX4),
    "Files.remove": Call(lambda s: s.vehicle.files.remove(s.put(s.new_name()))),
    "Files.make_directory": Call(lambda s: s.vehicle.files.make_directory(s.new_name())),
    "Files.remove_directory": Call(lambda s: _directory_and_back(s)),
    "Files.rename": Call(lambda s: s.vehicle.files.rename(s.put(s.new_name()), s.new_name())),
    "Logs.list": Call(lambda s: s.vehicle.logs.list(), grounded),
    "Logs.read": Call(lambda s: s.vehicle.logs.read(1, method="log"), grounded),
    "Logs.download": Call(lambda s: s.vehicle.logs.download(1, s.local()), grounded),
    "Logs.erase": Call(lambda s: s.vehicle.logs.erase(), grounded, after=Stage.put_logs),
    # ---------------------------------------------------------------------------- cells and streams
    "StateCell.wait_until": Call(
        lambda s: s.vehicle.position.wait_until(lambda _: s.vehicle.position.age == 0, held_for=1.0, timeout=9)
    ),
    "StateCell.changes": Call(_changes),
    "StateCell.updates": Call(_updates),
    "Subscription.get": Call(_get),
    "Connection.subscribe": Call(_subscribe_to_connection),
}


async def _directory_and_back(stage: Stage) -> None:
    path = stage.new_name()
    await stage.vehicle.files.make_directory(path)
    await stage.vehicle.files.remove_directory(path)
