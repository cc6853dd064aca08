"""Mode, storage, and the settings from the factory."""

from __future__ import annotations

from typing import TYPE_CHECKING

import anyio

from aerokit.arguments import checks_arguments
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd
from aerokit.vehicle.camera.decoding import known, mode_of, storage_of
from aerokit.vehicle.camera.part import CameraPart
from aerokit.vehicle.camera.values import MODES, ModeName, Storage
from aerokit.vehicle.checks import check_range

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.runtime.cells import StateCell
    from aerokit.vehicle.camera.line import CameraLine

__all__ = ["StorageCalls"]

SETTINGS_S, STORAGE_S = 5.0, 5.0
ASK_S, AGAIN_S = 1.0, 0.5
FORMATTING_S = 60.0


@checks_arguments
class StorageCalls(CameraPart):
    """What the camera is set to, and what it keeps pictures on."""

    def __init__(self, line: CameraLine) -> None:
        super().__init__(line)
        self.mode: StateCell[str] = line.asked_cell("camera.mode", m.CameraSettings, SETTINGS_S)
        """``"photo"``, ``"video"`` or ``"survey"`` (CAMERA_SETTINGS), which a camera tells when it changes; asked for
        every 5 s while somebody looks at this cell, as the next two."""
        self.zoom_percent: StateCell[float | None] = line.asked_cell(
            "camera.zoom_percent", m.CameraSettings, SETTINGS_S
        )
        """0 (widest) to 100; None while the camera does not know."""
        self.focus_percent: StateCell[float | None] = line.asked_cell(
            "camera.focus_percent", m.CameraSettings, SETTINGS_S
        )
        """0 (nearest) to 100; None while the camera does not know."""
        self.storage: StateCell[tuple[Storage, ...]] = line.asked_cell(
            "camera.storage", m.StorageInformation, STORAGE_S
        )
        """Its storage media by their numbers; asked for every 5 s while somebody looks at this cell."""
        self._media: dict[int, Storage] = {}
        line.listen(m.CameraSettings, self._on_settings)
        line.listen(m.StorageInformation, self._on_storage)

    async def set_mode(self, mode: ModeName, *, timeout: float = 5.0) -> None:
        """Change the mode (MAV_CMD_SET_CAMERA_MODE); returns when the camera tells that it is in it.

        A camera that tells no mode (CAMERA_SETTINGS) is believed when it accepts.

        Args:
            mode: ``"photo"``, ``"video"`` or ``"survey"``.
            timeout: seconds until it must be told.

        Raises:
            NotSupported: the camera has no modes. Nothing was sent.
            CommandRejected: the camera refused: it is busy, or does not know this one.
            CommandTimeout: it did not answer.
            OperationTimeout: it accepted, and tells another mode; or no camera was heard.
        """
        await self._line.able("set_mode", "has_modes")
        with self._line.giving("mode") as given:
            await self._line.order(MavCmd.SET_CAMERA_MODE, self._line.device, MODES[mode], given=given)
        told = ""
        with anyio.move_on_after(timeout):
            while told != mode:
                message = await self._line.ask(m.CameraSettings, timeout=ASK_S)
                told = told if message is None else mode_of(message)
                if m.CameraSettings in self._line.untold:
                    return
                if told != mode:
                    await anyio.sleep(AGAIN_S)
            return
        tells = f"tells {told}" if told else "tells no mode"
        raise self._line.timed_out(f"accepted {mode}, and {tells} after {timeout:g} s")

    async def load_storage(self) -> tuple[Storage, ...]:
        """Ask for the storage media (STORAGE_INFORMATION).

        Raises:
            OperationTimeout: none was told of, or no camera was heard.
        """
        await self._line.find()
        if await self._line.ask(m.StorageInformation, 0) is None:
            raise self._line.timed_out("told of no storage")
        return self.storage.value

    async def format_storage(
        self,
        number: int = 1,
        *,
        timeout: float = FORMATTING_S,
        on_progress: Callable[[int | None], None] | None = None,
    ) -> None:
        """Format a storage medium, and clear the log of pictures (MAV_CMD_STORAGE_FORMAT): what is on it is lost.

        Args:
            number: of the medium, 1 to 255.
            timeout: seconds to wait after the order, and after each sign of progress.
            on_progress: called with 0–100, or None.

        Raises:
            InvalidArgument: ``number`` is out of range. Nothing was sent.
            CommandRejected: the camera refused: it is busy, or there is no such medium.
            CommandTimeout: it did not answer; it may be formatting.
            OperationTimeout: no camera was heard.
        """
        check_range("number", number, 1, 255)
        await self._line.find()
        await self._line.order(
            MavCmd.STORAGE_FORMAT, number, 1, 1, attempts=1, progress_timeout=timeout, on_progress=on_progress
        )
        for forget in self._line.on_cleared:
            forget()
        await self._line.ask(m.StorageInformation, 0, timeout=ASK_S)

    async def reset_settings(self) -> None:
        """Set everything as it came from the factory (MAV_CMD_RESET_CAMERA_SETTINGS).

        Raises:
            CommandRejected: the camera refused.
            CommandTimeout: it did not answer.
            OperationTimeout: no camera was heard.
        """
        await self._line.find()
        with self._line.giving("mode") as given:
            await self._line.order(MavCmd.RESET_CAMERA_SETTINGS, 1, self._line.device, given=given)
        await self._line.ask(m.CameraSettings, timeout=ASK_S)

    def _on_settings(self, message: m.CameraSettings) -> None:
        self._line.tell(self.mode, mode_of(message), message)
        self._line.tell(self.zoom_percent, known(message.zoomLevel), message)
        self._line.tell(self.focus_percent, known(message.focusLevel), message)

    def _on_storage(self, message: m.StorageInformation) -> None:
        medium = storage_of(message)
        self._media = {number: each for number, each in self._media.items() if number <= medium.count}
        self._media[medium.number] = medium
        media = tuple(self._media[number] for number in sorted(self._media))
        self._line.tell(self.storage, media, message)
