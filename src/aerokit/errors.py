"""Every exception that aerokit raises: one tree, so that one ``except AerokitError`` catches it all."""

from __future__ import annotations

__all__ = [
    "AerokitError",
    "BusyError",
    "CommandRejected",
    "CommandTimeout",
    "ConnectFailed",
    "ConnectionClosed",
    "HeartbeatTimeout",
    "LinkError",
    "LinkLost",
    "LinkOpenError",
    "LocalProtocolError",
    "NotSupported",
    "OperationRejected",
    "OperationTimeout",
    "RemoteProtocolError",
    "SetpointStreamStopped",
    "StaleValueError",
    "SubscriptionOverflow",
    "ValueUnknownError",
]


class AerokitError(Exception):
    """The root of every exception that this library raises on purpose."""


# ---------------------------------------------------------------------------------------- links


class LinkError(AerokitError, OSError):
    """Bytes cannot be moved."""


class LinkOpenError(LinkError):
    """A link could not be opened: the port is taken, the host does not answer, the device is missing."""


class LinkLost(LinkError):
    """A link that was open has gone: the peer closed it or the device was unplugged."""


class ConnectionClosed(AerokitError):
    """The connection was used after it was closed, or closed while this call waited; ``__cause__`` says why."""


# ------------------------------------------------------------------------------------- timeouts


class OperationTimeout(AerokitError, TimeoutError):
    """Something did not happen in time; the text says what was waited for and what was seen meanwhile."""


class CommandTimeout(OperationTimeout):
    """No COMMAND_ACK arrived, although the command was sent again."""


class HeartbeatTimeout(OperationTimeout):
    """No heartbeat of the vehicle arrived in time."""


class ConnectFailed(HeartbeatTimeout):
    """No vehicle was found; the text says what was heard instead."""


# ------------------------------------------------------------------------------------- refusals


class OperationRejected(AerokitError):
    """The vehicle refused, or accepted and then did something else.

    ``reasons`` holds what the vehicle gave for it: status texts, failing health bits, estimator flags.
    """

    def __init__(self, message: str, *, reasons: tuple[str, ...] = ()) -> None:
        super().__init__(message + "".join(f"\n  - {reason}" for reason in reasons))
        self.reasons = reasons


class CommandRejected(OperationRejected):
    """The vehicle answered a command with a result other than ACCEPTED.

    ``result`` is the MAV_RESULT (https://mavlink.io/en/messages/common.html#MAV_RESULT), ``command`` the MAV_CMD.
    """

    def __init__(self, message: str, *, command: int, result: int, reasons: tuple[str, ...] = ()) -> None:
        super().__init__(message, reasons=reasons)
        self.command = command
        self.result = result


class NotSupported(OperationRejected):
    """This vehicle cannot do that; nothing was sent."""


class SetpointStreamStopped(OperationRejected):
    """A set-point stream ended by itself: stale set-points, a blocked loop, a lost link or a changed mode."""


# ------------------------------------------------------------------------------- protocol, state


class LocalProtocolError(AerokitError, ValueError):
    """We were asked to send nonsense; the text says which field, which value and what is allowed. Nothing was sent."""


class RemoteProtocolError(AerokitError):
    """The vehicle broke the standard."""


class ValueUnknownError(AerokitError, LookupError):
    """The vehicle has not said this yet."""


class StaleValueError(ValueUnknownError):
    """The value is older than the caller accepts."""


class SubscriptionOverflow(AerokitError):
    """A subscription with the policy ``error`` was not read fast enough."""


class BusyError(AerokitError):
    """Something that can only be done once at a time is under way."""
