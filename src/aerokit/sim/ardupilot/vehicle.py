"""`ArduPilotVehicle`: base of the simulated ArduPilots, which creates their parts, boots and changes modes."""

# pyright: reportIncompatibleVariableOverride=false
# `ArduPilotHost` declares the parts as protocols, but here each part has its concrete type.

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any, ClassVar

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavModeFlag, MavResult, MavSeverity
from aerokit.mavlink.message import Message
from aerokit.mavlink.signing import SigningKey
from aerokit.sim.ardupilot.calibration import Calibrations
from aerokit.sim.ardupilot.camera import ArduPilotCamera
from aerokit.sim.ardupilot.devices import ArduPilotDevices
from aerokit.sim.ardupilot.external import ArduPilotExternal
from aerokit.sim.ardupilot.failsafes import ArduPilotArming, ArduPilotFailsafes
from aerokit.sim.ardupilot.fence import ArduPilotFence
from aerokit.sim.ardupilot.gimbal import ArduPilotGimbal
from aerokit.sim.ardupilot.host import ArduPilotHost, ArduPilotMode, ArduPilotMotors, GuidedMode
from aerokit.sim.ardupilot.kinds import BOOT_TIMELINES, BootTimeline, parameters_of
from aerokit.sim.ardupilot.mission_run import MissionMode, MissionRun
from aerokit.sim.ardupilot.mission_server import ArduPilotMissionServer
from aerokit.sim.ardupilot.navigation import ArduPilotNavigation, SmartPath
from aerokit.sim.ardupilot.radio import ArduPilotJoystick, ArduPilotRadio
from aerokit.sim.ardupilot.requests import ArduPilotMessageRequests
from aerokit.sim.ardupilot.storage import ArduPilotSigning, ArduPilotStorage
from aerokit.sim.autopilot import SimulatedBattery, VehicleStorage
from aerokit.sim.channel import Channel
from aerokit.sim.commands import CommandHandler
from aerokit.sim.logs import DEFAULT_LOGS, SimulatedLog
from aerokit.sim.motion import HOME, GlobalPoint, LocalFrame, Motion, Ned, SimulatedWind
from aerokit.sim.parameters import SimParameters
from aerokit.sim.vehicle import AttachableComponent, sender_of

_TIMESYNC_INTERVAL_S = 10.0
_STICK_MIDDLE, _STICK_RANGE = 1500, 500
_BEFORE_READY = frozenset({m.Heartbeat.ID, m.AutopilotVersion.ID})


class ArduPilotVehicle(ArduPilotHost):
    """Base of the simulated ArduPilots. A subclass sets the class attributes and implements commands and motion.

    - ``home``: power-on location: latitude, longitude (degrees), altitude AMSL (m); ``heading_deg``: initial heading
    - ``boot_time_s``: seconds until the estimator has a position; SITL takes 41.5; with 0 the vehicle is ready at once
    - ``boot_text``: True sends the plain text that a serial or TCP port sends before the first frame
    - ``version``: version in AUTOPILOT_VERSION and the banner; ``parameters``: values that differ from the defaults;
      ``parameter_count``: limits how many are listed, for quick tests; ``parameter_errors``: sends PARAM_ERROR
    - ``logs``: logs of earlier runs; ``link_bytes_per_s``: see `ArduPilotStorage`
    - ``battery_percent``: initial charge; ``battery_capacity_mah``: capacity of the battery
    - ``wind``: constant wind and gusts; ``rangefinder_reach_m``: range of the range finder, 0 without one
    - ``unsupported_commands``: MAV_CMDs to answer UNSUPPORTED, such as SET_MESSAGE_INTERVAL for an old firmware;
      ``stream_groups``: False ignores REQUEST_DATA_STREAM
    - ``components``: further components: `SimulatedCamera`, `SimulatedGimbal`, or `ExtraComponent`
    - ``unix_time_at_boot``: GPS time at simulated second 0, in seconds since 1970; continues through a reboot
    - ``signing_key``: see `ArduPilotSigning`
    """

    MAV_TYPE: ClassVar[int]
    BASE_FLAGS: ClassVar[int]
    """MAV_MODE_FLAGs of the heartbeat in every mode."""
    GUIDED_MODES: ClassVar[frozenset[str]] = frozenset()
    """Names of the modes in which the heartbeat has the flag GUIDED_ENABLED."""
    BUILDERS: ClassVar[Mapping[int, Callable[[Any], Message | None]]]
    """Functions that build messages, by message id. A function returns None if there is nothing to send."""
    MODES: ClassVar[tuple[Callable[[Any], ArduPilotMode], ...]]
    """Factories of the modes, in the order of AVAILABLE_MODES."""
    ARMING: ClassVar[type[ArduPilotArming[Any]]]
    FAILSAFES: ClassVar[type[ArduPilotFailsafes[Any]]]
    FENCE: ClassVar[type[ArduPilotFence[Any]]] = ArduPilotFence
    MOTORS: ClassVar[type[ArduPilotMotors]] = ArduPilotMotors
    JOYSTICK: ClassVar[type[ArduPilotJoystick]] = ArduPilotJoystick
    """Receiver of MANUAL_CONTROL."""

    HOME_NEEDS_ORIGIN: ClassVar[bool] = True
    """True if home cannot be set before the estimator has an origin."""
    REPORTS_HOME: ClassVar[bool] = False
    """True if a text reports each new home."""

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
        wind: SimulatedWind | None = None,
        rangefinder_reach_m: float = 0.0,
        unsupported_commands: Collection[int] = (),
        stream_groups: bool = True,
        components: Iterable[AttachableComponent] = (),
        unix_time_at_boot: float = 1_790_000_000.0,
        signing_key: SigningKey | None = None,
    ) -> None:
        self.parameters: SimParameters = parameters_of(self.KIND, parameter_count)
        """Parameters by name. A test may change them, and they survive a reboot."""
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
        self.battery: SimulatedBattery = SimulatedBattery(battery_capacity_mah, percent=battery_percent)
        self.motion: Motion = self.make_motion(wind)
        self.motion.yaw = math.remainder(math.radians(heading_deg), 2 * math.pi)
        self.rangefinder_reach_m = rangefinder_reach_m
        self.rc: ArduPilotRadio = ArduPilotRadio(self)  # RC channels. The throttle stick (index 2) rests at 1000.
        self.calibrations: Calibrations = Calibrations(self)
        self._boot_text = boot_text
        latitude, longitude, altitude_m = home
        self.frame: LocalFrame = LocalFrame(GlobalPoint(round(latitude * 1e7), round(longitude * 1e7), altitude_m))
        self.external: ArduPilotExternal = ArduPilotExternal(self)
        """Measurements received from companion computers."""
        self.missions: ArduPilotMissionServer = ArduPilotMissionServer(self)
        """Mission, fence and rally points, which survive a reboot."""
        self._reset()
        self.requests: ArduPilotMessageRequests = ArduPilotMessageRequests(self, stream_groups=stream_groups)
        self.serve_commands(self.make_commands())
        self.on(m.Heartbeat, self._on_heartbeat)
        self.on(m.SetMode, self._on_set_mode)
        # A reboot creates another gimbal, so its method is looked up for each message.
        self.observe(m.GlobalPositionInt, lambda message, channel: self.gimbal.on_global_position(message, channel))
        self.JOYSTICK(self)
        self.storage: VehicleStorage = ArduPilotStorage(
            self, logs, parameter_errors=parameter_errors, link_bytes_per_s=link_bytes_per_s
        )

    def _reset(self) -> None:
        """Create or reset the parts that do not survive a power cycle."""
        self.is_initialised: bool = False
        self.has_left_boot: bool = False
        self.is_landed: bool = self.motion.is_on_ground
        self.motors: ArduPilotMotors = self.MOTORS(self)
        self.navigation: ArduPilotNavigation = ArduPilotNavigation(self, self.external)
        self.path: SmartPath = SmartPath(self)  # Only ArduCopter and ArduRover record it.
        self.ground_station_seen_at: float = math.nan
        self.failsafes: ArduPilotFailsafes[Any] = self.FAILSAFES(self)
        self.arming: ArduPilotArming[Any] = self.ARMING(self, self.failsafes, self.calibrations.compasses)
        self.devices: ArduPilotDevices = ArduPilotDevices(self, self.arming)
        self.fence: ArduPilotFence[Any] = self.FENCE(self)
        self.gimbal: ArduPilotGimbal = ArduPilotGimbal(self)
        self.camera: ArduPilotCamera = ArduPilotCamera(self, self.gimbal)
        self.calibrations.reset()
        self.external.reset()
        self.rc.release_overrides()
        modes = [make_mode(self) for make_mode in self.MODES]
        self._modes: dict[int, ArduPilotMode] = {mode.number: mode for mode in modes}
        self.auto: MissionMode = next(mode for mode in modes if isinstance(mode, MissionMode))
        self.guided: GuidedMode = next(mode for mode in modes if isinstance(mode, GuidedMode))
        self.on(m.SetPositionTargetLocalNed, self.guided.on_local_target)
        self.on(m.SetPositionTargetGlobalInt, self.guided.on_global_target)
        self.on(m.SetAttitudeTarget, self.guided.on_attitude_target)
        self.reset_controllers()
        self.mission: MissionRun = MissionRun(self, self.auto, self.camera)
        self.missions.reset()
        self.mode: ArduPilotMode = self._modes[self.first_mode]

    def make_signing(self, key: SigningKey | None, timestamp: int) -> ArduPilotSigning:
        return ArduPilotSigning(self, key, timestamp)

    def make_motion(self, wind: SimulatedWind | None) -> Motion:
        """Create the motion model."""
        return Motion(self.rng, wind=wind)

    def make_commands(self) -> dict[int, CommandHandler]:
        """Return the handler of each MAV_CMD."""
        raise NotImplementedError

    def look_at(self, place: Ned | None) -> None:
        """Point the gimbal, if there is one, at a place. None returns it to its default mode."""
        self.gimbal.look_at(place)

    def accept_reposition(self, place: Ned) -> bool:
        """Called before DO_REPOSITION is executed. Return False to refuse the command."""
        return True

    def reset_controllers(self) -> None:
        """Reset the parts that only this kind of vehicle has. Called at power-on, after the modes were created."""

    def text_for_unknown_mode(self, number: int) -> tuple[int, str]:
        """Return severity and text for a mode number that does not exist."""
        return MavSeverity.WARNING, f"No such mode {number}"

    def refusal_text(self, mode: ArduPilotMode, reason: str) -> str:
        """Return the text that reports a refused mode change."""
        return "Flight mode change failed"

    @property
    def first_mode(self) -> int:
        """Mode number after power-on."""
        return int(self.parameters["INITIAL_MODE"])

    @property
    def base_mode(self) -> int:
        """MAV_MODE_FLAGs of the heartbeat."""
        guided = MavModeFlag.GUIDED_ENABLED.value if self.mode.name in self.GUIDED_MODES else 0
        armed = MavModeFlag.SAFETY_ARMED.value if self.is_armed else 0
        return self.BASE_FLAGS | guided | armed

    def stick(self, index: int) -> float:
        """Return the position of a stick from -1 to 1."""
        return (self.rc[index] - _STICK_MIDDLE) / _STICK_RANGE

    def move(self, dt: float) -> None:
        """Move for ``dt`` seconds, and report a touchdown."""
        motion = self.motion
        was_on_ground = motion.is_on_ground
        motion.step(dt, powered=self.motors.is_armed and not self.faults.motor_failed)
        if motion.is_on_ground and not was_on_ground:
            self.info(f"SIM Hit ground at {motion.impact_speed_m_s:f} m/s")

    def is_addressed(self, message: Message) -> bool:
        """Return True unless a message is for another system, or for one of the other `components` of this vehicle.

        As in the firmware (MAVLink_routing.cpp), the autopilot also processes messages to unknown components.
        """
        system, component = getattr(message, "target_system", 0), getattr(message, "target_component", 0)
        return system in (0, self.system_id) and all(component != present.component_id for present in self.components)

    def boot(self) -> None:
        """Restart the servers and schedule the events of the boot."""
        self.storage.restart()
        self.requests.restart()
        if self._boot_text:
            for channel in self.channels:
                channel.write(f"\r\n\r\nInit {self.FIRMWARE} V{self.version} ({self.GIT_HASH.decode()})\r\n".encode())
                channel.write(b"\r\nFree RAM: 524288\r\nBooting 0/0\r\n")
        self.call_later(self.timeline.ready, self._become_ready)
        self.navigation.start()

    def _become_ready(self) -> None:
        self.is_initialised = True
        self.info("ArduPilot Ready")
        self.info("AHRS: DCM active")
        self.arming.start()
        self.failsafes.start()
        # SITL is still in MAV_STATE_BOOT for about half a second after it has reported "ArduPilot Ready".
        self.call_later(0.25 * self.timeline.ready, self._leave_boot)
        if self.KIND in ("copter", "rover"):
            self.path.start()

    def _leave_boot(self) -> None:
        self.has_left_boot = True

    def start_channel(self, channel: Channel) -> None:
        """Start heartbeats, TIMESYNC and the streams that the port's parameters (MAV1_EXTRA1 …) select."""
        heartbeat_at = self.booted_at + self.timeline.heartbeat
        timesync_at = self.booted_at + _TIMESYNC_INTERVAL_S
        ready_at = self.booted_at + self.timeline.ready
        channel.streams.set_interval(m.Heartbeat.ID, 1.0, max(self.now, heartbeat_at))
        channel.streams.set_interval(m.Timesync.ID, _TIMESYNC_INTERVAL_S, max(self.now, timesync_at))
        self.requests.start_channel(channel, max(self.now, ready_at))

    def reboot(self, silence_s: float) -> None:
        """See `SimulatedVehicle.reboot`. Resets estimates and the autopilot's own devices, such as its gimbal."""
        self.parameters["STAT_BOOTCNT"] += 1
        self.motion.settle()  # After a reboot in flight, the vehicle is on the ground at once.
        self._reset()
        for channel in self.channels:
            channel.closes_clients = True  # The reboot also ends the TCP server of the firmware.
        super().reboot(silence_s)

    def send_text(self, severity: int, text: str) -> None:
        """Send a text after the answer to the present command. During the boot, send it at once, like the firmware."""
        if self.is_initialised:
            self.call_later(0.0, lambda: super(ArduPilotVehicle, self).send_text(severity, text))
        else:
            super().send_text(severity, text)

    def set_mode(self, number: int) -> bool:
        """Enter a mode. Return False, and report the reason, if the mode is unknown or refused."""
        if number == self.mode.number:
            return True
        mode = self._modes.get(number)
        if mode is None:
            self.send_text(*self.text_for_unknown_mode(number))
            return False
        refusal_by_fence = self.fence.refusal(mode)
        if refusal_by_fence is not None:
            self.send_text(*refusal_by_fence)
            return False
        is_armed = self.motors.is_armed
        has_position = self.navigation.has_position and not self.failsafes.has_estimator_failed
        if is_armed and mode.needs_position and not has_position:
            self.send_text(MavSeverity.WARNING, self.refusal_text(mode, "requires position"))
            return False
        is_entered = mode.enter(force=not is_armed)  # A disarmed vehicle may select a mode that cannot run yet.
        if not is_entered:
            self.send_text(MavSeverity.WARNING, self.refusal_text(mode, mode.refused_because))
            return False
        self.mode.leave()  # Like the firmware, leave the old mode after entering the new one.
        self.mode = mode
        self.fence.on_mode_changed()
        self.call_later(0.0, lambda: self.send_built(m.Heartbeat.ID))  # The firmware reports a new mode at once.
        return True

    def set_mode_from(self, base_mode: int, custom_mode: int) -> int:
        """Execute DO_SET_MODE or SET_MODE and return the MAV_RESULT. Only custom modes are supported."""
        if not base_mode & MavModeFlag.CUSTOM_MODE_ENABLED:
            return MavResult.DENIED
        return self.change_to(custom_mode)

    def enter_first_accepted(self, *modes: int) -> bool:
        """Change to the first mode that is not refused. Return False if all modes are refused."""
        return any(self.set_mode(mode) for mode in modes)

    def change_to(self, number: int) -> int:
        """Change the mode for a command and return the MAV_RESULT."""
        return MavResult.ACCEPTED if self.set_mode(number) else MavResult.FAILED

    def available_modes(self) -> list[m.AvailableModes]:
        return [
            m.AvailableModes(
                number_modes=len(self._modes), mode_index=index, standard_mode=0, custom_mode=mode.number, properties=0,
                mode_name=mode.name,
            )
            for index, mode in enumerate(self._modes.values(), start=1)
        ]  # fmt: skip

    def build(self, message_id: int) -> Message | None:
        """Build the message with this id. Return None if the firmware does not send the message at present."""
        builder = self.BUILDERS.get(message_id)
        if builder is not None:
            return builder(self) if self.is_initialised or message_id in _BEFORE_READY else None
        if message_id == m.Timesync.ID:
            # A request (tc1 is 0) with the time in nanoseconds. The firmware adds its system id to the time.
            return m.Timesync(tc1=0, ts1=int(self.uptime * 1e9) + self.system_id)
        if message_id == m.AvailableModesMonitor.ID:
            return m.AvailableModesMonitor(0)
        return None

    def tick(self, dt: float) -> None:
        if self.motors.is_armed:
            self.mode.update(dt)
        self.motors.update(dt, landed=self.is_landed)
        if not self.is_landed:
            self.move(dt)
        self.battery.drain(self.motors.current_a, dt)
        if not self.motors.is_armed and self.is_landed and self.motors.is_idle:
            self.set_ticking(False)  # Ticks are not needed until the vehicle is armed, because nothing moves.

    def _on_set_mode(self, request: m.SetMode, _: Channel) -> None:
        self.set_mode_from(request.base_mode, request.custom_mode)

    def _on_heartbeat(self, message: m.Heartbeat, _: Channel) -> None:
        sender_system, _component = sender_of(message)
        if sender_system == self.parameters["MAV_GCS_SYSID"]:
            self.ground_station_seen_at = self.now
