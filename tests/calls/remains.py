"""Things that a call could leave behind: tasks, timers, sinks, waiters, locks, rates, open files."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import anyio
from call_stage import Stage
from flight_harness import make_parts

from aerokit.connection import loop_watch
from aerokit.vehicle.session.commands import PENDING_ACK_TIMEOUT_S

__all__ = ["SETTLED_S", "check_remains", "snapshot"]

SETTLED_S = 20.0
"""An abandoned arm command is monitored for 15 s, and acknowledged then."""
POLL_INTERVAL_S = 0.25


def snapshot(stage: Stage) -> Counter[str]:
    """Return the present counts by name."""
    return Counter(_all(stage))


async def check_remains(stage: Stage, before: Counter[str]) -> Counter[str]:
    """Return what remains in addition to ``before``, after waiting for it to go or settle."""
    waited = 0.0
    while (left := snapshot(stage) - before) and waited < SETTLED_S:
        await anyio.sleep(POLL_INTERVAL_S)
        waited += POLL_INTERVAL_S
    return left


def _all(stage: Stage) -> Iterator[str]:
    vehicle: Any = stage.vehicle
    connection = vehicle.connection
    make_parts(vehicle)
    yield from _tasks()
    yield from _timers()
    talks = [vehicle._session, *(component._session for component in vehicle._components._by_id.values())]
    streams = [stream for session in talks for stream in session.rates._streams.values()]
    counters = [stream.on_frame for stream in streams]  # they stay, one for each stream
    for key, sinks in connection.bus._sinks.items():
        yield from _times(f"sink of message {key}", [sink for _, sink in sinks if sink not in counters])
    yield from (f"sink of {key.__name__}" for key, sinks in connection.bus._event_sinks.items() for _ in sinks)
    yield from _times("end of the connection", connection._end_signal._callbacks)
    yield from _times("deadline", connection.deadlines._deadlines)
    for cell in (*vehicle.telemetry.cells.values(), vehicle.link_quality):
        yield from _times(f"waiter on {cell.name}", cell._listeners)
    for stream in streams:
        yield from _times(f"wish for {stream.message_type.NAME}", stream.requests)
    yield from _times(
        "answer under way", [key for key in vehicle._session.commands._pending_acks if _is_awaited(vehicle, key)]
    )
    yield from _times("command that waits", vehicle._session.commands._runs)
    yield from _times("order", vehicle._arbiter._orders_in_progress[1:])
    yield from _times("sending", vehicle._arbiter._sent_commands)
    yield from _times("held parameter", vehicle.parameters._registry._blocks)
    closing = vehicle.files._channel._closing.values()
    yield from _times("file that is being closed", [task for _, task in closing if not task.done()])
    yield from _times("open session", range(stage.simulated.ftp.open_sessions))
    yield from _times("log on its way", range(stage.simulated.storage.logs.is_busy))
    yield from _times("set-point stream", range(vehicle._flight_cleanup.is_stream_open))
    yield from (f"lock {name}" for name, lock in _locks("vehicle", vehicle, set()) if lock.locked())


def _is_awaited(vehicle: Any, key: tuple[int, int]) -> bool:
    oldest = vehicle.connection.now() - PENDING_ACK_TIMEOUT_S
    expected = vehicle._session.commands._pending_acks.get((vehicle.component_id, key[1]), ())
    return any(at >= oldest for at in expected)


def _times(name: str, items: Iterable[object]) -> Iterator[str]:
    return (name for _ in items)


def _tasks() -> Iterator[str]:
    current = asyncio.current_task()
    for task in asyncio.all_tasks():
        if task is not current:
            is_named = not task.get_name().startswith("Task-")
            yield f"task {task.get_name() if is_named else getattr(task.get_coro(), '__qualname__', '')}"


def _timers() -> Iterator[str]:
    """Count timers, except those of sleeping tasks and of the simulator, which come and go. The loop's own watch is
    always active, and in the list of timers except in the iteration in which it is due.
    """
    loop: Any = asyncio.get_running_loop()
    for timer in loop._scheduled:
        module = getattr(timer._callback, "__module__", "")
        is_ours = module.startswith(("aerokit.vehicle", "aerokit.connection")) and module != loop_watch.__name__
        if is_ours and not timer.cancelled():
            yield f"timer {timer._callback.__qualname__}"


def _locks(name: str, item: Any, visited: set[int]) -> Iterator[tuple[str, asyncio.Lock]]:
    """Every lock that a vehicle holds, wherever."""
    if id(item) in visited:
        return
    visited.add(id(item))
    if isinstance(item, asyncio.Lock):
        yield name, item
    elif isinstance(item, Mapping) and len(item) < 100:
        for key, value in item.items():
            yield from _locks(f"{name}[{key}]", value, visited)
    elif type(item).__module__.startswith(("aerokit.vehicle", "aerokit.connection")):
        for key, value in getattr(item, "__dict__", {}).items():
            yield from _locks(f"{name}.{key}", value, visited)
