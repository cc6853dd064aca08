"""``SignatureGate``: what signs the frames of a connection, and which of the received ones are let in."""

from __future__ import annotations

import asyncio
import logging
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
    from aerokit.mavlink.signing import Refusal, Signing

logger: logging.Logger = logging.getLogger("aerokit")


UNSIGNED_FRAMES = 3
UNSIGNED_S = 2.0
"""A vehicle that has its key sends a signed heartbeat each second."""


class SignatureGate:
    """Lets in what the encoder's ``signing`` accepts, everything while that is None.

    The first refusal for each reason is told, by a warning in the log and an event.

    ``unix_time`` gives seconds since 1970; ``publish`` tells the event.
    """

    def __init__(
        self, encoder: FrameEncoder, unix_time: Callable[[], float], publish: Callable[[Event], object]
    ) -> None:
        self._encoder, self._unix_time, self._publish = encoder, unix_time, publish
        self._told: set[Refusal] = set()
        self._handover: _Handover | None = None
        self._is_handing_over = False
        self._keep_error: OSError | None = None
        self.is_open: bool = True
        """Whether everything is let in without looking at it."""

    def use(self, signing: Signing | None) -> None:
        """Sign and check with this from now on; None: neither. InvalidArgument while we send MAVLink 1."""
        check_signing(signing, self._encoder.version)
        self._encoder.signing = signing
        self._update()

    @contextmanager
    def handing_over(
        self, signing: Signing | None, system_id: int, component_id: int
    ) -> Iterator[asyncio.Event]:
        """For the time of the block, change to ``signing`` when frames of the component show that it has.

        The event is set then. Frames are signed and checked as before until that. One frame that is signed with the new
        key, and not an old one, shows it; that there is no key any more is shown by unsigned frames, `UNSIGNED_FRAMES`
        at least, over `UNSIGNED_S`, and no signed one in between: anybody can send a few of those.

        BusyError while another block is open.
        """
        check_signing(signing, self._encoder.version)
        if self._is_handing_over:
            raise BusyError("setup_signing: another vehicle on this connection is just being given a key")
        self._is_handing_over = True
        taken = asyncio.Event()
        self._handover = _Handover(signing, (system_id, component_id), taken)
        self._update()
        try:
            yield taken
        finally:
            self._handover, self._is_handing_over = None, False
            self._update()

    def _update(self) -> None:
        self.is_open = self._encoder.signing is None and self._handover is None

    def admits(self, frame: Frame, *, may_hand_over: bool = True) -> bool:
        """Whether a frame is let in; one that does not come from where its sender is says nothing about keys."""
        handover = self._handover
        is_of_handover = handover is not None and may_hand_over and handover.concerns(frame)
        if handover is not None and is_of_handover and handover.is_shown_by(frame, self._unix_time()):
            self._handover = None
            self.use(handover.signing)
            handover.taken.set()
        signing = self._encoder.signing
        if signing is None:
            return True
        try:
            if is_of_handover and not _has_key(frame):
                return signing.may_be_unsigned(frame)  # neither told nor counted
            refusal = signing.check(frame, self._unix_time())
        except Exception:
            logger.exception("allow_unsigned of %r raised; the frame was refused", signing)
            return False
        if refusal is not None and refusal not in self._told:
            self._told.add(refusal)
            self._tell(frame, signing, refusal)
        return refusal is None

    def has_checked(self, frame: Frame) -> bool:
        """Whether a frame that was let in shows by its signature that it comes from somebody with our key."""
        return self._encoder.signing is not None and bool(frame.incompat_flags & SIGNED)

    def _tell(self, frame: Frame, signing: Signing, refusal: Refusal) -> None:
        source = frame.system_id, frame.component_id
        logger.warning(
            "a frame of %d/%d was refused: %s (%r); more such frames are only counted",
            *source,
            refusal.value,
            signing.key,
        )
        self._publish(FrameRefused(frame.received_at, *source, refusal.value))

    def tell_keeping(self) -> None:
        """Log, once each time, that the file of ``Signing(keep=…)`` cannot be written."""
        signing = self._encoder.signing
        error = None if signing is None else signing.keep_error
        if error is not None and self._keep_error is None:
            logger.error("the time stamp of %r is not kept: %s", signing, error)
        self._keep_error = error

    def describe(self, heartbeats: Iterable[Heartbeat]) -> str:
        """What keeps us and the senders of these heartbeats apart, for error texts; empty when nothing does."""
        signing = self._encoder.signing
        if signing is not None:
            refused = "; ".join(f"{n}: {why.value}" for why, n in signing.refused.items() if n)
            return f"frames were refused ({refused}) by {signing.key!r}" if refused else ""
        frames = (each.received_frame for each in heartbeats)
        is_signed = any(frame is not None and _has_key(frame) for frame in frames)
        return "its frames are signed and no key was given (signing=…)" if is_signed else ""


def _has_key(frame: Frame) -> bool:
    from aerokit.mavlink.signing import is_signed_with_a_key  # with hashlib: few programs come to this

    return is_signed_with_a_key(frame)


class _Handover:
    """A component is being given another key, or none."""

    def __init__(self, signing: Signing | None, source: tuple[int, int], taken: asyncio.Event) -> None:
        self.signing, self.taken = signing, taken
        self._source = source
        self._unsigned, self._unsigned_since = 0, 0.0

    def concerns(self, frame: Frame) -> bool:
        """Whether it is a frame of this component."""
        return (frame.system_id, frame.component_id) == self._source

    def is_shown_by(self, frame: Frame, unix_time_s: float) -> bool:
        """Whether this frame shows that the component has the key; for None: that it has none."""
        if self.signing is not None:
            return self.signing.would_accept(frame, unix_time_s)
        if _has_key(frame):
            self._unsigned = 0
            return False
        self._unsigned += 1
        if self._unsigned == 1:
            self._unsigned_since = frame.received_at
        long_enough = frame.received_at - self._unsigned_since >= UNSIGNED_S
        return long_enough and self._unsigned >= UNSIGNED_FRAMES


def check_signing(signing: Signing | None, mavlink_version: int) -> None:
    """Raise InvalidArgument when this version has no signatures."""
    if signing is not None and mavlink_version == 1:
        raise InvalidArgument("signing needs MAVLink 2: mavlink_version = 1 has no signatures")
