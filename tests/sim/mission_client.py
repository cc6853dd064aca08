"""Raw mission transfers for tests of simulated vehicles."""

from __future__ import annotations

from collections.abc import Sequence

from simulated_client import Client

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd
from aerokit.missions import MissionItem

WAYPOINT, TAKE_OFF, LAND, RETURN = (
    MavCmd.NAV_WAYPOINT,
    MavCmd.NAV_TAKEOFF,
    MavCmd.NAV_LAND,
    MavCmd.NAV_RETURN_TO_LAUNCH,
)
VERTEX, CIRCLE, RALLY = (
    MavCmd.NAV_FENCE_POLYGON_VERTEX_INCLUSION,
    MavCmd.NAV_FENCE_CIRCLE_INCLUSION,
    MavCmd.NAV_RALLY_POINT,
)
# Position of the simulated copter.
NORTH, EAST = -353_632_610, 1_491_652_299


def item(
    command: int,
    frame: int,
    param1: float = 0.0,
    param2: float = 0.0,
    param3: float = 0.0,
    param4: float = 0.0,
    x: int = 0,
    y: int = 0,
    z: float = 0.0,
    autocontinue: bool = True,
) -> MissionItem:
    return MissionItem(command, frame, param1, param2, param3, param4, x, y, z, autocontinue)


HOME = item(WAYPOINT, 0)


def message(one: MissionItem, seq: int, mission_type: int = 0, current: int = 0) -> m.MissionItemInt:
    head = (seq, one.frame, one.command, current, int(one.autocontinue))
    numbers = (one.param1, one.param2, one.param3, one.param4)
    return m.MissionItemInt(1, 1, *head, *numbers, round(one.x), round(one.y), one.z, mission_type)


def results(client: Client) -> list[int]:
    return [ack.type for ack in client.all(m.MissionAck)]


def upload(client: Client, items: Sequence[MissionItem], mission_type: int = 0) -> int:
    """Send the requested items; return the result."""
    first = len(client.received)
    client.send(m.MissionCount(1, 1, len(items), mission_type))
    for _ in range(len(items) + 1):
        new = [received for _, received in client.received[first:]]
        acks = [received for received in new if isinstance(received, m.MissionAck)]
        if acks:
            return acks[-1].type
        asked = [received.seq for received in new if isinstance(received, m.MissionRequest | m.MissionRequestInt)]
        client.send(message(items[asked[-1]], asked[-1], mission_type))
    acks = [received for _, received in client.received[first:] if isinstance(received, m.MissionAck)]
    return acks[-1].type


def download(client: Client, mission_type: int = 0) -> list[MissionItem]:
    client.send(m.MissionRequestList(1, 1, mission_type))
    items = []
    for seq in range(client.last(m.MissionCount).count):
        client.send(m.MissionRequestInt(1, 1, seq, mission_type))
        back = client.last(m.MissionItemInt)
        assert (back.seq, back.mission_type, back.target_component) == (seq, mission_type, 190)
        numbers = (back.param1, back.param2, back.param3, back.param4, back.x, back.y, back.z)
        items.append(MissionItem(back.command, back.frame, *numbers, bool(back.autocontinue)))
    client.send(m.MissionAck(1, 1, 0, mission_type))
    return items
