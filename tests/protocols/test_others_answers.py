"""Messages of other components or systems, and unrequested ones, are not taken as answers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from parameter_channel import framed

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavMissionResult, MavMissionType
from aerokit.mavlink.message import Message
from aerokit.missions import MissionItem
from aerokit.parameters import Parameter, ParameterType
from aerokit.protocols.blocks import Reassembly
from aerokit.protocols.exchange import Exchange
from aerokit.protocols.logs import LOG_BLOCK, LogDownload, LogList
from aerokit.protocols.mission_download import MissionDownload
from aerokit.protocols.mission_upload import MissionUpload
from aerokit.protocols.missions import MissionClear, SetCurrentItem
from aerokit.protocols.parameter_list import ParameterList
from aerokit.protocols.parameter_requests import ParameterReads, ParameterWrites

ACCEPTED, FENCE = MavMissionResult.ACCEPTED, MavMissionType.FENCE
ITEM = MissionItem(16, 3, x=1, y=1, z=1.0)
VALUE = m.ParamValue("A", 1.0, 9, 1, 0)
WANTED = Parameter("A", 1.0, ParameterType.REAL32)


def log() -> Exchange[Any]:
    return LogDownload(1, 1, 1, 9, Reassembly(lambda data: None, block_size=LOG_BLOCK))


EXCHANGES: dict[str, tuple[Callable[[], Exchange[Any]], Message]] = {
    "mission_download": (lambda: MissionDownload(1, 1, window=4), m.MissionCount(255, 190, 0)),
    "mission_upload": (lambda: MissionUpload(1, 1, [ITEM], window=4), m.MissionRequestInt(255, 190, 0)),
    "mission_clear": (lambda: MissionClear(1, 1), m.MissionAck(255, 190, ACCEPTED)),
    "mission_current": (lambda: SetCurrentItem(1, 1, 2), m.MissionCurrent(2)),
    "parameter_list": (lambda: ParameterList(1, 1, bytewise=False), VALUE),
    "parameter_reads": (lambda: ParameterReads(1, 1, ["A"], bytewise=False), VALUE),
    "parameter_writes": (lambda: ParameterWrites(1, 1, [WANTED], bytewise=False), VALUE),
    "log_list": (lambda: LogList(1, 1, first_id=1), m.LogEntry(0, 0, 0, 0, 0)),
    "log_download": (log, m.LogData(1, 0, 9, bytes(90))),
}


def started(name: str) -> tuple[Exchange[Any], Message]:
    make, answer = EXCHANGES[name]
    exchange = make()
    exchange.start(0.0)
    exchange.take_outbox()
    return exchange, answer


def state(exchange: Exchange[Any]) -> tuple[bool, float | None, list[Message]]:
    return exchange.done, exchange.deadline, exchange.take_outbox()


@pytest.mark.parametrize("name", EXCHANGES)
@pytest.mark.parametrize(("system_id", "component_id"), [(1, 2), (2, 1)])
def test_exchange_ignores_other_components(name: str, system_id: int, component_id: int) -> None:
    exchange, answer = started(name)
    before = state(exchange)
    exchange.receive(framed(answer, system_id=system_id, component_id=component_id), 0.5)
    assert state(exchange) == before
    exchange.receive(framed(answer), 0.5)
    assert state(exchange) != before


@pytest.mark.parametrize("name", EXCHANGES)
def test_exchange_ignores_unrequested_messages(name: str) -> None:
    exchange, _ = started(name)
    before = state(exchange)
    exchange.receive(framed(m.Heartbeat(2, 3, 81, 4, 3)), 0.5)
    assert state(exchange) == before


@pytest.mark.parametrize("name", [name for name in EXCHANGES if name.startswith("mission") and "current" not in name])
def test_mission_exchange_ignores_other_mission_types(name: str) -> None:
    exchange, answer = started(name)
    before = state(exchange)
    fields = {field.name: getattr(answer, field.name) for field in answer.FIELDS}
    exchange.receive(framed(type(answer)(**{**fields, "mission_type": FENCE})), 0.5)
    assert state(exchange) == before


@pytest.mark.parametrize("name", EXCHANGES)
def test_result_before_end_raises(name: str) -> None:
    exchange, _ = started(name)
    with pytest.raises(RuntimeError, match="has not ended yet"):
        exchange.result()
    exchange.abort(ValueError("aborted"))
    exchange.abort(KeyError("too late"))
    assert (exchange.done, exchange.deadline) == (True, None)
    with pytest.raises(ValueError, match="aborted"):
        exchange.result()
