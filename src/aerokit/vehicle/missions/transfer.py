"""``PlanTransfer``: uploads and downloads plans in the fastest way that the vehicle supports."""

from __future__ import annotations

from contextlib import contextmanager
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
from aerokit.mavlink.enums import MavCmd, MavMissionResult, MavMissionType, MavProtocolCapability
from aerokit.missions.compare import ItemStorage, changed_items, item_differences
from aerokit.missions.wire import PACKED_PATHS, pack_items, shift_jumps, unpack_items, with_home
from aerokit.protocols.ftp import crc32
from aerokit.protocols.mission_download import DownloadResult, MissionDownload
from aerokit.protocols.mission_upload import MissionUpload, UploadResult
from aerokit.protocols.missions import BUSY_TIMEOUT_S, MissionClear, mission_checksum
from aerokit.vehicle.commanding.arming import BOOT_STATES

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence

    from typing_extensions import Self

    from aerokit.missions.item import MissionItem
    from aerokit.protocols.exchange import OnProgress
    from aerokit.protocols.missions import MissionExchange
    from aerokit.vehicle.missions.context import PlanContext

ResultT = TypeVar("ResultT")
# Seconds after a refusal in which the texts that explain it may arrive.
REFUSAL_TEXT_DELAY_S = 0.3
# A download reads a plan's file at most this many times, if other stations keep changing the plan.
MAX_FILE_READS = 5
UNKNOWN_CONTENT = "whether the vehicle has the new items is unknown: call download()"


class PlanChannel:
    """Transfers plans of one MAV_MISSION_TYPE. Items are numbered as the vehicle numbers them.

    Errors use the program's item numbers, contain the vehicle's status texts, and say which items the vehicle has now.
    """

    def __init__(
        self, context: PlanContext, mission_type: int, idle_timeout_s: float, on_progress: OnProgress | None
    ) -> None:
        self.mission_type = mission_type
        self._context = context
        self._options: dict[str, Any] = {"idle_timeout_s": idle_timeout_s, "on_progress": on_progress}
        # Path of the plan's file on ArduPilot.
        self._path = PACKED_PATHS[mission_type]
        self._has_changed = False  # True if the vehicle may have received some of our items
        self._may_have_read_file = False  # True if the vehicle may have evaluated a file of this call
        self._may_continue_older_upload = False  # True if the vehicle may not know that an older upload has ended
        self.is_single_precision: bool = False  # True if positions are sent as 32-bit floats (MISSION_ITEM)

    async def send(self, items: Sequence[MissionItem]) -> UploadResult:
        window = self._context.autopilot.mission_upload_window
        exchange = await self._new_upload(items, window=window)
        try:
            return await self._run(exchange)
        except MissionRejected:
            if not exchange.is_refusal_ambiguous:
                raise
        # The refusal does not identify the refused item, so the items are sent again one at a time.
        return await self._run(await self._new_upload(items, window=1))

    async def send_part(self, items: Sequence[MissionItem], first_seq: int) -> UploadResult | None:
        """Replace items from ``first_seq`` on. Return None if all items must be sent instead."""
        exchange = await self._new_upload(items, window=1, first_seq=first_seq)
        try:
            result = await self._run(exchange)
        except MissionRejected:
            if exchange.was_started and not exchange.was_dropped:
                raise
            return None  # The vehicle refused or cancelled the partial upload itself, not one of its items.
        self._has_changed = True
        return result

    async def receive(self, only: Sequence[int] | None = None) -> DownloadResult:
        """Read the items with the numbers ``only``; None: all items; empty: none, but their count."""
        options = self._wire_options
        requests_only_count = only is not None and not only
        if requests_only_count:
            options["on_progress"] = None  # A count is no progress.
        received = await self._run(
            MissionDownload(
                *self._target,
                window=self._context.autopilot.mission_download_window,
                only=only,
                supports_int=await self._supports_int(),
                **options,
            )
        )
        return received.replace(items=self._normalized(received.items))

    async def receive_one_plan(self) -> DownloadResult:
        """Read all items again until their number is still the same afterwards, unless the vehicle reports an id."""
        while True:
            received = await self.receive()
            if received.opaque_id:
                return received
            recounted = await self.receive(only=())
            # ArduPilot does not show that another station has replaced the plan by one with the same number of items.
            if recounted.count == received.count:
                return received

    async def clear(self) -> None:
        await self._run(MissionClear(*self._target, **self._wire_options))

    async def has_ftp(self, *, by_default: bool) -> bool:
        """Return True if the vehicle supports MAVFTP; ``by_default`` if it does not report its capabilities."""
        return await self._has_capability(MavProtocolCapability.FTP, by_default=by_default)

    async def write_file(self, items: Sequence[MissionItem]) -> None:
        """Write the plan's file. ArduPilot evaluates the file when it is closed, and does not report the result."""
        self._may_have_read_file = True
        try:
            await self._context.files().write(self._path, pack_items(items, self.mission_type), **self._options)
        except FileError:
            self._may_have_read_file = False  # The vehicle has no such file, or has refused a part of it.
            raise
        self._has_changed = True

    async def read_file(self, *, must_be_one_plan: bool) -> tuple[MissionItem, ...]:
        """Read the plan's file. With ``must_be_one_plan``, read again if another station has changed it meanwhile.

        Raises RemoteProtocolError for a plan of another kind, or if each read was in vain.
        """
        previous_data = None
        for _ in range(MAX_FILE_READS):
            data = await self._context.files().read(self._path, **self._options)
            if not must_be_one_plan or await self._is_one_plan(data, previous_data):
                return self._normalized(unpack_items(data, self.mission_type))
            previous_data = data
        raise RemoteProtocolError(f"read {self._path}: the plan was changed during each of {MAX_FILE_READS} reads")

    async def _is_one_plan(self, data: bytes, previous_data: bytes | None) -> bool:
        """Return True unless ``data`` may have parts of two plans. Wait while another station uploads its items."""
        # ArduPilot makes each block of the file from the plan that it has at that moment, even in the middle of an
        # upload (AP_Filesystem_Mission.cpp, read). The mission protocol refuses requests during an upload.
        if self.mission_type in self._context.autopilot.overwrites_plans_in_place:
            await self.receive(only=())
        if data == previous_data:  # Two reads in succession gave the same plan.
            return True
        try:
            crc = await self._context.files().crc32(self._path, idle_timeout_s=self._options["idle_timeout_s"])
        except FileError:
            return True  # The vehicle cannot compute a CRC-32.
        return crc == crc32(data)

    def _normalized(self, items: tuple[MissionItem, ...]) -> tuple[MissionItem, ...]:
        # Fences and rally points have no autocontinue; ArduPilot returns False for them.
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

    async def _has_capability(self, capability: MavProtocolCapability, *, by_default: bool = True) -> bool:
        capabilities = await self._context.transfers.capabilities()
        return by_default if capabilities is None else bool(capabilities & capability)

    async def _supports_int(self) -> bool:
        is_supported = await self._has_capability(MavProtocolCapability.MISSION_INT)
        self.is_single_precision = not is_supported
        return is_supported

    async def _new_upload(
        self, items: Sequence[MissionItem], *, window: int, first_seq: int | None = None
    ) -> MissionUpload:
        return MissionUpload(
            *self._target,
            items,
            first=first_seq,
            window=window,
            supports_int=await self._supports_int(),
            **self._wire_options,
        )

    async def _run(self, exchange: MissionExchange[ResultT]) -> ResultT:
        connection = self._context.transfers.connection
        if self.mission_type != MavMissionType.MISSION and connection.mavlink_version == 1:
            raise NotSupported(
                "MAVLink 1 can transfer only missions, so the vehicle would use this plan as its mission;"
                " nothing was sent"
            )
        started_at = connection.now()
        session = self._context.session
        other_boots = session.watch.other_boots
        if started_at - self._context.upload_abandoned_at < BUSY_TIMEOUT_S and not session.is_held_back:
            self._may_continue_older_upload = True
            # If PX4 receives MISSION_REQUEST_LIST during an upload, it may leave the upload in such a way that it
            # refuses all uploads until it reboots (mavlink_mission.cpp, handle_mission_request_list). The cancellation
            # of the upload may have been lost.
            self._send_cancellation(exchange)
        try:
            return await self._context.transfers.run(exchange)
        except MissionRejected as error:
            self._record_changes(exchange)
            await anyio.sleep(REFUSAL_TEXT_DELAY_S)
            texts = self._context.session.texts_since(started_at)
            description = self._describe_items_on_vehicle(exchange, refused_item=error.item, result=error.result)
            message = f"{error}{description}"
            raise MissionRejected(message, result=error.result, item=error.item, reasons=texts) from None
        except MissionTimeout as error:
            self._record_changes(exchange)
            self._record_abandoned_upload(exchange)
            # Change only the text, so that the error keeps its attribute `missing`.
            error.args = (f"{error}{self._describe_items_on_vehicle(exchange, is_silent=True)}",)
            raise
        finally:
            # If this call was cancelled, the transfer is also cancelled on the vehicle. A reopened link may lead to
            # another vehicle, which may have a transfer with another station.
            is_same_boot = session.watch.other_boots == other_boots and not session.is_held_back
            if not exchange.done and is_same_boot:
                self._record_abandoned_upload(exchange)
                self._send_cancellation(exchange)

    def _send_cancellation(self, exchange: MissionExchange[Any]) -> None:
        connection = self._context.transfers.connection
        if connection.is_open:
            for cancellation in exchange.cancellation():
                connection.send(cancellation)

    def _record_abandoned_upload(self, exchange: MissionExchange[Any]) -> None:
        if isinstance(exchange, MissionUpload):
            self._context.upload_abandoned_at = self._context.now()

    def _record_changes(self, exchange: MissionExchange[Any]) -> None:
        if isinstance(exchange, MissionUpload):
            self._has_changed |= exchange.may_have_changed_items

    def _describe_items_on_vehicle(
        self,
        exchange: MissionExchange[Any],
        *,
        is_silent: bool = False,
        refused_item: int | None = None,
        result: int | None = None,
    ) -> str:
        """Return a clause for the error text of an upload: which items the vehicle has now."""
        if not isinstance(exchange, MissionUpload):
            return ""
        overwrites_in_place = self.mission_type in self._context.autopilot.overwrites_plans_in_place
        is_partly_overwritten = overwrites_in_place and self._has_changed
        if is_silent and exchange.was_sent_completely:
            return "; all items were sent, but whether the vehicle accepted them is unknown: call download()"
        if is_silent and self._may_have_read_file:
            return f"; {UNKNOWN_CONTENT}"
        # PX4 may take the first items for those of an older, shorter upload, and its acceptance may have been lost.
        is_end_unknown = is_silent or result == MavMissionResult.ERROR
        may_be_cut = exchange.was_started and is_end_unknown and self._may_continue_older_upload
        may_have_first_items_only = exchange.was_accepted_early or may_be_cut
        if may_have_first_items_only and not overwrites_in_place:
            return "; the vehicle may have accepted the first items as the whole plan: call download()"
        if is_partly_overwritten and refused_item:
            # After the upload of a file there are no later items, because ArduPilot has cleared its plan first.
            new_items = "only item 0 is new" if refused_item == 1 else f"items 0 to {refused_item - 1} are new"
            later_items = "later items, if there are any, are old"
            return f"; on the vehicle, {new_items} now, and {later_items}: upload again, or clear"
        if is_partly_overwritten and refused_item == 0:
            return "; on the vehicle, no item is new, and old items may be missing: upload again, or clear"
        if is_partly_overwritten:
            has = "may have" if is_silent else "has"
            return f"; the vehicle now {has} some new and some old items: upload again, or clear"
        may_have_cut_plan = overwrites_in_place and is_silent and not exchange.is_partial
        if may_have_cut_plan:  # The request MISSION_COUNT alone cuts the plan.
            return "; if the vehicle received the request, it has cut its plan to the new number of items"
        if result == MavMissionResult.DENIED:  # Another station may be replacing the items.
            return "; it has stored none of the new items"
        return "; the vehicle still has its previous items"


# ArduPilot erases a small fence within 0.1 s after its upload; see `PlanTransfer._is_erased`.
FENCE_ERASED_WITHIN_S = 0.5
MIN_KEPT_ZONE_POINTS = 3

MAX_BOOT_S = 10.0

PLAN_NAMES = ("mission", "fence", "rally points")
# MISSION_CURRENT, which has the checksum, is sent at 1 Hz.
CHECKSUM_INTERVAL_S = 1.0
# The extra messages of a partial upload cost about as much as this many items.
PART_OVERHEAD_ITEMS = 4


class PlanProtocol(Protocol):
    """Interface of missions, fences and rally points."""

    MISSION_TYPE: ClassVar[int]

    def check(self, *, home_is_item_0: bool) -> None: ...

    def to_items(self, *, home_is_item_0: bool = False) -> tuple[MissionItem, ...]: ...

    @classmethod
    def from_items(cls, items: Sequence[MissionItem], *, home_is_item_0: bool) -> Self: ...


PlanT = TypeVar("PlanT", bound=PlanProtocol)


class PlanTransfer(Generic[PlanT]):
    """One upload, download or clearing. Items are numbered as the vehicle numbers them: ArduPilot's item 0 is home."""

    def __init__(
        self,
        context: PlanContext,
        plan_type: type[PlanT],
        *,
        idle_timeout_s: float,
        on_progress: OnProgress | None,
    ) -> None:
        self._context = context
        self._plan_type = plan_type
        self._mission_type = plan_type.MISSION_TYPE
        self._cache = context.caches[self._mission_type]
        self._channel = PlanChannel(context, self._mission_type, idle_timeout_s, on_progress)
        # 1 if the vehicle's item 0 is home, otherwise 0.
        self._offset = context.offset_of(self._mission_type)
        # How the vehicle rounds the values of items, for comparisons.
        self._storage = ItemStorage(context.autopilot.mission_storage)

    async def upload(self, plan: PlanT, method: str, *, only_changes: bool, verify: bool) -> None:
        items = plan.to_items()
        if self._offset:  # Item 0 must be the vehicle's home, because older firmware may use it as the new home.
            items = with_home(items, self._context.home)
        if len(items) == self._offset:  # The plan is empty, except for home.
            await self.clear()
            return
        if only_changes and await self._send_changes(items, method, verify=verify):
            return  # The vehicle has the plan now.
        self._cache.forget(self._context.now())
        try:
            await self._send_all(items, method, verify=verify)
        except (VerificationFailed, MissionRejected):
            if not await self._is_erased(items):
                raise
        else:
            if not await self._is_erased(items):
                return
        await self._send_items(items, method, verify=True)

    async def download(self, method: str) -> PlanT:
        with self._describe_file_timeout(method):
            items = await self._read(method, must_be_one_plan=True)
        return self._plan_type.from_items(items, home_is_item_0=bool(self._offset))

    async def clear(self) -> None:
        self._cache.forget(self._context.now())
        await self._channel.clear()
        received = await self._channel.receive(only=())  # Without item numbers, only the count is requested.
        remaining = received.count - self._offset
        if remaining > 0:
            raise self._mismatch((f"the vehicle still has items: {remaining}",))

    async def _is_erased(self, items: Sequence[MissionItem]) -> bool:
        """Return True if the vehicle has just erased a fence of one or two circles.

        Its FENCE_TOTAL is 0. If that was not 0 before, ArduPilot takes the change for an order to erase the fence
        (AC_PolyFence_loader.cpp, write_fence and update). A second upload of the same fence is not erased.
        """
        zone_points = sum(item.command != MavCmd.NAV_FENCE_RETURN_POINT for item in items)
        is_small_fence = self._mission_type == MavMissionType.FENCE and zone_points < MIN_KEPT_ZONE_POINTS
        if not (is_small_fence and self._context.autopilot.erases_small_fences):
            return False
        uploaded = self._cache.items
        self._cache.forget(self._context.now())  # The plan stays unknown if this call fails or is cancelled.
        changes = self._cache.changes
        await anyio.sleep(FENCE_ERASED_WITHIN_S)
        received = await self._channel.receive(only=())  # Without item numbers, only the count is requested.
        if received.count == 0:
            return True
        if uploaded is not None and self._cache.changes == changes:
            self._cache.set(uploaded, self._context.now())
        return False

    async def _read(self, method: str, *, must_be_one_plan: bool = False) -> tuple[MissionItem, ...]:
        while True:
            changes = self._cache.changes
            received = await self._receive(method, must_be_one_plan=must_be_one_plan)
            if not received.items and await self._was_fence_hidden():
                continue
            if self._cache.changes == changes:  # No other station has changed the plan meanwhile.
                self._cache.set(received.items, self._context.now(), received.opaque_id)
                return received.items

    async def _was_fence_hidden(self) -> bool:
        """Return True if the vehicle was still starting, and has started now."""
        # ArduPilot reads its fence from storage at the end of its boot, 2.4 s after it has answered the first message.
        # Until then, it reports an empty fence.
        status = self._context.session.telemetry.system_status
        hides_fence = self._context.autopilot.hides_fence_at_boot and self._mission_type == MavMissionType.FENCE
        if not hides_fence or status.latest not in BOOT_STATES:
            return False
        with anyio.move_on_after(MAX_BOOT_S):
            await status.wait_until(lambda state: state not in BOOT_STATES, description="the end of the boot")
        return status.latest not in BOOT_STATES

    async def _receive(self, method: str, *, must_be_one_plan: bool) -> DownloadResult:
        if await self._uses_file(method):
            try:
                items = await self._channel.read_file(must_be_one_plan=must_be_one_plan)
            except (FileError, FileTimeout, RemoteProtocolError) as error:
                self._on_file_error(error, method)
            else:
                self._cache.has_file = True
                return DownloadResult(items, len(items), opaque_id=0)
        return await (self._channel.receive_one_plan() if must_be_one_plan else self._channel.receive())

    async def _uses_file(self, method: str, *, is_upload: bool = False) -> bool:
        """Return True if the plan is to be transferred as a file.

        Raises NotSupported if ``method`` is ``"ftp"`` and the vehicle has no MAVFTP.
        """
        if method == "items":
            return False
        has_ftp = await self._channel.has_ftp(by_default=method == "ftp")
        if method == "ftp":
            if not has_ftp:
                raise NotSupported(f"{self._name}: the vehicle has no file transfer; nothing was sent")
            return True
        # ArduPilot refuses a mission file while it flies a mission, because a new file first clears the old mission.
        is_refused = is_upload and self._mission_type == MavMissionType.MISSION and self._context.is_flying_mission
        may_have_file = self._cache.has_file is not False  # None until tried
        return has_ftp and may_have_file and not is_refused

    def _on_file_error(self, error: Exception, method: str) -> None:
        """Raise the error, or use the mission protocol instead of files from now on."""
        # If files have worked before, only a FileError ends their use.
        if method == "ftp" or (self._cache.has_file and not isinstance(error, FileError)):
            raise error
        self._cache.has_file = False

    @contextmanager
    def _describe_file_timeout(
        self, method: str, consequence: str = "", *, missing: Sequence[int] = ()
    ) -> Iterator[None]:
        """Add the consequence to the text of a FileTimeout. Unless ``method`` is ``"ftp"``, raise a MissionTimeout."""
        try:
            yield
        except FileTimeout as error:
            text = f"{error}{consequence}"
            if method != "ftp":
                raise MissionTimeout(f"{self._name}: {text}", missing=tuple(missing)) from None
            error.args = (text,)
            raise

    async def _send_all(self, items: Sequence[MissionItem], method: str, *, verify: bool) -> None:
        if await self._uses_file(method, is_upload=True):
            with self._describe_file_timeout(method, f"; {UNKNOWN_CONTENT}", missing=range(len(items) - self._offset)):
                await self._send_file(items, method)
        else:
            await self._send_items(items, method, verify=verify)

    async def _send_items(
        self, items: Sequence[MissionItem], method: str, *, verify: bool, may_repeat: bool = True
    ) -> None:
        started_at = self._context.now()
        result = await self._channel.send(items)
        if result.is_confirmed:
            self._cache.set(items, self._context.now(), result.opaque_id)
        if result.is_confirmed and not verify:
            return
        if await self._is_verified_by_checksum(items):
            return
        try:
            await self._verify(items, method)
        except MissionTimeout as error:
            # This is the time-out of the download. The caller must learn what became of the upload.
            is_unknown = "but whether the vehicle accepted them is unknown: call download()"
            outcome = "and confirmed by the vehicle" if result.is_confirmed else is_unknown
            error.args = (f"{error}; all items were sent, {outcome}",)
            error.missing = () if result.is_confirmed else tuple(range(result.item, len(items) - self._offset))
            raise
        except VerificationFailed as error:
            if result.is_confirmed:
                raise
            if may_repeat:
                # The answers were ambiguous. PX4 may have taken the first of our items for those of an earlier, shorter
                # upload, whose cancellation was lost. That upload has ended now.
                await self._send_items(items, method, verify=verify, may_repeat=False)
                return
            # The differences show that the vehicle refused the plan.
            raise MissionRejected(
                f"{self._name}: the vehicle refused the plan at about item {result.item}, or has changed items;"
                " its items differ from those sent",
                result=MavMissionResult.ERROR,
                item=result.item,
                # ArduPilot explains its refusal of a whole fence only by a text, e.g. "Fence exceeds storage size".
                reasons=self._context.session.texts_since(started_at) + error.differences,
            ) from None

    async def _send_file(self, items: Sequence[MissionItem], method: str) -> None:
        try:
            await self._channel.write_file(items)
        except (FileError, FileTimeout) as error:
            self._on_file_error(error, method)
        else:
            try:
                await self._verify(items, method)
                return
            except VerificationFailed:
                if method == "ftp":
                    raise
        # The vehicle has no such file, or has refused an item. The mission protocol reports which item and why.
        await self._send_items(items, method, verify=True)

    async def _send_changes(self, items: Sequence[MissionItem], method: str, *, verify: bool) -> bool:
        """Send only the differences. Return False if all items must be sent instead."""
        autopilot = self._context.autopilot
        if autopilot.reports_mission_checksum:
            reported = self._context.plan_id(self._mission_type, self._cache.updated_at)
            # Another station may have just replaced the plan. The next report must therefore have the same checksum.
            if reported == mission_checksum(items) and await self._reports_checksum_of(items):
                return True
        if not autopilot.writes_partial_missions or not self._is_worthwhile(self._changed_seqs(items), len(items)):
            return False
        try:
            with self._describe_file_timeout(method, "; the vehicle still has its previous items"):
                await self._read(method)  # Another station may have changed the plan.
        except RemoteProtocolError:  # Another station has changed it during the read; see `_verify`.
            return False
        changed_seqs = self._changed_seqs(items)
        if changed_seqs == []:  # The vehicle has these items already.
            return True
        if changed_seqs is None or not self._is_worthwhile(changed_seqs, len(items)):
            return False
        if not await self._replace_items(items, changed_seqs):
            return False
        if verify:  # Another station may have replaced other items since they were read.
            with self._describe_file_timeout(method, f"; all changed items were sent, {UNKNOWN_CONTENT}"):
                await self._verify(items, method)
        return True

    async def _replace_items(self, items: Sequence[MissionItem], changed_seqs: list[int]) -> bool:
        vehicle_items = list(self._cache.items or ())
        # The vehicle's plan is unknown until all parts are confirmed, because the call may fail or be cancelled.
        self._cache.forget(self._context.now())
        changes_before = self._cache.changes
        for part in _consecutive_ranges(changed_seqs):
            if not await self._send_part(items[part.start : part.stop], part.start):
                return False
            vehicle_items[part.start : part.stop] = items[part.start : part.stop]
        if self._cache.changes != changes_before:  # Another station has replaced the plan meanwhile.
            return False
        self._cache.set(vehicle_items, self._context.now())
        return True

    async def _send_part(self, items: Sequence[MissionItem], first_seq: int) -> bool:
        """Send consecutive items. Return False if all items must be sent instead."""
        result = await self._channel.send_part(items, first_seq)
        if result is None:
            return False
        if not result.is_confirmed:
            seqs = range(first_seq, first_seq + len(items))
            received = await self._channel.receive(only=seqs)
            self._compare(dict(zip(seqs, items)), dict(zip(seqs, received.items)))  # noqa: B905 - may be shorter
        return True

    def _changed_seqs(self, items: Sequence[MissionItem]) -> list[int] | None:
        """Return the seqs of changed items, or None if the plans cannot be compared."""
        vehicle_items = self._cache.items
        if vehicle_items is None or len(vehicle_items) != len(items):
            return None
        return [seq for seq in changed_items(items, vehicle_items, self._storage) if seq >= self._offset]

    @staticmethod
    def _is_worthwhile(changed_seqs: Collection[int] | None, count: int) -> bool:
        """Return True if sending only the changed items takes fewer messages than sending all."""
        if changed_seqs is None:
            return False
        parts = list(_consecutive_ranges(changed_seqs))
        return not parts or len(changed_seqs) + PART_OVERHEAD_ITEMS * len(parts) < count

    async def _is_verified_by_checksum(self, items: Sequence[MissionItem]) -> bool:
        """Return True if the vehicle reports the checksum of these items.

        Does not wait for the report if reading the items back is faster.
        """
        autopilot = self._context.autopilot
        round_trip_s = self._context.transfers.round_trip.smoothed_s or 0.0
        reading_takes_s = len(items) / autopilot.mission_download_window * round_trip_s
        is_checksum_faster = autopilot.reports_mission_checksum and reading_takes_s >= CHECKSUM_INTERVAL_S
        return is_checksum_faster and await self._reports_checksum_of(items)

    async def _reports_checksum_of(self, items: Sequence[MissionItem]) -> bool:
        checksum = mission_checksum(items)
        is_reported = await self._context.wait_for_plan_id(self._mission_type, checksum)
        if is_reported:
            self._cache.set(items, self._context.now(), checksum)
        return is_reported

    async def _verify(self, items: Sequence[MissionItem], method: str) -> None:
        try:
            received_items = await self._read(method)
        except RemoteProtocolError as error:
            # The plan has changed during the read: ArduPilot has erased a small fence, or another station has sent a
            # plan. The file then has blocks of two plans.
            raise self._mismatch((str(error),)) from error
        self._compare(dict(enumerate(items)), dict(enumerate(received_items)))

    def _compare(self, sent: dict[int, MissionItem], received: dict[int, MissionItem]) -> None:
        """Raise VerificationFailed if the items differ. Both mappings are keyed by seq."""
        differences = []
        if len(sent) != len(received):
            sent_count, received_count = (sum(seq >= self._offset for seq in seqs) for seqs in (sent, received))
            differences = [f"there are {received_count} items instead of {sent_count}"]
        is_single_precision = self._channel.is_single_precision
        for seq in sorted(sent.keys() & received.keys()):
            if seq >= self._offset:
                # Compare and show jump targets with the item numbers of the program, which do not count home.
                item, vehicle_item = shift_jumps([sent[seq], received[seq]], -self._offset)
                texts = item_differences(item, vehicle_item, self._storage, single_precision=is_single_precision)
                differences += [f"item {seq - self._offset} ({item.name}): {text}" for text in texts]
        if differences:
            raise self._mismatch(tuple(differences))

    def _mismatch(self, differences: tuple[str, ...]) -> VerificationFailed:
        """Forget the vehicle's items, and return the error for these differences."""
        self._cache.forget(self._context.now())
        message = f"{self._name}: the vehicle confirmed the plan, but has other items"
        return VerificationFailed(message, differences=differences)

    @property
    def _name(self) -> str:
        return PLAN_NAMES[self._mission_type]


def _consecutive_ranges(seqs: Collection[int]) -> Iterator[range]:
    """Return the ranges of consecutive numbers: 3, 4, 7 become 3–4 and 7."""
    current: range | None = None
    for seq in sorted(seqs):
        if current is not None and seq == current.stop:
            current = range(current.start, seq + 1)
            continue
        if current is not None:
            yield current
        current = range(seq, seq + 1)
    if current is not None:
        yield current
