"""MAVLink 2 signing: `SigningKey`, and `Signing`, which signs the frames of one link and checks those it brings.

A signature says that who sent the frame has the key, and that the frame is not an old one played again; nothing is
encrypted. No clock here: the time comes as an argument. https://mavlink.io/en/guide/message_signing.html

It is written here, and not by a program or a connection, because no frame may leave with a time stamp that is not on
the disk yet: only who makes the signature knows when that is.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from hashlib import sha256
from hmac import compare_digest
from os import PathLike
from pathlib import Path

from aerokit._internal.files import write_whole
from aerokit.errors import FileFormatError, InvalidArgument
from aerokit.mavlink.frame import SIGNATURE_LENGTH, SIGNED, Frame

KEY_LENGTH = 32

TICKS_PER_S = 100_000
"""A tick of a time stamp is 10 microseconds."""

EPOCH_S = 1_420_070_400
"""Time stamps begin in 2015; this is then in seconds since 1970."""

LAST_TIMESTAMP = (1 << 48) - 1

ONE_MINUTE = 60 * TICKS_PER_S

MOST_STREAMS = 1024
"""So many (system id, component id, link id) are remembered; only who has the key makes any."""

ALWAYS_UNSIGNED = frozenset((109, 166))
"""RADIO_STATUS and RADIO: telemetry radios put them between the frames, and have no key."""

_HASH_LENGTH = 6

_NO_KEY = bytes(KEY_LENGTH)

AllowUnsigned = Callable[[Frame], bool]


def timestamp_at(unix_time_s: float) -> int:
    """The time stamp of an instant, given in seconds since 1970; 0 for everything before 2015."""
    return max(0, int((unix_time_s - EPOCH_S) * TICKS_PER_S))


def is_signed_with_a_key(frame: Frame) -> bool:
    """Whether a frame has a signature that says anything: PX4 without a key signs with one of zeros, as anybody can."""
    raw = frame.raw
    return bool(frame.incompat_flags & SIGNED) and (
        sha256(_NO_KEY + raw[:-_HASH_LENGTH]).digest()[:_HASH_LENGTH] != raw[-_HASH_LENGTH:]
    )


class SigningKey:
    """The 32 bytes that both sides know. Its text is a short fingerprint, so that it can be named and never leaks."""

    __slots__ = ("_secret",)

    def __init__(self, secret: bytes) -> None:
        """Take 32 bytes that are not all zero (zeros mean "no signing" on the wire); InvalidArgument otherwise."""
        if not isinstance(secret, (bytes, bytearray)) or len(secret) != KEY_LENGTH:
            raise InvalidArgument("a signing key must be 32 bytes; SigningKey.from_passphrase takes a text")
        if not any(secret):
            raise InvalidArgument("a signing key of zeros only is no key: it turns signing off")
        self._secret = bytes(secret)

    @classmethod
    def from_passphrase(cls, passphrase: str) -> SigningKey:
        """The SHA-256 of a text, as Mission Planner, MAVProxy and QGroundControl make a key of it.

        InvalidArgument for an empty one.
        """
        if not passphrase:
            raise InvalidArgument("the passphrase of a signing key is empty")
        return cls(sha256(passphrase.encode()).digest())

    @classmethod
    def from_text(cls, text: str) -> SigningKey:
        """64 hexadecimal digits are the key itself, anything else is a passphrase; spaces around it do not count."""
        text = text.strip()
        try:
            secret = bytes.fromhex(text) if len(text) == 2 * KEY_LENGTH else b""
        except ValueError:
            secret = b""
        return cls(secret) if len(secret) == KEY_LENGTH else cls.from_passphrase(text)

    @property
    def secret(self) -> bytes:
        """The 32 bytes. Whoever has them can command the vehicle."""
        return self._secret

    @property
    def fingerprint(self) -> str:
        """Eight hexadecimal digits to tell keys apart by; the key cannot be worked out from them."""
        return sha256(b"aerokit signing key" + self._secret).hexdigest()[:8]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SigningKey) and compare_digest(self._secret, other._secret)

    def __hash__(self) -> int:
        return hash(self._secret)

    def __repr__(self) -> str:
        return f"<SigningKey {self.fingerprint}>"


class Refusal(Enum):
    """Why a frame was not let in; the value is the reason in words."""

    UNSIGNED = "it is not signed"
    WRONG_SIGNATURE = "it is signed with another key, or was changed on its way"
    REPLAYED = (
        "its time stamp is not later than the last one of its sender: an old frame, played again or overtaken"
    )
    TOO_OLD = "its sender was not heard before, and its time stamp is more than a minute behind ours"


class Signing:
    """One key on one link: signs what we send there, checks what we receive there, and counts what was refused.

    It keeps the time stamps, so use one for each link, and :meth:`for_link` for another link with the same key. May be
    used again when its link is closed and another one is opened.
    """

    def __init__(
        self,
        key: SigningKey,
        *,
        link_id: int = 0,
        timestamp: int = 0,
        allow_unsigned: AllowUnsigned | None = None,
        keep: str | PathLike[str] | None = None,
    ) -> None:
        """Begin with a key.

        Args:
            key: the key that the other side has, too.
            link_id: tells the links of one sender apart, 0–255. Two programs with the same system and component id
                need different ones.
            timestamp: what :attr:`timestamp` was when the key was last used, where the clock cannot be relied on to
                be later (10 µs since 2015). The clock's time counts when it is later.
            allow_unsigned: ``allow_unsigned(frame)`` says whether a frame is let in that carries no good signature:
                of a camera without a key, for example. Anybody can send such a frame. None: no such frame but
                RADIO_STATUS, which telemetry radios send.
            keep: a file that the library keeps the time stamp in, so that nothing that was heard or sent before a
                restart is accepted after it. One for each key, and not for two programs at once. It holds a time
                stamp up to half a minute ahead, from which the next program goes on: so it is written twice a minute at
                most, whole or not at all, and before the time stamps are used.

        Raises:
            InvalidArgument: a number is out of range, or ``key`` is no key.
            FileFormatError: the file of ``keep`` holds no time stamp.
            OSError: it cannot be read or written. Later :attr:`keep_error` tells; signing goes on.
        """
        if not isinstance(key, SigningKey):
            raise InvalidArgument("key must be a SigningKey: SigningKey(32 bytes), or from_passphrase(text)")
        if not 0 <= link_id <= 255:
            raise InvalidArgument(f"link_id = {link_id!r} must be in 0..255")
        if not 0 <= timestamp <= LAST_TIMESTAMP:
            raise InvalidArgument(f"timestamp = {timestamp!r} must be in 0..{LAST_TIMESTAMP}")
        self.key = key
        self.link_id: int = int(link_id)
        self.timestamp: int = int(timestamp)
        """The earliest time stamp that the next frame gets, in 10 µs since 2015: later than all that were sent, and not
        before any that was received. Keep it where it survives a restart if the clock does not."""
        self.allow_unsigned = allow_unsigned
        self.refused: dict[Refusal, int] = dict.fromkeys(Refusal, 0)
        """How many frames were refused, for each reason."""
        self._kept: TimestampFile | None = None
        if keep is not None:
            self._kept = TimestampFile(keep, LAST_TIMESTAMP)
            self.timestamp = max(self.timestamp, self._kept.timestamp)
        self._keyed = sha256(key.secret)
        self.streams: dict[tuple[int, int, int], int] = {}
        """The last time stamp of each (system id, component id, link id); all links with the key share it."""

    def for_link(self, link_id: int) -> Signing:
        """The same key on another link (0–255): what was played on one of them cannot be played again on the other."""
        other = Signing(
            self.key, link_id=link_id, timestamp=self.timestamp, allow_unsigned=self.allow_unsigned
        )
        other.streams, other._kept = self.streams, self._kept
        return other

    def timestamp_now(self, now: float = 0.0) -> int:
        """The time stamp that a frame signed at ``now`` (seconds since 1970, 0: there is no clock) would get."""
        return max(self.timestamp, timestamp_at(now))

    def sign(self, frame: bytes, now: float = 0.0) -> bytes:
        """The 13 bytes that go behind a whole MAVLink 2 frame whose header says that it is signed.

        ``now`` is seconds since 1970; 0: there is no clock, and time stamps just count on. InvalidArgument when
        48 bits hold no later time stamp: this key has come to its end.
        """
        stamp = self.timestamp_now(now)
        if stamp > LAST_TIMESTAMP:
            raise InvalidArgument(f"the time stamps of {self.key!r} are used up: agree on another key")
        self._advance(stamp + 1)
        place = bytes((self.link_id,)) + stamp.to_bytes(6, "little")
        return place + self._hash(frame + place)

    def accepts(self, frame: Frame, now: float = 0.0) -> bool:
        """Whether to let a frame in: one with a good signature, or one that may do without. Others are counted."""
        return self.check(frame, now) is None

    def check(self, frame: Frame, now: float = 0.0) -> Refusal | None:
        """As :meth:`accepts`, but says why not; ``now`` is seconds since 1970, 0 when there is no clock."""
        refusal = self._check_signature(frame, now)
        if refusal is None or self.may_be_unsigned(frame):
            return None
        self.refused[refusal] += 1
        return refusal

    @property
    def keep_error(self) -> OSError | None:
        """Why the file of ``keep`` could not be written the last time, or None; it is tried again."""
        return None if self._kept is None else self._kept.error

    @property
    def frames_refused(self) -> int:
        """How many frames were refused, for whatever reason."""
        return sum(self.refused.values())

    def has_signed(self, frame: Frame) -> bool:
        """Whether a frame was signed with this key, at whatever time; nothing is counted or remembered."""
        raw = frame.raw
        return bool(frame.incompat_flags & SIGNED) and compare_digest(
            self._hash(raw[:-_HASH_LENGTH]), raw[-_HASH_LENGTH:]
        )

    def would_accept(self, frame: Frame, now: float = 0.0) -> bool:
        """Whether a frame has a good signature and no old time stamp; nothing is counted or remembered."""
        return self._refusal(frame, now) is None

    def _check_signature(self, frame: Frame, now: float) -> Refusal | None:
        refusal = self._refusal(frame, now)
        if refusal is None:
            signature = frame.raw[-SIGNATURE_LENGTH:]
            stamp = int.from_bytes(signature[1:7], "little")
            self._remember((frame.system_id, frame.component_id, signature[0]), stamp)
        return refusal

    def _refusal(self, frame: Frame, now: float) -> Refusal | None:
        if not frame.incompat_flags & SIGNED:
            return Refusal.UNSIGNED
        if not self.has_signed(frame):
            return Refusal.WRONG_SIGNATURE
        signature = frame.raw[-SIGNATURE_LENGTH:]
        stamp = int.from_bytes(signature[1:7], "little")
        stream = (frame.system_id, frame.component_id, signature[0])
        last = self.streams.get(stream)
        if last is None:
            if stamp + ONE_MINUTE < self.timestamp_now(now):
                return Refusal.TOO_OLD
        elif stamp <= last:
            return Refusal.REPLAYED
        return None

    def _remember(self, stream: tuple[int, int, int], stamp: int) -> None:
        """Of a sender that is forgotten, time stamps are compared with ours, as of one that was never heard."""
        if stream not in self.streams and len(self.streams) >= MOST_STREAMS:
            del self.streams[min(self.streams, key=self.streams.__getitem__)]
        self.streams[stream] = stamp
        self._advance(max(self.timestamp, stamp))

    def _advance(self, timestamp: int) -> None:
        """Kept before it is used: after a crash at any instant, the next program begins later."""
        if self._kept is not None:
            self._kept.reserve(timestamp, ONE_MINUTE // 2)  # a sender may be a minute behind
        self.timestamp = timestamp

    def may_be_unsigned(self, frame: Frame) -> bool:
        """Whether a frame without a good signature is let in."""
        if frame.message_id in ALWAYS_UNSIGNED:
            return True
        return self.allow_unsigned is not None and bool(self.allow_unsigned(frame))

    def _hash(self, data: bytes) -> bytes:
        digest = self._keyed.copy()
        digest.update(data)
        return digest.digest()[:_HASH_LENGTH]

    def __repr__(self) -> str:
        return f"<Signing {self.key.fingerprint} link {self.link_id}, {self.frames_refused} frames refused>"


_LONGEST = 64


class TimestampFile:
    """Holds one number: all time stamps that were used are below it.

    FileFormatError for other contents, OSError when it cannot be read or written. What goes wrong later does not stop a
    flight: ``error`` has it, until the file has been written again.
    """

    def __init__(self, path: str | PathLike[str], most: int) -> None:
        self._path, self._most = Path(path), most
        self.timestamp: int = self._read()
        """The number in the file; 0 when there was none."""
        self.error: OSError | None = None
        """Why it could not be written the last time."""
        self._write(self.timestamp)

    def reserve(self, timestamp: int, ahead: int) -> None:
        """See to it that the file holds more than this number, ``ahead`` more if it has to be written."""
        if timestamp < self.timestamp:
            return
        self.timestamp = min(timestamp + ahead, self._most)
        try:
            self._write(self.timestamp)
            self.error = None
        except OSError as error:
            self.error = error

    def _write(self, timestamp: int) -> None:
        write_whole(self._path, f"{timestamp}\n")

    def _read(self) -> int:
        try:
            with self._path.open("rb") as file:
                text = file.read(_LONGEST).decode("ascii", "replace")
        except FileNotFoundError:
            return 0
        if not (text.strip().isdecimal() and int(text) <= self._most):
            raise FileFormatError(f"{self._path} holds no time stamp of signing: {text[:40]!r}")
        return int(text)
