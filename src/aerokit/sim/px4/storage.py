"""Files, logs, parameters and signing key of a simulated PX4, and their protocol servers."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Sequence
from functools import partial
from pathlib import Path
from typing import ClassVar, NamedTuple

from aerokit.errors import RemoteProtocolError
from aerokit.mavlink.enums import MavFtpErr, MavFtpOpcode, MavParamType, MavSeverity
from aerokit.mavlink.frame import Frame
from aerokit.mavlink.messages import AdsbVehicle, Collision, Heartbeat, LogEntry, LogRequestData, LogRequestList
from aerokit.parameters.pack import HEADER, MAGIC, read_entry, read_header
from aerokit.protocols.ftp import DATA_SIZE
from aerokit.protocols.servers.files import EEXIST, EINVAL, FileFault, FileHandle, FileTree
from aerokit.protocols.servers.ftp import ServedClient, SessionFtpServer
from aerokit.protocols.servers.ftp_packets import FtpPacket
from aerokit.sim.autopilot import VehicleSigning, VehicleStorage
from aerokit.sim.channel import Channel
from aerokit.sim.logs import BLOCK_SIZE, LogServer, SimulatedLog
from aerokit.sim.parameter_server import ParameterServer, Px4ParameterServer
from aerokit.sim.parameters import ParameterPackMount, SimParameters
from aerokit.sim.px4.host import Px4Host
from aerokit.sim.vehicle import MessageHost


def px4_parameters(count: int | None = None, table: str = "quadrotor") -> SimParameters:
    """Return the parameters of a "quadrotor" or an "airplane". ``count`` limits how many are listed."""
    return SimParameters(Path(__file__).with_name(f"{table}.param.csv").read_text("utf-8"), count)


class Px4ParameterMount(ParameterPackMount):
    """``@PARAM`` files of PX4. Opening a file reports its exact size.

    A download is padded, so that no block of 239 bytes, the payload of one MAVFTP packet, ends inside a value or a
    default. Uploaded parameters are applied as they arrive.
    """

    def __init__(self, parameters: SimParameters, apply: Callable[[str, float], None]) -> None:
        super().__init__(parameters, apply, block=DATA_SIZE)

    def open(self, path: str, *, writing: bool) -> FileHandle:
        reader = super().open(path, writing=False)  # This also checks the path of a file to write.
        return _Writer(self._parameters, self._apply) if writing else reader


class _Announced(NamedTuple):
    """Number of entries and file size that the header of an uploaded file announces."""

    entry_count: int
    file_size: int


class _Writer(FileHandle):
    """Upload of parameters, which are applied as they arrive.

    Repeated bytes are acknowledged again. A gap makes the upload fail, and closing an incomplete upload also fails.
    Parameters that were applied before the failure are kept.
    """

    def __init__(self, parameters: SimParameters, apply: Callable[[str, float], None]) -> None:
        self._parameters = parameters
        self._apply = apply
        self._pending = b""  # Received bytes that are not yet a complete entry.
        self._written = 0  # number of bytes received so far
        self._announced: _Announced | None = None  # None before the header
        self._count = 0  # number of entries that were applied
        self._previous_name = b""  # name in the last entry; the next name may begin with the same letters
        self._is_rejected = False  # True once the upload has failed

    def read(self, offset: int, size: int) -> bytes:
        raise FileFault(EINVAL)

    def write(self, offset: int, data: bytes) -> None:
        new_bytes = data[max(0, self._written - offset) :]  # A repeated write contains bytes that were received before.
        has_gap = offset > self._written
        if self._is_rejected or has_gap:
            raise self._rejection()
        self._pending += new_bytes
        self._written += len(new_bytes)
        self._parse()
        if self._announced is not None and self._written > self._announced.file_size:
            raise self._rejection()

    def close(self) -> None:
        is_complete = not self._pending and self._announced == _Announced(self._count, self._written)
        if self._is_rejected or not is_complete:
            raise FileFault(EINVAL)

    def _rejection(self) -> FileFault:
        """Return the error of an invalid upload. All later requests fail, too."""
        self._is_rejected = True
        return FileFault(EINVAL)

    def _parse(self) -> None:
        """Apply the entries that are complete."""
        if self._announced is None:
            if len(self._pending) < HEADER.size:
                return
            magic, count, size = read_header(self._pending)
            if magic != MAGIC or size < HEADER.size:
                raise self._rejection()
            self._announced = _Announced(count, size)
            self._pending = self._pending[HEADER.size :]
        while self._apply_next_entry():
            pass

    def _apply_next_entry(self) -> bool:
        """Apply the next entry. Return False if it is incomplete."""
        pending = self._pending = self._pending.lstrip(b"\0")  # Zero bytes between two entries are padding.
        try:
            entry = read_entry(pending, 0, self._previous_name) if pending else None
        except RemoteProtocolError:
            raise self._rejection() from None
        if entry is None:
            return False
        if entry.default is not None:
            raise self._rejection()
        name = entry.name.decode("ascii", "replace")
        if name in self._parameters:
            self._apply(name, entry.value)
        self._pending = pending[entry.end :]
        self._previous_name = entry.name
        self._count += 1
        return True


class Px4Ftp(SessionFtpServer[FileTree]):
    """MAVFTP server of PX4. Each link has one session (number 0), which ends after 10 s without a request.

    A burst ignores the requested size. After a failure, the next refusals may report its errno, until the client has
    listed a directory. `Faults.no_ftp` turns the server off.
    """

    max_clients: ClassVar[int] = 1 << 16
    max_sessions: ClassVar[int] = 1
    list_prefix: ClassVar[tuple[bytes, ...]] = (b"S", b"S")
    crc_block: ClassVar[int] = 256
    crc_blocks_at_once: ClassVar[int] = 1 << 32

    def __init__(self, vehicle: MessageHost, files: FileTree) -> None:
        super().__init__(vehicle, files, is_enabled=lambda: not vehicle.faults.no_ftp)

    def _key(self, request: FtpPacket, channel: Channel) -> Hashable:
        return channel

    def _is_repeated(self, client: ServedClient, request: FtpPacket, reply: FtpPacket) -> bool:
        return request.sequence + 1 == reply.sequence and request.client == reply.client

    def _new_number(self, client: ServedClient, request: FtpPacket) -> int:
        return 0

    def _answer_fault(self, client: ServedClient, request: FtpPacket, fault: FileFault) -> FtpPacket:
        if request.opcode in (MavFtpOpcode.TRUNCATEFILE, MavFtpOpcode.CALCFILECRC):
            return request.refuse_errno(client.errno)  # The firmware reports the errno of an earlier failure.
        client.errno = fault.errno
        if request.opcode == MavFtpOpcode.LISTDIRECTORY:
            return request.refuse(MavFtpErr.FILENOTFOUND)
        return request.refuse_errno(fault.errno)

    def _adapted(self, client: ServedClient, request: FtpPacket, answer: FtpPacket) -> FtpPacket:
        if answer.opcode == MavFtpOpcode.NAK and client.errno == EEXIST:
            answer = request.refuse(MavFtpErr.FILEEXISTS)
        return super()._adapted(client, request, answer)

    def _list(self, client: ServedClient, request: FtpPacket) -> FtpPacket:
        answer = super()._list(client, request)
        client.errno = 0
        return answer

    def _rename(self, client: ServedClient, request: FtpPacket) -> FtpPacket:
        old_name, _, _ = request.data[: request.size].partition(b"\0")
        has_new_name = len(old_name) + 2 < request.size
        if not has_new_name:
            return request.refuse_errno(client.errno)  # The firmware reports the errno of an earlier failure.
        return super()._rename(client, request)


class Px4LogServer(LogServer):
    """PX4's log server. Log numbers start at 0, and data is sent only after a list request.

    All logs from ``start`` are listed, and ``end`` is only copied to ``last_log_num``. A new request replaces the
    transfer. The last block is not cut to the requested size. Without logs, a list request is not answered.
    """

    FOLDER: ClassVar[str] = "/fs/microsd/log"
    _was_listed = False

    def path(self, index: int) -> str:
        return f"{self.FOLDER}/2026-11-21/{10 + index:02}_00_00.ulg"

    def _on_list(self, request: LogRequestList, channel: Channel) -> None:
        self._was_listed = True
        count = len(self.logs)
        last = count if request.end == 0xFFFF else request.end
        numbers = range(request.start, count)
        self.transfer([partial(self._entry, number, last) for number in numbers], channel)

    def _entry(self, number: int, last: int) -> LogEntry:
        log = self.logs[number]
        return LogEntry(number, len(self.logs), last, log.time_utc, log.size)

    def _on_data(self, request: LogRequestData, channel: Channel) -> None:
        is_available = self._was_listed and request.id < len(self.logs)
        if not is_available or request.ofs >= self.logs[request.id].size:
            self.restart()
            return
        whole_blocks = max(1, math.ceil(request.count / BLOCK_SIZE))
        self.transfer(self.blocks(request.id, request.id, request.ofs, whole_blocks * BLOCK_SIZE), channel)


_LINK_SHARE = 0.5


class Px4Storage(VehicleStorage):
    """Protocol servers of files, logs and parameters.

    ``parameter_file`` serves ``@PARAM/param.pck``, as PX4 does since August 2026. ``link_bytes_per_s`` is the
    configured data rate of the port. None selects the rate of a network link.
    """

    def __init__(
        self, px4: Px4Host, logs: Sequence[SimulatedLog], *, parameter_file: bool, link_bytes_per_s: float | None
    ) -> None:
        super().__init__()
        self._px4 = px4
        if parameter_file:
            self.files.mounts["@PARAM"] = Px4ParameterMount(px4.parameters, self._apply)
        sends_param_error = not px4.version.startswith("1.16")
        self.parameters: ParameterServer = Px4ParameterServer(px4, px4.parameters, sends_errors=sends_param_error)
        self.ftp: SessionFtpServer[FileTree] = Px4Ftp(px4, self.files)
        # The folder of the logs exists even if it is empty. To create it, create a file in it and remove the file.
        self.files.put(f"{Px4LogServer.FOLDER}/.keep", b"").clear_folder(Px4LogServer.FOLDER)
        self.logs: LogServer = Px4LogServer(px4, logs, self.files)
        self.limit_rates(link_bytes_per_s, parameters=_LINK_SHARE, files=_LINK_SHARE, logs=_LINK_SHARE)

    def _apply(self, name: str, value: float) -> None:
        """Apply a parameter of an uploaded file."""
        parameters = self._px4.parameters
        can_store = math.isfinite(value) or parameters.type(name) == MavParamType.REAL32
        if name not in self._px4.faults.read_only_parameters and can_store:
            parameters[name] = self.parameters.clamped(name, value)


_UNSIGNED = frozenset((Heartbeat.ID, AdsbVehicle.ID, Collision.ID))


class Px4Signing(VehicleSigning):
    """Message signing of PX4. A text reports a new key.

    Unsigned HEARTBEAT, ADSB_VEHICLE and COLLISION messages are accepted. PX4 stores the time stamp only together with a
    new key. Version 1.16 does not support signing.
    """

    _vehicle: Px4Host  # pyright: ignore[reportIncompatibleVariableOverride]

    def is_for(self, link_id: int) -> bool:
        return not self._vehicle.version.startswith("1.16")

    def unsigned_on(self, link_id: int) -> Callable[[Frame], bool] | None:
        return lambda frame: frame.message_id in _UNSIGNED

    def may_change(self) -> bool:
        if not self.is_for(0):
            return False
        if self._vehicle.is_armed:
            self._vehicle.send_text(MavSeverity.CRITICAL, "MAVLink signing: rejected while armed")
            return False
        return True

    def on_key_changed(self) -> None:
        self._vehicle.info("MAVLink signing disabled" if self.key is None else "MAVLink signing key accepted")
