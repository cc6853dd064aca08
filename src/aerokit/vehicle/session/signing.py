"""Installs or removes a signing key on a vehicle by SETUP_SIGNING, which is not acknowledged."""

from __future__ import annotations

from typing import TYPE_CHECKING

import anyio

from aerokit.errors import (
    NotSupported,
    OperationTimeout,
)
from aerokit.mavlink.messages import (
    SetupSigning,
)

if TYPE_CHECKING:
    from aerokit.mavlink.signing import Signing
    from aerokit.vehicle.session.session import VehicleSession


# The retry interval is that of HEARTBEAT, whose signature shows whether the key was accepted.
RETRY_INTERVAL_S = 1.0


NO_KEY = bytes(32)


# The vehicle's initial timestamp must not be older than the frame that sets it, or its frames would be
# rejected as replayed.
TIMESTAMP_TICKS_PER_S = 100_000


async def set_up_signing(session: VehicleSession, signing: Signing | None, timeout: float) -> None:
    """Implement :meth:`aerokit.Vehicle.setup_signing`."""
    _check_vehicle(session)
    connection, started = session.connection, session.connection.now()
    with connection._gate.key_handover(signing, session.system_id, session.component_id) as taken:
        with anyio.move_on_after(timeout):
            while not taken.is_set():
                session.send(_message(session, signing))
                with anyio.move_on_after(RETRY_INTERVAL_S):
                    await taken.wait()
                connection.raise_if_ended()
        if taken.is_set():
            return
    texts = "; ".join(session.texts_since(started)) or "no status text about it"
    if session.autopilot.signing_key_restriction:
        texts += f"; {session.autopilot.signing_key_restriction}"
    wanted = "without a signature" if signing is None else f"signed with {signing.key!r}"
    raise OperationTimeout(
        f"setup_signing: no frame {wanted} arrived within {timeout:g} s; {texts}; {session.describe_link()}"
    )


def _check_vehicle(session: VehicleSession) -> None:
    heartbeat = session.connection.heartbeats.get((session.system_id, session.component_id))
    frame = None if heartbeat is None else heartbeat.received_frame
    if session.connection.mavlink_version == 1 or (frame is not None and frame.version == 1):
        whose = "our" if session.connection.mavlink_version == 1 else "the vehicle's"
        raise NotSupported(f"setup_signing: {whose} frames are MAVLink 1, which has no signatures")
    session.check_disarmed("setup_signing")


def _message(session: VehicleSession, signing: Signing | None) -> SetupSigning:
    if signing is None:
        return SetupSigning(session.system_id, session.component_id, NO_KEY, 0)
    stamp = signing.timestamp_now(session.connection.unix_time()) + TIMESTAMP_TICKS_PER_S
    return SetupSigning(session.system_id, session.component_id, signing.key.secret, stamp)
