"""Manual control of a simulated PX4, compared with real firmware (v1.17-alpha)."""

from __future__ import annotations

import math

import pytest
from simulated_client import Client

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd, MavResult, MavState
from aerokit.sim import SimulatedPx4

ARM = MavCmd.COMPONENT_ARM_DISARM
ALTITUDE, POSITION, STABILIZED, HOLD, RTL = (2, 0), (3, 0), (7, 0), (4, 3), (4, 5)


class Pilot(Client):
    """Sends MANUAL_CONTROL at 10 Hz while it runs."""

    def fly(
        self,
        seconds: float,
        *,
        forward: int = 0,
        right: int = 0,
        throttle: int = 500,
        turn: int = 0,
    ) -> None:
        for _ in range(round(seconds / 0.1)):
            self.send(m.ManualControl(1, forward, right, throttle, turn, 0))
            self.run(0.1)

    def set_mode(self, main: int, sub: int = 0) -> list[int]:
        self.clear()
        self.command(MavCmd.DO_SET_MODE, 1, main, sub)
        return [ack.result for ack in self.all(m.CommandAck)]


def ready(**parameters: float) -> tuple[SimulatedPx4, Pilot]:
    px4 = SimulatedPx4(fast_rate_hz=2.0, boot_time_s=1.0, parameter_count=100, parameters=parameters)
    pilot = Pilot(px4)
    pilot.run(2.0)
    pilot.clear()
    return px4, pilot


def flying(mode: tuple[int, int] = POSITION) -> tuple[SimulatedPx4, Pilot]:
    """Take off manually."""
    px4, pilot = ready()
    pilot.fly(0.2, throttle=0)
    assert pilot.set_mode(*POSITION) == [MavResult.ACCEPTED] * 2
    assert pilot.command(ARM, 1) == MavResult.ACCEPTED
    pilot.fly(7.0, throttle=1000)
    pilot.fly(3.0)
    assert pilot.set_mode(*mode) == [MavResult.ACCEPTED] * 2
    return px4, pilot


def test_arming_in_manual_mode_needs_sticks() -> None:
    px4, pilot = ready()
    pilot.set_mode(*POSITION)
    pilot.run(1.1)
    assert pilot.last(m.Heartbeat).system_status == MavState.UNINIT
    assert pilot.command(ARM, 1) == MavResult.TEMPORARILY_REJECTED
    assert "".join(pilot.texts) == "Arming denied: Resolve system health failures first\t"
    pilot.fly(1.1, throttle=0)
    assert pilot.last(m.Heartbeat).system_status == MavState.STANDBY
    assert pilot.command(ARM, 1) == MavResult.ACCEPTED
    assert px4.is_armed


@pytest.mark.parametrize(
    ("mode", "throttle", "armed"), [(POSITION, 500, True), (POSITION, 700, False), (STABILIZED, 150, False)]
)
def test_arming_needs_low_throttle(mode: tuple[int, int], throttle: int, armed: bool) -> None:
    px4, pilot = ready()
    pilot.fly(0.2, throttle=throttle)
    pilot.set_mode(*mode)
    pilot.command(ARM, 1)
    assert px4.is_armed == armed
    assert ("Arming denied: throttle not in safe position\t" in pilot.texts) == (not armed)


def test_released_sticks_hold_the_position() -> None:
    px4, pilot = flying()
    motion = px4.motion
    assert px4.altitude_m > 5.0
    pilot.fly(5.0, forward=1000)
    assert motion.velocity_north > 7.0
    assert abs(motion.velocity_down) < 0.1
    pilot.fly(6.0)
    place = (motion.north, motion.east, motion.down)
    pilot.fly(5.0)
    assert math.dist(place, (motion.north, motion.east, motion.down)) < 0.2
    pilot.fly(2.0, turn=1000)
    assert motion.yaw_rate == pytest.approx(2.5, abs=0.2)
    pilot.fly(1.0)
    pilot.fly(3.0, throttle=1000)
    assert motion.velocity_down == pytest.approx(-3.0, abs=0.2)


def test_altitude_mode_does_not_brake() -> None:
    px4, pilot = flying(ALTITUDE)
    pilot.fly(2.0, right=1000)
    assert math.degrees(px4.motion.roll) == pytest.approx(35.0, abs=3.0)
    before, height = px4.motion.velocity_east, px4.altitude_m
    pilot.fly(1.0)
    assert px4.motion.velocity_east > 0.5 * before
    assert px4.altitude_m == pytest.approx(height, abs=0.3)


def test_stabilized_throttle_is_thrust() -> None:
    px4, pilot = flying(STABILIZED)
    pilot.fly(1.0)
    assert abs(px4.motion.velocity_down) < 0.2
    pilot.fly(1.5, throttle=700)
    assert px4.motion.velocity_down < -1.5


def test_throttle_stick_lands_the_vehicle() -> None:
    px4, pilot = flying()
    for _ in range(60):
        pilot.fly(1.0, throttle=0)
        if not px4.is_armed:
            break
    assert px4.is_landed
    assert pilot.texts[-2:] == ["Landing detected\t", "Disarmed by landing\t"]


def test_moved_sticks_override_automatic_modes() -> None:
    px4, pilot = flying()
    pilot.set_mode(*HOLD)
    pilot.fly(1.0)
    assert px4.mode == HOLD
    pilot.fly(0.3, forward=400)
    assert px4.mode == POSITION
    assert pilot.texts == ["Pilot took over using sticks\t"]


def test_lost_sticks_hold_and_return() -> None:
    px4, pilot = flying()
    pilot.run(2.0)
    assert (px4.mode, px4.is_in_failsafe) == (HOLD, True)
    pilot.run(5.0)
    assert px4.mode == RTL


def test_channel_overrides_need_assigned_channels() -> None:
    override = m.RcChannelsOverride(1, 1, 1500, 1500, 1000, 1500, 0, 0, 0, 0)
    for assigned in (False, True):
        names = ("RC_MAP_ROLL", "RC_MAP_PITCH", "RC_MAP_THROTTLE", "RC_MAP_YAW")
        px4, pilot = ready(**({name: number for number, name in enumerate(names, start=1)} if assigned else {}))
        pilot.send(override)
        assert px4.sticks.are_fresh == assigned
        pilot.run(0.2)
        assert pilot.last(m.RcChannels).chancount == 8
