"""Files, logs, parameters and signing key of a simulated ArduPilot, and their protocol servers."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import ClassVar

from aerokit.mavlink.enums import MavSeverity
from aerokit.mavlink.frame import Frame
from aerokit.mavlink.messages import LogEntry, LogErase, LogRequestData, LogRequestEnd, LogRequestList
from aerokit.mavlink.signing import ONE_MINUTE, SigningKey, timestamp_at
from aerokit.protocols.servers.files import FileTree, TextMount
from aerokit.protocols.servers.ftp import SessionFtpServer
from aerokit.sim.ardupilot.ftp import ArduPilotFtp
from aerokit.sim.ardupilot.host import ArduPilotHost
from aerokit.sim.autopilot import VehicleSigning, VehicleStorage
from aerokit.sim.channel import Channel
from aerokit.sim.logs import LogServer, SimulatedLog
from aerokit.sim.missions import MissionMount
from aerokit.sim.parameter_server import ArduPilotParameterServer, ParameterServer, rounded
from aerokit.sim.parameters import ParameterPackMount

_SYSTEM_TEXTS = {
    "threads.txt": "ThreadsV1\n",
    "tasks.txt": "TasksV2\n",
    "memory.txt": "MemInfoV1\n",
    "uarts.txt": "UARTV1\n",
    "timers.txt": "TIMERV1\n",
}


class ArduPilotLogServer(LogServer):
    """ArduPilot's log server. Log numbers start at 1, and requests are refused while the vehicle is armed.

    A request during a transfer, or for an unknown log, gets no data.
    """

    FOLDER: ClassVar[str] = "/APM/LOGS"
    _vehicle: ArduPilotHost  # pyright: ignore[reportIncompatibleVariableOverride]

    def __init__(self, vehicle: ArduPilotHost, logs: Sequence[SimulatedLog], files: FileTree) -> None:
        super().__init__(vehicle, logs, files)
        files.put(f"{self.FOLDER}/LASTLOG.TXT", f"{len(logs)}\r\n".encode())
        self._has_warned = False

    def path(self, index: int) -> str:
        return f"{self.FOLDER}/{index + 1:08}.BIN"

    def _on_list(self, request: LogRequestList, channel: Channel) -> None:
        if self._refuses_while_armed():
            return
        if self.is_busy:
            self._vehicle.info("Log download in progress")
            return
        first, last = max(1, request.start), min(len(self.logs), request.end)
        if not self.logs:  # Without logs, answer with a single empty entry that has the number 0.
            first = last = 0
        numbers = range(first, last + 1)
        self.transfer([partial(self._entry, number, last) for number in numbers], channel)

    def _entry(self, number: int, last: int) -> LogEntry:
        if number == 0:
            return LogEntry(id=0, num_logs=0, last_log_num=0, time_utc=0, size=0)
        log = self.logs[number - 1]
        return LogEntry(number, len(self.logs), last, log.time_utc, log.size)

    def _on_data(self, request: LogRequestData, channel: Channel) -> None:
        is_known = 1 <= request.id <= len(self.logs)
        if self._refuses_while_armed() or self.is_busy or not is_known:
            return
        self.transfer(self.blocks(request.id - 1, request.id, request.ofs, request.count), channel)

    def _on_erase(self, request: LogErase, channel: Channel) -> None:
        if not self._refuses_while_armed():
            super()._on_erase(request, channel)

    def _on_end(self, request: LogRequestEnd, channel: Channel) -> None:
        if not self._refuses_while_armed():
            super()._on_end(request, channel)

    def _refuses_while_armed(self) -> bool:
        armed = self._vehicle.is_armed
        if armed and not self._has_warned:
            self._vehicle.send_text(MavSeverity.ERROR, "Disarm for log download")
        self._has_warned = armed
        return armed


class ArduPilotStorage(VehicleStorage):
    """Protocol servers of files, logs and parameters.

    ``link_bytes_per_s`` is the data rate of a port without flow control. A parameter list uses 30 % of this rate, a
    file burst a third, and a log download half. None means flow control, as on USB and in a network.
    """

    def __init__(
        self,
        vehicle: ArduPilotHost,
        logs: Sequence[SimulatedLog],
        *,
        parameter_errors: bool,
        link_bytes_per_s: float | None,
    ) -> None:
        super().__init__()
        self._vehicle = vehicle
        self.files.mounts["@SYS"] = TextMount(_SYSTEM_TEXTS)
        self.files.mounts["@PARAM"] = ParameterPackMount(vehicle.parameters, self._apply)
        self.files.mounts["@MISSION"] = MissionMount(vehicle.missions)
        banner = vehicle.send_banner
        self.parameters: ParameterServer = ArduPilotParameterServer(
            vehicle, vehicle.parameters, sends_errors=parameter_errors, send_banner=banner
        )
        self.ftp: SessionFtpServer[FileTree] = ArduPilotFtp(vehicle, self.files, send_banner=banner)
        self.logs: LogServer = ArduPilotLogServer(vehicle, logs, self.files)
        self.limit_rates(link_bytes_per_s, parameters=0.3, files=1 / 3, logs=0.5)

    def _apply(self, name: str, value: float) -> None:
        """Set a parameter that an uploaded file contains."""
        parameters = self._vehicle.parameters
        # The firmware ignores a value that is not finite (AP_Param.cpp, set_float).
        if name not in self._vehicle.faults.read_only_parameters and math.isfinite(value):
            parameters[name] = rounded(self.parameters.clamped(name, value), parameters.type(name))


_SAVE_INTERVAL_S = 30.0
_SIGNING_OFF = 1


class ArduPilotSigning(VehicleSigning):
    """Message signing of ArduPilot, which sends no status text about a new key.

    The time stamp is stored every 30 s. When a port begins to sign, its time stamp is the stored one plus a minute.

    The first port is considered secure, like USB on a flight controller: it signs, but accepts unsigned frames. If the
    only link of the vehicle is a radio, set ``trusts_first_port`` to False and call `load`.

    Bit 0 of MAV1_OPTIONS turns signing off on the first port, and bit 0 of MAV2_OPTIONS on the second. A change of the
    bit takes effect at the next boot or SETUP_SIGNING.
    """

    AHEAD: ClassVar[int] = ONE_MINUTE
    _vehicle: ArduPilotHost  # pyright: ignore[reportIncompatibleVariableOverride]

    def __init__(self, vehicle: ArduPilotHost, key: SigningKey | None, timestamp: int) -> None:
        super().__init__(vehicle, key, timestamp)
        self.trusts_first_port = True
        vehicle.on_power_on(self._keep_time)

    def is_for(self, link_id: int) -> bool:
        name = f"MAV{link_id + 1}_OPTIONS"
        parameters = self._vehicle.parameters
        return not (name in parameters and int(parameters[name]) & _SIGNING_OFF)

    def unsigned_on(self, link_id: int) -> Callable[[Frame], bool] | None:
        return (lambda _: True) if link_id == 0 and self.trusts_first_port else None

    def may_change(self) -> bool:
        if self._vehicle.is_armed:
            self._vehicle.send_text(MavSeverity.WARNING, "ERROR: Won't setup signing when armed")
            return False
        return True

    def _keep_time(self) -> None:
        self._vehicle.every(_SAVE_INTERVAL_S, self._save)
        self._vehicle.call_later(self._vehicle.timeline.gps_fix, self._on_gps_time)

    def _on_gps_time(self) -> None:
        stamp = timestamp_at(int(self._vehicle.unix_time))
        for channel in self._vehicle.channels:
            if channel.signing is not None:
                channel.signing.timestamp = max(channel.signing.timestamp, stamp)
        self._save()

    def _save(self) -> None:
        if self.key is not None:
            port_timestamps = [
                channel.signing.timestamp for channel in self._vehicle.channels if channel.signing is not None
            ]
            self.timestamp: int = max([self.timestamp, *port_timestamps])
