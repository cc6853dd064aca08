"""What the commands that talk to one vehicle share: where it is, how long to try, and the connection to it."""

from __future__ import annotations

import argparse
import os
import sys
from argparse import ArgumentTypeError
from contextlib import AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING, Any

import anyio

from aerokit.apps.cli.arguments import add_baud, address, number, system_id
from aerokit.apps.cli.completers import addresses, offer
from aerokit.apps.cli.output import add_json
from aerokit.apps.cli.terminal import waiting
from aerokit.connection.opening import ONLOOKER
from aerokit.errors import InvalidArgument

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable

    from aerokit.mavlink.signing import Signing, SigningKey
    from aerokit.transport.link import Link
    from aerokit.vehicle.vehicle import Vehicle

LISTEN_S = 1.5
"""HEARTBEAT comes once a second."""


async def check_alone(vehicle: Vehicle, options: argparse.Namespace) -> None:
    """Unless ``--system-id`` says which vehicle is meant, listen whether there are others.

    Raises:
        InvalidArgument: there are.
    """
    if options.system_id is not None:
        return
    heard = {vehicle.system_id}
    with anyio.move_on_after(LISTEN_S):
        async for found in vehicle.connection.vehicles():
            heard.add(found.system_id)
            if len(heard) > 1:
                numbers = ", ".join(map(str, sorted(heard)))
                raise InvalidArgument(
                    f"several vehicles were heard ({numbers}): say which by --system-id; nothing was sent"
                )


ENVIRONMENT = "AEROKIT_SIGNING_KEY"
"""The variable with the key, for commands that talk to a vehicle: a passphrase, or 64 hexadecimal digits."""


def add_signing_key(command: argparse._ActionsContainer, text: str) -> None:
    """Add ``--signing-key FILE``; ``text`` says what the key is for."""
    command.add_argument(
        "--signing-key",
        type=key_file,
        metavar="FILE",
        help=f"{text}: a file with a passphrase, or with the key as 64 hexadecimal digits",
    )


def key_file(path: str) -> SigningKey:
    """The key that a file holds."""
    from aerokit.errors import InvalidArgument
    from aerokit.mavlink.signing import SigningKey

    try:
        with open(path, encoding="utf-8-sig") as file:
            return SigningKey.from_text(file.read())
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "it is no text"
        raise ArgumentTypeError(f"cannot read a signing key from {path!r}: {why}") from None
    except InvalidArgument as error:
        raise ArgumentTypeError(f"{path!r} has no signing key: {error}") from None


def signing_of(options: argparse.Namespace) -> Signing | None:
    """What a connection to a vehicle signs with: the option's key, else the environment's, else nothing."""
    key, text = options.signing_key, os.environ.get(ENVIRONMENT, "")
    if key is None and not text.strip():
        return None
    from aerokit.mavlink.signing import Signing, SigningKey

    return Signing(SigningKey.from_text(text) if key is None else key)


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
