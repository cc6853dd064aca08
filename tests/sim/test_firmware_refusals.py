"""Simulated vehicles refuse, ignore and disconnect as real firmware does, so that programs that pass here also fly."""

from __future__ import annotations

import asyncio
import itertools

import pytest
from for_each import for_each
from simulated_client import Client, flying_copter, ready_copter

from aerokit.mavlink import messages as m
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import CopterMode, MavCmd, MavFrame, MavModeFlag, MavMountMode, MavResult, MavType
from aerokit.mavlink.framer import Framer
from aerokit.sim import SimulatedCopter, SimulatedPx4, open_simulator
from aerokit.sim.kinds import scale_timeouts

ARM = MavCmd.COMPONENT_ARM_DISARM
NAN = float("nan")
INT32_MAX = 0x7FFFFFFF
STATION = m.Heartbeat(MavType.GCS, 8, 0, 0, 4, 3)
ONBOARD = m.Heartbeat(MavType.ONBOARD_CONTROLLER, 8, 0, 0, 4, 3)


def ready_px4(**options: object) -> tuple[SimulatedPx4, Client]:
    px4 = SimulatedPx4(fast_rate_hz=2.0, boot_time_s=1.0, parameter_count=100, **options)  # type: ignore[arg-type]
    client = Client(px4)
    client.run(2.0)
    client.clear()
    return px4, client


def flying_px4() -> tuple[SimulatedPx4, Client]:
    px4, client = ready_px4()
    assert client.command(MavCmd.NAV_TAKEOFF, 0, 0, 0, NAN, NAN, NAN, NAN) == 0
    assert client.command(ARM, 1) == 0
    client.run_until(lambda: not px4.is_landed, 40.0)
    client.clear()
    return px4, client


# ------------------------------------------------------------------------------------------------ PX4

COMMANDS = (MavCmd.DO_REPOSITION, ARM, MavCmd.DO_SET_HOME, 31999)
OTHER_FRAMES = [frame for frame in MavFrame if frame != MavFrame.GLOBAL_INT]


@for_each("command, frame", list(itertools.product(COMMANDS, OTHER_FRAMES)))
def test_px4_command_int_needs_frame_global_int(command: int, frame: int) -> None:
    px4, client = ready_px4()
    assert client.command_int(command, frame, 1, 1) == MavResult.COMMAND_UNSUPPORTED_MAV_FRAME
    assert not px4.is_armed
    assert client.command_int(31999, MavFrame.GLOBAL_INT) == MavResult.UNSUPPORTED


def test_px4_1_16_accepts_command_int_in_any_frame() -> None:
    px4, client = ready_px4(version="1.16.1")
    assert client.command_int(ARM, MavFrame.GLOBAL, 1) == MavResult.ACCEPTED
    assert px4.is_armed


def test_px4_invalid_position_encoding_is_denied() -> None:
    _, client = ready_px4()
    nan, reposition = 0x7FF80000, MavCmd.DO_REPOSITION
    assert client.command_int(reposition, 5, -1, 1, x=nan, y=nan) == MavResult.DENIED
    assert client.command(reposition, -1, 1, 0, NAN, INT32_MAX, INT32_MAX, NAN) == MavResult.DENIED
    next_float = 2.0**31 + 256  # The firmware also refuses the floats next to INT32_MAX.
    assert client.command(reposition, -1, 1, 0, NAN, next_float, next_float, NAN) == MavResult.DENIED
    assert client.command_int(reposition, 5, -1, 1, x=INT32_MAX, y=INT32_MAX, z=NAN) == MavResult.ACCEPTED


class Port:
    """One of several links of a vehicle; it sends nothing itself."""

    def __init__(self, px4: SimulatedPx4, *, is_first: bool = False) -> None:
        self.px4 = px4
        self.channel = px4.channels[0] if is_first else px4.open_channel()
        self.framer = Framer()

    def send(self, message: m.Heartbeat) -> None:
        data = FrameEncoder(255, 190).encode(message)
        self.px4.receive(data, self.px4.now, channel=self.channel)

    def texts(self) -> list[str]:
        decoded = map(STANDARD.decode, self.framer.receive(self.channel.take_outbox(), self.px4.now))
        return [message.text.strip() for message in decoded if isinstance(message, m.Statustext)]


def test_px4_texts_go_only_to_links_with_a_ground_station() -> None:
    px4 = SimulatedPx4(boot_time_s=0.0, parameter_count=100)
    ports = [Port(px4, is_first=True), Port(px4), Port(px4)]
    px4.step(10.0)
    for port in ports:
        port.texts()
    ports[1].send(STATION)
    ports[1].texts()
    ports[2].send(ONBOARD)
    px4.info("a text")
    px4.step(10.1)
    assert [port.texts() for port in ports] == [[], ["a text"], []]


def test_px4_queues_eight_texts_for_five_seconds() -> None:
    px4 = SimulatedPx4(boot_time_s=0.0, parameter_count=100)
    port = Port(px4, is_first=True)
    px4.step(10.0)
    px4.info("too old")
    px4.step(13.0)
    for number in range(10):
        px4.info(f"text {number}")
    px4.step(15.5)
    port.send(STATION)
    assert port.texts() == [f"text {number}" for number in range(2, 10)]
    px4.step(18.5)
    px4.info("the station is silent")
    px4.step(19.0)
    assert port.texts() == []


def test_px4_in_fast_simulation_keeps_texts_for_slow_station() -> None:
    """At ten times real speed, the heartbeats of a station are ten simulated seconds apart."""
    px4 = SimulatedPx4(boot_time_s=0.0, parameter_count=100)
    scale_timeouts([px4], 10.0)
    port = Port(px4, is_first=True)
    port.send(STATION)
    px4.step(9.0)
    px4.info("a text")
    px4.step(9.1)
    assert port.texts()[-1] == "a text"


@pytest.mark.parametrize("action", range(5))
def test_px4_storage_is_refused_while_armed(action: int) -> None:
    _, client = ready_px4()
    assert client.command(MavCmd.PREFLIGHT_STORAGE, action) == MavResult.ACCEPTED
    assert client.command(MavCmd.PREFLIGHT_STORAGE, 9) is None
    client.command(ARM, 1)
    assert client.command(MavCmd.PREFLIGHT_STORAGE, action) == MavResult.TEMPORARILY_REJECTED


@pytest.mark.parametrize(
    ("function", "result"), [(1, 0), (12, 0), (13, None), (33, 0), (41, None), (1101, 0), (0, None)]
)
def test_px4_actuator_test_is_denied_while_armed(function: int, result: int | None) -> None:
    _, client = ready_px4()
    assert client.command(MavCmd.ACTUATOR_TEST, 0, 1, 0, 0, function) == result
    client.command(ARM, 1)
    assert client.command(MavCmd.ACTUATOR_TEST, 0, 1, 0, 0, function) == MavResult.DENIED


def test_px4_answers_broadcast_pings_only() -> None:
    px4, client = ready_px4()
    for target in ((1, 1), (1, 0), (0, 1)):
        client.send(m.Ping(99, 7, *target))
    assert [ping for ping in client.all(m.Ping) if ping.target_system] == []
    client.send(m.Ping(99, 8, 0, 0))
    (pong,) = [ping for ping in client.all(m.Ping) if ping.target_system]
    assert (pong.time_usec, pong.seq, pong.target_system, pong.target_component) == (99, 8, 255, 190)
    assert px4.is_ready


# ---------------------------------------------------------------------------------------- ArduCopter


def test_copter_motor_test_in_the_air_is_refused() -> None:
    copter, client = flying_copter()
    assert client.command(MavCmd.DO_MOTOR_TEST, 1, 0, 10, 2) == MavResult.FAILED
    client.run(0.1)
    assert client.texts == ["Motor Test: vehicle not landed"]
    assert copter.is_armed


def test_copter_motor_test_arms_for_its_duration() -> None:
    copter, client = ready_copter()
    assert client.command(MavCmd.DO_MOTOR_TEST, 1, 0, 10, 2, 2) == MavResult.ACCEPTED
    client.run(4.5)
    assert client.last(m.Heartbeat).base_mode & MavModeFlag.SAFETY_ARMED
    assert client.command(MavCmd.PREFLIGHT_REBOOT_SHUTDOWN, 1) == MavResult.FAILED
    client.run(2.0)
    assert not client.last(m.Heartbeat).base_mode & MavModeFlag.SAFETY_ARMED
    assert client.texts == ["starting motor test", "finished motor test"]
    assert not copter.is_armed


def test_copter_motor_test_with_too_much_throttle_ends_at_once() -> None:
    copter, client = ready_copter()
    assert client.command(MavCmd.DO_MOTOR_TEST, 1, 0, 101, 2) == MavResult.ACCEPTED
    client.run(0.1)
    assert client.texts == ["starting motor test", "finished motor test"]
    assert not copter.is_armed


def test_copter_without_gps_cannot_arm_in_position_modes() -> None:
    copter, client = ready_copter()
    client.send(m.ParamSet(1, 1, "SIM_GPS1_ENABLE", 0.0, 2))
    client.run(1.0)
    client.command(MavCmd.DO_SET_MODE, 1, CopterMode.GUIDED)
    assert client.command(ARM, 1) == MavResult.FAILED
    client.run(0.1)
    assert "Arm: GPS 1: Bad fix" in client.texts
    client.command(MavCmd.DO_SET_MODE, 1, CopterMode.STABILIZE)
    assert client.command(ARM, 1) == MavResult.ACCEPTED
    assert copter.is_armed


def test_copter_gimbal_rates_start_at_neutral() -> None:
    copter, client = ready_copter(parameters={"MNT1_TYPE": 1})
    client.command(MavCmd.DO_GIMBAL_MANAGER_PITCHYAW, -60, 40, NAN, NAN, 0, 0, 1)
    for mode in (MavMountMode.NEUTRAL, MavMountMode.RETRACT):
        client.command(MavCmd.DO_MOUNT_CONFIGURE, mode)
        client.run(0.5)
        client.command(MavCmd.DO_GIMBAL_MANAGER_PITCHYAW, NAN, NAN, -10, 10, 0, 0, 1)
        client.run(1.0)
        assert copter.gimbal.angles == pytest.approx((0.0, -10.0, 10.0), abs=1.0)


def test_copter_gimbal_neutral_uses_parameters() -> None:
    copter, client = ready_copter(parameters={"MNT1_TYPE": 1})
    copter.parameters["MNT1_NEUTRAL_Y"] = -30.0
    client.command(MavCmd.DO_MOUNT_CONFIGURE, MavMountMode.NEUTRAL)
    assert copter.gimbal.angles == (0.0, -30.0, 0.0)


def test_copter_armed_in_throw_waits_for_the_throw() -> None:
    _, client = ready_copter()
    client.command(MavCmd.DO_SET_MODE, 1, CopterMode.THROW)
    assert client.command(ARM, 1, 21196) == MavResult.ACCEPTED
    client.run(3.0)
    assert client.texts == ["Arming motors", "waiting for throw"]


@pytest.mark.anyio
async def test_copter_reboot_closes_tcp_connections() -> None:
    copter = SimulatedCopter(boot_time_s=0.0, parameter_count=100)
    async with open_simulator(copter, "tcpin:127.0.0.1:0") as server:
        host, port = server.addresses[0].removeprefix("tcpin:").split(":")
        reader, writer = await asyncio.open_connection(host, int(port))
        await reader.read(1)
        reboot = m.CommandLong(1, 1, MavCmd.PREFLIGHT_REBOOT_SHUTDOWN, 0, 1, *(0.0,) * 6)
        writer.write(FrameEncoder(255, 190).encode(reboot))
        received = await asyncio.wait_for(reader.read(), 10.0)
        answers = [STANDARD.decode(message) for message in Framer().receive(received, 0.0)]
        assert any(isinstance(answer, m.CommandAck) and answer.result == 0 for answer in answers)
        writer.close()
        again, writer = await asyncio.open_connection(host, int(port))
        assert await asyncio.wait_for(again.read(1), 10.0)
        writer.close()


def test_copter_disarm_delay_scales_up_to_127_s() -> None:
    copter, _ = ready_copter()
    scale_timeouts([copter], 5.0)
    assert copter.parameters["DISARM_DELAY"] == 50.0
    scale_timeouts([copter], 20.0)
    assert copter.parameters["DISARM_DELAY"] == 127.0
