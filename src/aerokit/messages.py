"""MAVLink messages: ``from aerokit.messages import Heartbeat``. An alias of :mod:`aerokit.mavlink.messages`."""

import sys
from typing import TYPE_CHECKING

from aerokit.mavlink import messages

if TYPE_CHECKING:
    from aerokit.mavlink.messages import *  # noqa: F403
else:
    # Make this module an alias. A star import would load all messages, not only those in use.
    sys.modules[__name__] = messages
