"""`nox -s diaries`: run the tests twice, keep the digests of the wire diaries that are the same both times.

What differs from run to run (keys drawn by chance, times of the wall clock) is left out. With paths of tests as
arguments only theirs are kept anew.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from wire_diary import KEPT, WRITTEN_WITH

FOLDERS = ("autopilots", "links", "mavlink", "orders", "protocols", "runtime", "vehicle")
SECOND = ("--reversed",)


def main(paths: Sequence[str] = ()) -> int:
    tests = paths or [str(KEPT.parent / name) for name in FOLDERS]
    first, second = _run("1", *tests), _run("2", *SECOND, *tests)
    digests = {
        test: digest for test, digest in sorted(first.items()) if digest and second.get(test) == digest
    }
    before = json.loads(KEPT.read_text())["digests"] if KEPT.exists() else {}
    if paths:  # the other tests have theirs as before
        digests = {test: digest for test, digest in before.items() if test not in first} | digests
    digests = dict(sorted(digests.items()))
    changed = [test for test, digest in digests.items() if before.get(test, digest) != digest]
    KEPT.write_text(json.dumps({"written with": WRITTEN_WITH, "digests": digests}, indent=0) + "\n")
    new, gone = len(digests.keys() - before.keys()), len(before.keys() - digests.keys())
    sys.stdout.write("".join(f"changed: {test}\n" for test in changed))
    sys.stdout.write(f"{len(digests)} diaries, {len(changed)} changed, {new} new, {gone} gone\n")
    return 0


def _run(hash_seed: str, *options: str) -> dict[str, str]:
    """Test → digest; empty where nothing was written down."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "pytest", "-q", "--diaries", folder, *options]
        subprocess.run(
            command, cwd=KEPT.parent.parent, env=os.environ | {"PYTHONHASHSEED": hash_seed}, check=True
        )
        written = [each.read_text().partition("\n") for each in Path(folder).iterdir()]
    return {test: hashlib.sha256(text.encode()).hexdigest()[:8] if text else "" for test, _, text in written}


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
