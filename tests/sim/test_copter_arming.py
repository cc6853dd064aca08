from __future__ import annotations

from simulated_client import Client, flying_copter, ready_copter, set_mode

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import CopterMode, FenceType, MavCmd, MavModeFlag, MavResult, MavSysStatusSensor
from aerokit.sim import SimulatedCopter

ARM = MavCmd.COMPONENT_ARM_DISARM
FORCE = 21196.0


def test_arming_in_guided_sends_text() -> None:
    copter, client = ready_copter()
    assert set_mode(client, CopterMode.GUIDED) == MavResult.ACCEPTED
    assert client.command(ARM, 1) == MavResult.ACCEPTED
    assert copter.is_armed
    assert client.texts == ["Arming motors"]
    assert client.all(m.HomePosition), "home moves to where it is armed"
    client.run(1.0)
    assert client.last(m.Heartbeat).base_mode & MavModeFlag.SAFETY_ARMED
    assert client.command(ARM, 1) == MavResult.ACCEPTED, "arming twice is accepted"


def test_arming_refusal_text_follows_acknowledgement() -> None:
    copter, client = ready_copter()
    copter.faults.prearm_failures = ["Compass not healthy", "Hardware safety switch"]
    assert client.command(ARM, 1) == MavResult.FAILED
    assert client.texts == ["Arm: Compass not healthy", "Arm: Hardware safety switch"]
    kinds = [type(message) for _, message in client.received]
    assert kinds[0] is m.CommandAck


def test_arming_needs_position_in_guided_only() -> None:
    client = Client(SimulatedCopter())  # its boot takes five seconds
    client.run(4.0)
    set_mode(client, CopterMode.GUIDED)
    assert client.command(ARM, 1) == MavResult.FAILED
    assert client.texts[-1] == "Arm: Need Position Estimate"
    assert client.command(ARM, 1, FORCE) == MavResult.FAILED, "mandatory even by force"
    set_mode(client, CopterMode.STABILIZE)
    assert client.command(ARM, 1) == MavResult.ACCEPTED


def test_arming_reasons_change_during_boot() -> None:
    copter = SimulatedCopter(boot_time_s=41.5)
    client = Client(copter)
    observed = []
    while copter.uptime < 42.0:
        copter.mode = copter.guided
        observed += copter.arming.reasons()[:1] or ["none"]
        client.run(0.05)
    assert list(dict.fromkeys(observed)) == [
        "System not initialised",
        "GPS 1: not healthy",
        "GPS 1: Bad fix",
        "AHRS: waiting for home",
        "AHRS: Not healthy",
        "Need Position Estimate",
        "none",
    ]


def test_forced_arming_while_estimator_starts_is_refused() -> None:
    copter = SimulatedCopter(boot_time_s=41.5)
    client = Client(copter)
    while not copter.is_initialised:
        client.run(0.05)
    assert client.command(ARM, 1, FORCE) == MavResult.FAILED
    assert client.texts[-1].startswith("Arm: AHRS: ")


def test_fence_needs_position_to_arm_in_any_mode() -> None:
    copter = SimulatedCopter()
    copter.parameters["FENCE_ENABLE"], copter.parameters["FENCE_TYPE"] = 1, FenceType.CIRCLE
    client = Client(copter)
    client.run(2.0)
    set_mode(client, CopterMode.STABILIZE)
    assert list(copter.arming.position_reasons()) == ["AHRS: waiting for home"]
    client.run(2.0)
    assert client.command(ARM, 1, FORCE) == MavResult.FAILED
    assert client.texts[-1] == "Arm: Fence enabled, need position estimate"


def test_arming_in_returning_modes_is_refused() -> None:
    _, client = ready_copter()
    for mode, name in ((CopterMode.RTL, "RTL"), (CopterMode.LAND, "LAND"), (CopterMode.BRAKE, "BRAKE")):
        set_mode(client, mode)
        assert client.command(ARM, 1) == MavResult.FAILED
        assert client.texts[-1] == f"Arm: {name} mode not armable"
    set_mode(client, CopterMode.AUTO)
    assert client.command(ARM, 1) == MavResult.FAILED
    assert client.texts[-1] == "Arm: Mode requires mission"
    assert client.command(ARM, 1, FORCE) == MavResult.ACCEPTED, "force overrides it"


def test_raised_throttle_prevents_arming_in_stick_modes() -> None:
    copter, client = ready_copter()
    copter.rc[2] = 1700
    assert client.command(ARM, 1) == MavResult.FAILED
    assert client.texts == ["Arm: Throttle too high"]
    set_mode(client, CopterMode.GUIDED)
    assert client.command(ARM, 1) == MavResult.ACCEPTED


def test_raised_throttle_is_ignored_without_radio_check() -> None:
    copter, client = ready_copter()
    copter.parameters["ARMING_CHECK"] = 8.0
    copter.rc[2] = 1700
    assert client.command(ARM, 1) == MavResult.ACCEPTED


def test_lost_gps_is_ignored_without_gps_check() -> None:
    copter, client = ready_copter()
    copter.parameters["ARMING_CHECK"] = 64.0
    set_mode(client, CopterMode.GUIDED)
    copter.faults.gps_lost = True
    client.run(1.0)
    assert copter.arming.gps_reasons() == ("GPS 1: Bad fix",)
    assert client.command(ARM, 1) == MavResult.ACCEPTED


def test_mode_must_be_armable_even_without_checks() -> None:
    copter, client = ready_copter()
    copter.parameters["ARMING_CHECK"] = 0.0
    set_mode(client, CopterMode.RTL)
    assert client.command(ARM, 1) == MavResult.FAILED
    assert client.texts[-1] == "Arm: RTL mode not armable"


def test_prearm_failures_are_reported_periodically_and_on_request() -> None:
    copter, client = ready_copter()
    assert client.command(MavCmd.RUN_PREARM_CHECKS) == MavResult.ACCEPTED
    assert client.texts == []
    copter.faults.prearm_failures = ["Compass not healthy"]
    assert client.command(MavCmd.RUN_PREARM_CHECKS) == MavResult.ACCEPTED
    assert client.texts == ["PreArm: Compass not healthy"]
    client.run(61.0)
    assert len(client.texts) == 3
    copter.faults.prearm_failures = []
    client.command(ARM, 1)
    assert client.command(MavCmd.RUN_PREARM_CHECKS) == MavResult.TEMPORARILY_REJECTED


def test_prearm_health_follows_checks_within_one_second() -> None:
    copter, client = ready_copter()
    bit = MavSysStatusSensor.MAV_SYS_STATUS_PREARM_CHECK
    client.command(MavCmd.SET_MESSAGE_INTERVAL, m.SysStatus.ID, 100_000)
    client.run(1.5)
    assert client.last(m.SysStatus).onboard_control_sensors_health & bit
    copter.faults.prearm_failures = ["Compass not healthy"]
    client.run(1.5)
    assert not client.last(m.SysStatus).onboard_control_sensors_health & bit


def test_disarming_in_air_needs_force_and_crashes() -> None:
    copter, client = flying_copter(5.0)
    assert client.command(ARM, 0) == MavResult.FAILED
    assert client.texts == []
    assert client.command(ARM, 0, FORCE) == MavResult.ACCEPTED
    client.run(3.0)
    assert not copter.is_armed
    assert copter.altitude_m == 0.0
    assert copter.is_landed
    hit = next(text for text in client.texts if text.startswith("SIM Hit ground at"))
    assert 7.0 < float(hit.split()[4]) < 10.0


def test_idle_copter_disarms_after_disarm_delay() -> None:
    copter, client = ready_copter()
    set_mode(client, CopterMode.GUIDED)
    client.command(ARM, 1)
    assert 9.9 < client.run_until(lambda: not copter.is_armed) < 10.3
    assert client.texts[-1] == "Disarming motors"
    copter.parameters["DISARM_DELAY"] = 0
    client.command(ARM, 1)
    client.run(60.0)
    assert copter.is_armed


def test_arming_before_initialisation_is_refused() -> None:
    client = Client(SimulatedCopter())
    client.run(0.2)
    assert client.command(ARM, 1) == MavResult.FAILED
    assert client.texts[-1] == "Arm: System not initialised"


def test_low_battery_prevents_arming() -> None:
    _, client = ready_copter(battery_percent=3.0, parameters={"BATT_ARM_VOLT": 10.5})
    assert client.command(ARM, 1) == MavResult.FAILED
    assert client.texts == ["Arm: Battery 1 below minimum arming voltage"]
