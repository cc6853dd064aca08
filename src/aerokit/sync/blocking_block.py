"""``BlockingBlock``: what is for ``with`` says so when it is used in the manner of the asynchronous API."""

from __future__ import annotations

from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from types import TracebackType

    from typing_extensions import Self

__all__ = ["BlockingBlock"]


class BlockingBlock:
    """A base of what :mod:`aerokit.sync` opens. Nobody else would close it then, so it is closed first."""

    _opened_by: str
    """The function that makes one."""

    def close(self) -> None:
        """End it; idempotent."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    if not TYPE_CHECKING:  # type checkers know that they are not there

        def __await__(self) -> NoReturn:
            self._misused("await")

        async def __aenter__(self) -> NoReturn:
            self._misused("async with")

        async def __aexit__(self, *_: object) -> None:
            """Never: it cannot be entered so. Python looks for it first."""

    def _misused(self, word: str) -> NoReturn:
        self.close()
        name = self._opened_by
        raise TypeError(
            f"aerokit.sync.{name}(…) blocks, and is not for `{word}`: write `with aerokit.sync.{name}(…) as …:`, or"
            f" `async with aerokit.{name}(…) as …:` in an async function; what was opened is closed again"
        )
