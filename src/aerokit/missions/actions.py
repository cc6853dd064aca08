"""Builders for what is done on the way: speed, waiting, headings, servos, relays, jumps, transitions.

What cannot be right raises :class:`~aerokit.errors.InvalidArgument` with the argument and what is allowed.
https://mavlink.io/en/messages/common.html#mav_commands
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from aerokit.errors import InvalidArgument
from aerokit.mavlink.enums import MavCmd
from aerokit.missions.places import action, in_range, whole

if TYPE_CHECKING:
    from aerokit.missions.item import MissionItem

__all__ = [
    "change_speed",
    "condition_delay",
    "condition_distance",
    "condition_yaw",
    "delay",
    "delay_until",
    "enable_fence",
    "jump",
    "jump_tag",
    "jump_to_tag",
    "land_start",
    "set_relay",
    "set_servo",
    "vtol_transition",
]

_LONGEST_S = 86_400.0 * 365
_SPEEDS = {"air": 0.0, "ground": 1.0, "climb": 2.0, "descent": 3.0}


def change_speed(
    speed_m_s: float,
    *,
    kind: Literal["air", "ground", "climb", "descent"] = "ground",
    throttle_percent: float | None = None,
) -> MissionItem:
    """Fly on with another speed: 0 to 1,000 m/s, or -2 for the vehicle's own (the standard's word; PX4: -1).

    ``kind`` is which speed: ``"climb"`` and ``"descent"`` on copters. ``throttle_percent`` (0 to 100) is for planes
    without airspeed sensor, None leaves it. https://mavlink.io/en/messages/common.html#MAV_CMD_DO_CHANGE_SPEED
    """
    if kind not in _SPEEDS:
        raise InvalidArgument(f"kind = {kind!r} is not allowed: {', '.join(map(repr, _SPEEDS))}")
    return action(
        MavCmd.DO_CHANGE_SPEED,
        _SPEEDS[kind],
        in_range("speed_m_s", speed_m_s, 0, 1000, or_=(-1, -2)),
        -1.0 if throttle_percent is None else in_range("throttle_percent", throttle_percent, 0, 100),
    )


def delay(duration_s: float) -> MissionItem:
    """Stay where the vehicle is for that many seconds, above 0.

    https://mavlink.io/en/messages/common.html#MAV_CMD_NAV_DELAY
    """
    if duration_s == 0:
        raise InvalidArgument("duration_s = 0 is not allowed: ArduPilot takes it for a time of day; above 0")
    return action(MavCmd.NAV_DELAY, in_range("duration_s", duration_s, 0, _LONGEST_S), -1.0, -1.0, -1.0)


def delay_until(hour: int, minute: int = 0, second: int = 0) -> MissionItem:
    """Stay where the vehicle is until that time of day, in UTC (ArduPilot).

    https://mavlink.io/en/messages/common.html#MAV_CMD_NAV_DELAY
    """
    return action(
        MavCmd.NAV_DELAY,
        -1.0,
        whole("hour", hour, 0, 23),
        whole("minute", minute, 0, 59),
        whole("second", second, 0, 59),
    )


def condition_delay(duration_s: float) -> MissionItem:
    """Do the actions behind this one only after that many seconds, and fly on meanwhile.

    https://mavlink.io/en/messages/common.html#MAV_CMD_CONDITION_DELAY
    """
    return action(MavCmd.CONDITION_DELAY, in_range("duration_s", duration_s, 0, _LONGEST_S))


def condition_distance(distance_m: float) -> MissionItem:
    """Do the actions behind this one only within that many metres of the next place.

    https://mavlink.io/en/messages/common.html#MAV_CMD_CONDITION_DISTANCE
    """
    return action(MavCmd.CONDITION_DISTANCE, in_range("distance_m", distance_m, 0, 1e7))


def condition_yaw(
    heading_deg: float,
    *,
    rate_deg_s: float = 0.0,
    direction: Literal["shortest", "clockwise", "counterclockwise"] = "shortest",
    relative: bool = False,
) -> MissionItem:
    """Turn to a heading (ArduCopter): 0 to 360 degrees from north, or from where it points with ``relative``.

    ``rate_deg_s`` is 0 (its own) to 360. https://mavlink.io/en/messages/common.html#MAV_CMD_CONDITION_YAW
    """
    directions = {"shortest": 0.0, "clockwise": 1.0, "counterclockwise": -1.0}
    if direction not in directions:
        raise InvalidArgument(f"direction = {direction!r} is not allowed: {', '.join(map(repr, directions))}")
    return action(
        MavCmd.CONDITION_YAW,
        in_range("heading_deg", heading_deg, 0, 360),
        in_range("rate_deg_s", rate_deg_s, 0, 360),
        directions[direction],
        float(relative),
    )


def set_servo(servo: int, pwm_us: int) -> MissionItem:
    """Put an output (1 to 32) to a pulse of 500 to 2,500 microseconds, or 0: no pulse (ArduPilot; PX4 refuses it).

    https://mavlink.io/en/messages/common.html#MAV_CMD_DO_SET_SERVO
    """
    number = whole("servo", servo, 1, 32)
    return action(MavCmd.DO_SET_SERVO, number, in_range("pwm_us", pwm_us, 500, 2500, or_=(0,)))


def set_relay(relay: int, on: bool) -> MissionItem:
    """Switch a relay, 0 to 15 (ArduPilot; PX4 refuses it).

    https://mavlink.io/en/messages/common.html#MAV_CMD_DO_SET_RELAY
    """
    return action(MavCmd.DO_SET_RELAY, whole("relay", relay, 0, 15), float(on))


def jump(to_item: int, *, repeat: int = -1) -> MissionItem:
    """Go on with another item of the mission, ``repeat`` times (0 to 32,767, -1: for ever).

    Items are counted from 0 without home, as in :class:`Mission`, whatever the autopilot: jump(0) leads to the first.
    https://mavlink.io/en/messages/common.html#MAV_CMD_DO_JUMP
    """
    target = whole("to_item", to_item, 0, 65_534)
    return action(MavCmd.DO_JUMP, target, whole("repeat", repeat, -1, 32_767))


def jump_tag(tag: int) -> MissionItem:
    """A mark for :func:`jump_to_tag` (ArduPilot): 0 to 65,535.

    https://mavlink.io/en/messages/common.html#MAV_CMD_JUMP_TAG
    """
    return action(MavCmd.JUMP_TAG, whole("tag", tag, 0, 65_535))


def jump_to_tag(tag: int, *, repeat: int = -1) -> MissionItem:
    """Go on with the first :func:`jump_tag` of that number (ArduPilot), ``repeat`` times, -1: for ever.

    https://mavlink.io/en/messages/common.html#MAV_CMD_DO_JUMP_TAG
    """
    return action(MavCmd.DO_JUMP_TAG, whole("tag", tag, 0, 65_535), whole("repeat", repeat, -1, 32_767))


def vtol_transition(to: Literal["multicopter", "fixed_wing"]) -> MissionItem:
    """Go over to the other kind of flight.

    https://mavlink.io/en/messages/common.html#MAV_CMD_DO_VTOL_TRANSITION
    """
    states = {"multicopter": 3.0, "fixed_wing": 4.0}
    if to not in states:
        raise InvalidArgument(f"to = {to!r} is not allowed: {', '.join(map(repr, states))}")
    return action(MavCmd.DO_VTOL_TRANSITION, states[to])


def land_start() -> MissionItem:
    """Mark where the landing begins, for a return or a failsafe that goes on from here.

    https://mavlink.io/en/messages/common.html#MAV_CMD_DO_LAND_START
    """
    return action(MavCmd.DO_LAND_START)


def enable_fence(enable: bool = True) -> MissionItem:
    """Switch the fence on or off (ArduPilot).

    https://mavlink.io/en/messages/common.html#MAV_CMD_DO_FENCE_ENABLE
    """
    return action(MavCmd.DO_FENCE_ENABLE, float(enable))
