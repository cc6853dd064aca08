"""The order table: lost answers × lost copies × delays × pilot × failsafe × outage × both autopilots, on virtual time.

`nox -s orders -- SEEDS` flies many more seeds of each row than these.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest
from call_table import Row
from exhaustive import sampled
from order_air import Silence, Weather
from order_airs import TwoLinks
from order_cases import RIGHT_AFTER_S, Case, random_case, random_case_over_two
from order_flights import Flown, fly, mode_of
from order_judge import faults
from order_table import ARM, REPOSITION, ROWS, SET_MODE

from aerokit.errors import AerokitError, CommandTimeout, OperationRejected
from aerokit.mavlink.enums import MavCmd
from aerokit.protocols.command import SENT_ONCE

SEEDS = int(os.environ.get("AEROKIT_ORDER_SEEDS", "2"))
BY_NAME = {row.name: row for row in ROWS}
BOTH = ("ardupilot", "px4")


EVERY_ROW = [
    pytest.param(row, each, id=f"{row.name}-{row.command}-{each}") for row in ROWS for each in row.on
]
IS_SESSION = "AEROKIT_ORDER_SEEDS" in os.environ
FEW_ROWS = [
    pytest.param(row, each, id=f"{row.name}-{row.command}-{each}", marks=marks)
    for place, row in enumerate(ROWS)
    for each in row.on
    for marks in [() if each == row.on[place % len(row.on)] else pytest.mark.exhaustive]
]
"""Each row on one autopilot by default, on either in turn."""
OVER_TWO, SEEDS_OVER_TWO = (EVERY_ROW, SEEDS) if IS_SESSION else (sampled(EVERY_ROW[::6], 4), 1)
"""Few of them in the tests, all of them in the session."""


@pytest.mark.parametrize("seed", range(SEEDS_OVER_TWO))
@pytest.mark.parametrize(("row", "autopilot"), OVER_TWO)
def test_no_rule_is_broken_over_two_links(row: Row, autopilot: str, seed: int) -> None:
    """The one in use falls silent before, with or after the order, which is not sent again late or blind."""
    case = random_case_over_two(row, autopilot, seed)
    assert faults(fly(case)) == [], case


@pytest.mark.parametrize("seed", sampled(range(SEEDS), 2))
@pytest.mark.parametrize(("row", "autopilot"), FEW_ROWS)
def test_no_rule_is_broken(row: Row, autopilot: str, seed: int) -> None:
    case = random_case(row, autopilot, seed)
    assert faults(fly(case)) == [], case


def test_each_order_stands_in_the_documentation() -> None:
    text = (Path(__file__).parents[4] / "docs" / "reliability.md").read_text()
    for row in ROWS:
        assert re.search(rf"^\| [^|]*`{re.escape(row.name.split()[0])}", text, re.MULTILINE), row.name


# --------------------------------------------------------- the faults that were found, one by one


@pytest.mark.parametrize("autopilot", BOTH)
def test_a_pilot_who_took_over_during_a_lost_answer_keeps_the_vehicle(autopilot: str) -> None:
    weather = Weather(command=REPOSITION, lost_acks=1)
    flown = fly(Case(BY_NAME["go_to"], autopilot, weather, pilot_at=0.3))
    assert isinstance(flown.error, OperationRejected)
    assert len([each for each in flown.air.sent if getattr(each.message, "command", 0) == REPOSITION]) == 1
    assert mode_of(flown.vehicle) == flown.acted[0][1]


@pytest.mark.parametrize("name", ["land", "return_to_launch", "hold"])
def test_a_mode_that_was_told_is_not_ordered_again(name: str) -> None:
    """The answer is lost, HEARTBEAT tells the mode, then the pilot takes over, before the time to send again."""
    flown = fly(Case(BY_NAME[name], "ardupilot", Weather(command=SET_MODE, lost_acks=9), pilot_at=0.4))
    assert len([each for each in flown.air.sent if getattr(each.message, "command", 0) == SET_MODE]) == 1
    assert mode_of(flown.vehicle) == "ALT_HOLD"


@pytest.mark.parametrize("autopilot", BOTH)
def test_arming_is_not_repeated_against_another_station(autopilot: str) -> None:
    flown = fly(Case(BY_NAME["arm"], autopilot, Weather(command=ARM, lost_acks=9), pilot_at=1.3))
    assert len([each for each in flown.air.sent if getattr(each.message, "command", 0) == ARM]) == 1
    assert not flown.is_armed_at_end


@pytest.mark.parametrize("until", [10.3, 11.0, 12.0, 13.0])
@pytest.mark.parametrize("name", ["go_to", "guided.velocity"])
def test_a_failsafe_during_an_outage_is_left_alone(name: str, until: float) -> None:
    """FS_GCS_ENABLE returns the vehicle after five seconds; what was to be held then stays with the failsafe."""
    weather = Weather(outage=(0.5, 0.5 + until))
    flown = fly(Case(BY_NAME[name], "ardupilot", weather, station_failsafe=True))
    assert flown.error is not None
    assert mode_of(flown.vehicle) in ("RTL", "LAND")
    assert faults(flown) == []


@pytest.mark.parametrize("cancel_at", [2.0, 6.5, 9.0])
def test_cancelled_in_an_outage_it_leaves_a_failsafe_alone(cancel_at: float) -> None:
    weather = Weather(outage=(0.5, 12.0))
    flown = fly(Case(BY_NAME["go_to"], "ardupilot", weather, station_failsafe=True, cancel_at=cancel_at))
    assert mode_of(flown.vehicle) in ("RTL", "LAND")
    assert faults(flown) == []


@pytest.mark.parametrize("autopilot", BOTH)
def test_cancelled_in_an_outage_without_a_failsafe_it_holds_when_it_is_heard_again(autopilot: str) -> None:
    row = BY_NAME["go_to"]
    far = Row(
        row.name,
        lambda v: v.go_to(v.position.value.offset(north_m=300.0)),
        row.command,
        modes=row.modes,
        holds=True,
    )
    flown = fly(Case(far, autopilot, Weather(outage=(1.0, 6.0)), cancel_at=5.0))
    assert mode_of(flown.vehicle) == ("LOITER" if autopilot == "px4" else "BRAKE")
    assert faults(flown) == []


@pytest.mark.parametrize("autopilot", BOTH)
def test_an_order_to_arm_that_comes_late_is_taken_back(autopilot: str) -> None:
    """A stalled line delivers it three seconds after the call has given up."""
    flown = fly(Case(BY_NAME["arm"], autopilot, Weather(stall=(0.0, 7.0))))
    assert isinstance(flown.error, CommandTimeout)
    assert "may still be carried out" in str(flown.error)
    assert not flown.is_armed_at_end


def test_an_order_to_arm_that_comes_late_is_taken_back_from_somebody_else_too() -> None:
    """HEARTBEAT comes through and tells another mode while the order waits on its way."""
    weather = Weather(stall=(0.0, 5.0))
    flown = fly(Case(BY_NAME["arm"], "ardupilot", weather, pilot_at=0.5, by_switch=True))
    assert isinstance(flown.error, OperationRejected)
    assert not flown.is_armed_at_end


def test_a_pilot_who_goes_back_to_the_mode_from_before_keeps_the_vehicle() -> None:
    """Flown by hand, sent somewhere, given up and told to stop, which was told: then by hand again."""
    weather = Weather(command=REPOSITION, lost_acks=9, lost_commands=1, latency_s=0.2)
    flown = fly(Case(BY_NAME["go_to from another mode"], "px4", weather, pilot_at=1.51, cancel_at=0.98))
    assert faults(flown) == []
    assert mode_of(flown.vehicle) == "POSCTL"


# ------------------------------------------------------------------------------- over two links


def sent(flown: Flown, command: int) -> int:
    """How often this command went out, over either link."""
    return len([each for each in flown.air.sent if getattr(each.message, "command", 0) == command])


def test_an_answer_that_comes_over_the_other_link_is_the_answer() -> None:
    two = TwoLinks(Silence(RIGHT_AFTER_S), is_copied=True)
    flown = fly(Case(BY_NAME["set_speed"], "ardupilot", Weather(), two=two))
    assert flown.error is None
    assert sent(flown, BY_NAME["set_speed"].command) == 1
    assert flown.ended_at - flown.given_at < 0.5


@pytest.mark.parametrize("autopilot", BOTH)
def test_a_pilot_keeps_the_vehicle_when_the_answer_is_lost_on_both_links(autopilot: str) -> None:
    """The mode is told over the next link only."""
    two = TwoLinks(Silence(RIGHT_AFTER_S), is_copied=autopilot == "px4")
    weather = Weather(command=REPOSITION, lost_acks=9)
    flown = fly(Case(BY_NAME["go_to"], autopilot, weather, pilot_at=0.3, two=two))
    assert isinstance(flown.error, OperationRejected)
    assert sent(flown, REPOSITION) == 1
    assert mode_of(flown.vehicle) == flown.acted[0][1]
    assert faults(flown) == []


def test_what_a_dying_link_has_lost_is_sent_again_once_the_next_one_has_told_that_nothing_changed() -> None:
    flown = fly(Case(BY_NAME["land"], "ardupilot", Weather(), two=TwoLinks(Silence(0.0))))
    assert flown.error is None
    first, again = [each for each in flown.air.sent if getattr(each.message, "command", 0) == SET_MODE]
    assert [first.is_lost, again.is_lost] == [True, False]
    assert any(first.number < each.number < again.number for each in flown.air.heartbeats)


def test_a_reboot_is_not_sent_again_over_the_next_link() -> None:
    row = BY_NAME["reboot"]
    flown = fly(Case(row, "ardupilot", Weather(), two=TwoLinks(Silence(0.0))))
    assert isinstance(flown.error, AerokitError)
    assert sent(flown, row.command) == 1


def test_each_command_that_is_sent_once_stands_in_the_documentation() -> None:
    text = (Path(__file__).parents[4] / "docs" / "reliability.md").read_text()
    for command, (what, where) in SENT_ONCE.items():
        condition = "" if where is None else f" (param{where[0] + 1} = {where[1]:g})"
        assert f"| {MavCmd(command).name}{condition} | {what} |" in text
