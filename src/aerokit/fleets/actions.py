"""``Actions``: vehicle actions executed by several members at once, and barriers."""

from __future__ import annotations

import contextlib
from collections.abc import Awaitable, Callable
from operator import attrgetter
from typing import Any

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit._internal.formatting import short_repr
from aerokit.errors import InvalidArgument, OperationTimeout
from aerokit.fleets.action import SelectionBase
from aerokit.fleets.distances import POSITION_MAX_AGE_S
from aerokit.fleets.members import Member
from aerokit.fleets.policy import FleetResult
from aerokit.vehicle.commanding.progress import ChangeSignal

POLL_INTERVAL_S = 0.25


@checks_arguments
class Actions(SelectionBase):
    """Actions of several members: arming, take-off, landing, modes and, with ``do``, any other method of a vehicle."""

    async def do(
        self,
        action: str | Callable[[Member], Awaitable[Any]],
        *arguments: object,
        timeout: float | None = None,
        stagger_s: float | None = None,
        **options: object,
    ) -> FleetResult:
        """Execute any action with all members at once.

        Args:
            action: the name of a method of :class:`aerokit.Vehicle` (``"set_speed"``, ``"mission.resume"``), or a
                coroutine function that is called with each :class:`Member`.
            *arguments: positional arguments of the method.
            timeout: seconds for each member; None: no limit besides that of the method.
            stagger_s: delay in seconds between the starts of consecutive members; None: all at once.
            **options: keyword arguments of the method.

        Raises:
            InvalidArgument: there is no such method, or arguments were given although ``action`` is a function. Nothing
                was sent. If the method refuses an argument, each member fails instead.
        """
        if isinstance(action, str):
            name = action
            for member in self:
                _method(member, name)  # an unknown name raises here, before any member has started

            async def execute(member: Member) -> Any:
                return await _method(member, name)(*arguments, **options)

        else:
            if arguments or options:
                raise InvalidArgument("do: arguments and options are allowed only if action is the name of a method")
            execute = action  # type: ignore[assignment]
            name = getattr(action, "__name__", "action")
        return await self._run(
            name, execute, timeout=timeout, stagger_s=stagger_s, is_function=not isinstance(action, str)
        )

    async def wait_ready(self, *, timeout: float = 90.0) -> FleetResult:
        """Wait until each member is ready to fly; see :meth:`aerokit.Vehicle.wait_ready`.

        Args:
            timeout: seconds for each member.
        """
        return await self._run("wait_ready", lambda member: member.vehicle.wait_ready(timeout=timeout))

    async def arm(self, *, timeout: float = 10.0, stagger_s: float | None = None) -> FleetResult:
        """Arm all members: **propellers may start to turn**; see :meth:`aerokit.Vehicle.arm`.

        Args:
            timeout: seconds for each member.
            stagger_s: delay in seconds between the starts of consecutive members; None: all at once.
        """
        return await self._run("arm", lambda member: member.vehicle.arm(timeout=timeout), stagger_s=stagger_s)

    async def disarm(self, *, timeout: float = 10.0) -> FleetResult:
        """Disarm all members; see :meth:`aerokit.Vehicle.disarm`. Vehicles in the air refuse.

        Args:
            timeout: seconds for each member.
        """
        return await self._run("disarm", lambda member: member.vehicle.disarm(timeout=timeout))

    async def take_off(
        self, altitude_m: float, *, timeout: float = 60.0, stagger_s: float | None = None
    ) -> FleetResult:
        """Take off and climb to ``altitude_m`` above home; see :meth:`aerokit.Vehicle.take_off`.

        Args:
            altitude_m: metres above the home of each member; more than 0 and at most 10,000.
            timeout: seconds for each member.
            stagger_s: delay in seconds between the starts of consecutive members; None: all at once.

        Raises:
            InvalidArgument: the altitude is out of range. Nothing was sent.
        """
        check_range("altitude_m", altitude_m, 0, 10_000, above=True)
        return await self._run(
            "take_off", lambda member: member.vehicle.take_off(altitude_m, timeout=timeout), stagger_s=stagger_s
        )

    async def land(self, *, timeout: float | None = 300.0, stagger_s: float | None = None) -> FleetResult:
        """Land at the current position; see :meth:`aerokit.Vehicle.land`. A member's failure does not stop the others.

        Args:
            timeout: seconds for each member; None: no limit.
            stagger_s: delay in seconds between the starts of consecutive members; None: all at once.
        """
        return await self._run("land", lambda member: member.vehicle.land(timeout=timeout), stagger_s=stagger_s)

    async def return_to_launch(self, *, timeout: float | None = 600.0, stagger_s: float | None = None) -> FleetResult:
        """Return to launch; see :meth:`aerokit.Vehicle.return_to_launch`. A member's failure does not stop the others.

        Args:
            timeout: seconds for each member; None: no limit.
            stagger_s: delay in seconds between the starts of consecutive members; None: all at once.
        """
        return await self._run(
            "return_to_launch", lambda member: member.vehicle.return_to_launch(timeout=timeout), stagger_s=stagger_s
        )

    async def hold(self) -> FleetResult:
        """Stop and hold position; see :meth:`aerokit.Vehicle.hold`. A member's failure does not stop the others."""
        return await self._run("hold", lambda member: member.vehicle.hold())

    async def set_mode(self, mode: str | int, *, timeout: float = 6.0) -> FleetResult:
        """Change the flight mode; see :meth:`aerokit.Vehicle.set_mode`.

        Args:
            mode: name as in the autopilot's documentation, or number.
            timeout: seconds for each member.

        Raises:
            InvalidArgument: a member has no such mode. Nothing was sent.
        """
        for member in self:  # an unknown mode raises here, before any member has changed its mode
            if member.is_available:
                member.vehicle.autopilot.find_mode(mode, member.vehicle.telemetry.mode_names)
        return await self._run("set_mode", lambda member: member.vehicle.set_mode(mode, timeout=timeout))

    # ------------------------------------------------------------------------------------- barriers

    async def barrier(
        self, condition: Callable[[Member], bool], *, timeout: float = 60.0, description: str = "barrier"
    ) -> FleetResult:
        """Wait until a condition has been true for every available member, not necessarily at the same time.

        Args:
            condition: function of a member; it is called four times a second and when the member's state changes, until
                it is true for this member.
            timeout: the longest time in seconds to wait for all members together.
            description: name of the barrier in errors.

        Raises:
            FleetError: the time has expired before the condition was true for every member. The fleet's policy for
                failed members was applied.
        """
        deadline = self._context.now() + timeout  # one deadline for all members

        async def wait_for_condition(member: Member) -> None:
            vehicle = member.vehicle
            # The condition is checked again whenever one of these values changes.
            cells = (vehicle.mode, vehicle.armed, vehicle.position, vehicle.landed_state)
            with vehicle._session.streaming("position"), ChangeSignal(vehicle._session, *cells) as change_signal:
                while not condition(member):
                    vehicle.connection.raise_if_ended()
                    if vehicle.connection.now() >= deadline:
                        unready = [
                            candidate.name for candidate in self if candidate.is_available and not condition(candidate)
                        ]
                        raise OperationTimeout(
                            f"{description}: not reached within {timeout:g} s by {', '.join(unready)}"
                        )
                    await change_signal.next(POLL_INTERVAL_S)

        result = await self._run(description, wait_for_condition, is_function=True)
        result.raise_for_errors()
        return result

    async def wait_at_altitude(
        self, altitude_m: float, *, tolerance_m: float = 1.0, timeout: float = 60.0
    ) -> FleetResult:
        """Wait until all members are at an altitude above their homes.

        Args:
            altitude_m: metres above the home of each member.
            tolerance_m: allowed difference from ``altitude_m`` in metres.
            timeout: seconds until all members are at the altitude.

        Raises:
            FleetError: a member did not reach the altitude in time.
        """

        def is_at_altitude(member: Member) -> bool:
            position, age_s = member.vehicle.position.latest, member.vehicle.position.age
            if position is None or position.altitude_relative_m is None or age_s > POSITION_MAX_AGE_S:
                return False
            return abs(position.altitude_relative_m - altitude_m) <= tolerance_m

        return await self.barrier(is_at_altitude, timeout=timeout, description="wait_at_altitude")


def _method(member: Member, name: str) -> Callable[..., Awaitable[Any]]:
    """Return a public method of the vehicle or of one of its parts (``"mission.resume"``)."""
    method: Any = None
    is_public = not any(part.startswith("_") for part in name.split("."))
    if is_public:
        with contextlib.suppress(AttributeError):
            method = attrgetter(name)(member.vehicle)
    if not callable(method):
        raise InvalidArgument(f"action = {short_repr(name)} is not a method of Vehicle, such as 'land'")
    return method  # type: ignore[no-any-return]
