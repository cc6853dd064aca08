"""`GimbalOrders`: what orders to one gimbal are sent as, and to whom: its manager, or the mount of an older vehicle."""

from __future__ import annotations

import asyncio
import math
from contextlib import suppress
from typing import TYPE_CHECKING, Any, NoReturn

from aerokit._internal.wording import shown
from aerokit.autopilots import GimbalRules
from aerokit.errors import AerokitError, CommandRejected, CommandTimeout, NotSupported
from aerokit.mavlink.enums import GimbalManagerFlags, MavCmd, MavMountMode, MavResult
from aerokit.mavlink.messages import GimbalManagerInformation, MountConfigure, MountControl

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from aerokit.connection.cells import StateCell
    from aerokit.mavlink.message import Message
    from aerokit.vehicle.commanding.context import Bridge
    from aerokit.vehicle.commanding.order import Order
    from aerokit.vehicle.gimbal.device import Claims, Device, GimbalControllers
    from aerokit.vehicle.gimbal.discovery import Hearing
    from aerokit.vehicle.session.session import Talk
    from aerokit.vehicle.state.equipment import GimbalAttitude

NAN = math.nan

PITCHYAW, CONFIGURE = MavCmd.DO_GIMBAL_MANAGER_PITCHYAW, MavCmd.DO_GIMBAL_MANAGER_CONFIGURE

MOUNT = MavCmd.DO_MOUNT_CONTROL

LEVEL = GimbalManagerFlags.ROLL_LOCK | GimbalManagerFlags.PITCH_LOCK
"""Roll and pitch from the horizon, yaw from the vehicle's nose."""

LOCKED = LEVEL | GimbalManagerFlags.YAW_LOCK
"""Yaw from north."""

RELEASE, UNCHANGED = -3, -1

FOUND_S = 1.0
"""How long what was promised may take to come."""

BY_THE_STANDARD = GimbalRules()


class GimbalOrders:
    """Of one gimbal, or of the first one. They end a wait for the one before; control is claimed when it is denied."""

    def __init__(self, bridge: Bridge, hearing: Hearing, device: Device | None) -> None:
        self.bridge: Bridge = bridge
        self.talk: Talk = bridge.talk
        self._hearing, self._device = hearing, device
        self._claimed: int | None = None
        """Whose control was claimed without a block: a component id."""

    # ------------------------------------------------------------------------- who is meant

    @property
    def device(self) -> Device:
        """The one that is meant now."""
        return self._hearing.first if self._device is None else self._device

    @property
    def shown(self) -> Device:
        """Whose cells programs see of it; for the first one they are those of whichever is the first."""
        return self._hearing.nobody if self._device is None else self._device

    @property
    def told(self) -> Device:
        """Who tells where it points: itself, or the mount of old while no gimbal tells at all."""
        is_mount = self._device is None and self._hearing.telling is None
        return self._hearing.nobody if is_mount else self.device

    @property
    def manager_id(self) -> int:
        """The component that the orders go to; the autopilot's while nobody has said that it is the manager."""
        manager_id = self.device.manager_id
        return self.talk.component_id if manager_id is None else manager_id

    def silent_for_s(self, component_id: int) -> float:
        """Seconds in which nothing was heard of a component; inf: it was never heard."""
        return self._hearing.silent_for_s(component_id)

    @property
    def parameter(self) -> int:
        """The gimbal device id in commands; an autopilot's first one needs none."""
        if self._device is None and self.manager_id == self.talk.component_id:
            return 0
        return self.device.device_id

    @property
    def rules(self) -> GimbalRules:
        """What its manager makes of the protocol."""
        is_autopilot = self.manager_id == self.talk.component_id
        return self.talk.autopilot.gimbals if is_autopilot else BY_THE_STANDARD

    @property
    def roi_parameter(self) -> int:
        """The gimbal device id in commands about a region of interest."""
        return self.parameter if self.rules.looks_with_each else 0

    def check_looks(self) -> None:
        """Raise what says so before anything is sent: not this gimbal, or control was lost."""
        if not self.rules.looks_with_each and self.parameter not in (0, 1):
            self.not_supported("looks at places and systems with its first gimbal only")
        self.raise_if_taken()

    @property
    def us(self) -> tuple[int, int]:
        """Our ids, as who is in control."""
        return self.talk.connection.source_system, self.talk.connection.source_component

    @property
    def name(self) -> str:
        """For error texts."""
        return f"gimbal {self.device.device_id}" if self.device.component_id else "the gimbal"

    @property
    def claims(self) -> Claims:
        """What blocks of this program want or have control of, of all gimbals of the vehicle."""
        return self._hearing.claims

    # ----------------------------------------------------------------------------- sending

    async def give(self, turn: Order | None, command: int, *params: float, is_sent: bool = False) -> None:
        """One command to the manager, of an order, or on its own."""
        with self.bridge.arbiter.aside(turn) as order:
            await self.bridge.sender.give(
                order,
                self.talk.commands.send_long,
                command,
                *params,
                component_id=self.manager_id,
                is_sent=is_sent,
            )

    def begin(self) -> Order:
        """A new order: those before end."""
        return self.bridge.arbiter.of_device(self.device.topic)

    async def insist(self, command: int, send: Callable[[], Awaitable[None]]) -> None:
        """Send a command, and claim control if that is denied, now or to somebody who did not wait for the answer."""
        self.raise_if_taken()
        self.claim_if_denied(command)
        try:
            await send()
        except CommandRejected:
            self.raise_if_taken()
            if not self.claim_if_denied(command):
                raise
            await send()

    async def manage(self, turn: Order, pitch: float, yaw: float, *rates: float, flags: int) -> bool:
        """PITCHYAW, in degrees; False for a manager that does not know it. Control is claimed if that is denied."""
        if self.talk.commands.is_unknown(PITCHYAW, self.manager_id):
            return False
        pitch_rate, yaw_rate = rates or (NAN, NAN)
        params = (pitch, yaw, pitch_rate, yaw_rate, flags, 0, self.parameter)
        try:
            await self.insist(PITCHYAW, lambda: self.give(turn, PITCHYAW, *params))
        except CommandRejected as error:
            if error.result != MavResult.UNSUPPORTED:
                raise
            return False
        return True

    async def look(self, turn: Order, command: int, *params: float, **place: Any) -> None:
        """A command about a region of interest, as COMMAND_INT if it has a place."""

        async def send() -> None:
            with self.bridge.arbiter.aside(turn) as order:
                commands = self.talk.commands
                await self.bridge.sender.give(
                    order,
                    commands.send_int if place else commands.send_long,
                    command,
                    *params,
                    component_id=self.manager_id,
                    **place,
                )

        if self.rules.looking_needs_control:
            await self.insist(command, send)
        else:
            await send()

    async def mount(self, turn: Order, mode: int, pitch: float = 0, roll: float = 0, yaw: float = 0) -> bool:
        """DO_MOUNT_CONTROL; False for firmware that is older, and was told the mode by a message without an answer."""
        if not self.talk.commands.is_unknown(MOUNT, self.manager_id):
            try:
                await self.give(turn, MOUNT, pitch, roll, yaw, 0, 0, 0, mode)
            except CommandRejected as error:
                if error.result != MavResult.UNSUPPORTED:
                    raise
            else:
                return True
        if not turn.is_newest:
            return True
        self.talk.send(MountConfigure(self.talk.system_id, self.manager_id, mode, 1, 1, 1))
        return False

    async def mount_to(self, turn: Order, pitch: float, roll: float, yaw: float, *, from_nose: bool) -> None:
        """The mount's angles, whose yaw is from the nose: right at the moment of the order."""
        heading = self.talk.telemetry.attitude.latest
        nose = 0.0 if heading is None else heading.yaw_deg
        turned = yaw if from_nose else math.remainder(yaw - nose, 360.0)
        if not await self.mount(turn, MavMountMode.MAVLINK_TARGETING, pitch, roll, turned):
            north = yaw + nose if from_nose else yaw
            a, b, c = (round(each * 100) for each in (pitch, roll, north))
            self.talk.send(MountControl(self.talk.system_id, self.manager_id, a, b, c, 0))

    def ask_in_background(self, message_id: int) -> None:
        """Have the manager send a message once; that it may not is nobody's business."""

        async def ask() -> None:
            with suppress(AerokitError):
                await self.ask(message_id, self.manager_id)

        self.talk.background.start(ask, "aerokit gimbal")

    async def ask(self, message_id: int, component_id: int, *, attempts: int = 3) -> None:
        """REQUEST_MESSAGE: a question, asked again until it is answered.

        Raises:
            CommandRejected: it has no such message, or not now.
            CommandTimeout: there was no answer.
        """
        await self.talk.commands.send_long(
            MavCmd.REQUEST_MESSAGE, message_id, component_id=component_id, attempts=attempts
        )

    async def hear(self, found: Callable[[], object], kind: type[Message], within_s: float) -> None:
        """Wait until something has come that was promised in messages of a kind, for so long at most."""
        done = asyncio.Event()

        def look(_: Message) -> None:
            if found() is not None:
                done.set()

        if found() is not None:
            return
        bus = self.talk.connection.bus
        detach = bus.attach(kind, look, system_id=self.talk.system_id)
        too_late = asyncio.get_running_loop().call_later(within_s, done.set)
        try:
            await done.wait()
        finally:
            too_late.cancel()
            detach()

    async def find_manager(self) -> int:
        """Who manages it: what was told, or, of a gimbal with an id of its own, itself if it says so when asked."""
        device = self.device
        if device.manager_id is None and device.component_id:
            with suppress(CommandRejected, CommandTimeout):
                await self.ask(GimbalManagerInformation.ID, device.component_id, attempts=1)
                await self.hear(lambda: device.manager_id, GimbalManagerInformation, FOUND_S)
        return self.manager_id

    # ----------------------------------------------------------------------------- control

    def configure(self, *, is_primary: bool, release: bool = False) -> tuple[float, ...]:
        """The parameters that claim control, or let it go: ids in figures, because PX4's "whoever asks" is PX4."""
        pair = (RELEASE, RELEASE) if release else self.us
        unchanged = (UNCHANGED, UNCHANGED)
        return (
            *(pair if is_primary else unchanged),
            *(unchanged if is_primary else pair),
            0,
            0,
            self.parameter,
        )

    def claim_if_denied(self, command: int) -> bool:
        """Say that we are in control, if the last answer denied us something, whoever waited for it."""
        commands, manager_id = self.talk.commands, self.manager_id
        if self.device.controls or commands.last_result(command, manager_id) != MavResult.DENIED:
            return False
        commands.forget_result(command, manager_id)
        params = self.us if self.parameter == 0 else (*self.us, UNCHANGED, UNCHANGED, 0, 0, self.parameter)
        commands.send_unconfirmed(CONFIGURE, *params, component_id=manager_id)
        self._claimed = manager_id
        return True

    async def let_go(self, turn: Order) -> None:
        """What was claimed without a block."""
        if self._claimed == self.manager_id:
            self._claimed = None
            params = (
                (RELEASE, RELEASE) if self.parameter == 0 else self.configure(is_primary=True, release=True)
            )
            await self.give(turn, CONFIGURE, *params)

    def raise_if_taken(self) -> None:
        """Nothing is ordered by who had control in a block that is still open, and has lost it."""
        controls = self.device.controls.values()
        if not any(each.is_held for each in controls):
            for each in controls:
                each.raise_if_taken()

    @property
    def is_taken(self) -> bool:
        """Whether a block that is still open has lost control, and no other one has it."""
        controls = self.device.controls.values()
        return bool(controls) and not any(each.is_held for each in controls)

    def not_supported(self, what: str) -> NoReturn:
        """What the manager does not do, told before anything is sent."""
        autopilot = self.talk.autopilot
        who = autopilot.firmware if self.manager_id == self.talk.component_id else shown(self.manager_id)
        raise NotSupported(f"{self.name}: {who} {what}; nothing was sent")


class GimbalPart:
    """A part of :class:`Gimbal`: its state, and some of its orders."""

    def __init__(self, bridge: Bridge, hearing: Hearing, device: Device | None) -> None:
        self._orders = GimbalOrders(bridge, hearing, device)
        self._bridge, self._talk = bridge, bridge.talk
        shown = self._orders.shown
        self.attitude: StateCell[GimbalAttitude] = shown.attitude
        """Where it points (GIMBAL_DEVICE_ATTITUDE_STATUS of any component of the vehicle, MOUNT_ORIENTATION,
        MOUNT_STATUS). The autopilot is asked for it while somebody waits, follows or observes; reading asks nothing."""
        self.controllers: StateCell[GimbalControllers] = shown.controllers
        """Who is in control of it, as its manager tells by itself (GIMBAL_MANAGER_STATUS)."""

    @property
    def device_id(self) -> int:
        """Its gimbal device id: 1 to 6 behind its manager, or its component id; 0 while none is heard of."""
        return self._orders.device.device_id

    def _now(self) -> float:
        return self._talk.connection.now()
