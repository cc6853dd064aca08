"""Files and logs between the client's protocol machines and simulated vehicles over bad radios."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from protocol_pair import KINDS, LOGS, Pair, radios, seeds, vehicle_of

from aerokit.errors import FileError
from aerokit.mavlink.enums import MavFtpOpcode
from aerokit.parameters import unpack_parameters
from aerokit.protocols.blocks import Reassembly
from aerokit.protocols.ftp import DATA_SIZE, FtpClient, FtpMessage, FtpRequest
from aerokit.protocols.ftp_transfer import FtpDownload, FtpUpload
from aerokit.protocols.logs import LOG_BLOCK, LogDownload, LogList, LogStop
from aerokit.testing.fault_model import FaultModel

# No shrinking: a failure reports radio and seed, and shrinking a transfer that hangs would take minutes.
few = settings(max_examples=6, phases=[Phase.generate])
each = pytest.mark.parametrize("kind", KINDS)
Op = MavFtpOpcode


class Files:
    """File access of a program, one request at a time; reopens a file that the vehicle has closed."""

    def __init__(self, pair: Pair) -> None:
        self.pair = pair
        self.client = FtpClient(1, 1, source_system=255, source_component=190, first_sequence=7)

    def ask(self, opcode: MavFtpOpcode, path: str, *, session: int = 0, offset: int = 0) -> FtpMessage:
        data = b"" if opcode == Op.TERMINATESESSION else path.encode()
        return self.pair.run(
            FtpRequest(self.client, opcode, path=path, session=session, offset=offset, data=data, idle_timeout_s=60)
        )

    def read(self, path: str) -> bytes:
        content = bytearray()
        into = Reassembly(content.extend, block_size=DATA_SIZE)

        def once(opened: FtpMessage) -> None:
            size = int.from_bytes(opened.data[:4], "little")
            self.pair.run(FtpDownload(self.client, path, into, session=opened.session, size=size, idle_timeout_s=60))

        self._with_file(Op.OPENFILERO, path, once)
        return bytes(content)

    def write(self, path: str, content: bytes) -> None:
        self._with_file(
            Op.CREATEFILE,
            path,
            lambda opened: self.pair.run(
                FtpUpload(self.client, path, content, session=opened.session, idle_timeout_s=60)
            ),
        )

    def _with_file(self, opcode: MavFtpOpcode, path: str, use: Callable[[FtpMessage], None]) -> None:
        for _ in range(8):
            try:
                opened = self.ask(opcode, path, session=self.client.next_session())
                use(opened)
                self.ask(Op.TERMINATESESSION, path, session=opened.session)
                return
            except FileError:
                self.pair.wait(12.0)  # Wait until the vehicle closes unused sessions.
        raise AssertionError(f"{path} cannot be used")


@each
@few
@given(radio=radios, seed=seeds, content=st.binary(max_size=4000))
def test_downloaded_file_equals_the_original(kind: str, radio: FaultModel, seed: int, content: bytes) -> None:
    vehicle = vehicle_of(kind)
    vehicle.files.put("/note", content)
    assert Files(Pair(vehicle, radio, seed)).read("/note") == content


@each
@few
@given(radio=radios, seed=seeds, content=st.binary(max_size=2000))
def test_uploaded_file_exists(kind: str, radio: FaultModel, seed: int, content: bytes) -> None:
    vehicle = vehicle_of(kind)
    folder = "/APM" if kind == "copter" else "/fs/microsd"
    vehicle.files.make_folder(f"{folder}/new")
    files = Files(Pair(vehicle, radio, seed))
    files.write(f"{folder}/new/file", content)
    assert vehicle.files.get(f"{folder}/new/file") == content
    assert files.read(f"{folder}/new/file") == content
    listed = files.ask(Op.LISTDIRECTORY, f"{folder}/new").data.split(b"\0")
    assert b"Ffile\t%d" % len(content) in listed


@few
@given(radio=radios, seed=seeds)
def test_parameter_pack_equals_the_parameters(radio: FaultModel, seed: int) -> None:
    vehicle = vehicle_of("copter")
    table = unpack_parameters(Files(Pair(vehicle, radio, seed)).read("@PARAM/param.pck"))
    assert {name: table[name].value for name in table} == pytest.approx(
        {name: vehicle.parameters[name] for name in vehicle.parameters}, rel=1e-6
    )


@each
@few
@given(radio=radios, seed=seeds)
def test_downloaded_logs_equal_the_originals(kind: str, radio: FaultModel, seed: int) -> None:
    pair = Pair(vehicle_of(kind), radio, seed)
    entries = pair.run(LogList(1, 1, first_id=int(kind == "copter"), idle_timeout_s=60))
    assert [(entry.size, entry.time_utc) for entry in entries] == [(log.size, log.time_utc) for log in LOGS]
    for entry, log in zip(entries, LOGS, strict=True):
        content = bytearray()
        into = Reassembly(content.extend, block_size=LOG_BLOCK)
        pair.run(LogDownload(1, 1, entry.id, entry.size, into, idle_timeout_s=60))
        assert bytes(content) == log.make()
    pair.run(LogStop(1, 1))
    pair.wait(1.0)
    assert not pair.vehicle.storage.logs.is_busy
