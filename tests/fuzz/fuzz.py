"""Fuzzing from the command line: ``python tests/fuzz/fuzz.py [--runs N] [TARGET …]``; see ``nox -s fuzz``.

Uses atheris, which is coverage-guided, if it is installed, else random bytes and mutations of the corpus. Each target
runs in its own process, because a failing input ends it. Failing inputs are stored in ``fuzz-failures/``: fix the
fault, and move the file to ``tests/fuzz/corpus/TARGET/``.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import random
import subprocess
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent / "helpers")]
CORPUS = HERE / "corpus"
FAILURES = Path("fuzz-failures")
RUNS = 2000


def main() -> int:
    parser = argparse.ArgumentParser(description="Fuzz aerokit.")
    parser.add_argument("targets", nargs="*", metavar="TARGET", help="all of them by default")
    parser.add_argument("--runs", type=int, default=RUNS, help=f"inputs for each target ({RUNS})")
    parser.add_argument("--grow", type=Path, metavar="DIR", help="keep inputs that reach new code there, by target")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--plain", action="store_true", help="without atheris")
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        return fuzz(options.targets[0], options)
    from targets import TARGETS

    failed = [name for name in options.targets or TARGETS if not succeeds(name, options)]
    print(f"failed: {', '.join(failed)}; inputs in {FAILURES}/" if failed else "all passed")
    return 1 if failed else 0


def succeeds(name: str, options: argparse.Namespace) -> bool:
    print(f"{name} …", flush=True)
    command = [
        sys.executable,
        __file__,
        "--one",
        "--runs",
        str(options.runs),
        "--seed",
        str(options.seed),
        name,
    ]
    command += ["--plain"] if options.plain else []
    if options.grow is not None:
        command += ["--grow", str(options.grow)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        print(done.stdout[-4000:], done.stderr[-4000:], sep="\n")
    return done.returncode == 0


def fuzz(name: str, options: argparse.Namespace) -> int:
    FAILURES.mkdir(exist_ok=True)
    if importlib.util.find_spec("atheris") is not None and not options.plain:
        fuzz_with_atheris(name, options)  # does not return
    from targets import TARGETS

    chance = random.Random(options.seed)
    known = [path.read_bytes() for path in sorted((CORPUS / name).glob("*"))]
    for data in [*known, *(changed(known, chance, TARGETS[name].longest) for _ in range(options.runs))]:
        try:
            TARGETS[name](data)
        except Exception:
            (FAILURES / f"{name}-failed").write_bytes(data)
            raise
    return 0


def fuzz_with_atheris(name: str, options: argparse.Namespace) -> None:
    atheris: Any = importlib.import_module("atheris")

    with atheris.instrument_imports(include=["aerokit"]):
        from targets import TARGETS

        TARGETS[name](b"")  # imports on first use
    folders = [str(CORPUS / name)] if (CORPUS / name).is_dir() else []
    if options.grow is not None:
        grown = options.grow / name
        grown.mkdir(parents=True, exist_ok=True)
        folders.insert(0, str(grown))
    arguments = [f"-runs={options.runs}", f"-seed={options.seed}", f"-max_len={TARGETS[name].longest}"]
    arguments += [f"-artifact_prefix={FAILURES}/{name}-", "-timeout=60", "-rss_limit_mb=2048"]
    atheris.Setup([name, *arguments, *folders], TARGETS[name].__call__)
    atheris.Fuzz()


def changed(known: list[bytes], chance: random.Random, longest: int) -> bytes:
    """Return an input of the corpus with some bytes changed, removed or inserted, or random bytes."""
    if not known or chance.random() < 0.3:
        return chance.randbytes(chance.randrange(longest))
    data = bytearray(chance.choice(known))
    for _ in range(1 + chance.randrange(8)):
        at = chance.randrange(len(data) + 1)
        data[at : at + chance.randrange(3)] = chance.randbytes(chance.randrange(3))
    return bytes(data)


if __name__ == "__main__":
    sys.exit(main())
