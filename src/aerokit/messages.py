"""MAVLink messages: ``from aerokit.messages import Heartbeat``. An alias of :mod:`aerokit.mavlink.messages`."""

import sys
from typing import TYPE_CHECKING

from aerokit.mavlink import messages

if TYPE_CHECKING:
    from aerokit.mavlink.messages import *  # noqa: F403
else:
    # An alias, because a star import would load all parts instead of those in use.
    sys.modules[__name__] = messages
