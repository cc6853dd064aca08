"""Seeded programs of random calls on simulated vehicles. `side_by_side` runs them on a binary, too, and compares."""

from __future__ import annotations

from dataclasses import replace

import pytest
from side_by_side import Step, differences, program, run_simulated

SPEEDUP = 5.0


@pytest.mark.exhaustive
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("kind", ["copter", "px4"])
def test_program_of_one_seed_is_reproducible(kind: str, seed: int) -> None:
    first, second = (run_simulated(kind, seed, SPEEDUP) for _ in range(2))
    assert first == second
    assert len(first) == len(program(kind, seed))
    assert all(step.result != "cancelled" for step in first)


def test_programs_of_different_seeds_differ_and_use_every_call() -> None:
    programs = [program("copter", seed) for seed in range(60)]
    assert program("copter", 1) == programs[1] != programs[2]
    assert len({call.name for calls in programs for call in calls}) == 16


def test_differences_end_where_the_states_part() -> None:
    same = Step("arm()", "done", "GUIDED", True, True, ())
    said = replace(same, texts=("a text",))
    apart = replace(same, armed=False)
    assert differences([same, same], [same, same]) == []
    found = differences([said, same, apart, said], [same, same, same, same])
    assert [line[:2].strip() for line in found] == ["0", "2", "2"]
    assert "texts real ('a text',), simulated ()" in found[0]
    assert found[-1].endswith("their states differ")
