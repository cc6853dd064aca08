"""The key for signing: from a file or the environment, never from the command line, which others can read."""

from __future__ import annotations

import os
from argparse import ArgumentTypeError
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import argparse

    from aerokit.mavlink.signing import Signing, SigningKey

__all__ = ["ENVIRONMENT", "add_signing_key", "key_file", "signing_of"]

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
