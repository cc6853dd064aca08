"""Writes that are put back: for the time of a block (``temporarily``), or when it fails (``transaction``)."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import anyio

from aerokit._internal.arguments import checks_arguments
from aerokit.connection.tasks import to_its_end
from aerokit.errors import AerokitError, InvalidArgument, RollbackFailed, VerificationFailed
from aerokit.parameters import Parameter
from aerokit.parameters.parameter import same_value
from aerokit.vehicle.parameters.writing import Found

if TYPE_CHECKING:
    from types import TracebackType

    from typing_extensions import Self

    from aerokit.parameters import ParameterDifference
    from aerokit.vehicle.parameters.access import ParameterAccess
    from aerokit.vehicle.parameters.writing import ParameterWrite, ParameterWriting

__all__ = ["Holds", "Temporarily", "Transaction"]

logger: logging.Logger = logging.getLogger("aerokit")

LONGEST_PUTTING_BACK = 3
"""In patiences: the end of a block is bounded, however slowly the link goes."""


class Holds:
    """Which blocks will put back which parameter, in the order in which they first wrote it."""

    def __init__(self) -> None:
        self._blocks: dict[str, list[_Block]] = {}

    def add(self, name: str, block: _Block) -> None:
        """This block has begun to hold the parameter."""
        self._blocks.setdefault(name, []).append(block)

    def remove(self, name: str, block: _Block) -> _Block | None:
        """It holds it no more; returns the block that came next to it, if there is one."""
        blocks = self._blocks[name]
        place = blocks.index(block)
        del blocks[place]
        if not blocks:
            del self._blocks[name]
        return blocks[place] if place < len(blocks) else None


class _Block:
    """Remembers what parameters were before it wrote them."""

    def __init__(
        self, holds: Holds, access: ParameterAccess, writing: ParameterWriting, patience_s: float
    ) -> None:
        self._holds, self._access, self._writing = holds, access, writing
        self._patience_s = patience_s
        self._before: dict[str, Parameter] = {}

    async def _write(self, values: Mapping[str, float]) -> dict[str, ParameterWrite]:
        await self._remember(values)
        return await self._writing.write(values, patience_s=self._patience_s)

    async def _remember(self, values: Mapping[str, float]) -> None:
        """Read what they are now: what is known may be old."""
        found = await self._writing.names.find(values, self._patience_s)
        fresh = {
            each.name: each.parameter for each in found.values() if isinstance(each, Found) and each.is_fresh
        }
        known = {each.name for each in found.values() if isinstance(each, Found)}
        answers = await self._access.read(known - fresh.keys() - self._before.keys(), self._patience_s)
        for name, answer in (answers | fresh).items():
            if not isinstance(answer, Parameter):
                raise answer
            if name not in self._before:
                self._before[name] = (
                    self._access.store.get(name) or answer
                )  # a read may have lost the last bits
                self._holds.add(name, self)

    def _release(self) -> list[Parameter]:
        """What this block has to put back. A parameter that another block holds, too, is that one's to put back."""
        own = []
        for name, before in self._before.items():
            later = self._holds.remove(name, self)
            if later is None:
                own.append(before)
            else:
                later._before[name] = before
        return own

    def _keep(self) -> None:
        for name in self._before:
            self._holds.remove(name, self)

    async def _put_back(self, cause: BaseException | None) -> None:
        """Bounded, and not to be cancelled; RollbackFailed names what could not be restored."""
        await to_its_end(self._write_back(self._release(), cause))

    async def _write_back(self, wanted: list[Parameter], cause: BaseException | None) -> None:
        answers: Mapping[str, object] = {}
        reason = ""
        with anyio.move_on_after(LONGEST_PUTTING_BACK * self._patience_s):
            try:
                changed = await self._changed_by_others(wanted)
                wanted = [each for each in wanted if not isinstance(changed.get(each.name), Parameter)]
                to_write = [each for each in wanted if each.name not in changed]
                answers = await self._access.write(to_write, self._patience_s)
            except AerokitError as error:
                reason = f" ({error})"
        left = {each.name: each.value for each in wanted if not _is_back(each, answers.get(each.name))}
        if left:
            names = ", ".join(f"{name} = {value!r}" for name, value in left.items())
            raise RollbackFailed(f"could not be put back{reason}: {names}", not_restored=left) from cause

    async def _changed_by_others(self, wanted: list[Parameter]) -> dict[str, object]:
        """What another station has changed since this program wrote it, which is logged; and what does not answer."""
        written = self._access.written
        own = [each.name for each in wanted if each.name in written]
        changed: dict[str, object] = {}
        for name, told in (await self._access.read(own, self._patience_s)).items():
            if not isinstance(told, Parameter) or float(told.value) != float(written[name]):
                changed[name] = told
            if isinstance(told, Parameter) and name in changed:
                text = "%s is not put back: another station has changed it from %r to %r"
                logger.warning(text, name, written[name], told.value)
        return changed


class Temporarily(_Block):
    """Other values for the time of a block; see :meth:`Parameters.temporarily`. Gives the results of the writes."""

    def __init__(
        self,
        holds: Holds,
        access: ParameterAccess,
        writing: ParameterWriting,
        values: Mapping[str, float],
        patience_s: float,
    ) -> None:
        super().__init__(holds, access, writing, patience_s)
        self._values = dict(values)
        self._is_open = False

    async def __aenter__(self) -> dict[str, ParameterWrite]:
        if self._is_open:
            raise InvalidArgument("this block has been entered already; make another one")
        self._is_open = True
        try:
            results = await self._write(self._values)
            _raise_first_error(results)
        except BaseException as error:
            await self._put_back(error)
            raise
        return results

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        await self._put_back(exc)


@checks_arguments
class Transaction(_Block):
    """Several writes, all or none.

    Every write is verified; one that fails or is clamped raises. When the block raises, for whatever reason, all that
    was written is set back, as far as the link lives: what could not be set back is in
    :class:`aerokit.errors.RollbackFailed`, and stays as it is, also when the link comes back. The block's own exception
    comes out otherwise.

    What another station has changed meanwhile is left as it is, and a warning of logger "aerokit" names it. Other
    tasks of this program are not kept from writing meanwhile: what a transaction puts back is what it found before its
    own first write. Blocks about the same parameter may be nested and may overlap; an inner one that succeeds is undone
    by an outer one that fails.
    """

    def __init__(
        self,
        holds: Holds,
        access: ParameterAccess,
        writing: ParameterWriting,
        needs_reboot: Callable[[str], bool],
        patience_s: float,
    ) -> None:
        super().__init__(holds, access, writing, patience_s)
        self._name_needs_reboot = needs_reboot
        self._after: dict[str, int | float] = {}
        self._is_open = False

    @property
    def changes(self) -> tuple[ParameterDifference, ...]:
        """What was written so far and is another value than before, by the names on the vehicle."""
        from aerokit.parameters import ParameterDifference

        return tuple(
            ParameterDifference(name, self._before[name].value, after)
            for name, after in self._after.items()
            if not same_value(self._before[name].value, after)
        )

    @property
    def needs_reboot(self) -> tuple[str, ...]:
        """Those of the changes that take effect after a reboot; needs :meth:`Parameters.load_metadata`."""
        return tuple(change.name for change in self.changes if self._name_needs_reboot(change.name))

    async def set(self, name: str, value: float) -> ParameterWrite:
        """Set one parameter; errors are those of :meth:`Parameters.set`, and VerificationFailed when it is clamped."""
        return (await self.set_many({name: value}))[name]

    async def set_many(self, values: Mapping[str, float]) -> dict[str, ParameterWrite]:
        """Set several; the first error is raised after all were tried."""
        if not self._is_open:
            raise InvalidArgument("this transaction is not open: it has ended, or was not entered")
        results = await self._write(values)
        for name in self._before:
            known = self._access.store.get(name)
            if known is not None:
                self._after[name] = known.value
        _raise_first_error(results)
        clamped = [each for each in results.values() if each.outcome == "clamped"]
        if clamped:
            texts = tuple(f"{each.name}: asked for {each.requested:g}, is {each.value:g}" for each in clamped)
            raise VerificationFailed("the vehicle took other values", differences=texts)
        return results

    async def __aenter__(self) -> Self:
        if self._is_open or self._before:
            raise InvalidArgument("this transaction has been entered already; make another one")
        self._is_open = True
        return self

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._is_open = False
        if exc is None:
            self._keep()
        else:
            await self._put_back(exc)


def _raise_first_error(results: Mapping[str, ParameterWrite]) -> None:
    for result in results.values():
        if result.error is not None:
            raise result.error


def _is_back(wanted: Parameter, answer: object) -> bool:
    return isinstance(answer, Parameter) and same_value(answer.value, wanted.value)
