"""MAVLink's enums: ``from aerokit.enums import MavCmd``; the module :mod:`aerokit.mavlink.enums` itself."""

import sys
from typing import TYPE_CHECKING

from aerokit.mavlink import enums

if TYPE_CHECKING:
    from aerokit.mavlink.enums import *  # noqa: F403
else:
    # Not a star import: each part is imported when the first of its names is used.
    sys.modules[__name__] = enums
