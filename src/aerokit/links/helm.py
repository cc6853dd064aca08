"""Who may order the vehicle when several programs can reach it: one has the helm, the others are told.

Sans-IO; time is an argument.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import MavCmd, MavFtpOpcode, MavMissionResult, MavResult, MavSeverity
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.messages import (
    INDEX,
    CommandAck,
    CommandInt,
    CommandLong,
    FileTransferProtocol,
    MissionAck,
    Statustext,
)

from .zenoh_keys import Told, Wish

if TYPE_CHECKING:
    from aerokit.mavlink.frame import Frame
    from aerokit.mavlink.message import Message

__all__ = ["HELM_KEPT_S", "Gate", "Helm", "is_read", "refusals_in"]

HELM_KEPT_S = 5.0
"""Who has not been heard for so long has the helm no more."""

TELL_EVERY_S = 0.5
"""A client is told so often of messages of one kind that were refused (set-points come 20 times a second)."""

READ_MESSAGES = frozenset(
    (
        "Heartbeat", "SystemTime", "Timesync", "Ping", "Statustext", "CommandAck", "MessageInterval", "LoggingAck",
        "ParamRequestRead", "ParamRequestList", "ParamExtRequestRead", "ParamExtRequestList", "MissionRequest",
        "MissionRequestInt", "MissionRequestList", "MissionRequestPartialList", "MissionAck", "FenceFetchPoint",
        "RallyFetchPoint", "RequestDataStream", "RequestEvent", "LogRequestList", "LogRequestData", "LogRequestEnd",
        "DeviceOpRead",
    )
)  # fmt: skip
"""What anybody may send: it asks, or says something of its sender, and changes nothing but streams."""

READ_COMMANDS = frozenset(
    (
        MavCmd.REQUEST_MESSAGE, MavCmd.SET_MESSAGE_INTERVAL, MavCmd.GET_MESSAGE_INTERVAL, MavCmd.GET_HOME_POSITION,
        MavCmd.REQUEST_PROTOCOL_VERSION, MavCmd.REQUEST_AUTOPILOT_CAPABILITIES, MavCmd.RUN_PREARM_CHECKS,
        MavCmd.REQUEST_CAMERA_INFORMATION, MavCmd.REQUEST_CAMERA_SETTINGS, MavCmd.REQUEST_STORAGE_INFORMATION,
        MavCmd.REQUEST_CAMERA_CAPTURE_STATUS, MavCmd.REQUEST_CAMERA_IMAGE_CAPTURE, MavCmd.REQUEST_FLIGHT_INFORMATION,
        MavCmd.REQUEST_VIDEO_STREAM_INFORMATION, MavCmd.REQUEST_VIDEO_STREAM_STATUS,
    )
)  # fmt: skip
"""So do these commands."""

READ_FILES = frozenset(
    (
        MavFtpOpcode.NONE, MavFtpOpcode.TERMINATESESSION, MavFtpOpcode.RESETSESSION, MavFtpOpcode.LISTDIRECTORY,
        MavFtpOpcode.OPENFILERO, MavFtpOpcode.READFILE, MavFtpOpcode.CALCFILECRC, MavFtpOpcode.BURSTREADFILE,
    )
)  # fmt: skip
"""And these operations of MAVFTP."""

_OPCODE_AT = 3  # https://mavlink.io/en/services/ftp.html#payload
_SAYS = "network: "
_LONGEST_TEXT = 50
_MOST_KINDS = 64
_READ_IDS = frozenset(message_id for message_id, row in INDEX.items() if row[0] in READ_MESSAGES)
COMMANDS = ("COMMAND_LONG", "COMMAND_INT")
_PLANS = ("MISSION_COUNT", "MISSION_CLEAR_ALL", "MISSION_WRITE_PARTIAL_LIST")


def is_read(frame: Frame) -> bool:
    """Whether anybody may send it; what is not known is an order."""
    if frame.message_id in _READ_IDS:  # without decoding it: most are
        return True
    if frame.message_id in (CommandLong.ID, CommandInt.ID):
        return getattr(_decoded(frame), "command", 0) in READ_COMMANDS
    if frame.message_id == FileTransferProtocol.ID:
        payload: bytes = getattr(_decoded(frame), "payload", b"")
        return len(payload) > _OPCODE_AT and payload[_OPCODE_AT] in READ_FILES
    return False


def refusals_in(answer: bytes) -> tuple[bytes, ...]:
    """The frames of an answer by which an order is refused; others have no business there."""
    return tuple(frame.raw for frame in Framer().receive(answer) if _is_refusal(_decoded(frame)))


def _is_refusal(message: Message | None) -> bool:
    if isinstance(message, CommandAck):
        return message.result == MavResult.TEMPORARILY_REJECTED
    if isinstance(message, Statustext):
        return message.text.startswith(_SAYS)
    return isinstance(message, MissionAck) and message.type == MavMissionResult.DENIED


class Helm:
    """Which client may order. Whoever orders first has it while it is free, and keeps it while it is heard.

    It is free again when its holder has gone, or was not heard for `HELM_KEPT_S`; who takes it has it at once.
    """

    def __init__(self) -> None:
        self._holder: str | None = None
        self._heard_at = 0.0

    def holder(self, now: float) -> str | None:
        """The client that has it; None: it is free."""
        if self._holder is not None and now - self._heard_at > HELM_KEPT_S:
            self._holder = None
        return self._holder

    def hear(self, client: str, now: float) -> None:
        """A client is there: something from now came of it."""
        if self.holder(now) == client:
            self._heard_at = now

    def may_order(self, client: str, now: float) -> bool:
        """Whether this client has it; it has when it was free."""
        if self.holder(now) is None:
            self.take(client, now)
        return self._holder == client

    def take(self, client: str, now: float) -> None:
        """Give it to this client, whoever has it."""
        self._holder, self._heard_at = client, now

    def leave(self, client: str) -> None:
        """A client has gone, or wants it no more."""
        if self._holder == client:
            self._holder = None


class Gate:
    """What one client sends: whole frames that it may send pass, of the others it is told."""

    heard_at: float

    refused: int

    def __init__(self, client: str, helm: Helm) -> None:
        self.refused = 0
        """Frames that did not pass."""
        self.heard_at = 0.0
        """When its owner heard something of the client."""
        self._client, self._helm = client, helm
        self._framer = _framer()
        self._nonce: int | None = None  # of the program that orders under this name
        self._nonce_at = 0.0
        self._told: dict[str, tuple[float, int]] = {}  # message → when it was told, and how many came since

    def receive(self, data: bytes, wish: Wish, now: float, nonce: int = 0) -> tuple[bytes, list[Told]]:
        """Take a datagram that is from now; return what passes, and what the client is to be told.

        ``nonce`` tells programs apart that were given one name by mistake: the first of them is the client.
        """
        is_namesake = self._is_namesake(nonce, wish, now)
        if not is_namesake:
            self._helm.hear(self._client, now)
        passed: list[bytes] = []
        tell: list[Told] = []
        frames = self._framer.receive(data, now)
        if self._framer.waiting:  # a datagram has whole frames: what is begun in one does not end in the next
            self._framer = _framer()
        for frame in frames:
            may_order = wish != "never" and not is_namesake
            if is_read(frame) or (may_order and self._helm.may_order(self._client, now)):
                passed.append(frame.raw)
                continue
            holder = self._helm.holder(now) if may_order else None
            reason = "this link never orders (helm=never)" if holder is None else f"{holder} has the helm"
            if is_namesake:
                reason = f"another program is called {self._client}, too"
            tell += self._refuse(frame, _decoded(frame), reason, holder, now)
        return b"".join(passed), tell

    def _is_namesake(self, nonce: int, wish: Wish, now: float) -> bool:
        """Whether another program of this name was heard lately, and this one does not take the helm."""
        if self._nonce not in (None, nonce) and wish != "take" and now - self._nonce_at <= HELM_KEPT_S:
            return True
        self._nonce, self._nonce_at = nonce, now
        return False

    def refuse_late(self, data: bytes, now: float) -> list[Told]:
        """Take a datagram that is not from now: nothing of it passes; its orders are told.

        Without an answer: whoever waited for one may have given the same order again.
        """
        tell: list[Told] = []
        for frame in _framer().receive(data, now):
            if is_read(frame):
                self.refused += 1
            else:
                tell += self._refuse(frame, _decoded(frame), "it came too late", None, now, is_late=True)
        return tell

    def _refuse(
        self,
        frame: Frame,
        message: Message | None,
        reason: str,
        helm: str | None,
        now: float,
        *,
        is_late: bool = False,
    ) -> list[Told]:
        self.refused += 1
        name = f"message {frame.message_id}" if message is None else message.NAME
        answer = b"" if message is None or is_late else _answer(frame, message, reason)
        told_at, waiting = self._told.get(name, (-TELL_EVERY_S, 0))
        if not answer and now - told_at < TELL_EVERY_S:
            self._told[name] = (told_at, waiting + 1)
            return []
        if len(self._told) >= _MOST_KINDS:
            self._told.clear()
        self._told[name] = (now, 0)
        return [Told(name, reason, helm, answer, waiting + 1)]


def _framer() -> Framer:
    framer = Framer()
    framer.keep_unknown = True  # whoever has the helm may send what we do not know
    return framer


def _decoded(frame: Frame) -> Message | None:
    return None if STANDARD.get(frame.message_id) is None else STANDARD.decode(frame)


def _answer(frame: Frame, message: Message, reason: str) -> bytes:
    """The frames by which a vehicle would refuse, with the reason; empty where it has none, or the order is for all."""
    fields: object = message
    system: int = getattr(fields, "target_system", 0)
    component: int = getattr(fields, "target_component", 0) or 1
    answer: Message | None = None
    if message.NAME in COMMANDS:
        command: int = getattr(fields, "command", 0)
        result = MavResult.TEMPORARILY_REJECTED
        answer = CommandAck(command, result, 0, 0, frame.system_id, frame.component_id)
    elif message.NAME in _PLANS:
        kind: int = getattr(fields, "mission_type", 0)
        answer = MissionAck(frame.system_id, frame.component_id, MavMissionResult.DENIED, kind)
    if answer is None or system == 0:
        return b""
    text = Statustext(MavSeverity.WARNING, f"{_SAYS}{reason}"[:_LONGEST_TEXT])
    encoder = FrameEncoder(system, component)
    return encoder.encode(text) + encoder.encode(answer)
