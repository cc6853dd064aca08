"""Calls of outputs and devices, of the shell and the log stream: successful, blocking, and failing ones."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import suppress
from typing import Any, NamedTuple

import anyio
from call_stage import Place, Stage, airborne, anywhere, armed, grounded
from provoked import Do, Provocation, Table, accepted, ignored, refused, stops_sending

from aerokit import messages as m
from aerokit.errors import AerokitError
from aerokit.mavlink.enums import MavCmd, MavResult, MavType
from aerokit.sim.commands import CommandHandler, ReceivedCommand
from aerokit.sim.components.component import Builder, SimulatedComponent
from aerokit.sim.faults import Faults

__all__ = [
    "BLOCKING_DEVICES",
    "BLOCKS",
    "DEVICES",
    "DEVICE_CALLS",
    "DEVICE_ERRORS",
    "FITTED",
    "DeviceCall",
    "components_of",
    "fit",
]

Give = Callable[[Any], Any]
C = MavCmd
COPTER, PX4 = ("ardupilot",), ("px4",)
BOTH = COPTER + PX4
FITTED = {"GRIP_ENABLE": 1.0, "LGR_ENABLE": 1.0, "CHUTE_ENABLED": 1.0, "WINCH_TYPE": 1.0, "SERVO9_FUNCTION": 0.0}


class DeviceCall(NamedTuple):
    """An order to a device: its name in CALLS, the call, the MAV_CMD, and an invalid call.

    ``has_effect`` is True if the call waits for an effect after the acknowledgement.
    """

    name: str
    give: Give
    command: int
    on: tuple[str, ...] = COPTER
    place: Place = anywhere
    wrong: Give | None = None
    has_effect: bool = False

    @property
    def order(self) -> str:
        """Name in the table of orders: ``"gripper.grab"`` for ``"Gripper.grab"``."""
        name = self.name.removeprefix("Vehicle.")
        return name[0].lower() + name[1:]

    def errors(self) -> Table:
        """Provocations of NotSupported, and of the errors while the call waits for the effect."""
        do, rows = _do(self.give), {}
        if self.on != BOTH:
            absent = "px4" if self.on == COPTER else "ardupilot"
            rows[self.name, "NotSupported"] = Provocation(do, self.place, on=absent)
        if self.has_effect:
            without_effect = _fitted(accepted(self.command))
            rows[self.name, "OperationRejected"] = Provocation(_superseded(do, self.give), before=without_effect)
            rows[self.name, "OperationTimeout"] = Provocation(do, before=without_effect)
        return rows


def fit(stage: Stage) -> None:
    """Fit all devices to a copter, and let failures be injected on PX4."""
    parameters = {"SYS_FAILURE_EN": 1.0} if stage.is_px4 else FITTED
    for name, value in parameters.items():
        stage.simulated.parameters[name] = value


def _do(give: Give) -> Do:
    return lambda stage: give(stage.vehicle)


def _test_motor(v: Any, **changes: Any) -> Any:
    return v.actuators.test_motor(1, **{"throttle_percent": 5, "duration_s": 0.5, "intent": "spin motor", **changes})


def _fail(v: Any, **changes: Any) -> Any:
    return v.inject_failure("battery", "off", **{"intent": "inject failure", **changes})


DEVICE_CALLS = (
    DeviceCall(
        "Actuators.set_servo",
        lambda v: v.actuators.set_servo(9, 1600),
        C.DO_SET_SERVO,
        wrong=lambda v: v.actuators.set_servo(33, 1600),
        has_effect=True,
    ),
    DeviceCall(
        "Actuators.repeat_servo",
        lambda v: v.actuators.repeat_servo(9, 1600, count=2, period_s=1),
        C.DO_REPEAT_SERVO,
        wrong=lambda v: v.actuators.repeat_servo(9, 1600, count=0, period_s=1),
    ),
    DeviceCall(
        "Actuators.set_relay",
        lambda v: v.actuators.set_relay(0, True),
        C.DO_SET_RELAY,
        wrong=lambda v: v.actuators.set_relay(16, True),
        has_effect=True,
    ),
    DeviceCall(
        "Actuators.repeat_relay",
        lambda v: v.actuators.repeat_relay(0, count=2, period_s=1),
        C.DO_REPEAT_RELAY,
        wrong=lambda v: v.actuators.repeat_relay(0, count=2, period_s=0),
    ),
    DeviceCall(
        "Actuators.set_actuator",
        lambda v: v.actuators.set_actuator(2, 0.5),
        C.DO_SET_ACTUATOR,
        PX4,
        wrong=lambda v: v.actuators.set_actuator(7, 0.5),
    ),
    DeviceCall(
        "Actuators.set_actuators",
        lambda v: v.actuators.set_actuators(0.5, None, -1),
        C.DO_SET_ACTUATOR,
        PX4,
        wrong=lambda v: v.actuators.set_actuators(1.5),
    ),
    DeviceCall(
        "Actuators.raise_landing_gear",
        lambda v: v.actuators.raise_landing_gear(),
        C.AIRFRAME_CONFIGURATION,
        place=airborne,
    ),
    DeviceCall(
        "Actuators.lower_landing_gear",
        lambda v: v.actuators.lower_landing_gear(),
        C.AIRFRAME_CONFIGURATION,
    ),
    DeviceCall(
        "Actuators.test_motor",
        _test_motor,
        C.DO_MOTOR_TEST,
        place=grounded,
        wrong=lambda v: _test_motor(v, intent="spin"),
    ),
    DeviceCall(
        "Actuators.enable_parachute",
        lambda v: v.actuators.enable_parachute(),
        C.DO_PARACHUTE,
    ),
    DeviceCall("Gripper.grab", lambda v: v.gripper().grab(), C.DO_GRIPPER, BOTH, has_effect=True),
    DeviceCall("Gripper.release", lambda v: v.gripper().release(), C.DO_GRIPPER, BOTH, has_effect=True),
    DeviceCall("Winch.relax", lambda v: v.winch().relax(), C.DO_WINCH),
    DeviceCall(
        "Winch.pay_out",
        lambda v: v.winch().pay_out(0.6),
        C.DO_WINCH,
        wrong=lambda v: v.winch().pay_out(1e5),
    ),
    DeviceCall(
        "Winch.set_rate",
        lambda v: v.winch().set_rate(0),
        C.DO_WINCH,
        wrong=lambda v: v.winch().set_rate(50),
    ),
    DeviceCall(
        "Vehicle.inject_failure",
        _fail,
        C.INJECT_FAILURE,
        PX4,
        wrong=lambda v: _fail(v, instance=17),
    ),
)
"""Orders that end with an effect or an acknowledgement of the autopilot."""


# -------------------------------------------------------------- devices that are components


class Winch(SimulatedComponent):
    """A winch that executes every order at once and reports ``flags``, by default all."""

    TYPE = MavType.WINCH
    flags = 0x1FFFF

    def commands(self) -> dict[int, CommandHandler]:
        return {C.DO_WINCH: lambda _: MavResult.ACCEPTED}

    def builders(self) -> dict[int, Builder]:
        return {m.WinchStatus.ID: lambda _: [m.WinchStatus(0, 0.0, 0.0, 0.0, 0.0, 0.0, 20, self.flags)]}


class Light(SimulatedComponent):
    """A light that reports its state; with ``is_stuck``, the state never changes."""

    TYPE = MavType.ILLUMINATOR
    is_on = is_stuck = False

    def commands(self) -> dict[int, CommandHandler]:
        return {C.ILLUMINATOR_ON_OFF: self._switch}

    def builders(self) -> dict[int, Builder]:
        return {m.IlluminatorStatus.ID: lambda _: [self._status()]}

    def _switch(self, command: ReceivedCommand) -> int:
        self.is_on = self.is_on if self.is_stuck else bool(command.param1)
        return MavResult.ACCEPTED

    def _status(self) -> m.IlluminatorStatus:
        fields = {field.name: 0 for field in m.IlluminatorStatus.FIELDS}
        return m.IlluminatorStatus(**{**fields, "enable": int(self.is_on)})


def components_of(stage: Stage) -> tuple[Winch, Light]:
    """Add a winch and a light to the vehicle, once."""
    fit(stage)
    simulated: Any = stage.simulated
    if not hasattr(simulated, "test_devices"):
        simulated.test_devices = (Winch(169), Light(243))
        for device in simulated.test_devices:
            device.join(simulated)
    devices: tuple[Winch, Light] = simulated.test_devices
    for device in devices:
        device.faults = Faults()
    devices[0].flags, devices[1].is_stuck = Winch.flags, False
    return devices


def _winch(name: str) -> Do:
    return lambda stage: getattr(stage.vehicle.winch(component_id=169), name)()


WINCH_ORDERS = ("lock", "deliver", "hold", "retract", "load_line", "abandon_line", "load_payload")
DEVICES: dict[str, tuple[Do, Place]] = {
    "Actuators.set_lights": (lambda s: s.vehicle.actuators.set_lights(not s.counter), anywhere),
    **{f"Winch.{name}": (_winch(name), anywhere) for name in WINCH_ORDERS},
}
"""Calls to devices that are components."""


# --------------------------------------------------------------- parachute, shell and log stream


async def _high(stage: Stage) -> None:
    """Climb high enough for a parachute."""
    await airborne(stage)
    if (stage.vehicle.position.value.altitude_relative_m or 0) < 15:
        here = stage.vehicle.position.value
        await stage.vehicle.go_to(here.replace(altitude_amsl_m=None, altitude_relative_m=20.0))


def _release(vehicle: Any, intent: Any = "release parachute") -> Any:
    return vehicle.actuators.release_parachute(intent=intent)


async def _shell(stage: Stage) -> None:
    async with stage.vehicle.shell() as shell:
        await shell.run("echo 1")
        shell.write("echo 2")
        await shell.read(timeout=2)


async def _stream(stage: Stage) -> None:
    async with stage.vehicle.logs.stream() as stream:
        await stream.__anext__()


BLOCKS: dict[str, tuple[Do, Place, tuple[str, ...]]] = {
    "Actuators.release_parachute": (_do(_release), _high, COPTER),
    "Vehicle.shell": (_shell, anywhere, PX4),
    "Shell.read": (_shell, anywhere, PX4),
    "Shell.run": (_shell, anywhere, PX4),
    "Logs.stream": (_stream, anywhere, PX4),
}


def _sync_shell(stage: Any) -> None:
    with stage.vehicle.shell() as shell:
        shell.run("echo 1")
        shell.write("echo 2")
        shell.read(timeout=2)


def _sync_stream(stage: Any) -> None:
    with stage.vehicle.logs.stream() as stream:
        next(stream)


BLOCKING_DEVICES: dict[str, Callable[[Any], object]] = {
    **dict.fromkeys(("Vehicle.shell", "Shell.write", "Shell.read", "Shell.run"), _sync_shell),
    "Logs.stream": _sync_stream,
    "Vehicle.gripper": lambda s: s.vehicle.gripper(),
    "Vehicle.winch": lambda s: s.vehicle.winch(),
    "Vehicle.play_tune": lambda s: s.vehicle.play_tune("L8 CEG"),
    "Vehicle.send_status_text": lambda s: s.vehicle.send_status_text("hello"),
}

# ---------------------------------------------------------------------------------- provocations

P = Provocation


def _fitted(*troubles: Callable[[Stage], object]) -> Callable[[Stage], None]:
    def before(stage: Stage) -> None:
        components_of(stage)
        for trouble in troubles:
            trouble(stage)

    return before


def _superseded(do: Do, other: Give, after_s: float = 0.3) -> Do:
    """Give another order for the device during the call."""

    async def both(stage: Stage) -> None:
        async def later() -> None:
            await anyio.sleep(after_s)
            with suppress(AerokitError):
                await other(stage.vehicle)

        task = asyncio.ensure_future(later())
        try:
            await do(stage)
        finally:
            await task

    return both


def _component(index: int, *, refuse: int | None = None, ignore: int | None = None) -> Callable[[Stage], None]:
    def before(stage: Stage) -> None:
        faults = components_of(stage)[index].faults
        if refuse is not None:
            faults.refuse(refuse, MavResult.FAILED)
        if ignore is not None:
            faults.ignore(ignore)

    return before


def _stuck(stage: Stage) -> None:
    winch, light = components_of(stage)
    winch.flags, light.is_stuck = 0, True


def _lit_and_stuck(stage: Stage) -> None:
    light = components_of(stage)[1]
    light.is_on = light.is_stuck = True


def _called(give: Give) -> Do:
    async def call(stage: Stage) -> None:
        give(stage.vehicle)

    return call


def _silent_soon(stage: Stage) -> None:
    asyncio.get_running_loop().call_later(0.3, stops_sending, stage)


def _stays_armed(stage: Stage) -> None:
    """Let the pilot arm during the motor test."""
    accepted(C.DO_MOTOR_TEST)(stage)
    copter: Any = stage.simulated
    asyncio.get_running_loop().call_later(0.3, lambda: copter.motors.set_armed(armed=True))


async def _in_shell(stage: Stage, use: Callable[[Any], Any]) -> None:
    async with stage.vehicle.shell() as shell:
        await use(shell)


async def _twice(stage: Stage) -> None:
    shell = stage.vehicle.shell()
    async with shell:
        await shell.__aenter__()


async def _write_lines(shell: Any) -> None:
    shell.write("one\ntwo")


def _deaf(stage: Stage) -> None:
    """Let the shell not answer."""
    stage.simulated.handlers[m.SerialControl.ID] = lambda *_: None


async def _run_in_deaf_shell(stage: Stage) -> None:
    async with stage.vehicle.shell() as shell:
        _deaf(stage)
        await shell.run("a", timeout=1)


def _winch_errors(name: str) -> Table:
    """Return the provoked errors of an order to a winch that is a component."""
    key, do = f"Winch.{name}", _winch(name)
    rows = {
        (key, "NotSupported"): P(lambda stage: getattr(stage.vehicle.winch(), name)(), before=fit),
        (key, "CommandRejected"): P(do, before=_component(0, refuse=C.DO_WINCH)),
        (key, "CommandTimeout"): P(do, before=_component(0, ignore=C.DO_WINCH)),
    }
    is_awaited = name not in ("deliver", "hold")
    trouble = _stuck if is_awaited else _component(0, ignore=C.DO_WINCH)
    rows[key, "OperationRejected"] = P(_superseded(do, lambda v: v.winch(component_id=169).hold()), before=trouble)
    if is_awaited:
        rows |= {
            (key, "HeartbeatTimeout"): P(do, before=_fitted(_stuck, _silent_soon), alone=True),
            (key, "OperationTimeout"): P(do, before=_stuck),
        }
    return rows


def _light(v: Any) -> Any:
    return v.actuators.set_lights(True)


def _pay_out(v: Any) -> Any:
    return v.winch().pay_out(50, timeout=30)


DEVICE_ERRORS: Table = {
    **{key: row for call in DEVICE_CALLS for key, row in call.errors().items()},
    **{key: row for name in WINCH_ORDERS for key, row in _winch_errors(name).items()},
    ("Actuators.raise_landing_gear", "OperationRejected"): P(_do(lambda v: v.actuators.raise_landing_gear()), grounded),
    ("Actuators.set_lights", "InvalidArgument"): P(_do(lambda v: v.actuators.set_lights(True, component_id=0))),
    ("Actuators.set_lights", "NotSupported"): P(_do(lambda v: v.actuators.set_lights(True, component_id=1))),
    ("Actuators.set_lights", "CommandRejected"): P(_do(_light), before=_component(1, refuse=C.ILLUMINATOR_ON_OFF)),
    ("Actuators.set_lights", "CommandTimeout"): P(_do(_light), before=_component(1, ignore=C.ILLUMINATOR_ON_OFF)),
    ("Actuators.set_lights", "OperationRejected"): P(
        _superseded(_do(lambda v: v.actuators.set_lights(False)), _light), before=_lit_and_stuck
    ),
    ("Actuators.set_lights", "OperationTimeout"): P(
        _do(lambda v: v.actuators.set_lights(False)), before=_lit_and_stuck
    ),
    ("Actuators.test_motor", "OperationRejected"): P(_do(_test_motor), armed),
    ("Actuators.test_motor", "OperationTimeout"): P(_do(_test_motor), grounded, _stays_armed, alone=True),
    ("Actuators.release_parachute", "InvalidArgument"): P(_do(lambda v: _release(v, "yes"))),
    ("Actuators.release_parachute", "NotSupported"): P(_do(_release), on="px4"),
    ("Actuators.release_parachute", "OperationRejected"): P(_do(_release), grounded, fit),
    ("Actuators.release_parachute", "CommandRejected"): P(_do(_release), before=_fitted(refused(C.DO_PARACHUTE))),
    ("Actuators.release_parachute", "CommandTimeout"): P(_do(_release), before=_fitted(ignored(C.DO_PARACHUTE))),
    ("Actuators.release_parachute", "OperationTimeout"): P(_do(_release), before=_fitted(accepted(C.DO_PARACHUTE))),
    ("Winch.pay_out", "OperationRejected"): P(_superseded(_do(_pay_out), lambda v: v.winch().relax()), before=fit),
    ("Winch.relax", "OperationRejected"): P(
        _superseded(_do(lambda v: v.winch().relax()), lambda v: v.winch().relax()),
        before=_fitted(ignored(C.DO_WINCH)),
    ),
    ("Winch.pay_out", "HeartbeatTimeout"): P(_do(_pay_out), before=_fitted(_silent_soon), alone=True),
    ("Winch.pay_out", "OperationTimeout"): P(_do(lambda v: v.winch().pay_out(50, timeout=2)), before=fit),
    ("Winch.set_rate", "OperationRejected"): P(
        _superseded(_do(lambda v: v.winch().set_rate(5)), lambda v: v.winch().relax()), before=fit
    ),
    ("Winch.set_rate", "OperationTimeout"): P(_do(lambda v: v.winch().set_rate(5)), before=fit),
    ("Vehicle.gripper", "InvalidArgument"): P(_called(lambda v: v.gripper(0))),
    ("Vehicle.winch", "InvalidArgument"): P(_called(lambda v: v.winch(0))),
    ("Vehicle.play_tune", "InvalidArgument"): P(_called(lambda v: v.play_tune("héhé"))),
    ("Vehicle.send_status_text", "InvalidArgument"): P(_called(lambda v: v.send_status_text(""))),
    ("Shell", "NotSupported"): P(_shell),
    ("Shell", "BusyError"): P(_twice, on="px4"),
    ("Shell", "OperationTimeout"): P(_shell, before=_deaf, on="px4"),
    ("Shell.write", "InvalidArgument"): P(lambda s: _in_shell(s, _write_lines), on="px4"),
    ("Shell.read", "InvalidArgument"): P(lambda s: _in_shell(s, lambda shell: shell.read(timeout=-1)), on="px4"),
    ("Shell.read", "OperationTimeout"): P(lambda s: _in_shell(s, lambda shell: shell.read(timeout=1)), on="px4"),
    ("Shell.run", "InvalidArgument"): P(lambda s: _in_shell(s, lambda shell: shell.run("a", timeout=0)), on="px4"),
    ("Shell.run", "OperationTimeout"): P(_run_in_deaf_shell, on="px4"),
    ("LogStream", "NotSupported"): P(_stream),
    ("LogStream", "CommandRejected"): P(_stream, before=refused(C.LOGGING_START), on="px4"),
    ("LogStream", "CommandTimeout"): P(_stream, before=ignored(C.LOGGING_START), on="px4"),
    ("Logs.stream", "InvalidArgument"): P(_called(lambda v: v.logs.stream(idle_timeout_s=-1))),
}
