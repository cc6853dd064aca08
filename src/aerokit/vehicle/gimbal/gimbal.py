"""``Gimbal`` and ``Gimbals``: the gimbals of one vehicle."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

import anyio

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit._internal.async_block import ReadOnly
from aerokit.errors import BusyError, CommandRejected, CommandTimeout, InvalidArgument
from aerokit.mavlink.enums import MavCmd
from aerokit.mavlink.messages import GimbalDeviceInformation, GimbalManagerInformation, GlobalPositionInt
from aerokit.position import Home, Position, position_with_altitude
from aerokit.vehicle.gimbal.control import GimbalControl
from aerokit.vehicle.gimbal.device import MAX_GIMBAL_NUMBER, YawFrame, information_of
from aerokit.vehicle.gimbal.discovery import MAX_GIMBALS, GimbalRegistry
from aerokit.vehicle.gimbal.orders import GimbalMixin
from aerokit.vehicle.gimbal.pointing import (
    AngleTarget,
    PointingMixin,
    attitude_stream,
    direction_to,
    wait_until_reached,
)
from aerokit.vehicle.gimbal.rates import GimbalRates

if TYPE_CHECKING:
    from collections.abc import Iterator

    from typing_extensions import Self

    from aerokit.connection.bus import Detach
    from aerokit.mavlink.message import Message
    from aerokit.vehicle.commanding.context import VehicleContext
    from aerokit.vehicle.gimbal.device import GimbalDevice, GimbalInformation
    from aerokit.vehicle.gimbal.pointing import Angles

__all__ = ["Gimbal", "Gimbals"]

# Maximum age of another vehicle's position. An older position is not used.
POSITION_MAX_AGE_S = 5.0


class _SystemTracker:
    """Context manager that tracks the position of another system on this connection."""

    def __init__(self, context: VehicleContext, system_id: int) -> None:
        self._context, self._system_id = context, system_id
        self._position: Position | None = None
        self._received_at = 0.0
        self._detach: Detach | None = None

    def __enter__(self) -> Self:
        bus = self._context.session.connection.bus
        self._detach = bus.attach(GlobalPositionInt, self._on_position, system_id=self._system_id)
        return self

    def __exit__(self, *_: object) -> None:
        if self._detach is not None:
            self._detach()

    def direction(self) -> Angles | None:
        """Return the direction from the vehicle to the other system, or None while it is unknown."""
        if self._position is None or self._context.session.connection.now() - self._received_at > POSITION_MAX_AGE_S:
            return None
        return direction_to(self._context, self._position)

    def _on_position(self, message: GlobalPositionInt) -> None:
        if message.lat or message.lon:
            self._position = Position(message.lat * 1e-7, message.lon * 1e-7, altitude_amsl_m=message.alt * 1e-3)
            self._received_at = self._context.session.connection.now()


@checks_arguments
class RoiMixin(GimbalMixin):
    """Region of interest: pointing a gimbal at a position or another vehicle. A newer order ends the previous one."""

    async def look_at(
        self, target: Position | Home, *, wait: bool = True, tolerance_deg: float = 5.0, timeout: float = 15.0
    ) -> None:
        """Keep the gimbal pointed at a position; returns when it points there.

        Sends MAV_CMD_DO_SET_ROI_LOCATION. A target without an altitude is at the vehicle's own altitude. If the gimbal
        of a copter cannot turn to the side, the copter turns its nose.

        Args:
            target: the position.
            wait: False: return when the manager has accepted the order.
            tolerance_deg: accepted deviation in each axis, above 0 and at most 45.
            timeout: seconds to wait.

        Raises:
            InvalidArgument: the tolerance is out of range. Nothing was sent.
            NotSupported: the manager supports regions of interest for its first gimbal only. Nothing was sent.
            ValueUnknownError: the target needs home or the vehicle's altitude, which is unknown. Nothing was sent.

        Otherwise raises as :meth:`neutral`.
        """
        check_range("tolerance_deg", tolerance_deg, 0, 45, above=True)
        orders = self._orders
        orders.check_roi()
        target = position_with_altitude(target)
        place = self._context.vehicle_position.command_int_place(target)
        order = orders.begin_order()
        aim = AngleTarget(
            lambda: direction_to(self._context, target),
            tolerance_deg,
            "the vehicle's position, or the height difference to the target, is unknown",
        )
        with attitude_stream(orders), self._session.streaming("position"):
            since = self._now()
            await orders.send_roi(order, MavCmd.DO_SET_ROI_LOCATION, orders.roi_parameter, **place)
            if wait:
                await wait_until_reached(orders, order, f"{orders.name}: look_at", aim, since=since, timeout=timeout)

    async def look_at_system(
        self, system_id: int, *, wait: bool = True, tolerance_deg: float = 5.0, timeout: float = 15.0
    ) -> None:
        """Keep the gimbal pointed at another vehicle (MAV_CMD_DO_SET_ROI_SYSID); returns when it points there.

        Both the gimbal's manager and this connection must receive the position of the other vehicle
        (GLOBAL_POSITION_INT).

        Args:
            system_id: MAVLink system id of the other vehicle, 1 to 255.
            wait: False: return when the manager has accepted the order.
            tolerance_deg: accepted deviation in each axis, above 0 and at most 45.
            timeout: seconds to wait.

        Raises:
            InvalidArgument: the system id or the tolerance is out of range. Nothing was sent.
            NotSupported: the manager does not support this command. Nothing was sent.

        Otherwise raises as :meth:`neutral`.
        """
        if isinstance(system_id, bool):  # True would mean system 1.
            raise InvalidArgument(f"system_id = {system_id} is not allowed: it must be 1 to 255")
        check_range("system_id", system_id, 1, 255)
        check_range("tolerance_deg", tolerance_deg, 0, 45, above=True)
        orders = self._orders
        orders.check_roi()
        if not orders.rules.supports_roi_sysid:
            raise orders.not_supported("cannot point a gimbal at another system")
        order = orders.begin_order()
        with (
            _SystemTracker(self._context, system_id) as tracker,
            attitude_stream(orders),
            self._session.streaming("position"),
        ):
            since = self._now()
            await orders.send_roi(order, MavCmd.DO_SET_ROI_SYSID, system_id, orders.roi_parameter)
            if wait:
                aim = AngleTarget(tracker.direction, tolerance_deg, f"the position of system {system_id} is unknown")
                description = f"{orders.name}: look_at_system({system_id})"
                await wait_until_reached(orders, order, description, aim, since=since, timeout=timeout)

    async def stop_looking(self) -> None:
        """End :meth:`look_at` (MAV_CMD_DO_SET_ROI_NONE). Afterwards the gimbal manager chooses the direction.

        Raises:
            CommandRejected: the manager refused.
            CommandTimeout: there was no answer.
            GimbalTaken: your program had control and lost it.
            OperationRejected: another order was given before the answer.
        """
        orders = self._orders
        orders.raise_if_taken()
        await orders.send_roi(orders.begin_order(), MavCmd.DO_SET_ROI_NONE, orders.roi_parameter)


# Seconds to wait for the information after the manager has accepted the request.
INFORMATION_TIMEOUT_S = 2.0


def _is_new(message: Message | None, old_message: Message | None) -> bool:
    return message is not None and message is not old_message


@checks_arguments
class Gimbal(ReadOnly, PointingMixin, RoiMixin):
    """One gimbal with the gimbal protocol v2 (https://mavlink.io/en/services/gimbal_v2.html), or an older mount.

    ``vehicle.gimbal`` is the first gimbal, ``vehicle.gimbals`` has all gimbals. An order returns when the gimbal
    reports the ordered direction, and raises an error when another order is given. While the vehicle moves, the gimbal
    keeps the direction in the frame of the order, e.g. its yaw from north or from the nose. If the manager accepts
    orders only from the station in control, an order outside a block of :meth:`control` claims control, and keeps it
    until :meth:`release`.
    """

    async def information(self) -> GimbalInformation:
        """Request capabilities, limits and identity (GIMBAL_MANAGER_INFORMATION, GIMBAL_DEVICE_INFORMATION).

        Afterwards, angles beyond the gimbal's limits are refused before anything is sent.

        Raises:
            CommandRejected: there is no gimbal manager, or it does not support the messages.
            CommandTimeout: there was no answer.
        """
        orders = self._orders
        manager_id = await orders.find_manager()
        failure: CommandRejected | CommandTimeout | None = None
        # Messages that were received before do not count as answers.
        old_manager = orders.device.manager_information
        old_device = orders.device.device_information

        def has_manager_answered() -> bool:
            return _is_new(orders.device.manager_information, old_manager)

        def has_device_answered() -> bool:
            return _is_new(orders.device.device_information, old_device)

        try:
            await orders.ask(GimbalManagerInformation.ID, manager_id)
            await orders.wait_for(has_manager_answered, GimbalManagerInformation, INFORMATION_TIMEOUT_S)
        except (CommandRejected, CommandTimeout) as error:
            failure = error
        device = orders.device
        is_placeholder = device.component_id == 0
        if failure is None or not is_placeholder:  # The component id to ask is known.
            has_own_id = not is_placeholder and device.number == 0
            target = device.component_id if has_own_id else manager_id
            with suppress(CommandRejected, CommandTimeout):
                # For a servo gimbal, autopilots do not send GIMBAL_DEVICE_INFORMATION.
                await orders.ask(GimbalDeviceInformation.ID, target, attempts=1)
                await orders.wait_for(has_device_answered, GimbalDeviceInformation, INFORMATION_TIMEOUT_S)
        if not has_manager_answered() and not has_device_answered():
            raise failure or CommandTimeout(
                f"{orders.name}: the request for information was accepted, but no information was received;"
                f" {self._session.describe_link()}"
            )
        device = orders.device  # The answers may have shown that another gimbal is the first one.
        device.checks_limits = True
        return information_of(
            device.device_id, orders.manager_id, device.manager_information, device.device_information
        )

    def control(self, *, secondary: bool = False) -> GimbalControl:
        """Control the gimbal for the duration of an ``async with`` block; see :class:`GimbalControl`.

        Args:
            secondary: take secondary control, alongside the station that has primary control.
        """
        return GimbalControl(self._orders, is_primary=not secondary)

    def rates(
        self,
        pitch_deg_s: float = 0.0,
        yaw_deg_s: float = 0.0,
        *,
        frame: YawFrame = "vehicle",
        rate_hz: float = 10.0,
        valid_for_s: float = 1.0,
        max_lag_s: float = 0.5,
    ) -> GimbalRates:
        """Turn the gimbal at rates that the ``async with`` block supplies; see :class:`GimbalRates`.

        Args:
            pitch_deg_s: the first rate in degrees per second, −720 to 720; positive is up.
            yaw_deg_s: the first rate in degrees per second, −720 to 720; positive is to the right.
            frame: ``"earth"``: the yaw stays relative to north; ``"vehicle"``: the gimbal turns with the vehicle.
            rate_hz: how often the latest rates are sent, 2 to 100.
            valid_for_s: stop the gimbal if no new rates are set for this many seconds.
            max_lag_s: if the event loop is blocked for longer than this many seconds, stop the gimbal as soon as the
                loop runs again.

        Raises:
            InvalidArgument: a value is out of range. Nothing was sent.
        """
        is_from_north = frame == "earth"
        return GimbalRates(self._orders, (pitch_deg_s, yaw_deg_s), is_from_north, rate_hz, valid_for_s, max_lag_s)


# Component id that addresses all components.
BROADCAST_COMPONENT = 0


@checks_arguments
class Gimbals:
    """The discovered gimbals: ``vehicle.gimbals[154]``; ``for gimbal in vehicle.gimbals``.

    A gimbal is identified by its gimbal device id: its component id (154, 171 to 175), or 1 to 6 if attached to the
    autopilot.
    """

    def __init__(self, context: VehicleContext) -> None:
        self._context = context
        self._registry = GimbalRegistry(context)
        self._gimbals: dict[tuple[int, int], Gimbal] = {}
        self.first: Gimbal = Gimbal(context, self._registry, None)
        """The first gimbal. A gimbal attached to the autopilot comes before gimbals with their own component id."""

    @property
    def ids(self) -> tuple[int, ...]:
        """Gimbal device ids of the discovered gimbals, beginning with that of :attr:`first`."""
        return tuple(device.device_id for device in self._sorted())

    def get(self, device_id: int) -> Gimbal:
        """Return the gimbal of this id, whether or not it has been discovered.

        Args:
            device_id: 1 to 6 if attached to the autopilot, or a component id up to 255.

        Raises:
            InvalidArgument: the id is out of range.
            BusyError: the maximum number of gimbals is reached.
        """
        check_range("device_id", device_id, 1, 255)
        device = self._registry.find(device_id)
        if device is None and device_id <= MAX_GIMBAL_NUMBER:  # It is attached to the autopilot.
            device = self._registry.get_or_create(self._context.session.component_id, number=device_id)
        elif device is None:
            device = self._registry.get_or_create(device_id, number=0)
        if device is None:
            raise BusyError(f"there are {MAX_GIMBALS} gimbals already: {', '.join(map(str, self.ids))}")
        return self._gimbal(device)

    async def discover(self, *, timeout: float = 2.0) -> tuple[int, ...]:
        """Ask all components which gimbals they manage (GIMBAL_MANAGER_INFORMATION), then return :attr:`ids`.

        Args:
            timeout: seconds to wait for answers; the call always takes this time.

        Raises:
            ConnectionClosed, LinkLost: the connection ended.
        """
        session = self._context.session
        deadline = session.connection.now() + timeout
        with anyio.move_on_after(timeout):
            # If one component refuses the request to all components, others may still send the message.
            with suppress(CommandRejected, CommandTimeout):
                await session.commands.send_long(
                    MavCmd.REQUEST_MESSAGE, GimbalManagerInformation.ID, component_id=BROADCAST_COMPONENT, attempts=2
                )
        await anyio.sleep(max(0.0, deadline - session.connection.now()))
        session.end.raise_if_ended()
        return self.ids

    def __getitem__(self, device_id: int) -> Gimbal:
        return self.get(device_id)

    def __iter__(self) -> Iterator[Gimbal]:
        return iter([self._gimbal(device) for device in self._sorted()])

    def _sorted(self) -> list[GimbalDevice]:
        return sorted(self._registry.devices.values(), key=self._registry.sort_key)

    def _gimbal(self, device: GimbalDevice) -> Gimbal:
        if device.key not in self._gimbals:
            self._gimbals[device.key] = Gimbal(self._context, self._registry, device)
        return self._gimbals[device.key]

    def __len__(self) -> int:
        return len(self._registry.devices)
