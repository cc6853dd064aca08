"""``RecordedMission``: the mission in a recording, transferred item by item or as a file by MAVFTP."""

from __future__ import annotations

import math
from typing import TypeAlias

from aerokit.errors import RemoteProtocolError
from aerokit.logs.flights.flight import Waypoint
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavFtpOpcode, MavMissionResult, MavMissionType
from aerokit.missions.item import GLOBAL_FRAMES, has_place
from aerokit.missions.wire import HEADER, NO_CLEAR, PACKED_PATHS, read_header, to_wire, unpack_items
from aerokit.protocols.ftp import FtpMessage

MissionMessage: TypeAlias = (
    "m.MissionItemInt | m.MissionItem | m.MissionCount | m.MissionClearAll | m.MissionAck | m.FileTransferProtocol"
)

_DEGREES_E7 = 1e7
_MISSION_PATH = PACKED_PATHS[MavMissionType.MISSION].encode()
_OPENING = (MavFtpOpcode.OPENFILERO, MavFtpOpcode.OPENFILEWO, MavFtpOpcode.CREATEFILE)
_NO_MISSION_ITEM = (2, 3)  # values of `current` for a target or an altitude in GUIDED
_READING = (MavFtpOpcode.READFILE, MavFtpOpcode.BURSTREADFILE)


class RecordedMission:
    """The last mission that was sent to a vehicle or read from it."""

    MESSAGES = (
        m.MissionItemInt, m.MissionItem, m.MissionCount, m.MissionClearAll, m.MissionAck, m.FileTransferProtocol,
    )  # fmt: skip
    """Classes of the messages that :meth:`on_message` takes."""

    def __init__(self, system_id: int) -> None:
        self._system_id = system_id
        self._items: dict[int, Waypoint] = {}
        self._is_clearing = False  # True until the vehicle answers a MISSION_CLEAR_ALL
        self._is_file_open = False  # True while a program writes or reads the mission file
        self._file = bytearray()  # the mission file, up to the first missing block
        self._later_blocks: dict[int, bytes] = {}  # the blocks after the missing block, by their offset

    @property
    def waypoints(self) -> list[Waypoint]:
        return [self._items[number] for number in sorted(self._items)]

    def on_message(self, _time_s: float, message: MissionMessage) -> None:
        sender = None if message.received_frame is None else message.received_frame.system_id
        if self._system_id not in (sender, message.target_system):
            return
        if isinstance(message, m.FileTransferProtocol):
            self._on_file_transfer(message)
        elif message.mission_type not in (MavMissionType.MISSION, MavMissionType.ALL):
            return
        elif isinstance(message, m.MissionClearAll):
            self._is_clearing = True
        elif isinstance(message, m.MissionAck):
            if self._is_clearing and sender == self._system_id:
                self._is_clearing = False
                # ArduPilot refuses to clear a mission that it flies.
                if message.type == MavMissionResult.ACCEPTED:
                    self._items.clear()
        elif isinstance(message, m.MissionCount):
            self._is_clearing = False  # The next MISSION_ACK is about this transfer, not about clearing.
            # Items beyond this number belong to an earlier mission.
            self._items = {number: item for number, item in self._items.items() if number < message.count}
        elif message.current not in _NO_MISSION_ITEM:
            self._store_item(message)

    def _on_file_transfer(self, message: m.FileTransferProtocol) -> None:
        """Collect the blocks of ArduPilot's mission file while it is uploaded or downloaded."""
        ftp = FtpMessage.decode(message.payload)
        if ftp.opcode in _OPENING:
            self._is_file_open = ftp.data.rstrip(b"\0") == _MISSION_PATH
            self._file.clear()
            self._later_blocks.clear()
        elif self._is_file_open:
            is_new = bool(ftp.data) and ftp.offset >= len(self._file)  # A repeated block begins in the known part.
            is_block_read = ftp.is_ack and ftp.request_opcode in _READING
            if is_new and (is_block_read or ftp.opcode == MavFtpOpcode.WRITEFILE):
                self._later_blocks[ftp.offset] = ftp.data
                while block := self._later_blocks.pop(len(self._file), b""):
                    self._file += block
                self._read_file()

    def _read_file(self) -> None:
        """Store the items of the file as the mission, once the file is complete."""
        if len(self._file) < HEADER.size:
            return
        try:
            header = read_header(bytes(self._file[: HEADER.size]))
            if len(self._file) < header.length:
                return
            items = unpack_items(bytes(self._file[: header.length]), MavMissionType.MISSION)
        except RemoteProtocolError:  # The file does not contain a mission.
            self._is_file_open = False
            return
        self._is_file_open = False
        # With NO_CLEAR, the vehicle keeps the other items of its mission.
        if not header.options & NO_CLEAR:
            self._items.clear()
        for number, item in enumerate(items, header.first_index):
            self._store_item(to_wire(item, number, target_system=0, target_component=0))

    def _store_item(self, message: m.MissionItemInt | m.MissionItem) -> None:
        scale = _DEGREES_E7 if isinstance(message, m.MissionItemInt) else 1.0
        # x and y are degrees only in a global frame, and only if the command has a place. 0, 0 means no place.
        has_position = message.frame in GLOBAL_FRAMES and has_place(message.command) and (message.x or message.y)
        self._items[message.seq] = Waypoint(
            number=message.seq,
            command=message.command,
            latitude_deg=message.x / scale if has_position else math.nan,
            longitude_deg=message.y / scale if has_position else math.nan,
            altitude_m=message.z,
            frame=message.frame,
        )
