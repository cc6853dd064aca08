"""What the others do when one of them fails: rules, without IO."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any, Literal, get_args

from aerokit._internal.values import Snapshot
from aerokit._internal.wording import shown
from aerokit.errors import FleetError, InvalidArgument

__all__ = ["Failure", "FleetResult", "Policy", "PolicyName", "PolicyOrder", "Rules"]

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
