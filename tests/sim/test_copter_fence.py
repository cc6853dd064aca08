"""The fence of the simulated ArduCopter: limits, breaches, actions, arming."""

from __future__ import annotations

import pytest
from simulated_client import Client, flying_copter, ready_copter, set_mode

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import CopterMode, FenceBreach, MavCmd, MavMissionType, MavResult
from aerokit.mavlink.enums import MavSysStatusSensor as Sensor
from aerokit.missions import MissionItem
from aerokit.sim import SimulatedCopter
from aerokit.sim.missions import CircleZone, PolygonZone

ARM = MavCmd.COMPONENT_ARM_DISARM
FENCE = MavCmd.DO_FENCE_ENABLE
ENABLED = {"FENCE_ENABLE": 1.0, "FENCE_RADIUS": 30.0, "FENCE_ALT_MAX": 25.0}
OUT_EAST = (0, 0, 0, 0.0, 0.0, 0.0, 0.0, 6.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def fly_east(copter: SimulatedCopter, client: Client) -> None:
    """Fly east by velocity until another mode takes over."""
    for _ in range(60):
        client.send(m.SetPositionTargetLocalNed(0, 1, 1, 1, 0xDC7, *OUT_EAST[3:]))
        client.run(0.5)
        if copter.mode.number != CopterMode.GUIDED:
            return
    raise AssertionError("the fence did not act")


def upload(copter: SimulatedCopter, *items: MissionItem) -> None:
    copter.missions.fence.replace(items, lambda _: None)


def corner(copter: SimulatedCopter, north: float, east: float, *, count: int, inside: bool) -> MissionItem:
    place = copter.frame.to_global(north, east, 0.0)
    kind = MavCmd.NAV_FENCE_POLYGON_VERTEX_EXCLUSION
    if inside:
        kind = MavCmd.NAV_FENCE_POLYGON_VERTEX_INCLUSION
    return MissionItem(kind, 0, float(count), x=place.latitude_e7, y=place.longitude_e7)


def test_disabled_fence_does_nothing() -> None:
    copter, client = flying_copter()
    for _ in range(10):
        client.send(m.SetPositionTargetLocalNed(0, 1, 1, 1, 0xDC7, *OUT_EAST[3:]))
        client.run(0.5)
    assert copter.mode.number == CopterMode.GUIDED
    assert not client.all(m.FenceStatus)


def test_circle_breach_returns_and_reports() -> None:
    copter, client = flying_copter(parameters=ENABLED)
    fly_east(copter, client)
    assert copter.mode.number == CopterMode.RTL
    assert client.texts[:2] == ["Circle fence breached", "Manual recovery started"]
    status = client.last(m.FenceStatus)
    assert (status.breach_status, status.breach_count, status.breach_type) == (1, 1, FenceBreach.BOUNDARY)
    assert 0 <= copter.time_boot_ms - status.breach_time < 1500
    client.run_until(lambda: "Fence breach cleared" in client.texts)
    assert copter.fence.breached == 0


@pytest.mark.parametrize(
    ("action", "mode"),
    [
        (2, CopterMode.LAND),
        (3, CopterMode.SMART_RTL),
        (4, CopterMode.BRAKE),
        (5, CopterMode.SMART_RTL),
    ],
)
def test_fence_action_selects_mode(action: int, mode: int) -> None:
    copter, client = flying_copter(parameters={**ENABLED, "FENCE_ACTION": float(action)})
    fly_east(copter, client)
    assert copter.mode.number == mode


def test_fence_report_only_keeps_mode() -> None:
    copter, _ = flying_copter(parameters={**ENABLED, "FENCE_ACTION": 0.0, "FENCE_ALT_MAX": 5.0})
    assert copter.mode.number == CopterMode.GUIDED
    assert copter.fence.breached == 1
    assert copter.fence.health == (True, False, False)


def test_max_altitude_breach_returns() -> None:
    copter, client = flying_copter(parameters=ENABLED)
    copter.parameters["FENCE_ALT_MAX"] = 8.0
    client.run(0.5)
    assert "Max Alt fence breached" in client.texts
    assert copter.mode.number == CopterMode.RTL
    assert client.last(m.FenceStatus).breach_type == FenceBreach.MAXALT


def test_min_altitude_fence_enables_above_it_and_disables_for_landing() -> None:
    copter, client = ready_copter(parameters={**ENABLED, "FENCE_TYPE": 15.0, "FENCE_ALT_MIN": 5.0})
    assert set_mode(client, CopterMode.GUIDED) == MavResult.ACCEPTED
    assert client.command(ARM, 1) == MavResult.ACCEPTED
    assert client.command(MavCmd.NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 10) == MavResult.ACCEPTED
    client.run_until(lambda: "Min Alt fence enabled (auto enable)" in client.texts)
    assert copter.altitude_m >= 7.0
    assert set_mode(client, CopterMode.LAND) == MavResult.ACCEPTED
    client.run_until(lambda: "Min Alt fence auto-disabled" in client.texts)
    client.run_until(lambda: not copter.is_armed)
    assert not any("breached" in text for text in client.texts)


def test_mode_change_during_breach_suspends_fence_ten_seconds() -> None:
    copter, client = flying_copter(parameters={**ENABLED, "FENCE_ALT_MAX": 25.0})
    copter.parameters["FENCE_ALT_MAX"] = 8.0
    client.run(0.5)
    client.clear()
    assert set_mode(client, CopterMode.GUIDED) == MavResult.ACCEPTED
    client.run(5.0)
    assert copter.mode.number == CopterMode.GUIDED
    assert client.texts == ["Manual recovery started"]


def test_fence_option_refuses_mode_changes_during_breach() -> None:
    copter, client = flying_copter(parameters={**ENABLED, "FENCE_OPTIONS": 1.0})
    fly_east(copter, client)
    client.clear()
    assert set_mode(client, CopterMode.GUIDED) == MavResult.FAILED
    client.run(0.1)
    assert client.texts == ["Mode change to GUIDED failed: in fence recovery"]


def test_reposition_outside_fence_is_refused() -> None:
    copter, client = flying_copter(parameters=ENABLED)
    assert set_mode(client, CopterMode.LOITER) == MavResult.ACCEPTED
    far = copter.frame.to_global(0.0, 100.0, 0.0)
    x, y = far.latitude_e7, far.longitude_e7
    assert client.command_int(MavCmd.DO_REPOSITION, 3, -1, 1, x=x, y=y, z=10) == MavResult.FAILED
    assert copter.mode.number == CopterMode.LOITER
    near = copter.frame.to_global(0.0, 10.0, 0.0)
    x, y = near.latitude_e7, near.longitude_e7
    assert client.command_int(MavCmd.DO_REPOSITION, 3, -1, 1, x=x, y=y, z=40) == MavResult.FAILED
    assert client.command_int(MavCmd.DO_REPOSITION, 3, -1, 1, x=x, y=y, z=15) == MavResult.ACCEPTED


def test_exclusion_zone_breach_returns() -> None:
    copter, client = flying_copter(parameters={"FENCE_ENABLE": 1.0})
    corners = [(-20.0, 15.0), (20.0, 15.0), (20.0, 30.0), (-20.0, 30.0)]
    upload(copter, *(corner(copter, n, e, count=4, inside=False) for n, e in corners))
    assert len(copter.missions.items(MavMissionType.FENCE)) == 4
    fly_east(copter, client)
    assert "Polygon fence breached" in client.texts
    assert 15.0 <= copter.motion.east < 18.0


@pytest.mark.parametrize(
    ("parameters", "reason"),
    [
        ({"FENCE_MARGIN": 200.0}, "Circle FENCE_MARGIN is greater than FENCE_RADIUS"),
        ({"FENCE_TYPE": 0.0}, "Fences enabled, but none selected"),
        ({"FENCE_ALT_MAX": 1.0, "FENCE_ALT_MIN": 0.0}, "FENCE_MARGIN too big"),
        ({"FENCE_ALT_MAX": -1.0, "FENCE_ALT_MIN": -10.0}, "Invalid FENCE_ALT_MAX value"),
        ({"FENCE_ALT_MIN": 50.0}, "FENCE_ALT_MAX < FENCE_ALT_MIN"),
    ],
)
def test_invalid_fence_settings_prevent_arming(parameters: dict[str, float], reason: str) -> None:
    copter, _ = ready_copter(parameters={**ENABLED, **parameters})
    assert copter.arming.reasons() == [reason]


def test_arming_outside_fence_is_refused() -> None:
    copter, client = ready_copter(parameters=ENABLED)
    inside = [(10.0, 10.0), (20.0, 10.0), (20.0, 20.0)]
    upload(copter, *(corner(copter, n, e, count=3, inside=True) for n, e in inside))
    client.run(1.0)
    client.clear()
    assert client.command(ARM, 1) == MavResult.FAILED
    assert client.texts == ["Arm: Vehicle breaching Polygon fence"]


def test_fence_enable_command_switches_kinds() -> None:
    copter, client = ready_copter()
    assert client.command(FENCE, 1) == MavResult.ACCEPTED
    assert copter.fence.enabled == 7
    assert client.command(FENCE, 0, 2) == MavResult.ACCEPTED
    assert copter.fence.enabled == 5
    assert client.command(FENCE, 7) == MavResult.FAILED
    assert client.command(FENCE, 0) == MavResult.ACCEPTED
    copter.parameters["FENCE_TYPE"] = 4.0
    assert client.command(FENCE, 1) == MavResult.FAILED, "no polygon is uploaded"


def test_fence_autoenable_follows_arming() -> None:
    _, client = ready_copter(parameters={"FENCE_AUTOENABLE": 3.0})
    assert set_mode(client, CopterMode.GUIDED) == MavResult.ACCEPTED
    assert client.command(ARM, 1) == MavResult.ACCEPTED
    client.run(0.1)
    assert client.texts[-2:] == ["Max Alt, Circle and Polygon fences auto-enabled", "Arming motors"]
    assert client.command(ARM, 0) == MavResult.ACCEPTED
    client.run(0.1)
    assert client.texts[-2:] == ["Max Alt, Circle and Polygon fences auto-disabled", "Disarming motors"]


def test_fence_status_is_streamed_only_while_enabled() -> None:
    copter, client = ready_copter()
    assert client.command(MavCmd.SET_MESSAGE_INTERVAL, m.FenceStatus.ID, 500_000) == MavResult.ACCEPTED
    client.run(2.0)
    assert not client.all(m.FenceStatus)
    copter.parameters["FENCE_ENABLE"] = 1.0
    client.run(2.0)
    assert len(client.all(m.FenceStatus)) >= 3
    client.command(MavCmd.REQUEST_MESSAGE, m.SysStatus.ID)
    client.run(0.1)
    assert client.last(m.SysStatus).onboard_control_sensors_enabled & Sensor.MAV_SYS_STATUS_GEOFENCE


def test_zone_distances_are_signed() -> None:
    square = PolygonZone([(0.0, 0.0), (10.0, 0.0), (10.0, 10.0), (0.0, 10.0)])
    assert square.outside_m((5.0, 4.0)) == pytest.approx(-4.0)
    assert square.outside_m((5.0, 13.0)) == pytest.approx(3.0)
    assert square.outside_m((-3.0, -4.0)) == pytest.approx(5.0)
    assert CircleZone((0.0, 0.0), 5.0).outside_m((3.0, 0.0)) == pytest.approx(-2.0)
