"""``aerokit completion``: completion of commands, options and names in the shell, by argcomplete."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from aerokit.cli.exits import DONE, FAILED, NotInstalled
from aerokit.cli.extras import need

if TYPE_CHECKING:
    import argparse

__all__ = ["add_arguments", "complete", "run_completion"]

SHELLS = ("bash", "zsh", "fish")


def add_arguments(command: argparse.ArgumentParser) -> None:
    """The arguments of the command."""
    command.set_defaults(run=run_completion)
    command.add_argument(
        "shell",
        choices=SHELLS,
        help='bash, zsh: eval "$(aerokit completion bash)" in ~/.bashrc or ~/.zshrc; fish: aerokit completion'
        " fish > ~/.config/fish/completions/aerokit.fish",
    )


async def run_completion(options: argparse.Namespace) -> int:
    """Print what the shell has to read."""
    print(need("argcomplete", "completion").shellcode(["aerokit"], shell=options.shell))
    return DONE


def complete() -> int:
    """Answer the shell, which has said by variables what is typed so far."""
    from aerokit.cli.main import make_parser

    try:
        argcomplete = need("argcomplete", "completion")
    except NotInstalled:
        return FAILED
    words = os.environ.get("COMP_LINE", "").split()
    argcomplete.autocomplete(make_parser(words[1] if len(words) > 1 else ""))
    return FAILED  # it does not come back
