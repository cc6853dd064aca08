"""``aerokit hub``: several links joined into one MAVLink network, until Ctrl-C."""

from __future__ import annotations

import argparse
import asyncio
import re
from typing import TYPE_CHECKING

import anyio

from aerokit._internal.wording import did_you_mean
from aerokit.apps.cli.arguments import add_baud, address, number, writable_file
from aerokit.apps.cli.completers import addresses, offer
from aerokit.apps.cli.output import DONE, INTERRUPTED, add_json, make_new_recording, remove_if_empty, tell
from aerokit.apps.cli.terminal import on_interrupt
from aerokit.apps.cli.vehicle_command import ENVIRONMENT, add_signing_key, signing_of
from aerokit.errors import InvalidArgument

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from aerokit.hub import Endpoint, EndpointStatistics, Hub, HubEvent

_NAMED = re.compile(r"([A-Za-z][\w-]*)=(.+)", re.DOTALL)
_FILTER = "'GPS_*,HEARTBEAT@NAME'"


def add_arguments(command: argparse.ArgumentParser) -> None:
    """The arguments of the command."""
    command.set_defaults(run=_hub)
    place = command.add_argument(
        "places",
        nargs="+",
        type=_place,
        metavar="[NAME=]ADDRESS",
        help="tcpin:0.0.0.0:5760, udpout:10.0.0.7:14550, radio=/dev/ttyUSB0,57600 …; options find it by its NAME,"
        " or by the address as it is written",
    )
    offer(place, addresses)
    _add_names(command, "--read-only", "what comes from there is not passed on, not even heartbeats")
    _add_names(command, "--patient", "begin without it when it cannot be opened, and go on trying")
    only = f"only these messages go out, at one endpoint or, without @NAME, at all: {_FILTER}"
    _add_filter(command, "--only", _messages, only)
    _add_filter(command, "--block", _messages, f"these messages do not go out: {_FILTER}")
    _add_filter(
        command,
        "--rate",
        _rate,
        "these go out so many times a second at most, of each sender: 'ATTITUDE=5@NAME'",
    )
    _add_names(command, "--signed", "sign what goes out there, and let in only what is signed")
    add_signing_key(command, f"for --signed (${ENVIRONMENT})")
    add_baud(command, "serial ports whose address says none")
    command.add_argument(
        "--record",
        type=_log_file,
        metavar="FILE",
        help="write every frame once, to a new file: flight.tlog",
    )
    command.add_argument(
        "--every", type=number(0.1, 1e6), default=10.0, metavar="S", help="seconds between statistics (10)"
    )
    command.add_argument("--seconds", type=number(0.1, 1e6), metavar="S", help="end after so many seconds")
    add_json(command)


def _add_names(command: argparse.ArgumentParser, option: str, text: str) -> None:
    command.add_argument(option, action="append", default=[], metavar="NAME", help=f"{text} (repeatable)")


def _add_filter(
    command: argparse.ArgumentParser, option: str, read: Callable[[str], object], text: str
) -> None:
    command.add_argument(
        option, action="append", default=[], type=read, metavar="FILTER", help=f"{text} (repeatable)"
    )


def _place(text: str) -> tuple[str, str]:
    """Name and address."""
    named = _NAMED.fullmatch(text)
    return (named[1], address(named[2])) if named else (text, address(text))


def _messages(text: str) -> tuple[str, tuple[str, ...]]:
    """For which endpoint ("": all), and names of messages."""
    names, at, endpoint = text.partition("@")
    found = tuple(each.strip() for each in names.split(",") if each.strip())
    if not found:
        raise argparse.ArgumentTypeError(f"{text!r} names no message: {_FILTER}")
    if at and not endpoint:
        raise argparse.ArgumentTypeError(f"{text!r} names no endpoint behind the @: {_FILTER}")
    return endpoint, found


def _rate(text: str) -> tuple[str, dict[str, float]]:
    """For which endpoint ("": all), and the rate of each message."""
    endpoint, parts = _messages(text)
    rates = {}
    for part in parts:
        name, _, hz = part.partition("=")
        try:
            rates[name] = float(hz)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{part!r} is no rate: ATTITUDE=5") from None
    return endpoint, rates


def _log_file(text: str) -> str:
    if not text.lower().endswith(".tlog"):
        raise argparse.ArgumentTypeError(f"{text!r} does not end in .tlog")
    return writable_file(text)


async def _hub(options: argparse.Namespace) -> int:
    from aerokit.hub import Hub

    endpoints = _endpoints(options)
    stop = asyncio.Event()
    hub = Hub(endpoints)
    hub.on_event(lambda event: _tell_event(options, event))
    with on_interrupt(stop.set):
        async with hub:
            if options.record is not None:
                make_new_recording(options.record)
                hub.record(options.record)
            record = {"endpoints": [each.address for each in hub.endpoints], "file": options.record}
            tell(
                options,
                "hub",
                record,
                f"{len(endpoints)} endpoint{'s' if len(endpoints) > 1 else ''}, {_how_long(options)}",
            )
            with anyio.move_on_after(options.seconds):
                while not stop.is_set():
                    with anyio.move_on_after(options.every):
                        await stop.wait()
                    if not stop.is_set():
                        _tell_statistics(options, hub)
            _tell_statistics(options, hub)
        if options.record is not None:
            remove_if_empty(options.record)
    return INTERRUPTED if stop.is_set() and options.seconds is not None else DONE


def _how_long(options: argparse.Namespace) -> str:
    return "until Ctrl-C" if options.seconds is None else f"for {options.seconds:g} s"


def _endpoints(options: argparse.Namespace) -> list[Endpoint]:
    from aerokit.hub import Endpoint

    names = [name for name, _ in options.places]
    for option in ("read_only", "patient", "signed"):
        for name in getattr(options, option):
            _check_known(name, names)
    for name in (name for option in ("only", "block", "rate") for name, _ in getattr(options, option)):
        if name:
            _check_known(name, names)
    if options.signed and signing_of(options) is None:
        raise InvalidArgument(f"--signed needs a key: --signing-key FILE or ${ENVIRONMENT}")
    return [
        Endpoint(
            place,
            name=name,
            only=_for(name, options.only),
            block=_for(name, options.block),
            rates={
                key: hz for where, rates in options.rate if where in ("", name) for key, hz in rates.items()
            },
            read_only=name in options.read_only,
            signing=signing_of(options) if name in options.signed else None,
            baud=options.baud,
            patient=name in options.patient,
        )
        for name, place in options.places
    ]


def _for(name: str, filters: Sequence[tuple[str, tuple[str, ...]]]) -> tuple[str, ...]:
    return tuple(pattern for where, patterns in filters if where in ("", name) for pattern in patterns)


def _check_known(name: str, names: list[str]) -> None:
    if name not in names:
        raise InvalidArgument(
            f"there is no endpoint {name!r}{did_you_mean(name, names)}; there are: {', '.join(names)}"
        )


def _tell_event(options: argparse.Namespace, event: HubEvent) -> None:
    record = {"endpoint": event.endpoint, "kind": event.kind, "text": event.text}
    tell(options, "hub_event", record, f"{event.endpoint}: {event.text}")


def _tell_statistics(options: argparse.Namespace, hub: Hub) -> None:
    for each in hub.endpoints:
        tell(options, "endpoint", each.to_dict(), _line(each))


def _line(each: EndpointStatistics) -> str:
    systems = ", ".join(f"{system}/{component}" for system, component in each.systems) or "nobody"
    text = (
        f"{each.name}: {each.frames_in} frames in, {each.frames_out} out, {each.lost} lost; heard {systems}"
    )
    if not each.is_open:
        text += "; away"
    return text + "".join(f"; {reason.replace('_', ' ')} {count}" for reason, count in each.dropped.items())
