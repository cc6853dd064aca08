"""Missions, fences and rally points between the client's protocol machines and simulated vehicles over bad radios."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from mission_client import CIRCLE, RALLY, VERTEX, WAYPOINT, item
from protocol_pair import KINDS, Pair, radios, seeds, vehicle_of

from aerokit.mavlink.enums import MavFrame, MavMissionType
from aerokit.mavlink.messages import MissionCurrent
from aerokit.missions import MissionItem
from aerokit.protocols.mission_download import MissionDownload
from aerokit.protocols.mission_upload import MissionUpload
from aerokit.protocols.missions import MissionClear, SetCurrentItem
from aerokit.testing.fault_model import FaultModel

# No shrinking: a failure reports radio and seed, and shrinking a transfer that hangs would take minutes.
few = settings(max_examples=6, phases=[Phase.generate])
each = pytest.mark.parametrize("kind", KINDS)
GLOBAL = MavFrame.GLOBAL_RELATIVE_ALT
MISSION, FENCE, POINTS = MavMissionType.MISSION, MavMissionType.FENCE, MavMissionType.RALLY
places = st.tuples(st.integers(47_390_0000, 47_400_0000), st.integers(8_540_0000, 8_550_0000))


def plan_of(mission_type: int, corners: Sequence[tuple[int, int]]) -> list[MissionItem]:
    if mission_type == MISSION:
        return [item(WAYPOINT, GLOBAL, x=x, y=y, z=20.0) for x, y in corners]
    if mission_type == FENCE:
        polygon = [item(VERTEX, MavFrame.GLOBAL, len(corners), x=x, y=y) for x, y in corners]
        return [*polygon, item(CIRCLE, MavFrame.GLOBAL, 90.0, x=corners[0][0], y=corners[0][1])]
    return [item(RALLY, GLOBAL, x=x, y=y, z=30.0) for x, y in corners]


def places_of(items: Sequence[MissionItem | None]) -> list[tuple[int, float, float, float]]:
    return [(one.command, one.param1, one.x, one.y) for one in items if one is not None]


def download(pair: Pair, mission_type: int) -> list[tuple[int, float, float, float]]:
    """Return the items on the vehicle, without home."""
    window = 1 if pair.is_px4 else 4
    came = pair.run(MissionDownload(1, 1, mission_type=mission_type, window=window, idle_timeout_s=60)).items
    pair.wait(6.0)  # PX4 is busy until it has our acknowledgement or times out.
    return places_of(came[mission_type == MISSION and not pair.is_px4 :])


@pytest.mark.sampled(3)
@each
@pytest.mark.parametrize("mission_type", [MISSION, FENCE, POINTS])
@few
@given(radio=radios, seed=seeds, corners=st.lists(places, min_size=3, max_size=12), window=st.integers(1, 6))
def test_downloaded_plan_equals_the_upload(
    kind: str, mission_type: int, radio: FaultModel, seed: int, corners: list[tuple[int, int]], window: int
) -> None:
    pair = Pair(vehicle_of(kind), radio, seed)
    items = plan_of(mission_type, corners)
    with_home = [item(WAYPOINT, 0), *items] if mission_type == MISSION and kind == "copter" else items
    for attempt in range(3):
        upload = MissionUpload(
            1, 1, with_home, window=window if attempt == 0 else 1, mission_type=mission_type, idle_timeout_s=60
        )
        if pair.run(upload).is_confirmed:
            break
        pair.wait(10.0)
    pair.wait(6.0)
    assert download(pair, mission_type) == places_of(items)
    assert download(Pair(pair.vehicle), mission_type) == places_of(items)
    pair.run(MissionClear(1, 1, mission_type=mission_type, idle_timeout_s=60))
    assert download(pair, mission_type) == []


@each
@few
@given(radio=radios, seed=seeds, seq=st.integers(1, 5))
def test_set_current_selects_the_item(kind: str, radio: FaultModel, seed: int, seq: int) -> None:
    vehicle = vehicle_of(kind)
    items = plan_of(MISSION, [(47_390_0000, 8_540_0000 + n) for n in range(6)])
    assert Pair(vehicle).run(MissionUpload(1, 1, items, window=1)).is_confirmed
    pair = Pair(vehicle, radio, seed)
    vehicle.channels[0].streams.set_interval(MissionCurrent.ID, 1.0, pair.now)
    pair.run(SetCurrentItem(1, 1, seq, idle_timeout_s=60))
    reported = vehicle.build(MissionCurrent.ID)
    assert isinstance(reported, MissionCurrent)
    assert reported.seq == seq
