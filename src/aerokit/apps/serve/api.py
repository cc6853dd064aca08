"""The HTTP API: a table of operations, from which the routes and the OpenAPI document are made."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from starlette.responses import Response

from aerokit import __version__
from aerokit._internal.formatting import to_jsonable
from aerokit.apps.serve.orders import (
    ORDERS,
    SET_PARAMETER,
    UPLOAD,
    OrderRecord,
    OrderRunner,
    OrderType,
    check_parameter,
    parameter_order,
    parse_plan_body,
)
from aerokit.apps.serve.requests import (
    HttpProblem,
    json_response,
    problem_response,
    query_flag,
    read_body,
    seen_at,
    system_id_of,
)
from aerokit.errors import ParameterRejected
from aerokit.mavlink.enums import EkfStatusFlags, EstimatorStatusFlags, MavPowerStatus, MavSysStatusSensor
from aerokit.parameters.renames import other_names
from aerokit.vehicle.vehicle import overview

if TYPE_CHECKING:
    from collections.abc import Iterable

    from starlette.requests import Request

    from aerokit.apps.serve.guard import AccessControl
    from aerokit.apps.serve.orders import OrderArgument
    from aerokit.apps.serve.served_vehicles import ServedVehicles
    from aerokit.missions import Fence, Mission, MissionItem, RallyPoints
    from aerokit.parameters import Metadata, Parameter
    from aerokit.vehicle.missions.context import PlanVersion
    from aerokit.vehicle.vehicle import Vehicle

_ABOUT = """State, missions, parameters and orders of MAVLink vehicles (docs/serve.md of aerokit).

Field names contain the units. Unknown values are missing or null, never 0. A request with an order waits until the
vehicle has executed it or failed; the order continues if the client disconnects. With the same `Idempotency-Key` a
request can be repeated safely: the order runs once."""

_QUERY = {
    "refresh": "true: read from the vehicle again; needs the token",
    "wait": "false: return 202 as soon as the order runs; its result is on the stream and at /api/orders",
}

_FAILURES = {
    "400": "wrong arguments; nothing was sent",
    "401": "the token is missing or wrong",
    "403": "the server is read-only, or the request comes from a page of another site",
    "404": "no such vehicle or resource",
    "409": "the vehicle refused or is busy, or another party took control",
    "413": "the body is too large",
    "415": "the body is not JSON",
    "503": "the vehicle is silent, or the link is lost",
    "504": "timed out",
}

# The request headers of orders: name, whether it is required, type and description.
_HEADERS = (
    (
        "Idempotency-Key",
        True,
        "string",
        "unique key of the order, 8 to 64 characters; a repeated request does not run it again",
    ),
    (
        "Aerokit-Seen-At",
        False,
        "number",
        "at_s of the newest state message that the client has; an order is refused if that is too old",
    ),
)
_PROBLEM: dict[str, Any] = {
    "type": "object",
    "description": "RFC 9457; `error` is the class of the error, `reasons` are the vehicle's reasons.",
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
        "ended_unix_s": {"type": ["number", "null"], "description": "time of `done` or `failed`"},
        "state": {"enum": ["running", "done", "failed"]},
        "result": {},
        "problem": {"anyOf": [{"$ref": "#/components/schemas/Problem"}, {"type": "null"}]},
        "replaced_by": {
            "type": ["string", "null"],
            "description": "key of the later order of this server that replaced this one, which is then `failed`",
        },
    },
}
_METADATA = ("short_description", "description", "unit", "minimum", "maximum", "reboot_required", "read_only")
# Maps states to the names of their bits, which the page displays.
_BITS = {
    state: {str(int(bit)): str(bit.name) for bit in flags}
    for state, flags in {
        "sensors": MavSysStatusSensor,
        "power": MavPowerStatus,
        "EKF_STATUS_REPORT": EkfStatusFlags,
        "ESTIMATOR_STATUS": EstimatorStatusFlags,
    }.items()
}
# With wait=false, the server responds after this time, or as soon as the order is refused.
_REFUSAL_TIMEOUT_S = 0.2


def document(operations: Iterable[Operation], root_path: str = "") -> dict[str, Any]:
    """Return the OpenAPI document. ``root_path`` is the path at which the application is mounted."""
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
    description: dict[str, Any] = {
        "operationId": operation.name,
        "summary": operation.summary,
        "parameters": [*_parameters(operation)],
        "responses": {
            "200": {"description": "done" if is_order else "the current values", "content": _json_content(answer)},
            **_failures(operation),
        },
    }
    if not operation.is_open:
        # In OpenAPI, {} means that a request without a token may be allowed, too.
        description["security"] = [{"token": []}] if is_order else [{"token": []}, {}]
    if is_order:
        description["responses"]["202"] = {"description": "running (wait=false)", "content": _json_content(answer)}
    order_type = operation.order or operation.body_type
    if order_type is not None:
        description["requestBody"] = {
            "required": any(argument.is_required for argument in order_type.arguments.values()),
            "content": _json_content(_body_schema(order_type)),
        }
    return description


def _parameters(operation: Operation) -> Iterable[dict[str, Any]]:
    for name in re.findall(r"{(\w+)}", operation.path):
        schema = {"type": "integer", "minimum": 1, "maximum": 255} if name == "system_id" else {"type": "string"}
        yield {"name": name, "in": "path", "required": True, "schema": schema}
    for name in operation.query:
        schema = {"type": "boolean"}
        yield {"name": name, "in": "query", "description": _QUERY[name], "schema": schema}
    if operation.order is None:
        return
    for name, is_required, json_type, text in _HEADERS:
        yield {
            "name": name,
            "in": "header",
            "required": is_required,
            "description": text,
            "schema": {"type": json_type},
        }


def _failures(operation: Operation) -> dict[str, Any]:
    if operation.is_open:
        return {}
    # Without a request body, the statuses 413 and 415 cannot occur.
    impossible = set() if operation.order or operation.body_type else {"413", "415"}
    problem = {"application/problem+json": {"schema": {"$ref": "#/components/schemas/Problem"}}}
    return {
        status: {"description": text, "content": problem}
        for status, text in _FAILURES.items()
        if status not in impossible
    }


def _body_schema(order_type: OrderType) -> dict[str, Any]:
    arguments = order_type.arguments
    return {
        "type": "object",
        "properties": {name: _argument_schema(argument) for name, argument in arguments.items()},
        "required": [name for name, argument in arguments.items() if argument.is_required],
        "additionalProperties": False,
    }


def _argument_schema(argument: OrderArgument) -> dict[str, Any]:
    json_type = argument.type if isinstance(argument.type, str) else list(argument.type)
    return {"type": json_type, "description": argument.text}


def _json_content(schema: dict[str, Any]) -> dict[str, Any]:
    return {"application/json": {"schema": schema}}


def _stream() -> dict[str, Any]:
    return {
        "operationId": "stream",
        "summary": "WebSocket: JSON messages hello, state, event, order",
        "description": "Subprotocol aerokit.v1; browsers pass the token as a second one, bearer.TOKEN. A slow client"
        " gets the newest state; `missed` counts the events that were dropped.",
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


Handler = Callable[["Request"], Awaitable[Response]]


@dataclass(frozen=True)
class Operation:
    """One HTTP method of one path.

    ``name`` is the operationId. ``order`` is the type of order that the operation gives to a vehicle. An operation that
    only checks the arguments of an order has ``body_type`` instead.
    """

    method: str
    path: str
    name: str
    summary: str
    handler: Handler
    order: OrderType | None = None
    body_type: OrderType | None = None
    query: tuple[str, ...] = ()
    is_open: bool = False
    """True if the operation needs no token, because it reveals nothing about vehicles."""


@dataclass(frozen=True)
class _Download:
    plan: Mission | Fence | RallyPoints
    received_at: float
    version: PlanVersion

    def is_outdated(self, version: PlanVersion, count: int | None) -> bool:
        """Return True if the plan's version has changed, or the vehicle reports another number of items."""
        return version != self.version or count not in (None, len(self.plan.to_items()))


class HttpApi:
    def __init__(
        self,
        served: ServedVehicles,
        orders: OrderRunner,
        access: AccessControl,
        settings: dict[str, Any],
        metadata: Metadata | None = None,
    ) -> None:
        self._served = served
        self._orders = orders
        self._access = access
        self._settings = settings
        self._metadata = metadata
        self._locks: dict[Vehicle, asyncio.Lock] = {}
        # The last download of each vehicle's mission, fence and rally points.
        self._downloads: dict[tuple[Vehicle, str], _Download] = {}
        served.listen(self._on_message)

    def operations(self) -> tuple[Operation, ...]:
        path = "/api/vehicles/{system_id}"
        parameter_path = f"{path}/parameters/{{name}}"
        refresh = ("refresh",)
        get = partial(Operation, "GET")
        return (
            get("/api", "about", "Version and settings of this server", self._about, is_open=True),
            get("/api/openapi.json", "openapi", "This document", self._openapi, is_open=True),
            get("/api/vehicles", "vehicles", "All vehicles", self._list),
            get(path, "vehicle", "The state of a vehicle, with ages", self._vehicle),
            get(f"{path}/texts", "texts", "The status texts of a vehicle, the newest last", self._texts),
            get(f"{path}/track", "track", "The recent track of a vehicle, the newest position last", self._track),
            get(f"{path}/mission", "mission", "The mission of a vehicle", self._mission, query=refresh),
            get(f"{path}/fence", "fence", "The fence of a vehicle", self._fence, query=refresh),
            get(f"{path}/rally", "rally", "The rally points of a vehicle", self._rally, query=refresh),
            get(f"{path}/parameters", "parameters", "All parameters of a vehicle", self._parameters, query=refresh),
            get(parameter_path, "parameter", "One parameter, read from the vehicle", self._parameter),
            get("/api/events", "events", "Recent events, the newest last", self._events),
            get("/api/orders", "orders", "Orders and their results, the newest last", self._list_orders),
            get("/api/orders/{key}", "order", "One order, by its Idempotency-Key", self._order),
            Operation("POST", "/api/plan", "plan", "Check a plan; sends nothing", self._check_plan, body_type=UPLOAD),
            *(self._order_operation("POST", f"{path}/{order_type.name}", order_type) for order_type in ORDERS),
            self._order_operation("PUT", parameter_path, SET_PARAMETER),
        )

    def endpoint(self, operation: Operation) -> Handler:
        async def answer(request: Request) -> Response:
            try:
                if not operation.is_open:
                    self._access.check(request.headers, is_order=operation.order is not None)
                return await operation.handler(request)
            except Exception as error:
                response = problem_response(error)
                if response.status_code == 500:
                    raise  # Starlette logs the error, and sends the response of `_server_error`
                return response

        return answer

    def _order_operation(self, method: str, path: str, order_type: OrderType) -> Operation:
        return Operation(
            method,
            path,
            name=order_type.name.replace("/", "_"),
            summary=order_type.summary,
            handler=partial(self._run_order, order_type),
            order=order_type,
            query=("wait",),
        )

    async def _about(self, request: Request) -> Response:
        return json_response({"aerokit": __version__, "bits": _BITS, **self._settings})

    async def _openapi(self, request: Request) -> Response:
        return json_response(document(self.operations(), request.scope.get("root_path", "")))

    async def _list(self, request: Request) -> Response:
        return json_response({"vehicles": [_summary(vehicle) for vehicle in self._served.vehicles.values()]})

    async def _vehicle(self, request: Request) -> Response:
        vehicle = self._vehicle_of(request)
        # A vehicle may report modes that its firmware does not have by default.
        names = dict.fromkeys([*vehicle.autopilot.modes.names, *vehicle.telemetry.mode_names.values()])
        unselectable = vehicle.autopilot.unselectable_modes
        return json_response({**overview(vehicle), "modes": [name for name in names if name not in unselectable]})

    async def _texts(self, request: Request) -> Response:
        return json_response({"texts": self._served.texts(self._vehicle_of(request).system_id)})

    async def _track(self, request: Request) -> Response:
        return json_response({"points": self._served.track(self._vehicle_of(request).system_id)})

    async def _mission(self, request: Request) -> Response:
        mission, age_s = await self._plan(request, "mission")
        control = self._vehicle_of(request).mission
        place = {"current": control.current.latest, "version": list(control._version)}
        return json_response({"items": _items(mission), "age_s": age_s, **place})

    async def _fence(self, request: Request) -> Response:
        fence, age_s = await self._plan(request, "fence")
        return json_response({**to_jsonable(fence), "age_s": age_s})

    async def _rally(self, request: Request) -> Response:
        rally, age_s = await self._plan(request, "rally")
        return json_response({"items": _items(rally), "age_s": age_s})

    async def _plan(self, request: Request, kind: str) -> tuple[Any, float]:
        """Return the mission, fence or rally points of a vehicle, and their age in seconds."""
        vehicle, is_refresh = self._vehicle_of(request), self._is_refresh(request)
        async with self._transfer_lock(vehicle):
            download = self._downloads.get((vehicle, kind))
            control = getattr(vehicle, kind)
            count = vehicle.mission.count.latest if kind == "mission" else None
            if download is None or is_refresh or download.is_outdated(control._version, count):
                plan = await control.download()
                download = _Download(plan, vehicle.connection.now(), control._version)
                self._downloads[vehicle, kind] = download
        return download.plan, to_jsonable(vehicle.connection.now() - download.received_at)

    def _on_message(self, message: dict[str, Any]) -> None:
        # Drop the stored downloads even if the upload failed, because it may have changed plans on the vehicle.
        if message["type"] == "order" and message["order"] == "mission/upload":
            for vehicle, kind in tuple(self._downloads):
                if vehicle.system_id == message["system_id"]:
                    del self._downloads[vehicle, kind]

    async def _check_plan(self, request: Request) -> Response:
        self._access.check(request.headers, needs_token=True)  # before parsing, which takes long for large plans
        arguments = await read_body(request, UPLOAD.max_body_size)
        UPLOAD.check(arguments)
        _, _, plan = parse_plan_body(arguments)
        checked = {
            "mission_items": len(plan.mission),
            "fence_areas": len(plan.fence.polygons) + len(plan.fence.circles),
            "rally_points": len(plan.rally),
            "items": _items(plan.mission),
            "fence": to_jsonable(plan.fence),
            "rally": _items(plan.rally),
        }
        return json_response(checked)

    async def _parameters(self, request: Request) -> Response:
        vehicle = self._vehicle_of(request)
        is_refresh = self._is_refresh(request)
        # A recording needs PARAM_VALUE messages, because reports do not read parameters from MAVFTP.
        is_recorded = vehicle.connection._observers.recording is not None
        async with self._transfer_lock(vehicle):
            table = await vehicle.parameters.download(method="list" if is_recorded else "auto", refresh=is_refresh)
        metadata = self._metadata_of(vehicle)
        return json_response({"parameters": [_parameter(table[name], metadata) for name in sorted(table)]})

    async def _parameter(self, request: Request) -> Response:
        vehicle = self._vehicle_of(request)
        try:
            return json_response(to_jsonable(await vehicle.parameters.read(request.path_params["name"])))
        except ParameterRejected as error:
            raise HttpProblem(404, "ParameterRejected", str(error)) from None

    async def _events(self, request: Request) -> Response:
        return json_response({"events": list(self._served.events)})

    async def _list_orders(self, request: Request) -> Response:
        return json_response({"orders": [record.to_dict() for record in self._orders.all()]})

    async def _order(self, request: Request) -> Response:
        return json_response(self._orders.get(request.path_params["key"]).to_dict())

    async def _run_order(self, order_type: OrderType, request: Request) -> Response:
        vehicle = self._vehicle_of(request)
        waits = query_flag(request, "wait", default=True)
        arguments = await read_body(request, order_type.max_body_size)
        order_type.check(arguments)
        if order_type is SET_PARAMETER:
            arguments["name"] = request.path_params["name"]
            metadata = self._metadata_of(vehicle)
            check_parameter(metadata, arguments)
            order_type = parameter_order(metadata)
        key = request.headers.get("idempotency-key", "").strip().strip('"')
        record = self._orders.submit(vehicle, order_type, arguments, key, seen_at(request))
        await _wait_until_ended(record, None if waits else _REFUSAL_TIMEOUT_S)
        if record.problem is not None:
            return json_response(
                {**record.problem, "order": record.to_dict()}, record.problem["status"], "application/problem+json"
            )
        return json_response(record.to_dict(), 200 if record.state == "done" else 202)

    def _vehicle_of(self, request: Request) -> Vehicle:
        return self._served.vehicle(system_id_of(request))

    def _metadata_of(self, vehicle: Vehicle) -> Metadata | None:
        return vehicle.parameters.metadata or self._metadata

    def _is_refresh(self, request: Request) -> bool:
        is_refresh = query_flag(request, "refresh", default=False)
        if is_refresh:
            self._access.check(request.headers, needs_token=True)
        return is_refresh

    def _transfer_lock(self, vehicle: Vehicle) -> asyncio.Lock:
        # With this lock, a request waits for a running transfer of the vehicle, and then uses its result.
        return self._locks.setdefault(vehicle, asyncio.Lock())


def _items(items: Iterable[MissionItem]) -> list[dict[str, Any]]:
    return [
        {"index": index, "name": item.name, "position": to_jsonable(item.position), **to_jsonable(item)}
        for index, item in enumerate(items)
    ]


def _parameter(parameter: Parameter, metadata: Metadata | None) -> dict[str, Any]:
    entry = None if metadata is None else metadata.get(parameter.name)
    fields = {**to_jsonable(parameter), "other_names": other_names(parameter.name)}
    if entry is None:
        return fields
    default = entry.default if parameter.default is None else parameter.default
    fields |= {name: to_jsonable(getattr(entry, name)) for name in _METADATA}
    fields |= {"default": to_jsonable(default), "meaning": entry.describe(parameter.value)}
    fields |= {"values": {str(value): text for value, text in entry.values.items()}, "has_bits": bool(entry.bitmask)}
    return fields


async def _wait_until_ended(record: OrderRecord, timeout_s: float | None) -> None:
    # Not `wait_for` or `move_on_after`: on Python 3.10 they can lose a cancellation at the time-out.
    waiting = asyncio.ensure_future(record.ended.wait())
    try:
        await asyncio.wait((waiting,), timeout=timeout_s)
    finally:
        waiting.cancel()


def _summary(vehicle: Vehicle) -> dict[str, Any]:
    summary = overview(vehicle)
    states = summary.pop("states")
    return {**summary, "mode": states.get("mode"), "armed": states.get("armed")}
