"""Two vehicles with one system id, switched on at the same instant: their hardware ids tell them apart."""

from __future__ import annotations

import logging
from contextlib import AbstractAsyncContextManager

import anyio
import pytest
from several_harness import News, Radios, Told, over

import aerokit
from aerokit import events
from aerokit import messages as m
from aerokit.connection.components import HardwareId
from aerokit.connection.multilink.link_choice import PROOFS, UNNAMED_AFTER, LinkChoice
from aerokit.errors import AerokitError
from aerokit.sim import SimulatedCopter
from aerokit.testing import VIRTUAL_BACKEND

pytestmark = pytest.mark.anyio

NOBODY = bytes(18)
OURS, THEIRS = HardwareId(b"A" * 18, 0), HardwareId(b"B" * 18, 0)


@pytest.fixture
def anyio_backend() -> tuple[str, dict[str, object]]:
    return VIRTUAL_BACKEND


def copter(uid2: bytes) -> SimulatedCopter:
    made = SimulatedCopter(boot_time_s=0.0)
    made.uid = uid2
    return made


class Twins:
    """Two copters that were switched on together; each has a radio of its own."""

    def __init__(self, ours: bytes, theirs: bytes) -> None:
        self.ours, self.theirs = copter(ours), copter(theirs)
        self.radios = Radios(2)
        self.told = Told(self.radios)

    def connected(self) -> AbstractAsyncContextManager[aerokit.Connection]:
        vehicles = [self.ours, self.theirs]
        return over(self.radios, vehicles, server={"vehicles_on": [[self.ours], [self.theirs]]})


def choice_of(connection: aerokit.Connection) -> LinkChoice:
    assert connection._several is not None
    return connection._several._choices[1]


async def test_another_vehicle_that_was_switched_on_at_the_same_instant_is_told_and_left_alone(
    caplog: pytest.LogCaptureFixture,
) -> None:
    twins = Twins(b"A" * 18, b"B" * 18)
    with caplog.at_level(logging.WARNING, "aerokit"):
        async with twins.connected() as connection:
            doubts = News(connection, events.HeardTwice)
            async with aerokit.connect(connection) as flying:
                await flying.wait_ready()
                await anyio.sleep(10)
                assert [(each.system_id, type(each)) for each in doubts.all] == [(1, events.HeardTwice)]
                twins.told.messages.clear()
                twins.radios.cut(0)
                await anyio.sleep(8)
                with pytest.raises(AerokitError):
                    await flying.arm()
                assert not twins.theirs.is_armed
                assert [index for index, _ in twins.told.of(m.CommandLong) if index == 1] == []
                assert choice_of(connection).candidates[1].is_doubted
    warnings = [each.getMessage() for each in caplog.records if "hardware id" in each.getMessage()]
    assert len(warnings) == 1
    assert "another vehicle speaks as system 1 over" in warnings[0]


@pytest.mark.parametrize(
    ("ours", "theirs"), [(NOBODY, NOBODY), (b"A" * 18, NOBODY), (NOBODY, b"B" * 18), (b"A" * 18, b"A" * 18)]
)
async def test_without_two_ids_to_compare_the_clock_decides(ours: bytes, theirs: bytes) -> None:
    twins = Twins(ours, theirs)
    async with twins.connected() as connection:
        doubts = News(connection, events.HeardTwice)
        async with aerokit.connect(connection) as flying:
            await flying.wait_ready()
            await anyio.sleep(4)
            assert choice_of(connection).candidates[1].is_proven
            assert doubts.all == []


async def test_without_a_vehicle_object_both_are_asked() -> None:
    twins = Twins(b"A" * 18, b"B" * 18)
    async with twins.connected() as connection:
        await anyio.sleep(5)
        asked = [index for index, each in twins.told.of(m.CommandLong) if getattr(each, "command", 0) == 512]
        assert sorted(asked) == [0, 1]
        assert choice_of(connection).candidates[1].is_doubted


async def test_one_vehicle_with_two_radios_is_asked_once_over_the_second() -> None:
    radios = Radios(2)
    told = Told(radios)
    async with over(radios, copter(b"A" * 18)) as connection, aerokit.connect(connection) as flying:
        await flying.wait_ready()
        await anyio.sleep(5)
        asked = [each for index, each in told.of(m.CommandLong) if index == 1]
        assert [(getattr(each, "command", 0), getattr(each, "param1", 0)) for each in asked] == [(512, 148)]
        assert choice_of(connection).candidates[1].is_proven


async def test_a_question_that_is_lost_is_asked_again() -> None:
    twins = Twins(b"A" * 18, b"B" * 18)
    write, lost = twins.radios.links[1].link.write, [0]

    def lose_two(data: bytes, peer: object = None) -> None:
        if data[7] == m.CommandLong.ID and lost[0] < 2:
            lost[0] += 1
        else:
            write(data, peer)

    twins.radios.links[1].link.write = lose_two  # type: ignore[method-assign]
    async with twins.connected() as connection:
        proven: list[bool] = []
        async with aerokit.connect(connection) as flying:
            await flying.wait_ready()
            for _ in range(60):
                await anyio.sleep(0.1)
                proven.append(choice_of(connection).candidates[1].is_proven)
        assert lost == [2]
        assert not any(proven)
        assert choice_of(connection).candidates[1].is_doubted


async def test_nothing_is_sent_to_nor_taken_of_who_was_used_by_mistake() -> None:
    """Theirs tells its hardware id only after ours has gone."""
    twins = Twins(b"A" * 18, NOBODY)
    async with twins.connected() as connection, aerokit.connect(connection) as flying:
        await flying.wait_ready()
        await anyio.sleep(4)
        twins.radios.cut(0)
        await anyio.sleep(3)
        assert choice_of(connection).used is choice_of(connection).candidates[1]
        twins.theirs.uid = b"B" * 18
        connection.send(m.CommandLong(1, 1, 512, 0, 148.0, 0, 0, 0, 0, 0, 0))
        await anyio.sleep(1)
        twins.told.messages.clear()
        taken: list[m.Heartbeat] = []
        connection.bus.attach(m.Heartbeat, taken.append)
        connection.send(m.CommandLong(1, 1, 400, 0, 1.0, 0, 0, 0, 0, 0, 0))
        await anyio.sleep(3)
        assert twins.told.of(m.CommandLong) == []
        assert taken == []
        assert not twins.theirs.is_armed


# ------------------------------------------------------------------------- the choice, by itself


class Answers:
    """Two links to who tells the same time."""

    def __init__(self) -> None:
        self.choice, self.now = LinkChoice(needs_proof=True), 0.0
        for link in (0, 1):
            self.choice.heard(link, 0.0, is_costly=False)
        self.choice.choose(0.0)
        self.second = self.choice.candidates[1]

    def come(self, times: int, *links: int, ahead_s: float = 70.0) -> None:
        """Each is asked for its hardware, and answers with the time alone."""
        for _ in range(times):
            self.now += 0.5
            for link in links or (0, 1):
                self.choice.heard(link, self.now, is_costly=False)
                self.choice.asks_hardware(self.choice.candidates[link], is_wanted=True)
                self.choice.note_answer(link, self.now, self.now + ahead_s, 0.01, self.now)
            self.choice.choose(self.now)


def test_who_does_not_tell_its_hardware_is_believed_by_its_clock_soon() -> None:
    answers = Answers()
    answers.choice.note_hardware(0, OURS)
    steps = 0
    while not answers.second.is_proven:
        answers.come(1)
        steps += 1
    assert PROOFS < steps <= 1 + PROOFS + UNNAMED_AFTER


def test_who_tells_another_hardware_late_is_not_used_any_more() -> None:
    answers = Answers()
    answers.choice.note_hardware(0, OURS)
    answers.come(10)
    assert answers.choice.may_be_used(answers.second)
    answers.choice.note_hardware(1, THEIRS)
    for _ in range(5):
        answers.second.note_copy(answers.now)
    answers.come(10)
    assert not answers.choice.may_be_used(answers.second)
    assert answers.second.is_doubted
    assert not answers.second.is_proven


def test_a_vehicle_that_is_found_to_be_another_one_while_it_is_used_gets_nothing() -> None:
    """Ours has gone; who answers over the second link tells only then who it is."""
    answers = Answers()
    answers.choice.note_hardware(0, OURS)
    answers.come(10)
    answers.come(10, 1)
    assert answers.choice.used is answers.second
    answers.choice.note_hardware(1, THEIRS)
    answers.come(2, 1)
    assert not answers.choice.may_be_used(answers.second)
    answers.choice.heard(0, answers.now, is_costly=False)
    assert answers.choice.choose(answers.now) == "another vehicle"
    assert answers.choice.used is answers.choice.candidates[0]
    assert not answers.second.is_proven


def test_after_a_reboot_the_hardware_may_be_another_one() -> None:
    answers = Answers()
    for link in (0, 1):
        answers.choice.note_hardware(link, OURS)
    answers.come(10)
    answers.come(1, ahead_s=0.0)
    for link in (0, 1):
        answers.choice.note_hardware(link, THEIRS)
    answers.come(10, ahead_s=0.0)
    assert answers.choice.may_be_used(answers.second)
    assert not answers.second.is_doubted


def test_ids_are_compared_by_the_field_that_both_tell() -> None:
    def of(uid2: bytes, uid: int) -> HardwareId:
        return HardwareId.of(m.AutopilotVersion(0, 0, 0, 0, 0, b"", b"", b"", 0, 0, uid, uid2))

    one, two = b"\1".ljust(18, b"\0"), b"\2".ljust(18, b"\0")
    assert of(one, 7).contradicts(of(two, 7))
    assert not of(one, 7).contradicts(of(one, 8))
    assert of(b"", 7).contradicts(of(two, 8)), "as MAVLink 1 tells it"
    assert not of(b"", 7).contradicts(of(two, 7))
    assert not of(b"", 0).contradicts(of(two, 7))
    assert not of(one, 0).contradicts(of(b"", 7))
    assert of(one, 7).confirms(of(one, 8)), "uid2 decides"
    assert of(b"", 7).confirms(of(two, 7))
    assert not of(one, 7).confirms(of(two, 7))
    assert not of(b"", 0).confirms(of(b"", 0)), "nothing told is no evidence"
    assert [of(b"", 0).is_told, of(one, 0).is_told, of(b"", 1).is_told] == [False, True, True]
