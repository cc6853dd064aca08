"""Two vehicles with one system id, switched on at the same instant, are distinguished by their hardware ids."""

from __future__ import annotations

import logging
from contextlib import AbstractAsyncContextManager
from pathlib import Path

import anyio
import pytest
from several_harness import EventLog, Radios, ReceivedMessages, over

import aerokit
from aerokit import events
from aerokit import messages as m
from aerokit.connection.multilink.link_choice import MAX_ANSWERS_WITHOUT_HARDWARE, MIN_CLOCK_MATCHES, LinkChoice
from aerokit.connection.multilink.vehicle_clock import ClockSample, HardwareId
from aerokit.errors import AerokitError, CommandTimeout
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
    """Two copters that were switched on together, each with its own radio."""

    def __init__(self, ours: bytes, theirs: bytes) -> None:
        self.ours, self.theirs = copter(ours), copter(theirs)
        self.radios = Radios(2)
        self.reported = ReceivedMessages(self.radios)

    def connected(self) -> AbstractAsyncContextManager[aerokit.Connection]:
        vehicles = [self.ours, self.theirs]
        return over(self.radios, vehicles, server={"vehicles_on": [[self.ours], [self.theirs]]})


def choice_of(connection: aerokit.Connection) -> LinkChoice:
    assert connection._multilink is not None
    return connection._multilink._choices[1]


async def test_vehicle_with_other_hardware_id_is_reported_and_refused(
    caplog: pytest.LogCaptureFixture,
) -> None:
    twins = Twins(b"A" * 18, b"B" * 18)
    with caplog.at_level(logging.WARNING, "aerokit"):
        async with twins.connected() as connection:
            doubts = EventLog(connection, events.DuplicateSender)
            async with aerokit.connect(connection) as flying:
                await flying.wait_ready()
                await anyio.sleep(10)
                assert [(event.system_id, type(event)) for event in doubts.all] == [(1, events.DuplicateSender)]
                twins.reported.messages.clear()
                twins.radios.cut(0)
                await anyio.sleep(8)
                with pytest.raises(AerokitError):
                    await flying.arm()
                assert not twins.theirs.is_armed
                assert [index for index, _ in twins.reported.of(m.CommandLong) if index == 1] == []
                assert choice_of(connection).candidates[1].is_same_vehicle is False
    warnings = [record.getMessage() for record in caplog.records if "hardware id" in record.getMessage()]
    assert len(warnings) == 1
    assert "another vehicle with system id 1 was received over" in warnings[0]


@pytest.mark.parametrize(
    ("ours", "theirs"), [(NOBODY, NOBODY), (b"A" * 18, NOBODY), (NOBODY, b"B" * 18), (b"A" * 18, b"A" * 18)]
)
async def test_clock_decides_without_two_hardware_ids(ours: bytes, theirs: bytes) -> None:
    twins = Twins(ours, theirs)
    async with twins.connected() as connection:
        doubts = EventLog(connection, events.DuplicateSender)
        async with aerokit.connect(connection) as flying:
            await flying.wait_ready()
            await anyio.sleep(4)
            assert choice_of(connection).candidates[1].is_same_vehicle
            assert doubts.all == []


async def test_both_links_are_probed_without_vehicle_object() -> None:
    twins = Twins(b"A" * 18, b"B" * 18)
    async with twins.connected() as connection:
        await anyio.sleep(5)
        asked = [index for index, message in twins.reported.of(m.CommandLong) if getattr(message, "command", 0) == 512]
        assert sorted(asked) == [0, 1]
        assert choice_of(connection).candidates[1].is_same_vehicle is False


async def test_second_radio_is_asked_once_for_hardware() -> None:
    radios = Radios(2)
    received = ReceivedMessages(radios)
    async with over(radios, copter(b"A" * 18)) as connection, aerokit.connect(connection) as flying:
        await flying.wait_ready()
        await anyio.sleep(5)
        asked = [message for index, message in received.of(m.CommandLong) if index == 1]
        assert [(getattr(request, "command", 0), getattr(request, "param1", 0)) for request in asked] == [(512, 148)]
        assert choice_of(connection).candidates[1].is_same_vehicle


async def test_lost_hardware_request_is_repeated() -> None:
    twins = Twins(b"A" * 18, b"B" * 18)
    write, lost = twins.radios.links[1].link.write, [0]

    def lose_two(data: bytes, peer: object = None) -> None:
        if data[7] == m.CommandLong.ID and lost[0] < 2:
            lost[0] += 1
        else:
            write(data, peer)

    twins.radios.links[1].link.write = lose_two  # type: ignore[method-assign]
    async with twins.connected() as connection:
        proven: list[bool | None] = []
        async with aerokit.connect(connection) as flying:
            await flying.wait_ready()
            for _ in range(60):
                await anyio.sleep(0.1)
                proven.append(choice_of(connection).candidates[1].is_same_vehicle)
        assert lost == [2]
        assert not any(proven)
        assert choice_of(connection).candidates[1].is_same_vehicle is False


async def test_wrongly_used_vehicle_is_ignored_once_known(tmp_path: Path) -> None:
    """The other vehicle reports its hardware id only after ours has failed. An order is not recorded as sent."""
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
        twins.reported.messages.clear()
        taken: list[m.Heartbeat] = []
        connection.bus.attach(m.Heartbeat, taken.append)
        sent: list[bytes] = []
        connection.observe_sent_frames(sent.append)
        connection.record(tmp_path / "flight.tlog")
        order = m.CommandLong(1, 1, 400, 0, 1.0, 0, 0, 0, 0, 0, 0)
        connection.send(order)
        await anyio.sleep(3)
        assert twins.reported.of(m.CommandLong) == []
        assert taken == []
        assert not twins.theirs.is_armed
        with pytest.raises(CommandTimeout, match="was not sent, because there was no usable link"):
            await flying.terminate(intent="terminate flight")
    recorded = (tmp_path / "flight.tlog").read_bytes()
    assert order.encode().rstrip(b"\0") not in b"".join(sent) + recorded
    assert sent


# ------------------------------------------------------------------------------ LinkChoice alone


class Answers:
    """Two links on which the same time is received."""

    def __init__(self) -> None:
        self.choice, self.now = LinkChoice(has_autopilot=True), 0.0
        for link in (0, 1):
            self.choice.record_heartbeat(link, 0.0, is_costly=False)
        self.choice.choose(0.0)
        self.second = self.choice.candidates[1]

    def answer_probes(self, times: int, *links: int, ahead_s: float = 70.0) -> None:
        """Request the hardware id over each link; the answers contain only the time."""
        for _ in range(times):
            self.now += 0.5
            for link in links or (0, 1):
                self.choice.record_heartbeat(link, self.now, is_costly=False)
                candidate = self.choice.candidates[link]
                if self.choice.should_request_hardware(candidate, has_vehicle_object=True):
                    candidate.count_hardware_request()
                self.choice.record_answer(link, ClockSample(self.now, self.now + ahead_s, 0.01), self.now)
            self.choice.choose(self.now)


def test_vehicle_without_hardware_id_is_proven_by_clock() -> None:
    answers = Answers()
    answers.choice.record_hardware(0, OURS)
    steps = 0
    while not answers.second.is_same_vehicle:
        answers.answer_probes(1)
        steps += 1
    assert MIN_CLOCK_MATCHES < steps <= 1 + MIN_CLOCK_MATCHES + MAX_ANSWERS_WITHOUT_HARDWARE


def test_late_other_hardware_id_disables_the_link() -> None:
    answers = Answers()
    answers.choice.record_hardware(0, OURS)
    answers.answer_probes(10)
    assert answers.choice.may_be_used(answers.second)
    answers.choice.record_hardware(1, THEIRS)
    for _ in range(5):
        answers.second.record_copy(answers.now)
    answers.answer_probes(10)
    assert not answers.choice.may_be_used(answers.second)
    assert answers.second.is_same_vehicle is False
    assert not answers.second.is_same_vehicle


def test_used_link_with_other_hardware_gets_nothing() -> None:
    """Our vehicle has failed; only then the one behind the second link sends its hardware id."""
    answers = Answers()
    answers.choice.record_hardware(0, OURS)
    answers.answer_probes(10)
    answers.answer_probes(10, 1)
    assert answers.choice.used is answers.second
    answers.choice.record_hardware(1, THEIRS)
    answers.answer_probes(2, 1)
    assert not answers.choice.may_be_used(answers.second)
    answers.choice.record_heartbeat(0, answers.now, is_costly=False)
    assert answers.choice.choose(answers.now) == "another vehicle"
    assert answers.choice.used is answers.choice.candidates[0]
    assert not answers.second.is_same_vehicle


def test_hardware_may_change_after_reboot() -> None:
    answers = Answers()
    for link in (0, 1):
        answers.choice.record_hardware(link, OURS)
    answers.answer_probes(10)
    answers.answer_probes(1, ahead_s=0.0)
    for link in (0, 1):
        answers.choice.record_hardware(link, THEIRS)
    answers.answer_probes(10, ahead_s=0.0)
    assert answers.choice.may_be_used(answers.second)
    assert answers.second.is_same_vehicle is not False


def test_hardware_ids_are_compared_by_common_field() -> None:
    def of(uid2: bytes, uid: int) -> HardwareId:
        return HardwareId.from_message(m.AutopilotVersion(0, 0, 0, 0, 0, b"", b"", b"", 0, 0, uid, uid2))

    one, two = b"\1".ljust(18, b"\0"), b"\2".ljust(18, b"\0")
    assert of(one, 7).contradicts(of(two, 7))
    assert not of(one, 7).contradicts(of(one, 8))
    assert of(b"", 7).contradicts(of(two, 8)), "as in a MAVLink 1 message"
    assert not of(b"", 7).contradicts(of(two, 7))
    assert not of(b"", 0).contradicts(of(two, 7))
    assert not of(one, 0).contradicts(of(b"", 7))
    assert of(one, 7).confirms(of(one, 8)), "uid2 decides"
    assert of(b"", 7).confirms(of(two, 7))
    assert not of(one, 7).confirms(of(two, 7))
    assert not of(b"", 0).confirms(of(b"", 0)), "two missing ids are no evidence"
    assert [of(b"", 0).has_value, of(one, 0).has_value, of(b"", 1).has_value] == [False, True, True]
