from aerokit.dronekit.util import *  # noqa: F403
