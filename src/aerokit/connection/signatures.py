"""``SignatureFilter``: signs the frames of a connection and refuses received frames without a valid signature."""

from __future__ import annotations

import asyncio
import logging
import math
from contextlib import contextmanager
from typing import TYPE_CHECKING

from aerokit.errors import BusyError, InvalidArgument
from aerokit.events import FrameRefused
from aerokit.mavlink.frame import SIGNED

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from aerokit.events import Event
    from aerokit.mavlink.encoder import FrameEncoder
    from aerokit.mavlink.frame import Frame
    from aerokit.mavlink.messages import Heartbeat
    from aerokit.mavlink.signing import Refusal, Signing, SigningKey

logger: logging.Logger = logging.getLogger("aerokit")

# This many unsigned frames, over MIN_UNSIGNED_S, prove that the vehicle has removed its key, because a vehicle with a
# key sends a signed heartbeat each second.
MIN_UNSIGNED_FRAMES = 3
MIN_UNSIGNED_S = 2.0

# For this time after a switch to another key, delayed frames with the former key may arrive. They do not prove that the
# component uses the former key again.
DELAYED_FRAMES_S = 2.0


class SignatureFilter:
    """Admits the frames that the encoder's ``signing`` accepts, or all frames while that is None.

    The first refusal for each reason is logged and published as an event. ``unix_time`` returns seconds since 1970.
    """

    def __init__(
        self, encoder: FrameEncoder, unix_time: Callable[[], float], publish: Callable[[Event], object]
    ) -> None:
        self._encoder, self._unix_time, self._publish = encoder, unix_time, publish
        self._reported: set[Refusal] = set()  # reasons that were already logged
        self._handover: _Handover | None = None  # None before a handover, and after the switch to the new key
        self._left_keys: dict[SigningKey, float] = {}  # maps former keys to the time of the switch to the next key
        self._timestamp = 0  # timestamp of the last `Signing` that was replaced
        self._is_handing_over = False  # True inside the `with` block of key_handover()
        self._logged_keep_error: OSError | None = None  # last logged error of writing the file of ``Signing(keep=…)``
        self.admits_all: bool = True
        """True while no frame needs a check."""
        self.on_change: Callable[[], object] = lambda: None
        """Called when :attr:`admits_all` may have changed."""

    def set_signing(self, signing: Signing | None) -> None:
        """Sign and verify with this key from now on (None: neither). Raises InvalidArgument with MAVLink 1."""
        check_signing(signing, self._encoder.version)
        former = self._encoder.signing
        if former is not None:
            self._timestamp = max(self._timestamp, former.timestamp)
        if signing is not None:
            # ArduPilot remembers our last timestamp, whatever the key was (signing_streams in GCS_Signing.cpp), and
            # refuses frames with an earlier one.
            signing.timestamp = max(signing.timestamp, self._timestamp)
        self._encoder.signing = signing
        self._update()

    def check_version(self, mavlink_version: int) -> None:
        """Raise InvalidArgument if a key is set and this MAVLink version has no signatures."""
        check_signing(self._encoder.signing, mavlink_version)
        if self._handover is not None:
            check_signing(self._handover.signing, mavlink_version)

    @contextmanager
    def key_handover(self, signing: Signing | None, system_id: int, component_id: int) -> Iterator[asyncio.Event]:
        """Switch to ``signing`` when frames of the component show that it uses the new key.

        Until then, the old key signs and verifies. The switch sets the yielded event. With ``signing=None``, the
        component is to stop signing. Raises BusyError if another handover is in progress.
        """
        check_signing(signing, self._encoder.version)
        if self._is_handing_over:
            raise BusyError("setup_signing: another key handover on this connection is in progress")
        self._is_handing_over = True
        switched = asyncio.Event()
        left_at = -math.inf if signing is None else self._left_keys.get(signing.key, -math.inf)
        not_before = left_at + DELAYED_FRAMES_S
        self._handover = _Handover(signing, (system_id, component_id), switched, not_before)
        self._update()
        try:
            yield switched
        finally:
            self._handover, self._is_handing_over = None, False
            self._update()

    def _update(self) -> None:
        self.admits_all = self._encoder.signing is None and self._handover is None
        self.on_change()

    def admits(self, frame: Frame, *, may_hand_over: bool = True) -> bool:
        """Return True if a frame may be delivered. A frame with the new key causes the switch of :meth:`key_handover`.

        ``may_hand_over`` is False if the frame did not come from the component's own peer. It then causes no switch.
        """
        handover = self._handover
        is_of_handover = handover is not None and may_hand_over and handover.concerns(frame)
        if handover is not None and is_of_handover and handover.is_proved_by(frame, self._unix_time()):
            self._handover = None
            former, now = self._encoder.signing, frame.received_at
            self._left_keys = {key: at for key, at in self._left_keys.items() if now - at < DELAYED_FRAMES_S}
            if former is not None:
                self._left_keys[former.key] = now
            self.set_signing(handover.signing)
            handover.switched.set()
        signing = self._encoder.signing
        if signing is None:
            return True
        try:
            if is_of_handover and not _is_signed_with_a_key(frame):
                # During the handover, the vehicle may be without a key. Its unsigned frames are therefore neither
                # reported nor counted as refused.
                return signing.may_be_unsigned(frame)
            refusal = signing.check(frame, self._unix_time())
        except Exception:  # Only `allow_unsigned`, a function of the program, can raise here.
            logger.exception("the check of a frame by %r raised an exception; the frame was refused", signing)
            return False
        if refusal is not None and refusal not in self._reported:
            self._reported.add(refusal)
            self._report(frame, signing, refusal)
        return refusal is None

    def has_verified(self, frame: Frame) -> bool:
        """Return True if an admitted frame has a signature that was verified with our key."""
        # A frame that may be unsigned is admitted with any signature, also a forged or replayed one.
        signing = self._encoder.signing
        return signing is not None and bool(frame.incompat_flags & SIGNED) and not signing.may_be_unsigned(frame)

    def _report(self, frame: Frame, signing: Signing, refusal: Refusal) -> None:
        source = frame.system_id, frame.component_id
        logger.warning(
            "a frame of %d/%d was refused: %s (%r); further frames refused for this reason are counted, but not logged",
            *source,
            refusal.value,
            signing.key,
        )
        self._publish(FrameRefused(frame.received_at, *source, refusal.value))

    def log_storage_errors(self) -> None:
        signing = self._encoder.signing
        error = None if signing is None else signing.keep_error
        if error is not None and self._logged_keep_error is None:
            logger.error("the time stamp of %r cannot be stored: %s", signing, error)
        self._logged_keep_error = error

    def describe(self, heartbeats: Iterable[Heartbeat]) -> str:
        """Return a hint for error texts about refused frames, or about signed heartbeats without a key. "" if none."""
        signing = self._encoder.signing
        if signing is not None:
            refused = "; ".join(f"{count}: {reason.value}" for reason, count in signing.refused.items() if count)
            return f"frames were refused ({refused}) by {signing.key!r}" if refused else ""
        frames = (heartbeat.received_frame for heartbeat in heartbeats)
        is_signed = any(frame is not None and _is_signed_with_a_key(frame) for frame in frames)
        return "its frames are signed and no key was given (signing=…)" if is_signed else ""


def _is_signed_with_a_key(frame: Frame) -> bool:
    from aerokit.mavlink.signing import is_signed_with_a_key  # imports hashlib, which few programs need

    return is_signed_with_a_key(frame)


class _Handover:
    """A key handover in progress: one component is changing to another signing key, or to none."""

    def __init__(
        self, signing: Signing | None, source: tuple[int, int], switched: asyncio.Event, not_before: float
    ) -> None:
        self.signing, self.switched = signing, switched
        self._source = source  # (system id, component id)
        self._not_before = not_before  # Frames that were received earlier prove nothing.
        # Number of unsigned frames since the last signed one, and the time of the first of them.
        self._unsigned_count, self._unsigned_since = 0, 0.0

    def concerns(self, frame: Frame) -> bool:
        return (frame.system_id, frame.component_id) == self._source

    def is_proved_by(self, frame: Frame, unix_time_s: float) -> bool:
        """Record a frame of the component. Return True if it proves that the component uses the new key."""
        if self.signing is not None:
            return frame.received_at >= self._not_before and self.signing.would_accept(frame, unix_time_s)
        if _is_signed_with_a_key(frame):
            self._unsigned_count = 0
            return False
        self._unsigned_count += 1
        if self._unsigned_count == 1:
            self._unsigned_since = frame.received_at
        # Any sender could forge a few unsigned frames.
        is_long_enough = frame.received_at - self._unsigned_since >= MIN_UNSIGNED_S
        return is_long_enough and self._unsigned_count >= MIN_UNSIGNED_FRAMES


def check_signing(signing: Signing | None, mavlink_version: int) -> None:
    """Raise InvalidArgument if ``signing`` is given and this MAVLink version has no signatures."""
    if signing is not None and mavlink_version == 1:
        raise InvalidArgument("signing needs MAVLink 2: mavlink_version = 1 has no signatures")
