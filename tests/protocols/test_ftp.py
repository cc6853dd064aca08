"""MAVFTP: the payload, and single requests."""

from __future__ import annotations

from typing import Any

import pytest
from for_each import for_each
from ftp_server import as_message, make_client, reply_to, requests_in
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.mavftp import FTP_OP

from aerokit.errors import FileError, FileTimeout, InvalidArgument
from aerokit.mavlink.enums import MavFtpErr, MavFtpOpcode
from aerokit.mavlink.messages import FileTransferProtocol
from aerokit.protocols.exchange import RoundTrip
from aerokit.protocols.ftp import ERRNOS, FtpMessage, FtpRequest, file_error, path_bytes

Op = MavFtpOpcode
bytes_of_data = st.binary(max_size=239)


def make_request(opcode: MavFtpOpcode = Op.OPENFILERO, *, idle_timeout_s: float = 10.0, **options: Any) -> FtpRequest:
    return FtpRequest(
        make_client(7),
        opcode,
        path="/a",
        data=b"/a",
        round_trip=RoundTrip(0.1),
        idle_timeout_s=idle_timeout_s,
        **options,
    )


def started(request: FtpRequest) -> FtpMessage:
    request.start(0.0)
    (sent,) = requests_in(request.take_outbox())
    return sent


# -------------------------------------------------------------------------------- the payload


@given(
    st.integers(0, 0xFFFF),
    st.integers(0, 255),
    st.integers(0, 255),
    st.integers(0, 255),
    st.booleans(),
    st.integers(0, 0xFFFFFFFF),
    bytes_of_data,
)
def test_ftp_message_round_trip(
    sequence: int, opcode: int, session: int, asked: int, complete: bool, offset: int, data: bytes
) -> None:
    message = FtpMessage(sequence, opcode, session, len(data), asked, complete, offset, data)
    theirs = FTP_OP(sequence, session, opcode, len(data), asked, complete, offset, bytearray(data)).pack()
    assert message.encode() == bytes(theirs).ljust(251, b"\0")
    assert FtpMessage.decode(message.encode()) == message
    assert FtpMessage.decode(message.encode(), cut=False).data == data.ljust(239, b"\0")


@given(st.binary(max_size=300))
def test_ftp_message_decodes_any_bytes(payload: bytes) -> None:
    message = FtpMessage.decode(payload)
    assert len(message.data) <= 239
    assert 0 <= message.error_code <= 255


@pytest.mark.parametrize("path", ["", "a\0b", "x" * 239, "ä" * 120, "\ud800"])
def test_ftp_rejects_invalid_paths(path: str) -> None:
    with pytest.raises(InvalidArgument, match="path"):
        path_bytes(path)


def test_ftp_accepts_valid_paths() -> None:
    assert path_bytes("@PARAM/param.pck?withdefaults=1") == b"@PARAM/param.pck?withdefaults=1"
    assert len(path_bytes("x" * 238)) == 238
    assert path_bytes("ä" * 119) == "ä".encode() * 119


# -------------------------------------------------------------------------------- the request


def test_ftp_request_result_and_round_trip() -> None:
    request = make_request()
    sent = started(request)
    assert (sent.sequence, sent.opcode, sent.data, sent.size) == (7, Op.OPENFILERO, b"/a", 2)
    request.receive(as_message(reply_to(sent, b"\x05\0\0\0")), 0.2)
    assert request.done
    assert request.result().data == b"\x05\0\0\0"
    assert request.round_trip.smoothed_s == pytest.approx(0.1 + 0.1 / 8)


def test_ftp_request_retries_with_same_sequence() -> None:
    request = make_request(idle_timeout_s=3.0)
    sent, times = started(request), []
    while not request.done:
        assert request.deadline is not None
        times.append(request.deadline)
        request.expire(request.deadline)
        assert all(request_sent == sent for request_sent in requests_in(request.take_outbox()))
    assert times[0] < 0.4
    assert times[-1] == pytest.approx(3.0)
    assert len(times) < 12
    with pytest.raises(FileTimeout, match="open for reading /a: no answer"):
        request.result()
    request.expire(4.0)
    assert request.take_outbox() == []


def test_ftp_refusal_names_operation_and_reason() -> None:
    request = make_request()
    sent = started(request)
    refusal = reply_to(sent, code=MavFtpErr.FAILERRNO)
    request.receive(as_message(refusal.replace(size=2, data=bytes([MavFtpErr.FAILERRNO, 28]))), 0.1)
    with pytest.raises(FileError, match=r"open for reading /a: no space left \(FAILERRNO, ENOSPC\)") as raised:
        request.result()
    assert (raised.value.path, raised.value.code, raised.value.errno) == ("/a", MavFtpErr.FAILERRNO, 28)


@pytest.mark.parametrize("code", [*MavFtpErr, 99])
def test_ftp_error_codes_have_texts(code: int) -> None:
    request = make_request()
    request.receive(as_message(reply_to(started(request), code=code)), 0.1)
    with pytest.raises(FileError, match="/a: "):
        request.result()


NEWLIB = {
    "EPERM": 1, "ENOENT": 2, "EIO": 5, "EBADF": 9, "EAGAIN": 11, "ENOMEM": 12, "EACCES": 13, "EBUSY": 16, "EEXIST": 17,
    "ENODEV": 19, "ENOTDIR": 20, "EISDIR": 21, "EINVAL": 22, "ENFILE": 23, "EMFILE": 24, "EFBIG": 27, "ENOSPC": 28,
    "EROFS": 30, "ENOSYS": 88, "ENOTEMPTY": 90, "ENAMETOOLONG": 91, "EOPNOTSUPP": 95,
}  # fmt: skip
"""errno.h of newlib, which ArduPilot is built with."""
LINUX = {"ENAMETOOLONG": 36, "ENOSYS": 38, "ENOTEMPTY": 39}
"""Differences in Linux and NuttX, which PX4 runs on."""


def test_ftp_errno_names_match_systems() -> None:
    assert {(name, number) for number, (name, _) in ERRNOS.items()} == {*NEWLIB.items(), *LINUX.items()}


@for_each("name, number", [*NEWLIB.items(), *LINUX.items()])
def test_ftp_errno_is_named(name: str, number: int) -> None:
    error = file_error(MavFtpOpcode.REMOVEFILE, "/a", MavFtpErr.FAILERRNO, number)
    assert str(error) == f"remove /a: {ERRNOS[number][1]} (FAILERRNO, {name})"


def test_ftp_unknown_errno_is_shown_as_number() -> None:
    error = file_error(99, "/a", MavFtpErr.FAILERRNO, 200)
    assert str(error) == "operation 99 /a: the operation failed (FAILERRNO, errno 200)"


def test_ftp_ignores_unrelated_replies() -> None:
    request = make_request()
    sent = started(request)
    answer = reply_to(sent)
    request.receive(as_message(answer.replace(sequence=100)), 0.1)
    request.receive(FileTransferProtocol(0, 255, 191, answer.encode()), 0.1)
    request.receive(FileTransferProtocol(0, 254, 190, answer.encode()), 0.1)
    request.receive(as_message(sent), 0.1)
    assert not request.done
    request.receive(FileTransferProtocol(0, 0, 0, answer.encode()), 0.1)
    assert request.done


def test_ftp_request_is_renumbered_after_old_reply() -> None:
    request = make_request()
    sent = started(request)
    stale = reply_to(sent).replace(request_opcode=Op.LISTDIRECTORY)
    for attempt in range(5):
        request.receive(as_message(stale), 0.1)
        again = requests_in(request.take_outbox())
        assert len(again) == (attempt < 3)  # the client abandons a server that always does that
        if again:
            assert again[0].sequence == sent.sequence + 1
            sent, stale = again[0], stale.replace(sequence=again[0].sequence + 1)
    request.receive(as_message(reply_to(sent)), 0.25)
    assert request.done
    assert request.round_trip.smoothed_s == pytest.approx(0.1 + 0.05 / 8)  # from the sending that was answered


def test_ftp_close_of_closed_session_succeeds() -> None:
    request = make_request(Op.TERMINATESESSION, session=3)
    sent = started(request)
    request.receive(as_message(reply_to(sent, code=MavFtpErr.INVALIDSESSION)), 0.1)
    assert request.is_answered


def test_ftp_close_waits_for_burst() -> None:
    request = make_request(Op.TERMINATESESSION, session=3, idle_timeout_s=2.0)
    sent = started(request)
    burst = reply_to(sent, b"x").replace(request_opcode=Op.BURSTREADFILE, sequence=500)
    for tenth in range(1, 100):
        request.receive(as_message(burst), tenth / 10)
        assert request.deadline is not None
        assert request.deadline > tenth / 10 + 0.1
    assert request.take_outbox() == []
    request.receive(as_message(reply_to(sent)), 10.0)
    assert request.is_answered


@pytest.mark.parametrize(
    ("opcode", "code"),
    [
        (Op.REMOVEFILE, MavFtpErr.FILENOTFOUND),
        (Op.REMOVEDIRECTORY, MavFtpErr.FILENOTFOUND),
        (Op.CREATEDIRECTORY, MavFtpErr.FILEEXISTS),
    ],
)
def test_ftp_retry_accepts_earlier_success(opcode: MavFtpOpcode, code: int) -> None:
    request = make_request(opcode)
    sent = started(request)
    request.expire(0.5)
    request.receive(as_message(reply_to(sent, code=code)), 0.6)
    assert request.is_answered
    first = make_request(opcode)
    first.receive(as_message(reply_to(started(first), code=code)), 0.1)
    assert not first.is_answered


def test_ftp_already_sent_request_is_not_sent() -> None:
    request = FtpRequest(make_client(), Op.TERMINATESESSION, path="/a", sent_by_caller=True)
    request.start(0.0)
    assert request.take_outbox() == []
    assert request.deadline is not None
    request.expire(request.deadline)
    assert len(request.take_outbox()) == 1


def test_ftp_session_numbers_wrap() -> None:
    client = make_client(254)
    assert [client.next_session() for _ in range(3)] == [255, 1, 2]
