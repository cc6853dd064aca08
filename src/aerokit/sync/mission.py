"""Missions, fences and rally points for programs without ``async``."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Generic, TypeVar

from aerokit.sync.cells import StateCell
from aerokit.vehicle.progress import LONGEST_SILENCE_S

if TYPE_CHECKING:
    from aerokit.missions import Fence, Mission, RallyPoints  # noqa: F401 - named in the base classes below
    from aerokit.protocols.transfer import OnProgress
    from aerokit.sync.loop_thread import LoopThread
    from aerokit.vehicle.fence import FenceControl as AsyncFenceControl
    from aerokit.vehicle.mission import MissionControl as AsyncMissionControl
    from aerokit.vehicle.plan_transfer import Plan
    from aerokit.vehicle.plans import HeldPlan as AsyncHeldPlan
    from aerokit.vehicle.plans import PlanMethod
    from aerokit.vehicle.rally import RallyControl as AsyncRallyControl
    from aerokit.vehicle.state.values import MissionProgress

__all__ = ["FenceControl", "HeldPlan", "MissionControl", "RallyControl"]

PlanT = TypeVar("PlanT", bound="Plan")


class HeldPlan(Generic[PlanT]):
    """A mission, a fence or rally points that a vehicle holds; as :class:`aerokit.vehicle.plans.HeldPlan`."""

    def __init__(self, loop: LoopThread, plan: AsyncHeldPlan[PlanT]) -> None:
        self._loop, self._plan = loop, plan

    def upload(
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
        """Have the vehicle hold this plan; see :meth:`aerokit.vehicle.plans.HeldPlan.upload`."""
        self._loop.run(
            self._plan.upload,
            plan,
            method=method,
            only_changes=only_changes,
            verify=verify,
            patience_s=patience_s,
            timeout=timeout,
            on_progress=on_progress,
        )

    def download(
        self,
        *,
        method: PlanMethod = "auto",
        patience_s: float = 10.0,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> PlanT:
        """Read what the vehicle holds; see :meth:`aerokit.vehicle.plans.HeldPlan.download`."""
        return self._loop.run(
            self._plan.download,
            method=method,
            patience_s=patience_s,
            timeout=timeout,
            on_progress=on_progress,
        )

    def clear(self, *, patience_s: float = 10.0, timeout: float | None = None) -> None:
        """Have the vehicle forget it; see :meth:`aerokit.vehicle.plans.HeldPlan.clear`."""
        self._loop.run(self._plan.clear, patience_s=patience_s, timeout=timeout)


class MissionControl(HeldPlan["Mission"]):
    """The mission that a vehicle holds, and flying it; as :class:`aerokit.vehicle.mission.MissionControl`."""

    def __init__(self, loop: LoopThread, mission: AsyncMissionControl) -> None:
        super().__init__(loop, mission)
        self._mission = mission

    @cached_property
    def current(self) -> StateCell[int | None]:
        """The item it goes for (MISSION_CURRENT); None: it has not begun, or there is no mission."""
        return StateCell(self._loop, self._mission.current)

    @cached_property
    def count(self) -> StateCell[int]:
        """How many items it holds, by MISSION_CURRENT or by the last transfer."""
        return StateCell(self._loop, self._mission.count)

    @cached_property
    def progress(self) -> StateCell[MissionProgress]:
        """``current``, ``total`` and ``state`` (MISSION_STATE: 2 not started, 3 active, 4 paused, 5 complete)."""
        return StateCell(self._loop, self._mission.progress)

    @property
    def reached(self) -> int | None:
        """The item that was reached last (MISSION_ITEM_REACHED), None before the first."""
        return self._mission.reached

    def set_current(self, item: int, *, timeout: float = 5.0) -> None:
        """Have it go for this item next; see :meth:`aerokit.vehicle.mission.MissionControl.set_current`."""
        self._loop.run(self._mission.set_current, item, timeout=timeout)

    def start(self, item: int = 0, *, timeout: float = 10.0) -> None:
        """Fly the mission from ``item`` on; see :meth:`aerokit.vehicle.mission.MissionControl.start`."""
        self._loop.run(self._mission.start, item, timeout=timeout)

    def pause(self) -> None:
        """Stop and keep the place in the mission; see :meth:`aerokit.vehicle.mission.MissionControl.pause`."""
        self._loop.run(self._mission.pause)

    def resume(self, *, timeout: float = 10.0) -> None:
        """Go on with the mission; see :meth:`aerokit.vehicle.mission.MissionControl.resume`."""
        self._loop.run(self._mission.resume, timeout=timeout)

    def wait_finished(
        self, *, timeout: float | None = None, max_silence_s: float | None = LONGEST_SILENCE_S
    ) -> None:
        """Wait until the mission has been flown; see :meth:`aerokit.vehicle.mission.MissionControl.wait_finished`."""
        self._loop.run(self._mission.wait_finished, timeout=timeout, max_silence_s=max_silence_s)


class FenceControl(HeldPlan["Fence"]):
    """The fence that a vehicle holds; as :class:`aerokit.vehicle.fence.FenceControl`."""

    def __init__(self, loop: LoopThread, fence: AsyncFenceControl) -> None:
        super().__init__(loop, fence)
        self._fence = fence

    def enable(self, on: bool = True) -> None:
        """Have the vehicle mind its fence, or not; see :meth:`aerokit.vehicle.fence.FenceControl.enable`."""
        self._loop.run(self._fence.enable, on)


class RallyControl(HeldPlan["RallyPoints"]):
    """The rally points that a vehicle holds; as :class:`aerokit.vehicle.rally.RallyControl`."""

    def __init__(self, loop: LoopThread, rally: AsyncRallyControl) -> None:
        super().__init__(loop, rally)
