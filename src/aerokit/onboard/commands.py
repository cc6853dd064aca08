"""Runs the command handlers of a component: progress, cancellation, results. `ComponentServices` has all servers."""

from __future__ import annotations

import asyncio
import contextvars
import inspect
import logging
import math
from collections.abc import Awaitable, Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING, Any

import anyio

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit._internal.formatting import short_repr
from aerokit.errors import BusyError, InvalidArgument, NotSupported
from aerokit.mavlink.enums import MavFrame, MavResult
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import CommandAck
from aerokit.missions.item import canonical_frame, command_name
from aerokit.onboard.arguments import CommandArgument, arguments_of
from aerokit.position import Position
from aerokit.protocols.servers.commands import MAX_RUNNING_COMMANDS, CommandDispatcher, CommandResult, RunningCommands
from aerokit.protocols.servers.files import FileTree
from aerokit.protocols.servers.intervals import MessageStreams

if TYPE_CHECKING:
    from aerokit.connection.tasks import BackgroundTasks
    from aerokit.onboard.host import ComponentHost
    from aerokit.onboard.parameters import ComponentParameters
    from aerokit.protocols.servers.commands import CommandHandler, CommandProgress, ReceivedCommand, RunningCommand
    from aerokit.protocols.servers.host import ComponentIds

logger: logging.Logger = logging.getLogger("aerokit")

MAX_THREADS = MAX_RUNNING_COMMANDS + 2  # Two more for a series of pictures and the check of an upload.


@checks_arguments
class CommandRequest:
    """A command that a handler executes."""

    def __init__(self, command: ReceivedCommand, report: Callable[[int], None]) -> None:
        self._command, self._report = command, report

    @property
    def command(self) -> int:
        """MAV_CMD."""
        return self._command.command

    @property
    def sender(self) -> ComponentIds:
        """System id and component id of the sender."""
        return self._command.sender

    @property
    def params(self) -> tuple[float, ...]:
        """Parameters 1 to 7. Latitude and longitude are in degrees, also those of a COMMAND_INT."""
        *params, x, y, z = self._command.params
        # In COMMAND_INT, x and y are latitude and longitude in 1e-7 degrees, except in these two frames.
        if self._command.frame is not None and self._command.frame not in (MavFrame.MISSION, MavFrame.LOCAL_NED):
            x, y = x / 1e7, y / 1e7
        return (*params, x, y, z)

    @property
    def position(self) -> Position:
        """Position of the command. Its altitude is above home or above mean sea level, depending on the frame.

        Raises:
            InvalidArgument: latitude or longitude is missing or out of range, or the altitude is relative to something
                else, such as the terrain.
        """
        frame = self._command.altitude_frame
        *_, latitude, longitude, altitude = self.params
        altitude_m = altitude if math.isfinite(altitude) else None
        if canonical_frame(frame) == MavFrame.GLOBAL:
            return Position(latitude, longitude, altitude_amsl_m=altitude_m)
        if canonical_frame(frame) == MavFrame.GLOBAL_RELATIVE_ALT:
            return Position(latitude, longitude, altitude_relative_m=altitude_m)
        raise InvalidArgument(
            f"frame = {frame} is not allowed: it must be a global MAV_FRAME with the altitude above home or sea level"
        )

    def report_progress(self, percent: int) -> None:
        """Send IN_PROGRESS with this percentage (0 to 100) now, and repeat it until the next report."""
        check_range("percent", percent, 0, 100)
        self._report(percent)

    def __repr__(self) -> str:
        return f"<CommandRequest {command_name(self.command)} from {self.sender.system}/{self.sender.component}>"


def command_result(value: object) -> CommandResult:
    """Convert the return value of a handler. Raise TypeError if COMMAND_ACK cannot carry it."""
    if value is None or value is True:
        return CommandResult()
    result = CommandResult(MavResult.FAILED)
    if isinstance(value, CommandResult):
        result = value
    elif isinstance(value, int) and value is not False:  # False, which is an int too, means FAILED.
        result = CommandResult(int(value))
    try:
        CommandAck(0, result.result, result.progress, result.detail).encode()
    except InvalidArgument as error:
        raise TypeError(f"the function returned {short_repr(value)}, which is no result: {error}") from None
    return result


def overrides(driver: object, base: type, name: str) -> bool:
    return getattr(type(driver), name) is not getattr(base, name)


def result_of(error: BaseException) -> int:
    if isinstance(error, NotSupported):
        return MavResult.UNSUPPORTED
    if isinstance(error, BusyError):
        return MavResult.TEMPORARILY_REJECTED
    if isinstance(error, (InvalidArgument, ValueError, PermissionError)):
        return MavResult.DENIED
    return MavResult.FAILED


class ComponentCommands:
    """Command handlers of one component, which run as tasks until the component closes."""

    def __init__(self, host: ComponentHost, tasks: BackgroundTasks) -> None:
        self.uses_threads = False
        """True if plain (not ``async``) handlers are called in threads, because they may block."""
        self.handlers: dict[int, CommandHandler] = {}
        """Maps MAV_CMD to handler. Protocol servers add their handlers."""
        self.server: CommandDispatcher = CommandDispatcher(host, self.handlers)
        self._running = RunningCommands(host, self.server)
        self._host, self._tasks = host, tasks
        # Tasks that wait for a handler in a thread. They cannot be cancelled, because a thread cannot be stopped.
        self._tasks_in_threads: set[asyncio.Task[Any] | None] = set()
        self.thread_calls: set[asyncio.Future[Any]] = set()
        """Calls of functions in threads that have not returned, also those for which no task waits any more."""
        # Handlers have their own threads. In the loop's few default threads, slow handlers would delay the saving of
        # parameters.
        self._threads: ThreadPoolExecutor | None = None  # None before the first call in a thread
        host.knows_command = self.handlers.__contains__

    def add(
        self,
        command: int,
        function: Callable[..., Any],
        *,
        is_stop: Callable[[ReceivedCommand], bool] = lambda _: False,
    ) -> None:
        """Register the handler of a MAV_CMD.

        A command for which ``is_stop`` returns True cancels a running handler. Raises InvalidArgument if the command
        already has a handler, or an annotation of the function is not supported.
        """
        arguments = arguments_of(function)

        def execute(received: ReceivedCommand) -> None:
            self._execute(function, arguments, received, is_stop=is_stop(received))

        self._register({command: execute})

    def _register(self, handlers: Mapping[int, CommandHandler]) -> None:
        """Register handlers that check the parameters themselves.

        Raises InvalidArgument if a command already has a handler.
        """
        for command in handlers:
            if command in self.handlers:
                raise InvalidArgument(f"{command_name(command)} already has a handler")
        self.handlers.update(handlers)

    def add_guarded(self, handlers: Mapping[int, CommandHandler]) -> None:
        """Register handlers that call the program's code. An exception of this code is answered as a MAV_RESULT."""

        def guard(handler: CommandHandler) -> CommandHandler:
            def guarded(command: ReceivedCommand) -> int | CommandProgress | None:
                try:
                    return handler(command)
                except Exception as error:
                    self._host.report_error(command_name(command.command), error)
                    return result_of(error)

            return guarded

        self._register({command: guard(handler) for command, handler in handlers.items()})

    async def call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call a function of the program, and wait for its result.

        A plain function runs in a thread if `uses_threads` is True.
        """
        result = self.start_call(function, *arguments)
        return await result if inspect.isawaitable(result) else result

    def start_call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Like `call`, but return the result or an awaitable for it."""
        if inspect.iscoroutinefunction(function) or not self.uses_threads:
            try:
                return function(*arguments)
            except asyncio.CancelledError as error:  # raised by `result()` of a cancelled task, for example
                raise RuntimeError("the function raised CancelledError") from error
        return self._call_in_thread(function, *arguments)

    async def _call_in_thread(self, function: Callable[..., Any], *arguments: Any) -> Any:
        task = asyncio.current_task()
        self._tasks_in_threads.add(task)
        if self._threads is None:
            self._threads = ThreadPoolExecutor(MAX_THREADS, thread_name_prefix="aerokit command")
        call = partial(contextvars.copy_context().run, function, *arguments)
        try:
            future = asyncio.get_running_loop().run_in_executor(self._threads, call)
            self.thread_calls.add(future)
            future.add_done_callback(self.thread_calls.discard)
            result = await asyncio.shield(future)  # A thread goes on although its task is cancelled.
        finally:
            self._tasks_in_threads.discard(task)
        return await result if inspect.isawaitable(result) else result

    def add_raw(self, command: int, function: Callable[[ReceivedCommand], Awaitable[int]]) -> None:
        """Register a coroutine function of a protocol server, which checks the parameters itself."""

        async def run(request: CommandRequest) -> int:
            return await function(request._command)

        self._register({command: partial(self._execute, run, ())})

    def cancel_all(self) -> None:
        self._running.cancel_all()

    def close(self) -> None:
        for call in tuple(self.thread_calls):
            call.cancel()  # Nothing waits for its result any more.
        if self._threads is not None:
            self._threads.shutdown(wait=False)

    def _execute(
        self,
        function: Callable[..., Any],
        arguments: tuple[CommandArgument, ...],
        command: ReceivedCommand,
        *,
        is_stop: bool = False,
    ) -> None:
        execution = _Execution(self, function)
        running = self._running.start(command, execution.cancel, is_stop=is_stop)
        if running is not None:  # None if start() has answered a repetition, or rejected the command.
            execution.begin(running, arguments)


class _Execution:
    """One execution of a command handler, as a task if the handler returns an awaitable."""

    _running: RunningCommand
    _returned: Any  # what the handler has returned

    def __init__(self, commands: ComponentCommands, function: Callable[..., Any]) -> None:
        self._commands, self._function = commands, function
        self._loop = asyncio.get_running_loop()
        self._task: asyncio.Task[Any] | None = None  # None before the task has started
        self._is_cancelled = False  # True if cancelled before the task has started

    def begin(self, running: RunningCommand, arguments: tuple[CommandArgument, ...]) -> None:
        self._running = running
        request = CommandRequest(running.command, self._report)
        try:
            values = [argument.convert(request.params[argument.number - 1]) for argument in arguments]
            self._returned = self._commands.start_call(self._function, request, *values)
            result = None if inspect.isawaitable(self._returned) else command_result(self._returned)
        except Exception as error:
            self._finish_with_error(error)
            return
        if result is not None:
            self._finish(result)
            return
        task = self._commands._tasks.start(self._run, f"aerokit {command_name(running.command.command)}")
        if task is None:  # The component is closing.
            self.cancel()

    def cancel(self) -> bool:
        """Cancel the handler. Return False if it runs in a thread, which cannot be cancelled."""
        if self._task in self._commands._tasks_in_threads:
            return False  # The sender gets the result of the thread.
        if self._task is not None:
            self._task.cancel()
        elif not self._is_cancelled:
            self._is_cancelled = True
            if inspect.iscoroutine(self._returned):
                self._returned.close()
            self._finish(CommandResult(MavResult.CANCELLED))
        return True

    async def _run(self) -> None:
        if self._is_cancelled:
            return
        self._task = asyncio.current_task()
        try:
            result = command_result(await self._returned)
        except asyncio.CancelledError:
            self._finish(CommandResult(MavResult.CANCELLED))
            raise
        except Exception as error:
            self._finish_with_error(error)
        else:
            self._finish(result)

    def _report(self, percent: int) -> None:
        if self._commands.uses_threads:  # A thread must not call the event loop's objects directly.
            self._loop.call_soon_threadsafe(self._commands._running.report, self._running, percent)
        else:
            self._commands._running.report(self._running, percent)

    def _finish(self, result: CommandResult) -> None:
        self._commands._running.finish(self._running, result)

    def _finish_with_error(self, error: Exception) -> None:
        name = getattr(self._function, "__name__", "run")
        if name == "run":  # The name of aerokit's own wrapper tells the sender nothing.
            name = command_name(self._running.command.command)
        self._commands._host.report_error(name, error)
        self._finish(CommandResult(result_of(error)))


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
        check_range("hz", hz, 0.0, 1.0 / MIN_STREAM_INTERVAL_S)
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
