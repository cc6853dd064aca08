"""``FleetResult``: what became of one action of many vehicles."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from aerokit.errors import FleetError

__all__ = ["FleetResult"]


class FleetResult(Mapping[str, Any]):
    """Member's name → what its action returned, or the exception that it raised.

    A member that was not ordered anything, because it is lost or somebody else flies it, is in ``left_out`` only.
    """

    def __init__(
        self,
        action: str,
        outcomes: Mapping[str, Any],
        *,
        failed: Mapping[str, Exception],
        stopped: Mapping[str, Exception],
        left_out: Mapping[str, str],
    ) -> None:
        self.action: str = action
        """What was ordered."""
        self.failed: dict[str, Exception] = dict(failed)
        """Those that did not do it, and why."""
        self.stopped: dict[str, Exception] = dict(stopped)
        """Those that were stopped by the policy because another one had failed."""
        self.left_out: dict[str, str] = dict(left_out)
        """Those of whom nothing was ordered, and why."""
        self._outcomes = dict(outcomes)

    @property
    def is_complete(self) -> bool:
        """Whether every member that was ordered to has done it."""
        return not self.failed and not self.stopped

    def raise_for_errors(self) -> None:
        """Raise FleetError if a member has failed, or was stopped; its ``errors`` has all of them."""
        errors = {**self.failed, **self.stopped}
        if errors:
            done = len(self._outcomes) - len(errors)
            raise FleetError(f"{self.action}: {done} of {len(self._outcomes)} did it", errors=errors)

    def __getitem__(self, name: str) -> Any:
        return self._outcomes[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._outcomes)

    def __len__(self) -> int:
        return len(self._outcomes)

    def __repr__(self) -> str:
        parts = [f"{len(self) - len(self.failed) - len(self.stopped)} of {len(self)} done"]
        parts += [f"failed: {', '.join(self.failed)}"] if self.failed else []
        parts += [f"stopped: {', '.join(self.stopped)}"] if self.stopped else []
        parts += [f"left out: {', '.join(self.left_out)}"] if self.left_out else []
        return f"<FleetResult of {self.action}: {'; '.join(parts)}>"
