"""``vehicle.parameters`` on simulated vehicles: downloads, reads, writes, names old and new, events."""

from __future__ import annotations

import asyncio
import struct
import sys
import warnings
from pathlib import Path
from typing import Any

import anyio
import pytest
from flight_harness import Flight, Px4Flight, open_flight, open_px4

from aerokit import events, messages
from aerokit.errors import (
    FileError,
    FileTimeout,
    InvalidArgument,
    NotSupported,
    OperationTimeout,
    ParameterRejected,
    ParameterTimeout,
)
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import MavCmd, MavFtpErr
from aerokit.parameters import Parameter, ParameterRenamedWarning, ParameterType
from aerokit.protocols.exchange import Progress
from aerokit.sim import SimulatedCopter, SimulatedPx4, simulated_link
from aerokit.testing import FaultModel, FaultyLink
from aerokit.vehicle.connect import connect
from aerokit.vehicle.files.files import Files
from aerokit.vehicle.parameters.access import LEAST_TO_PACK, MOST_TO_READ_BACK
from aerokit.vehicle.parameters.parameters import Parameters
from aerokit.vehicle.parameters.store import default_directory
from aerokit.vehicle.parameters.writing import Found, found_among

pytestmark = pytest.mark.anyio


def now() -> float:
    return asyncio.get_running_loop().time()


def copter(count: int | None = 120, **options: Any) -> SimulatedCopter:
    return SimulatedCopter(boot_time_s=0.0, parameter_count=count, **options)


def px4(**options: Any) -> SimulatedPx4:
    return SimulatedPx4(boot_time_s=0.0, parameter_count=120, **options)


def sent_writes(flight: Flight | Px4Flight) -> list[str]:
    return [each.param_id for each in flight.wire.all(messages.ParamSet)]


def reads_and_lists(flight: Flight | Px4Flight) -> int:
    wire = flight.wire
    return len(wire.all(messages.ParamRequestRead)) + len(wire.all(messages.ParamRequestList))


def files_in(directory: Path) -> list[str]:
    return [each.name for each in directory.iterdir()]


class Heard:
    """The ParameterChanged events of a vehicle."""

    def __init__(self, flight: Flight | Px4Flight) -> None:
        self.events: list[tuple[str, float, float]] = []
        flight.vehicle.connection.bus.attach_event(events.ParameterChanged, self._take)

    def _take(self, event: events.ParameterChanged) -> None:
        self.events.append((event.name, event.before, event.after))


# ---------------------------------------------------------------------------------- downloading


@pytest.mark.parametrize("method", ["auto", "ftp", "list"])
async def test_every_way_brings_the_same(method: Any) -> None:
    simulated = copter()
    async with open_flight(simulated) as flight:
        parameters = flight.vehicle.parameters
        assert len(parameters.table) == 0
        was_complete = parameters.is_complete
        table = await parameters.download(method=method)
        assert list(table) == list(simulated.parameters)
        assert table.values_by_name() == {name: simulated.parameters[name] for name in simulated.parameters}
        assert table is parameters.table
        assert (was_complete, parameters.is_complete) == (False, True)
        assert table.has_defaults == (method != "list")
        assert bool(flight.wire.all(messages.ParamRequestList)) == (method == "list")


async def test_what_is_known_is_not_downloaded_again_unless_asked_for() -> None:
    simulated = copter()
    async with open_flight(simulated) as flight:
        parameters = flight.vehicle.parameters
        await parameters.download(method="list")
        simulated.parameters["RTL_ALT"] = 2000  # without telling anybody
        assert (await parameters.download())["RTL_ALT"].value == 1500
        heard = Heard(flight)
        assert (await parameters.download(method="list", refresh=True))["RTL_ALT"].value == 2000
        assert heard.events == [("RTL_ALT", 1500, 2000)]


async def test_without_mavftp_the_list_is_taken() -> None:
    simulated = copter()
    simulated.faults.no_ftp = True
    async with open_flight(simulated) as flight:
        assert len(await flight.vehicle.parameters.download()) == 120
        assert len(flight.wire.all(messages.ParamRequestList)) == 1
        assert not flight.wire.all(messages.FileTransferProtocol)


async def test_where_mavftp_is_swallowed_the_list_is_taken_soon() -> None:
    simulated = copter()
    async with open_flight(simulated) as flight:
        await flight.vehicle.version.wait_until(lambda _: True)
        simulated.faults.no_ftp = True  # it has told before that it has it
        began = anyio.current_time()
        assert len(await flight.vehicle.parameters.download()) == 120
        assert anyio.current_time() - began < 5
        assert flight.wire.all(messages.FileTransferProtocol)
        with pytest.raises(FileTimeout):
            await flight.vehicle.parameters.download(method="ftp", refresh=True)


async def test_a_vehicle_without_the_file_is_asked_for_it_once_until_it_reboots() -> None:
    async with open_px4(px4()) as flight:
        parameters = flight.vehicle.parameters
        assert len(await parameters.download()) == 120
        asked = len(flight.wire.all(messages.FileTransferProtocol))
        assert asked
        await parameters.download(refresh=True)
        assert len(flight.wire.all(messages.FileTransferProtocol)) == asked
        parameters._access.forget()
        await parameters.download()
        assert len(flight.wire.all(messages.FileTransferProtocol)) > asked
        with pytest.raises(FileError):
            await parameters.download(method="ftp", refresh=True)


async def test_defaults_of_an_earlier_file_are_kept_by_a_list() -> None:
    async with open_flight(copter()) as flight:
        await flight.vehicle.parameters.download(method="ftp")
        table = await flight.vehicle.parameters.download(method="list", refresh=True)
        assert table.has_defaults


@pytest.mark.parametrize(("damaged", "reads"), [(1, 2), (2, 3), (3, 3)])
async def test_a_file_that_does_not_hold_together_is_read_again(
    monkeypatch: pytest.MonkeyPatch, damaged: int, reads: int
) -> None:
    """A parameter has come to differ from its default while holes were filled."""
    read, paths = Files.read, []

    async def read_damaged(files: Files, path: str, **options: Any) -> bytes:
        paths.append(path)
        data = await read(files, path, **options)
        return data[:-3] if len(paths) <= damaged else data

    monkeypatch.setattr(Files, "read", read_damaged)
    async with open_flight(copter()) as flight:
        table = await flight.vehicle.parameters.download()
        assert len(table) == 120
        assert len(paths) == reads
        assert table.has_defaults == (damaged == 1)
        assert bool(flight.wire.all(messages.ParamRequestList)) == (damaged == 3)


async def test_two_downloads_at_once_are_one() -> None:
    async with open_flight(copter()) as flight, anyio.create_task_group() as tasks:
        for _ in range(3):
            tasks.start_soon(flight.vehicle.parameters.download)
    assert len(flight.wire.all(messages.ParamRequestList)) <= 1


async def test_progress_ends_with_all_of_it() -> None:
    seen: list[Progress] = []
    async with open_flight(copter()) as flight:
        await flight.vehicle.parameters.download(method="list", on_progress=seen.append)
        assert (seen[-1].done, seen[-1].total) == (120, 120)
        await flight.vehicle.parameters.download(method="ftp", refresh=True, on_progress=seen.append)
        assert seen[-1].done == seen[-1].total or seen[-1].total is None


async def test_what_does_not_come_is_named_and_the_rest_is_known() -> None:
    simulated = copter()
    simulated.faults.mute_parameters = {"RTL_ALT", "LAND_SPEED"}
    async with open_flight(simulated) as flight:
        parameters = flight.vehicle.parameters
        with pytest.raises(ParameterTimeout, match="last heartbeat") as timeout:
            await parameters.download(method="list", patience_s=3.0)
        names = list(simulated.parameters)
        assert {names[int(index)] for index in timeout.value.missing} == {"RTL_ALT", "LAND_SPEED"}
        assert len(parameters.table) == 118
        assert not parameters.is_complete


async def test_a_limit_for_all_of_it() -> None:
    async with open_flight(copter(None)) as flight:
        with pytest.raises(OperationTimeout, match=r"not done within 0.1 s"):
            await flight.vehicle.parameters.download(method="list", timeout=0.1)
        assert len(await flight.vehicle.parameters.download(method="list")) == 1349


async def test_wrong_methods() -> None:
    async with open_flight(copter()) as flight:
        with pytest.raises(InvalidArgument, match="auto, ftp, list"):
            await flight.vehicle.parameters.download(method="fast")  # type: ignore[arg-type]
        with pytest.raises(InvalidArgument, match="auto, ftp, set"):
            await flight.vehicle.parameters.upload({"RTL_ALT": 1}, method="fast")  # type: ignore[arg-type]


async def test_a_list_over_a_bad_radio_is_exact() -> None:
    simulated = copter()
    async with simulated_link(simulated) as link:
        radio = FaultyLink(link, FaultModel(delay_s=0.05), seed=5)
        async with connect(radio, rates={}) as vehicle:
            radio.incoming.model = radio.outgoing.model = FaultModel(
                delay_s=0.05, loss=0.2, duplication=0.1, reordering=0.1, corruption=0.05, jitter_s=0.02
            )
            table = await vehicle.parameters.download(method="list")
    assert table.values_by_name() == {name: simulated.parameters[name] for name in simulated.parameters}


# ------------------------------------------------------------------------------ reboots, events


async def test_a_reboot_forgets_all() -> None:
    async with open_flight(copter()) as flight:
        parameters = flight.vehicle.parameters
        await parameters.download()
        await flight.vehicle.reboot()
        assert not parameters.is_complete
        assert len(await parameters.download()) == 120


async def test_what_others_change_is_told_and_known() -> None:
    simulated = copter()
    async with open_flight(simulated) as flight:
        heard, parameters = Heard(flight), flight.vehicle.parameters
        await parameters.download()
        other = FrameEncoder(254, 190)
        simulated.receive(other.encode(messages.ParamSet(1, 1, "RTL_ALT", 2500.0, 6)), simulated.now)
        await anyio.sleep(0.5)
        assert heard.events == [("RTL_ALT", 1500, 2500)]
        changed = parameters.table["RTL_ALT"]
        assert (changed.value, changed.type, changed.default) == (2500, ParameterType.INT32, 1500)


async def test_values_of_other_components_change_nothing() -> None:
    async with open_flight(copter()) as flight:
        heard, parameters = Heard(flight), flight.vehicle.parameters
        await parameters.download()
        camera = FrameEncoder(1, 100)
        flight.wire.deliver(camera.encode(messages.ParamValue("RTL_ALT", 7.0, 6, 1, 0)))
        assert parameters.table["RTL_ALT"].value == 1500
        assert not heard.events


async def test_a_value_that_has_just_been_replaced_is_a_late_message() -> None:
    """ArduPilot answers reads later than writes."""
    async with open_flight(copter()) as flight:
        parameters = flight.vehicle.parameters
        await parameters.download()
        await parameters.set("RTL_ALT", 2000)
        late = FrameEncoder(1, 1).encode(messages.ParamValue("RTL_ALT", 1500.0, 6, 120, 0xFFFF))
        flight.wire.deliver(late)
        assert parameters.table["RTL_ALT"].value == 2000
        await anyio.sleep(2.0)
        flight.wire.deliver(late)
        assert parameters.table["RTL_ALT"].value == 1500


async def test_leaving_the_vehicle_stops_listening() -> None:
    async with open_flight(copter()) as flight:
        kept: Parameters = flight.vehicle.parameters
        await kept.download()
    assert len(kept.table) == 120
    with pytest.raises(Exception, match=r"block|closed"):
        await kept.get("RTL_ALT")


# -------------------------------------------------------------------------------------- reading


async def test_single_reads() -> None:
    async with open_flight(copter()) as flight:
        parameters = flight.vehicle.parameters
        assert await parameters.get("RTL_ALT") == 1500
        assert isinstance(await parameters.get("RTL_ALT"), int)
        read = await parameters.read("WPNAV_SPEED")
        assert (read.name, read.value, read.type) == ("WPNAV_SPEED", 1000.0, ParameterType.REAL32)
        assert {"RTL_ALT", "WPNAV_SPEED"} <= set(parameters.table) < set(flight.copter.parameters)


@pytest.mark.parametrize("errors", [False, True])
async def test_unknown_names(errors: bool) -> None:
    """Released ArduPilot says so, the version before it said nothing."""
    async with open_flight(copter(parameter_errors=errors)) as flight:
        with pytest.raises(ParameterRejected, match="NO_SUCH_ONE") as rejected:
            await flight.vehicle.parameters.get("NO_SUCH_ONE")
        assert rejected.value.code == (1 if errors else None)
        with pytest.raises(ParameterRejected):
            await flight.vehicle.parameters.set("NO_SUCH_ONE", 1)
    assert not sent_writes(flight)


@pytest.mark.parametrize("errors", [False, True])
async def test_several_are_asked_for_by_exactly_these_names(errors: bool) -> None:
    simulated = copter(parameter_errors=errors)
    async with open_flight(simulated) as flight:
        answers = await flight.vehicle.parameters.probe("RTL_ALT", "NO_SUCH_ONE", "WPNAV_SPEED")
        told = {name: getattr(answer, "value", None) for name, answer in answers.items()}
        assert told == {"RTL_ALT": 1500, "NO_SUCH_ONE": None, "WPNAV_SPEED": 1000.0}
        missing = answers["NO_SUCH_ONE"]
        assert isinstance(missing, ParameterRejected)
        assert (missing.name, missing.code) == ("NO_SUCH_ONE", 1 if errors else None)
        assert await flight.vehicle.parameters.probe() == {}
        simulated.faults.silent = True
        silent = (await flight.vehicle.parameters.probe("RTL_ALT", patience_s=2.0))["RTL_ALT"]
        assert isinstance(silent, ParameterTimeout)


async def test_a_silent_vehicle_is_a_timeout() -> None:
    simulated = copter()
    async with open_flight(simulated) as flight:
        simulated.faults.silent = True
        with pytest.raises(ParameterTimeout) as timeout:
            await flight.vehicle.parameters.get("RTL_ALT", patience_s=2.0)
        assert timeout.value.missing == ("RTL_ALT",)


@pytest.mark.parametrize("name", ["", "A" * 17, "Ä", "A B"])
async def test_impossible_names_are_refused_before_anything_is_sent(name: str) -> None:
    async with open_flight(copter()) as flight:
        parameters = flight.vehicle.parameters
        for attempt in (
            parameters.get(name),
            parameters.probe("RTL_ALT", name),
            parameters.set(name, 1),
            parameters.set_many({"RTL_ALT": 1, name: 1}),
        ):
            with pytest.raises(InvalidArgument):
                await attempt
        assert not reads_and_lists(flight)
        assert not sent_writes(flight)


# -------------------------------------------------------------------------------------- writing


async def test_a_write_says_what_came_of_it() -> None:
    simulated = copter()
    async with open_flight(simulated) as flight:
        result = await flight.vehicle.parameters.set("RTL_ALT", 2000)
        assert (result.name, result.requested, result.value, result.type) == (
            "RTL_ALT",
            2000,
            2000,
            ParameterType.INT32,
        )
        assert (result.outcome, result.note, result.error) == ("set", "", None)
        assert simulated.parameters["RTL_ALT"] == 2000
        assert (await flight.vehicle.parameters.set("RTL_ALT", 2000)).outcome == "unchanged"
        assert (await flight.vehicle.parameters.set("WPNAV_SPEED", 700.1)).outcome == "set"


async def test_clamped_rounded_and_refused() -> None:
    simulated = copter()
    simulated.faults.parameter_limits = {"RTL_ALT": (0, 3000)}
    simulated.faults.read_only_parameters = {"LAND_SPEED"}
    async with open_flight(simulated) as flight:
        parameters = flight.vehicle.parameters
        clamped = await parameters.set("RTL_ALT", 9000)
        assert (clamped.outcome, clamped.value, clamped.requested) == ("clamped", 3000, 9000)
        rounded = await parameters.set("LOG_BITMASK", 16_777_217)
        assert (rounded.outcome, rounded.value) == ("rounded", 16_777_216)
        with pytest.raises(ParameterRejected, match="keeps 50"):
            await parameters.set("LAND_SPEED", 60)
    assert len(sent_writes(flight)) < 20


async def test_px4_takes_integers_to_the_last_bit() -> None:
    simulated = px4()
    async with open_px4(simulated) as flight:
        for value in (16_777_217, -5_000_000, -1, 2**31 - 1, 0):
            result = await flight.vehicle.parameters.set("COM_RC_IN_MODE", value)
            assert (result.value, result.type) == (value, ParameterType.INT32)
            assert simulated.parameters["COM_RC_IN_MODE"] == value
            assert await flight.vehicle.parameters.get("COM_RC_IN_MODE") == value


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e39, "5", None])
async def test_impossible_numbers_are_refused_before_anything_is_set(value: Any) -> None:
    async with open_flight(copter()) as flight:
        parameters = flight.vehicle.parameters
        await parameters.download()
        with pytest.raises(InvalidArgument, match="WPNAV_SPEED"):
            await parameters.set_many({"RTL_ALT": 2000, "WPNAV_SPEED": value})
        assert not sent_writes(flight)


@pytest.mark.parametrize(
    ("name", "value"), [("RTL_ALT", 1.5), ("FRAME_CLASS", 300), ("RTL_ALT_FINAL", 40_000)]
)
async def test_what_a_type_cannot_hold_is_refused_before_anything_is_set(name: str, value: float) -> None:
    async with open_flight(copter()) as flight:
        parameters = flight.vehicle.parameters
        for _ in range(2):  # without and with what the vehicle has being known
            with pytest.raises(InvalidArgument, match=name):
                await parameters.set_many({"LAND_SPEED": 60, name: value})
            assert not sent_writes(flight)
            await parameters.download()


async def test_many_writes_with_one_result_each() -> None:
    simulated = copter()
    simulated.faults.read_only_parameters = {"LAND_SPEED"}
    async with open_flight(simulated) as flight:
        wanted = {"RTL_ALT": 2000, "LAND_SPEED": 60, "NO_SUCH_ONE": 1, "WPNAV_SPEED": 700}
        results = await flight.vehicle.parameters.set_many(wanted)
        assert list(results) == list(wanted)
        outcomes = {name: each.outcome for name, each in results.items()}
        assert outcomes == {
            "RTL_ALT": "set",
            "LAND_SPEED": "failed",
            "NO_SUCH_ONE": "failed",
            "WPNAV_SPEED": "set",
        }
        assert isinstance(results["LAND_SPEED"].error, ParameterRejected)
        assert results["LAND_SPEED"].value == 50
        assert results["NO_SUCH_ONE"].value != results["NO_SUCH_ONE"].value
        assert await flight.vehicle.parameters.set_many({}) == {}


async def test_an_unconfirmed_write_is_a_timeout() -> None:
    simulated = copter()
    async with open_flight(simulated) as flight:
        await flight.vehicle.parameters.download()
        simulated.faults.mute_parameters = {"RTL_ALT"}
        with pytest.raises(ParameterTimeout, match="not confirmed"):
            await flight.vehicle.parameters.set("RTL_ALT", 2000, patience_s=2.0)


# ------------------------------------------------------------------------------------ uploading


@pytest.mark.parametrize("method", ["auto", "ftp", "set"])
async def test_only_what_differs_is_uploaded(method: Any, tmp_path: Path) -> None:
    simulated = copter()
    async with open_flight(simulated) as flight:
        parameters = flight.vehicle.parameters
        table = await parameters.download()
        changed = [name for name, each in table.items() if each.type is ParameterType.REAL32][:15]
        values = table.values_by_name() | {name: table[name].value + 1.25 for name in changed}
        heard = Heard(flight)
        results = await parameters.upload(values, method=method)
        assert {name for name, each in results.items() if each.outcome == "set"} == set(changed)
        assert {each.outcome for each in results.values()} == {"set", "unchanged"}
        assert {name: simulated.parameters[name] for name in changed} == pytest.approx(
            {name: values[name] for name in changed}
        )
        assert {name for name, _, _ in heard.events} == set(changed)
        assert set(sent_writes(flight)) == (set(changed) if method == "set" else set())


async def test_a_file_is_uploaded_and_compared(tmp_path: Path) -> None:
    path = tmp_path / "copter.param"
    path.write_text("RTL_ALT,2500\nLAND_SPEED,50\nNO_SUCH_ONE,1\n")
    simulated = copter()
    async with open_flight(simulated) as flight:
        parameters = flight.vehicle.parameters
        found = {each.name: (each.before, each.after) for each in await parameters.diff(path)}
        assert found == {"RTL_ALT": (1500, 2500), "NO_SUCH_ONE": (None, 1)}
        results = await parameters.upload(path)
        assert {name: each.outcome for name, each in results.items()} == {
            "RTL_ALT": "set",
            "LAND_SPEED": "unchanged",
            "NO_SUCH_ONE": "failed",
        }
        assert [each.name for each in await parameters.diff(path)] == ["NO_SUCH_ONE"]


async def test_what_a_file_does_not_bring_about_is_set() -> None:
    """The vehicle clamps: the file is taken without a word."""
    simulated = copter()
    simulated.faults.parameter_limits = {"LAND_SPEED": (0, 100)}
    async with open_flight(simulated) as flight:
        result = (await flight.vehicle.parameters.upload({"LAND_SPEED": 200, "RTL_ALT": 2000}, method="ftp"))[
            "LAND_SPEED"
        ]
        assert result.outcome in ("clamped", "set")
        assert result.value == simulated.parameters["LAND_SPEED"]


@pytest.mark.parametrize("method", ["ftp", "auto"])
async def test_a_file_that_is_not_taken_is_an_error_or_set_one_by_one(
    monkeypatch: pytest.MonkeyPatch, method: Any
) -> None:
    """As it was asked for."""

    async def refused(*_: Any, **__: Any) -> None:
        raise FileError("write: not today", path="@PARAM/param.pck", code=MavFtpErr.FAIL)

    async with open_flight(copter()) as flight:
        parameters = flight.vehicle.parameters
        names = list(await parameters.download())[:LEAST_TO_PACK]
        monkeypatch.setattr(Files, "write", refused)
        wanted = dict.fromkeys(names, 1)
        if method == "ftp":
            with pytest.raises(FileError, match="not today"):
                await parameters.upload(wanted, method=method)
            assert sent_writes(flight) == []
        else:
            results = await parameters.upload(wanted, method=method)
            changed = [name for name, each in results.items() if each.outcome != "unchanged"]
            assert sorted(set(sent_writes(flight))) == sorted(changed) != []


@pytest.mark.parametrize("more", [0, 1])
async def test_up_to_a_hundred_are_read_back_one_by_one_and_more_as_a_list(more: int) -> None:
    """What is read back is what the vehicle has, whichever way it comes."""
    async with open_flight(copter(400)) as flight:
        parameters = flight.vehicle.parameters
        table = await parameters.download()
        wanted = {each.name: each.value + 1 for each in table.values() if each.type == ParameterType.REAL32}
        wanted = dict(list(wanted.items())[: MOST_TO_READ_BACK + more])
        assert len(wanted) == MOST_TO_READ_BACK + more
        flight.wire.forget()
        results = await parameters.upload(wanted, method="ftp")
        assert {each.outcome for each in results.values()} == {"set"}
        assert {name: each.value for name, each in results.items()} == pytest.approx(wanted, rel=1e-6)
        assert (reads_and_lists(flight) >= MOST_TO_READ_BACK) is not bool(more)


async def test_what_was_changed() -> None:
    simulated = copter()
    simulated.parameters["RTL_ALT"] = 4000
    async with open_flight(simulated) as flight:
        changed = await flight.vehicle.parameters.changed_from_default()
        assert (changed["RTL_ALT"].value, changed["RTL_ALT"].default) == (4000, 1500)
        assert "LAND_SPEED" not in changed


async def test_what_was_changed_needs_defaults() -> None:
    async with open_px4(px4()) as flight:
        with pytest.raises(NotSupported, match="load_metadata"):
            await flight.vehicle.parameters.changed_from_default()


# ------------------------------------------------------------------------------------- old names


async def test_old_and_new_names_read_and_written_with_a_warning() -> None:
    """This copter is between the versions: it has MAV_SYSID and ARMING_CHECK, and WPNAV_SPEED."""
    simulated = copter()
    async with open_flight(simulated) as flight:
        parameters = flight.vehicle.parameters
        for _ in range(2):  # without and with what the vehicle has being known
            with pytest.warns(ParameterRenamedWarning, match="MAV_SYSID") as warned:
                assert await parameters.get("SYSID_THISMAV") == 1
            assert warned[0].filename == __file__
            with pytest.warns(ParameterRenamedWarning, match="WP_SPD"):
                speed = await parameters.read("WP_SPD")
            assert (speed.name, speed.value) == ("WP_SPD", 10.0)
            with pytest.warns(ParameterRenamedWarning):
                assert await parameters.get("ARMING_SKIPCHK") == 0
            await parameters.download()
        with pytest.warns(ParameterRenamedWarning):
            result = await parameters.set("WP_SPD", 7.5)
        assert (result.name, result.requested, result.value) == ("WP_SPD", 7.5, 7.5)
        assert "WPNAV_SPEED" in result.note
        assert simulated.parameters["WPNAV_SPEED"] == 750


async def test_renamed_parameter_is_set_without_any_command() -> None:
    async with open_flight(copter()) as flight:
        with pytest.warns(ParameterRenamedWarning):
            await flight.vehicle.parameters.set("WP_SPD", 7.5)
        await asyncio.sleep(1)
        asked = [each.param1 for each in flight.wire.commands(MavCmd.SET_MESSAGE_INTERVAL)]
        assert messages.ParamValue.ID not in asked


async def test_parameter_that_is_long_in_doubt_has_the_vehicle_asked_to_answer_more_often() -> None:
    async with open_flight(copter(), latency_s=0.2) as flight:
        with pytest.raises(ParameterRejected):
            await flight.vehicle.parameters.get("NO_SUCH_ONE")
        await asyncio.sleep(1)
        asked = [
            each
            for each in flight.wire.commands(MavCmd.SET_MESSAGE_INTERVAL)
            if each.param1 == messages.ParamValue.ID
        ]
        assert {each.param2 for each in asked} == {20_000, 0}


async def test_renamed_names_in_files_and_blocks() -> None:
    simulated = copter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ParameterRenamedWarning)
        async with open_flight(simulated) as flight:
            parameters = flight.vehicle.parameters
            with pytest.warns(ParameterRenamedWarning) as warned:
                differences = await parameters.diff({"WP_SPD": 8.0, "SYSID_THISMAV": 1})
            assert [str(each.message).split()[0] for each in warned] == ["WP_SPD", "SYSID_THISMAV"]
            assert {each.filename for each in warned} == {__file__}
            assert [(each.name, each.before, each.after) for each in differences] == [
                ("WPNAV_SPEED", 1000, 800)
            ]
            assert (await parameters.upload({"WP_SPD": 8.0}))["WP_SPD"].outcome == "set"
            async with parameters.temporarily({"WP_SPD": 5.0}):
                assert simulated.parameters["WPNAV_SPEED"] == 500
            assert simulated.parameters["WPNAV_SPEED"] == 800
            async with parameters.transaction() as transaction:
                await transaction.set("WP_SPD", 6.0)
            assert simulated.parameters["WPNAV_SPEED"] == 600
            results = await parameters.upload({"WP_SPD": 9.0, "WPNAV_SPEED": 700})
            assert list(results) == ["WPNAV_SPEED"]
            with pytest.raises(InvalidArgument, match="contradict"):
                await parameters.set_many({"WP_SPD": 9.0, "WPNAV_SPEED": 800})
            assert simulated.parameters["WPNAV_SPEED"] == 700


# -------------------------------------------------------------------------------------- metadata

PDEF = """<?xml version="1.0"?><paramfile><vehicles><parameters name="ArduCopter">
<param humanName="RTL Altitude" name="ArduCopter:RTL_ALT" documentation="How high" user="Standard">
<field name="Range">30 300000</field><field name="Units">cm</field><field name="RebootRequired">True</field></param>
</parameters></vehicles></paramfile>"""


async def test_metadata_are_advice(tmp_path: Path) -> None:
    path = tmp_path / "apm.pdef.xml"
    path.write_text(PDEF)
    simulated = copter()
    async with open_flight(simulated) as flight:
        parameters = flight.vehicle.parameters
        metadata = [parameters.metadata, parameters.load_metadata(path), parameters.metadata]
        assert metadata[0] is None
        assert metadata[1] is metadata[2]
        result = await parameters.set("RTL_ALT", 10)
        assert (result.outcome, simulated.parameters["RTL_ALT"]) == ("set", 10)
        assert "30" in result.note
        assert "reboot" in result.note
        async with parameters.transaction() as transaction:
            await transaction.set("LAND_SPEED", 70)
            assert not transaction.needs_reboot
            await transaction.set("RTL_ALT", 2000)
            assert transaction.needs_reboot == ("RTL_ALT",)


# ---------------------------------------------------------------------------------------- hash


def hash_requests(flight: Px4Flight) -> list[str]:
    return [each.param_id for each in flight.wire.all(messages.ParamRequestRead)]


async def test_the_second_connect_takes_one_request(tmp_path: Path) -> None:
    simulated = px4()
    async with open_px4(simulated) as flight:
        first = await flight.vehicle.parameters.download(cache=tmp_path)
        assert len(files_in(tmp_path)) == 1
    async with simulated_link(simulated) as link, connect(link) as vehicle:
        await vehicle.version.wait_until(lambda _: True)
        begun = now()
        assert await vehicle.parameters.download(cache=tmp_path) == first
        assert vehicle.parameters.is_complete
        assert now() - begun < 0.05


async def test_a_change_makes_the_cache_worthless(tmp_path: Path) -> None:
    simulated = px4()
    async with open_px4(simulated) as flight:
        await flight.vehicle.parameters.download(cache=tmp_path)
        simulated.parameters["COM_RC_IN_MODE"] = 4
        flight.vehicle.parameters._access.forget()
        flight.wire.forget()
        table = await flight.vehicle.parameters.download(cache=tmp_path)
        assert table["COM_RC_IN_MODE"].value == 4
        assert len(flight.wire.all(messages.ParamRequestList)) == 1
        flight.vehicle.parameters._access.forget()
        flight.wire.forget()
        await flight.vehicle.parameters.download(cache=tmp_path)
        assert hash_requests(flight) == ["_HASH_CHECK"]
        assert not flight.wire.all(messages.ParamRequestList)
        await flight.vehicle.parameters.download(cache=tmp_path, refresh=True)
        assert len(flight.wire.all(messages.ParamRequestList)) == 1


@pytest.mark.parametrize(
    ("platform", "environment", "folder"),
    [
        ("linux", {}, "home/.cache"),
        ("linux", {"XDG_CACHE_HOME": "relative"}, "home/.cache"),
        ("darwin", {}, "home/Library/Caches"),
        ("win32", {}, "home/AppData/Local"),
        ("win32", {"LOCALAPPDATA": "/local"}, "/local"),
        ("win32", {"LOCALAPPDATA": "/local", "XDG_CACHE_HOME": "/cache"}, "/cache"),
    ],
)
def test_where_caches_are_kept(
    monkeypatch: pytest.MonkeyPatch, platform: str, environment: dict[str, str], folder: str
) -> None:
    for name in ("XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(sys, "platform", platform)
    monkeypatch.setattr(Path, "home", lambda: Path("home"))
    assert default_directory() == Path(folder) / "aerokit" / "parameters"


def test_a_parameter_is_found_under_its_names() -> None:
    old, new = (Parameter(name, 3, ParameterType.INT16) for name in ("SYSID_THISMAV", "MAV_SYSID"))
    assert found_among("MAV_SYSID", {"MAV_SYSID": new}) == Found("MAV_SYSID", new, False)
    renamed = found_among("SYSID_THISMAV", {"MAV_SYSID": new})
    assert renamed is not None
    assert (renamed.asked, renamed.parameter, renamed.is_fresh) == ("SYSID_THISMAV", new, False)
    assert renamed.note == "MAV_SYSID on this vehicle"
    assert found_among("OTHER", {"SYSID_THISMAV": old}) is None


async def test_nothing_is_written_to_disk_unless_asked_for(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    async with open_px4(px4()) as flight:
        await flight.vehicle.parameters.download()
        assert files_in(tmp_path) == []
        await flight.vehicle.parameters.download(cache=True, refresh=True)
        assert len(files_in(tmp_path / "aerokit" / "parameters")) == 1


async def test_ardupilot_has_no_hash_and_no_cache(tmp_path: Path) -> None:
    async with open_flight(copter()) as flight:
        await flight.vehicle.parameters.download(cache=tmp_path)
    assert files_in(tmp_path) == []


def test_wire_bits_of_a_signalling_nan() -> None:
    """What the tests with -5,000,000 are about."""
    bits = struct.unpack("<I", struct.pack("<i", -5_000_000))[0]
    assert bits & 0x7F800000 == 0x7F800000
    assert bits & 0x007FFFFF
    assert not bits & 0x00400000
