"""Simulated PX4 multicopter and plane: `SimulatedPx4` and `SimulatedPx4Plane`."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import ClassVar

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd as Cmd
from aerokit.mavlink.enums import MavType
from aerokit.mavlink.message import Message
from aerokit.missions import MissionItem
from aerokit.sim.channel import Channel
from aerokit.sim.commands import CommandHandler, ReceivedCommand
from aerokit.sim.motion import Motion, Ned, SimulatedWind
from aerokit.sim.px4 import modes
from aerokit.sim.px4.base import Px4Vehicle
from aerokit.sim.px4.commands import px4_commands, refusal_by_place, set_mode
from aerokit.sim.px4.flight import Px4Flight
from aerokit.sim.px4.mission import LANDINGS, TAKE_OFFS, Px4Mission
from aerokit.sim.px4.modes import Px4Mode
from aerokit.sim.px4.telemetry import BUILDERS, GIMBAL_MESSAGES
from aerokit.sim.vehicle import sender_of
from aerokit.sim.vehicle_motion import FixedWing, WingLimits


class SimulatedPx4(Px4Vehicle):
    """PX4 v1.16 or v1.17 multicopter, as far as a client can observe it. `Motion` is the motion model.

    Not simulated: REQUEST_EVENT, returning along a mission (RTL_TYPE 2), estimator failures other than a lost GPS,
    follow-me, external modes. Camera commands are answered only by a camera, which is a separate component.
    MNT_MODE_IN 4 enables a gimbal.

    - ``home``: latitude, longitude (degrees), altitude AMSL (m); ``heading_deg``: initial heading
    - ``boot_time_s``: seconds until the vehicle can be armed
    - ``version``: 1.16 accepts unknown modes, and switches to POSITION when offboard set-points stop. 1.17 refuses
      unknown modes, switches to RTL when set-points stop, and refuses a COMMAND_INT in a frame other than GLOBAL_INT
    - ``fast_rate_hz``: rate of attitude, position and targets on "normal" links
    - ``link_modes``: MAV_n_MODE of the first link, the second …: "normal", "onboard", "config" or "minimal"
    - ``parameters``: values that differ from the defaults; ``parameter_count``: limits how many are listed,
      for quick tests; ``parameter_file``, ``link_bytes_per_s``: see `Px4Storage`; ``logs``: logs of earlier flights
    - ``signing_key``: see `Px4Signing`
    """

    def make_commands(self) -> dict[int, CommandHandler]:
        self.on(m.SetMode, self._on_set_mode)
        return px4_commands(self)

    def can_build(self, message_id: int) -> bool:
        """Return True if the vehicle can send this message. Gimbal messages require a gimbal."""
        return message_id in BUILDERS and (message_id not in GIMBAL_MESSAGES or self.gimbal.is_fitted)

    def build(self, message_id: int) -> Message | None:
        """Return the current message of this id; None if there is none."""
        return BUILDERS[message_id](self) if self.can_build(message_id) else None

    def refusal_of_command(self, command: ReceivedCommand) -> int | None:
        """Refuse an invalid position and, except in version 1.16, an unsupported frame."""
        return refusal_by_place(command, checks_frame=not self.version.startswith("1.16"))

    def _on_set_mode(self, request: m.SetMode, channel: Channel) -> None:
        mode = modes.mode_from_custom(request.custom_mode)
        main_mode, sub_mode = mode
        command = ReceivedCommand(
            Cmd.DO_SET_MODE, param1=request.base_mode, param2=main_mode, param3=sub_mode, param4=0, x=0, y=0, z=0,
            frame=None, channel=channel, sender=sender_of(request),
        )  # fmt: skip
        # PX4 acknowledges SET_MODE like DO_SET_MODE.
        self.commands.answer(command, set_mode(self, request.base_mode, mode))


_FLARE_M = 3.0
_GLIDE_SPEED_FACTOR = 1.3
# `FixedWing.climb_rate_to` returns the vertical distance to the target divided by this time.
_CLIMB_TIME_CONSTANT_S = 2.5
_FLARE_SINK_M_S = 0.5
_HEIGHT_REACHED_M = 10.0


class Px4PlaneFlight(Px4Flight):
    """Navigator of a plane. ``target`` is the center of a circle or the end of a straight line."""

    _vehicle: SimulatedPx4Plane  # pyright: ignore[reportIncompatibleVariableOverride]

    def __init__(self, plane: SimulatedPx4Plane) -> None:
        super().__init__(plane)
        self._motion = plane.motion
        self.course: float = 0.0  # Course of the climb after take-off, in radians.

    @property
    def cruise_speed_m_s(self) -> float:
        return self._vehicle.parameters["FW_AIRSPD_TRIM"]

    @property
    def top_speed_m_s(self) -> float:
        return self._vehicle.parameters["FW_AIRSPD_MAX"]

    @property
    def is_rolling(self) -> bool:
        return (
            self.lifts_off
            and self._vehicle.now - self._vehicle.arming.armed_at >= self._vehicle.parameters["RWTO_RAMP_TIME"]
        )

    def enter(self, mode: Px4Mode) -> None:
        self.radius_m: float = self._vehicle.parameters["NAV_LOITER_RAD"]
        self.course = self._motion.yaw
        super().enter(mode)

    def update(self) -> None:
        plane = self._vehicle
        mode, mission = plane.mode, plane.mission
        self.lifts_off: bool = mode == modes.TAKEOFF or (mode == modes.MISSION and mission.wants_up)
        if plane.is_landed and not self.is_rolling:  # The take-off roll has not begun.
            return
        if plane.is_landed and not self._motion.is_on_ground:  # The wing has lifted the plane.
            plane.leave_ground()
        if mode == modes.TAKEOFF:
            self._take_off()
        elif mode == modes.LAND:
            self.circle_down()
        elif mode == modes.RTL:
            self._return()
        elif mode == modes.MISSION:
            mission.update()
        elif mode == modes.OFFBOARD and all(map(math.isfinite, plane.offboard.position)):
            self.target = plane.offboard.position
            self.circle()
        elif mode in modes.STICK_MODES and plane.sticks.are_fresh:
            self._follow_sticks()
        else:
            self.circle()

    def _follow_sticks(self) -> None:
        sticks, parameters = self._vehicle.sticks, self._vehicle.parameters
        climbs = sticks.pitch < 0
        climb = -sticks.pitch * parameters["FW_T_CLMB_MAX" if climbs else "FW_T_SINK_MAX"]
        min_speed, max_speed = parameters["FW_AIRSPD_MIN"], parameters["FW_AIRSPD_MAX"]
        throttle = (sticks.throttle + 1.0) / 2  # from 0 to 1
        speed = min_speed + throttle * (max_speed - min_speed)
        self._motion.bank_and_climb(speed, math.radians(parameters["FW_R_LIM"]) * sticks.roll, climb)
        self.stay_here()  # If stick input is lost, the plane circles here.

    def fly_to_target(self) -> None:
        self.circle()

    def circle(self) -> None:
        self._motion.circle(*self.target, radius=self.radius_m, airspeed=self.speed_m_s)

    def fly_straight(self) -> None:
        self._motion.fly_to(*self.target, airspeed=self.speed_m_s)

    def climb_out(self) -> None:
        climb = self._vehicle.parameters["FW_T_CLMB_MAX"]
        self._motion.head(self.course, self.speed_m_s, climb)

    def _take_off(self) -> None:
        self.climb_out()
        _, _, target_down = self.target
        if self._motion.down > target_down:
            return
        place = (self._motion.north, self._motion.east, target_down)
        self._vehicle.mission.is_finished = True  # takeoff.cpp sets mission_result.finished.
        self._vehicle.switch_to(modes.HOLD)  # This sets the target to the current altitude.
        self.target = place

    def circle_down(self) -> None:
        sink = self._vehicle.parameters["FW_T_SINK_MIN"]
        north, east, _ = self.target
        self.target = (north, east, self._motion.down + sink * _CLIMB_TIME_CONSTANT_S)  # makes the plane sink at `sink`
        self._land(self.circle)

    def descend(self) -> None:
        self._land(self._glide)

    def _land(self, approach: Callable[[], None]) -> None:
        """Call ``approach`` until the flare, then touch down and roll out."""
        motion = self._motion
        height = motion.ground_down - motion.down
        if motion.is_on_ground:
            motion.roll_out()
        elif height < _FLARE_M:  # Sink slowly at minimum speed, straight on.
            motion.head(motion.yaw, self._vehicle.parameters["FW_AIRSPD_MIN"], -_FLARE_SINK_M_S)
        else:
            approach()

    def _glide(self) -> None:
        motion, parameters = self._motion, self._vehicle.parameters
        height = motion.distance_to(self.target) * math.tan(math.radians(parameters["FW_LND_ANG"]))
        climb = min(0.0, motion.climb_rate_to(motion.ground_down - height))
        motion.head(motion.bearing_to(self.target), parameters["FW_AIRSPD_MIN"] * _GLIDE_SPEED_FACTOR, climb)

    def _return(self) -> None:
        motion, plane = self._motion, self._vehicle
        if self._phase == "land":
            self.circle_down()
            return
        self.circle()
        _, _, target_down = self.target
        if abs(motion.down - target_down) > _HEIGHT_REACHED_M or not self._is_near():
            return
        north, east, down = self.destination
        if self._phase == "climb":
            self._phase = "return"
            self.target: Ned = (north, east, target_down)
        elif self._phase == "return":
            loiter_down = down - plane.parameters["RTL_DESCEND_ALT"]
            self.radius_m = plane.parameters["RTL_LOITER_RAD"]
            self._phase = "loiter"
            self.target = (north, east, max(target_down, loiter_down))
        elif self._phase == "loiter" and plane.parameters["RTL_LAND_DELAY"] < 0:
            self._phase = "done"
            plane.info("RTL: completed, loitering")
        elif self._phase == "loiter":
            self._phase = "land"
            plane.info("RTL: land at destination")

    def _is_near(self) -> bool:
        return self._motion.distance_to(self.target) <= abs(self.radius_m) + self._vehicle.parameters["NAV_ACC_RAD"]


_CIRCLES = (Cmd.NAV_LOITER_UNLIM, Cmd.NAV_LOITER_TIME, Cmd.NAV_LOITER_TO_ALT)
_TURN_LEAD_S = 2.0


class Px4PlaneMission(Px4Mission):
    """Mission mode of a plane."""

    _px4: SimulatedPx4Plane  # pyright: ignore[reportIncompatibleVariableOverride]

    def _climb(self, down: float | None) -> None:
        super()._climb(down)
        self._px4.flight.course = self._px4.motion.yaw

    def _set_target_for(self, item: MissionItem) -> None:
        super()._set_target_for(item)
        flight = self._px4.flight
        radius = 0.0
        if item.command in (Cmd.NAV_LOITER_UNLIM, Cmd.NAV_LOITER_TIME):
            radius = item.param3
        elif item.command == Cmd.NAV_LOITER_TO_ALT:
            radius = item.param2
        default = self._px4.parameters["NAV_LOITER_RAD"]
        has_radius = radius != 0.0 and math.isfinite(radius)
        flight.radius_m = radius if has_radius else default
        if item.command in LANDINGS:
            self._phase = "land"

    def update(self) -> None:
        item, flight = self._item, self._px4.flight
        if item is None or self.is_finished:
            flight.circle()
        elif self._phase == "land":
            flight.descend()
        elif self._phase == "climb":
            flight.climb_out()
            _, _, target_down = flight.target
            if self._px4.motion.down <= target_down:
                self._end_climb(item)
        else:
            self._go(item)

    def _end_climb(self, item: MissionItem) -> None:
        if item.command in TAKE_OFFS:
            self._complete_item(item)
        else:
            self._phase = "go"
            self._px4.flight.target = self._place(item)

    def _go(self, item: MissionItem) -> None:
        flight = self._px4.flight
        if item.command in _CIRCLES or item.command == Cmd.NAV_DELAY:
            flight.circle()
        else:
            flight.fly_straight()
        if not self._is_at_target(item):
            return
        if math.isnan(self._arrived_at):
            self._arrived_at = self._px4.now
        if self._is_done(item):
            self._complete_item(item)

    def _acceptance_radius_m(self, item: MissionItem) -> float:
        plane = self._px4
        # A fast plane must turn earlier.
        radius = max(plane.parameters["NAV_ACC_RAD"], _TURN_LEAD_S * plane.motion.airspeed_m_s)
        if item.command == Cmd.NAV_WAYPOINT:
            return max(radius, item.param2)
        return radius + abs(plane.flight.radius_m) if item.command in _CIRCLES else radius

    @property
    def _height_tolerance_m(self) -> float:
        return self._px4.parameters["NAV_FW_ALT_RAD"]

    def _hold(self) -> None:
        target = self._px4.flight.target
        super()._hold()
        # The plane flies on to the present target instead of holding here.
        if self._px4.mode == modes.HOLD:
            self._px4.flight.target = target


_AMPERES_AT_FULL = 20.0


class SimulatedPx4Plane(SimulatedPx4):
    """PX4 plane (MAV_TYPE 1, airframe 10041). `FixedWing` is the motion model. See `SimulatedPx4` for the arguments.

    The plane takes off straight ahead, from a runway. It never hovers, but circles with the radius NAV_LOITER_RAD. RTL
    ends in a circle above home, without a landing (RTL_LAND_DELAY is -1). LAND descends in circles. A mission must
    contain a landing (MIS_TKO_LAND_REQ), which has a straight glide path. OFFBOARD circles a position. Sticks control
    bank, climb and speed in every manual mode. The plane is not disarmed automatically before take-off.

    Not simulated, in addition to `SimulatedPx4`: hand launch, stalls, aborted landings, figures of eight.
    """

    VEHICLE_TYPE: ClassVar[int] = MavType.FIXED_WING
    PARAMETER_TABLE: ClassVar[str] = "airplane"
    FLIGHT: ClassVar[type[Px4Flight]] = Px4PlaneFlight
    MISSION: ClassVar[type[Px4Mission]] = Px4PlaneMission

    flight: Px4PlaneFlight  # pyright: ignore[reportIncompatibleVariableOverride]
    motion: FixedWing  # pyright: ignore[reportIncompatibleVariableOverride]

    @property
    def airspeed_m_s(self) -> float:
        return self.motion.airspeed_m_s

    def _make_motion(self, wind: SimulatedWind | None) -> Motion:
        values = self.parameters
        wing = WingLimits(
            airspeed_min_m_s=values["FW_AIRSPD_MIN"],
            airspeed_max_m_s=values["FW_AIRSPD_MAX"],
            climb_m_s=values["FW_T_CLMB_MAX"],
            sink_m_s=values["FW_T_SINK_MAX"],
        )
        return FixedWing(self.rng, wing, wind)

    def _is_moving(self) -> bool:
        return super()._is_moving() or self.flight.is_rolling

    def _has_touched_down(self) -> bool:
        return self.motion.is_at_rest

    def _run_motors(self, dt: float) -> None:
        self.throttle: float = self.motion.throttle if self.is_armed else 0.0
        self.battery.drain(self.throttle * _AMPERES_AT_FULL, dt)
