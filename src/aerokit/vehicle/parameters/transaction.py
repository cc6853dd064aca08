"""Parameter writes that are undone at the end of a block (``temporarily``) or if it fails (``transaction``)."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Callable, Iterable, Mapping
from contextlib import asynccontextmanager
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
    from aerokit.vehicle.parameters.writing import ParameterFailure, ParameterWrite, ParameterWriter

__all__ = ["TemporaryParameters", "Transaction"]

logger: logging.Logger = logging.getLogger("aerokit")

# Parameters are restored for at most this many times ``idle_timeout_s``, even if the link is slow.
MAX_RESTORE_TIMEOUTS = 3


class RestoreRegistry:
    """Maps each parameter to the open `async with` blocks that will restore it, in the order of their first writes."""

    def __init__(self) -> None:
        self._blocks: dict[str, list[_Block]] = {}
        self._lock = asyncio.Lock()
        self.restored: dict[str, Parameter] = {}
        """Parameters that blocks have restored, by name. Cleared whenever a block saves values."""

    @asynccontextmanager
    async def exclusive(self, timeout: float | None = None) -> AsyncIterator[None]:
        """Context manager: wait until no other block saves or restores values, at most ``timeout`` seconds.

        After the time-out it enters anyway. Without this lock, a block might save, and later restore, a temporary value
        that another block is just replacing.
        """
        with anyio.move_on_after(timeout) as waiting:
            await self._lock.acquire()
        try:
            yield
        finally:
            if not waiting.cancelled_caught:
                self._lock.release()

    def add(self, name: str, block: _Block) -> None:
        self._blocks.setdefault(name, []).append(block)

    def remove(self, name: str, block: _Block) -> _Block | None:
        """Remove a block. Return the next block that wrote the parameter, or None."""
        blocks = self._blocks[name]
        position = blocks.index(block)
        del blocks[position]
        if not blocks:
            del self._blocks[name]
        return blocks[position] if position < len(blocks) else None


class _Block:
    """Base class: saves parameters before their first write, and restores them."""

    def __init__(
        self, registry: RestoreRegistry, access: ParameterAccess, writer: ParameterWriter, idle_timeout_s: float
    ) -> None:
        self._registry, self._access, self._writer = registry, access, writer
        self._idle_timeout_s = idle_timeout_s
        self._saved: dict[str, Parameter] = {}  # parameters before their first write in this block
        self._has_ended = False

    async def _write(self, values: Mapping[str, float]) -> dict[str, ParameterWrite]:
        return await self._writer.write(values, resolve=self._resolve_and_save, idle_timeout_s=self._idle_timeout_s)

    async def _resolve_and_save(
        self, names: Iterable[str], idle_timeout_s: float
    ) -> dict[str, ResolvedParameter | ParameterFailure]:
        """Resolve names, and save the parameters as they are before their first write."""
        # The writer calls this method before each round of writes, because some parameters appear only after the first
        # round.
        async with self._registry.exclusive():
            self._registry.restored.clear()
            return await self._resolve_and_save_locked(names, idle_timeout_s)

    async def _resolve_and_save_locked(
        self, names: Iterable[str], idle_timeout_s: float
    ) -> dict[str, ResolvedParameter | ParameterFailure]:
        results = await self._writer.names.resolve(names, idle_timeout_s)
        resolved = [result for result in results.values() if isinstance(result, ResolvedParameter)]
        fresh_parameters = {answer.name: answer.parameter for answer in resolved if answer.is_fresh}
        unread_names = {answer.name for answer in resolved} - fresh_parameters.keys() - self._saved.keys()
        # Save the vehicle's present values, because the store may be outdated.
        answers = await self._access.read(unread_names, idle_timeout_s)
        if self._has_ended:  # A write by another task must not outlive the block, because nothing would restore it.
            raise InvalidArgument("the `async with` block has ended; the remaining parameters were not set")
        current: dict[str, Parameter] = {}
        for name, answer in (answers | fresh_parameters).items():
            if not isinstance(answer, Parameter):
                raise answer
            # If another block has just restored the parameter, the answer may still be that block's temporary value.
            current[name] = self._registry.restored.get(name) or self._with_stored_precision(answer)
            if name not in self._saved:
                self._saved[name] = current[name]
                self._registry.add(name, self)
        for result in resolved:
            if result.name in current:
                results[result.requested] = result.replace(parameter=current[result.name])
        return results

    def _with_stored_precision(self, answer: Parameter) -> Parameter:
        """Return the stored parameter if it equals the answer. PARAM_VALUE rounds large integers to a float."""
        # An answer that differs from the stored value is right: another station has undone our write, and the store has
        # ignored its message (`set_stale`).
        known = self._access.store.get(answer.name)
        return known if known is not None and same_value(float(known.value), float(answer.value)) else answer

    def _take_saved(self) -> list[Parameter]:
        """End the block, and return the parameters that it must restore."""
        self._has_ended = True
        to_restore = []
        for name, saved in self._saved.items():
            later_block = self._registry.remove(name, self)
            if later_block is None:
                to_restore.append(saved)
            else:
                # An overlapping block has written the parameter later. That block restores the value when it ends.
                later_block._saved[name] = saved
        return to_restore

    def _discard(self) -> None:
        self._has_ended = True
        for name in self._saved:
            self._registry.remove(name, self)

    async def _restore(self, cause: BaseException | None) -> None:
        """Restore the parameters within a limited time, shielded from cancellation.

        Raises RollbackFailed for parameters that were not restored.
        """
        self._has_ended = True
        await run_shielded(self._write_previous(cause))

    async def _write_previous(self, cause: BaseException | None) -> None:
        answers: Mapping[str, object] = {}
        reason = ""
        began_at = anyio.current_time()
        # If another block waits long for an answer, restore the values of this block without waiting for it.
        async with self._registry.exclusive(self._idle_timeout_s):
            to_restore = self._take_saved()
            # Register these values before the write. A block that reads a temporary value then saves the restored one.
            self._registry.restored.update({param.name: param for param in to_restore})
            # A blocked event loop may have lengthened the wait. This must not use up the time to restore the values.
            waited_s = min(anyio.current_time() - began_at, self._idle_timeout_s)
            with anyio.move_on_after(MAX_RESTORE_TIMEOUTS * self._idle_timeout_s - waited_s):
                try:
                    # Keep values that another station has changed. If no write of this program was confirmed (None),
                    # such a change cannot be recognised.
                    confirmed = [param.name for param in to_restore if self._access.written.get(param.name) is not None]
                    present = await self._access.read(confirmed, self._idle_timeout_s)
                    to_restore = [
                        param for param in to_restore if not self._was_changed(param.name, present.get(param.name))
                    ]
                    # A parameter that cannot be read may have another station's value, so it is not overwritten.
                    unreadable = {name for name, answer in present.items() if not isinstance(answer, Parameter)}
                    to_write = [param for param in to_restore if param.name not in unreadable]
                    answers = await self._access.write(to_write, self._idle_timeout_s)
                except AerokitError as error:
                    reason = f" ({error})"
        _raise_not_restored(
            [param for param in to_restore if not _is_restored(param, answers.get(param.name))], reason, cause
        )

    def _abandon(self, error: AerokitError, cause: BaseException | None) -> None:
        """End the block without restoring, because the loop of its connection has ended."""
        if self._has_ended:
            raise error
        _raise_not_restored(self._take_saved(), f" ({error})", cause)

    def _was_changed(self, name: str, present: object) -> bool:
        """Return True, and log a warning, if another station has changed the parameter."""
        written = self._access.written.get(name)  # None if another task of this program is writing the parameter
        if not isinstance(present, Parameter) or written is None or float(present.value) == float(written):
            return False
        text = "%s is not restored: another station has changed it from %r to %r"
        logger.warning(text, name, written, present.value)
        return True


class TemporaryParameters(_Block):
    """Changes parameters for the duration of a block, and then restores them; see :meth:`Parameters.temporarily`."""

    def __init__(
        self,
        registry: RestoreRegistry,
        access: ParameterAccess,
        writer: ParameterWriter,
        values: Mapping[str, float],
        idle_timeout_s: float,
    ) -> None:
        super().__init__(registry, access, writer, idle_timeout_s)
        self._values = dict(values)
        self._was_entered = False

    async def __aenter__(self) -> dict[str, ParameterWrite]:
        """Set the values; if one of them cannot be set, restore all."""
        if self._was_entered:
            raise InvalidArgument("this block was entered before: call temporarily() anew for each `with` block")
        self._was_entered = True
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
    """Several parameter writes, of which either all take effect or none.

    Every write is verified; a write that fails or is clamped raises an error. If the block raises, aerokit restores all
    written parameters, and the exception of the block propagates. :class:`aerokit.errors.RollbackFailed` names the
    parameters that could not be restored; aerokit does not try again when the link returns.

    A value that another station has changed meanwhile is not restored; a warning of logger "aerokit" names the
    parameter. Other tasks of your program may write at the same time: a transaction restores the values from before
    its own first write. Blocks that write the same parameter may be nested or overlap. An outer block that fails also
    undoes an inner block that succeeded.
    """

    def __init__(
        self,
        registry: RestoreRegistry,
        access: ParameterAccess,
        writer: ParameterWriter,
        needs_reboot: Callable[[str], bool],
        idle_timeout_s: float,
    ) -> None:
        super().__init__(registry, access, writer, idle_timeout_s)
        self._name_needs_reboot = needs_reboot
        # The vehicle's values of all parameters that were written in this block.
        self._new_values: dict[str, int | float] = {}
        self._is_open = False

    @property
    def changes(self) -> tuple[ParameterDifference, ...]:
        """The changes that this transaction has made so far, with the vehicle's names of the parameters."""
        from aerokit.parameters import ParameterDifference

        return tuple(
            ParameterDifference(name, self._saved[name].value, new_value)
            for name, new_value in self._new_values.items()
            if not same_value(self._saved[name].value, new_value)
        )

    @property
    def needs_reboot(self) -> tuple[str, ...]:
        """Names of the changed parameters that need a reboot; empty without :meth:`Parameters.load_metadata`."""
        return tuple(change.name for change in self.changes if self._name_needs_reboot(change.name))

    async def set(self, name: str, value: float) -> ParameterWrite:
        """Set one parameter; errors as for :meth:`Parameters.set`.

        Raises VerificationFailed if the vehicle clamps the value.
        """
        return (await self.set_many({name: value}))[name]

    async def set_many(self, values: Mapping[str, float]) -> dict[str, ParameterWrite]:
        """Set several parameters. If some fail, the first error is raised after all were tried."""
        if not self._is_open:
            raise InvalidArgument("this transaction is not open: it has ended, or was not entered yet")
        try:
            results = await self._write(values)
        finally:  # Some values may be set, even if others could not be read or written.
            for name in self._saved:
                known = self._access.store.get(name)
                if known is not None:
                    self._new_values[name] = known.value
        _raise_first_error(results)
        clamped = [result for result in results.values() if result.outcome == "clamped"]
        if clamped:
            texts = tuple(f"{result.name}: requested {result.requested:g}, is {result.value:g}" for result in clamped)
            raise VerificationFailed("the vehicle has set other values than requested", differences=texts)
        return results

    async def __aenter__(self) -> Self:
        if self._is_open or self._saved:
            raise InvalidArgument("this transaction was entered already: call transaction() again")
        self._is_open = True
        return self

    async def __aexit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        self._is_open = False
        if error is None:
            self._discard()
        else:
            await self._restore(error)

    def _abandon(self, error: AerokitError, cause: BaseException | None) -> None:
        if cause is not None:
            super()._abandon(error, cause)


def abandon(block: TemporaryParameters | Transaction, error: AerokitError, cause: BaseException | None) -> None:
    """End a block whose event loop has ended, so that it cannot restore parameters.

    Raises RollbackFailed, with the text of ``error``, if the block would have restored parameters. Raises ``error``
    itself if the block had already ended. ``cause`` is the exception that has left the block, or None.
    """
    block._abandon(error, cause)


def _raise_first_error(results: Mapping[str, ParameterWrite]) -> None:
    for result in results.values():
        if result.error is not None:
            raise result.error


def _raise_not_restored(parameters: list[Parameter], reason: str, cause: BaseException | None) -> None:
    not_restored = {param.name: param.value for param in parameters}
    if not_restored:
        values = ", ".join(f"{name} = {value!r}" for name, value in not_restored.items())
        raise RollbackFailed(f"could not restore{reason}: {values}", not_restored=not_restored) from cause


def _is_restored(saved: Parameter, answer: object) -> bool:
    return isinstance(answer, Parameter) and same_value(answer.value, saved.value)
