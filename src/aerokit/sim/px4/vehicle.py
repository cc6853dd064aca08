"""`SimulatedPx4`: a PX4 quadrotor, for the paths of a client that differ from ArduPilot's."""

from __future__ import annotations

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd
from aerokit.mavlink.message import Message
from aerokit.sim.channel import Channel
from aerokit.sim.commands import Command, CommandHandler
from aerokit.sim.px4.base import Px4Vehicle
from aerokit.sim.px4.commands import px4_commands, refusal_by_place, set_mode
from aerokit.sim.px4.modes import mode_from_custom
from aerokit.sim.px4.telemetry import BUILDERS, GIMBAL_MESSAGES
from aerokit.sim.vehicle import sender_of


class SimulatedPx4(Px4Vehicle):
    """Speaks as PX4 v1.16/v1.17 does where a client can see it; flies as `Motion` does.

    Simulated: arming and its denial, every mode with its double acknowledgement, take-off to an AMSL altitude, hold,
    reposition, orbit, land, return to home or a rally point, sticks (MANUAL_CONTROL), offboard with its time-out and
    failsafe, flight termination, calibration, streams without being asked and at the rates of the link's mode, every
    message that the real one sends on request, heartbeats only once a second, chunked texts with a tab at the end, the
    events of those texts, bytewise parameters with _HASH_CHECK, commands of its own to component 0, pings to
    everybody, the failsafes of battery, ground station, manual control and geofence.
    Not simulated: REQUEST_EVENT, returning by way of a mission (RTL_TYPE 2), estimator failures other than a lost GPS,
    follow-me, modes of a companion; the camera is a component of its own, and without it nobody answers. MNT_MODE_IN 4
    fits a gimbal.

    - ``home``: latitude, longitude (degrees), altitude AMSL (m); ``heading_deg``: where its nose points
    - ``boot_time_s``: seconds until it can be armed
    - ``version``: 1.16 accepts unknown modes and falls back to POSITION when offboard set-points stop, 1.17 refuses
      them and returns, and refuses a COMMAND_INT in another frame than GLOBAL_INT
    - ``fast_rate_hz``: rate of attitude, position and targets on links of mode "normal"
    - ``link_modes``: of the first link, the second …: "normal", "onboard", "config" or "minimal", as MAV_0_MODE says
    - ``parameters``: values other than the defaults; ``parameter_count``: fewer than all 910, for quick tests;
      ``parameter_file``, ``link_bytes_per_s``: see `Storage`; ``logs``: what flights have left
    - ``signing_key``: see `Px4Signing`
    """

    def make_commands(self) -> dict[int, CommandHandler]:
        self.on(m.SetMode, self._on_set_mode)
        return px4_commands(self)

    def can_build(self, message_id: int) -> bool:
        """Those of a gimbal only with one."""
        return message_id in BUILDERS and (message_id not in GIMBAL_MESSAGES or self.gimbal.is_fitted)

    def build(self, message_id: int) -> Message | None:
        """What is to be streamed now."""
        builder = BUILDERS.get(message_id)
        return None if builder is None else builder(self)

    def refusal_of_command(self, command: Command) -> int | None:
        """Of frames; and of NaN sent as an integer, or "ignore" as a number (mavlink_receiver.cpp)."""
        return refusal_by_place(command, checks_frame=not self.version.startswith("1.16"))

    def _on_set_mode(self, request: m.SetMode, channel: Channel) -> None:
        main, sub = mode_from_custom(request.custom_mode)
        command = Command(
            MavCmd.DO_SET_MODE, request.base_mode, main, sub, 0, 0, 0, 0, None, channel, sender_of(request)
        )
        self.commands.answer(command, set_mode(self, request.base_mode, (main, sub)))
