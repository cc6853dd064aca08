"""``aerokit completion``: shell completion by argcomplete, and the values that are offered for arguments."""

from __future__ import annotations

import argparse
import os
from glob import glob
from importlib.resources import files
from typing import TYPE_CHECKING

from aerokit.apps.cli.output import import_extra

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

_SHELLS = ("bash", "zsh", "fish")
_COMMON_ADDRESSES = ("udpin:0.0.0.0:14550", "udpin:0.0.0.0:14540", "tcp:127.0.0.1:5760")
_DEVICE_PATTERNS = ("/dev/serial/by-id/*", "/dev/ttyACM*", "/dev/ttyUSB*", "/dev/cu.usb*")
_PARAMETER_TABLES = (
    "ardupilot/copter",
    "ardupilot/plane",
    "ardupilot/rover",
    "ardupilot/sub",
    "px4/quadrotor",
    "px4/airplane",
)


def add_arguments(command: argparse.ArgumentParser) -> None:
    command.set_defaults(run=run_completion)
    command.add_argument(
        "shell",
        choices=_SHELLS,
        help='bash, zsh: eval "$(aerokit completion bash)" in ~/.bashrc or ~/.zshrc; fish: aerokit completion'
        " fish > ~/.config/fish/completions/aerokit.fish",
    )


async def run_completion(options: argparse.Namespace) -> None:
    print(import_extra("argcomplete", extra="completion").shellcode(["aerokit"], shell=options.shell))


def set_completions(action: argparse.Action, values: Callable[[], Iterable[str]]) -> None:
    setattr(action, "completer", lambda **_: list(values()))  # noqa: B010 - not an attribute of argparse.Action


def addresses() -> list[str]:
    default = os.environ.get("AEROKIT_ADDRESS", "").strip()
    offered = [default] if default else []
    offered += _COMMON_ADDRESSES
    for pattern in _DEVICE_PATTERNS:
        offered += sorted(glob(pattern))
    return offered


def assignments() -> list[str]:
    return [f"{name}=" for name in parameter_names()]


def kinds() -> tuple[str, ...]:
    from aerokit.sim.kinds import kind_names

    return kind_names()


def parameter_names() -> list[str]:
    """Return the sorted parameter names of the simulated vehicles."""
    names = set()
    for table in _PARAMETER_TABLES:
        lines = files("aerokit").joinpath(f"sim/{table}.param.csv").read_text(encoding="utf-8").splitlines()
        names |= {line.partition(",")[0] for line in lines if line and not line.startswith("#")}
    return sorted(names)
