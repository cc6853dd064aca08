"""``ComponentServices``: the protocol servers that the parts of one component share."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any

import anyio

from aerokit.errors import InvalidArgument
from aerokit.mavlink.message import Message
from aerokit.onboard.commands import ComponentCommands
from aerokit.protocols.servers.files import FileTree
from aerokit.protocols.servers.intervals import MessageStreams

if TYPE_CHECKING:
    from aerokit.connection.tasks import BackgroundTasks
    from aerokit.onboard.host import ComponentHost
    from aerokit.onboard.parameters import ComponentParameters

logger: logging.Logger = logging.getLogger("aerokit")

MAX_STREAMS = 64
MIN_STREAM_INTERVAL_S = 0.005
STOP_TIMEOUT_S = 2.0


class ComponentServices:
    """The command handlers, message streams, parameters and in-memory files of one component."""

    def __init__(self, host: ComponentHost, tasks: BackgroundTasks, parameters: ComponentParameters) -> None:
        self.host: ComponentHost = host
        self.tasks: BackgroundTasks = tasks
        self.parameters: ComponentParameters = parameters
        self.commands: ComponentCommands = ComponentCommands(host, tasks)
        self.streams: MessageStreams = MessageStreams(
            host, min_interval_s=MIN_STREAM_INTERVAL_S, max_streams=MAX_STREAMS
        )
        self.commands.add_guarded(self.streams.commands())
        self.memory: FileTree = FileTree()
        self.stop_functions: dict[str, Callable[[], Any]] = {}
        """Maps the name of a moving part, e.g. "winch", to the program's function that stops it."""

    async def stop_motions(self) -> None:
        thread_calls = set(self.commands.thread_calls)
        stop_functions = dict(self.stop_functions)
        self.stop_functions.clear()
        await self._call_all(stop_functions)
        if stop_functions and thread_calls:  # One of these threads may have started the motion again.
            await asyncio.wait(thread_calls, timeout=STOP_TIMEOUT_S)
            await self._call_all(stop_functions)

    async def _call_all(self, stop_functions: Mapping[str, Callable[[], Any]]) -> None:
        for part, stop in stop_functions.items():
            try:
                with anyio.fail_after(STOP_TIMEOUT_S):
                    await self.commands.call(stop)
            except (Exception, asyncio.CancelledError) as error:  # e.g. the driver awaits a task that it has cancelled
                self.host.report_error(f"stopping the {part}", error)

    def add_message(self, message_type: type[Message], function: Callable[[], Message | None], hz: float) -> None:
        """Send the message that ``function`` returns: on request, and at a rate of ``hz``.

        Raises InvalidArgument if the rate is not 0 to 200 Hz, or the message already has a function.
        """
        if not 0.0 <= hz <= 1.0 / MIN_STREAM_INTERVAL_S:
            raise InvalidArgument(f"hz = {hz} is not allowed: it must be 0 to {1.0 / MIN_STREAM_INTERVAL_S:g}")
        if message_type.ID in self.streams.builders:
            raise InvalidArgument(f"{message_type.NAME} already has a function")

        is_failing = False

        def build(_: object) -> Iterable[Message]:
            nonlocal is_failing
            try:
                message = function()
            except Exception:
                if not is_failing:  # Log the first failure only.
                    logger.exception("the function for %s failed", message_type.NAME)
                is_failing = True
                return []
            is_failing = False
            return [] if message is None else [message]

        self.streams.builders[message_type.ID] = build
        if hz > 0:
            self.streams.stream(message_type.ID, 1.0 / hz)
