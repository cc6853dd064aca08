"""The operations of the HTTP API: a table, from which the routes and the OpenAPI document are made."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from starlette.responses import Response

from aerokit import __version__
from aerokit._internal.plain import plain
from aerokit.apps.serve.orders import ORDERS, SET_PARAMETER, Given, OrderKind, Orders
from aerokit.apps.serve.requests import (
    Problem,
    body_of,
    is_asked,
    json_response,
    problem_response,
    seen_at,
    system_id_of,
)
from aerokit.errors import ParameterRejected
from aerokit.vehicle.vehicle import overview

if TYPE_CHECKING:
    from collections.abc import Iterable

    from starlette.requests import Request

    from aerokit.apps.serve.guard import Keys
    from aerokit.apps.serve.orders import Argument
    from aerokit.apps.serve.watch import Watch
    from aerokit.missions import Mission
    from aerokit.vehicle.vehicle import Vehicle

_ABOUT = """State, missions, parameters and orders of vehicles that speak MAVLink (docs/serve.md of aerokit).

Fields have their units in their names; what a vehicle has not told is missing or null, never 0. An order is awaited:
its answer says that the vehicle has done it, or why not. It runs on when the client goes away. `Idempotency-Key`
makes it safe to ask again: an order is given once."""

_QUERY = {
    "refresh": "ask the vehicle again, instead of what is known; needs the token",
    "wait": "false: answer 202 at once when the order is under way; its result comes on the stream and at /api/orders",
}

_FAILURES = {
    "400": "wrong arguments; nothing was sent",
    "401": "the token is missing or wrong",
    "403": "orders are switched off, or the page of another site asks",
    "404": "no such vehicle has been heard, or there is nothing of that name",
    "409": "the vehicle refused, somebody else took over, or it is busy",
    "413": "the body is too large",
    "415": "the body is no JSON",
    "503": "the vehicle is silent, or the link has gone",
    "504": "not done in time",
}

_HEADERS = (
    (
        "Idempotency-Key",
        True,
        "string",
        "of this order alone, 8 to 64 characters; asked again, it is not given again",
    ),
    (
        "Aerokit-Seen-At",
        False,
        "number",
        "at_s of the state on the stream that the order is given upon: refused when old",
    ),
)


def document(operations: Iterable[Operation], root_path: str = "") -> dict[str, Any]:
    """The document; ``root_path`` is where the application is mounted."""
    paths: dict[str, Any] = {}
    for operation in operations:
        paths.setdefault(operation.path, {})[operation.method.lower()] = _operation(operation)
    paths["/api/stream"] = {"get": _stream()}
    return {
        "openapi": "3.1.0",
        "info": {"title": "aerokit serve", "version": __version__, "description": _ABOUT},
        "servers": [{"url": root_path or "/"}],
        "paths": paths,
        "components": {
            "schemas": {"Problem": _PROBLEM, "Order": _ORDER},
            "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}},
        },
    }


def _operation(operation: Operation) -> dict[str, Any]:
    is_order = operation.order is not None
    answer = {"$ref": "#/components/schemas/Order"} if is_order else {"type": "object"}
    found: dict[str, Any] = {
        "operationId": operation.name,
        "summary": operation.summary,
        "parameters": [*_parameters(operation)],
        "responses": {
            "200": {"description": "done" if is_order else "what is known", "content": _json(answer)},
            **_failures(operation),
        },
    }
    if not operation.is_open:
        found["security"] = [{"token": []}] if is_order else [{"token": []}, {}]
    if operation.order is not None:
        found["responses"]["202"] = {"description": "under way (wait=false)", "content": _json(answer)}
        found["requestBody"] = {
            "required": any(each.is_required for each in operation.order.arguments.values()),
            "content": _json(_body(operation.order)),
        }
    return found


def _parameters(operation: Operation) -> Iterable[dict[str, Any]]:
    for name in re.findall(r"{(\w+)}", operation.path):
        schema = (
            {"type": "integer", "minimum": 1, "maximum": 255} if name == "system_id" else {"type": "string"}
        )
        yield {"name": name, "in": "path", "required": True, "schema": schema}
    for name in operation.query:
        schema = {"type": "boolean"}
        yield {"name": name, "in": "query", "description": _QUERY[name], "schema": schema}
    for name, is_required, kind, text in _HEADERS if operation.order is not None else ():
        yield {
            "name": name,
            "in": "header",
            "required": is_required,
            "description": text,
            "schema": {"type": kind},
        }


def _failures(operation: Operation) -> dict[str, Any]:
    if operation.is_open:
        return {}
    left_out = set() if operation.order is not None else {"413", "415"}
    problem = {"application/problem+json": {"schema": {"$ref": "#/components/schemas/Problem"}}}
    return {
        status: {"description": text, "content": problem}
        for status, text in _FAILURES.items()
        if status not in left_out
    }


def _body(kind: OrderKind) -> dict[str, Any]:
    return {
        "type": "object",
        "properties": {name: _schema(each) for name, each in kind.arguments.items()},
        "required": [name for name, each in kind.arguments.items() if each.is_required],
        "additionalProperties": False,
    }


def _schema(argument: Argument) -> dict[str, Any]:
    kind = argument.type if isinstance(argument.type, str) else list(argument.type)
    return {"type": kind, "description": argument.text}


def _json(schema: dict[str, Any]) -> dict[str, Any]:
    return {"application/json": {"schema": schema}}


def _stream() -> dict[str, Any]:
    return {
        "operationId": "stream",
        "summary": "WebSocket: JSON messages hello, state, event, order",
        "description": "Subprotocol aerokit.v1; browsers give the token as a second one, bearer.TOKEN. A slow client"
        " gets the newest state; of events, `missed` says how many it did not get.",
        "parameters": [
            {
                "name": "rate_hz",
                "in": "query",
                "description": "states per second, 0.1 to 20 (5)",
                "schema": {"type": "number", "minimum": 0.1, "maximum": 20},
            }
        ],
        "security": [{"token": []}, {}],
        "responses": {"101": {"description": "the WebSocket is open"}},
    }


_PROBLEM: dict[str, Any] = {
    "type": "object",
    "description": "RFC 9457; `error` is the kind of failure, `reasons` what the vehicle gave for it.",
    "required": ["type", "title", "status", "detail", "error"],
    "properties": {
        "type": {"type": "string"},
        "title": {"type": "string"},
        "status": {"type": "integer"},
        "detail": {"type": "string"},
        "error": {"type": "string"},
        "reasons": {"type": "array", "items": {"type": "string"}},
        "order": {"$ref": "#/components/schemas/Order"},
    },
}

_ORDER: dict[str, Any] = {
    "type": "object",
    "required": ["key", "system_id", "order", "arguments", "given_unix_s", "state"],
    "properties": {
        "key": {"type": "string"},
        "system_id": {"type": "integer"},
        "order": {"type": "string"},
        "arguments": {"type": "object"},
        "given_unix_s": {"type": "number"},
        "state": {"enum": ["running", "done", "failed"]},
        "result": {},
        "problem": {"anyOf": [{"$ref": "#/components/schemas/Problem"}, {"type": "null"}]},
    },
}

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
