"""Connections that sign: with simulated vehicles, in virtual time."""

from __future__ import annotations

import logging
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any

import anyio
import pytest

from aerokit import Signing, SigningKey, Vehicle, connect, events, open_connection
from aerokit.connection.connection import Connection
from aerokit.connection.signatures import SignatureFilter
from aerokit.errors import (
    BusyError,
    CommandTimeout,
    ConnectFailed,
    InvalidArgument,
    NotSupported,
    OperationRejected,
    OperationTimeout,
)
from aerokit.mavlink import Frame, FrameEncoder, Framer, Message, read_tlog
from aerokit.mavlink import signing as timestamp_file
from aerokit.mavlink.messages import Attitude, Heartbeat, RadioStatus, SetupSigning
from aerokit.mavlink.signing import Refusal
from aerokit.sim import SimulatedCopter, SimulatedPx4, SimulatedVehicle, simulated_link
from aerokit.sim.channel import Channel
from aerokit.transport import memory_link_pair
from aerokit.vehicle.connect import connect as connect_vehicle

pytestmark = pytest.mark.anyio

KEY = SigningKey.from_passphrase("right")
WRONG = SigningKey.from_passphrase("wrong")


def radio_copter(**options: Any) -> SimulatedCopter:
    """Its only link is a radio."""
    copter = SimulatedCopter(boot_time_s=0.0, **options)
    copter.signing.trusts_first_port = False
    return copter


@asynccontextmanager
async def connected(vehicle: SimulatedVehicle, **options: Any) -> AsyncIterator[Vehicle]:
    async with simulated_link(vehicle) as link, connect(link, rates={}, **options) as client:
        yield client


def lenient(key: SigningKey) -> Signing:
    return Signing(key, allow_unsigned=lambda frame: True)


# ------------------------------------------------------------------------------- vehicle and client


@pytest.mark.parametrize("make", [radio_copter, SimulatedPx4])
async def test_key_is_set_up_used_and_removed(make: Any) -> None:
    simulated = make()
    async with connected(simulated) as vehicle:
        await vehicle.wait_ready()
        signing = Signing(KEY)
        await vehicle.setup_signing(signing)
        assert simulated.signing.key == KEY
        assert vehicle.connection.signing is signing
        await vehicle.arm()
        await vehicle.disarm()
        heartbeat = await vehicle.message(Heartbeat).wait_until(lambda _: True)
        assert heartbeat.received_frame is not None
        assert signing.has_signed(heartbeat.received_frame)
        await vehicle.setup_signing(None)
        assert [simulated.signing.key, vehicle.connection.signing] == [None, None]
        await vehicle.arm()
        assert signing.frames_refused == 0


@pytest.mark.parametrize("make", [radio_copter, SimulatedPx4])
@pytest.mark.parametrize("removes_first", [False, True])
async def test_vehicle_accepts_our_frames_after_change_of_key(make: Any, removes_first: bool) -> None:
    """The vehicle remembers our last timestamp, which was ahead of the clock, when the key changes."""
    async with connected(make()) as vehicle:
        await vehicle.wait_ready()
        ahead = timestamp_file.timestamp_at(vehicle.connection.unix_time() + 30)
        await vehicle.setup_signing(Signing(KEY, timestamp=ahead))
        await vehicle.arm()
        await vehicle.disarm()
        if removes_first:
            await vehicle.setup_signing(None)
        await vehicle.setup_signing(Signing(WRONG))
        await vehicle.arm()


def test_delayed_frames_with_former_key_do_not_end_handover() -> None:
    vehicle, signatures = FrameEncoder(1, 1), SignatureFilter(FrameEncoder(255, 190), lambda: 1.8e9, lambda _: None)

    def is_switched(key: SigningKey, *received_at: float) -> list[bool]:
        vehicle.signing = Signing(key)
        with signatures.key_handover(Signing(key), 1, 1) as switched:
            switches = []
            for at in received_at:
                signatures.admits(Frame.parse(vehicle.encode(Heartbeat(2, 3, 81, 0, 4), 1.8e9 + at), at))
                switches.append(switched.is_set())
            return switches

    assert is_switched(KEY, 1.0) == [True]
    assert is_switched(WRONG, 2.0) == [True]
    assert is_switched(KEY, 2.1, 3.9, 4.1) == [False, False, True]


async def test_whole_flight_signed() -> None:
    signing = Signing(KEY)
    copter = radio_copter(signing_key=KEY, parameter_count=200)
    async with connected(copter, signing=signing) as vehicle:
        await vehicle.wait_ready()
        await vehicle.parameters.download()
        await vehicle.arm()
        await vehicle.take_off(5)
        await vehicle.land()
        assert vehicle.connection.counts(1)[1] == 0
    assert signing.refused[Refusal.UNSIGNED] == signing.refused[Refusal.WRONG_SIGNATURE] == 0


async def test_vehicle_with_key_ignores_unsigned_program() -> None:
    async with connected(radio_copter(signing_key=KEY)) as vehicle:
        with pytest.raises(CommandTimeout, match="its frames are signed and no key was given"):
            await vehicle.command(512, 148)
        vehicle.connection.signing = lenient(WRONG)
        with pytest.raises(CommandTimeout):
            await vehicle.command(512, 148)
        vehicle.connection.signing = Signing(KEY)
        await vehicle.command(512, 148)


class Zeros(SigningKey):
    """Key with which PX4 signs without a key; SigningKey refuses it."""

    def __init__(self) -> None:
        self._secret = bytes(32)


async def test_signing_with_zeros_means_no_key() -> None:
    px4 = SimulatedPx4()
    async with connected(px4) as vehicle:
        px4.channels[0].sign_with(lenient(Zeros()))
        await anyio.sleep(2)
        heartbeat = vehicle.connection.heartbeats[1, 1].received_frame
        assert heartbeat is not None
        assert lenient(Zeros()).has_signed(heartbeat)
        px4.faults.ignore(512)
        with pytest.raises(CommandTimeout) as failure:
            await vehicle.command(512, 148)
        assert "signed" not in str(failure.value)


async def test_key_is_removed_from_vehicle_signing_with_zeros(monkeypatch: pytest.MonkeyPatch) -> None:
    px4 = SimulatedPx4(signing_key=KEY)
    start = px4.signing.start

    def with_zeros(channel: Channel) -> None:
        start(channel)
        if px4.signing.key is None:
            channel.sign_with(lenient(Zeros()))

    monkeypatch.setattr(px4.signing, "start", with_zeros)
    async with connected(px4, signing=Signing(KEY)) as vehicle:
        await vehicle.wait_ready()
        await vehicle.setup_signing(None)
        assert [px4.signing.key, vehicle.connection.signing] == [None, None]


async def test_px4_accepts_keys_by_usb_only() -> None:
    px4 = SimulatedPx4()
    px4.signing.may_change = lambda: False  # type: ignore[method-assign]
    async with connected(px4) as vehicle:
        with pytest.raises(OperationTimeout, match="PX4 accepts a signing key only on its USB port"):
            await vehicle.setup_signing(Signing(KEY))


@pytest.mark.parametrize(("vehicle_key", "why"), [(None, "is not signed"), (WRONG, "another key")])
async def test_vehicle_without_the_key_is_not_found(
    vehicle_key: SigningKey | None, why: str, caplog: pytest.LogCaptureFixture
) -> None:
    signing = Signing(KEY)
    with caplog.at_level(logging.WARNING, "aerokit"), pytest.raises(ConnectFailed) as failure:
        async with connected(radio_copter(signing_key=vehicle_key), signing=signing, timeout=5.0):
            pass
    assert why in str(failure.value)
    assert KEY.fingerprint in str(failure.value)
    assert KEY.secret.hex() not in str(failure.value)
    assert signing.frames_refused >= 3
    (record,) = caplog.records
    assert why in record.getMessage()
    assert KEY.fingerprint in record.getMessage()


async def test_allow_unsigned_decides() -> None:
    signing = Signing(KEY, allow_unsigned=lambda frame: frame.message_id == Heartbeat.ID)
    async with connected(radio_copter(), signing=signing) as vehicle:
        await anyio.sleep(3)
        assert vehicle.heartbeat_age < 1.5
        with pytest.raises(CommandTimeout, match=r"frames were refused .*it is not signed"):
            await vehicle.command(512, 148)


async def test_allow_unsigned_exception_refuses_only_the_frame(
    caplog: pytest.LogCaptureFixture,
) -> None:
    def raises_error(frame: Frame) -> bool:
        raise ValueError(frame.system_id)

    async with connected(radio_copter(signing_key=KEY), signing=Signing(KEY, allow_unsigned=raises_error)) as one:
        connection = one.connection
        connection.bytes_received(FrameEncoder(77, 1).encode(Heartbeat(2, 3, 0, 0, 3, 3)), None)
        await anyio.sleep(2)
        assert connection.is_open
        assert (77, 1) not in connection.heartbeats
        assert "allow_unsigned" in caplog.text


async def test_setup_is_refused_before_sending_and_by_vehicle() -> None:
    copter = radio_copter()
    async with connected(copter) as vehicle:
        await vehicle.wait_ready()
        vehicle.connection.mavlink_version = 1
        with pytest.raises(NotSupported, match="our frames are MAVLink 1"):
            await vehicle.setup_signing(Signing(KEY))
        with pytest.raises(InvalidArgument, match="mavlink_version = 1"):
            vehicle.connection.signing = Signing(KEY)
        vehicle.connection.mavlink_version = 2
        beat = vehicle.connection.heartbeats[1, 1]
        (frame,) = Framer().receive(FrameEncoder(1, 1, version=1).encode(beat))
        vehicle.connection.heartbeats[1, 1] = Heartbeat.decode(frame.payload, frame)
        with pytest.raises(NotSupported, match="the vehicle's frames are MAVLink 1"):
            await vehicle.setup_signing(Signing(KEY))
        vehicle.connection.heartbeats[1, 1] = beat
        await vehicle.arm()
        with pytest.raises(OperationRejected, match="armed; nothing was sent"):
            await vehicle.setup_signing(Signing(KEY))
        await vehicle.disarm()
        with pytest.raises(InvalidArgument, match="timeout"):
            await vehicle.setup_signing(Signing(KEY), timeout=0)
        assert copter.signing.key is None
        copter.signing.may_change = lambda: False  # type: ignore[method-assign]
        with pytest.raises(OperationTimeout, match=KEY.fingerprint):
            await vehicle.setup_signing(Signing(KEY))
        assert vehicle.connection.signing is None
        await vehicle.arm()


async def test_one_key_handover_at_a_time() -> None:
    copter = radio_copter()
    async with connected(copter) as vehicle, anyio.create_task_group() as tasks:
        await vehicle.wait_ready()
        copter.faults.drop_incoming = 1
        tasks.start_soon(vehicle.setup_signing, Signing(KEY))
        await anyio.wait_all_tasks_blocked()
        with pytest.raises(BusyError, match="setup_signing: another key handover on this connection"):
            await vehicle.setup_signing(Signing(WRONG))
    assert copter.signing.key == KEY


async def test_mavlink_1_is_refused_during_key_handover() -> None:
    """Otherwise the vehicle's first signed frame would close the connection."""
    copter = radio_copter()
    async with connected(copter) as vehicle:
        await vehicle.wait_ready()
        copter.faults.drop_incoming = 1
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(vehicle.setup_signing, Signing(KEY))
            await anyio.wait_all_tasks_blocked()
            with pytest.raises(InvalidArgument, match="signing needs MAVLink 2"):
                vehicle.connection.mavlink_version = 1
        assert vehicle.connection.signing is not None


async def test_setup_over_a_lossy_link() -> None:
    copter = radio_copter(seed=3)
    async with connected(copter) as vehicle:
        await vehicle.wait_ready()
        copter.faults.drop_incoming = 2
        await vehicle.setup_signing(Signing(KEY), timeout=20)
        await vehicle.setup_signing(Signing(WRONG), timeout=20)  # SETUP_SIGNING itself is signed with the old key
        assert copter.signing.key == WRONG


async def test_reboot_is_no_replay() -> None:
    signing = Signing(KEY)
    copter = radio_copter(signing_key=KEY)
    async with connected(copter, signing=signing) as vehicle:
        await anyio.sleep(31)  # the vehicle stores its time stamp every 30 seconds
        await vehicle.reboot()
        await vehicle.wait_ready()
    assert signing.refused[Refusal.REPLAYED] == 0


async def test_next_run_starts_with_stored_time_stamp() -> None:
    first = Signing(KEY, timestamp=1 << 47)
    async with connected(radio_copter(signing_key=KEY), signing=first) as vehicle:
        await vehicle.command(512, 148)
    kept = first.timestamp
    assert kept > 1 << 47
    copter = radio_copter(signing_key=KEY)
    copter.signing.timestamp = kept
    async with connected(copter, signing=Signing(KEY, timestamp=kept)) as vehicle:
        await vehicle.command(512, 148)


# ------------------------------------------------------------------------------------ the connection


class FarLink:
    """The far end of a memory link: sends on demand, and records received data."""

    def __init__(self) -> None:
        self.link, self._own = memory_link_pair()
        self.framer = Framer()
        self.framer.keep_unknown = True
        self.frames: list[Frame] = []

    async def open(self) -> None:
        await self._own.open(self)

    def bytes_received(self, data: bytes, peer: object) -> None:
        self.frames += self.framer.receive(data)

    def link_lost(self, error: Exception) -> None:
        """Ignore it."""

    async def send(self, *raws: bytes) -> None:
        for raw in raws:
            self._own.write(raw)
        await anyio.sleep(0.01)


@asynccontextmanager
async def with_far(**options: Any) -> AsyncIterator[tuple[Connection, FarLink]]:
    far = FarLink()
    await far.open()
    async with open_connection(far.link, **options) as connection:
        yield connection, far


def raw(message: Message, signing: Signing | None = None, system_id: int = 1) -> bytes:
    encoder = FrameEncoder(system_id, 1)
    encoder.signing = signing
    return encoder.encode(message, 1.9e9)


HEARTBEAT = Heartbeat(2, 3, 81, 0, 3)
ATTITUDE = Attitude(0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


async def test_refused_frames_are_reported_once_per_reason(tmp_path: Path) -> None:
    path = tmp_path / "log.tlog"
    signing, good = Signing(KEY), raw(HEARTBEAT, Signing(KEY))
    tapped: list[int] = []
    async with with_far(signing=signing, record=path) as (connection, far):
        with (
            connection.subscribe(events.FrameRefused, capacity=9) as refused,
            connection.subscribe(Heartbeat, Attitude, capacity=9) as attitudes,
        ):
            connection.observe_frames(lambda frame, _: tapped.append(frame.system_id))
            bad = raw(ATTITUDE, system_id=7), raw(ATTITUDE, Signing(WRONG), 8), good
            await far.send(good, *bad, *bad, raw(RadioStatus(0, 0, 0, 0, 0, 0, 0), system_id=51))
            reported = [await refused.get() for _ in range(3)]
            assert (await attitudes.get()) == HEARTBEAT
            assert refused.missed == attitudes.missed == 0
        assert [(event.system_id, event.reason) for event in reported] == [
            (7, Refusal.UNSIGNED.value),
            (8, Refusal.WRONG_SIGNATURE.value),
            (1, Refusal.REPLAYED.value),
        ]
        assert tapped == [1, 51]
        assert list(connection.heartbeats) == [(1, 1)]
    assert signing.refused == {**dict.fromkeys(Refusal, 2), Refusal.TOO_OLD: 0}
    received = [frame for _, frame in read_tlog(path) if frame[5] != 255]
    assert received[0] == good
    assert len(received) == 2


async def test_forwarded_frames_keep_signature_and_keys_are_not_recorded(
    tmp_path: Path,
) -> None:
    path = tmp_path / "log.tlog"
    theirs = raw(ATTITUDE, Signing(WRONG), 9)
    async with with_far(signing=Signing(KEY), record=path) as (connection, far):
        connection.write_raw(theirs)
        connection.send(SetupSigning(1, 1, KEY.secret, 5))
        connection.write_raw(raw(SetupSigning(1, 1, KEY.secret, 6)))
        await anyio.sleep(0.01)
        assert [frame.message_id for frame in far.frames].count(SetupSigning.ID) == 2
        assert theirs in [frame.raw for frame in far.frames]
    recorded = [frame for _, frame in read_tlog(path)]
    assert theirs in recorded
    assert KEY.secret not in path.read_bytes()
    assert all(Signing(KEY).has_signed(Frame.parse(frame)) for frame in recorded if frame[5] == 255)


async def test_unknown_message_is_verified() -> None:
    signing, observed = Signing(KEY), []
    header = bytes((0xFD, 3, 1, 0, 0, 1, 1)) + (16_000_000).to_bytes(3, "little")
    frame = header + b"abc\x11\x22"
    async with with_far(signing=signing) as (connection, far):
        connection.observe_frames(lambda frame, _: observed.append(frame.message_id))
        await far.send(frame + Signing(KEY).sign(frame, 1.9e9), frame + Signing(WRONG).sign(frame, 2e9))
    assert observed == [16_000_000]
    assert signing.refused[Refusal.WRONG_SIGNATURE] == 1


async def test_open_connection_has_its_signing() -> None:
    async with with_far() as (connection, _):
        with pytest.raises(InvalidArgument, match="signing"):
            async with connect_vehicle(connection, signing=Signing(KEY)):
                pass
    with pytest.raises(InvalidArgument, match="mavlink_version = 1"):
        async with with_far(signing=Signing(KEY), mavlink_version=1):
            pass


async def test_time_stamps_follow_the_clock_of_the_connection() -> None:
    signing = Signing(KEY)
    async with with_far(signing=signing) as (_, far):
        await anyio.sleep(0.5)
        before = signing.timestamp
        await anyio.sleep(60)
        assert signing.timestamp - before == pytest.approx(60 * 100_000, abs=110_000)
        stamps = [int.from_bytes(frame.signature[1:7], "little") for frame in far.frames]
        assert stamps == sorted(set(stamps))


async def test_storage_error_of_time_stamp_is_logged_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Storing fails from the first heartbeat on, and the flight continues."""

    def full(target: Path, text: str) -> None:
        raise OSError(28, "No space left on device")

    signing = Signing(KEY, keep=tmp_path / "stamp")
    async with AsyncExitStack() as stack:
        far = None
        for times in (1, 2):
            with monkeypatch.context() as broken:
                broken.setattr(timestamp_file, "write_atomically", full)
                if far is None:
                    _, far = await stack.enter_async_context(with_far(signing=signing))
                await anyio.sleep(100)
                events = [text for text in caplog.messages if "cannot be stored: [Errno 28]" in text]
                assert len(events) == times
            await anyio.sleep(100)
            assert signing.keep_error is None
        assert far is not None
        assert len(far.frames) == pytest.approx(400, abs=2)
    assert len(caplog.messages) == 2
