"""Base class of missions, fences and rally points on a vehicle."""

from __future__ import annotations

from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Generic, Literal, TypeVar

from aerokit._internal.arguments import check_kind, checks_arguments
from aerokit._internal.async_block import ReadOnly
from aerokit.mavlink.enums import MavCmd
from aerokit.vehicle.commanding.progress import MAX_DISTANCE_M

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Sequence

    from aerokit.missions import Fence, RallyPoints
    from aerokit.missions.item import MissionItem
    from aerokit.protocols.exchange import OnProgress
    from aerokit.vehicle.missions.context import PlanContext, PlanVersion
    from aerokit.vehicle.missions.transfer import PlanProtocol, PlanTransfer

__all__ = ["FenceControl", "PlanMethod", "RallyControl", "VehiclePlan"]

PlanT = TypeVar("PlanT", bound="PlanProtocol")


PlanMethod = Literal["auto", "ftp", "items"]


@checks_arguments
class VehiclePlan(ReadOnly, Generic[PlanT]):
    """A mission, a fence or rally points on a vehicle.

    Transfers with one vehicle run one at a time. You can cancel any call;
    aerokit then ends the transfer on the vehicle.
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
        idle_timeout_s: float = 10.0,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> None:
        """Replace the plan on the vehicle by ``plan``. An empty plan clears the vehicle's plan.

        Args:
            plan: checked before anything is sent.
            method: ``"ftp"`` (ArduPilot's ``@MISSION/…`` files), ``"items"`` (the mission protocol), or ``"auto"``.
            only_changes: send nothing if the vehicle already has this plan, and if possible only the items that differ.
                PX4's plan is compared by its checksum. ArduPilot's plan is read first if ``plan`` is similar to the
                plan that was last transferred; if not, all items are sent.
            verify: read the plan back and compare it, or compare PX4's checksum if that is faster. A plan that is sent
                as a file is read back even if this is False.
            max_distance_m: refuse a plan with a position farther than this from the vehicle, if the vehicle's position
                is known.
            idle_timeout_s: fail after this many seconds without progress.
            timeout: seconds in total, including the wait until other transfers have ended; None for no limit.
            on_progress: called with the progress in items, or in bytes of a file.

        See https://mavlink.io/en/services/mission.html. PX4 keeps the old items until it has received all new ones.
        ArduPilot overwrites missions and rally points item by item, and a fence at the end. After a failure, ArduPilot
        may therefore have both old and new items; the error text then says so.

        Raises:
            InvalidArgument: the plan is invalid, or has a position that is too far away. Nothing was sent.
            MissionRejected: the vehicle refused; see ``item``, ``result`` and ``reasons``.
            MissionTimeout: the vehicle stopped answering; ``missing`` has the items that the vehicle did not confirm.
            VerificationFailed: the vehicle confirmed the plan, but has different items.
            NotSupported: ``"ftp"`` was requested, but the vehicle does not support it; or a fence or rally points were
                to be transferred over MAVLink 1, which has only missions.
            FileError, FileTimeout: with ``"ftp"`` only: the vehicle refused an operation on a file, or did not answer.
            OperationTimeout: the transfer was not done within ``timeout``.
        """
        plan = self._checked(plan)
        places = [item.position for item in plan.to_items()]
        self._context.vehicle_context.vehicle_position.check_reach("plan", places, max_distance_m, are_items=True)

        async with self._transfer(idle_timeout_s, timeout, on_progress) as transfer:
            await transfer.upload(plan, method, only_changes=only_changes, verify=verify)
            self._on_count(len(plan.to_items()))

    async def download(
        self,
        *,
        method: PlanMethod = "auto",
        idle_timeout_s: float = 10.0,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> PlanT:
        """Read the plan on the vehicle; arguments as for :meth:`upload`.

        Raises:
            InvalidArgument: an argument is invalid. Nothing was sent.
            MissionRejected: the vehicle refused.
            MissionTimeout: items did not arrive; ``missing`` has their numbers.
            RemoteProtocolError: the received items are not a valid plan.
            NotSupported, FileError, FileTimeout: as for :meth:`upload`.
            OperationTimeout: the transfer was not complete within ``timeout``.
        """
        async with self._transfer(idle_timeout_s, timeout, on_progress) as transfer:
            plan = await transfer.download(method)
            self._on_count(len(plan.to_items()))
            return plan

    async def clear(self, *, idle_timeout_s: float = 10.0, timeout: float | None = None) -> None:
        """Remove all items of the plan from the vehicle, and verify that it has none. Arguments as for :meth:`upload`.

        Raises:
            InvalidArgument: an argument is invalid. Nothing was sent.
            MissionRejected: the vehicle refused. ArduPilot refuses to clear a mission that it is flying.
            MissionTimeout: the vehicle stopped answering.
            VerificationFailed: the vehicle confirmed the command, but still has items.
            OperationTimeout: the transfer was not done within ``timeout``.
        """
        async with self._transfer(idle_timeout_s, timeout, None) as transfer:
            await transfer.clear()
            self._on_count(0)

    @property
    def _version(self) -> PlanVersion:
        return self._context.version(self._get_plan_type().MISSION_TYPE)

    @property
    def _known_items(self) -> tuple[MissionItem, ...] | None:
        """The items that the vehicle had after the last transfer; None if they may have been replaced since."""
        return self._context.caches[self._get_plan_type().MISSION_TYPE].items

    def _may_differ_from(self, uploaded_items: Sequence[MissionItem] | None) -> bool:
        """Return True if the vehicle may have other items now than ``uploaded_items``, an earlier `_known_items`."""
        return self._context.may_differ(self._get_plan_type().MISSION_TYPE, uploaded_items)

    def _get_plan_type(self) -> type[PlanT]:
        """Return the class of the plan, imported on demand."""
        raise NotImplementedError

    def _on_count(self, count: int) -> None:
        """Called with the number of items after each transfer."""

    def _checked(self, plan: PlanT) -> PlanT:
        plan_type = self._get_plan_type()
        check_kind("plan", plan, plan_type)
        plan.check(home_is_item_0=bool(self._context.offset_of(plan_type.MISSION_TYPE)))
        return plan

    @asynccontextmanager
    async def _transfer(
        self, idle_timeout_s: float, timeout: float | None, on_progress: OnProgress | None
    ) -> AsyncIterator[PlanTransfer[PlanT]]:
        """Wait until transfers of the vehicle's other plans have ended, then yield a new transfer."""
        from aerokit.vehicle.missions.transfer import PlanTransfer

        context = self._context
        transfer = PlanTransfer(context, self._get_plan_type(), idle_timeout_s=idle_timeout_s, on_progress=on_progress)
        with context.transfers.limit(timeout):
            async with context.lock:
                yield transfer


@checks_arguments
class FenceControl(VehiclePlan["Fence"]):
    """The fence of a vehicle: ``await vehicle.fence.upload(Fence(polygons=[...]))``.

    ArduPilot does not enable an uploaded fence: use :meth:`enable`, or the parameter FENCE_ENABLE. PX4 always enforces
    its fence; its parameter GF_ACTION defines the reaction.
    """

    async def enable(self, on: bool = True) -> None:
        """Enable or disable the fence (MAV_CMD_DO_FENCE_ENABLE) until the next reboot.

        See https://mavlink.io/en/messages/common.html#MAV_CMD_DO_FENCE_ENABLE.

        Raises:
            CommandRejected: the vehicle refused; PX4 does not support the command.
            CommandTimeout: the vehicle did not answer.
        """
        await self._context.vehicle_context.sender.auxiliary_command(MavCmd.DO_FENCE_ENABLE, float(on))

    def _get_plan_type(self) -> type[Fence]:
        from aerokit.missions import Fence

        return Fence


class RallyControl(VehiclePlan["RallyPoints"]):
    """Rally points, where a vehicle may return instead of home: ``await vehicle.rally.upload(RallyPoints([...]))``.

    PX4 calls them safe points, and ignores them if its parameter RTL_TYPE is 2 or 4 (return along the mission).
    """

    def _get_plan_type(self) -> type[RallyPoints]:
        from aerokit.missions import RallyPoints

        return RallyPoints
