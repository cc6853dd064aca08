"""What the Foxglove viewer shows: ``foxglove_bridge`` serves it live, ``aerokit convert`` writes the same to a file.

``async with foxglove_bridge(connection): ...`` needs foxglove-sdk (``pip install 'aerokit-mavlink[foxglove]'``); see
docs/convert.md.
"""

from __future__ import annotations

from aerokit.apps.foxglove.bridge import FoxgloveBridge, foxglove_bridge

__all__ = ["FoxgloveBridge", "foxglove_bridge"]
