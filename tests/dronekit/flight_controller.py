"""A scripted flight controller on a real loopback socket: sends messages for a test, and records received ones.

Built on pymavlink's encoder and parser, and independent of the library under test: any MAVLink program can connect.
"""

from __future__ import annotations

import contextlib
import select
import socket
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from flight_controller_services import MissionService, ParameterService
from free_ports import free_port
from pymavlink.dialects.v20 import ardupilotmega as mavlink

__all__ = ["FlightController", "Received", "message_of"]

ARMED = 128
CUSTOM_MODE = 1
PX4 = 12
ACCEPTED, UNSUPPORTED = 0, 3
DO_SET_MODE, ARM_DISARM, REQUEST_MESSAGE, REQUEST_VERSION, GET_HOME = 176, 400, 512, 520, 410
SET_HOME = 179
HOUSEKEEPING = (511, REQUEST_MESSAGE, REQUEST_VERSION, GET_HOME)
"""Commands that only request information; scenarios ignore them by default."""
TEST_TIMEOUT_S = 100.0
SILENCE_S = 0.005
"""Seconds between heartbeats until a client answers, so that tests connect quickly."""

Message = Any
Answer = Callable[[Message], object]


@dataclass(frozen=True)
class Received:
    """A frame of the other side."""

    name: str
    message: Message
    version: int
    system: int
    component: int
    time: float

    def __getattr__(self, field: str) -> Any:
        return getattr(self.message, field)

    @property
    def target(self) -> tuple[int, int]:
        """Return the target system; -1 if the message has no such field."""
        return getattr(self.message, "target_system", -1), getattr(self.message, "target_component", -1)

    @property
    def params(self) -> tuple[float, ...]:
        """param1 to param7 of a COMMAND_LONG or COMMAND_INT."""
        last = ("param5", "param6", "param7") if self.name == "COMMAND_LONG" else ("x", "y", "z")
        return tuple(getattr(self.message, name) for name in ("param1", "param2", "param3", "param4", *last))


class FlightController:
    """Sends heartbeats, answers commands, parameters and missions from tables, and sends any message on demand.

    Args:
        link: ``"udp"`` (the other side listens at :attr:`address`) or ``"tcp"`` (this side does).
        version: MAVLink version of sent messages, 1 or 2.
        vehicle_type: MAV_TYPE. autopilot: MAV_AUTOPILOT.
        heartbeat_s: seconds between heartbeats; None sends none but those of :meth:`beat`.
    """

    def __init__(
        self,
        *,
        link: str = "udp",
        version: int = 2,
        vehicle_type: int = 2,
        autopilot: int = 3,
        mode: int = 0,
        heartbeat_s: float | None = 0.05,
        port: int | None = None,
    ) -> None:
        self.version = version
        self.source: tuple[int, int] = (1, 1)
        self.vehicle_type, self.autopilot = vehicle_type, autopilot
        self.base_mode, self.custom_mode, self.system_status = CUSTOM_MODE, mode, 3
        self.heartbeat_s = heartbeat_s
        self.capabilities = 1 | 2 | 4 | 8 | 8192
        self.flight_sw_version = 0x040503FF
        self.home: tuple[int, int, int] | None = (-353632610, 1491652300, 584000)
        self.results: dict[int, int | None] = {}
        """Command → MAV_RESULT; None: no answer. Commands that are not here are accepted."""
        self.reasons: dict[int, str] = {}
        """Command → STATUSTEXT that goes out before its answer."""
        self.parameters = ParameterService(self)
        self.missions = MissionService(self)
        self.answers: dict[str, Answer] = {
            "COMMAND_LONG": self._on_command,
            "COMMAND_INT": self._on_command,
            "SET_MODE": lambda message: self._change_mode(message.custom_mode),
            **self.parameters.answers,
            **self.missions.answers,
        }
        self.accepts_streams = False
        self._log: list[Received] = []
        self._came = threading.Condition()
        self._sending = threading.RLock()
        self._encoders: dict[tuple[int, int], Any] = {}
        self._parser = _new_parser()
        self._is_closed = False
        self._faults: list[Exception] = []
        self._peer: socket.socket | None = None
        self._open(link, port)
        self._thread = threading.Thread(target=self._serve, name="flight controller", daemon=True)
        self._thread.start()

    # ------------------------------------------------------------------------------- sending

    def beat(self, **fields: Any) -> None:
        """Send a heartbeat now; fields are those it differs in."""
        with self._sending:  # none with older values comes after it
            usual = {
                "type": self.vehicle_type,
                "autopilot": self.autopilot,
                "base_mode": self.base_mode,
                "custom_mode": self.custom_mode,
                "system_status": self.system_status,
                "mavlink_version": 3,
            }
            self.report("HEARTBEAT", **{**usual, **fields})

    def report(self, name: str, *, source: tuple[int, int] | None = None, version: int = 0, **fields: Any) -> None:
        """Send a message; fields that are not given are 0."""
        self.send(message_of(name, **fields), source=source, version=version)

    def send(self, message: Message, *, source: tuple[int, int] | None = None, version: int = 0) -> None:
        """Send a message of pymavlink, from (system, component)."""
        source = source or self.source
        with self._sending:
            encoder = self._encoders.setdefault(source, mavlink.MAVLink(None, *source))
            frame = message.pack(encoder, force_mavlink1=(version or self.version) == 1)
            encoder.seq = (encoder.seq + 1) % 256
            self._write(frame)

    def write(self, data: bytes) -> None:
        """Send bytes as they are."""
        with self._sending:
            self._write(data)

    # ----------------------------------------------------------------------------------- log

    def mark(self) -> int:
        """Number of received frames; pass it as ``since`` to consider later ones only."""
        with self._came:
            return len(self._log)

    def received(self, *names: str, since: int = 0) -> list[Received]:
        """The frames of these names; without names all."""
        with self._came:
            return [frame for frame in self._log[since:] if not names or frame.name in names]

    def wait_for(
        self,
        name: str,
        predicate: Callable[[Received], object] = lambda _: True,
        timeout: float = TEST_TIMEOUT_S,
        since: int = 0,
    ) -> Received:
        """The first such frame, once it has come.

        Raises:
            AssertionError: it did not come in time; the text has what came.
        """
        found: list[Received] = []

        def has_arrived() -> bool:
            found.extend(frame for frame in self._log[since:] if frame.name == name and predicate(frame))
            return bool(found)

        with self._came:
            if not self._came.wait_for(has_arrived, timeout):
                raise AssertionError(f"no such {name} in {timeout} s; came: {_brief(self._log[since:])}")
        return found[0]

    def wait_until(self, condition: Callable[[], object], timeout: float = TEST_TIMEOUT_S) -> None:
        """Wait until something holds that frames of the other side bring about."""
        with self._came:
            if not self._came.wait_for(condition, timeout):
                raise AssertionError(f"not in {timeout} s; came: {_brief(self._log)}")

    def commands(self, *numbers: int, since: int = 0) -> list[Received]:
        """COMMAND_LONG and COMMAND_INT of these commands; without numbers those that ask for more than information."""
        every = self.received("COMMAND_LONG", "COMMAND_INT", since=since)
        return [
            frame for frame in every if (frame.command in numbers if numbers else frame.command not in HOUSEKEEPING)
        ]

    def wait_for_command(self, number: int, since: int = 0) -> Received:
        """The first such COMMAND_LONG, once it has come."""
        return self.wait_for("COMMAND_LONG", lambda frame: frame.command == number, since=since)

    # ------------------------------------------------------------------------------ life cycle

    def close(self) -> None:
        """End it. Idempotent."""
        self._is_closed = True
        with contextlib.suppress(OSError):
            self._wake.send(b"!")
        self._thread.join(TEST_TIMEOUT_S)
        for used in (self._socket, self._peer, self._wake, self._woken):
            if used is not None:
                used.close()

    def __enter__(self) -> FlightController:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
        if self._faults:
            raise self._faults[0]

    def drop(self) -> None:
        """Close the connection of the other side, and wait for another one (TCP)."""
        peer, self._peer = self._peer, None
        if peer is not None:
            with contextlib.suppress(OSError):
                peer.shutdown(socket.SHUT_RDWR)
            peer.close()

    # ------------------------------------------------------------------------------- inside

    def _open(self, link: str, port: int | None) -> None:
        self._is_tcp = link == "tcp"
        self._wake, self._woken = socket.socketpair()
        if self._is_tcp:
            self._socket = socket.create_server(("127.0.0.1", port or 0))
            self.address = f"tcp:127.0.0.1:{self._socket.getsockname()[1]}"
        else:
            self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._socket.bind(("127.0.0.1", 0))
            self._remote = ("127.0.0.1", port or free_port())
            self.address = f"udpin:127.0.0.1:{self._remote[1]}"

    def _serve(self) -> None:
        next_beat = time.monotonic()
        while not self._is_closed:
            beats_in = max(0.0, next_beat - time.monotonic()) if self.heartbeat_s else 0.05
            listened = [self._socket, self._woken] + ([self._peer] if self._peer else [])
            try:
                ready = select.select(listened, [], [], beats_in)[0]
            except (OSError, ValueError):  # dropped meanwhile
                continue
            for ready_socket in ready:
                self._read(ready_socket)
            if self.heartbeat_s and time.monotonic() >= next_beat:
                next_beat = time.monotonic() + (self.heartbeat_s if self._log else SILENCE_S)
                self.beat()

    def _read(self, ready: socket.socket) -> None:
        try:
            if self._is_tcp and ready is self._socket:
                self._peer = self._socket.accept()[0]
                self._parser = _new_parser()
                self._peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self.beat()
                return
            data = ready.recv(65536)
        except OSError:
            return
        if self._is_tcp and not data and ready is self._peer:
            self.drop()
        elif data and ready is not self._woken:
            self._take(data)

    def _take(self, data: bytes) -> None:
        for message in self._parser.parse_buffer(data) or ():
            if message.get_type() == "BAD_DATA":
                continue
            version = 2 if message.get_msgbuf()[0] == 0xFD else 1
            source = (message.get_srcSystem(), message.get_srcComponent())
            frame = Received(message.get_type(), message, version, *source, time.monotonic())
            answer = self.answers.get(frame.name)
            with self._came:
                self._log.append(frame)
            if answer is not None:
                try:
                    answer(frame)
                except Exception as error:  # of the script; close() raises it
                    self._faults.append(error)
            with self._came:
                self._came.notify_all()

    def _write(self, frame: bytes) -> None:
        with contextlib.suppress(OSError):  # the client is not listening
            if not self._is_tcp:
                self._socket.sendto(frame, self._remote)
            elif self._peer is not None:
                self._peer.sendall(frame)

    # ------------------------------------------------------------------------------ commands

    def _on_command(self, frame: Received) -> None:
        result = self.results.get(frame.command, ACCEPTED)
        if frame.command in self.reasons:
            self.report("STATUSTEXT", severity=2, text=self.reasons[frame.command].encode())
        if result == ACCEPTED:
            result = self._do(frame)
        if result is not None:
            me: dict[str, Any] = {"target_system": frame.system, "target_component": frame.component}
            self.report("COMMAND_ACK", command=frame.command, result=result, **me)

    def _do(self, frame: Received) -> int:
        number = int(frame.param1)
        if frame.command == ARM_DISARM:
            self.base_mode = self.base_mode | ARMED if number else self.base_mode & ~ARMED
            self.beat()
        elif frame.command == DO_SET_MODE:
            main, sub = int(frame.param2), int(frame.param3)
            self._change_mode(main << 16 | sub << 24 if self.autopilot == PX4 else main)
        elif frame.command == REQUEST_VERSION or (frame.command == REQUEST_MESSAGE and number == 148):
            self.send_version()
        elif frame.command == GET_HOME or (frame.command == REQUEST_MESSAGE and number == 242):
            return self._send_home()
        elif frame.command == SET_HOME:
            self._set_home(frame)
        elif frame.command == REQUEST_MESSAGE:
            return UNSUPPORTED
        return ACCEPTED

    def _change_mode(self, custom_mode: int) -> None:
        self.custom_mode = custom_mode
        self.beat()

    def send_version(self, **fields: Any) -> None:
        """Send AUTOPILOT_VERSION."""
        usual = {"capabilities": self.capabilities, "flight_sw_version": self.flight_sw_version}
        self.report("AUTOPILOT_VERSION", **{**usual, **fields})

    def _set_home(self, frame: Received) -> None:
        scale = 1 if frame.name == "COMMAND_INT" else 1e7
        x, y, z = frame.params[4:]
        self.home = round(x * scale), round(y * scale), round(z * 1000)
        self._send_home()

    def _send_home(self) -> int:
        if self.home is None:
            return 4
        latitude, longitude, altitude = self.home
        self.report("HOME_POSITION", latitude=latitude, longitude=longitude, altitude=altitude)
        return ACCEPTED


def message_of(name: str, **fields: Any) -> Message:
    """Return a pymavlink message; omitted fields are 0, unknown fields raise an error."""
    kind = mavlink.mavlink_map[getattr(mavlink, f"MAVLINK_MSG_ID_{name}")]
    unknown = set(fields) - set(kind.fieldnames)
    assert not unknown, f"{name} has no {unknown}"
    lengths = dict(zip(kind.ordered_fieldnames, kind.array_lengths, strict=True))
    kinds = dict(zip(kind.fieldnames, kind.fieldtypes, strict=True))
    return kind(*(fields.get(name, _zero(kinds[name], lengths[name])) for name in kind.fieldnames))


def _zero(kind: str, length: int) -> Any:
    if kind == "char":
        return b""
    return [0] * length if length else 0


def _new_parser() -> Any:
    parser = mavlink.MAVLink(None)
    parser.robust_parsing = True
    return parser


def _brief(frames: Iterable[Received]) -> str:
    return ", ".join(
        f"{frame.name}({frame.command}{frame.params})" if frame.name.startswith("COMMAND_") else frame.name
        for frame in frames
        if frame.name != "HEARTBEAT"
    )
