"""Random messages do not stop a component, and nothing unexpected is logged."""

from __future__ import annotations

import asyncio
import math
import random
import struct
from pathlib import Path

import pytest
from onboard_peers import payload_and_station
from test_ready_made_parts import Eye, Head, Spool

from aerokit.mavlink import messages as m
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import MavCmd, MavFtpOpcode
from aerokit.mavlink.frame import x25
from aerokit.mavlink.message import Message
from aerokit.onboard import CommandRequest
from aerokit.protocols.servers.ftp_packets import FtpPacket

pytestmark = pytest.mark.anyio

ROUNDS = 300
EXTREMES = (0.0, 1.0, -1.0, math.nan, math.inf, 1e38, 1e-38)
SENDER = (200, 77)


def random_frame(kind: type[Message], rng: random.Random, target: tuple[int, int]) -> bytes:
    """Return a frame with random bytes, addressed to the component; its texts may be invalid UTF-8."""
    payload = bytearray(rng.choice((0, 1, 2, 255, rng.randrange(256))) for _ in range(kind.LENGTH))
    for name, value in zip(("target_system", "target_component"), target, strict=True):
        message = kind.decode(bytes(kind.LENGTH))
        if hasattr(message, name):
            setattr(message, name, 0xAB)
            payload[message.encode().index(0xAB)] = value
    body = struct.pack("<BBBBBBHB", len(payload), 0, 0, 0, *SENDER, kind.ID & 0xFFFF, kind.ID >> 16) + payload
    return b"\xfd" + body + x25(body + bytes((kind.CRC_EXTRA,))).to_bytes(2, "little")


def hostile(rng: random.Random, target: tuple[int, int], kinds: list[int], commands: list[int]) -> bytes:
    chance, encoder = rng.random(), FrameEncoder(*SENDER)
    if chance < 0.4:
        params = [rng.choice((*EXTREMES, rng.uniform(-200, 200))) for _ in range(7)]
        p1, p2, p3, p4, p5, p6, p7 = params
        command, again = rng.choice(commands), rng.randrange(3)
        return encoder.encode(m.CommandLong(*target, command, again, p1, p2, p3, p4, p5, p6, p7))
    if chance < 0.6:
        opcode, size = rng.choice(list(MavFtpOpcode)), rng.randrange(240)
        path = rng.choice((b"/a", b"/..", b"a\0b", b"/x/y", b"\xff\xfe", b""))
        packet = FtpPacket(rng.randrange(9), opcode, rng.randrange(5), size, offset=rng.getrandbits(18), data=path)
        return encoder.encode(packet.replace(client=target).message())
    kind = STANDARD.get(rng.choice(kinds))
    assert kind is not None
    return random_frame(kind, rng, target)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("seed", range(4))
async def test_random_messages_are_survived(seed: int, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    rng = random.Random(seed)
    (tmp_path / "a").write_bytes(bytes(1000))
    async with payload_and_station() as (payload, station):
        payload.parameters.add("SPEED", 1.0, minimum=0.0, maximum=3.0)
        payload.parameters.add("NAME", "north")
        payload.serve_files(tmp_path, writable=True)
        payload.add_camera(Eye())
        payload.add_gimbal(Head())
        payload.add_winch(Spool())
        payload.add_arm_authorizer(lambda _: 10.0)
        _ = payload.missions

        @payload.command(MavCmd.USER_1)
        async def work(_: CommandRequest, height_m: float, kind: int) -> None:
            await asyncio.sleep(0.2)

        kinds = [number for number in payload.connection.bus.wanted if number != m.Heartbeat.ID]
        commands = list(payload._commands.handlers)
        for _ in range(ROUNDS):
            station.connection.write_raw(hostile(rng, station.target, kinds, commands))
            await asyncio.sleep(0.01)
        await asyncio.sleep(20.0)
        ping = await station.ask(m.Ping(1, 1, 0, 0), m.Ping)
    assert ping.seq == 1
    assert [record.getMessage() for record in caplog.records if record.levelname == "ERROR"] == []
