"""`Newest`: of the orders about one thing that does not steer, the newest counts."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

from aerokit.errors import OperationRejected

if TYPE_CHECKING:
    from collections.abc import Iterator

    from aerokit.vehicle.commanding.helm import Helm
    from aerokit.vehicle.commanding.order import Order

__all__ = ["OVERRULED", "Newest", "Turn"]

OVERRULED = "another order was given"
"""Why an older order ends."""


class Newest:
    """Gives the orders about one thing their turns; what an older one has under way is not sent again."""

    def __init__(self, helm: Helm) -> None:
        self.helm = helm
        self.open: list[Order] = []
        """The commands that wait for their answers."""
        self.latest: Turn | None = None
        """The newest order."""

    def begin(self) -> Turn:
        """A new order is given."""
        for each in self.open:
            each.note_newer()
        self.latest = Turn(self)
        return self.latest


class Turn:
    """One order, until a newer one is given."""

    def __init__(self, newest: Newest) -> None:
        self._newest = newest

    @property
    def is_newest(self) -> bool:
        """Whether no other one was given since."""
        return self._newest.latest is self

    @contextmanager
    def order(self) -> Iterator[Order]:
        """One command of it, for the time of the block.

        Raises:
            OperationRejected: a newer one was given since.
        """
        if not self.is_newest:
            raise OperationRejected(f"{OVERRULED}; the rest of the order was not sent")
        with self._newest.helm.aside() as order:
            self._newest.open.append(order)
            try:
                yield order
            finally:
                self._newest.open.remove(order)
