"""``Vehicle`` for programs without ``async``, and ``connect``, which makes one."""

from __future__ import annotations

import contextlib
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeVar

from aerokit.arguments import checked
from aerokit.errors import ConnectionClosed
from aerokit.mavlink.dialect import STANDARD
from aerokit.runtime.connection import MAV_COMP_ID_MISSIONPLANNER
from aerokit.sync.blocking_block import BlockingBlock
from aerokit.sync.cells import StateCell
from aerokit.sync.connection import Connection
from aerokit.sync.files import Files
from aerokit.sync.guided import Guided
from aerokit.sync.logs import Logs
from aerokit.sync.loop_thread import LoopThread
from aerokit.sync.mission import FenceControl, MissionControl, RallyControl
from aerokit.sync.parameters import Parameters
from aerokit.sync.state import VehicleState
from aerokit.sync.subscription import Subscription
from aerokit.vehicle.connect import connect as connect_async
from aerokit.vehicle.connect import tell_how_it_is_left
from aerokit.vehicle.progress import LONGEST_SILENCE_S

if TYPE_CHECKING:
    import os
    from collections.abc import Callable, Iterator, Mapping
    from types import TracebackType

    from typing_extensions import Self

    from aerokit.links.allowed import Peers
    from aerokit.links.link import Link
    from aerokit.mavlink.dialect import Dialect
    from aerokit.mavlink.message import Message
    from aerokit.mavlink.messages import CommandAck
    from aerokit.mavlink.signing import Signing
    from aerokit.protocols.command import Standing
    from aerokit.runtime.events import Event
    from aerokit.runtime.subscription import Overflow
    from aerokit.sync.loop_thread import Held
    from aerokit.vehicle.values import Position
    from aerokit.vehicle.vehicle import Vehicle as AsyncVehicle

__all__ = ["Vehicle", "connect"]

ItemT = TypeVar("ItemT", bound="Message | Event")
MessageT = TypeVar("MessageT", bound="Message")


@checked
def connect(
    address: str | Link | Connection,
    *,
    system_id: int | None = None,
    timeout: float = 30.0,
    rates: Mapping[type[Message], float] | None = None,
    source_system: int = 255,
    source_component: int = MAV_COMP_ID_MISSIONPLANNER,
    baud: int = 57600,
    dialect: Dialect = STANDARD,
    mavlink_version: int = 2,
    signing: Signing | None = None,
    record: str | os.PathLike[str] | None = None,
    reconnect: bool = False,
    peers: Peers | None = None,
    may_move: bool = False,
) -> Vehicle:
    """Connect to a vehicle and return it at its first heartbeat; use it in a ``with`` block, or close it yourself.

    Arguments and errors are those of :func:`aerokit.connect`. The vehicle has a loop thread of its own, or, given a
    connection of :func:`aerokit.sync.open_connection`, shares that of the connection.
    """
    loop = address._loop if isinstance(address, Connection) else LoopThread()
    try:
        held = loop.hold_open(
            connect_async(
                address.aio if isinstance(address, Connection) else address,
                system_id=system_id,
                timeout=timeout,
                rates=rates,
                source_system=source_system,
                source_component=source_component,
                baud=baud,
                dialect=dialect,
                mavlink_version=mavlink_version,
                signing=signing,
                record=record,
                reconnect=reconnect,
                peers=peers,
                may_move=may_move,
            )
        )
    except BaseException:
        if not isinstance(address, Connection):
            loop.close()
        raise
    return Vehicle(loop, held, owns_loop=not isinstance(address, Connection))


class Vehicle(VehicleState, BlockingBlock):
    """One vehicle, blocking; the methods, arguments and errors of :class:`aerokit.Vehicle`. A context manager.

    Made by :func:`aerokit.sync.connect`. Methods block, properties never do. Any thread may use it.
    """

    _opened_by = "connect"

    def __init__(self, loop: LoopThread, held: Held[AsyncVehicle], *, owns_loop: bool) -> None:
        super().__init__(loop, held.value)
        self._held, self._owns_loop = held, owns_loop
        self.connection = Connection(loop, self.aio.connection)
        """The connection it is reached by."""
        self.guided = Guided(loop, self.aio.guided)
        """Set-point streams: velocity, position, acceleration, attitude."""
        self.files = Files(loop, self.aio.files)
        """The files on it, by MAVFTP."""
        self.logs = Logs(loop, self.aio.logs)
        """Its flight logs."""
        self.parameters = Parameters(loop, self.aio.parameters)
        """The autopilot's parameters: download, get, set, transactions, what was changed."""
        self.mission = MissionControl(loop, self.aio.mission)
        """The mission it holds: upload, download, start, pause, wait until it is finished."""
        self.fence = FenceControl(loop, self.aio.fence)
        """The fence it holds."""
        self.rally = RallyControl(loop, self.aio.rally)
        """The rally points it holds."""

    def close(self) -> None:
        """Let the vehicle go: link, loop and thread end, calls that wait raise ConnectionClosed. Idempotent.

        Nothing is sent: a vehicle in the air goes on with what it does. A connection that was handed in stays open.
        """
        try:
            self._held.close()
        finally:
            if self._owns_loop:
                self._loop.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        was_told = self.aio._is_told_to_hold
        self.close()
        if exc is not None and not was_told:  # the loop's side knows of no exception
            tell_how_it_is_left(self.aio)

    def __repr__(self) -> str:
        return f"<Vehicle {self.system_id}/{self.component_id} {self.autopilot.firmware}, blocking>"

    # --------------------------------------------------------------------------- readiness

    def wait_ready(self, *, timeout: float = 90.0) -> None:
        """Wait until it could fly; see :meth:`aerokit.Vehicle.wait_ready`."""
        self._loop.run(self.aio.wait_ready, timeout=timeout)

    def why_not_armable(self) -> list[str]:
        """Return the reasons why arming would be refused now; see :meth:`aerokit.Vehicle.why_not_armable`."""
        return self._loop.run(self.aio.why_not_armable)

    # ----------------------------------------------------------------------------- actions

    def set_mode(self, mode: str | int, *, timeout: float = 6.0) -> None:
        """Change the flight mode and wait until HEARTBEAT tells it; see :meth:`aerokit.Vehicle.set_mode`."""
        self._loop.run(self.aio.set_mode, mode, timeout=timeout)

    def arm(
        self,
        *,
        mode: str | int | None = None,
        force: bool = False,
        timeout: float = 10.0,
        max_silence_s: float | None = LONGEST_SILENCE_S,
    ) -> None:
        """Arm the motors: **propellers may start to turn**; see :meth:`aerokit.Vehicle.arm`."""
        self._loop.run(self.aio.arm, mode=mode, force=force, timeout=timeout, max_silence_s=max_silence_s)

    def disarm(
        self,
        *,
        force: bool = False,
        timeout: float = 10.0,
        max_silence_s: float | None = LONGEST_SILENCE_S,
    ) -> None:
        """Stop the motors (``force``: also in the air, **it falls**); see :meth:`aerokit.Vehicle.disarm`."""
        self._loop.run(self.aio.disarm, force=force, timeout=timeout, max_silence_s=max_silence_s)

    def take_off(
        self,
        altitude_m: float,
        *,
        timeout: float = 60.0,
        max_silence_s: float | None = LONGEST_SILENCE_S,
    ) -> None:
        """Take off and climb to ``altitude_m`` metres above home; see :meth:`aerokit.Vehicle.take_off`."""
        self._loop.run(self.aio.take_off, altitude_m, timeout=timeout, max_silence_s=max_silence_s)

    def go_to(
        self,
        target: Position,
        *,
        speed_m_s: float | None = None,
        heading_deg: float | None = None,
        tolerance_m: float | None = None,
        timeout: float | None = None,
        max_silence_s: float | None = LONGEST_SILENCE_S,
    ) -> None:
        """Fly to a place and return on arrival; see :meth:`aerokit.Vehicle.go_to`."""
        self._loop.run(
            self.aio.go_to,
            target,
            speed_m_s=speed_m_s,
            heading_deg=heading_deg,
            tolerance_m=tolerance_m,
            timeout=timeout,
            max_silence_s=max_silence_s,
        )

    def land(self, *, timeout: float | None = 300.0, max_silence_s: float | None = LONGEST_SILENCE_S) -> None:
        """Land where the vehicle is; see :meth:`aerokit.Vehicle.land`."""
        self._loop.run(self.aio.land, timeout=timeout, max_silence_s=max_silence_s)

    def return_to_launch(
        self, *, timeout: float | None = 600.0, max_silence_s: float | None = LONGEST_SILENCE_S
    ) -> None:
        """Return to the launch place; see :meth:`aerokit.Vehicle.return_to_launch`."""
        self._loop.run(self.aio.return_to_launch, timeout=timeout, max_silence_s=max_silence_s)

    def hold(self) -> None:
        """Stop and stay; see :meth:`aerokit.Vehicle.hold`."""
        self._loop.run(self.aio.hold)

    def set_speed(self, speed_m_s: float) -> None:
        """Change the ground speed for flying somewhere, m/s; see :meth:`aerokit.Vehicle.set_speed`."""
        self._loop.run(self.aio.set_speed, speed_m_s)

    def set_heading(
        self,
        heading_deg: float,
        *,
        relative: bool = False,
        rate_deg_s: float = 0.0,
        tolerance_deg: float = 5.0,
        timeout: float = 60.0,
        max_silence_s: float | None = LONGEST_SILENCE_S,
    ) -> None:
        """Turn on the spot and return when the nose points there; see :meth:`aerokit.Vehicle.set_heading`."""
        self._loop.run(
            self.aio.set_heading,
            heading_deg,
            relative=relative,
            rate_deg_s=rate_deg_s,
            tolerance_deg=tolerance_deg,
            timeout=timeout,
            max_silence_s=max_silence_s,
        )

    def look_at(self, target: Position) -> None:
        """Make nose or gimbal point at a place; see :meth:`aerokit.Vehicle.look_at`."""
        self._loop.run(self.aio.look_at, target)

    def stop_looking(self) -> None:
        """End :meth:`look_at`."""
        self._loop.run(self.aio.stop_looking)

    def reboot(self, *, force: bool = False, timeout: float = 60.0) -> None:
        """Reboot the autopilot and wait until it is back; see :meth:`aerokit.Vehicle.reboot`."""
        self._loop.run(self.aio.reboot, force=force, timeout=timeout)

    def setup_signing(self, signing: Signing | None, *, timeout: float = 5.0) -> None:
        """Give the vehicle a key, **in clear**, or take it away; see :meth:`aerokit.Vehicle.setup_signing`."""
        self._loop.run(self.aio.setup_signing, signing, timeout=timeout)

    # ---------------------------------------------------------------- commands and messages

    def command(
        self,
        command: int,
        *params: float,
        component_id: int | None = None,
        attempts: int = 4,
        attempt_timeout: float = 1.0,
        progress_timeout: float = 10.0,
        on_progress: Callable[[int | None], None] | None = None,
        standing: Standing | None = None,
    ) -> CommandAck:
        """Send any MAV_CMD as COMMAND_LONG and return its ACCEPTED ack; see :meth:`aerokit.Vehicle.command`."""
        return self._loop.run(
            self.aio.command,
            command,
            *params,
            component_id=component_id,
            attempts=attempts,
            attempt_timeout=attempt_timeout,
            progress_timeout=progress_timeout,
            on_progress=on_progress,
            standing=standing,
        )

    def command_int(
        self,
        command: int,
        *params: float,
        frame: int,
        x: int = 0,
        y: int = 0,
        z: float = 0.0,
        component_id: int | None = None,
        attempts: int = 4,
        attempt_timeout: float = 1.0,
        progress_timeout: float = 10.0,
        on_progress: Callable[[int | None], None] | None = None,
        standing: Standing | None = None,
    ) -> CommandAck:
        """Send any MAV_CMD as COMMAND_INT; see :meth:`aerokit.Vehicle.command_int`."""
        return self._loop.run(
            self.aio.command_int,
            command,
            *params,
            frame=frame,
            x=x,
            y=y,
            z=z,
            component_id=component_id,
            attempts=attempts,
            attempt_timeout=attempt_timeout,
            progress_timeout=progress_timeout,
            on_progress=on_progress,
            standing=standing,
        )

    def send(self, message: Message) -> None:
        """Send one message as it is, once. Its ``target_system`` is yours to set."""
        self._loop.call(self.aio.send, message)

    def subscribe(
        self,
        *types: type[ItemT],
        capacity: int = 1,
        overflow: Overflow = "drop_oldest",
        rate_hz: float | None = None,
    ) -> Subscription[ItemT]:
        """Return a stream of messages or events, for use in a ``with`` block; see :meth:`aerokit.Vehicle.subscribe`."""
        return Subscription(
            self._loop, self.aio.subscribe(*types, capacity=capacity, overflow=overflow, rate_hz=rate_hz)
        )

    def message(self, message_type: type[MessageT], *, rate_hz: float | None = None) -> StateCell[MessageT]:
        """The latest message of a kind as it came, in a cell; see :meth:`aerokit.Vehicle.message`."""
        cell = self._loop.call(self.aio.message, message_type, rate_hz=rate_hz)
        return StateCell(self._loop, cell)

    @contextmanager
    def rate(self, message_type: type[Message], rate_hz: float) -> Iterator[None]:
        """Have the vehicle send ``message_type`` at ``rate_hz`` or faster for the time of the ``with`` block."""
        rate = self.aio.rate(message_type, rate_hz)
        self._loop.enter_at_once(rate)
        try:
            yield
        finally:
            with contextlib.suppress(ConnectionClosed):
                self._loop.call(rate.__exit__, None, None, None)
