"""Every transfer over bad radios, a few seeds of each; ``nox -s badlinks`` (`survey.py`) has two hundred.

``AEROKIT_SEEDS=20 pytest tests/badlink`` does more of them here.
"""

from __future__ import annotations

import math
import os
import statistics

import anyio
import pytest
from bad_link import DELAY_S, NARROW, WIDE, Program, Radio, attempt
from exhaustive import exhaustive
from transfers_under_test import CASES, TINY, Case, leftovers, make_copter
from verdicts import judge

from aerokit.protocols.exchange import IDLE_TIMEOUT_S
from aerokit.testing import FaultModel

SEEDS = int(os.environ.get("AEROKIT_SEEDS", "1"))
ENOUGH = 21
"""For a median: with fewer, luck decides."""
LOSSES = [0.1, *map(exhaustive, (0.0, 0.05, 0.2, 0.3))]
each_case = pytest.mark.parametrize("case", CASES, ids=lambda case: case.name.replace(" ", "-"))

ROUGH = Radio(
    "repeated, overtaken, damaged",
    FaultModel(
        loss=0.02,
        duplication=0.2,
        reordering=0.2,
        corruption=0.05,
        delay_s=DELAY_S,
        jitter_s=0.05,
        overtaken_s=0.08,
    ),
)


@pytest.mark.sampled(3)
@each_case
@pytest.mark.parametrize("loss", LOSSES, ids=lambda loss: f"{loss:.0%}")
def test_transfer_ends_with_exact_content_and_leaves_nothing(case: Case, loss: float) -> None:
    for seed in range(SEEDS):
        verdict = judge(case, TINY, WIDE.with_loss(loss), seed)
        assert verdict.faults == []
        assert verdict.error is None


@pytest.mark.exhaustive
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name.replace(" ", "-"))
def test_transfer_time_stays_near_ideal_with_losses(case: Case) -> None:
    for loss, most in ((0.05, 2.0), (0.2, 4.0)):
        radio = NARROW.with_loss(loss)
        verdicts = [judge(case, TINY, radio, seed) for seed in range(max(SEEDS, ENOUGH))]
        assert [verdict.faults for verdict in verdicts if verdict.faults] == []
        assert statistics.median(verdict.ratio for verdict in verdicts) <= most


@pytest.mark.sampled(3)
@each_case
def test_repeated_reordered_and_damaged_frames_do_no_harm(case: Case) -> None:
    verdict = judge(case, TINY, ROUGH, seed=1)
    assert verdict.faults == []
    assert verdict.error is None


@pytest.mark.sampled(3)
@each_case
def test_three_seconds_of_silence_are_survived(case: Case) -> None:
    begin = 0.5 + 0.6 * case.ideal(make_copter(case, TINY, NARROW), TINY).seconds(NARROW)
    radio = Radio("outage", NARROW.model.replace(loss=0.05), NARROW.half_duplex, NARROW.port_bytes_per_s, begin, 3.0)
    verdict = judge(case, TINY, radio, seed=2)
    assert verdict.faults == []
    assert verdict.error is None


@pytest.mark.sampled(3)
@each_case
@pytest.mark.parametrize("share", [exhaustive(0.0), 0.4, exhaustive(0.9)])
def test_dead_link_error_names_what_is_missing(case: Case, share: float) -> None:
    ideal_s = case.ideal(make_copter(case, TINY, WIDE), TINY).seconds(WIDE)
    verdict = judge(case, TINY, Radio("dies", WIDE.model, outage_after_s=share * ideal_s, outage_s=math.inf), seed=3)
    assert verdict.faults == []
    assert (
        verdict.seconds <= ideal_s + 3 * IDLE_TIMEOUT_S
    )  # a transfer has three parts at most, each with its own patience


@pytest.mark.sampled(3)
@each_case
@pytest.mark.parametrize("share", [exhaustive(0.1), 0.5, exhaustive(0.95)])
def test_cancelled_transfer_leaves_nothing_behind(case: Case, share: float) -> None:
    radio = NARROW.with_loss(0.1)
    copter = make_copter(case, TINY, radio)
    after_s = share * case.ideal(copter, TINY).seconds(radio)

    async def work(program: Program) -> None:
        with anyio.move_on_after(after_s):
            await case.work(program, TINY)

    done = attempt(work, radio, 4, lambda: copter, before=case.before, leftovers=leftovers)
    assert done.error is None
    assert done.left == []
