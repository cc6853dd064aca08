"""``python -m aerokit.dronekit program.py arguments…`` runs a DroneKit program without changes."""

from __future__ import annotations

import sys

from aerokit.dronekit.runner import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
