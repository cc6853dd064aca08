"""``CameraLine``: how one camera is found, told things and heard, whatever it is behind."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import TYPE_CHECKING, Any, TypeVar

import anyio

from aerokit.connection.cells import Source, StateCell
from aerokit.errors import (
    AerokitError,
    CommandRejected,
    CommandTimeout,
    NotSupported,
    OperationTimeout,
)
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd, MavResult
from aerokit.mavlink.message import Message
from aerokit.vehicle.camera.orders import Ordering
from aerokit.vehicle.camera.values import CameraInformation, information_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.connection.bus import Detach
    from aerokit.events import Event
    from aerokit.vehicle.commanding.context import Bridge
    from aerokit.vehicle.components.component import Component

WANTED_S = 10.0
"""Somebody has looked at a cell: so long its messages are asked for."""

LOOK_S = 1.0

MessageT = TypeVar("MessageT", bound=Message)

OF_OLD: dict[type[Message], tuple[int, tuple[float, ...]]] = {
    m.CameraInformation: (MavCmd.REQUEST_CAMERA_INFORMATION, (1,)),
    m.CameraSettings: (MavCmd.REQUEST_CAMERA_SETTINGS, (1,)),
    m.CameraCaptureStatus: (MavCmd.REQUEST_CAMERA_CAPTURE_STATUS, (1,)),
    m.StorageInformation: (MavCmd.REQUEST_STORAGE_INFORMATION, (0, 1)),
    m.CameraImageCaptured: (MavCmd.REQUEST_CAMERA_IMAGE_CAPTURE, (0,)),
    m.VideoStreamInformation: (MavCmd.REQUEST_VIDEO_STREAM_INFORMATION, (0,)),
    m.VideoStreamStatus: (MavCmd.REQUEST_VIDEO_STREAM_STATUS, (0,)),
}
"""What asked for a message before MAV_CMD_REQUEST_MESSAGE did, and its parameters; the first is the number of which."""

NUMBERED = (m.StorageInformation, m.CameraImageCaptured, m.VideoStreamInformation, m.VideoStreamStatus)

UNKNOWN = (MavResult.UNSUPPORTED, MavResult.DENIED)
"""Answers that mean: never, until it reboots. Others mean: not now."""

MAYBE_UNKNOWN = (*UNKNOWN, MavResult.FAILED)
"""ArduPilot says FAILED of messages that it does not know, others of what they cannot do now: asked for rarely."""

RARELY_S = 60.0


class _Wish:
    """Notices that somebody looks at a cell; the camera is asked for what tells it, and reading asks nothing itself."""

    def __init__(
        self, now: Callable[[], float], cell: StateCell[Any], message_type: type[Message], period_s: float
    ) -> None:
        self._now, self._cell = now, cell
        self.message_type, self.period_s = message_type, period_s
        self.looked_at = self.asked_at = -math.inf
        self.is_refused = self.is_doubtful = False
        cell._feed_from(self)

    @property
    def pending(self) -> bool:
        """Never: but who asks has looked."""
        self.looked_at = self._now()
        return False

    def catch_up(self) -> None:
        """There is nothing to work out."""

    def watchers_changed(self) -> None:
        """Somebody begins or ends to wait."""
        self.looked_at = self._now()

    def is_due(self) -> bool:
        """Whether to ask: somebody looks, and nothing has come or was asked for lately."""
        now = self._now()
        is_wanted = self._cell._is_watched or now - self.looked_at <= WANTED_S
        period_s = max(RARELY_S, self.period_s) if self.is_doubtful else self.period_s
        newest = max(self.asked_at, self._cell._updated_at)
        return is_wanted and not self.is_refused and now - newest >= period_s


class Questions:
    """Asks one camera."""

    def __init__(self, line: CameraLine) -> None:
        self._line = line
        self._wishes: list[_Wish] = []
        self._asked_as_of_old: set[type[Message]] = set()

    async def ask(
        self,
        message_type: type[MessageT],
        *params: float,
        where: Callable[[MessageT], bool] = lambda _: True,
        timeout: float = 3.0,
    ) -> MessageT | None:
        """Ask for one message; None when it does not come in time.

        Raises:
            CommandRejected: the camera does not know it.
        """
        refusal: CommandRejected | None = None
        if message_type not in self._asked_as_of_old:
            try:
                return await self._line.component.request(message_type, *params, where=where, timeout=timeout)
            except OperationTimeout:
                return None
            except CommandRejected as error:
                if message_type not in OF_OLD or error.result not in MAYBE_UNKNOWN or self._line.is_behind:
                    raise
                refusal = error
        try:
            found = await self._ask_as_of_old(message_type, params, where, timeout)
        except CommandRejected as error:
            raise refusal or error from None
        self._asked_as_of_old.add(message_type)
        return found

    async def _ask_as_of_old(
        self,
        message_type: type[MessageT],
        params: tuple[float, ...],
        where: Callable[[MessageT], bool],
        timeout: float,
    ) -> MessageT | None:
        command, (first, *others) = OF_OLD[message_type]
        if message_type in NUMBERED and params:
            first = params[0]
        with self._line.component.subscribe(message_type, capacity=100) as answers:
            with suppress(CommandTimeout):
                await self._line.component.command(command, first, *others, retries=1)
            with anyio.move_on_after(timeout):
                async for answer in answers:
                    if where(answer):
                        return answer
        return None

    def keep_fresh(self, cell: StateCell[Any], message_type: type[Message], period_s: float) -> None:
        """Have the message asked for every so often while somebody looks at the cell that it tells."""
        self._wishes.append(_Wish(self._line.now, cell, message_type, period_s))

    def forget_refusals(self) -> None:
        """The camera, or the vehicle, has rebooted."""
        self._asked_as_of_old.clear()
        for wish in self._wishes:
            wish.is_refused = wish.is_doubtful = False

    async def run(self) -> None:
        """Ask for what somebody looks at, until cancelled."""
        while True:
            await anyio.sleep(LOOK_S)
            for wish in self._wishes:
                if self._line.number is not None and wish.is_due():
                    await self._refresh(wish)

    async def _refresh(self, wish: _Wish) -> None:
        wish.asked_at = self._line.now()
        try:
            await self.ask(wish.message_type, timeout=LOOK_S)
        except CommandRejected as error:
            wish.is_refused = error.result in UNKNOWN
            wish.is_doubtful = error.result in MAYBE_UNKNOWN
        else:
            wish.is_doubtful = False


BEHIND = range(1, 7)
"""Numbers of cameras that have no component id of their own."""

HEARD_WITHIN_S = 2.5
"""A camera with a heartbeat of its own has been heard by then."""

SILENT_S = 5.0
"""Heartbeats come every second: after so long without one, whoever comes back may be another."""


class CameraLine(Ordering):
    """One camera: a component, and its device id there if the autopilot speaks for it.

    Without a ``number`` it is the first camera that is heard; until then nothing is known of it.
    """

    def __init__(
        self,
        bridge: Bridge,
        component_of: Callable[[int], Component],
        number: int | None,
        *,
        on_bound: Callable[[int], None] = lambda _: None,
    ) -> None:
        self._bridge, self._talk = bridge, bridge.talk
        self._component_of, self._on_bound = component_of, on_bound
        self.is_quiet = False
        """Another object tells of the pictures of this camera."""
        self._component: Component | None = None
        self.number: int | None = None
        """1 to 6 behind the autopilot, otherwise its component id; None until it is heard."""
        self._listeners: list[tuple[type[Message], Callable[[Any], object]]] = []
        self.questions: Questions = Questions(self)
        """What it is asked, for those who want to know of a refusal."""
        self._is_looking = False
        self.untold: set[type[Message]] = set()
        """Messages that the camera refused to send."""
        self.on_cleared: list[Callable[[], None]] = []
        """Called when the camera's log of pictures was cleared."""
        self._finding = anyio.Lock()
        self._is_bound = anyio.Event()
        self._heartbeat_at = -math.inf
        self._was_silent = False
        """It may be another camera now, or the same with other firmware."""
        self._talk.on_reboot.append(self._on_reboot)
        self.information: StateCell[CameraInformation] = self.cell("camera.information", "CAMERA_INFORMATION")
        self.listen(m.CameraInformation, self._on_information)
        self.listen(m.Heartbeat, self._on_heartbeat)
        if number is not None:
            self.bind(number)

    # ------------------------------------------------------------------------------- who it is

    @property
    def device(self) -> int:
        """The target camera id in commands: 0 is the component itself."""
        return self.number if self.number is not None and self.is_behind else 0

    @property
    def is_behind(self) -> bool:
        """Whether the autopilot speaks for it."""
        return self.number in BEHIND

    @property
    def by_trigger(self) -> bool:
        """Whether all that the autopilot has for it is its trigger."""
        return self.is_behind and self._talk.autopilot.cameras_by_trigger

    @property
    def video_stream(self) -> int:
        """The stream that is recorded: 0 is all of them."""
        return self.device if self._talk.autopilot.video_by_camera else 0

    @property
    def telemetry(self) -> Any:
        """The vehicle's."""
        return self._talk.telemetry

    @property
    def round_trip_s(self) -> float | None:
        """Measured by what keeps the clocks together."""
        return self._talk.link_watch.round_trip_s

    def publish(self, event_type: type[Event], *fields: Any) -> None:
        """Tell who listens to events of the vehicle, and of this component."""
        if not self.is_quiet:
            self._talk.publish(event_type, *fields, self.component.component_id)

    def later(self, seconds: float, action: Callable[[], None]) -> None:
        """Do something after so many seconds, unless the vehicle is let go before."""

        async def wait() -> None:
            await anyio.sleep(seconds)
            action()

        self._talk.background.start(wait, "aerokit camera, a moment later")

    def timed_out(self, what: str) -> OperationTimeout:
        """The error that says what the camera did not do in time, and how well it is heard."""
        return OperationTimeout(f"{self.describe()} {what}; {self._talk.describe_link()}")

    def describe(self) -> str:
        """For error texts."""
        information = self.information._latest
        told = "" if information is None else f"{information.vendor} {information.model}".strip()
        model = "".join(each for each in told if each.isprintable())
        return f"camera {self.number}{f' ({model})' if model else ''}"

    def now(self) -> float:
        """On the loop's clock."""
        return self._talk.connection.now()

    def bind(self, number: int) -> None:
        """It is this one from now on; once."""
        if self.number is not None:
            return
        self.number = number
        self._on_bound(number)
        component_id = self._talk.component_id if number in BEHIND else number
        self._component = self._component_of(component_id)
        self._heartbeat_at = self._talk.connection.heard_at(self._talk.system_id, component_id)
        self._is_bound.set()
        for message_type, take in self._listeners:
            self._attach(message_type, take)

    def look(self) -> None:
        """Begin to ask for what somebody looks at; on the loop's thread."""
        if not self._is_looking:
            self._is_looking = True
            self._talk.background.start(self.questions.run, "aerokit camera")

    async def find(self) -> CameraInformation | None:
        """Who it is, asked once; None of a camera behind the autopilot that says nothing of itself.

        Raises:
            OperationTimeout: no camera was heard, or it does not say what it is.
        """
        if not self.information.is_known or self._was_silent:
            async with self._finding:
                if self.number is None:
                    await self._find_first()
                if (not self.information.is_known or self._was_silent) and not self.by_trigger:
                    await self._ask_who()
        return self.information.latest

    async def _find_first(self) -> None:
        """One with a heartbeat of its own comes first; else the autopilot's, which is asked."""
        heard_for = self.now() - self._talk.transfers.began_at
        with anyio.move_on_after(max(0.0, HEARD_WITHIN_S - heard_for)):
            await self._is_bound.wait()
        if self.number is None:
            self.bind(BEHIND[0])

    async def _ask_who(self) -> None:
        try:
            await self.questions.ask(m.CameraInformation, self.device, where=self._is_its)
        except CommandRejected:
            if not self.is_behind and not self.information.is_known:
                raise
        if not self.information.is_known and not self.is_behind:
            raise self.timed_out("did not say what it is")

    async def able(self, action: str, *capabilities: str) -> None:
        """Raise NotSupported unless the camera says that it has one of these, or says nothing about what it can."""
        information = await self.find()
        if self.by_trigger and "capture_image" not in capabilities:
            raise NotSupported(
                f"{action}: {self.describe()} is a trigger, which takes pictures; nothing was sent"
            )
        if information is not None and not information.can(*capabilities):
            names = " or ".join(each.upper() for each in capabilities)
            raise NotSupported(f"{action}: {self.describe()} has no {names}; nothing was sent")

    # --------------------------------------------------------------------------------- asking

    async def ask(
        self,
        message_type: type[MessageT],
        *params: float,
        where: Callable[[MessageT], bool] | None = None,
        timeout: float = 3.0,
    ) -> MessageT | None:
        """Ask for one message; None when it does not come, or is not known there."""

        def is_meant(message: MessageT) -> bool:
            return self._is_its(message) and (where is None or where(message))

        try:
            answer = await self.questions.ask(message_type, *params, where=is_meant, timeout=timeout)
        except CommandRejected as error:
            if error.result in MAYBE_UNKNOWN:
                self.untold.add(message_type)
            return None
        if answer is not None:
            self.untold.discard(message_type)
        return answer

    # --------------------------------------------------------------------------------- hearing

    def want(self, message_type: type[Message], rate_hz: float) -> Detach:
        """Have the camera send a message at a rate, until what is returned is called."""
        return self.component._talk.rates.want(message_type, rate_hz, is_optional=True)

    def cell(self, name: str, waits_for: str) -> StateCell[Any]:
        """A state of the camera, which ends with the vehicle."""
        cell: StateCell[Any] = self._talk.connection.new_cell(name, waits_for)
        self._talk.keep(cell)
        return cell

    def asked_cell(self, name: str, message_type: type[Message], period_s: float) -> StateCell[Any]:
        """A state of which the message is asked for every so often while somebody looks at it."""
        cell = self.cell(name, message_type.NAME)
        self.questions.keep_fresh(cell, message_type, period_s)
        return cell

    def tell(self, cell: StateCell[Any], value: Any, message: Message) -> None:
        """Write a cell."""
        component_id = self._talk.component_id if self._component is None else self._component.component_id
        cell.set(value, Source(self._talk.system_id, component_id, message.NAME))

    def listen(self, message_type: type[Message], take: Callable[[Any], object]) -> None:
        """Have this camera's messages of a kind given to ``take``, from when it is known which one it is."""
        self._listeners.append((message_type, take))
        if self._component is not None:
            self._attach(message_type, take)

    def _attach(self, message_type: type[Message], take: Callable[[Any], object]) -> None:
        bus, component_id = self._talk.connection.bus, self.component.component_id

        def filtered(message: Any) -> None:
            frame = message.received_frame
            if frame is not None and frame.component_id == component_id and self._is_its(message):
                take(message)

        if bus.dialect.get(message_type.ID) is not None:
            self._talk.at_close(bus.attach(message_type, filtered, system_id=self._talk.system_id))

    def _is_its(self, message: Any) -> bool:
        """Firmware that does not know the field leaves 0 in it, and means its first camera."""
        if not self.is_behind:
            return True
        device = getattr(message, "camera_device_id", 0) or getattr(message, "camera_id", 0)
        counted_from_0 = getattr(message, "lens_id", 0) or getattr(message, "cam_idx", 0)
        return bool((device or counted_from_0 + 1) == self.number)

    def _on_heartbeat(self, _: m.Heartbeat) -> None:
        before, self._heartbeat_at = self._heartbeat_at, self.now()
        if self._heartbeat_at - before > SILENT_S and before > -math.inf:
            self._forget_refusals()
            self._was_silent = self.information._known
            if self._was_silent:
                self._talk.background.start(self._find_again, "aerokit camera, which was silent")

    async def _find_again(self) -> None:
        with suppress(AerokitError):
            await self.find()

    def _on_reboot(self) -> None:
        """Of the vehicle."""
        self._forget_refusals()
        if self.is_behind:
            for forget in self.on_cleared:
                forget()

    def _forget_refusals(self) -> None:
        """Whoever answers now may know more."""
        self.untold.clear()
        self.questions.forget_refusals()

    def _on_information(self, message: m.CameraInformation) -> None:
        self._was_silent = False
        self.tell(self.information, information_of(message, self.number or 0), message)
