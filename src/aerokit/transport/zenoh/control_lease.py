"""Who may order the vehicle when several programs can reach it: one has the helm, the others are told.

Sans-IO; time is an argument.

The vehicle side sends beacons, numbered; a client stamps each datagram with the last one that it has heard. So the
datagram is not older than that beacon, and how old the beacon is the vehicle side knows. What a broken connection kept
back bears an old number, whenever it comes.

Time is an argument, seconds on any clock that does not go back.
"""

from __future__ import annotations

from collections import OrderedDict, deque
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
from aerokit.transport.zenoh.keys import Beacon, Stamp, Told, Wish

if TYPE_CHECKING:
    from aerokit.mavlink.frame import Frame
    from aerokit.mavlink.message import Message

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


BEACON_EVERY_S = 0.5
"""So often a vehicle side says that it is there."""

FRESH_S = 2.0
"""A datagram whose stamp is older is refused; a client that has heard no beacon for so long sends nothing."""

_MOST_NONCES = 256

_DRIFT = 0.001
"""Two clocks go apart by less than this (a millisecond in a second; quartz is ten times better)."""


class Judge:
    """The vehicle side: makes beacons, and judges what bears their numbers."""

    doubled: int
    late: int

    def __init__(self, epoch: int) -> None:
        self.epoch: int = epoch
        self.late = 0
        """Datagrams that were refused because their stamp was too old, or another vehicle side's."""
        self.doubled = 0
        """Datagrams that were refused because one like them, or a later one, had come."""
        self._number = 0
        self._sent: deque[tuple[int, float]] = deque()  # (number, when) of the beacons that still count
        self._sequences: OrderedDict[tuple[str, int], int] = OrderedDict()

    def beacon(self, now: float, helm: str | None = None) -> Beacon:
        """The next beacon, to be sent at once."""
        self._forget(now)
        self._number += 1
        self._sent.append((self._number, now))
        return Beacon(self.epoch, self._number, now, helm)

    def accepts(self, client: str, stamp: Stamp | None, now: float) -> bool:
        """Whether what bears this stamp is from now, and did not come before; counts what is not."""
        self._forget(now)
        is_fresh = (
            stamp is not None
            and stamp.epoch == self.epoch
            and bool(self._sent)
            and self._sent[0][0] <= stamp.beacon <= self._sent[-1][0]
        )
        if stamp is None or not is_fresh:
            self.late += 1
            return False
        who = client, stamp.nonce
        if stamp.sequence <= self._sequences.get(who, 0):
            self.doubled += 1
            return False
        self._sequences[who] = stamp.sequence
        self._sequences.move_to_end(who)
        if len(self._sequences) > _MOST_NONCES:
            self._sequences.popitem(last=False)
        return True

    def _forget(self, now: float) -> None:
        while self._sent and now - self._sent[0][1] > FRESH_S:
            self._sent.popleft()


class Lateness:
    """How much later than the quickest something comes: the least delay ever seen is taken for no delay.

    The clocks need not agree, only go alike. What was late from the very beginning is not known to be.
    """

    def __init__(self) -> None:
        self._least: float | None = None  # of our time less the sender's
        self._at = 0.0

    def of(self, sent_s: float, now: float) -> float:
        """Seconds, of what was sent then on the sender's clock and came ``now`` on ours."""
        delay = now - sent_s
        least = None if self._least is None else self._least + _DRIFT * (now - self._at)
        if least is None or delay <= least:
            self._least, self._at = delay, now
            return 0.0
        return delay - least


class Ears:
    """A client: which vehicle side it listens to, whether that one is there, and what to stamp."""

    foreign: int
    heard_at: float
    late: int

    def __init__(self, nonce: int, wish: Wish = "free") -> None:
        self.epoch: int | None = None
        """Of the vehicle side that is listened to; None: none was heard."""
        self.helm: str | None = None
        """Who has the helm, as told last."""
        self.late = 0
        """Frames of the vehicle side and beacons that came too late to be listened to."""
        self.foreign = 0
        """Those of another vehicle side of the same name than the one that is listened to."""
        self.heard_at = 0.0
        """When the last beacon came in time."""
        self._nonce, self._wish = nonce, wish
        self._beacon = 0
        self._sequence = 0
        self._lateness = Lateness()

    def hear_beacon(self, beacon: Beacon, now: float) -> bool:
        """Whether it counts: one of the vehicle side that is listened to, in time.

        Another one's counts as soon as the first has been silent for `FRESH_S`, or was :meth:`forget`-ten.
        """
        if beacon.epoch != self.epoch:
            if self.epoch is not None and not self.is_silent(now):
                self.foreign += 1
                return False
            self.epoch, self._beacon, self._lateness = beacon.epoch, 0, Lateness()
        elif beacon.number <= self._beacon:
            return False
        if self._lateness.of(beacon.clock_s, now) > FRESH_S:
            self.late += 1
            return False
        self._beacon, self.heard_at, self.helm = beacon.number, now, beacon.helm
        return True

    def hears(self, epoch: int, sent_s: float, now: float) -> bool:
        """Whether frames that were sent then, on the vehicle side's clock, are listened to."""
        if epoch != self.epoch:
            self.foreign += 1
            return False
        if self._lateness.of(sent_s, now) > FRESH_S:
            self.late += 1
            return False
        return True

    def stamp(self, now: float, wish: Wish | None = None) -> Stamp | None:
        """For what is sent now; None: nothing may be sent, because no beacon has come for `FRESH_S`."""
        if self.epoch is None or self.is_silent(now):
            return None
        self._sequence += 1
        return Stamp(self.epoch, self._beacon, self._nonce, self._sequence, wish or self._wish)

    def is_silent(self, now: float) -> bool:
        """Whether no beacon has come in time for `FRESH_S`."""
        return self._beacon == 0 or now - self.heard_at > FRESH_S

    def forget(self) -> None:
        """The vehicle side has said that it ends."""
        self.epoch, self._beacon, self.helm = None, 0, None
