"""Provocations of what gimbals promise to raise."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from typing import Any

import anyio
from call_stage import Stage, airborne, grounded
from provoked import Do, Provocation, Table, accepted, ignored, later, lost, refused, stops_sending

from aerokit import Position, messages
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import MavCmd, MavResult

__all__ = ["GIMBALS"]

P, Cmd = Provocation, MavCmd
PITCHYAW, CONFIGURE = Cmd.DO_GIMBAL_MANAGER_PITCHYAW, Cmd.DO_GIMBAL_MANAGER_CONFIGURE
Trouble = Callable[[Stage], object]


def _call(name: str, *args: Any, **options: Any) -> Do:
    return lambda stage: getattr(stage.vehicle.gimbal, name)(*args, **options)


def _fitted(*troubles: Trouble) -> Trouble:
    """Add a gimbal to the vehicle, then apply the troubles to it."""

    def before(stage: Stage) -> None:
        stage.simulated.parameters["MNT1_TYPE"] = 1.0
        for trouble in troubles:
            trouble(stage)

    return before


def _takes(stage: Stage) -> None:
    """Another ground station claims it."""
    claim = messages.CommandLong(1, 1, CONFIGURE, 0, -2, -2, -1, -1, 0, 0, 0)
    stage.simulated.receive(FrameEncoder(254, 190).encode(claim), stage.simulated.now)


def _another_order(stage: Stage) -> None:
    stage.task = asyncio.ensure_future(stage.vehicle.gimbal.release())  # type: ignore[attr-defined]


def _in_control(do: Callable[[Stage, Any], Any], *, taken: bool = False) -> Do:
    async def control(stage: Stage) -> None:
        async with stage.vehicle.gimbal.control() as block:
            if taken:
                _takes(stage)
                await anyio.sleep(1.0)
            await do(stage, block)

    return control


async def _nothing(*_: Any) -> None:
    pass


def _taken(do: Do) -> Provocation:
    return P(_in_control(lambda stage, _: do(stage), taken=True), grounded, _fitted())


def _control(**options: Any) -> Do:
    async def enter(stage: Stage) -> None:
        async with stage.vehicle.gimbal.control(**options):
            await anyio.sleep(0.1)

    return enter


def _rates(feed: Callable[[Any], Any] = _nothing, **options: Any) -> Do:
    async def enter(stage: Stage) -> None:
        async with stage.vehicle.gimbal.rates(**options) as stream:
            await feed(stream)

    return enter


def _setting(*rates: float, after_s: float = 0.0) -> Callable[[Any], Any]:
    async def feed(stream: Any) -> None:
        await anyio.sleep(after_s)
        stream.set(*rates)

    return feed


def _turning(*args: float, after_s: float = 0.0) -> Callable[[Any], Any]:
    async def feed(stream: Any) -> None:
        await anyio.sleep(after_s)
        await stream.turn(*args)

    return feed


async def _feed_after_takeover(stage: Stage, feed: Callable[[Any], Any]) -> None:
    async with stage.vehicle.gimbal.control(), stage.vehicle.gimbal.rates(valid_for_s=9.0) as stream:
        _takes(stage)
        await anyio.sleep(1.0)
        await feed(stream)


async def _rates_after_takeover(stage: Stage) -> None:
    async with stage.vehicle.gimbal.control():
        _takes(stage)
        await anyio.sleep(1.0)
        async with stage.vehicle.gimbal.rates():
            pass


async def _ended(stage: Stage, end: Trouble) -> None:
    async with stage.vehicle.gimbal.control() as control:
        asyncio.get_running_loop().call_later(0.5, end, stage)
        await control.until_lost()


async def _left(stage: Stage) -> None:
    async with stage.vehicle.gimbal.control() as control:
        pass
    await control.until_lost()


async def _discover(stage: Stage, end: Trouble) -> None:
    asyncio.get_running_loop().call_later(0.5, end, stage)
    await stage.vehicle.gimbals.discover()


def _closed(stage: Stage) -> None:
    stage.vehicle.connection.close()


async def _get(stage: Stage, device_id: int) -> None:
    stage.vehicle.gimbals.get(device_id)


def _many(stage: Stage) -> None:
    """Announce many gimbals."""
    for number in range(7, 200):
        stage.vehicle.gimbal  # noqa: B018 - it begins to listen
        status = messages.GimbalDeviceAttitudeStatus(0, 0, 0, 32, (1, 0, 0, 0), 0, 0, 0, 0)
        stage.wire.deliver(FrameEncoder(1, number).encode(status))


async def _raise_after_takeover(_: Stage, block: Any) -> None:
    block.raise_if_taken()


def _look(stage: Stage, **options: Any) -> Any:
    return stage.vehicle.gimbal.look_at(stage.target(), **options)


def _place_of(stage: Stage) -> Any:
    return stage.vehicle.gimbals.get(2).look_at(stage.target())


def _look_north(stage: Stage) -> Any:
    return stage.vehicle.gimbal.look_at(Position(47.0, 8.0, altitude_relative_m=5.0))


def _table() -> Table:
    rows: Table = {
        ("Gimbal.point", "InvalidArgument"): P(_call("point", 999, 0)),
        ("Gimbal.look_at", "InvalidArgument"): P(lambda s: _look(s, tolerance_deg=99), airborne),
        ("Gimbal.look_at_system", "InvalidArgument"): P(_call("look_at_system", 0)),
        ("Gimbal.look_at", "NotSupported"): P(_place_of, airborne),
        ("Gimbal.look_at", "ValueUnknownError"): P(_look_north, airborne, lambda s: s.vehicle.home.forget(), on="px4"),
        ("Gimbal.look_at_system", "NotSupported"): P(_call("look_at_system", 2), on="px4"),
        ("Gimbal.retract", "NotSupported"): P(_call("retract"), on="px4"),
        ("Gimbal.release", "CommandRejected"): P(_call("release"), before=refused(Cmd.DO_MOUNT_CONTROL)),
        ("Gimbal.release", "CommandTimeout"): P(_call("release"), grounded, ignored(Cmd.DO_MOUNT_CONTROL)),
        ("Gimbal.release", "GimbalTaken"): _taken(_call("release")),
        ("Gimbal.release", "OperationRejected"): later(
            _call("release"), _another_order, 0.1, before=refused(Cmd.DO_MOUNT_CONTROL, MavResult.UNSUPPORTED)
        ),
        ("Gimbal.stop_looking", "CommandRejected"): P(_call("stop_looking"), before=refused(Cmd.DO_SET_ROI_NONE)),
        ("Gimbal.stop_looking", "CommandTimeout"): P(_call("stop_looking"), grounded, ignored(Cmd.DO_SET_ROI_NONE)),
        ("Gimbal.stop_looking", "OperationRejected"): later(
            _call("stop_looking"), _another_order, 0.5, grounded, before=ignored(Cmd.DO_SET_ROI_NONE)
        ),
        ("Gimbal.stop_looking", "GimbalTaken"): _taken(_call("stop_looking")),
        ("Gimbal.information", "CommandRejected"): P(
            _call("information"), before=refused(Cmd.REQUEST_MESSAGE), alone=True
        ),
        ("Gimbal.information", "CommandTimeout"): P(
            _call("information"), grounded, ignored(Cmd.REQUEST_MESSAGE), alone=True
        ),
        ("Gimbal.rates", "InvalidArgument"): P(_rates(pitch_deg_s=9e9)),
        ("GimbalRates", "InvalidArgument"): P(_rates(yaw_deg_s=math.nan)),
        ("GimbalRates", "NotSupported"): P(_rates(), before=refused(PITCHYAW, MavResult.UNSUPPORTED), alone=True),
        ("GimbalRates", "CommandRejected"): P(_rates(), before=refused(PITCHYAW)),
        ("GimbalRates", "CommandTimeout"): P(_rates(), grounded, ignored(PITCHYAW)),
        ("GimbalRates", "GimbalTaken"): P(_rates_after_takeover, grounded, _fitted()),
        ("GimbalRates", "SetpointStreamStopped"): P(_rates(_setting(0.0, after_s=2.0)), before=_fitted()),
        ("GimbalRates.set", "InvalidArgument"): P(_rates(_setting(9e9)), before=_fitted()),
        ("GimbalRates.set", "SetpointStreamStopped"): P(_rates(_setting(0.0, after_s=2.0)), before=_fitted()),
        ("GimbalRates.set", "GimbalTaken"): P(lambda s: _feed_after_takeover(s, _setting(1.0)), grounded, _fitted()),
        ("GimbalRates.turn", "InvalidArgument"): P(_rates(_turning(9e9, 0, 1)), before=_fitted()),
        ("GimbalRates.turn", "SetpointStreamStopped"): P(_rates(_turning(0, 0, 1, after_s=2.0)), before=_fitted()),
        ("GimbalRates.turn", "GimbalTaken"): P(
            lambda s: _feed_after_takeover(s, _turning(0, 0, 1)), grounded, _fitted()
        ),
        ("GimbalControl", "NotSupported"): P(_control(secondary=True)),
        ("GimbalControl", "BusyError"): P(_in_control(lambda s, _: _control()(s)), grounded, _fitted()),
        ("GimbalControl", "CommandRejected"): P(_control(), before=refused(CONFIGURE)),
        ("GimbalControl", "CommandTimeout"): P(_control(), grounded, ignored(CONFIGURE)),
        ("GimbalControl", "OperationTimeout"): P(_control(), grounded, accepted(CONFIGURE)),
        ("GimbalControl", "GimbalTaken"): _taken(_nothing),
        ("GimbalControl.raise_if_taken", "GimbalTaken"): P(
            _in_control(_raise_after_takeover, taken=True), grounded, _fitted()
        ),
        ("GimbalControl.until_lost", "OperationRejected"): P(_left, grounded, _fitted()),
        ("GimbalControl.until_lost", "ConnectionClosed"): P(
            lambda s: _ended(s, _closed), grounded, _fitted(), alone=True
        ),
        ("GimbalControl.until_lost", "LinkLost"): P(lambda s: _ended(s, lost), grounded, _fitted(), alone=True),
        ("Gimbals.get", "InvalidArgument"): P(lambda s: _get(s, 0)),
        ("Gimbals.get", "BusyError"): P(lambda s: _get(s, 250), before=_many, alone=True),
        ("Gimbals.discover", "ConnectionClosed"): P(lambda s: _discover(s, _closed), alone=True),
        ("Gimbals.discover", "LinkLost"): P(lambda s: _discover(s, lost), alone=True),
    }
    for name, do, command in (
        ("point", lambda **o: _call("point", 0, 77, **o), PITCHYAW),
        ("neutral", lambda **o: _call("neutral", **o), PITCHYAW),
        ("retract", lambda **o: _call("retract", **o), PITCHYAW),
        ("look_at", lambda **o: lambda s: _look(s, **o), Cmd.DO_SET_ROI_LOCATION),
        ("look_at_system", lambda **o: _call("look_at_system", 9, **o), Cmd.DO_SET_ROI_SYSID),
    ):
        call = f"Gimbal.{name}"
        status, stuck = _fitted(accepted(command)), airborne
        rows[call, "CommandRejected"] = P(do(), airborne, refused(command))
        rows[call, "CommandTimeout"] = P(do(), airborne, ignored(command))
        rows[call, "OperationTimeout"] = P(do(timeout=1.0), stuck, status)
        rows[call, "OperationRejected"] = later(do(timeout=9.0), _another_order, 0.5, stuck, before=status)
        rows[call, "HeartbeatTimeout"] = later(do(timeout=60.0), stops_sending, 0.5, stuck, before=status)
        rows[call, "GimbalTaken"] = _taken(do())
    return rows


GIMBALS = _table()
