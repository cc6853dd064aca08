"""Flight logs in the formats of other programs: MCAP, CSV, Parquet, GPX, KML; see docs/convert.md."""

from __future__ import annotations

from aerokit.logs.convert.converting import FORMATS, Conversion, convert

__all__ = ["FORMATS", "Conversion", "convert"]
