"""``CameraLink``: the connection to one camera, which has its own component id or is attached to the autopilot."""

from __future__ import annotations

import math
from contextlib import asynccontextmanager, suppress
from typing import TYPE_CHECKING, Any

import anyio

from aerokit.connection.cells import Source, StateCell
from aerokit.errors import AerokitError, CommandRejected, NotSupported, OperationTimeout
from aerokit.mavlink import messages as m
from aerokit.vehicle.camera.orders import (
    AUTOPILOT_CAMERA_IDS,
    MAYBE_UNSUPPORTED,
    CameraOrders,
    MessageRequests,
    MessageT,
)
from aerokit.vehicle.camera.values import CameraInformation, information_of

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable

    from aerokit.connection.bus import Detach
    from aerokit.events import Event
    from aerokit.mavlink.message import Message
    from aerokit.vehicle.commanding.context import VehicleContext
    from aerokit.vehicle.commanding.order import Order
    from aerokit.vehicle.components.component import Component
    from aerokit.vehicle.session.session import VehicleSession

# A camera with a component id sends a HEARTBEAT within this time.
DISCOVERY_TIMEOUT_S = 2.5

# After a silence of more than this many seconds, another camera may be using the component id.
MAX_SILENCE_S = 5.0


class CameraLink(CameraOrders):
    """Sends commands to one camera and receives its messages.

    ``number`` is 1 to 6 for a camera attached to the autopilot, otherwise its component id. None: the first camera that
    is found.
    """

    def __init__(
        self,
        context: VehicleContext,
        component_of: Callable[[int], Component],
        number: int | None,
        *,
        on_bound: Callable[[int], None] = lambda _: None,
    ) -> None:
        self.context: VehicleContext = context
        self.session: VehicleSession = context.session
        self._component_of = component_of
        # Called with the number of the camera as soon as it is known.
        self._on_bound = on_bound
        # True if another object publishes the events of this camera.
        self.is_muted = False
        # The component and the number of the camera are None until a camera is found.
        self._component: Component | None = None
        self.number = None
        self._ordered_topics = set()
        self._listeners: list[tuple[type[Message], Callable[[Any], object]]] = []
        self._detach_listeners: list[Detach] = []
        self._cells: list[StateCell[Any]] = []
        self.requests: MessageRequests = MessageRequests(self)
        self._is_polling = False
        # Messages that the camera refused to send.
        self.unavailable: set[type[Message]] = set()
        # Called when the camera's log of captures was cleared.
        self.on_cleared: list[Callable[[], None]] = []
        self._identify_lock = anyio.Lock()
        self._is_number_confirmed = anyio.Event()
        self._heartbeat_at = -math.inf
        # True if an identified camera was silent and must identify itself again: another camera may now use its id.
        self._must_identify_again = False
        self.session.on_reboot.append(self._on_reboot)
        self.information: StateCell[CameraInformation] = self.new_cell("camera.information", "CAMERA_INFORMATION")
        self.listen(m.CameraInformation, self._on_information)
        self.listen(m.Heartbeat, self._on_heartbeat)
        if number is not None:
            self.bind(number)

    @property
    def is_trigger(self) -> bool:
        """True if the camera is only a trigger output of the autopilot."""
        return self.is_autopilot_attached and self.session.autopilot.camera_by_trigger_only

    @property
    def video_stream(self) -> int:
        """Stream id for recording commands; 0 means all streams. ArduPilot takes it for the number of the camera."""
        return self.device_id if self.session.autopilot.video_addresses_camera else 0

    def publish(self, event_type: type[Event], *fields: Any) -> None:
        if not self.is_muted:
            self.session.publish(event_type, *fields, self.component.component_id)

    def call_later(self, seconds: float, action: Callable[[], None]) -> None:
        """Call ``action`` after a delay. The end of the vehicle's `async with` block prevents the call."""

        async def wait() -> None:
            await anyio.sleep(seconds)
            action()

        self.session.background.start(wait, "aerokit camera timer")

    def timeout_error(self, predicate: str) -> OperationTimeout:
        """Return an error with the text ``camera 100 <predicate>; <state of the link>``."""
        return OperationTimeout(f"{self.describe()} {predicate}; {self.session.describe_link()}")

    def describe(self) -> str:
        """Return e.g. ``camera 100 (Acme Zoom)``, for error texts."""
        information = self.information._latest
        model = "" if information is None else f"{information.vendor} {information.model}".strip()
        model = "".join(character for character in model if character.isprintable())
        return f"camera {self.number} ({model})" if model else f"camera {self.number}"

    def bind(self, number: int, *, is_guess: bool = False) -> None:
        """Use the camera with this number. A guess is replaced by a later call, unless it has been given orders."""
        # Orders that were given to the guessed camera must not be repeated to another one.
        has_given_orders = any(self.context.arbiter.latest(topic) is not None for topic in self._ordered_topics)
        if self._is_number_confirmed.is_set() or has_given_orders:
            return
        if not is_guess:
            self._is_number_confirmed.set()
        if number != self.number:  # The guessed number was wrong.
            self._change_number(number)

    def _change_number(self, number: int) -> None:
        self.number = number
        self._on_bound(number)
        component_id = self.session.component_id if number in AUTOPILOT_CAMERA_IDS else number
        self._component = self._component_of(component_id)
        self._heartbeat_at = self.session.connection.last_heartbeat_at(self.session.system_id, component_id)
        # Refusals and values so far are about the camera that was guessed.
        self._forget_refusals()
        for cell in self._cells:
            cell.forget()
        for detach in self._detach_listeners:
            detach()
        for message_type, callback in self._listeners:
            self._attach_listener(message_type, callback)

    def start_polling(self) -> None:
        """Start polling state values in the background. Call it on the event loop's thread."""
        if not self._is_polling:
            self._is_polling = True
            self.session.background.start(self.requests.run, "aerokit camera")

    async def identify(self) -> CameraInformation | None:
        """Find the camera, and request its information if that is not known yet.

        Returns None if an autopilot sends no information about its camera.
        """
        if self._needs_information():
            async with self._identify_lock:
                if self.number is None:
                    await self._find_first_camera()
                # Another call may have received the information while this call waited for the lock.
                asked_number: int | None = None
                while self._needs_information() and not self.is_trigger and self.number != asked_number:
                    # If the number is a guess, another camera may be found during the request, and is then asked.
                    asked_number = self.number
                    await self._request_information()
        return self.information.latest

    def _needs_information(self) -> bool:
        return not self.information.is_known or self._must_identify_again

    async def _find_first_camera(self) -> None:
        # A camera with its own component id takes precedence over one that is attached to the autopilot, so
        # wait for the heartbeat of such a camera.
        connected_for_s = self.now() - self.session.transfers.began_at
        with anyio.move_on_after(max(0.0, DISCOVERY_TIMEOUT_S - connected_for_s)):
            await self._is_number_confirmed.wait()
        if self.number is None:  # Until a camera sends a message, assume that one is attached to the autopilot.
            self.bind(AUTOPILOT_CAMERA_IDS[0], is_guess=True)

    async def _request_information(self) -> None:
        # An autopilot may have no information about a camera that is attached to it.
        must_identify = not self.is_autopilot_attached
        try:
            await self.requests.request(m.CameraInformation, self.device_id, where=self._is_from_this_camera)
        except CommandRejected:
            # Information that was received earlier stays valid: after a silence, it is usually the same camera.
            if must_identify and not self.information.is_known:
                raise
        if must_identify and not self.information.is_known:
            raise self.timeout_error("did not identify itself")

    async def require_capability(self, action: str, *capabilities: str) -> None:
        """Raise NotSupported if the camera is known to have none of ``capabilities``.

        A trigger output has only "capture_image". Any other camera that reports no capabilities passes the check.
        """
        information = await self.identify()
        if self.is_trigger and "capture_image" not in capabilities:
            raise NotSupported(
                f"{action}: {self.describe()} is a trigger output, which only takes pictures; nothing was sent"
            )
        if information is not None and not information.can(*capabilities):
            names = " or ".join(name.upper() for name in capabilities)
            raise NotSupported(f"{action}: {self.describe()} does not have {names}; nothing was sent")

    async def request(
        self,
        message_type: type[MessageT],
        *params: float,
        where: Callable[[MessageT], bool] | None = None,
        timeout: float = 3.0,
    ) -> MessageT | None:
        """Request one message. Returns None if the camera refuses or does not answer."""

        def is_answer(message: MessageT) -> bool:
            return self._is_from_this_camera(message) and (where is None or where(message))

        try:
            answer = await self.requests.request(message_type, *params, where=is_answer, timeout=timeout)
        except CommandRejected as error:
            if error.result in MAYBE_UNSUPPORTED:
                self.unavailable.add(message_type)
            return None
        if answer is not None:
            self.unavailable.discard(message_type)
        return answer

    def request_rate(self, message_type: type[Message], rate_hz: float) -> Detach:
        return self.component._session.rates.request(message_type, rate_hz, is_optional=True)

    def new_cell(self, name: str, waits_for: str) -> StateCell[Any]:
        cell: StateCell[Any] = self.session.connection.new_cell(name, waits_for)
        self.session.register_cell(cell)
        self._cells.append(cell)
        return cell

    def polled_cell(self, name: str, message_type: type[Message], period_s: float) -> StateCell[Any]:
        """Create a state value whose message is polled while the program uses the value."""
        cell = self.new_cell(name, message_type.NAME)
        self.requests.poll_for(cell, message_type, period_s)
        return cell

    def set_cell(self, cell: StateCell[Any], value: Any, message: Message) -> None:
        component_id = self.session.component_id if self._component is None else self._component.component_id
        cell.set(value, Source(self.session.system_id, component_id, message.NAME))

    def listen(self, message_type: type[Message], callback: Callable[[Any], object]) -> None:
        """Call ``callback`` with this camera's messages of one type, as soon as the camera is bound."""
        self._listeners.append((message_type, callback))
        if self._component is not None:
            self._attach_listener(message_type, callback)

    def _attach_listener(self, message_type: type[Message], callback: Callable[[Any], object]) -> None:
        bus, component_id = self.session.connection.bus, self.component.component_id

        def on_message(message: Any) -> None:
            frame = message.received_frame
            is_from_component = frame is not None and frame.component_id == component_id
            if is_from_component and self._is_from_this_camera(message):
                # Other messages do not prove that there is a camera: PX4 sends STORAGE_INFORMATION about its own card.
                if message_type.NAME.startswith("CAMERA_"):
                    self._is_number_confirmed.set()
                callback(message)

        if bus.dialect.get(message_type.ID) is not None:  # The user's dialect may lack a message.
            detach = bus.attach(message_type, on_message, system_id=self.session.system_id)
            self._detach_listeners.append(detach)
            self.session.at_close(detach)

    def _is_from_this_camera(self, message: Any) -> bool:
        if not self.is_autopilot_attached:
            return True
        # An autopilot may have several cameras. Each message type has only one or two of the fields below, and a
        # firmware may leave them at 0. If all are 0, the message is from the first camera.
        number_from_1 = getattr(message, "camera_device_id", 0) or getattr(message, "camera_id", 0)
        number_from_0 = getattr(message, "lens_id", 0) or getattr(message, "cam_idx", 0)
        return bool((number_from_1 or number_from_0 + 1) == self.number)

    def _on_heartbeat(self, _: m.Heartbeat) -> None:
        previous_at, self._heartbeat_at = self._heartbeat_at, self.now()
        is_first = previous_at == -math.inf
        if not is_first and self._heartbeat_at - previous_at > MAX_SILENCE_S:
            self._forget_refusals()
            self._must_identify_again = self.information._known
            if self._must_identify_again:
                self.session.background.start(self._identify_again, "aerokit camera after silence")

    async def _identify_again(self) -> None:
        with suppress(AerokitError):  # The next call to the camera identifies it again, and raises the error.
            await self.identify()

    def _on_reboot(self) -> None:
        self._forget_refusals()
        if self.is_autopilot_attached:
            for callback in self.on_cleared:
                callback()

    def _forget_refusals(self) -> None:
        self.unavailable.clear()
        self.requests.forget_refusals()

    def _on_information(self, message: m.CameraInformation) -> None:
        self._must_identify_again = False
        self.set_cell(self.information, information_of(message, self.number or 0), message)


class CameraMixin:
    """Base class of the mixins of :class:`Camera`."""

    def __init__(self, link: CameraLink) -> None:
        self._link = link


class ActiveOperation:
    """An operation of a camera that must be stopped at the end of its own block or of the vehicle's block."""

    def __init__(self, link: CameraLink, subject: str, stop_command: Callable[[], tuple[float, ...]]) -> None:
        self._link, self._stop_command = link, stop_command
        self.order: Order = link.begin_order(subject)
        # True once the stop command was sent, or is no longer needed.
        self._is_over = False
        self._detach_finish = link.context.on_finish(self._finish)

    @asynccontextmanager
    async def starting(self) -> AsyncIterator[None]:
        """Start the operation in this block. If the block raises, the operation ends."""
        try:
            yield
        except BaseException as error:
            cannot_have_started = not self.order.was_sent or isinstance(error, CommandRejected)
            if cannot_have_started:
                self.order.withdraw()
                self.discard()
            else:
                self.order.commit()
                # Do not wait for the answer to the stop command, so that the error is raised without delay.
                await self.stop(is_awaited=False)
            raise
        self.order.commit()

    def discard(self) -> None:
        """Mark the operation as ended without sending its stop command."""
        self._is_over = True
        self._detach_finish()

    async def stop(self, *, is_awaited: bool) -> None:
        """Send the stop command, once. After a newer order, nothing is sent."""
        if not self._is_over:
            self.discard()
            command, *params = self._stop_command()
            await self._link.end_operation(self.order, int(command), *params, is_awaited=is_awaited)

    def _finish(self) -> None:
        # The vehicle's `async with` block ends, so there is no time to wait for an answer.
        is_active = self.order.was_sent and self.order.is_newest
        self.discard()
        if is_active:
            command, *params = self._stop_command()
            self._link.send_now(int(command), *params)


class CameraBlock:
    """An operation of a camera for the duration of an ``async with`` block.

    The command to stop is sent at once when the block exits, also under cancellation, and retried. If the vehicle's
    block exits first, the command is sent once at that time. It is not sent after a newer order about the same subject.
    """

    def __init__(
        self,
        link: CameraLink,
        subject: str,
        check: Callable[[], Awaitable[None]],
        start: Callable[[Order], Awaitable[None]],
        stop_command: Callable[[], tuple[float, ...]],
    ) -> None:
        self._link = link
        self._subject = subject
        self._check = check
        self._start = start
        self._stop_command = stop_command
        self._operation: ActiveOperation | None = None

    async def __aenter__(self) -> None:
        await self._check()
        operation = ActiveOperation(self._link, self._subject, self._stop_command)
        self._operation = operation
        async with operation.starting():
            await self._start(operation.order)

    async def __aexit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        if self._operation is not None:
            await self._operation.stop(is_awaited=error is None)
