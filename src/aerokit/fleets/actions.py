"""``Actions``: what a vehicle does, of many at once; and barriers.

https://mavlink.io/en/messages/common.html#GPS_RTCM_DATA
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from operator import attrgetter
from typing import TYPE_CHECKING, Any

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit._internal.wording import shown
from aerokit.errors import InvalidArgument, OperationTimeout
from aerokit.fleets.action import FleetPart
from aerokit.fleets.members import Member
from aerokit.fleets.policy import FleetResult
from aerokit.vehicle.commanding.progress import Arrivals

if TYPE_CHECKING:
    from collections.abc import Iterator

    from aerokit.mavlink.messages import GpsRtcmData

LOOK_S = 0.25


@checks_arguments
class Actions(FleetPart):
    """Arming, taking off, landing, modes; anything else by ``do``."""

    async def do(
        self,
        action: str | Callable[[Member], Awaitable[Any]],
        *arguments: object,
        timeout: float | None = None,
        stagger_s: float | None = None,
        **options: object,
    ) -> FleetResult:
        """Do something with each of them at once.

        Args:
            action: a method of :class:`aerokit.Vehicle` by its name (``"set_speed"``, ``"mission.resume"``), or a
                coroutine function that is called with each :class:`Member`.
            *arguments: of the method.
            timeout: seconds that each of them has; None: what the action itself allows.
            stagger_s: each begins so many seconds after the one before; None: all at once.
            **options: of the method.

        Raises:
            InvalidArgument: there is no such action, or an argument is wrong. Nothing was sent.
        """
        if isinstance(action, str):
            for member in self:
                _method(member, action)  # refuse it before anybody has begun
            name = action

            async def act(member: Member) -> Any:
                return await _method(member, name)(*arguments, **options)

            what = action
        else:
            if arguments or options:
                raise InvalidArgument(
                    "arguments and options go with an action by name; a function has its own"
                )
            act, what = action, getattr(action, "__name__", "action")  # type: ignore[assignment]
        return await self._run(what, act, timeout=timeout, stagger_s=stagger_s)

    async def wait_ready(self, *, timeout: float = 90.0) -> FleetResult:
        """Wait until each could fly; as :meth:`aerokit.Vehicle.wait_ready`.

        Args:
            timeout: seconds that each of them has.
        """
        return await self._run("wait_ready", lambda member: member.vehicle.wait_ready(timeout=timeout))

    async def arm(self, *, timeout: float = 10.0, stagger_s: float | None = None) -> FleetResult:
        """Arm them: **propellers may start to turn**; as :meth:`aerokit.Vehicle.arm`.

        Args:
            timeout: seconds that each of them has.
            stagger_s: each begins so many seconds after the one before; None: all at once.
        """
        return await self._run("arm", lambda member: member.vehicle.arm(timeout=timeout), stagger_s=stagger_s)

    async def disarm(self, *, timeout: float = 10.0) -> FleetResult:
        """Disarm them; as :meth:`aerokit.Vehicle.disarm`: refused in the air.

        Args:
            timeout: seconds that each of them has.
        """
        return await self._run("disarm", lambda member: member.vehicle.disarm(timeout=timeout))

    async def take_off(
        self, altitude_m: float, *, timeout: float = 60.0, stagger_s: float | None = None
    ) -> FleetResult:
        """Take off and climb to ``altitude_m`` above home; as :meth:`aerokit.Vehicle.take_off`.

        Args:
            altitude_m: metres above the home of each, above 0, at most 10,000.
            timeout: seconds that each of them has.
            stagger_s: each begins so many seconds after the one before; None: all at once.

        Raises:
            InvalidArgument: the altitude is out of range. Nothing was sent.
        """
        check_range("altitude_m", altitude_m, 0, 10_000, above=True)
        return await self._run(
            "take_off",
            lambda member: member.vehicle.take_off(altitude_m, timeout=timeout),
            stagger_s=stagger_s,
        )

    async def land(self, *, timeout: float | None = 300.0, stagger_s: float | None = None) -> FleetResult:
        """Land where they are; as :meth:`aerokit.Vehicle.land`. Nobody is stopped because another one has failed.

        Args:
            timeout: seconds that each of them has; None: as long as it takes.
            stagger_s: each begins so many seconds after the one before; None: all at once.
        """
        return await self._run(
            "land", lambda member: member.vehicle.land(timeout=timeout), stagger_s=stagger_s
        )

    async def return_to_launch(
        self, *, timeout: float | None = 600.0, stagger_s: float | None = None
    ) -> FleetResult:
        """Return to where each has started; as :meth:`aerokit.Vehicle.return_to_launch`, and as :meth:`land` here.

        Args:
            timeout: seconds that each of them has; None: as long as it takes.
            stagger_s: each begins so many seconds after the one before; None: all at once.
        """
        return await self._run(
            "return_to_launch",
            lambda member: member.vehicle.return_to_launch(timeout=timeout),
            stagger_s=stagger_s,
        )

    async def hold(self) -> FleetResult:
        """Stop and stay; as :meth:`aerokit.Vehicle.hold`. Nobody is stopped because another one has failed."""
        return await self._run("hold", lambda member: member.vehicle.hold())

    async def set_mode(self, mode: str | int, *, timeout: float = 6.0) -> FleetResult:
        """Change the flight mode; as :meth:`aerokit.Vehicle.set_mode`.

        Args:
            mode: a name as the autopilot's own documentation spells it, or its number.
            timeout: seconds that each of them has.

        Raises:
            InvalidArgument: one of them has no such mode. Nothing was sent.
        """
        for member in self:  # before anybody has changed it
            if member.takes_orders:
                member.vehicle.autopilot.find_mode(mode, member.vehicle.telemetry.mode_names)
        return await self._run("set_mode", lambda member: member.vehicle.set_mode(mode, timeout=timeout))

    # ------------------------------------------------------------------------------------- barriers

    async def barrier(
        self, condition: Callable[[Member], bool], *, timeout: float = 60.0, description: str = "barrier"
    ) -> FleetResult:
        """Wait until something is true of each of them; who gets there first waits for the others.

        Args:
            condition: called with a member, four times a second and whenever it tells something.
            timeout: seconds until it is true of all of them.
            description: what is waited for, in error texts.

        Raises:
            FleetError: it did not become true of one, who then counts as failed in a common action.
        """

        async def until(member: Member) -> None:
            vehicle = member.vehicle
            cells = (vehicle.mode, vehicle.armed, vehicle.position, vehicle.landed_state)
            with vehicle._talk.streaming("position"), Arrivals(vehicle._talk, *cells) as news:
                while not condition(member):
                    vehicle.connection.raise_if_ended()
                    if vehicle.connection.now() >= until_at:
                        missing = [each.name for each in self if each.takes_orders and not condition(each)]
                        raise OperationTimeout(
                            f"{description}: not within {timeout:g} s, for want of {', '.join(missing)}"
                        )
                    await news.next(LOOK_S)

        until_at = self._crew.now() + timeout
        result = await self._run(description, until)
        result.raise_for_errors()
        return result

    async def all_at_altitude(
        self, altitude_m: float, *, tolerance_m: float = 1.0, timeout: float = 60.0
    ) -> FleetResult:
        """Wait until all of them are at an altitude above their homes, before anybody goes on.

        Args:
            altitude_m: metres above the home of each.
            tolerance_m: how near is there.
            timeout: seconds until they are.

        Raises:
            FleetError: one of them did not get there.
        """

        def is_there(member: Member) -> bool:
            here = member.vehicle.position.latest
            above = None if here is None else here.altitude_relative_m
            return above is not None and abs(above - altitude_m) <= tolerance_m

        return await self.barrier(is_there, timeout=timeout, description="all_at_altitude")


def _method(member: Member, name: str) -> Callable[..., Awaitable[Any]]:
    found: Any = None
    if not any(part.startswith("_") for part in name.split(".")):
        try:
            found = attrgetter(name)(member.vehicle)
        except AttributeError:
            found = None
    if not callable(found):
        raise InvalidArgument(f"action = {shown(name)} is not allowed: a method of Vehicle, such as 'land'")
    return found  # type: ignore[no-any-return]


PIECE, PIECES = 180, 4

PREAMBLE, AROUND = 0xD3, 6
"""An RTCM 3 message: preamble, ten bits of length, as many bytes, and a CRC of three."""


def rtcm_messages(data: bytes) -> Iterator[bytes]:
    """The RTCM 3 messages in these bytes, one by one; bytes that are none of them as they are."""
    while data:
        size = len(data)
        if len(data) > 3 and data[0] == PREAMBLE:
            size = min(size, AROUND + ((data[1] & 0x03) << 8 | data[2]))
        yield data[:size]
        data = data[size:]


def fragments(data: bytes, sequence: int) -> list[GpsRtcmData]:
    """One RTCM message as GPS_RTCM_DATA: flags are "is a fragment", two bits of its number, five of the sequence.

    A message is whole when four fragments are there, or all before the first that is not full: so an empty one
    follows where the last is full.

    Raises:
        InvalidArgument: it is empty, or longer than the 720 bytes that fit into four.
    """
    from aerokit.mavlink.messages import GpsRtcmData

    if not 0 < len(data) <= PIECE * PIECES:
        raise InvalidArgument(
            f"rtcm: {len(data)} bytes are not allowed: 1 to {PIECE * PIECES} in one message"
        )
    flags = (sequence & 0x1F) << 3
    if len(data) <= PIECE:
        return [GpsRtcmData(flags, len(data), data.ljust(PIECE, b"\0"))]
    pieces = [data[begin : begin + PIECE] for begin in range(0, len(data), PIECE)]
    if len(pieces) < PIECES and len(pieces[-1]) == PIECE:
        pieces.append(b"")
    return [
        GpsRtcmData(flags | number << 1 | 1, len(piece), piece.ljust(PIECE, b"\0"))
        for number, piece in enumerate(pieces)
    ]
