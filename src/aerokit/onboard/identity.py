"""Identity of a component: AUTOPILOT_VERSION, COMPONENT_INFORMATION_BASIC and the files of its metadata."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from aerokit._internal.values import Snapshot
from aerokit.errors import InvalidArgument
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import CompMetadataType
from aerokit.mavlink.enums import MavProtocolCapability as Capability
from aerokit.protocols.ftp import crc32

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from aerokit.mavlink.message import Message
    from aerokit.onboard.host import ComponentHost
    from aerokit.protocols.servers.commands import ReceivedCommand
    from aerokit.protocols.servers.files import FileTree
    from aerokit.protocols.servers.intervals import Builder

GENERAL_PATH, PARAMETER_PATH = "/general.json", "/parameter.json"


class Identity(Snapshot):
    """Name and versions of a component.

    ``version`` has one to four numbers: ``"1.4.2"``. ``uid`` is a 64-bit serial number, 0 if there is none.
    """

    vendor: str = "aerokit"
    model: str = "component"
    version: str = "0.0.0"
    hardware_version: str = ""
    serial_number: str = ""
    uid: int = 0

    def _check(self) -> None:
        # The texts must fit into the fields of COMPONENT_INFORMATION_BASIC.
        sizes = {"vendor": 32, "model": 32, "version": 24, "hardware_version": 24, "serial_number": 32}
        for name, size in sizes.items():
            value = getattr(self, name)
            if not isinstance(value, str) or len(value.encode()) > size:
                raise InvalidArgument(f"{name} = {value!r} is not allowed: it must be a text of at most {size} bytes")
        _ = self.version_number  # Raises InvalidArgument if the version is invalid.
        if not 0 <= self.uid < 1 << 64:
            raise InvalidArgument(f"uid = {self.uid} is not allowed: it must be 0 to 2**64 - 1")

    @property
    def version_number(self) -> int:
        """The version as an integer with one byte for each number, as AUTOPILOT_VERSION has it."""
        parts = self.version.split(".")
        if len(parts) > 4 or not all(part.isdecimal() and int(part) <= 255 for part in parts):
            raise InvalidArgument(
                f"version = {self.version!r} is not allowed: it must be one to four numbers up to 255, such as '1.4.2'"
            )
        major, minor, patch, release_type = [*map(int, parts), 0, 0, 0][:4]  # Numbers that are not given are 0.
        return major << 24 | minor << 16 | patch << 8 | release_type


class IdentityMessages:
    """Builds the messages that identify a component, and writes its metadata files."""

    def __init__(self, host: ComponentHost, identity: Identity, memory: FileTree) -> None:
        self.capabilities: int = int(Capability.MAVLINK2 | Capability.COMMAND_INT)
        """MAV_PROTOCOL_CAPABILITY of the protocols that are served."""
        # By COMP_METADATA_TYPE: the path of a file, and the function that is called for its content.
        self._metadata_files: dict[int, tuple[str, Callable[[], bytes]]] = {}
        self._host, self._identity, self._memory = host, identity, memory

    def builders(self) -> dict[int, Builder]:
        return {
            m.AutopilotVersion.ID: lambda _: [self._version()],
            m.ComponentInformationBasic.ID: lambda _: [self._basic()],
            m.ComponentMetadata.ID: self._metadata,
        }

    def _version(self) -> m.AutopilotVersion:
        identity = self._identity
        return m.AutopilotVersion(
            capabilities=self.capabilities,
            flight_sw_version=identity.version_number,
            middleware_sw_version=0,
            os_sw_version=0,
            board_version=0,
            flight_custom_version=bytes(8),
            middleware_custom_version=bytes(8),
            os_custom_version=bytes(8),
            vendor_id=0,
            product_id=0,
            uid=identity.uid,
        )

    def _basic(self) -> m.ComponentInformationBasic:
        identity = self._identity
        return m.ComponentInformationBasic(
            time_boot_ms=self._host.time_boot_ms,
            capabilities=self.capabilities,
            time_manufacture_s=0,
            vendor_name=identity.vendor,
            model_name=identity.model,
            software_version=identity.version,
            hardware_version=identity.hardware_version,
            serial_number=identity.serial_number,
        )

    def update_files(self) -> int:
        """Write the metadata files; return the checksum of the general metadata file."""
        entries = []
        for kind, (path, content) in self._metadata_files.items():
            data = content()
            self._memory.put(path, data)
            entries.append({"type": kind, "uri": f"mftp://{path}", "fileCrc": crc32(data)})
        general = json.dumps({"version": 1, "metadataTypes": entries}).encode()
        self._memory.put(GENERAL_PATH, general)
        return crc32(general)

    def _metadata(self, _: ReceivedCommand | None) -> Iterable[Message]:
        if not self._metadata_files:
            return []
        checksum = self.update_files()
        uri = f"mftp://{GENERAL_PATH}"
        return [m.ComponentMetadata(time_boot_ms=self._host.time_boot_ms, file_crc=checksum, uri=uri)]

    def add_metadata(self, kind: CompMetadataType, path: str, content: Callable[[], bytes]) -> None:
        self._metadata_files[kind] = (path, content)
        self.update_files()
