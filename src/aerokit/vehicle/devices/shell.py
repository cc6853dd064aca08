"""``Shell``: PX4's system shell over MAVLink."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit._internal.async_block import ReadOnly
from aerokit.errors import ConnectionClosed, InvalidArgument, NotSupported, OperationTimeout
from aerokit.mavlink.enums import SerialControlDev, SerialControlFlag
from aerokit.mavlink.messages import SerialControl

if TYPE_CHECKING:
    from typing_extensions import Self

    from aerokit.connection.bus import Subscription
    from aerokit.vehicle.commanding.context import VehicleContext

__all__ = ["Shell"]

PROMPTS = ("pxh> ", "nsh> ")
"""PX4's prompts, in simulation and on NuttX. The shell shows its prompt when a command has ended."""
DATA_BYTES = 70
"""Size of the field ``data`` of SERIAL_CONTROL."""
MAX_LINE_BYTES, MAX_WAITING_MESSAGES, OPEN_TIMEOUT_S = 1000, 4096, 5.0
_RESPOND, _REPLY = SerialControlFlag.RESPOND, SerialControlFlag.REPLY


@checks_arguments
class Shell(ReadOnly):
    """PX4's system shell, open for the duration of an ``async with`` block: ``vehicle.shell()`` (SERIAL_CONTROL).

    PX4 has one shell for each of its ports, and all stations on a port share the shell. aerokit sends each line once.
    aerokit's rules for orders do not apply to shell commands, because aerokit does not know their effect.
    SERIAL_CONTROL has neither sequence numbers nor acknowledgements, so parts of the text may be lost.

    Entering raises:
        NotSupported: the vehicle runs ArduPilot, which has no shell. Nothing was sent.
        BusyError: this shell was entered before; call ``vehicle.shell()`` again.
        OperationTimeout: there was no prompt within five seconds.
    """

    def __init__(self, context: VehicleContext) -> None:
        self._context, self._session = context, context.session
        session = context.session
        self._output: Subscription[SerialControl] = session.connection.subscribe(
            SerialControl, system_id=session.system_id, capacity=MAX_WAITING_MESSAGES
        )
        self._is_open = False

    async def __aenter__(self) -> Self:
        """Open the shell, and wait for its prompt."""
        autopilot = self._session.autopilot
        if not autopilot.has_shell:
            raise NotSupported(f"shell: {autopilot.firmware} has no shell; nothing was sent")
        self._output.__enter__()
        self._is_open = True
        self._detach_finish = self._context.on_finish(self._finish)
        try:
            await self.run("", timeout=OPEN_TIMEOUT_S)  # An empty command makes the shell show its prompt.
        except BaseException:
            self._close()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        self._close()

    def _finish(self) -> None:
        self._close(ConnectionClosed("the async with block of this vehicle was left"))

    def _close(self, error: Exception | None = None) -> None:
        """Close the shell. A waiting reader raises ``error``."""
        self._detach_finish()
        self._output.close(error)
        if self._is_open and self._session.is_open:
            # A message that requests no response closes the shell.
            self._send(b"", flags=0)
        self._is_open = False

    def write(self, line: str) -> None:
        """Send one line without waiting for output. :meth:`read` returns the output.

        Args:
            line: at most 1000 bytes, without a line break.

        Raises:
            InvalidArgument: the line is too long or has a line break, or the shell is not open. Nothing was sent.
        """
        data = line.encode()
        if len(data) > MAX_LINE_BYTES or "\n" in line or "\r" in line:
            raise InvalidArgument(
                f"line of {len(data)} bytes is not allowed: it must have at most {MAX_LINE_BYTES} bytes, and no line"
                " break"
            )
        if not self._is_open:
            raise InvalidArgument("the shell is not open: write to it inside its `async with` block")
        data += b"\n"
        for start in range(0, len(data), DATA_BYTES):
            self._send(data[start : start + DATA_BYTES], _RESPOND)

    def _send(self, data: bytes, flags: int) -> None:
        """Send at most DATA_BYTES bytes to the shell."""
        message = SerialControl(
            device=SerialControlDev.DEV_SHELL,
            flags=flags,
            timeout=0,
            baudrate=0,
            count=len(data),
            data=data.ljust(DATA_BYTES, b"\0"),
            target_system=self._session.system_id,
            target_component=self._session.component_id,
        )
        self._session.send(message)

    async def read(self, *, timeout: float | None = None) -> str:
        """Return the next piece of output, up to 70 bytes, including echoes and prompts.

        Args:
            timeout: seconds; None waits without a limit.

        Raises:
            InvalidArgument: the timeout is out of range, or the shell is not open.
            OperationTimeout: there was no output in time.
        """
        if timeout is not None:
            check_range("timeout", timeout, 0, 1e6)
        now = self._session.connection.now
        deadline = math.inf if timeout is None else now() + timeout
        while True:  # Messages that are not for us do not extend the time.
            message = await self._output.get(None if timeout is None else max(0.0, deadline - now()))
            is_for_us = message.target_system in (0, self._session.connection.source_system)
            is_shell_output = message.device == SerialControlDev.DEV_SHELL and message.flags & _REPLY
            if is_for_us and is_shell_output:
                return bytes(message.data[: message.count]).decode(errors="replace")

    async def run(self, command: str, *, timeout: float = 10.0) -> str:
        """Run a command, wait until the shell shows its prompt again, and return the output.

        A cancellation or time-out does not end the command. Output that arrived before the call is discarded.

        Args:
            command: at most 1000 bytes, without a line break.
            timeout: seconds until the prompt, above 0.

        Raises:
            InvalidArgument: as for :meth:`write`.
            OperationTimeout: there was no prompt in time; the error text has the output so far.
        """
        check_range("timeout", timeout, 0, 1e6, above=True)
        while self._output.get_nowait() is not None:
            pass  # Discard earlier output.
        self.write(command)
        now = self._session.connection.now
        deadline = now() + timeout
        text = ""
        try:
            while not text.endswith(PROMPTS):
                text += await self.read(timeout=max(0.0, deadline - now()))
        except OperationTimeout:
            link = self._session.describe_link()
            raise OperationTimeout(
                f"shell: {command!r} has not ended within {timeout:g} s; output: {text!r}; {link}"
            ) from None
        # The output begins with an echo of the command, and its last line is the prompt.
        output, _, _ = text.removeprefix(command).removeprefix("\n").rpartition("\n")
        return output
