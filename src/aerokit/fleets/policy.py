"""What the others do when one of them fails: rules, without IO."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Literal, get_args

from aerokit.errors import InvalidArgument
from aerokit.snapshot import Snapshot
from aerokit.wording import shown

__all__ = ["Failure", "Policy", "PolicyName", "PolicyOrder", "Rules"]

PolicyName = Literal["hold_others", "land_others", "return_others", "go_on"]
"""What a policy is called."""
PolicyOrder = Literal["hold", "land", "return"]
"""What one member is told to do."""


class Failure(Snapshot):
    """One member has failed: ``member``, of ``group``, in ``action``, with ``error``; ``others`` are the rest."""

    member: str
    group: str
    action: str
    error: Exception
    others: tuple[str, ...]


Policy = PolicyName | Callable[[Failure], "PolicyName | Mapping[str, PolicyOrder] | None"]
"""One of the four, or a function that gives one of them, or an order for each of some members; None: go on.

It is called on the event loop and must not wait.
"""

ORDERS: Mapping[str, PolicyOrder] = {
    "hold_others": "hold",
    "land_others": "land",
    "return_others": "return",
}


class Rules:
    """The policy of a fleet, and those of groups: that of the group of who failed is the one that holds."""

    def __init__(self, policy: Policy, of_groups: Mapping[str, Policy]) -> None:
        for name, each in (
            ("on_error", policy),
            *((f"on_error of {group}", of_groups[group]) for group in of_groups),
        ):
            if not callable(each) and each not in get_args(PolicyName):
                raise InvalidArgument(
                    f"{name} = {shown(each)} is not allowed: one of {', '.join(get_args(PolicyName))}, or a function"
                )
        self._policy, self._of_groups = policy, dict(of_groups)

    def decide(self, failure: Failure) -> dict[str, PolicyOrder]:
        """What each of the others is told; who is not in it goes on.

        Raises:
            InvalidArgument: the program's function gave something else, or a member that is not one of the others.
        """
        policy = self._of_groups.get(failure.group, self._policy)
        decided = policy(failure) if callable(policy) else policy
        if decided is None or decided == "go_on":
            return {}
        if isinstance(decided, str) and decided in ORDERS:
            return dict.fromkeys(failure.others, ORDERS[decided])
        if isinstance(decided, Mapping):
            wrong: list[str] = [name for name in decided if name not in failure.others] or [
                str(order) for order in decided.values() if order not in get_args(PolicyOrder)
            ]
            if not wrong:
                return dict(decided)
            raise self._nonsense(wrong[0])
        raise self._nonsense(decided)

    @staticmethod
    def _nonsense(decided: object) -> InvalidArgument:
        return InvalidArgument(
            f"the policy decided {shown(decided)}: allowed are {', '.join(get_args(PolicyName))}, or for some of the"
            f" others one of {', '.join(get_args(PolicyOrder))} each"
        )
