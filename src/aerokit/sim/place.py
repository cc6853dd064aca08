"""Where simulated vehicles stand unless told otherwise."""

from __future__ import annotations

__all__ = ["HOME"]

HOME = (-35.363261, 149.165230, 584.09)
"""The model airfield near Canberra that SITL and the examples of the field begin at: degrees, metres above the sea."""
