"""Fuzz targets of corrections and calibration: RTCM, answers of NTRIP casters, PX4's texts."""

from __future__ import annotations

import asyncio
from contextlib import suppress

from target import Target

from aerokit.errors import InvalidArgument
from aerokit.protocols.rtcm import RtcmReader, crc24q, fragments, rtcm_messages
from aerokit.vehicle.calibration.values import parse_report
from aerokit.vehicle.rtk.ntrip import _Response

__all__ = ["CORRECTION_TARGETS"]


def fuzz_rtcm(data: bytes) -> None:
    """Only whole messages are found, and fragments contain the same bytes."""
    reader = RtcmReader()
    found = [message for begin in range(0, len(data), 100) for message in reader.feed(data[begin : begin + 100])]
    assert all(crc24q(message) == 0 for message in found)
    assert sum(map(len, found)) + reader.skipped_bytes + len(reader._buffer) == len(data)
    with suppress(InvalidArgument):
        for message in rtcm_messages(data):
            pieces = fragments(message, 40)
            assert b"".join(piece.data[: piece.len] for piece in pieces) == message


def fuzz_ntrip(data: bytes) -> None:
    """An answer of a caster is read to its end, or raises an error that the client catches."""

    async def read() -> None:
        reader = asyncio.StreamReader()
        reader.feed_data(data)
        reader.feed_eof()
        with suppress(OSError, ValueError, EOFError):
            async for piece in (await _Response.read(reader)).body():
                assert len(piece) <= len(data)

    loop = asyncio.new_event_loop()
    try:
        loop.run_until_complete(read())
    finally:
        loop.close()


def fuzz_calibration_text(data: bytes) -> None:
    """A text is a report with valid values, or no report."""
    report = parse_report(data.decode(errors="replace"))
    assert report is None or report.progress is None or 0 <= report.progress <= 1


CORRECTION_TARGETS = (
    Target("rtcm", fuzz_rtcm, 2048),
    Target("ntrip", fuzz_ntrip, 4096),
    Target("calibration_text", fuzz_calibration_text, 60),
)
