"""``aerokit hub``: several links joined into one MAVLink network."""

from __future__ import annotations

import argparse
import asyncio
import re
from typing import TYPE_CHECKING

import anyio

from aerokit.apps.cli.arguments import add_baud, add_number, add_record, add_repeatable, address
from aerokit.apps.cli.completion import addresses, set_completions
from aerokit.apps.cli.connecting import SIGNING_KEY_VARIABLE, add_signing_key, signing_of
from aerokit.apps.cli.output import DONE, INTERRUPTED, add_json, can_print, emit, new_recording, suggestion
from aerokit.apps.cli.terminal import on_interrupt
from aerokit.errors import InvalidArgument

if TYPE_CHECKING:
    from collections.abc import Sequence

    from aerokit.hub import Endpoint, EndpointStatistics, Hub, HubEvent

_NAMED_ADDRESS = re.compile(r"([A-Za-z][\w-]*)=(.+)", re.DOTALL)
_FILTER_EXAMPLE = "'GPS_*,HEARTBEAT@NAME'"


def add_arguments(command: argparse.ArgumentParser) -> None:
    command.set_defaults(run=_hub)
    endpoints = command.add_argument(
        "endpoints",
        nargs="+",
        type=_named_address,
        metavar="[NAME=]ADDRESS",
        help="tcpin:0.0.0.0:5760, udpout:10.0.0.7:14550, radio=/dev/ttyUSB0,57600 …; options refer to an endpoint by"
        " NAME, or by ADDRESS as written",
    )
    set_completions(endpoints, addresses)
    add_repeatable(command, "--read-only", "NAME", "do not forward messages received there, heartbeats included")
    add_repeatable(command, "--patient", "NAME", "if it cannot be opened, start without it and keep trying")
    only = f"send only these messages, to one endpoint or, without @NAME, to each: {_FILTER_EXAMPLE}"
    block = f"do not send these messages: {_FILTER_EXAMPLE}"
    rate = "limit messages to a rate in Hz, for each sender: 'ATTITUDE=5@NAME'"
    add_repeatable(command, "--only", "FILTER", only, type=_parse_filter)
    add_repeatable(command, "--block", "FILTER", block, type=_parse_filter)
    add_repeatable(command, "--rate", "FILTER", rate, type=_parse_rates)
    add_repeatable(command, "--signed", "NAME", "sign what is sent there, and accept only signed messages")
    add_signing_key(command, f"key for --signed (${SIGNING_KEY_VARIABLE})")
    add_baud(command)
    add_record(command)
    add_number(command, "--every", 0.1, 1e6, "S", "seconds between statistics", default=10.0)
    add_number(command, "--seconds", 0.1, 1e6, "S", "stop after S seconds")
    add_json(command)


def _named_address(text: str) -> tuple[str, str]:
    """Parse ``[NAME=]ADDRESS`` into the name of an endpoint and its address."""
    match = _NAMED_ADDRESS.fullmatch(text)
    name, endpoint_address = (text, text) if match is None else match.groups()
    return name, address(endpoint_address)


def _parse_filter(text: str) -> tuple[str, tuple[str, ...]]:
    """Parse ``MESSAGE,…[@ENDPOINT]`` into the endpoint's name and the patterns of message names.

    Without ``@ENDPOINT``, which means all endpoints, the name is "".
    """
    names, separator, endpoint = text.partition("@")
    patterns = tuple(name.strip() for name in names.split(",") if name.strip())
    if not patterns:
        raise argparse.ArgumentTypeError(f"{text!r} has no message name; expected {_FILTER_EXAMPLE}")
    if separator and not endpoint:
        raise argparse.ArgumentTypeError(f"{text!r} has no endpoint after the @; expected {_FILTER_EXAMPLE}")
    return endpoint, patterns


def _parse_rates(text: str) -> tuple[str, dict[str, float]]:
    """Parse ``MESSAGE=HZ,…[@ENDPOINT]`` into the endpoint ("" for all) and the rate of each message."""
    endpoint, rate_texts = _parse_filter(text)
    rates = {}
    for rate_text in rate_texts:
        name, _, hz = rate_text.partition("=")
        try:
            rates[name] = float(hz)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{rate_text!r} is not a rate; expected ATTITUDE=5 (in Hz)") from None
    return endpoint, rates


async def _hub(options: argparse.Namespace) -> int:
    from aerokit.hub import Hub

    endpoints = _endpoints(options)
    stop = asyncio.Event()
    hub = Hub(endpoints)
    hub.on_event(lambda event: _emit_hub_event(options, event) if can_print() else None)
    with on_interrupt(stop.set), new_recording(options.record):
        async with hub:
            if options.record is not None:
                hub.record(options.record)
            record = {"endpoints": [endpoint.address for endpoint in hub.endpoints], "file": options.record}
            how_long = "until Ctrl-C" if options.seconds is None else f"for {options.seconds:g} s"
            text = f"{len(endpoints)} endpoint{'s' if len(endpoints) > 1 else ''}, {how_long}"
            emit(options, "hub", record, text)
            with anyio.move_on_after(options.seconds):
                while not stop.is_set():
                    with anyio.move_on_after(options.every):
                        await stop.wait()
                    if not stop.is_set() and can_print():
                        _emit_statistics(options, hub)
            _emit_statistics(options, hub)  # totals since the start
    # Without --seconds, Ctrl-C is the normal end of the command.
    return INTERRUPTED if stop.is_set() and options.seconds is not None else DONE


def _endpoints(options: argparse.Namespace) -> list[Endpoint]:
    from aerokit.hub import Endpoint

    names = [name for name, _ in options.endpoints]
    filter_names = [name for name, _ in (*options.only, *options.block, *options.rate) if name]  # "" means all
    for name in (*options.read_only, *options.patient, *options.signed, *filter_names):
        if name not in names:
            hint = suggestion(name, names)
            raise InvalidArgument(f"no endpoint is named {name!r}{hint}; endpoints: {', '.join(names)}")
    if options.signed and signing_of(options) is None:
        raise InvalidArgument(f"--signed needs a key: give --signing-key FILE, or set ${SIGNING_KEY_VARIABLE}")
    return [
        Endpoint(
            endpoint_address,
            name=name,
            only=_patterns_for(name, options.only),
            block=_patterns_for(name, options.block),
            rates=_rates_for(name, options.rate),
            read_only=name in options.read_only,
            signing=signing_of(options) if name in options.signed else None,
            baud=options.baud,
            retry_open=name in options.patient,
        )
        for name, endpoint_address in options.endpoints
    ]


def _patterns_for(name: str, filters: Sequence[tuple[str, tuple[str, ...]]]) -> tuple[str, ...]:
    return tuple(pattern for endpoint, patterns in filters if endpoint in ("", name) for pattern in patterns)


def _rates_for(name: str, filters: Sequence[tuple[str, dict[str, float]]]) -> dict[str, float]:
    return {message: hz for endpoint, rates in filters if endpoint in ("", name) for message, hz in rates.items()}


def _emit_hub_event(options: argparse.Namespace, event: HubEvent) -> None:
    record = {"endpoint": event.endpoint, "kind": event.kind, "text": event.text}
    emit(options, "hub_event", record, f"{event.endpoint}: {event.text}")


def _emit_statistics(options: argparse.Namespace, hub: Hub) -> None:
    for endpoint in hub.endpoints:
        emit(options, "endpoint", endpoint.to_dict(), _statistics_line(endpoint))


def _statistics_line(endpoint: EndpointStatistics) -> str:
    systems = ", ".join(f"{system}/{component}" for system, component in endpoint.systems) or "none"
    text = (
        f"{endpoint.name}: {endpoint.frames_in} frames in, {endpoint.frames_out} out, {endpoint.lost} lost;"
        f" systems {systems}"
    )
    if not endpoint.is_open:
        text += "; not connected"
    dropped = (f"; {reason.replace('_', ' ')} {count}" for reason, count in endpoint.dropped.items())
    return text + "".join(dropped)
