"""Telemetry: what each message does to the cells, and what must never reach them."""

from __future__ import annotations

import math
from typing import Any

import pytest

from aerokit.autopilots import autopilot_for
from aerokit.errors import ConnectionClosed, ValueUnknownError
from aerokit.mavlink import Frame, FrameEncoder, Framer, messages
from aerokit.mavlink.message import Message
from aerokit.position import Position
from aerokit.vehicle.state.movement import Velocity
from aerokit.vehicle.state.telemetry import Telemetry

NAN = math.nan
U16 = 0xFFFF
ARDUPILOT, PX4 = 3, 12


class Clock:
    """A clock that stands until it is moved."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def telemetry(clock: Clock) -> Telemetry:
    return vehicle(clock)


def vehicle(clock: Clock, autopilot: int = ARDUPILOT) -> Telemetry:
    return Telemetry(clock, autopilot=autopilot_for(heartbeat(autopilot=autopilot)))


def heartbeat(
    autopilot: int = ARDUPILOT, base_mode: int = 81, custom_mode: int = 4, status: int = 3
) -> messages.Heartbeat:
    return messages.Heartbeat(2, autopilot, base_mode, custom_mode, status)


def global_position(lat: int = 473977000, relative_alt: int = 10000, hdg: int = 9000) -> messages.GlobalPositionInt:
    return messages.GlobalPositionInt(0, lat, 85456000, 498000, relative_alt, 100, -200, 50, hdg)


def received(message: Message, system_id: int = 1, component_id: int = 1, version: int = 2) -> Message:
    """The same message off the wire."""
    frame: Frame = Framer().receive(FrameEncoder(system_id, component_id, version=version).encode(message))[0]
    return type(message).decode(frame.payload, frame)


# ------------------------------------------------------------------------------- whose message


@pytest.mark.parametrize(("system_id", "component_id"), [(2, 1), (1, 154), (255, 190)])
def test_others_never_change_the_state(telemetry: Telemetry, system_id: int, component_id: int) -> None:
    for message in (heartbeat(), global_position(), messages.Statustext(6, "hello")):
        telemetry.receive(received(message, system_id, component_id))
        telemetry.handles[message.ID](received(message, system_id, component_id))
    assert [cell.name for cell in telemetry.cells.values() if cell.is_known] == []
    assert telemetry.texts_since(-1) == ()


def test_messages_of_autopilot_are_processed(telemetry: Telemetry) -> None:
    message = received(heartbeat())
    assert message.received_frame is not None
    assert telemetry.accepts(message.received_frame)
    telemetry.handles[0](message)
    assert telemetry.mode.value.name == "GUIDED"
    source = telemetry.mode.source
    assert source is not None
    assert (source.system_id, source.component_id, source.message) == (1, 1, "HEARTBEAT")


def test_unrelated_messages_are_ignored(telemetry: Telemetry) -> None:
    telemetry.receive(messages.Ping(0, 0, 0, 0))


# ---------------------------------------------------------------------------------------- modes


def test_heartbeat(telemetry: Telemetry) -> None:
    telemetry.receive(heartbeat(base_mode=81 | 128, custom_mode=6, status=4))
    assert telemetry.mode.value.name == "RTL"
    assert telemetry.armed.value is True
    assert (telemetry.system_status.value, telemetry.landed_state.value) == (4, 2)


def test_telemetry_autopilot_is_taken_from_first_heartbeat(clock: Clock) -> None:
    telemetry = Telemetry(clock)
    telemetry.receive(heartbeat(autopilot=PX4, custom_mode=50593792))
    assert telemetry.autopilot.name == "PX4"
    assert telemetry.mode.value.name == "LOITER"
    assert telemetry.wind.waits_for == "WIND_COV"


def test_landed_state_prefers_extended_sys_state(telemetry: Telemetry, clock: Clock) -> None:
    telemetry.receive(messages.ExtendedSysState(0, 3))
    telemetry.receive(heartbeat(status=4))
    assert telemetry.landed_state.value == 3
    clock.now = 10
    telemetry.receive(heartbeat(status=3))
    assert telemetry.landed_state.value == 1
    telemetry.receive(messages.ExtendedSysState(3, 0))
    assert (telemetry.landed_state.value, telemetry.vtol_state.value) == (1, 3)


def test_current_mode_message_updates_mode(clock: Clock) -> None:
    telemetry = vehicle(clock, PX4)
    telemetry.receive(messages.CurrentMode(5, 84148224, 84148224))
    assert not telemetry.mode.is_known
    telemetry.receive(heartbeat(PX4, custom_mode=50593792))
    telemetry.receive(messages.CurrentMode(5, 84148224, 84148224))
    assert telemetry.mode.value.name == "RTL"
    telemetry.receive(messages.CurrentMode(0, 0, 0))
    assert telemetry.mode.value.name == "RTL"


def test_unsolicited_available_modes_are_used(telemetry: Telemetry) -> None:
    telemetry.receive(messages.AvailableModes(2, 1, 0, 127, 0, "Drone show"))
    telemetry.receive(messages.AvailableModes(2, 2, 0, 4, 0, "GUIDED"))
    assert telemetry.mode_names == {127: "Drone show"}
    telemetry.receive(heartbeat(custom_mode=127))
    assert telemetry.mode.value.name == "Drone show"


# ------------------------------------------------------------------------------------- movement


def test_global_position(telemetry: Telemetry) -> None:
    telemetry.receive(global_position())
    assert telemetry.position.value == Position(47.3977, 8.5456, 498.0, 10.0)
    assert telemetry.velocity.value == Velocity(1.0, -2.0, 0.5)
    assert telemetry.heading_deg.value == 90.0


def test_heading_before_fix_is_known_position_is_not(telemetry: Telemetry) -> None:
    telemetry.receive(messages.GlobalPositionInt(0, 0, 0, 12, 170, 0, 0, 0, 36000))
    telemetry.receive(messages.GlobalPositionInt(0, 3001, -1091, -220, -223, 0, 0, 0, 36000))  # seen of a plane
    assert telemetry.heading_deg.value == 0.0
    with pytest.raises(ValueUnknownError, match="no GLOBAL_POSITION_INT with a fix"):
        _ = telemetry.position.value
    assert not telemetry.velocity.is_known


def test_invalid_position_is_unknown(telemetry: Telemetry) -> None:
    telemetry.receive(global_position(lat=2_000_000_000, hdg=U16))
    assert not telemetry.position.is_known
    assert not telemetry.heading_deg.is_known


def test_relative_altitude_before_home_is_unknown(telemetry: Telemetry) -> None:
    telemetry.receive(global_position(relative_alt=498004))
    assert telemetry.position.value.altitude_relative_m is None
    telemetry.receive(messages.HomePosition(473977000, 85456000, 0, 0, 0, 0, (1, 0, 0, 0), 0, 0, 0))
    telemetry.receive(global_position(relative_alt=498000))
    assert telemetry.position.value.altitude_relative_m == 498.0


def test_fallback_source_is_ignored_after_better_one(telemetry: Telemetry, clock: Clock) -> None:
    telemetry.receive(global_position())
    local = messages.LocalPositionNed(0, 1, 2, -3, 9, 9, 9)
    hud = messages.VfrHud(NAN, 2.0, 91, 40, 500, 0.5)
    telemetry.receive(local)
    telemetry.receive(hud)
    assert (telemetry.velocity.value, telemetry.heading_deg.value) == (Velocity(1.0, -2.0, 0.5), 90.0)
    clock.now = 5
    telemetry.receive(local)
    telemetry.receive(hud)
    assert (telemetry.velocity.value, telemetry.heading_deg.value) == (Velocity(9, 9, 9), 91.0)
    assert telemetry.local_position.value.down_m == -3


def test_hud(telemetry: Telemetry) -> None:
    telemetry.receive(messages.VfrHud(NAN, 2.0, 360, 40, 500, 0.5))
    assert (telemetry.ground_speed_m_s.value, telemetry.climb_m_s.value) == (2.0, 0.5)
    assert (telemetry.throttle_percent.value, telemetry.heading_deg.value) == (40, 0)
    assert not telemetry.air_speed_m_s.is_known


def test_attitude_from_both_messages(telemetry: Telemetry) -> None:
    telemetry.receive(messages.Attitude(0, 0.1, -0.2, 3.0, 0.01, 0.02, 0.03))
    by_angles = telemetry.attitude.value
    assert by_angles.pitch_deg == pytest.approx(math.degrees(-0.2))
    telemetry.receive(messages.AttitudeQuaternion(0, *by_angles.quaternion, 0.01, 0.02, 0.03))
    assert telemetry.attitude.value.to_dict() == pytest.approx(by_angles.to_dict())
    assert telemetry.attitude.source is not None
    assert telemetry.attitude.source.message == "ATTITUDE_QUATERNION"


def test_home_and_origin_are_decoded(telemetry: Telemetry) -> None:
    telemetry.receive(messages.HomePosition(0, 0, 0, 0, 0, 0, (1, 0, 0, 0), 0, 0, 0))
    telemetry.receive(messages.GpsGlobalOrigin(0, 0, 0))
    assert not telemetry.home.is_known
    assert not telemetry.origin.is_known
    telemetry.receive(messages.HomePosition(473977000, 85456000, 488000, NAN, NAN, NAN, (NAN,) * 4, 0, 0, 0))
    assert (telemetry.home.value.altitude_amsl_m, telemetry.home.value.north_m) == (488.0, None)
    telemetry.receive(messages.GpsGlobalOrigin(473977000, 85456000, 488000))
    assert telemetry.origin.value.altitude_amsl_m == 488.0


def test_wind_of_both_autopilots(telemetry: Telemetry) -> None:
    telemetry.receive(messages.Wind(-90.0, 5.0, -1.0))
    assert (telemetry.wind.value.direction_deg, telemetry.wind.value.speed_m_s) == (270.0, 5.0)
    telemetry.receive(messages.WindCov(0, 3.0, 4.0, NAN, 0, 0, 0, 0, 0))
    assert telemetry.wind.value.speed_m_s == 5.0
    assert telemetry.wind.value.direction_deg == pytest.approx(180 + math.degrees(math.atan2(4, 3)))
    assert telemetry.wind.value.down_m_s is None
    telemetry.receive(messages.WindCov(0, NAN, NAN, NAN, 0, 0, 0, 0, 0))
    assert telemetry.wind.value.speed_m_s == 5.0


# -------------------------------------------------------------------- several devices of one kind


def gps(fix_type: int = 3, satellites: int = 9) -> messages.GpsRawInt:
    return messages.GpsRawInt(0, fix_type, 473977000, 85456000, 488000, 121, U16, U16, 9000, satellites)


def test_gps_receivers_are_kept_separately(telemetry: Telemetry) -> None:
    second = messages.Gps2Raw(0, 6, 473977000, 85456000, 488000, 80, 90, 100, U16, 12, 0, 0, yaw=36000, h_acc=14)
    telemetry.receive(second)
    telemetry.receive(gps())
    first_receiver, second_receiver = telemetry.gps.value
    assert (first_receiver.index, first_receiver.hdop, first_receiver.vdop) == (0, 1.21, None)
    assert (first_receiver.ground_speed_m_s, first_receiver.course_deg) == (None, 90.0)
    assert (first_receiver.yaw_deg, first_receiver.horizontal_accuracy_m) == (None, None)
    assert (second_receiver.yaw_deg, second_receiver.horizontal_accuracy_m) == (0.0, 0.014)
    assert second_receiver.course_deg is None


def test_gps_without_fix_has_no_position(telemetry: Telemetry) -> None:
    telemetry.receive(gps(fix_type=1, satellites=255))
    (receiver,) = telemetry.gps.value
    assert (receiver.latitude_deg, receiver.altitude_amsl_m, receiver.satellites) == (None, None, None)


def battery(number: int, voltages: list[int], **fields: Any) -> messages.BatteryStatus:
    cells = (*voltages, *(U16,) * (10 - len(voltages)))
    values: dict[str, Any] = {
        "temperature": 0x7FFF,
        "current_battery": -1,
        "current_consumed": -1,
        "energy_consumed": -1,
    }
    values |= {"battery_remaining": -1} | fields
    return messages.BatteryStatus(number, 0, 0, voltages=cells, **values)


def test_battery_with_and_without_cells_is_decoded(telemetry: Telemetry) -> None:
    telemetry.receive(battery(1, [4100, 4050, 4000], current_battery=1234, current_consumed=500))
    telemetry.receive(battery(0, [12600]))
    first, second = telemetry.batteries.value
    assert (first.id, first.voltage_v, first.cell_voltages_v) == (0, 12.6, ())
    assert (first.current_a, first.remaining_percent, first.consumed_mah) == (None, None, None)
    assert (first.temperature_c, first.time_remaining_s) == (None, None)
    assert second.cell_voltages_v == (4.1, 4.05, 4.0)
    assert second.voltage_v == pytest.approx(12.15)
    assert (second.current_a, second.consumed_mah) == (12.34, 500)


def test_battery_voltage_of_zero_is_unknown_unlike_zero_of_cell(telemetry: Telemetry) -> None:
    telemetry.receive(battery(0, [0]))
    telemetry.receive(battery(1, [4100, 0, 4000]))
    unmeasured, with_dead_cell = telemetry.batteries.value
    assert (unmeasured.voltage_v, unmeasured.cell_voltages_v) == (None, ())
    assert with_dead_cell.cell_voltages_v == (4.1, 0.0, 4.0)


def test_battery_with_many_cells_or_high_voltage(telemetry: Telemetry) -> None:
    telemetry.receive(battery(0, [4000] * 10, voltages_ext=(4000, 4000, 0, 0)))
    assert len(telemetry.batteries.value[0].cell_voltages_v) == 12
    telemetry.receive(battery(0, [65534, 10000]))
    assert telemetry.batteries.value[0].voltage_v == pytest.approx(75.534)
    assert telemetry.batteries.value[0].cell_voltages_v == ()


def sys_status(voltage: int = 12600, remaining: int = 80, health: int = 0) -> messages.SysStatus:
    return messages.SysStatus(0x10000020, 0x10000020, health, 250, voltage, 150, remaining, 0, 0, 0, 0, 0, 0)


def test_sys_status_battery_is_fallback(telemetry: Telemetry, clock: Clock) -> None:
    telemetry.receive(sys_status())
    assert (telemetry.batteries.value[0].voltage_v, telemetry.batteries.value[0].current_a) == (12.6, 1.5)
    telemetry.receive(battery(0, [12500], battery_remaining=79))
    telemetry.receive(sys_status())
    assert telemetry.batteries.value[0].remaining_percent == 79
    clock.now = 10
    telemetry.receive(sys_status(voltage=U16, remaining=-1))
    assert telemetry.batteries.value[0].remaining_percent == 79


def test_px4_current_minus_one_is_unknown(clock: Clock) -> None:
    telemetry = vehicle(clock, PX4)
    telemetry.receive(battery(0, [15300], current_battery=-100, current_consumed=-25))
    assert (telemetry.batteries.value[0].current_a, telemetry.batteries.value[0].consumed_mah) == (None, None)


def test_distance_sensors(telemetry: Telemetry) -> None:
    telemetry.receive(messages.DistanceSensor(0, 20, 4000, 512, 0, 1, 25, 0, signal_quality=80))
    telemetry.receive(messages.DistanceSensor(0, 20, 4000, 0, 0, 0, 0, 0, signal_quality=1))
    telemetry.receive(messages.Rangefinder(9.9, 0))
    front, down = telemetry.range_finders.value
    assert (front.id, front.distance_m, front.quality_percent) == (0, None, None)
    assert (down.distance_m, down.max_distance_m, down.orientation, down.quality_percent) == (
        5.12,
        40.0,
        25,
        80,
    )


def test_rangefinder_message_without_distance_sensor_is_used(telemetry: Telemetry) -> None:
    telemetry.receive(messages.Rangefinder(2.5, 0))
    assert (telemetry.range_finders.value[0].distance_m, telemetry.range_finders.value[0].orientation) == (
        2.5,
        25,
    )


def servos(port: int, first: int) -> messages.ServoOutputRaw:
    return messages.ServoOutputRaw(0, port, *range(first, first + 16))


def test_servo_outputs_of_two_ports(telemetry: Telemetry) -> None:
    telemetry.receive(servos(1, 2000))
    assert telemetry.servo_outputs.value.outputs_us == (*(0,) * 16, *range(2000, 2016))
    telemetry.receive(servos(0, 1000))
    assert telemetry.servo_outputs.value.outputs_us == (*range(1000, 1016), *range(2000, 2016))


def test_mavlink_1_has_eight_servo_outputs(telemetry: Telemetry) -> None:
    telemetry.receive(received(servos(0, 1000), version=1))
    assert telemetry.servo_outputs.value.outputs_us == tuple(range(1000, 1008))


def test_rc_channels(telemetry: Telemetry) -> None:
    telemetry.receive(messages.RcChannels(*(0, 3, 1500, U16, 1100), *(U16,) * 15, rssi=255))
    assert (telemetry.rc_channels.value.channels_us, telemetry.rc_channels.value.rssi) == (
        (1500, None, 1100),
        None,
    )


# --------------------------------------------------------------------------------------- health


def test_sensors(telemetry: Telemetry) -> None:
    telemetry.receive(sys_status())
    sensors = telemetry.sensors.value
    assert (sensors.failing, sensors.prearm_checks_pass, sensors.load_percent) == (("GPS",), False, 25.0)


def test_estimator_health_of_both_autopilots_is_decoded(telemetry: Telemetry, clock: Clock) -> None:
    telemetry.receive(messages.EkfStatusReport(831, 0.1, 0.2, 0.3, 0.4, NAN))
    estimator = telemetry.estimator.value
    assert (estimator.message, estimator.missing, estimator.terrain_ratio) == ("EKF_STATUS_REPORT", (), None)
    assert estimator.has_absolute_position
    px4 = vehicle(clock, PX4)
    px4.receive(messages.EstimatorStatus(0, 0x27, 0.1, 0.2, 0.3, 0.4, 0.5, NAN, 0.6, 0.7))
    assert px4.estimator.value.missing == ("absolute horizontal position",)
    assert px4.estimator.value.airspeed_ratio is None
    assert px4.estimator.value.vertical_accuracy_m == pytest.approx(0.7)


def test_mission_time_vibration_version(telemetry: Telemetry) -> None:
    telemetry.receive(messages.MissionCurrent(0, U16, 1))
    assert (telemetry.mission_current.value.current, telemetry.mission_current.value.state) == (None, 1)
    telemetry.receive(messages.MissionCurrent(3))
    assert (telemetry.mission_current.value.current, telemetry.mission_current.value.total) == (3, None)
    telemetry.receive(messages.MissionItemReached(2))
    assert telemetry.mission_reached.value == 2
    telemetry.receive(messages.SystemTime(0, 1500))
    assert (telemetry.system_time.value.unix_s, telemetry.system_time.value.since_boot_s) == (None, 1.5)
    telemetry.receive(messages.SystemTime(1_795_227_537_766_908, 1500))
    assert telemetry.system_time.value.unix_s == 1795227537.766908
    telemetry.receive(messages.Vibration(0, 1.0, 2.0, 3.0, 4, 5, 6))
    assert telemetry.vibration.value.clippings == (4, 5, 6)
    blank = bytes(8)
    telemetry.receive(messages.AutopilotVersion(0xFBEF, 0x04070000, 0, 0, 0, b"21910f24", blank, blank, 0, 0, 0))
    assert (str(telemetry.version.value), telemetry.capabilities.value) == ("4.7.0-dev (21910f24)", 0xFBEF)


# ---------------------------------------------------------------------------------------- texts


def test_status_texts_are_published_and_kept(telemetry: Telemetry, clock: Clock) -> None:
    observed: list[str] = []
    telemetry.status_text.observe(lambda _, text: observed.append(text.text))
    for clock.now in (1.0, 2.0):
        telemetry.receive(messages.Statustext(4, "PreArm: RC not found"))
    assert observed == ["PreArm: RC not found"] * 2
    assert [text.at for text in telemetry.texts_since(1.5)] == [2.0]


def test_status_text_end_lost_is_delivered_in_time(telemetry: Telemetry, clock: Clock) -> None:
    telemetry.receive(messages.Statustext(4, "x" * 50, 1, 0))
    assert not telemetry.status_text.is_known
    clock.now = 3.0
    telemetry.expire(clock.now)
    assert telemetry.status_text.value.text == "x" * 50 + "…"


# ------------------------------------------------------------------------------- whole telemetry


def test_forget_keeps_status_texts(telemetry: Telemetry) -> None:
    telemetry.receive(heartbeat())
    telemetry.receive(messages.Statustext(6, "hello"))
    telemetry.forget()
    assert [cell.name for cell in telemetry.cells.values() if cell.is_known] == []
    assert telemetry.texts_since(-1)[0].text == "hello"


@pytest.mark.anyio
async def test_telemetry_close_ends_all_waits(telemetry: Telemetry) -> None:
    telemetry.close(ConnectionClosed("closed"))
    for cell in telemetry.cells.values():
        with pytest.raises(ConnectionClosed):
            await cell.wait_until(lambda _: True)


def test_required_messages_exist_for_every_cell(telemetry: Telemetry, clock: Clock) -> None:
    for name in telemetry.cells:
        for message in telemetry.required_messages(name):
            assert message.ID in telemetry.handles
        assert getattr(telemetry, name).name == name
    assert telemetry.required_messages("estimator") == (messages.EkfStatusReport,)
    px4 = vehicle(clock, PX4)
    assert px4.required_messages("estimator") == (messages.EstimatorStatus,)
    assert px4.required_messages("wind") == (messages.WindCov,)
    assert messages.EstimatorStatus in px4.default_rates
    assert messages.EkfStatusReport not in px4.default_rates


def test_unknown_cell_name_raises(telemetry: Telemetry) -> None:
    with pytest.raises(KeyError):
        telemetry.required_messages("nonsense")
