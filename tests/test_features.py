"""docs/features.md and features-onboard.md have an equivalent, or a reason, for each call of MAVSDK."""

from __future__ import annotations

import ast
import importlib.util
import inspect
import re
from collections.abc import Iterator
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any

import pytest
from for_each import for_each

import aerokit
from aerokit import messages, missions, onboard
from aerokit.sim import SimulatedCamera, SimulatedCopter, simulated_link
from aerokit.testing import run_virtual
from aerokit.transport import memory_link_pair

DOCS = Path(__file__).parent.parent / "docs"
PAGE, ONBOARD_PAGE = DOCS / "features.md", DOCS / "features-onboard.md"
ROW = re.compile(r"^\| `(\w+)\.(\w+)` \| (.*) \|$", re.M)
CALLS = {
    "action": """
        arm arm_force disarm takeoff land reboot shutdown terminate kill return_to_launch goto_location
        goto_location_fixedwing do_orbit hold set_actuator set_relay transition_to_fixedwing
        transition_to_multicopter get_takeoff_altitude set_takeoff_altitude get_return_to_launch_altitude
        set_return_to_launch_altitude set_current_speed set_gps_global_origin set_home
    """,
    "calibration": """
        calibrate_gyro calibrate_accelerometer calibrate_magnetometer calibrate_level_horizon
        calibrate_gimbal_accelerometer cancel
    """,
    "camera": """
        take_photo start_photo_interval stop_photo_interval start_video stop_video start_video_streaming
        stop_video_streaming set_mode list_photos camera_list get_mode get_video_stream_info
        subscribe_capture_info get_storage get_current_settings get_possible_setting_options set_setting
        get_setting format_storage reset_settings zoom_in_start zoom_out_start zoom_stop zoom_range track_point
        track_rectangle track_stop focus_in_step focus_out_step focus_in_start focus_out_start focus_stop
        focus_range focus_meters focus_auto focus_auto_single focus_auto_continuous
    """,
    "component_metadata": "request_component request_autopilot_component subscribe_metadata_available get_metadata",
    "core": "subscribe_connection_state set_mavlink_timeout",
    "events": "subscribe_events subscribe_health_and_arming_checks get_health_and_arming_checks_report",
    "failure": "inject",
    "follow_me": "get_config set_config is_active set_target_location get_last_location start stop",
    "ftp": """
        download upload list_directory create_directory remove_directory remove_file rename are_files_identical
        set_target_compid
    """,
    "geofence": "upload_geofence download_geofence clear_geofence",
    "gimbal": """
        set_angles set_angular_rates set_roi_location take_control release_control gimbal_list
        get_control_status get_attitude
    """,
    "gripper": "grab release",
    "info": "get_identification get_product get_version get_speed_factor subscribe_flight_information",
    "log_files": "get_entries download_log_file cancel_download_log_file erase_all_log_files",
    "log_streaming": "start_log_streaming stop_log_streaming subscribe_log_streaming_raw",
    "manual_control": "start_position_control start_altitude_control set_manual_control_input",
    "mavlink_direct": "send_message subscribe_message load_custom_xml send_command",
    "mission": """
        upload_mission upload_mission_with_progress cancel_mission_upload download_mission
        download_mission_with_progress cancel_mission_download start_mission pause_mission clear_mission
        set_current_mission_item is_mission_finished mission_progress get_return_to_launch_after_mission
        set_return_to_launch_after_mission
    """,
    "mission_raw": """
        upload_mission upload_mission_with_progress upload_geofence upload_rally_points cancel_mission_upload
        download_mission download_geofence download_rallypoints cancel_mission_download start_mission
        pause_mission clear_mission set_current_mission_item mission_progress subscribe_mission_changed
        import_qgroundcontrol_mission import_qgroundcontrol_mission_from_string import_mission_planner_mission
        import_mission_planner_mission_from_string is_mission_finished
    """,
    "mocap": """
        set_vision_position_estimate set_vision_speed_estimate set_attitude_position_mocap set_odometry
    """,
    "offboard": """
        start stop is_active set_attitude set_actuator_control set_attitude_rate set_position_ned
        set_position_global set_velocity_body set_velocity_ned set_position_velocity_ned
        set_position_velocity_acceleration_ned set_acceleration_ned
    """,
    "param": """
        get_param_int set_param_int get_param_float set_param_float get_param_custom set_param_custom
        get_all_params select_component
    """,
    "rtk": "send_rtcm_data",
    "shell": "send subscribe_receive",
    "telemetry": """
        position home in_air landed_state armed vtol_state attitude_quaternion attitude_euler
        attitude_angular_velocity_body velocity_ned gps_info raw_gps battery flight_mode health rc_status
        status_text actuator_control_target actuator_output_status odometry position_velocity_ned ground_truth
        fixedwing_metrics imu scaled_imu raw_imu health_all_ok unix_epoch_time distance_sensor scaled_pressure
        heading altitude wind set_rate_position set_rate_home set_rate_in_air set_rate_landed_state
        set_rate_vtol_state set_rate_attitude_quaternion set_rate_attitude_euler set_rate_velocity_ned
        set_rate_gps_info set_rate_raw_gps set_rate_battery set_rate_rc_status set_rate_actuator_control_target
        set_rate_actuator_output_status set_rate_odometry set_rate_position_velocity_ned set_rate_ground_truth
        set_rate_fixedwing_metrics set_rate_imu set_rate_scaled_imu set_rate_raw_imu set_rate_unix_epoch_time
        set_rate_distance_sensor set_rate_altitude set_rate_health get_gps_global_origin
    """,
    "transponder": "transponder set_rate_transponder",
    "tune": "play_tune",
    "winch": """
        status relax relative_length_control rate_control lock deliver hold retract load_line abandon_line
        load_payload
    """,
}
"""Calls of MAVSDK 4.1 by plugin; ``get_`` and ``subscribe_`` of one thing are one call. The wheel lacks ``core``."""
SERVER_CALLS = {
    "action_server": """
        subscribe_arm_disarm subscribe_flight_mode_change subscribe_takeoff subscribe_land subscribe_reboot
        subscribe_shutdown subscribe_terminate set_allow_takeoff set_armable set_disarmable set_allowable_flight_modes
        get_allowable_flight_modes set_armed_state set_flight_mode set_flight_mode_internal
    """,
    "arm_authorizer_server": "subscribe_arm_authorization accept_arm_authorization reject_arm_authorization",
    "camera_server": """
        set_information set_video_streaming set_in_progress subscribe_take_photo subscribe_start_video
        subscribe_stop_video subscribe_start_video_streaming subscribe_stop_video_streaming subscribe_set_mode
        subscribe_storage_information subscribe_capture_status subscribe_format_storage subscribe_reset_settings
        subscribe_zoom_in_start subscribe_zoom_out_start subscribe_zoom_stop subscribe_zoom_range set_zoom_factor
        subscribe_focus_in_start subscribe_focus_out_start subscribe_focus_stop subscribe_focus_range
        subscribe_focus_in_step subscribe_focus_out_step subscribe_focus_meters subscribe_focus_auto
        subscribe_focus_auto_single subscribe_focus_auto_continuous subscribe_tracking_point_command
        subscribe_tracking_rectangle_command subscribe_tracking_off_command set_tracking_rectangle_status
        set_tracking_off_status set_position set_attitude_quaternion set_field_of_view
    """,
    "component_metadata_server": "set_metadata",
    "ftp_server": "set_root_dir",
    "mission_raw_server": """
        subscribe_incoming_mission subscribe_current_item_changed subscribe_clear_all set_current_item_complete
    """,
    "param_server": """
        set_protocol provide_param_int provide_param_float provide_param_custom retrieve_param_int
        retrieve_param_float retrieve_param_custom retrieve_all_params subscribe_changed_param_int
        subscribe_changed_param_float subscribe_changed_param_custom
    """,
    "server_utility": "send_status_text",
    "telemetry_server": """
        publish_position publish_home publish_attitude publish_visual_flight_rules_hud publish_raw_gps
        publish_battery publish_sys_status publish_extended_sys_state publish_status_text publish_odometry
        publish_position_velocity_ned publish_ground_truth publish_imu publish_scaled_imu publish_raw_imu
        publish_unix_epoch_time publish_distance_sensor
    """,
}
"""Server calls of MAVSDK 4.1 by plugin; ``respond_`` belongs to ``subscribe_``."""
UNNAMED = {"subscribe_capture_status", "get_allowable_flight_modes", "set_protocol"}
"""Server calls without a named equivalent, because nothing is to be called."""
PENDING: set[str] = set()
"""Names on the page that are not built yet. Remove a name when it exists; a test fails otherwise."""
MIN_FULL = 235


def rows(page: Path = PAGE) -> list[tuple[str, str, str]]:
    return ROW.findall(page.read_text(encoding="utf-8"))


@pytest.mark.parametrize(("page", "calls"), [(PAGE, CALLS), (ONBOARD_PAGE, SERVER_CALLS)], ids=lambda given: "")
def test_every_call_has_one_row(page: Path, calls: dict[str, str]) -> None:
    listed = [(plugin, call) for plugin, call, _ in rows(page)]
    assert len(listed) == len(set(listed))
    assert set(listed) == {(plugin, call) for plugin, names in calls.items() for call in names.split()}
    assert f"makes {len(listed)} rows" in page.read_text(encoding="utf-8")


def names_in(answer: str) -> list[str]:
    return re.findall(r"`((?:\w+\.)+\w+)(?:\([^`]*\))?`", answer)


@pytest.fixture(scope="module")
def missing() -> set[str]:
    """Names on the page that do not exist on a vehicle."""

    async def find_missing() -> set[str]:
        copter = SimulatedCopter(boot_time_s=0.0, components=[SimulatedCamera()])
        async with simulated_link(copter) as link, aerokit.connect(link) as vehicle:
            roots: dict[str, Any] = {
                "vehicle": vehicle,
                "camera": vehicle.camera,
                "component": vehicle.component(100),
                "connection": vehicle.connection,
                "gimbal": vehicle.gimbal,
                "gripper": vehicle.gripper(),
                "winch": vehicle.winch(),
                "shell": vehicle.shell(),
                "missions": missions,
                "aerokit": aerokit,
            }
            named = {name for *_, answer in rows() for name in names_in(answer)}
            return {name for name in named if not exists(roots, name)}

    return run_virtual(find_missing())


def exists(roots: dict[str, Any], name: str) -> bool:
    root, _, rest = name.partition(".")
    try:
        _ = attrgetter(rest)(roots[root]) if rest else roots[root]
    except (AttributeError, KeyError):
        return False
    return True


def calls_in(answer: str) -> Iterator[ast.expr]:
    """Parse the code of a row; ``…`` stands for further arguments."""
    for code in re.findall(r"`([^`]+)`", answer):
        text = code.replace(", …", "").replace("(…, ", "(").replace("=…", "=0").replace("[…]", "[]").replace("…", "")
        yield ast.parse(text, mode="eval").body


def wrong_in(roots: dict[str, Any], answer: str) -> list[str]:
    """Return attributes that do not exist, and calls whose arguments have other names, in the code of a row."""
    wrong = []
    for node in (node for expression in calls_in(answer) for node in ast.walk(expression)):
        if isinstance(node, ast.Attribute) and not exists(roots, ast.unparse(node)):
            wrong.append(ast.unparse(node))
        elif isinstance(node, ast.Call) and exists(roots, name := ast.unparse(node.func)):
            root, _, rest = name.partition(".")
            known = inspect.signature(attrgetter(rest)(roots[root]) if rest else roots[root]).parameters
            wrong.extend(f"{name}({word.arg}=)" for word in node.keywords if word.arg not in known)
    return wrong


def test_rows_of_components_name_attributes_and_arguments_that_exist() -> None:
    async def check() -> None:
        near, _ = memory_link_pair()
        async with aerokit.component(near) as component:
            roots: dict[str, Any] = {
                "component": component,
                "camera": onboard.CameraDriver(),
                "autopilot": onboard.AutopilotDriver(),
                "messages": messages,
                "CameraDriver": onboard.CameraDriver,
            }
            wrong = {call: found for _, call, answer in rows(ONBOARD_PAGE) if (found := wrong_in(roots, answer))}
            assert wrong == {}
            assert wrong_in(roots, "`camera.fly()`, `CameraDriver(lens=1)`") == [
                "camera.fly",
                "CameraDriver(lens=)",
            ]

    run_virtual(check())
    unnamed = {call for *_, call, answer in rows(ONBOARD_PAGE) if "`" not in answer}
    assert unnamed == UNNAMED


@for_each("plugin, call, answer", rows())
def test_row_names_existing_attribute_or_gives_reason(plugin: str, call: str, answer: str, missing: set[str]) -> None:
    names = names_in(answer)
    assert names or answer.startswith("no: "), f"{plugin}.{call} has no name and no reason"
    assert not missing.intersection(names) - PENDING, f"{plugin}.{call} names a missing attribute"


def test_pending_names_are_missing(missing: set[str]) -> None:
    assert PENDING - missing == set(), "built: remove them from PENDING"


def test_most_calls_have_full_equivalent() -> None:
    limited = [answer for *_, answer in rows() if answer.startswith(("no: ", "partly: "))]
    assert len(rows()) - len(limited) >= MIN_FULL


@pytest.mark.skipif(importlib.util.find_spec("mavsdk") is None, reason="MAVSDK is not installed")
def test_calls_are_those_of_installed_mavsdk() -> None:
    spec = importlib.util.find_spec("mavsdk")
    assert spec is not None
    assert spec.origin is not None
    plugins = Path(spec.origin).parent / "asyncio" / "plugins"
    for plugin in (path.name for path in plugins.iterdir() if (path / f"{path.name}.py").is_file()):
        tree = ast.parse((plugins / plugin / f"{plugin}.py").read_text())
        classes = [node for node in tree.body if isinstance(node, ast.ClassDef) and node.name.endswith("Async")]
        methods = {
            node.name
            for node in classes[0].body
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)) and not node.name.startswith("_")
        }
        if plugin in SERVER_CALLS:
            expected = set(SERVER_CALLS[plugin].split())
            answers = {name.replace("respond_", "subscribe_") for name in methods if name.startswith("respond_")}
            assert answers <= expected
            assert expected == {name for name in methods if not name.startswith("respond_")} - {"destroy"}
        elif plugin != "mavlink_direct_server":  # a client of any ids, as `mavlink_direct`
            assert set(CALLS[plugin].split()) == {*map(partial(one_name, methods), methods)} - {"destroy"}


def one_name(methods: set[str], method: str) -> str:
    """Return the name of the row of a method: ``position`` for ``subscribe_position``, if there are both."""
    plain = method.removeprefix("subscribe_")
    return next((name for name in (plain, f"get_{plain}") if name in methods), method)
