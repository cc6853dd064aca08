"""`SimulatedPx4`: a PX4 quadrotor, for the paths of a client that differ from ArduPilot's."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from typing import TYPE_CHECKING, ClassVar

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd, MavResult, MavSeverity, MavType
from aerokit.sim.autopilot import SimulatedAutopilot
from aerokit.sim.battery import Battery
from aerokit.sim.commands import Command
from aerokit.sim.local_frame import GlobalPoint, LocalFrame
from aerokit.sim.motion import GRAVITY_M_S2, Motion, MotionLimits, Wind
from aerokit.sim.px4.commands import px4_commands
from aerokit.sim.px4.failsafes import WITHOUT_TAB, Failsafes
from aerokit.sim.px4.flight import Flight
from aerokit.sim.px4.mission import Mission
from aerokit.sim.px4.mission_server import MissionServer
from aerokit.sim.px4.modes import (
    HOLD,
    KNOWN,
    LAND,
    MISSION,
    OFFBOARD,
    POSITION,
    RTL,
    TAKEOFF,
    Px4Mode,
    mode_from_custom,
)
from aerokit.sim.px4.offboard import Offboard
from aerokit.sim.px4.parameters import px4_parameters
from aerokit.sim.px4.signing import Px4Signing
from aerokit.sim.px4.storage import DEFAULT_LOGS, Storage
from aerokit.sim.px4.telemetry import BUILDERS, DEFAULT_RATES_HZ, FAST_MESSAGES
from aerokit.sim.vehicle import Component, sender_of

if TYPE_CHECKING:
    from aerokit.mavlink.message import Message
    from aerokit.mavlink.signing import SigningKey
    from aerokit.sim.channel import Channel
    from aerokit.sim.logs import SimulatedLog
    from aerokit.sim.px4.ftp import Px4Ftp

__all__ = ["SimulatedPx4"]

_FIRST_HEARTBEAT_SHARE = 0.15
_REBOOT_SILENCE_S = 1.5
_LAND_DETECTOR_S = 1.0
_HOVER_THROTTLE = 0.5
_AMPERES_AT_FULL = 40.0
_WITHOUT_POSITION = frozenset({(1, 0), (2, 0), (5, 0), (7, 0), LAND})
_NOT_AFTER_LANDING = frozenset({TAKEOFF, LAND, RTL})


class SimulatedPx4(SimulatedAutopilot):
    """Speaks as PX4 v1.16/v1.17 does where a client can see it; flies as `Motion` does.

    Simulated: arming and its denial, modes with their double acknowledgement, take-off to an AMSL altitude, hold,
    reposition, land, return, offboard with its time-out and failsafe, streams without being asked, heartbeats only
    once a second, chunked texts with a tab at the end, bytewise parameters with _HASH_CHECK, commands of its own to
    component 0, pings to everybody, the failsafes of battery, ground station, manual control and geofence.
    Not simulated: flying to rally points, the events interface, sticks (POSITION and the
    manual modes stay where they are), estimator failures other than a lost GPS.

    - ``home``: latitude, longitude (degrees), altitude AMSL (m); ``heading_deg``: where its nose points
    - ``boot_time_s``: seconds until it can be armed
    - ``version``: 1.16 accepts unknown modes and falls back to POSITION when offboard set-points stop, 1.17 refuses
      them and returns
    - ``fast_rate_hz``: rate of attitude, position and targets
    - ``parameters``: values other than the defaults; ``parameter_count``: fewer than all 889, for quick tests;
      ``parameter_file``, ``link_bytes_per_s``: see `Storage`; ``logs``: what flights have left
    - ``signing_key``: see `Px4Signing`
    """

    CAPABILITIES: ClassVar[int] = 0xE8FF
    VEHICLE_TYPE: ClassVar[int] = MavType.QUADROTOR
    PARAMETER_TABLE: ClassVar[str] = "quadrotor"

    storage: Storage
    """Files, logs, and the servers of them and of the parameters."""

    def __init__(
        self,
        *,
        system_id: int = 1,
        home: tuple[float, float, float] = (47.3977432, 8.5455939, 489.4),
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
        wind: Wind | None = None,
        fast_rate_hz: float = 50.0,
        unsupported_commands: Collection[int] = (),
        components: Iterable[Component] = (),
        unix_time_at_boot: float = 1_790_000_000.0,
        signing_key: SigningKey | None = None,
    ) -> None:
        self.parameters = px4_parameters(parameter_count, self.PARAMETER_TABLE)
        """By name; they survive a reboot."""
        self.parameters["MAV_SYS_ID"] = system_id
        for name, value in (parameters or {}).items():
            self.parameters[name] = value
        super().__init__(
            system_id=system_id,
            seed=seed,
            components=components,
            version=version,
            unsupported_commands=unsupported_commands,
            unix_time_at_boot=unix_time_at_boot,
            signing_key=signing_key,
        )
        self.frame = LocalFrame(GlobalPoint(round(home[0] * 1e7), round(home[1] * 1e7), home[2]))
        self.battery = Battery(5000.0, cells=4, percent=battery_percent)
        self.motion = self._make_motion(wind)
        self.motion.yaw = math.remainder(math.radians(heading_deg), 2 * math.pi)
        self._boot_time_s = boot_time_s
        self._fast_rate_hz = fast_rate_hz
        self._next_text_id = 0
        self._pings = 0
        self.home = (0.0, 0.0, 0.0)
        self.missions = MissionServer(self)
        """Mission, fence and rally points; they survive a reboot."""
        self._reset()
        self._listen()
        self.storage = Storage(self, logs, parameter_file=parameter_file, link_bytes_per_s=link_bytes_per_s)

    def _make_motion(self, wind: Wind | None) -> Motion:
        limits = MotionLimits(
            acceleration_m_s2=3.0, vertical_acceleration_m_s2=3.0, lean_rad=math.radians(45)
        )
        return Motion(self.rng, limits, wind)

    def _make_flight(self) -> Flight:
        return Flight(self)

    def _make_mission(self) -> Mission:
        return Mission(self)

    def _reset(self) -> None:
        self.is_ready = self.is_armed = False
        self.is_landed = True
        self.mode: Px4Mode = HOLD
        self.intended_mode: Px4Mode = HOLD
        self.is_in_failsafe = False
        self.armed_at = -math.inf
        self.throttle = 0.0
        self.home_is_set_by_hand = False
        self._mode_after_landing: Px4Mode = HOLD
        self._touched_at = math.nan
        self._landed_at = math.nan
        self._has_flown = False
        self.flight = self._make_flight()
        self.mission = self._make_mission()
        self.failsafes = Failsafes(self)
        self.missions.reset()

    def make_signing(self, key: SigningKey | None, timestamp: int) -> Px4Signing:
        """Keeps the key."""
        return Px4Signing(self, key, timestamp)

    def _listen(self) -> None:
        self.offboard = Offboard(self)
        self.commands = self.serve_commands(px4_commands(self))
        self.on(m.SetMode, self._on_set_mode)
        self.listen_to_clocks()
        self.missions.listen()
        self.failsafes.listen()

    # ----------------------------------------------------------------------------------------- state

    @property
    def ftp(self) -> Px4Ftp:
        """The server of the files."""
        return self.storage.ftp

    @property
    def altitude_m(self) -> float:
        """Metres above home."""
        return self.home[2] - self.motion.down

    @property
    def airspeed_m_s(self) -> float:
        """What an airspeed sensor says; NaN without one."""
        return math.nan

    @property
    def has_position(self) -> bool:
        """Whether the estimator has a global position."""
        return self.uptime >= 0.5 * self._boot_time_s and not self.faults.gps_lost

    @property
    def accepts_unknown_modes(self) -> bool:
        """v1.16 says ACCEPTED to a mode that it does not know."""
        return self.version.startswith("1.16")

    def reasons(self) -> list[str]:
        """Why it cannot be armed, as the texts that tell it."""
        reasons = list(self.faults.prearm_failures)
        if not self.is_ready:
            reasons.append("heading estimate not stable")
        if not self.has_position and self.mode not in _WITHOUT_POSITION:
            reasons.append("No valid position estimate")
        return [f"Preflight Fail: {reason}" for reason in reasons] + self.failsafes.arming_reasons()

    def report_reasons(self) -> None:
        """Say what fails."""
        for reason in self.reasons():
            self.send_text(MavSeverity.CRITICAL, reason)

    def next_ping(self) -> int:
        """Sequence number of the next PING."""
        self._pings += 1
        return self._pings - 1

    # ------------------------------------------------------------------------------- boot and reboot

    def boot(self) -> None:
        """Start up."""
        self.storage.restart()
        self.call_later(0.3 * self._boot_time_s, self._warn_while_booting)
        self.mission.start()
        self.failsafes.listen()
        self.failsafes.start()
        self.call_later(self._boot_time_s, self._become_ready)

    def _warn_while_booting(self) -> None:
        self.info("[logger] ./log/2026-11-21/02_15_51.ulg")
        self.report_reasons()

    def _become_ready(self) -> None:
        self.is_ready = True
        self.home = (self.motion.north, self.motion.east, self.motion.down)

    def start_channel(self, channel: Channel) -> None:
        """Everything is streamed without being asked."""
        first = max(self.now, self.booted_at + _FIRST_HEARTBEAT_SHARE * self._boot_time_s)
        for message_id, rate in DEFAULT_RATES_HZ.items():
            channel.streams.set_interval(message_id, 1.0 / rate, first)
        for message_id in FAST_MESSAGES:
            channel.streams.set_interval(message_id, 1.0 / self._fast_rate_hz, first)

    def restart(self) -> None:
        """Reboot now."""
        self.motion.down = self.motion.ground_down
        self.motion.settle()
        self._reset()
        self._next_text_id = 0
        self.reboot(_REBOOT_SILENCE_S)

    def build(self, message_id: int) -> Message | None:
        """What is to be streamed now."""
        builder = BUILDERS.get(message_id)
        return None if builder is None else builder(self)

    def send_text(self, severity: int, text: str) -> None:
        """Every text has an id, nearly every one ends in a tab; it leaves after what is being answered."""
        text = text if text in WITHOUT_TAB or text.startswith("MAVLink signing") else text + "\t"
        number, self._next_text_id = self._next_text_id, (self._next_text_id + 1) & 0xFFFF
        self.call_later(0.0, lambda: self.send_chunks(severity, text, number))

    # ------------------------------------------------------------------------------ arming and modes

    def arm(self) -> bool:
        """Arm if the checks allow it."""
        if self.is_armed:
            return True
        if not self.is_ready and not self.faults.prearm_failures:
            return False  # without a text, as seen
        if self.reasons():
            self.send_text(MavSeverity.CRITICAL, "Arming denied: Resolve system health failures first")
            self.report_reasons()
            return False
        self.is_armed, self.armed_at, self._has_flown = True, self.now, False
        self._landed_at = math.nan
        if not self.home_is_set_by_hand:
            self.home = (self.motion.north, self.motion.east, self.motion.down)
        self.info("Armed by external command")
        self.failsafes.armed()
        if self.mode == MISSION:
            self.mission.enter()
        self.set_ticking(True)
        return True

    def disarm(self, by: str, *, force: bool = False) -> bool:
        """Stop the motors; in the air only by force."""
        if not self.is_armed:
            return True
        if not self.is_landed and not force:
            self.send_text(MavSeverity.CRITICAL, "Disarming denied: not landed")
            return False
        self.is_armed, self.throttle = False, 0.0
        self.info(f"Disarmed by {by}")
        self.is_in_failsafe = False
        if self.mode in _NOT_AFTER_LANDING:
            self.switch_to(self._mode_after_landing)
        return True

    def change_mode(self, mode: Px4Mode) -> bool:
        """What a user asks for: anything while disarmed, only what can run while armed; LAND always."""
        if self.is_armed and mode != LAND and not self.can_run(mode):
            return False
        if mode not in _NOT_AFTER_LANDING:
            self._mode_after_landing = mode
        self.is_in_failsafe = False
        self.intended_mode = mode
        self.failsafes.take_over()
        if mode == self.mode == MISSION:
            self.mission.enter()
        elif mode == self.mode:
            self.flight.stay_here()
        else:
            self.switch_to(mode)
        if mode == TAKEOFF:
            motion, altitude = self.motion, self.parameters["MIS_TAKEOFF_ALT"]
            self.flight.target = (motion.north, motion.east, self.home[2] - altitude)
        return True

    def can_run(self, mode: Px4Mode) -> bool:
        """Whether the mode has what it needs: sticks, a mission, set-points, a position."""
        if mode == MISSION and not self.mission.is_valid:
            return False
        if mode == POSITION or mode not in KNOWN or (mode[0] != 4 and mode != OFFBOARD):
            return False
        return self.has_position and (mode != OFFBOARD or self.offboard.is_fresh)

    def switch_to(self, mode: Px4Mode) -> None:
        """Change the mode, whoever wants it; only the next heartbeat tells."""
        self.mode = mode
        self.flight.enter(mode)
        if mode == RTL:
            zeros = (0.0,) * 7
            self.send(
                m.CommandLong(self.system_id, 0, MavCmd.NAV_RETURN_TO_LAUNCH, 0, *zeros)
            )  # to its own parts

    # ---------------------------------------------------------------------------------------- flying

    def leave_ground(self) -> None:
        """The land detector sees a take-off."""
        self.is_landed, self._has_flown, self._touched_at = False, True, math.nan
        self.info("Takeoff detected")

    def tick(self, dt: float) -> None:
        """Mode, motion, land detector, battery, failsafe."""
        if self.is_armed:
            self.offboard.watch()
            self.flight.update()
        if self._moves():
            self.motion.step(dt, powered=self.is_armed and not self.faults.motor_failed)
        if not self.is_landed:
            self._detect_landing()
        self._disarm_by_itself()
        self._run_motors(dt)
        if not self.is_armed and self.is_landed:
            self.set_ticking(False)

    def _moves(self) -> bool:
        return not self.is_landed

    def _is_down(self) -> bool:
        return self.motion.is_on_ground

    def _run_motors(self, dt: float) -> None:
        self.throttle = 0.0
        if self.is_armed and not self.is_landed:
            lift = max(0.0, 1.0 - self.motion.acceleration_down / GRAVITY_M_S2)
            lean = math.cos(self.motion.roll) * math.cos(self.motion.pitch)
            self.throttle = min(1.0, _HOVER_THROTTLE * lift / max(0.5, lean))
        self.battery.drain(self.throttle * _AMPERES_AT_FULL, dt)

    def _detect_landing(self) -> None:
        if not self._is_down() or self.flight.lifts_off:
            self._touched_at = math.nan
        elif math.isnan(self._touched_at):
            self._touched_at = self.now
        elif self.now - self._touched_at >= _LAND_DETECTOR_S or not self.is_armed:
            self.is_landed, self._landed_at = True, self.now
            self.motion.settle()
            self.info("Landing detected")
            self.mission.landed()

    def _disarm_by_itself(self) -> None:
        if not self.is_armed or not self.is_landed or self.flight.lifts_off:
            return
        if self._has_flown and self.now - self._landed_at >= self.parameters["COM_DISARM_LAND"]:
            self.disarm("landing")
        elif not self._has_flown and 0 < self.parameters["COM_DISARM_PRFLT"] <= self.now - self.armed_at:
            self.disarm("auto preflight disarming")

    # -------------------------------------------------------------------------------- other messages

    def _on_set_mode(self, request: m.SetMode, channel: Channel) -> None:
        main, sub = mode_from_custom(request.custom_mode)
        command = Command(
            MavCmd.DO_SET_MODE, request.base_mode, main, sub, 0, 0, 0, 0, None, channel, sender_of(request)
        )
        known = (main, sub) in KNOWN and self.change_mode((main, sub))
        self.commands.answer(command, MavResult.ACCEPTED if known else MavResult.TEMPORARILY_REJECTED)
