"""Checks of a link for ``aerokit doctor``: senders, ids, protocol version, signing, dialect, loss."""

from __future__ import annotations

import asyncio
from collections import Counter
from typing import TYPE_CHECKING, Literal

import anyio

from aerokit._internal.formatting import enum_name
from aerokit._internal.values import Snapshot
from aerokit.apps.cli.output import emit
from aerokit.connection.heartbeats import is_autopilot
from aerokit.connection.opening import explain_no_vehicle
from aerokit.events import DuplicateSender
from aerokit.mavlink.enums import MavType
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.messages import Heartbeat
from aerokit.mavlink.signing import is_signed_with_a_key
from aerokit.transport import SerialLink

if TYPE_CHECKING:
    import argparse
    from collections.abc import Iterator

    from aerokit.connection.connection import Connection
    from aerokit.errors import LinkLost
    from aerokit.mavlink.frame import Frame
    from aerokit.transport.link import Peer

BAUD_RATES = (57600, 115200, 921600, 460800, 230400, 500000, 38400, 19200, 9600)
"""Baud rates to try, the most common first."""
# Fewer valid frames may be noise.
_MIN_FRAMES = 2
_MARKS: dict[str, str] = {"ok": "ok  ", "note": "note", "problem": "BAD "}
_MAX_LOSS = 0.02
# Default system and component id of programs that use aerokit, other than `aerokit doctor`.
_PROGRAM_IDS = (255, 190)
# The loss is reported only if at least this many frames were received.
_MIN_FRAMES_FOR_LOSS = 20
_SERIAL_LOSS_ADVICE = (
    "check antennas and distance, whether the baud rate is too low for the traffic, and RTS/CTS flow control"
)
_STATUS_ADVICE = "`aerokit status` shows what is missing before the vehicle can arm or fly by itself"
_NETWORK_LOSS_ADVICE = "check the network (Wi-Fi, radio), and whether the link is too slow for the traffic"


class BaudRateProbe:
    """Counts what a serial port receives at one baud rate."""

    def __init__(self, baud: int) -> None:
        self.baud: int = baud
        self.bytes: int = 0
        self.frames: int = 0
        self._framer = Framer()
        self.ended: asyncio.Event = asyncio.Event()
        """Set when MAVLink is detected, or the port is lost."""
        self._loop = asyncio.get_running_loop()
        self.error: LinkLost | None = None

    @property
    def is_mavlink(self) -> bool:
        return self.frames >= _MIN_FRAMES

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        self.bytes += len(data)
        self._framer.receive(data, self._loop.time())
        self.frames = self._framer.statistics.frames
        if self.is_mavlink:
            self.ended.set()

    def link_lost(self, error: LinkLost) -> None:
        self.error = error
        self.ended.set()


async def listen_at(device: str, baud: int, seconds: float) -> BaudRateProbe:
    """Listen to a serial port at one baud rate.

    Raises LinkOpenError if the port cannot be opened, and LinkLost if it is lost.
    """
    probe = BaudRateProbe(baud)
    link = SerialLink(device, baud)
    await link.open(probe)
    try:
        with anyio.move_on_after(seconds):
            await probe.ended.wait()
    finally:
        link.close()
        await link.wait_closed()
    if probe.error is not None:
        raise probe.error
    return probe


Level = Literal["ok", "note", "problem"]
"""Severity of a finding. Only a "problem" makes the command fail."""


class Finding(Snapshot):
    """One result of a check: its subject, what was found, and what to do, which may be empty."""

    level: Level
    subject: str
    text: str
    do: str = ""


def emit_finding(options: argparse.Namespace, finding: Finding) -> None:
    lines = [f"{_MARKS[finding.level]}  {finding.subject}: {finding.text}"]
    if finding.do:
        lines.append(f"      → {finding.do}")
    emit(options, "finding", finding.to_dict(), "\n".join(lines))


class LinkExamination:
    """Collects all frames that a connection receives, and derives findings from them."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._own_ids = (connection.source_system, connection.source_component)
        # Keys are (system id, component id). A key with several entries in `_types_and_autopilots` has several senders.
        self._versions: dict[tuple[int, int], set[int]] = {}
        self._signed: Counter[tuple[int, int]] = Counter()
        self._frames: Counter[tuple[int, int]] = Counter()
        self._types_and_autopilots: dict[tuple[int, int], set[tuple[int, int]]] = {}
        self._duplicate_sources: set[tuple[int, int]] = set()
        connection.observe_frames(self._on_frame)
        connection.bus.attach(Heartbeat, self._on_heartbeat)
        connection.bus.attach_event(DuplicateSender, self._on_duplicate_sender)

    def _on_frame(self, frame: Frame, peer: Peer) -> None:
        if self._connection.bus.dialect.get(frame.message_id) is None:
            return  # the checksum of an unknown message cannot be verified, so the frame may be noise
        source = frame.system_id, frame.component_id
        self._frames[source] += 1
        self._versions.setdefault(source, set()).add(frame.version)
        if is_signed_with_a_key(frame):
            self._signed[source] += 1

    def _on_heartbeat(self, heartbeat: Heartbeat) -> None:
        frame = heartbeat.received_frame
        if frame is not None:
            senders = self._types_and_autopilots.setdefault((frame.system_id, frame.component_id), set())
            senders.add((heartbeat.type, heartbeat.autopilot))

    def _on_duplicate_sender(self, event: DuplicateSender) -> None:
        self._duplicate_sources.add((event.system_id, event.component_id))

    def findings(self) -> Iterator[Finding]:
        yield from self._missing_vehicle()
        yield from self._ambiguous_ids()
        yield from self._senders()
        yield from self._signing()
        yield from self._undecoded()
        yield from self._loss()

    @property
    def is_silent(self) -> bool:
        return not set(self._frames) - {self._own_ids}

    def _missing_vehicle(self) -> Iterator[Finding]:
        connection = self._connection
        if any(is_autopilot(heartbeat) for heartbeat in connection.heartbeats.values()):
            return
        text = explain_no_vehicle(connection, wanted_system=None)
        total = sum(statistics.bytes for statistics in connection.statistics())
        if set(self._frames) == {self._own_ids}:
            text += "; they seem to be an echo of what this program sends"
            advice = "check whether TX and RX are shorted, or a router sends everything back"
        elif total == 0:
            advice = (
                "check that the vehicle is on. Serial: TX to RX and RX to TX, ground to ground, SERIALn_PROTOCOL 2"
                " (ArduPilot) or MAV_n_CONFIG (PX4). UDP: the vehicle must send to this computer and port, and no"
                " firewall may block it"
            )
        elif not self._frames:
            advice = (
                "serial: try other baud rates (SERIALn_BAUD, SER_TELn_BAUD), and check that the port is MAVLink and not"
                " GPS, RC or a console. UDP: check for other programs that send to this port"
            )
        else:
            advice = "check that this port is connected to the autopilot"
        yield Finding("problem", "vehicle", text, advice)

    def _ambiguous_ids(self) -> Iterator[Finding]:
        ambiguous = {source for source, senders in self._types_and_autopilots.items() if len(senders) > 1}
        for system, component in sorted((self._duplicate_sources | ambiguous) - {self._own_ids}):
            yield Finding(
                "problem",
                "ids",
                f"two senders use system {system}, component {component}; the messages of one are ignored",
                "give each vehicle a unique system id (ArduPilot MAV_SYSID or SYSID_THISMAV, PX4 MAV_SYS_ID), and check"
                " for a second path to the same vehicle",
            )
        components_by_system: dict[int, list[int]] = {}
        for (system, component), heartbeat in sorted(self._connection.heartbeats.items()):
            if is_autopilot(heartbeat):
                components_by_system.setdefault(system, []).append(component)
        for system, components in components_by_system.items():
            if len(components) > 1:
                listed = ", ".join(map(str, components))
                yield Finding(
                    "problem",
                    "ids",
                    f"system {system} has {len(components)} autopilots (components {listed})",
                    "give each vehicle a unique system id",
                )
        if _PROGRAM_IDS in self._frames:
            system, component = _PROGRAM_IDS
            yield Finding(
                "note",
                "ids",
                f"another ground station uses the ids of aerokit programs ({system}/{component})",
                "vehicles cannot distinguish it from your program: close it, or set source_system=254 in your program",
            )
        if any(system == 0 for system, _ in self._frames):
            yield Finding(
                "problem", "ids", "a sender uses system id 0, which means broadcast", "give it an id from 1 to 255"
            )

    def _senders(self) -> Iterator[Finding]:
        for source, heartbeat in sorted(self._connection.heartbeats.items()):
            if source == self._own_ids:
                continue
            system, component = source
            versions = self._versions.get(source, set())
            type_name = enum_name(MavType, heartbeat.type, f"type {heartbeat.type}").lower().replace("_", " ")
            kind = "autopilot" if is_autopilot(heartbeat) else type_name.replace("gcs", "ground station")
            mavlink = " and ".join(str(version) for version in sorted(versions)) or "?"
            text = f"system {system}, component {component}: {kind}, MAVLink {mavlink}, {self._frames[source]} frames"
            if is_autopilot(heartbeat) and 2 not in versions:
                yield Finding(
                    "note",
                    "sender",
                    text,
                    "MAVLink 1 lacks signing and newer messages: set SERIALn_PROTOCOL 2 (ArduPilot) or MAV_PROTO_VER 2"
                    " (PX4); ArduPilot sends version 1 until it receives version 2",
                )
            else:
                yield Finding("ok", "sender", text, _STATUS_ADVICE if is_autopilot(heartbeat) else "")

    def _signing(self) -> Iterator[Finding]:
        signing = self._connection.signing
        if signing is not None:
            if problems := self._connection.describe_signature_problems():
                yield Finding("problem", "signing", problems, "check that the key is the vehicle's (docs/signing.md)")
            return
        if self._signed:
            names = ", ".join(f"{system}/{component}" for system, component in sorted(self._signed))
            yield Finding(
                "problem",
                "signing",
                f"frames from {names} are signed, but no key is given: their senders will ignore this computer",
                "give the key: --signing-key FILE, or the variable AEROKIT_SIGNING_KEY",
            )

    def _undecoded(self) -> Iterator[Finding]:
        unknown_messages: Counter[int] = Counter()
        for statistics in self._connection.statistics():
            unknown_messages.update(statistics.unknown_messages)
        if unknown_messages:
            first_messages = sorted(unknown_messages.items())[:10]
            listed = ", ".join(f"{message_id} ({count})" for message_id, count in first_messages)
            yield Finding(
                "note",
                "dialect",
                f"messages of an unknown dialect: {listed}",
                "they are ignored; load their definitions with Dialect.from_xml",
            )
        bad = sum(statistics.bad_bytes for statistics in self._connection.statistics())
        total = sum(statistics.bytes for statistics in self._connection.statistics())
        if self._frames and bad > _MAX_LOSS * total:
            yield Finding(
                "problem",
                "bytes",
                f"{bad} of {total} bytes are not MAVLink",
                "check for a console or another protocol on the port, and for a damaged line",
            )

    def _loss(self) -> Iterator[Finding]:
        is_serial = self._connection.link.address.startswith(("serial:", "/dev/", "COM"))
        for system in sorted({system for system, _ in self._frames} - {self._connection.source_system}):
            received, lost = self._connection.counts(system)
            if received + lost < _MIN_FRAMES_FOR_LOSS:
                continue
            loss = lost / (received + lost)
            text = f"system {system}: {100 * loss:.1f} % of {received + lost} frames lost"
            if loss <= _MAX_LOSS:
                yield Finding("ok", "loss", text)
            else:
                yield Finding("problem", "loss", text, _SERIAL_LOSS_ADVICE if is_serial else _NETWORK_LOSS_ADVICE)
