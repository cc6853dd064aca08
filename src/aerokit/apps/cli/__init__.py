"""The command line: ``aerokit demo`` and ``aerokit sim``."""

from aerokit.apps.cli.main import main

__all__ = ["main"]
