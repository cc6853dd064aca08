"""``OwnFlight``: a flight that a command arms for, and what becomes of the vehicle when it fails or is interrupted."""

from __future__ import annotations

from abc import ABC, abstractmethod
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING

from aerokit.cli.exits import DONE, INTERRUPTED
from aerokit.errors import (
    AerokitError,
    CommandRejected,
    HeartbeatTimeout,
    OperationRejected,
    OperationTimeout,
)
from aerokit.mavlink.enums import MavLandedState
from aerokit.runtime.link_state import SILENT_AFTER_S
from aerokit.vehicle.orders.late_arming import LATE_S

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable
    from typing import Literal

    from aerokit.cli.demo_lines import FlightReport
    from aerokit.cli.interrupt import Interruptible
    from aerokit.vehicle.vehicle import Vehicle

    Purpose = Literal["mission", "hold", "land", "return", "take_off", "setpoint"]

__all__ = ["ON_INTERRUPT", "OwnFlight"]

ON_INTERRUPT: dict[str, str] = {
    "return": "returning to launch",
    "land": "landing here",
    "hold": "holding here",
    "nothing": "it is left to itself",
}
"""What Ctrl-C may end a flight with, and what is said then."""
DISARMS_WITHIN_S = 30.0


class OwnFlight(ABC):
    """Arms a vehicle and flies it, and says what becomes of it.

    Nothing is ordered of a vehicle that was armed before, or whose mode somebody else has changed since.
    """

    def __init__(
        self, vehicle: Vehicle, report: FlightReport, interruptible: Interruptible, on_interrupt: str
    ) -> None:
        self._vehicle, self._say, self._interruptible = vehicle, report.say, interruptible
        self._on_interrupt = on_interrupt
        self.is_ours: bool = False
        """Whether it was told to arm by us."""
        self._may_arm_late = False  # the order to arm has not come to its end
        self._modes_armed_in: set[str] = set()
        self._has_started = False  # it has left the mode in which it was armed, by our order

    async def fly(self) -> int:
        """Fly it to its end, and return the exit code; what ends it otherwise is raised, once it is safe or left."""
        try:
            code = await self._interruptible.run(self._fly)
        except Exception as error:  # whatever it is, what stands armed by our doing is not left so
            self._say(f"failed: {error}")
            if self.is_ours:
                await self._come_to_rest(partial(self._after_failure, error))
            raise
        if code is None:
            self._say(f"interrupted, {self._vehicle.describe_now()}")
            if self.is_ours:
                await self._come_to_rest(self._after_interrupt)
            return INTERRUPTED
        return code

    @abstractmethod
    async def _fly(self) -> int:
        """All of it, as it should go; the exit code."""

    @abstractmethod
    def _our_purposes(self) -> tuple[Purpose, ...]:
        """In the modes for which it is flown by us, and by nobody else."""

    # ------------------------------------------------------------------------------ as it should go

    def _check_disarmed(self) -> None:
        now = self._vehicle.describe_now()
        if self._vehicle.heartbeat_age > SILENT_AFTER_S:
            raise HeartbeatTimeout(f"whether somebody has armed it is not known ({now}); nothing was started")
        if not self._vehicle.is_surely_disarmed:
            raise OperationRejected(f"it is left to whoever armed it ({now}); nothing was started")

    async def _arm(self) -> None:
        self._check_disarmed()
        self.is_ours = self._may_arm_late = True
        self._modes_armed_in.add(self._vehicle.mode_name)
        try:
            await self._vehicle.arm()
        except CommandRejected:
            self._may_arm_late = False
            raise
        self._may_arm_late = False
        self._modes_armed_in.add(self._vehicle.mode_name)

    async def _wait_disarmed_on_ground(self) -> None:
        if self._vehicle.landed_state.latest == MavLandedState.ON_GROUND:
            with suppress(OperationTimeout):
                await self._vehicle.armed.wait_until(lambda armed: not armed, timeout=DISARMS_WITHIN_S)

    # ---------------------------------------------------------------------------------- otherwise

    async def _come_to_rest(self, action: Callable[[], Awaitable[int]]) -> None:
        """A second Ctrl-C, and whatever fails now, leaves it to itself."""
        try:
            if await self._interruptible.run(action) is None:
                self._say(f"interrupted again: left {self._vehicle.describe_now()}")
        except AerokitError as error:
            self._say(f"that failed, too: {error}")
            self._say(f"left {self._vehicle.describe_now()}")

    async def _after_failure(self, error: Exception) -> int:
        """Switch off what stands on the ground by our doing; what flies is left to its mission, pilot or failsafe."""
        vehicle = self._vehicle
        if vehicle.is_surely_disarmed:
            await self._watch_late_arming()
        elif self._stands_armed and self._is_in_our_mode:
            await self._disarm()
        else:
            self._say(f"no order is given: left {vehicle.describe_now()}")
        return DONE

    async def _after_interrupt(self) -> int:
        """Switch off what stands on the ground; what flies does what Ctrl-C is to do, if it is flown by us."""
        vehicle, wanted = self._vehicle, self._on_interrupt
        if vehicle.is_surely_disarmed:
            await self._watch_late_arming()
            return DONE
        if not self._is_left_to_us():
            return DONE
        if self._stands_armed and wanted != "nothing":
            try:
                await self._disarm()
            except CommandRejected as error:  # it has left the ground since it told where it is
                self._say(f"it does not disarm: {error}")
            if vehicle.is_surely_disarmed or not self._is_left_to_us():
                return DONE
        self._say(
            ON_INTERRUPT[wanted] + ("" if wanted == "nothing" else "; Ctrl-C again to leave it to itself")
        )
        if wanted == "return":
            await vehicle.return_to_launch(timeout=None)
        elif wanted == "land":
            await vehicle.land(timeout=None)
        elif wanted == "hold":
            await vehicle.hold()
        if wanted in ("return", "land"):
            await self._wait_disarmed_on_ground()
        self._say(vehicle.describe_now())
        return DONE

    async def _watch_late_arming(self) -> None:
        """An order to arm that was given up may still arrive: while we are connected, it is disarmed then."""
        if not self._may_arm_late:
            return
        self._say(
            f"the order to arm may still be carried out: watched for {LATE_S:g} s, and disarmed if it arms;"
            " Ctrl-C again to leave it"
        )
        armed = self._vehicle.armed
        with suppress(OperationTimeout):
            await armed.wait_until(bool, timeout=LATE_S)
            await armed.wait_until(lambda armed: not armed, timeout=DISARMS_WITHIN_S)
        self._say(self._vehicle.describe_now())

    async def _disarm(self) -> None:
        self._say("on the ground and armed; disarming")
        await self._vehicle.disarm()
        self._say("disarmed")

    def _is_left_to_us(self) -> bool:
        if not self._is_in_our_mode:
            mode, now = self._vehicle.mode_name, self._vehicle.describe_now()
            self._say(f"left to whoever put it into {mode}: {now}")
        return self._is_in_our_mode

    @property
    def _stands_armed(self) -> bool:
        return self._vehicle.is_armed and self._vehicle.landed_state.latest == MavLandedState.ON_GROUND

    @property
    def _is_in_our_mode(self) -> bool:
        vehicle = self._vehicle
        if not self._has_started and vehicle.mode_name in self._modes_armed_in:
            return True
        mode_for, is_vtol = vehicle.autopilot.mode_for, vehicle.is_vtol
        modes = [mode_for(purpose, is_vtol=is_vtol) for purpose in self._our_purposes()]
        return vehicle.mode_name in [mode.name for mode in modes if mode is not None]
