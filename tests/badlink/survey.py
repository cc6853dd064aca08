"""Every transfer over bad radios, many seeds of each: ``nox -s badlinks``, or

    PYTHONPATH=tests/helpers python tests/badlink/survey.py --seeds 200 --sizes real "parameter list" file

prints a table for each kind of radio: the numbers of exact transfers and of errors that name the missing parts, the
median of time / ideal (see `ideals.py`), and the maximum number of messages sent. The exit code is 1 if a transfer was
wrong, left state behind or sent too much, or if a promised median (2 at 5 % loss, 4 at 20 %) is exceeded.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import repeat

from bad_link import NARROW, WIDE, Radio
from transfers_under_test import CASES, REAL, SMALL, TINY, Sizes
from verdicts import Verdict, judge

LOSSES = (0.0, 0.05, 0.1, 0.2, 0.3)
SIZES = {"tiny": TINY, "small": SMALL, "real": REAL}
RADIOS = (NARROW, WIDE)
MAX_RATIO = {0.05: 2.0, 0.2: 4.0}
"""Times the ideal, promised for `NARROW`, whose bandwidth is the limit. On `WIDE` it is a matter of single losses."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Judge all of them, print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="transfers whose names contain this")
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--sizes", choices=SIZES, default="small")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    options = parser.parse_args(arguments)
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    deviations: list[str] = []
    with ProcessPoolExecutor(options.jobs) as pool:
        for radio in RADIOS:
            say(f"\n{radio.name}; {options.sizes} sizes, {options.seeds} seeds")
            say(f"{'':26}" + "".join(f"{loss:>22.0%}" for loss in LOSSES))
            for name in _chosen(options.names):
                cells = []
                for loss in LOSSES:
                    work = (repeat(name), repeat(options.sizes), repeat(radio), repeat(loss), seeds)
                    verdicts = list(pool.map(_judge, *work, chunksize=4))
                    cells.append(_cell(verdicts))
                    deviations += _complaints(radio, loss, verdicts)
                say(f"{name:26}" + "".join(f"{cell:>22}" for cell in cells))
    say("\nexact + honest errors / median time in ideals / most messages")
    say("\n".join(deviations) or "all as promised")
    return int(bool(deviations))


def say(text: str) -> None:
    """Print a line of the table immediately."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def _chosen(words: Sequence[str]) -> Iterable[str]:
    return [case.name for case in CASES if not words or any(word in case.name for word in words)]


def _judge(name: str, sizes: str, radio: Radio, loss: float, seed: int) -> Verdict:
    (case,) = [case for case in CASES if case.name == name]
    chosen: Sizes = SIZES[sizes]
    return judge(case, chosen, radio.with_loss(loss), seed)


def _cell(verdicts: Sequence[Verdict]) -> str:
    exact = sum(verdict.is_exact for verdict in verdicts)
    errors = sum(verdict.error is not None for verdict in verdicts)
    ratio = statistics.median(verdict.ratio for verdict in verdicts)
    return f"{exact}+{errors} / {ratio:.2f} / {max(verdict.messages for verdict in verdicts)}"


def _complaints(radio: Radio, loss: float, verdicts: Sequence[Verdict]) -> Iterable[str]:
    where = f"{verdicts[0].case}, {radio.name}, {loss:.0%} loss"
    for verdict in verdicts:
        for fault in verdict.faults:
            yield f"{where}, seed {verdict.seed}: {fault}"
    ratio = statistics.median(verdict.ratio for verdict in verdicts)
    if radio is NARROW and ratio > MAX_RATIO.get(loss, float("inf")):
        yield f"{where}: {ratio:.2f} times the ideal, more than {MAX_RATIO[loss]:g}"


if __name__ == "__main__":
    sys.exit(main())
