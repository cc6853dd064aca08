"""Events of one flight of the order table, drawn by seed."""

from __future__ import annotations

import math
import random
from dataclasses import dataclass, replace

from call_table import Row
from disturbed_hub import Side, ThroughHub, Ways
from disturbed_link import Disturbances, Silence
from disturbed_link_pair import TwoLinks

RIGHT_AFTER_S = 0.001
"""Seconds after which everything sent with the call has left."""


@dataclass(frozen=True)
class Case:
    """Events of one flight; all times are seconds since the order was given."""

    row: Row
    autopilot: str
    disturbances: Disturbances
    pilot_at: float | None = None
    """Another party acts: turns the mode switch; on the ground, disarms, unless ``by_switch``."""
    by_switch: bool = False
    failsafe_at: float | None = None
    """The vehicle returns by itself."""
    state_at: float | None = None
    """HEARTBEAT starts to report a failsafe (MAV_STATE_CRITICAL) in the present mode."""
    station_failsafe: bool = False
    """True if the vehicle returns when it loses the ground station."""
    cancel_at: float | None = None
    two: TwoLinks | None = None
    """None: over one link."""
    hub: ThroughHub | None = None
    """None: there is no hub between."""

    @property
    def quiet_until(self) -> float:
        """The time at which all events are over."""
        outage = 0.0 if self.disturbances.outage is None else self.disturbances.outage[1]
        return max(outage, 0.0 if self.hub is None else self.hub.quiet_until)


def random_case(row: Row, autopilot: str, seed: int) -> Case:
    """Lost answers × lost copies × delays × pilot × failsafe × outage, by a seed."""
    dice = random.Random(f"{row.name} {row.command} {autopilot} {seed}")
    disturbances = Disturbances(
        command=row.command,
        lost_acks=dice.choice((0, 1, 1, 2, 9)),
        lost_commands=dice.choice((0, 0, 1, 2)),
        latency_s=dice.choice((0.01, 0.05, 0.2)),
    )
    if dice.random() < 0.35:
        begin = round(dice.uniform(0.0, 5.0), 2)
        disturbances.outage = (begin, begin + round(dice.uniform(1.0, 14.0), 2))
    elif dice.random() < 0.15:
        disturbances.stall = (0.0, round(dice.uniform(1.0, 8.0), 2))
    happens = dice.random()
    later = random.Random(f"a failsafe {row.name} {row.command} {autopilot} {seed}")
    return Case(
        row,
        autopilot,
        disturbances,
        state_at=round(later.uniform(0.05, 6.0), 2) if happens >= 0.6 and later.random() < 0.5 else None,
        pilot_at=round(dice.uniform(0.05, 6.0), 2) if happens < 0.45 else None,
        failsafe_at=round(dice.uniform(0.05, 6.0), 2) if 0.45 <= happens < 0.6 else None,
        station_failsafe=dice.random() < 0.5,
        cancel_at=round(dice.uniform(0.05, 12.0), 2) if dice.random() < 0.25 else None,
        by_switch=dice.random() < 0.5,
    )


def random_case_over_two(row: Row, autopilot: str, seed: int) -> Case:
    """The same over two links: the link in use falls silent before, with or after the order. Answers come over the
    other link, or are lost on both. No link delivers late, because a program cannot take back what a network stores.
    """
    case = random_case(row, autopilot, seed)
    dice = random.Random(f"two links {row.name} {row.command} {autopilot} {seed}")
    begin_s = dice.choice((0.0, RIGHT_AFTER_S, RIGHT_AFTER_S, round(dice.uniform(0.05, 4.0), 2)))
    lasts_s = dice.choice((float("inf"), float("inf"), round(dice.uniform(0.5, 8.0), 2)))
    silence = Silence(begin_s, begin_s + lasts_s, is_one_way=dice.random() < 0.5)
    two = TwoLinks(silence, is_copied=dice.random() < 0.5)
    return replace(case, disturbances=replace(case.disturbances, stall=None), two=two)


def random_case_through_hub(row: Row, autopilot: str, seed: int) -> Case:
    """The same through a hub, with disturbances on either side. The hub's endpoint may be full, or disappear and
    return, or two links connect the hub with program or vehicle.
    """
    case = random_case(row, autopilot, seed)
    dice = random.Random(f"a hub {row.name} {row.command} {autopilot} {seed}")
    side: Side = dice.choice(("vehicle", "program"))
    ways: Ways = dice.choice(("one", "one", "one", "vehicle twice", "program twice", "program copied"))
    begin_s = dice.choice((0.0, RIGHT_AFTER_S, round(dice.uniform(0.01, 4.0), 2)))
    trouble = (begin_s, begin_s + round(dice.uniform(0.3, 6.0), 2))
    happens = dice.random()
    hub = ThroughHub(
        side,
        ways,
        jam=trouble if happens < 0.35 else None,
        away=trouble if 0.35 <= happens < 0.7 else None,
        silence=Silence(begin_s, dice.choice((math.inf, trouble[1])), is_one_way=dice.random() < 0.5),
    )
    if ways != "one":
        case = replace(case, disturbances=replace(case.disturbances, stall=None))
    return replace(case, hub=hub)
