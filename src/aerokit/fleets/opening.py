"""``aerokit.fleet``: from addresses, connections and vehicles to a fleet, for the time of an ``async with`` block."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING, Literal

from aerokit._internal.arguments import checked
from aerokit._internal.async_block import async_block
from aerokit._internal.wording import shown
from aerokit.connection.connection import Connection
from aerokit.connection.opening import open_connection
from aerokit.errors import InvalidArgument
from aerokit.fleets.action import Crew
from aerokit.fleets.distances import DistanceWatch
from aerokit.fleets.finding import find_systems
from aerokit.fleets.fleet import Fleet
from aerokit.fleets.members import Keepers, Member
from aerokit.fleets.policy import Failure, PolicyName, PolicyOrder, Rules
from aerokit.transport.link import Link
from aerokit.vehicle.vehicle import Vehicle

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from aerokit.mavlink.message import Message

WhenTooClose = Literal["hold", "tell"]
"""What is done about two members that are too near to each other in flight."""
Source = str | Link | Connection | Vehicle


@checked
@async_block
async def fleet(
    *sources: str | Link | Connection | Vehicle | Mapping[str, str | Link | Connection | Vehicle],
    count: int | None = None,
    system_ids: Iterable[int] | Mapping[str, Iterable[int]] | None = None,
    groups: Mapping[str, Iterable[str]] | None = None,
    roles: Mapping[str, Iterable[str]] | None = None,
    on_error: PolicyName | Callable[[Failure], PolicyName | Mapping[str, PolicyOrder] | None] = "hold_others",
    on_error_of: Mapping[str, PolicyName | Callable[[Failure], PolicyName | Mapping[str, PolicyOrder] | None]]
    | None = None,
    min_distance_m: float | None = None,
    too_close: WhenTooClose = "hold",
    timeout: float = 30.0,
    rates: Mapping[type[Message], float] | None = None,
) -> AsyncIterator[Fleet]:
    """Make many vehicles one fleet for the time of the ``async with`` block.

    Each connection is a network with a name, and a member is called by both: ``"north/7"`` is system 7 of the network
    "north". So system ids, which end at 255, may be the same on several networks.

    Args:
        *sources: addresses, links, connections that are open already, on which all vehicles that are heard become
            members; and vehicles. Networks without a name are called ``"1"``, ``"2"`` …; a mapping gives names: of
            networks, and of vehicles.
        count: how many vehicles are waited for, in all; None: at least one on each network, and who is heard in the
            2.5 seconds after.
        system_ids: those on the networks that belong to it, for all networks or by the network's name; None: all.
        groups: group → names or patterns of its members (``"north/*"``). Who is in none has the group ``""``.
        roles: role → names or patterns, likewise.
        on_error: what the others do when one fails in a common action (docs/fleets.md).
        on_error_of: group → the same when one of this group fails.
        min_distance_m: metres between any two: ways are compared before they are flown, and in flight the event
            ``TooClose`` tells who is nearer to whom; None: nobody looks.
        too_close: what is done then: both ``"hold"``, as far as they take orders, or it is only told (``"tell"``).
        timeout: seconds to wait for all of them; after five of them a warning of logger "aerokit" says who is missing.
        rates: message class → Hz, asked of each instead of the default rates; ``{}`` asks for nothing.

    Raises:
        InvalidArgument: an argument is wrong, or two vehicles have the same name.
        BusyError: this program has a vehicle object of one of ``system_ids`` on that connection already.
        LinkOpenError: a link could not be opened.
        LinkLost, ConnectionClosed: a link went down while waiting.
        ConnectFailed: not all of them were heard in time; the text says which were.
    """
    rules = Rules(on_error, on_error_of or {})
    if min_distance_m is not None and not 0 < min_distance_m < 10_000:
        raise InvalidArgument(f"min_distance_m = {min_distance_m!r} is not allowed: above 0 to 10,000 metres")
    if too_close not in ("hold", "tell"):
        raise InvalidArgument(f"too_close = {too_close!r} is not allowed: 'hold' or 'tell'")
    strange = [group for group in on_error_of or {} if group and group not in (groups or {})]
    if strange:
        there = f"the groups are {', '.join(groups)}" if groups else "there are no groups"
        raise InvalidArgument(f"on_error_of = {shown(strange[0])} is not allowed: {there}")
    if count is not None and count < 1:
        raise InvalidArgument(f"count = {count} is not allowed: 1 or more, or None")
    named = _named(sources)
    async with AsyncExitStack() as stack:
        networks: dict[str, Connection] = {}
        for name, source in named.items():
            if isinstance(source, (str, Link)):
                networks[name] = await stack.enter_async_context(open_connection(source))
            elif isinstance(source, Connection):
                networks[name] = source
        members = _given(named, networks)
        found = [name for name, source in named.items() if not isinstance(source, Vehicle)]
        ids = await find_systems(
            {name: networks[name] for name in found}, _ids(system_ids, found), count, len(members), timeout
        )
        keepers = Keepers(timeout, rates)
        stack.push_async_exit(keepers.leave)
        kept = await keepers.keep([(name, networks[name], each) for name in found for each in ids[name]])
        members += [Member(f"{name}/{vehicle.system_id}", name, vehicle) for name, vehicle in kept]
        _check_names(members)
        crew = Crew(members, networks, rules, next(iter(networks.values())).now, _raise, min_distance_m)
        _sort(crew, groups or {}, "group")
        _sort(crew, roles or {}, "role")
        stack.push_async_callback(crew.aclose)
        crew.start()
        if min_distance_m is not None:
            watch = DistanceWatch(crew, min_distance_m, holds=too_close == "hold")
            crew.background.start(watch.run, "aerokit distances")
        yield Fleet(crew)


def _named(sources: tuple[Source | Mapping[str, Source], ...]) -> dict[str, Source]:
    """Name → source: network or vehicle."""
    named: dict[str, Source] = {}
    for number, source in enumerate(sources, 1):
        more = source if isinstance(source, Mapping) else {str(number): source}
        for name, each in more.items():
            if not isinstance(name, str) or not name:
                raise InvalidArgument(f"sources: {shown(name)} is no name")
            if name in named:
                raise InvalidArgument(f"sources: two are called {name!r}")
            named[name] = each
    if not named:
        raise InvalidArgument("sources: a fleet needs an address, a connection or a vehicle")
    return named


def _given(named: Mapping[str, Source], networks: dict[str, Connection]) -> list[Member]:
    """Members of the vehicles that were handed in; their connections are networks, too."""
    members: list[Member] = []
    for name, source in named.items():
        if isinstance(source, Vehicle):
            network = next(
                (each for each, open_one in networks.items() if open_one is source.connection), None
            )
            if network is None:
                network = name
                networks[name] = source.connection
            is_numbered = name.isdecimal()
            members.append(Member(f"{network}/{source.system_id}" if is_numbered else name, network, source))
    return members


def _ids(
    system_ids: Iterable[int] | Mapping[str, Iterable[int]] | None, networks: list[str]
) -> dict[str, list[int] | None]:
    ids: dict[str, list[int] | None] = {name: None for name in networks}  # noqa: C420 - of a wider type
    by_network: dict[str, Iterable[int]] = {}
    if isinstance(system_ids, Mapping):
        by_network = {str(name): those for name, those in system_ids.items()}
    elif system_ids is not None:
        ids = {name: list(system_ids) for name in networks}
    for name, those in by_network.items():
        if name not in ids:
            raise InvalidArgument(f"system_ids: {shown(name)} is no network: {', '.join(networks)}")
        ids[name] = list(those)
    for each in (number for those in ids.values() for number in those or ()):
        if not isinstance(each, int) or not 1 <= each <= 255:
            raise InvalidArgument(f"system_ids: {shown(each)} is not allowed: 1 to 255")
    return ids


def _check_names(members: list[Member]) -> None:
    seen: dict[str, Member] = {}
    for each in members:
        other = seen.setdefault(each.name, each)
        if other is not each:
            raise InvalidArgument(f"two vehicles are called {each.name!r}: give them names of their own")
        twice = next((one.name for one in members if one is not each and one.vehicle is each.vehicle), None)
        if twice is not None:
            raise InvalidArgument(f"{each.name!r} and {twice!r} are the same vehicle")


def _sort(crew: Crew, sorts: Mapping[str, Iterable[str]], what: str) -> None:
    for name, patterns in sorts.items():
        those = [patterns] if isinstance(patterns, str) else list(patterns)
        for each in crew.matching(*those):
            before = getattr(crew.members[each], what)
            if before:
                raise InvalidArgument(f"{each} is in two {what}s: {before!r} and {name!r}")
            setattr(crew.members[each], what, name)


def _raise(error: Exception) -> None:
    raise error
