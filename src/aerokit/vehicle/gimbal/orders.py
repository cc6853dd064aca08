"""`GimbalOrders`: sends orders to the manager of one gimbal, or to the mount of older firmware."""

from __future__ import annotations

import asyncio
import math
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import anyio

from aerokit._internal.formatting import short_repr
from aerokit.autopilots import GimbalRules
from aerokit.errors import AerokitError, CommandRejected, CommandTimeout, NotSupported
from aerokit.mavlink.enums import GimbalManagerFlags, MavCmd, MavMountMode, MavResult
from aerokit.mavlink.messages import GimbalManagerInformation, MountConfigure, MountControl
from aerokit.vehicle.commanding.sender import revoked_acceptance

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from aerokit.connection.cells import StateCell
    from aerokit.mavlink.message import Message
    from aerokit.vehicle.commanding.context import VehicleContext
    from aerokit.vehicle.commanding.order import Order
    from aerokit.vehicle.gimbal.device import GimbalControllers, GimbalDevice
    from aerokit.vehicle.gimbal.discovery import GimbalRegistry
    from aerokit.vehicle.session.session import VehicleSession
    from aerokit.vehicle.state.equipment import GimbalAttitude

NAN = math.nan
PITCHYAW, CONFIGURE = MavCmd.DO_GIMBAL_MANAGER_PITCHYAW, MavCmd.DO_GIMBAL_MANAGER_CONFIGURE
MOUNT = MavCmd.DO_MOUNT_CONTROL

AIMING_COMMANDS = (PITCHYAW, MOUNT, MavCmd.DO_SET_ROI_LOCATION, MavCmd.DO_SET_ROI_SYSID)

# With these flags, roll and pitch are relative to the horizon, and yaw is relative to the vehicle's nose.
LEVEL = GimbalManagerFlags.ROLL_LOCK | GimbalManagerFlags.PITCH_LOCK

# With these flags, roll and pitch are relative to the horizon, and yaw is relative to north.
LOCKED = LEVEL | GimbalManagerFlags.YAW_LOCK

# Ids with a special meaning in MAV_CMD_DO_GIMBAL_MANAGER_CONFIGURE.
RELEASE, UNCHANGED = -3, -1
MANAGER_TIMEOUT_S = 1.0
HEADING_TIMEOUT_S = 3.0
STANDARD_RULES = GimbalRules()


class GimbalOrders:
    """Sends orders to ``device``, or to the first gimbal if ``device`` is None.

    A new order ends the wait for the previous one.
    """

    def __init__(self, context: VehicleContext, registry: GimbalRegistry, device: GimbalDevice | None) -> None:
        self.context: VehicleContext = context
        self.session: VehicleSession = context.session
        self.registry: GimbalRegistry = registry
        self._device = device
        # The manager from which control was requested outside of `async with gimbal.control()`.
        self._claimed_manager_id: int | None = None

    @property
    def device(self) -> GimbalDevice:
        """The gimbal that orders go to."""
        return self.registry.first if self._device is None else self._device

    @property
    def public_device(self) -> GimbalDevice:
        """The device whose state cells the program reads."""
        return self.registry.placeholder if self._device is None else self._device

    @property
    def attitude_source(self) -> GimbalDevice:
        # MOUNT_STATUS and MOUNT_ORIENTATION (older firmware) name no gimbal, so the placeholder has their attitude.
        is_mount = self._device is None and self.registry.first_reporting is None
        return self.registry.placeholder if is_mount else self.device

    @property
    def manager_id(self) -> int:
        manager_id = self.device.manager_id
        # The autopilot counts as the manager until one is known.
        return self.session.component_id if manager_id is None else manager_id

    @property
    def gimbal_id_param(self) -> int:
        if self._device is None and self.manager_id == self.session.component_id:
            # 0 stands for the first gimbal of an autopilot.
            return 0
        return self.device.device_id

    @property
    def rules(self) -> GimbalRules:
        is_autopilot = self.manager_id == self.session.component_id
        # A manager other than the autopilot is expected to follow the standard.
        return self.session.autopilot.gimbals if is_autopilot else STANDARD_RULES

    @property
    def roi_parameter(self) -> int:
        return self.gimbal_id_param if self.rules.roi_per_gimbal else 0

    def check_roi(self) -> None:
        if not self.rules.roi_per_gimbal and self.gimbal_id_param not in (0, 1):
            raise self.not_supported("supports a region of interest for its first gimbal only")
        self.raise_if_taken()

    @property
    def own_ids(self) -> tuple[int, int]:
        return self.session.connection.source_system, self.session.connection.source_component

    @property
    def name(self) -> str:
        return f"gimbal {self.device.device_id}" if self.device.component_id else "the gimbal"

    async def send(self, order: Order | None, command: int, *params: float) -> None:
        """Send a COMMAND_LONG to the manager, as a part of ``order``; None if the command is an order of its own."""
        with self.context.arbiter.auxiliary_order(order) as sent_order:
            await self.context.sender.send_long(sent_order, command, *params, component_id=self.manager_id)

    def begin_order(self) -> Order:
        return self.context.arbiter.device_order(self.device.topic)

    async def send_claiming_control(self, command: int, send: Callable[[], Awaitable[None]]) -> None:
        """Send a command. If the manager denies it, claim control and send it again."""
        self.raise_if_taken()
        self.claim_if_denied(command)  # The previous command of this type may have been denied for lack of control.
        try:
            await send()
        except CommandRejected:
            self.raise_if_taken()
            was_claimed = self.claim_if_denied(command)
            # Nothing was claimed if control was not missing, or if a `gimbal.control()` block claims it.
            if not was_claimed:
                raise
            await send()

    async def send_pitch_yaw(
        self, order: Order, pitch: float, yaw: float, *, rates: tuple[float, float] = (NAN, NAN), flags: int
    ) -> bool:
        """Send MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW. Return False if the manager does not support it.

        Angles are in degrees, ``rates`` (pitch, yaw) in degrees per second. NaN leaves a value to the gimbal.
        """
        if self.session.commands.is_unsupported(PITCHYAW, self.manager_id):
            return False
        reserved = 0
        params = (pitch, yaw, *rates, flags, reserved, self.gimbal_id_param)
        try:
            await self.send_claiming_control(PITCHYAW, lambda: self.send(order, PITCHYAW, *params))
        except CommandRejected as error:
            if error.result != MavResult.UNSUPPORTED:
                raise
            return False
        return True

    async def send_roi(self, order: Order, command: int, *params: float, **place: Any) -> None:
        async def send() -> None:
            with self.context.arbiter.auxiliary_order(order) as sent_order:
                commands = self.session.commands
                await self.context.sender.run_command(
                    sent_order,
                    commands.send_int if place else commands.send_long,  # Only COMMAND_INT can have a place.
                    command,
                    *params,
                    component_id=self.manager_id,
                    **place,
                )

        if self.rules.roi_needs_control:
            await self.send_claiming_control(command, send)
        else:
            await send()

    async def send_mount_mode(self, order: Order, mode: int, pitch: float = 0, roll: float = 0, yaw: float = 0) -> bool:
        """Send DO_MOUNT_CONTROL, or MOUNT_CONFIGURE to older firmware.

        Returns True if the angles were sent. MOUNT_CONFIGURE contains only the mode.
        """
        self.raise_if_taken()
        if not self.session.commands.is_unsupported(MOUNT, self.manager_id):
            try:
                unused_place = (0, 0, 0)  # altitude, latitude, longitude
                await self.send(order, MOUNT, pitch, roll, yaw, *unused_place, mode)
            except CommandRejected as error:
                if error.result != MavResult.UNSUPPORTED:
                    raise
            else:
                return True
        stabilized = {"stab_roll": 1, "stab_pitch": 1, "stab_yaw": 1}
        self._send_unanswered(order, MountConfigure(self.session.system_id, self.manager_id, mode, **stabilized))
        return False

    def _send_unanswered(self, order: Order, message: Message) -> None:
        """Send a message that has no ack. Raises OperationRejected if a newer order was given after ``order``."""
        with self.context.arbiter.auxiliary_order(order):
            self.session.send(message)

    async def send_mount_angles(self, order: Order, pitch: float, roll: float, yaw: float, *, from_nose: bool) -> None:
        """Send mount angles in degrees.

        Raises OperationTimeout if the vehicle's heading is needed and stays unknown.
        """
        # The mount turns with the vehicle, so a yaw from north is correct only at the time of sending.
        yaw_from_nose = yaw if from_nose else math.remainder(yaw - await self._heading(), 360.0)
        were_angles_sent = await self.send_mount_mode(order, MavMountMode.MAVLINK_TARGETING, pitch, roll, yaw_from_nose)
        if not were_angles_sent:
            # MOUNT_CONTROL, for older firmware, has a yaw from north, and all angles in centidegrees.
            yaw_from_north = yaw + await self._heading() if from_nose else yaw
            message = MountControl(
                self.session.system_id,
                self.manager_id,
                input_a=round(pitch * 100),
                input_b=round(roll * 100),
                input_c=round(yaw_from_north * 100),
                save_position=0,
            )
            self._send_unanswered(order, message)

    async def _heading(self) -> float:
        """Return the vehicle's heading in degrees. Wait for it if no recent one is known."""
        heading = self.registry.heading()
        if heading is None:
            with self.session.streaming("attitude"):
                attitude = await self.session.telemetry.attitude.wait_until(
                    lambda _: self.registry.heading() is not None,
                    timeout=HEADING_TIMEOUT_S,
                    description=f"{self.name}: the vehicle's heading, to convert the yaw",
                )
            heading = attitude.yaw_deg
        return heading

    def ask_in_background(self, message_id: int) -> None:
        async def ask() -> None:
            with suppress(AerokitError):
                await self.ask(message_id, self.manager_id)

        self.session.background.start(ask, "aerokit gimbal")

    async def ask(self, message_id: int, component_id: int, *, attempts: int = 3) -> None:
        await self.session.commands.send_long(
            MavCmd.REQUEST_MESSAGE, message_id, component_id=component_id, attempts=attempts
        )

    async def wait_for(self, is_done: Callable[[], bool], message_type: type[Message], within_s: float) -> None:
        """Wait until ``is_done()`` or for ``within_s`` seconds. Each message of the type causes a check."""
        done = asyncio.Event()

        def check(_: Message) -> None:
            if is_done():
                done.set()

        if is_done():
            return
        bus = self.session.connection.bus
        detach = bus.attach(message_type, check, system_id=self.session.system_id)
        try:
            with anyio.move_on_after(within_s):
                await done.wait()
        finally:
            detach()

    async def find_manager(self) -> int:
        """Return the component id of the manager.

        If none is known, first ask the device whether it is its own manager.
        """
        device = self.device
        if device.manager_id is None and device.component_id:
            # If the device does not answer, the autopilot counts as the manager.
            with suppress(CommandRejected, CommandTimeout):
                await self.ask(GimbalManagerInformation.ID, device.component_id, attempts=1)
                await self.wait_for(lambda: device.manager_id is not None, GimbalManagerInformation, MANAGER_TIMEOUT_S)
        return self.manager_id

    def control_params(self, *, is_primary: bool, release: bool = False) -> tuple[float, ...]:
        # -2 would stand for the sender of the command, but PX4 then gives control to itself (input_mavlink.cpp).
        controller = (RELEASE, RELEASE) if release else self.own_ids
        unchanged = (UNCHANGED, UNCHANGED)
        primary, secondary = (controller, unchanged) if is_primary else (unchanged, controller)
        reserved = (0, 0)
        return (*primary, *secondary, *reserved, self.gimbal_id_param)

    def claim_if_denied(self, command: int) -> bool:
        """Claim control if the manager denied this command because we are not in control.

        Returns True if a claim was sent. Its answer is not awaited.
        """
        commands, manager_id = self.session.commands, self.manager_id
        # An open `gimbal.control()` block has requested control itself, and reports if it loses control.
        if self.device.control_blocks or commands.last_result(command, manager_id) != MavResult.DENIED:
            return False
        commands.forget_result(command, manager_id)  # One denial must not lead to a second claim.
        commands.send_unconfirmed(CONFIGURE, *self.control_params(is_primary=True), component_id=manager_id)
        self._claimed_manager_id = manager_id
        return True

    async def release_control(self, order: Order) -> None:
        """Release control that was claimed outside of a control block."""
        if self._claimed_manager_id == self.manager_id:
            await self.send(order, CONFIGURE, *self.control_params(is_primary=True, release=True))
            self._claimed_manager_id = None

    def raise_if_taken(self) -> None:
        """Raise GimbalTaken if the open control blocks have lost control."""
        if self.is_taken:
            for block in self.device.control_blocks:
                block.raise_if_taken()

    def raise_if_refused(self, description: str, since: float) -> None:
        """Raise CommandRejected if the manager has refused an order that counted as accepted from ``since`` on."""
        for command in AIMING_COMMANDS:
            result = self.session.commands.late_refusal(command, self.manager_id, since)
            if result is not None:
                raise revoked_acceptance(description, command, result)

    @property
    def is_taken(self) -> bool:
        blocks = self.device.control_blocks
        return bool(blocks) and not any(block.is_held for block in blocks)

    def not_supported(self, predicate: str) -> NotSupported:
        autopilot = self.session.autopilot
        manager = autopilot.firmware if self.manager_id == self.session.component_id else short_repr(self.manager_id)
        return NotSupported(f"{self.name}: {manager} {predicate}; nothing was sent")


class GimbalMixin:
    """Base class of the mixins of :class:`Gimbal`."""

    def __init__(self, context: VehicleContext, registry: GimbalRegistry, device: GimbalDevice | None) -> None:
        self._orders = GimbalOrders(context, registry, device)
        self._context, self._session = context, context.session
        public_device = self._orders.public_device
        self.attitude: StateCell[GimbalAttitude] = public_device.attitude
        """Attitude (GIMBAL_DEVICE_ATTITUDE_STATUS of any component of the vehicle, MOUNT_ORIENTATION, MOUNT_STATUS).
        It is requested from the autopilot while your program watches this value; reading the value requests nothing.
        """
        self.controllers: StateCell[GimbalControllers] = public_device.controllers
        """Stations in control, as reported by the manager (GIMBAL_MANAGER_STATUS)."""

    @property
    def device_id(self) -> int:
        """Gimbal device id: 1 to 6 if attached to its manager, or the component id; 0 until a gimbal is discovered."""
        return self._orders.device.device_id

    def _now(self) -> float:
        return self._session.connection.now()
