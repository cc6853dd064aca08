"""The compiled wire and the Python one: same messages, frames, errors, copies."""

from __future__ import annotations

import copy
import gc
import io
import os
import pickle
import random
import subprocess
import sys
import weakref
from typing import Any

import pytest
from framer_harness import noise, some_frames
from hypothesis import given
from hypothesis import strategies as st
from wire_samples import samples

import aerokit
from aerokit.errors import InvalidArgument
from aerokit.mavlink import STANDARD, Dialect, Frame, FrameEncoder, Framer, FramerStatistics, Message, messages
from aerokit.mavlink import tlog as tlog_module
from aerokit.mavlink.framer import PythonFramer
from aerokit.mavlink.message import decoder_of, field_names, layout_of
from aerokit.mavlink.statistics import SourceStatistics

compiled = pytest.mark.skipif(aerokit.wire_implementation != "c", reason="the extension is not built or not used")


class PythonEncoder(FrameEncoder):
    _encode_frame = None


def exact(message: Message) -> list[tuple[type[Any], str]]:
    """All fields with their types, so that 0.0 and -0.0 differ."""
    return [(type(value), repr(value)) for value in (getattr(message, name) for name in field_names(message))]


@compiled
def test_all_messages_decode_and_encode_the_same() -> None:
    for message_class in STANDARD:
        assert layout_of(message_class) is not None, message_class
        ours, theirs = FrameEncoder(3, 4), PythonEncoder(3, 4)
        for message in samples(message_class):
            raw = theirs.encode(message)
            assert ours.encode(message) == raw, message
            frame = Frame.parse(raw)
            decoded = STANDARD.decode(frame)
            assert type(decoded) is message_class
            assert decoded.received_frame is frame
            assert exact(decoded) == exact(message_class.decode_body(frame.body, frame))
            assert exact(decoder_of(message_class)(frame)) == exact(decoded)


@compiled
@given(st.sampled_from(sorted(STANDARD.rows)), st.binary(max_size=255), st.booleans())
def test_any_payload_decodes_the_same(message_id: int, payload: bytes, has_only_body: bool) -> None:
    header = bytes((len(payload), 0, 0, 7, 1, 1)) + message_id.to_bytes(3, "little")
    frame = Frame.parse(b"\xfd" + header + payload + b"\1\2")
    if has_only_body:  # like a frame of PythonFramer
        del frame._raw
    expected = STANDARD[message_id].decode_body(frame.body, frame)
    decoded = STANDARD.decode(frame)
    assert exact(decoded) == exact(expected)
    try:
        payload = expected.encode()
    except InvalidArgument:  # invalid UTF-8 can become longer
        with pytest.raises(InvalidArgument):
            FrameEncoder(1, 1).encode(decoded)
        return
    assert FrameEncoder(1, 1).encode(decoded) == PythonEncoder(1, 1).encode(expected)


VALUES = (
    [(messages.Heartbeat, "custom_mode", value) for value in (-1, 1 << 32, 1 << 70, True, 2.0, "1", None, 7)]
    + [
        (messages.Attitude, "roll", value)
        for value in (1, True, 1 << 2000, 3.4028235677973366e38, 3.5e38, -3.5e38, float("inf"), float("nan"), "x", None)
    ]
    + [(messages.Statustext, "text", value) for value in ("é" * 25, "é" * 26, "\ud800", b"abc", None, "")]
    + [(messages.FileTransferProtocol, "payload", value) for value in (b"1" * 251, b"1" * 252, bytearray(3), "x", None)]
    + [
        (messages.BatteryStatus, "voltages", value)
        for value in ([1, 2], (1,) * 10, (1,) * 11, (-1,), (65536,), ("a",), 5, None, range(3))
    ]
)


@compiled
@pytest.mark.parametrize(("message_class", "name", "value"), VALUES)
def test_odd_values_encode_or_fail_the_same(message_class: type[Message], name: str, value: Any) -> None:
    def outcome(encoder: FrameEncoder) -> object:
        message = next(samples(message_class))
        setattr(message, name, value)
        try:
            return encoder.encode(message), encoder.sequence
        except InvalidArgument as error:
            return str(error), encoder.sequence

    ours, theirs = FrameEncoder(1, 1), PythonEncoder(1, 1)
    for _ in range(2):  # the first message of a class is encoded by Python
        assert outcome(ours) == outcome(theirs)


@compiled
def test_subclass_of_message_keeps_its_own_methods() -> None:
    class Louder(messages.Heartbeat):
        def encode(self) -> bytes:
            return bytes(reversed(super().encode()))

    dialect = Dialect("own", [Louder])
    raw = FrameEncoder(1, 1).encode(Louder(1, 2, 3, 4, 5, 3))
    assert layout_of(Louder) is None
    assert raw[10:-2] == bytes(reversed(messages.Heartbeat(1, 2, 3, 4, 5).encode())).rstrip(b"\0")
    assert type(dialect.decode(Frame.parse(raw))) is Louder


def test_unknown_message_raises_key_error() -> None:
    frame = Frame.parse(b"\xfd" + bytes(6) + (16_000_000).to_bytes(3, "little") + bytes(2))
    with pytest.raises(KeyError):
        STANDARD.decode(frame)


@compiled
@given(st.lists(st.one_of(st.integers(0, 40).map(lambda seed: some_frames(3, seed=seed)[seed % 3]), noise)))
def test_any_log_has_the_same_records(parts: list[bytes]) -> None:
    chance = random.Random(len(parts))
    log = b"".join(chance.randrange(1 << 52).to_bytes(8, "big") + part for part in parts)

    def records(is_compiled: bool) -> list[tuple[float, bytes]]:
        with pytest.MonkeyPatch.context() as patch:
            if not is_compiled:
                patch.setattr(tlog_module, "_compiled", None)
            return list(tlog_module.read_tlog(io.BytesIO(log)))

    assert records(True) == records(False)


def copied(value: Any) -> Any:
    return copy.copy(value)


def pickled(value: Any) -> Any:
    return pickle.loads(pickle.dumps(value))


def test_frames_and_counters_can_be_copied() -> None:
    framer = Framer()
    (frame,) = framer.receive(FrameEncoder(1, 1).encode(messages.Heartbeat(2, 3, 81, 4, 3)), 5.0)
    statistics: FramerStatistics
    for again in (copied, pickled):
        assert (again(frame).raw, again(frame).received_at, again(frame).system_id) == (frame.raw, 5.0, 1)
        statistics = again(framer.statistics)
        assert (statistics.bytes, statistics.frames) == (21, 1)
        source: SourceStatistics = again(framer.statistics.sources[1, 1])
        assert (source.received, source.expected) == (1, 1)


def test_framer_and_dialect_are_freed() -> None:
    dialect = Dialect("own", [messages.Heartbeat])
    framer = Framer(dialect)
    (frame,) = framer.receive(FrameEncoder(1, 1).encode(messages.Heartbeat(2, 3, 81, 4, 3)))
    dialect.decode(frame)
    framer.wanted = [framer]  # type: ignore[list-item]
    gone = weakref.ref(framer), weakref.ref(dialect)
    del framer, dialect, frame
    gc.collect()
    assert [reference() for reference in gone] == [None, None]


@compiled
@pytest.mark.parametrize("raw", [b"", b"\xfd", b"\xfe\xff" + bytes(20), b"\xfd\1" + bytes(10), bytearray(21), None])
def test_frame_of_incomplete_data_has_no_body(raw: Any) -> None:
    frame = Frame()
    frame.message_id = messages.Heartbeat.ID
    for decode in (STANDARD.decode, decoder_of(messages.Heartbeat)):
        frame._raw = raw
        with pytest.raises(AttributeError, match="body"):
            decode(frame)
        del frame._raw
        with pytest.raises(AttributeError, match="body"):
            decode(frame)


@compiled
def test_uninitialized_compiled_objects_raise() -> None:
    framer = Framer.__new__(Framer)
    with pytest.raises(RuntimeError, match="not initialized"):
        framer.receive(b"")
    receive: Any = Framer().receive
    for arguments in ((), (b"", 0.0, 1)):
        with pytest.raises(TypeError):
            receive(*arguments)
    with pytest.raises(TypeError):
        type(layout_of(messages.Heartbeat))()


@compiled
def test_exceptions_within_framer_are_passed_on() -> None:
    class Broken(Framer):
        def _search(self, data: bytes, begin: int, scan: object) -> Any:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        Broken().receive(b"noise")


@compiled
@pytest.mark.parametrize(("kind", "wire"), [("legacy", "c"), ("isolated", "python")])
def test_subinterpreter_has_wire(kind: str, wire: str) -> None:
    interpreters: Any = pytest.importorskip("_interpreters", reason="needs Python 3.13")
    interpreter = interpreters.create(kind)
    program = (
        "import aerokit; from aerokit.mavlink import *\n"
        "raw = FrameEncoder(1, 1).encode(messages.Heartbeat(2, 3, 81, 4, 3))\n"
        "assert STANDARD.decode(*Framer().receive(raw)).custom_mode == 4\n"
        f"assert aerokit.wire_implementation == {wire!r}"
    )
    assert interpreters.exec(interpreter, program) is None
    interpreters.destroy(interpreter)


def test_environment_forces_python_wire() -> None:
    program = (
        "import aerokit, aerokit.mavlink.framer as f; print(aerokit.wire_implementation, f.Framer is f.PythonFramer)"
    )
    environment = {**os.environ, "AEROKIT_PURE": "1"}
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, env=environment)
    assert done.stdout == "python True\n"
    assert aerokit.wire_implementation == ("python" if Framer is PythonFramer else "c")
