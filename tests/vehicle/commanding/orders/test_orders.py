"""The order table: lost answers × lost copies × delays × pilot × failsafe × outage × both autopilots, on virtual time.

`nox -s orders -- SEEDS` flies many more seeds of each row than these.
"""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from call_table import Row
from device_calls import DEVICE_CALLS
from disturbed_link import Disturbances, Silence
from disturbed_link_pair import TwoLinks
from order_cases import RIGHT_AFTER_S, Case, random_case, random_case_over_two
from order_flights import Flown, fly, mode_of
from order_judge import faults
from order_table import ARM, REPOSITION, ROWS, SET_MODE

from aerokit.errors import AerokitError, CommandTimeout, OperationRejected

SEEDS = int(os.environ.get("AEROKIT_ORDER_SEEDS", "2"))
BY_NAME = {row.name: row for row in ROWS}
BOTH = ("ardupilot", "px4")


ALL_ROWS = [
    pytest.param(row, autopilot, id=f"{row.name}-{row.command}-{autopilot}") for row in ROWS for autopilot in row.on
]
IS_SESSION = "AEROKIT_ORDER_SEEDS" in os.environ
DEFAULT_ROWS = [
    pytest.param(row, autopilot, id=f"{row.name}-{row.command}-{autopilot}", marks=marks)
    for place, row in enumerate(ROWS)
    for autopilot in row.on
    for marks in [() if autopilot == row.on[place % len(row.on)] else pytest.mark.exhaustive]
]
"""Each row on one autopilot by default, on either in turn."""
OVER_TWO, SEEDS_OVER_TWO = (ALL_ROWS, SEEDS) if IS_SESSION else (ALL_ROWS[::6], 1)
"""Few of them in the tests, all of them in the session."""


@pytest.mark.sampled(20)
@pytest.mark.parametrize("seed", range(SEEDS_OVER_TWO))
@pytest.mark.parametrize(("row", "autopilot"), OVER_TWO)
def test_order_table_two_links_no_rule_is_broken(row: Row, autopilot: str, seed: int) -> None:
    """The link in use falls silent before, with or after the order; the order is not repeated late or in silence."""
    case = random_case_over_two(row, autopilot, seed)
    assert faults(fly(case)) == [], case


@pytest.mark.sampled(9)
@pytest.mark.parametrize("seed", range(SEEDS))
@pytest.mark.parametrize(("row", "autopilot"), DEFAULT_ROWS)
def test_order_table_no_rule_is_broken(row: Row, autopilot: str, seed: int) -> None:
    case = random_case(row, autopilot, seed)
    assert faults(fly(case)) == [], case


def test_orders_are_all_documented() -> None:
    text = (Path(__file__).parents[4] / "docs" / "reliability.md").read_text()
    names = {row.name.split()[0] for row in ROWS}.difference(call.order for call in DEVICE_CALLS)
    missing = [name for name in names if not re.search(rf"^\| [^|]*`{re.escape(name)}", text, re.MULTILINE)]
    assert not missing, f"add them to a table of orders in docs/reliability.md: {missing}"


# ------------------------------------------------------------------------------------ regressions


@pytest.mark.parametrize("autopilot", BOTH)
def test_takeover_during_lost_ack_keeps_vehicle(autopilot: str) -> None:
    disturbances = Disturbances(command=REPOSITION, lost_acks=1)
    flown = fly(Case(BY_NAME["go_to"], autopilot, disturbances, pilot_at=0.3))
    assert isinstance(flown.error, OperationRejected)
    assert len([message for message in flown.traffic.sent if getattr(message.message, "command", 0) == REPOSITION]) == 1
    assert mode_of(flown.vehicle) == flown.acted[0][1]


@pytest.mark.parametrize("name", ["land", "return_to_launch", "hold"])
def test_ensure_mode_recently_reported_sends_nothing(name: str) -> None:
    """The ack is lost, HEARTBEAT reports the mode, then the pilot takes over before the retry."""
    flown = fly(Case(BY_NAME[name], "ardupilot", Disturbances(command=SET_MODE, lost_acks=9), pilot_at=0.4))
    assert len([message for message in flown.traffic.sent if getattr(message.message, "command", 0) == SET_MODE]) == 1
    assert mode_of(flown.vehicle) == "ALT_HOLD"


@pytest.mark.parametrize("autopilot", BOTH)
def test_arm_is_not_repeated_against_other_station(autopilot: str) -> None:
    flown = fly(Case(BY_NAME["arm"], autopilot, Disturbances(command=ARM, lost_acks=9), pilot_at=1.3))
    assert len([message for message in flown.traffic.sent if getattr(message.message, "command", 0) == ARM]) == 1
    assert not flown.is_armed_at_end


@pytest.mark.parametrize("lost", ["acks", "commands"])
@pytest.mark.parametrize("place", ["air", "air, flown by hand"])
def test_directed_turn_without_ack_is_sent_once(lost: str, place: str) -> None:
    """Several HEARTBEATs report the state from before the order, which would allow a repetition of other orders."""
    row = replace(BY_NAME["set_heading with a direction"], place=place)
    losses: dict[str, Any] = {f"lost_{lost}": 9}
    disturbances = Disturbances(command=row.command, **losses)
    flown = fly(Case(row, "ardupilot", disturbances))
    assert isinstance(flown.error, CommandTimeout)
    sent_at = [sent.at for sent in flown.traffic.sent if getattr(sent.message, "command", 0) == row.command]
    assert len(sent_at) == 1
    assert len([beat for beat in flown.traffic.heartbeats if sent_at[0] < beat.at < flown.ended_at]) >= 2
    assert faults(flown) == []


@pytest.mark.sampled(3)
@pytest.mark.parametrize("until", [10.3, 11.0, 12.0, 13.0])
@pytest.mark.parametrize("name", ["go_to", "guided.velocity"])
def test_failsafe_during_outage_keeps_vehicle(name: str, until: float) -> None:
    """FS_GCS_ENABLE makes the vehicle return after five seconds; the pending hold is not sent against the failsafe."""
    disturbances = Disturbances(outage=(0.5, 0.5 + until))
    flown = fly(Case(BY_NAME[name], "ardupilot", disturbances, station_failsafe=True))
    assert flown.error is not None
    assert mode_of(flown.vehicle) in ("RTL", "LAND")
    assert faults(flown) == []


@pytest.mark.parametrize("cancel_at", [2.0, 6.5, 9.0])
def test_cancelled_in_outage_keeps_failsafe(cancel_at: float) -> None:
    disturbances = Disturbances(outage=(0.5, 12.0))
    flown = fly(Case(BY_NAME["go_to"], "ardupilot", disturbances, station_failsafe=True, cancel_at=cancel_at))
    assert mode_of(flown.vehicle) in ("RTL", "LAND")
    assert faults(flown) == []


@pytest.mark.parametrize("autopilot", BOTH)
def test_cancelled_in_outage_holds_after_it(autopilot: str) -> None:
    row = BY_NAME["go_to"]
    far = Row(
        row.name,
        lambda v: v.go_to(v.position.value.offset(north_m=300.0)),
        row.command,
        modes=row.modes,
        holds=True,
    )
    flown = fly(Case(far, autopilot, Disturbances(outage=(1.0, 6.0)), cancel_at=5.0))
    assert mode_of(flown.vehicle) == ("LOITER" if autopilot == "px4" else "BRAKE")
    assert faults(flown) == []


@pytest.mark.parametrize("autopilot", BOTH)
def test_late_arming_is_undone(autopilot: str) -> None:
    """A stalled link delivers the arm command three seconds after the call has timed out."""
    flown = fly(Case(BY_NAME["arm"], autopilot, Disturbances(stall=(0.0, 7.0))))
    assert isinstance(flown.error, CommandTimeout)
    assert "may still be executed" in str(flown.error)
    assert not flown.is_armed_at_end


def test_late_arming_is_undone_after_other_stations_mode() -> None:
    """While the command is delayed, a HEARTBEAT reports another station's mode."""
    disturbances = Disturbances(stall=(0.0, 5.0))
    flown = fly(Case(BY_NAME["arm"], "ardupilot", disturbances, pilot_at=0.5, by_switch=True))
    assert isinstance(flown.error, OperationRejected)
    assert not flown.is_armed_at_end


def test_takeover_to_previous_mode_keeps_vehicle() -> None:
    """The pilot's mode before `go_to` and after its confirmed hold is the same."""
    # By the time of the cancellation, the latency has been measured, so the hold is not repeated too early.
    disturbances = Disturbances(command=REPOSITION, lost_acks=9, lost_commands=1, latency_s=0.2)
    flown = fly(Case(BY_NAME["go_to from another mode"], "px4", disturbances, pilot_at=2.51, cancel_at=1.98))
    assert faults(flown) == []
    assert mode_of(flown.vehicle) == "POSCTL"


# ------------------------------------------------------------------------------- over two links


def sent(flown: Flown, command: int) -> int:
    """Return how many times this command was sent, over either link."""
    return len([message for message in flown.traffic.sent if getattr(message.message, "command", 0) == command])


def test_ack_over_other_link_is_accepted() -> None:
    two = TwoLinks(Silence(RIGHT_AFTER_S), is_copied=True)
    flown = fly(Case(BY_NAME["set_speed"], "ardupilot", Disturbances(), two=two))
    assert flown.error is None
    assert sent(flown, BY_NAME["set_speed"].command) == 1
    assert flown.ended_at - flown.given_at < 0.5


@pytest.mark.parametrize("autopilot", BOTH)
def test_takeover_with_ack_lost_on_both_links_keeps_vehicle(autopilot: str) -> None:
    """The mode is reported over the next link only."""
    two = TwoLinks(Silence(RIGHT_AFTER_S), is_copied=autopilot == "px4")
    disturbances = Disturbances(command=REPOSITION, lost_acks=9)
    flown = fly(Case(BY_NAME["go_to"], autopilot, disturbances, pilot_at=0.3, two=two))
    assert isinstance(flown.error, OperationRejected)
    assert sent(flown, REPOSITION) == 1
    assert mode_of(flown.vehicle) == flown.acted[0][1]
    assert faults(flown) == []


def test_order_lost_on_link_is_repeated_on_next_after_heartbeat() -> None:
    flown = fly(Case(BY_NAME["land"], "ardupilot", Disturbances(), two=TwoLinks(Silence(0.0))))
    assert flown.error is None
    first, again = [message for message in flown.traffic.sent if getattr(message.message, "command", 0) == SET_MODE]
    assert [first.is_lost, again.is_lost] == [True, False]
    assert any(first.number < heartbeat.number < again.number for heartbeat in flown.traffic.heartbeats)


def test_reboot_command_is_not_repeated_over_next_link() -> None:
    row = BY_NAME["reboot"]
    flown = fly(Case(row, "ardupilot", Disturbances(), two=TwoLinks(Silence(0.0))))
    assert isinstance(flown.error, AerokitError)
    assert sent(flown, row.command) == 1
