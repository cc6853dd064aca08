"""Give a vehicle a signing key over a cable. A file stores the timestamp for the next program.

    python signed_link.py /dev/ttyACM0 "a long passphrase"

Afterwards, the vehicle obeys only programs that have the key:

    async with aerokit.connect(address, signing=Signing(key, keep=STAMP)) as vehicle: ...
"""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path

import aerokit
from aerokit import Signing, SigningKey

STAMP = Path("signing-timestamp.txt")


async def main(address: str, passphrase: str, stamp: Path = STAMP) -> None:
    """Give the vehicle the key, use it, and remove it."""
    signing = Signing(SigningKey.from_passphrase(passphrase), keep=stamp)
    async with aerokit.connect(address) as vehicle:
        await vehicle.wait_ready()
        await vehicle.setup_signing(signing)  # the only message that contains the key, unencrypted
        print("the vehicle signs with", signing.key)
        await vehicle.parameters.get("MAV_SYSID")  # request and answer are signed
        print(signing.frames_refused, "frames were refused")
        await vehicle.setup_signing(None)  # leave this out to keep the key
        print("the vehicle does not sign any more")


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1], sys.argv[2]))
