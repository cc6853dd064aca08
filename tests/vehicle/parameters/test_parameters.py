"""``vehicle.parameters`` on simulated vehicles: downloads, reads, writes, names old and new, events."""

from __future__ import annotations

import asyncio
import re
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
from aerokit.mavlink.enums import MavCmd, MavFtpErr, MavFtpOpcode
from aerokit.parameters import Parameter, ParameterRenamedWarning, ParameterTable, ParameterType
from aerokit.parameters.pack import pack_parameters
from aerokit.protocols.exchange import TransferProgress
from aerokit.protocols.ftp import FtpMessage
from aerokit.sim import SimulatedCopter, SimulatedPx4, simulated_link
from aerokit.testing import FaultModel, FaultyLink
from aerokit.vehicle.connect import connect
from aerokit.vehicle.files.files import Files
from aerokit.vehicle.parameters.access import MAX_READ_BACK, MIN_CHANGES_FOR_FILE
from aerokit.vehicle.parameters.parameters import Parameters
from aerokit.vehicle.parameters.store import ParameterCache, default_directory
from aerokit.vehicle.parameters.writing import ResolvedParameter, resolve_known

pytestmark = pytest.mark.anyio


def now() -> float:
    return asyncio.get_running_loop().time()


def copter(count: int | None = 120, **options: Any) -> SimulatedCopter:
    return SimulatedCopter(boot_time_s=0.0, parameter_count=count, **options)


def px4(**options: Any) -> SimulatedPx4:
    return SimulatedPx4(boot_time_s=0.0, parameter_count=120, **options)


def sent_writes(flight: Flight | Px4Flight) -> list[str]:
    return [write.param_id for write in flight.wire.all(messages.ParamSet)]


def reads_and_lists(flight: Flight | Px4Flight) -> int:
    wire = flight.wire
    return len(wire.all(messages.ParamRequestRead)) + len(wire.all(messages.ParamRequestList))


def files_in(directory: Path) -> list[str]:
    return [path.name for path in directory.iterdir()]


class ParameterEvents:
    """The ParameterChanged events of a vehicle."""

    def __init__(self, flight: Flight | Px4Flight) -> None:
        self.events: list[tuple[str, float, float]] = []
        flight.vehicle.connection.bus.attach_event(events.ParameterChanged, self._take)

    def _take(self, event: events.ParameterChanged) -> None:
        self.events.append((event.name, event.before, event.after))


# ---------------------------------------------------------------------------------- downloading


@pytest.mark.parametrize("method", ["auto", "ftp", "list"])
async def test_download_methods_return_equal_tables(method: Any) -> None:
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


async def test_download_is_cached_until_refresh() -> None:
    simulated = copter()
    async with open_flight(simulated) as flight:
        parameters = flight.vehicle.parameters
        await parameters.download(method="list")
        simulated.parameters["RTL_ALT"] = 2000  # without sending PARAM_VALUE
        assert (await parameters.download())["RTL_ALT"].value == 1500
        received = ParameterEvents(flight)
        assert (await parameters.download(method="list", refresh=True))["RTL_ALT"].value == 2000
        assert received.events == [("RTL_ALT", 1500, 2000)]


async def test_download_without_mavftp_uses_the_list() -> None:
    simulated = copter()
    simulated.faults.no_ftp = True
    async with open_flight(simulated) as flight:
        assert len(await flight.vehicle.parameters.download()) == 120
        assert len(flight.wire.all(messages.ParamRequestList)) == 1
        assert not flight.wire.all(messages.FileTransferProtocol)


async def test_download_with_dropped_mavftp_soon_uses_the_list() -> None:
    simulated = copter()
    async with open_flight(simulated) as flight:
        await flight.vehicle.version.wait_until(lambda _: True)
        simulated.faults.no_ftp = True  # after it has reported MAVFTP
        began = anyio.current_time()
        assert len(await flight.vehicle.parameters.download()) == 120
        assert anyio.current_time() - began < 5
        assert flight.wire.all(messages.FileTransferProtocol)
        with pytest.raises(FileTimeout):
            await flight.vehicle.parameters.download(method="ftp", refresh=True)


async def test_mavftp_answers_to_another_station_do_not_delay_the_list() -> None:
    simulated = copter()
    async with open_flight(simulated) as flight:
        await flight.vehicle.version.wait_until(lambda _: True)
        answer = messages.FileTransferProtocol(0, 77, 190, b"")
        simulated.handlers[messages.FileTransferProtocol.ID] = lambda *_: simulated.send(answer)
        began = anyio.current_time()
        assert len(await flight.vehicle.parameters.download()) == 120
        assert anyio.current_time() - began < 5


async def test_missing_file_is_tried_once_until_reboot() -> None:
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


async def test_list_keeps_defaults_of_earlier_file() -> None:
    async with open_flight(copter()) as flight:
        await flight.vehicle.parameters.download(method="ftp")
        table = await flight.vehicle.parameters.download(method="list", refresh=True)
        assert table.has_defaults


@pytest.mark.parametrize(("damaged", "reads"), [(1, 2), (2, 3), (3, 3)])
async def test_inconsistent_file_is_read_again(monkeypatch: pytest.MonkeyPatch, damaged: int, reads: int) -> None:
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


async def test_concurrent_downloads_are_one() -> None:
    async with open_flight(copter()) as flight, anyio.create_task_group() as tasks:
        for _ in range(3):
            tasks.start_soon(flight.vehicle.parameters.download)
    assert len(flight.wire.all(messages.ParamRequestList)) <= 1


async def test_download_progress_ends_with_the_total() -> None:
    observed: list[TransferProgress] = []
    async with open_flight(copter()) as flight:
        await flight.vehicle.parameters.download(method="list", on_progress=observed.append)
        assert (observed[-1].done, observed[-1].total) == (120, 120)
        await flight.vehicle.parameters.download(method="ftp", refresh=True, on_progress=observed.append)
        assert observed[-1].done == observed[-1].total or observed[-1].total is None


async def test_incomplete_list_names_missing_indices() -> None:
    simulated = copter()
    simulated.faults.mute_parameters = {"RTL_ALT", "LAND_SPEED"}
    async with open_flight(simulated) as flight:
        parameters = flight.vehicle.parameters
        with pytest.raises(ParameterTimeout, match="last heartbeat") as timeout:
            await parameters.download(method="list", idle_timeout_s=3.0)
        names = list(simulated.parameters)
        assert {names[int(index)] for index in timeout.value.missing} == {"RTL_ALT", "LAND_SPEED"}
        assert len(parameters.table) == 118
        assert not parameters.is_complete


async def test_timeout_error_of_program_is_raised_unchanged() -> None:
    async with open_flight() as flight:
        for limit in (flight.vehicle._session.transfers.limit(5.0), flight.vehicle._session.transfers.limit(None)):
            with pytest.raises(TimeoutError, match="the disk does not answer"), limit:
                raise TimeoutError("the disk does not answer")


async def test_download_timeout() -> None:
    async with open_flight(copter(None)) as flight:
        with pytest.raises(OperationTimeout, match=r"not done within 0.1 s"):
            await flight.vehicle.parameters.download(method="list", timeout=0.1)
        assert len(await flight.vehicle.parameters.download(method="list")) == 1349


async def test_download_unknown_method_is_refused() -> None:
    async with open_flight(copter()) as flight:
        with pytest.raises(InvalidArgument, match="auto, ftp, list"):
            await flight.vehicle.parameters.download(method="fast")  # type: ignore[arg-type]
        with pytest.raises(InvalidArgument, match="auto, ftp, set"):
            await flight.vehicle.parameters.upload({"RTL_ALT": 1}, method="fast")  # type: ignore[arg-type]


async def test_list_over_bad_radio_is_complete() -> None:
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


async def test_reboot_clears_the_table() -> None:
    async with open_flight(copter()) as flight:
        parameters = flight.vehicle.parameters
        await parameters.download()
        await flight.vehicle.reboot()
        assert not parameters.is_complete
        assert len(await parameters.download()) == 120


async def test_list_from_before_a_reboot_is_downloaded_again() -> None:
    simulated = copter()
    first = next(iter(simulated.parameters))
    async with open_flight(simulated) as flight:
        session = flight.vehicle._session
        reboots: list[TransferProgress] = []

        def reboot_once(progress: TransferProgress) -> None:
            if progress.done == 60 and not reboots:
                reboots.append(progress)
                simulated.parameters[first] += 1
                for function in session.on_reboot:
                    function()

        table = await flight.vehicle.parameters.download(method="list", on_progress=reboot_once)
        assert table[first].value == simulated.parameters[first]
        assert len(reboots) == 1
        assert flight.vehicle.parameters.is_complete


async def test_changes_by_others_update_the_table() -> None:
    simulated = copter()
    async with open_flight(simulated) as flight:
        received, parameters = ParameterEvents(flight), flight.vehicle.parameters
        await parameters.download()
        other = FrameEncoder(254, 190)
        simulated.receive(other.encode(messages.ParamSet(1, 1, "RTL_ALT", 2500.0, 6)), simulated.now)
        await anyio.sleep(0.5)
        assert received.events == [("RTL_ALT", 1500, 2500)]
        changed = parameters.table["RTL_ALT"]
        assert (changed.value, changed.type, changed.default) == (2500, ParameterType.INT32, 1500)


async def test_values_of_other_components_are_ignored() -> None:
    async with open_flight(copter()) as flight:
        received, parameters = ParameterEvents(flight), flight.vehicle.parameters
        await parameters.download()
        camera = FrameEncoder(1, 100)
        flight.wire.deliver(camera.encode(messages.ParamValue("RTL_ALT", 7.0, 6, 1, 0)))
        assert parameters.table["RTL_ALT"].value == 1500
        assert not received.events


async def test_late_message_with_replaced_value_is_ignored() -> None:
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


async def test_late_message_from_before_two_writes_does_not_stay() -> None:
    async with open_flight(copter()) as flight:
        parameters = flight.vehicle.parameters
        await parameters.download()
        await parameters.set("RTL_ALT", 2000)
        await parameters.set("RTL_ALT", 2500)
        flight.wire.deliver(FrameEncoder(1, 1).encode(messages.ParamValue("RTL_ALT", 1500.0, 6, 120, 0xFFFF)))
        await anyio.sleep(1.5)
        assert parameters.table["RTL_ALT"].value == 2500


async def test_write_undone_by_another_station_at_once_is_noticed() -> None:
    """The value looks like a late message from before the write, so it is read when no late message may arrive."""
    simulated = copter()
    async with open_flight(simulated) as flight:
        received, parameters = ParameterEvents(flight), flight.vehicle.parameters
        await parameters.download()
        await parameters.set("RTL_ALT", 2000)
        other = FrameEncoder(254, 190)
        simulated.receive(other.encode(messages.ParamSet(1, 1, "RTL_ALT", 1500.0, 6)), simulated.now)
        await anyio.sleep(1.5)
        assert received.events == [("RTL_ALT", 1500, 2000), ("RTL_ALT", 2000, 1500)]
        assert parameters.table["RTL_ALT"].value == 1500


async def test_block_exit_unsubscribes() -> None:
    async with open_flight(copter()) as flight:
        kept: Parameters = flight.vehicle.parameters
        await kept.download()
    assert len(kept.table) == 120
    with pytest.raises(Exception, match=r"block|closed"):
        await kept.get("RTL_ALT")


# -------------------------------------------------------------------------------------- reading


async def test_read_returns_one_parameter() -> None:
    async with open_flight(copter(None)) as flight:
        parameters = flight.vehicle.parameters
        assert await parameters.get("RTL_ALT") == 1500
        assert isinstance(await parameters.get("RTL_ALT"), int)
        read = await parameters.read("WPNAV_SPEED")
        assert (read.name, read.value, read.type) == ("WPNAV_SPEED", 1000.0, ParameterType.REAL32)
        assert {"RTL_ALT", "WPNAV_SPEED"} <= set(parameters.table) < set(flight.copter.parameters)


@pytest.mark.parametrize("errors", [False, True])
async def test_read_unknown_name_is_rejected(errors: bool) -> None:
    """Current ArduPilot answers with an error, older versions do not answer."""
    async with open_flight(copter(parameter_errors=errors)) as flight:
        with pytest.raises(ParameterRejected, match="NO_SUCH_ONE") as rejected:
            await flight.vehicle.parameters.get("NO_SUCH_ONE")
        assert rejected.value.code == (1 if errors else None)
        with pytest.raises(ParameterRejected):
            await flight.vehicle.parameters.set("NO_SUCH_ONE", 1)
    assert not sent_writes(flight)


@pytest.mark.parametrize("errors", [False, True])
async def test_probe_uses_exact_names(errors: bool) -> None:
    simulated = copter(parameter_errors=errors)
    async with open_flight(simulated) as flight:
        answers = await flight.vehicle.parameters.probe("RTL_ALT", "NO_SUCH_ONE", "WPNAV_SPEED")
        reported = {name: getattr(answer, "value", None) for name, answer in answers.items()}
        assert reported == {"RTL_ALT": 1500, "NO_SUCH_ONE": None, "WPNAV_SPEED": 1000.0}
        missing = answers["NO_SUCH_ONE"]
        assert isinstance(missing, ParameterRejected)
        assert (missing.name, missing.code) == ("NO_SUCH_ONE", 1 if errors else None)
        assert await flight.vehicle.parameters.probe() == {}
        simulated.faults.silent = True
        silent = (await flight.vehicle.parameters.probe("RTL_ALT", idle_timeout_s=2.0))["RTL_ALT"]
        assert isinstance(silent, ParameterTimeout)


async def test_read_silent_vehicle_times_out() -> None:
    simulated = copter()
    async with open_flight(simulated) as flight:
        simulated.faults.silent = True
        with pytest.raises(ParameterTimeout) as timeout:
            await flight.vehicle.parameters.get("RTL_ALT", idle_timeout_s=2.0)
        assert timeout.value.missing == ("RTL_ALT",)


@pytest.mark.parametrize("name", ["", "A" * 17, "Ä", "A B"])
async def test_invalid_names_are_refused(name: str) -> None:
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


async def test_set_returns_the_outcome() -> None:
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


async def test_set_clamped_rounded_and_refused() -> None:
    simulated = copter()
    simulated.faults.parameter_limits = {"RTL_ALT": (0, 3000)}
    simulated.faults.read_only_parameters = {"LAND_SPEED"}
    async with open_flight(simulated) as flight:
        parameters = flight.vehicle.parameters
        clamped = await parameters.set("RTL_ALT", 9000)
        assert (clamped.outcome, clamped.value, clamped.requested) == ("clamped", 3000, 9000)
        for _ in range(2):
            rounded = await parameters.set("LOG_BITMASK", 16_777_217)
            assert (rounded.outcome, rounded.value) == ("rounded", 16_777_216)
        with pytest.raises(ParameterRejected, match="keeps 50"):
            await parameters.set("LAND_SPEED", 60)
    assert len(sent_writes(flight)) < 40


async def test_px4_integers_are_exact() -> None:
    simulated = px4()
    async with open_px4(simulated) as flight:
        for value in (16_777_217, -5_000_000, -1, 2**31 - 1, 0):
            result = await flight.vehicle.parameters.set("COM_RC_IN_MODE", value)
            assert (result.value, result.type) == (value, ParameterType.INT32)
            assert simulated.parameters["COM_RC_IN_MODE"] == value
            assert await flight.vehicle.parameters.get("COM_RC_IN_MODE") == value


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e39, "5", None])
async def test_invalid_numbers_are_refused(value: Any) -> None:
    async with open_flight(copter()) as flight:
        parameters = flight.vehicle.parameters
        await parameters.download()
        with pytest.raises(InvalidArgument, match="WPNAV_SPEED"):
            await parameters.set_many({"RTL_ALT": 2000, "WPNAV_SPEED": value})
        with pytest.raises(InvalidArgument, match=r"WPNAV_SPEED .*must be "):
            await parameters.set("WPNAV_SPEED", value)
        assert not sent_writes(flight)


@pytest.mark.parametrize(("name", "value"), [("RTL_ALT", 1.5), ("FRAME_CLASS", 300), ("RTL_ALT_FINAL", 40_000)])
async def test_value_beyond_type_is_refused(name: str, value: float) -> None:
    async with open_flight(copter()) as flight:
        parameters = flight.vehicle.parameters
        for _ in range(2):  # with an empty and with a complete table
            with pytest.raises(InvalidArgument, match=name):
                await parameters.set_many({"LAND_SPEED": 60, name: value})
            assert not sent_writes(flight)
            await parameters.download()


async def test_set_many_returns_one_result_each() -> None:
    simulated = copter()
    simulated.faults.read_only_parameters = {"LAND_SPEED"}
    async with open_flight(simulated) as flight:
        wanted = {"RTL_ALT": 2000, "LAND_SPEED": 60, "NO_SUCH_ONE": 1, "WPNAV_SPEED": 700}
        results = await flight.vehicle.parameters.set_many(wanted)
        assert list(results) == list(wanted)
        outcomes = {name: result.outcome for name, result in results.items()}
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


async def test_reboot_while_names_are_read_makes_none_unknown() -> None:
    async with open_flight(copter()) as flight:
        parameters = flight.vehicle.parameters
        await parameters.get("LAND_SPEED")

        def reboot(message: messages.ParamValue) -> None:
            detach()
            parameters._access.forget()

        detach = flight.vehicle.connection.bus.attach(messages.ParamValue, reboot)
        results = await parameters.set_many({"LAND_SPEED": 60, "RTL_ALT": 2000})
        assert {name: result.outcome for name, result in results.items()} == {"LAND_SPEED": "set", "RTL_ALT": "set"}


async def test_unconfirmed_write_times_out() -> None:
    simulated = copter()
    async with open_flight(simulated) as flight:
        await flight.vehicle.parameters.download()
        simulated.faults.mute_parameters = {"RTL_ALT"}
        with pytest.raises(ParameterTimeout, match="not confirmed"):
            await flight.vehicle.parameters.set("RTL_ALT", 2000, idle_timeout_s=2.0)


# ------------------------------------------------------------------------------------ uploading


async def test_upload_by_file_keeps_value_set_during_read_back() -> None:
    async with open_flight(copter()) as flight:
        simulated, parameters = flight.copter, flight.vehicle.parameters
        await parameters.download()
        on_read = simulated.handlers[messages.ParamRequestRead.ID]
        writes: list[asyncio.Task[Any]] = []

        def set_at_first_read(message: messages.ParamRequestRead, channel: Any) -> None:
            if writes:
                on_read(message, channel)
            else:  # The first request is not answered, so the upload reads the value after the other task has set it.
                writes.append(asyncio.create_task(parameters.set("RTL_ALT", 3000)))

        simulated.handlers[messages.ParamRequestRead.ID] = set_at_first_read
        result = (await parameters.upload({"RTL_ALT": 2000}, method="ftp"))["RTL_ALT"]
        assert (result.outcome, result.value) == ("set", 2000)
        assert (await writes[0]).outcome == "set"
        assert simulated.parameters["RTL_ALT"] == 3000


@pytest.mark.parametrize("method", ["ftp", "set"])
async def test_upload_does_not_change_number_of_plan_items(method: Any) -> None:
    async with open_flight(copter()) as flight:
        results = await flight.vehicle.parameters.upload(
            {"FENCE_TOTAL": 7, "RALLY_TOTAL": 1, "MIS_TOTAL": 0, "RTL_ALT": 2000}, method=method
        )
        assert {name: result.outcome for name, result in results.items()} == {
            "FENCE_TOTAL": "failed",
            "RALLY_TOTAL": "failed",
            "MIS_TOTAL": "unchanged",
            "RTL_ALT": "set",
        }
        assert isinstance(results["FENCE_TOTAL"].error, ParameterRejected)
        assert [flight.copter.parameters[name] for name in ("FENCE_TOTAL", "RALLY_TOTAL", "RTL_ALT")] == [0, 0, 2000]


async def test_upload_by_file_has_each_parameter_once(monkeypatch: pytest.MonkeyPatch) -> None:
    uploaded: list[Parameter] = []

    def pack(parameters: tuple[Parameter, ...]) -> bytes:
        uploaded.extend(parameters)
        return pack_parameters(parameters)

    monkeypatch.setattr("aerokit.parameters.pack.pack_parameters", pack)
    async with open_flight(copter()) as flight:
        results = await flight.vehicle.parameters.upload({"RTL_ALT": 2000, "rtl_alt": 2000}, method="ftp")
        assert {name: result.value for name, result in results.items()} == {"RTL_ALT": 2000, "rtl_alt": 2000}
        assert [parameter.name for parameter in uploaded] == ["RTL_ALT"]


async def test_upload_by_file_of_previous_value_updates_the_table() -> None:
    async with open_flight(copter()) as flight:
        parameters = flight.vehicle.parameters
        await parameters.download()
        await parameters.set("RTL_ALT", 2000)
        await parameters.upload({"RTL_ALT": 1500}, method="ftp")
        assert flight.copter.parameters["RTL_ALT"] == parameters.table["RTL_ALT"].value == 1500


@pytest.mark.parametrize("method", ["auto", "ftp", "set"])
async def test_upload_sends_only_differences(method: Any, tmp_path: Path) -> None:
    simulated = copter()
    async with open_flight(simulated) as flight:
        parameters = flight.vehicle.parameters
        table = await parameters.download()
        changed = [name for name, other_name in table.items() if other_name.type is ParameterType.REAL32][:15]
        values = table.values_by_name() | {name: table[name].value + 1.25 for name in changed}
        received = ParameterEvents(flight)
        results = await parameters.upload(values, method=method)
        assert {name for name, result in results.items() if result.outcome == "set"} == set(changed)
        assert {result.outcome for result in results.values()} == {"set", "unchanged"}
        assert {name: simulated.parameters[name] for name in changed} == pytest.approx(
            {name: values[name] for name in changed}
        )
        assert {name for name, _, _ in received.events} == set(changed)
        assert set(sent_writes(flight)) == (set(changed) if method == "set" else set())


async def test_upload_after_cancelled_write_sends_known_value() -> None:
    """The vehicle has set the value of the cancelled write, but its answer was lost."""
    async with open_flight(copter()) as flight:
        parameters = flight.vehicle.parameters
        before = (await parameters.download())["RTL_ALT"].value
        flight.copter.faults.lose(messages.ParamValue, times=1000)
        with anyio.move_on_after(1.0):
            await parameters.set("RTL_ALT", 2000)
        flight.copter.faults.lost_messages.clear()
        results = await parameters.upload({"RTL_ALT": before})
        assert (results["RTL_ALT"].outcome, results["RTL_ALT"].before) == ("set", 2000)
        assert flight.copter.parameters["RTL_ALT"] == before


async def test_lost_write_after_cancelled_one_is_repeated() -> None:
    """The value of the cancelled write is neither the value from before, nor another station's."""
    async with open_flight(copter()) as flight:
        parameters = flight.vehicle.parameters
        await parameters.download()
        flight.copter.faults.lose(messages.ParamValue, times=1000)
        with anyio.move_on_after(1.0):
            await parameters.set("RTL_ALT", 2000)
        flight.copter.faults.lost_messages.clear()
        on_set = flight.copter.handlers[messages.ParamSet.ID]

        def lose_first(_message: messages.ParamSet, _channel: Any) -> None:
            flight.copter.handlers[messages.ParamSet.ID] = on_set

        flight.copter.handlers[messages.ParamSet.ID] = lose_first
        assert (await parameters.set("RTL_ALT", 2500)).outcome == "set"
        assert flight.copter.parameters["RTL_ALT"] == 2500


@pytest.mark.parametrize("lost", [0, 239, 478])
async def test_interrupted_upload_by_file_sets_no_parameter(lost: int) -> None:
    """A SERVO10_MAX of 1879 became 0 on ArduCopter, which evaluates what has arrived when the file is closed."""
    async with open_flight(SimulatedCopter(boot_time_s=0.0), latency_s=0.02) as flight:
        parameters = flight.vehicle.parameters
        table = await parameters.download()
        handle = flight.copter.handlers[messages.FileTransferProtocol.ID]

        def lose_block(message: Any, *more: Any) -> None:
            request = FtpMessage.decode(bytes(message.payload))
            if (request.opcode, request.offset) != (MavFtpOpcode.WRITEFILE, lost):
                handle(message, *more)

        flight.copter.handlers[messages.FileTransferProtocol.ID] = lose_block
        values = {name: table[name].value + 1 for name in table if re.fullmatch(r"(SERVO|RC)\d+_(MIN|MAX|TRIM)", name)}
        assert len(pack_parameters(table[name] for name in values)) > 478
        with anyio.move_on_after(2):
            await parameters.upload(values, method="ftp")
        await anyio.sleep(1)
        assert {name: flight.copter.parameters[name] for name in values} == {name: table[name].value for name in values}


async def test_px4_upload_by_file_arrives_in_order() -> None:
    """PX4 sets parameters as they arrive, and refuses a file with a gap."""
    async with open_px4(px4(parameter_file=True)) as flight:
        parameters = flight.vehicle.parameters
        table = await parameters.download()
        values = {p.name: p.value + 1 for p in table.values() if p.type is ParameterType.INT32 and p.value < 1e6}
        assert len(pack_parameters(table[name] for name in values)) > 239
        await parameters.upload(values, method="ftp")
        assert {name: flight.px4.parameters[name] for name in values} == values
        assert sent_writes(flight) == []


async def test_upload_by_file_without_changes_sends_no_file() -> None:
    async with open_flight(copter()) as flight:
        parameters = flight.vehicle.parameters
        value = (await parameters.download())["RTL_ALT"].value
        flight.wire.clear()
        results = await parameters.upload({"RTL_ALT": value}, method="ftp")
        assert results["RTL_ALT"].outcome == "unchanged"
        assert not flight.wire.all(messages.FileTransferProtocol)


async def test_upload_by_file_is_verified(tmp_path: Path) -> None:
    path = tmp_path / "copter.param"
    path.write_text("RTL_ALT,2500\nLAND_SPEED,50\nNO_SUCH_ONE,1\n")
    simulated = copter()
    async with open_flight(simulated) as flight:
        parameters = flight.vehicle.parameters
        found = {difference.name: (difference.before, difference.after) for difference in await parameters.diff(path)}
        assert found == {"RTL_ALT": (1500, 2500), "NO_SUCH_ONE": (None, 1)}
        results = await parameters.upload(path)
        assert {name: result.outcome for name, result in results.items()} == {
            "RTL_ALT": "set",
            "LAND_SPEED": "unchanged",
            "NO_SUCH_ONE": "failed",
        }
        assert [difference.name for difference in await parameters.diff(path)] == ["NO_SUCH_ONE"]


async def test_upload_by_file_sets_the_rest() -> None:
    """The vehicle clamps values of a file without reporting it."""
    simulated = copter()
    simulated.faults.parameter_limits = {"LAND_SPEED": (0, 100)}
    async with open_flight(simulated) as flight:
        result = (await flight.vehicle.parameters.upload({"LAND_SPEED": 200, "RTL_ALT": 2000}, method="ftp"))[
            "LAND_SPEED"
        ]
        assert result.outcome in ("clamped", "set")
        assert result.value == simulated.parameters["LAND_SPEED"]


@pytest.mark.parametrize("method", ["ftp", "auto"])
async def test_refused_upload_file_raises_or_falls_back(monkeypatch: pytest.MonkeyPatch, method: Any) -> None:
    """The requested method decides: a file transfer raises, an automatic choice falls back."""

    async def refused(*_: Any, **__: Any) -> None:
        raise FileError("write: not today", path="@PARAM/param.pck", code=MavFtpErr.FAIL)

    async with open_flight(copter()) as flight:
        parameters = flight.vehicle.parameters
        names = list(await parameters.download())[:MIN_CHANGES_FOR_FILE]
        monkeypatch.setattr(Files, "write", refused)
        wanted = dict.fromkeys(names, 1)
        if method == "ftp":
            with pytest.raises(FileError, match="not today"):
                await parameters.upload(wanted, method=method)
            assert sent_writes(flight) == []
        else:
            results = await parameters.upload(wanted, method=method)
            changed = [name for name, result in results.items() if result.outcome != "unchanged"]
            assert sorted(set(sent_writes(flight))) == sorted(changed) != []


@pytest.mark.parametrize("more", [0, 1])
async def test_upload_reads_back_singly_or_by_list(more: int) -> None:
    """Both ways of reading back return the vehicle's values."""
    async with open_flight(copter(400)) as flight:
        parameters = flight.vehicle.parameters
        table = await parameters.download()
        wanted = {
            parameter.name: parameter.value + 1
            for parameter in table.values()
            if parameter.type == ParameterType.REAL32
        }
        wanted = dict(list(wanted.items())[: MAX_READ_BACK + more])
        assert len(wanted) == MAX_READ_BACK + more
        flight.wire.clear()
        results = await parameters.upload(wanted, method="ftp")
        assert {result.outcome for result in results.values()} == {"set"}
        assert {name: result.value for name, result in results.items()} == pytest.approx(wanted, rel=1e-6)
        assert (reads_and_lists(flight) >= MAX_READ_BACK) is not bool(more)


async def test_changed_from_default() -> None:
    simulated = copter()
    simulated.parameters["RTL_ALT"] = 4000
    async with open_flight(simulated) as flight:
        changed = await flight.vehicle.parameters.changed_from_default()
        assert (changed["RTL_ALT"].value, changed["RTL_ALT"].default) == (4000, 1500)
        assert "LAND_SPEED" not in changed


async def test_changed_from_default_needs_defaults() -> None:
    async with open_px4(px4()) as flight:
        with pytest.raises(NotSupported, match="load_metadata"):
            await flight.vehicle.parameters.changed_from_default()


# ------------------------------------------------------------------------------------- old names


async def test_renamed_parameters_work_with_a_warning() -> None:
    """This copter is between the versions: it has MAV_SYSID and ARMING_CHECK, and WPNAV_SPEED."""
    simulated = copter()
    async with open_flight(simulated) as flight:
        parameters = flight.vehicle.parameters
        for _ in range(2):  # with an empty and with a complete table
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


async def test_renamed_parameter_is_set_without_commands() -> None:
    async with open_flight(copter()) as flight:
        with pytest.warns(ParameterRenamedWarning):
            await flight.vehicle.parameters.set("WP_SPD", 7.5)
        await asyncio.sleep(1)
        asked = [command.param1 for command in flight.wire.commands(MavCmd.SET_MESSAGE_INTERVAL)]
        assert messages.ParamValue.ID not in asked


async def test_doubtful_parameter_raises_the_parameter_rate() -> None:
    async with open_flight(copter(), latency_s=0.2) as flight:
        with pytest.raises(ParameterRejected):
            await flight.vehicle.parameters.get("NO_SUCH_ONE")
        await asyncio.sleep(1)
        asked = [
            command
            for command in flight.wire.commands(MavCmd.SET_MESSAGE_INTERVAL)
            if command.param1 == messages.ParamValue.ID
        ]
        assert {request.param2 for request in asked} == {20_000, 0}


async def test_renamed_parameters_in_files_and_blocks() -> None:
    simulated = copter(None)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ParameterRenamedWarning)
        async with open_flight(simulated) as flight:
            parameters = flight.vehicle.parameters
            with pytest.warns(ParameterRenamedWarning) as warned:
                differences = await parameters.diff({"WP_SPD": 8.0, "SYSID_THISMAV": 1})
            assert [str(warning.message).split()[0] for warning in warned] == ["WP_SPD", "SYSID_THISMAV"]
            assert {warning.filename for warning in warned} == {__file__}
            assert [(difference.name, difference.before, difference.after) for difference in differences] == [
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


async def test_metadata_without_defaults_is_named(tmp_path: Path) -> None:
    path = tmp_path / "apm.pdef.xml"
    path.write_text(PDEF)
    async with open_px4(px4()) as flight:
        flight.vehicle.parameters.load_metadata(path)
        with pytest.raises(NotSupported, match="the loaded metadata has none either"):
            await flight.vehicle.parameters.changed_from_default()


async def test_metadata_only_adds_notes(tmp_path: Path) -> None:
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
    return [request.param_id for request in flight.wire.all(messages.ParamRequestRead)]


async def test_cached_list_takes_one_request(tmp_path: Path) -> None:
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


async def test_reboot_before_list_is_cached_repeats_the_download(tmp_path: Path) -> None:
    async with open_px4(px4()) as flight:
        parameters, answers = flight.vehicle.parameters, 0

        def reboot_at_last_hash(message: messages.ParamValue) -> None:
            nonlocal answers
            answers += message.param_id == "_HASH_CHECK"
            if answers == 3:  # The first _HASH_CHECK precedes the list, the second begins it, the third is the last.
                parameters._access.forget()

        flight.vehicle.connection.bus.attach(messages.ParamValue, reboot_at_last_hash)
        assert len(await parameters.download(cache=tmp_path, method="list")) == 120
        parameters._access.forget()
        assert len(await parameters.download(cache=tmp_path)) == 120


async def test_changed_hash_invalidates_the_cache(tmp_path: Path) -> None:
    simulated = px4()
    async with open_px4(simulated) as flight:
        await flight.vehicle.parameters.download(cache=tmp_path)
        simulated.parameters["ATT_EN"] = 1
        flight.vehicle.parameters._access.forget()
        flight.wire.clear()
        table = await flight.vehicle.parameters.download(cache=tmp_path)
        assert table["ATT_EN"].value == 1
        assert len(flight.wire.all(messages.ParamRequestList)) == 1
        flight.vehicle.parameters._access.forget()
        flight.wire.clear()
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
def test_default_cache_directory(
    monkeypatch: pytest.MonkeyPatch, platform: str, environment: dict[str, str], folder: str
) -> None:
    for name in ("XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(sys, "platform", platform)
    monkeypatch.setattr(Path, "home", lambda: Path("home"))
    assert default_directory() == Path(folder) / "aerokit" / "parameters"


def test_resolve_known_finds_all_names() -> None:
    old, new = (Parameter(name, 3, ParameterType.INT16) for name in ("SYSID_THISMAV", "MAV_SYSID"))
    assert resolve_known("MAV_SYSID", {"MAV_SYSID": new}) == ResolvedParameter("MAV_SYSID", new, False)
    renamed = resolve_known("SYSID_THISMAV", {"MAV_SYSID": new})
    assert renamed is not None
    assert (renamed.requested, renamed.parameter, renamed.is_fresh) == ("SYSID_THISMAV", new, False)
    assert renamed.note == "MAV_SYSID on this vehicle"
    assert resolve_known("OTHER", {"SYSID_THISMAV": old}) is None


async def test_cache_is_off_by_default(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    async with open_px4(px4()) as flight:
        await flight.vehicle.parameters.download()
        assert files_in(tmp_path) == []
        await flight.vehicle.parameters.download(cache=True, refresh=True)
        assert len(files_in(tmp_path / "aerokit" / "parameters")) == 1


async def test_ardupilot_is_not_cached(tmp_path: Path) -> None:
    async with open_flight(copter()) as flight:
        await flight.vehicle.parameters.download(cache=tmp_path)
    assert files_in(tmp_path) == []


def test_signalling_nan_bits_are_kept() -> None:
    """Shows the reason for the tests with -5,000,000."""
    bits = struct.unpack("<I", struct.pack("<i", -5_000_000))[0]
    assert bits & 0x7F800000 == 0x7F800000
    assert bits & 0x007FFFFF
    assert not bits & 0x00400000


def test_cache_with_default_that_is_no_number_is_ignored(tmp_path: Path) -> None:
    cache = ParameterCache(tmp_path)
    cache.save("vehicle", 1, ParameterTable([Parameter("A", 1.0, ParameterType.REAL32, 2.0)]))
    path = tmp_path / "vehicle.json"
    assert cache.load("vehicle", 1) is not None
    path.write_text(path.read_text().replace("2.0", '"two"'))
    assert cache.load("vehicle", 1) is None


def test_cache_that_cannot_be_written_leaves_no_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def fail(*_: object) -> None:
        raise OSError("No space left on device")

    monkeypatch.setattr(Path, "replace", fail)
    ParameterCache(tmp_path).save("vehicle", 1, ParameterTable([]))
    assert list(tmp_path.iterdir()) == []
