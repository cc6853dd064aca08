"""Stands in for sniffio, which trio, openai and anthropic bring: a callback outside any task is of no library."""

from __future__ import annotations

import asyncio
from contextvars import ContextVar


class AsyncLibraryNotFoundError(RuntimeError):
    """Raised when no async library is running."""


current_async_library_cvar: ContextVar[str | None] = ContextVar("current_async_library_cvar", default=None)


def current_async_library() -> str:
    library = current_async_library_cvar.get()
    if library is not None:
        return library
    try:
        if asyncio.current_task() is not None:
            return "asyncio"
    except RuntimeError:
        pass
    raise AsyncLibraryNotFoundError
