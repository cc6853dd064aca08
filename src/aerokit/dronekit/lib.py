"""``dronekit.lib``: the names of ``dronekit``, for programs written for DroneKit 1."""

from __future__ import annotations

from aerokit.dronekit import *  # noqa: F403
from aerokit.dronekit import __all__ as __all__
