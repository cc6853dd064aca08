"""Recording what is sent and received, and flying the same program on the recording."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import anyio
import pytest
from pymavlink import mavutil

from aerokit import connect
from aerokit.errors import LinkLost
from aerokit.links import create_link
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.messages import Attitude
from aerokit.mavlink.tlog import read_tlog
from aerokit.sim import SimulatedCopter, simulated_link

pytestmark = pytest.mark.anyio


async def fly(path: Path) -> None:
    """A short flight, recorded."""
    async with simulated_link(SimulatedCopter(boot_time_s=1)) as link, connect(link, record=path) as vehicle:
        await vehicle.wait_ready()
        await vehicle.arm()
        await vehicle.take_off(5)
        await vehicle.land()


def senders(path: Path) -> Counter[int]:
    framer = Framer()
    return Counter(frame.system_id for _, raw in read_tlog(path) for frame in framer.receive(raw))


async def test_both_directions_are_recorded_and_pymavlink_reads_every_frame(tmp_path: Path) -> None:
    path = tmp_path / "flight.tlog"
    await fly(path)
    ours = senders(path)
    assert ours[1] > 500
    assert ours[255] > 50
    log = mavutil.mavlink_connection(str(path), dialect="ardupilotmega")
    theirs: Counter[int] = Counter()
    while (message := log.recv_msg()) is not None:
        assert message.get_type() != "BAD_DATA"
        if not message.get_type().startswith("UNKNOWN"):
            theirs[message.get_srcSystem()] += 1
    log.close()
    assert theirs[255] == ours[255]
    assert ours[1] - theirs[1] < 60  # AVAILABLE_MODES and CURRENT_MODE are unknown to its dialect


async def test_frames_nobody_wants_are_recorded_too(tmp_path: Path) -> None:
    path = tmp_path / "all.tlog"
    async with (
        simulated_link(SimulatedCopter(boot_time_s=0)) as link,
        connect(link, record=path, rates={Attitude: 10}) as vehicle,
    ):
        await anyio.sleep(3)
        received, _ = vehicle.connection.counts(1)
    assert received <= senders(path)[1] <= received + 5  # some may come while it closes
    assert received > 50


async def test_an_existing_file_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "twice.tlog"
    path.write_bytes(b"from another day")
    await fly(path)
    assert b"another day" not in path.read_bytes()


@pytest.mark.parametrize("speed", ["1", "10", "inf"])
async def test_the_same_program_runs_on_a_recorded_flight(tmp_path: Path, speed: str) -> None:
    path = tmp_path / "flight.tlog"
    await fly(path)
    highest, modes, armed = 0.0, list[str](), list[bool]()

    def note(_: object, position: object) -> None:
        nonlocal highest
        highest = max(highest, getattr(position, "altitude_relative_m", 0.0) or 0.0)

    started = anyio.current_time()
    with pytest.raises(LinkLost, match="end of"):
        async with connect(create_link(f"replay:{path}?speed={speed}"), rates={}) as vehicle:
            assert vehicle.autopilot.firmware == "ArduCopter"
            vehicle.position.observe(note)
            vehicle.mode.observe(lambda _, mode: modes.append(mode.name))
            vehicle.armed.observe(lambda _, is_armed: armed.append(is_armed))
            await vehicle.mode.wait_until(lambda mode: mode.name == "NEVER", timeout=1000)
    seconds = anyio.current_time() - started
    assert highest == pytest.approx(5, abs=0.6)
    assert modes[-2:] == ["GUIDED", "LAND"]
    assert armed[0] is True
    if speed != "inf":
        recorded = [at for at, _ in read_tlog(path)]
        expected = (recorded[-1] - recorded[0]) / float(speed)
        assert seconds <= expected + 5
