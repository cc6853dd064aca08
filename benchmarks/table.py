"""Rows of the table of benchmarks: creation from measured figures, formatting and writing."""

from __future__ import annotations

import json
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

__all__ = ["Row", "faster_is_better", "higher_is_better", "is_missed", "printed", "quantile", "row", "write"]

Row = dict[str, Any]
"""``name``, ``aerokit`` and ``peer`` (in ``unit``), ``peer_name``, ``ratio`` (above 1: aerokit is ahead), ``aim``."""

HEADINGS = ("name", "aerokit", "peer", "unit", "ratio", "aim", "", "against")


def faster_is_better(
    name: str, aerokit: Sequence[float], peer: Sequence[float], peer_name: str, *, unit: str, aim: float
) -> Row:
    """Create a row from two series of durations: their medians, and the ratio of the peer's to aerokit's."""
    aerokit_median = statistics.median(aerokit)
    peer_median = statistics.median(peer)
    ratio = peer_median / aerokit_median
    return row(name, aerokit_median, peer_median, peer_name, unit=unit, ratio=ratio, aim=aim)


def higher_is_better(
    name: str, aerokit: Sequence[float], peer: Sequence[float], peer_name: str, *, unit: str, aim: float
) -> Row:
    """Create a row from two series of rates, measured in turns: their medians, and the median of the ratios."""
    ratio = statistics.median(own_rate / peer_rate for own_rate, peer_rate in zip(aerokit, peer, strict=True))
    return row(name, statistics.median(aerokit), statistics.median(peer), peer_name, unit=unit, ratio=ratio, aim=aim)


def quantile(values: Sequence[float], share: float) -> float:
    """Return the value that this share of the values does not exceed."""
    ordered = sorted(values)
    return ordered[min(int(share * len(ordered)), len(ordered) - 1)]


def row(name: str, aerokit: float, peer: float, peer_name: str, *, unit: str, ratio: float, aim: float) -> Row:
    """Create a row with rounded figures."""
    return {
        "name": name,
        "aerokit": _rounded(aerokit),
        "peer": _rounded(peer),
        "peer_name": peer_name,
        "unit": unit,
        "ratio": round(ratio, 3),
        "aim": round(aim, 3),
    }


def is_missed(row: Row) -> bool:
    """Return True if the ratio is below the target."""
    return bool(row["ratio"] < row["aim"])


def printed(rows: Sequence[Row]) -> str:
    """Return the table as text."""
    lines = [HEADINGS, *(_cells(row) for row in rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    texts = []
    for line in lines:
        cells = [cell.ljust(width) for cell, width in zip(line, widths, strict=True)]
        texts.append("  ".join(cells).rstrip())
    return "\n".join(texts)


def write(rows: Sequence[Row], path: Path) -> None:
    """Write the rows as JSON."""
    path.write_text(json.dumps(list(rows), indent=2) + "\n")


def _cells(row: Row) -> tuple[str, ...]:
    verdict = "MISSED" if is_missed(row) else "ok"
    figures = (f"{row['aerokit']:,}", f"{row['peer']:,}", row.get("unit", ""), f"{row['ratio']:.2f}")
    return (row["name"], *figures, f"{row['aim']:.2f}", verdict, row["peer_name"])


def _rounded(value: float) -> float:
    return round(value) if value >= 1000 else round(value, 1)
