from __future__ import annotations

import math
import struct
import zlib
from contextlib import suppress

import pytest
from ftp_client import Err, FtpClient, Op
from hypothesis import given
from hypothesis import strategies as st
from simulated_client import Client

from aerokit.errors import InvalidArgument
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavParamError, MavParamType
from aerokit.mavlink.message import Message
from aerokit.parameters import (
    pack_parameters,
    unpack_parameters,
)
from aerokit.protocols.servers.files import FileFault
from aerokit.sim import SimulatedCopter, SimulatedPx4
from aerokit.sim.ardupilot.kinds import KINDS, Kind, parameters_of
from aerokit.sim.parameter_server import rounded
from aerokit.sim.parameters import ParameterPackMount, SimParameters
from aerokit.sim.px4.storage import px4_parameters

REAL, INT8, INT16, INT32 = MavParamType.REAL32, MavParamType.INT8, MavParamType.INT16, MavParamType.INT32


def a_copter(**options: object) -> tuple[SimulatedCopter, Client]:
    copter = SimulatedCopter(boot_time_s=0.0, **options)  # type: ignore[arg-type]
    return copter, ready(copter)


def a_px4(**options: object) -> tuple[SimulatedPx4, Client]:
    px4 = SimulatedPx4(boot_time_s=0.0, fast_rate_hz=1.0, **options)  # type: ignore[arg-type]
    return px4, ready(px4)


def ready(vehicle: SimulatedCopter | SimulatedPx4) -> Client:
    client = Client(vehicle)
    client.run(1.0)
    client.clear()
    return client


def answers(client: Client, message: Message, seconds: float = 0.1) -> list[m.ParamValue]:
    client.clear()
    client.send(message)
    client.run(seconds)
    return client.all(m.ParamValue)


def bits_of(message: m.ParamValue) -> int:
    assert message.received_frame is not None
    return int.from_bytes(message.received_frame.payload[:4], "little")


def test_change_with_unknown_name_sets_nothing() -> None:
    copter, _ = a_copter()
    with pytest.raises(InvalidArgument, match="RTL_ALTT"):
        copter.parameters.change({"WPNAV_SPEED": 300.0, "RTL_ALTT": 1.0})
    assert copter.parameters["WPNAV_SPEED"] != 300.0


# ---------------------------------------------------------------------------------------- tables


def test_tables_match_the_firmwares() -> None:
    assert (len(parameters_of("copter")), len(px4_parameters())) == (1349, 910)
    assert len(parameters_of("copter", 100)) == 100
    assert px4_parameters().names == tuple(sorted(px4_parameters().names))
    copter = parameters_of("copter")
    assert sum(copter.default(name) != copter[name] for name in copter) == 41
    assert all(math.isfinite(copter[name]) for name in copter)


def test_each_ardupilot_firmware_has_a_table() -> None:
    tables = {kind: parameters_of(kind) for kind in KINDS}
    assert {kind: len(table) for kind, table in tables.items()} == {
        "copter": 1349, "plane": 1401, "rover": 1235, "sub": 1386,
    }  # fmt: skip
    for table in tables.values():
        assert all(math.isfinite(table[name]) and math.isfinite(table.default(name)) for name in table)
    assert [tables[kind]["MAV_SYSID"] for kind in KINDS] == [1, 1, 1, 1]
    assert {len(parameters_of(kind, 100)) for kind in KINDS} == {100}
    tables["plane"]["BATT2_MONITOR"] = 4
    assert len(tables["plane"]) == 1415


def test_enabling_a_feature_changes_the_count() -> None:
    copter = parameters_of("copter")
    assert copter["BATT2_CAPACITY"] == 3300, "always readable by name"
    assert "BATT2_CAPACITY" not in copter.names
    copter["BATT2_MONITOR"] = 4
    assert len(copter) == 1362
    assert copter.index("BATT2_CAPACITY") == copter.index("BATT2_MONITOR") + 1
    copter["BATT2_MONITOR"] = 0
    assert len(copter) == 1349
    copter.add("NEW", 2.0)
    assert copter.names[-1] == "NEW"
    copter.remove("NEW")
    assert len(copter) == 1349


@pytest.mark.parametrize(
    ("type_", "value", "kept"),
    [(INT8, 20.7, 20), (INT8, 20.995, 21), (INT8, 300, 127), (INT8, -300, -128), (INT8, -2.5, -2),
     (INT16, 70_000, 32_767), (INT32, 16_777_217, 16_777_216), (REAL, 0.1, pytest.approx(0.1, rel=1e-6))],
)  # fmt: skip
def test_ardupilot_stores_single_precision(type_: int, value: float, kept: float) -> None:
    copter, client = a_copter(parameter_count=80)
    copter.parameters.add("X", 0, type_)
    (echo,) = answers(client, m.ParamSet(1, 1, "X", value, REAL))
    assert (echo.param_value, echo.param_type, echo.param_index) == (kept, type_, 0xFFFF)
    assert copter.parameters["X"] == kept


# ------------------------------------------------------------------------------------- ArduPilot


def test_ardupilot_list_restarts_and_runs_at_2000_hz() -> None:
    copter, client = a_copter()
    client.send(m.ParamRequestList(1, 1))
    client.run(0.2)
    first = len(client.all(m.ParamValue))
    assert first == pytest.approx(400, abs=30)
    client.send(m.ParamRequestList(1, 1))
    client.run(1.0)
    indices = [value.param_index for value in client.all(m.ParamValue)[first:]]
    assert indices == list(range(1349))
    assert copter.storage.parameters.running_lists == 0
    assert client.texts.count("Frame: QUAD/PLUS") == 2


def test_ardupilot_list_uses_30_percent_of_slow_link() -> None:
    _, client = a_copter(link_bytes_per_s=5760)
    values = answers(client, m.ParamRequestList(1, 1), 2.0)
    assert len(values) * 37 == pytest.approx(2 * 0.3 * 5760, rel=0.05)


def test_ardupilot_queues_twenty_reads() -> None:
    _, client = a_copter(parameter_count=100)
    for index in range(50):
        client.vehicle.receive(client._encoder.encode(m.ParamRequestRead(1, 1, "", index)), client.now)
    client.run(0.1)
    assert [value.param_index for value in client.all(m.ParamValue)] == list(range(20 + 1))
    assert [v.param_index for v in answers(client, m.ParamRequestRead(1, 1, "RTL_ALT", -1))] == [0xFFFF]


def test_ardupilot_released_version_sends_parameter_errors() -> None:
    questions = (
        (m.ParamSet(1, 1, "NOPE", 1.0, REAL), MavParamError.DOES_NOT_EXIST, -1),
        (m.ParamSet(1, 1, "RTL_ALT", math.nan, REAL), MavParamError.VALUE_OUT_OF_RANGE, -1),
        (m.ParamRequestRead(1, 1, "NOPE", -1), MavParamError.DOES_NOT_EXIST, -1),
        (m.ParamRequestRead(1, 1, "", 5000), MavParamError.DOES_NOT_EXIST, 5000),
    )
    _, silent = a_copter(parameter_count=80)
    _, frank = a_copter(parameter_count=80, parameter_errors=True)
    for question, code, index in questions:
        assert answers(silent, question) == []
        assert answers(frank, question) == []
        (error,) = frank.all(m.ParamError)
        assert (error.error, error.param_index, error.target_system) == (code, index, 255)
    assert silent.all(m.ParamError) == []
    assert len(answers(frank, m.ParamSet(1, 1, "RTL_ALT", 1000.0, REAL))) == 2


def test_faults_clamp_protect_and_mute_parameters() -> None:
    copter, client = a_copter(parameter_count=100, parameter_errors=True)
    copter.faults.parameter_limits["RTL_ALT"] = (300.0, 8000.0)
    assert answers(client, m.ParamSet(1, 1, "RTL_ALT", 10.0, REAL))[0].param_value == 300.0
    copter.faults.read_only_parameters.add("RTL_ALT")
    assert answers(client, m.ParamSet(1, 1, "RTL_ALT", 500.0, REAL))[0].param_value == 300.0
    assert client.all(m.ParamError)[0].error == MavParamError.PERMISSION_DENIED
    assert "Param write denied (RTL_ALT)" in client.texts
    copter.faults.mute_parameters.add("RTL_ALT")
    names = [value.param_id for value in answers(client, m.ParamRequestList(1, 1), 1.0)]
    assert len(names) == 99
    assert "RTL_ALT" not in names


# --------------------------------------------------------------------------------- param.pck


@pytest.mark.parametrize("block", [239, 80, 100, 17])
def test_pack_equals_the_firmwares_pack(block: int) -> None:
    parameters = parameters_of("copter")
    rows = [parameters.row(name) for name in parameters.names]
    for fixed in (None, block):
        table = unpack_parameters(served(parameters, "param.pck?withdefaults=1", block, fixed))
        assert list(table) == [row.name for row in rows]
        for row in rows:
            assert (table[row.name].value, table[row.name].default) == (row.value, row.default)


def served(parameters: SimParameters, path: str = "param.pck", block: int = 239, fixed: int | None = None) -> bytes:
    """Return the pack, read in blocks of this size."""
    file = ParameterPackMount(parameters, lambda *_: None, block=fixed).open(path, writing=False)
    content = b""
    while piece := file.read(len(content), block):
        content += piece
    return content


def test_pack_reads_need_one_block_size() -> None:
    copter, client = a_copter(parameter_count=100)
    ftp = FtpClient(client)
    assert ftp.data(Op.OPENFILERO, "@PARAM/param.pck?start=98&count=5") == (1200).to_bytes(4, "little")
    part = ftp.data(Op.READFILE, size=200)
    assert struct.unpack_from("<HHH", part) == (0x671B, 2, 100)
    assert ftp.refusal(Op.READFILE, size=100) == (Err.FAILERRNO, 22)
    ftp.data(Op.TERMINATESESSION)
    assert any("ArduCopter" in text for text in client.texts) or copter.now > 0
    for path in ("@PARAM/param.pck?start=70000", "@PARAM/param.pck?withdefaults=2"):
        assert ftp.refusal(Op.OPENFILERO, path) == (Err.FAILERRNO, 22)
    for path in ("@PARAM/other", "@PARAM/param.pckx"):
        assert ftp.refusal(Op.OPENFILERO, path) == (Err.FILENOTFOUND,)


def test_uploaded_pack_is_applied_on_close() -> None:
    copter, client = a_copter(parameter_count=100)
    ftp = FtpClient(client)
    table = unpack_parameters(served(copter.parameters))
    assert table
    content = pack_parameters(table)
    for name in ("RTL_ALT", "WPNAV_SPEED", "DISARM_DELAY"):
        copter.parameters[name] = 1
    ftp.upload("@PARAM/param.pck", content)
    assert {name: copter.parameters[name] for name in copter.parameters} == table.values_by_name()
    copter.parameters["RTL_ALT"] = 1
    for broken in (b"", content + b"\0", b"\0" + content[1:]):
        ftp.upload("@PARAM/param.pck", broken)
    assert copter.parameters["RTL_ALT"] == 1


@given(st.binary(max_size=200), st.integers(0, 5))
def test_random_uploads_are_handled(noise: bytes, count: int) -> None:
    copter = SimulatedCopter(parameter_count=70)
    file = copter.files.open("@PARAM/param.pck", writing=True)
    file.write(0, struct.pack("<HHH", 0x671B, count, 6 + len(noise)) + noise)
    with suppress(FileFault):
        file.close()


@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize("name", ["FENCE_TYPE", "GUID_TIMEOUT", "GF_ACTION"])
def test_uploaded_value_that_is_not_finite_is_ignored(name: str, value: float) -> None:
    vehicle = SimulatedPx4(parameter_file=True) if name == "GF_ACTION" else SimulatedCopter()
    before = vehicle.parameters[name]
    float_type = 4
    entry = bytes([float_type, (len(name) - 1) << 4]) + name.encode() + struct.pack("<f", value)
    file = vehicle.files.open("@PARAM/param.pck", writing=True)
    file.write(0, struct.pack("<HHH", 0x671B, 1, 6 + len(entry)) + entry)
    file.close()
    assert vehicle.parameters[name] == before


# ------------------------------------------------------------------------------------------ PX4


def test_px4_hash_excludes_volatile_parameters() -> None:
    px4, client = a_px4()
    rows = [px4.parameters.row(name) for name in px4.parameters.names]
    crc = 0xFFFFFFFF
    for row in rows:
        if not row.is_volatile:
            value = struct.pack("<i", int(row.value)) if row.type == INT32 else struct.pack("<f", row.value)
            crc = zlib.crc32(row.name.encode() + value, crc)
    assert px4.parameters.row("CAL_ACC0_XOFF").is_volatile

    def reported_hash() -> int:
        (answer,) = answers(client, m.ParamRequestRead(1, 1, "_HASH_CHECK", -1))
        return bits_of(answer)

    assert reported_hash() == crc ^ 0xFFFFFFFF
    px4.parameters["CAL_ACC0_XOFF"] = 1.0
    assert reported_hash() == crc ^ 0xFFFFFFFF
    px4.parameters["MPC_XY_CRUISE"] = 6.0
    assert reported_hash() != crc ^ 0xFFFFFFFF


def test_px4_sends_hash_first_except_on_restart() -> None:
    _, client = a_px4()
    client.send(m.ParamRequestList(1, 1))
    client.run(0.2)
    client.send(m.ParamRequestList(1, 1))
    client.run(1.5)
    values = client.all(m.ParamValue)
    assert [v.param_id for v in values].count("_HASH_CHECK") == 1
    assert (values[0].param_id, values[0].param_index) == ("_HASH_CHECK", 0xFFFF)
    assert [v.param_index for v in values[-910:]] == list(range(910))
    assert answers(client, m.ParamRequestList(0, 0), 1.0) == []


@pytest.mark.parametrize("value", [0, 1, -1, -5_000_000, 0x7F800001, -(2**31), 2**31 - 1])
def test_px4_stores_every_bit(value: int) -> None:
    px4, client = a_px4(parameter_count=70)
    px4.parameters["COM_LOW_BAT_ACT"] = value
    (echo,) = answers(client, m.ParamRequestRead(1, 1, "COM_LOW_BAT_ACT", -1))
    assert bits_of(echo) == value & 0xFFFFFFFF
    payload = bytearray(m.ParamSet(1, 1, "COM_RC_IN_MODE", 0.0, INT32).encode())
    payload[:4] = struct.pack("<i", value)
    message = m.ParamSet.decode(bytes(payload))
    frame = client._encoder.encode(message)
    if struct.pack("<f", message.param_value) == struct.pack("<i", value):  # A Python float has kept the bits.
        px4.receive(frame, client.now)
        assert px4.parameters["COM_RC_IN_MODE"] == value


def test_px4_confirms_a_change_twice() -> None:
    px4, client = a_px4(parameter_count=70)
    index = px4.parameters.index("MIS_TAKEOFF_ALT")
    first, second = answers(client, m.ParamSet(1, 1, "MIS_TAKEOFF_ALT", 3.0, REAL))
    assert (first.param_index, second.param_index, first.param_value) == (index, index, 3.0)
    assert len(answers(client, m.ParamSet(1, 1, "MIS_TAKEOFF_ALT", 3.0, REAL))) == 1
    (nan,) = answers(client, m.ParamSet(1, 1, "MIS_TAKEOFF_ALT", math.nan, REAL))
    assert math.isnan(nan.param_value)
    assert math.isnan(px4.parameters["MIS_TAKEOFF_ALT"])


def test_px4_sends_parameter_errors_since_1_17() -> None:
    questions = (
        (m.ParamSet(1, 1, "NOPE", 1.0, REAL), MavParamError.DOES_NOT_EXIST),
        (m.ParamSet(1, 1, "COM_LOW_BAT_ACT", 1.0, REAL), 7),
        (m.ParamSet(1, 1, "COM_LOW_BAT_ACT", 1.0, INT16), 6),
        (m.ParamSet(1, 1, "_HASH_CHECK", 0.0, REAL), MavParamError.READ_ONLY),
        (m.ParamRequestRead(1, 1, "NOPE", -1), MavParamError.DOES_NOT_EXIST),
        (m.ParamRequestRead(1, 1, "", 5000), MavParamError.DOES_NOT_EXIST),
    )
    _, new = a_px4(parameter_count=70)
    _, old = a_px4(parameter_count=70, version="1.16.1")
    for question, code in questions:
        assert answers(new, question) == []
        (error,) = new.all(m.ParamError)
        assert error.error == code
        assert answers(old, question) == []
        assert old.all(m.ParamError) == []


def test_px4_serves_the_pack_if_enabled() -> None:
    px4, client = a_px4(parameter_count=100)
    assert FtpClient(client).refusal(Op.OPENFILERO, "@PARAM/param.pck") == (Err.FILENOTFOUND,)
    px4, client = a_px4(parameter_count=100, parameter_file=True)
    ftp = FtpClient(client)
    size = int.from_bytes(ftp.data(Op.OPENFILERO, "@PARAM/param.pck?withdefaults=1"), "little")
    ftp.data(Op.TERMINATESESSION)
    content = ftp.download("@PARAM/param.pck?withdefaults=1")
    assert len(content) == size, "opening reports the exact size"
    table = unpack_parameters(content)
    assert table.values_by_name() == {name: px4.parameters[name] for name in px4.parameters}
    assert table["CA_ROTOR_COUNT" if "CA_ROTOR_COUNT" in table else "BAT1_N_CELLS"].default == 0


def test_px4_accepts_packs_in_order_only() -> None:
    px4, client = a_px4(parameter_count=100, parameter_file=True)
    ftp = FtpClient(client)
    content = pack_parameters(unpack_parameters(served(px4.parameters)))
    first, second = content[:239], content[239:478]
    names = px4.parameters.names
    for name in names:
        px4.parameters[name] = 77
    ftp.upload("@PARAM/param.pck", content)
    assert 77 not in {px4.parameters[name] for name in names}
    px4.parameters[names[0]] = 77
    ftp.data(Op.CREATEFILE, "@PARAM/param.pck")
    ftp.data(Op.WRITEFILE, first)
    ftp.data(Op.WRITEFILE, first)
    assert px4.parameters[names[0]] != 77, "before the end"
    assert ftp.refusal(Op.WRITEFILE, second, offset=478) == (Err.FAILERRNO, 22)
    assert ftp.refusal(Op.WRITEFILE, second, offset=239) == (Err.FAILERRNO, 22), "a gap makes it invalid"
    assert ftp.refusal(Op.TERMINATESESSION) == (Err.FAILERRNO, 22)
    assert px4.ftp.open_sessions == 0


@given(st.floats(-200, 200), st.sampled_from([INT8, INT16, INT32]))
def test_rounding_truncates_after_adding_a_hundredth(value: float, type_: int) -> None:
    assert abs(rounded(value, type_)) <= abs(value) + 0.011
    assert abs(rounded(value, type_) - value) < 1.0


@pytest.mark.parametrize("kind", KINDS)
def test_parameters_that_are_not_listed_can_be_read_and_set(kind: Kind) -> None:
    reduced = parameters_of(kind, 1)
    assert reduced.names == tuple(parameters_of(kind))[:1]
    reduced["FENCE_ENABLE"] = 1
    assert (reduced["FENCE_ENABLE"], reduced.index("FENCE_ENABLE"), len(reduced)) == (1, 0xFFFF, 1)
