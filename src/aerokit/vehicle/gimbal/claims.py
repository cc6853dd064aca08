"""`Claim`: that a block of this program wants or has control of a gimbal."""

from __future__ import annotations

__all__ = ["Claim", "Claims"]


class Claim:
    """Of one block, from its entering on, to one manager; a ``parameter`` of 0 means all gimbals of the manager."""

    def __init__(self, manager_id: int, parameter: int, *, is_primary: bool) -> None:
        self.manager_id: int = manager_id
        self.parameter: int = parameter
        self.is_primary: bool = is_primary
        self.owes_release = False
        """Whether an earlier block, whose last word was not answered, leaves it to this one to give control back."""

    def shares(self, other: Claim) -> bool:
        """Whether to give back what the one has takes it away from the other."""
        is_same = (self.manager_id, self.is_primary) == (other.manager_id, other.is_primary)
        return is_same and (self.parameter == other.parameter or 0 in (self.parameter, other.parameter))


class Claims:
    """Those that are open."""

    def __init__(self) -> None:
        self._open: list[Claim] = []

    def add(self, claim: Claim) -> None:
        """Its block is being entered."""
        self._open.append(claim)

    def end(self, claim: Claim) -> None:
        """Its block was left, or not entered."""
        if claim in self._open:
            self._open.remove(claim)

    def may_give_back(self, claim: Claim) -> bool:
        """Whether no other block wants or has the same; one that does has to give it back now."""
        others = [each for each in self._open if each is not claim and each.shares(claim)]
        for each in others:
            each.owes_release = True
        return not others
