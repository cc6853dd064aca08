"""Writes that are restored: at the end of a block (``temporarily``), or if it fails (``transaction``)."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import anyio

from aerokit._internal.arguments import checks_arguments
from aerokit.connection.tasks import run_shielded
from aerokit.errors import AerokitError, InvalidArgument, RollbackFailed, VerificationFailed
from aerokit.parameters import Parameter
from aerokit.parameters.parameter import same_value
from aerokit.vehicle.parameters.writing import ResolvedParameter

if TYPE_CHECKING:
    from typing_extensions import Self

    from aerokit.parameters import ParameterDifference
    from aerokit.vehicle.parameters.access import ParameterAccess
    from aerokit.vehicle.parameters.writing import ParameterWrite, ParameterWriter

__all__ = ["TemporaryParameters", "Transaction"]

logger: logging.Logger = logging.getLogger("aerokit")

# Limits the end of a block to this many times ``idle_timeout_s``, however slow the link is.
MAX_RESTORE_TIMEOUTS = 3


class RestoreRegistry:
    """Open blocks that will restore each parameter, in the order of their first write."""

    def __init__(self) -> None:
        self._blocks: dict[str, list[_Block]] = {}

    def add(self, name: str, block: _Block) -> None:
        self._blocks.setdefault(name, []).append(block)

    def remove(self, name: str, block: _Block) -> _Block | None:
        """Remove a block; return the block that wrote the parameter next after it, if any."""
        blocks = self._blocks[name]
        position = blocks.index(block)
        del blocks[position]
        if not blocks:
            del self._blocks[name]
        return blocks[position] if position < len(blocks) else None


class _Block:
    """Base class: saves parameters before their first write, and restores them."""

    def __init__(
        self, registry: RestoreRegistry, access: ParameterAccess, writing: ParameterWriter, idle_timeout_s: float
    ) -> None:
        self._registry, self._access, self._writing = registry, access, writing
        self._idle_timeout_s = idle_timeout_s
        self._before: dict[str, Parameter] = {}

    async def _write(self, values: Mapping[str, float]) -> dict[str, ParameterWrite]:
        await self._save_previous(values)
        return await self._writing.write(values, idle_timeout_s=self._idle_timeout_s)

    async def _save_previous(self, values: Mapping[str, float]) -> None:
        # Read again, because the store may be outdated.
        found = await self._writing.names.resolve(values, self._idle_timeout_s)
        resolved = [answer for answer in found.values() if isinstance(answer, ResolvedParameter)]
        fresh = {answer.name: answer.parameter for answer in resolved if answer.is_fresh}
        known = {answer.name for answer in resolved}
        answers = await self._access.read(known - fresh.keys() - self._before.keys(), self._idle_timeout_s)
        for name, answer in (answers | fresh).items():
            if not isinstance(answer, Parameter):
                raise answer
            if name not in self._before:
                # A value that was read may lack its last bits.
                self._before[name] = self._access.store.get(name) or answer
                self._registry.add(name, self)

    def _release_own(self) -> list[Parameter]:
        """Return the parameters that this block must restore. An overlapping block restores those that it shares."""
        own = []
        for name, before in self._before.items():
            later = self._registry.remove(name, self)
            if later is None:
                own.append(before)
            else:
                later._before[name] = before
        return own

    def _discard(self) -> None:
        for name in self._before:
            self._registry.remove(name, self)

    async def _restore(self, cause: BaseException | None) -> None:
        """Restore within a limited time, shielded from cancellation; RollbackFailed names what was not restored."""
        await run_shielded(self._write_previous(self._release_own(), cause))

    async def _write_previous(self, wanted: list[Parameter], cause: BaseException | None) -> None:
        answers: Mapping[str, object] = {}
        reason = ""
        with anyio.move_on_after(MAX_RESTORE_TIMEOUTS * self._idle_timeout_s):
            try:
                changed = await self._changed_by_others(wanted)
                wanted = [param for param in wanted if not isinstance(changed.get(param.name), Parameter)]
                to_write = [param for param in wanted if param.name not in changed]
                answers = await self._access.write(to_write, self._idle_timeout_s)
            except AerokitError as error:
                reason = f" ({error})"
        left = {param.name: param.value for param in wanted if not _is_restored(param, answers.get(param.name))}
        if left:
            names = ", ".join(f"{name} = {value!r}" for name, value in left.items())
            raise RollbackFailed(f"could not restore{reason}: {names}", not_restored=left) from cause

    async def _changed_by_others(self, wanted: list[Parameter]) -> dict[str, object]:
        """Return parameters that cannot be read, or that another station has changed since. Log these changes."""
        written = self._access.written
        own = [param.name for param in wanted if param.name in written]
        changed: dict[str, object] = {}
        for name, actual in (await self._access.read(own, self._idle_timeout_s)).items():
            if not isinstance(actual, Parameter) or float(actual.value) != float(written[name]):
                changed[name] = actual
            if isinstance(actual, Parameter) and name in changed:
                text = "%s is not restored: another station has changed it from %r to %r"
                logger.warning(text, name, written[name], actual.value)
        return changed


class TemporaryParameters(_Block):
    """Sets other values for the duration of a block; see :meth:`Parameters.temporarily`."""

    def __init__(
        self,
        registry: RestoreRegistry,
        access: ParameterAccess,
        writing: ParameterWriter,
        values: Mapping[str, float],
        idle_timeout_s: float,
    ) -> None:
        super().__init__(registry, access, writing, idle_timeout_s)
        self._values = dict(values)
        self._is_open = False

    async def __aenter__(self) -> dict[str, ParameterWrite]:
        if self._is_open:
            raise InvalidArgument("this block was entered already: call temporarily() again")
        self._is_open = True
        try:
            results = await self._write(self._values)
            _raise_first_error(results)
        except BaseException as error:
            await self._restore(error)
            raise
        return results

    async def __aexit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        await self._restore(error)


@checks_arguments
class Transaction(_Block):
    """Several writes, all or none.

    Every write is verified; one that fails or is clamped raises. If the block raises, all written parameters are
    restored as far as possible: those that could not be restored are in :class:`aerokit.errors.RollbackFailed`, and
    are not tried again when the link returns. Otherwise the exception of the block propagates.

    A value that another station has changed meanwhile stays, and a warning of logger "aerokit" names it. Other tasks
    of your program may write meanwhile: a transaction restores the values from before its own first write. Blocks with
    the same parameter may be nested and may overlap; an outer block that fails also undoes an inner one that succeeded.
    """

    def __init__(
        self,
        registry: RestoreRegistry,
        access: ParameterAccess,
        writing: ParameterWriter,
        needs_reboot: Callable[[str], bool],
        idle_timeout_s: float,
    ) -> None:
        super().__init__(registry, access, writing, idle_timeout_s)
        self._name_needs_reboot = needs_reboot
        self._after: dict[str, int | float] = {}
        self._is_open = False

    @property
    def changes(self) -> tuple[ParameterDifference, ...]:
        """Parameters that were written so far and have changed, by their names on the vehicle."""
        from aerokit.parameters import ParameterDifference

        return tuple(
            ParameterDifference(name, self._before[name].value, after)
            for name, after in self._after.items()
            if not same_value(self._before[name].value, after)
        )

    @property
    def needs_reboot(self) -> tuple[str, ...]:
        """Names of changes that take effect after a reboot; needs :meth:`Parameters.load_metadata`."""
        return tuple(change.name for change in self.changes if self._name_needs_reboot(change.name))

    async def set(self, name: str, value: float) -> ParameterWrite:
        """Set one parameter; errors as for :meth:`Parameters.set`, and VerificationFailed if it is clamped."""
        return (await self.set_many({name: value}))[name]

    async def set_many(self, values: Mapping[str, float]) -> dict[str, ParameterWrite]:
        """Set several parameters; raises the first error after all were tried."""
        if not self._is_open:
            raise InvalidArgument("this transaction is not open: it has ended, or was not entered yet")
        results = await self._write(values)
        for name in self._before:
            known = self._access.store.get(name)
            if known is not None:
                self._after[name] = known.value
        _raise_first_error(results)
        clamped = [result for result in results.values() if result.outcome == "clamped"]
        if clamped:
            texts = tuple(f"{one.name}: requested {one.requested:g}, is {one.value:g}" for one in clamped)
            raise VerificationFailed("the vehicle has set other values than requested", differences=texts)
        return results

    async def __aenter__(self) -> Self:
        if self._is_open or self._before:
            raise InvalidArgument("this transaction was entered already: call transaction() again")
        self._is_open = True
        return self

    async def __aexit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        self._is_open = False
        if error is None:
            self._discard()
        else:
            await self._restore(error)


def _raise_first_error(results: Mapping[str, ParameterWrite]) -> None:
    for result in results.values():
        if result.error is not None:
            raise result.error


def _is_restored(wanted: Parameter, answer: object) -> bool:
    return isinstance(answer, Parameter) and same_value(answer.value, wanted.value)
