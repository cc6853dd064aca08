"""A simulated flight that is served, with an in-memory HTTP client and an ASGI WebSocket client."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Any

import httpx
from flight_harness import Flight, open_flight

from aerokit.apps.serve import ServeApp, make_app

TOKEN = "a-token-of-24-characters"
HOST = "127.0.0.1:8080"


@dataclass
class Stage:
    flight: Flight
    app: ServeApp
    client: httpx.AsyncClient
    keys: int = 0

    async def submit(self, order: str, body: object = None, **headers: str) -> httpx.Response:
        """POST an order for vehicle 1, with a new key unless ``headers`` has one."""
        self.keys += 1
        sent = {"Authorization": f"Bearer {TOKEN}", "Idempotency-Key": f"key-{self.keys:08}", **headers}
        sent = {name.replace("_", "-"): value for name, value in sent.items()}
        return await self.client.post(f"/api/vehicles/1/{order}", json=body, headers=sent)


@asynccontextmanager
async def open_stage(*, ready: bool = True, **options: Any) -> AsyncIterator[Stage]:
    async with open_flight() as flight:
        if ready:
            await flight.vehicle.wait_ready()
        async with make_app(flight.vehicle, token=TOKEN, **options) as app:
            transport = httpx.ASGITransport(app, raise_app_exceptions=False)
            async with httpx.AsyncClient(transport=transport, base_url=f"http://{HOST}") as client:
                yield Stage(flight, app, client)


@dataclass
class Socket:
    """An ASGI server's side of one WebSocket; clear ``flows`` to block sending, like a full socket."""

    app: ServeApp
    path: str = "/api/stream"
    query: str = ""
    token: str | None = TOKEN
    host: str = HOST
    origin: str | None = None
    sent: list[dict[str, Any]] = field(default_factory=list)
    news: asyncio.Event = field(default_factory=asyncio.Event)
    flows: asyncio.Event = field(default_factory=asyncio.Event)

    async def __aenter__(self) -> Socket:
        protocols = ["aerokit.v1", *([f"bearer.{self.token}"] if self.token else [])]
        headers = [(b"host", self.host.encode()), (b"sec-websocket-protocol", ", ".join(protocols).encode())]
        if self.origin is not None:
            headers.append((b"origin", self.origin.encode()))
        scope = {
            "type": "websocket",
            "asgi": {"version": "3.0"},
            "scheme": "ws",
            "path": self.path,
            "raw_path": self.path.encode(),
            "root_path": "",
            "query_string": self.query.encode(),
            "headers": headers,
            "subprotocols": protocols,
            "extensions": {"websocket.http.response": {}},
        }
        self.incoming: asyncio.Queue[dict[str, Any]] = asyncio.Queue()
        self.incoming.put_nowait({"type": "websocket.connect"})
        self.flows.set()
        self.task = asyncio.ensure_future(self.app(scope, self.incoming.get, self._take))
        return self

    async def __aexit__(self, *_: object) -> None:
        self.incoming.put_nowait({"type": "websocket.disconnect", "code": 1001})
        self.flows.set()
        await asyncio.wait_for(self.task, 5.0)

    async def _take(self, message: Any) -> None:
        await self.flows.wait()
        self.sent.append(message)
        self.news.set()

    async def next(self, kind: str) -> dict[str, Any]:
        """The next message of this type (of ASGI: ``websocket.accept``; of ours: ``state``)."""
        while True:
            while self.sent:
                message = self.sent.pop(0)
                if "text" in message:
                    message = json.loads(message["text"])
                if message["type"] == kind:
                    return dict(message)
            self.news.clear()
            await asyncio.wait_for(self.news.wait(), 30.0)
