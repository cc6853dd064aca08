"""MAVLink enums: ``from aerokit.enums import MavCmd``. An alias of :mod:`aerokit.mavlink.enums`."""

import sys
from typing import TYPE_CHECKING

from aerokit.mavlink import enums

if TYPE_CHECKING:
    from aerokit.mavlink.enums import *  # noqa: F403
else:
    # This module is an alias: a star import would load all enums instead of only those in use.
    sys.modules[__name__] = enums
