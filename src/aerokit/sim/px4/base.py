"""`Px4Vehicle`: boot, state, modes and flight of a simulated PX4."""

# pyright: reportIncompatibleVariableOverride=false
# `Px4Host` declares the modules as protocols, but here the attributes have the concrete types.

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterable, Iterator, Sequence
from functools import partial
from typing import ClassVar

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavType
from aerokit.mavlink.signing import SigningKey
from aerokit.sim.autopilot import SimulatedBattery, VehicleStorage
from aerokit.sim.channel import Channel
from aerokit.sim.commands import CommandHandler, CommandServer
from aerokit.sim.logs import DEFAULT_LOGS, SimulatedLog
from aerokit.sim.motion import HOME, GlobalPoint, LocalFrame, Motion, MotionLimits, Ned, SimulatedWind
from aerokit.sim.parameters import SimParameters
from aerokit.sim.px4.arming import Px4Arming, Px4Calibration
from aerokit.sim.px4.console import Px4LogStream, Px4Shell
from aerokit.sim.px4.external import Px4External
from aerokit.sim.px4.failsafes import Px4Failsafes
from aerokit.sim.px4.flight import Px4Flight
from aerokit.sim.px4.host import Px4Host
from aerokit.sim.px4.links import Px4Events, Px4StreamRates, Px4TextLinks, on_the_wire
from aerokit.sim.px4.manual import Px4Sticks
from aerokit.sim.px4.mission import Px4Mission
from aerokit.sim.px4.mission_server import Px4MissionServer
from aerokit.sim.px4.offboard import Px4Offboard
from aerokit.sim.px4.payload import Px4CameraTrigger, Px4Gimbal
from aerokit.sim.px4.storage import Px4Signing, Px4Storage, px4_parameters
from aerokit.sim.vehicle import AttachableComponent, sender_of

# Shares of the boot time after which the streams start, and pre-arm warnings are sent.
_HEARTBEAT_BOOT_SHARE, _WARNING_BOOT_SHARE = 0.2, 0.3
_HOVER_THROTTLE = 0.5
_AMPERES_AT_FULL = 40.0


class Px4Vehicle(Px4Host):
    """Base of the simulated PX4, without commands and telemetry. See `SimulatedPx4` for the arguments."""

    CAPABILITIES: ClassVar[int] = 0xE8FF
    VEHICLE_TYPE: ClassVar[int] = MavType.QUADROTOR
    PARAMETER_TABLE: ClassVar[str] = "quadrotor"
    FLIGHT: ClassVar[type[Px4Flight]] = Px4Flight
    MISSION: ClassVar[type[Px4Mission]] = Px4Mission

    def __init__(
        self,
        *,
        system_id: int = 1,
        home: tuple[float, float, float] = HOME,
        heading_deg: float = 0.0,
        seed: int = 0,
        boot_time_s: float = 3.5,
        version: str = "1.17.0-alpha",
        parameters: dict[str, float] | None = None,
        parameter_count: int | None = None,
        parameter_file: bool = False,
        logs: Sequence[SimulatedLog] = DEFAULT_LOGS,
        link_bytes_per_s: float | None = None,
        battery_percent: float = 100.0,
        wind: SimulatedWind | None = None,
        fast_rate_hz: float = 50.0,
        link_modes: Sequence[str] = ("normal",),
        unsupported_commands: Collection[int] = (),
        components: Iterable[AttachableComponent] = (),
        unix_time_at_boot: float = 1_790_000_000.0,
        signing_key: SigningKey | None = None,
    ) -> None:
        self.parameters: SimParameters = px4_parameters(parameter_count, self.PARAMETER_TABLE)
        self.parameters["MAV_SYS_ID"] = system_id
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
        latitude, longitude, altitude_m = home
        self.frame: LocalFrame = LocalFrame(GlobalPoint(round(latitude * 1e7), round(longitude * 1e7), altitude_m))
        self.battery: SimulatedBattery = SimulatedBattery(5000.0, cells=4, percent=battery_percent)
        self.motion: Motion = self._make_motion(wind)
        self.motion.yaw = math.remainder(math.radians(heading_deg), 2 * math.pi)
        self.boot_time_s: float = boot_time_s
        self.rates: Px4StreamRates = Px4StreamRates(link_modes, self.can_build, fast_rate_hz)
        self.events: Px4Events = Px4Events(self)
        self._next_text_id = 0
        self.ping_numbers: Iterator[int] = itertools.count()  # sequence numbers of the next PINGs
        self.home: Ned = (0.0, 0.0, 0.0)  # In the local frame, whose zero point is the argument `home`.
        self.missions: Px4MissionServer = Px4MissionServer(self)
        """Mission, fence and rally points, which survive a reboot."""
        self.camera_trigger: Px4CameraTrigger = Px4CameraTrigger(self)
        """Camera trigger, enabled while the parameter TRIG_MODE is not 0."""
        self._reset()
        self._listen()
        self.storage: VehicleStorage = Px4Storage(
            self, logs, parameter_file=parameter_file, link_bytes_per_s=link_bytes_per_s
        )

    def make_commands(self) -> dict[int, CommandHandler]:
        """Return handlers by MAV_CMD."""
        raise NotImplementedError

    def can_build(self, message_id: int) -> bool:
        """Return True if the vehicle can send this message."""
        raise NotImplementedError

    def _make_motion(self, wind: SimulatedWind | None) -> Motion:
        limits = MotionLimits(acceleration_m_s2=3.0, vertical_acceleration_m_s2=3.0, lean_rad=math.radians(45))
        return Motion(self.rng, limits, wind)

    def _reset(self) -> None:
        """Set the state after a power-on."""
        self._reset_state()
        self.calibration: Px4Calibration = Px4Calibration(self)
        self.arming: Px4Arming = Px4Arming(self, self.calibration)
        self.vtol_state: int = 0
        """MAV_VTOL_STATE to report. Assign a value to simulate a VTOL. The motion of the vehicle does not change."""
        self.flight: Px4Flight = self.FLIGHT(self)
        self.mission: Px4Mission = self.MISSION(self)
        self.text_links: Px4TextLinks = Px4TextLinks(self)
        self.failsafes: Px4Failsafes = Px4Failsafes(self, self.text_links)
        self.missions.reset()

    def make_signing(self, key: SigningKey | None, timestamp: int) -> Px4Signing:
        return Px4Signing(self, key, timestamp)

    def _listen(self) -> None:
        # A reboot does not replace these parts.
        self.offboard: Px4Offboard = Px4Offboard(self)
        self.sticks: Px4Sticks = Px4Sticks(self)
        self.external: Px4External = Px4External(self)
        """Measurements received from companion computers."""
        self.gimbal: Px4Gimbal = Px4Gimbal(self)
        """Gimbal on the AUX outputs, enabled by MNT_MODE_IN."""
        self.shell: Px4Shell = Px4Shell(self)
        self.log_stream: Px4LogStream = Px4LogStream(self)
        self.commands: CommandServer = self.serve_commands(self.make_commands())
        self.on(m.Ping, self._on_ping)

    @property
    def airspeed_m_s(self) -> float:
        """Airspeed that the vehicle measures, in m/s; NaN without an airspeed sensor."""
        return math.nan

    def boot(self) -> None:
        self.storage.restart()
        self.camera_trigger.restart()
        self.gimbal.start()
        self.call_later(_WARNING_BOOT_SHARE * self.boot_time_s, self._warn_while_booting)
        self.mission.start()
        self.failsafes.start()
        self.call_later(self.boot_time_s, self._set_ready)

    def _warn_while_booting(self) -> None:
        self.arming.report_reasons()
        self.arming.start_log()  # The first flight is part of this log.

    def _set_ready(self) -> None:
        self.is_ready = True
        self.home = self.motion.place

    def start_channel(self, channel: Channel) -> None:
        """Start the default streams."""
        first = max(self.now, self.booted_at + _HEARTBEAT_BOOT_SHARE * self.boot_time_s)
        self.rates.start(channel, self.channels.index(channel), first)
        ready_at = max(self.now, self.booted_at + self.boot_time_s)
        # PX4 does not stream the origin, but sends it once, and again after a change.
        self.call_at(ready_at, lambda: self.send_built(m.GpsGlobalOrigin.ID, channel))

    def reboot(self, silence_s: float) -> None:
        self.motion.down = self.motion.ground_down
        self.motion.settle()
        self._reset()
        self._next_text_id = 0
        super().reboot(silence_s)

    def shut_down(self) -> None:
        """Switch off until `power_on`."""
        self._reset()
        super().reboot(math.inf)

    def send_text(self, severity: int, text: str) -> None:
        """Queue a status text and its event, if it has one. They are sent after the answer to the present command."""
        self.call_later(0.0, partial(self.events.send_for, text))
        text = on_the_wire(text)
        text_id = self._next_text_id
        self._next_text_id = (text_id + 1) & 0xFFFF
        self.call_later(0.0, lambda: self.send_chunks(severity, text, text_id))

    def on_speedup(self, speedup: float) -> None:
        self.text_links.speedup = speedup

    def send_parts(self, chunks: list[m.Statustext]) -> None:
        self.text_links.send(chunks)

    def tick(self, dt: float) -> None:
        """Update mode, motion, land detector, battery and motors."""
        if self.is_armed:
            self.offboard.watch()
            self.flight.update()
        if self._is_moving():
            self.motion.step(dt, powered=self.has_power)
        if not self.is_landed:
            self._detect_landing()
        self._auto_disarm()
        self._run_motors(dt)
        if not self.is_armed and self.is_landed:
            self.set_ticking(False)

    @property
    def has_power(self) -> bool:
        """True while armed, unless the motors have failed or the flight was terminated."""
        return self.is_armed and not self.faults.motor_failed and not self.arming.is_terminated

    def _is_moving(self) -> bool:
        return not self.is_landed

    def _run_motors(self, dt: float) -> None:
        self.throttle: float = 0.0
        if self.is_armed and not self.is_landed:
            self.throttle = min(1.0, _HOVER_THROTTLE * self.motion.thrust_share)
        self.battery.drain(self.throttle * _AMPERES_AT_FULL, dt)

    def _on_ping(self, ping: m.Ping, channel: Channel) -> None:
        # A PING with an address is an answer itself, so it is not answered.
        if ping.target_system == ping.target_component == 0:
            self.send(m.Ping(ping.time_usec, ping.seq, *sender_of(ping)), channel)
