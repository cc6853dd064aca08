"""Download the newest flight log, without async.

python examples/download_logs.py udpin:0.0.0.0:14550 [FILE]
"""

from __future__ import annotations

import sys

import aerokit.sync


def main(address: str, file: str = "") -> None:
    """Download the newest log; the file gets its name when it is complete."""
    with aerokit.sync.connect(address) as vehicle:
        logs = vehicle.logs.list()
        if not logs:
            print("the vehicle has no logs")
            return
        newest = logs[-1]
        target = file or f"log{newest.id:05}{vehicle.autopilot.log_suffix}"
        vehicle.logs.download(newest, target, on_progress=lambda progress: print(progress.done, "bytes"))
        print(f"log {newest.id} is in {target}")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "udpin:0.0.0.0:14550", sys.argv[2] if len(sys.argv) > 2 else "")
