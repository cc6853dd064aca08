"""Cost of a frame through a hub, compared with MAVProxy's ``--out``; writes ``bench-hub.json``.

    python benchmarks/hub.py                          # everything, some minutes
    python benchmarks/hub.py out_4 # these only
    python benchmarks/hub.py --quick                  # a short check that it runs; the figures mean little

The measured process, ``aerokit hub udpin:… udpout:… …`` or ``mavproxy.py --master udpin:… --out udpout:… …``, receives
frames over UDP on 127.0.0.1 and forwards each to 1, 4 or 16 receivers.

- ``out_N``: frames forwarded to N receivers per second of processor time. Frames of a recorded ArduCopter are sent at
  600 Hz, ten at a time. The hubs take turns, and neither may lose frames. MAVProxy runs without modules and log.
- ``dense_N``: the same with 20 frames in each datagram, as another hub or a companion computer sends them.
- ``…_floor``: against a Python program that only reads the datagrams and writes them to each receiver, joined. This is
  the limit for every hub in Python; most of it is the cost of a wake-up.
- ``latency_…``: median and 99th percentile of the time from sending a frame to receiving it at the first of four
  receivers, at 100 Hz.

``$AEROKIT_MAVPROXY_PYTHON`` names the interpreter with MAVProxy, by default this one; without MAVProxy there are no
rows. If ``$AEROKIT_MAVLINK_ROUTERD`` names a mavlink-routerd (C++), it gets another row, without a target.
"""

from __future__ import annotations

import argparse
import os
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import table
from table import Row, row

from aerokit.hub.message_rules import TargetFields
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.frame import MAGIC_V2, Frame, x25
from aerokit.mavlink.messages import Heartbeat, SystemTime
from aerokit.mavlink.tlog import read_tlog

ROOT = Path(__file__).parent.parent
# Number of receivers, and of frames in each datagram.
LOADS = {"out_1": (1, 1), "out_4": (4, 1), "out_16": (16, 1), "dense_1": (1, 20), "dense_4": (4, 20)}
NAMES = (*LOADS, "latency_median", "latency_p99")
PYTHON = os.environ.get("AEROKIT_MAVPROXY_PYTHON", sys.executable)
MAVPROXY = Path(PYTHON).parent / "mavproxy.py"
ROUTERD = os.environ.get("AEROKIT_MAVLINK_ROUTERD", "")
DATAGRAMS_IN_A_ROW = 10
SENT_HZ = 600
WARM_UP_DATAGRAMS = 600
HEARTBEAT = FrameEncoder(1, 1).encode(Heartbeat(type=2, autopilot=3, base_mode=81, custom_mode=0, system_status=3))
FLOOR = """
import asyncio, select, socket, sys
async def main():
    source, sink = (socket.socket(type=socket.SOCK_DGRAM) for _ in range(2))
    poll = select.poll()
    source.bind(("127.0.0.1", int(sys.argv[1])))
    source.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
    poll.register(source, select.POLLIN)
    outs = [("127.0.0.1", int(port)) for port in sys.argv[2:]]
    def forward():
        pieces = [source.recvfrom(65535)[0]]
        while sum(map(len, pieces)) < 1000 and poll.poll(0):
            pieces.append(source.recvfrom(65535)[0])
        for out in outs:
            sink.sendto(b"".join(pieces), out)
    asyncio.get_running_loop().add_reader(source, forward)
    await asyncio.Event().wait()
asyncio.run(main())
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure the requested parts, print and write the results."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(NAMES))
    parser.add_argument("--quick", action="store_true", help="few frames, to check that everything runs")
    parser.add_argument("--output", type=Path, default=Path("bench-hub.json"), help="default: bench-hub.json")
    options = parser.parse_args(arguments)
    wanted = options.names or NAMES
    if not set(wanted) <= set(NAMES):
        parser.error(f"the names are {', '.join(NAMES)}")
    rows: list[Row] = []
    for name in LOADS:
        if name in wanted:
            rows += _throughput(name, options.quick)
    if any(name.startswith("latency") for name in wanted):
        rows += [row for row in _latencies(options.quick) if row["name"] in wanted]
    print(table.printed(rows))
    missed = [row["name"] for row in rows if table.is_missed(row)]
    print(f"MISSED: {', '.join(missed)}" if missed else "every aim is met")
    table.write(rows, options.output)
    return 0


# ------------------------------------------------------------------------------- frames per CPU-second


def _throughput(load: str, quick: bool) -> list[Row]:
    receiver_count, per_datagram = LOADS[load]
    measured_datagrams = 2_000 if quick else 12_000
    datagrams = _datagrams(WARM_UP_DATAGRAMS + measured_datagrams, per_datagram)
    figures: dict[str, list[float]] = {name: [] for name in _available(is_dense=per_datagram > 1)}
    for _ in range(1 if quick else 3):
        for name in figures:
            with _hub(name, receiver_count) as (process, sender, receivers):
                rate = _frames_per_cpu_second(process, sender, receivers, datagrams, per_datagram)
            figures[name].append(rate)
            print(f"{load} {name}: {rate:.0f} frames per CPU-second", file=sys.stderr, flush=True)
    medians = {name: statistics.median(values) for name, values in figures.items()}
    own = medians.pop("aerokit")
    rows = []
    for name, peer in medians.items():
        suffix, peer_name, aim = _PEERS[name]
        rows.append(row(f"{load}{suffix}", own, peer, peer_name, unit="frames/CPU-s", ratio=own / peer, aim=aim))
    return rows


# For each peer: suffix of the row's name, name of the peer, and target.
_PEERS = {
    "mavproxy": ("", "MAVProxy --out", 10.0),
    "routerd": ("_routerd", "mavlink-router", 0.0),
    "floor": ("_floor", "reading and writing", 0.0),
}


def _available(*, is_dense: bool) -> list[str]:
    """Return the hubs to measure. MAVProxy would lose frames of dense datagrams."""
    names = ["aerokit"]
    if MAVPROXY.exists() and not is_dense:
        names.append("mavproxy")
    if ROUTERD:
        names.append("routerd")
    return [*names, "floor"]


def _frames_per_cpu_second(
    process: subprocess.Popen[bytes],
    sender: socket.socket,
    receivers: list[socket.socket],
    datagrams: list[bytes],
    per_datagram: int,
) -> float:
    """Return the number of frames per second of processor time. RuntimeError if more than 0.5 % were lost."""
    _send(datagrams[:WARM_UP_DATAGRAMS], per_datagram, sender, receivers)
    measured = datagrams[WARM_UP_DATAGRAMS:]
    cpu_before_s = _cpu_s(process.pid)
    received = _send(measured, per_datagram, sender, receivers)
    cpu_s = _cpu_s(process.pid) - cpu_before_s
    frames = len(measured) * per_datagram
    if received < frames * 0.995:
        raise RuntimeError(f"{frames - received} of {frames} frames were lost: {process.args!r}")
    return frames / cpu_s


def _send(
    datagrams: Sequence[bytes],
    per_datagram: int,
    sender: socket.socket,
    receivers: list[socket.socket],
) -> int:
    """Send datagrams, some in a row, and wait at most a second for the last ones.

    Return the number of frames of the receiver that received the fewest.
    """
    counts = [0] * len(receivers)
    started_at = time.perf_counter()
    for begin in range(0, len(datagrams), DATAGRAMS_IN_A_ROW):
        end = begin + DATAGRAMS_IN_A_ROW
        for datagram in datagrams[begin:end]:
            sender.send(datagram)
        while time.perf_counter() - started_at < end / SENT_HZ:
            _count_received(receivers, counts)
            time.sleep(0.001)
    for _ in range(100):
        if min(counts) >= len(datagrams) * per_datagram:
            break
        time.sleep(0.01)
        _count_received(receivers, counts)
    return min(counts)


def _datagrams(count: int, per_datagram: int) -> list[bytes]:
    frames = _recorded_frames(count * per_datagram)
    return [b"".join(frames[begin : begin + per_datagram]) for begin in range(0, len(frames), per_datagram)]


def _recorded_frames(count: int) -> list[bytes]:
    """Return broadcast frames of a recorded copter. The recording is repeated with continuous sequence numbers."""
    path = ROOT / "tests" / "recordings" / "ardupilot-copter.tlog"
    targets = TargetFields(STANDARD)
    frames = [Frame.parse(raw) for _, raw in read_tlog(path) if raw[0] == MAGIC_V2]
    of_copter = [frame for frame in frames if (frame.system_id, frame.component_id) == (1, 1)]
    broadcast = [frame for frame in of_copter if targets.target_of(frame) == (0, 0)]
    # The body of a frame is without its magic byte: length, flags, 1 byte, sequence number, …
    unsigned = [frame for frame in broadcast if frame.body[1] == 0]
    numbered = []
    for number in range(count):
        frame = unsigned[number % len(unsigned)]
        body = frame.body[:3] + bytes((number & 0xFF,)) + frame.body[4:]
        checksum = x25(body + STANDARD.extras[frame.message_id])
        numbered.append(bytes((MAGIC_V2,)) + body + checksum.to_bytes(2, "little"))
    return numbered


def _count_received(receivers: list[socket.socket], counts: list[int]) -> None:
    """Add the received frames of system 1 to the count of each receiver. A datagram may contain several frames."""
    for index, receiver in enumerate(receivers):
        while True:
            try:
                data = receiver.recv(65535)
            except BlockingIOError:
                break
            begin = 0
            while begin < len(data):
                magic = data[begin]
                payload_length = data[begin + 1]
                if magic == MAGIC_V2 and data[begin + 5] == 1:  # the system id
                    counts[index] += 1
                begin += payload_length + (12 if magic == MAGIC_V2 else 8)  # with header and checksum


# --------------------------------------------------------------------------------------------- latency


def _latencies(quick: bool) -> list[Row]:
    if "mavproxy" not in _available(is_dense=False):
        return []
    series: dict[str, list[float]] = {"aerokit": [], "mavproxy": []}
    for _ in range(1 if quick else 5):
        for name, delays in series.items():
            with _hub(name, 4) as (_, sender, receivers):
                first_receiver, *_ = receivers
                delays += _delays(sender, first_receiver, 100 if quick else 500)
    rows: list[Row] = []
    for name, share in (("median", 0.5), ("p99", 0.99)):
        own = 1e6 * table.quantile(series["aerokit"], share)
        peer = 1e6 * table.quantile(series["mavproxy"], share)
        rows.append(row(f"latency_{name}", own, peer, "MAVProxy --out", unit="µs", ratio=peer / own, aim=1.0))
    return rows


def _delays(sender: socket.socket, receiver: socket.socket, count: int) -> list[float]:
    """Return the seconds from sending each frame to its reception at one receiver."""
    encoder = FrameEncoder(1, 1)
    delays = []
    receiver.setblocking(True)
    receiver.settimeout(1.0)
    for number in range(1, count + 1):
        frame = encoder.encode(SystemTime(number, 7))
        sent_at = time.perf_counter()
        sender.send(frame)
        while frame not in receiver.recv(65535):
            pass
        delays.append(time.perf_counter() - sent_at)
        time.sleep(0.01)
    return delays


# --------------------------------------------------------------------------------------------- processes


@contextmanager
def _hub(name: str, count: int) -> Iterator[tuple[subprocess.Popen[bytes], socket.socket, list[socket.socket]]]:
    """Run a forwarding process. Yield it, a socket to send to it, and the sockets that it sends to."""
    receivers = [_bound_socket() for _ in range(count)]
    with _bound_socket() as probe:
        port = _port_of(probe)
    outs = [f"127.0.0.1:{_port_of(receiver)}" for receiver in receivers]
    with tempfile.TemporaryDirectory() as folder:
        command = _command(name, port, outs, folder)
        process = subprocess.Popen(
            command,
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
                sender.connect(("127.0.0.1", port))
                _wait_until_forwarding(process, sender, receivers)
                yield process, sender, receivers
        finally:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(5)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            for receiver in receivers:
                receiver.close()


def _command(name: str, port: int, outs: Sequence[str], folder: str) -> list[str]:
    master = f"udpin:127.0.0.1:{port}"
    if name == "aerokit":
        return [sys.executable, "-m", "aerokit", "hub", master, *(f"udpout:{out}" for out in outs)]
    if name == "floor":
        return [sys.executable, "-c", FLOOR, str(port), *(out.rpartition(":")[2] for out in outs)]
    if name == "routerd":
        command = [ROUTERD, "-t", "0"]
        for out in outs:
            command += ["-e", out]
        return [*command, f"127.0.0.1:{port}"]
    command = [PYTHON, str(MAVPROXY), "--daemon", "--non-interactive", "--master", master]
    command += ["--default-modules", "", "--streamrate", "-1", "--logfile", os.devnull, "--state-basedir", folder]
    for out in outs:
        command += ["--out", f"udpout:{out}"]
    return command


def _wait_until_forwarding(
    process: subprocess.Popen[bytes], sender: socket.socket, receivers: list[socket.socket]
) -> None:
    """Send heartbeats until all receivers have received one, then discard what arrives within a second."""
    deadline = time.monotonic() + 30.0
    silent = set(receivers)
    while silent:
        if time.monotonic() > deadline or process.poll() is not None:
            raise RuntimeError(f"no frames are forwarded by {process.args!r}")
        with suppress(ConnectionRefusedError):
            sender.send(HEARTBEAT)
        time.sleep(0.1)
        for receiver in tuple(silent):
            try:
                receiver.recv(65535)
                silent.discard(receiver)
            except BlockingIOError:
                pass
    time.sleep(1.0)
    for receiver in receivers:
        try:
            while True:
                receiver.recv(65535)
        except BlockingIOError:
            pass


def _port_of(sock: socket.socket) -> int:
    _, port = sock.getsockname()
    return int(port)


def _bound_socket() -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 * 1024 * 1024)
    sock.bind(("127.0.0.1", 0))
    sock.setblocking(False)
    return sock


def _cpu_s(pid: int) -> float:
    """Return the processor time of all threads of a process, in nanosecond resolution (Linux)."""
    schedules = Path(f"/proc/{pid}/task").glob("*/schedstat")
    return sum(int(schedule.read_text().split()[0]) for schedule in schedules) / 1e9


if __name__ == "__main__":
    sys.exit(main())
