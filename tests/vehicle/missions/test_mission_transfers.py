"""vehicle.mission: upload, download, clear, partial changes, by items and by file; and failures."""

from __future__ import annotations

import asyncio
import math
from typing import Any

import anyio
import pytest
from flight_harness import Flight, Px4Flight, now, open_flight, open_px4
from plan_flights import changed, long_mission, near_home, sent_for_plans

from aerokit import messages as m
from aerokit.errors import (
    ConnectionClosed,
    InvalidArgument,
    MissionRejected,
    MissionTimeout,
    NotSupported,
    OperationTimeout,
    VerificationFailed,
)
from aerokit.mavlink import FrameEncoder
from aerokit.mavlink.enums import MavFtpOpcode, MavMissionType
from aerokit.mavlink.enums import MavMissionResult as Result
from aerokit.missions import Fence, FenceCircle, Mission, MissionItem
from aerokit.missions.actions import jump
from aerokit.missions.compare import ItemStorage
from aerokit.position import Position
from aerokit.protocols.exchange import TransferProgress
from aerokit.protocols.ftp import FtpMessage
from aerokit.sim import SimulatedCopter
from aerokit.sim.missions import MissionMount

pytestmark = pytest.mark.anyio

UNKNOWN = MissionItem(31_000, 3)
"""No autopilot supports this command, but only the upload reveals that."""


def held_by(flight: Flight | Px4Flight) -> Mission:
    vehicle = flight.copter if isinstance(flight, Flight) else flight.px4
    return Mission.from_items(vehicle.missions.items(0), home_is_item_0=isinstance(flight, Flight))


def holds(flight: Flight | Px4Flight, mission: Mission) -> bool:
    storage = ItemStorage.ARDUPILOT if isinstance(flight, Flight) else ItemStorage.PX4
    return mission.matches(held_by(flight), storage)


# -------------------------------------------------------------------------------- round trip


@pytest.mark.parametrize("method", ["items", "ftp", "auto"])
async def test_copter_home_item_is_hidden(method: Any) -> None:
    mission = Mission([*long_mission(12), jump(2, repeat=3)])
    async with open_flight(latency_s=0.02) as flight:
        await flight.vehicle.wait_ready()
        await flight.vehicle.mission.upload(mission, method=method)
        assert holds(flight, mission)
        assert len(flight.copter.missions.items(0)) == 14
        assert flight.copter.missions.items(0)[13].param1 == 3
        found = await flight.vehicle.mission.download(method=method)
        assert mission.matches(found, ItemStorage.ARDUPILOT)
        assert found.home is not None
        assert flight.vehicle.mission.count.value == 13
        assert bool(flight.wire.all(m.FileTransferProtocol)) == (method != "items")
        assert bool(flight.wire.all(m.MissionItemInt)) == (method == "items")


async def test_px4_has_no_home_item_and_no_file() -> None:
    mission = long_mission(12)
    async with open_px4() as flight:
        await flight.vehicle.mission.upload(mission)
        assert holds(flight, mission)
        assert mission.matches(await flight.vehicle.mission.download(), ItemStorage.PX4)
        asked = len(flight.wire.all(m.FileTransferProtocol))
        await flight.vehicle.mission.download()
        assert len(flight.wire.all(m.FileTransferProtocol)) == asked  # the result is remembered


async def test_items_are_sent_before_requested() -> None:
    async with open_flight(latency_s=0.05) as flight:
        started = asyncio.get_running_loop().time()
        await flight.vehicle.mission.upload(long_mission(50), method="items", verify=False)
        assert asyncio.get_running_loop().time() - started < 1.5
        assert len(flight.wire.all(m.MissionItemInt)) == 51


@pytest.mark.parametrize("opened", [open_flight, open_px4])
async def test_empty_mission_clears(opened: Any) -> None:
    async with opened() as flight:
        await flight.vehicle.mission.upload(long_mission(3))
        await flight.vehicle.mission.upload(Mission())
        assert len(held_by(flight)) == 0
        assert flight.vehicle.mission.count.value == 0
        assert flight.wire.all(m.MissionClearAll)
        assert await flight.vehicle.mission.download() == Mission(home=(await flight.vehicle.mission.download()).home)
        await flight.vehicle.mission.upload(long_mission(3))
        await flight.vehicle.mission.clear()
        assert len(held_by(flight)) == 0


async def test_upload_progress() -> None:
    reported: list[TransferProgress] = []
    async with open_flight(latency_s=0.02) as flight:
        await flight.vehicle.mission.upload(long_mission(20), method="items", verify=False, on_progress=reported.append)
    assert (reported[-1].done, reported[-1].total) == (21, 21)
    assert reported[-1].rate > 0


@pytest.mark.parametrize("opened", [open_flight, open_px4])
async def test_transfer_continues_if_progress_callback_raises(opened: Any, caplog: pytest.LogCaptureFixture) -> None:
    def fail(_: TransferProgress) -> None:
        raise ZeroDivisionError

    async with opened() as flight:
        with anyio.fail_after(2.0):
            await flight.vehicle.mission.upload(long_mission(3), method="items", verify=False, on_progress=fail)
    assert "on_progress raised an exception; the transfer continues" in caplog.text


# ----------------------------------------------------------------------------------------- changes


async def test_px4_equal_plan_is_not_sent() -> None:
    async with open_px4() as flight:
        mission = flight.vehicle.mission
        await mission.upload(long_mission(12))
        await anyio.sleep(1.5)
        flight.wire.clear()
        await mission.upload(long_mission(12))
        assert sent_for_plans(flight.wire) == []
        await mission.upload(long_mission(12), only_changes=False)
        assert len(flight.wire.all(m.MissionItemInt)) == 12
        await mission.upload(changed(long_mission(12), 4))  # the fence has no partial upload
        assert holds(flight, changed(long_mission(12), 4))


async def test_ardupilot_gets_only_changed_items() -> None:
    async with open_flight() as flight:
        mission = flight.vehicle.mission
        await mission.upload(long_mission(40))
        flight.wire.clear()
        await mission.upload(changed(long_mission(40), 3, 4, 20), method="items")
        assert holds(flight, changed(long_mission(40), 3, 4, 20))
        parts = [(part.start_index, part.end_index) for part in flight.wire.all(m.MissionWritePartialList)]
        assert parts == [(4, 5), (21, 21)]  # home is item 0
        assert len(flight.wire.all(m.MissionItemInt)) == 3
        flight.wire.clear()
        await mission.upload(changed(long_mission(40), 3, 4, 20))
        assert not flight.wire.all(m.MissionItemInt)
        flight.wire.clear()
        await mission.upload(
            changed(long_mission(40), *range(0, 40, 2)), method="items"
        )  # too many differences for a partial upload
        assert not flight.wire.all(m.MissionWritePartialList)
        assert holds(flight, changed(long_mission(40), *range(0, 40, 2)))


async def test_ardupilot_plan_changed_by_another_station() -> None:
    async with open_flight() as flight:
        mission = flight.vehicle.mission
        await mission.upload(long_mission(40))
        flight.copter.missions.replace(0, changed(long_mission(40), 30).to_items(home_is_item_0=True))
        await mission.upload(changed(long_mission(40), 3))
        assert holds(flight, changed(long_mission(40), 3))
        flight.copter.missions.replace(0, long_mission(7).to_items(home_is_item_0=True))
        await mission.upload(changed(long_mission(40), 4))
        assert holds(flight, changed(long_mission(40), 4))


async def test_plan_replaced_by_another_station_during_upload_of_changes() -> None:
    """The other station replaces the plan after the first of two items was sent."""
    async with open_flight(latency_s=0.05) as flight:
        mission = flight.vehicle.mission
        await mission.upload(long_mission(60), method="items")

        def on_ack(_: m.MissionAck) -> None:
            detach()
            flight.copter.missions.replace(0, long_mission(60).to_items(home_is_item_0=True))
            flight.wire.deliver(FrameEncoder(1, 1).encode(m.MissionAck(99, 190, Result.ACCEPTED)))

        detach = flight.vehicle.connection.bus.attach(m.MissionAck, on_ack)
        await mission.upload(changed(long_mission(60), 10, 30), method="items", verify=False)
        assert holds(flight, changed(long_mission(60), 10, 30))


async def test_plan_replaced_by_another_station_during_download_is_read_again() -> None:
    async with open_flight(latency_s=0.05) as flight:
        mission = flight.vehicle.mission
        await mission.upload(long_mission(60), method="items")

        def on_item(_: m.MissionItemInt) -> None:
            detach()
            flight.copter.missions.replace(0, changed(long_mission(60), 0).to_items(home_is_item_0=True))
            flight.wire.deliver(FrameEncoder(1, 1).encode(m.MissionAck(99, 190, Result.ACCEPTED)))

        detach = flight.vehicle.connection.bus.attach(m.MissionItemInt, on_item)
        downloaded = await mission.download(method="items")
        assert holds(flight, downloaded)


@pytest.mark.parametrize("index", [1, 28])
async def test_file_replaced_by_another_station_during_read_is_read_again(
    index: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another station, over a link of its own, replaces an item that was already read, or one that was not."""
    async with open_flight() as flight:
        await flight.vehicle.mission.upload(long_mission(30))
        open_file = MissionMount.open
        replacement = changed(long_mission(30), index).to_items(home_is_item_0=True)

        def open_and_replace(*args: Any, writing: bool) -> Any:
            handle = open_file(*args, writing=writing)
            read = handle.read

            def read_and_replace(offset: int, size: int) -> bytes:
                if offset >= 3 * 239:
                    flight.copter.missions.replace(0, replacement)
                return read(offset, size)

            monkeypatch.setattr(handle, "read", read_and_replace)
            return handle

        monkeypatch.setattr(MissionMount, "open", open_and_replace)
        downloaded = await flight.vehicle.mission.download(method="ftp")
        assert holds(flight, downloaded)
        assert downloaded[index].z == 33.0


@pytest.mark.parametrize(("replaced_after_s", "is_sent"), [(0.4, True), (1.2, False)])
async def test_plan_shortened_during_read_of_upload(replaced_after_s: float, is_sent: bool) -> None:
    """Another station, over a link of its own, shortens the plan while it is read before or after the new items."""
    async with open_flight(latency_s=0.1) as flight:
        mission = flight.vehicle.mission
        await mission.upload(long_mission(60))
        short_plan = flight.copter.missions.items(0)[:5]
        asyncio.get_running_loop().call_later(replaced_after_s, flight.copter.missions.replace, 0, short_plan)
        if is_sent:
            await mission.upload(changed(long_mission(60), 3))
            assert holds(flight, changed(long_mission(60), 3))
        else:
            with pytest.raises(VerificationFailed):
                await mission.upload(changed(long_mission(60), 3))


async def test_download_by_file_waits_for_upload_of_another_station() -> None:
    async with open_flight() as flight:
        await flight.vehicle.mission.upload(long_mission(30))
        flight.vehicle.connection.link.write(FrameEncoder(77, 191).encode(m.MissionCount(1, 1, 20)))
        with pytest.raises(OperationTimeout):
            await flight.vehicle.mission.download(method="ftp", timeout=3)


async def test_download_by_items_of_longer_new_plan_is_read_again() -> None:
    """Another station, over a link of its own, replaces the plan by a longer one."""
    async with open_flight(latency_s=0.05) as flight:
        mission = flight.vehicle.mission
        await mission.upload(long_mission(30), method="items")

        def on_item(_: m.MissionItemInt) -> None:
            detach()
            flight.copter.missions.replace(0, changed(long_mission(40), 0).to_items(home_is_item_0=True))

        detach = flight.vehicle.connection.bus.attach(m.MissionItemInt, on_item)
        downloaded = await mission.download(method="items")
        assert holds(flight, downloaded)


async def test_px4_plan_changed_by_another_station() -> None:
    async with open_px4() as flight:
        await flight.vehicle.mission.upload(long_mission(5))
        flight.px4.missions.replace(0, long_mission(6).to_items())
        await anyio.sleep(1.5)
        await flight.vehicle.mission.upload(long_mission(5))
        assert holds(flight, long_mission(5))


async def test_interrupted_upload_by_file_keeps_mission() -> None:
    """The last block of 24 items has four bytes: without it, the altitude of the last item is above sea level."""
    async with open_flight(latency_s=0.02) as flight:
        await flight.vehicle.mission.upload(long_mission(5))
        handle = flight.copter.handlers[m.FileTransferProtocol.ID]

        def lose_last_block(message: Any, *more: Any) -> None:
            request = FtpMessage.decode(bytes(message.payload))
            if (request.opcode, request.offset) != (MavFtpOpcode.WRITEFILE, 956):
                handle(message, *more)

        flight.copter.handlers[m.FileTransferProtocol.ID] = lose_last_block
        with anyio.move_on_after(2):
            await flight.vehicle.mission.upload(long_mission(24), method="ftp")
        await anyio.sleep(1)
        assert holds(flight, long_mission(5))


# ---------------------------------------------------------------------------------------- refusals


@pytest.mark.parametrize("opened", [open_flight, open_px4])
@pytest.mark.parametrize("method", ["auto", "items"])
async def test_rejected_upload_names_item_and_remains(opened: Any, method: Any) -> None:
    async with opened(latency_s=0.02) if opened is open_flight else opened() as flight:
        await flight.vehicle.mission.upload(long_mission(30))
        bad = Mission([*long_mission(17), UNKNOWN, *long_mission(4)])
        with pytest.raises(MissionRejected, match="item 17: the command is not supported") as caught:
            await flight.vehicle.mission.upload(bad, method=method)
        assert (caught.value.item, caught.value.result) == (17, Result.UNSUPPORTED)
        keeps = opened is open_px4
        assert ("still has its previous items" in str(caught.value)) == keeps
        assert ("items 0 to 16 are new now, and later items, if there are any, are old" in str(caught.value)) != keeps
        assert holds(flight, long_mission(30)) == keeps
        # A file clears ArduPilot's mission first; MISSION_COUNT cuts it.
        assert len(held_by(flight)) == (30 if keeps else 17 if method == "auto" else 22)
        await flight.vehicle.mission.upload(long_mission(30))  # it was not recorded as uploaded
        assert holds(flight, long_mission(30))


async def test_upload_by_file_without_answer_raises_mission_timeout() -> None:
    async with open_flight(latency_s=0.02) as flight:
        await flight.vehicle.mission.upload(long_mission(5))
        await flight.vehicle.mission.download()
        flight.copter.faults.silent = True
        with pytest.raises(MissionTimeout, match="whether the vehicle has the new items is unknown") as caught:
            await flight.vehicle.mission.upload(long_mission(6), only_changes=False)
        assert caught.value.missing == tuple(range(6))
        with pytest.raises(MissionTimeout):
            await flight.vehicle.mission.download()


async def test_upload_by_file_applied_before_silence_is_unknown() -> None:
    fence = Fence(circles=[FenceCircle(Position(*near_home(0)), 100)])
    async with open_flight(latency_s=0.02) as flight:
        handle = flight.copter.handlers[m.FileTransferProtocol.ID]

        def fall_silent_after_close(message: Any, *more: Any) -> None:
            flight.copter.faults.silent = (
                FtpMessage.decode(bytes(message.payload)).opcode == MavFtpOpcode.TERMINATESESSION
            )
            handle(message, *more)

        flight.copter.handlers[m.FileTransferProtocol.ID] = fall_silent_after_close
        with pytest.raises(MissionTimeout, match="whether the vehicle has the new items is unknown"):
            await flight.vehicle.fence.upload(fence)
        assert flight.copter.missions.items(1)


async def test_upload_denied_by_other_upload_does_not_mention_old_items() -> None:
    encoder = FrameEncoder(77, 191)
    async with open_flight() as flight:
        await flight.vehicle.mission.upload(long_mission(5))
        flight.vehicle.connection.link.write(encoder.encode(m.MissionCount(1, 1, 2)))
        with pytest.raises(MissionRejected, match="stored none of the new items") as caught:
            await flight.vehicle.mission.upload(long_mission(8), method="items")
        assert "previous items" not in str(caught.value)
        assert not holds(flight, long_mission(5))


async def test_rejected_first_item_is_not_called_new() -> None:
    async with open_flight() as flight:
        await flight.vehicle.mission.upload(long_mission(3))
        with pytest.raises(MissionRejected, match="no item is new, and old items may be missing"):
            await flight.vehicle.mission.upload(Mission([UNKNOWN]), method="items")
        assert holds(flight, long_mission(1))


async def test_rejected_partial_upload() -> None:
    async with open_flight() as flight:
        await flight.vehicle.mission.upload(long_mission(30))
        items = list(long_mission(30))
        items[7] = UNKNOWN
        with pytest.raises(MissionRejected, match=r"item 7.*still has its previous items") as caught:
            await flight.vehicle.mission.upload(Mission(items))
        assert caught.value.item == 7
        assert holds(flight, long_mission(30))


async def test_ignored_partial_upload_leaves_previous_items() -> None:
    async with open_flight() as flight:
        await flight.vehicle.mission.upload(long_mission(30))
        flight.copter.handlers[m.MissionWritePartialList.ID] = lambda *_: None
        with pytest.raises(MissionTimeout, match=r"no item was requested.*still has its previous items"):
            await flight.vehicle.mission.upload(changed(long_mission(30), 7), idle_timeout_s=4)


async def test_plan_cut_after_partial_upload_is_verification_failed() -> None:
    async with open_flight() as flight:
        await flight.vehicle.mission.upload(long_mission(30))

        def cut(message: Any) -> None:
            if message.type == Result.ACCEPTED:
                flight.copter.missions.replace(0, long_mission(7).to_items(home_is_item_0=True))

        flight.wire.clear()
        flight.vehicle.connection.bus.attach(m.MissionAck, cut)
        with pytest.raises(VerificationFailed) as caught:
            await flight.vehicle.mission.upload(changed(long_mission(30), 5, 6, 7))
        assert flight.wire.all(m.MissionWritePartialList)
        assert caught.value.differences[0] == "there are 7 items instead of 30"


async def test_other_item_replaced_during_partial_upload_is_verification_failed() -> None:
    """Another station, over a link of its own, replaces an item that this upload keeps."""
    async with open_flight() as flight:
        await flight.vehicle.mission.upload(long_mission(30))

        def replace(message: Any) -> None:
            if message.type == Result.ACCEPTED:
                flight.copter.missions.replace(0, changed(long_mission(30), 5, 20).to_items(home_is_item_0=True))

        flight.wire.clear()
        flight.vehicle.connection.bus.attach(m.MissionAck, replace)
        with pytest.raises(VerificationFailed) as caught:
            await flight.vehicle.mission.upload(changed(long_mission(30), 5))
        assert flight.wire.all(m.MissionWritePartialList)
        assert caught.value.differences == ("item 20 (NAV_WAYPOINT): z is 33.0 instead of 20.0",)


async def test_ambiguous_upload_without_read_back_is_unknown() -> None:
    async with open_flight(latency_s=0.02) as flight:
        handlers = flight.copter.handlers

        def refuse_last(message: m.MissionItemInt, channel: Any) -> None:
            if message.seq == 3:
                flight.copter.send(m.MissionAck(255, 190, Result.ERROR, 0))
            else:
                on_item(message, channel)

        on_item = handlers[m.MissionItemInt.ID]
        handlers[m.MissionItemInt.ID] = refuse_last
        handlers[m.MissionRequestList.ID] = lambda *_: None
        with pytest.raises(MissionTimeout, match="no MISSION_COUNT was received"):
            await flight.vehicle.mission.upload(long_mission(3), method="items", idle_timeout_s=4)
        assert flight.vehicle.mission._context.caches[0].items is None


async def test_late_ack_of_earlier_upload_does_not_confirm_lost_items() -> None:
    async with open_flight(latency_s=0.02) as flight:
        await flight.vehicle.mission.upload(long_mission(9), method="items")
        on_item = flight.copter.handlers[m.MissionItemInt.ID]

        def lose_items(message: m.MissionItemInt, channel: Any) -> None:
            if message.seq == 0:
                on_item(message, channel)
                flight.copter.send(m.MissionAck(255, 190, Result.ACCEPTED, 0))
            elif message.seq == 3:
                flight.copter.send_text(4, "No storage")

        flight.copter.handlers[m.MissionItemInt.ID] = lose_items
        other = changed(long_mission(3), 1)
        with pytest.raises(
            MissionRejected, match=r"refused the plan at about item 0.*differ from those sent"
        ) as caught:
            await flight.vehicle.mission.upload(other, method="items", only_changes=False, verify=False)
        assert not holds(flight, other)
        assert "No storage" in caught.value.reasons


@pytest.mark.parametrize("older_count", [1, 3, 4, 5, 9, 20])
@pytest.mark.parametrize("older_kind", [MavMissionType.MISSION, MavMissionType.FENCE])
async def test_px4_upload_after_lost_cancellation_of_older_upload(older_count: int, older_kind: MavMissionType) -> None:
    """PX4 waits for the first item of the older upload, and keeps its kind and number of items."""
    async with open_px4(latency_s=0.02) as flight:
        await flight.vehicle.mission.upload(long_mission(7))
        flight.vehicle.connection.send(m.MissionCount(flight.px4.system_id, 1, older_count, older_kind))
        plan, started_at = changed(long_mission(4), 1), now()
        await flight.vehicle.mission.upload(plan, verify=False)
        assert holds(flight, plan)
        assert now() - started_at < 4.0


async def test_px4_lost_cancellation_before_download_blocks_no_upload() -> None:
    async with open_px4(latency_s=0.02) as flight:
        handlers = flight.px4.handlers
        on_item, on_ack = handlers[m.MissionItemInt.ID], handlers[m.MissionAck.ID]
        handlers[m.MissionItemInt.ID] = handlers[m.MissionAck.ID] = lambda *_: None
        with anyio.move_on_after(0.5):
            await flight.vehicle.mission.upload(long_mission(7), method="items")
        await anyio.sleep(0.1)  # The cancellation arrives, and is lost.
        assert flight.px4.missions.transfer_is_open
        handlers[m.MissionItemInt.ID], handlers[m.MissionAck.ID] = on_item, on_ack
        assert await flight.vehicle.mission.download(method="items") == Mission()
        await flight.vehicle.mission.upload(long_mission(7), method="items")
        assert holds(flight, long_mission(7))


async def test_px4_silent_after_early_acceptance_may_have_first_items() -> None:
    async with open_px4(latency_s=0.02) as flight:
        await flight.vehicle.mission.upload(long_mission(7))
        flight.vehicle.connection.send(m.MissionCount(flight.px4.system_id, 1, count=3))
        on_item = flight.px4.handlers[m.MissionItemInt.ID]

        def lose_later_items(message: m.MissionItemInt, channel: Any) -> None:
            if message.seq < 3:
                on_item(message, channel)

        flight.px4.handlers[m.MissionItemInt.ID] = lose_later_items
        with pytest.raises(MissionTimeout, match="may have accepted the first items as the whole plan"):
            await flight.vehicle.mission.upload(changed(long_mission(20), 1))
        assert len(held_by(flight)) == 3


async def test_px4_silent_after_abandoned_upload_may_have_first_items() -> None:
    """PX4 takes the first items for those of the abandoned upload. Its acceptance is lost, like both cancellations."""
    async with open_px4(latency_s=0.02) as flight:
        handlers, upload = flight.px4.handlers, flight.vehicle.mission.upload
        on_item = handlers[m.MissionItemInt.ID]
        handlers[m.MissionItemInt.ID] = handlers[m.MissionAck.ID] = lambda *_: None
        with anyio.move_on_after(0.5):
            await upload(long_mission(3), method="items")

        def lose_later_items(message: m.MissionItemInt, channel: Any) -> None:
            if message.seq < 3:
                on_item(message, channel)

        handlers[m.MissionItemInt.ID] = lose_later_items
        flight.px4.faults.lose(m.MissionAck, times=100)
        with pytest.raises(MissionTimeout, match="may have accepted the first items as the whole plan"):
            await upload(changed(long_mission(20), 1), method="items")
        assert len(held_by(flight)) == 3


async def test_upload_that_cannot_be_read_back_was_confirmed() -> None:
    async with open_px4(latency_s=0.02) as flight:
        flight.px4.handlers[m.MissionRequestList.ID] = lambda *_: None
        with pytest.raises(MissionTimeout, match="all items were sent, and confirmed by the vehicle") as caught:
            await flight.vehicle.mission.upload(long_mission(9))
        assert caught.value.missing == ()
        assert holds(flight, long_mission(9))


@pytest.mark.parametrize("silence_s", [0.3, 5.0])
async def test_px4_upload_continues_after_reboot(silence_s: float) -> None:
    async with open_px4(latency_s=0.05) as flight:
        await anyio.sleep(10)  # so that the time since boot is smaller after the reboot
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(flight.vehicle.mission.upload, long_mission(60))
            await anyio.sleep(0.6)
            flight.px4.reboot(silence_s)
        assert holds(flight, long_mission(60))


async def test_too_many_items_has_the_vehicles_reasons() -> None:
    async with open_flight() as flight:
        with pytest.raises(MissionRejected, match="items are supported") as caught:
            await flight.vehicle.mission.upload(long_mission(1200), method="items")
        assert caught.value.result == Result.NO_SPACE
        assert caught.value.item is None
        assert caught.value.reasons


async def test_wrong_readback_is_verification_failed() -> None:
    async with open_flight() as flight:
        items = flight.copter.missions

        def keep_something_else(message: Any) -> None:
            if message.type == Result.ACCEPTED:
                items.replace(0, changed(long_mission(9), 5).to_items(home_is_item_0=True))

        flight.vehicle.connection.bus.attach(m.MissionAck, keep_something_else)
        with pytest.raises(VerificationFailed) as caught:
            await flight.vehicle.mission.upload(long_mission(9), method="items")
        assert caught.value.differences == ("item 5 (NAV_WAYPOINT): z is 33.0 instead of 20.0",)
        await flight.vehicle.mission.upload(long_mission(9), method="items", only_changes=False, verify=False)


async def test_mission_file_is_compared_exactly(monkeypatch: pytest.MonkeyPatch) -> None:
    """A file is compared exactly; items are not, because they are converted to 32-bit floats."""
    async with open_flight() as flight:
        items = flight.copter.missions
        replace = items.replace

        def keep_something_else(type_: int, given: Any, **options: Any) -> Any:
            return replace(type_, [item.replace(x=item.x + 3 * (item.frame == 3)) for item in given], **options)

        monkeypatch.setattr(items, "replace", keep_something_else)
        mission = long_mission(1)
        with pytest.raises(VerificationFailed) as caught:
            await flight.vehicle.mission.upload(mission, method="ftp")
        (difference,) = caught.value.differences
        assert difference == f"item 0 (NAV_WAYPOINT): x is {mission[0].x + 3} instead of {mission[0].x}"


async def test_ftp_method_with_unknown_capabilities_is_tried() -> None:
    copter = SimulatedCopter(boot_time_s=0.0)
    copter.faults.lose(m.AutopilotVersion, times=1000)
    async with open_flight(copter) as flight:
        await flight.vehicle.mission.upload(long_mission(3), method="ftp")
        assert holds(flight, long_mission(3))


async def test_ftp_method_without_mavftp_is_not_supported() -> None:
    copter = SimulatedCopter(boot_time_s=0.0)
    copter.faults.no_ftp = True
    async with open_flight(copter) as flight:
        with pytest.raises(NotSupported, match="no file transfer; nothing was sent"):
            await flight.vehicle.mission.upload(long_mission(3), method="ftp")
        await flight.vehicle.mission.upload(long_mission(3))
        assert holds(flight, long_mission(3))


@pytest.mark.parametrize(
    ("plan", "options", "text"),
    [
        (Mission([MissionItem(16, 77)]), {}, "frame"),
        (Mission([MissionItem(16, 3, param1=math.nan)]), {}, "param1"),
        (Mission([MissionItem(16, 3, x=910_000_000)]), {}, "latitude"),
        (Fence(circles=[FenceCircle(Position(47, 8), 10)]), {}, "plan"),
        ([MissionItem(16, 3)], {}, "plan"),
        (long_mission(2), {"method": "ftpp"}, "method"),
        (long_mission(2), {"idle_timeout_s": 0}, "idle_timeout_s"),
        (long_mission(2), {"timeout": -1.0}, "timeout"),
    ],
)
async def test_invalid_plan_is_not_sent(plan: Any, options: dict[str, Any], text: str) -> None:
    async with open_flight() as flight:
        flight.wire.clear()
        with pytest.raises(InvalidArgument, match=text):
            await flight.vehicle.mission.upload(plan, **options)
        assert sent_for_plans(flight.wire) == []


async def test_invalid_plan_is_refused_without_waiting() -> None:
    async with open_flight(latency_s=0.2) as flight, anyio.create_task_group() as tasks:
        tasks.start_soon(flight.vehicle.mission.upload, long_mission(40))
        await anyio.sleep(1.0)
        begin = now()
        with pytest.raises(InvalidArgument, match="idle_timeout_s = -1 is not allowed"):
            await flight.vehicle.mission.upload(long_mission(2), idle_timeout_s=-1)
        assert now() == begin


# --------------------------------------------------------------------------- concurrency and cancellation


async def test_transfers_are_serialized() -> None:
    async with open_px4() as flight:
        vehicle = flight.vehicle
        fence = Fence(circles=[FenceCircle(Position(*near_home(0)), 300.0)])
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(vehicle.mission.upload, long_mission(40))
            tasks.start_soon(vehicle.fence.upload, fence)
            tasks.start_soon(vehicle.mission.upload, long_mission(7))
        assert holds(flight, long_mission(7))
        assert len(flight.px4.missions.items(1)) == 1
    async with open_flight() as other:
        async with anyio.create_task_group() as tasks:
            for count in (40, 7):
                tasks.start_soon(other.vehicle.mission.upload, long_mission(count))
        assert holds(other, long_mission(7))


@pytest.mark.sampled(3)
@pytest.mark.parametrize("opened", [open_flight, open_px4])
@pytest.mark.parametrize("after_s", [0.0, 0.05, 0.13, 0.2])
async def test_upload_cancelled_half_way(opened: Any, after_s: float) -> None:
    async with opened(latency_s=0.02) if opened is open_flight else opened() as flight:
        with anyio.move_on_after(after_s):
            await flight.vehicle.mission.upload(long_mission(100), method="items")
        await flight.vehicle.mission.upload(long_mission(8), method="items")
        assert holds(flight, long_mission(8))
        with anyio.move_on_after(after_s):
            await flight.vehicle.mission.download(method="items")
        assert long_mission(8).matches(await flight.vehicle.mission.download(method="items"))
        vehicle = flight.copter if isinstance(flight, Flight) else flight.px4
        assert not vehicle.missions.transfer_is_open


async def test_cancelled_upload_is_cancelled_on_the_vehicle() -> None:
    async with open_flight(latency_s=0.05) as flight:
        with pytest.raises(OperationTimeout, match=r"not done within 0\.4 s"):
            await flight.vehicle.mission.upload(long_mission(100), method="items", timeout=0.4)
        assert flight.wire.last(m.MissionAck).type == Result.OPERATION_CANCELLED


async def test_silent_vehicle_times_out() -> None:
    async with open_flight() as flight:
        await flight.vehicle.mission.upload(long_mission(5))
        flight.copter.faults.silent = True
        with pytest.raises(
            MissionTimeout, match=r"no item was requested.*last heartbeat.*if the vehicle received the request"
        ):
            await flight.vehicle.mission.upload(long_mission(9), method="items", idle_timeout_s=4)
        with pytest.raises(MissionTimeout, match="no MISSION_COUNT was received"):
            await flight.vehicle.mission.download(method="items", idle_timeout_s=4)
        with pytest.raises(MissionTimeout, match="may have cleared it"):
            await flight.vehicle.mission.clear(idle_timeout_s=4)


async def test_block_exit_ends_transfers() -> None:
    async with open_flight() as flight:
        mission = flight.vehicle.mission
    with pytest.raises(ConnectionClosed):
        await mission.upload(long_mission(3))
    with pytest.raises(ConnectionClosed):
        await mission.current.wait_until(lambda _: True)


async def test_first_request_after_slow_timesync_is_repeated() -> None:
    copter = SimulatedCopter(boot_time_s=0.0)
    answer_time, answer_list = copter.handlers[m.Timesync.ID], copter.handlers[m.MissionRequestList.ID]
    copter.handlers[m.Timesync.ID] = lambda *request: copter.call_later(8.0, lambda: answer_time(*request))

    def lose_once(*_: object) -> None:
        copter.handlers[m.MissionRequestList.ID] = answer_list

    copter.handlers[m.MissionRequestList.ID] = lose_once
    async with open_flight(copter) as flight:
        await anyio.sleep(20.0)
        await flight.vehicle.mission.download(method="items")
