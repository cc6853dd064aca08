"""Abandoned arm commands: monitoring afterwards, and armings that are left alone."""

from __future__ import annotations

import asyncio

import anyio
import pytest
from flight_harness import Flight, open_flight, open_px4, suspend_computer

from aerokit.errors import AerokitError, CommandTimeout, OperationRejected, OperationTimeout
from aerokit.mavlink import FrameEncoder
from aerokit.mavlink.enums import CopterMode, MavCmd, MavResult
from aerokit.mavlink.messages import CommandAck, Heartbeat
from aerokit.sim import SimulatedCopter, SimulatedPx4

ARM_WATCH_S = 15.0

pytestmark = pytest.mark.anyio

ARM = MavCmd.COMPONENT_ARM_DISARM


def ordered(flight: Flight) -> list[float]:
    """1 for each order to arm that was sent, 0 for each to disarm."""
    return [command.param1 for command in flight.wire.commands(ARM)]


async def test_arming_after_abandoned_order_is_undone(grounded: Flight) -> None:
    await grounded.vehicle.set_mode("GUIDED")
    with anyio.move_on_after(0.0):
        await grounded.vehicle.arm()
    await anyio.sleep(5.0)
    assert ordered(grounded) == [1, 0]
    assert not grounded.copter.is_armed


async def test_late_arming_counts_only_later_reports(grounded: Flight) -> None:
    await grounded.vehicle.set_mode("GUIDED")
    grounded.copter.faults.lose_ack(ARM)
    scope = anyio.CancelScope()
    detach = grounded.vehicle.armed.observe(lambda _, armed: scope.cancel())
    with scope:
        await grounded.vehicle.arm()
    assert scope.cancelled_caught
    detach()
    assert grounded.vehicle.is_armed
    grounded.copter.arming.disarm()  # Another party disarms the vehicle before the next HEARTBEAT.
    await anyio.sleep(5.0)
    assert ordered(grounded) == [1]


@pytest.mark.parametrize("ends", ["cancelled", "unanswered"])
async def test_vehicle_armed_before_order_stays_armed(flying: Flight, ends: str) -> None:
    """A flying vehicle was not armed by this order."""
    if ends == "cancelled":
        with anyio.move_on_after(0.0):
            await flying.vehicle.arm()
    else:
        flying.copter.faults.ignore(ARM)
        with pytest.raises(CommandTimeout):
            await flying.vehicle.arm()
    await anyio.sleep(20.0)
    assert ordered(flying).count(0) == 0


async def test_late_disarm_continues_after_watch_time(grounded: Flight) -> None:
    """The vehicle arms at the last moment, and the first disarm command is lost."""
    await grounded.vehicle.set_mode("GUIDED")
    grounded.copter.faults.ignore(ARM)
    reported_at = grounded.vehicle.armed.updated_at
    await grounded.vehicle.armed.wait_until(lambda _: grounded.vehicle.armed.updated_at > reported_at)
    await anyio.sleep(0.7)  # of the second from one heartbeat to the next
    with anyio.move_on_after(0.0):
        await grounded.vehicle.arm()
    (order,) = grounded.wire.commands(ARM)
    await anyio.sleep(ARM_WATCH_S - 1.0)
    grounded.copter.faults.commands.clear()
    grounded.wire._link.write(FrameEncoder(255, 190).encode(order))
    await anyio.sleep(0.1)
    grounded.copter.faults.ignore(ARM)
    await anyio.sleep(1.0)
    assert grounded.vehicle.is_armed
    assert ordered(grounded) == [1, 0]
    grounded.copter.faults.commands.clear()
    await anyio.sleep(3.0)
    assert ordered(grounded) == [1, 0, 0]
    assert not grounded.copter.is_armed


async def test_failed_late_disarm_logs_error(grounded: Flight, caplog: pytest.LogCaptureFixture) -> None:
    await grounded.vehicle.set_mode("GUIDED")
    with anyio.move_on_after(0.0):
        await grounded.vehicle.arm()
    await grounded.vehicle.armed.wait_until(bool, timeout=5)
    grounded.copter.faults.refuse(ARM, MavResult.FAILED)
    await anyio.sleep(5.0)
    (record,) = [record for record in caplog.records if record.levelname == "ERROR"]
    assert "an abandoned arm command has armed the vehicle, and it could not be disarmed" in record.message
    assert grounded.copter.is_armed


async def test_pilot_arming_after_mode_change_stays_armed(grounded: Flight, caplog: pytest.LogCaptureFixture) -> None:
    """The pilot's mode change has ended the call, and the arm command was lost."""
    grounded.copter.parameters["DISARM_DELAY"] = 0.0
    await grounded.vehicle.set_mode("GUIDED")
    grounded.copter.faults.ignore(ARM)
    asyncio.get_running_loop().call_later(0.5, grounded.copter.set_mode, CopterMode.STABILIZE)
    with pytest.raises(OperationRejected, match="mode changed to STABILIZE"):
        await grounded.vehicle.arm()
    await anyio.sleep(0.3)
    assert grounded.copter.arming.arm()
    await anyio.sleep(ARM_WATCH_S)
    assert grounded.copter.is_armed
    assert ordered(grounded) == [1]
    assert "it stays armed, because another party may have armed it" in caplog.text


async def test_pilot_arming_after_mode_change_after_cancellation_stays_armed(grounded: Flight) -> None:
    """The arm command was lost, and the next HEARTBEAT reports both actions of the pilot."""
    grounded.copter.parameters["DISARM_DELAY"] = 0.0
    await grounded.vehicle.set_mode("GUIDED")
    grounded.copter.faults.ignore(ARM)
    with anyio.move_on_after(0.1):
        await grounded.vehicle.arm()
    grounded.copter.faults.commands.clear()
    grounded.copter.set_mode(CopterMode.STABILIZE)
    assert grounded.copter.arming.arm()
    await anyio.sleep(ARM_WATCH_S)
    assert grounded.copter.is_armed
    assert ordered(grounded) == [1]


async def test_pilot_arming_while_computer_slept_stays_armed(grounded: Flight) -> None:
    """The arm command was lost. By the loop's clock, the next HEARTBEAT follows within a second."""
    await grounded.vehicle.set_mode("GUIDED")
    grounded.copter.faults.ignore(ARM)
    with anyio.move_on_after(0.1):
        await grounded.vehicle.arm()
    assert ordered(grounded) == [1]
    suspend_computer(grounded.vehicle, 600.0)
    assert grounded.copter.arming.arm()
    grounded.copter.faults.commands.clear()
    await anyio.sleep(ARM_WATCH_S)
    assert ordered(grounded) == [1]


async def test_pilot_arming_later_by_sticks_stays_armed(grounded: Flight) -> None:
    await grounded.vehicle.set_mode("STABILIZE")
    grounded.copter.parameters["DISARM_DELAY"] = 0.0
    grounded.copter.faults.ignore(ARM)
    with anyio.move_on_after(0.1):
        await grounded.vehicle.arm()
    await anyio.sleep(3.0)
    assert grounded.copter.arming.arm()
    await anyio.sleep(ARM_WATCH_S)
    assert grounded.copter.is_armed
    assert ordered(grounded) == [1]


async def test_late_accepted_arm_is_undone(grounded: Flight) -> None:
    """The late ack shows that this program armed the vehicle."""
    await grounded.vehicle.set_mode("GUIDED")
    grounded.copter.faults.ignore(ARM)
    with anyio.move_on_after(0.1):
        await grounded.vehicle.arm()
    (order,) = grounded.wire.commands(ARM)
    await anyio.sleep(6.0)
    grounded.copter.faults.commands.clear()
    grounded.wire._link.write(FrameEncoder(255, 190).encode(order))
    await anyio.sleep(5.0)
    assert ordered(grounded) == [1, 0]
    assert not grounded.copter.is_armed


@pytest.mark.parametrize("kind", ["copter", "px4"])
async def test_arm_is_not_repeated_after_pilot_disarmed(kind: str) -> None:
    """The pilot disarms between two HEARTBEATs, which both report disarmed; the ack was lost."""
    async with open_flight() if kind == "copter" else open_px4() as flight:
        await flight.vehicle.wait_ready()
        simulated = flight.copter if isinstance(flight, Flight) else flight.px4
        beat_at = flight.vehicle.armed.updated_at
        await flight.vehicle.armed.wait_until(lambda _: flight.vehicle.armed.updated_at > beat_at)
        simulated.faults.lose_ack(ARM)
        asyncio.get_running_loop().call_later(0.4, disarm, simulated)
        with pytest.raises(AerokitError):
            await flight.vehicle.arm()
        await anyio.sleep(ARM_WATCH_S)
        assert [command.param1 for command in flight.wire.commands(ARM)] == [1]
        assert not simulated.is_armed


def disarm(simulated: SimulatedCopter | SimulatedPx4) -> None:
    if isinstance(simulated, SimulatedCopter):
        simulated.arming.disarm()
    else:
        simulated.arming.disarm("the pilot")


async def test_pilot_disarming_and_arming_later_stays_armed(grounded: Flight) -> None:
    """Our command armed the vehicle, but the pilot disarmed it before a HEARTBEAT reported that."""
    await grounded.vehicle.set_mode("STABILIZE")
    grounded.copter.parameters["DISARM_DELAY"] = 0.0
    reported_at = grounded.vehicle.armed.updated_at
    await grounded.vehicle.armed.wait_until(lambda _: grounded.vehicle.armed.updated_at > reported_at)
    asyncio.get_running_loop().call_later(0.3, grounded.copter.arming.disarm)
    with anyio.move_on_after(0.2):
        await grounded.vehicle.arm()
    await anyio.sleep(6.0)
    assert grounded.copter.arming.arm()
    await anyio.sleep(ARM_WATCH_S)
    assert grounded.copter.is_armed
    assert ordered(grounded) == [1]


async def test_ack_naming_other_station_proves_nothing(grounded: Flight) -> None:
    """A MAVLink 1 ack names no station: it may answer another station's command."""
    await grounded.vehicle.set_mode("STABILIZE")
    grounded.copter.parameters["DISARM_DELAY"] = 0.0
    grounded.copter.faults.ignore(ARM)
    with anyio.move_on_after(0.1):
        await grounded.vehicle.arm()
    await anyio.sleep(6.0)
    assert grounded.copter.arming.arm()
    grounded.wire.deliver(FrameEncoder(1, 1).encode(CommandAck(ARM, 0, 0, 0, 0, 0)))
    await anyio.sleep(ARM_WATCH_S)
    assert grounded.copter.is_armed
    assert ordered(grounded) == [1]


async def test_arming_after_watch_time_is_left_alone(grounded: Flight) -> None:
    await grounded.vehicle.set_mode("GUIDED")
    grounded.copter.faults.ignore(ARM)
    with anyio.move_on_after(0.0):
        await grounded.vehicle.arm()
    (order,) = grounded.wire.commands(ARM)
    await anyio.sleep(ARM_WATCH_S + 2.0)
    grounded.copter.faults.commands.clear()
    grounded.wire._link.write(FrameEncoder(255, 190).encode(order))
    await anyio.sleep(6.0)
    assert grounded.copter.is_armed
    assert ordered(grounded) == [1]


@pytest.mark.parametrize(("ack_delay_s", "is_undone"), [(2.5, True), (4.5, False)])
async def test_late_arming_is_undone_only_with_timely_ack(
    grounded: Flight, ack_delay_s: float, is_undone: bool
) -> None:
    """Without an ack, arming seconds after the order may be the pilot's."""
    await grounded.vehicle.set_mode("GUIDED")
    grounded.copter.faults.ignore(ARM)
    with anyio.move_on_after(0.0):
        await grounded.vehicle.arm()
    (order,) = grounded.wire.commands(ARM)
    await anyio.sleep(5.0)
    grounded.copter.faults.delay_ack(ARM, ack_delay_s)
    grounded.wire._link.write(FrameEncoder(255, 190).encode(order))
    await anyio.sleep(8.0)
    assert ordered(grounded) == ([1, 0] if is_undone else [1])
    assert grounded.copter.is_armed is not is_undone


async def test_pilot_arming_after_accepted_order_without_effect_stays_armed(
    grounded: Flight, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The pilot arms right after the call has ended, before another HEARTBEAT reports disarmed."""
    grounded.copter.parameters["DISARM_DELAY"] = 0.0
    await grounded.vehicle.set_mode("GUIDED")
    with monkeypatch.context() as patch:
        patch.setattr(grounded.copter.arming, "arm", lambda **_: True)
        with pytest.raises(OperationTimeout):
            await grounded.vehicle.arm(timeout=5.0)
    assert grounded.copter.arming.arm()
    await anyio.sleep(ARM_WATCH_S)
    assert ordered(grounded) == [1]
    assert grounded.copter.is_armed


async def late_arming(flight: Flight) -> None:
    """Abandon an arm command, and arm the vehicle by it five seconds later without an acknowledgement."""
    flight.copter.parameters["DISARM_DELAY"] = 0.0
    await flight.vehicle.set_mode("GUIDED")
    flight.copter.faults.ignore(ARM)
    with anyio.move_on_after(0.0):
        await flight.vehicle.arm()
    await anyio.sleep(5.0)
    flight.copter.faults.commands.clear()


async def test_vehicle_disarmed_and_armed_by_pilot_before_ack_stays_armed(grounded: Flight) -> None:
    await late_arming(grounded)
    assert grounded.copter.arming.arm()
    await grounded.vehicle.armed.wait_until(bool)
    grounded.copter.arming.disarm()
    await grounded.vehicle.armed.wait_until(lambda armed: not armed)
    grounded.wire.deliver(FrameEncoder(1, 1).encode(CommandAck(ARM, 0, 0, 0, 255, 190)))
    assert grounded.copter.arming.arm()
    await anyio.sleep(ARM_WATCH_S)
    assert ordered(grounded) == [1]
    assert grounded.copter.is_armed


async def test_raw_arm_command_while_ack_is_awaited_stays_armed(grounded: Flight) -> None:
    await late_arming(grounded)
    assert grounded.copter.arming.arm()
    await grounded.vehicle.armed.wait_until(bool)
    await grounded.vehicle.command(ARM, 1.0)
    await anyio.sleep(ARM_WATCH_S)
    assert ordered(grounded) == [1, 1]
    assert grounded.copter.is_armed


async def test_cancelled_arm_leaves_vehicle_to_newer_arm(grounded: Flight) -> None:
    grounded.copter.parameters["DISARM_DELAY"] = 0.0
    await grounded.vehicle.set_mode("GUIDED")
    async with anyio.create_task_group() as tasks:
        older = asyncio.create_task(grounded.vehicle.arm())
        await anyio.sleep(0.01)
        tasks.start_soon(grounded.vehicle.arm)
        await anyio.sleep(0.01)
        older.cancel()
    await anyio.sleep(ARM_WATCH_S)
    assert ordered(grounded) == [1, 1]
    assert grounded.copter.is_armed


@pytest.mark.parametrize("is_newer_sent", [True, False])
async def test_cancelled_arm_leaves_vehicle_to_older_arm(grounded: Flight, is_newer_sent: bool) -> None:
    grounded.copter.parameters["DISARM_DELAY"] = 0.0
    await grounded.vehicle.set_mode("GUIDED")
    if not is_newer_sent:  # The command of the newer call waits until that of the older call is answered.
        grounded.copter.faults.lose_ack(ARM)
    older = asyncio.create_task(grounded.vehicle.arm())
    await anyio.sleep(0.01)
    with anyio.move_on_after(0.01):
        await grounded.vehicle.arm()
    await older
    await anyio.sleep(ARM_WATCH_S)
    assert ordered(grounded) == ([1, 1] if is_newer_sent else [1])
    assert grounded.copter.is_armed


async def test_two_cancelled_arms_are_undone(grounded: Flight) -> None:
    await grounded.vehicle.set_mode("GUIDED")
    older = asyncio.create_task(grounded.vehicle.arm())
    await anyio.sleep(0.01)
    with anyio.move_on_after(0.01):
        await grounded.vehicle.arm()
    older.cancel()
    await anyio.sleep(5.0)
    assert ordered(grounded) == [1, 1, 0]
    assert not grounded.copter.is_armed


async def test_arming_by_two_cancelled_orders_is_undone(grounded: Flight) -> None:
    await grounded.vehicle.set_mode("GUIDED")
    grounded.copter.faults.lose_ack(ARM)
    calls = [asyncio.create_task(grounded.vehicle.arm()) for _ in range(2)]
    await anyio.sleep(0.01)
    for call in calls:
        call.cancel()
    await anyio.sleep(5.0)
    assert ordered(grounded) == [1, 0]
    assert not grounded.copter.is_armed


async def test_abandoned_arming_before_newer_mode_is_undone(grounded: Flight) -> None:
    await grounded.vehicle.set_mode("GUIDED")
    grounded.copter.faults.lose_ack(ARM)
    with anyio.move_on_after(0.0):
        await grounded.vehicle.arm()
    await grounded.vehicle.set_mode("LOITER")
    await anyio.sleep(5.0)
    assert ordered(grounded) == [1, 0]
    assert not grounded.copter.is_armed


@pytest.mark.parametrize("is_abandoned", [True, False])
async def test_disarm_is_repeated_after_answer_to_earlier_arm(grounded: Flight, is_abandoned: bool) -> None:
    """A link that duplicates frames makes the vehicle answer the command to arm twice."""
    vehicle, copter = grounded.vehicle, grounded.copter
    await vehicle.set_mode("GUIDED")
    if is_abandoned:
        with anyio.move_on_after(0.0):
            await vehicle.arm()
    else:
        await vehicle.arm()
    copter.faults.ignore(ARM, times=1)
    async with anyio.create_task_group() as tasks:
        if not is_abandoned:
            tasks.start_soon(vehicle.disarm)
        while 0 not in ordered(grounded):  # noqa: ASYNC110
            await anyio.sleep(0.01)
        copter.send(CommandAck(ARM, MavResult.ACCEPTED, target_system=255, target_component=190))
        await anyio.sleep(4.0)
    assert ordered(grounded) == [1, 0, 0]
    assert not copter.is_armed


@pytest.mark.parametrize("arm", ["undone", "cancelled", "awaited"])
async def test_disarm_before_answers_to_earlier_arm_is_repeated(grounded: Flight, arm: str) -> None:
    """The first command to disarm is lost. A link that duplicates frames delivers both answers to the arm after it."""
    vehicle, copter = grounded.vehicle, grounded.copter
    copter.parameters["DISARM_DELAY"] = 0.0
    await vehicle.set_mode("GUIDED")
    copter.faults.lose_ack(ARM)
    arming = asyncio.create_task(vehicle.arm())
    await anyio.sleep(0.05)
    assert copter.is_armed
    copter.faults.commands.clear()
    copter.faults.ignore(ARM, times=1)
    if arm != "awaited":
        arming.cancel()
    disarming = None if arm == "undone" else asyncio.create_task(vehicle.disarm())
    while 0 not in ordered(grounded):  # noqa: ASYNC110
        await anyio.sleep(0.01)
    for _ in range(2):
        copter.send(CommandAck(ARM, MavResult.ACCEPTED, target_system=255, target_component=190))
    await anyio.sleep(4.0)
    assert ordered(grounded) == [1, 0, 0]
    assert not grounded.copter.is_armed
    await asyncio.gather(arming, *([disarming] if disarming else []), return_exceptions=True)


async def test_heartbeat_from_before_arming_does_not_report_disarming(grounded: Flight) -> None:
    """The command to disarm is lost. A HEARTBEAT from before the arming and both answers to the arm arrive after it."""
    vehicle, copter = grounded.vehicle, grounded.copter
    copter.parameters["DISARM_DELAY"] = 0.0
    await vehicle.set_mode("GUIDED")
    old_heartbeat = copter.build(Heartbeat.ID)
    assert old_heartbeat is not None
    copter.faults.lose_ack(ARM)
    arming = asyncio.create_task(vehicle.arm())
    await anyio.sleep(0.05)
    copter.faults.commands.clear()
    copter.faults.ignore(ARM, times=1)
    disarming = asyncio.create_task(vehicle.disarm())
    while 0 not in ordered(grounded):  # noqa: ASYNC110
        await anyio.sleep(0.01)
    copter.send(old_heartbeat)
    for _ in range(2):
        copter.send(CommandAck(ARM, MavResult.ACCEPTED, target_system=255, target_component=190))
    await disarming
    assert not copter.is_armed
    await asyncio.gather(arming, return_exceptions=True)


async def after_heartbeat(flight: Flight) -> None:
    """Wait for the next HEARTBEAT."""
    armed = flight.vehicle.armed
    reported_at = armed.updated_at
    await armed.wait_until(lambda _: armed.updated_at > reported_at)


@pytest.mark.parametrize("first", ["arm", "disarm"])
async def test_acknowledged_arm_command_ends_with_opposite_one(grounded: Flight, first: str) -> None:
    """No HEARTBEAT is received between the two orders of the program."""
    vehicle = grounded.vehicle
    await vehicle.set_mode("GUIDED")
    if first == "disarm":
        await vehicle.arm()
    await after_heartbeat(grounded)
    orders = [vehicle.arm, vehicle.disarm] if first == "arm" else [vehicle.disarm, vehicle.arm]
    older = asyncio.create_task(orders[0]())
    await anyio.sleep(0.2)
    assert grounded.copter.is_armed is (first == "arm")
    await orders[1]()
    with pytest.raises(OperationRejected, match="another order was given"):
        await older
    await anyio.sleep(5.0)
    assert ordered(grounded)[-2:] == ([1, 0] if first == "arm" else [0, 1])
    assert grounded.copter.is_armed is (first == "disarm")


@pytest.mark.parametrize("timeout", [0.5, 10.0])
async def test_acknowledged_disarm_keeps_later_arming_of_pilot(grounded: Flight, timeout: float) -> None:
    """The pilot arms again before a HEARTBEAT reports disarmed. The program armed long before."""
    vehicle, copter = grounded.vehicle, grounded.copter
    copter.parameters["DISARM_DELAY"] = 0.0
    await vehicle.set_mode("GUIDED")
    await vehicle.arm()
    await anyio.sleep(10.0)
    await after_heartbeat(grounded)
    asyncio.get_running_loop().call_later(0.3, copter.arming.arm)
    with pytest.raises(OperationTimeout):
        await vehicle.disarm(timeout=timeout)
    assert ordered(grounded) == [1, 0]
    assert copter.is_armed
