"""``ServedVehicles``: the vehicles that are served, with their recent events, texts and tracks."""

from __future__ import annotations

import asyncio
import json
import logging
import math
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import anyio

from aerokit._internal.formatting import to_jsonable
from aerokit.apps.readiness import ArmingCheckRequests, active_failsafe, arm_refusals, run_arming_checks, unarmable_mode
from aerokit.apps.serve.flight_watch import FlightWatch
from aerokit.apps.serve.requests import HttpProblem
from aerokit.autopilots.failsafes import gcs_failsafe
from aerokit.connection.connection import Connection
from aerokit.connection.tasks import BackgroundTasks
from aerokit.errors import AerokitError, InvalidArgument
from aerokit.events import Event, LinkReport, LinkState, StatusTextReceived
from aerokit.vehicle.commanding.ground import VELOCITY_MAX_AGE_S
from aerokit.vehicle.connect import vehicles_on
from aerokit.vehicle.parameters.return_altitude import known_return_altitude
from aerokit.vehicle.vehicle import Vehicle, overview

if TYPE_CHECKING:
    from aerokit.connection.bus import Detach
    from aerokit.position import Position

logger: logging.Logger = logging.getLogger("aerokit")

Listener = Callable[[dict[str, Any]], object]

MAX_EVENTS = 500
MAX_TEXTS = 200
"""Maximum number of stored texts for each vehicle."""
SNAPSHOT_MAX_AGE_S = 0.05
"""Requests for a snapshot get the previous one if it is not older than this many seconds."""
MAX_TRACK_POINTS = 2000
"""Maximum number of stored track points for each vehicle. If a track is full, every second point is removed, so that
the track still covers the whole flight."""
TRACK_INTERVAL_S = 0.2
MIN_TRACK_STEP_M = 0.5
TRACK_GAP_S = 3.0


class _TrackPoint(NamedTuple):
    position: Position
    is_after_gap: bool


class ServedVehicles:
    """Follows the vehicles of a source, and keeps their recent events, texts and tracks.

    Requests the return altitude of each vehicle once. Requests the reasons for not arming when a disarmed vehicle
    begins to report failing checks, and again when the failing sensors change.

    ``source`` is a connection (its vehicles are added as they appear), one vehicle, or a mapping from system id to
    vehicle, which may grow.
    """

    def __init__(self, source: Connection | Vehicle | Mapping[int, Vehicle]) -> None:
        self.events: deque[dict[str, Any]] = deque(maxlen=MAX_EVENTS)
        self._texts: dict[int, deque[dict[str, Any]]] = {}
        self._tracks: dict[int, list[_TrackPoint]] = {}
        self._arming_checks = ArmingCheckRequests()
        self._watches: dict[Vehicle, FlightWatch] = {}
        self._listeners: list[Listener] = []
        self._attached: dict[Connection, list[Detach]] = {}
        self._message_count = 0
        self._snapshot = ""
        self._snapshot_at = -math.inf
        self._background = BackgroundTasks(_log_unexpected)
        self._vehicles: Mapping[int, Vehicle] = {}
        if isinstance(source, Connection):
            self._attach(source)
            self._attached[source].append(source.on_end(lambda _: self._background.cancel()))
            self._background.start(lambda: self._follow_connection(source), "aerokit serve")
        elif isinstance(source, Vehicle):
            self._vehicles = {source.system_id: source}
        elif isinstance(source, Mapping):
            self._vehicles = source
        else:
            raise InvalidArgument(f"source = {source!r} is not a connection, a vehicle or a mapping of vehicles")
        self._attach_new_connections()
        self.listen(self._on_message)
        self._background.start(self._record_tracks, "aerokit serve tracks")
        self._background.start(self._request_arming_checks, "aerokit serve checks")

    @property
    def vehicles(self) -> Mapping[int, Vehicle]:
        self._attach_new_connections()
        return self._vehicles

    def vehicle(self, system_id: int) -> Vehicle:
        """Return the vehicle with this system id; raise HttpProblem 404 if there is none."""
        vehicle = self.vehicles.get(system_id)
        if vehicle is None:
            known_ids = ", ".join(map(str, self.vehicles)) or "none"
            raise HttpProblem(
                404, "UnknownVehicle", f"no vehicle has system id {system_id} (vehicles: {known_ids}); nothing was sent"
            )
        return vehicle

    def crash(self, vehicle: Vehicle) -> dict[str, Any] | None:
        """Return the impact after which the vehicle has not moved; None if it may have moved."""
        # Without recent velocities, the vehicle may have moved since the impact.
        is_connected = vehicle.link_state.latest is LinkState.CONNECTED
        is_observed = is_connected and vehicle.velocity.age <= VELOCITY_MAX_AGE_S
        return self._flight_watch(vehicle).crash if is_observed else None

    def texts(self, system_id: int) -> list[dict[str, Any]]:
        return list(self._texts.get(system_id, ()))

    def track(self, system_id: int) -> list[tuple[float, float, bool]]:
        """Return a vehicle's track as (latitude, longitude, is after a gap), the oldest position first."""
        points = self._tracks.get(system_id, ())
        return [(point.position.latitude_deg, point.position.longitude_deg, point.is_after_gap) for point in points]

    def snapshot(self) -> str:
        """Return the stream's message ``state`` as JSON. It is at most `SNAPSHOT_MAX_AGE_S` old."""
        now = asyncio.get_running_loop().time()
        if now - self._snapshot_at > SNAPSHOT_MAX_AGE_S:
            vehicles = [self._state_of(vehicle) for vehicle in self.vehicles.values()]
            message = {"type": "state", "at_s": now, "vehicles": vehicles}
            self._snapshot = json.dumps(message, ensure_ascii=False, allow_nan=False)
            self._snapshot_at = now
        return self._snapshot

    def listen(self, listener: Listener) -> Callable[[], None]:
        """Call ``listener`` with each published message. Return a function that ends this."""
        self._listeners.append(listener)
        return lambda: self._listeners.remove(listener)

    def publish(self, message: dict[str, Any]) -> None:
        self._message_count += 1
        numbered = {**message, "number": self._message_count}
        if message["type"] == "event":
            self.events.append(numbered)
        for listener in tuple(self._listeners):
            listener(numbered)

    async def aclose(self) -> None:
        for detaches in self._attached.values():
            for detach in detaches:
                detach()
        self._attached.clear()
        for watch in self._watches.values():
            watch.close()
        self._watches.clear()
        await self._background.aclose()

    def _flight_watch(self, vehicle: Vehicle) -> FlightWatch:
        if vehicle not in self._watches:
            self._watches[vehicle] = FlightWatch(vehicle)
            self._background.start(partial(_read_return_altitude, vehicle), "aerokit serve altitude")
        return self._watches[vehicle]

    def _on_message(self, message: Mapping[str, Any]) -> None:
        vehicle = self._vehicles.get(message["system_id"]) if message["type"] == "order" else None
        if vehicle is not None:
            self._flight_watch(vehicle).on_order(message["order"])

    async def _follow_connection(self, connection: Connection) -> None:
        async with vehicles_on(connection) as vehicles:
            self._vehicles = vehicles
            await anyio.sleep_forever()

    def _attach_new_connections(self) -> None:
        for vehicle in self._vehicles.values():
            if vehicle.connection not in self._attached:
                self._attach(vehicle.connection)

    def _attach(self, connection: Connection) -> None:
        def on_event(event: Event) -> None:
            is_about_link_or_vehicle = event.system_id == 0 or event.system_id in self._vehicles
            if isinstance(event, LinkReport) or not is_about_link_or_vehicle:
                return
            self._record_event(event, connection.unix_time() - (connection.now() - event.at))

        self._attached[connection] = connection.attach([Event], on_event)

    def _record_event(self, event: Event, unix_s: float) -> None:
        if isinstance(event, StatusTextReceived):
            texts = self._texts.setdefault(event.system_id, deque(maxlen=MAX_TEXTS))
            texts.append({"time_unix_s": unix_s, "severity": event.severity, "text": event.text})
        self.publish({"type": "event", "event": type(event).__name__, "time_unix_s": unix_s, **to_jsonable(event)})

    async def _record_tracks(self) -> None:
        interrupted: set[int] = set()  # system ids of vehicles whose next position is the first after a gap
        while True:
            for system_id, vehicle in tuple(self._vehicles.items()):
                self._flight_watch(vehicle)  # starts to watch a new vehicle
                position = vehicle.position.latest
                if position is None or vehicle.position.age > TRACK_GAP_S:
                    interrupted.add(system_id)
                    continue
                track = self._tracks.setdefault(system_id, [])
                if track and track[-1].position.distance_to(position) < MIN_TRACK_STEP_M:
                    continue
                if len(track) >= MAX_TRACK_POINTS:
                    _thin_out(track)
                track.append(_TrackPoint(position, is_after_gap=system_id in interrupted))
                interrupted.discard(system_id)
            await anyio.sleep(TRACK_INTERVAL_S)

    async def _request_arming_checks(self) -> None:
        while True:
            for vehicle in tuple(self._vehicles.values()):
                if self._arming_checks.claim_if_due(vehicle):
                    self._background.start(partial(run_arming_checks, vehicle), "aerokit serve check")
            await anyio.sleep(TRACK_INTERVAL_S)

    def _state_of(self, vehicle: Vehicle) -> dict[str, Any]:
        watch = self._flight_watch(vehicle)
        missing = vehicle.missing_for_flight()
        is_connected = vehicle.link_state.latest is LinkState.CONNECTED
        unread_parameters = []
        if watch.disarm_parameter is not None and watch.disarm_delay_s is None:
            unread_parameters.append(watch.disarm_parameter)
        return {
            **overview(vehicle),
            "missing_for_flight": missing,
            "not_armable": arm_refusals(vehicle, missing),
            # `self.crash` is None for a silent vehicle, because it may have moved. The page shows its last known crash.
            "crash": self.crash(vehicle) if is_connected else watch.crash,
            "disarming": watch.disarming,
            "disarm_parameter": watch.disarm_parameter,
            "disarm_delay_s": watch.disarm_delay_s,
            "unread": unread_parameters,
            "return_altitude_m": known_return_altitude(vehicle.parameters, vehicle.autopilot, is_vtol=vehicle.is_vtol),
            "failsafe": ground_station_failsafe(vehicle),
            "active_failsafe": active_failsafe(vehicle),
            # This index does not count home. The state `mission_current` is the item number in MAVLink, where
            # ArduPilot's item 0 is home.
            "mission_item": vehicle.mission.current.latest,
            "mission_items": vehicle.mission.count.latest,
            "mission_version": list(vehicle.mission._version),
            "is_flying_mission": _is_flying_mission(vehicle),
            "unarmable_mode": unarmable_mode(vehicle),
        }


def _log_unexpected(error: Exception) -> None:
    # An AerokitError is not logged, because the states of the vehicle and of the link show its cause.
    if not isinstance(error, AerokitError):
        logger.error("a task of aerokit serve has failed", exc_info=error)


def _thin_out(track: list[_TrackPoint]) -> None:
    """Remove every second point of a full track. The first and the last point stay."""
    removed_and_kept = zip(track[2::2], track[3::2], strict=False)
    # A kept point takes over the mark `is_after_gap` of the removed point before it.
    track[2:] = [
        _TrackPoint(kept.position, is_after_gap=kept.is_after_gap or removed.is_after_gap)
        for removed, kept in removed_and_kept
    ]


async def _read_return_altitude(vehicle: Vehicle) -> None:
    with suppress(AerokitError):  # after an error, the altitude stays unknown
        await vehicle.return_altitude()


def _is_flying_mission(vehicle: Vehicle) -> bool:
    """Return True if the vehicle is in its mission mode and not known to be disarmed."""
    mode = vehicle.autopilot.mode_for("mission", is_vtol=vehicle.telemetry.is_vtol)
    return mode is not None and vehicle.telemetry.is_in(mode) and not vehicle.telemetry.is_confirmed_disarmed


def ground_station_failsafe(vehicle: Vehicle) -> dict[str, Any]:
    """Return what the vehicle does after the loss of the ground station. Requests nothing.

    ``action`` is a part of a sentence, such as ``lands``, or None if it is unknown. ``because`` is the parameter that
    sets the action, with its value. If the value is not known yet, ``unread`` has the name of the parameter.
    """

    def value_of(name: str) -> float | None:
        parameter = vehicle.parameters.known(name)
        return None if parameter is None else parameter.value

    name, action = gcs_failsafe(vehicle.autopilot.firmware, value_of)
    if name is None or action is None:
        return {"action": None, "because": None, "unread": [] if name is None else [name]}
    return {"action": action, "because": f"{name} = {value_of(name):g}", "unread": []}
