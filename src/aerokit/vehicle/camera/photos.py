"""Pictures: one, or one after the other, and what was taken before."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import anyio

from aerokit._internal.arguments import check_range, checks_arguments
from aerokit._internal.wording import shown
from aerokit.errors import FileFormatError, InvalidArgument, NotSupported
from aerokit.vehicle.camera.album import LONGEST, Album
from aerokit.vehicle.camera.capture import Capture
from aerokit.vehicle.camera.part import CameraPart
from aerokit.vehicle.camera.shooting import PhotoInterval, Shutter

if TYPE_CHECKING:
    from aerokit.connection.cells import StateCell
    from aerokit.vehicle.camera.link import CameraLine

MOST, MOST_MISSING = 32_767, 3
MAVFTP = re.compile(r"(?:mftp|mavlinkftp)://.|/.", re.IGNORECASE)


@checks_arguments
class PhotoCalls(CameraPart):
    """Taking pictures, and the list of those that were taken."""

    def __init__(self, line: CameraLine) -> None:
        super().__init__(line)
        self._album = Album(line)
        self._shutter = Shutter(line, self._album)
        self.capture: StateCell[Capture] = self._album.cell
        """The latest picture that was heard of."""

    async def take_photo(self, *, timeout: float = 10.0) -> Capture:
        """Take one picture; returns when the camera has told of it.

        Sends MAV_CMD_IMAGE_START_CAPTURE (https://mavlink.io/en/services/camera.html), MAV_CMD_DO_DIGICAM_CONTROL to
        PX4's trigger and to whoever knows nothing better. The order is never sent again blindly: only when the camera,
        asked after it, says that it takes no picture and has taken none. CAMERA_IMAGE_CAPTURED that was lost is asked
        for. Cancelled, it may still be taken.

        Args:
            timeout: seconds until it must have been told.

        Raises:
            NotSupported: the camera takes no pictures. Nothing was sent.
            CommandRejected: the camera refused: it is busy, or in the wrong mode.
            CommandTimeout: it did not answer; it may have taken the picture.
            OperationRejected: it could not take the picture.
            OperationTimeout: it told of no picture, or no camera was heard.
        """
        await self._line.able("take_photo", "capture_image")
        return await self._shutter.take(timeout)

    def photo_interval(self, seconds: float, count: int = 0) -> PhotoInterval:
        """A picture every so many seconds for the time of an ``async with`` block, which gives them in order.

        ``async with camera.photo_interval(2, count=10) as captures: async for capture in captures: …``. Those of which
        the message was lost are asked for again. MAV_CMD_IMAGE_STOP_CAPTURE at the end of the block, also when it is
        cancelled; PX4's trigger is started and stopped by MAV_CMD_DO_TRIGGER_CONTROL.

        Args:
            seconds: from one picture to the next, above 0 to 3600.
            count: 0 (until the block ends) to 32767; after so many the iterator ends.

        Raises:
            InvalidArgument: an argument is out of range. Nothing was sent.
        """
        check_range("seconds", seconds, 0, 3600, above=True)
        check_range("count", count, 0, MOST)
        return PhotoInterval(self._shutter, seconds, count)

    def captures(self) -> list[Capture]:
        """The pictures that were heard of, by their index; at most 20,000, the newest."""
        return self._album.captures()

    async def load_captures(self, *, timeout: float = 600.0) -> list[Capture]:
        """All pictures in the camera's log, also those that were taken before: what is not known yet is asked for.

        The newest 20,000 at most. A camera behind the autopilot tells of its newest one only. Where three on
        end are not told, it ends.

        Args:
            timeout: seconds until all must have come; :meth:`captures` has those that came in time.

        Raises:
            OperationTimeout: the camera does not say how many there are, or what it is, or it took too long.
        """
        count: int | None = None
        with anyio.move_on_after(timeout):
            await self._line.find()
            status = await self._shutter.status()
            if status is None:
                raise self._line.timed_out("does not say how many pictures it has taken")
            count = status.image_count
            missing = 0
            for index in range(max(0, count - (1 if self._line.is_behind else LONGEST)), count):
                missing = 0 if await self._album.ask_for(index) else missing + 1
                if missing == MOST_MISSING:
                    break
            return self.captures()
        told = (
            "did not say how many it has taken"
            if count is None
            else f"did not tell of all of its {count} pictures"
        )
        raise self._line.timed_out(f"{told} within {timeout:g} s")

    async def read_picture(self, capture: Capture) -> bytes:
        """The file of a picture, by MAVFTP: for a ``file_url`` that begins with ``mftp:`` or ``/``, at most 16 MB.

        Raises:
            NotSupported: its URL is another one, or it has none. Nothing was sent.
            FileError: the camera has no such file.
            OperationTimeout: nothing came any more, or no camera was heard.
        """
        url = capture.file_url
        if not MAVFTP.match(url):
            raise NotSupported(
                f"read_picture: {shown(url) if url else 'no URL'} is none of MAVFTP; nothing was sent"
            )
        await self._line.find()
        try:
            return await self._line.component.fetch(f"mftp://{url}" if url.startswith("/") else url)
        except FileFormatError:
            raise
        except InvalidArgument as error:
            raise NotSupported(f"read_picture: {error}; nothing was sent") from None
