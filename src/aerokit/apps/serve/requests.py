"""Reads requests, with limited sizes and checked values, and makes JSON responses."""

from __future__ import annotations

import asyncio
import json
import math
from typing import TYPE_CHECKING, Any, NoReturn

from starlette.responses import Response

from aerokit.errors import (
    AerokitError,
    BusyError,
    ConnectionClosed,
    FileFormatError,
    HeartbeatTimeout,
    InvalidArgument,
    LinkError,
    OperationRejected,
    OperationTimeout,
    RemoteProtocolError,
    ValueUnknownError,
)

if TYPE_CHECKING:
    from starlette.requests import Request

# Maps error classes to HTTP statuses. The first class that matches an error counts.
_STATUS: tuple[tuple[type[Exception], int], ...] = (
    (InvalidArgument, 400),
    (FileFormatError, 400),
    (HeartbeatTimeout, 503),
    (LinkError, 503),
    (ConnectionClosed, 503),
    (OperationTimeout, 504),
    (OperationRejected, 409),
    (BusyError, 409),
    (ValueUnknownError, 409),
    (RemoteProtocolError, 502),
)
MAX_BODY_SIZE = 16_384
MAX_PLAN_SIZE = 1_000_000
"""Maximum size in bytes of a request body with a plan."""
BODY_TIMEOUT_S = 10.0


class HttpProblem(Exception):
    """A request failed. Clients recognise the problem by its ``kind``, which is ``error`` in the response."""

    def __init__(self, status: int, kind: str, text: str, headers: dict[str, str] | None = None) -> None:
        super().__init__(text)
        self.status: int = status
        self.kind: str = kind
        self.headers: dict[str, str] | None = headers


def problem_of(error: Exception) -> dict[str, Any]:
    """Return the problem object (RFC 9457) of an error."""
    if isinstance(error, HttpProblem):
        status, kind = error.status, error.kind
    else:
        kind = type(error).__name__
        status = next((status for error_class, status in _STATUS if isinstance(error, error_class)), 500)
    is_public = isinstance(error, (AerokitError, HttpProblem))  # the texts of other errors may reveal internals
    problem: dict[str, Any] = {
        "type": "about:blank",
        "title": kind,
        "status": status,
        "error": kind,
        "detail": str(error) if is_public else "internal server error; see the server's log",
    }
    if reasons := getattr(error, "reasons", ()):
        problem["reasons"] = list(reasons)
    return problem


def problem_response(error: Exception) -> Response:
    problem = problem_of(error)
    headers = error.headers if isinstance(error, HttpProblem) else None
    return json_response(problem, problem["status"], "application/problem+json", headers)


def json_response(
    value: object, status: int = 200, media_type: str = "application/json", headers: dict[str, str] | None = None
) -> Response:
    """Return a response with a JSON body that must not be cached."""
    text = json.dumps(value, ensure_ascii=False, allow_nan=False)
    return Response(text, status, {"Cache-Control": "no-store", **(headers or {})}, media_type)


async def read_body(request: Request, max_size: int = MAX_BODY_SIZE) -> dict[str, Any]:
    """Read the JSON object in the request body. An empty body counts as an empty object.

    Raises HttpProblem if the body is not a JSON object (400), did not arrive in time (408), is too large (413) or is
    not declared as JSON (415).
    """
    try:
        data = await asyncio.wait_for(_read_bytes(request, max_size), BODY_TIMEOUT_S)
    except asyncio.TimeoutError:
        raise HttpProblem(
            408, "BodyTimeout", f"the request body did not arrive within {BODY_TIMEOUT_S:g} s; nothing was sent"
        ) from None
    if not data:
        return {}
    if request.headers.get("content-type", "").partition(";")[0].strip().lower() != "application/json":
        raise HttpProblem(415, "NotJson", "the header Content-Type must be application/json; nothing was sent")
    try:
        body = json.loads(data, parse_constant=_refuse_constant, object_pairs_hook=_object_without_duplicates)
        # Raises for infinity (1e999) and lone surrogates, because they could not be sent to other clients.
        json.dumps(body, ensure_ascii=False, allow_nan=False).encode()
    except (ValueError, RecursionError) as error:
        raise HttpProblem(400, "NotJson", f"the request body is not valid JSON: {error}; nothing was sent") from None
    if not isinstance(body, dict):
        raise HttpProblem(400, "NotJson", "the request body is not a JSON object; nothing was sent")
    return body


async def _read_bytes(request: Request, max_size: int) -> bytes:
    data = bytearray()
    async for part in request.stream():
        data += part
        if len(data) > max_size:
            raise HttpProblem(413, "TooLarge", f"the request body is larger than {max_size} bytes; nothing was sent")
    return bytes(data)


def _refuse_constant(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is not a JSON number")


def _object_without_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result = dict(pairs)
    if len(result) < len(pairs):
        raise ValueError("an object contains the same name twice")
    return result


def query_flag(request: Request, name: str, *, default: bool) -> bool:
    text = request.query_params.get(name, "true" if default else "false")
    if text not in ("true", "false"):
        raise HttpProblem(400, "WrongQuery", f"{name} must be true or false")
    return text == "true"


def seen_at(request: Request) -> float | None:
    """Return the header Aerokit-Seen-At, the time of the client's newest state message; None without the header."""
    text = request.headers.get("aerokit-seen-at")
    if text is None:
        return None
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise HttpProblem(400, "WrongHeader", "Aerokit-Seen-At must be the at_s of a state message; nothing was sent")
    return value


def system_id_of(request: Request) -> int:
    """Return the system id in the path; raise HttpProblem 404 if it is invalid."""
    text = request.path_params["system_id"]
    if not (text.isascii() and text.isdigit() and len(text) <= 3 and 1 <= int(text) <= 255):
        raise HttpProblem(404, "UnknownVehicle", "the system id must be a number from 1 to 255; nothing was sent")
    return int(text)
