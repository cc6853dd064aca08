"""``vehicle.parameters``: the settings of the autopilot, read, written, compared and put back.

https://mavlink.io/en/services/parameter.html
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import TYPE_CHECKING

from aerokit._internal.arguments import checks_arguments
from aerokit._internal.async_block import ReadOnly
from aerokit.errors import NotSupported, ParameterRejected, ParameterTimeout
from aerokit.parameters import Parameter, ParameterTable, check_name
from aerokit.protocols.exchange import PATIENCE_S
from aerokit.vehicle.parameters.access import CacheChoice, DownloadMethod, ParameterAccess, UploadMethod
from aerokit.vehicle.parameters.transaction import Holds, Temporarily, Transaction
from aerokit.vehicle.parameters.writing import (
    Found,
    Outcome,
    ParameterNames,
    ParameterWrite,
    ParameterWriting,
    check_values,
)

if TYPE_CHECKING:
    from aerokit.parameters import Metadata, ParameterDifference
    from aerokit.protocols.exchange import OnProgress
    from aerokit.protocols.parameter_requests import Answer
    from aerokit.vehicle.files.files import Files
    from aerokit.vehicle.session.transfers import Talking

__all__ = ["Outcome", "ParameterWrite", "Parameters", "Transaction"]

ParameterSource = ParameterTable | Mapping[str, float] | str | os.PathLike[str]
"""A table, a plain dict of values, or a parameter file."""


@checks_arguments
class Parameters(ReadOnly):
    """The parameters of one autopilot. Coroutines talk to it; ``table`` is what is known, and never does.

    Every PARAM_VALUE of the autopilot keeps the table up to date, also when somebody else has changed something, and
    is told as :class:`aerokit.events.ParameterChanged`. After a reboot nothing is known until it is read anew.

    ArduPilot 4.7 renamed parameters and changed their units (``WPNAV_SPEED`` in cm/s became ``WP_SPD`` in m/s). Every
    method here takes the old and the new name with either firmware, and converts; an old name that the vehicle does
    not have any more is answered with a :class:`aerokit.errors.ParameterRenamedWarning`, which names the new one.

    ArduPilot sees to parameters a few times a second. While more than five are read, or when it has not answered for
    half a second whether it has some, it is asked to do so more often, by SET_MESSAGE_INTERVAL of PARAM_VALUE, and at
    the end to go on as before.

    All methods take ``patience_s`` (give up after so many seconds without anything new) and ``timeout`` (for all of it;
    then OperationTimeout). Each can be cancelled at any moment.
    """

    def __init__(self, talk: Talking, files: Files) -> None:
        self._transfers = transfers = talk.transfers
        self._access = ParameterAccess(transfers, files)
        talk.at_close(self._access.store.attach())
        talk.on_reboot.append(self._access.forget)
        self._names = ParameterNames(self._access)
        self._metadata: Metadata | None = None
        self._writing = ParameterWriting(self._access, self._names, self._note_of)
        self._holds = Holds()

    # ---------------------------------------------------------------------------- what is known

    @property
    def table(self) -> ParameterTable:
        """What is known now, in the vehicle's order; empty before anything was read, and after a reboot."""
        return self._access.store.table

    def known(self, name: str) -> Parameter | None:
        """What was told last of the parameter that the vehicle calls so; as ``table.get(name)``, but makes no table."""
        return self._access.store.get(name)

    @property
    def is_complete(self) -> bool:
        """Whether the whole list was downloaded since the vehicle started."""
        return self._access.store.is_complete

    @property
    def metadata(self) -> Metadata | None:
        """Descriptions, units, ranges and bits by name, once :meth:`load_metadata` has read them."""
        return self._metadata

    def load_metadata(self, path: str | os.PathLike[str]) -> Metadata:
        """Read ArduPilot's ``apm.pdef.xml`` or ``apm.pdef.json``, or PX4's ``parameters.xml`` or ``parameters.json``.

        Metadata are advice: a write outside the documented range is done, and its result has a ``note``; refused is
        only what the type cannot hold. They also tell which changes need a reboot, and PX4's tell the defaults.

        Raises:
            FileFormatError: the file is damaged or of another kind.
        """
        from aerokit.parameters import load_metadata

        self._metadata = load_metadata(path)
        return self._metadata

    # -------------------------------------------------------------------------------- reading

    async def download(
        self,
        *,
        method: DownloadMethod = "auto",
        refresh: bool = False,
        cache: CacheChoice = False,
        patience_s: float = PATIENCE_S,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> ParameterTable:
        """Return all parameters; at once when they were downloaded since the vehicle started.

        Args:
            method: ``"ftp"`` reads one small file with the defaults (``@PARAM/param.pck``), ``"list"`` has the vehicle
                send one message for each; ``"auto"`` takes the file where there is one.
            refresh: download again, whatever is known or in the cache.
            cache: keep the list on disk, and take it from there when the vehicle's own hash says that nothing has
                changed: the second connect takes one request. True is the user's cache directory, or name one. Only PX4
                has such a hash; parameters that it changes by itself are not in it, and may be older. Nothing is
                written to disk by default.
            patience_s: give up after so many seconds without anything new.
            timeout: seconds for all of it.
            on_progress: called with parameters, or bytes of the file, done and in total.

        Raises:
            ParameterTimeout: the list did not come whole; ``missing`` has the indices. What did come is in ``table``.
            FileError, FileTimeout, RemoteProtocolError: with ``method="ftp"`` only.
        """
        with self._transfers.limit(timeout):
            return await self._access.download(
                method, refresh=refresh, cache=cache, patience_s=patience_s, on_progress=on_progress
            )

    async def get(
        self, name: str, *, patience_s: float = PATIENCE_S, timeout: float | None = None
    ) -> int | float:
        """Ask the vehicle for one value; the rest is as for :meth:`read`."""
        return (await self.read(name, patience_s=patience_s, timeout=timeout)).value

    async def read(
        self, name: str, *, patience_s: float = PATIENCE_S, timeout: float | None = None
    ) -> Parameter:
        """Ask the vehicle for one parameter; ``table[name]`` is what is known without asking.

        Raises:
            InvalidArgument: the name is none, or longer than 16 characters.
            ParameterRejected: the vehicle has no such parameter. It may say so, or answer others and not this one.
            ParameterTimeout: no answer.
        """
        with self._transfers.limit(timeout):
            found = _found((await self._names.find([name], patience_s))[name])
            if found.is_fresh:
                return found.in_terms_asked(found.parameter)
            answer = _parameter((await self._access.read([found.name], patience_s))[found.name])
            return found.in_terms_asked(answer)

    async def probe(
        self, *names: str, patience_s: float = PATIENCE_S, timeout: float | None = None
    ) -> dict[str, Parameter | ParameterRejected | ParameterTimeout]:
        """Ask the vehicle for parameters that it may not have, all at once and by exactly these names.

        So it is found which of several names a firmware has; where ArduPilot renamed one, :meth:`get` does that.

        Returns:
            For each name the parameter, or what :meth:`get` would have raised; its ``code`` is None when the vehicle
            did not say itself that it has none, but answered others and not this one.

        Raises:
            InvalidArgument: a name is none, or longer than 16 characters. Nothing was sent.
        """
        with self._transfers.limit(timeout):
            return await self._access.read(map(check_name, names), patience_s, are_doubtful=True)

    # -------------------------------------------------------------------------------- writing

    async def set(
        self, name: str, value: float, *, patience_s: float = PATIENCE_S, timeout: float | None = None
    ) -> ParameterWrite:
        """Set one parameter, and return what the vehicle says it is then.

        Raises:
            InvalidArgument: a name that cannot be, NaN, or a value that the parameter's type cannot hold.
            ParameterRejected: the vehicle has no such parameter, or keeps the value it had; ``code`` says why.
            ParameterTimeout: not confirmed. It may have been set all the same.
        """
        results = await self.set_many({name: value}, patience_s=patience_s, timeout=timeout)
        result = results[name]
        if result.error is not None:
            raise result.error
        return result

    async def set_many(
        self,
        values: Mapping[str, float],
        *,
        patience_s: float = PATIENCE_S,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> dict[str, ParameterWrite]:
        """Set several parameters, some of them at a time, and return one result each; look at ``error``.

        A parameter that appears only when another one of them is set (ArduPilot's ``…_ENABLE``) is set after it.

        Raises:
            InvalidArgument: one of the names or values cannot be; then none of them was set.
        """
        with self._transfers.limit(timeout):
            return await self._writing.write(values, patience_s=patience_s, on_progress=on_progress)

    async def upload(
        self,
        parameters: ParameterSource,
        *,
        method: UploadMethod = "auto",
        patience_s: float = PATIENCE_S,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> dict[str, ParameterWrite]:
        """Bring the vehicle's parameters to those of a table, a dict or a parameter file; what is equal is not sent.

        ``method="ftp"`` writes one file (``@PARAM/param.pck``) and reads the values back, ``"set"`` sets them one by
        one, ``"auto"`` takes the file where the vehicle has one and there is much to change. Results are as for
        :meth:`set_many`; parameters of other hardware or firmware in the file end as ``"failed"`` with
        ParameterRejected, and do not keep the others from being set. Where a parameter is given under two names, the
        vehicle's own counts, and the other has no result.

        Raises:
            InvalidArgument, FileFormatError: a name, a value or the file cannot be; then nothing was set.
            ParameterTimeout: the vehicle's own parameters could not be downloaded.
        """
        with self._transfers.limit(timeout):
            values = _values_of(parameters)
            check_values(values)
            table = await self._access.download(
                "auto", refresh=False, cache=False, patience_s=patience_s, on_progress=None
            )
            values = self._names.without_doubles(values, table)
            return await self._writing.write(
                values, upload=method, patience_s=patience_s, on_progress=on_progress
            )

    def temporarily(self, values: Mapping[str, float], *, patience_s: float = PATIENCE_S) -> Temporarily:
        """Have other values for the time of an ``async with`` block: they are set, and put back at its end.

        Also when the block raises or is cancelled: then the end of the block takes up to ``patience_s`` seconds. When
        one value cannot be set, those before are put back, and its error is raised. Blocks may be nested and may
        overlap, also about the same parameter: it gets the value from before the first of them when the last one ends.
        A value that another station has changed meanwhile is left as it is, and a warning of logger "aerokit" names it.

        Raises:
            RollbackFailed: values could not be put back; ``not_restored`` has them.
        """
        return Temporarily(self._holds, self._access, self._writing, values, patience_s)

    def transaction(self, *, patience_s: float = PATIENCE_S) -> Transaction:
        """Write several parameters, all or none: ``async with vehicle.parameters.transaction() as t: await t.set(…)``.

        Each write is verified. When the block raises, or is cancelled, or one of the writes fails, what was written is
        set back to what it was; see :class:`Transaction`.
        """
        return Transaction(self._holds, self._access, self._writing, self._needs_reboot, patience_s)

    # ------------------------------------------------------------------------------- comparing

    async def diff(
        self,
        parameters: ParameterSource,
        *,
        patience_s: float = PATIENCE_S,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> tuple[ParameterDifference, ...]:
        """How the vehicle (``before``) differs from a table, a dict or a file (``after``); it is downloaded if need be.

        Parameters that are not in ``parameters`` do not count; those that the vehicle has not got have ``before``
        None. Names and units are the vehicle's.
        """
        from aerokit.parameters import diff

        values = _values_of(parameters)
        check_values(values)
        table = await self.download(patience_s=patience_s, timeout=timeout, on_progress=on_progress)
        translated = self._names.translated(values, table)
        return diff(table, translated, names=translated)

    async def changed_from_default(
        self,
        *,
        patience_s: float = PATIENCE_S,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> ParameterTable:
        """Return the parameters that differ from their default, as the vehicle tells it by MAVFTP, or the metadata.

        Raises:
            NotSupported: neither of them does.
        """
        table = await self.download(patience_s=patience_s, timeout=timeout, on_progress=on_progress)
        if not any(each.default is not None for each in table.values()):
            table = self._with_documented_defaults(table)
        return table.changed_from_default()

    # ------------------------------------------------------------------------------- inside

    def _with_documented_defaults(self, table: ParameterTable) -> ParameterTable:
        defaults = {name: each.default for name, each in (self._metadata or {}).items() if name in table}
        if not any(default is not None for default in defaults.values()):
            raise NotSupported(
                "this vehicle does not tell defaults, only MAVFTP does, nor do the metadata: see load_metadata()"
            )
        return ParameterTable(each.replace(default=defaults.get(name)) for name, each in table.items())

    def _note_of(self, name: str, value: float) -> str:
        """What the metadata have to say of a value."""
        if self._metadata is None or name not in self._metadata:
            return ""
        notes = [
            self._metadata[name].complaint(value),
            "needs a reboot" if self._needs_reboot(name) else None,
        ]
        return "; ".join(filter(None, notes))

    def _needs_reboot(self, name: str) -> bool:
        known = None if self._metadata is None else self._metadata.get(name)
        return known is not None and bool(known.reboot_required)


def _found(answer: Found | ParameterRejected | ParameterTimeout) -> Found:
    """What was found, or the reason why nothing was, raised."""
    if isinstance(answer, Found):
        return answer
    raise answer


def _parameter(answer: Answer) -> Parameter:
    """What was read, or the reason why nothing was, raised."""
    if isinstance(answer, Parameter):
        return answer
    raise answer


def _values_of(parameters: ParameterSource) -> Mapping[str, float]:
    if isinstance(parameters, (str, os.PathLike)):
        from aerokit.parameters import read_parameter_file

        return read_parameter_file(parameters)
    if isinstance(parameters, ParameterTable):
        return parameters.values_by_name()
    return parameters
