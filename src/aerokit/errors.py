"""Every exception that aerokit raises: one tree, so that one ``except AerokitError`` catches it all."""

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
    """The root of every exception that this library raises on purpose."""


# ---------------------------------------------------------------------------------------- links


class LinkError(AerokitError, OSError):
    """Bytes cannot be moved."""


class LinkOpenError(LinkError):
    """A link could not be opened: the port is taken, the host does not answer, the device is missing."""


class LinkLost(LinkError):
    """A link that was open has gone: the peer closed it or the device was unplugged."""


class RecordingEnded(LinkLost):
    """A recording that was replayed has come to its end, or cannot be read on."""


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


class ParameterTimeout(OperationTimeout):
    """Parameters did not arrive or were not confirmed; ``missing`` are their names, or indices of unknown ones."""

    def __init__(self, message: str, *, missing: tuple[str | int, ...] = ()) -> None:
        super().__init__(message)
        self.missing = missing


class MissionTimeout(OperationTimeout):
    """A mission transfer did not end; ``missing`` are the items (counted as the program counts) not transferred."""

    def __init__(self, message: str, *, missing: tuple[int, ...] = ()) -> None:
        super().__init__(message)
        self.missing = missing


class FileTimeout(OperationTimeout):
    """A file or log did not arrive whole; ``missing`` are the byte ranges (offset, size) that did not."""

    def __init__(self, message: str, *, missing: tuple[tuple[int, int], ...] = ()) -> None:
        super().__init__(message)
        self.missing = missing


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


class ParameterRejected(OperationRejected):
    """The vehicle refused a parameter: it has none of this name, or does not take the value.

    ``name`` is the parameter, ``code`` the MAV_PARAM_ERROR (https://mavlink.io/en/messages/common.html#PARAM_ERROR),
    None when the vehicle gave none.
    """

    def __init__(self, message: str, *, name: str, code: int | None = None) -> None:
        super().__init__(message)
        self.name = name
        self.code = code


class RollbackFailed(OperationRejected):
    """What was to be put back could not be; ``not_restored`` maps the parameters to the values they should have."""

    def __init__(self, message: str, *, not_restored: dict[str, float]) -> None:
        super().__init__(message)
        self.not_restored = not_restored


class MissionRejected(OperationRejected):
    """The vehicle refused a mission, a fence or rally points; the text says whether it still has those from before.

    ``result`` is the MAV_MISSION_RESULT (https://mavlink.io/en/messages/common.html#MAV_MISSION_RESULT), ``item`` the
    index of the item it was about, None when that is not known.
    """

    def __init__(
        self, message: str, *, result: int, item: int | None = None, reasons: tuple[str, ...] = ()
    ) -> None:
        super().__init__(message, reasons=reasons)
        self.result = result
        self.item = item


class VerificationFailed(OperationRejected):
    """The vehicle confirmed something and then holds something else; ``differences`` says what, one text each."""

    def __init__(self, message: str, *, differences: tuple[str, ...]) -> None:
        super().__init__(message, reasons=differences)
        self.differences = differences


class FileError(OperationRejected):
    """The vehicle refused a file operation; ``code`` is the MAV_FTP_ERR, ``errno`` the system's number behind it.

    See https://mavlink.io/en/services/ftp.html#error_codes.
    """

    def __init__(self, message: str, *, path: str, code: int, errno: int | None = None) -> None:
        super().__init__(message)
        self.path = path
        self.code = code
        self.errno = errno


class NotSupported(OperationRejected):
    """This vehicle cannot do that; nothing was sent."""


class GimbalTaken(OperationRejected):
    """Control of a gimbal was lost to ``system_id`` and ``component_id``; zeros: nobody has it now."""

    def __init__(self, message: str, *, system_id: int, component_id: int) -> None:
        super().__init__(message)
        self.system_id = system_id
        self.component_id = component_id


class FleetError(OperationRejected):
    """Some of a fleet did not do what all of them were to do; ``errors`` has the error of each by the member's name."""

    def __init__(self, message: str, *, errors: Mapping[str, Exception]) -> None:
        super().__init__(message, reasons=tuple(f"{name}: {error}" for name, error in errors.items()))
        self.errors: dict[str, Exception] = dict(errors)


# ---------------------------------------------------------------------- arguments, protocol, state


class InvalidArgument(AerokitError, ValueError):
    """An argument cannot be right: the text says which, its value, and what is allowed. Nothing was sent."""


class FileFormatError(AerokitError, ValueError):
    """A file is damaged or of another kind; the text names file, place and what was expected."""


class RemoteProtocolError(AerokitError):
    """The vehicle broke the standard."""


class ValueUnknownError(AerokitError, LookupError):
    """The vehicle has not said this yet."""


class StaleValueError(ValueUnknownError):
    """The value is older than the caller accepts."""


class SubscriptionOverflow(AerokitError):
    """A subscription with the policy ``error`` was not read fast enough."""


class SetpointStreamStopped(AerokitError):
    """A stream ended by itself: stale set-points, a blocked loop, a lost link or a changed mode; the text says why."""


class BusyError(AerokitError):
    """Something that can only be done once at a time is under way."""
