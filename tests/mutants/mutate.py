"""Mutation tests: does a test fail for a changed line? `nox -s mutants -- [PATH …] [--sample N] [--seed S]`.

Draws a sample of all single changes (`mutations.py`); for each, the tests that run the changed lines (`reach.py`) run
on a copy of the sources, the nearest and fastest first, until one fails. Undetected changes are printed, unless
`equivalent.json` says why they change nothing.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from mutations import Mutation, difference, mutations_of
from reach import ROOT, SOURCE, Reach, measure
from trial import NOTICED, SURVIVED, TOO_LONG, Trials

PACKAGES = ("autopilots", "transport", "mavlink", "protocols", "connection", "vehicle")
TESTS = (
    *PACKAGES,
    "golden",
    "calls",
    "parameters",
    "missions",
    "test_hostile_files.py",
    "sync",
)
GENERATED = ("mavlink/messages", "mavlink/enums")
EQUIVALENT = Path(__file__).with_name("equivalent.json")
GOAL = 0.9
NO_SUCH_TEST = "ERROR: not found"
READS_DEFAULTS = ("test_sync.py",)
"""Looks at the signatures of all calls, and runs none of their lines."""


def main() -> int:
    options = _arguments()
    mutants = list(_sample(_sources(options.paths), options.sample, random.Random(options.seed)))
    reach = measure(path for name in options.tests for path in _test_files(name))
    explained = {(e["path"], e["old"], e["new"]) for e in json.loads(EQUIVALENT.read_text())}
    counts: dict[str, int] = dict.fromkeys((NOTICED, TOO_LONG, SURVIVED, "explained"), 0)
    with tempfile.TemporaryDirectory() as folder, Trials(Path(folder)) as trials:
        _check_unchanged(trials, reach)
        for number, (mutation, source, changed) in enumerate(mutants, 1):
            if options.only and number not in options.only:
                continue
            old, new = difference(source, changed)
            begin = time.monotonic()
            tests = _tests_of(mutation, reach, options.seconds)
            verdict, by = _verdict(trials, mutation, changed, tests, reach)
            if verdict == SURVIVED and (mutation.path, old, new) in explained:
                verdict = "explained"
            counts[verdict] += 1
            took = time.monotonic() - begin
            where = f"{mutation.path}:{mutation.lines[0]}"
            _say(f"{number:4} {verdict:9} {took:4.0f} s {len(tests):4} tests  {where}  {by[:150]}")
            if verdict != NOTICED or options.verbose:
                _say(f"       - {old}\n       + {new}")
    judged = sum(counts.values()) - counts["explained"]
    score = (counts[NOTICED] + counts[TOO_LONG]) / judged if judged else 1.0
    _say(f"{score:.1%} of {judged} noticed (seed {options.seed}): {counts}")
    return 0 if score >= GOAL else 1


def _verdict(trials: Trials, mutation: Mutation, changed: str, tests: list[str], reach: Reach) -> tuple[str, str]:
    """Return the result of a change. A failing test counts only if it passes, after the same others, without the
    change.
    """
    while True:
        verdict, by = trials.run(mutation.path, changed, tests, reach.seconds)
        test = next((test for test in tests if verdict == NOTICED and test in by), None)
        if test is None:
            return verdict, by
        if NO_SUCH_TEST in by:  # its name has the constant in it that was changed
            tests = [node_id for node_id in tests if node_id != test]
            continue
        upto = [node_id for node_id in tests[: tests.index(test) + 1] if _file_of(node_id) == _file_of(test)]
        same = (SOURCE / mutation.path).read_text()
        if trials.run(mutation.path, same, upto, reach.seconds)[0] == SURVIVED:
            return verdict, by
        tests = [node_id for node_id in tests if _file_of(node_id) != _file_of(test)]


def _file_of(test: str) -> str:
    return test.partition("::")[0]


def _check_unchanged(trials: Trials, reach: Reach) -> None:
    """Without a change the quickest tests pass here: otherwise everything would be noticed."""
    tests = sorted(reach.seconds, key=lambda test: reach.seconds[test])[:100]
    same = (SOURCE / "errors.py").read_text()
    verdict, by = trials.run("errors.py", same, tests, reach.seconds)
    if verdict != SURVIVED:
        raise SystemExit(f"the tests fail without any change: {by}")


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="nox -s mutants --", description=__doc__)
    parser.add_argument("paths", nargs="*", default=PACKAGES, help="files or folders in src/aerokit")
    parser.add_argument("--sample", type=int, default=200, help="so many changes, drawn by chance (200)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=60, help="processor time of the tests of a change (60)")
    parser.add_argument("--tests", nargs="*", default=TESTS, help="test files or folders in tests/")
    parser.add_argument("--only", nargs="*", type=int, help="of the sample, those with these numbers")
    parser.add_argument("--verbose", action="store_true", help="show the changes that were noticed, too")
    return parser.parse_args()


def _sources(paths: list[str]) -> Iterator[Path]:
    for name in paths:
        path = SOURCE / name.removeprefix("src/aerokit/")
        for source in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            if not str(source.relative_to(SOURCE)).startswith(GENERATED):
                yield source


def _test_files(name: str) -> list[Path]:
    path = ROOT / "tests" / name.removeprefix("tests/")
    return sorted(path.rglob("test_*.py")) if path.is_dir() else [path]


def _sample(sources: Iterator[Path], size: int, chance: random.Random) -> Iterator[tuple[Mutation, str, str]]:
    texts = {str(path.relative_to(SOURCE)): path.read_text() for path in sources}
    everything = [mutation for path, text in texts.items() for mutation in mutations_of(path, text)]
    chance.shuffle(everything)
    _say(f"{len(everything)} changes in {len(texts)} files")
    for mutation in everything:
        changed = mutation.apply(texts[mutation.path]) if size else None
        if changed is not None:
            size -= 1
            yield mutation, texts[mutation.path], changed


def _tests_of(mutation: Mutation, reach: Reach, seconds: float) -> list[str]:
    """Return the tests that run the line, within the time limit: first those named after its file, then the fastest."""
    words = (Path(mutation.path).stem, *Path(mutation.path).stem.split("_"))
    near = reach.by_file.get(mutation.path, set())
    chosen, left = [], seconds

    def distance(test: str) -> tuple[bool, int, bool, float]:
        reads = mutation.at_import and any(name in test for name in READS_DEFAULTS)
        return not reads, -sum(word in test for word in words), test not in near, reach.seconds[test]

    tests = set(reach.seconds) if mutation.at_import else reach.tests_of(mutation.path, mutation.lines)
    for test in sorted(tests, key=distance):
        left -= reach.seconds[test]
        if left < 0:
            break
        chosen.append(test)
    return chosen


def _say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
