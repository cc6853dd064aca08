"""``SharedLink``: an open connection of this program as a link of a hub."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

from aerokit.errors import AerokitError, BusyError, LinkLost
from aerokit.events import DuplicateSender
from aerokit.hub.message_rules import TargetFields
from aerokit.hub.port import FrameSigner
from aerokit.mavlink.frame import MAGIC_V1, SIGNATURE_LENGTH, Frame
from aerokit.transport.link import Link, Peer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from aerokit.connection.connection import Connection
    from aerokit.mavlink.signing import Signing
    from aerokit.transport.link import Receiver

logger: logging.Logger = logging.getLogger("aerokit")


class SharedLink(Link):
    """Link that lets a hub use an open connection of this program.

    The hub gets all frames that the connection receives or sends. The connection stays open when this link is closed.
    """

    def __init__(self, connection: Connection) -> None:
        self.connection = connection
        self._ids = connection.source_system, connection.source_component
        self._targets = TargetFields(connection.bus.dialect)
        self._receiver: Receiver | None = None  # None while the link is not open
        self._detachments: list[Callable[[], None]] = []  # functions that end the observation of the connection
        self._signer: FrameSigner | None = None
        self._loss_report: asyncio.Handle | None = None  # pending call that reports the end of the connection
        self._is_duplicate_reported = False
        self.address: str = f"shared:{connection.link.address}"
        self.dropped_writes: int = 0

    async def open(self, receiver: Receiver) -> None:
        if self._receiver is not None:
            raise BusyError(f"{self.address} is open; a link can be opened only once")
        self.connection.raise_if_ended()
        self._receiver = receiver
        self._detachments = [
            self.connection.observe_frames(self._on_frame),
            self.connection.observe_sent_frames(self._on_sent),
            self.connection.on_end(self._on_end),
        ]

    def write(self, data: bytes, peer: Peer = None) -> None:
        if self._receiver is None:
            return
        for raw in _split_frames(data):
            frame = Frame.parse(raw)
            if not self._is_duplicate_reported:
                self._check_ids(frame)
            # A vehicle may have the same system id as this program, if the program runs on its companion computer.
            if self._targets.target_of(frame) == self._ids:  # The frame is for this program.
                continue
            try:
                signer = self._current_signer()
                signed = raw if signer is None else signer.sign(raw, self.connection.unix_time())
                if signed is None:
                    self.dropped_writes += 1
                else:
                    dropped_before = self.connection.link.dropped_writes
                    self.connection.write_raw(signed)
                    self.dropped_writes += self.connection.link.dropped_writes - dropped_before
            except AerokitError:  # The connection has ended, or the frame cannot be signed.
                self.dropped_writes += 1

    @property
    def unsent_bytes(self) -> int:
        return self.connection.unsent_bytes

    def close(self) -> None:
        self._receiver = None
        for detach in self._detachments:
            detach()
        self._detachments.clear()
        if self._loss_report is not None:
            self._loss_report.cancel()

    async def wait_closed(self) -> None:
        """Return at once, because the connection stays open."""

    def _check_ids(self, frame: Frame) -> None:
        if (frame.system_id, frame.component_id) == self._ids:
            self._is_duplicate_reported = True
            logger.warning(
                "another station on the shared link uses the same ids %d/%d as this program, so both process each"
                " other's answers; give this program other ids (source_system=, source_component=)",
                *self._ids,
            )
            self.connection.bus.publish(DuplicateSender(self.connection.now(), *self._ids))

    def _on_frame(self, frame: Frame, peer: Peer) -> None:
        signer = self._current_signer()
        if self._receiver is not None:
            unsigned = frame if signer is None else signer.strip_signature(frame)
            self._receiver.bytes_received(unsigned.raw, None)

    def _on_sent(self, raw: bytes) -> None:
        signer = self._current_signer()
        if self._receiver is not None:
            unsigned = raw if signer is None else signer.strip_signature(Frame.parse(raw)).raw
            self._receiver.bytes_received(unsigned, None)

    def _on_end(self, error: Exception) -> None:
        # The loss is reported in the next loop iteration, because the connection may have ended during a write. A link
        # must not call its receiver during a write.
        self._loss_report = asyncio.get_running_loop().call_soon(self._report_loss, error)

    def _report_loss(self, error: Exception) -> None:
        receiver, self._receiver = self._receiver, None
        if receiver is not None:
            lost = LinkLost(f"{self.address}: {error}")
            lost.__cause__ = error
            receiver.link_lost(lost)

    def _current_signer(self) -> FrameSigner | None:
        signing: Signing | None = self.connection.signing
        if signing is None:
            self._signer = None
        elif self._signer is None or self._signer.signing is not signing:
            self._signer = FrameSigner(signing, self.connection.bus.dialect.extras, _ignore)
        return self._signer


def _split_frames(data: bytes) -> Iterator[bytes]:
    begin = 0
    while begin < len(data):
        payload_length = data[begin + 1]
        if data[begin] == MAGIC_V1:
            end = begin + 6 + payload_length + 2  # header, payload and checksum
        else:
            is_signed = data[begin + 2] != 0  # "signed" is the only incompatibility flag.
            end = begin + 10 + payload_length + 2 + (SIGNATURE_LENGTH if is_signed else 0)
        yield data[begin:end]
        begin = end


def _ignore(frame: Frame, reason: str) -> None:
    """Do nothing, because the connection verifies received frames."""
