"""Orders to vehicles: the table of order types, and ``OrderRunner``, which runs each order once."""

from __future__ import annotations

import asyncio
import hashlib
import json
import logging
import re
import sys
from collections import OrderedDict
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

from aerokit._internal.formatting import to_jsonable
from aerokit.apps.parameter_values import check_values, with_range_note
from aerokit.apps.plan_text import parse_plan_text
from aerokit.apps.serve.flight_watch import SURFACE_TYPES
from aerokit.apps.serve.requests import MAX_BODY_SIZE, MAX_PLAN_SIZE, HttpProblem, problem_of
from aerokit.connection.tasks import BackgroundTasks
from aerokit.errors import BusyError, HeartbeatTimeout, InvalidArgument, OperationRejected
from aerokit.events import LinkState
from aerokit.mavlink.enums import MavType
from aerokit.position import Position
from aerokit.vehicle.commanding.order import SUPERSEDED
from aerokit.vehicle.state.telemetry import is_reported_on_ground

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from aerokit.apps.serve.served_vehicles import ServedVehicles
    from aerokit.missions import Plan
    from aerokit.parameters import Metadata
    from aerokit.vehicle.vehicle import Vehicle

logger: logging.Logger = logging.getLogger("aerokit")

MAX_RUNNING = 16
"""Maximum number of running orders for each vehicle. Orders with ``is_safe`` are accepted nevertheless."""
MAX_RESULTS = 500
"""Maximum number of orders whose results are stored."""
MAX_USED_KEYS = 100_000
"""Maximum number of keys of older orders that are stored to detect reuse."""
STATE_MAX_AGE_S = 5.0
"""Maximum age in seconds of the state on which a client bases an order."""
_LANDED_STATE_MAX_AGE_S = 3.0
_NOT_MOTION = ("arm", "disarm", "mission/upload", "set_parameter")
"""Orders that do not replace a running order about the vehicle's motion."""
_KEY = re.compile(r"[A-Za-z0-9._~-]{8,64}")


@dataclass(frozen=True)
class OrderArgument:
    """One argument of an order: a field of the request body, with its JSON type and description."""

    type: str | tuple[str, ...]
    text: str
    is_required: bool = False


class ParsedArguments(NamedTuple):
    """Arguments of an order: those to store in its `OrderRecord`, and those to pass to `OrderType.run`."""

    recorded: dict[str, Any]
    passed: dict[str, Any]


def _parse_unchanged(values: Mapping[str, Any]) -> ParsedArguments:
    return ParsedArguments(recorded=dict(values), passed=dict(values))


@dataclass(frozen=True)
class OrderType:
    """One type of order: its arguments, and the function that runs it.

    ``is_safe`` is True for an order that stops, lands or disarms the vehicle. It is sent even to a silent vehicle.
    ``holds_at_end`` is True if the vehicle is commanded to hold when the server ends while the order runs.
    ``parse`` converts the arguments of the request.
    """

    name: str
    summary: str
    run: Callable[[Vehicle, dict[str, Any]], Awaitable[object]]
    arguments: Mapping[str, OrderArgument] = field(default_factory=dict)
    is_safe: bool = False
    holds_at_end: bool = False
    parse: Callable[[Mapping[str, Any]], ParsedArguments] = _parse_unchanged
    max_body_size: int = MAX_BODY_SIZE

    def check(self, values: Mapping[str, Any]) -> None:
        """Raise InvalidArgument for unknown and missing arguments, and for a boolean in place of another type.

        A boolean argument accepts only booleans. Other types and ranges are checked by the method that the order calls.
        """
        for name in values:
            if name not in self.arguments:
                names = ", ".join(self.arguments) or "none"
                raise InvalidArgument(f"{self.name}: unknown argument {name[:40]!r}; arguments: {names}")
        for name, argument in self.arguments.items():
            value = values.get(name)
            # Python accepts bools as ints, but True is not the number of a mode.
            if value is not None and isinstance(value, bool) != (argument.type == "boolean"):
                raise InvalidArgument(
                    f"{self.name}: {name} = {value!r:.40} is not allowed: its type must be {argument.type}"
                )
            if argument.is_required and value is None:
                raise InvalidArgument(f"{self.name}: argument {name} is missing ({argument.text})")


async def _disarm(vehicle: Vehicle, values: dict[str, Any]) -> None:
    await vehicle.disarm(force=bool(values.get("force")))


async def _go_to(vehicle: Vehicle, values: dict[str, Any]) -> None:
    altitude_m = values.get("altitude_relative_m")
    is_below_home = isinstance(altitude_m, (int, float)) and altitude_m < 0
    if is_below_home and vehicle.autopilot.vehicle_type != MavType.SUBMARINE:
        raise InvalidArgument(
            f"go_to: altitude_relative_m = {altitude_m!r:.40} is not allowed: it must be 0 or more, except for"
            " submarines (altitude_amsl_m is not limited); nothing was sent"
        )
    position = {name: values.pop(name) for name in tuple(values) if name in _POSITION}
    await vehicle.go_to(Position(**position), **values)


async def _hold(vehicle: Vehicle, _: dict[str, Any]) -> object:
    await vehicle.hold()
    return {"mode": vehicle.mode_name}


async def _pause(vehicle: Vehicle, _: dict[str, Any]) -> object:
    await vehicle.mission.pause()
    return {"mode": vehicle.mode_name}


async def _resume(vehicle: Vehicle, values: dict[str, Any]) -> None:
    # On the ground, an ArduCopter with a finished mission would take off and fly the mission again.
    is_on_ground = is_reported_on_ground(vehicle, max_age_s=_LANDED_STATE_MAX_AGE_S)
    if vehicle.is_armed and is_on_ground and vehicle.autopilot.vehicle_type not in SURFACE_TYPES:
        raise OperationRejected(
            "mission/resume: the vehicle is on the ground and would take off; use mission/start to take off;"
            " nothing was sent"
        )
    await vehicle.mission.resume()


async def _set_parameter(vehicle: Vehicle, values: dict[str, Any], metadata: Metadata | None = None) -> object:
    result = await vehicle.parameters.set(values["name"], values["value"])
    return with_range_note(metadata, result, metadata_option="serve --metadata FILE")


def parameter_order(metadata: Metadata | None) -> OrderType:
    """Return the type of orders that set a parameter. Their results say if a value's range was not checked."""
    return replace(SET_PARAMETER, run=partial(_set_parameter, metadata=metadata))


def check_parameter(metadata: Metadata | None, values: Mapping[str, Any]) -> None:
    value = values["value"]
    # The library itself rejects values of other types, and values that MAVLink cannot represent.
    if isinstance(value, (int, float)) and abs(value) <= sys.float_info.max and not values.get("force"):
        check_values(metadata, {values["name"]: value}, force_option='"force": true')


async def _upload(vehicle: Vehicle, values: dict[str, Any]) -> None:
    plan: Plan = values["plan"]
    if plan.mission.items:
        await vehicle.mission.upload(plan.mission)
    if plan.fence.to_items():
        await vehicle.fence.upload(plan.fence)
    if len(plan.rally):
        await vehicle.rally.upload(plan.rally)


def parse_plan_body(values: Mapping[str, Any]) -> tuple[str, str, Plan]:
    """Return the name, the text and the plan of a request body.

    The field ``plan`` is the JSON object of a .plan, or the text of a file. Raises the errors of `parse_plan_text`.
    """
    name = values.get("name")
    name = name[:100] if isinstance(name, str) else "plan"
    content = values["plan"]
    text = content if isinstance(content, str) else json.dumps(content)
    return name, text, parse_plan_text(text, name)


def _parse_plan_arguments(values: Mapping[str, Any]) -> ParsedArguments:
    """Parse the plan. Record only its name, counts and hash, because a plan may be large."""
    name, text, plan = parse_plan_body(values)
    counts = {
        "mission_items": len(plan.mission),
        "fence_items": len(plan.fence.to_items()),
        "rally_points": len(plan.rally),
    }
    if not any(counts.values()):
        raise InvalidArgument(f"{name} has no mission items, fence or rally points; nothing was sent")
    recorded = {"name": name, **counts, "sha256": hashlib.sha256(text.encode()).hexdigest()}
    return ParsedArguments(recorded, passed={"plan": plan})


_POSITION = {
    "latitude_deg": OrderArgument("number", "degrees, WGS 84", is_required=True),
    "longitude_deg": OrderArgument("number", "degrees, WGS 84", is_required=True),
    "altitude_relative_m": OrderArgument("number", "metres above home; without an altitude, the current one"),
    "altitude_amsl_m": OrderArgument("number", "metres above sea level, as an alternative"),
}
_GO_TO = {
    **_POSITION,
    "speed_m_s": OrderArgument("number", "metres per second"),
    "heading_deg": OrderArgument("number", "heading of the nose, clockwise from north"),
}
_ALTITUDE = {"altitude_m": OrderArgument("number", "metres above home, above 0, at most 10,000", is_required=True)}
_MODE = {"mode": OrderArgument(("string", "integer"), "the autopilot's name or number of the mode", is_required=True)}
_DISARM = {
    "force": OrderArgument(
        "boolean", "true: also if the vehicle reports that it flies; refused unless it has a `crash` (false)"
    )
}
_ITEM = {"item": OrderArgument("integer", "first item, counted from 0 (0)")}
_VALUE = {
    "value": OrderArgument("number", "finite", is_required=True),
    "force": OrderArgument("boolean", "true: also set a value that the metadata does not allow (false)"),
}
_PLAN = {
    "plan": OrderArgument(
        ("object", "string"),
        "content of a QGroundControl .plan file; or the text of one, or of a QGC WPL 110 file",
        is_required=True,
    ),
    "name": OrderArgument("string", "name of the file, for the list of orders"),
}

UPLOAD = OrderType(
    "mission/upload",
    "Replace the mission; the fence and rally points too, if the plan has them",
    _upload,
    _PLAN,
    parse=_parse_plan_arguments,
    max_body_size=MAX_PLAN_SIZE,
)
ORDERS = (
    OrderType("arm", "Arm the motors: propellers may start to turn", lambda vehicle, _: vehicle.arm()),
    OrderType("disarm", "Stop the motors, on the ground", _disarm, _DISARM, is_safe=True),
    OrderType(
        "take_off",
        "Take off and climb",
        lambda vehicle, values: vehicle.take_off(**values),
        _ALTITUDE,
        holds_at_end=True,
    ),
    OrderType("go_to", "Go to a position", _go_to, _GO_TO, holds_at_end=True),
    OrderType("hold", "Stop and hold position", _hold, is_safe=True),
    OrderType("land", "Land at the current position", lambda vehicle, _: vehicle.land(), is_safe=True),
    OrderType(
        "return_to_launch", "Return to the launch position", lambda vehicle, _: vehicle.return_to_launch(), is_safe=True
    ),
    OrderType("mode", "Change the flight mode", lambda vehicle, values: vehicle.set_mode(values["mode"]), _MODE),
    UPLOAD,
    OrderType(
        "mission/start",
        "Fly the mission",
        lambda vehicle, values: vehicle.mission.start(**values),
        _ITEM,
        holds_at_end=True,
    ),
    OrderType("mission/pause", "Pause the mission", _pause, is_safe=True),
    OrderType("mission/resume", "Resume the mission, in the air", _resume, holds_at_end=True),
)
SET_PARAMETER = OrderType("set_parameter", "Set a parameter", _set_parameter, _VALUE)


# What happens to a running order when the server ends (docs/reliability.md).
_HOLDS_NOTE = "the vehicle is commanded to hold, unless it is silent or another party has taken over"
_UNKNOWN_NOTE = "the vehicle may have executed it, or may continue it"


_RECORD_FIELDS = (
    "key",
    "system_id",
    "order",
    "arguments",
    "given_unix_s",
    "ended_unix_s",
    "state",
    "result",
    "problem",
    "replaced_by",
)


@dataclass(eq=False)
class OrderRecord:
    """One order to a vehicle, and its result."""

    key: str
    system_id: int
    order: str
    arguments: dict[str, Any]
    given_unix_s: float
    ended_unix_s: float | None = None
    state: str = "running"
    result: Any = None
    problem: dict[str, Any] | None = None
    replaced_by: str | None = None
    """Key of the later order that replaced this one."""
    ended: asyncio.Event = field(default_factory=asyncio.Event)

    def fail(self, error: Exception) -> dict[str, Any]:
        """Record that the order has failed, and return the problem that the API shows."""
        self.state, self.problem = "failed", problem_of(error)
        return self.problem

    def to_dict(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in _RECORD_FIELDS}

    def is_same(self, system_id: int, order: str, arguments: Mapping[str, Any]) -> bool:
        return (self.system_id, self.order, self.arguments) == (system_id, order, arguments)


class OrderRunner:
    """Runs each order once, in a task of its own. An order continues when its client disconnects."""

    def __init__(self, served: ServedVehicles) -> None:
        self._served = served
        self._records: OrderedDict[str, OrderRecord] = OrderedDict()
        self._used_keys: OrderedDict[str, None] = OrderedDict()
        self._background = BackgroundTasks(lambda error: None)

    def submit(
        self, vehicle: Vehicle, order_type: OrderType, arguments: dict[str, Any], key: str, seen_at_s: float | None
    ) -> OrderRecord:
        """Start an order. If the same order was already submitted with this key, return the earlier order.

        The caller must have checked the arguments with ``order_type.check``.

        Raises HttpProblem if the key is missing or was used for another order or long ago, ``seen_at_s`` is outdated,
        or a ``force`` is not allowed.
        Raises InvalidArgument or FileFormatError if the arguments cannot be parsed, BusyError if too many orders are
        running, HeartbeatTimeout if the vehicle is silent, and ConnectionClosed or LinkLost if the connection has
        ended.
        """
        if not _KEY.fullmatch(key):
            raise HttpProblem(
                400,
                "KeyMissing",
                "an order needs a unique Idempotency-Key header: 8 to 64 characters of A-Z a-z 0-9 . _ ~ -",
            )
        parsed = order_type.parse(arguments)
        earlier = self._records.get(key)
        if earlier is not None:
            if earlier.is_same(vehicle.system_id, order_type.name, parsed.recorded):
                return earlier
            raise HttpProblem(409, "KeyUsed", "this Idempotency-Key was used for another order; nothing was sent")
        # The order has ended, but its result is no longer stored. A retry must not execute it again.
        if key in self._used_keys:
            raise HttpProblem(
                409,
                "KeyUsed",
                "an order with this Idempotency-Key has ended, and its result is no longer stored; nothing was sent"
                " now: check the state of the vehicle before you give an order with a new key",
            )
        self._check_allowed(vehicle, order_type, parsed.recorded, seen_at_s)
        unix_s = vehicle.connection.unix_time()
        record = OrderRecord(key, vehicle.system_id, order_type.name, parsed.recorded, unix_s)
        run = partial(self._run, vehicle, order_type, record, parsed.passed)
        task = self._background.start(run, f"aerokit serve {order_type.name}")
        if task is None:
            raise HttpProblem(503, "Ended", "the server has ended; nothing was sent")
        task.add_done_callback(lambda _: self._end_unstarted(vehicle, record))
        self._store(record)
        self._publish(record)
        return record

    def all(self) -> list[OrderRecord]:
        """Return the stored orders, the oldest first."""
        return list(self._records.values())

    def get(self, key: str) -> OrderRecord:
        """Return the order with this key; raise HttpProblem 404 if there is none."""
        if key not in self._records:
            raise HttpProblem(404, "NoSuchOrder", "no order has this key, or its result is no longer stored")
        return self._records[key]

    async def aclose(self) -> None:
        """Cancel running orders. Their vehicles hold, as after every cancelled action."""
        await self._background.aclose()

    def _check_allowed(
        self, vehicle: Vehicle, order_type: OrderType, arguments: Mapping[str, Any], seen_at_s: float | None
    ) -> None:
        vehicle.connection.raise_if_ended()
        now = asyncio.get_running_loop().time()
        # The clock of the loop stands still while the computer sleeps, so the sleep is added to the age of the state.
        slept_s = 0.0 if seen_at_s is None else vehicle.connection._slept_since(seen_at_s)
        state_age_s = 0.0 if seen_at_s is None else now - seen_at_s + slept_s
        if not 0 <= state_age_s <= STATE_MAX_AGE_S:
            raise HttpProblem(
                409,
                "Late",
                f"the client's state of the vehicle is not from the last {STATE_MAX_AGE_S:g} s; nothing was sent: check"
                " the current state, then repeat the order",
            )
        if arguments.get("force") and order_type.name == "disarm" and self._served.crash(vehicle) is None:
            raise HttpProblem(
                409,
                "NotCrashed",
                "disarm: force is allowed only after the server has seen the vehicle hit the ground and stay there;"
                " nothing was sent",
            )
        if order_type.is_safe:  # the following checks do not apply to safe orders
            return
        if vehicle.link_state.latest is not LinkState.CONNECTED:
            raise HeartbeatTimeout(
                f"{order_type.name}: vehicle {vehicle.system_id} is silent"
                f" (last heartbeat {vehicle.heartbeat_age:.1f} s ago); nothing was sent"
            )
        running_count = sum(
            record.system_id == vehicle.system_id and record.state == "running" for record in self._records.values()
        )
        if running_count >= MAX_RUNNING:
            raise BusyError(
                f"{MAX_RUNNING} orders to vehicle {vehicle.system_id} are already running; nothing was sent"
            )

    def _store(self, record: OrderRecord) -> None:
        self._records[record.key] = record
        ended_keys = [key for key, stored in self._records.items() if stored.state != "running"]
        for key in ended_keys:
            if len(self._records) <= MAX_RESULTS:
                break
            del self._records[key]
            # A client that retries with this key must not cause a second execution.
            self._used_keys[key] = None
        while len(self._used_keys) > MAX_USED_KEYS:
            self._used_keys.popitem(last=False)

    async def _run(
        self, vehicle: Vehicle, order_type: OrderType, record: OrderRecord, arguments: dict[str, Any]
    ) -> None:
        try:
            record.result = to_jsonable(await order_type.run(vehicle, arguments))
            record.state = "done"
        except asyncio.CancelledError:
            end_note = _HOLDS_NOTE if order_type.holds_at_end else _UNKNOWN_NOTE
            record.fail(HttpProblem(503, "Ended", f"the server ended before {order_type.name} did; {end_note}"))
            raise
        except Exception as error:
            problem = record.fail(error)
            record.replaced_by = self._replaced_by(record, error)
            if problem["status"] == 500:
                logger.exception("order %s to vehicle %d failed", record.order, record.system_id)
        finally:
            self._end(vehicle, record)

    def _end_unstarted(self, vehicle: Vehicle, record: OrderRecord) -> None:
        """End an order whose task was cancelled before its first step, so that no request waits for it."""
        if not record.ended.is_set():
            record.fail(HttpProblem(503, "Ended", "the server has ended; nothing was sent"))
            self._end(vehicle, record)

    def _end(self, vehicle: Vehicle, record: OrderRecord) -> None:
        record.ended_unix_s = vehicle.connection.unix_time()
        record.ended.set()
        self._publish(record)

    def _replaced_by(self, record: OrderRecord, error: Exception) -> str | None:
        """Return the key of the order that replaced ``record``: the newest later order for motion.

        Return None if ``error`` does not say that ``record`` was replaced.
        """
        if not isinstance(error, OperationRejected) or SUPERSEDED not in str(error):
            return None
        newest_key = None
        is_later = False
        for stored in self._records.values():  # the oldest first
            if is_later and stored.system_id == record.system_id and stored.order not in _NOT_MOTION:
                newest_key = stored.key
            is_later = is_later or stored is record
        return newest_key

    def _publish(self, record: OrderRecord) -> None:
        self._served.publish({"type": "order", **record.to_dict()})
