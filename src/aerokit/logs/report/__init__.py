"""A flight, or two compared, as one HTML file that needs no network; see docs/report.md."""

from __future__ import annotations

from aerokit.logs.report.writing import Report, write_report

__all__ = ["Report", "write_report"]
