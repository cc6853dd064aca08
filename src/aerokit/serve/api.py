"""The operations of the HTTP API: a table, from which the routes and the OpenAPI document are made."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from starlette.responses import Response

from aerokit import __version__
from aerokit.errors import ParameterRejected
from aerokit.plain import plain
from aerokit.serve.openapi import document
from aerokit.serve.orders import ORDERS, SET_PARAMETER, Given, OrderKind, Orders
from aerokit.serve.problems import Problem, json_response, problem_response
from aerokit.serve.requests import body_of, is_asked, seen_at, system_id_of
from aerokit.vehicle.overview import overview

if TYPE_CHECKING:
    from starlette.requests import Request

    from aerokit.missions import Mission
    from aerokit.serve.guard import Keys
    from aerokit.serve.watch import Watch
    from aerokit.vehicle.vehicle import Vehicle

__all__ = ["Api", "Operation"]

Handler = Callable[["Request"], Awaitable[Response]]

AT_ONCE_S = 0.2
"""What is refused without asking the vehicle is told in the answer, also when that is not to wait."""


@dataclass(frozen=True)
class Operation:
    """One method of one path; ``name`` is its operationId. ``order``: what its body is."""

    method: str
    path: str
    name: str
    summary: str
    handler: Handler
    order: OrderKind | None = None
    query: tuple[str, ...] = ()
    is_open: bool = False
    """Whether it is answered without a token: it says nothing of vehicles."""


class Api:
    """Answers requests from what is known, and gives orders."""

    def __init__(self, watch: Watch, orders: Orders, keys: Keys, settings: dict[str, Any]) -> None:
        self._watch, self._orders, self._keys, self._settings = watch, orders, keys, settings
        self._locks: dict[Vehicle, asyncio.Lock] = {}
        self._missions: dict[Vehicle, tuple[Mission, float]] = {}

    def operations(self) -> tuple[Operation, ...]:
        """All of them."""
        one, named = "/api/vehicles/{system_id}", "/api/vehicles/{system_id}/parameters/{name}"
        get = partial(Operation, "GET")
        return (
            get("/api", "about", "Version and settings of this server", self._about, is_open=True),
            get("/api/openapi.json", "openapi", "This document", self._openapi, is_open=True),
            get("/api/vehicles", "vehicles", "The vehicles that have been heard", self._list),
            get(one, "vehicle", "All that is known of a vehicle, with ages", self._vehicle),
            get(f"{one}/texts", "texts", "What it has said, the newest last", self._texts),
            get(f"{one}/mission", "mission", "Its mission", self._mission, query=("refresh",)),
            get(
                f"{one}/parameters", "parameters", "All its parameters", self._parameters, query=("refresh",)
            ),
            get(named, "parameter", "One parameter, asked of it now", self._parameter),
            get("/api/events", "events", "The last events, the newest last", self._events),
            get("/api/orders", "orders", "Orders and what came of them, the newest last", self._list_orders),
            get("/api/orders/{key}", "order", "One order, by its Idempotency-Key", self._order),
            *(self._order_operation("POST", f"{one}/{kind.name}", kind) for kind in ORDERS),
            self._order_operation("PUT", named, SET_PARAMETER),
        )

    def endpoint(self, operation: Operation) -> Handler:
        """The operation as Starlette calls it: nobody gets in without the token that it needs."""

        async def answer(request: Request) -> Response:
            try:
                if not operation.is_open:
                    self._keys.check(request.headers, is_order=operation.order is not None)
                return await operation.handler(request)
            except Exception as error:
                answer = problem_response(error)
                if answer.status_code == 500:
                    raise
                return answer

        return answer

    def _order_operation(self, method: str, path: str, kind: OrderKind) -> Operation:
        name = kind.name.replace("/", "_")
        return Operation(method, path, name, kind.summary, partial(self._give, kind), kind, ("wait",))

    # ------------------------------------------------------------------------------------- reading

    async def _about(self, request: Request) -> Response:
        return json_response({"aerokit": __version__, **self._settings})

    async def _openapi(self, request: Request) -> Response:
        return json_response(document(self.operations(), request.scope.get("root_path", "")))

    async def _list(self, request: Request) -> Response:
        return json_response({"vehicles": [_summary(each) for each in self._watch.vehicles.values()]})

    async def _vehicle(self, request: Request) -> Response:
        vehicle = self._vehicle_of(request)
        known = vehicle.autopilot.modes.names
        modes = [*known, *(name for name in vehicle.telemetry.mode_names.values() if name not in known)]
        return json_response({**overview(vehicle), "modes": modes})

    async def _texts(self, request: Request) -> Response:
        return json_response({"texts": self._watch.texts(self._vehicle_of(request).system_id)})

    async def _mission(self, request: Request) -> Response:
        vehicle, is_new = self._vehicle_of(request), self._is_refresh(request)
        async with self._lock(vehicle):
            if is_new or not self._has_mission(vehicle):
                self._missions[vehicle] = (await vehicle.mission.download(), vehicle.connection.now())
            mission, read_at = self._missions[vehicle]
        items = [
            {"index": index, "name": item.name, "position": plain(item.position), **plain(item)}
            for index, item in enumerate(mission)
        ]
        age_s = plain(vehicle.connection.now() - read_at)
        return json_response({"items": items, "current": vehicle.mission.current.latest, "age_s": age_s})

    def _has_mission(self, vehicle: Vehicle) -> bool:
        """Whether it was read, and has as many items still; another station may have changed them all the same."""
        mission, _ = self._missions.get(vehicle, (None, 0.0))
        count = vehicle.mission.count.latest
        return mission is not None and count in (None, len(mission))

    async def _parameters(self, request: Request) -> Response:
        vehicle, is_new = self._vehicle_of(request), self._is_refresh(request)
        async with self._lock(vehicle):
            table = await vehicle.parameters.download(refresh=is_new)
        return json_response({"parameters": [plain(table[name]) for name in sorted(table)]})

    async def _parameter(self, request: Request) -> Response:
        vehicle = self._vehicle_of(request)
        try:
            return json_response(plain(await vehicle.parameters.read(request.path_params["name"])))
        except ParameterRejected as error:
            raise Problem(404, "ParameterRejected", str(error)) from None

    async def _events(self, request: Request) -> Response:
        return json_response({"events": list(self._watch.events)})

    async def _list_orders(self, request: Request) -> Response:
        return json_response({"orders": [each.record() for each in self._orders.all()]})

    async def _order(self, request: Request) -> Response:
        return json_response(self._orders.get(request.path_params["key"]).record())

    # -------------------------------------------------------------------------------------- orders

    async def _give(self, kind: OrderKind, request: Request) -> Response:
        vehicle = self._vehicle_of(request)
        waits, arguments = is_asked(request, "wait", default=True), await body_of(request)
        kind.check(arguments)
        if kind is SET_PARAMETER:
            arguments["name"] = request.path_params["name"]
        key = request.headers.get("idempotency-key", "").strip().strip('"')
        given = self._orders.give(vehicle, kind, arguments, key, seen_at(request))
        await _ended(given, None if waits else AT_ONCE_S)
        if given.problem is not None:
            return json_response(
                {**given.problem, "order": given.record()},
                given.problem["status"],
                "application/problem+json",
            )
        return json_response(given.record(), 200 if given.state == "done" else 202)

    # -------------------------------------------------------------------------------------- inside

    def _vehicle_of(self, request: Request) -> Vehicle:
        return self._watch.vehicle(system_id_of(request))

    def _is_refresh(self, request: Request) -> bool:
        """What is asked of the vehicle once more costs its link something: only who may order it may have it."""
        is_new = is_asked(request, "refresh", default=False)
        if is_new:
            self._keys.check(request.headers, needs_token=True)
        return is_new

    def _lock(self, vehicle: Vehicle) -> asyncio.Lock:
        """One transfer at a time, whose result all get who asked."""
        return self._locks.setdefault(vehicle, asyncio.Lock())


async def _ended(given: Given, timeout_s: float | None) -> None:
    waiting = asyncio.ensure_future(given.ended.wait())
    try:
        await asyncio.wait((waiting,), timeout=timeout_s)
    finally:
        waiting.cancel()


def _summary(vehicle: Vehicle) -> dict[str, Any]:
    known = overview(vehicle)
    states = known.pop("states")
    return {**known, "mode": states.get("mode"), "armed": states.get("armed")}
