"""`python tests/golden/record.py [NAME …]`: rewrite the golden traces, after a change that is meant.

Read the diff before you commit it: each line is a frame that a vehicle gets, or that it is answered by.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

HERE = Path(__file__).parent


def main(names: Sequence[str]) -> int:
    from golden_scenes import SCENES, recorded

    for name in names or SCENES:
        path, text = HERE / f"{name}.txt", recorded(name)
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
            sys.stdout.write(f"rewritten: {path.name}\n")
    for path in HERE.glob("*.txt"):
        if path.stem not in SCENES:
            path.unlink()
            sys.stdout.write(f"removed: {path.name}\n")
    return 0


if __name__ == "__main__":
    sys.path.insert(0, str(HERE.parent / "helpers"))
    sys.exit(main(sys.argv[1:]))
