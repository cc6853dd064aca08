from __future__ import annotations

import struct
import zlib

import pytest
from ftp_client import BLOCK, Err, FtpClient, Op
from hypothesis import given
from hypothesis import strategies as st
from simulated_client import Client

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd, MavProtocolCapability
from aerokit.missions import MissionItem
from aerokit.sim import SimulatedCopter, SimulatedLog, SimulatedPx4

ENOENT, EISDIR, EINVAL, EROFS, ENOSPC, ENOTEMPTY = 2, 21, 22, 30, 28, 39
TEXT = bytes(range(256)) * 4


def copter_ftp(**options: object) -> tuple[SimulatedCopter, FtpClient]:
    copter = SimulatedCopter(boot_time_s=0.0, parameter_count=80, **options)  # type: ignore[arg-type]
    client = Client(copter)
    client.run(1.0)
    client.clear()
    return copter, FtpClient(client)


def px4_ftp(**options: object) -> tuple[SimulatedPx4, FtpClient]:
    px4 = SimulatedPx4(boot_time_s=0.0, parameter_count=70, fast_rate_hz=1.0, **options)  # type: ignore[arg-type]
    client = Client(px4)
    client.run(1.0)
    client.clear()
    return px4, FtpClient(client)


Vehicle = SimulatedCopter | SimulatedPx4


def either(kind: str, **options: object) -> tuple[Vehicle, FtpClient]:
    return copter_ftp(**options) if kind == "copter" else px4_ftp(**options)


both = pytest.mark.parametrize("kind", ["copter", "px4"])


# ------------------------------------------------------------------------------------------ both


@both
def test_written_file_is_read_back(kind: str) -> None:
    vehicle, ftp = either(kind)
    ftp.upload("/notes.bin", TEXT)
    assert vehicle.files.get("/notes.bin") == TEXT
    assert ftp.download("/notes.bin") == TEXT
    assert vehicle.ftp.open_sessions == 0


@both
def test_files_and_folders_are_created_renamed_and_removed(kind: str) -> None:
    vehicle, ftp = either(kind)
    ftp.data(Op.CREATEDIRECTORY, "/a")
    assert ftp.refusal(Op.CREATEDIRECTORY, "/a") == (Err.FILEEXISTS,)
    ftp.upload("/a/one", b"1")
    ftp.data(Op.RENAME, b"/a/one\0/a/two")
    assert ftp.refusal(Op.RENAME, b"/a/one\0/a/two") == (Err.FILENOTFOUND,)
    assert ftp.refusal(Op.REMOVEDIRECTORY, "/a") == (
        Err.FAILERRNO,
        EISDIR if kind == "copter" else ENOTEMPTY,
    )
    ftp.data(Op.REMOVEFILE, "/a/two")
    ftp.data(Op.REMOVEDIRECTORY, "/a")
    assert "/a" not in vehicle.files
    assert ftp.refusal(Op.REMOVEFILE, "/a/two") == (Err.FILENOTFOUND,)


@both
def test_checksum_has_no_inversions(kind: str) -> None:
    vehicle, ftp = either(kind)
    vehicle.files.put("/t", TEXT)
    checksum = zlib.crc32(TEXT, 0xFFFFFFFF) ^ 0xFFFFFFFF
    assert ftp.data(Op.CALCFILECRC, "/t") == checksum.to_bytes(4, "little")


@both
def test_full_card_refuses_writes(kind: str) -> None:
    vehicle, ftp = either(kind)
    vehicle.files.free_bytes = 100
    ftp.data(Op.CREATEFILE, "/t")
    ftp.data(Op.WRITEFILE, bytes(90))
    assert ftp.refusal(Op.WRITEFILE, bytes(90), offset=90) == (Err.FAILERRNO, ENOSPC)
    ftp.data(Op.TERMINATESESSION)
    ftp.data(Op.REMOVEFILE, "/t")
    assert vehicle.files.free_bytes == 100


@both
def test_full_card_accepts_changes_that_need_no_space(kind: str) -> None:
    vehicle, ftp = either(kind)
    ftp.upload("/empty", b"")
    ftp.upload("/t", bytes(90))
    vehicle.files.free_bytes = 0
    ftp.upload("/empty", b"")
    assert ftp.refusal(Op.CREATEFILE, "/new") == (Err.FAILERRNO, ENOSPC)
    assert ftp.refusal(Op.CREATEDIRECTORY, "/new") == (Err.FAILERRNO, ENOSPC)
    ftp.data(Op.OPENFILEWO, "/t")
    ftp.data(Op.WRITEFILE, bytes(90))
    ftp.data(Op.TERMINATESESSION)


@both
def test_replaced_file_frees_its_space(kind: str) -> None:
    vehicle, ftp = either(kind)
    ftp.upload("/old", bytes(90))
    ftp.upload("/new", b"1")
    vehicle.files.free_bytes = 0
    ftp.data(Op.RENAME, b"/new\0/old")
    assert vehicle.files.free_bytes == 90
    ftp.data(Op.RENAME, b"/old\0/old")
    assert vehicle.files.free_bytes == 90


@both
def test_no_ftp_fault_removes_the_capability(kind: str) -> None:
    vehicle, ftp = either(kind)

    def capabilities() -> int:
        ftp.client.command(MavCmd.REQUEST_MESSAGE, m.AutopilotVersion.ID)
        ftp.client.run(0.1)
        return ftp.client.last(m.AutopilotVersion).capabilities

    before = capabilities()
    vehicle.faults.no_ftp = True
    assert before - capabilities() == MavProtocolCapability.FTP
    ftp.send(Op.NONE)
    assert ftp.answers() == []


@both
def test_reboot_ends_sessions_and_keeps_files(kind: str) -> None:
    vehicle, ftp = either(kind)
    ftp.upload("/t", TEXT)
    ftp.data(Op.OPENFILERO, "/t")
    assert vehicle.ftp.open_sessions == 1
    vehicle.restart()
    ftp.wait(5.0)
    assert vehicle.ftp.open_sessions == 0
    assert ftp.download("/t") == TEXT


Request = tuple[int, bytes, int, int, int, float]
requests: st.SearchStrategy[Request] = st.tuples(
    st.sampled_from([*Op, 77]),
    st.sampled_from([b"/", b"/a", b"/b/c", b"/b", b"@PARAM/param.pck", b"@MISSION/mission.dat", b"@SYS", b"/a\0/b"])
    | st.binary(max_size=BLOCK),
    st.integers(0, 3) | st.integers(0, 255),
    st.integers(0, 300) | st.integers(0, 0xFFFFFFFF),
    st.integers(0, 2),
    st.sampled_from([0.0, 0.0, 0.05, 4.0]),
)


@pytest.mark.sampled(2)
@both
@given(asked=st.lists(requests, max_size=25), sizes=st.lists(st.none() | st.integers(0, 255), min_size=25))
def test_random_requests_leave_no_session_open(kind: str, asked: list[Request], sizes: list[int | None]) -> None:
    vehicle, ftp = either(kind)
    vehicle.files.free_bytes = 100_000
    for (opcode, data, step, offset, session, pause), size in zip(asked, sizes, strict=False):
        if offset > 100_000 and opcode in (Op.WRITEFILE, Op.TRUNCATEFILE):
            offset = 100_000  # Keeps the test small in memory.
        sequence = (ftp.sequence + step) & 0xFFFF
        ftp.send(opcode, data, size=size, offset=offset, session=session, sequence=sequence)
        ftp.wait(pause)
    ftp.wait(15.0)
    assert vehicle.ftp.open_sessions == 0


# ------------------------------------------------------------------------------------- ArduPilot


def test_ardupilot_folder_list_ends_with_zeros_root_has_mounts() -> None:
    _, ftp = copter_ftp(logs=[SimulatedLog(500)])
    assert ftp.data(Op.LISTDIRECTORY, "/") == b"D.\0\0D..\0\0DAPM\0\0D@SYS\0\0"
    assert ftp.data(Op.LISTDIRECTORY, "/APM/LOGS/", offset=2) == b"F00000001.BIN\t500\0\0FLASTLOG.TXT\t3\0\0"
    assert ftp.refusal(Op.LISTDIRECTORY, "/APM/LOGS", offset=4) == (Err.EOF,)
    assert ftp.refusal(Op.LISTDIRECTORY, "@PARAM") == (Err.FILENOTFOUND,)
    assert ftp.refusal(Op.LISTDIRECTORY, "") == (Err.INVALIDDATASIZE,)


def test_ardupilot_queue_holds_five_requests() -> None:
    _, ftp = copter_ftp()
    for _ in range(12):
        ftp.send(Op.NONE)
    assert [answer.sequence for answer in ftp.answers()] == [2, 3, 4, 5, 6]


def test_ardupilot_repeats_its_last_reply() -> None:
    vehicle, ftp = copter_ftp()
    ftp.upload("/t", b"123")
    first = ftp.ask(Op.REMOVEFILE, "/t")
    ftp.send(Op.REMOVEFILE, "/t", sequence=ftp.sequence)
    assert ftp.answers() == [first], "the same reply, not FILENOTFOUND"
    assert "/t" not in vehicle.files


def test_ardupilot_has_a_single_session() -> None:
    vehicle, ftp = copter_ftp()
    vehicle.files.put("/t", TEXT)
    ftp.data(Op.OPENFILERO, "/t", session=3)
    assert ftp.refusal(Op.OPENFILERO, "/t", session=3) == (Err.FAIL,)
    assert ftp.refusal(Op.OPENFILERO, "/t", session=4) == (Err.INVALIDSESSION,)
    assert ftp.refusal(Op.LISTDIRECTORY, "/", session=4) == (Err.INVALIDSESSION,)
    assert ftp.refusal(Op.WRITEFILE, b"x", session=3) == (Err.FAIL,)
    ftp.data(Op.RESETSESSION, session=4)
    assert vehicle.ftp.open_sessions == 1, "only the session itself can end it"
    ftp.wait(3.1)
    assert vehicle.ftp.open_sessions == 0
    ftp.data(Op.OPENFILERO, "/t", session=4)
    assert vehicle.ftp.open_sessions == 1


def test_ardupilot_burst_uses_the_requested_size() -> None:
    vehicle, ftp = copter_ftp()
    vehicle.files.put("/t", TEXT)
    ftp.data(Op.OPENFILERO, "/t")
    *blocks, end = ftp.burst(size=100)
    assert b"".join(block.data[: block.size] for block in blocks) == TEXT
    assert [block.offset for block in blocks] == list(range(0, 1024, 100))
    assert [block.burst_complete for block in blocks] == [0] * 10 + [1]
    assert (end.opcode, end.data[0], end.offset, end.burst_complete) == (Op.NAK, Err.EOF, 1024, 1)
    assert end.sequence == blocks[-1].sequence + 1


def test_ardupilot_burst_has_500_blocks() -> None:
    vehicle, ftp = copter_ftp()
    vehicle.files.put("/t", TEXT * 3)
    ftp.data(Op.OPENFILERO, "/t")
    ftp.send(Op.BURSTREADFILE, size=4)
    ftp.send(Op.TERMINATESESSION)
    *blocks, end = ftp.answers(1.0)
    assert len(blocks) == 500
    assert blocks[-1].burst_complete == 1
    assert end.request_opcode == Op.TERMINATESESSION
    assert vehicle.ftp.open_sessions == 0


def test_ardupilot_burst_uses_third_of_slow_link() -> None:
    vehicle, ftp = copter_ftp(link_bytes_per_s=5760)
    vehicle.files.put("/t", bytes(10_000))
    ftp.data(Op.OPENFILERO, "/t")
    blocks = ftp.burst(2.0)
    assert len(blocks) * 266 == pytest.approx(2 * 5760 / 3, rel=0.1)


def test_ardupilot_checks_paths_and_cannot_truncate() -> None:
    vehicle, ftp = copter_ftp()
    vehicle.files.put("/t", TEXT)
    assert ftp.refusal(Op.TRUNCATEFILE, "/t", offset=3) == (Err.FAIL,)
    assert ftp.refusal(77) == (Err.FAIL,)
    assert ftp.refusal(Op.OPENFILERO, "/t", size=1) == (Err.INVALIDDATASIZE,)
    assert ftp.refusal(Op.OPENFILERO, "/t", size=250) == (Err.INVALIDDATASIZE,)
    assert ftp.refusal(Op.OPENFILERO, "/APM") == (Err.FILENOTFOUND,)
    assert ftp.refusal(Op.CREATEFILE, "@SYS/x") == (Err.FAILERRNO, EROFS)
    assert ftp.refusal(Op.CREATEFILE, "/no/x") == (Err.FILENOTFOUND,)
    assert ftp.refusal(Op.READFILE, size=10) == (Err.FILENOTFOUND,)
    assert ftp.data(Op.OPENFILERO, "@SYS/tasks.txt") == (100_000).to_bytes(4, "little")
    assert ftp.data(Op.READFILE, size=BLOCK) == b"TasksV2\n"


def test_ardupilot_serves_missions_as_files() -> None:
    vehicle, ftp = copter_ftp()
    assert ftp.data(Op.OPENFILERO, "@MISSION/mission.dat") == (1 << 20).to_bytes(4, "little")
    ftp.data(Op.TERMINATESESSION)
    home = MissionItem(16, 0, x=-353632610, y=1491652299, z=584.0)
    item = MissionItem(16, 3, x=-353600000, y=1491600000, z=20.0)
    numbers = [(0.0,) * 4 + (mission_item.x, mission_item.y, mission_item.z, seq, 16, 0, 0, mission_item.frame, 0, 1, 0)
               for seq, mission_item in enumerate((home, item))]  # fmt: skip
    content = struct.pack("<HHHHH", 0x763D, 0, 0, 0, 2) + b"".join(
        struct.pack("<4fiifHHBBBBBB", *row) for row in numbers
    )
    ftp.upload("@MISSION/mission.dat", content)
    assert vehicle.missions.items(0)[1] == item
    downloaded = ftp.download("@MISSION/mission.dat")
    assert (downloaded[:10], downloaded[48:]) == (content[:10], content[48:])
    for broken in (b"", b"short", content[:-1], content[:-38] + bytes(38), b"\0\0" + content[2:]):
        ftp.upload("@MISSION/mission.dat", broken)
        assert len(vehicle.missions.items(0)) == 2, "acknowledged without effect"


# ------------------------------------------------------------------------------------------ PX4


def test_px4_lists_skipped_entries() -> None:
    _, ftp = px4_ftp(logs=[SimulatedLog(500)])
    assert ftp.data(Op.LISTDIRECTORY, "/fs/microsd/log/2026-11-21") == b"S\0S\0F10_00_00.ulg\t500\0"
    assert ftp.data(Op.LISTDIRECTORY, "/fs/microsd", offset=2) == b"Dlog\0"
    assert ftp.refusal(Op.LISTDIRECTORY, "/fs", offset=3) == (Err.EOF,)
    assert ftp.refusal(Op.LISTDIRECTORY, "/none") == (Err.FILENOTFOUND,)
    assert ftp.refusal(Op.LISTDIRECTORY, "/fs/../..") == (Err.FILEPROTECTED,)


def test_px4_sessions_have_number_0() -> None:
    vehicle, ftp = px4_ftp()
    vehicle.files.put("/t", TEXT)
    assert ftp.ask(Op.OPENFILERO, "/t", session=3).session == 0
    assert ftp.refusal(Op.READFILE, size=10, session=3) == (Err.INVALIDSESSION,)
    assert ftp.refusal(Op.OPENFILERO, "/t") == (Err.NOSESSIONSAVAILABLE,)
    assert ftp.refusal(Op.TERMINATESESSION, session=3) == (Err.INVALIDSESSION,)
    ftp.wait(9.0)
    assert vehicle.ftp.open_sessions == 1
    ftp.wait(1.5)
    assert vehicle.ftp.open_sessions == 0


def test_px4_has_one_session_per_port() -> None:
    px4, ftp = px4_ftp()
    px4.files.put("/t", TEXT)
    other = px4.open_channel()
    ftp.data(Op.OPENFILERO, "/t")
    ftp.send(Op.OPENFILERO, "/t")
    assert [answer.opcode for answer in ftp.answers()] == [Op.NAK]
    assert px4.ftp.open_sessions == 1
    assert other.take_outbox()[7:10] != b"\x6e\0\0", "no request came from there"


def test_px4_burst_ignores_size_and_ends_at_35_kb() -> None:
    vehicle, ftp = px4_ftp()
    content = bytes(range(250)) * 200
    vehicle.files.put("/t", content)
    ftp.data(Op.OPENFILERO, "/t")
    blocks = ftp.burst(size=80)
    assert [block.burst_complete for block in blocks] == [0] * 167 + [1]
    assert {block.size for block in blocks} == {BLOCK}
    *more, end = ftp.burst(offset=168 * BLOCK)
    assert (end.opcode, end.data[0], end.burst_complete) == (Op.NAK, Err.EOF, 0)
    assert b"".join(block.data[: block.size] for block in [*blocks, *more]) == content


def test_px4_keeps_reporting_eexist() -> None:
    _, ftp = px4_ftp()
    ftp.data(Op.CREATEDIRECTORY, "/a")
    assert ftp.refusal(Op.CREATEDIRECTORY, "/a") == (Err.FILEEXISTS,)
    assert ftp.refusal(77) == (Err.FILEEXISTS,), "as measured: the server keeps an errno"
    assert ftp.refusal(Op.OPENFILERO, "/none") == (Err.FILENOTFOUND,)
    assert ftp.refusal(77) == (Err.UNKNOWNCOMMAND,)
    assert ftp.refusal(Op.CALCFILECRC, "/none") == (Err.FILENOTFOUND,)


def test_px4_truncates_files() -> None:
    vehicle, ftp = px4_ftp()
    vehicle.files.put("/t", b"hello")
    ftp.data(Op.TRUNCATEFILE, "/t", offset=3)
    assert vehicle.files.get("/t") == b"hel"
    ftp.data(Op.TRUNCATEFILE, "/t", offset=5)
    assert vehicle.files.get("/t") == b"hel\0\0"


@pytest.mark.parametrize("size", [4, 5, 261])
def test_repeated_open_of_any_size_opens_one_session(size: int) -> None:
    """The first byte of the answer is the low byte of the size. In a refusal, 5 means that no session is free."""
    copter, ftp = copter_ftp()
    copter.files.put("/t", bytes(size))
    ftp.ask(Op.OPENFILERO, "/t")
    ftp.send(Op.OPENFILERO, "/t", sequence=ftp.sequence)
    assert [answer.opcode for answer in ftp.answers()] == [Op.ACK]
    assert copter.ftp.open_sessions == 1


def test_px4_repeats_small_answers_only() -> None:
    vehicle, ftp = px4_ftp()
    vehicle.files.put("/t", b"hello, world")
    first = ftp.ask(Op.OPENFILERO, "/t")
    ftp.send(Op.OPENFILERO, "/t", sequence=ftp.sequence)
    assert ftp.answers() == [first]
    ftp.ask(Op.READFILE, size=12)
    vehicle.files.put("/t", b"other")
    ftp.send(Op.READFILE, size=12, sequence=ftp.sequence)
    assert len(ftp.answers()) == 1
