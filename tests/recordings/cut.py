"""Cuts the project's own recordings out of longer ones. Only needed when the windows below change.

PYTHONPATH=src python tests/recordings/cut.py ../shared/traces
"""

from __future__ import annotations

import sys
from itertools import islice
from pathlib import Path

from aerokit.mavlink import TlogWriter, read_tlog

HERE = Path(__file__).parent

WINDOWS: dict[str, tuple[tuple[int, int], ...]] = {
    "ardupilot-copter": (
        (0, 300),  # boot, connect, first parameters
        (1360, 1760),  # streams begin, mission up and down
        (2220, 2360),  # attitude known
        (3320, 3420),  # GPS found, first position
        (5900, 5980),  # origin and home
        (6790, 6830),  # pre-arm checks pass
        (8000, 9000),  # one whole stretch
        (11370, 11420),  # the estimator uses GPS
        (12730, 12930),  # GUIDED, arm, take-off order
        (13660, 13700),  # in the air
        (14290, 14320),  # in-flight alignment
        (16420, 16520),  # position set-point
        (19560, 19660),  # arrived, RTL
        (21180, 21280),  # highest point
        (32420, 32450),  # touch-down
        (33000, 33110),  # disarmed
    ),
    "px4-quad": (
        (0, 420),  # connect, position known, preflight failure
        (870, 1060),  # ready, first parameters
        (2650, 3000),  # mission up and down, arm, take-off
        (3390, 3430),  # take-off detected
        (3690, 3720),  # taking off
        (4070, 4100),  # PING, VIBRATION
        (7420, 7500),  # in the air
        (7800, 7850),  # MISSION
        (11240, 11260),  # an item reached
        (15020, 15080),  # mission finished
        (15310, 15350),  # RTL
        (20000, 20600),  # one whole stretch
        (22890, 23200),  # highest point, landing
        (34700, 34790),  # landed
        (35450, 35528),  # disarmed
    ),
}
"""First frame, and the one after the last, counted in the longer recording."""

RAW_BYTES = 4096
"""For the serial boot: the text before the first frame, and about a hundred frames."""


def main(source: Path) -> None:
    """Write all recordings."""
    for name, windows in WINDOWS.items():
        records = list(islice(read_tlog(source / f"{name}.tlog"), windows[-1][1]))
        with TlogWriter(HERE / f"{name}.tlog") as writer:
            for begin, end in windows:
                for when, raw in records[begin:end]:
                    writer.write(raw, when)
    boot = "ardupilot-copter-serial-boot.raw"
    (HERE / boot).write_bytes((source / boot).read_bytes()[:RAW_BYTES])


if __name__ == "__main__":
    main(Path(sys.argv[1]))
