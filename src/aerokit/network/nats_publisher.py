"""``nats_publisher``: typed state at a server of NATS, by nats-py."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any

from aerokit.arguments import checked
from aerokit.async_block import async_block
from aerokit.errors import LinkOpenError
from aerokit.links.address import host_and_port
from aerokit.links.needed import needed
from aerokit.network.broker_address import parse_broker
from aerokit.network.broker_link import CONNECT_TIMEOUT_S, BrokerLink, publisher_over

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from aerokit.network.broker_address import BrokerAddress
    from aerokit.network.publisher import Publisher

__all__ = ["nats_publisher"]

ANSWER_TIMEOUT_S = 5.0
"""The server says that it has what was sent within this time, or the line is lost."""
PING_EVERY_S = 5
CLOSE_TIMEOUT_S = 2.0


class NatsLink(BrokerLink):
    """One connection to a server. The next messages are sent when it has said that it has those before."""

    def __init__(self, where: BrokerAddress) -> None:
        super().__init__(where)
        self._client: Any = None
        self._sending: asyncio.Task[None] | None = None
        self._error: Exception | None = None
        self._root = where.place.root.replace("/", ".") + ".state."

    async def _connect(self) -> None:
        nats = needed(self.address, "nats.aio.client", "nats-py", "nats")
        where = self._where
        login = {"user": where.user, "password": where.password}
        self._client = client = nats.Client()
        self._error = None
        self._released.clear()
        connecting = client.connect(
            f"nats://{host_and_port(where.host, where.port)}",
            error_cb=self._keep,
            closed_cb=self._closed,
            allow_reconnect=False,  # it would keep what is published meanwhile for later
            max_reconnect_attempts=1,
            reconnect_time_wait=0,
            connect_timeout=CONNECT_TIMEOUT_S,
            ping_interval=PING_EVERY_S,
            max_outstanding_pings=1,
            **({"token": where.user} if where.password is None else login),
        )
        try:
            await asyncio.wait_for(connecting, CONNECT_TIMEOUT_S)
        except Exception as error:  # of many kinds, and not all of them are nats.errors.Error
            cause = error if isinstance(error, asyncio.TimeoutError) else self._error or error
            if isinstance(cause, asyncio.TimeoutError):
                text = f"no answer within {CONNECT_TIMEOUT_S:g} s (is it a server of NATS?)"
                raise LinkOpenError(f"cannot open {self.address}: {text}") from None
            if isinstance(cause, OSError):
                raise self._refused(cause) from None
            raise LinkOpenError(f"cannot open {self.address}: {_reason(cause)}") from None

    async def _keep(self, error: Exception) -> None:
        self._error = error

    async def _closed(self) -> None:
        self._lose(f"the connection to the server has ended ({_reason(self._error)})")

    def _send_waiting(self) -> None:
        if self._sending is None:
            self._sending = asyncio.get_running_loop().create_task(self._send(), name="aerokit nats")

    async def _send(self) -> None:
        client = self._client
        try:
            while client is self._client and self._waiting:
                taken, self._waiting = self._waiting, {}
                for name, data in taken.items():
                    await client.publish(self._root + name.replace("/", "."), data)
                await client.flush(ANSWER_TIMEOUT_S)
        except Exception as error:
            self._lose(f"the server does not answer ({_reason(error)})", error)
        finally:
            self._sending = None

    def _release(self) -> None:
        client, self._client = self._client, None
        self._waiting.clear()
        if self._sending is not None:
            self._sending.cancel()
        if client is None:
            if self._closing is None:
                self._released.set()
        else:
            loop = asyncio.get_running_loop()
            self._closing = loop.create_task(self._close(client, self._sending), name="aerokit nats closing")
            self._closing.add_done_callback(lambda _: self._released.set())

    _closing: asyncio.Task[None] | None = None

    async def _close(self, client: Any, sending: asyncio.Task[None] | None) -> None:
        if sending is not None and sending is not asyncio.current_task():
            await asyncio.wait([sending], timeout=CLOSE_TIMEOUT_S)
        with contextlib.suppress(
            Exception
        ):  # whatever it says, it is closed; of a line that stands it never says so
            await asyncio.wait_for(client.close(), CLOSE_TIMEOUT_S)


def _reason(error: BaseException | None) -> str:
    """Without the name of the library."""
    text = str(error or "").removeprefix("nats: ").strip().strip("'")
    return text or ("closed" if error is None else type(error).__name__)


@checked
@async_block
async def nats_publisher(address: str) -> AsyncIterator[Publisher]:
    """Connect to a server of NATS for the time of the block.

    States go to the subjects ``aerokit.FLEET.NAME.state.…``. A connection that is lost is opened again; what is put
    meanwhile is dropped. A server that asks for TLS gets it, and its certificate is checked.

    Args:
        address: ``"nats://10.0.0.5:4222/fleet/alpha"``, ``"nats://user:password@…"``, ``"nats://token@…"``.

    Returns:
        What :func:`publishing` takes.

    Raises:
        LocalProtocolError: this is no address of a server of NATS.
        LinkOpenError: the server cannot be reached or refuses, or nats-py is not installed.
    """
    where = parse_broker(address, "nats")
    async with publisher_over(lambda: NatsLink(where)) as publisher:
        yield publisher
