"""`Device`: what one gimbal and its manager have told."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

from aerokit.mavlink.enums import GimbalDeviceErrorFlags
from aerokit.mavlink.messages import GimbalDeviceAttitudeStatus
from aerokit.runtime.cells import Source, StateCell
from aerokit.vehicle.gimbal.values import GimbalControllers, controllers_of
from aerokit.vehicle.orders.newest import Newest
from aerokit.vehicle.talk.rates import SUBSCRIPTION_HZ

if TYPE_CHECKING:
    from collections.abc import Iterator

    from aerokit.mavlink.message import Message
    from aerokit.mavlink.messages import (
        GimbalDeviceInformation,
        GimbalManagerInformation,
        GimbalManagerStatus,
    )
    from aerokit.runtime.bus import Detach
    from aerokit.vehicle.gimbal.control import GimbalControl
    from aerokit.vehicle.orders.bridge import Bridge
    from aerokit.vehicle.state.gimbal import GimbalAttitude
    from aerokit.vehicle.talk.talk import Talk

__all__ = ["ATTITUDE_COMES_IN", "LAST_NUMBER", "Device"]

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
        self.controls: dict[bool, GimbalControl] = {}
        """The blocks that are open: of primary control (True), of secondary (False)."""
        self.checks_limits = False
        """Whether the program has asked for its limits, so that it may be held to them."""
        self.boots = 0
        """How often the vehicle has rebooted since."""
        self.newest: Newest = Newest(bridge.helm)
        """Of the orders to it."""
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
