"""What missions, fences and rally points of one vehicle share: one transfer at a time, what was sent or read last."""

from __future__ import annotations

import asyncio
import math
from typing import TYPE_CHECKING, Generic, Literal, Protocol, TypeVar

import anyio

from aerokit.arguments import checks_arguments
from aerokit.errors import LocalProtocolError
from aerokit.mavlink.messages import MissionCurrent
from aerokit.vehicle.checks import check_kind, check_seconds

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sequence

    from aerokit.mavlink.frame import Frame
    from aerokit.missions.item import MissionItem
    from aerokit.position import Position
    from aerokit.protocols.transfer import OnProgress
    from aerokit.vehicle.orders.bridge import Bridge
    from aerokit.vehicle.plans.transfer import Plan, PlanTransfer

__all__ = ["HeldPlan", "PlanContext", "PlanFiles", "PlanMemory", "PlanMethod"]

PlanT = TypeVar("PlanT", bound="Plan")
ResultT = TypeVar("ResultT")
PlanMethod = Literal["auto", "ftp", "items"]
METHODS = ("auto", "ftp", "items")
FRESH_IDS_S = 2.5
"""MISSION_CURRENT comes at 1 Hz."""
IDS_AT = (6, 10, 14)
"""Where in its payload ``mission_id``, ``fence_id`` and ``rally_points_id`` are: the dialect does not have them yet."""


@checks_arguments
class HeldPlan(Generic[PlanT]):
    """A mission, a fence or rally points that a vehicle holds.

    There is one transfer of them at a time with one vehicle; another one waits for its turn. Each can be cancelled at
    any moment, and the vehicle is told.
    """

    def __init__(self, context: PlanContext) -> None:
        self._context = context

    async def upload(
        self,
        plan: PlanT,
        *,
        method: PlanMethod = "auto",
        only_changes: bool = True,
        verify: bool = True,
        patience_s: float = 10.0,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> None:
        """Have the vehicle hold this plan instead of the one it holds; an empty one clears it.

        Args:
            plan: it is checked before anything is sent.
            method: ``"ftp"`` (ArduPilot's ``@MISSION/…`` files), ``"items"`` (the mission protocol), or what the
                vehicle has.
            only_changes: when it is known what the vehicle holds, from an upload or a download and confirmed by the
                vehicle, send nothing if it is the same, and only the items that differ if the vehicle takes them alone.
            verify: read it back and compare, or compare the checksum that PX4 tells when that is quicker. What was sent
                as a file is always read back.
            patience_s: give up after so many seconds without progress.
            timeout: seconds for all of it.
            on_progress: called with how far it is, in items, or in bytes of a file.

        See https://mavlink.io/en/services/mission.html. PX4 keeps the old items until it has all of the new ones.
        ArduPilot overwrites a mission and rally points one by one (a fence at the end), so that after a failure it
        holds a part of both: the error says so.

        Raises:
            LocalProtocolError: the plan cannot be right; nothing was sent.
            MissionRejected: the vehicle refused; ``item``, ``result`` and ``reasons`` tell what and why.
            MissionTimeout: it fell silent; ``missing`` are the items it did not confirm.
            VerificationFailed: it confirmed, and holds something else.
            NotSupported: ``"ftp"`` was asked for, and it has none.
            FileError, FileTimeout: the same for a file, with ``"ftp"``.
            OperationTimeout: not done within ``timeout``.
        """
        plan = self._checked(plan)

        async def work(transfer: PlanTransfer[PlanT]) -> None:
            await transfer.upload(plan, method, only_changes=only_changes, verify=verify)
            self._counted(len(plan.to_items()))

        await self._transfer(work, method, patience_s, timeout, on_progress)

    async def download(
        self,
        *,
        method: PlanMethod = "auto",
        patience_s: float = 10.0,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> PlanT:
        """Read what the vehicle holds; arguments as for :meth:`upload`.

        Raises:
            LocalProtocolError: an argument that cannot be right; nothing was sent.
            MissionRejected: the vehicle refused.
            MissionTimeout: items are missing in the end; ``missing`` has them.
            RemoteProtocolError: what it sent makes no sense.
            NotSupported, FileError, FileTimeout: as for :meth:`upload`, with ``"ftp"``.
            OperationTimeout: not done within ``timeout``.
        """

        async def work(transfer: PlanTransfer[PlanT]) -> PlanT:
            plan = await transfer.download(method)
            self._counted(len(plan.to_items()))
            return plan

        return await self._transfer(work, method, patience_s, timeout, on_progress)

    async def clear(self, *, patience_s: float = 10.0, timeout: float | None = None) -> None:
        """Have the vehicle forget it, and see that it has. ArduPilot refuses to forget a mission that it is flying.

        Raises:
            LocalProtocolError: an argument that cannot be right; nothing was sent.
            MissionRejected: the vehicle refused.
            MissionTimeout: it fell silent.
            VerificationFailed: it confirmed, and still holds items.
            OperationTimeout: not done within ``timeout``.
        """

        async def work(transfer: PlanTransfer[PlanT]) -> None:
            await transfer.clear()
            self._counted(0)

        await self._transfer(work, "items", patience_s, timeout, None)

    # ------------------------------------------------------------------------------------ inside

    def _plan_type(self) -> type[PlanT]:
        """The class of the plan, imported when needed."""
        raise NotImplementedError

    def _counted(self, count: int) -> None:
        """So many items are known to be held."""

    def _checked(self, plan: PlanT) -> PlanT:
        plan_type = self._plan_type()
        check_kind("plan", plan, plan_type)
        plan.check(home_is_item_0=bool(self._context.offset_of(plan_type.MISSION_TYPE)))
        return plan

    async def _transfer(
        self,
        work: Callable[[PlanTransfer[PlanT]], Awaitable[ResultT]],
        method: str,
        patience_s: float,
        timeout: float | None,
        on_progress: OnProgress | None,
    ) -> ResultT:
        from aerokit.vehicle.plans.transfer import PlanTransfer

        if method not in METHODS:
            raise LocalProtocolError(f"method = {method!r} is not allowed: {', '.join(METHODS)}")
        check_seconds("patience_s", patience_s)
        check_seconds("timeout", timeout, none_is_allowed=True)
        context = self._context
        transfer = PlanTransfer(context, self._plan_type(), patience_s=patience_s, on_progress=on_progress)
        with context.transfers.limit(timeout):
            async with context.lock:
                return await work(transfer)


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
        self.learned_at = -math.inf
        self.has_file: bool | None = None
        """Whether the vehicle has a file of it; None: not tried yet."""

    def learn(self, items: Sequence[MissionItem], now: float) -> None:
        """The vehicle holds these."""
        self.items, self.learned_at = tuple(items), now

    def forget(self, now: float) -> None:
        """The vehicle may hold anything from now on."""
        self.items, self.learned_at = None, now


class PlanContext:
    """One lock, since autopilots have one state for the transfers of all three; what MISSION_CURRENT calls them."""

    def __init__(self, bridge: Bridge, files: PlanFiles | None) -> None:
        self.bridge, self.talk, self.files = bridge, bridge.talk, files
        self.transfers = bridge.talk.transfers
        self.autopilot = bridge.talk.autopilot
        self.lock = asyncio.Lock()
        self.memories = (PlanMemory(), PlanMemory(), PlanMemory())
        """By MAV_MISSION_TYPE."""
        self._current: Frame | None = None
        talk = bridge.talk
        talk.detach.append(
            talk.connection.bus.attach_frames(MissionCurrent, self._note_current, system_id=talk.system_id)
        )

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
        at = IDS_AT[mission_type]
        return int.from_bytes(frame.payload[at : at + 4], "little")

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
