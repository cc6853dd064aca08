"""The command line, ``aerokit COMMAND``."""

from aerokit.apps.cli.main import main

__all__ = ["main"]
