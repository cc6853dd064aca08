"""MAVLink enums: ``from aerokit.enums import MavCmd``. An alias of :mod:`aerokit.mavlink.enums`."""

import sys
from typing import TYPE_CHECKING

from aerokit.mavlink import enums

if TYPE_CHECKING:
    from aerokit.mavlink.enums import *  # noqa: F403
else:
    # Make this module an alias. A star import would load all enums, not only those in use.
    sys.modules[__name__] = enums
