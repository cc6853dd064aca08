"""Events that a program can subscribe to; see :mod:`aerokit.runtime.events`."""

from aerokit.runtime.events import *  # noqa: F403
from aerokit.runtime.events import __all__ as __all__
