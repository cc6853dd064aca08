"""Base class of the generated blocking twin of `OnboardComponent`, and the function that opens the twin."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

from aerokit.sync.blocks import ConnectionTwin, OpenedTwin
from aerokit.sync.loop_thread import LoopThread

if TYPE_CHECKING:
    from contextlib import AbstractAsyncContextManager

    from aerokit.mavlink.message import Message
    from aerokit.onboard.component import OnboardComponent  # noqa: F401
    from aerokit.sync.loop_thread import OpenContext

FunctionT = TypeVar("FunctionT", bound=Callable[..., Any])
ComponentT = TypeVar("ComponentT", bound="ComponentTwin")


class ComponentTwin(OpenedTwin["OnboardComponent"]):
    """Component as a context manager, which also closes the connection that was opened for it."""

    _opened_by = "component"

    def command(self, command: int) -> Callable[[FunctionT], FunctionT]:
        """Decorator: execute a MAV_CMD by a plain function, in a thread.

        Arguments and results are those of `aerokit.onboard.OnboardComponent.command`. COMMAND_CANCEL cannot stop a
        thread, so it is ignored: the function runs to its end, and the sender gets its result.

        Raises:
            InvalidArgument: the command already has a handler, or an annotation of the function is not supported.
        """

        def register(function: FunctionT) -> FunctionT:
            self._loop.call(self.aio.command(command), function)
            return function

        return register

    def message(self, message_type: type[Message], *, hz: float = 0.0) -> Callable[[FunctionT], FunctionT]:
        """Decorator: send the message that a function returns, on request and at intervals that other programs set.

        The function runs on the loop's thread and must return at once. It returns None while it has no values.

        Args:
            message_type: the message.
            hz: rate (0 to 200) at which it is sent to all programs from the start; 0 sends it only when asked.

        Raises:
            InvalidArgument: ``hz`` is out of range, or the message already has a function.
        """

        def register(function: FunctionT) -> FunctionT:
            self._loop.call(self.aio.message(message_type, hz=hz), function)
            return function

        return register

    def close(self) -> None:
        """Cancel running commands, stop the heartbeat and end the loop thread. Idempotent."""
        super().close()


def opened_component(
    twin: type[ComponentT],
    open_async: Callable[..., AbstractAsyncContextManager[Any]],
    address: Any,
    connection: ConnectionTwin | None,
    **options: Any,
) -> ComponentT:
    """Open a component on the connection's loop thread or, without a connection, on a new one."""
    owns_loop = connection is None
    loop = LoopThread() if connection is None else connection._loop
    try:
        async_connection = None if connection is None else connection.aio
        context: OpenContext[Any] = loop.open_context(open_async(address, connection=async_connection, **options))
        try:
            loop.call(context.value._use_threads)
        except BaseException:
            context.close()
            raise
    except BaseException:
        if owns_loop:
            loop.close()
        raise
    return twin(loop, context, owns_loop=owns_loop)
