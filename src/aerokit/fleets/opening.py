"""``aerokit.fleet``: opens connections, finds and connects vehicles, and yields the fleet."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterable, Mapping
from contextlib import AsyncExitStack, ExitStack, contextmanager
from functools import partial
from itertools import combinations
from typing import TYPE_CHECKING, Literal, NamedTuple

import anyio

from aerokit._internal.arguments import checked
from aerokit._internal.async_block import async_block
from aerokit._internal.formatting import short_repr
from aerokit.connection.connection import Connection
from aerokit.connection.heartbeats import is_autopilot
from aerokit.connection.opening import explain_no_vehicle, open_connection
from aerokit.connection.tasks import BackgroundTasks, run_shielded
from aerokit.errors import ConnectFailed, InvalidArgument
from aerokit.fleets.action import FleetContext
from aerokit.fleets.distances import DistanceMonitor
from aerokit.fleets.fleet import Fleet
from aerokit.fleets.members import Member
from aerokit.fleets.policy import MemberFailure, PolicyDecision, PolicyName, PolicyRules
from aerokit.mavlink.messages import Heartbeat
from aerokit.transport.link import Link
from aerokit.vehicle.connect import connect
from aerokit.vehicle.vehicle import Vehicle

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Collection, Iterator, Sequence
    from types import TracebackType

    from aerokit.mavlink.message import Message

logger: logging.Logger = logging.getLogger("aerokit")

TooCloseAction = Literal["hold", "report"]
"""The fleet's reaction if two members come too close to each other in flight."""
Source = str | Link | Connection | Vehicle

DISCOVERY_S = 2.5  # In this time, two heartbeats arrive at 1 Hz, of which one may be lost.
HEARTBEAT_MAX_AGE_S = 10.0  # On an open connection, a vehicle that was silent for longer counts as gone.
WAIT_WARNING_S = 5.0


@checked
@async_block
async def fleet(
    *sources: str | Link | Connection | Vehicle | Mapping[str, str | Link | Connection | Vehicle],
    count: int | None = None,
    system_ids: Iterable[int] | Mapping[str, Iterable[int]] | None = None,
    groups: Mapping[str, Iterable[str]] | None = None,
    roles: Mapping[str, Iterable[str]] | None = None,
    on_error: PolicyName | Callable[[MemberFailure], PolicyDecision] = "hold_others",
    on_error_by_group: Mapping[str, PolicyName | Callable[[MemberFailure], PolicyDecision]] | None = None,
    min_distance_m: float | None = None,
    on_too_close: TooCloseAction = "hold",
    timeout: float = 30.0,
    rates: Mapping[type[Message], float] | None = None,
) -> AsyncIterator[Fleet]:
    """Combine vehicles into a fleet for the duration of the ``async with`` block.

    Each connection is a network with a name. A member is named after its network and its system id: ``"north/7"`` is
    system 7 of network "north". Several networks can therefore use the same system ids.

    Args:
        *sources: vehicle objects, which become members, and addresses, links or open connections, whose vehicles become
            members. A mapping gives names to networks or vehicles; other networks are named ``"1"``, ``"2"`` …
        count: total number of vehicles to wait for; None: wait until each network has one, then 2.5 seconds for others.
        system_ids: system ids to use, for all networks or mapped by network name; None: all that are found.
        groups: maps groups to names or patterns of members (``"north/*"``). Other members have the group ``""``.
        roles: maps roles to names or patterns of members.
        on_error: policy for the other members when a member fails in an action (docs/fleets.md).
        on_error_by_group: maps groups to the policy for a failure of one of their members, instead of ``on_error``.
        min_distance_m: minimum distance between any two members in metres. Paths are compared before flight, and the
            event ``TooClose`` reports violations in flight; None: no checks.
        on_too_close: ``"hold"``: members that are too close also hold, if this program flies them; ``"report"``: only
            publish the event.
        timeout: seconds to wait for all members. After five seconds, a warning of the logger "aerokit" lists the
            missing members.
        rates: maps message classes to rates in Hz that are requested from each member instead of the default rates;
            ``{}`` requests nothing.

    Raises:
        InvalidArgument: an argument is not allowed, or two vehicles have the same name.
        BusyError: this program already has a vehicle object for one of ``system_ids`` on that connection.
        LinkOpenError: a link could not be opened.
        LinkLost, ConnectionClosed: a link closed while the fleet waited for members.
        ConnectFailed: some members were not found in time; the text lists the members found.
    """
    rules = PolicyRules(on_error, on_error_by_group or {})
    _check_arguments(count, groups or {}, on_error_by_group or {}, min_distance_m, on_too_close)
    sources_by_name = _named_sources(sources)
    async with AsyncExitStack() as stack:
        networks: dict[str, Connection] = {}
        for name, source in sources_by_name.items():
            if isinstance(source, (str, Link)):
                networks[name] = await stack.enter_async_context(open_connection(source))
            elif isinstance(source, Connection):
                networks[name] = source
        given_names = {name for source in sources if isinstance(source, Mapping) for name in source}
        members = _members_of_vehicles(sources_by_name, given_names, networks)
        searched = {name: networks[name] for name, source in sources_by_name.items() if not isinstance(source, Vehicle)}
        requested_ids = _requested_ids(system_ids, list(searched))
        found_ids = await _Discovery(searched, requested_ids, count, passed_count=len(members)).run(timeout)
        systems = [_System(name, searched[name], system_id) for name, ids in found_ids.items() for system_id in ids]
        connections = MemberConnections(timeout, rates)
        stack.push_async_exit(connections.aclose)
        for system, vehicle in zip(systems, await connections.open(systems), strict=True):
            members.append(Member(system.name, system.network, vehicle))
        _check_names(members)
        now = next(iter(networks.values())).now  # the clock of the event loop, which all connections share
        context = FleetContext(members, networks, rules, now=now, on_error=_raise, min_distance_m=min_distance_m)
        _assign(context, groups or {}, "group")
        _assign(context, roles or {}, "role")
        stack.push_async_callback(context.aclose)
        context.start()
        if min_distance_m is not None:
            monitor = DistanceMonitor(context, min_distance_m, holds=on_too_close == "hold")
            context.background.start(monitor.run, "aerokit distances")
        yield Fleet(context)


def _check_arguments(
    count: int | None,
    groups: Collection[str],
    groups_with_policy: Iterable[str],
    min_distance_m: float | None,
    on_too_close: TooCloseAction,
) -> None:
    if min_distance_m is not None and not 0 < min_distance_m < 10_000:
        raise InvalidArgument(
            f"min_distance_m = {min_distance_m!r} is not allowed: it must be above 0 and below 10,000 metres"
        )
    if on_too_close not in ("hold", "report"):
        raise InvalidArgument(f"on_too_close = {on_too_close!r} is not allowed: it must be 'hold' or 'report'")
    for group in groups_with_policy:
        if group and group not in groups:  # members outside of all groups have the group ""
            allowed = f"the groups are {', '.join(groups)}" if groups else "there are no groups"
            raise InvalidArgument(f"on_error_by_group = {short_repr(group)} is not allowed: {allowed}")
    if count is not None and count < 1:
        raise InvalidArgument(f"count = {count} is not allowed: it must be 1 or more, or None")


def _named_sources(sources: tuple[Source | Mapping[str, Source], ...]) -> dict[str, Source]:
    sources_by_name: dict[str, Source] = {}
    for number, source in enumerate(sources, 1):
        entries = source if isinstance(source, Mapping) else {str(number): source}
        for name, entry in entries.items():
            if not isinstance(name, str) or not name:
                raise InvalidArgument(f"sources: name {short_repr(name)} is not allowed: it must be a non-empty string")
            if name in sources_by_name:
                raise InvalidArgument(f"sources: two sources are named {name!r}")
            sources_by_name[name] = entry
    if not sources_by_name:
        raise InvalidArgument("a fleet needs at least one address, link, connection or vehicle")
    return sources_by_name


def _members_of_vehicles(
    sources_by_name: Mapping[str, Source], given_names: set[str], networks: dict[str, Connection]
) -> list[Member]:
    """Return a member for each vehicle object, and add the vehicles' connections to ``networks``."""
    members: list[Member] = []
    for name, source in sources_by_name.items():
        if isinstance(source, Vehicle):
            names_of_connection = (key for key, connection in networks.items() if connection is source.connection)
            network = next(names_of_connection, None)
            if network is None:
                network = name
                networks[name] = source.connection
            # The program has chosen the names in `given_names`.
            member_name = name if name in given_names else f"{network}/{source.system_id}"
            members.append(Member(member_name, network, source))
    return members


def _requested_ids(
    system_ids: Iterable[int] | Mapping[str, Iterable[int]] | None, networks: list[str]
) -> dict[str, list[int] | None]:
    """Return the requested system ids of each network; None means all that are found."""
    ids: dict[str, list[int] | None] = {name: None for name in networks}  # noqa: C420 - `fromkeys` has a narrower type
    if isinstance(system_ids, Mapping):
        for name, network_ids in system_ids.items():
            if str(name) not in ids:
                raise InvalidArgument(
                    f"system_ids: {short_repr(name)} is not a network; networks: {', '.join(networks)}"
                )
            ids[str(name)] = list(network_ids)
    elif system_ids is not None:
        all_ids = list(system_ids)
        ids = {name: list(all_ids) for name in networks}
    for requested in ids.values():
        for system_id in requested or ():
            if not isinstance(system_id, int) or not 1 <= system_id <= 255:
                raise InvalidArgument(f"system_ids: {short_repr(system_id)} is not allowed: it must be 1 to 255")
    return ids


def _check_names(members: list[Member]) -> None:
    for member, other in combinations(members, 2):
        if member.name == other.name:
            raise InvalidArgument(f"two vehicles are named {member.name!r}: pass a mapping with different names")
        if member.vehicle is other.vehicle:
            raise InvalidArgument(f"{member.name!r} and {other.name!r} are the same vehicle")


def _assign(context: FleetContext, patterns_by_name: Mapping[str, Iterable[str]], attribute: str) -> None:
    """Set ``attribute`` (``group`` or ``role``) to each name, for the members that match its patterns."""
    for name, one_or_more in patterns_by_name.items():
        patterns = [one_or_more] if isinstance(one_or_more, str) else one_or_more
        for member_name in context.matching(*patterns):
            member = context.members[member_name]
            previous = getattr(member, attribute)
            if previous:
                raise InvalidArgument(f"member {member_name} has two {attribute}s: {previous!r} and {name!r}")
            setattr(member, attribute, name)


def _raise(error: Exception) -> None:
    raise error


# --------------------------------------------------------------------------------------- discovery


class _Discovery:
    """Finds the system ids to connect to, by network: the requested ones, or all found that have no vehicle object yet.

    ``requested`` maps networks to system ids, or to None for all. ``count`` is the total number of vehicles to wait
    for; None: at least one on each network. The count includes the ``passed_count`` vehicles that the program passed to
    ``fleet()``.
    """

    def __init__(
        self,
        networks: Mapping[str, Connection],
        requested: Mapping[str, list[int] | None],
        count: int | None,
        passed_count: int,
    ) -> None:
        self._networks, self._count, self._passed_count = networks, count, passed_count
        self._searched = [name for name in networks if requested[name] is None]
        # The system ids of each network: first those that were requested, then those that are found. The inner dicts
        # serve as ordered sets.
        self._found: dict[str, dict[int, None]] = {name: dict.fromkeys(requested[name] or ()) for name in networks}
        self._changed = asyncio.Event()

    async def run(self, timeout: float) -> dict[str, list[int]]:
        """Wait for the vehicles. Raises ConnectFailed or, if a link that is searched has ended, its error."""
        with ExitStack() as stack:
            self._observe_networks(stack)
            with anyio.move_on_after(timeout):
                with warn_while_waiting(timeout, self._describe):
                    await self._wait_until_complete()
                if self._searched and self._count is None:
                    await anyio.sleep(DISCOVERY_S)
        if not self._is_complete:
            silent = (name for name in self._searched if not self._found[name])
            reasons = [
                f"\n  - network {name}: {explain_no_vehicle(self._networks[name], wanted_system=None)}"
                for name in silent
            ]
            raise ConnectFailed(f"within {timeout:g} s {self._describe()}{''.join(reasons)}")
        return {name: sorted(ids) for name, ids in self._found.items()}

    def _observe_networks(self, stack: ExitStack) -> None:
        for name in self._searched:
            connection = self._networks[name]
            connection.raise_if_ended()
            # A vehicle that returns after a silence sends a HEARTBEAT, but causes no second event VehicleFound.
            stack.callback(connection.bus.attach(Heartbeat, partial(self._on_heartbeat, name)))
            stack.callback(connection.on_end(lambda _: self._changed.set()))
            for source, heartbeat in connection.heartbeats.items():
                if connection.now() - connection.last_heartbeat_at(*source) <= HEARTBEAT_MAX_AGE_S:
                    self._on_heartbeat(name, heartbeat)

    @property
    def _is_complete(self) -> bool:
        if self._count is not None:
            return self._passed_count + sum(map(len, self._found.values())) >= self._count
        return all(self._found[name] for name in self._searched)

    async def _wait_until_complete(self) -> None:
        while not self._is_complete:
            for name in self._searched:
                self._networks[name].raise_if_ended()
            self._changed.clear()
            await self._changed.wait()

    def _describe(self) -> str:
        names = [f"{name}/{system_id}" for name, ids in self._found.items() for system_id in ids]
        listed = ", ".join(names)
        if self._count is not None:
            found_count = self._passed_count + len(names)
            text = f"{found_count or 'none'} of {self._count} vehicles were found"
            if self._passed_count:
                text += f", {self._passed_count} of them passed as vehicles"
            return f"{text}: {listed}" if names else text
        text = f"no vehicle was found on {', '.join(name for name in self._searched if not self._found[name])}"
        return f"{text}; found: {listed}" if names else text

    def _on_heartbeat(self, name: str, heartbeat: Heartbeat) -> None:
        frame = heartbeat.received_frame
        assert frame is not None
        if is_autopilot(heartbeat) and frame.system_id not in self._networks[name].attached:
            self._found[name].setdefault(frame.system_id)
            self._changed.set()


@contextmanager
def warn_while_waiting(timeout: float, describe: Callable[[], str]) -> Iterator[None]:
    """Log one warning if the ``with`` block takes longer than five seconds.

    ``describe`` returns what is missing.
    """

    def warn() -> None:
        logger.warning("fleet: %s after %g s; waiting up to %g s in total", describe(), WAIT_WARNING_S, timeout)

    timer = asyncio.get_running_loop().call_later(WAIT_WARNING_S, warn)
    try:
        yield
    finally:
        timer.cancel()


class _System(NamedTuple):
    """A vehicle to connect to."""

    network: str
    connection: Connection
    system_id: int

    @property
    def name(self) -> str:
        return f"{self.network}/{self.system_id}"


class _BlockFailed(Exception):
    """Raised in the `connect` block of each vehicle after an error in the fleet's block.

    `connect` then closes the vehicle as after any error, and logs a vehicle that is still flying.
    """


class MemberConnections:
    """Connects vehicles, each in a separate task, so that closing the fleet closes all of them at once."""

    def __init__(self, timeout: float, rates: Mapping[type[Message], float] | None) -> None:
        self._timeout, self._rates = timeout, rates
        self._tasks = BackgroundTasks(self._on_error)
        self._connected: dict[_System, Vehicle] = {}
        self._error: Exception | None = None
        self._changed = asyncio.Event()  # set after each connection and each error
        self._closing = asyncio.Event()  # set at the end of the fleet's block
        self._has_block_failed = False
        self._running_task_count = 0
        self._all_closed = asyncio.Event()

    async def open(self, systems: Sequence[_System]) -> list[Vehicle]:
        """Connect to systems, and return their vehicles in the same order."""
        for system in systems:
            self._running_task_count += 1
            self._tasks.start(partial(self._run, system))

        def describe_missing() -> str:
            return f"no heartbeat of {', '.join(system.name for system in systems if system not in self._connected)}"

        with warn_while_waiting(self._timeout, describe_missing):
            while len(self._connected) < len(systems) and self._error is None:
                self._changed.clear()
                await self._changed.wait()
        if self._error is not None:
            raise self._error
        return [self._connected[system] for system in systems]

    async def aclose(
        self,
        error_class: type[BaseException] | None = None,
        error: BaseException | None = None,
        traceback: TracebackType | None = None,
    ) -> None:
        self._has_block_failed = error is not None
        self._closing.set()
        # While a task is still connecting, opening has failed, and it suffices to cancel the tasks.
        are_all_connected = len(self._connected) == self._running_task_count
        if self._running_task_count and are_all_connected:
            await run_shielded(self._all_closed.wait())
        await self._tasks.aclose()

    async def _run(self, system: _System) -> None:
        connection, system_id = system.connection, system.system_id
        try:
            async with connect(connection, system_id=system_id, timeout=self._timeout, rates=self._rates) as vehicle:
                self._connected[system] = vehicle
                self._changed.set()
                await self._closing.wait()
                if self._has_block_failed:  # connect() must close the vehicle as after an error in its own block.
                    raise _BlockFailed
        except _BlockFailed:
            pass
        finally:
            self._running_task_count -= 1
            if not self._running_task_count:
                self._all_closed.set()

    def _on_error(self, error: Exception) -> None:
        self._error = self._error or error
        self._changed.set()
