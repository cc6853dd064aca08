"""``Transfers``: runs the exchanges of messages that transfer parameters, missions, files and logs."""

from __future__ import annotations

import logging
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Protocol, TypeVar

import anyio

from aerokit.connection.exchanges import run_exchange
from aerokit.errors import AerokitError, CommandRejected, CommandTimeout, OperationRejected, OperationTimeout
from aerokit.events import VehicleRebooted
from aerokit.protocols.exchange import RoundTrip, Transfer, TransferProgress
from aerokit.vehicle.session.watch import OTHER_BOOT

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator

    from aerokit.autopilots.base import Autopilot
    from aerokit.autopilots.telemetry import AutopilotVersion
    from aerokit.connection.bus import Detach, EndSignal
    from aerokit.connection.cells import StateCell
    from aerokit.connection.connection import Connection
    from aerokit.connection.tasks import BackgroundTasks
    from aerokit.protocols.exchange import Exchange, OnProgress

logger: logging.Logger = logging.getLogger("aerokit")

ResultT = TypeVar("ResultT")

# Seconds to wait for AUTOPILOT_VERSION, which contains the capabilities.
VERSION_TIMEOUT_S = 3.0
BACKGROUND_COMMAND_TIMEOUT_S = 5.0

# A longer round trip of TIMESYNC was probably measured while the link paused. If the time-outs were based on it, a lost
# request would not be repeated before the transfer fails.
MAX_FIRST_ROUND_TRIP_S = 1.5


class Messaging(Protocol):
    """Interface that transfers need from the session of an autopilot or another component."""

    on_reboot: list[Callable[[], None]]

    @property
    def transfers(self) -> Transfers: ...

    def at_close(self, *functions: Detach) -> None:
        """Register callbacks for the end of the vehicle's `async with` block."""


def _without_errors(on_progress: OnProgress) -> OnProgress:
    """Return a callback that logs the errors of ``on_progress`` instead of raising them."""

    def report(progress: TransferProgress) -> None:
        try:
            on_progress(progress)
        except Exception:
            logger.exception("on_progress raised an exception; the transfer continues")

    return report


class Transfers:
    """Runs exchanges of requests and answers with one component, and provides its capabilities."""

    def __init__(
        self,
        connection: Connection,
        system_id: int,
        component_id: int,
        *,
        autopilot: Autopilot,
        version: StateCell[AutopilotVersion],
        background: BackgroundTasks,
        end: EndSignal,
        describe: Callable[[], str],
        round_trip_s: Callable[[], float | None] = lambda: None,
        round_trip: RoundTrip | None = None,
        send_command: Callable[..., Awaitable[object]] | None = None,
        request_version: Callable[[], Awaitable[object]] | None = None,
    ) -> None:
        self.connection = connection
        self.began_at: float = connection.now()
        """Start time of the session on the event loop's clock.

        MAVFTP derives its first sequence number from this time, so that the number differs from earlier programs'.
        """
        self.system_id: int = system_id
        self.component_id: int = component_id
        self.autopilot = autopilot
        self.background = background
        self._round_trip: RoundTrip = RoundTrip() if round_trip is None else round_trip
        self._end = end
        # True once a component has not answered the request for its version.
        self._is_version_unavailable = False
        self._send_command = send_command
        self._request_version = request_version
        self._version = version
        # Describes the link, for error texts.
        self._describe = describe
        self._round_trip_s = round_trip_s

    @property
    def round_trip(self) -> RoundTrip:
        """Round-trip time: measured by TIMESYNC at first, and by transfers from the first one on."""
        if self._round_trip.smoothed_s is None:
            seconds = self._round_trip_s()
            if seconds is not None:
                self._round_trip.add_sample(min(seconds, MAX_FIRST_ROUND_TRIP_S))
        return self._round_trip

    async def run(self, exchange: Exchange[ResultT], *, timeout: float | None = None) -> ResultT:
        """Run one exchange to its end and return its result.

        Cancellation ends the exchange at once. Raises :class:`OperationTimeout` after ``timeout`` seconds, or when the
        exchange itself times out, and :class:`OperationRejected` if the link was reopened meanwhile and may lead to
        another vehicle.
        """
        self._end.raise_if_ended()
        connection, has_changed_boot = self.connection, False
        was_held_back = connection.is_held_back(self.system_id)  # If True, the exchange begins after the proof.

        def on_reboot(event: VehicleRebooted) -> None:
            nonlocal has_changed_boot
            is_on_reopened_link = connection.is_held_back(self.system_id)
            if event.system_id == self.system_id and is_on_reopened_link and not was_held_back:
                has_changed_boot = True
                scope.cancel()

        with self.limit(timeout), anyio.CancelScope() as scope:
            if isinstance(exchange, Transfer) and exchange.on_progress is not None:
                exchange.on_progress = _without_errors(exchange.on_progress)
            detach_callbacks = [
                self._end.on_end(lambda _: scope.cancel()),
                connection.bus.attach_event(VehicleRebooted, on_reboot),
            ]
            try:
                result = await run_exchange(connection, self.system_id, exchange)
            except OperationTimeout as error:
                self._append_link_description(error)
                raise
            finally:
                for detach in detach_callbacks:
                    detach()
            if isinstance(result, dict):  # A request for several names returns one value or exception for each name.
                for answer in result.values():
                    if isinstance(answer, OperationTimeout):
                        self._append_link_description(answer)
            return result
        self._end.raise_if_ended()
        assert has_changed_boot  # Only `on_reboot` and the end of the session cancel `scope`.
        raise OperationRejected(f"the transfer has ended: {OTHER_BOOT}")

    def _append_link_description(self, error: OperationTimeout) -> None:
        error.args = (f"{error}; {self._describe()}",)

    @contextmanager
    def limit(self, timeout: float | None) -> Iterator[None]:
        """Raise OperationTimeout if a `with` block takes more than ``timeout`` seconds."""
        with anyio.move_on_after(timeout) as scope:
            yield
        if scope.cancelled_caught:
            raise OperationTimeout(f"the operation was not done within {timeout:g} s; {self._describe()}")

    def command_in_background(self, command: int, *params: float, was_just_sent: bool = False) -> None:
        """Send an optional command without waiting for its ack, and ignore failures.

        With ``was_just_sent``, the caller has sent the command already, so it is sent again only if no ack arrives.
        """
        send = self._send_command

        async def send_command() -> None:
            if send is not None:
                with suppress(AerokitError), anyio.move_on_after(BACKGROUND_COMMAND_TIMEOUT_S):
                    await send(command, *params, was_just_sent=was_just_sent)

        if self._end.error is None:
            self.background.start(send_command, "aerokit command of a transfer")

    @property
    def version(self) -> AutopilotVersion | None:
        return self._version.latest

    @property
    def version_cell(self) -> StateCell[AutopilotVersion]:
        return self._version

    @property
    def known_capabilities(self) -> int | None:
        """MAV_PROTOCOL_CAPABILITY bits of the component, None while unknown."""
        version = self._version.latest
        return None if version is None else version.capabilities

    async def capabilities(self) -> int | None:
        """Return the MAV_PROTOCOL_CAPABILITY bits, or None if they do not arrive in a few seconds."""
        # Later calls do not wait again for a component that has not answered.
        if not self._version.is_known and not self._is_version_unavailable:
            with anyio.move_on_after(VERSION_TIMEOUT_S), suppress(CommandRejected, CommandTimeout):
                if self._request_version is not None:
                    await self._request_version()
                await self._version.wait_until(lambda _: True)
            # An autopilot has no `request_version`: its session requests the version until it arrives.
            self._is_version_unavailable = self._request_version is not None and not self._version.is_known
        return self.known_capabilities
