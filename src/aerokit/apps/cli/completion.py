"""``aerokit completion``: completion of commands, options and names in the shell, by argcomplete."""

from __future__ import annotations

import argparse

from aerokit.apps.cli.output import DONE, need

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
