"""`PlanContext`: what the transfers of missions, fences and rally points of one vehicle share."""

from __future__ import annotations

import asyncio
import math
from typing import TYPE_CHECKING, Protocol

import anyio

from aerokit.mavlink.messages import MissionCurrent
from aerokit.vehicle.missions.mission_progress import MissionWatch

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from aerokit.autopilots.base import Autopilot
    from aerokit.mavlink.frame import Frame
    from aerokit.missions.item import MissionItem
    from aerokit.position import Position
    from aerokit.protocols.exchange import OnProgress
    from aerokit.vehicle.commanding.context import Bridge
    from aerokit.vehicle.session.session import Talk
    from aerokit.vehicle.session.transfers import Transfers

FRESH_IDS_S = 2.5
"""MISSION_CURRENT comes at 1 Hz."""


class PlanFiles(Protocol):
    """What transfers of plans ask of the vehicle's files."""

    async def read(self, path: str, *, patience_s: float, on_progress: OnProgress | None) -> bytes:
        """Return the whole file."""
        ...

    async def write(
        self, path: str, data: bytes, *, patience_s: float, on_progress: OnProgress | None
    ) -> None:
        """Write the whole file."""


class PlanMemory:
    """What one kind of plan was when it was last sent or read, counted as the vehicle counts, and by which way."""

    def __init__(self) -> None:
        self.items: tuple[MissionItem, ...] | None = None
        self.learned_at: float = -math.inf
        self.has_file: bool | None = None
        """Whether the vehicle has a file of it; None: not tried yet."""

    def learn(self, items: Sequence[MissionItem], now: float) -> None:
        """The vehicle holds these."""
        self.items, self.learned_at = tuple(items), now

    def forget(self, now: float) -> None:
        """The vehicle may hold anything from now on."""
        self.items = None
        self.learned_at = now


class PlanContext:
    """One lock, since autopilots have one state for the transfers of all three; what MISSION_CURRENT calls them, and
    how far the mission is.

    ``files``: gives the vehicle's files when they are needed.
    """

    def __init__(self, bridge: Bridge, files: Callable[[], PlanFiles]) -> None:
        self.bridge: Bridge = bridge
        self.talk: Talk = bridge.talk
        self.files: Callable[[], PlanFiles] = files
        self.transfers: Transfers = bridge.talk.transfers
        self.autopilot: Autopilot = bridge.talk.autopilot
        self.lock: asyncio.Lock = asyncio.Lock()
        self.memories: tuple[PlanMemory, PlanMemory, PlanMemory] = (PlanMemory(), PlanMemory(), PlanMemory())
        """By MAV_MISSION_TYPE."""
        self._current: Frame | None = None
        talk = bridge.talk
        talk.at_close(
            talk.connection.bus.attach_frames(MissionCurrent, self._note_current, system_id=talk.system_id)
        )
        self.watch: MissionWatch = MissionWatch(talk)

    def now(self) -> float:
        """Seconds on the loop's clock."""
        return self.talk.connection.now()

    def offset_of(self, mission_type: int) -> int:
        """How much higher the vehicle counts items than the program does: home may be its item 0."""
        return int(mission_type == 0 and self.autopilot.home_is_item_0)

    @property
    def home(self) -> Position | None:
        """Where the vehicle says that its home is."""
        home = self.talk.telemetry.home.latest
        return None if home is None else home.position.replace(altitude_amsl_m=home.altitude_amsl_m)

    @property
    def is_flown(self) -> bool:
        """Whether the vehicle is flying its mission."""
        mode = self.autopilot.mode_for("mission", is_vtol=self.talk.telemetry.is_vtol)
        return (
            mode is not None
            and self.talk.telemetry.is_in(mode)
            and not self.talk.telemetry.is_surely_disarmed
        )

    def id_of(self, mission_type: int, since: float) -> int:
        """What a MISSION_CURRENT that came lately, and after ``since``, calls the plan; 0 where it does not."""
        frame = self._current
        if frame is None or frame.received_at <= since or self.now() - frame.received_at > FRESH_IDS_S:
            return 0
        current = MissionCurrent.decode_body(frame.body)
        return (current.mission_id, current.fence_id, current.rally_points_id)[mission_type]

    async def is_called(self, mission_type: int, opaque_id: int) -> bool:
        """Whether MISSION_CURRENT, waited for, calls the plan so."""
        told, now = asyncio.Event(), self.now()

        def look(_: MissionCurrent) -> None:
            if self.id_of(mission_type, now) == opaque_id:
                told.set()

        detach = self.talk.connection.bus.attach(MissionCurrent, look, system_id=self.talk.system_id)
        try:
            with anyio.move_on_after(FRESH_IDS_S):
                await told.wait()
        finally:
            detach()
        return told.is_set()

    def _note_current(self, frame: Frame) -> None:
        if self.talk.telemetry.accepts(frame):
            self._current = frame
