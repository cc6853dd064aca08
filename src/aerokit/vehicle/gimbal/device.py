"""`GimbalDevice`: state of one gimbal and its manager."""

from __future__ import annotations

import math
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Literal, Protocol

from aerokit._internal.values import Snapshot
from aerokit.connection.cells import Source, StateCell
from aerokit.mavlink.enums import GimbalManagerCapFlags
from aerokit.mavlink.messages import GimbalDeviceAttitudeStatus
from aerokit.vehicle.session.subscriber import SUBSCRIPTION_HZ, WatchedStream

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from aerokit.connection.bus import Detach
    from aerokit.mavlink.message import Message
    from aerokit.mavlink.messages import GimbalDeviceInformation, GimbalManagerInformation, GimbalManagerStatus
    from aerokit.vehicle.commanding.context import VehicleContext
    from aerokit.vehicle.commanding.order import Topic
    from aerokit.vehicle.session.session import VehicleSession
    from aerokit.vehicle.state.equipment import GimbalAttitude

__all__ = ["GimbalControllers", "GimbalInformation", "YawFrame"]

YawFrame = Literal["earth", "vehicle"]
"""Reference of a yaw angle: true north, or the nose of the vehicle."""

CapFlags = GimbalManagerCapFlags


class GimbalControllers(Snapshot):
    """Controllers of a gimbal as (system id, component id); (0, 0) means none (GIMBAL_MANAGER_STATUS)."""

    primary: tuple[int, int]
    secondary: tuple[int, int]


class GimbalInformation(Snapshot):
    """Capabilities and identity of a gimbal (GIMBAL_MANAGER_INFORMATION, GIMBAL_DEVICE_INFORMATION).

    ``gimbal_device_id`` is the component id of the device, or 1 to 6 for a gimbal without its own component id, which
    is attached to its manager. ``manager_component_id`` is the component id of the manager. ``roll_deg``, ``pitch_deg``
    and ``yaw_deg`` are the lowest and highest angle, None if unknown. Texts are empty and ``uid`` is 0 if the device
    does not report them.
    """

    gimbal_device_id: int
    manager_component_id: int
    capabilities: int
    roll_deg: tuple[float, float] | None = None
    pitch_deg: tuple[float, float] | None = None
    yaw_deg: tuple[float, float] | None = None
    vendor: str = ""
    model: str = ""
    custom_name: str = ""
    firmware_version: str = ""
    hardware_version: str = ""
    uid: int = 0

    def can(self, capability: int) -> bool:
        """Return True if the gimbal has this capability, a member of ``enums.GimbalManagerCapFlags``."""
        return bool(self.capabilities & capability)

    @property
    def can_retract(self) -> bool:
        """True if the gimbal has a retracted position."""
        return self.can(CapFlags.HAS_RETRACT)

    @property
    def has_neutral(self) -> bool:
        """True if the gimbal has a neutral position."""
        return self.can(CapFlags.HAS_NEUTRAL)

    @property
    def axes(self) -> tuple[str, ...]:
        """The axes about which the gimbal rotates: some of ``"roll"``, ``"pitch"`` and ``"yaw"``."""
        bits = (("roll", CapFlags.HAS_ROLL_AXIS), ("pitch", CapFlags.HAS_PITCH_AXIS), ("yaw", CapFlags.HAS_YAW_AXIS))
        return tuple(name for name, bit in bits if self.can(bit))

    @property
    def can_point_at_location(self) -> bool:
        """True if the manager can point the gimbal at a global position."""
        return self.can(CapFlags.CAN_POINT_LOCATION_GLOBAL)


def information_of(
    device_id: int,
    manager_id: int,
    manager: GimbalManagerInformation | None,
    device: GimbalDeviceInformation | None,
) -> GimbalInformation:
    """Combine the messages of manager and device. The manager's limits take precedence."""
    source = manager or device
    assert source is not None
    information = GimbalInformation(
        gimbal_device_id=device_id,
        manager_component_id=manager_id,
        capabilities=source.cap_flags,
        roll_deg=_limits(source.roll_min, source.roll_max),
        pitch_deg=_limits(source.pitch_min, source.pitch_max),
        yaw_deg=_limits(source.yaw_min, source.yaw_max),
    )
    if device is None:
        return information
    return information.replace(
        vendor=device.vendor_name,
        model=device.model_name,
        custom_name=device.custom_name,
        firmware_version=_version(device.firmware_version),
        hardware_version=_version(device.hardware_version),
        uid=device.uid,
    )


def _limits(low: float, high: float) -> tuple[float, float] | None:
    # Devices send zeros for limits that they do not know.
    if not (math.isfinite(low) and math.isfinite(high)) or low >= high:
        return None
    # Adding 0.0 turns -0.0 into 0.0.
    return round(math.degrees(low), 2) + 0.0, round(math.degrees(high), 2) + 0.0


def _version(number: int) -> str:
    # Major, minor and patch, one byte each, lowest byte first.
    return "" if not number else f"{number & 0xFF}.{number >> 8 & 0xFF}.{number >> 16 & 0xFF}"


# Gimbals without their own component id are numbered from 1 to this.
MAX_GIMBAL_NUMBER = 6

# A status with a lower time stamp than the newest status arrived late. If the time stamp is lower by this many
# milliseconds or more, the manager has rebooted instead.
REORDER_WINDOW_MS = 5_000

ATTITUDE_MESSAGES = "GIMBAL_DEVICE_ATTITUDE_STATUS or MOUNT_ORIENTATION"


class ControlBlock(Protocol):
    """Interface of the ``async with`` blocks that control a gimbal."""

    @property
    def is_primary(self) -> bool: ...

    @property
    def is_held(self) -> bool: ...

    def raise_if_taken(self) -> None: ...


class GimbalDevice:
    """One gimbal, addressed by a number and by the component that sends its attitude.

    ``number`` is 1 to 6 for gimbals attached to that component, and 0 if the component itself is the gimbal. Before any
    gimbal is discovered, a placeholder with ``component_id`` 0 stands for the first gimbal.
    """

    def __init__(self, context: VehicleContext, component_id: int, number: int) -> None:
        self.component_id: int = component_id
        self.number: int = number
        # Component id of the manager; None while it is unknown. A gimbal without its own component id is attached to
        # its manager.
        self.manager_id: int | None = component_id if number else None
        self.flags: int = 0  # the latest GIMBAL_DEVICE_FLAGS
        self.failures: int = 0  # the latest GIMBAL_DEVICE_ERROR_FLAGS
        self.manager_information: GimbalManagerInformation | None = None
        self.device_information: GimbalDeviceInformation | None = None
        # Open `gimbal.control()` blocks: at most one with primary and one with secondary control.
        self.control_blocks: list[ControlBlock] = []
        # True once the program has requested the limits. Orders beyond the limits are then refused.
        self.checks_limits = False
        self.reboots: int = 0  # number of reboots of the vehicle so far
        self.topic: Topic = ("gimbal", *self.key)
        name = f"gimbal {self.device_id}" if component_id else "gimbal"
        self.attitude: StateCell[GimbalAttitude] = context.session.connection.new_cell(
            f"{name}.attitude", ATTITUDE_MESSAGES
        )
        # Only the autopilot is requested to send the attitude. Gimbals with their own component ids send it by
        # themselves.
        if component_id in (0, context.session.component_id):
            self.attitude._feed_from(WatchedStream(self.attitude, partial(self._request_attitude, context.session)))
        self.controllers: StateCell[GimbalControllers] = context.session.connection.new_cell(
            f"{name}.controllers", "GIMBAL_MANAGER_STATUS"
        )
        # True once a message from this gimbal was received. The program may name it earlier.
        self.is_discovered = False
        self.pending_orders: int = 0  # number of calls that are waiting for the end of an order to this gimbal
        # Rank of the known manager, and its newest status; see `update_manager` and `update_status`.
        self._manager_rank = 0
        self._newest_status: GimbalManagerStatus | None = None
        self._system_id = context.session.system_id
        context.session.register_cell(self.attitude)
        context.session.register_cell(self.controllers)

    def _request_attitude(self, session: VehicleSession) -> Detach | None:
        source = self.attitude.source
        if source is not None and source.component_id != session.component_id:
            # Another component than the autopilot sends the attitude.
            return None
        return session.rates.request(GimbalDeviceAttitudeStatus, SUBSCRIPTION_HZ, is_optional=True)

    @property
    def key(self) -> tuple[int, int]:
        return (self.component_id, self.number)

    @property
    def device_id(self) -> int:
        return self.number or self.component_id

    def has_control_block(self, *, is_primary: bool) -> bool:
        return any(block.is_primary is is_primary for block in self.control_blocks)

    @property
    def is_in_use(self) -> bool:
        return bool(self.control_blocks or self.pending_orders)

    @contextmanager
    def in_use(self) -> Iterator[None]:
        self.pending_orders += 1
        try:
            yield
        finally:
            self.pending_orders -= 1

    def set_attitude(self, message: Message, attitude: GimbalAttitude) -> None:
        self.attitude.set(attitude, self._source(message))

    def update_flags(self, message: GimbalDeviceAttitudeStatus) -> None:
        self.flags = message.flags
        self.failures = message.failure_flags

    def update_status(self, message: GimbalManagerStatus) -> bool:
        """Record the controllers of the gimbal. Return False if the message arrived late."""
        if self._newest_status is not None and _is_older(message, self._newest_status):
            return False
        self._newest_status = message
        self.set_controllers(message)
        return True

    def set_controllers(self, message: GimbalManagerStatus) -> None:
        primary = (message.primary_control_sysid, message.primary_control_compid)
        secondary = (message.secondary_control_sysid, message.secondary_control_compid)
        self.controllers.set(GimbalControllers(primary, secondary), self._source(message))

    def update_manager(self, component_id: int, rank: int, *, is_known_manager_gone: bool) -> None:
        if self.manager_id == component_id:
            self._manager_rank = max(self._manager_rank, rank)
        elif self.manager_id is None or rank > self._manager_rank or is_known_manager_gone:
            self.manager_id = component_id
            self._manager_rank = rank
            self._newest_status = None  # The time stamps of the new manager are from another clock.

    def reset(self) -> None:
        self.reboots += 1
        self._newest_status = None
        self._manager_rank = 0
        self.manager_id = self.component_id if self.number else None  # as for a new gimbal
        self.flags = 0
        self.failures = 0
        self.manager_information = None
        self.device_information = None

    def _source(self, message: Message) -> Source:
        frame = message.received_frame
        return Source(self._system_id, self.component_id if frame is None else frame.component_id, message.NAME)


def _is_older(message: GimbalManagerStatus, newest: GimbalManagerStatus) -> bool:
    older_by_ms = newest.time_boot_ms - message.time_boot_ms
    frame, newest_frame = message.received_frame, newest.received_frame
    are_simultaneous = older_by_ms == 0 and message.time_boot_ms != 0  # sent in the same millisecond
    if are_simultaneous and frame is not None and newest_frame is not None:
        # The sequence number of MAVLink frames returns to 0 after 255.
        return 0 < (newest_frame.sequence - frame.sequence) % 256 < 128
    return 0 < older_by_ms < REORDER_WINDOW_MS


class ControlRequest:
    """Request for control of a gimbal, made by an open ``gimbal.control()`` block.

    A ``gimbal_id_param`` of 0 means all gimbals of the manager.
    """

    def __init__(self, manager_id: int, gimbal_id_param: int, *, is_primary: bool) -> None:
        self.manager_id: int = manager_id
        self.gimbal_id_param: int = gimbal_id_param
        self.is_primary: bool = is_primary
        # True once another block that requested the same control has ended without releasing it (`leave_release_to`).
        self.must_release = False

    def is_released_with(self, other: ControlRequest) -> bool:
        has_same_role = (self.manager_id, self.is_primary) == (other.manager_id, other.is_primary)
        is_same_gimbal = self.gimbal_id_param == other.gimbal_id_param
        is_for_all_gimbals = 0 in (self.gimbal_id_param, other.gimbal_id_param)
        return has_same_role and (is_same_gimbal or is_for_all_gimbals)

    def leave_release_to(self, requests: Iterable[ControlRequest]) -> bool:
        """Let other blocks with the same control release it later. Return False if there are none."""
        shared = [request for request in requests if request is not self and request.is_released_with(self)]
        # A release now would take the control from the other blocks, which are still open.
        for request in shared:
            request.must_release = True
        return bool(shared)
