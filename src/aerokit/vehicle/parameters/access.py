"""``ParameterAccess``: parameters of one vehicle by the names they have there: lists, reads, writes."""

from __future__ import annotations

import asyncio
import math
import os
from contextlib import contextmanager, nullcontext
from typing import TYPE_CHECKING, Literal

import anyio

from aerokit.errors import (
    FileError,
    FileTimeout,
    NotSupported,
    RemoteProtocolError,
)
from aerokit.mavlink.enums import MavCmd, MavFtpErr, MavProtocolCapability
from aerokit.mavlink.messages import FileTransferProtocol, ParamValue
from aerokit.parameters import Parameter, ParameterTable
from aerokit.parameters.pack import HASH_NAME
from aerokit.parameters.parameter import same_value
from aerokit.protocols.exchange import RoundTrip
from aerokit.vehicle.parameters.store import ParameterStore

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from aerokit.protocols.exchange import OnProgress
    from aerokit.protocols.parameter_requests import Answer
    from aerokit.vehicle.files.files import Files
    from aerokit.vehicle.parameters.store import ParameterCache
    from aerokit.vehicle.session.transfers import Transfers

DownloadMethod = Literal["auto", "ftp", "list"]
UploadMethod = Literal["auto", "ftp", "set"]
CacheChoice = bool | str | os.PathLike[str]
"""False: no cache; True: the one of this user; or a directory."""

FIRST_ANSWER_S, FIRST_ATTEMPTS = 2.0, 3
"""Silent for so long, and for so many sendings, MAVFTP is not there, whatever the vehicle says."""
ANSWER_S = 0.1
AS_BEFORE = 0
ECHOES_S = 3.0
"""How long after a write late and repeated answers to it may still come."""
FEW_READS = 5
"""More are not answered at once."""
SLOW_S = 0.5
"""After this long it is doubtful whether the vehicle has a parameter: to find out takes several rounds of requests."""
LEAST_TO_PACK = 10
"""Fewer changes than that are set one by one: it takes no longer, and each is confirmed by the vehicle itself."""
MOST_TO_READ_BACK = 100
"""More than that are read back by a download."""


class ParameterAccess:
    """What the vehicle has, and how to get and change it. Knows nothing of renamed parameters."""

    def __init__(self, transfers: Transfers, files: Files) -> None:
        self._transfers, self._files = transfers, files
        self.store: ParameterStore = ParameterStore(transfers)
        self._downloading = asyncio.Lock()
        self._writing = asyncio.Lock()
        self._has_pack: bool | None = None
        self._answers: RoundTrip | None = None
        self._attending = 0
        self._written_at: dict[str, float] = {}
        self.written: dict[str, int | float] = {}
        """What the vehicle has confirmed of the last write of each, by this program."""

    @property
    def _answer_time(self) -> RoundTrip:
        """How long reads take. Not the link's own time: ArduPilot answers ten times a second, five reads each time."""
        if self._answers is None:
            link_s = self._transfers.round_trip.smoothed_s
            self._answers = RoundTrip(None if link_s is None else link_s + ANSWER_S)
        return self._answers

    @property
    def has_upper_case_names(self) -> bool:
        """Whether all parameters of this autopilot are spelled in capitals."""
        return self._transfers.autopilot.has_upper_case_parameters

    def forget(self) -> None:
        """The vehicle has started anew, perhaps with another firmware."""
        self.store.forget()
        self._has_pack = None

    # ------------------------------------------------------------------------------- all of them

    async def download(
        self,
        method: DownloadMethod,
        *,
        refresh: bool,
        cache: CacheChoice,
        patience_s: float,
        on_progress: OnProgress | None,
    ) -> ParameterTable:
        """The whole table; see :meth:`Parameters.download`."""
        async with self._downloading:
            if self.store.is_complete and not refresh:
                return self.store.table
            keeper = None
            if cache is not False and self._transfers.autopilot.has_parameter_hash:
                from aerokit.vehicle.parameters.store import ParameterCache

                keeper = _Keeper(self, ParameterCache(None if cache is True else cache), patience_s)
                if await keeper.begin(refresh):
                    return self.store.table
            await self._download(method, patience_s, on_progress)
            if keeper is not None:
                await keeper.keep()
            return self.store.table

    async def _download(
        self, method: DownloadMethod, patience_s: float, on_progress: OnProgress | None
    ) -> None:
        if method == "ftp" or (method == "auto" and await self.has_pack()):
            try:
                with nullcontext() if method == "ftp" else self._unless_silent():
                    await self._download_pack(patience_s, on_progress)
                return
            except (FileError, FileTimeout, NotSupported, RemoteProtocolError) as error:
                if method == "ftp":
                    raise
                is_for_now = isinstance(error, RemoteProtocolError) or (
                    isinstance(error, FileError) and error.code == MavFtpErr.NOSESSIONSAVAILABLE
                )
                self._has_pack = None if is_for_now else False
        await self._download_list(patience_s, on_progress)

    @contextmanager
    def _unless_silent(self) -> Iterator[None]:
        """FileTimeout soon when MAVFTP is not answered at all: relays drop it, and there is another way."""
        connection, round_trip = self._transfers.connection, self._transfers.round_trip
        at_most_s = max(FIRST_ANSWER_S, FIRST_ATTEMPTS * round_trip.timeout_s())
        heard: list[object] = []
        detach = connection.bus.attach(
            FileTransferProtocol, heard.append, system_id=self._transfers.system_id
        )
        with anyio.CancelScope() as scope:
            timer = asyncio.get_running_loop().call_later(
                at_most_s, lambda: None if heard else scope.cancel()
            )
            try:
                yield
            finally:
                timer.cancel()
                detach()
        if scope.cancelled_caught:
            raise FileTimeout(f"MAVFTP was not answered within {at_most_s:.1f} s")

    async def has_pack(self) -> bool:
        """Whether the vehicle seems to give ``@PARAM/param.pck``: it has MAVFTP, and did not refuse it."""
        if self._has_pack is not None:
            return self._has_pack
        capabilities = await self._transfers.capabilities()
        return bool(capabilities and capabilities & MavProtocolCapability.FTP)

    async def _download_pack(self, patience_s: float, on_progress: OnProgress | None) -> None:
        """Read the file, again when it does not hold together.

        ArduPilot makes it up as it is read: where a parameter comes to differ from its default meanwhile, all behind it
        moves by some bytes, and holes that are filled do not fit. Without defaults nothing moves.
        """
        from aerokit.parameters.pack import PACK_PATH, PACK_PATH_WITH_DEFAULTS, unpack_parameters

        for path in (PACK_PATH_WITH_DEFAULTS, PACK_PATH_WITH_DEFAULTS, PACK_PATH):
            since = self.store.updates
            data = await self._files.read(path, patience_s=patience_s, on_progress=on_progress)
            try:
                table = unpack_parameters(data)
            except RemoteProtocolError:
                if path == PACK_PATH:
                    raise
            else:
                self.store.replace(self._with_known_defaults(table), since=since)
                self._has_pack = True
                return

    def _with_known_defaults(self, table: ParameterTable) -> ParameterTable:
        known = self.store.table
        return ParameterTable(
            Parameter(each.name, each.value, each.type, known[each.name].default, each.index)
            if each.default is None and each.name in known
            else each
            for each in table.values()
        )

    async def _download_list(self, patience_s: float, on_progress: OnProgress | None) -> None:
        from aerokit.protocols.parameter_list import ParameterList

        transfers = self._transfers
        exchange = ParameterList(
            transfers.system_id,
            transfers.component_id,
            bytewise=self.store.bytewise,
            round_trip=self._answer_time,
            patience_s=patience_s,
            on_progress=on_progress,
        )
        since = self.store.updates
        with self._attended():
            table = await transfers.run(exchange)
        self.store.replace(self._with_known_defaults(table), since=since)

    # ------------------------------------------------------------------------------- some of them

    async def read(
        self, names: Iterable[str], patience_s: float, *, are_doubtful: bool = False
    ) -> dict[str, Answer]:
        """What the vehicle says of each of them; ``are_doubtful``: perhaps it has none of these names."""
        names = tuple(names)
        if not names:
            return {}
        from aerokit.parameters.renames import other_names
        from aerokit.protocols.parameter_requests import ParameterReads

        transfers, store = self._transfers, self.store
        exchange = ParameterReads(
            transfers.system_id,
            transfers.component_id,
            names,
            bytewise=store.bytewise,
            are_doubtful=are_doubtful,
            rivals={name: other_names(name) for name in names} if are_doubtful else {},
            distrusted={name: old for name in names if (old := store.distrusted(name)) is not None},
            own_system=transfers.connection.source_system,
            round_trip=self._answer_time,
            patience_s=patience_s,
        )
        with self._attended(after_s=0.0 if len(names) > FEW_READS else SLOW_S if are_doubtful else math.inf):
            return await transfers.run(exchange)

    @contextmanager
    def _attended(self, *, after_s: float = 0.0) -> Iterator[None]:
        """Have the vehicle see to parameters more often until the block ends, where that can be had.

        It is asked by SET_MESSAGE_INTERVAL once the block has lasted ``after_s`` seconds, and again at its end.
        """
        interval_s = self._transfers.autopilot.parameter_interval_s
        if interval_s is None or after_s == math.inf:
            yield
            return
        has_begun = False

        def begin() -> None:
            nonlocal has_begun
            has_begun = True
            self._attending += 1
            if self._attending == 1:
                self._set_interval(interval_s * 1e6)

        timer = asyncio.get_running_loop().call_later(after_s, begin)
        try:
            yield
        finally:
            timer.cancel()
            if has_begun:
                self._attending -= 1
                if not self._attending:
                    self._set_interval(AS_BEFORE)

    def _set_interval(self, interval_us: float) -> None:
        self._transfers.command_in_background(MavCmd.SET_MESSAGE_INTERVAL, ParamValue.ID, interval_us)

    async def write(
        self,
        wanted: Iterable[Parameter],
        patience_s: float,
        on_progress: OnProgress | None = None,
    ) -> dict[str, Answer]:
        """Set each of them; what the vehicle says it is then. Writes of other tasks wait until it is done."""
        wanted = tuple(wanted)
        if not wanted:
            return {}
        from aerokit.protocols.parameter_requests import ParameterWrites

        transfers = self._transfers
        async with self._writing:
            before = {
                each.name: each.value for each in map(self.store.get, _names(wanted)) if each is not None
            }
            for name in _names(wanted):
                self.written.pop(name, None)
                self.store.trust(name)
            recent = self._recently_written() & set(_names(wanted))
            exchange = ParameterWrites(
                transfers.system_id,
                transfers.component_id,
                wanted,
                bytewise=self.store.bytewise,
                before=before,
                recent=recent,
                own_system=transfers.connection.source_system,
                round_trip=self._answer_time if recent else transfers.round_trip,
                patience_s=patience_s,
                on_progress=on_progress,
            )
            with self._attended(after_s=0.0 if len(recent) > FEW_READS else math.inf):
                answers = await transfers.run(exchange)
            for name, answer in answers.items():
                self._written_at[name] = transfers.connection.now()
                if isinstance(answer, Parameter):
                    self.written[name] = answer.value
                if isinstance(answer, Parameter) and name in before and answer.value != before[name]:
                    self.store.distrust(name, before[name])
            return answers

    def _recently_written(self) -> set[str]:
        """Those are read back after the next write, too: echoes of the last one may still come."""
        now = self._transfers.connection.now()
        self._written_at = {name: at for name, at in self._written_at.items() if now - at < ECHOES_S}
        return set(self._written_at)

    async def write_pack(
        self,
        wanted: Iterable[Parameter],
        method: UploadMethod,
        patience_s: float,
        on_progress: OnProgress | None,
    ) -> dict[str, Answer]:
        """As :meth:`write`, all in one file where that works; what did not arrive that way is set one by one."""
        wanted = tuple(wanted)
        if method == "set" or (
            method == "auto" and (len(wanted) < LEAST_TO_PACK or not await self.has_pack())
        ):
            return await self.write(wanted, patience_s, on_progress)
        answers: dict[str, Answer] = {}
        try:
            async with self._writing:
                await self._upload_pack(wanted, patience_s, on_progress)
            answers = await self._read_back(wanted, patience_s)
        except (FileError, FileTimeout, NotSupported):
            if method == "ftp":
                raise
        left = [each for each in wanted if not self._is_there(each, answers.get(each.name))]
        self.written.update({each.name: each.value for each in wanted if each not in left})
        return {each.name: answers[each.name] for each in wanted if each not in left} | await self.write(
            left, patience_s, on_progress
        )

    async def _upload_pack(
        self, wanted: tuple[Parameter, ...], patience_s: float, on_progress: OnProgress | None
    ) -> None:
        from aerokit.parameters.pack import PACK_PATH, pack_parameters

        await self._files.write(
            PACK_PATH, pack_parameters(wanted), patience_s=patience_s, on_progress=on_progress
        )

    async def _read_back(self, wanted: tuple[Parameter, ...], patience_s: float) -> dict[str, Answer]:
        if len(wanted) <= MOST_TO_READ_BACK:
            return await self.read(_names(wanted), patience_s)
        await self.download("auto", refresh=True, cache=False, patience_s=patience_s, on_progress=None)
        table = self.store.table
        return {name: table[name] for name in _names(wanted) if name in table}

    def _is_there(self, wanted: Parameter, answer: Answer | None) -> bool:
        """Whether a value has arrived; one read back as a number in a float has lost its last bits."""
        if not isinstance(answer, Parameter):
            return False
        if self.store.bytewise:
            return same_value(answer.value, wanted.value)
        return same_value(float(answer.value), float(wanted.value))


class _Keeper:
    """One download and the file in the cache that spares it."""

    def __init__(self, access: ParameterAccess, cache: ParameterCache, patience_s: float) -> None:
        self._access, self._cache, self._patience_s = access, cache, patience_s
        self._hash: int | None = None

    async def begin(self, refresh: bool) -> bool:
        """Whether the list on disk is that of the vehicle and wanted: then it is the store's now."""
        key, store, since = await self._key(), self._access.store, self._access.store.updates
        self._hash = await self._read_hash()
        table = None if refresh or self._hash is None else self._cache.load(key, self._hash)
        if table is None:
            return False
        store.replace(table, since=since)
        return True

    async def keep(self) -> None:
        """Write the list to disk, if nothing has changed while it came."""
        if self._hash is not None and self._hash == await self._read_hash():
            self._cache.save(await self._key(), self._hash, self._access.store.table)

    async def _key(self) -> str:
        from aerokit.vehicle.parameters.store import vehicle_key

        transfers = self._access._transfers
        await transfers.capabilities()
        return vehicle_key(transfers.autopilot.name, transfers.system_id, transfers.version)

    async def _read_hash(self) -> int | None:
        answer = (await self._access.read([HASH_NAME], self._patience_s))[HASH_NAME]
        return int(answer.value) if isinstance(answer, Parameter) else None


def _names(parameters: Iterable[Parameter]) -> list[str]:
    return [each.name for each in parameters]
