"""Rules that must never be broken: checks each rule of docs/reliability.md against the recorded traffic."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator

from disturbed_link import RecordedTraffic, TrafficEntry
from order_flights import WATCH_S, Flown, mode_of
from order_table import ARM, REPOSITION, SET_MODE

from aerokit.autopilots import autopilot_for, is_armed
from aerokit.errors import OperationTimeout
from aerokit.mavlink.enums import MavCmd
from aerokit.mavlink.message import Message
from aerokit.mavlink.messages import (
    CommandInt,
    CommandLong,
    Heartbeat,
    SetAttitudeTarget,
    SetMode,
    SetPositionTargetGlobalInt,
    SetPositionTargetLocalNed,
)
from aerokit.vehicle.commanding.arbiter import ARM_HEARTBEAT_DELAY_S
from aerokit.vehicle.commanding.order import CHANGED_BY_COMMAND, FAILSAFE_STATES, REQUEST_COMMANDS

ENDS_FLIGHT = ("disarm", "land", "return_to_launch")
MODE_MAX_AGE_S = 2.6
SETPOINTS = (SetPositionTargetLocalNed, SetPositionTargetGlobalInt, SetAttitudeTarget)
OUTAGE_RECOVERY_S = 4.0
"""Seconds after an outage until the vehicle's state is known and the hold command is sent."""
PX4_AUTO, PX4_AUTO_LOITER = 4, 3
PX4_LOITER = PX4_AUTO << 16 | PX4_AUTO_LOITER << 24
COPTER_AUTO, COPTER_GUIDED, COPTER_BRAKE = 3, 4, 17
INITIAL_SEND_S = 0.01
"""A command sent this soon after the call is the order itself."""


def faults(flown: Flown) -> list[str]:
    """Return a description of every rule that was broken."""
    return [
        *_sent_again(flown),
        *_sent_into_silence(flown),
        *_sent_after_takeover(flown),
        *_false_success(flown),
        *_armed_late(flown),
        *_abandoned_flight_not_held(flown),
        *_sent_afterwards(flown),
        *_took_too_long(flown),
    ]


def _orders(flown: Flown) -> Iterator[TrafficEntry]:
    return orders_in(flown.traffic)


def orders_in(traffic: RecordedTraffic) -> Iterator[TrafficEntry]:
    """Return the sent messages that change something."""
    for message in traffic.sent:
        command = getattr(message.message, "command", None)
        is_command = isinstance(message.message, (CommandLong, CommandInt)) and command not in REQUEST_COMMANDS
        if is_command or isinstance(message.message, SetMode):
            yield message


State = tuple[int, bool, bool]
"""Mode, armed, and whether a failsafe is active."""


def _states_between(flown: Flown, since: int, until: int) -> list[State]:
    """Return the states that HEARTBEAT reported between two recorded messages."""
    reported = [_state(heartbeat) for heartbeat in flown.traffic.heartbeats if since < heartbeat.number < until]
    return [(mode, armed, False) for mode, armed, _ in reported] if _ends_flight(flown) else reported


def _ends_flight(flown: Flown) -> bool:
    """Return True if it lands, returns or disarms, which is intended during a failsafe as well."""
    modes = flown.case.row.modes[flown.case.autopilot == "px4"]
    return flown.case.row.name in ENDS_FLIGHT or (bool(modes) and set(modes) <= {"LAND", "RTL"})


def _state(entry: TrafficEntry) -> State:
    beat = entry.message
    assert isinstance(beat, Heartbeat)
    return beat.custom_mode, is_armed(beat.base_mode), beat.system_status in FAILSAFE_STATES


def _key(message: Message) -> object:
    fields = message.to_dict()
    fields.pop("confirmation", None)
    return message.NAME, repr(sorted(fields.items()))


def _sent_again(flown: Flown) -> Iterator[str]:
    """A repetition needs a HEARTBEAT after the last transmission; all HEARTBEATs since the first one report the
    previous state.
    """
    first: dict[object, int] = {}
    last: dict[object, int] = {}
    for order in _orders(flown):
        key = _key(order.message)
        if key in first:
            before = _states_between(flown, -1, first[key])[-1:]
            since = _states_between(flown, first[key], order.number)
            if _is_directed_turn(order.message):
                yield f"{_text_of(flown, order)} was sent again, and might begin another circle"
            elif not _states_between(flown, last[key], order.number):
                yield f"{_text_of(flown, order)} was sent again without a HEARTBEAT since"
            elif any(state != before[0] and not _may_report_effect(flown, order.message, state) for state in since):
                yield f"{_text_of(flown, order)} was sent again although HEARTBEAT had reported a change"
        first.setdefault(key, order.number)
        last[key] = order.number


def _is_directed_turn(message: Message) -> bool:
    """Return True for a turn to a heading in a given direction (param3)."""
    return isinstance(message, CommandLong) and message.command == MavCmd.CONDITION_YAW and message.param3 != 0


def _may_report_effect(flown: Flown, message: Message, state: State) -> bool:
    """Return True if the effect may already be reported. An abandoned order may take effect late; then aerokit orders
    another hold. A PX4 that DO_REPOSITION stops may be in its hold mode all the time, which is not the effect. Such a
    stop is followed by an order of the hold mode.
    """
    if not isinstance(message, CommandLong):
        return False
    is_px4_hold = message.command == SET_MODE and (message.param2, message.param3) == (PX4_AUTO, PX4_AUTO_LOITER)
    if message.command == REPOSITION or is_px4_hold:
        return state == (PX4_LOITER, True, False)
    is_hold = message.command == SET_MODE and message.param2 == COPTER_BRAKE
    return (
        is_hold
        and flown.case.row.holds
        and state
        in {
            (COPTER_GUIDED, True, False),
            (COPTER_AUTO, True, False),
        }
    )


def _sent_into_silence(flown: Flown) -> Iterator[str]:
    """The rest of an order is not sent while the vehicle is silent."""
    for order in _orders(flown):
        given = (flown.given_at, *flown.fresh_at)
        is_late = not any(0 <= order.at - at <= INITIAL_SEND_S for at in given)
        if is_late and not any(order.at - MODE_MAX_AGE_S <= entry.at <= order.at for entry in flown.traffic.heartbeats):
            yield f"{_text_of(flown, order)} was sent into a silence"


def _sent_after_takeover(flown: Flown) -> Iterator[str]:
    """After another party's mode was reported, no steering message is sent."""
    takeover = _takeover_heartbeat(flown)
    if takeover is None or not flown.case.row.steers:
        return
    for message in flown.traffic.sent:
        command = getattr(message.message, "command", None)
        steers = command in CHANGED_BY_COMMAND.keys() - {ARM} or isinstance(message.message, (SetMode, *SETPOINTS))
        if steers and message.number > takeover.number:
            yield f"{_text_of(flown, message)} was sent after a takeover: {_text_of(flown, takeover)}"


def _takeover_heartbeat(flown: Flown) -> TrafficEntry | None:
    """Return the HEARTBEAT that reported a takeover or a failsafe to the program."""
    own = set(flown.case.row.modes[flown.case.autopilot == "px4"])
    reported = flown.traffic.heartbeats
    assert isinstance(reported[0].message, Heartbeat)
    autopilot = autopilot_for(reported[0].message)
    allowed: set[str] = set()
    had_failsafe = False
    for event in reported:
        assert isinstance(event.message, Heartbeat)
        name = autopilot.mode_of(event.message).name
        has_failsafe = event.message.system_status in FAILSAFE_STATES
        is_new, had_failsafe = has_failsafe and not had_failsafe, has_failsafe
        if event.at < flown.given_at:
            allowed = {name}
        elif is_new and not _ends_flight(flown):
            return event
        elif name in own:
            allowed = set()
        elif name not in allowed:
            return event
    return None


def _false_success(flown: Flown) -> Iterator[str]:
    """A successful call was true when it returned."""
    if flown.error is not None:
        return
    mode, armed = flown.state_at_end
    row, own = flown.case.row, flown.case.row.modes[flown.case.autopilot == "px4"]
    if row.name in ("set_mode", "hold") and mode not in own:
        yield f"{row.name} returned in {mode}"
    if row.name == "arm" and not armed:
        yield "arm returned disarmed"
    if row.name == "disarm" and armed:
        yield "disarm returned armed"
    if row.name.startswith(("go_to", "take_off", "set_heading")) and mode not in own:
        yield f"{row.name} returned in {mode}"


def _armed_late(flown: Flown) -> Iterator[str]:
    """An abandoned arm command does not leave the vehicle armed if the program could notice."""
    if flown.case.row.name != "arm" or flown.error is None or not flown.is_armed_at_end:
        return
    disturbances, until = flown.case.disturbances, flown.given_at + ARM_HEARTBEAT_DELAY_S
    is_answered = not disturbances.lost_acks and disturbances.outage is None and not (flown.case.two or flown.case.hub)
    is_reported_armed = any(
        _state(heartbeat)[1] for heartbeat in flown.traffic.heartbeats if flown.given_at < heartbeat.at <= until
    )
    if is_answered or (is_reported_armed and not flown.acted):
        yield f"arm ended with {flown.error!r} and the vehicle is armed"


def _abandoned_flight_not_held(flown: Flown) -> Iterator[str]:
    """An abandoned flight without a takeover ends in a hold, also if the vehicle was silent at that time."""
    row, is_abandoned = flown.case.row, isinstance(flown.error, (asyncio.CancelledError, OperationTimeout))
    was_reachable = flown.given_at + flown.case.quiet_until < flown.ended_at + WATCH_S - OUTAGE_RECOVERY_S
    if (
        row.holds
        and is_abandoned
        and was_reachable
        and _takeover_heartbeat(flown) is None
        and not flown.acted
        and flown.is_armed_at_end
    ):
        wanted = "LOITER" if flown.case.autopilot == "px4" else "BRAKE"
        was_ordered = row.place != "armed" or flown.vehicle.altitude_m > 1.0
        if was_ordered and mode_of(flown.vehicle) != wanted and _is_reached(flown):
            yield f"it was abandoned ({flown.error!r}) and is in {mode_of(flown.vehicle)}"


def _sent_afterwards(flown: Flown) -> Iterator[str]:
    """An abandoned transfer or setting sends nothing more."""
    if flown.case.row.steers or flown.case.row.ends_later or flown.case.row.name == "arm":
        return
    for message in flown.traffic.sent:
        is_lasting = message.message.NAME in ("PARAM_SET", "MISSION_COUNT", "MISSION_ITEM_INT", "MISSION_ITEM")
        if message.at > flown.ended_at and (is_lasting or message in list(_orders(flown))):
            yield f"{_text_of(flown, message)} was sent after the call had ended"


def _is_reached(flown: Flown) -> bool:
    """Return True if the vehicle received any message of the order."""
    return any(not order.is_lost for order in _orders(flown))


def _took_too_long(flown: Flown) -> Iterator[str]:
    if flown.ended_at - flown.given_at > 62.0:
        yield f"it took {flown.ended_at - flown.given_at:.0f} s"


def _text_of(flown: Flown, entry: TrafficEntry) -> str:
    message = entry.message.to_dict()
    what = " ".join(f"{key}={value:g}" for key, value in message.items() if isinstance(value, (int, float)) and value)
    return f"{entry.at - flown.given_at:.2f} s: {entry.message.NAME} {what}"
