"""Files, logs, parameters and signing key of a simulated ArduPilot, and their protocol servers."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import ClassVar

from aerokit.mavlink.enums import MavSeverity
from aerokit.mavlink.frame import Frame
from aerokit.mavlink.signing import ONE_MINUTE, SigningKey, timestamp_at
from aerokit.protocols.servers.files import FileTree, TextMount
from aerokit.sim.ardupilot.ftp import ArduPilotFtp
from aerokit.sim.ardupilot.host import ArduPilotHost
from aerokit.sim.autopilot import VehicleSigning
from aerokit.sim.logs import ArduPilotLogServer, SimulatedLog
from aerokit.sim.missions import MissionMount
from aerokit.sim.parameter_server import ArduPilotParameterServer, rounded
from aerokit.sim.parameters import ParameterPackMount

LOG_FOLDER = "/APM/LOGS"
DEFAULT_LOGS = (SimulatedLog(186_432, 1_789_990_000), SimulatedLog(45_103, 1_789_995_000))

_SYSTEM_TEXTS = {
    "threads.txt": "ThreadsV1\n",
    "tasks.txt": "TasksV2\n",
    "memory.txt": "MemInfoV1\n",
    "uarts.txt": "UARTV1\n",
    "timers.txt": "TIMERV1\n",
}

# Sizes of three kinds of MAVLink 2 frames in bytes, without a signature.
_PARAM_VALUE_FRAME, _FTP_FRAME, _LOG_DATA_FRAME = 37, 266, 109
_PARAMETERS_SHARE, _BURST_SHARE, _LOG_SHARE = 0.3, 1 / 3, 0.5


class ArduPilotStorage:
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
        self._vehicle = vehicle
        self.files: FileTree = FileTree()
        self._put_logs(logs)
        self.files.mounts["@SYS"] = TextMount(_SYSTEM_TEXTS)
        self.files.mounts["@PARAM"] = ParameterPackMount(vehicle.parameters, self._apply)
        self.files.mounts["@MISSION"] = MissionMount(vehicle.missions)
        banner = vehicle.send_banner
        self.parameters: ArduPilotParameterServer = ArduPilotParameterServer(
            vehicle, vehicle.parameters, sends_errors=parameter_errors, send_banner=banner
        )
        self.ftp: ArduPilotFtp = ArduPilotFtp(vehicle, self.files, send_banner=banner)
        self.logs: ArduPilotLogServer = ArduPilotLogServer(
            vehicle,
            logs,
            is_armed=lambda: vehicle.is_armed,
            erase_files=self._erase_logs,
            append_to_file=lambda number, data: self.files.append(_log_path(number), data),
        )
        if link_bytes_per_s is not None:
            self.parameters.list_rate_hz = _PARAMETERS_SHARE * link_bytes_per_s / _PARAM_VALUE_FRAME
            self.ftp.burst_interval_s = _FTP_FRAME / (_BURST_SHARE * link_bytes_per_s)
            self.logs.rate_hz = _LOG_SHARE * link_bytes_per_s / _LOG_DATA_FRAME
            self.parameters.burst = self.logs.burst = 1

    def restart(self) -> None:
        self.parameters.restart()
        self.ftp.restart()
        self.logs.restart()

    def _put_logs(self, logs: Sequence[SimulatedLog]) -> None:
        for number, log in enumerate(logs):
            self.files.put(_log_path(number), log.make, size=log.size)
        self.files.put(f"{LOG_FOLDER}/LASTLOG.TXT", f"{len(logs)}\r\n".encode())

    def _erase_logs(self) -> None:
        for name, _ in self.files.entries(LOG_FOLDER):
            self.files.remove_file(f"{LOG_FOLDER}/{name}")

    def _apply(self, name: str, value: float) -> None:
        """Set a parameter that an uploaded file contains."""
        parameters = self._vehicle.parameters
        # The firmware ignores a value that is not finite (AP_Param.cpp, set_float).
        if name not in self._vehicle.faults.read_only_parameters and math.isfinite(value):
            parameters[name] = rounded(self.parameters.clamped(name, value), parameters.type(name))


def _log_path(number: int) -> str:
    return f"{LOG_FOLDER}/{number + 1:08}.BIN"


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

    def __init__(self, vehicle: ArduPilotHost, key: SigningKey | None, timestamp: int) -> None:
        super().__init__(vehicle, key, timestamp)
        self.trusts_first_port = True
        self._ardupilot = vehicle
        vehicle.on_power_on(self._keep_time)

    def is_for(self, link_id: int) -> bool:
        name = f"MAV{link_id + 1}_OPTIONS"
        parameters = self._ardupilot.parameters
        return not (name in parameters and int(parameters[name]) & _SIGNING_OFF)

    def unsigned_on(self, link_id: int) -> Callable[[Frame], bool] | None:
        return _accept_all if link_id == 0 and self.trusts_first_port else None

    def may_change(self) -> bool:
        if self._ardupilot.is_armed:
            self._ardupilot.send_text(MavSeverity.WARNING, "ERROR: Won't setup signing when armed")
            return False
        return True

    def _keep_time(self) -> None:
        self._ardupilot.every(_SAVE_INTERVAL_S, self._save)
        self._ardupilot.call_later(self._ardupilot.timeline.gps_fix, self._on_gps_time)

    def _on_gps_time(self) -> None:
        stamp = timestamp_at(int(self._ardupilot.unix_time))
        for channel in self._ardupilot.channels:
            if channel.signing is not None:
                channel.signing.timestamp = max(channel.signing.timestamp, stamp)
        self._save()

    def _save(self) -> None:
        if self.key is not None:
            port_timestamps = [
                channel.signing.timestamp for channel in self._ardupilot.channels if channel.signing is not None
            ]
            self.timestamp: int = max([self.timestamp, *port_timestamps])


def _accept_all(_: Frame) -> bool:
    return True
