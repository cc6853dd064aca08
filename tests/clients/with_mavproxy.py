"""Flies the vehicle with MAVProxy by the commands that its users type; its output shows the progress."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import threading
import time
from pathlib import Path

from steps import ALTITUDE_M, PARAMETERS, Steps, mission, wait_for

ALTITUDE = re.compile(r"GLOBAL_POSITION_INT .*?relative_alt : (-?\d+)")

WAYPOINT = re.compile(r"^\d+ \d+ -?\d+\.\d+ .* auto=", re.MULTILINE)
PX4_MISSION, PX4_LAND = "long DO_SET_MODE 1 4 4", "long DO_SET_MODE 1 4 6"
"""`mode` of MAVProxy 1.8.75 fails for PX4 before it sends anything."""


class Console:
    """MAVProxy in a process: typed commands and printed output."""

    def __init__(self, port: int) -> None:
        command = [
            sys.executable, "-u", str(Path(sys.executable).with_name("mavproxy.py")),
            f"--master=udpin:127.0.0.1:{port}", "--streamrate=4",
            "--default-modules=log,signing,wp,rally,fence,ftp,param,relay,arm,mode,misc,cmdlong,battery,output",
        ]  # fmt: skip
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            env={**os.environ, "PYTHONUNBUFFERED": "1", "HOME": os.getcwd()},
        )  # fmt: skip
        self.text = ""
        self._seen = 0
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        while text := self._process.stdout.readline():
            self.text += text

    def type(self, line: str) -> None:
        """Type a line; earlier output is ignored from then on."""
        assert self._process.stdin is not None
        self._seen = len(self.text)
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()

    @property
    def answer(self) -> str:
        """Return the output since the last line was typed."""
        return self.text[self._seen :]

    def wait(self, pattern: str, timeout: float = 60.0) -> re.Match[str]:
        wait_for(lambda: re.search(pattern, self.answer) is not None, f"{pattern} in {self.text[-1500:]}", timeout)
        found = re.search(pattern, self.answer)
        assert found is not None
        return found

    def look(self, pattern: str, timeout: float) -> re.Match[str] | None:
        """Return the output until then."""
        deadline = time.monotonic() + timeout
        while time.monotonic() < deadline:
            if found := re.search(pattern, self.answer):
                return found
            time.sleep(0.05)
        return None

    def command_until_accepted(
        self, line: str, pattern: str, attempts: int = 30, patience_s: float = 2.0
    ) -> re.Match[str]:
        """Type it until the vehicle is ready for it."""
        for _ in range(attempts):
            self.type(line)
            if found := self.look(pattern, patience_s):
                return found
        sys.exit(f"{line} did not lead to {pattern}: {self.text[-1500:]}")

    def altitude_m(self) -> float:
        """The last that was watched."""
        found = ALTITUDE.findall(self.answer)
        return int(found[-1]) / 1000 if found else 0.0

    def end(self) -> None:
        self._process.kill()
        self._process.wait()


def write_mission(kind: str, path: Path) -> int:
    """Write a waypoint file; its first line is home for both autopilots, and is not sent to PX4 as an item."""
    lines = ["QGC WPL 110"]
    items = mission(kind)
    for number, item in enumerate(items):
        values = (number, int(number == 0), item.frame, item.command, item.hold_s, 0, 0, 0)
        place = (f"{item.latitude:.7f}", f"{item.longitude:.7f}", item.altitude_m, 1)
        lines.append("\t".join(str(field) for field in (*values, *place)))
    path.write_text("\n".join(lines) + "\n")
    return len(items)


def fly(kind: str, console: Console) -> None:
    steps = Steps()
    console.wait(r"Detected vehicle|online system 1|Received \d+ parameters")
    steps.done("connect")
    got_all = r"Received (\d+) parameters"  # it does not ask again when one of its requests timed out
    received = console.look(got_all, 30.0) or console.command_until_accepted("param fetch", got_all, 4, 30.0)
    assert int(received[1]) >= PARAMETERS[kind], received[0]
    steps.done("parameters", received[1])
    count = write_mission(kind, Path("flight.txt"))
    console.command_until_accepted("wp load flight.txt", rf"Loaded {count} waypoints in ")
    steps.done("upload", count)
    console.command_until_accepted("wp list", r"Saved waypoints to ")
    assert len(WAYPOINT.findall(console.answer)) == count, console.answer
    steps.done("download", count)
    if kind == "copter":
        console.command_until_accepted("mode GUIDED", r"Mode GUIDED|GUIDED>")
    console.command_until_accepted("arm throttle", r"\bARMED")
    steps.done("arm")
    if kind == "copter":
        console.command_until_accepted(f"takeoff {ALTITUDE_M}", r"TAKEOFF: ACCEPTED")
    else:  # MAVProxy's take-off has no position, which PX4 requires.
        console.command_until_accepted(PX4_MISSION, r"Mode MISSION|MISSION>")
    console.type("watch GLOBAL_POSITION_INT")
    wait_for(lambda: console.altitude_m() > ALTITUDE_M - 1, f"altitude: {console.text[-1000:]}")
    steps.done("take off", f"{console.altitude_m()} m")
    console.type("unwatch")
    if kind == "copter":
        console.command_until_accepted("mode AUTO", r"Mode AUTO|AUTO>")
    console.wait(rf"[Ww]aypoint {count - 1}|Reached waypoint #{count - 1}", timeout=90)
    steps.done("fly")
    console.command_until_accepted("mode LAND" if kind == "copter" else PX4_LAND, r"Mode LAND|LAND>")
    console.wait(r"DISARMED")
    steps.done("land")


def main() -> None:
    console = Console(int(sys.argv[2]))
    try:
        fly(sys.argv[1], console)
    finally:
        console.end()


if __name__ == "__main__":
    main()
