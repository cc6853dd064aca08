"""``dronekit.lib``: where programs written for DroneKit 1 look for the names of ``dronekit``."""

from __future__ import annotations

from aerokit.dronekit import *  # noqa: F403 - all of them, as they are
from aerokit.dronekit import __all__ as __all__
