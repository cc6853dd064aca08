"""``Watch``: the vehicles that are served, and what they have told lately, for pages that are opened later."""

from __future__ import annotations

import asyncio
import json
from collections import deque
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from aerokit._internal.plain import plain
from aerokit.apps.serve.requests import Problem
from aerokit.connection.connection import Connection
from aerokit.connection.tasks import Background
from aerokit.errors import InvalidArgument
from aerokit.events import Event, LinkReport, StatusTextReceived
from aerokit.vehicle.connect import vehicles_on
from aerokit.vehicle.vehicle import Vehicle, overview

if TYPE_CHECKING:
    from aerokit.connection.bus import Detach

Listener = Callable[[dict[str, Any]], object]

MOST_EVENTS = 500
MOST_TEXTS = 200
"""Of each vehicle."""
SNAPSHOT_LASTS_S = 0.05
"""All who ask within this time get the same one."""


class Watch:
    """The vehicles of a source, their events and texts; nothing is asked of a vehicle.

    ``source``: a connection, whose vehicles are all followed as they are heard; one vehicle; or system id → vehicle,
    which may grow.
    """

    def __init__(self, source: Connection | Vehicle | Mapping[int, Vehicle]) -> None:
        self.events: deque[dict[str, Any]] = deque(maxlen=MOST_EVENTS)
        self._texts: dict[int, deque[dict[str, Any]]] = {}
        self._listeners: list[Listener] = []
        self._watched: dict[Connection, list[Detach]] = {}
        self._count = 0
        self._snapshot: tuple[float, str] | None = None
        self._background = Background(_let_out)
        self._vehicles: Mapping[int, Vehicle] = {}
        if isinstance(source, Connection):
            self._attach(source)
            self._watched[source].append(source.on_end(lambda _: self._background.cancel()))
            self._background.start(lambda: self._follow(source), "aerokit serve")
        elif isinstance(source, Vehicle):
            self._vehicles = {source.system_id: source}
        elif isinstance(source, Mapping):
            self._vehicles = source
        else:
            raise InvalidArgument(f"{source!r} is no connection, no vehicle and no mapping of vehicles")
        self._look()

    @property
    def vehicles(self) -> Mapping[int, Vehicle]:
        """System id → vehicle, of those that have been heard."""
        self._look()
        return self._vehicles

    def vehicle(self, system_id: int) -> Vehicle:
        """The vehicle of this id and no other one.

        Raises:
            Problem: 404, it has not been heard.
        """
        found = self.vehicles.get(system_id)
        if found is None:
            heard = ", ".join(map(str, self.vehicles)) or "none"
            raise Problem(
                404,
                "NotHeard",
                f"vehicle {system_id} has not been heard (heard so far: {heard}); nothing was sent",
            )
        return found

    def texts(self, system_id: int) -> list[dict[str, Any]]:
        """What the vehicle has said since it is served, the oldest first."""
        return list(self._texts.get(system_id, ()))

    def snapshot(self) -> str:
        """The state of all vehicles now, as the text of a ``state`` message of the stream."""
        now = asyncio.get_running_loop().time()
        if self._snapshot is None or now - self._snapshot[0] > SNAPSHOT_LASTS_S:
            vehicles = [_told(vehicle) for vehicle in self.vehicles.values()]
            message = {"type": "state", "at_s": now, "vehicles": vehicles}
            self._snapshot = now, json.dumps(message, ensure_ascii=False, allow_nan=False)
        return self._snapshot[1]

    def listen(self, listener: Listener) -> Callable[[], None]:
        """Have every message that is published given to it, until what this returns is called."""
        self._listeners.append(listener)
        return lambda: self._listeners.remove(listener)

    def publish(self, message: dict[str, Any]) -> None:
        """Number a message and give it to everyone who listens."""
        self._count += 1
        numbered = {**message, "number": self._count}
        if message["type"] == "event":
            self.events.append(numbered)
        for listener in tuple(self._listeners):
            listener(numbered)

    async def aclose(self) -> None:
        """Watch no more, and have nothing left behind."""
        for detaches in self._watched.values():
            for detach in detaches:
                detach()
        self._watched.clear()
        await self._background.aclose()

    async def _follow(self, connection: Connection) -> None:
        async with vehicles_on(connection) as vehicles:
            self._vehicles = vehicles
            await asyncio.Event().wait()

    def _look(self) -> None:
        for vehicle in self._vehicles.values():
            if vehicle.connection not in self._watched:
                self._attach(vehicle.connection)

    def _attach(self, connection: Connection) -> None:
        def on_event(event: Event) -> None:
            if isinstance(event, LinkReport) or not (
                event.system_id == 0 or event.system_id in self._vehicles
            ):
                return
            self._note(event, connection.unix_time() - (connection.now() - event.at))

        self._watched[connection] = connection.attach([Event], on_event)

    def _note(self, event: Event, unix_s: float) -> None:
        if isinstance(event, StatusTextReceived):
            told = self._texts.setdefault(event.system_id, deque(maxlen=MOST_TEXTS))
            told.append({"time_unix_s": unix_s, "severity": event.severity, "text": event.text})
        self.publish({"type": "event", "event": type(event).__name__, "time_unix_s": unix_s, **plain(event)})


def _told(vehicle: Vehicle) -> dict[str, Any]:
    """With the mission item as the mission counts; the state ``mission_current`` counts as the wire does."""
    mission = vehicle.mission
    return {
        **overview(vehicle),
        "mission_item": mission.current.latest,
        "mission_items": mission.count.latest,
    }


def _let_out(error: Exception) -> None:
    """A connection that has ended: the vehicles' own states say so."""
