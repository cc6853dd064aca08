"""param.pck: round trips, pymavlink's reading, and damaged files."""

from __future__ import annotations

import contextlib
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.mavftp import MAVFTP

from aerokit.errors import InvalidArgument, RemoteProtocolError
from aerokit.parameters import Parameter, ParameterTable, ParameterType
from aerokit.parameters.pack import pack_for_download, pack_parameters, unpack_parameters

TYPES = [ParameterType.INT8, ParameterType.INT16, ParameterType.INT32, ParameterType.REAL32]


def values_of(type_: ParameterType) -> st.SearchStrategy[int | float]:
    if type_.is_integer:
        return st.integers(int(type_.minimum), int(type_.maximum))
    return st.floats(width=32, allow_nan=False, allow_infinity=False)


@st.composite
def tables(draw: st.DrawFn, least: int = 0) -> ParameterTable:
    names = draw(st.lists(st.text("ABC_1", min_size=1, max_size=16), min_size=least, max_size=40, unique=True))
    rows = []
    for index, name in enumerate(sorted(names) if draw(st.booleans()) else names):
        type_ = draw(st.sampled_from(TYPES))
        values = values_of(type_)
        rows.append(Parameter(name, draw(values), type_, draw(values), index))
    return ParameterTable(rows)


def undefaulted(table: ParameterTable) -> ParameterTable:
    return ParameterTable(p.replace(default=None) for p in table.values())


def as_served(upload: bytes) -> bytes:
    """Return the parameters with a download's header, whose third number is not the length."""
    magic, count, _ = struct.unpack_from("<HHH", upload)
    return struct.pack("<HHH", magic, count, count) + upload[6:]


@given(tables(least=1), st.integers(6, 239))
def test_downloaded_pack_round_trip(table: ParameterTable, block_size: int) -> None:
    assert unpack_parameters(pack_for_download(table, block_size=block_size)) == undefaulted(table)
    served = pack_for_download(table, with_defaults=True, block_size=block_size)
    assert unpack_parameters(served) == table
    oracle = MAVFTP.ftp_param_decode(served)
    assert oracle is not None
    assert oracle.defaults is not None
    assert [(n.decode(), v) for n, v, _ in oracle.params] == [(p.name, p.value) for p in table.values()]
    assert [(n.decode(), v) for n, v, _ in oracle.defaults] == [(p.name, p.default) for p in table.values()]


@given(tables())
def test_uploaded_pack_round_trip(table: ParameterTable) -> None:
    data = pack_parameters(table)
    magic, count, length = struct.unpack_from("<HHH", data)
    assert (magic, count, length) == (0x671B, len(table), len(data))
    served = as_served(data)
    assert unpack_parameters(served) == undefaulted(table)
    oracle = MAVFTP.ftp_param_decode(served)
    assert oracle is not None
    assert [(n.decode(), v) for n, v, _ in oracle.params] == [(p.name, p.value) for p in table.values()]


@given(tables(least=3), st.data())
def test_partial_pack_round_trip(table: ParameterTable, data: st.DataObject) -> None:
    start = data.draw(st.integers(0, len(table) - 1))
    count = data.draw(st.integers(0, len(table)))
    part = list(undefaulted(table).values())[start : start + count if count else None]
    served = pack_for_download(table, start=start, count=count)
    assert unpack_parameters(served, start=start) == ParameterTable(part)


@given(tables(least=1), st.sampled_from([20, 100, 239]), st.data())
def test_pack_values_do_not_cross_blocks(table: ParameterTable, block_size: int, data: st.DataObject) -> None:
    later = ParameterTable(p.replace(value=data.draw(values_of(p.type))) for p in table.values())
    one, two = (pack_for_download(t, block_size=block_size) for t in (table, later))
    blocks = [data.draw(st.sampled_from((one, two)))[i : i + block_size] for i in range(0, len(one), block_size)]
    mixed = unpack_parameters(b"".join(blocks))
    assert all(p.value in (table[p.name].value, later[p.name].value) for p in mixed.values())


@given(tables(least=2), st.data())
def test_damaged_pack_raises_only_protocol_error(table: ParameterTable, data: st.DataObject) -> None:
    whole = pack_for_download(table, with_defaults=data.draw(st.booleans()))
    cut = whole[: data.draw(st.integers(0, len(whole) - 1))]
    if any(whole[len(cut) :]):
        with pytest.raises(RemoteProtocolError):
            unpack_parameters(cut)
    changed = bytearray(whole)
    changed[data.draw(st.integers(0, len(whole) - 1))] ^= data.draw(st.integers(1, 255))
    with contextlib.suppress(RemoteProtocolError):
        unpack_parameters(bytes(changed))


@given(st.binary(max_size=100))
def test_pack_decodes_noise_or_raises(data: bytes) -> None:
    with contextlib.suppress(RemoteProtocolError):
        unpack_parameters(struct.pack("<HHH", 0x671B, 1, 1) + data)


ROWS = [
    Parameter("ARMING_CHECK", 1, ParameterType.INT32, 1),
    Parameter("ARMING_REQUIRE", -2, ParameterType.INT8, 1),
    Parameter("RTL_ALT", 1500.0, ParameterType.REAL32, 1.5),
]


@pytest.mark.parametrize(
    ("made", "golden"),
    [
        (pack_parameters(ROWS), "1b67 0300 2f00 03b041524d494e475f434845434b01000000 016752455155495245fe"
         " 046052544c5f414c540080bb44"),
        (
            pack_for_download(ROWS, with_defaults=True, block_size=24, whole_defaults=True),
            "1c67 0300 0300 03b041524d494e475f434845434b01000000 116752455155495245fe01"
            " 00000000 146052544c5f414c540080bb440000c03f",
        ),
    ],
)  # fmt: skip
def test_pack_bytes_match_ardupilot(made: bytes, golden: str) -> None:
    """Compare with ArduPilot's description of the file; the simulator shares our codec and would prove nothing."""
    assert made.hex() == golden.replace(" ", "")


def test_damaged_pack_error_names_position() -> None:
    def file(*entries: bytes, count: int | None = None) -> bytes:
        number = len(entries) if count is None else count
        return struct.pack("<HHH", 0x671B, number, number) + b"".join(entries)

    good = b"\x01\x00A\x05"
    assert unpack_parameters(file(b"\0\0\0" + good)).values_by_name() == {"A": 5}
    for entry, text in (
        (b"\x05\x00A\x05", "type 5"),
        (b"\x21\x00A\x05", "flags 2"),
        (b"\x01\x01A\x05", "length 1 \\+ 1 after"),
        (b"\x01\x00\x80\x05", "invalid name"),
        (b"\x02\x00A\x05", "ends inside"),
        (b"\x01", "ends inside"),
    ):
        with pytest.raises(RemoteProtocolError, match=f"byte 6: .*{text}"):
            unpack_parameters(file(entry))
    with pytest.raises(RemoteProtocolError, match="has 1 parameters, but its header says 2"):
        unpack_parameters(file(good, count=2))
    with pytest.raises(RemoteProtocolError, match="twice"):
        unpack_parameters(file(good, good))
    with pytest.raises(RemoteProtocolError, match="header"):
        unpack_parameters(b"\x1b\x67")
    with pytest.raises(RemoteProtocolError, match=r"not a param\.pck"):
        unpack_parameters(b"<html>")


def test_pack_stores_unsigned_types_in_wider_ones() -> None:
    rows = [
        Parameter("A", 200, ParameterType.UINT8),
        Parameter("B", 60000, ParameterType.UINT16),
        Parameter("C", 2**31 - 1, ParameterType.UINT32),
    ]
    read = unpack_parameters(as_served(pack_parameters(rows)))
    assert read.values_by_name() == {"A": 200, "B": 60000, "C": 2**31 - 1}
    assert [p.type for p in read.values()] == [ParameterType.INT16, ParameterType.INT32, ParameterType.INT32]


@pytest.mark.parametrize(
    ("parameter", "text"),
    [
        (Parameter("SEVENTEEN_LETTERS", 1, ParameterType.INT8), "17 characters"),
        (Parameter("X", float("nan"), ParameterType.REAL32), "finite"),
        (Parameter("X", 300, ParameterType.INT8), "-128..127"),
        (Parameter("X", 2**31, ParameterType.UINT32), "must be in"),
        (Parameter("X", 1, ParameterType.INT64), "INT64"),
    ],
)
def test_pack_rejects_unsupported_parameters(parameter: Parameter, text: str) -> None:
    with pytest.raises(InvalidArgument, match=text):
        pack_parameters([parameter])


def test_pack_size_limits() -> None:
    rows = [Parameter(f"{i * 7919 % 10000:04}{i:012}", 1, ParameterType.INT32) for i in range(8000)]
    with pytest.raises(InvalidArgument, match="the file can hold 65535 bytes"):
        pack_parameters(rows)
    assert len(pack_parameters(rows[:2000])) < 65536
    with pytest.raises(InvalidArgument, match=r"start = 8000 must be in 0\.\.7999"):
        pack_for_download(rows, start=8000)
