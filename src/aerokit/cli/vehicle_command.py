"""What the commands that talk to one vehicle share: where it is, how long to try, and the connection to it."""

from __future__ import annotations

import argparse
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

from aerokit.cli.arguments import address, number, system_id
from aerokit.cli.signing import ENVIRONMENT, add_signing_key, signing_of

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable

    from aerokit.vehicle.vehicle import Vehicle

__all__ = ["add_action", "connected", "vehicle_arguments"]

DEFAULT_ADDRESS = "udpin:0.0.0.0:14550"


def vehicle_arguments() -> argparse.ArgumentParser:
    """The arguments that every one of these commands takes, as a parent parser."""
    parent = argparse.ArgumentParser(add_help=False)
    group = parent.add_argument_group("vehicle")
    group.add_argument(
        "--connect",
        type=address,
        default=DEFAULT_ADDRESS,
        metavar="ADDRESS",
        help=f"udpin:0.0.0.0:14550, tcp:127.0.0.1:5760, /dev/ttyACM0,57600 … ({DEFAULT_ADDRESS})",
    )
    group.add_argument("--system-id", type=system_id, metavar="ID", help="of the vehicle (the first heard)")
    group.add_argument(
        "--baud", type=int, default=57600, help="of a serial port whose address says none (57600)"
    )
    group.add_argument(
        "--patience",
        type=number(0.1, 3600),
        default=10.0,
        metavar="S",
        help="give up when nothing has come for so many seconds (10)",
    )
    add_signing_key(group, f"of a vehicle that wants signed messages (${ENVIRONMENT})")
    return parent


def add_action(
    actions: argparse._SubParsersAction[argparse.ArgumentParser],
    name: str,
    run: Callable[[argparse.Namespace], Awaitable[int]],
    text: str,
    *,
    talks: bool = True,
) -> argparse.ArgumentParser:
    """Add ``aerokit COMMAND name``; ``talks`` says whether it needs a vehicle."""
    parents = [vehicle_arguments()] if talks else []
    summary = text[0].lower() + text[1:].partition(". ")[0].rstrip(".")
    action = actions.add_parser(name, help=summary, description=text, parents=parents)
    action.set_defaults(run=run)
    return action


@asynccontextmanager
async def connected(options: argparse.Namespace) -> AsyncIterator[Vehicle]:
    """The vehicle that the arguments name. Nothing but heartbeats is asked of it: the link is for the transfer."""
    from aerokit.vehicle.connect import connect

    async with connect(
        options.connect,
        system_id=options.system_id,
        baud=options.baud,
        rates={},
        signing=signing_of(options),
    ) as vehicle:
        yield vehicle
