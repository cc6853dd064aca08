"""docs/features.md has an equivalent, or a reason, for each MAVSDK call about components."""

from __future__ import annotations

import ast
import importlib.util
import re
from operator import attrgetter
from pathlib import Path
from typing import Any

import pytest
from for_each import for_each

import aerokit
from aerokit.sim import SimulatedCamera, SimulatedCopter, simulated_link
from aerokit.testing import run_virtual

PAGE = Path(__file__).parent.parent / "docs" / "features.md"
ROW = re.compile(r"^\| `(\w+)\.(\w+)` \| (.*) \|$", re.M)
CALLS = {
    "camera": """
        take_photo start_photo_interval stop_photo_interval start_video stop_video start_video_streaming
        stop_video_streaming set_mode list_photos camera_list get_mode get_video_stream_info subscribe_capture_info
        get_storage get_current_settings get_possible_setting_options set_setting get_setting format_storage
        reset_settings zoom_in_start zoom_out_start zoom_stop zoom_range track_point track_rectangle track_stop
        focus_in_step focus_out_step focus_in_start focus_out_start focus_stop focus_range focus_meters focus_auto
        focus_auto_single focus_auto_continuous
    """,
    "gimbal": """
        set_angles set_angular_rates set_roi_location take_control release_control gimbal_list get_control_status
        get_attitude
    """,
    "info": "get_identification get_product get_version get_speed_factor subscribe_flight_information",
    "param": """
        get_param_int set_param_int get_param_float set_param_float get_param_custom set_param_custom get_all_params
        select_component
    """,
    "ftp": """
        download upload list_directory create_directory remove_directory remove_file rename are_files_identical
        set_target_compid
    """,
    "component_metadata": "request_component request_autopilot_component subscribe_metadata_available get_metadata",
}
"""Calls of MAVSDK 4.1 by plugin; ``get_`` and ``subscribe_`` of one thing are one call."""


def rows() -> list[tuple[str, str, str]]:
    return ROW.findall(PAGE.read_text(encoding="utf-8"))


def test_every_call_has_one_row() -> None:
    listed = [(plugin, call) for plugin, call, _ in rows()]
    assert len(listed) == len(set(listed))
    assert set(listed) == {(plugin, call) for plugin, calls in CALLS.items() for call in calls.split()}


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
            }
            named = {name for *_, answer in rows() for name in names_in(answer)}
            return {name for name in named if not exists(roots, name)}

    return run_virtual(find_missing())


def exists(roots: dict[str, Any], name: str) -> bool:
    root, _, rest = name.partition(".")
    try:
        attrgetter(rest)(roots[root])
    except (AttributeError, KeyError):
        return False
    return True


@for_each("plugin, call, answer", rows())
def test_row_names_existing_attribute_or_gives_reason(plugin: str, call: str, answer: str, missing: set[str]) -> None:
    names = names_in(answer)
    assert names or answer.startswith("no: "), f"{plugin}.{call} has no name and no reason"
    assert not missing.intersection(names), f"{plugin}.{call} names a missing attribute"


@pytest.mark.skipif(importlib.util.find_spec("mavsdk") is None, reason="MAVSDK is not installed")
def test_calls_are_those_of_installed_mavsdk() -> None:
    spec = importlib.util.find_spec("mavsdk")
    assert spec is not None
    assert spec.origin is not None
    plugins = Path(spec.origin).parent / "asyncio" / "plugins"
    for plugin, calls in CALLS.items():
        tree = ast.parse((plugins / plugin / f"{plugin}.py").read_text())
        classes = [node for node in tree.body if isinstance(node, ast.ClassDef) and node.name.endswith("Async")]
        methods = {node.name for node in ast.walk(classes[0]) if isinstance(node, ast.AsyncFunctionDef)}
        for call in calls.split():
            assert call in methods or call.removeprefix("subscribe_") in methods or f"subscribe_{call}" in methods
