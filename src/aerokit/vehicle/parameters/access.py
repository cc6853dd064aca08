"""``ParameterAccess``: lists, reads and writes parameters by the names that the vehicle uses."""

from __future__ import annotations

import asyncio
import os
from contextlib import contextmanager, nullcontext, suppress
from typing import TYPE_CHECKING, Literal

import anyio

from aerokit.errors import AerokitError, FileError, FileTimeout, RemoteProtocolError
from aerokit.mavlink.enums import MavCmd, MavFtpErr, MavProtocolCapability
from aerokit.mavlink.messages import FileTransferProtocol, ParamValue
from aerokit.parameters import Parameter, ParameterTable
from aerokit.parameters.pack import HASH_NAME
from aerokit.parameters.parameter import same_value
from aerokit.protocols.exchange import IDLE_TIMEOUT_S, RoundTrip, is_addressed_to
from aerokit.vehicle.parameters.store import STALE_VALUE_S, ParameterCache, ParameterStore, vehicle_key

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from aerokit.protocols.exchange import OnProgress
    from aerokit.protocols.parameter_requests import ParameterAnswer
    from aerokit.vehicle.files.files import Files
    from aerokit.vehicle.session.transfers import Transfers

DownloadMethod = Literal["auto", "ftp", "list"]
UploadMethod = Literal["auto", "ftp", "set"]
CacheChoice = bool | str | os.PathLike[str]
"""False: no cache; True: the user's cache directory; or the path of another directory."""

# Seconds and attempts without an answer after which MAVFTP counts as unsupported, even if the vehicle advertises it.
FTP_PROBE_TIMEOUT_S, FTP_PROBE_ATTEMPTS = 2.0, 3
# ArduPilot answers MAX_READS_AT_DEFAULT_RATE reads every ANSWER_DELAY_S while PARAM_VALUE has its default rate.
ANSWER_DELAY_S, MAX_READS_AT_DEFAULT_RATE = 0.1, 5
# Value of SET_MESSAGE_INTERVAL that restores the autopilot's default rate.
DEFAULT_INTERVAL = 0
# Seconds after a write in which late or repeated answers to it may arrive.
LATE_ANSWER_S = 3.0
# A read that is unanswered after this many seconds probably asks for a parameter that the vehicle lacks. Because the
# request is then repeated several times, a higher rate of answers is worth its cost.
RAISE_DELAY_S = 0.5
# Fewer changes than this are set one by one. A file would not be faster, and the vehicle confirms each value.
MIN_CHANGES_FOR_FILE = 10
# If more values than this must be read back, the whole list is downloaded instead.
MAX_READ_BACK = 100


class ParameterAccess:
    """Downloads, reads and writes the parameters of one vehicle, by the names that its firmware uses.

    :class:`NameResolver` finds these names if the program uses others.
    """

    def __init__(self, transfers: Transfers, files: Files) -> None:
        self._transfers, self._files = transfers, files
        self.store: ParameterStore = ParameterStore(transfers, self._read_later)
        self._read_later_names: set[str] = set()  # names that `_read_later` will read
        self._download_lock = asyncio.Lock()
        self._write_lock = asyncio.Lock()
        self._has_file: bool | None = None  # True if the vehicle offers all parameters in one file; None until tried
        self._cached_read_round_trip: RoundTrip | None = None  # see `_read_round_trip`
        self._has_awaited_capabilities = False  # see `learn_encoding`
        self._rate_users = 0  # number of running operations that need a raised rate of answers
        self._written_at: dict[str, float] = {}  # maps each name to the time of its last write
        # Last value of each parameter that this program has written; None until the vehicle confirms the value.
        self.written: dict[str, int | float | None] = {}

    @property
    def _read_round_trip(self) -> RoundTrip:
        if self._cached_read_round_trip is None:
            shared = self._transfers.round_trip
            initial_s = None if shared.smoothed_s is None else shared.smoothed_s + ANSWER_DELAY_S
            self._cached_read_round_trip = RoundTrip(initial_s, link_s=shared.link_s)
        return self._cached_read_round_trip

    @property
    def has_upper_case_names(self) -> bool:
        return self._transfers.autopilot.has_upper_case_parameters

    @property
    def plan_size_parameters(self) -> frozenset[str]:
        return self._transfers.autopilot.plan_size_parameters

    def forget(self) -> None:
        self.store.forget()
        self._has_file = None
        self._has_awaited_capabilities = False

    async def learn_encoding(self) -> None:
        """Wait for the capabilities if the encoding of integers depends on them, but only once."""
        if self._transfers.autopilot.has_fixed_parameter_encoding or self._has_awaited_capabilities:
            return
        await self._transfers.capabilities()
        self._has_awaited_capabilities = True

    async def download(
        self,
        method: DownloadMethod,
        *,
        refresh: bool,
        cache: CacheChoice,
        idle_timeout_s: float,
        on_progress: OnProgress | None,
    ) -> ParameterTable:
        """Return all parameters. Download them if some are unknown, or if ``refresh`` is True."""
        async with self._download_lock:
            if self.store.is_complete and not refresh:
                return self.store.table
            cached_list = None
            if cache is not False and self._transfers.autopilot.has_parameter_hash:
                cached_list = _CachedList(self, ParameterCache(None if cache is True else cache), idle_timeout_s)
                is_loaded = await cached_list.load_if_current(refresh=refresh)
                if is_loaded:
                    return self.store.table
            while True:
                await self._download(method, idle_timeout_s, on_progress)
                if cached_list is not None:
                    await cached_list.save()
                if self.store.is_complete:  # False if the vehicle has rebooted meanwhile.
                    return self.store.table

    async def _download(self, method: DownloadMethod, idle_timeout_s: float, on_progress: OnProgress | None) -> None:
        if method == "ftp" or (method == "auto" and await self.has_file()):
            # With "auto", the probe ends the attempt if MAVFTP does not answer, and the list is downloaded instead.
            probe = nullcontext() if method == "ftp" else self._ftp_probe()
            try:
                with probe:
                    await self._download_file(idle_timeout_s, on_progress)
                return
            except (FileError, FileTimeout, RemoteProtocolError) as error:
                if method == "ftp":
                    raise
                # The next download may succeed if the file was damaged, or if the vehicle had another file open.
                is_damaged = isinstance(error, RemoteProtocolError)
                is_busy = isinstance(error, FileError) and error.code == MavFtpErr.NOSESSIONSAVAILABLE
                # With None, the next download tries the file again.
                self._has_file = None if is_damaged or is_busy else False
        await self._download_list(idle_timeout_s, on_progress)

    @contextmanager
    def _ftp_probe(self) -> Iterator[None]:
        """Context manager: cancel its block and raise FileTimeout if no MAVFTP answer arrives within a few seconds."""
        connection, round_trip = self._transfers.connection, self._transfers.round_trip
        # Some relays drop only MAVFTP, so do not wait for the idle time-out.
        timeout_s = max(FTP_PROBE_TIMEOUT_S, FTP_PROBE_ATTEMPTS * round_trip.timeout_s())

        def on_message(message: FileTransferProtocol) -> None:
            # The vehicle also answers other stations.
            if is_addressed_to(message, connection.source_system, connection.source_component):
                timer.cancel()

        with anyio.CancelScope() as scope:
            timer = asyncio.get_running_loop().call_later(timeout_s, scope.cancel)
            detach = connection.bus.attach(FileTransferProtocol, on_message, system_id=self._transfers.system_id)
            try:
                yield
            finally:
                timer.cancel()
                detach()
        if scope.cancelled_caught:
            raise FileTimeout(f"the vehicle did not answer MAVFTP requests within {timeout_s:.1f} s")

    async def has_file(self) -> bool:
        if self._has_file is not None:
            return self._has_file
        capabilities = await self._transfers.capabilities()
        return bool(capabilities and capabilities & MavProtocolCapability.FTP)

    async def _download_file(self, idle_timeout_s: float, on_progress: OnProgress | None) -> None:
        from aerokit.parameters.pack import PACK_PATH, PACK_PATH_WITH_DEFAULTS, unpack_parameters

        # ArduPilot generates the file while it is read. If a parameter changes from its default value meanwhile, all
        # data after it moves by some bytes. Blocks that were read at different times then do not fit together. A file
        # without defaults does not have this problem.
        for path in (PACK_PATH_WITH_DEFAULTS, PACK_PATH_WITH_DEFAULTS, PACK_PATH):
            updates_before = self.store.updates
            data = await self._files.read(path, idle_timeout_s=idle_timeout_s, on_progress=on_progress)
            try:
                table = unpack_parameters(data)
            except RemoteProtocolError:
                if path == PACK_PATH:
                    raise
            else:
                self.store.replace(self._with_known_defaults(table), updates_before=updates_before)
                self._has_file = True
                return

    def _with_known_defaults(self, table: ParameterTable) -> ParameterTable:
        """Return a copy of ``table``. Defaults that it lacks are taken from the parameters that were known before."""
        known = self.store.table
        parameters = []
        for parameter in table.values():
            if parameter.default is None and parameter.name in known:
                parameter = parameter.replace(default=known[parameter.name].default)
            parameters.append(parameter)
        return ParameterTable(parameters)

    async def _download_list(self, idle_timeout_s: float, on_progress: OnProgress | None) -> None:
        from aerokit.protocols.parameter_list import ParameterList

        await self.learn_encoding()
        transfers = self._transfers
        exchange = ParameterList(
            transfers.system_id,
            transfers.component_id,
            bytewise=self.store.bytewise,
            round_trip=self._read_round_trip,
            idle_timeout_s=idle_timeout_s,
            on_progress=on_progress,
        )
        updates_before = self.store.updates
        with self._raised_rate():
            table = await transfers.run(exchange)
        self.store.replace(self._with_known_defaults(table), updates_before=updates_before)

    async def read(
        self, names: Iterable[str], idle_timeout_s: float, *, probe: bool = False
    ) -> dict[str, ParameterAnswer]:
        """Request parameters from the vehicle. Return a parameter or an error for each name.

        Set ``probe`` to True if the vehicle may not have all of them.
        """
        names = tuple(names)
        if not names:
            return {}
        from aerokit.parameters.renames import other_names
        from aerokit.protocols.parameter_requests import ParameterReads

        await self.learn_encoding()
        transfers, store = self._transfers, self.store
        stale_values = {name: store.stale_value(name) for name in names}
        exchange = ParameterReads(
            transfers.system_id,
            transfers.component_id,
            names,
            bytewise=store.bytewise,
            probe=probe,
            alternatives={name: other_names(name) for name in names} if probe else {},
            possibly_stale={name: stale.value for name, stale in stale_values.items() if stale is not None},
            own_system=transfers.connection.source_system,
            round_trip=self._read_round_trip,
            idle_timeout_s=idle_timeout_s,
        )
        if len(names) > MAX_READS_AT_DEFAULT_RATE:
            raise_rate_after_s: float | None = 0.0
        elif probe:
            raise_rate_after_s = RAISE_DELAY_S
        else:
            raise_rate_after_s = None
        with self._raised_rate(raise_rate_after_s):
            return await transfers.run(exchange)

    def _read_later(self, name: str, due_at: float) -> None:
        """Schedule a background read of a parameter at the time ``due_at`` of the event loop's clock."""

        async def read() -> None:
            await anyio.sleep(due_at - self._transfers.connection.now())
            self._read_later_names.discard(name)
            with suppress(AerokitError):
                # The answer corrects the stored value, which may be wrong.
                await self.read([name], IDLE_TIMEOUT_S)

        if name not in self._read_later_names:
            self._read_later_names.add(name)
            self._transfers.background.start(read, f"aerokit read of {name}")

    @contextmanager
    def _raised_rate(self, after_s: float | None = 0.0) -> Iterator[None]:
        """Context manager: raise the rate at which ArduPilot handles parameters ``after_s`` seconds after entry.

        The rate is restored at the end of the block. If ``after_s`` is None, the rate is not changed.
        """
        interval_s = self._transfers.autopilot.parameter_interval_s
        if interval_s is None or after_s is None:
            yield
            return
        is_raised = False

        def raise_rate() -> None:
            nonlocal is_raised
            is_raised = True
            self._rate_users += 1
            if self._rate_users == 1:
                # ArduPilot handles parameters at the rate of the message PARAM_VALUE.
                self._set_interval(interval_s * 1e6)  # microseconds

        timer = asyncio.get_running_loop().call_later(after_s, raise_rate)
        try:
            yield
        finally:
            timer.cancel()
            if is_raised:
                self._rate_users -= 1
                if not self._rate_users:
                    self._set_interval(DEFAULT_INTERVAL)

    def _set_interval(self, interval_us: float) -> None:
        self._transfers.command_in_background(MavCmd.SET_MESSAGE_INTERVAL, ParamValue.ID, interval_us)

    async def write(
        self, parameters: Iterable[Parameter], idle_timeout_s: float, on_progress: OnProgress | None = None
    ) -> dict[str, ParameterAnswer]:
        async with self._write_lock:
            return await self._write(tuple(parameters), idle_timeout_s, on_progress)

    async def _write(
        self, parameters: tuple[Parameter, ...], idle_timeout_s: float, on_progress: OnProgress | None
    ) -> dict[str, ParameterAnswer]:
        if not parameters:
            return {}
        from aerokit.protocols.parameter_requests import ParameterWrites

        transfers = self._transfers
        names = _names(parameters)
        known = [self.store.get(name) for name in names if not self.is_in_doubt(name)]
        old_values = {parameter.name: parameter.value for parameter in known if parameter is not None}
        self._forget_written(names)
        # Recently written parameters are verified by a read, which ArduPilot answers more slowly than a write.
        recently_written = self._recently_written() & set(names)
        exchange = ParameterWrites(
            transfers.system_id,
            transfers.component_id,
            parameters,
            bytewise=self.store.bytewise,
            before=old_values,
            recent=recently_written,
            own_system=transfers.connection.source_system,
            round_trip=self._read_round_trip if recently_written else transfers.round_trip,
            idle_timeout_s=idle_timeout_s,
            on_progress=on_progress,
        )
        # A higher rate of PARAM_VALUE takes bandwidth from telemetry, so it is requested only for many reads.
        raise_rate_after_s = 0.0 if len(recently_written) > MAX_READS_AT_DEFAULT_RATE else None
        try:
            with self._raised_rate(raise_rate_after_s):
                answers = await transfers.run(exchange)
        finally:
            # Failed and cancelled writes are recorded as well, because their answers may arrive late.
            self._written_at.update(dict.fromkeys(names, transfers.connection.now()))
        for name, answer in answers.items():
            if isinstance(answer, Parameter):
                self._on_confirmed(name, answer.value, old_values.get(name))
        return answers

    def _on_confirmed(self, name: str, value: float, old_value: float | None) -> None:
        self.written[name] = value
        # A late answer with the previous value must not replace the new one in the store.
        if old_value is not None and value != old_value:
            self.store.set_stale(name, old_value)
        stored = self.store.get(name)
        if stored is not None and not same_value(stored.value, value):
            # Another value arrived after the confirmation. It may answer an earlier request, so read it again.
            self._read_later(name, self._transfers.connection.now() + STALE_VALUE_S)

    def is_in_doubt(self, name: str) -> bool:
        """Return True if the known value may be wrong because of the last write by this program.

        This is so if the write was cancelled or not confirmed, or if the known value differs from the written one.
        """
        if name not in self.written:
            return False
        known, written = self.store.get(name), self.written[name]
        return known is None or written is None or not same_value(known.value, written)

    def _forget_written(self, names: Iterable[str]) -> None:
        # Until the new values are confirmed, the vehicle's values are unknown.
        for name in names:
            self.written[name] = None
            self.store.clear_stale(name)

    def _recently_written(self) -> set[str]:
        # A late answer to the last write of these parameters could be taken for the answer to their next write. The
        # next write is therefore verified by a read.
        earliest = self._transfers.connection.now() - LATE_ANSWER_S
        self._written_at = {name: written_at for name, written_at in self._written_at.items() if written_at > earliest}
        return set(self._written_at)

    async def write_file(
        self,
        parameters: Iterable[Parameter],
        method: UploadMethod,
        idle_timeout_s: float,
        on_progress: OnProgress | None,
    ) -> dict[str, ParameterAnswer]:
        """Write parameters in one file, or one by one, as ``method`` says.

        After a file, all values are read back, and those that the vehicle did not apply are set one by one.
        """
        parameters = tuple(parameters)
        if not parameters:
            return {}
        if method == "auto" and (len(parameters) < MIN_CHANGES_FOR_FILE or not await self.has_file()):
            method = "set"
        if method == "set":
            return await self.write(parameters, idle_timeout_s, on_progress)
        answers: dict[str, ParameterAnswer] = {}
        # Another task must not write during the read-back. This call would take the other task's value for a wrong one,
        # and overwrite it.
        async with self._write_lock:
            self._forget_written(_names(parameters))
            try:
                await self._upload_file(parameters, idle_timeout_s, on_progress)
                answers = await self._read_back(parameters, idle_timeout_s)
            except (FileError, FileTimeout):  # With "auto", all parameters are set one by one instead.
                if method == "ftp":
                    raise
            not_applied = tuple(param for param in parameters if not self._was_applied(param, answers.get(param.name)))
            applied = [param for param in parameters if param not in not_applied]
            self.written.update({param.name: param.value for param in applied})
            later_answers = await self._write(not_applied, idle_timeout_s, on_progress)
            return {param.name: answers[param.name] for param in applied} | later_answers

    async def _upload_file(
        self, parameters: tuple[Parameter, ...], idle_timeout_s: float, on_progress: OnProgress | None
    ) -> None:
        from aerokit.parameters.pack import PACK_PATH, pack_parameters

        await self._files.write(
            PACK_PATH, pack_parameters(parameters), idle_timeout_s=idle_timeout_s, on_progress=on_progress
        )

    async def _read_back(self, written: tuple[Parameter, ...], idle_timeout_s: float) -> dict[str, ParameterAnswer]:
        if len(written) <= MAX_READ_BACK:
            return await self.read(_names(written), idle_timeout_s)
        await self.download("auto", refresh=True, cache=False, idle_timeout_s=idle_timeout_s, on_progress=None)
        table = self.store.table
        return {name: table[name] for name in _names(written) if name in table}

    def _was_applied(self, written: Parameter, answer: ParameterAnswer | None) -> bool:
        if not isinstance(answer, Parameter):
            return False
        if self.store.bytewise:
            return same_value(answer.value, written.value)
        # The vehicle sends all values as floats, so the last bits are ignored.
        return same_value(float(answer.value), float(written.value))


class _CachedList:
    """Cached parameter list of a vehicle. It is used if the vehicle's parameter hash has not changed."""

    def __init__(self, access: ParameterAccess, cache: ParameterCache, idle_timeout_s: float) -> None:
        self._access, self._cache, self._idle_timeout_s = access, cache, idle_timeout_s
        self._hash: int | None = None

    async def load_if_current(self, *, refresh: bool) -> bool:
        """Put the cached list into the store. Return False if it is missing or outdated, or if ``refresh`` is True."""
        store = self._access.store
        key = await self._key()
        updates_before = store.updates
        self._hash = await self._read_hash()  # The hash is also read with `refresh`, because `save` needs it.
        if refresh or self._hash is None:
            return False
        table = self._cache.load(key, self._hash)
        if table is None:
            return False
        store.replace(table, updates_before=updates_before)
        return store.is_complete

    async def save(self) -> None:
        # Another hash means that a parameter changed during the download.
        if self._hash is not None and self._hash == await self._read_hash():
            key = await self._key()
            if self._access.store.is_complete:  # False if the vehicle has rebooted meanwhile.
                self._cache.save(key, self._hash, self._access.store.table)

    async def _key(self) -> str:
        transfers = self._access._transfers
        await transfers.capabilities()
        return vehicle_key(transfers.autopilot.name, transfers.system_id, transfers.version)

    async def _read_hash(self) -> int | None:
        answers = await self._access.read([HASH_NAME], self._idle_timeout_s)
        answer = answers[HASH_NAME]
        return int(answer.value) if isinstance(answer, Parameter) else None


def _names(parameters: Iterable[Parameter]) -> list[str]:
    return [parameter.name for parameter in parameters]
