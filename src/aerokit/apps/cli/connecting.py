"""Options and connections shared by commands that use a vehicle or a whole link."""

from __future__ import annotations

import argparse
import asyncio
import os
from argparse import ArgumentTypeError
from contextlib import AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING, Any

import anyio

from aerokit.apps.cli.arguments import add_baud, add_number, add_system_id, address, number, system_id
from aerokit.apps.cli.completion import addresses, set_completions
from aerokit.apps.cli.output import DONE, FAILED, add_json, emit
from aerokit.apps.cli.terminal import confirm, is_interactive, on_interrupt, showing_countdown
from aerokit.connection.opening import OBSERVER_SYSTEM_ID, explain_no_vehicle, open_connection
from aerokit.errors import ConnectFailed, InvalidArgument

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable
    from contextlib import AbstractAsyncContextManager

    from aerokit.connection.connection import Connection
    from aerokit.mavlink.signing import Signing, SigningKey
    from aerokit.transport.link import Link
    from aerokit.vehicle.vehicle import Vehicle

# How long to listen for other vehicles: long enough for their heartbeats, which they send once a second.
_OTHER_VEHICLES_TIMEOUT_S = 1.5
SIGNING_KEY_VARIABLE = "AEROKIT_SIGNING_KEY"
"""Name of the environment variable that contains the signing key: a passphrase, or 64 hexadecimal digits."""
ADDRESS_VARIABLE = "AEROKIT_ADDRESS"
"""Name of the environment variable that contains the default address."""
_DEFAULT_ADDRESS = "udpin:0.0.0.0:14550"
_CONNECT_TIMEOUT_S = 30.0


async def _check_only_vehicle(vehicle: Vehicle, options: argparse.Namespace) -> None:
    """Raise InvalidArgument if several vehicles are on the link.

    Nothing is checked if the user chose one with ``--system-id``.
    """
    if options.system_id is not None:
        return
    system_ids = {vehicle.system_id}
    with anyio.move_on_after(_OTHER_VEHICLES_TIMEOUT_S):
        async for discovery in vehicle.connection.vehicles():
            system_ids.add(discovery.system_id)
            if len(system_ids) > 1:
                listed = ", ".join(map(str, sorted(system_ids)))
                raise InvalidArgument(
                    f"several vehicles are on the link (system ids {listed}): choose one with --system-id;"
                    " nothing was sent"
                )


def add_signing_key(command: argparse._ActionsContainer, text: str) -> None:
    command.add_argument(
        "--signing-key",
        type=key_file,
        metavar="FILE",
        help=f"{text}: file with a passphrase, or with the key as 64 hexadecimal digits",
    )


def key_file(path: str) -> SigningKey:
    from aerokit.mavlink.signing import SigningKey

    try:
        with open(path, encoding="utf-8-sig") as file:
            return SigningKey.from_text(file.read())
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not a text file"
        raise ArgumentTypeError(f"cannot read a signing key from {path!r}: {reason}") from None
    except InvalidArgument as error:
        raise ArgumentTypeError(f"{path!r} has no signing key: {error}") from None


def signing_of(options: argparse.Namespace) -> Signing | None:
    """Return the signing for a connection, or None without a key.

    The key is that of ``--signing-key`` or of the environment variable.
    """
    key: SigningKey | None = options.signing_key
    text = os.environ.get(SIGNING_KEY_VARIABLE, "")
    if key is None and not text.strip():
        return None
    from aerokit.mavlink.signing import Signing, SigningKey

    return Signing(SigningKey.from_text(text) if key is None else key)


def default_address() -> str:
    return os.environ.get(ADDRESS_VARIABLE, "").strip() or _DEFAULT_ADDRESS


def add_address(
    command: argparse._ActionsContainer, name: str = "address", *, what: str = "", default_text: str | None = None
) -> None:
    """Add an argument or option for the address of a link, and ``--baud``.

    ``name`` has leading dashes if the address is an option. The help text begins with ``what``. It ends with
    ``default_text``, which says what the command does without an address. If ``default_text`` is None, the command uses
    the default address.
    """
    keywords: dict[str, Any] = {} if name.startswith("-") else {"nargs": "?"}
    if default_text is None:
        default = default_address()
        default_text = f"${ADDRESS_VARIABLE}, or {_DEFAULT_ADDRESS}"
    else:
        default = None
    argument = command.add_argument(
        name,
        type=address,
        default=default,
        metavar="ADDRESS",
        help=f"{what}udpin:0.0.0.0:14550, tcp:127.0.0.1:5760, /dev/ttyACM0,57600 … (default: {default_text})",
        **keywords,
    )
    set_completions(argument, addresses)
    add_baud(command)


def _vehicle_parser() -> argparse.ArgumentParser:
    parent = argparse.ArgumentParser(add_help=False)
    add_vehicle(parent)
    parent.add_argument(
        "--source-system",
        type=system_id,
        default=OBSERVER_SYSTEM_ID,
        metavar="ID",
        help=f"system id of this program ({OBSERVER_SYSTEM_ID}; with 255, a flying vehicle starts its GCS failsafe"
        " when the command ends, but vehicles that accept commands from one ground station only may require it)",
    )
    return parent


def add_vehicle(command: argparse.ArgumentParser) -> None:
    group = command.add_argument_group("vehicle")
    add_address(group, "--connect")
    add_system_id(group)
    add_number(group, "--patience", 0.1, 3600, "S", "time out after S seconds without progress", default=10.0)
    add_signing_key(group, f"signing key of the vehicle (${SIGNING_KEY_VARIABLE})")


def add_action(
    actions: argparse._SubParsersAction[argparse.ArgumentParser],
    name: str,
    run: Callable[[argparse.Namespace], Awaitable[int | None]],
    text: str,
    *,
    connects: bool = True,
) -> argparse.ArgumentParser:
    """Add the action ``name`` to a command. With ``connects``, include the options for a connection to a vehicle."""
    parents = [_vehicle_parser()] if connects else []
    summary = text[0].lower() + text[1:].partition(". ")[0].rstrip(".")
    action = actions.add_parser(name, help=summary, description=text, parents=parents)
    action.set_defaults(run=run)
    add_json(action)
    return action


def command_action(
    name: str,
    text: str,
    action: Callable[[Any, argparse.Namespace], Awaitable[object]],
    open_target: Callable[[argparse.Namespace], AbstractAsyncContextManager[Any]] | None = None,
    *,
    question: str = "",
) -> Callable[[argparse.Namespace], Awaitable[int]]:
    """Return the ``run`` function of a command that performs one action and then prints one line.

    The line is ``text``, or with ``--json`` a ``done`` record with ``name``. In ``text`` and ``name``, the name of an
    option in braces is replaced by the option's value. ``action`` is called with a target and the options; the target
    is the vehicle, or what ``open_target`` yields. With a ``question``, the command asks the user for confirmation
    before it connects; the caller adds its option ``--yes``, which answers the question.
    """

    async def run(options: argparse.Namespace) -> int:
        done, record = text.format(**vars(options)), {"action": name.format(**vars(options))}
        is_confirmed = not question or options.yes or (is_interactive() and await confirm(question))
        if not is_confirmed:
            emit(options, "declined", record, f"not confirmed; nothing was {done}")
            return FAILED
        opening = connected(options, changes_vehicle=True) if open_target is None else open_target(options)
        async with opening as target:
            await action(target, options)
        emit(options, "done", record, done)
        return DONE

    return run


@asynccontextmanager
async def connected(options: argparse.Namespace, *, changes_vehicle: bool = False) -> AsyncIterator[Vehicle]:
    """Connect to the vehicle that the options name, without requesting message rates.

    With ``changes_vehicle``, the command changes something on the vehicle. If several vehicles are on the link, the
    user must then choose one with ``--system-id``.
    """
    async with connect_to(
        options,
        options.connect,
        changes_vehicle=changes_vehicle,
        source_system=options.source_system,
        rates={},
        signing=signing_of(options),
    ) as vehicle:
        yield vehicle


@asynccontextmanager
async def connect_to(
    options: argparse.Namespace, link: str | Link, *, changes_vehicle: bool, **connecting: Any
) -> AsyncIterator[Vehicle]:
    """Connect to the vehicle on a link, and show a countdown while waiting.

    ``changes_vehicle`` is as in :func:`connected`. Other arguments are passed to :func:`aerokit.connect`.
    """
    from aerokit.vehicle.connect import connect

    address = link if isinstance(link, str) else link.address
    async with AsyncExitStack() as stack:
        async with showing_countdown(options, address, _CONNECT_TIMEOUT_S):
            vehicle = await stack.enter_async_context(
                connect(link, system_id=options.system_id, timeout=_CONNECT_TIMEOUT_S, baud=options.baud, **connecting)
            )
        if changes_vehicle:
            await _check_only_vehicle(vehicle, options)
        yield vehicle


def add_link(command: argparse.ArgumentParser, *, default_text: str | None = None) -> None:
    add_address(command, default_text=default_text)
    add_signing_key(command, f"signing key of the vehicles (${SIGNING_KEY_VARIABLE})")
    add_json(command)


def add_seconds(command: argparse.ArgumentParser, text: str, default: float | None = None) -> None:
    command.add_argument("--seconds", type=number(0.1, 1e6), default=default, metavar="S", help=text)


@asynccontextmanager
async def opened(options: argparse.Namespace, *, reconnect: bool = False) -> AsyncIterator[Connection]:
    """Open a connection that sends only heartbeats.

    With ``reconnect``, a lost link is opened again.
    """
    # In tests, the address may be a `Link`, which cannot reconnect because it can be opened only once.
    link: str | Link = options.address
    async with open_connection(
        link,
        baud=options.baud,
        signing=signing_of(options),
        source_system=OBSERVER_SYSTEM_ID,
        reconnect=reconnect and isinstance(link, str),
    ) as connection:
        yield connection


async def await_vehicle(connection: Connection, options: argparse.Namespace, patience_s: float) -> None:
    """Wait for the first heartbeat of an autopilot.

    Raises ConnectFailed if there is none within ``patience_s``. The text describes what was received instead.
    """
    async with showing_countdown(options, connection.link.address, patience_s):
        with anyio.move_on_after(patience_s):
            async for _ in connection.vehicles():
                return
    raise ConnectFailed(
        f"no autopilot heartbeat on {connection.link.address} within {patience_s:g} s:"
        f" {explain_no_vehicle(connection, wanted_system=None)}{_simulator_hint(connection)}"
    )


def _simulator_hint(connection: Connection) -> str:
    link_address = connection.link.address.replace("0.0.0.0", "127.0.0.1")
    has_received_bytes = any(peer.bytes for peer in connection.statistics())
    if not link_address.startswith("udpin:127.0.0.1:") or has_received_bytes:
        return ""
    return f" (to simulate one, in another terminal: aerokit sim {link_address.replace('udpin', 'udpout')})"


async def await_end(connection: Connection, seconds: float | None, work: asyncio.Task[None] | None = None) -> bool:
    """Wait for Ctrl-C, for the time to pass, or for ``work`` to end.

    Returns True after Ctrl-C. Raises the connection's error if the connection ends first.
    """
    ended = asyncio.Event()
    interrupted = False

    def interrupt() -> None:
        nonlocal interrupted
        interrupted = True
        ended.set()

    detach = connection.on_end(lambda _: ended.set())
    if work is not None:
        work.add_done_callback(lambda _: ended.set())
    try:
        with on_interrupt(interrupt), anyio.move_on_after(seconds):
            await ended.wait()
    finally:
        detach()
    if not interrupted:
        connection.raise_if_ended()
    return interrupted
