"""`Device`: what one gimbal and its manager have told."""

from __future__ import annotations

import math
from contextlib import contextmanager
from typing import TYPE_CHECKING, Literal, Protocol

from aerokit._internal.values import Snapshot
from aerokit.connection.cells import Source, StateCell
from aerokit.mavlink.enums import GimbalDeviceErrorFlags, GimbalManagerCapFlags
from aerokit.mavlink.messages import GimbalDeviceAttitudeStatus
from aerokit.vehicle.session.rates import SUBSCRIPTION_HZ

if TYPE_CHECKING:
    from collections.abc import Iterator

    from aerokit.connection.bus import Detach
    from aerokit.mavlink.message import Message
    from aerokit.mavlink.messages import (
        GimbalDeviceInformation,
        GimbalManagerInformation,
        GimbalManagerStatus,
    )
    from aerokit.vehicle.commanding.context import Bridge
    from aerokit.vehicle.commanding.order import Topic
    from aerokit.vehicle.session.session import Talk
    from aerokit.vehicle.state.equipment import GimbalAttitude

__all__ = [
    "ATTITUDE_COMES_IN",
    "LAST_NUMBER",
    "Claim",
    "Claims",
    "Device",
    "Frame",
    "GimbalControllers",
    "GimbalInformation",
    "controllers_of",
    "information_of",
]

Frame = Literal["earth", "vehicle"]
"""What a yaw counts from, and keeps to: north, or the vehicle's nose."""

Can = GimbalManagerCapFlags


class GimbalControllers(Snapshot):
    """Who is in control of a gimbal: (system id, component id), (0, 0): nobody (GIMBAL_MANAGER_STATUS)."""

    primary: tuple[int, int]
    secondary: tuple[int, int]


class GimbalInformation(Snapshot):
    """What a gimbal is and can do (GIMBAL_MANAGER_INFORMATION, GIMBAL_DEVICE_INFORMATION).

    ``gimbal_device_id``: the component id of the device, or 1 to 6 behind its manager's component, which is
    ``manager_component_id``. ``roll_deg``, ``pitch_deg``, ``yaw_deg``: lowest and highest angle, None: not told. The
    texts are empty, and ``uid`` is 0, of a device that does not tell them.
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
        """Whether it has this: a member of ``enums.GimbalManagerCapFlags``."""
        return bool(self.capabilities & capability)

    @property
    def retracts(self) -> bool:
        """Whether it can be retracted."""
        return self.can(Can.HAS_RETRACT)

    @property
    def has_neutral(self) -> bool:
        """Whether it has a neutral position."""
        return self.can(Can.HAS_NEUTRAL)

    @property
    def axes(self) -> tuple[str, ...]:
        """Those that it turns about: of ``"roll"``, ``"pitch"``, ``"yaw"``."""
        bits = (("roll", Can.HAS_ROLL_AXIS), ("pitch", Can.HAS_PITCH_AXIS), ("yaw", Can.HAS_YAW_AXIS))
        return tuple(name for name, bit in bits if self.can(bit))

    @property
    def looks_at_places(self) -> bool:
        """Whether its manager says that it can point at a place on the globe."""
        return self.can(Can.CAN_POINT_LOCATION_GLOBAL)


def controllers_of(message: GimbalManagerStatus) -> GimbalControllers:
    """Of GIMBAL_MANAGER_STATUS."""
    return GimbalControllers(
        (message.primary_control_sysid, message.primary_control_compid),
        (message.secondary_control_sysid, message.secondary_control_compid),
    )


def information_of(
    device_id: int,
    manager_id: int,
    manager: GimbalManagerInformation | None,
    device: GimbalDeviceInformation | None,
) -> GimbalInformation:
    """Of what was told; the manager's word goes before the device's."""
    told = manager or device
    assert told is not None
    capabilities = manager.cap_flags if manager is not None else told.cap_flags
    limits = (
        _limits(told.roll_min, told.roll_max),
        _limits(told.pitch_min, told.pitch_max),
        _limits(told.yaw_min, told.yaw_max),
    )
    if device is None:
        return GimbalInformation(device_id, manager_id, capabilities, *limits)
    names = (device.vendor_name, device.model_name, device.custom_name)
    versions = (_version(device.firmware_version), _version(device.hardware_version))
    return GimbalInformation(device_id, manager_id, capabilities, *limits, *names, *versions, device.uid)


def _limits(low: float, high: float) -> tuple[float, float] | None:
    """Zeros are what devices say that do not know."""
    if not (math.isfinite(low) and math.isfinite(high)) or low >= high:
        return None
    return round(math.degrees(low), 2) + 0.0, round(math.degrees(high), 2) + 0.0


def _version(number: int) -> str:
    """Major, minor and patch, each a byte from the lowest on."""
    return "" if not number else f"{number & 0xFF}.{number >> 8 & 0xFF}.{number >> 16 & 0xFF}"


LAST_NUMBER = 6
"""Gimbals without a component id of their own are numbered from 1 to this."""

OVERTAKEN_MS = 5_000
"""Behind by more, its manager has rebooted."""

ATTITUDE_COMES_IN = "GIMBAL_DEVICE_ATTITUDE_STATUS or MOUNT_ORIENTATION"


class _AttitudeStream:
    """Asks the autopilot for GIMBAL_DEVICE_ATTITUDE_STATUS while somebody waits for values that nobody else tells."""

    pending = False

    def __init__(self, cell: StateCell[GimbalAttitude], talk: Talk) -> None:
        self._cell, self._talk = cell, talk
        self._release: Detach | None = None

    def catch_up(self) -> None:
        """Values are worked out as they come."""

    def watchers_changed(self) -> None:
        """See `Feed`."""
        if not self._cell._is_watched:
            if self._release is not None:
                self._release()
            self._release = None
            return
        source, rates = self._cell.source, self._talk.rates
        if self._release is None and (source is None or source.component_id == self._talk.component_id):
            self._release = rates.want(GimbalDeviceAttitudeStatus, SUBSCRIPTION_HZ, is_optional=True)


class ControlBlock(Protocol):
    """What a gimbal knows of a block that is about its control."""

    @property
    def is_held(self) -> bool:
        """Whether this program is in control."""

    def raise_if_taken(self) -> None:
        """Raise GimbalTaken if it was, and somebody else is."""


class Device:
    """One gimbal: ``component_id`` tells where it points, ``number`` is 1 to 6 behind that one, 0 of the component
    itself. Nobody is heard of yet while ``component_id`` is 0.
    """

    boots: int
    waiting: int

    def __init__(self, bridge: Bridge, component_id: int, number: int) -> None:
        self.component_id: int = component_id
        self.number: int = number
        self.manager_id: int | None = component_id if number else None
        """The component whose word counts for it; None: not told yet."""
        self.flags: int = 0
        self.failures: int = 0
        """GIMBAL_DEVICE_FLAGS and GIMBAL_DEVICE_ERROR_FLAGS as told last."""
        self.manager_information: GimbalManagerInformation | None = None
        self.device_information: GimbalDeviceInformation | None = None
        self.controls: dict[bool, ControlBlock] = {}
        """The blocks that are open: of primary control (True), of secondary (False)."""
        self.checks_limits = False
        """Whether the program has asked for its limits, so that it may be held to them."""
        self.boots = 0
        """How often the vehicle has rebooted since."""
        self.topic: Topic = ("gimbal", *self.key)
        """What orders to it are about."""
        name = f"gimbal {self.device_id}" if component_id else "gimbal"
        self.attitude: StateCell[GimbalAttitude] = bridge.talk.connection.new_cell(
            f"{name}.attitude", ATTITUDE_COMES_IN
        )
        if component_id in (0, bridge.talk.component_id):  # one with an id of its own tells it unasked
            self.attitude._feed_from(_AttitudeStream(self.attitude, bridge.talk))
        self.controllers: StateCell[GimbalControllers] = bridge.talk.connection.new_cell(
            f"{name}.controllers", "GIMBAL_MANAGER_STATUS"
        )
        self.is_told = False
        """Whether anything was heard of it; a program may name one that is not there."""
        self.waiting = 0
        """How many orders of ours go on."""
        self._manager_rank = 0
        self._status_ms = 0
        self._system_id = bridge.talk.system_id
        bridge.talk.keep(self.attitude)
        bridge.talk.keep(self.controllers)

    @property
    def key(self) -> tuple[int, int]:
        """Of several the smallest is the first."""
        return (self.component_id, self.number)

    @property
    def device_id(self) -> int:
        """What MAVLink calls it: 1 to 6, or its component id."""
        return self.number or self.component_id

    @property
    def is_in_use(self) -> bool:
        """Whether we control it, or an order to it goes on."""
        return bool(self.controls or self.waiting)

    @contextmanager
    def in_use(self) -> Iterator[None]:
        """For the time of the block an order goes on."""
        self.waiting += 1
        try:
            yield
        finally:
            self.waiting -= 1

    def tell(self, message: Message, attitude: GimbalAttitude) -> None:
        """Where it points, in any message."""
        self.attitude.set(attitude, self._source(message))

    def note_flags(self, message: GimbalDeviceAttitudeStatus) -> None:
        """What it does, and what fails."""
        self.flags, self.failures = message.flags, message.failure_flags

    def note_status(self, message: GimbalManagerStatus) -> bool:
        """Who is in control; False for what a newer one has overtaken on its way, which does not count."""
        behind = self._status_ms - message.time_boot_ms
        if 0 < behind < OVERTAKEN_MS:
            return False
        self._status_ms = message.time_boot_ms
        self.tell_status(message)
        return True

    def tell_status(self, message: GimbalManagerStatus) -> None:
        """The same, for who looks."""
        self.controllers.set(controllers_of(message), self._source(message))

    def note_manager(self, component_id: int, rank: int, *, is_gone: bool) -> None:
        """Somebody speaks as its manager: of two the higher rank counts, then the first, until that is gone."""
        if self.manager_id == component_id:
            self._manager_rank = max(self._manager_rank, rank)
        elif self.manager_id is None or rank > self._manager_rank or is_gone:
            self.manager_id, self._manager_rank = component_id, rank
            self._status_ms = 0  # its clock is another one

    def forget(self) -> None:
        """The vehicle has rebooted."""
        self.boots += 1
        self._status_ms = self._manager_rank = 0
        self.manager_id = self.component_id if self.number else None
        self.flags = 0
        self.failures = 0
        self.manager_information = self.device_information = None

    def describe_failures(self) -> str:
        """What it says is wrong, in words; empty: nothing."""
        return str(GimbalDeviceErrorFlags(self.failures).name or self.failures) if self.failures else ""

    def _source(self, message: Message) -> Source:
        frame = message.received_frame
        return Source(
            self._system_id, self.component_id if frame is None else frame.component_id, message.NAME
        )


class Claim:
    """Of one block, from its entering on, to one manager; a ``parameter`` of 0 means all gimbals of the manager."""

    def __init__(self, manager_id: int, parameter: int, *, is_primary: bool) -> None:
        self.manager_id: int = manager_id
        self.parameter: int = parameter
        self.is_primary: bool = is_primary
        self.owes_release = False
        """Whether an earlier block, whose last word was not answered, leaves it to this one to give control back."""

    def shares(self, other: Claim) -> bool:
        """Whether to give back what the one has takes it away from the other."""
        is_same = (self.manager_id, self.is_primary) == (other.manager_id, other.is_primary)
        return is_same and (self.parameter == other.parameter or 0 in (self.parameter, other.parameter))


class Claims:
    """Those that are open."""

    def __init__(self) -> None:
        self._open: list[Claim] = []

    def add(self, claim: Claim) -> None:
        """Its block is being entered."""
        self._open.append(claim)

    def end(self, claim: Claim) -> None:
        """Its block was left, or not entered."""
        if claim in self._open:
            self._open.remove(claim)

    def may_give_back(self, claim: Claim) -> bool:
        """Whether no other block wants or has the same; one that does has to give it back now."""
        others = [each for each in self._open if each is not claim and each.shares(claim)]
        for each in others:
            each.owes_release = True
        return not others
