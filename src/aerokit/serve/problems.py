"""Errors as JSON problem objects (RFC 9457), with the HTTP status of their kind."""

from __future__ import annotations

import json
from typing import Any

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

__all__ = ["Problem", "json_response", "problem_of", "problem_response"]

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
