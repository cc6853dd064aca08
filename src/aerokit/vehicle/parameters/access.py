"""``ParameterAccess``: lists, reads and writes parameters by the names that the vehicle uses."""

from __future__ import annotations

import asyncio
import math
import os
from contextlib import contextmanager, nullcontext
from typing import TYPE_CHECKING, Literal

import anyio

from aerokit.errors import FileError, FileTimeout, NotSupported, RemoteProtocolError
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
    from aerokit.protocols.parameter_requests import ParameterAnswer
    from aerokit.vehicle.files.files import Files
    from aerokit.vehicle.parameters.store import ParameterCache
    from aerokit.vehicle.session.transfers import Transfers

DownloadMethod = Literal["auto", "ftp", "list"]
UploadMethod = Literal["auto", "ftp", "set"]
CacheChoice = bool | str | os.PathLike[str]
"""False: no cache; True: the user's cache directory; or the path of another directory."""

# Seconds and attempts without an answer after which MAVFTP counts as unsupported, even if the vehicle advertises it.
FTP_PROBE_TIMEOUT_S, FTP_PROBE_ATTEMPTS = 2.0, 3
ANSWER_DELAY_S = 0.1
# SET_MESSAGE_INTERVAL: the default rate of the autopilot.
DEFAULT_INTERVAL = 0
# Late or repeated answers to a write may arrive for this long.
ECHO_WINDOW_S = 3.0
# ArduPilot answers this many reads at once; more wait for its next turn.
MAX_READS_UNBOOSTED = 5
# A missing parameter is recognised only after several requests, so the rate is raised after this time.
BOOST_DELAY_S = 0.5
# Fewer changes than this are set one by one, which is as fast, and which the vehicle confirms.
MIN_PACK_SIZE = 10
# More values than this are read back by a download.
MAX_READ_BACK = 100


class ParameterAccess:
    """The parameters of one vehicle. Does not translate renamed parameters."""

    def __init__(self, transfers: Transfers, files: Files) -> None:
        self._transfers, self._files = transfers, files
        self.store: ParameterStore = ParameterStore(transfers)
        self._downloading = asyncio.Lock()
        self._writing = asyncio.Lock()
        self._has_pack: bool | None = None
        self._answers: RoundTrip | None = None
        self._boosts = 0
        self._written_at: dict[str, float] = {}
        # Last value of each parameter that this program has written and the vehicle has confirmed.
        self.written: dict[str, int | float] = {}

    @property
    def _answer_time(self) -> RoundTrip:
        # Answers take longer than the round trip of the link, because ArduPilot answers at most five reads every 0.1 s.
        if self._answers is None:
            link_s = self._transfers.round_trip.smoothed_s
            self._answers = RoundTrip(None if link_s is None else link_s + ANSWER_DELAY_S)
        return self._answers

    @property
    def has_upper_case_names(self) -> bool:
        """True if all parameter names of this autopilot are in upper case."""
        return self._transfers.autopilot.has_upper_case_parameters

    def forget(self) -> None:
        self.store.forget()
        self._has_pack = None

    async def download(
        self,
        method: DownloadMethod,
        *,
        refresh: bool,
        cache: CacheChoice,
        idle_timeout_s: float,
        on_progress: OnProgress | None,
    ) -> ParameterTable:
        async with self._downloading:
            if self.store.is_complete and not refresh:
                return self.store.table
            cached_list = None
            if cache is not False and self._transfers.autopilot.has_parameter_hash:
                from aerokit.vehicle.parameters.store import ParameterCache

                cached_list = _CachedList(self, ParameterCache(None if cache is True else cache), idle_timeout_s)
                if await cached_list.load_if_current(refresh):
                    return self.store.table
            await self._download(method, idle_timeout_s, on_progress)
            if cached_list is not None:
                await cached_list.save()
            return self.store.table

    async def _download(self, method: DownloadMethod, idle_timeout_s: float, on_progress: OnProgress | None) -> None:
        if method == "ftp" or (method == "auto" and await self.has_pack()):
            try:
                with nullcontext() if method == "ftp" else self._ftp_probe():
                    await self._download_pack(idle_timeout_s, on_progress)
                return
            except (FileError, FileTimeout, NotSupported, RemoteProtocolError) as error:
                if method == "ftp":
                    raise
                is_temporary = isinstance(error, RemoteProtocolError) or (
                    isinstance(error, FileError) and error.code == MavFtpErr.NOSESSIONSAVAILABLE
                )
                self._has_pack = None if is_temporary else False
        await self._download_list(idle_timeout_s, on_progress)

    @contextmanager
    def _ftp_probe(self) -> Iterator[None]:
        """Raise FileTimeout early if MAVFTP is not answered, because some relays drop it, and not the list."""
        connection, round_trip = self._transfers.connection, self._transfers.round_trip
        timeout_s = max(FTP_PROBE_TIMEOUT_S, FTP_PROBE_ATTEMPTS * round_trip.timeout_s())
        answers: list[object] = []
        detach = connection.bus.attach(FileTransferProtocol, answers.append, system_id=self._transfers.system_id)
        with anyio.CancelScope() as scope:
            timer = asyncio.get_running_loop().call_later(timeout_s, lambda: None if answers else scope.cancel())
            try:
                yield
            finally:
                timer.cancel()
                detach()
        if scope.cancelled_caught:
            raise FileTimeout(f"MAVFTP was not answered within {timeout_s:.1f} s")

    async def has_pack(self) -> bool:
        """Return True if the vehicle has MAVFTP and has not refused ``@PARAM/param.pck``."""
        if self._has_pack is not None:
            return self._has_pack
        capabilities = await self._transfers.capabilities()
        return bool(capabilities and capabilities & MavProtocolCapability.FTP)

    async def _download_pack(self, idle_timeout_s: float, on_progress: OnProgress | None) -> None:
        """Read the packed file; retry if its content is inconsistent.

        ArduPilot generates it while it is read: when a parameter comes to differ from its default meanwhile, all
        following data moves by some bytes, and blocks read at different times do not fit. Without defaults, nothing
        moves.
        """
        from aerokit.parameters.pack import PACK_PATH, PACK_PATH_WITH_DEFAULTS, unpack_parameters

        for path in (PACK_PATH_WITH_DEFAULTS, PACK_PATH_WITH_DEFAULTS, PACK_PATH):
            since = self.store.updates
            data = await self._files.read(path, idle_timeout_s=idle_timeout_s, on_progress=on_progress)
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
            param.replace(default=known[param.name].default) if param.default is None and param.name in known else param
            for param in table.values()
        )

    async def _download_list(self, idle_timeout_s: float, on_progress: OnProgress | None) -> None:
        from aerokit.protocols.parameter_list import ParameterList

        transfers = self._transfers
        exchange = ParameterList(
            transfers.system_id,
            transfers.component_id,
            bytewise=self.store.bytewise,
            round_trip=self._answer_time,
            idle_timeout_s=idle_timeout_s,
            on_progress=on_progress,
        )
        since = self.store.updates
        with self._boosted():
            table = await transfers.run(exchange)
        self.store.replace(self._with_known_defaults(table), since=since)

    async def read(
        self, names: Iterable[str], idle_timeout_s: float, *, probe: bool = False
    ) -> dict[str, ParameterAnswer]:
        """Read parameters; with ``probe``, ones that the vehicle may not have."""
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
            probe=probe,
            alternatives={name: other_names(name) for name in names} if probe else {},
            possibly_stale={name: old for name in names if (old := store.replaced_value(name)) is not None},
            own_system=transfers.connection.source_system,
            round_trip=self._answer_time,
            idle_timeout_s=idle_timeout_s,
        )
        with self._boosted(after_s=0.0 if len(names) > MAX_READS_UNBOOSTED else BOOST_DELAY_S if probe else math.inf):
            return await transfers.run(exchange)

    @contextmanager
    def _boosted(self, *, after_s: float = 0.0) -> Iterator[None]:
        """Raise the rate at which ArduPilot handles parameters, by SET_MESSAGE_INTERVAL of PARAM_VALUE.

        The rate is raised after ``after_s`` seconds, if the block lasts that long, and restored at the end of the
        block.
        """
        interval_s = self._transfers.autopilot.parameter_interval_s
        if interval_s is None or after_s == math.inf:
            yield
            return
        is_boosted = False

        def boost() -> None:
            nonlocal is_boosted
            is_boosted = True
            self._boosts += 1
            if self._boosts == 1:
                self._set_interval(interval_s * 1e6)

        timer = asyncio.get_running_loop().call_later(after_s, boost)
        try:
            yield
        finally:
            timer.cancel()
            if is_boosted:
                self._boosts -= 1
                if not self._boosts:
                    self._set_interval(DEFAULT_INTERVAL)

    def _set_interval(self, interval_us: float) -> None:
        self._transfers.command_in_background(MavCmd.SET_MESSAGE_INTERVAL, ParamValue.ID, interval_us)

    async def write(
        self, wanted: Iterable[Parameter], idle_timeout_s: float, on_progress: OnProgress | None = None
    ) -> dict[str, ParameterAnswer]:
        """Set parameters and return the vehicle's values. Writes of other tasks wait."""
        wanted = tuple(wanted)
        if not wanted:
            return {}
        from aerokit.protocols.parameter_requests import ParameterWrites

        transfers = self._transfers
        async with self._writing:
            before = {
                parameter.name: parameter.value
                for parameter in map(self.store.get, _names(wanted))
                if parameter is not None
            }
            for name in _names(wanted):
                self.written.pop(name, None)
                self.store.clear_replaced(name)
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
                idle_timeout_s=idle_timeout_s,
                on_progress=on_progress,
            )
            with self._boosted(after_s=0.0 if len(recent) > MAX_READS_UNBOOSTED else math.inf):
                answers = await transfers.run(exchange)
            for name, answer in answers.items():
                self._written_at[name] = transfers.connection.now()
                if isinstance(answer, Parameter):
                    self.written[name] = answer.value
                if isinstance(answer, Parameter) and name in before and answer.value != before[name]:
                    self.store.mark_replaced(name, before[name])
            return answers

    def _recently_written(self) -> set[str]:
        """Names whose values may still be echoed: the next write of one of them is read back."""
        now = self._transfers.connection.now()
        self._written_at = {name: at for name, at in self._written_at.items() if now - at < ECHO_WINDOW_S}
        return set(self._written_at)

    async def write_pack(
        self,
        wanted: Iterable[Parameter],
        method: UploadMethod,
        idle_timeout_s: float,
        on_progress: OnProgress | None,
    ) -> dict[str, ParameterAnswer]:
        """Like :meth:`write`, but in one file if possible; values that were not applied are then set one by one."""
        wanted = tuple(wanted)
        if method == "set" or (method == "auto" and (len(wanted) < MIN_PACK_SIZE or not await self.has_pack())):
            return await self.write(wanted, idle_timeout_s, on_progress)
        answers: dict[str, ParameterAnswer] = {}
        try:
            async with self._writing:
                await self._upload_pack(wanted, idle_timeout_s, on_progress)
            answers = await self._read_back(wanted, idle_timeout_s)
        except (FileError, FileTimeout, NotSupported):
            if method == "ftp":
                raise
        left = [param for param in wanted if not self._was_applied(param, answers.get(param.name))]
        applied = [param for param in wanted if param not in left]
        self.written.update({param.name: param.value for param in applied})
        remaining = await self.write(left, idle_timeout_s, on_progress)
        return {param.name: answers[param.name] for param in applied} | remaining

    async def _upload_pack(
        self, wanted: tuple[Parameter, ...], idle_timeout_s: float, on_progress: OnProgress | None
    ) -> None:
        from aerokit.parameters.pack import PACK_PATH, pack_parameters

        await self._files.write(
            PACK_PATH, pack_parameters(wanted), idle_timeout_s=idle_timeout_s, on_progress=on_progress
        )

    async def _read_back(self, wanted: tuple[Parameter, ...], idle_timeout_s: float) -> dict[str, ParameterAnswer]:
        if len(wanted) <= MAX_READ_BACK:
            return await self.read(_names(wanted), idle_timeout_s)
        await self.download("auto", refresh=True, cache=False, idle_timeout_s=idle_timeout_s, on_progress=None)
        table = self.store.table
        return {name: table[name] for name in _names(wanted) if name in table}

    def _was_applied(self, wanted: Parameter, answer: ParameterAnswer | None) -> bool:
        """Return True if the vehicle has the value; a value that was read as a float lacks its last bits."""
        if not isinstance(answer, Parameter):
            return False
        if self.store.bytewise:
            return same_value(answer.value, wanted.value)
        return same_value(float(answer.value), float(wanted.value))


class _CachedList:
    """The cached list of a vehicle, used if the vehicle's parameter hash has not changed."""

    def __init__(self, access: ParameterAccess, cache: ParameterCache, idle_timeout_s: float) -> None:
        self._access, self._cache, self._idle_timeout_s = access, cache, idle_timeout_s
        self._hash: int | None = None

    async def load_if_current(self, refresh: bool) -> bool:
        """Load the list into the store if it is current, and return True then."""
        key, store, since = await self._key(), self._access.store, self._access.store.updates
        self._hash = await self._read_hash()
        table = None if refresh or self._hash is None else self._cache.load(key, self._hash)
        if table is None:
            return False
        store.replace(table, since=since)
        return True

    async def save(self) -> None:
        """Save the downloaded list, unless parameters changed during the download."""
        if self._hash is not None and self._hash == await self._read_hash():
            self._cache.save(await self._key(), self._hash, self._access.store.table)

    async def _key(self) -> str:
        from aerokit.vehicle.parameters.store import vehicle_key

        transfers = self._access._transfers
        await transfers.capabilities()
        return vehicle_key(transfers.autopilot.name, transfers.system_id, transfers.version)

    async def _read_hash(self) -> int | None:
        answer = (await self._access.read([HASH_NAME], self._idle_timeout_s))[HASH_NAME]
        return int(answer.value) if isinstance(answer, Parameter) else None


def _names(parameters: Iterable[Parameter]) -> list[str]:
    return [parameter.name for parameter in parameters]
