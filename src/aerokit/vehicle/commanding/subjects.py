"""`Subject`: of the orders to a device that are about one thing, the newest counts that was not refused."""

from __future__ import annotations

__all__ = ["Given", "Subject"]


class Subject:
    """What orders are about: the video of a camera, its zoom, its mode."""

    def __init__(self) -> None:
        self._latest: Given | None = None

    @property
    def latest(self) -> Given | None:
        """The newest order that was not withdrawn."""
        while self._latest is not None and self._latest.is_withdrawn:
            self._latest = self._latest.before
        return self._latest

    def begin(self) -> Given:
        """A new order is given: what those before have under way is not sent again."""
        self._latest = Given(self, self.latest)
        return self._latest


class Given:
    """One order, until a newer one is given."""

    def __init__(self, subject: Subject, before: Given | None) -> None:
        self._subject, self.before = subject, before
        self.is_sent = False
        self.is_withdrawn: bool = False

    @property
    def is_newest(self) -> bool:
        """Whether no other one was given since that was not withdrawn."""
        return self._subject.latest is self

    def withdraw(self) -> None:
        """It was refused, or never accepted: the one before counts again."""
        self.is_withdrawn = True

    def settle(self) -> None:
        """It was accepted, or is told to end: there is no way back to the one before."""
        self.before = None
