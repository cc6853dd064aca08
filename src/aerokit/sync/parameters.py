"""Parameters for programs without ``async``."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import TYPE_CHECKING

from aerokit.protocols.transfer import PATIENCE_S

if TYPE_CHECKING:
    from types import TracebackType

    from typing_extensions import Self

    from aerokit.parameters import Metadata, Parameter, ParameterDifference, ParameterTable
    from aerokit.protocols.transfer import OnProgress
    from aerokit.sync.loop_thread import LoopThread
    from aerokit.vehicle.parameter_access import CacheChoice, DownloadMethod, UploadMethod
    from aerokit.vehicle.parameter_transaction import Temporarily as AsyncTemporarily
    from aerokit.vehicle.parameter_transaction import Transaction as AsyncTransaction
    from aerokit.vehicle.parameters import Parameters as AsyncParameters
    from aerokit.vehicle.parameters import ParameterSource, ParameterWrite

__all__ = ["Parameters", "Temporarily", "Transaction"]


class Parameters:
    """The parameters of one autopilot, blocking; as :class:`aerokit.vehicle.parameters.Parameters`."""

    def __init__(self, loop: LoopThread, parameters: AsyncParameters) -> None:
        self._loop, self._parameters = loop, parameters

    @property
    def table(self) -> ParameterTable:
        """What is known now; see :attr:`aerokit.vehicle.parameters.Parameters.table`."""
        return self._parameters.table

    @property
    def is_complete(self) -> bool:
        """Whether the whole list was downloaded since the vehicle started."""
        return self._parameters.is_complete

    @property
    def metadata(self) -> Metadata | None:
        """Descriptions, units, ranges and bits by name, once :meth:`load_metadata` has read them."""
        return self._parameters.metadata

    def load_metadata(self, path: str | os.PathLike[str]) -> Metadata:
        """Read a metadata file; see :meth:`aerokit.vehicle.parameters.Parameters.load_metadata`."""
        return self._parameters.load_metadata(path)

    def download(
        self,
        *,
        method: DownloadMethod = "auto",
        refresh: bool = False,
        cache: CacheChoice = False,
        patience_s: float = PATIENCE_S,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> ParameterTable:
        """Return all parameters; see :meth:`aerokit.vehicle.parameters.Parameters.download`."""
        return self._loop.run(
            self._parameters.download,
            method=method,
            refresh=refresh,
            cache=cache,
            patience_s=patience_s,
            timeout=timeout,
            on_progress=on_progress,
        )

    def known(self, name: str) -> Parameter | None:
        """What was told last of one parameter; see :meth:`aerokit.vehicle.parameters.Parameters.known`."""
        return self._parameters.known(name)

    def get(self, name: str, *, patience_s: float = PATIENCE_S, timeout: float | None = None) -> int | float:
        """Ask the vehicle for one value; see :meth:`aerokit.vehicle.parameters.Parameters.get`."""
        return self._loop.run(self._parameters.get, name, patience_s=patience_s, timeout=timeout)

    def read(self, name: str, *, patience_s: float = PATIENCE_S, timeout: float | None = None) -> Parameter:
        """Ask the vehicle for one parameter; see :meth:`aerokit.vehicle.parameters.Parameters.read`."""
        return self._loop.run(self._parameters.read, name, patience_s=patience_s, timeout=timeout)

    def set(
        self, name: str, value: float, *, patience_s: float = PATIENCE_S, timeout: float | None = None
    ) -> ParameterWrite:
        """Set one parameter; see :meth:`aerokit.vehicle.parameters.Parameters.set`."""
        return self._loop.run(self._parameters.set, name, value, patience_s=patience_s, timeout=timeout)

    def set_many(
        self,
        values: Mapping[str, float],
        *,
        patience_s: float = PATIENCE_S,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> dict[str, ParameterWrite]:
        """Set several parameters; see :meth:`aerokit.vehicle.parameters.Parameters.set_many`."""
        return self._loop.run(
            self._parameters.set_many, values, patience_s=patience_s, timeout=timeout, on_progress=on_progress
        )

    def upload(
        self,
        parameters: ParameterSource,
        *,
        method: UploadMethod = "auto",
        patience_s: float = PATIENCE_S,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> dict[str, ParameterWrite]:
        """Send what differs; see :meth:`aerokit.vehicle.parameters.Parameters.upload`."""
        return self._loop.run(
            self._parameters.upload,
            parameters,
            method=method,
            patience_s=patience_s,
            timeout=timeout,
            on_progress=on_progress,
        )

    def temporarily(self, values: Mapping[str, float], *, patience_s: float = PATIENCE_S) -> Temporarily:
        """Have other values in a ``with`` block; see :meth:`aerokit.vehicle.parameters.Parameters.temporarily`."""
        return Temporarily(self._loop, self._parameters.temporarily(values, patience_s=patience_s))

    def transaction(self, *, patience_s: float = PATIENCE_S) -> Transaction:
        """Write all or none in a ``with`` block; see :meth:`aerokit.vehicle.parameters.Parameters.transaction`."""
        return Transaction(self._loop, self._parameters.transaction(patience_s=patience_s))

    def diff(
        self,
        parameters: ParameterSource,
        *,
        patience_s: float = PATIENCE_S,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> tuple[ParameterDifference, ...]:
        """How the vehicle differs; see :meth:`aerokit.vehicle.parameters.Parameters.diff`."""
        return self._loop.run(
            self._parameters.diff, parameters, patience_s=patience_s, timeout=timeout, on_progress=on_progress
        )

    def changed_from_default(
        self,
        *,
        patience_s: float = PATIENCE_S,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> ParameterTable:
        """Return what was changed; see :meth:`aerokit.vehicle.parameters.Parameters.changed_from_default`."""
        return self._loop.run(
            self._parameters.changed_from_default,
            patience_s=patience_s,
            timeout=timeout,
            on_progress=on_progress,
        )


class Temporarily:
    """Other values for the time of a ``with`` block; gives the results of the writes."""

    def __init__(self, loop: LoopThread, block: AsyncTemporarily) -> None:
        self._loop, self._block = loop, block

    def __enter__(self) -> dict[str, ParameterWrite]:
        return self._loop.enter(self._block)

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._loop.run_to_its_end(self._block.__aexit__, exc_type, exc, traceback)


class Transaction:
    """Several writes, all or none; as :class:`aerokit.vehicle.parameters.Transaction`."""

    def __init__(self, loop: LoopThread, block: AsyncTransaction) -> None:
        self._loop, self._block = loop, block

    @property
    def changes(self) -> tuple[ParameterDifference, ...]:
        """What was written so far and is another value than before, by the names on the vehicle."""
        return self._block.changes

    @property
    def needs_reboot(self) -> tuple[str, ...]:
        """Those of the changes that take effect after a reboot; needs :meth:`Parameters.load_metadata`."""
        return self._block.needs_reboot

    def set(self, name: str, value: float) -> ParameterWrite:
        """Set one parameter; errors are those of :meth:`Parameters.set`, and VerificationFailed when it is clamped."""
        return self._loop.run(self._block.set, name, value)

    def set_many(self, values: Mapping[str, float]) -> dict[str, ParameterWrite]:
        """Set several; the first error is raised after all were tried."""
        return self._loop.run(self._block.set_many, values)

    def __enter__(self) -> Self:
        self._loop.enter(self._block)
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._loop.run_to_its_end(self._block.__aexit__, exc_type, exc, traceback)
