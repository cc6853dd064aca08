"""What requests bring: bodies of bounded size, and the values in them, checked."""

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

_STATUS: tuple[tuple[type[Exception], int], ...] = (
    (InvalidArgument, 400),
    (HeartbeatTimeout, 503),
    (LinkError, 503),
    (ConnectionClosed, 503),
    (OperationTimeout, 504),
    (OperationRejected, 409),
    (BusyError, 409),
    (ValueUnknownError, 409),
    (RemoteProtocolError, 502),
)
"""The first that fits counts, as for the exit codes of the command line."""


class Problem(Exception):
    """A request that is answered by a problem object; ``kind`` is a word for programs."""

    def __init__(self, status: int, kind: str, text: str, headers: dict[str, str] | None = None) -> None:
        super().__init__(text)
        self.status: int = status
        self.kind: str = kind
        self.headers: dict[str, str] | None = headers


def problem_of(error: Exception) -> dict[str, Any]:
    """``error`` (the kind), ``status``, ``title``, ``detail``, and ``reasons`` where the vehicle gave some."""
    if isinstance(error, Problem):
        status, kind = error.status, error.kind
    else:
        kind = type(error).__name__
        status = next((status for each, status in _STATUS if isinstance(error, each)), 500)
    is_known = isinstance(error, (AerokitError, Problem))
    found: dict[str, Any] = {
        "type": "about:blank",
        "title": kind,
        "status": status,
        "error": kind,
        "detail": str(error) if is_known else "a mistake in the server; its log has more",
    }
    if reasons := getattr(error, "reasons", ()):
        found["reasons"] = list(reasons)
    return found


def problem_response(error: Exception, **more: object) -> Response:
    """The answer to a request that failed by this error."""
    found = {**problem_of(error), **more}
    headers = error.headers if isinstance(error, Problem) else None
    return json_response(found, found["status"], "application/problem+json", headers)


def json_response(
    value: object,
    status: int = 200,
    media_type: str = "application/json",
    headers: dict[str, str] | None = None,
) -> Response:
    """An answer that nobody keeps: what it says is true now."""
    text = json.dumps(value, ensure_ascii=False, allow_nan=False)
    return Response(text, status, {"Cache-Control": "no-store", **(headers or {})}, media_type)


LARGEST_BODY = 16_384

BODY_TIMEOUT_S = 10.0


async def body_of(request: Request) -> dict[str, Any]:
    """The JSON object in the body; an empty one when there is no body.

    Raises:
        Problem: 400 no JSON object, 408 it does not come, 413 it is too large, 415 it says that it is something else.
    """
    try:
        data = await asyncio.wait_for(_read(request), BODY_TIMEOUT_S)
    except asyncio.TimeoutError:
        raise Problem(408, "BodyTimeout", "the body did not come; nothing was sent") from None
    if not data:
        return {}
    if request.headers.get("content-type", "").partition(";")[0].strip().lower() != "application/json":
        raise Problem(415, "NotJson", "a body has Content-Type: application/json; nothing was sent")
    try:
        found = json.loads(data, parse_constant=_refuse, object_pairs_hook=_object)
        json.dumps(
            found, ensure_ascii=False, allow_nan=False
        ).encode()  # 1e999 and half a character are told to nobody
    except (ValueError, RecursionError) as error:
        raise Problem(400, "NotJson", f"the body is no JSON: {error}; nothing was sent") from None
    if not isinstance(found, dict):
        raise Problem(400, "NotJson", "the body is no JSON object; nothing was sent")
    return found


async def _read(request: Request) -> bytes:
    data = bytearray()
    async for part in request.stream():
        data += part
        if len(data) > LARGEST_BODY:
            raise Problem(413, "TooLarge", f"a body has at most {LARGEST_BODY} bytes; nothing was sent")
    return bytes(data)


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is no number of JSON")


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a name stands in an object twice")
    return found


def is_asked(request: Request, name: str, *, default: bool) -> bool:
    """A query parameter that is true or false."""
    text = request.query_params.get(name, "true" if default else "false")
    if text not in ("true", "false"):
        raise Problem(400, "WrongQuery", f"{name} is true or false")
    return text == "true"


def seen_at(request: Request) -> float | None:
    """The ``at_s`` of the state that the giver of an order had before him, if he says so."""
    text = request.headers.get("aerokit-seen-at")
    if text is None:
        return None
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise Problem(400, "WrongHeader", "Aerokit-Seen-At is the at_s of a state message; nothing was sent")
    return value


def system_id_of(request: Request) -> int:
    """Which vehicle is meant."""
    text = request.path_params["system_id"]
    if not (text.isascii() and text.isdigit() and len(text) <= 3 and 1 <= int(text) <= 255):
        raise Problem(404, "NotHeard", "a vehicle's id is a number from 1 to 255; nothing was sent")
    return int(text)
