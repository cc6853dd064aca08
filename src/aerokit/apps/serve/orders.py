"""Orders to vehicles: a table of them, and ``Orders``, which runs each once, in a task of the server."""

from __future__ import annotations

import asyncio
import logging
import re
from collections import OrderedDict
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from aerokit._internal.plain import plain
from aerokit.apps.serve.requests import Problem, problem_of
from aerokit.connection.tasks import Background
from aerokit.errors import BusyError, HeartbeatTimeout, InvalidArgument
from aerokit.events import LinkState
from aerokit.position import Position

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from aerokit.apps.serve.watch import Watch
    from aerokit.vehicle.vehicle import Vehicle

logger: logging.Logger = logging.getLogger("aerokit")

MOST_RUNNING = 16
"""Of one vehicle at a time; orders that bring it to rest are taken all the same."""
MOST_KEPT = 500
MOST_KEYS = 100_000
"""Of orders whose result is not kept any more: they are not given again either."""
LATE_S = 5.0
"""An order whose giver saw the vehicle's state longer ago is not given."""
_KEY = re.compile(r"[A-Za-z0-9._~-]{8,64}")


@dataclass(frozen=True)
class Argument:
    """One field of an order's body: its JSON type, and what it means."""

    type: str | tuple[str, ...]
    text: str
    is_required: bool = False


@dataclass(frozen=True)
class OrderKind:
    """One order: what it takes, and how it is given. ``rests``: it is tried on a silent vehicle, too."""

    name: str
    summary: str
    give: Callable[[Vehicle, dict[str, Any]], Awaitable[object]]
    arguments: Mapping[str, Argument] = field(default_factory=dict)
    rests: bool = False

    def check(self, given: Mapping[str, Any]) -> None:
        """Raise InvalidArgument unless these are its arguments; their values are checked by the library."""
        for name in given:
            if name not in self.arguments:
                known = ", ".join(self.arguments) or "none"
                raise InvalidArgument(f"{self.name}: {name[:40]!r} is no argument; there are: {known}")
        for name, argument in self.arguments.items():
            if isinstance(given.get(name), bool):  # Python's True is 1, a flight mode
                raise InvalidArgument(f"{self.name}: {name} = {given[name]} is no {argument.type}")
            if argument.is_required and given.get(name) is None:
                raise InvalidArgument(f"{self.name}: {name} is missing ({argument.text})")


async def _go_to(vehicle: Vehicle, given: dict[str, Any]) -> None:
    place = {name: given.pop(name) for name in tuple(given) if name in _PLACE}
    await vehicle.go_to(Position(**place), **given)


async def _set_parameter(vehicle: Vehicle, given: dict[str, Any]) -> object:
    return await vehicle.parameters.set(given["name"], given["value"])


_PLACE = {
    "latitude_deg": Argument("number", "degrees, WGS 84", True),
    "longitude_deg": Argument("number", "degrees, WGS 84", True),
    "altitude_relative_m": Argument("number", "metres above home; the present altitude when none is given"),
    "altitude_amsl_m": Argument("number", "metres above the sea, instead"),
}
_GO_TO = {
    **_PLACE,
    "speed_m_s": Argument("number", "metres per second"),
    "heading_deg": Argument("number", "where the nose is to point, clockwise from north"),
}
_ALTITUDE = {"altitude_m": Argument("number", "metres above home, above 0, at most 10,000", True)}
_MODE = {"mode": Argument(("string", "integer"), "the autopilot's own name of it, or its number", True)}
_ITEM = {"item": Argument("integer", "from this item on, counted from 0 (0)")}
_VALUE = {"value": Argument("number", "finite", True)}

ORDERS = (
    OrderKind("arm", "Arm the motors: propellers may start to turn", lambda v, a: v.arm()),
    OrderKind("disarm", "Stop the motors, on the ground", lambda v, a: v.disarm(), rests=True),
    OrderKind("take_off", "Take off and climb", lambda v, a: v.take_off(**a), _ALTITUDE),
    OrderKind("go_to", "Go to a place", _go_to, _GO_TO),
    OrderKind("hold", "Stop and stay", lambda v, a: v.hold(), rests=True),
    OrderKind("land", "Land where it is", lambda v, a: v.land(), rests=True),
    OrderKind(
        "return_to_launch", "Return to the launch place", lambda v, a: v.return_to_launch(), rests=True
    ),
    OrderKind("mode", "Change the flight mode", lambda v, a: v.set_mode(a["mode"]), _MODE),
    OrderKind("mission/start", "Fly the mission", lambda v, a: v.mission.start(**a), _ITEM),
    OrderKind("mission/pause", "Pause the mission", lambda v, a: v.mission.pause(), rests=True),
    OrderKind("mission/resume", "Go on with the mission", lambda v, a: v.mission.resume()),
)
SET_PARAMETER = OrderKind("set_parameter", "Set a parameter", _set_parameter, _VALUE)


@dataclass(eq=False)
class Given:
    """One order that was given, and what has come of it."""

    key: str
    system_id: int
    order: str
    arguments: dict[str, Any]
    given_unix_s: float
    state: str = "running"
    result: Any = None
    problem: dict[str, Any] | None = None
    ended: asyncio.Event = field(default_factory=asyncio.Event)

    def record(self) -> dict[str, Any]:
        """It as the API shows it."""
        names = ("key", "system_id", "order", "arguments", "given_unix_s", "state", "result", "problem")
        return {name: getattr(self, name) for name in names}

    def is_same(self, system_id: int, order: str, arguments: Mapping[str, Any]) -> bool:
        """Whether this order is that one, given again."""
        return (self.system_id, self.order, self.arguments) == (system_id, order, arguments)


class Orders:
    """Gives each order once. Its task is the server's: a client that goes away changes nothing about a flight."""

    def __init__(self, watch: Watch) -> None:
        self._watch = watch
        self._kept: OrderedDict[str, Given] = OrderedDict()
        self._spent: OrderedDict[str, None] = OrderedDict()
        self._background = Background(_nothing)

    def give(
        self, vehicle: Vehicle, kind: OrderKind, arguments: dict[str, Any], key: str, seen_at_s: float | None
    ) -> Given:
        """Give an order, or return what was given by this key before. The kind has checked its arguments.

        Raises:
            Problem: no key, or one that was used for another order; the giver saw an old state. Nothing was sent.
            BusyError, HeartbeatTimeout, ConnectionClosed, LinkLost: as the texts say. Nothing was sent.
        """
        if not _KEY.fullmatch(key):
            raise Problem(
                400,
                "KeyMissing",
                "an order needs a header Idempotency-Key of its own: 8 to 64 of A-Z a-z 0-9 . _ ~ -",
            )
        before = self._kept.get(key)
        if before is not None and before.is_same(vehicle.system_id, kind.name, arguments):
            return before
        if before is not None or key in self._spent:
            raise Problem(409, "KeyUsed", "this Idempotency-Key was used before; nothing was sent")
        self._check(vehicle, kind, seen_at_s)
        given = Given(key, vehicle.system_id, kind.name, arguments, vehicle.connection.unix_time())
        self._keep(given)
        self._background.start(lambda: self._run(vehicle, kind, given), f"aerokit serve {kind.name}")
        self._tell(given)
        return given

    def all(self) -> list[Given]:
        """Those whose results are kept, the oldest first."""
        return list(self._kept.values())

    def get(self, key: str) -> Given:
        """The order of this key.

        Raises:
            Problem: 404, there is none.
        """
        if key not in self._kept:
            raise Problem(
                404, "NoSuchOrder", "there is no order of this key, or its result is not kept any more"
            )
        return self._kept[key]

    async def aclose(self) -> None:
        """Cancel those that are under way: the vehicle holds, as for any action of the library that is cancelled."""
        await self._background.aclose()

    def _check(self, vehicle: Vehicle, kind: OrderKind, seen_at_s: float | None) -> None:
        vehicle.connection.raise_if_ended()
        now = asyncio.get_running_loop().time()
        if seen_at_s is not None and not 0 <= now - seen_at_s <= LATE_S:
            raise Problem(
                409,
                "Late",
                "the state that this order was given upon is too old; nothing was sent: look, and order again",
            )
        if kind.rests:
            return
        if vehicle.link_state.latest is not LinkState.CONNECTED:
            raise HeartbeatTimeout(
                f"{kind.name}: vehicle {vehicle.system_id} is not heard"
                f" (last heartbeat {vehicle.heartbeat_age:.1f} s ago); nothing was sent"
            )
        running = [each for each in self._kept.values() if each.state == "running"]
        if sum(each.system_id == vehicle.system_id for each in running) >= MOST_RUNNING:
            raise BusyError(
                f"{MOST_RUNNING} orders to vehicle {vehicle.system_id} are under way; nothing was sent"
            )

    def _keep(self, given: Given) -> None:
        self._kept[given.key] = given
        for key in [key for key, each in self._kept.items() if each.state != "running"]:
            if len(self._kept) <= MOST_KEPT:
                break
            del self._kept[key]
            self._spent[key] = None
        while len(self._spent) > MOST_KEYS:
            self._spent.popitem(last=False)

    async def _run(self, vehicle: Vehicle, kind: OrderKind, given: Given) -> None:
        try:
            given.result = plain(await kind.give(vehicle, dict(given.arguments)))
            given.state = "done"
        except asyncio.CancelledError:
            given.state = "failed"
            given.problem = problem_of(Problem(503, "Ended", "the server ended; what can be held, holds"))
            raise
        except Exception as error:
            given.state, given.problem = "failed", problem_of(error)
            if given.problem["status"] == 500:
                logger.exception("order %s to vehicle %d", given.order, given.system_id)
        finally:
            given.ended.set()
            self._tell(given)

    def _tell(self, given: Given) -> None:
        self._watch.publish({"type": "order", **given.record()})


def _nothing(error: Exception) -> None:
    pass
