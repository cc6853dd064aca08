"""Recognises an address or a file that was given in place of another argument, before anything is opened."""

from __future__ import annotations

import argparse
import re
import shlex
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

_ADDRESS_PATTERN = re.compile(
    r"(udp(in|out|bcast)?|tcp(in|out)?|serial|zenoh(in)?):.+|\d+(\.\d+){3}:\d+|/dev/(tty|cu|serial).+|com\d+([,:]\d+)?",
    re.IGNORECASE,
)
_PLAN = "`aerokit fly {}` flies it, `aerokit mission upload {}` uploads it"
_PARAMETERS = "`aerokit params load {}` sets these parameters"
_COMMANDS_BY_SUFFIX = {
    ".plan": _PLAN,
    ".waypoints": _PLAN,
    ".param": _PARAMETERS,
    ".parm": _PARAMETERS,
    ".params": _PARAMETERS,
    ".py": "`aerokit run {}` runs a DroneKit program",
}


def is_address(word: str) -> bool:
    return _ADDRESS_PATTERN.fullmatch(word) is not None


def misplaced_file(word: str) -> str | None:
    """Return an error text if a file was given in place of an address; otherwise None.

    A name with a known suffix, such as .plan, counts as a file even if no such file exists. The text then names the
    command for this type of file.
    """
    path = Path(word)
    suffix = path.suffix.lower()
    advice = _COMMANDS_BY_SUFFIX.get(suffix)
    is_other_file = path.is_file() and suffix != ".tlog"  # a recording (.tlog) is a valid address
    if advice is None and not is_other_file:
        return None
    text = f"{word!r} is a file; an address is expected, such as udpin:0.0.0.0:14550"
    return text if advice is None else f"{text}. {advice.replace('{}', shlex.quote(word))}"


def misplaced_address(parser: argparse.ArgumentParser, words: Sequence[str]) -> str | None:
    """Return an error text with the right command line if an address is in the wrong place; else None."""
    words = list(words[: words.index("--")] if "--" in words else words)  # after --, every word is a value
    command = parser.prog.split()
    if parser._subparsers is not None:
        return _address_before_action(parser, words) if words and is_address(words[0]) else None
    takes_connect = "--connect" in parser._option_string_actions
    has_address_argument = any("address" in action.dest or action.dest == "endpoints" for action in parser._actions)
    if has_address_argument and not takes_connect:
        return _superfluous_connect(parser, words)
    takes_vehicle_paths = "files" in command
    for index, word in enumerate(words):
        # A path on the vehicle may begin with /dev, like the address of a serial port.
        is_path = takes_vehicle_paths and word.startswith("/")
        is_option_value = index > 0 and _takes_value(parser, words[index - 1])
        if is_path or not is_address(word) or is_option_value:
            continue
        if not takes_connect:
            return f"`{parser.prog}` takes no address; to record a link: aerokit record {shlex.quote(word)} flight.tlog"
        if any(argument.startswith("--connect") for argument in words):
            return f"{word!r} is a second address, besides --connect"
        other_words = (words[:index] + words[index + 1 :]) or _required_arguments(parser)
        line = shlex.join([*command, *other_words, "--connect", word])
        return f"{word!r} is an address, which needs --connect: {line}"
    return None


def _superfluous_connect(parser: argparse.ArgumentParser, words: list[str]) -> str | None:
    """Return an error text if --connect is given to a command that takes the address without it."""
    if not any(word.partition("=")[0] == "--connect" for word in words):
        return None
    other_words = [word.removeprefix("--connect=") for word in words if word != "--connect"]
    line = shlex.join([*parser.prog.split(), *other_words])
    return f"`{parser.prog}` takes the address without --connect: {line}"


def _address_before_action(parser: argparse.ArgumentParser, words: list[str]) -> str:
    """Return the error text for words such as ``aerokit params udpin:… list``."""
    address, *after_address = words
    action, *arguments = after_address or ["ACTION"]
    actions = next(item.choices for item in parser._actions if isinstance(item, argparse._SubParsersAction))
    # An unknown or missing action is treated like the first one.
    action_parser = actions.get(action) or next(iter(actions.values()))
    takes_connect = "--connect" in action_parser._option_string_actions
    address_words = ["--connect", address] if takes_connect else [address]
    line = shlex.join([*parser.prog.split(), action, *address_words, *arguments])
    return f"{address!r} is an address; put it after the action: {line}"


def _takes_value(parser: argparse.ArgumentParser, option: str) -> bool:
    # The option may be abbreviated.
    actions = (action for name, action in parser._option_string_actions.items() if name.startswith(option))
    return option.startswith("--") and any(action.nargs != 0 for action in actions)


def _required_arguments(parser: argparse.ArgumentParser) -> list[str]:
    positional = (action for action in parser._actions if not action.option_strings)
    return [str(action.metavar or action.dest).upper() for action in positional if action.nargs not in ("?", "*")]
