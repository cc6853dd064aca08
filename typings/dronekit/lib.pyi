from aerokit.dronekit import *  # noqa: F403
