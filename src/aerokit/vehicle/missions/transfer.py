"""``PlanTransfer``: the shortest way to have a vehicle hold a plan, and to read the one it holds."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Generic, Protocol, TypeVar

import anyio

from aerokit.errors import (
    FileError,
    FileTimeout,
    MissionRejected,
    MissionTimeout,
    NotSupported,
    RemoteProtocolError,
    VerificationFailed,
)
from aerokit.mavlink.enums import MavMissionResult, MavMissionType, MavProtocolCapability
from aerokit.missions.compare import Storage, changed_items, item_differences
from aerokit.missions.pack import PACKED_NAMES, pack_items, unpack_items
from aerokit.missions.wire import shift_jumps, with_home
from aerokit.protocols.mission_download import Downloaded, MissionDownload
from aerokit.protocols.mission_upload import MissionUpload, UploadEnd
from aerokit.protocols.missions import MissionClear, mission_checksum

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence

    from typing_extensions import Self

    from aerokit.missions.item import MissionItem
    from aerokit.protocols.exchange import OnProgress
    from aerokit.protocols.missions import MissionExchange
    from aerokit.vehicle.missions.context import PlanContext

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


KINDS = ("mission", "fence", "rally points")

CHECKSUM_TAKES_S = 1.0
"""MISSION_CURRENT comes at 1 Hz."""

PART_COSTS = 4
"""A stretch of changed items costs about as many messages more as so many items."""


class Plan(Protocol):
    """What missions, fences and rally points have in common."""

    MISSION_TYPE: ClassVar[int]

    def check(self, *, home_is_item_0: bool) -> None:
        """Raise InvalidArgument unless it can be sent."""

    def to_items(self, *, home_is_item_0: bool = False) -> tuple[MissionItem, ...]:
        """Its items."""
        ...

    @classmethod
    def from_items(cls, items: Sequence[MissionItem], *, home_is_item_0: bool) -> Self:
        """The plan of these items."""
        ...


PlanT = TypeVar("PlanT", bound=Plan)


class PlanTransfer(Generic[PlanT]):
    """One upload, download or clearing. Items are counted as the vehicle counts them: an ArduPilot's home is item 0."""

    def __init__(
        self,
        context: PlanContext,
        plan_type: type[PlanT],
        *,
        patience_s: float,
        on_progress: OnProgress | None,
    ) -> None:
        self._context, self._plan_type = context, plan_type
        self._type = plan_type.MISSION_TYPE
        self._memory = context.memories[self._type]
        self._channel = PlanChannel(context, self._type, patience_s, on_progress)
        self._offset = context.offset_of(self._type)
        self._storage = Storage(context.autopilot.mission_storage)

    # ---------------------------------------------------------------------------------- whole

    async def upload(self, plan: PlanT, method: str, *, only_changes: bool, verify: bool) -> None:
        """Have the vehicle hold this plan."""
        items = plan.to_items()
        if self._offset:  # its own home, not the planner's: older firmware might take it for a new one
            items = with_home(items, self._context.home)
        if len(items) == self._offset:
            await self.clear()
            return
        if only_changes and await self._send_changes(items, method, verify=verify):
            return
        self._memory.forget(self._context.now())
        if await self._uses_file(method, is_upload=True):
            await self._send_file(items, method)
        else:
            await self._send_items(items, method, verify=verify)

    async def download(self, method: str) -> PlanT:
        """Read the plan that the vehicle holds."""
        return self._plan_type.from_items(await self._read(method), home_is_item_0=bool(self._offset))

    async def clear(self) -> None:
        """Have the vehicle hold nothing, and see that it does."""
        self._memory.forget(self._context.now())
        await self._channel.clear()
        left = (await self._channel.receive(only=())).count - self._offset
        if left > 0:
            self._fail(("the vehicle still has items: " + str(left),))

    async def _read(self, method: str) -> tuple[MissionItem, ...]:
        if await self._uses_file(method):
            try:
                items = await self._channel.read_file()
            except (FileError, FileTimeout, RemoteProtocolError) as error:
                self._note_no_file(error, method)
            else:
                self._memory.has_file = True
                self._memory.learn(items, self._context.now())
                return items
        received = await self._channel.receive()
        self._memory.learn(received.items, self._context.now())
        return received.items

    async def _uses_file(self, method: str, *, is_upload: bool = False) -> bool:
        if method == "items":
            return False
        has_ftp = await self._channel.has_ftp()
        if method == "ftp":
            if not has_ftp:
                raise NotSupported(f"{self._kind}: the vehicle has no file transfer; nothing was sent")
            return True
        # ArduPilot empties the old mission first, and cannot do so while it flies it
        is_flown = is_upload and self._type == 0 and self._context.is_flown
        return has_ftp and self._memory.has_file is not False and not is_flown

    def _note_no_file(self, error: Exception, method: str) -> None:
        """Use items from now on, unless files are insisted on, or used to be there: then raise the error."""
        if method == "ftp" or (self._memory.has_file and not isinstance(error, FileError)):
            raise error
        self._memory.has_file = False

    async def _send_items(self, items: Sequence[MissionItem], method: str, *, verify: bool) -> None:
        end = await self._channel.send(items)
        self._memory.learn(items, self._context.now())
        if (end.is_sure and not verify) or await self._has_checksum_of(items):
            return
        try:
            await self._verify(items, method)
        except VerificationFailed as error:
            if end.is_sure:
                raise
            raise MissionRejected(
                f"{self._kind}: the vehicle refused, at about item {end.item}, and holds something else now",
                result=MavMissionResult.ERROR,
                item=end.item,
                reasons=error.differences,
            ) from None

    async def _send_file(self, items: Sequence[MissionItem], method: str) -> None:
        try:
            await self._channel.write_file(items)
        except (FileError, FileTimeout) as error:
            self._note_no_file(error, method)
        else:
            found = await self._read(method)
            try:
                self._compare(dict(enumerate(items)), dict(enumerate(found)))
                return
            except VerificationFailed:
                if method == "ftp":
                    raise
        # there is no such file; or something was refused, and the other protocol tells which item, and why
        await self._send_items(items, method, verify=True)

    # -------------------------------------------------------------------------------- changes

    async def _send_changes(self, items: Sequence[MissionItem], method: str, *, verify: bool) -> bool:
        """Send only what differs; False when it is not known what the vehicle holds, or this is no shorter way."""
        autopilot = self._context.autopilot
        if autopilot.tells_mission_checksum:
            told = self._context.id_of(self._type, self._memory.learned_at)
            checksum = mission_checksum(items)
            # still, not a moment ago
            if told == checksum and await self._context.is_called(self._type, checksum):
                return True
        if not autopilot.writes_partial_missions or not self._is_short(self._changes(items), len(items)):
            return False
        await self._read(method)  # somebody else may have changed it since
        changes = self._changes(items)
        if changes == []:
            return True
        if changes is None or not self._is_short(changes, len(items)):
            return False
        held = list(self._memory.items or ())
        self._memory.forget(self._context.now())
        for part in _stretches(changes):
            if not await self._send_part(items[part.start : part.stop], part.start, verify=verify):
                return False
            held[part.start : part.stop] = items[part.start : part.stop]
        self._memory.learn(held, self._context.now())
        return True

    async def _send_part(self, items: Sequence[MissionItem], first: int, *, verify: bool) -> bool:
        end = await self._channel.send_part(items, first)
        if end is None:
            return False
        if verify or not end.is_sure:
            seqs = range(first, first + len(items))
            received = await self._channel.receive(only=seqs)
            self._compare(dict(zip(seqs, items)), dict(zip(seqs, received.items)))  # noqa: B905 - may be shorter
        return True

    def _changes(self, items: Sequence[MissionItem]) -> list[int] | None:
        """Where these items differ from those the vehicle is known to hold; None when it holds another number."""
        held = self._memory.items
        if held is None or len(held) != len(items):
            return None
        return [seq for seq in changed_items(items, held, self._storage) if seq >= self._offset]

    @staticmethod
    def _is_short(changes: Collection[int] | None, count: int) -> bool:
        if changes is None:
            return False
        return len(changes) + PART_COSTS * len(list(_stretches(changes))) < count or len(changes) == 0

    # ------------------------------------------------------------------------------ verifying

    async def _has_checksum_of(self, items: Sequence[MissionItem]) -> bool:
        """Whether the vehicle soon tells the checksum of these items, where that is quicker than reading them back."""
        autopilot = self._context.autopilot
        round_trip_s = self._context.transfers.round_trip.smoothed_s or 0.0
        takes_s = len(items) / autopilot.mission_download_window * round_trip_s
        if not autopilot.tells_mission_checksum or takes_s < CHECKSUM_TAKES_S:
            return False
        checksum = mission_checksum(items)
        if not await self._context.is_called(self._type, checksum):
            return False
        self._memory.learn(items, self._context.now())
        return True

    async def _verify(self, items: Sequence[MissionItem], method: str) -> None:
        found = await self._read(method)
        self._compare(dict(enumerate(items)), dict(enumerate(found)))

    def _compare(self, wanted: dict[int, MissionItem], found: dict[int, MissionItem]) -> None:
        differences = []
        if len(wanted) != len(found):
            counts = (max(0, len(found) - self._offset), len(wanted) - self._offset)
            differences = ["there are {} items instead of {}".format(*counts)]
        for seq in sorted(wanted.keys() & found.keys()):
            if seq >= self._offset:
                item, other = shift_jumps([wanted[seq], found[seq]], -self._offset)
                texts = item_differences(
                    item, other, self._storage, single_precision=self._channel.is_single_precision
                )
                differences += [f"item {seq - self._offset} ({item.name}): {text}" for text in texts]
        if differences:
            self._fail(tuple(differences))

    def _fail(self, differences: tuple[str, ...]) -> None:
        self._memory.forget(self._context.now())
        message = f"{self._kind}: the vehicle confirmed, and holds something else than it was sent"
        raise VerificationFailed(message, differences=differences)

    @property
    def _kind(self) -> str:
        return KINDS[self._type]


def _stretches(seqs: Collection[int]) -> Iterator[range]:
    """Numbers in a row: 3, 4, 7 → 3–4, 7."""
    start = previous = None
    for seq in sorted(seqs):
        if previous is not None and start is not None and seq > previous + 1:
            yield range(start, previous + 1)
            start = seq
        start = seq if start is None else start
        previous = seq
    if start is not None and previous is not None:
        yield range(start, previous + 1)
