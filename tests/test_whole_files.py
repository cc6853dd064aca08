"""User files are written atomically: each place that opens a file for writing is listed here with its reason."""

from __future__ import annotations

import re
from pathlib import Path

SOURCE = Path(__file__).parent.parent / "src" / "aerokit"
WRITES = re.compile(
    r"""open\([^)\n]*["'](?:w|x|a|r\+)[bt+]*["']|(?:write_text|write_bytes)\(|\.open\(["'](?:w|x|a)[bt+]*["']"""
)
EXPECTED_WRITERS = {
    "apps/cli/devices.py": "beside what is there: nothing is replaced",
    "apps/cli/supervised_flight.py": "os.devnull",
    "apps/cli/main.py": "os.devnull",
    "logs/convert/__init__.py": "writes nothing: on Windows, os.fsync needs a writable file",
    "logs/convert/mcap.py": "converting.py moves it when it is whole",
    "logs/convert/tables.py": "converting.py moves it when it is whole",
    "logs/convert/tracks.py": "converting.py moves it when it is whole",
    "apps/cli/listening.py": "os.devnull",
    "mavlink/generator.py": "our own sources",
    "onboard/files.py": "a MAVFTP client writes block by block, as the protocol does",
    "mavlink/tlog.py": "a path is for a device or a pipe, or of a program; recordings: connection/frame_observers.py",
    "connection/frame_observers.py": "a new file; an existing one is renamed first",
    "sync/generator.py": "our own sources",
    "testing/failure.py": "of a failed test, under a name of its own",
    "vehicle/camera/capture.py": "moved when it is whole",
    "_internal/files.py": "write_atomically; a .part, which finish() moves",
    "vehicle/parameters/store.py": "moved when it is whole",
}


def test_file_writers_are_known() -> None:
    found = {
        path.relative_to(SOURCE).as_posix()
        for path in SOURCE.rglob("*.py")
        if WRITES.search(path.read_text(encoding="utf-8"))
    }
    assert found == set(EXPECTED_WRITERS)
