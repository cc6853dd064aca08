"""What ArduPilot's simulated vehicles have in common: boot, parameters, files, missions, requests, modes, texts."""

# pyright: reportIncompatibleVariableOverride=false
# The host declares what parts need of each other; here each is what it really is.

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any, ClassVar, TypeVar

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavModeFlag, MavResult, MavSeverity
from aerokit.mavlink.message import Message
from aerokit.mavlink.signing import SigningKey
from aerokit.parameters.encoding import UNKNOWN_INDEX
from aerokit.sim.ardupilot.accessories import Accessories
from aerokit.sim.ardupilot.calibration import Calibrations
from aerokit.sim.ardupilot.camera import Camera
from aerokit.sim.ardupilot.failsafes import Failsafes
from aerokit.sim.ardupilot.fence import Fence
from aerokit.sim.ardupilot.ftp import ArduPilotFtp
from aerokit.sim.ardupilot.gimbal import Gimbal
from aerokit.sim.ardupilot.host import ArmingPart, Host
from aerokit.sim.ardupilot.kinds import BOOT_TIMELINES, BootTimeline, parameters_of
from aerokit.sim.ardupilot.mission_run import MissionRun
from aerokit.sim.ardupilot.mission_server import MissionServer
from aerokit.sim.ardupilot.mode import AutoMode, VehicleMode
from aerokit.sim.ardupilot.motors import Motors
from aerokit.sim.ardupilot.navigation import Navigation
from aerokit.sim.ardupilot.radio import Joystick, Radio
from aerokit.sim.ardupilot.requests import Requests
from aerokit.sim.ardupilot.storage import DEFAULT_LOGS, ArduPilotSigning, Storage
from aerokit.sim.battery import Battery
from aerokit.sim.channel import Channel
from aerokit.sim.commands import CommandHandler
from aerokit.sim.file_tree import FileTree
from aerokit.sim.local_frame import HOME, GlobalPoint, LocalFrame, Ned
from aerokit.sim.logs import SimulatedLog
from aerokit.sim.motion import Motion, Wind
from aerokit.sim.parameters import Parameters
from aerokit.sim.vehicle import Component, sender_of

_REBOOT_SILENCE_S = 1.5
_TIMESYNC_S = 10.0
_BEFORE_READY = frozenset({m.Heartbeat.ID, m.AutopilotVersion.ID})
ModeT = TypeVar("ModeT", bound="VehicleMode")


class ArduPilotVehicle(Host):
    """A subclass says what sets its kind apart: the class attributes, the ``make_…`` methods, commands, motion.

    - ``home``: where it is switched on: latitude, longitude (degrees), altitude AMSL (m);
      ``heading_deg``: where its nose points then
    - ``boot_time_s``: seconds until the estimator has a position; the real one needs 41.5, 0 is ready at once
    - ``boot_text``: the plain text that a serial or TCP port gives before the first frame
    - ``version``: goes into AUTOPILOT_VERSION and the banner; ``parameters``: values other than the defaults,
      ``parameter_count``: fewer than all, for quick tests; ``parameter_errors``: it says PARAM_ERROR
    - ``logs``: what earlier runs have left; ``link_bytes_per_s``: see `Storage`
    - ``battery_percent``: charge at the start; ``battery_capacity_mah``: the size of the pack
    - ``wind``: constant wind and gusts; ``rangefinder_reach_m``: 0 means that there is no range finder
    - ``unsupported_commands``: MAV_CMDs that this firmware does not know (SET_MESSAGE_INTERVAL if it is old);
      ``stream_groups`` False: it does not know REQUEST_DATA_STREAM
    - ``components``: other components on its links: `SimulatedCamera`, `SimulatedGimbal`, or only heartbeats
    - ``unix_time_at_boot``: what its GPS clock says at simulated second 0
    - ``signing_key``: see `ArduPilotSigning`
    """

    MAV_TYPE: ClassVar[int]
    BUILDERS: ClassVar[Mapping[int, Callable[[Any], Message | None]]]
    """Message id → what to send now, or None."""
    MODES: ClassVar[tuple[Callable[[Any], VehicleMode], ...]]
    """Classes of the modes, in the order in which they are listed."""
    FAILSAFES: ClassVar[type[Failsafes]]
    """What it does by itself."""
    FENCE: ClassVar[type[Fence]] = Fence
    """Where it may be, and what it does elsewhere."""

    HOME_NEEDS_ORIGIN: ClassVar[bool] = True
    """Whether home cannot be set before the estimator has an origin."""
    TELLS_HOME: ClassVar[bool] = False
    """Whether a text says where home was set."""

    def __init__(
        self,
        *,
        system_id: int = 1,
        home: tuple[float, float, float] = HOME,
        heading_deg: float = 353.0,
        seed: int = 0,
        boot_time_s: float = 5.0,
        boot_text: bool = False,
        version: str = "4.7.0-dev",
        parameters: dict[str, float] | None = None,
        parameter_count: int | None = None,
        parameter_errors: bool = False,
        logs: Sequence[SimulatedLog] = DEFAULT_LOGS,
        link_bytes_per_s: float | None = None,
        battery_percent: float = 100.0,
        battery_capacity_mah: float = 3300.0,
        wind: Wind | None = None,
        rangefinder_reach_m: float = 0.0,
        unsupported_commands: Collection[int] = (),
        stream_groups: bool = True,
        components: Iterable[Component] = (),
        unix_time_at_boot: float = 1_790_000_000.0,
        signing_key: SigningKey | None = None,
    ) -> None:
        self.parameters: Parameters = parameters_of(self.KIND, parameter_count)
        """By name; change them as a test needs it. They survive a reboot."""
        self.parameters["MAV_SYSID"] = system_id
        self.parameters.change(parameters or {})
        super().__init__(
            system_id=system_id,
            seed=seed,
            components=components,
            version=version,
            unsupported_commands=unsupported_commands,
            unix_time_at_boot=unix_time_at_boot,
            signing_key=signing_key,
        )
        self.timeline: BootTimeline = BOOT_TIMELINES[self.KIND].scaled(boot_time_s)
        self.uid: bytes = bytes([0xA0, system_id]) + bytes(16)
        self.battery: Battery = Battery(battery_capacity_mah, percent=battery_percent)
        self.motion: Motion = self.make_motion(wind)
        self.motion.yaw = math.remainder(math.radians(heading_deg), 2 * math.pi)
        self.rangefinder_reach_m = rangefinder_reach_m
        self.rc: Radio = Radio(self)
        """What it hears of sticks and switches; the throttle (index 2) rests at 1000."""
        self.calibrations: Calibrations = Calibrations(self)
        self._boot_text = boot_text
        self._stream_groups = stream_groups
        self.frame: LocalFrame = LocalFrame(GlobalPoint(round(home[0] * 1e7), round(home[1] * 1e7), home[2]))
        self.missions: MissionServer = MissionServer(self)
        """Mission, fence and rally points; they survive a reboot."""
        self._reset()
        self._listen()
        self.storage: Storage = Storage(
            self, logs, parameter_errors=parameter_errors, link_bytes_per_s=link_bytes_per_s
        )
        """Files, logs, and the servers of them and of the parameters."""
        self.files: FileTree = self.storage.files

    def _reset(self) -> None:
        """What a power cycle makes new."""
        self.is_initialised: bool = False
        self.has_left_boot: bool = False
        self.is_landed: bool = self.motion.is_on_ground
        self.motors: Motors = self.make_motors()
        self.navigation: Navigation = Navigation(self, self.frame)
        self.arming: ArmingPart = self.make_arming()
        self.accessories: Accessories = Accessories(self)
        self.failsafes: Failsafes = self.FAILSAFES(self)
        self.fence: Fence = self.FENCE(self)
        self.gimbal: Gimbal = Gimbal(self)
        self.camera: Camera = Camera(self)
        self.calibrations.reset()
        self.rc.reset()
        self._modes: dict[int, VehicleMode] = {}
        for make in self.MODES:
            mode = make(self)
            self._modes[mode.number] = mode
        self.reset_controllers()
        self.mission: MissionRun = MissionRun(self, self.auto)
        self.missions.reset()
        self.mode: VehicleMode = self._modes[self.first_mode]

    def make_signing(self, key: SigningKey | None, timestamp: int) -> ArduPilotSigning:
        return ArduPilotSigning(self, key, timestamp)

    def _listen(self) -> None:
        self.requests: Requests = Requests(self, stream_groups=self._stream_groups)
        self.serve_commands(self.make_commands())
        self.hear_setpoints()
        self.on(m.Heartbeat, self._on_heartbeat)
        self.on(m.SetMode, self._on_set_mode)
        self.listen_to_clocks()
        self.rc.listen()
        self.make_joystick()
        self.missions.listen()

    def make_motion(self, wind: Wind | None) -> Motion:
        """What moves it."""
        return Motion(self.rng, wind=wind)

    def make_motors(self) -> Motors:
        """What drives it."""
        return Motors()

    def make_arming(self) -> ArmingPart:
        """Its arming checks."""
        raise NotImplementedError

    def make_commands(self) -> dict[int, CommandHandler]:
        """MAV_CMD → handler."""
        raise NotImplementedError

    def hear_setpoints(self) -> None:
        """Hear the messages that steer it."""

    def make_joystick(self) -> Joystick:
        """What hears MANUAL_CONTROL."""
        return Joystick(self)

    def look_at(self, place: Ned | None) -> None:
        """Point the gimbal, if there is one, at a place; None ends it."""
        self.gimbal.look_at(place)

    def reset_controllers(self) -> None:
        """What a power cycle makes new of its own; the modes are there already."""

    def unknown_mode(self, number: int) -> tuple[int, str]:
        """Severity and text with which it refuses a mode that it does not have."""
        return MavSeverity.WARNING, f"No such mode {number}"

    def refusal(self, mode: VehicleMode, reason: str) -> str:
        """What it says when it does not go into a mode."""
        return f"Mode change to {mode.name} failed: {reason}"

    @property
    def auto(self) -> AutoMode:
        """Its mode for missions."""
        raise NotImplementedError

    @property
    def first_mode(self) -> int:
        """The number of the mode in which it wakes up."""
        return int(self.parameters["INITIAL_MODE"])

    @property
    def base_mode(self) -> int:
        """MAV_MODE_FLAGs of its heartbeat."""
        raise NotImplementedError

    def move(self, dt: float) -> None:
        """Move on by one tick, when it is not at rest; notices that it is, too."""
        raise NotImplementedError

    @property
    def ftp(self) -> ArduPilotFtp:
        """The server of the files."""
        return self.storage.ftp

    def is_for_me(self, message: Message) -> bool:
        """Also what is for a component of this system that is not there (MAVLink_routing.cpp)."""
        system, component = getattr(message, "target_system", 0), getattr(message, "target_component", 0)
        return system in (0, self.system_id) and all(
            component != each.component_id for each in self.components
        )

    def boot(self) -> None:
        """Say what a booting vehicle says, when it says it."""
        line, later = self.timeline, self.call_later
        self.storage.restart()
        self.requests.restart()
        if self._boot_text:
            for channel in self.channels:
                channel.write(
                    f"\r\n\r\nInit {self.FIRMWARE} V{self.version} ({self.GIT_HASH.decode()})\r\n".encode()
                )
                channel.write(b"\r\nFree RAM: 524288\r\nBooting 0/0\r\n")
        later(line.ready, self._become_ready)
        self.navigation.start()

    def _become_ready(self) -> None:
        self.is_initialised = True
        self.info("ArduPilot Ready")
        self.info("AHRS: DCM active")
        self.arming.start()
        self.failsafes.start()
        self.call_later(0.25 * self.timeline.ready, self._leave_boot)

    def _leave_boot(self) -> None:
        self.has_left_boot = True

    def start_channel(self, channel: Channel) -> None:
        """Heartbeats, time synchronisation, and what the port's parameters (MAV1_EXTRA1 …) say."""
        first, ready = self.booted_at + self.timeline.heartbeat, self.booted_at + self.timeline.ready
        channel.streams.set_interval(m.Heartbeat.ID, 1.0, max(self.now, first))
        channel.streams.set_interval(m.Timesync.ID, _TIMESYNC_S, max(self.now, self.booted_at + _TIMESYNC_S))
        self.requests.start_channel(channel, max(self.now, ready))

    def restart(self) -> None:
        """Reboot now: silence, then the whole boot again; stream rates and estimates are forgotten."""
        self.parameters["STAT_BOOTCNT"] += 1
        if not self.motion.is_on_ground:
            self.motion.down = self.motion.ground_down
        self.motion.settle()
        self._reset()
        for channel in self.channels:
            channel.hangs_up = True
        self.reboot(_REBOOT_SILENCE_S)

    def send_text(self, severity: int, text: str) -> None:
        """Queue a text: as in the firmware, what explains a refusal leaves after the acknowledgement."""
        if self.is_initialised:
            self.call_later(0.0, lambda: super(ArduPilotVehicle, self).send_text(severity, text))
        else:
            super().send_text(severity, text)

    def set_mode(self, number: int) -> bool:
        """Change the mode if the vehicle may; says why not. A change is told by a heartbeat at once."""
        if number == self.mode.number:
            return True
        mode = self._modes.get(number)
        if mode is None:
            self.send_text(*self.unknown_mode(number))
            return False
        if (denied := self.fence.refusal(mode)) is not None:
            self.send_text(*denied)
            return False
        armed = self.motors.is_armed
        reason = None
        if (
            armed
            and mode.needs_position
            and not (self.navigation.has_position and not self.failsafes.estimator)
        ):
            reason = "requires position"
        elif not mode.enter(force=not armed):
            reason = mode.refused_because
        if reason is not None:
            self.send_text(MavSeverity.WARNING, self.refusal(mode, reason))
            return False
        self.mode.leave()
        self.mode = mode
        self.fence.mode_changed()
        self.call_later(0.0, lambda: self.send_built(m.Heartbeat.ID))
        return True

    def set_mode_from(self, base_mode: int, custom_mode: int) -> int:
        """DO_SET_MODE and SET_MODE: only custom modes; the MAV_RESULT. SET_MODE does not tell it."""
        if not base_mode & MavModeFlag.CUSTOM_MODE_ENABLED:
            return MavResult.DENIED
        return self.change_to(custom_mode)

    def change_to(self, number: int) -> int:
        """`set_mode` for a command: the MAV_RESULT."""
        return MavResult.ACCEPTED if self.set_mode(number) else MavResult.FAILED

    def mode_of(self, kind: type[ModeT]) -> ModeT:
        """Its mode of this class."""
        mode = self._modes[kind.number]
        assert isinstance(mode, kind)
        return mode

    def announce_parameter(self, name: str) -> None:
        self.storage.parameters.send(name, UNKNOWN_INDEX, None)

    def available_modes(self) -> list[m.AvailableModes]:
        """AVAILABLE_MODES, as ArduPilot numbers and names them."""
        modes = list(self._modes.values())
        return [
            m.AvailableModes(len(modes), index, 0, mode.number, 0, mode.name)
            for index, mode in enumerate(modes, start=1)
        ]

    def build(self, message_id: int) -> Message | None:
        """What is to be streamed now."""
        builder = self.BUILDERS.get(message_id)
        if builder is not None:
            return builder(self) if self.is_initialised or message_id in _BEFORE_READY else None
        if message_id == m.Timesync.ID:
            return m.Timesync(0, int(self.uptime * 1e9) + self.system_id)
        return m.AvailableModesMonitor(0) if message_id == m.AvailableModesMonitor.ID else None

    def tick(self, dt: float) -> None:
        if self.motors.is_armed:
            self.mode.update(dt)
        self.motors.update(self.now, dt, self.motion, landed=self.is_landed)
        if not self.is_landed:
            self.move(dt)
        self.battery.drain(self.motors.current_a, dt)
        if not self.motors.is_armed and self.is_landed and self.motors.is_idle:
            self.set_ticking(False)

    def _on_set_mode(self, request: m.SetMode, _: Channel) -> None:
        self.set_mode_from(request.base_mode, request.custom_mode)

    def _on_heartbeat(self, message: m.Heartbeat, _: Channel) -> None:
        if sender_of(message)[0] == self.parameters["MAV_GCS_SYSID"]:
            self.failsafes.ground_station_seen_at = self.now
