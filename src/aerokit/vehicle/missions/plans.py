"""What missions, fences and rally points of one vehicle share: one transfer at a time, what was sent or read last."""

from __future__ import annotations

from typing import TYPE_CHECKING, Generic, Literal, TypeVar

from aerokit._internal.arguments import check_kind, checks_arguments
from aerokit._internal.async_block import ReadOnly
from aerokit.mavlink.enums import MavCmd
from aerokit.vehicle.commanding.progress import MAX_DISTANCE_M

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from aerokit.missions import Fence, RallyPoints
    from aerokit.protocols.exchange import OnProgress
    from aerokit.vehicle.missions.context import PlanContext
    from aerokit.vehicle.missions.transfer import Plan, PlanTransfer

__all__ = ["FenceControl", "HeldPlan", "PlanMethod", "RallyControl"]

PlanT = TypeVar("PlanT", bound="Plan")

ResultT = TypeVar("ResultT")

PlanMethod = Literal["auto", "ftp", "items"]


@checks_arguments
class HeldPlan(ReadOnly, Generic[PlanT]):
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
        max_distance_m: float = MAX_DISTANCE_M,
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
            max_distance_m: metres from where the vehicle is, if it has told that; a plan with a place farther away is
                refused.
            patience_s: give up after so many seconds without progress.
            timeout: seconds for all of it.
            on_progress: called with how far it is, in items, or in bytes of a file.

        See https://mavlink.io/en/services/mission.html. PX4 keeps the old items until it has all of the new ones.
        ArduPilot overwrites a mission and rally points one by one (a fence at the end), so that after a failure it
        holds a part of both: the error says so.

        Raises:
            InvalidArgument: the plan cannot be right, or has a place that is too far away; nothing was sent.
            MissionRejected: the vehicle refused; ``item``, ``result`` and ``reasons`` tell what and why.
            MissionTimeout: it fell silent; ``missing`` are the items it did not confirm.
            VerificationFailed: it confirmed, and holds something else.
            NotSupported: ``"ftp"`` was asked for, and it has none.
            FileError, FileTimeout: the same for a file, with ``"ftp"``.
            OperationTimeout: not done within ``timeout``.
        """
        plan = self._checked(plan)
        places = [each.position for each in plan.to_items()]
        self._context.bridge.where.check_reach("plan", filter(None, places), max_distance_m)

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
            InvalidArgument: an argument that cannot be right; nothing was sent.
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
            InvalidArgument: an argument that cannot be right; nothing was sent.
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
        from aerokit.vehicle.missions.transfer import PlanTransfer

        context = self._context
        transfer = PlanTransfer(context, self._plan_type(), patience_s=patience_s, on_progress=on_progress)
        with context.transfers.limit(timeout):
            async with context.lock:
                return await work(transfer)


@checks_arguments
class FenceControl(HeldPlan["Fence"]):
    """``await vehicle.fence.upload(Fence(polygons=[...]))``: where the vehicle may and may not be.

    Uploading does not switch it on for ArduPilot (:meth:`enable`, or the parameter FENCE_ENABLE); PX4 minds every fence
    it holds, and does what GF_ACTION says.
    """

    async def enable(self, on: bool = True) -> None:
        """Have the vehicle mind its fence, or not (MAV_CMD_DO_FENCE_ENABLE), until it reboots.

        See https://mavlink.io/en/messages/common.html#MAV_CMD_DO_FENCE_ENABLE.

        Raises:
            CommandRejected: the vehicle refused; PX4 does not know the command.
            CommandTimeout: it did not answer.
        """
        await self._context.bridge.sender.command_aside(MavCmd.DO_FENCE_ENABLE, float(on))

    def _plan_type(self) -> type[Fence]:
        from aerokit.missions import Fence

        return Fence


class RallyControl(HeldPlan["RallyPoints"]):
    """``await vehicle.rally.upload(RallyPoints([...]))``: where the vehicle may return to instead of home.

    PX4 calls them safe points, and returns to one of them when RTL_TYPE says so.
    """

    def _plan_type(self) -> type[RallyPoints]:
        from aerokit.missions import RallyPoints

        return RallyPoints
