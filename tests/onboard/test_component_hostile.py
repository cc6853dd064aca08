"""Random messages do not stop a component, and nothing unexpected is logged."""

from __future__ import annotations

import asyncio
import math
import random
from pathlib import Path

import pytest
from onboard_peers import payload_and_station
from test_ready_made_parts import Eye, Head, Spool

from aerokit.mavlink import messages as m
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import MavCmd, MavFtpOpcode
from aerokit.mavlink.message import Message
from aerokit.onboard import CommandRequest
from aerokit.protocols.servers.ftp import FtpPacket

pytestmark = pytest.mark.anyio

ROUNDS = 400
EXTREMES = (0.0, 1.0, -1.0, math.nan, math.inf, 1e38)


def random_message(kind: type[Message], rng: random.Random, target: tuple[int, int]) -> Message:
    """Decode random bytes, and address the message to the component."""
    payload = bytes(rng.choice((0, 1, 2, 255, rng.randrange(256))) for _ in range(kind.LENGTH))
    message = kind.decode(payload)
    for name, value in zip(("target_system", "target_component"), target, strict=True):
        if hasattr(message, name):
            setattr(message, name, value)
    return message


def hostile(rng: random.Random, target: tuple[int, int], kinds: list[int], commands: list[int]) -> Message:
    chance = rng.random()
    if chance < 0.4:
        params = [
            rng.choice((0.0, 1.0, -1.0, float("nan"), float("inf"), 1e38, rng.uniform(-200, 200))) for _ in range(7)
        ]
        return m.CommandLong(*target, rng.choice(commands), rng.randrange(3), *params)
    if chance < 0.6:
        opcode, size = rng.choice(list(MavFtpOpcode)), rng.randrange(240)
        path = rng.choice((b"/a", b"/..", b"a\0b", b"/x/y", b"\xff\xfe", b""))
        packet = FtpPacket(rng.randrange(9), opcode, rng.randrange(5), size, offset=rng.getrandbits(32), data=path)
        return packet.replace(client=target).message()
    kind = STANDARD.get(rng.choice(kinds))
    assert kind is not None
    return random_message(kind, rng, target)


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
        encoder = FrameEncoder(200, 77)
        for _ in range(ROUNDS):
            station.connection.send_as(encoder, hostile(rng, station.target, kinds, commands))
            await asyncio.sleep(0.01)
        await asyncio.sleep(20.0)
        ping = await station.ask(m.Ping(1, 1, 0, 0), m.Ping)
    assert ping.seq == 1
    assert [record for record in caplog.records if record.levelname == "ERROR"] == []
