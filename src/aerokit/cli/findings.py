"""``Finding``: one thing that ``aerokit doctor`` has found, and what to do about it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from aerokit.cli.output import tell
from aerokit.snapshot import Snapshot

if TYPE_CHECKING:
    import argparse

__all__ = ["Finding", "Level", "tell_finding"]

Level = Literal["ok", "note", "problem"]
"""As it should be; worth knowing; to be mended."""
_MARKS: dict[str, str] = {"ok": "ok  ", "note": "note", "problem": "BAD "}


class Finding(Snapshot):
    """``subject`` is what was looked at in a few words, ``text`` what was found, ``do`` what to do (empty: nothing)."""

    level: Level
    subject: str
    text: str
    do: str = ""


def tell_finding(options: argparse.Namespace, finding: Finding) -> None:
    """Print it."""
    lines = [f"{_MARKS[finding.level]}  {finding.subject}: {finding.text}"]
    if finding.do:
        lines.append(f"      → {finding.do}")
    tell(options, "finding", finding.to_dict(), "\n".join(lines))
