"""``PlanChannel``: items of one kind of plan to a vehicle and from it, one by one or as a file."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeVar

import anyio

from aerokit.errors import MissionRejected, MissionTimeout, NotSupported
from aerokit.mavlink.enums import MavMissionType, MavProtocolCapability
from aerokit.missions.pack import PACKED_NAMES, pack_items, unpack_items
from aerokit.protocols.mission_download import Downloaded, MissionDownload
from aerokit.protocols.mission_upload import MissionUpload, UploadEnd
from aerokit.protocols.missions import MissionClear

if TYPE_CHECKING:
    from collections.abc import Sequence

    from aerokit.missions.item import MissionItem
    from aerokit.protocols.missions import MissionExchange
    from aerokit.protocols.transfer import OnProgress
    from aerokit.vehicle.plans.context import PlanContext

__all__ = ["PlanChannel"]

ResultT = TypeVar("ResultT")
SETTLE_S = 0.3
"""How long after a refusal the vehicle's texts about it are waited for."""


class PlanChannel:
    """The ways to and from one vehicle for one MAV_MISSION_TYPE. Items are counted as the vehicle counts them.

    Errors count as the program does, have the vehicle's texts in them, and say what became of the old items.
    """

    def __init__(
        self, context: PlanContext, mission_type: int, patience_s: float, on_progress: OnProgress | None
    ) -> None:
        self.mission_type = mission_type
        self._context = context
        self._options: dict[str, Any] = {"patience_s": patience_s, "on_progress": on_progress}
        self._path = PACKED_NAMES[mission_type]
        self._has_changed = False
        """Whether something of ours may be among what the vehicle holds."""
        self.is_single_precision: bool = False
        """Whether places go through 32-bit floats: the vehicle knows no MISSION_ITEM_INT."""

    # ------------------------------------------------------------------------------- one by one

    async def send(self, items: Sequence[MissionItem]) -> UploadEnd:
        """Send all items. A refusal that may be about any of several is tried again, one item at a time."""
        window = self._context.autopilot.mission_upload_window
        exchange = await self._upload(items, window=window)
        try:
            return await self._run(exchange)
        except MissionRejected:
            if not exchange.was_vague:
                raise
        return await self._run(await self._upload(items, window=1))

    async def send_part(self, items: Sequence[MissionItem], first: int) -> UploadEnd | None:
        """Send the items from ``first`` on in place of those there; None: the vehicle will not have it in parts."""
        exchange = await self._upload(items, window=1, first=first)
        try:
            end = await self._run(exchange)
            self._has_changed = True
            return end
        except MissionRejected:
            if exchange.was_begun:
                raise
            return None

    async def receive(self, only: Sequence[int] | None = None) -> Downloaded:
        """Read all items, or ``only`` some."""
        received = await self._run(
            MissionDownload(
                *self._target,
                window=self._context.autopilot.mission_download_window,
                only=only,
                gives_int=await self._knows_int(),
                **self._wire_options,
            )
        )
        return received.replace(items=self._tidy(received.items))

    async def clear(self) -> None:
        """Have the vehicle forget all items."""
        await self._run(MissionClear(*self._target, **self._wire_options))

    # ---------------------------------------------------------------------------------- as a file

    async def has_ftp(self) -> bool:
        """Whether the vehicle has file transfer at all."""
        return await self._has(MavProtocolCapability.FTP, by_default=False)

    async def write_file(self, items: Sequence[MissionItem]) -> None:
        """Write the file. ArduPilot looks at it when it is closed, and does not tell what it thinks of it."""
        await self._context.files().write(self._path, pack_items(items, self.mission_type), **self._options)
        self._has_changed = True

    async def read_file(self) -> tuple[MissionItem, ...]:
        """Read the file; RemoteProtocolError when it is none of this kind."""
        data = await self._context.files().read(self._path, **self._options)
        return self._tidy(unpack_items(data, self.mission_type))

    # ------------------------------------------------------------------------------------ inside

    def _tidy(self, items: tuple[MissionItem, ...]) -> tuple[MissionItem, ...]:
        """Outside missions ``autocontinue`` has no meaning, and comes back from ArduPilot as False."""
        if self.mission_type == MavMissionType.MISSION:
            return items
        return tuple(item.replace(autocontinue=True) for item in items)

    @property
    def _target(self) -> tuple[int, int]:
        return self._context.transfers.system_id, self._context.transfers.component_id

    @property
    def _wire_options(self) -> dict[str, Any]:
        transfers = self._context.transfers
        return {
            **self._options,
            "mission_type": self.mission_type,
            "offset": self._context.offset_of(self.mission_type),
            "own_system": transfers.connection.source_system,
            "own_component": transfers.connection.source_component,
            "round_trip": transfers.round_trip,
        }

    async def _has(self, capability: MavProtocolCapability, *, by_default: bool = True) -> bool:
        capabilities = await self._context.transfers.capabilities()
        return by_default if capabilities is None else bool(capabilities & capability)

    async def _knows_int(self) -> bool:
        knows = await self._has(MavProtocolCapability.MISSION_INT)
        self.is_single_precision = not knows
        return knows

    async def _upload(
        self, items: Sequence[MissionItem], *, window: int, first: int | None = None
    ) -> MissionUpload:
        return MissionUpload(
            *self._target,
            items,
            first=first,
            window=window,
            takes_int=await self._knows_int(),
            **self._wire_options,
        )

    async def _run(self, exchange: MissionExchange[ResultT]) -> ResultT:
        """Run it; given up from outside, it is given up at the vehicle too."""
        connection = self._context.transfers.connection
        if self.mission_type != MavMissionType.MISSION and connection.mavlink_version == 1:
            raise NotSupported(
                "MAVLink 1 has messages for missions only: to the vehicle this would be its mission; nothing was sent"
            )
        started = connection.now()
        try:
            return await self._context.transfers.run(exchange)
        except MissionRejected as error:
            await anyio.sleep(SETTLE_S)
            texts = self._context.talk.texts_since(started)
            message = f"{error}{self._what_is_left(exchange)}"
            raise MissionRejected(message, result=error.result, item=error.item, reasons=texts) from None
        except MissionTimeout as error:
            error.args = (f"{error}{self._what_is_left(exchange, is_silent=True)}",)
            raise
        finally:
            if not exchange.done and connection.is_open:
                for goodbye in exchange.cancellation():
                    connection.send(goodbye)

    def _what_is_left(self, exchange: MissionExchange[Any], *, is_silent: bool = False) -> str:
        if not isinstance(exchange, MissionUpload):
            return ""
        self._has_changed |= exchange.was_changing
        is_overwritten = self.mission_type in self._context.autopilot.replaced_as_they_come
        if is_silent and exchange.was_sent_whole:
            return "; everything was sent, and it is not known whether the vehicle took it: download to see"
        if is_overwritten and self._has_changed:
            return "; the vehicle now holds a part of the new items and a part of the old ones: upload again, or clear"
        if is_overwritten and is_silent:
            return "; if the vehicle heard of it, it has cut what it held to the new number of items"
        return "; the vehicle holds what it held before"
