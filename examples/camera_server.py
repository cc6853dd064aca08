"""A camera server: other programs take pictures from a video device, a file or a stream, and read them by MAVFTP.

python examples/camera_server.py udpout:127.0.0.1:14550 /dev/video0
python examples/camera_server.py udpout:127.0.0.1:14550            # a test pattern of FFmpeg
"""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path
from typing import Any

import av

import aerokit
from aerokit.enums import MavType
from aerokit.onboard import CameraDriver, Photo, Storage

PATTERN = "testsrc=size=640x480:rate=10"


class VideoDevice(CameraDriver):
    """Takes pictures with PyAV (pip install "aerokit-mavlink[video]" pillow)."""

    def __init__(self, source: str, folder: Path) -> None:
        super().__init__(vendor="aerokit", model="Video device", resolution=(640, 480))
        self._source = source
        self._folder = folder
        folder.mkdir(exist_ok=True)
        self._format: str | None = None  # FFmpeg recognises the format of files and streams
        if source == PATTERN:
            self._format = "lavfi"
        elif source.startswith("/dev/"):
            self._format = "v4l2"

    async def take_photo(self, index: int) -> Photo:
        """Read one frame in a thread, and write it as JPEG."""
        name = f"{index:04d}.jpg"
        await asyncio.to_thread(self._write, self._folder / name)
        return Photo(url=f"mftp:///{name}")

    def _write(self, path: Path) -> None:
        with av.open(self._source, format=self._format) as video:
            next(video.decode(video=0)).to_image().save(path)

    def storage(self) -> Storage:
        """Report the pictures in the folder, of at most 1000 MiB."""
        used = sum(path.stat().st_size for path in self._folder.glob("*.jpg")) / (1 << 20)
        return Storage(total_mib=1000.0, used_mib=used, available_mib=1000.0 - used)

    async def format_storage(self) -> None:
        """Delete all pictures."""
        for path in self._folder.glob("*.jpg"):
            path.unlink()


async def main(address: Any, source: str = PATTERN, folder: str = "pictures") -> None:
    """Serve the camera until the link ends."""
    pictures = Path(folder)
    camera = VideoDevice(source, pictures)
    async with aerokit.component(address, component_id=100, type=MavType.CAMERA) as component:
        component.serve_files(pictures)
        component.add_camera(camera)
        print("ready")
        await component.serve_forever()


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:4]))
