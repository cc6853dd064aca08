"""An MQTT broker (nats-server) in its own process, and a subscriber."""

from __future__ import annotations

import asyncio
import json
import shutil
import subprocess
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from free_ports import free_port
from zenoh_network import eventually

__all__ = ["PASSWORD", "USER", "Broker", "needs_a_broker"]

PROGRAM = shutil.which("nats-server", path=str(Path(sys.executable).parent)) or shutil.which("nats-server")
USER, PASSWORD = "alpha", "s3cret@/:"


def needs_a_broker() -> None:
    """Skip a test module if the server or a client is not installed."""
    pytest.importorskip("paho.mqtt.client")
    if PROGRAM is None:
        pytest.skip("nats-server is not installed", allow_module_level=True)


class Broker:
    """A server that can be killed and started again on the same port."""

    def __init__(self, folder: Path, *, with_password: bool = False) -> None:
        self.port = free_port()
        self._folder, self._starts = folder, 0
        self._process: subprocess.Popen[bytes] | None = None
        config: dict[str, Any] = {
            "server_name": "test",
            "listen": f"127.0.0.1:{free_port()}",
            "mqtt": {"listen": f"127.0.0.1:{self.port}"},
            "jetstream": {"store_dir": str(folder / "store")},
        }
        if with_password:
            config["authorization"] = {"user": USER, "password": PASSWORD}
        self._config = folder / "nats.conf"
        self._config.write_text(json.dumps(config), encoding="utf-8")

    async def __aenter__(self) -> Broker:
        await self.start()
        return self

    async def __aexit__(self, *_: object) -> None:
        self.kill()

    async def start(self) -> None:
        """Wait until the server is ready."""
        assert PROGRAM is not None
        assert self._process is None
        self._starts += 1
        log = self._folder / f"log-{self._starts}"
        self._run(PROGRAM, log)
        await eventually(lambda: log.exists() and "Server is ready" in log.read_text(encoding="utf-8"))

    def _run(self, program: str, log: Path) -> None:
        self._process = subprocess.Popen([program, "-c", str(self._config), "-l", str(log)])

    def kill(self) -> None:
        """Kill the server without shutdown, as a power failure does."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    @asynccontextmanager
    async def received(self, login: tuple[str, str] | None = None) -> AsyncIterator[list[Any]]:
        """Yield (topic, payload, retained) of each message."""
        from paho.mqtt import client as mqtt

        received: list[Any] = []
        subscribed: list[object] = []
        client: Any = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)  # type: ignore[attr-defined]
        if login is not None:
            client.username_pw_set(*login)
        client.on_connect = lambda *_: client.subscribe("aerokit/#")
        client.on_subscribe = lambda *_: subscribed.append(1)
        client.on_message = lambda _c, _d, got: received.append((got.topic, bytes(got.payload), got.retain))
        client.connect("127.0.0.1", self.port)
        client.loop_start()
        try:
            await eventually(lambda: bool(subscribed))
            yield received
        finally:
            client.disconnect()
            await asyncio.get_running_loop().run_in_executor(None, client.loop_stop)
