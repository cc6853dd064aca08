"""Exceptions raised by aerokit. All derive from `AerokitError`, so that `except AerokitError` catches every one."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = [
    "AerokitError",
    "BusyError",
    "CommandRejected",
    "CommandTimeout",
    "ConnectFailed",
    "ConnectionClosed",
    "FileError",
    "FileFormatError",
    "FileTimeout",
    "FleetError",
    "GimbalTaken",
    "HeartbeatTimeout",
    "InvalidArgument",
    "LinkError",
    "LinkLost",
    "LinkOpenError",
    "MissionRejected",
    "MissionTimeout",
    "NotSupported",
    "OperationRejected",
    "OperationTimeout",
    "ParameterRejected",
    "ParameterTimeout",
    "RecordingEnded",
    "RemoteProtocolError",
    "RollbackFailed",
    "SetpointStreamStopped",
    "StaleValueError",
    "SubscriptionOverflow",
    "ValueUnknownError",
    "VerificationFailed",
]


class AerokitError(Exception):
    """Base class of all exceptions that this library raises on purpose."""


# ---------------------------------------------------------------------------------------- links


class LinkError(AerokitError, OSError):
    """Base class of link failures: no bytes can be sent or received."""


class LinkOpenError(LinkError):
    """A link could not be opened: the port is in use, the host does not answer, or the device is missing."""


class LinkLost(LinkError):
    """An open link failed: the peer closed it, or the device was unplugged."""


class RecordingEnded(LinkLost):
    """The recording being replayed has ended, or the rest of the file cannot be read."""


class ConnectionClosed(AerokitError):
    """The connection was closed before or during this call. ``__cause__`` is the reason."""


# ------------------------------------------------------------------------------------- timeouts


class OperationTimeout(AerokitError, TimeoutError):
    """An operation did not complete in time. The text names what was expected and what happened instead."""


class CommandTimeout(OperationTimeout):
    """The vehicle did not acknowledge a command (COMMAND_ACK), despite retries."""

    def __init__(self, message: str, *, was_sent: bool = True) -> None:
        super().__init__(message)
        self.was_sent: bool = was_sent
        """False if aerokit did not send the command. If True, the vehicle may have executed it."""


class HeartbeatTimeout(OperationTimeout):
    """The vehicle did not send a heartbeat in time."""


class ConnectFailed(HeartbeatTimeout):
    """The connection found no vehicle. The text lists what was received instead."""


class ParameterTimeout(OperationTimeout):
    """Parameters were not received or not confirmed in time.

    ``missing`` holds the names of these parameters, or their indices where the names are unknown.
    """

    def __init__(self, message: str, *, missing: tuple[str | int, ...] = ()) -> None:
        super().__init__(message)
        self.missing = missing


class MissionTimeout(OperationTimeout):
    """A mission transfer did not complete in time.

    ``missing`` holds the indices of the items that were not transferred. The first item after home has index 0.
    """

    def __init__(self, message: str, *, missing: tuple[int, ...] = ()) -> None:
        super().__init__(message)
        self.missing = missing


class FileTimeout(OperationTimeout):
    """A file or log was not received completely in time. ``missing`` holds the missing ranges as (offset, size)."""

    def __init__(self, message: str, *, missing: tuple[tuple[int, int], ...] = ()) -> None:
        super().__init__(message)
        self.missing = missing


# ------------------------------------------------------------------------------------- refusals


class OperationRejected(AerokitError):
    """The vehicle refused an operation, or accepted it and then did something else.

    ``reasons`` holds the vehicle's explanations: status texts, failing health bits, estimator flags.
    """

    def __init__(self, message: str, *, reasons: tuple[str, ...] = ()) -> None:
        super().__init__(message + "".join(f"\n  - {reason}" for reason in reasons))
        self.reasons = reasons


class CommandRejected(OperationRejected):
    """The vehicle answered a command with a result other than ACCEPTED.

    ``command`` is the MAV_CMD, ``result`` the MAV_RESULT (https://mavlink.io/en/messages/common.html#MAV_RESULT).
    """

    def __init__(self, message: str, *, command: int, result: int, reasons: tuple[str, ...] = ()) -> None:
        super().__init__(message, reasons=reasons)
        self.command = command
        self.result = result


class ParameterRejected(OperationRejected):
    """The vehicle has no parameter of this name, or refused the value.

    ``name`` is the parameter; ``code`` is the MAV_PARAM_ERROR
    (https://mavlink.io/en/messages/common.html#PARAM_ERROR), or None if the vehicle sent none.
    """

    def __init__(self, message: str, *, name: str, code: int | None = None) -> None:
        super().__init__(message)
        self.name = name
        self.code = code


class RollbackFailed(OperationRejected):
    """Parameters could not be restored. ``not_restored`` maps their names to their original values."""

    def __init__(self, message: str, *, not_restored: dict[str, float]) -> None:
        super().__init__(message)
        self.not_restored = not_restored


class MissionRejected(OperationRejected):
    """The vehicle refused a mission, a fence or rally points.

    The text says whether the vehicle kept the previous items. ``result`` is the MAV_MISSION_RESULT
    (https://mavlink.io/en/messages/common.html#MAV_MISSION_RESULT); ``item`` is the index of the refused item, or None
    if unknown.
    """

    def __init__(self, message: str, *, result: int, item: int | None = None, reasons: tuple[str, ...] = ()) -> None:
        super().__init__(message, reasons=reasons)
        self.result = result
        self.item = item


class VerificationFailed(OperationRejected):
    """The vehicle confirmed a change, but then reported other values. ``differences`` describes each of them."""

    def __init__(self, message: str, *, differences: tuple[str, ...]) -> None:
        super().__init__(message, reasons=differences)
        self.differences = differences


class FileError(OperationRejected):
    """The vehicle refused a file operation.

    ``code`` is the MAV_FTP_ERR (https://mavlink.io/en/services/ftp.html#error_codes); ``errno`` is the error number of
    the vehicle's operating system, or None.
    """

    def __init__(self, message: str, *, path: str, code: int, errno: int | None = None) -> None:
        super().__init__(message)
        self.path = path
        self.code = code
        self.errno = errno


class NotSupported(OperationRejected):
    """This vehicle does not support the operation. Nothing was sent."""


class GimbalTaken(OperationRejected):
    """Control of a gimbal was lost: another system took it, or no system has it any longer.

    ``system_id`` and ``component_id`` identify the system now in control; both are 0 if there is none.
    """

    def __init__(self, message: str, *, system_id: int, component_id: int) -> None:
        super().__init__(message)
        self.system_id = system_id
        self.component_id = component_id


class FleetError(OperationRejected):
    """Some members of a fleet failed to complete an action. ``errors`` maps member names to their exceptions."""

    def __init__(self, message: str, *, errors: Mapping[str, Exception]) -> None:
        super().__init__(message, reasons=tuple(f"{name}: {error}" for name, error in errors.items()))
        self.errors: dict[str, Exception] = dict(errors)


# ---------------------------------------------------------------------- arguments, protocol, state


class InvalidArgument(AerokitError, ValueError):
    """An argument is invalid. The text has its name, its value and the allowed values. Nothing was sent."""


class FileFormatError(AerokitError, ValueError):
    """A file is damaged or not in the expected format. The text names the file, the position and what was expected."""


class RemoteProtocolError(AerokitError):
    """The vehicle violated the MAVLink standard."""


class ValueUnknownError(AerokitError, LookupError):
    """The vehicle has not reported this value yet."""


class StaleValueError(ValueUnknownError):
    """The value is older than the caller accepts."""


class SubscriptionOverflow(AerokitError):
    """A subscription with the policy ``error`` overflowed, because the program read too slowly."""


class SetpointStreamStopped(AerokitError):
    """A set-point stream stopped. The text names the cause.

    Causes are stale set-points, a blocked event loop, a lost link and a mode change.
    """


class BusyError(AerokitError):
    """This operation is already in progress, and cannot run twice at the same time."""
