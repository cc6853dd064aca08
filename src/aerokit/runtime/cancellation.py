"""``Cancellation``: a cancel scope that may be made, and cancelled, where no task is running."""

from __future__ import annotations

from typing import TYPE_CHECKING

import anyio

if TYPE_CHECKING:
    from types import TracebackType

    from typing_extensions import Self

__all__ = ["Cancellation"]


class Cancellation:
    """Entered once, by a task; cancelled at any time, before as well, from callbacks too.

    Where sniffio is installed (trio, openai and others bring it), anyio knows which library is running in tasks
    only: an ``anyio.CancelScope`` made in a callback of the loop raises.
    """

    def __init__(self) -> None:
        self._scope: anyio.CancelScope | None = None
        self._is_cancelled = False

    def cancel(self) -> None:
        """Cancel what it is around, but for what is shielded; idempotent."""
        self._is_cancelled = True
        if self._scope is not None:
            self._scope.cancel()

    def __enter__(self) -> Self:
        self._scope = anyio.CancelScope()
        self._scope.__enter__()
        if self._is_cancelled:
            self._scope.cancel()
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> bool:
        assert self._scope is not None
        return bool(self._scope.__exit__(exc_type, exc, traceback))
