"""Failsafes of a simulated PX4, compared with real firmware (v1.17-alpha)."""

from __future__ import annotations

import math

import pytest
from simulated_client import Client

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavBatteryChargeState, MavCmd, MavResult, MavState, MavType
from aerokit.missions import MissionItem
from aerokit.sim import SimulatedPx4

HOLD, MISSION, RTL, LAND = (4, 3), (4, 4), (4, 5), (4, 6)
NAN = math.nan


class Station(Client):
    """A client that sends ground-station heartbeats at 1 Hz until it is ``silent``."""

    silent = False

    def run(self, seconds: float) -> None:
        end = self.now + seconds
        while self.now < end - 1e-9:
            if not self.silent:
                self.send(m.Heartbeat(MavType.GCS, 8, 0, 0, 4, 3))
            super().run(min(1.0, end - self.now))


def flying(altitude_m: float = 20.0, **parameters: float) -> tuple[SimulatedPx4, Station]:
    px4 = SimulatedPx4(fast_rate_hz=1.0, boot_time_s=1.0, parameter_count=150, parameters=parameters)
    station = Station(px4)
    station.run(2.0)
    station.command(MavCmd.NAV_TAKEOFF, 0, 0, 0, NAN, NAN, NAN, 584.09 + altitude_m)
    assert station.command(MavCmd.COMPONENT_ARM_DISARM, 1) == MavResult.ACCEPTED
    station.run(30.0)
    assert px4.mode == HOLD
    station.clear()
    return px4, station


def set_mode(station: Station, sub: int) -> None:
    station.command(MavCmd.DO_SET_MODE, 1, 4, sub)


def fly_north(px4: SimulatedPx4, station: Station, metres: float, seconds: float) -> None:
    place = px4.frame.to_global(metres, 0.0, 0.0)
    station.command_int(MavCmd.DO_REPOSITION, 5, -1, 1, 0, NAN, x=place.latitude_e7, y=place.longitude_e7, z=NAN)
    station.run(seconds)


# ----------------------------------------------------------------------------------------- battery


def test_battery_levels_warn_return_and_land() -> None:
    px4, station = flying()
    px4.battery.percent = 14.9
    station.run(1.0)
    assert station.texts == ["Low battery\t"]
    assert px4.mode == HOLD
    assert station.last(m.Heartbeat).system_status == MavState.ACTIVE
    px4.battery.percent = 6.9
    station.run(1.0)
    assert station.texts[1:] == ["Critical battery\t", "Failsafe activated: entering Hold for 5 seconds\t"]
    assert px4.is_in_failsafe
    station.run(5.0)
    assert px4.mode == RTL
    assert "Failsafe activated\t" in station.texts
    px4.battery.percent = 4.9
    station.run(2.5)
    assert px4.mode == LAND, "at once: it is in a failsafe already"
    assert station.last(m.BatteryStatus).charge_state == MavBatteryChargeState.EMERGENCY
    assert station.last(m.Heartbeat).system_status == MavState.CRITICAL


@pytest.mark.parametrize(("action", "mode"), [(0, HOLD), (2, LAND), (3, RTL)])
def test_critical_battery_action_is_a_parameter(action: int, mode: tuple[int, int]) -> None:
    px4, station = flying(COM_LOW_BAT_ACT=action, COM_FAIL_ACT_T=0.0)
    px4.battery.percent = 6.0
    station.run(1.0)
    assert px4.mode == mode


def test_mode_change_overrides_until_worse_failure() -> None:
    px4, station = flying(COM_FAIL_ACT_T=0.0)
    px4.battery.percent = 6.0
    station.run(1.0)
    assert px4.mode == RTL
    set_mode(station, 3)
    station.run(3.0)
    assert px4.mode == HOLD
    assert not px4.is_in_failsafe


def test_new_setpoints_do_not_end_other_failsafes() -> None:
    px4, station = flying(COM_FAIL_ACT_T=1.0)
    px4.battery.percent = 100.0
    for step in range(20):
        station.send(m.SetPositionTargetLocalNed(0, 1, 1, 1, 0b110111000111, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0))
        if step == 2:
            station.command(MavCmd.DO_SET_MODE, 1, 6, 0)
        elif step == 5:
            assert px4.mode == (6, 0)
            px4.battery.percent = 6.0
        station.run(0.2)
    assert px4.mode == RTL


def test_empty_battery_prevents_arming() -> None:
    px4 = SimulatedPx4(boot_time_s=1.0, battery_percent=6.0, parameter_count=150)
    station = Station(px4)
    station.run(2.0)
    assert station.command(MavCmd.COMPONENT_ARM_DISARM, 1) == MavResult.TEMPORARILY_REJECTED
    assert "Critical battery\t" in station.texts


# ------------------------------------------------------------------------------------------- links


def test_lost_station_only_sends_text_by_default() -> None:
    px4, station = flying()
    station.silent = True
    station.run(12.0)
    assert station.texts == ["Connection to ground station lost\t"]
    assert px4.mode == HOLD
    station.silent = False
    station.run(1.0)
    assert station.texts[1:] == ["GCS connection regained\t"]


def test_regained_station_does_not_end_the_return() -> None:
    px4, station = flying(NAV_DLL_ACT=2)
    station.silent = True
    station.run(12.0)
    assert station.texts == [
        "Connection to ground station lost\t",
        "Preflight Fail: No connection to the GCS",
        "Failsafe activated: entering Hold for 5 seconds\t",
    ]
    station.run(5.0)
    assert px4.mode == RTL
    station.silent = False
    station.run(2.0)
    assert px4.mode == RTL
    assert px4.is_in_failsafe
    set_mode(station, 3)
    station.run(1.0)
    assert px4.mode == HOLD
    assert not px4.is_in_failsafe


def test_required_station_prevents_arming() -> None:
    px4 = SimulatedPx4(boot_time_s=1.0, parameter_count=150, parameters={"NAV_DLL_ACT": 2})
    client = Client(px4)
    client.run(2.0)
    assert client.command(MavCmd.COMPONENT_ARM_DISARM, 1) == MavResult.TEMPORARILY_REJECTED
    assert "Preflight Fail: No connection to the GCS" in client.texts


@pytest.mark.parametrize(("excepted", "mode"), [(0, RTL), (2, HOLD)])
def test_lost_sticks_trigger_return_unless_excepted(excepted: int, mode: tuple[int, int]) -> None:
    px4, station = flying(COM_RCL_EXCEPT=excepted, COM_FAIL_ACT_T=0.0)
    station.run(2.0)
    assert px4.mode == HOLD, "without sticks there is no failsafe"
    for _ in range(5):
        station.send(m.ManualControl(1, 0, 0, 500, 0, 0))
        station.run(0.1)
    station.run(2.0)
    assert px4.mode == mode


# ------------------------------------------------------------------------------------------- fence


@pytest.mark.parametrize(("action", "mode"), [(1, HOLD), (2, HOLD), (3, RTL), (5, LAND)])
def test_maximum_distance_triggers_fence_action(action: int, mode: tuple[int, int]) -> None:
    px4, station = flying(GF_ACTION=0, GF_MAX_HOR_DIST=30.0, COM_FAIL_ACT_T=0.0)
    fly_north(px4, station, 100.0, 10.0)
    px4.parameters["GF_ACTION"] = action
    station.run(2.0)
    assert station.texts[0] == "Geofence: exceeding maximum distance to Home"
    assert px4.mode == mode
    assert px4.is_in_failsafe == (action > 1)


def test_reposition_beyond_the_fence_is_refused() -> None:
    px4, station = flying(GF_MAX_HOR_DIST=30.0)
    fly_north(px4, station, 100.0, 10.0)
    assert station.texts == ["Reposition is outside geofence\t"]
    assert px4.motion.north == pytest.approx(0.0, abs=1.0)


def test_polygon_and_circle_fences() -> None:
    px4, _ = flying(GF_ACTION=2)
    corners = [(-50, -50), (50, -50), (50, 50), (-50, 50)]
    fence = [fence_item(px4, MavCmd.NAV_FENCE_POLYGON_VERTEX_INCLUSION, 4, *corner) for corner in corners]
    fence.append(fence_item(px4, MavCmd.NAV_FENCE_CIRCLE_EXCLUSION, 10, 30, 30))
    assert px4.missions.replace(1, fence) == 0
    allows = px4.failsafes.fence.allows
    assert allows((0.0, 0.0, -10.0))
    assert not allows((60.0, 0.0, -10.0))
    assert not allows((25.0, 28.0, -10.0))


def fence_item(px4: SimulatedPx4, command: int, param1: float, north: float, east: float) -> MissionItem:
    place = px4.frame.to_global(north, east, 0.0)
    return MissionItem(command, 3, param1, 0, 0, 0, place.latitude_e7, place.longitude_e7, 0)


# ---------------------------------------------------------------------------------------- position


def test_lost_position_ends_mode_after_five_seconds() -> None:
    """Flown by real PX4 in SIH without satellites: no hold before the descent, and dead-reckoned positions go on."""
    px4, station = flying()
    px4.faults.gps_lost = True
    station.run(4.5)
    assert px4.mode == HOLD
    station.clear()
    station.run(1.0)
    assert px4.mode == LAND
    assert [text.strip() for text in station.texts] == ["Failsafe activated"]
    station.run(5.0)
    assert station.last(m.Heartbeat).system_status == MavState.CRITICAL
    assert len(station.all(m.GlobalPositionInt)) >= 4


def test_lost_position_returns_nowhere() -> None:
    """A return needs a position, so the action of another failsafe is a landing."""
    px4, station = flying()
    px4.faults.gps_lost = True
    px4.battery.percent = 6.0
    station.run(1.0)
    assert px4.mode == LAND


def test_lost_position_does_not_matter_to_mode_without_position() -> None:
    px4, station = flying()
    set_mode(station, 6)
    station.clear()
    px4.faults.gps_lost = True
    station.run(10.0)
    assert station.texts == []
