"""MAVLink's messages: ``from aerokit.messages import Heartbeat``; the module :mod:`aerokit.mavlink.messages` itself."""

import sys
from typing import TYPE_CHECKING

from aerokit.mavlink import messages

if TYPE_CHECKING:
    from aerokit.mavlink.messages import *  # noqa: F403
else:
    # Not a star import: each part is imported when the first of its names is used.
    sys.modules[__name__] = messages
