"""What a simulated PX4 keeps in files, and how it gives it away."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from aerokit.sim.file_tree import FileTree
from aerokit.sim.logs import Px4LogServer, SimulatedLog
from aerokit.sim.px4.ftp import Px4Ftp
from aerokit.sim.px4.parameter_file import Px4ParameterMount
from aerokit.sim.px4.parameter_server import Px4ParameterServer

if TYPE_CHECKING:
    from aerokit.sim.px4.vehicle import SimulatedPx4

__all__ = ["DEFAULT_LOGS", "LOG_FOLDER", "Storage"]

LOG_FOLDER = "/fs/microsd/log"
DEFAULT_LOGS = (SimulatedLog(186_432, 1_789_990_000), SimulatedLog(45_103, 1_789_995_000))

_PARAM_VALUE_FRAME, _FTP_FRAME, _LOG_DATA_FRAME = 37, 266, 109
_SHARE = 0.5


class Storage:
    """Files, logs and parameters, and the servers that give them away.

    With ``parameter_file`` it serves ``@PARAM/param.pck``, as PX4 does since August 2026. ``link_bytes_per_s`` is
    the data rate that the port is told to use; None: that of a network.
    """

    def __init__(
        self,
        px4: SimulatedPx4,
        logs: Sequence[SimulatedLog],
        *,
        parameter_file: bool,
        link_bytes_per_s: float | None,
    ) -> None:
        self._px4 = px4
        self.files: FileTree = FileTree()
        self._put_logs(logs)
        if parameter_file:
            self.files.mounts["@PARAM"] = Px4ParameterMount(px4.parameters, self._apply)
        errors = not px4.version.startswith("1.16")
        self.parameters: Px4ParameterServer = Px4ParameterServer(px4, px4.parameters, errors=errors)
        self.ftp: Px4Ftp = Px4Ftp(px4, self.files)
        self.logs: Px4LogServer = Px4LogServer(
            px4,
            logs,
            erase_files=self._erase_logs,
            append_to_file=lambda number, data: self.files.append(_log_path(number), data),
        )
        if link_bytes_per_s is not None:
            self.parameters.list_rate_hz = _SHARE * link_bytes_per_s / _PARAM_VALUE_FRAME
            self.ftp.burst_interval_s = _FTP_FRAME / (_SHARE * link_bytes_per_s)
            self.logs.rate_hz = _SHARE * link_bytes_per_s / _LOG_DATA_FRAME
            self.parameters.burst = self.ftp.burst = self.logs.burst = 1

    def restart(self) -> None:
        """Transfers end, sessions are gone; files remain."""
        self.parameters.restart()
        self.ftp.restart()
        self.logs.restart()

    def _put_logs(self, logs: Sequence[SimulatedLog]) -> None:
        for number, log in enumerate(logs):
            self.files.put(_log_path(number), log.make, size=log.size)
        if not logs:
            self.files.put(f"{LOG_FOLDER}/.keep", b"").remove_file(f"{LOG_FOLDER}/.keep")

    def _erase_logs(self) -> None:
        for day, _ in self.files.entries(LOG_FOLDER):
            for name, _ in self.files.entries(f"{LOG_FOLDER}/{day}"):
                self.files.remove_file(f"{LOG_FOLDER}/{day}/{name}")
            self.files.remove_folder(f"{LOG_FOLDER}/{day}")

    def _apply(self, name: str, value: float) -> None:
        """One parameter of an uploaded file."""
        if name not in self._px4.faults.read_only_parameters:
            self._px4.parameters[name] = self.parameters.clamped(name, value)


def _log_path(number: int) -> str:
    return f"{LOG_FOLDER}/2026-11-21/{10 + number:02}_00_00.ulg"
