"""All fuzz targets by name."""

from __future__ import annotations

from correction_targets import CORRECTION_TARGETS
from exchange_targets import EXCHANGE_TARGETS
from file_targets import FILE_TARGETS
from simulator_targets import SIMULATOR_TARGETS
from target import Target
from wire_targets import WIRE_TARGETS

__all__ = ["TARGETS"]

ALL = (*WIRE_TARGETS, *FILE_TARGETS, *EXCHANGE_TARGETS, *SIMULATOR_TARGETS, *CORRECTION_TARGETS)
TARGETS: dict[str, Target] = {target.name: target for target in ALL}
