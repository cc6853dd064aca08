"""The order table through a hub, the bad air on either side of it; and what is dangerous at a hub alone.

`nox -s orders -- SEEDS` flies every row with many seeds.
"""

from __future__ import annotations

import pytest
from call_table import Row
from exhaustive import sampled
from hub_judge import hub_faults
from order_cases import random_case_through_hub
from order_flights import fly
from order_judge import faults
from test_orders import EVERY_ROW, IS_SESSION, SEEDS

ROWS, SEEDS_EACH = (EVERY_ROW, SEEDS) if IS_SESSION else (sampled(EVERY_ROW[::3], 4), 1)
"""Few of them in the tests, all of them in the session."""


@pytest.mark.parametrize("seed", range(SEEDS_EACH))
@pytest.mark.parametrize(("row", "autopilot"), ROWS)
def test_no_rule_is_broken(row: Row, autopilot: str, seed: int) -> None:
    """Nothing is carried out twice, late or made up, and what the call says is true."""
    flown = fly(case := random_case_through_hub(row, autopilot, seed))
    assert [*faults(flown), *hub_faults(flown)] == [], case
