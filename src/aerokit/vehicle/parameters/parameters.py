"""``vehicle.parameters``: reads, writes, compares and restores the parameters of an autopilot.

https://mavlink.io/en/services/parameter.html
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, TypeVar

from aerokit._internal.arguments import checks_arguments
from aerokit._internal.async_block import ReadOnly
from aerokit.errors import NotSupported, ParameterRejected, ParameterTimeout
from aerokit.parameters import Parameter, ParameterTable, check_name
from aerokit.protocols.exchange import IDLE_TIMEOUT_S
from aerokit.vehicle.parameters.access import CacheChoice, DownloadMethod, ParameterAccess, UploadMethod
from aerokit.vehicle.parameters.transaction import RestoreRegistry, TemporaryParameters, Transaction
from aerokit.vehicle.parameters.writing import NameResolver, Outcome, ParameterWrite, ParameterWriter, check_values

if TYPE_CHECKING:
    from aerokit.parameters import Metadata, ParameterDifference
    from aerokit.protocols.exchange import OnProgress
    from aerokit.vehicle.files.files import Files
    from aerokit.vehicle.session.transfers import Messaging

__all__ = ["Outcome", "ParameterWrite", "Parameters", "Transaction"]

ResultT = TypeVar("ResultT")

ParameterSource = ParameterTable | Mapping[str, float] | str | os.PathLike[str]
"""A table, a dict of values, or the path of a parameter file."""


@checks_arguments
class Parameters(ReadOnly):
    """The parameters of one autopilot. Coroutines exchange messages with the autopilot; ``table`` is the local copy.

    Every PARAM_VALUE of the autopilot updates the table, also after changes by other stations. Each change of a value
    is published as :class:`aerokit.events.ParameterChanged`. A reboot clears the table.

    ArduPilot 4.7 renamed parameters and changed their units (``WPNAV_SPEED`` in cm/s became ``WP_SPD`` in m/s). Every
    method accepts the old and the new name with either firmware, and converts the value. An old name that the vehicle
    no longer has causes an :class:`aerokit.parameters.ParameterRenamedWarning`, which contains the new name.

    ArduPilot handles parameters a few times a second. aerokit raises this rate by SET_MESSAGE_INTERVAL of PARAM_VALUE
    while it reads more than five parameters, and restores the rate at the end. While it reads fewer parameters that the
    vehicle may not have, it raises the rate after half a second without an answer.

    All methods take ``idle_timeout_s`` (fail after this many seconds without progress) and ``timeout`` (seconds in
    total; then OperationTimeout). You can cancel any call.
    """

    def __init__(self, session: Messaging, files: Files) -> None:
        self._transfers = session.transfers
        self._access = ParameterAccess(session.transfers, files)
        session.at_close(*self._access.store.attach())
        session.on_reboot.append(self._access.forget)
        self._names = NameResolver(self._access)
        self._metadata: Metadata | None = None  # set by `load_metadata`
        self._writer = ParameterWriter(self._access, self._names, self._note_of)
        self._registry = RestoreRegistry()

    @property
    def table(self) -> ParameterTable:
        """Known parameters in the vehicle's order; empty before the first read, and after a reboot."""
        return self._access.store.table

    def known(self, name: str) -> Parameter | None:
        """Return the known parameter with this name, or None. Like ``table.get(name)``, but does not build a table."""
        return self._access.store.get(name)

    @property
    def is_complete(self) -> bool:
        """True if all parameters were downloaded since the vehicle started, and since the link was last reopened."""
        return self._access.store.is_complete

    @property
    def metadata(self) -> Metadata | None:
        """Descriptions, units, ranges and bits of the parameters, by name. None before :meth:`load_metadata`."""
        return self._metadata

    def load_metadata(self, path: str | os.PathLike[str]) -> Metadata:
        """Load the documentation of the parameters from a file.

        The file is ArduPilot's ``apm.pdef.xml`` or ``apm.pdef.json``, or PX4's ``parameters.xml`` or
        ``parameters.json``. PX4's files also contain the defaults. Metadata does not restrict writes: a value outside
        its documented range is set, and the result has a ``note``. Metadata also says which changes need a reboot.

        Raises:
            FileFormatError, OSError: as for :func:`aerokit.parameters.load_metadata`.
        """
        from aerokit.parameters import load_metadata

        self._metadata = load_metadata(path)
        return self._metadata

    async def download(
        self,
        *,
        method: DownloadMethod = "auto",
        refresh: bool = False,
        cache: CacheChoice = False,
        idle_timeout_s: float = IDLE_TIMEOUT_S,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> ParameterTable:
        """Return all parameters. Downloads them first, unless :attr:`is_complete` is True.

        Args:
            method: ``"ftp"`` reads one small file that also has the defaults (``@PARAM/param.pck``), ``"list"``
                requests one message for each parameter, ``"auto"`` uses the file if there is one.
            refresh: download again, even if the parameters are known or cached.
            cache: store the list on disk, and use it while the vehicle's parameter hash is unchanged. The next program
                then needs only one request. True means the user's cache directory; or pass a path. Only PX4 has a hash.
                The hash does not cover parameters that PX4 changes by itself, so these may be outdated. Off by default.
            idle_timeout_s: fail after this many seconds without progress.
            timeout: seconds in total.
            on_progress: called with the number of parameters, or bytes of the file, so far and in total.

        Raises:
            ParameterTimeout: the list is incomplete; ``missing`` has the missing indices, ``table`` the parameters that
                have arrived.
            FileError, FileTimeout, RemoteProtocolError: with ``method="ftp"`` only.
        """
        with self._transfers.limit(timeout):
            return await self._access.download(
                method, refresh=refresh, cache=cache, idle_timeout_s=idle_timeout_s, on_progress=on_progress
            )

    async def get(
        self, name: str, *, idle_timeout_s: float = IDLE_TIMEOUT_S, timeout: float | None = None
    ) -> int | float:
        """Request one parameter from the vehicle; for arguments and errors see :meth:`read`."""
        return (await self.read(name, idle_timeout_s=idle_timeout_s, timeout=timeout)).value

    async def read(
        self, name: str, *, idle_timeout_s: float = IDLE_TIMEOUT_S, timeout: float | None = None
    ) -> Parameter:
        """Request one parameter from the vehicle, bypassing the local copy in ``table``.

        Raises:
            InvalidArgument: the name is empty, or longer than 16 characters.
            ParameterRejected: the vehicle reports that it has no such parameter, or answers only for other parameters.
            ParameterTimeout: there was no answer.
        """
        with self._transfers.limit(timeout):
            results = await self._names.resolve([name], idle_timeout_s)
            resolved = _value_or_raise(results[name])
            if resolved.is_fresh:  # The parameter has just been read to resolve the name.
                return resolved.as_requested(resolved.parameter)
            answers = await self._access.read([resolved.name], idle_timeout_s)
            return resolved.as_requested(_value_or_raise(answers[resolved.name]))

    async def probe(
        self, *names: str, idle_timeout_s: float = IDLE_TIMEOUT_S, timeout: float | None = None
    ) -> dict[str, Parameter | ParameterRejected | ParameterTimeout]:
        """Request several parameters that the vehicle may not have, by exactly these names.

        Use it to find out which of several names a firmware has; for renamed ArduPilot parameters use :meth:`get`.

        Returns:
            For each name the parameter, or the error that :meth:`get` would have raised. The error's ``code``
            is None if the vehicle ignored this name although it answered other requests.

        Raises:
            InvalidArgument: a name is empty, or longer than 16 characters. Nothing was sent.
        """
        with self._transfers.limit(timeout):
            return await self._access.read(map(check_name, names), idle_timeout_s, probe=True)

    async def set(
        self, name: str, value: float, *, idle_timeout_s: float = IDLE_TIMEOUT_S, timeout: float | None = None
    ) -> ParameterWrite:
        """Set one parameter; return the result as confirmed by the vehicle.

        Raises:
            InvalidArgument: the name is invalid, or the value is NaN or does not fit the parameter's type.
            ParameterRejected: the vehicle has no such parameter, or keeps the previous value; see ``code``.
            ParameterTimeout: the vehicle did not confirm the value, but may have set it.
        """
        results = await self.set_many({name: value}, idle_timeout_s=idle_timeout_s, timeout=timeout)
        result = results[name]
        if result.error is not None:
            raise result.error
        return result

    async def set_many(
        self,
        values: Mapping[str, float],
        *,
        idle_timeout_s: float = IDLE_TIMEOUT_S,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> dict[str, ParameterWrite]:
        """Set several parameters concurrently; return a result for each of them. Check the ``error`` of each result.

        Some ArduPilot parameters exist only while an ``…_ENABLE`` parameter is set. You can set both in one call.

        Raises:
            InvalidArgument: a name or value is invalid. Nothing was set.
        """
        with self._transfers.limit(timeout):
            return await self._writer.write(values, idle_timeout_s=idle_timeout_s, on_progress=on_progress)

    async def upload(
        self,
        parameters: ParameterSource,
        *,
        method: UploadMethod = "auto",
        idle_timeout_s: float = IDLE_TIMEOUT_S,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> dict[str, ParameterWrite]:
        """Set the vehicle's parameters to those of a table, a dict or a parameter file.

        Values that equal the known ones (:attr:`table`) are not sent, and get the outcome ``"unchanged"``. After a lost
        link was reopened (``reconnect=True``), the parameters are downloaded first. Call
        ``download(refresh=True)`` first if another station may have set values that your program has not received.

        ``method="ftp"`` writes one file (``@PARAM/param.pck``) and reads the values back. ``"set"`` sets them one by
        one. ``"auto"`` uses the file if the vehicle supports it and there are many changes.

        Results are as for :meth:`set_many`. A parameter that the vehicle does not have gets the outcome ``"failed"``
        and a ParameterRejected; all others are set. The same applies to ArduPilot's FENCE_TOTAL, MIS_TOTAL and
        RALLY_TOTAL, because another number would erase a plan or add old items to it. If two names mean the same
        parameter, the value under the vehicle's current name is used, and the other name gets no result.

        Raises:
            InvalidArgument, FileFormatError: a name, a value or the file is invalid. Nothing was set.
            OSError: the file cannot be read. Nothing was set.
            ParameterTimeout: the vehicle's own parameters could not be downloaded.
        """
        with self._transfers.limit(timeout):
            values = _values_of(parameters)
            check_values(values)
            table = await self._access.download(
                "auto", refresh=False, cache=False, idle_timeout_s=idle_timeout_s, on_progress=None
            )
            values = self._names.without_duplicates(values, table)
            return await self._writer.write(
                values, upload=method, idle_timeout_s=idle_timeout_s, on_progress=on_progress
            )

    def temporarily(
        self, values: Mapping[str, float], *, idle_timeout_s: float = IDLE_TIMEOUT_S
    ) -> TemporaryParameters:
        """Set values for the duration of an ``async with`` block, and restore the previous values at its end.

        They are also restored if the block raises or is cancelled; this takes at most three times ``idle_timeout_s``.
        If one value cannot be set, all other values are restored and the error is raised.

        Blocks that set the same parameter may be nested or overlap. When the last of them ends, the parameter gets its
        value from before the first. A value that another station has changed meanwhile is not restored; a warning of
        logger "aerokit" names the parameter.

        Raises:
            RollbackFailed: some values could not be restored; ``not_restored`` has them.
        """
        return TemporaryParameters(self._registry, self._access, self._writer, values, idle_timeout_s)

    def transaction(self, *, idle_timeout_s: float = IDLE_TIMEOUT_S) -> Transaction:
        """Write several parameters, either all or none.

        ``async with vehicle.parameters.transaction() as t: await t.set(…)``

        Each write is verified. If the block raises or is cancelled, or a write fails, the previous values are
        restored; see :class:`Transaction`.
        """
        return Transaction(self._registry, self._access, self._writer, self._needs_reboot, idle_timeout_s)

    async def diff(
        self,
        parameters: ParameterSource,
        *,
        idle_timeout_s: float = IDLE_TIMEOUT_S,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> tuple[ParameterDifference, ...]:
        """Compare the vehicle's parameters (``before``) with a table, a dict or a file (``after``).

        The vehicle's parameters are downloaded if they are not known. Only names in ``parameters`` are compared;
        ``before`` is None for a name that the vehicle does not have. Names and units in the result are the vehicle's.
        """
        from aerokit.parameters import diff as compare

        values = _values_of(parameters)
        check_values(values)
        table = await self.download(idle_timeout_s=idle_timeout_s, timeout=timeout, on_progress=on_progress)
        translated = self._names.translated(values, table)
        return compare(table, translated, names=translated)

    async def changed_from_default(
        self,
        *,
        idle_timeout_s: float = IDLE_TIMEOUT_S,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> ParameterTable:
        """Return the parameters that differ from their defaults.

        The defaults are those that the vehicle has sent by MAVFTP, otherwise those of the loaded metadata.

        Raises:
            NotSupported: the defaults are unknown, because neither MAVFTP nor metadata with defaults is available.
        """
        table = await self.download(idle_timeout_s=idle_timeout_s, timeout=timeout, on_progress=on_progress)
        if not any(parameter.default is not None for parameter in table.values()):
            table = self._with_documented_defaults(table)
        return table.changed_from_default()

    def _with_documented_defaults(self, table: ParameterTable) -> ParameterTable:
        defaults = {name: entry.default for name, entry in (self._metadata or {}).items() if name in table}
        if not any(default is not None for default in defaults.values()):
            hint = "call load_metadata() first" if self._metadata is None else "the loaded metadata has none either"
            raise NotSupported(
                f"the defaults of this vehicle are unknown, because it did not send them by MAVFTP: {hint}"
            )
        return ParameterTable(param.replace(default=defaults.get(name)) for name, param in table.items())

    def _note_of(self, name: str, value: float) -> str:
        if self._metadata is None or name not in self._metadata:
            return ""
        notes = [self._metadata[name].problem(value), "needs a reboot" if self._needs_reboot(name) else None]
        return "; ".join(filter(None, notes))

    def _needs_reboot(self, name: str) -> bool:
        entry = None if self._metadata is None else self._metadata.get(name)
        return entry is not None and bool(entry.reboot_required)


def _value_or_raise(answer: ResultT | ParameterRejected | ParameterTimeout) -> ResultT:
    if isinstance(answer, (ParameterRejected, ParameterTimeout)):
        raise answer
    return answer


def _values_of(parameters: ParameterSource) -> Mapping[str, float]:
    if isinstance(parameters, (str, os.PathLike)):
        from aerokit.parameters import read_parameter_file

        return read_parameter_file(parameters)
    if isinstance(parameters, ParameterTable):
        return parameters.values_by_name()
    return parameters
