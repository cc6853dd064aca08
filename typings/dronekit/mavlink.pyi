from aerokit.dronekit.mavlink import *  # noqa: F403
