# What `import dronekit` is where aerokit runs a program: the examples are checked against it.
from aerokit.dronekit import *  # noqa: F403
from aerokit.dronekit import __all__ as __all__
