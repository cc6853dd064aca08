"""What ``aerokit doctor`` finds on a link: who speaks, how, and what does not fit together."""

from __future__ import annotations

import asyncio
from collections import Counter
from typing import TYPE_CHECKING, Literal

import anyio

from aerokit._internal.values import Snapshot
from aerokit.apps.cli.output import tell
from aerokit.connection.components import is_autopilot
from aerokit.connection.opening import no_vehicle_reason
from aerokit.events import HeardTwice
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
"""The most usual first."""

MIN_FRAMES_AT_A_RATE = 2
"""One good checksum in noise may be luck."""


class Heard:
    """What came at one baud rate."""

    def __init__(self, baud: int) -> None:
        self.baud: int = baud
        self.bytes: int = 0
        self.frames: int = 0
        self._framer = Framer()
        self._ended = asyncio.Event()
        self._loop = asyncio.get_running_loop()
        self.error: LinkLost | None = None

    @property
    def is_mavlink(self) -> bool:
        """Whether there was enough of it."""
        return self.frames >= MIN_FRAMES_AT_A_RATE

    def bytes_received(self, data: bytes, peer: Peer) -> None:
        """Called by the link."""
        self.bytes += len(data)
        self._framer.receive(data, self._loop.time())
        self.frames = self._framer.statistics.frames
        if self.is_mavlink:
            self._ended.set()

    def link_lost(self, error: LinkLost) -> None:
        """Called by the link."""
        self.error = error
        self._ended.set()

    async def wait(self, seconds: float) -> None:
        """Until it is MAVLink, the port has gone, or so many seconds have passed."""
        with anyio.move_on_after(seconds):
            await self._ended.wait()


async def listen_at(device: str, baud: int, seconds: float) -> Heard:
    """Listen to a port at one rate; raises LinkOpenError when it cannot be opened, LinkLost when it has gone."""
    heard = Heard(baud)
    link = SerialLink(device, baud)
    await link.open(heard)
    try:
        await heard.wait(seconds)
    finally:
        link.close()
        await link.wait_closed()
    if heard.error is not None:
        raise heard.error
    return heard


Level = Literal["ok", "note", "problem"]
"""As it should be; worth knowing; to be mended."""

_MARKS: dict[str, str] = {"ok": "ok  ", "note": "note", "problem": "BAD "}


class Finding(Snapshot):
    """``subject`` is what was looked at in a few words, ``text`` what was found, ``do`` what to do (empty: nothing)."""

    level: Level
    subject: str
    text: str
    do: str = ""


def tell_finding(options: argparse.Namespace, finding: Finding) -> None:
    """Print it."""
    lines = [f"{_MARKS[finding.level]}  {finding.subject}: {finding.text}"]
    if finding.do:
        lines.append(f"      → {finding.do}")
    tell(options, "finding", finding.to_dict(), "\n".join(lines))


TOLERABLE_LOSS = 0.02

PROGRAM = (255, 190)
"""The ids of programs, unless they ask for others; doctor itself only looks on, by another one."""

ENOUGH_FRAMES = 20
"""Of fewer frames a loss says little."""

SERIAL_LOSS = (
    "check the antennas and the distance, the baud rate (is the link full?), and on serial lines RTS/CTS"
)

FORWARDED_LOSS = "check the network (Wi-Fi, radio), and whether the link is slower than what is sent over it"


class LinkExamination:
    """Listens to everything on a connection, from when it is made, and says what is to be said of it."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._own = (connection.source_system, connection.source_component)
        self._versions: dict[tuple[int, int], set[int]] = {}
        self._signed: Counter[tuple[int, int]] = Counter()
        self._frames: Counter[tuple[int, int]] = Counter()
        self._kinds: dict[tuple[int, int], set[tuple[int, int]]] = {}
        self._twice: set[tuple[int, int]] = set()
        connection.tap(self._on_frame)
        connection.bus.attach(Heartbeat, self._on_heartbeat)
        connection.bus.attach_event(HeardTwice, self._on_heard_twice)

    def _on_frame(self, frame: Frame, peer: Peer) -> None:
        if self._connection.bus.dialect.get(frame.message_id) is None:
            return  # its checksum could not be checked: it might be noise
        source = frame.system_id, frame.component_id
        self._frames[source] += 1
        self._versions.setdefault(source, set()).add(frame.version)
        self._signed[source] += is_signed_with_a_key(frame)

    def _on_heartbeat(self, heartbeat: Heartbeat) -> None:
        frame = heartbeat.received_frame
        if frame is not None:
            kinds = self._kinds.setdefault((frame.system_id, frame.component_id), set())
            kinds.add((heartbeat.type, heartbeat.autopilot))

    def _on_heard_twice(self, event: HeardTwice) -> None:
        self._twice.add((event.system_id, event.component_id))

    # ---------------------------------------------------------------------------------- findings

    def findings(self) -> Iterator[Finding]:
        """All of them, the worst kinds of trouble first."""
        yield from self._silence()
        yield from self._ids()
        yield from self._senders()
        yield from self._signing()
        yield from self._unknown()
        yield from self._loss()

    @property
    def is_silent(self) -> bool:
        """Whether no frame of anybody else was heard."""
        return not set(self._frames) - {self._own}

    def _silence(self) -> Iterator[Finding]:
        connection = self._connection
        if any(is_autopilot(heartbeat) for heartbeat in connection.heard.values()):
            return
        text = no_vehicle_reason(connection, None)
        total = sum(each.bytes for each in connection.statistics())
        if set(self._frames) == {self._own}:
            text += "; they look like our own, which come back"
            do = "are TX and RX joined, or does a router send everything back?"
        elif total == 0:
            do = (
                "is the vehicle on? serial: TX to RX and RX to TX, ground to ground, SERIALn_PROTOCOL 2 (ArduPilot) or"
                " MAV_n_CONFIG (PX4); UDP: does it send to this computer and this port, and does no firewall stop it?"
            )
        elif not self._frames:
            do = (
                "serial: try the other baud rates (SERIALn_BAUD, SER_TELn_BAUD); is this port MAVLink and not GPS, RC"
                " or a console? UDP: who else sends to this port?"
            )
        else:
            do = "is the autopilot's own port the one that you listen to?"
        yield Finding("problem", "vehicle", text, do)

    def _ids(self) -> Iterator[Finding]:
        different = {source for source, kinds in self._kinds.items() if len(kinds) > 1}
        for system, component in sorted((self._twice | different) - {self._own}):
            yield Finding(
                "problem",
                "ids",
                f"two senders use system {system}, component {component}: one of them is not listened to",
                "give each vehicle a system id of its own (ArduPilot MAV_SYSID or SYSID_THISMAV, PX4 MAV_SYS_ID); or is"
                " there a second way to the same vehicle?",
            )
        autopilots = [source for source, beat in self._connection.heard.items() if is_autopilot(beat)]
        for system, count in Counter(system for system, _ in autopilots).items():
            if count > 1:
                components = ", ".join(
                    str(component) for each, component in sorted(autopilots) if each == system
                )
                yield Finding(
                    "problem",
                    "ids",
                    f"system {system} has {count} autopilots (components {components})",
                    "give each vehicle a system id of its own",
                )
        if PROGRAM in self._frames:
            yield Finding(
                "note",
                "ids",
                f"another ground station uses our ids ({PROGRAM[0]}/{PROGRAM[1]})",
                "vehicles cannot tell it from a program of yours: close it, or use source_system=254 in your program",
            )
        if any(system == 0 for system, _ in self._frames):
            yield Finding(
                "problem", "ids", "somebody uses system id 0, which is nobody's", "give it an id of 1 to 255"
            )

    def _senders(self) -> Iterator[Finding]:
        for source, heartbeat in sorted(self._connection.heard.items()):
            if source == self._own:
                continue
            versions = self._versions.get(source, set())
            who = "autopilot" if is_autopilot(heartbeat) else _kind(heartbeat.type)
            number = " and ".join(str(each) for each in sorted(versions)) or "?"
            text = f"system {source[0]}, component {source[1]}: {who}, MAVLink {number}, {self._frames[source]} frames"
            if is_autopilot(heartbeat) and 2 not in versions:
                yield Finding(
                    "note",
                    "sender",
                    text,
                    "MAVLink 1 has neither signatures nor the newer messages: SERIALn_PROTOCOL 2 (ArduPilot),"
                    " MAV_PROTO_VER 2 (PX4); ArduPilot also speaks 1 until it has heard 2",
                )
            else:
                yield Finding("ok", "sender", text)

    def _signing(self) -> Iterator[Finding]:
        signing = self._connection.signing
        if signing is not None:
            if refused := self._connection.describe_signatures():
                yield Finding("problem", "signing", refused, "is this the vehicle's key? docs/signing.md")
            return
        signed = sorted(source for source, count in self._signed.items() if count)
        if signed:
            names = ", ".join(f"{system}/{component}" for system, component in signed)
            yield Finding(
                "problem",
                "signing",
                f"{names} signs its frames, and no key is given: it will not listen to us",
                "--signing-key FILE, or AEROKIT_SIGNING_KEY",
            )

    def _unknown(self) -> Iterator[Finding]:
        numbers: Counter[int] = Counter()
        for each in self._connection.statistics():
            numbers.update(each.unknown_messages)
        if numbers:
            listed = ", ".join(f"{number} ({count})" for number, count in sorted(numbers.items())[:10])
            yield Finding(
                "note",
                "dialect",
                f"messages that are in no dialect that aerokit has: {listed}",
                "they are passed over; Dialect.from_xml reads the definitions of their maker",
            )
        bad = sum(each.bad_bytes for each in self._connection.statistics())
        total = sum(each.bytes for each in self._connection.statistics())
        if self._frames and bad > TOLERABLE_LOSS * total:
            yield Finding(
                "problem",
                "bytes",
                f"{bad} of {total} bytes are no MAVLink",
                "a console or another protocol on the same port, or a line that damages bytes",
            )

    def _loss(self) -> Iterator[Finding]:
        is_serial = self._connection.link.address.startswith(("serial:", "/dev/", "COM"))
        for system in sorted({system for system, _ in self._frames} - {self._own[0]}):
            received, lost = self._connection.counts(system)
            if received + lost < ENOUGH_FRAMES:
                continue
            share = lost / (received + lost)
            text = f"system {system}: {100 * share:.1f} % of {received + lost} frames lost"
            if share <= TOLERABLE_LOSS:
                yield Finding("ok", "loss", text)
            else:
                yield Finding("problem", "loss", text, SERIAL_LOSS if is_serial else FORWARDED_LOSS)


def _kind(number: int) -> str:
    try:
        return MavType(number).name.lower().replace("_", " ").replace("gcs", "ground station")
    except ValueError:
        return f"type {number}"
