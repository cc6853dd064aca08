"""The exchanges of which golden traces are kept: what a program does with a simulated vehicle, on virtual time."""

from __future__ import annotations

import asyncio
import warnings
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Any

import anyio
from golden_trace import RATES, Tap, Trace, text_of
from late_loop import LateLoop

import aerokit
from aerokit import OwnHeartbeat, Signing, SigningKey, VelocitySetpoint
from aerokit import messages as m
from aerokit.errors import AerokitError
from aerokit.hub import Endpoint, Hub
from aerokit.mavlink.enums import MavCmd, MavType
from aerokit.missions import Fence, FenceCircle, Mission, RallyPoints, rally_point, waypoint
from aerokit.parameters import ParameterRenamedWarning
from aerokit.sim import (
    SimulatedCamera,
    SimulatedCopter,
    SimulatedLog,
    SimulatedPx4,
    SimulatorServer,
    simulated_link,
)
from aerokit.testing import FaultModel, FaultyLink
from aerokit.testing.journal import Journal
from aerokit.transport import Link, MultiLink, memory_link_pair

__all__ = ["SCENES", "recorded"]

Play = Callable[[Trace], Awaitable[None]]


@dataclass(frozen=True)
class Scene:
    """One exchange; ``show`` and ``max_alike`` are those of `Trace`."""

    play: Play
    show: Sequence[str] = ()
    max_alike: int = 6


SCENES: dict[str, Scene] = {}


def recorded(name: str) -> str:
    """Play the scene and record its traffic under its title."""
    scene = SCENES[name]
    if name == "dronekit_script":
        return _text(scene, dronekit_script())
    trace = Trace(scene.show, scene.max_alike)
    anyio.run(scene.play, trace, backend="asyncio", backend_options={"loop_factory": LateLoop})
    return _text(scene, trace.text())


def _text(scene: Scene, lines: str) -> str:
    about = "".join(f"# {line.strip()}\n" for line in (scene.play.__doc__ or "").strip().splitlines())
    return f"{about}\n{lines}"


def scene(*, show: Sequence[str] = (), max_alike: int = 6) -> Callable[[Play], Play]:
    def add(play: Play) -> Play:
        SCENES[getattr(play, "__name__", "")] = Scene(play, show, max_alike)
        return play

    return add


def copter(**options: Any) -> SimulatedCopter:
    return SimulatedCopter(boot_time_s=0.0, seed=1, **options)


def px4(**options: Any) -> SimulatedPx4:
    return SimulatedPx4(boot_time_s=1.0, seed=1, **options)


@asynccontextmanager
async def connected(
    trace: Trace, simulated: SimulatedCopter | SimulatedPx4, *, airborne: bool = False, **options: Any
) -> AsyncIterator[aerokit.Vehicle]:
    """Ready on the ground, or hovering at 10 m; recorded from then on."""
    async with (
        simulated_link(simulated) as link,
        aerokit.connect(Tap(link, trace), **options) as vehicle,
    ):
        await vehicle.wait_ready()
        if airborne:
            if isinstance(simulated, SimulatedCopter):
                await vehicle.set_mode("GUIDED")
            await vehicle.arm()
            await vehicle.take_off(10.0)
        await anyio.sleep(3.0)
        trace.begin()
        yield vehicle


def north_of(vehicle: aerokit.Vehicle, *metres: float) -> list[aerokit.Position]:
    home = vehicle.home.value
    place = aerokit.Position(home.latitude_deg, home.longitude_deg, altitude_relative_m=10.0)
    return [place.offset(north_m=distance) for distance in metres]


def mission(vehicle: aerokit.Vehicle) -> Mission:
    return Mission(
        [
            waypoint(place.latitude_deg, place.longitude_deg, altitude_relative_m=20)
            for place in north_of(vehicle, 50, 100, 150)
        ]
    )


async def _connect(trace: Trace, simulated: SimulatedCopter | SimulatedPx4) -> None:
    async with simulated_link(simulated) as link:
        trace.begin()
        async with aerokit.connect(Tap(link, trace)) as vehicle:
            await vehicle.wait_ready()
            trace.note("the program leaves the block")


@scene(show=[RATES], max_alike=100)
async def connect_ardupilot(trace: Trace) -> None:
    """Connecting to ArduCopter until it is ready: the requested messages and rates, and its answers."""
    await _connect(trace, copter())


@scene(show=[RATES], max_alike=100)
async def connect_px4(trace: Trace) -> None:
    """Connecting to PX4 until it is ready: the requested messages and rates, and its answers."""
    await _connect(trace, px4())


@scene(show=["HEARTBEAT"])
async def own_heartbeat(trace: Trace) -> None:
    """The HEARTBEAT of the program: one each second, of the kind that it asked for."""
    own = OwnHeartbeat(type=MavType.ONBOARD_CONTROLLER)
    async with simulated_link(copter()) as link:
        trace.begin()
        async with aerokit.open_connection(Tap(link, trace), heartbeat=own):
            await anyio.sleep(3.5)


@scene()
async def arm_and_disarm(trace: Trace) -> None:
    """Arming and disarming ArduCopter: an order is done when HEARTBEAT reports it."""
    async with connected(trace, copter()) as vehicle:
        await vehicle.arm()
        await vehicle.disarm()


@scene(show=["STATUSTEXT", RATES])
async def arm_refused(trace: Trace) -> None:
    """ArduCopter refuses to arm: its pre-arm checks are run for the reasons."""
    simulated = copter()
    async with connected(trace, simulated) as vehicle:
        simulated.faults.prearm_failures.append("Compass not healthy")
        try:
            await vehicle.arm()
        except AerokitError as error:
            trace.note(str(error).splitlines()[0])


@scene()
async def arm_unanswered(trace: Trace) -> None:
    """The order to arm is lost: it is never sent again."""
    simulated = copter()
    async with connected(trace, simulated) as vehicle:
        simulated.faults.ignore(MavCmd.COMPONENT_ARM_DISARM, times=1)
        try:
            await vehicle.arm()
        except AerokitError as error:
            trace.note(type(error).__name__)
        await anyio.sleep(5.0)


@scene()
async def take_off_and_land(trace: Trace) -> None:
    """ArduCopter takes off to 5 m and lands; it disarms by itself."""
    async with connected(trace, copter()) as vehicle:
        await vehicle.set_mode("GUIDED")
        await vehicle.arm()
        await vehicle.take_off(5.0)
        await vehicle.land()
        await vehicle.armed.wait_until(lambda is_armed: not is_armed)


@scene()
async def take_off_and_land_px4(trace: Trace) -> None:
    """PX4 takes off to 5 m and lands; it disarms by itself."""
    async with connected(trace, px4()) as vehicle:
        await vehicle.arm()
        await vehicle.take_off(5.0)
        await vehicle.land()
        await vehicle.armed.wait_until(lambda is_armed: not is_armed)


@scene()
async def set_mode(trace: Trace) -> None:
    """Changing the mode of ArduCopter in flight, and one that it refuses."""
    async with connected(trace, copter(), airborne=True) as vehicle:
        await vehicle.set_mode("LOITER")
        try:
            await vehicle.set_mode("AUTO")
        except AerokitError as error:
            trace.note(str(error).splitlines()[0])


@scene()
async def set_mode_px4(trace: Trace) -> None:
    """Changing the mode of PX4 in flight."""
    async with connected(trace, px4(), airborne=True) as vehicle:
        await vehicle.set_mode("RTL")
        await vehicle.hold()


@scene()
async def set_mode_fallback(trace: Trace) -> None:
    """Firmware without MAV_CMD_DO_SET_MODE gets the older SET_MODE."""
    async with connected(trace, copter(unsupported_commands=[MavCmd.DO_SET_MODE])) as vehicle:
        await vehicle.set_mode("GUIDED")


@scene()
async def go_to_overtaken(trace: Trace) -> None:
    """A newer `go_to` supersedes an older one: nothing more of the older one is sent."""
    async with connected(trace, copter(), airborne=True) as vehicle:
        near, far = north_of(vehicle, 10, 100)
        async with anyio.create_task_group() as tasks:

            async def older() -> None:
                try:
                    await vehicle.go_to(far)
                except AerokitError as error:
                    trace.note(f"the older one ends: {str(error).splitlines()[0]}")

            tasks.start_soon(older)
            await anyio.sleep(2.0)
            trace.note("the newer one is given")
            await vehicle.go_to(near)


@scene()
async def go_to_cancelled(trace: Trace) -> None:
    """A cancelled `go_to` ends in a hold."""
    async with connected(trace, copter(), airborne=True) as vehicle:
        with anyio.move_on_after(2.0):
            await vehicle.go_to(*north_of(vehicle, 100))
        trace.note("the program has given it up")
        await anyio.sleep(3.0)


async def _velocity(trace: Trace, vehicle: aerokit.Vehicle) -> None:
    async with vehicle.guided.velocity() as stream:
        await stream.fly(VelocitySetpoint(north_m_s=2.0), 1.0)
        trace.note("the program leaves the stream")
    await anyio.sleep(2.0)


@scene()
async def guided_velocity(trace: Trace) -> None:
    """A stream of velocities to ArduCopter, started and ended."""
    async with connected(trace, copter(), airborne=True) as vehicle:
        await _velocity(trace, vehicle)


@scene()
async def guided_velocity_px4(trace: Trace) -> None:
    """A stream of velocities to PX4: it needs set-points before it accepts OFFBOARD."""
    async with connected(trace, px4(), airborne=True) as vehicle:
        await _velocity(trace, vehicle)


@scene()
async def guided_pilot_takes_over(trace: Trace) -> None:
    """The pilot turns the mode switch while a stream runs: nothing is sent into his flight."""
    simulated = copter()
    async with connected(trace, simulated, airborne=True) as vehicle:
        try:
            async with vehicle.guided.velocity() as stream:
                await stream.fly(VelocitySetpoint(north_m_s=2.0), 1.0)
                trace.note("the pilot turns the switch to LOITER")
                simulated.rc[2] = 1500
                simulated.set_mode(5)
                await stream.fly(VelocitySetpoint(north_m_s=2.0), 5.0)
        except AerokitError as error:
            trace.note(str(error).splitlines()[0])
        await anyio.sleep(2.0)


@scene()
async def mission_upload(trace: Trace) -> None:
    """Uploading a mission to ArduPilot item by item; the vehicle's first request is lost."""
    simulated = copter()
    async with connected(trace, simulated) as vehicle:
        simulated.faults.lose(m.MissionRequest, times=1)
        await vehicle.mission.upload(mission(vehicle), method="items")


@scene()
async def mission_upload_px4(trace: Trace) -> None:
    """Uploading a mission to PX4, which reports a checksum; its first request is lost."""
    simulated = px4()
    async with connected(trace, simulated) as vehicle:
        simulated.faults.lose(m.MissionRequestInt, times=1)
        await vehicle.mission.upload(mission(vehicle), method="items")


@scene()
async def mission_download(trace: Trace) -> None:
    """Downloading a mission of PX4 item by item; an item is lost."""
    simulated = px4()
    async with connected(trace, simulated) as vehicle:
        await vehicle.mission.upload(mission(vehicle), method="items")
        trace.begin()
        simulated.faults.lose(m.MissionItemInt, times=1)
        await vehicle.mission.download(method="items")


@scene()
async def fence_and_rally(trace: Trace) -> None:
    """Uploading a fence and rally points to ArduCopter."""
    async with connected(trace, copter()) as vehicle:
        (home, beside) = north_of(vehicle, 0, 30)
        await vehicle.fence.upload(Fence(circles=[FenceCircle(home, 500.0)]), method="items")
        trace.note("rally points")
        place = rally_point(beside.latitude_deg, beside.longitude_deg, altitude_relative_m=30)
        await vehicle.rally.upload(RallyPoints([place]), method="items")


@scene(show=[RATES])
async def parameter_read_all(trace: Trace) -> None:
    """Reading all parameters of PX4 message by message; two values are lost and requested by index."""
    simulated = px4()
    simulated.faults.no_ftp = True
    async with connected(trace, simulated) as vehicle:
        loop = asyncio.get_running_loop()
        loop.call_later(0.5, lambda: simulated.faults.lose(m.ParamValue, times=2))
        await vehicle.parameters.download(refresh=True)


@scene(show=[RATES])
async def parameter_set(trace: Trace) -> None:
    """Setting a parameter of ArduPilot: the returned value counts; then another one whose answer is lost."""
    simulated = copter()
    async with connected(trace, simulated) as vehicle:
        await vehicle.parameters.set("WP_YAW_BEHAVIOR", 1)
        trace.note("the vehicle answers nothing once")
        simulated.faults.lose(m.ParamValue, times=1)
        await vehicle.parameters.set("WP_YAW_BEHAVIOR", 2)


@scene(show=[RATES])
async def parameter_renamed(trace: Trace) -> None:
    """Setting a parameter by its newer name: aerokit requests which of the two the vehicle has."""
    async with connected(trace, copter()) as vehicle:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ParameterRenamedWarning)
            await vehicle.parameters.set("WP_SPD", 5.0)


@scene()
async def ftp_download(trace: Trace) -> None:
    """Downloading a file by MAVFTP; a frame of the burst is lost."""
    simulated = copter()
    file = simulated.ftp.files.open("/APM/there.bin", writing=True, create=True)
    file.write(0, bytes(range(256)) * 4)
    file.close()
    async with connected(trace, simulated) as vehicle:
        loop = asyncio.get_running_loop()
        loop.call_later(0.0035, lambda: simulated.faults.lose(m.FileTransferProtocol, times=1))
        await vehicle.files.read("/APM/there.bin")


@scene(show=[RATES])
async def gimbal(trace: Trace) -> None:
    """Claiming a gimbal, pointing it, releasing it."""
    simulated = copter()
    simulated.parameters["MNT1_TYPE"] = 1.0
    async with connected(trace, simulated) as vehicle:
        async with vehicle.gimbal.control():
            await vehicle.gimbal.point(-30.0, 45.0)
            trace.note("the program leaves the block")
        await vehicle.gimbal.release()


@scene()
async def camera_photo(trace: Trace) -> None:
    """Taking a picture: done when CAMERA_IMAGE_CAPTURED reports it."""
    async with connected(trace, copter(components=[SimulatedCamera()])) as vehicle:
        await vehicle.camera.wait_found()
        trace.begin()
        await vehicle.camera.take_photo()


@scene()
async def log_download(trace: Trace) -> None:
    """Listing and downloading a flight log by LOG messages; one piece is lost."""
    simulated = copter(logs=[SimulatedLog(1000, 1_790_000_000)])
    simulated.faults.no_ftp = True
    async with connected(trace, simulated) as vehicle:
        (entry,) = await vehicle.logs.list()
        trace.note("download")
        simulated.faults.lose(m.LogData, times=1)
        await vehicle.logs.read(entry)


@scene()
async def fleet_take_off(trace: Trace) -> None:
    """A fleet of three arms and takes off."""
    copters = [
        SimulatedCopter(system_id=number, boot_time_s=0.0, seed=number, home=(47.3977, 8.5456 + number * 2e-4, 488.0))
        for number in (1, 2, 3)
    ]
    async with (
        simulated_link(copters) as link,
        aerokit.fleet(Tap(link, trace), count=3) as fleet,
    ):
        (await fleet.wait_ready()).raise_for_errors()
        await anyio.sleep(3.0)
        trace.begin()
        (await fleet.arm()).raise_for_errors()
        (await fleet.take_off(5.0)).raise_for_errors()


@scene(show=[RATES])
async def two_links(trace: Trace) -> None:
    """Two links to one vehicle: the one in use falls silent, and orders go over the other one."""
    pairs = [memory_link_pair(), memory_link_pair()]
    radios = [FaultyLink(near, FaultModel(), seed=number) for number, (near, _) in enumerate(pairs)]
    links: list[Link] = [Tap(radio, trace, name) for radio, name in zip(radios, "AB", strict=True)]
    together = MultiLink([lambda: links[0], lambda: links[1]])
    ports: list[Link] = [far for _, far in pairs]
    async with SimulatorServer(copter(), ports), aerokit.connect(together) as vehicle:
        await vehicle.wait_ready()
        await anyio.sleep(3.0)
        trace.begin()
        await vehicle.arm()
        trace.note("link A falls silent")
        radios[0].incoming.model = radios[0].outgoing.model = FaultModel(loss=1.0)
        await vehicle.disarm()


@scene()
async def through_hub(trace: Trace) -> None:
    """A command through the hub: it goes to the endpoint of the vehicle, and the answer comes back."""
    near, far = memory_link_pair()
    async with simulated_link(copter()) as link:
        endpoints = [
            Endpoint(Tap(link, trace, "hub:vehicle"), name="vehicle"),
            Endpoint(far, name="program"),
        ]
        async with Hub(endpoints), aerokit.connect(Tap(near, trace, "program:hub")) as vehicle:
            await vehicle.wait_ready()
            await anyio.sleep(3.0)
            trace.begin()
            await vehicle.set_mode("GUIDED")
            await vehicle.arm()


@scene()
async def signing(trace: Trace) -> None:
    """Handing a signing key over, ordering something with it, and taking it away again."""
    simulated = copter()
    simulated.signing.trusts_first_port = False
    async with connected(trace, simulated) as vehicle:
        await vehicle.setup_signing(Signing(SigningKey.from_passphrase("golden")))
        await vehicle.arm()
        await vehicle.disarm()
        await anyio.sleep(0.3)
        trace.note("the key is taken away")
        await vehicle.setup_signing(None)


async def _dronekit_script(_: Trace) -> None:
    """A classic DroneKit program: connect, arm, take off. Its threads run by the wall clock, so no times are kept."""


def dronekit_script() -> str:
    """The orders that reach the vehicle, in their order."""
    from served_copter import served

    from aerokit.dronekit import VehicleMode, connect

    simulated = copter()
    journal = simulated.journal = Journal()
    with served([simulated]) as address:
        vehicle = connect(address, wait_ready=True, timeout=60)
        try:
            vehicle.mode = VehicleMode("GUIDED")
            vehicle.wait_for_mode("GUIDED", timeout=30)
            vehicle.arm(timeout=30)
            vehicle.wait_simple_takeoff(5.0, timeout=60)
        finally:
            vehicle.close()
    orders = (m.CommandLong, m.CommandInt, m.SetMode, m.SetPositionTargetGlobalInt)
    lines = [
        f"{message.message.NAME} {text_of(message.message)}"
        for message in journal.messages
        if isinstance(message.message, orders) and getattr(message.message, "command", 0) not in REQUESTS
    ]
    return "".join(f"{line}\n" for line in dict.fromkeys(lines))


REQUESTS = (MavCmd.REQUEST_MESSAGE, MavCmd.SET_MESSAGE_INTERVAL)
SCENES["dronekit_script"] = Scene(_dronekit_script)
