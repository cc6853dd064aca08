from __future__ import annotations

import asyncio
import errno
import importlib
import importlib.util
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import anyio
import pytest
from far_end import far_end
from link_harness import Recorder, each_loop, each_traffic, eventually

from aerokit.errors import BusyError, ConnectionClosed, LinkOpenError
from aerokit.transport import SerialLink, serial

pytestmark = pytest.mark.skipif(os.name != "posix", reason="needs pseudo-terminals")


@each_loop
@each_traffic
async def test_serial_bytes_pass_both_ways(pieces: list[bytes]) -> None:
    with far_end() as far:
        far.reads()
        link, recorder = SerialLink(far.device, 115200), Recorder()
        await link.open(recorder)
        for piece in pieces:
            link.write(piece)
        await far.recorder.until_data(b"".join(pieces))
        await far.sends(b"".join(pieces))
        await recorder.until_data(b"".join(pieces))
        assert recorder.peers == [None]
        link.write(b"")
        link.close()
        await link.wait_closed()
    assert recorder.losses == []
    assert link.dropped_writes == 0


@each_loop
async def test_unplugging_loses_the_link_once() -> None:
    with far_end() as far:
        link, recorder = SerialLink(far.device), Recorder()
        await link.open(recorder)
        await far.sends(b"last words")
        await recorder.until_data(b"last words")
        far.unplug()
        error = await recorder.until_lost()
        assert str(error).startswith(f"serial://{far.device}:57600: the device failed: ")
        link.write(b"into the void")
        await link.wait_closed()
        link.close()
        await link.wait_closed()
        assert len(recorder.losses) == 1
        with pytest.raises(ConnectionClosed):
            await link.open(Recorder())


@each_loop
async def test_unplugging_noticed_by_write_is_reported_later() -> None:
    with far_end() as far:
        link, recorder = SerialLink(far.device), Recorder()
        await link.open(recorder)
        far.unplug()
        link.write(b"x")
        link.write(b"y")
        assert recorder.losses == []
        await recorder.until_lost()
        await link.wait_closed()
        assert len(recorder.losses) == 1


@each_loop
async def test_full_line_uses_bounded_memory_and_never_blocks() -> None:
    with far_end() as far:
        link = SerialLink(far.device, 57600)
        await link.open(Recorder())
        frame, written = bytes(280), 0
        while not link.dropped_writes:
            link.write(frame)
            written += 1
            assert written < 1000
            await asyncio.sleep(0)
        assert link._transport.get_write_buffer_size() <= 2 * 5760 + len(frame)
        before = link.dropped_writes
        link.write(frame)
        assert link.dropped_writes == before + 1
        far.reads()
        await far.recorder.until(lambda: len(far.recorder.data) == written * 280 - 280)
        await eventually(lambda: not link.unsent_bytes)
        link.write(b"again")
        await far.recorder.until(lambda: far.recorder.data.endswith(b"again"))
        link.close()
        await link.wait_closed()


@each_loop
async def test_close_is_bounded_without_a_reader(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serial, "LINGER_S", 0.03)
    with far_end() as far:
        link, recorder = SerialLink(far.device, 57600), Recorder()
        await link.open(recorder)
        for _ in range(60):
            link.write(bytes(280))
            await asyncio.sleep(0)
        link.close()
        with anyio.fail_after(100):
            await link.wait_closed()
        assert not link._port.is_open
        assert recorder.losses == []


@each_loop
async def test_data_written_before_close_is_sent() -> None:
    data = bytes(range(256)) * 40
    with far_end() as far:
        link = SerialLink(far.device, 57600)
        await link.open(Recorder())
        link.write(data)
        link.close()
        link.write(b"too late")
        far.reads()
        await link.wait_closed()
        await far.recorder.until_data(data)


@each_loop
async def test_no_callback_after_close() -> None:
    with far_end() as far:
        link, recorder = SerialLink(far.device), Recorder()
        recorder.at_each_piece = lambda data, peer: link.close()
        await link.open(recorder)
        await far.sends(b"first")
        await recorder.until_data(b"first")
        await far.sends(b"second")
        await link.wait_closed()
        far.unplug()
        await asyncio.sleep(0)
        assert recorder.data == b"first"
        assert recorder.losses == []


@each_loop
async def test_closed_in_the_iteration_of_opening() -> None:
    with far_end() as far:
        link = SerialLink(far.device)
        await link.open(Recorder())
        link.close()
        await link.wait_closed()
        assert not link._port.is_open


@each_loop
async def test_port_is_exclusive_and_link_opens_once() -> None:
    with far_end() as far:
        first, second = SerialLink(far.device), SerialLink(far.device)
        await first.open(Recorder())
        with pytest.raises(LinkOpenError, match="another program uses this port"):
            await second.open(Recorder())
        with pytest.raises(BusyError):
            await first.open(Recorder())
        first.close()
        await first.wait_closed()
        await second.open(Recorder())
        second.close()
        await second.wait_closed()


@each_loop
async def test_missing_device_error_lists_ports() -> None:
    link = SerialLink("/dev/ttyNoSuchPort", 57600)
    assert link.unsent_bytes == 0
    with pytest.raises(LinkOpenError, match=r"cannot open serial:///dev/ttyNoSuchPort:57600: .*serial port") as caught:
        await link.open(Recorder())
    assert caught.value.errno == errno.ENOENT
    await link.wait_closed()
    link.close()


@each_loop
async def test_file_that_is_no_port_has_a_hint(tmp_path: Path) -> None:
    path = tmp_path / "flight"
    path.write_bytes(b"")
    with pytest.raises(LinkOpenError, match="this is not a serial port; use replay:PATH to replay a recording"):
        await SerialLink(str(path)).open(Recorder())


@each_loop
async def test_missing_permission_error_names_the_group(monkeypatch: pytest.MonkeyPatch) -> None:
    pyserial = importlib.import_module("serial")

    def refuse(*args: Any, **kwargs: Any) -> None:
        raise pyserial.SerialException(errno.EACCES, "could not open port")

    monkeypatch.setattr(pyserial, "Serial", refuse)
    with pytest.raises(LinkOpenError, match="dialout"):
        await SerialLink("/dev/ttyACM0").open(Recorder())


def test_hardware_flow_control_is_in_the_address() -> None:
    assert SerialLink("COM3", 9600, rtscts=True).address == "serial://COM3:9600?rtscts=1"


def test_serial_close_without_running_loop() -> None:
    with far_end() as far:
        loop = asyncio.new_event_loop()
        link, gone = SerialLink(far.device), SerialLink(far.device)
        loop.run_until_complete(link.open(Recorder()))
        link.close()
        assert not link._port.is_open
        loop.run_until_complete(gone.open(Recorder()))
        loop.close()
        gone.close()
        assert not gone._port.is_open
        SerialLink(far.device).close()


def test_pyserial_is_imported_only_when_a_port_is_opened() -> None:
    program = "import aerokit.transport, sys; sys.exit('serial' in sys.modules)"
    path = os.pathsep.join(entry for entry in sys.path if entry)
    subprocess.run([sys.executable, "-c", program], check=True, env={**os.environ, "PYTHONPATH": path})


@each_loop
@pytest.mark.parametrize("taken", [0, 1])
async def test_bytes_cleared_from_driver_count_as_dropped_write(monkeypatch: pytest.MonkeyPatch, taken: int) -> None:
    with far_end() as far:
        link = SerialLink(far.device, 57600)
        await link.open(Recorder())
        waiting = iter((taken, 0))
        monkeypatch.setattr(link, "_unsent_bytes_of", lambda transport: next(waiting))
        link.discard_unsent()
        assert link.dropped_writes == taken
        monkeypatch.undo()
        link.close()
        await link.wait_closed()


@each_loop
@pytest.mark.parametrize(("room", "arriving"), [(0, b"after"), (3, b"an orderafter")])
async def test_write_that_waited_for_the_driver_too_long_is_dropped(
    monkeypatch: pytest.MonkeyPatch, room: int, arriving: bytes
) -> None:
    """A write that was sent in part is completed, because the receiver would take the next frame for its rest."""
    attempts = []
    write = os.write

    def write_to_busy_driver(fd: int, data: bytes) -> int:
        if bytes(data) == b"an order":
            attempts.append(data)
            assert link._outbox is not None
            link._outbox._last_forwarded = 1, -math.inf  # The time-out ends before the driver has room again.
            if len(attempts) == 1:
                if not room:
                    raise BlockingIOError
                return write(fd, data[:room])
        return write(fd, data)

    monkeypatch.setattr(os, "write", write_to_busy_driver)
    with far_end() as far:
        link = SerialLink(far.device, 57600)
        await link.open(Recorder())
        far.reads()
        link.write(b"an order")
        await eventually(lambda: bool(attempts) and not link._transport.get_write_buffer_size())
        link.write(b"after")
        await far.recorder.until_data(arriving)
        assert link.dropped_writes == (0 if room else 1)
        assert len(attempts) == 1
        link.close()
        await link.wait_closed()


@each_loop
async def test_device_that_vanishes_while_opening_leaves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    import termios

    def vanish(*_: object) -> None:
        raise termios.error(errno.EIO, "Input/output error")

    with far_end() as far:
        link = SerialLink(far.device)
        with monkeypatch.context() as patch:
            patch.setattr(importlib.import_module("serial_asyncio"), "SerialTransport", vanish)
            with pytest.raises(LinkOpenError, match="Input/output error"):
                await link.open(Recorder())
        await link.wait_closed()
        await link.open(Recorder())  # the port was released
        link.close()
        await link.wait_closed()


@each_loop
async def test_close_ends_if_port_cannot_be_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    with far_end() as far:
        link = SerialLink(far.device)
        await link.open(Recorder())
        close = link._port.close

        def fail() -> None:
            close()
            raise OSError(errno.EIO, "Input/output error")

        monkeypatch.setattr(link._port, "close", fail)
        link.close()
        with anyio.fail_after(100):
            await link.wait_closed()


def test_number_in_baud_rate_is_no_error_number() -> None:
    error = serial._open_error("serial:///dev/ttyS0:250000", ValueError("Invalid baud rate: 250000"))
    assert "replay:PATH" not in str(error)
