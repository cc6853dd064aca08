"""The order table for a fleet of three, each on a link of its own: no member and no policy breaks a rule.

`nox -s orders -- SEEDS` flies every action with every policy and many seeds.
"""

from __future__ import annotations

import pytest
from order_fleet import ACTIONS, POLICIES, faults_of, random_fleet_case
from test_orders import IS_SESSION, SEEDS

from aerokit.fleets.policy import PolicyName

EVERY = [(action, policy) for action in ACTIONS for policy in POLICIES]
FLOWN, SEEDS_EACH = (EVERY, SEEDS) if IS_SESSION else (EVERY[::2], 1)
"""Few of them in the tests, all of them in the session."""


@pytest.mark.sampled(20)
@pytest.mark.parametrize("seed", range(SEEDS_EACH))
@pytest.mark.parametrize(("action", "policy"), FLOWN)
def test_order_table_no_rule_is_broken(action: str, policy: PolicyName, seed: int) -> None:
    """Neither the action nor the policy repeats a command, sends into a silence or overrides a pilot."""
    assert faults_of(case := random_fleet_case(action, policy, seed)) == [], case
