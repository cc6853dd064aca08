"""Which of several programs may command a vehicle, and which of their datagrams arrive too late. Sans-IO.

The server (`ZenohListen`) sends numbered beacons. A client stamps each datagram with the number of the last
beacon that it received. A datagram that a broken connection has delayed therefore has an old number.

Times are seconds on any monotonic clock.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from typing import TYPE_CHECKING, NamedTuple

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
    MissionClearAll,
    MissionCount,
    MissionWritePartialList,
    Statustext,
)
from aerokit.transport.zenoh.keys import Beacon, ControlMode, RefusalNotice, SendTime, Stamp

if TYPE_CHECKING:
    from aerokit.mavlink.frame import Frame
    from aerokit.mavlink.message import Message

LEASE_TIMEOUT_S = 5.0
"""The control lease becomes free after this silence of its holder."""

NOTICE_INTERVAL_S = 0.5
"""Minimum interval of notices about refused messages of one type, e.g. about set-points that are sent at 20 Hz."""

# Messages that change nothing on the vehicle except its streams. Any client may send them.
READ_MESSAGES = frozenset(
    (
        "Heartbeat", "SystemTime", "Timesync", "Ping", "Statustext", "CommandAck", "MessageInterval", "LoggingAck",
        "ParamRequestRead", "ParamRequestList", "ParamExtRequestRead", "ParamExtRequestList", "MissionRequest",
        "MissionRequestInt", "MissionRequestList", "MissionRequestPartialList", "MissionAck", "FenceFetchPoint",
        "RallyFetchPoint", "RequestDataStream", "RequestEvent", "LogRequestList", "LogRequestData", "LogRequestEnd",
        "DeviceOpRead",
    )
)  # fmt: skip

# Commands that change nothing on the vehicle except its streams.
READ_COMMANDS = frozenset(
    (
        MavCmd.REQUEST_MESSAGE, MavCmd.SET_MESSAGE_INTERVAL, MavCmd.GET_MESSAGE_INTERVAL, MavCmd.GET_HOME_POSITION,
        MavCmd.REQUEST_PROTOCOL_VERSION, MavCmd.REQUEST_AUTOPILOT_CAPABILITIES, MavCmd.RUN_PREARM_CHECKS,
        MavCmd.REQUEST_CAMERA_INFORMATION, MavCmd.REQUEST_CAMERA_SETTINGS, MavCmd.REQUEST_STORAGE_INFORMATION,
        MavCmd.REQUEST_CAMERA_CAPTURE_STATUS, MavCmd.REQUEST_CAMERA_IMAGE_CAPTURE, MavCmd.REQUEST_FLIGHT_INFORMATION,
        MavCmd.REQUEST_VIDEO_STREAM_INFORMATION, MavCmd.REQUEST_VIDEO_STREAM_STATUS,
    )
)  # fmt: skip

# MAVFTP operations that change no file.
READ_FILES = frozenset(
    (
        MavFtpOpcode.NONE, MavFtpOpcode.TERMINATESESSION, MavFtpOpcode.RESETSESSION, MavFtpOpcode.LISTDIRECTORY,
        MavFtpOpcode.OPENFILERO, MavFtpOpcode.READFILE, MavFtpOpcode.CALCFILECRC, MavFtpOpcode.BURSTREADFILE,
    )
)  # fmt: skip

_OPCODE_OFFSET = 3  # https://mavlink.io/en/services/ftp.html#payload

_TEXT_PREFIX = "network: "

_MAX_TEXT_LENGTH = 50  # length of the text in STATUSTEXT

_MAX_NOTICES = 64  # The last notice is remembered for each message name, for at most this many names.

_READ_IDS = frozenset(message_id for message_id, (class_name, *_) in INDEX.items() if class_name in READ_MESSAGES)


def is_read_only(frame: Frame) -> bool:
    """Return True if clients without control may send this frame. Unknown messages count as commands."""
    if frame.message_id in _READ_IDS:  # Most frames need not be decoded.
        return True
    message = _decoded(frame)
    if isinstance(message, (CommandLong, CommandInt)):
        return message.command in READ_COMMANDS
    return isinstance(message, FileTransferProtocol) and message.payload[_OPCODE_OFFSET] in READ_FILES


def rejection_frames(answer: bytes) -> tuple[bytes, ...]:
    """Split the bytes of `RefusalNotice.answer` into frames, and return those that reject a command."""
    return tuple(frame.raw for frame in Framer().receive(answer) if _is_rejection(_decoded(frame)))


def _is_rejection(message: Message | None) -> bool:
    if isinstance(message, CommandAck):
        return message.result == MavResult.TEMPORARILY_REJECTED
    if isinstance(message, Statustext):
        return message.text.startswith(_TEXT_PREFIX)
    return isinstance(message, MissionAck) and message.type == MavMissionResult.DENIED


class ControlLease:
    """The right of one client to command the vehicle.

    A client acquires a free lease with its first command, and holds it until it leaves or is silent for
    `LEASE_TIMEOUT_S`. :meth:`take` acquires it in any case.
    """

    def __init__(self) -> None:
        self._holder: str | None = None  # None if no client has the lease
        self._received_at = 0.0  # time of the last data of the holder

    def holder(self, now: float) -> str | None:
        if self._holder is not None and now - self._received_at > LEASE_TIMEOUT_S:
            self._holder = None
        return self._holder

    def record_activity(self, client: str, now: float) -> None:
        if self.holder(now) == client:
            self._received_at = now

    def acquire(self, client: str, now: float) -> bool:
        """Acquire the lease if it is free. Return True if the client now holds it."""
        if self.holder(now) is None:
            self.take(client, now)
        return self._holder == client

    def take(self, client: str, now: float) -> None:
        self._holder, self._received_at = client, now

    def release(self, client: str) -> None:
        if self._holder == client:
            self._holder = None


class ClientFilter:
    """Accepts the frames that one client may send, and creates notices about refused frames."""

    def __init__(self, client: str, lease: ControlLease) -> None:
        self.refused: int = 0
        """Number of refused frames."""
        self.received_at: float = 0.0
        """Time of the last data of the client; set by the link that owns this filter."""
        self._client, self._lease = client, lease
        self._framer = _framer()
        # Nonce of the program that uses this client name; None before its first datagram.
        self._nonce: int | None = None
        self._nonce_at = 0.0  # time of the last datagram from that program
        self._notices: dict[str, _LastNotice] = {}  # by message name

    def receive(self, data: bytes, mode: ControlMode, now: float, nonce: int = 0) -> tuple[bytes, list[RefusalNotice]]:
        """Process a datagram that is not late. Return the accepted frames, and the notices for the client.

        ``nonce`` distinguishes programs that use the same client name by mistake.
        """
        has_name_conflict = self._has_name_conflict(nonce, mode, now)
        if not has_name_conflict:
            self._lease.record_activity(self._client, now)
        accepted: list[bytes] = []
        notices: list[RefusalNotice] = []
        frames = self._framer.receive(data, now)
        if self._framer.waiting:  # A datagram consists of complete frames, so a partial frame at its end is dropped.
            self._framer = _framer()
        may_control = mode != "never" and not has_name_conflict
        for frame in frames:
            is_allowed = is_read_only(frame) or (may_control and self._lease.acquire(self._client, now))
            if is_allowed:
                accepted.append(frame.raw)
                continue
            holder = self._lease.holder(now) if may_control else None
            if has_name_conflict:
                reason = f"another program uses the client name {self._client}"
            elif holder is None:
                reason = "this link is read-only (control=never)"
            else:
                reason = f"{holder} has control"
            notices += self._refuse(frame, reason, now, holder=holder)
        return b"".join(accepted), notices

    def _has_name_conflict(self, nonce: int, mode: ControlMode, now: float) -> bool:
        """Return True if another program recently used this client name."""
        is_other_program = self._nonce not in (None, nonce)
        is_recent = now - self._nonce_at <= LEASE_TIMEOUT_S
        if is_other_program and is_recent and mode != "take":
            return True
        self._nonce, self._nonce_at = nonce, now
        return False

    def refuse_late(self, data: bytes, now: float) -> list[RefusalNotice]:
        """Refuse the frames of a late datagram. Return the notices for the client."""
        notices: list[RefusalNotice] = []
        for frame in _framer().receive(data, now):
            if is_read_only(frame):
                self.refused += 1
            else:
                notices += self._refuse(frame, "it arrived too late", now, is_late=True)
        return notices

    def _refuse(
        self, frame: Frame, reason: str, now: float, *, holder: str | None = None, is_late: bool = False
    ) -> list[RefusalNotice]:
        """Count a refused frame. Return a list with a notice for the client, or an empty list.

        A notice without an answer is left out for `NOTICE_INTERVAL_S` after a notice about the same type of message.
        """
        self.refused += 1
        message = _decoded(frame)
        name = f"message {frame.message_id}" if message is None else message.NAME
        # A late command gets no answer, because the client may have sent it again. The client would take an answer to
        # the first transmission for an answer to the second one.
        answer = b"" if message is None or is_late else _answer(frame, message, reason)
        last = self._notices.get(name, _LastNotice(sent_at=-NOTICE_INTERVAL_S, unreported=0))
        # A notice with an answer is sent at once, because the client waits for the answer to its command.
        if not answer and now - last.sent_at < NOTICE_INTERVAL_S:
            self._notices[name] = _LastNotice(last.sent_at, last.unreported + 1)
            return []
        if len(self._notices) >= _MAX_NOTICES:
            self._notices.clear()
        self._notices[name] = _LastNotice(now, unreported=0)
        return [RefusalNotice(name, reason, holder, answer, last.unreported + 1)]


class _LastNotice(NamedTuple):
    sent_at: float
    unreported: int  # number of messages that were refused since `sent_at`


def _framer() -> Framer:
    framer = Framer()
    framer.keep_unknown = True  # The client in control may send messages of other dialects.
    return framer


def _decoded(frame: Frame) -> Message | None:
    return None if STANDARD.get(frame.message_id) is None else STANDARD.decode(frame)


def _answer(frame: Frame, message: Message, reason: str) -> bytes:
    """Return the frames by which a vehicle would reject a message. Empty if it needs no answer."""
    answer: Message
    if isinstance(message, (CommandLong, CommandInt)):
        answer = CommandAck(
            message.command, MavResult.TEMPORARILY_REJECTED, progress=0, result_param2=0,
            target_system=frame.system_id, target_component=frame.component_id,
        )  # fmt: skip
    elif isinstance(message, (MissionCount, MissionClearAll, MissionWritePartialList)):
        answer = MissionAck(frame.system_id, frame.component_id, MavMissionResult.DENIED, message.mission_type)
    else:
        return b""
    if message.target_system == 0:
        return b""
    text = Statustext(MavSeverity.WARNING, f"{_TEXT_PREFIX}{reason}"[:_MAX_TEXT_LENGTH])
    # A message for all components (0) is answered by the autopilot (1).
    encoder = FrameEncoder(message.target_system, message.target_component or 1)
    return encoder.encode(text) + encoder.encode(answer)


BEACON_INTERVAL_S = 0.5

MAX_DELAY_S = 2.0
"""Maximum age of a datagram's stamp. A client that received no beacon for this time sends nothing."""

_MAX_NONCES = 256

_MAX_DRIFT = 0.001  # maximum relative drift of two clocks; quartz clocks are ten times better


class FreshnessChecker:
    """Used by the server: makes its beacons, and refuses datagrams that are stamped with a beacon that is too old."""

    def __init__(self, epoch: int) -> None:
        self.epoch: int = epoch
        self.late: int = 0
        """Datagrams refused because their stamp was too old, invalid, missing, or for another server."""
        self.duplicates: int = 0
        """Datagrams refused because the same or a later datagram of the client was already received."""
        self._number = 0  # number of the last beacon
        self._sent: deque[Beacon] = deque()  # beacons whose numbers are accepted in stamps
        self._sequences: OrderedDict[tuple[str, int], int] = OrderedDict()  # (client, nonce) → last sequence number

    def make_beacon(self, now: float, lease_holder: str | None = None) -> Beacon:
        self._expire(now)
        self._number += 1
        beacon = Beacon(self.epoch, self._number, now, lease_holder)
        self._sent.append(beacon)
        return beacon

    def is_fresh(self, stamp: Stamp | None, now: float) -> bool:
        """Return True if the beacon in this stamp is recent."""
        self._expire(now)
        if stamp is not None and stamp.epoch == self.epoch:
            is_fresh = any(beacon.number == stamp.beacon for beacon in self._sent)
        else:
            is_fresh = False
        if not is_fresh:
            self.late += 1
        return is_fresh

    def is_new(self, client: str, stamp: Stamp) -> bool:
        """Return True if neither this datagram nor a later one of the client was received before."""
        key = client, stamp.nonce
        if stamp.sequence <= self._sequences.get(key, 0):
            self.duplicates += 1
            return False
        self._sequences[key] = stamp.sequence
        self._sequences.move_to_end(key)
        if len(self._sequences) > _MAX_NONCES:
            self._sequences.popitem(last=False)  # the client that was silent for longest
        return True

    def _expire(self, now: float) -> None:
        while self._sent and now - self._sent[0].clock_s > MAX_DELAY_S:
            self._sent.popleft()


class DelayEstimator:
    """Estimates by how much received data was slower than the fastest data so far.

    The sender's clock may show any time, but must run at the same rate as ours. A delay that was constant from the
    start is not detected.
    """

    def __init__(self) -> None:
        self._min_offset: float | None = None  # smallest difference so far between receive time and send time
        self._measured_at = 0.0  # time at which `_min_offset` was measured

    def delay(self, sent_s: float, now: float) -> float:
        """Return by how many seconds this data was slower than the fastest data so far.

        ``sent_s`` is the send time on the sender's clock.
        """
        offset = now - sent_s
        if self._min_offset is not None:
            # The clocks may drift apart, so with time a slightly larger offset counts as no delay.
            min_offset = self._min_offset + _MAX_DRIFT * (now - self._measured_at)
            if offset > min_offset:
                return offset - min_offset
        self._min_offset, self._measured_at = offset, now
        return 0.0


class ServerTracker:
    """Used by clients: tracks the server, and stamps datagrams with its last beacon."""

    def __init__(self, nonce: int, mode: ControlMode = "free") -> None:
        self.epoch: int | None = None
        """Epoch of the tracked server; None before the first beacon."""
        self.lease_holder: str | None = None
        """Client that holds the control lease according to the last beacon; None: free."""
        self.late: int = 0
        """Number of datagrams and beacons dropped because they arrived too late."""
        self.foreign: int = 0
        """Number of datagrams and beacons dropped because another server with the same name sent them."""
        self.received_at: float = 0.0
        """Time of the last valid beacon."""
        self.mode: ControlMode = mode
        """Control that the next stamps request."""
        self._nonce = nonce
        self._beacon_number = 0  # number of the last valid beacon; 0 if there is none
        self._sequence = 0  # number of the last datagram sent
        self._delays = DelayEstimator()

    def receive_beacon(self, beacon: Beacon, now: float) -> bool:
        """Record a beacon. Return False for a beacon that is ignored.

        A beacon is ignored if it is late, if a newer one was already received, or if another server has sent it.
        """
        if beacon.epoch != self.epoch:
            if self.epoch is not None and not self.is_silent(now):
                self.foreign += 1
                return False
            self.epoch = beacon.epoch
            self._beacon_number = 0
            self._delays = DelayEstimator()
        elif beacon.number <= self._beacon_number:  # A newer beacon was already received.
            return False
        if self._delays.delay(beacon.clock_s, now) > MAX_DELAY_S:
            self.late += 1
            return False
        self._beacon_number = beacon.number
        self.received_at = now
        self.lease_holder = beacon.lease_holder
        return True

    def accepts(self, sent: SendTime, now: float) -> bool:
        """Return True if a datagram is on time and from the tracked server."""
        if sent.epoch != self.epoch:
            self.foreign += 1
            return False
        if self._delays.delay(sent.clock_s, now) > MAX_DELAY_S:
            self.late += 1
            return False
        return True

    def make_stamp(self, now: float) -> Stamp | None:
        """Return a stamp for a datagram; None if no datagram may be sent, because no beacon arrived recently."""
        if self.epoch is None or self.is_silent(now):
            return None
        self._sequence += 1
        return Stamp(self.epoch, self._beacon_number, self._nonce, self._sequence, self.mode)

    def is_silent(self, now: float) -> bool:
        return self._beacon_number == 0 or now - self.received_at > MAX_DELAY_S

    def reset(self) -> None:
        self.epoch = self.lease_holder = None
        self._beacon_number = 0
