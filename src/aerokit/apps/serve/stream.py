"""The WebSocket: snapshots of the state at a bounded rate, events and results of orders as they come."""

from __future__ import annotations

import asyncio
import json
from collections import deque
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import anyio
from starlette.websockets import WebSocketDisconnect

from aerokit.apps.serve.guard import PROTOCOL
from aerokit.apps.serve.requests import Problem, problem_response

if TYPE_CHECKING:
    from starlette.websockets import WebSocket

    from aerokit.apps.serve.guard import Keys
    from aerokit.apps.serve.orders import Orders
    from aerokit.apps.serve.watch import Watch

MOST_SOCKETS = 32
MOST_VIEWERS = 16
"""Of them, those without the token, where reading is open."""
MOST_WAITING = 256
"""Events for one client that have not left; then the oldest go, and it is told how many."""
SEND_TIMEOUT_S = 10.0
DEFAULT_RATE_HZ, HIGHEST_RATE_HZ, LOWEST_RATE_HZ = 5.0, 20.0, 0.1


class Stream:
    """``/api/stream``. A client says nothing on it; one that does not read for 10 seconds is let go."""

    def __init__(self, watch: Watch, orders: Orders, keys: Keys) -> None:
        self._watch, self._orders, self._keys = watch, orders, keys
        self._open = self._viewers = 0

    async def endpoint(self, socket: WebSocket) -> None:
        """Serve one client."""
        try:
            rate_hz = self._admit(socket)
        except Problem as problem:
            await _deny(socket, problem)
            return
        is_viewer = not self._keys.holds_token(socket.headers)
        self._open += 1
        self._viewers += is_viewer
        try:
            is_asked = PROTOCOL in socket.scope.get("subprotocols", ())
            await socket.accept(PROTOCOL if is_asked else None)
            await self._talk(socket, 1 / rate_hz)
        finally:
            self._open -= 1
            self._viewers -= is_viewer

    def _admit(self, socket: WebSocket) -> float:
        self._keys.check(socket.headers)
        if self._open >= MOST_SOCKETS:
            raise Problem(503, "TooManySockets", f"{MOST_SOCKETS} clients are connected already")
        if self._viewers >= MOST_VIEWERS and not self._keys.holds_token(socket.headers):
            raise Problem(
                503, "TooManySockets", f"{MOST_VIEWERS} clients without the token are connected already"
            )
        text = socket.query_params.get("rate_hz", str(DEFAULT_RATE_HZ))
        try:
            rate_hz = float(text)
        except ValueError:
            rate_hz = 0.0
        if not LOWEST_RATE_HZ <= rate_hz <= HIGHEST_RATE_HZ:
            raise Problem(400, "WrongRate", f"rate_hz is a number from {LOWEST_RATE_HZ} to {HIGHEST_RATE_HZ}")
        return rate_hz

    async def _talk(self, socket: WebSocket, period_s: float) -> None:
        telling = asyncio.ensure_future(self._tell(socket, period_s))
        listening = asyncio.ensure_future(_listen(socket))
        both = {telling, listening}
        try:
            await asyncio.wait(both, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in both:
                task.cancel()
            await asyncio.gather(*both, return_exceptions=True)
        if listening.done() and not listening.cancelled() and listening.exception() is None:
            code = 1008  # it spoke
        elif telling.done() and not telling.cancelled() and isinstance(telling.exception(), TimeoutError):
            code = 1013  # it does not read
        else:
            return
        with suppress(Exception):
            await asyncio.wait_for(socket.close(code), 1.0)

    async def _tell(self, socket: WebSocket, period_s: float) -> None:
        loop, waiting, missed, news = asyncio.get_running_loop(), deque[dict[str, Any]](), 0, asyncio.Event()

        def note(message: dict[str, Any]) -> None:
            nonlocal missed
            if len(waiting) >= MOST_WAITING:
                waiting.popleft()
                missed += 1
            waiting.append(message)
            news.set()

        stop = self._watch.listen(note)
        try:
            await _send(socket, json.dumps(self._hello(), ensure_ascii=False))
            due = loop.time()
            while True:
                if loop.time() >= due:
                    await _send(socket, self._watch.snapshot())
                    due = loop.time() + period_s
                while waiting:
                    message = {**waiting.popleft(), **({"missed": missed} if missed else {})}
                    missed = 0
                    await _send(socket, json.dumps(message, ensure_ascii=False))
                news.clear()
                timer = loop.call_later(max(0.001, due - loop.time()), news.set)
                try:
                    await news.wait()
                finally:
                    timer.cancel()
        finally:
            stop()

    def _hello(self) -> dict[str, Any]:
        return {
            "type": "hello",
            "read_only": self._keys.read_only,
            "events": list(self._watch.events),
            "orders": [each.record() for each in self._orders.all()][-50:],
        }


async def _send(socket: WebSocket, text: str) -> None:
    with anyio.fail_after(SEND_TIMEOUT_S):  # wait_for can lose a cancellation before Python 3.12
        await socket.send_text(text)


async def _listen(socket: WebSocket) -> None:
    message = await socket.receive()
    if message["type"] == "websocket.disconnect":
        raise WebSocketDisconnect(message.get("code", 1005))


async def _deny(socket: WebSocket, problem: Problem) -> None:
    if "websocket.http.response" in socket.scope.get("extensions", {}):
        await socket.send_denial_response(problem_response(problem))
    else:
        await socket.close(1008)
