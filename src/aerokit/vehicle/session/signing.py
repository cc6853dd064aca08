"""Gives a vehicle a key for signing, or takes it away: SETUP_SIGNING, which is not acknowledged."""

from __future__ import annotations

from typing import TYPE_CHECKING

import anyio

from aerokit.errors import (
    NotSupported,
    OperationRejected,
    OperationTimeout,
)
from aerokit.mavlink.messages import (
    SetupSigning,
)

if TYPE_CHECKING:
    from aerokit.mavlink.signing import Signing
    from aerokit.vehicle.session.session import Talk


SEND_AGAIN_S = 1.0
"""A heartbeat comes each second, and shows whether the key was taken."""


NO_KEY = bytes(32)


A_SECOND = 100_000
"""The vehicle begins with a time stamp that is surely not before that of the frame which brings it: going back, its
frames would be taken for replayed ones."""


async def set_up_signing(talk: Talk, signing: Signing | None, timeout: float) -> None:
    """See :meth:`aerokit.Vehicle.setup_signing`."""
    _check_vehicle(talk)
    connection, started = talk.connection, talk.connection.now()
    with connection._gate.handing_over(signing, talk.system_id, talk.component_id) as taken:
        with anyio.move_on_after(timeout):
            while not taken.is_set():
                talk.send(_message(talk, signing))
                with anyio.move_on_after(SEND_AGAIN_S):
                    await taken.wait()
                connection.raise_if_ended()
        if taken.is_set():
            return
    texts = "; ".join(talk.texts_since(started)) or "it said nothing about it"
    if talk.autopilot.keys_are_taken:
        texts += f"; {talk.autopilot.keys_are_taken}"
    wanted = "without a signature" if signing is None else f"signed with {signing.key!r}"
    raise OperationTimeout(
        f"setup_signing: no frame {wanted} came within {timeout:g} s; {texts}; {talk.describe_link()}"
    )


def _check_vehicle(talk: Talk) -> None:
    heard = talk.connection.heard.get((talk.system_id, talk.component_id))
    frame = None if heard is None else heard.received_frame
    if talk.connection.mavlink_version == 1 or (frame is not None and frame.version == 1):
        whose = "our" if talk.connection.mavlink_version == 1 else "the vehicle's"
        raise NotSupported(f"setup_signing: {whose} frames are MAVLink 1, which has no signatures")
    if not talk.telemetry.is_surely_disarmed:
        state = "armed" if talk.telemetry.is_armed else "not known to be disarmed"
        raise OperationRejected(f"setup_signing: the vehicle is {state}; nothing was sent")


def _message(talk: Talk, signing: Signing | None) -> SetupSigning:
    if signing is None:
        return SetupSigning(talk.system_id, talk.component_id, NO_KEY, 0)
    stamp = signing.timestamp_now(talk.connection.unix_time()) + A_SECOND
    return SetupSigning(talk.system_id, talk.component_id, signing.key.secret, stamp)
