"""The WebSocket: state snapshots at a limited rate, events and results of orders as they occur."""

from __future__ import annotations

import asyncio
import json
import logging
from collections import deque
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import anyio
from starlette.websockets import WebSocketDisconnect

from aerokit.apps.serve.guard import PROTOCOL
from aerokit.apps.serve.requests import HttpProblem, problem_response

if TYPE_CHECKING:
    from starlette.websockets import WebSocket

    from aerokit.apps.serve.guard import AccessControl
    from aerokit.apps.serve.orders import OrderRunner
    from aerokit.apps.serve.served_vehicles import ServedVehicles

logger: logging.Logger = logging.getLogger("aerokit")

MAX_SOCKETS = 32
MAX_ANONYMOUS_SOCKETS = 16
"""Maximum number of WebSockets without the token, if reading without a token is allowed."""
MAX_QUEUED_MESSAGES = 256
"""Maximum number of queued messages for each client. If a queue is full, its oldest message is dropped and counted."""
MAX_HELLO_ORDERS = 50
"""Maximum number of earlier orders that a new client gets."""
SEND_TIMEOUT_S = 10.0
DEFAULT_RATE_HZ = 5.0
MAX_RATE_HZ = 20.0
MIN_RATE_HZ = 0.1


class StateStream:
    """The WebSocket endpoint ``/api/stream``.

    Clients must not send anything. Clients that do not read for 10 seconds are disconnected.
    """

    def __init__(self, served: ServedVehicles, orders: OrderRunner, access: AccessControl) -> None:
        self._served = served
        self._orders = orders
        self._access = access
        self._open: set[WebSocket] = set()
        self._anonymous: set[WebSocket] = set()

    async def endpoint(self, socket: WebSocket) -> None:
        try:
            rate_hz = self._admit(socket)
        except HttpProblem as problem:
            await _deny(socket, problem)
            return
        self._open.add(socket)
        if not self._access.has_token(socket.headers):
            self._anonymous.add(socket)
        try:
            is_requested = PROTOCOL in socket.scope.get("subprotocols", ())
            await socket.accept(PROTOCOL if is_requested else None)
            await self._serve(socket, 1 / rate_hz)
        finally:
            self._open.discard(socket)
            self._anonymous.discard(socket)

    def _admit(self, socket: WebSocket) -> float:
        """Return the client's ``rate_hz`` for state messages. Raise HttpProblem if the client is not admitted."""
        self._access.check(socket.headers)
        if len(self._open) >= MAX_SOCKETS:
            raise HttpProblem(503, "TooManySockets", f"the maximum number of clients ({MAX_SOCKETS}) is connected")
        if len(self._anonymous) >= MAX_ANONYMOUS_SOCKETS and not self._access.has_token(socket.headers):
            raise HttpProblem(
                503,
                "TooManySockets",
                f"the maximum number of clients without the token ({MAX_ANONYMOUS_SOCKETS}) is connected",
            )
        text = socket.query_params.get("rate_hz", str(DEFAULT_RATE_HZ))
        try:
            rate_hz = float(text)
        except ValueError:
            rate_hz = 0.0
        if not MIN_RATE_HZ <= rate_hz <= MAX_RATE_HZ:
            raise HttpProblem(400, "WrongRate", f"rate_hz must be a number from {MIN_RATE_HZ} to {MAX_RATE_HZ}")
        return rate_hz

    async def _serve(self, socket: WebSocket, period_s: float) -> None:
        """Send messages until the client disconnects, does not read, or sends a message itself."""
        sending = asyncio.ensure_future(self._send_messages(socket, period_s))
        receiving = asyncio.ensure_future(_receive(socket))
        tasks = {sending, receiving}
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
        failure = None if sending.cancelled() else sending.exception()
        if not receiving.cancelled() and receiving.exception() is None:
            code = 1008  # "policy violation": the client has sent a message
        elif isinstance(failure, TimeoutError):
            code = 1013  # "try again later": the client does not read
        elif receiving.cancelled() and not isinstance(failure, WebSocketDisconnect):  # the client is still connected
            logger.error("the stream of states has failed", exc_info=failure)
            code = 1011  # "internal error"
        else:
            return
        with suppress(Exception), anyio.move_on_after(1.0):  # the client may have disconnected
            await socket.close(code)

    async def _send_messages(self, socket: WebSocket, period_s: float) -> None:
        loop = asyncio.get_running_loop()
        queue: deque[dict[str, Any]] = deque()
        changed = asyncio.Event()
        missed = 0  # number of messages dropped since a queued message was last sent

        def enqueue(message: dict[str, Any]) -> None:
            nonlocal missed
            if len(queue) >= MAX_QUEUED_MESSAGES:
                queue.popleft()
                missed += 1
            queue.append(message)
            changed.set()

        stop_listening = self._served.listen(enqueue)
        try:
            await _send(socket, json.dumps(self._hello(), ensure_ascii=False))
            next_snapshot_at = loop.time()
            while True:
                if loop.time() >= next_snapshot_at:
                    await _send(socket, self._served.snapshot())
                    next_snapshot_at = loop.time() + period_s
                while queue and loop.time() < next_snapshot_at:
                    message = dict(queue.popleft())  # a copy, because all clients get the same object
                    if missed:
                        message["missed"] = missed
                        missed = 0
                    await _send(socket, json.dumps(message, ensure_ascii=False))
                changed.clear()
                # Not `move_on_after`: on Python 3.10 it can lose a cancellation at the deadline.
                timer = loop.call_later(max(0.001, next_snapshot_at - loop.time()), changed.set)
                try:
                    await changed.wait()
                finally:
                    timer.cancel()
        finally:
            stop_listening()

    def _hello(self) -> dict[str, Any]:
        return {
            "type": "hello",
            "read_only": self._access.read_only,
            "events": list(self._served.events),
            "orders": [record.to_dict() for record in self._orders.all()][-MAX_HELLO_ORDERS:],
        }


async def _send(socket: WebSocket, text: str) -> None:
    with anyio.fail_after(SEND_TIMEOUT_S):  # wait_for could lose a cancellation before Python 3.12
        await socket.send_text(text)


async def _receive(socket: WebSocket) -> None:
    message = await socket.receive()
    if message["type"] == "websocket.disconnect":
        raise WebSocketDisconnect(message.get("code", 1005))


async def _deny(socket: WebSocket, problem: HttpProblem) -> None:
    if "websocket.http.response" in socket.scope.get("extensions", {}):
        await socket.send_denial_response(problem_response(problem))
    else:
        await socket.close(1008)  # "policy violation"
