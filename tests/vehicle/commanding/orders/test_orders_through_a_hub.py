"""The order table through a hub, with bad links on either side, and failures that only a hub can have.

`nox -s orders -- SEEDS` flies every row with many seeds.
"""

from __future__ import annotations

import pytest
from call_table import Row
from hub_judge import hub_faults
from order_cases import random_case_through_hub
from order_flights import fly
from order_judge import faults
from test_orders import ALL_ROWS, IS_SESSION, SEEDS

ROWS, SEEDS_EACH = (ALL_ROWS, SEEDS) if IS_SESSION else (ALL_ROWS[::3], 1)
"""Few of them in the tests, all of them in the session."""


@pytest.mark.sampled(20)
@pytest.mark.parametrize("seed", range(SEEDS_EACH))
@pytest.mark.parametrize(("row", "autopilot"), ROWS)
def test_order_table_no_rule_is_broken(row: Row, autopilot: str, seed: int) -> None:
    """No command is executed twice, late or without an order, and the result of the call is true."""
    flown = fly(case := random_case_through_hub(row, autopilot, seed))
    assert [*faults(flown), *hub_faults(flown)] == [], case
