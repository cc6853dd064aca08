"""MAVLink 2 signing: `SigningKey`, and `Signing`, which signs and verifies the frames of one link.

A signature proves that the sender has the key, and that the frame is not a replay; nothing is encrypted. The time is an
argument, because this module has no clock. https://mavlink.io/en/guide/message_signing.html

Timestamps are persisted here, not by the connection or the program, because a frame must not be sent before a later
timestamp is on disk.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from hashlib import sha256
from hmac import compare_digest
from os import PathLike
from pathlib import Path

from aerokit._internal.files import write_atomically
from aerokit.errors import FileFormatError, InvalidArgument
from aerokit.mavlink.frame import RADIO_MESSAGE_IDS, SIGNATURE_LENGTH, SIGNED, Frame

KEY_LENGTH = 32

TICKS_PER_S = 100_000  # one tick of a timestamp is 10 µs

EPOCH_S = 1_420_070_400  # 2015-01-01 in seconds since 1970; timestamps count from then

LAST_TIMESTAMP = (1 << 48) - 1

ONE_MINUTE = 60 * TICKS_PER_S

# Maximum number of stored streams. A stream is a (system id, component id, link id); only senders with the key can
# create one.
MAX_STREAMS = 1024

# Maximum number of stored own signatures: those of a minute, with 270 frames a second. A replay that is older than a
# minute is refused as too old, unless its sender is also received.
MAX_OWN_SIGNATURES = 16_384

_HASH_LENGTH = 6

_NO_KEY = bytes(KEY_LENGTH)

AllowUnsigned = Callable[[Frame], bool]


def timestamp_at(unix_time_s: float) -> int:
    """Convert a Unix time to a signing timestamp; 0 for times before 2015."""
    return max(0, int((unix_time_s - EPOCH_S) * TICKS_PER_S))


def is_signed_with_a_key(frame: Frame) -> bool:
    # While PX4 has no key, it signs with zeros.
    raw = frame.raw
    return bool(frame.incompat_flags & SIGNED) and (
        sha256(_NO_KEY + raw[:-_HASH_LENGTH]).digest()[:_HASH_LENGTH] != raw[-_HASH_LENGTH:]
    )


def _stream_and_timestamp(frame: Frame) -> tuple[tuple[int, int, int], int]:
    """Return (system id, component id, link id) and the timestamp of a signed frame."""
    link_id, *timestamp = frame.raw[-SIGNATURE_LENGTH:-_HASH_LENGTH]
    return (frame.system_id, frame.component_id, link_id), int.from_bytes(timestamp, "little")


class SigningKey:
    """The shared secret of 32 bytes. ``repr`` shows only a short fingerprint, so that logs do not reveal the key."""

    __slots__ = ("_secret",)

    def __init__(self, secret: bytes) -> None:
        """Create a key. InvalidArgument if ``secret`` is not 32 bytes, or is all zeros ("no signing" in MAVLink)."""
        if not isinstance(secret, (bytes, bytearray)) or len(secret) != KEY_LENGTH:
            raise InvalidArgument("a signing key must be 32 bytes; use SigningKey.from_passphrase for a text")
        if not any(secret):
            raise InvalidArgument("a signing key must not be all zeros, because such a key turns signing off")
        self._secret = bytes(secret)

    @classmethod
    def from_passphrase(cls, passphrase: str) -> SigningKey:
        """Hash a passphrase with SHA-256, as Mission Planner, MAVProxy and QGroundControl do.

        Raises:
            InvalidArgument: the passphrase is empty.
        """
        if not passphrase:
            raise InvalidArgument("the passphrase of a signing key must not be empty")
        return cls(sha256(passphrase.encode()).digest())

    @classmethod
    def from_text(cls, text: str) -> SigningKey:
        """Parse 64 hexadecimal digits as a key, any other text as a passphrase. Surrounding spaces are ignored."""
        text = text.strip()
        try:
            secret = bytes.fromhex(text) if len(text) == 2 * KEY_LENGTH else b""
        except ValueError:
            secret = b""
        return cls(secret) if len(secret) == KEY_LENGTH else cls.from_passphrase(text)

    @property
    def secret(self) -> bytes:
        """The 32 bytes. Anyone who has them can command the vehicle."""
        return self._secret

    @property
    def fingerprint(self) -> str:
        """Eight hexadecimal digits that identify the key, without revealing it."""
        return sha256(b"aerokit signing key" + self._secret).hexdigest()[:8]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SigningKey) and compare_digest(self._secret, other._secret)

    def __hash__(self) -> int:
        return hash(self._secret)

    def __repr__(self) -> str:
        return f"<SigningKey {self.fingerprint}>"


class Refusal(Enum):
    """Reasons for dropping a frame. The value is the reason in words."""

    UNSIGNED = "it is not signed"
    WRONG_SIGNATURE = "it is signed with another key, or was changed in transit"
    REPLAYED = "its timestamp is not later than the last one of its sender: the frame was replayed or overtaken"
    TOO_OLD = "its sender is new, and its timestamp is more than a minute behind ours"


class Signing:
    """Signs the sent frames of one link, verifies the received frames, and counts refused frames.

    Use a separate object for each link. For further links with the same key, create the objects with :meth:`for_link`.
    An object can be reused after its link is closed.
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
        """Create signing for one link.

        Args:
            key: the key; the other side must have the same key.
            link_id: distinguishes the links of one sender, 0–255. Programs with the same system and component id need
                different link ids.
            timestamp: the last value of :attr:`timestamp` with this key (10 µs since 2015), for computers whose clock
                may be wrong. A later time of the clock takes precedence.
            allow_unsigned: called with each frame without a valid signature; returns True to accept it, for example
                from a camera without a key. Anyone can send such frames. RADIO_STATUS and RADIO, which telemetry radios
                send, are always accepted.
            keep: a file that stores the timestamp, so that a restarted program refuses frames from before the restart.
                Each key needs a separate file, and two programs must not use one file at the same time. The file is
                replaced atomically, at most twice a minute. Its timestamp is up to half a minute in the future.

        Raises:
            InvalidArgument: a number is out of range, or ``key`` is not a SigningKey.
            FileFormatError: the file of ``keep`` does not contain a timestamp.
            OSError: the file cannot be read or written. Later errors are in :attr:`keep_error`; signing continues.
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
        """Minimum timestamp of the next frame, in 10 µs since 2015: later than all timestamps sent, and not earlier
        than any received. Programs on computers without a reliable clock store this value across restarts."""
        self.allow_unsigned = allow_unsigned
        self.refused: dict[Refusal, int] = dict.fromkeys(Refusal, 0)
        """Number of frames refused, for each reason."""
        self._timestamp_file: TimestampFile | None = None  # None without ``keep``
        if keep is not None:
            self._timestamp_file = TimestampFile(keep, LAST_TIMESTAMP)
            self.timestamp = max(self.timestamp, self._timestamp_file.timestamp)
        # The key is the first input of each signature's hash. It is hashed once, and the hash object is then copied.
        self._keyed = sha256(key.secret)
        self.streams: dict[tuple[int, int, int], int] = {}
        """Last timestamp of each (system id, component id, link id). Objects from :meth:`for_link` share this dict."""
        # Hashes of our last signatures, in the order of signing. If one of our frames is replayed to us, `streams` does
        # not show it, because we have not received the frame before.
        self._own_signatures: dict[bytes, None] = {}

    def for_link(self, link_id: int) -> Signing:
        """Return a `Signing` for another link (0–255) with the same key.

        If one of the two has accepted a frame, the other refuses this frame as a replay.
        """
        signing = Signing(self.key, link_id=link_id, timestamp=self.timestamp, allow_unsigned=self.allow_unsigned)
        signing.streams = self.streams
        signing._own_signatures = self._own_signatures
        signing._timestamp_file = self._timestamp_file
        return signing

    def timestamp_now(self, now: float = 0.0) -> int:
        """Return the timestamp of a frame signed at ``now`` (seconds since 1970; 0 without a clock)."""
        return max(self.timestamp, timestamp_at(now))

    def sign(self, frame: bytes, now: float = 0.0) -> bytes:
        """Return the 13 bytes to append to a whole MAVLink 2 frame with the `SIGNED` flag.

        ``now`` is in seconds since 1970. 0 means that there is no clock; the previous timestamp is then incremented.

        Raises:
            InvalidArgument: no later timestamp fits into 48 bits, so another key is needed.
        """
        timestamp = self.timestamp_now(now)
        if timestamp > LAST_TIMESTAMP:
            raise InvalidArgument(f"the timestamps of {self.key!r} are exhausted: use another key")
        self._advance(timestamp + 1)  # The next frame must have a later timestamp.
        link_and_timestamp = bytes((self.link_id,)) + timestamp.to_bytes(6, "little")
        signature_hash = self._hash(frame + link_and_timestamp)
        self._own_signatures[signature_hash] = None
        if len(self._own_signatures) > MAX_OWN_SIGNATURES:
            del self._own_signatures[next(iter(self._own_signatures))]
        return link_and_timestamp + signature_hash

    def accepts(self, frame: Frame, now: float = 0.0) -> bool:
        """Return True if a frame has a valid signature, or needs none. Other frames are counted as refused."""
        return self.check(frame, now) is None

    def check(self, frame: Frame, now: float = 0.0) -> Refusal | None:
        """Like :meth:`accepts`, but return the reason for refusing a frame; None if it is accepted.

        ``now`` is the time in seconds since 1970; 0 if it is unknown.
        """
        refusal = self._check_signature(frame, now)
        if refusal is None or self.may_be_unsigned(frame):
            return None
        self.refused[refusal] += 1
        return refusal

    @property
    def keep_error(self) -> OSError | None:
        """Error of the last write of the ``keep`` file; None if it succeeded. A retry follows after half a minute."""
        return None if self._timestamp_file is None else self._timestamp_file.error

    @property
    def frames_refused(self) -> int:
        """Number of frames refused, for any reason."""
        return sum(self.refused.values())

    def has_signed(self, frame: Frame) -> bool:
        """Return True if a frame was signed with this key, whatever its timestamp. Has no side effects."""
        raw = frame.raw
        return bool(frame.incompat_flags & SIGNED) and compare_digest(
            self._hash(raw[:-_HASH_LENGTH]), raw[-_HASH_LENGTH:]
        )

    def would_accept(self, frame: Frame, now: float = 0.0) -> bool:
        """Return True if a frame has a valid signature and a new timestamp. Has no side effects."""
        return self._refusal(frame, now) is None

    def _check_signature(self, frame: Frame, now: float) -> Refusal | None:
        """Like `_refusal`, but store the timestamp of a valid signature."""
        refusal = self._refusal(frame, now)
        if refusal is None:
            # With the timestamp stored, the frame cannot be replayed.
            self._store_timestamp(*_stream_and_timestamp(frame))
        return refusal

    def _refusal(self, frame: Frame, now: float) -> Refusal | None:
        """Return the reason to refuse a frame; None if its signature is valid and its timestamp is new."""
        if not frame.incompat_flags & SIGNED:
            return Refusal.UNSIGNED
        if not self.has_signed(frame):
            return Refusal.WRONG_SIGNATURE
        if frame.raw[-_HASH_LENGTH:] in self._own_signatures:
            return Refusal.REPLAYED
        stream, timestamp = _stream_and_timestamp(frame)
        last = self.streams.get(stream)
        if last is None:
            if timestamp + ONE_MINUTE < self.timestamp_now(now):
                return Refusal.TOO_OLD
        elif timestamp <= last:
            return Refusal.REPLAYED
        return None

    def _store_timestamp(self, stream: tuple[int, int, int], timestamp: int) -> None:
        # Remove the stream with the oldest timestamp. Its next frame counts as the first frame of a new sender.
        if stream not in self.streams and len(self.streams) >= MAX_STREAMS:
            del self.streams[min(self.streams, key=self.streams.__getitem__)]
        self.streams[stream] = timestamp
        self._advance(max(self.timestamp, timestamp))

    def _advance(self, timestamp: int) -> None:
        # Store the timestamp before using it: even after a crash, the next program then starts with a later timestamp.
        if self._timestamp_file is not None:
            # After a restart, our timestamps may be half a minute ahead of other senders'. Receivers accept a minute.
            self._timestamp_file.reserve(timestamp, ONE_MINUTE // 2)
        self.timestamp = timestamp

    def may_be_unsigned(self, frame: Frame) -> bool:
        """Return True if a frame is accepted without a valid signature."""
        if frame.message_id in RADIO_MESSAGE_IDS:
            return True
        return self.allow_unsigned is not None and bool(self.allow_unsigned(frame))

    def _hash(self, data: bytes) -> bytes:
        digest = self._keyed.copy()
        digest.update(data)
        return digest.digest()[:_HASH_LENGTH]

    def __repr__(self) -> str:
        return f"<Signing {self.key.fingerprint} link {self.link_id}, {self.frames_refused} frames refused>"


_MAX_LENGTH = 64


class TimestampFile:
    """A file with a timestamp that is later than all timestamps used so far.

    The constructor raises OSError, or FileFormatError if the file does not contain a timestamp. :meth:`reserve` stores
    errors in ``error`` instead of raising them, because it is called in flight.
    """

    def __init__(self, path: str | PathLike[str], maximum: int) -> None:
        self._path, self._maximum = Path(path), maximum
        self.timestamp: int = self._read()
        """Timestamp of the last write, also if it failed; 0 if there is no file."""
        self.error: OSError | None = None
        """Error of the last write; None if the write succeeded."""
        self._write(self.timestamp)  # Fails at once if the file is not writable, rather than in flight.

    def reserve(self, timestamp: int, ahead: int) -> None:
        """Write ``timestamp + ahead`` if ``timestamp`` has reached the timestamp of the last write; else do nothing."""
        if timestamp < self.timestamp:
            return
        # Set the attribute even if the write fails: a retry for every frame might block the event loop each time.
        self.timestamp = min(timestamp + ahead, self._maximum)
        try:
            self._write(self.timestamp)
            self.error = None
        except OSError as error:  # Signing continues without the file. `Signing.keep_error` reports the error.
            self.error = error

    def _write(self, timestamp: int) -> None:
        write_atomically(self._path, f"{timestamp}\n")

    def _read(self) -> int:
        try:
            with self._path.open("rb") as file:
                text = file.read(_MAX_LENGTH).decode("ascii", "replace")
        except FileNotFoundError:
            return 0
        if not (text.strip().isdecimal() and int(text) <= self._maximum):
            raise FileFormatError(f"{self._path} does not contain a signing timestamp: {text[:40]!r}")
        return int(text)
