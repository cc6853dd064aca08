"""The OpenAPI document (3.1) of the operations."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

from aerokit import __version__

if TYPE_CHECKING:
    from collections.abc import Iterable

    from aerokit.serve.api import Operation
    from aerokit.serve.orders import Argument, OrderKind

__all__ = ["document"]

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
