"""A simulated vehicle with files, logs and a mission, a `Vehicle` connected to it, and the states to call from."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path

import anyio
from flight_harness import Wire

import aerokit
from aerokit import Position, messages
from aerokit.errors import AerokitError
from aerokit.mavlink.enums import CameraCapFlags, MavCmd
from aerokit.missions import Fence, FenceCircle, Mission, RallyPoints, rally_point, waypoint
from aerokit.sim import SimulatedCamera, SimulatedCopter, SimulatedLog, SimulatedPx4, simulated_link

__all__ = [
    "AUTOPILOTS",
    "Place",
    "Stage",
    "airborne",
    "anywhere",
    "armed",
    "grounded",
    "on_mission",
    "open_stage",
    "stage_cameras",
]

AUTOPILOTS = ("ardupilot", "px4")
LOGS = [SimulatedLog(20_000, 1_790_000_000), SimulatedLog(4_000, 1_790_000_500)]
DATA = bytes(range(256)) * 20


@dataclass
class Stage:
    """A simulated vehicle, the program's `Vehicle`, and arguments for calls."""

    simulated: SimulatedCopter | SimulatedPx4
    vehicle: aerokit.Vehicle
    wire: Wire
    folder: Path
    """Directory for files of the program."""
    camera: SimulatedCamera
    """The first camera. The second one refuses all commands."""
    counter: int = field(default=0)

    @property
    def is_px4(self) -> bool:
        return isinstance(self.simulated, SimulatedPx4)

    @property
    def parameter(self) -> str:
        """Name of a parameter that does not affect the flight."""
        return "NAV_ACC_RAD" if self.is_px4 else "WP_YAW_BEHAVIOR"

    def other_value(self) -> float:
        """Return a value of this parameter other than the previous one."""
        self.counter += 1
        return float(self.counter % 2 + 1)

    # ------------------------------------------------------------------------------- places

    @property
    def home(self) -> Position:
        home = self.vehicle.home.value
        return Position(home.latitude_deg, home.longitude_deg)

    def target(self) -> Position:
        """Return a target 25 m to the north, or home if that is far away."""
        here = self.vehicle.position.value.replace(altitude_amsl_m=None)
        is_far = self.vehicle.distance_to(self.home) > 60
        return self.home.replace(altitude_relative_m=here.altitude_relative_m) if is_far else here.offset(north_m=25)

    def mission(self) -> Mission:
        """Return a mission to the north, different for each call."""
        self.counter += 1
        places = [self.home.offset(north_m=100.0 * n, east_m=self.counter % 7) for n in range(1, 6)]
        return Mission([waypoint(place.latitude_deg, place.longitude_deg, altitude_relative_m=20) for place in places])

    def fence(self) -> Fence:
        self.counter += 1
        return Fence(circles=[FenceCircle(self.home, 5000 + self.counter % 7)])

    def rally(self) -> RallyPoints:
        self.counter += 1
        place = self.home.offset(east_m=20.0 + self.counter % 7)
        return RallyPoints([rally_point(place.latitude_deg, place.longitude_deg, altitude_relative_m=30)])

    # --------------------------------------------------------------------------------- files

    @property
    def root(self) -> str:
        return "/fs/microsd" if self.is_px4 else "/APM"

    @property
    def file(self) -> str:
        """A file on the vehicle."""
        return f"{self.root}/there.bin"

    def new_name(self) -> str:
        """An unused path on the vehicle."""
        self.counter += 1
        return f"{self.root}/new{self.counter}"

    def put(self, path: str, data: bytes = DATA) -> str:
        """Create a file on the vehicle."""
        file = self.simulated.ftp.files.open(path, writing=True, create=True)
        file.write(0, data)
        file.close()
        return path

    def put_logs(self) -> None:
        """Restore the erased logs of the vehicle."""
        self.simulated.storage.logs.logs[:] = LOGS

    def local(self, name: str = "here.bin") -> Path:
        """An unused path on this computer."""
        self.counter += 1
        return self.folder / f"{self.counter}-{name}"

    def local_file(self) -> Path:
        """An existing file on this computer."""
        path = self.folder / "given.bin"
        path.write_bytes(DATA)
        return path

    # -------------------------------------------------------------------------------- answers

    async def answers(self) -> None:
        """Check that the vehicle still executes commands and reports their effects."""
        await self.vehicle.command(MavCmd.REQUEST_MESSAGE, messages.AutopilotVersion.ID)


Place = Callable[[Stage], Awaitable[None]]


async def anywhere(stage: Stage) -> None:
    """The initial state."""
    stage.simulated.battery.percent = 100.0
    stage.simulated.battery.consumed_mah = 0.0


async def grounded(stage: Stage) -> None:
    """Disarmed and ready, on the ground, in a mode that can be armed."""
    vehicle = stage.vehicle
    await anywhere(stage)
    with anyio.fail_after(60):
        if vehicle.is_armed:
            await vehicle.disarm(force=True)
        was_falling = not stage.simulated.motion.is_on_ground
        while not stage.simulated.motion.is_on_ground:  # noqa: ASYNC110
            await anyio.sleep(0.1)
        if was_falling:
            await vehicle.landed_state.wait_until(lambda state: state == 1)
    with contextlib.suppress(AerokitError):  # the vehicle may be rebooting after a cancelled reboot command
        await vehicle.set_mode("LOITER" if stage.is_px4 else "GUIDED")
    await vehicle.wait_ready()
    await vehicle.set_mode("LOITER" if stage.is_px4 else "GUIDED")


async def armed(stage: Stage) -> None:
    """Armed a moment ago, on the ground, because both autopilots disarm after a while without take-off."""
    await grounded(stage)
    await stage.vehicle.arm()


async def airborne(stage: Stage) -> None:
    """Hovering."""
    vehicle = stage.vehicle
    await anywhere(stage)
    if not (vehicle.is_armed and _altitude(stage) > 2.0):
        await armed(stage)
        await vehicle.take_off(6.0)
    elif vehicle.mode_name not in ("GUIDED", "LOITER"):
        await vehicle.set_mode("LOITER" if stage.is_px4 else "GUIDED")


async def on_mission(stage: Stage) -> None:
    """Flying a long mission."""
    await airborne(stage)
    if stage.vehicle.mission.count.latest != 5:
        await stage.vehicle.mission.upload(stage.mission())
    if stage.vehicle.distance_to(stage.home) > 60:
        await stage.vehicle.go_to(stage.home.replace(altitude_relative_m=6.0))
    await stage.vehicle.mission.start()


def _altitude(stage: Stage) -> float:
    return stage.vehicle.position.value.altitude_relative_m or 0.0


def stage_cameras() -> list[SimulatedCamera]:
    """Create two cameras: one supports all commands at any time, the other one none."""
    both = CameraCapFlags.CAN_CAPTURE_IMAGE_IN_VIDEO_MODE | CameraCapFlags.CAN_CAPTURE_VIDEO_IN_IMAGE_MODE
    able = SimulatedCamera(capabilities=SimulatedCamera.ALL_CAPABILITIES | both, streams=["rtsp://127.0.0.1/a"])
    able.files.put("/DCIM/GIVEN.JPG", DATA)
    return [able, SimulatedCamera(101, capabilities=CameraCapFlags.HAS_MTI)]


@asynccontextmanager
async def open_stage(autopilot: str, folder: Path) -> AsyncIterator[Stage]:
    """Ready on the ground."""
    simulated: SimulatedCopter | SimulatedPx4
    cameras = stage_cameras()
    if autopilot == "px4":
        simulated = SimulatedPx4(boot_time_s=0.0, logs=LOGS, components=cameras)
    else:
        simulated = SimulatedCopter(boot_time_s=0.0, logs=LOGS, components=cameras)
    async with simulated_link(simulated) as link:
        wire = Wire(link)
        async with aerokit.connect(wire) as vehicle:
            await vehicle.wait_ready()
            stage = Stage(simulated, vehicle, wire, folder, cameras[0])
            await vehicle.camera.wait_found()
            vehicle.camera_at(101)
            stage.put(stage.file)
            yield stage
