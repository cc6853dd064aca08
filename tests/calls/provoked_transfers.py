"""Provocations of what parameters, missions, files and logs promise to raise."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from call_stage import Stage, airborne, grounded, on_mission
from provoked import (
    LOSING_STATE,
    NONSENSE,
    REFUSING,
    Do,
    Provocation,
    Table,
    ignored,
    later,
    no_modes,
    pilot,
    refused,
    stops_sending,
)

from aerokit import messages as m
from aerokit.mavlink.enums import MavCmd

__all__ = ["TRANSFERS"]

P, Cmd = Provocation, MavCmd
PATIENCE: dict[str, Any] = {"idle_timeout_s": 1.0}
HURRY: dict[str, Any] = {"timeout": 0.3}
NOWHERE = "/nowhere/at/all"


def _of(part: str, name: str, *args: Any, **options: Any) -> Do:
    """A method of a part of the vehicle; arguments that are functions are given the stage."""

    def do(stage: Stage) -> Any:
        given = [arg(stage) if callable(arg) else arg for arg in args]
        return getattr(getattr(stage.vehicle, part), name)(*given, **options)

    return do


# ------------------------------------------------------------------------------------- parameters


def _name(stage: Stage) -> str:
    return stage.parameter


def _damaged(stage: Stage) -> str:
    path = stage.local("damaged.xml")
    path.write_bytes(b"\0<no>")
    return str(path)


async def _load(stage: Stage) -> None:
    stage.vehicle.parameters.load_metadata(_damaged(stage))


async def _load_missing(stage: Stage) -> None:
    stage.vehicle.parameters.load_metadata(stage.local("missing.xml"))


async def _upload_unknown(stage: Stage) -> None:
    """The error is in the result."""
    result = (await stage.vehicle.parameters.upload({"NOSUCH_PARAM": 1.0}))["NOSUCH_PARAM"]
    assert result.error is not None
    raise result.error


async def _in_transaction(stage: Stage, name: str, value: float) -> None:
    async with stage.vehicle.parameters.transaction(**PATIENCE) as transaction:
        await transaction.set(name, value)


async def _silent_in(stage: Stage, block: Any) -> None:
    async with block:
        if hasattr(block, "set"):
            await block.set(stage.parameter, stage.other_value())
            await block.set(stage.parameter, stage.other_value())
        stops_sending(stage)
        raise ZeroDivisionError


def _clamp(stage: Stage) -> None:
    limit = 2.0 if stage.simulated.parameters[stage.parameter] < 2 else 1.0
    stage.simulated.faults.parameter_limits[stage.parameter] = (0.0, limit)


def _parameters() -> Table:
    rows: Table = {
        ("Parameters.download", "ParameterTimeout"): P(
            _of("parameters", "download", method="list", refresh=True, **PATIENCE), before=stops_sending
        ),
        ("Parameters.download", "FileError"): P(
            _of("parameters", "download", method="ftp", refresh=True), before=REFUSING
        ),
        ("Parameters.download", "FileTimeout"): P(
            _of("parameters", "download", method="ftp", refresh=True, **PATIENCE), before=stops_sending
        ),
        ("Parameters.download", "RemoteProtocolError"): P(
            _of("parameters", "download", method="ftp", refresh=True), before=NONSENSE
        ),
        ("Parameters.changed_from_default", "NotSupported"): P(_of("parameters", "changed_from_default"), on="px4"),
        ("Parameters.load_metadata", "FileFormatError"): P(_load),
        ("Parameters.load_metadata", "OSError"): P(_load_missing),
        ("Parameters.upload", "FileFormatError"): P(_of("parameters", "upload", _damaged)),
        ("Parameters.upload", "OSError"): P(_of("parameters", "upload", NOWHERE)),
        ("Parameters.upload", "ParameterRejected"): P(_upload_unknown),
        ("Parameters.temporarily", "RollbackFailed"): P(
            lambda s: _silent_in(s, s.vehicle.parameters.temporarily({s.parameter: s.other_value() + 1}, **PATIENCE))
        ),
        ("Transaction", "RollbackFailed"): P(lambda s: _silent_in(s, s.vehicle.parameters.transaction(**PATIENCE))),
        ("Transaction.set", "InvalidArgument"): P(lambda s: _in_transaction(s, s.parameter, math.nan)),
        ("Transaction.set", "ParameterRejected"): P(lambda s: _in_transaction(s, "NOSUCH_PARAM", 1)),
        ("Transaction.set", "ParameterTimeout"): P(lambda s: _in_transaction(s, s.parameter, 1), before=stops_sending),
        ("Transaction.set", "VerificationFailed"): P(lambda s: _in_transaction(s, s.parameter, 3), before=_clamp),
    }
    for name, args, wrong, unknown in (
        ("get", (_name,), ("",), ("NOSUCH_PARAM",)),
        ("read", (_name,), ("",), ("NOSUCH_PARAM",)),
        ("set", (_name, Stage.other_value), (_name, math.nan), ("NOSUCH_PARAM", 1.0)),
        ("set_many", (lambda s: {s.parameter: s.other_value()},), ({"": 1.0},), None),
        ("upload", (lambda s: {s.parameter: s.other_value()},), ({"": 1.0},), None),
        ("probe", (_name,), ("",), None),
        ("diff", ({"A": 1.0},), None, None),
        ("changed_from_default", (), None, None),
        ("download", (), None, None),
    ):
        options = {"refresh": True} if name == "download" else {}
        do: Callable[..., Do] = lambda *given, name=name, **more: _of("parameters", name, *given, **more)  # noqa: E731
        key = f"Parameters.{name}"
        rows[key, "OperationTimeout"] = P(do(*args, **HURRY, **options), before=_unknown_and_silent)
        if wrong is not None:
            rows[key, "InvalidArgument"] = P(do(*wrong))
            rows[key, "ParameterTimeout"] = P(do(*args, **PATIENCE), before=_unknown_and_silent)
        if unknown is not None:
            rows[key, "ParameterRejected"] = P(do(*unknown))
    del rows["Parameters.set_many", "ParameterTimeout"]  # it is in the results
    del rows["Parameters.probe", "ParameterTimeout"]  # here, too
    return rows


def _unknown_and_silent(stage: Stage) -> None:
    stage.vehicle.parameters._access.forget()
    stops_sending(stage)


# --------------------------------------------------------------------------------------- missions


def _answering(kind: type[Any], result: int, mission_type: int) -> Callable[[Stage], None]:
    """Answer this message with a MISSION_ACK and do not execute it."""

    def trouble(stage: Stage) -> None:
        def handle(_: Any, channel: Any) -> None:
            stage.simulated.send(m.MissionAck(255, 190, result, mission_type), channel)

        stage.simulated.handlers[kind.ID] = handle

    return trouble


def _fewer(mission_type: int) -> Callable[[Stage], None]:
    """Make the vehicle report an empty list."""

    def trouble(stage: Stage) -> None:
        def handle(_: Any, channel: Any) -> None:
            stage.simulated.send(m.MissionCount(255, 190, 0, mission_type), channel)

        stage.simulated.handlers[m.MissionRequestList.ID] = handle

    return trouble


def _clear_something(part: str) -> Do:
    async def do(stage: Stage) -> None:
        held = getattr(stage.vehicle, part)
        await held.upload(getattr(stage, part)(), method="items")
        _answering(m.MissionClearAll, 0, TYPES[part])(stage)
        await held.clear()

    return do


TYPES = {"mission": 0, "fence": 1, "rally": 2}
OWNERS = {"mission": "MissionControl", "fence": "FenceControl", "rally": "RallyControl"}


def _plans(part: str) -> Table:
    kind, owner = TYPES[part], OWNERS[part]
    plan: Any = lambda stage: getattr(stage, part)()  # noqa: E731
    items: dict[str, Any] = {"method": "items"}
    rows: Table = {
        (f"{owner}.upload", "VerificationFailed"): P(
            _of(part, "upload", plan, **items, only_changes=False), grounded, _fewer(kind)
        ),
        (f"{owner}.clear", "VerificationFailed"): P(_clear_something(part), grounded),
    }
    for name, args, options, asked in (
        ("upload", (plan,), items, m.MissionCount),
        ("download", (), items, m.MissionRequestList),
        ("clear", (), {}, m.MissionClearAll),
    ):
        key = f"{owner}.{name}"
        rows |= {
            (key, "InvalidArgument"): P(_of(part, name, *args, idle_timeout_s=-1)),
            (key, "MissionRejected"): P(_of(part, name, *args, **options), grounded, _answering(asked, 1, kind)),
            (key, "MissionTimeout"): P(_of(part, name, *args, **options, **PATIENCE), grounded, stops_sending),
            (key, "OperationTimeout"): P(_of(part, name, *args, **options, **HURRY), grounded, stops_sending),
        }
        if options:
            ftp = {"method": "ftp"}
            rows |= {
                (key, "NotSupported"): P(_of(part, name, *args, **ftp), grounded, _no_files, alone=True),
                (key, "FileError"): P(_of(part, name, *args, **ftp), grounded, REFUSING),
                (key, "FileTimeout"): P(_of(part, name, *args, **ftp, **PATIENCE), grounded, stops_sending),
            }
    rows[f"{owner}.download", "RemoteProtocolError"] = P(_of(part, "download", method="ftp"), grounded, NONSENSE)
    return rows


def _no_files(stage: Stage) -> None:
    version = stage.vehicle.telemetry.version
    version.set(version.value.replace(capabilities=type(version.value.capabilities)(0)), version.source)  # type: ignore[arg-type]


def _flown() -> Table:
    current, start, mode = Cmd.DO_SET_MISSION_CURRENT, Cmd.MISSION_START, Cmd.DO_SET_MODE
    mission = "mission"
    rows: Table = {
        ("MissionControl.set_current", "InvalidArgument"): P(_of(mission, "set_current", -1)),
        ("MissionControl.set_current", "CommandRejected"): P(
            _of(mission, "set_current", 2), on_mission, refused(current)
        ),
        ("MissionControl.set_current", "OperationRejected"): P(
            later(_of(mission, "set_current", 2), pilot, 0.3).do, on_mission, ignored(current)
        ),
        ("MissionControl.set_current", "OperationTimeout"): P(
            _of(mission, "set_current", 2), on_mission, ignored(current)
        ),
        ("MissionControl.start", "InvalidArgument"): P(_of(mission, "start", -1)),
        ("MissionControl.resume", "InvalidArgument"): P(_of(mission, "resume", timeout=-1)),
        ("MissionControl.pause", "OperationRejected"): P(_of(mission, "pause"), airborne),
        ("MissionControl.pause", "CommandRejected"): P(_of(mission, "pause"), on_mission, refused(mode)),
        ("MissionControl.pause", "OperationTimeout"): P(_of(mission, "pause"), on_mission, ignored(mode)),
        ("MissionControl.pause", "NotSupported"): P(_of(mission, "pause"), on_mission, no_modes, alone=True),
        ("MissionControl.wait_finished", "OperationRejected"): later(
            _of(mission, "wait_finished"), pilot, 1.0, on_mission
        ),
        ("MissionControl.wait_finished", "OperationTimeout"): P(_of(mission, "wait_finished", timeout=1), on_mission),
        ("MissionControl.wait_finished", "HeartbeatTimeout"): later(
            _of(mission, "wait_finished"), stops_sending, 1.0, on_mission
        ),
        ("FenceControl.enable", "CommandRejected"): P(_of("fence", "enable"), grounded, refused(Cmd.DO_FENCE_ENABLE)),
        ("FenceControl.enable", "CommandTimeout"): P(_of("fence", "enable"), grounded, ignored(Cmd.DO_FENCE_ENABLE)),
    }
    for name in ("start", "resume"):
        key = f"MissionControl.{name}"
        rows |= {
            (key, "OperationRejected"): P(_of(mission, name), grounded),
            (key, "CommandRejected"): P(_of(mission, name), on_mission, refused(start)),
            (key, "OperationTimeout"): P(_of(mission, name), on_mission, ignored(start)),
            (key, "NotSupported"): P(_of(mission, name), on_mission, no_modes, alone=True),
        }
        if name == "resume":
            rows[key, "CommandRejected"] = P(_of(mission, name), on_mission, _both(refused(start), refused(mode)))
            rows[key, "OperationTimeout"] = P(_of(mission, name), on_mission, _both(ignored(start), ignored(mode)))
    return rows


def _both(*troubles: Callable[[Stage], object]) -> Callable[[Stage], object]:
    return lambda stage: [trouble(stage) for trouble in troubles]


# ---------------------------------------------------------------------------------- files and logs


def _files() -> Table:
    rows: Table = {
        ("Files.write", "VerificationFailed"): P(_of("files", "write", "/x", b"abc"), before=LOSING_STATE),
        ("Files.upload", "VerificationFailed"): P(_of("files", "upload", Stage.local_file, "/x"), before=LOSING_STATE),
        ("Files.download", "OSError"): P(_of("files", "download", lambda s: s.file, NOWHERE)),
        ("Files.upload", "OSError"): P(_of("files", "upload", NOWHERE, "/x")),
    }
    there: Any = lambda stage: stage.file  # noqa: E731
    for name, before, after in (
        ("read", (), ()),
        ("download", (), (Stage.local,)),
        ("list", (), ()),
        ("crc32", (), ()),
        ("write", (), (b"abc",)),
        ("upload", (Stage.local_file,), ()),
        ("truncate", (), (1,)),
        ("remove", (), ()),
        ("remove_directory", (), ()),
        ("make_directory", (), ()),
        ("rename", (), ("/new",)),
    ):
        key = f"Files.{name}"
        right: tuple[Any, ...] = (*before, there, *after)
        rows |= {
            (key, "InvalidArgument"): P(_of("files", name, *before, "", *after)),
            (key, "FileError"): P(_of("files", name, *right), before=REFUSING),
            (key, "FileTimeout"): P(_of("files", name, *right, **PATIENCE), before=stops_sending),
        }
        if name in ("read", "download", "list", "crc32", "write", "upload"):
            rows[key, "RemoteProtocolError"] = P(_of("files", name, *right), before=NONSENSE)
    return rows


def _ignores_erase(stage: Stage) -> None:
    stage.simulated.handlers[m.LogErase.ID] = lambda *_: None


def _logs() -> Table:
    rows: Table = {
        ("Logs.list", "FileTimeout"): P(_of("logs", "list", **PATIENCE), grounded, stops_sending),
        ("Logs.erase", "FileTimeout"): P(_of("logs", "erase", idle_timeout_s=2), grounded, _ignores_erase),
        ("Logs.download", "OSError"): P(_of("logs", "download", 1, NOWHERE), grounded),
    }
    for name, after in (("download", (Stage.local,)), ("read", ())):
        rows |= {
            (f"Logs.{name}", "InvalidArgument"): P(_of("logs", name, -1, *after)),
            (f"Logs.{name}", "FileError"): P(_of("logs", name, 77, *after), grounded),
            (f"Logs.{name}", "FileTimeout"): P(_of("logs", name, 1, *after, **PATIENCE), grounded, stops_sending),
        }
    return rows


TRANSFERS: Table = {
    **_parameters(),
    **_plans("mission"),
    **_plans("fence"),
    **_plans("rally"),
    **_flown(),
    **_files(),
    **_logs(),
}
