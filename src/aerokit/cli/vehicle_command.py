"""What the commands that talk to one vehicle share: where it is, how long to try, and the connection to it."""

from __future__ import annotations

import argparse
import os
import sys
from contextlib import AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING, Any

from aerokit.cli.arguments import add_baud, address, number, system_id
from aerokit.cli.completers import addresses, offer
from aerokit.cli.output import add_json
from aerokit.cli.signing import ENVIRONMENT, add_signing_key, signing_of
from aerokit.cli.waiting import waiting
from aerokit.cli.which_vehicle import check_alone
from aerokit.runtime.opening import ONLOOKER

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable

    from aerokit.links.link import Link
    from aerokit.vehicle.vehicle import Vehicle

__all__ = [
    "ADDRESS_VARIABLE",
    "CONNECT_TIMEOUT_S",
    "add_action",
    "add_place",
    "add_vehicle",
    "agreed",
    "connected",
    "default_address",
    "reached",
    "vehicle_arguments",
]

ADDRESS_VARIABLE = "AEROKIT_ADDRESS"
"""The variable with the address of the vehicle, for commands that are told none."""
USUAL_ADDRESS = "udpin:0.0.0.0:14550"
CONNECT_TIMEOUT_S = 30.0


def default_address() -> str:
    """Where the vehicle is when nobody says it: what the environment says, else the port of ground stations."""
    return os.environ.get(ADDRESS_VARIABLE, "").strip() or USUAL_ADDRESS


def add_place(
    command: argparse._ActionsContainer, name: str = "address", *, what: str = "", default: str | None = None
) -> None:
    """Add the address of vehicles, as an argument or an option, and ``--baud``.

    ``what`` is said before the forms that an address has; ``default`` says what happens without one, if that is not
    the usual address.
    """
    options: dict[str, Any] = {} if name.startswith("-") else {"nargs": "?"}
    usual = f"${ADDRESS_VARIABLE}, else {USUAL_ADDRESS}"
    place = command.add_argument(
        name,
        type=address,
        default=default_address() if default is None else None,
        metavar="ADDRESS",
        help=f"{what}udpin:0.0.0.0:14550, tcp:127.0.0.1:5760, /dev/ttyACM0,57600 … ({default or usual})",
        **options,
    )
    offer(place, addresses)
    add_baud(command)


def vehicle_arguments() -> argparse.ArgumentParser:
    """The arguments that every one of these commands takes, as a parent parser."""
    parent = argparse.ArgumentParser(add_help=False)
    add_vehicle(parent)
    parent.add_argument(
        "--source-system",
        type=system_id,
        default=ONLOOKER,
        metavar="ID",
        help=f"our own id ({ONLOOKER}: a vehicle in the air misses its ground station, 255, when it has gone;"
        " but one that is set to obey no other needs 255)",
    )
    return parent


def add_vehicle(command: argparse.ArgumentParser) -> None:
    """Add the same to a command that has them itself."""
    group = command.add_argument_group("vehicle")
    add_place(group, "--connect")
    group.add_argument("--system-id", type=system_id, metavar="ID", help="of the vehicle (the only one)")
    group.add_argument(
        "--patience",
        type=number(0.1, 3600),
        default=10.0,
        metavar="S",
        help="give up when nothing has come for so many seconds (10)",
    )
    add_signing_key(group, f"of a vehicle that wants signed messages (${ENVIRONMENT})")


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
    add_json(action)
    return action


def agreed(question: str) -> bool:
    """Whether somebody at a terminal says yes; nobody there means no."""
    return sys.stdin.isatty() and input(f"{question} [y/N] ").strip().lower() in ("y", "yes")


@asynccontextmanager
async def connected(options: argparse.Namespace, *, changes: bool = False) -> AsyncIterator[Vehicle]:
    """The vehicle that the arguments name. Nothing but heartbeats is asked of it: the link is for the transfer.

    ``changes``: something will be ordered or written, so it has to be the only one, or the one that was named.
    """
    async with reached(
        options,
        options.connect,
        changes=changes,
        source_system=options.source_system,
        rates={},
        signing=signing_of(options),
    ) as vehicle:
        yield vehicle


@asynccontextmanager
async def reached(
    options: argparse.Namespace, link: str | Link, *, changes: bool, **connecting: Any
) -> AsyncIterator[Vehicle]:
    """The vehicle on a link, with a countdown until it is heard; ``connecting`` goes to :func:`aerokit.connect`.

    ``changes``: as of :func:`connected`.
    """
    from aerokit.vehicle.connect import connect

    address = link if isinstance(link, str) else link.address
    async with AsyncExitStack() as stack:
        async with waiting(options, address, CONNECT_TIMEOUT_S):
            vehicle = await stack.enter_async_context(
                connect(
                    link,
                    system_id=options.system_id,
                    timeout=CONNECT_TIMEOUT_S,
                    baud=options.baud,
                    **connecting,
                )
            )
        if changes:
            await check_alone(vehicle, options)
        yield vehicle
