"""Failure policies: which orders the other members get when a member fails. Without IO."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any, Literal, get_args

from aerokit._internal.formatting import short_repr
from aerokit._internal.values import Snapshot
from aerokit.errors import FleetError, InvalidArgument

__all__ = ["FleetResult", "MemberFailure", "Policy", "PolicyDecision", "PolicyName", "PolicyOrder", "PolicyRules"]

PolicyName = Literal["hold_others", "land_others", "return_others", "continue_others"]
"""The built-in policies."""

PolicyOrder = Literal["hold", "land", "return"]
"""An order that a policy can send to one member."""


class MemberFailure(Snapshot):
    """Failure of a member, passed to a policy function.

    ``others`` are the members to which the policy may send orders.
    """

    member: str
    group: str
    action: str
    error: Exception
    others: tuple[str, ...]


PolicyDecision = PolicyName | Mapping[str, PolicyOrder] | None
"""Result of a policy function: a built-in policy, a mapping of members to orders, or None (the others continue)."""

Policy = PolicyName | Callable[[MemberFailure], PolicyDecision]
"""A built-in policy, or a function. The function is called on the event loop and must not block."""

ORDERS: Mapping[str, PolicyOrder] = {
    "hold_others": "hold",
    "land_others": "land",
    "return_others": "return",
}


class PolicyRules:
    """Failure policies of a fleet: a default, and others for some groups of members."""

    def __init__(self, policy: Policy, by_group: Mapping[str, Policy]) -> None:
        arguments = {"on_error": policy}
        arguments.update({f"on_error_by_group[{group!r}]": by_group[group] for group in by_group})
        for name, value in arguments.items():
            if not callable(value) and value not in get_args(PolicyName):
                raise InvalidArgument(
                    f"{name} = {short_repr(value)} is not allowed: it must be"
                    f" {', '.join(get_args(PolicyName))}, or a function"
                )
        self._policy, self._by_group = policy, dict(by_group)

    def decide(self, failure: MemberFailure) -> dict[str, PolicyOrder]:
        """Return the orders for the members in ``failure.others``. Members without an order continue.

        Raises:
            InvalidArgument: the policy function did not return a PolicyDecision, or named a member that is not in
                ``others``.
        """
        policy = self._by_group.get(failure.group, self._policy)
        decision = policy(failure) if callable(policy) else policy
        if decision is None or decision == "continue_others":
            return {}
        if isinstance(decision, str) and decision in ORDERS:
            return dict.fromkeys(failure.others, ORDERS[decision])
        if not isinstance(decision, Mapping):
            raise InvalidArgument(
                f"the policy function returned {short_repr(decision)}: allowed are {', '.join(get_args(PolicyName))},"
                f" None, or a mapping of member names to orders"
            )
        for name, order in decision.items():
            if name not in failure.others:
                raise InvalidArgument(
                    f"the policy function returned an order for {short_repr(name)}, to which the policy cannot send"
                    f" orders; allowed are {', '.join(failure.others) or 'none'}"
                )
            if order not in get_args(PolicyOrder):
                raise InvalidArgument(
                    f"the policy function returned the order {short_repr(order)} for {name}: allowed are"
                    f" {', '.join(get_args(PolicyOrder))}"
                )
        return dict(decision)


class FleetResult(Mapping[str, Any]):
    """Result of a fleet action: maps each member's name to the action's return value or exception."""

    def __init__(
        self,
        action: str,
        outcomes: Mapping[str, Any],
        *,
        failed: Mapping[str, Exception],
        stopped: Mapping[str, Exception],
        skipped: Mapping[str, str],
    ) -> None:
        self.action: str = action
        """The name of the action."""
        self.failed: dict[str, Exception] = dict(failed)
        """Members that failed, with their errors."""
        self.stopped: dict[str, Exception] = dict(stopped)
        """Members that the policy stopped because another member failed."""
        self.skipped: dict[str, str] = dict(skipped)
        """Maps unavailable members, which got no order, to the reason. The FleetResult itself does not contain them."""
        self._outcomes = dict(outcomes)
        self._final_orders: Mapping[str, object] = {}  # `FleetContext.newest_orders` when each member finished

    @property
    def is_complete(self) -> bool:
        """True if no member failed and none was stopped."""
        return not self.failed and not self.stopped

    def raise_for_errors(self) -> None:
        """Raise FleetError if a member failed or was stopped. Its attribute ``errors`` maps these members to errors."""
        errors = {**self.failed, **self.stopped}
        if errors:
            done = len(self._outcomes) - len(errors)
            raise FleetError(f"{self.action}: {done} of {len(self._outcomes)} members succeeded", errors=errors)

    def __getitem__(self, name: str) -> Any:
        return self._outcomes[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._outcomes)

    def __len__(self) -> int:
        return len(self._outcomes)

    def __repr__(self) -> str:
        parts = [f"{len(self) - len(self.failed) - len(self.stopped)} of {len(self)} done"]
        for label, names in (("failed", self.failed), ("stopped", self.stopped), ("skipped", self.skipped)):
            if names:
                parts.append(f"{label}: {', '.join(names)}")
        return f"<FleetResult of {self.action}: {'; '.join(parts)}>"
