"""Installs or removes a signing key on a vehicle by SETUP_SIGNING, which is not acknowledged."""

from __future__ import annotations

from typing import TYPE_CHECKING

import anyio

from aerokit.errors import NotSupported, OperationTimeout
from aerokit.mavlink.messages import SetupSigning

if TYPE_CHECKING:
    from aerokit.mavlink.signing import Signing
    from aerokit.vehicle.session.session import VehicleSession


# SETUP_SIGNING is repeated only once per HEARTBEAT (1 Hz), because the signature of a HEARTBEAT shows whether the
# vehicle has accepted the key.
RETRY_INTERVAL_S = 1.0

# The key in SETUP_SIGNING that removes the vehicle's key.
NO_KEY = bytes(32)

# The time stamp of a signature counts units of 10 microseconds.
TIMESTAMP_TICKS_PER_S = 100_000


async def set_up_signing(session: VehicleSession, signing: Signing | None, timeout: float) -> None:
    """Send SETUP_SIGNING until the vehicle signs with the key. With None, until the vehicle no longer signs."""
    _check_vehicle(session)
    connection, started = session.connection, session.connection.now()
    other_boots = session.watch.other_boots
    with connection._signatures.key_handover(signing, session.system_id, session.component_id) as has_accepted:
        with anyio.move_on_after(timeout):
            while not has_accepted.is_set():
                session.watch.raise_if_other_boot(
                    other_boots, "the previous vehicle may have taken the key", action="setup_signing"
                )
                if not session.is_held_back:
                    session.send(_message(session, signing))
                with anyio.move_on_after(RETRY_INTERVAL_S):
                    await has_accepted.wait()
                connection.raise_if_ended()
        if has_accepted.is_set():
            return
    texts = "; ".join(session.texts_since(started)) or "the vehicle sent no status text"
    if session.autopilot.signing_key_restriction:
        texts += f"; {session.autopilot.signing_key_restriction}"
    # The repr of a key has its fingerprint, not the secret.
    expected = "without a signature" if signing is None else f"signed with {signing.key!r}"
    raise OperationTimeout(
        f"setup_signing: no frame {expected} arrived within {timeout:g} s; {texts}; {session.describe_link()}"
    )


def _check_vehicle(session: VehicleSession) -> None:
    heartbeat = session.connection.heartbeats.get((session.system_id, session.component_id))
    frame = None if heartbeat is None else heartbeat.received_frame
    sends_mavlink_1 = session.connection.mavlink_version == 1
    receives_mavlink_1 = frame is not None and frame.version == 1
    if sends_mavlink_1 or receives_mavlink_1:
        whose = "our" if sends_mavlink_1 else "the vehicle's"
        raise NotSupported(f"setup_signing: {whose} frames are MAVLink 1, which has no signatures")
    session.check_disarmed("setup_signing")


def _message(session: VehicleSession, signing: Signing | None) -> SetupSigning:
    if signing is None:
        return SetupSigning(session.system_id, session.component_id, NO_KEY, initial_timestamp=0)
    # The vehicle's time stamps continue from this one. It is a second ahead of our clock, because a receiver refuses a
    # frame as replayed if its time stamp is not later than the last one.
    timestamp = signing.timestamp_now(session.connection.unix_time()) + TIMESTAMP_TICKS_PER_S
    return SetupSigning(session.system_id, session.component_id, signing.key.secret, timestamp)
