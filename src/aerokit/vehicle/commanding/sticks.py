"""`StickStream`: sends stick positions from your program in place of a pilot's transmitter.

The stream sends MANUAL_CONTROL (https://mavlink.io/en/services/manual_control.html). ArduPilot treats this message as
an override of the transmitter's channels, PX4 as a second source of manual control.
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from aerokit._internal.arguments import check_kind, check_range, checks_arguments
from aerokit._internal.values import Snapshot
from aerokit.errors import AerokitError, NotSupported, OperationRejected
from aerokit.mavlink.messages import ManualControl, RcChannelsOverride
from aerokit.vehicle.commanding.streams import SteeringStream, known_values

if TYPE_CHECKING:
    from aerokit.autopilots import Mode
    from aerokit.mavlink.message import Message
    from aerokit.vehicle.commanding.context import VehicleContext
    from aerokit.vehicle.commanding.streams import Probe

__all__ = ["StickInput", "StickStream"]

# Value of an axis without a position. ArduPilot releases the channel of the axis (GCS_Common.cpp, manual_override).
NO_VALUE = 0x7FFF
# Values of RC_CHANNELS_OVERRIDE that release channels 1 to 8, release channels 9 to 18, or leave a channel unchanged.
RELEASED, RELEASED_UPPER, UNCHANGED = 0, 0xFFFE, 0xFFFF
# On ArduSub, MANUAL_CONTROL overrides the channels from 1 to this one (joystick.cpp).
SUB_CHANNELS = 11
MAX_BUTTONS = 0xFFFF

# Values of COM_RC_IN_MODE with which PX4 ignores stick positions sent by MAVLink (ManualControlSelector.cpp).
RC_ONLY, DISABLED = 0, 4
# Bit of RC_OPTIONS with which ArduPilot ignores overrides (RC_Channels.h).
IGNORE_OVERRIDES = 1 << 1


class StickInput(Snapshot):
    """Stick positions from −1 to 1; 0 is the center.

    ``forward`` is the pitch stick, ``right`` the roll stick; positive ``yaw`` turns clockwise. ``throttle`` −1 is the
    lowest position: a multicopter in a mode that holds altitude descends, a plane has no thrust, a rover reverses.
    ``buttons`` is a bit mask; ArduSub has functions for the buttons.
    """

    forward: float = 0.0
    right: float = 0.0
    throttle: float = 0.0
    yaw: float = 0.0
    buttons: int = 0


@checks_arguments
class StickStream(SteeringStream[StickInput]):
    """Sends the latest stick positions at a fixed rate while the ``async with`` block supplies them.

    Entering the block sends the initial positions for a second and then changes the mode. Leaving the block, also
    by an exception, orders the vehicle to hold, except after a newer order or a takeover. It also makes ArduPilot
    release the sticks. If the stream stops by itself (no new positions, a blocked event loop, a silent vehicle,
    another mode), the next ``set``, or else the end of the block, raises :class:`SetpointStreamStopped`.

    If the program is killed, ArduPilot returns to the transmitter after RC_OVERRIDE_TIME (3 s). ArduCopter without a
    transmitter executes the action of FS_THR_ENABLE after every end of a stream.

    PX4 has no message that releases the sticks. After every end of a stream, it waits for COM_RC_LOSS_T (0.5 s) and
    then treats the sticks as lost. Without another source of manual control, it executes NAV_RCL_ACT (return by
    default). To prevent this in hold mode, set bit 1 of COM_RCL_EXCEPT.

    Entering raises:
        InvalidArgument: a position is out of range. Nothing was sent.
        NotSupported: this type of vehicle has no sticks. Nothing was sent.
        OperationRejected: a parameter makes the vehicle ignore the sticks, or never release them; the error text names
            it.
        ParameterTimeout: the vehicle did not report a parameter that aerokit must check first. Nothing else was sent.
        CommandRejected: the vehicle refused the mode.
        BusyError: another set-point stream is open.
    """

    _NAME, _VALUE = "stick stream", "stick position"

    def __init__(
        self,
        context: VehicleContext,
        probe: Probe,
        mode: str | int | None,
        initial: StickInput | None,
        rate_hz: float,
        valid_for_s: float,
        max_lag_s: float,
    ) -> None:
        super().__init__(context, self._message_of, initial or StickInput(), rate_hz, valid_for_s, max_lag_s)
        self._rules = context.session.autopilot.sticks
        self._probe = probe
        # True from the first stick position sent until the sticks are released.
        self._has_sent = False
        telemetry = context.session.telemetry
        self._chosen_mode = None if mode is None else self._session.autopilot.find_mode(mode, telemetry.mode_names)

    def set(self, sticks: StickInput) -> None:
        """Set the stick positions, which are sent at the next tick and repeated until ``valid_for_s`` has passed.

        Raises:
            InvalidArgument: a position is out of range; the previous positions stay in force until they expire.
            SetpointStreamStopped: the stream has ended by itself, or its `async with` block was left.
        """
        check_kind("sticks", sticks, StickInput)
        self._set(sticks)

    async def move(self, sticks: StickInput, duration_s: float) -> None:
        """Keep the sticks in one position for ``duration_s`` seconds. Raises as :meth:`set`."""
        check_kind("sticks", sticks, StickInput)
        await self._supply_for(sticks, duration_s)

    @property
    def _needs_stream_before_mode(self) -> bool:
        return True  # Without stick positions, PX4 would start the mode with the transmitter's throttle.

    def _stream_mode(self) -> Mode:
        if self._rules is None:
            raise NotSupported(f"sticks: {self._session.autopilot.firmware} does not accept MANUAL_CONTROL")
        return self._chosen_mode or self._context.sender.mode_for("sticks", "sticks")

    async def _check_support(self) -> None:
        if self._session.autopilot.name == "PX4":
            await self._check_px4_parameters()
        else:
            await self._check_ardupilot_parameters()

    async def _check_px4_parameters(self) -> None:
        values = await known_values(self._probe, "COM_RC_IN_MODE")
        source = values.get("COM_RC_IN_MODE")
        if source in (RC_ONLY, DISABLED):
            raise OperationRejected(
                f"sticks: COM_RC_IN_MODE = {source:g} makes PX4 ignore MANUAL_CONTROL; set COM_RC_IN_MODE to 1"
                " (MAVLink only) or 3 (transmitter or MAVLink)"
            )

    async def _check_ardupilot_parameters(self) -> None:
        values = await known_values(self._probe, "MAV_GCS_SYSID", "SYSID_MYGCS", "RC_OVERRIDE_TIME", "RC_OPTIONS")
        own_id = self._session.connection.source_system
        # Older versions of ArduPilot have SYSID_MYGCS instead of MAV_GCS_SYSID.
        ground_station = values.get("MAV_GCS_SYSID", values.get("SYSID_MYGCS", own_id))
        if ground_station != own_id:
            raise OperationRejected(
                f"sticks: ArduPilot accepts stick positions only from system {ground_station:g} (MAV_GCS_SYSID), and"
                f" this program is system {own_id}: connect with source_system={ground_station:g}"
            )
        release_after_s = values.get("RC_OVERRIDE_TIME", 3.0)  # 3 s is ArduPilot's default.
        if release_after_s <= 0:
            effect = "ignores stick positions"
            if release_after_s < 0:
                effect = "never releases the sticks if this program dies"
            raise OperationRejected(
                f"sticks: with RC_OVERRIDE_TIME = {release_after_s:g}, ArduPilot {effect}; set RC_OVERRIDE_TIME to 3"
            )
        if int(values.get("RC_OPTIONS", 0)) & IGNORE_OVERRIDES:
            raise OperationRejected("sticks: bit 1 of RC_OPTIONS makes ArduPilot ignore overrides; clear this bit")

    def _message_of(self, sticks: StickInput) -> Message:
        for name in ("forward", "right", "throttle", "yaw"):
            check_range(name, getattr(sticks, name), -1, 1)
        check_range("buttons", sticks.buttons, 0, MAX_BUTTONS)
        if self._rules is not None and self._rules.signed_throttle:
            throttle = 1000 * sticks.throttle  # −1000 to 1000
        else:
            throttle = 500 * (sticks.throttle + 1)  # 0 to 1000
        return ManualControl(
            target=self._session.system_id,
            x=round(1000 * sticks.forward),
            y=round(1000 * sticks.right),
            z=round(throttle),
            r=round(1000 * sticks.yaw),
            buttons=sticks.buttons,
        )

    def _send(self) -> None:
        super()._send()
        self._has_sent = True

    def _release(self) -> None:
        if not self._has_sent or self._rules is None or not self._session.connection.is_open:
            return
        self._has_sent = False
        message: Message | None = None
        if self._rules.release == "axes":
            target = self._session.system_id
            message = ManualControl(target=target, x=NO_VALUE, y=NO_VALUE, z=NO_VALUE, r=NO_VALUE, buttons=0)
        elif self._rules.release == "channels":
            # The message has 18 channels, of which the first SUB_CHANNELS are released. The value for a release differs
            # between channels 1 to 8 and the channels above.
            released_upper_count = SUB_CHANNELS - 8
            unchanged_count = 18 - SUB_CHANNELS
            values = [RELEASED] * 8 + [RELEASED_UPPER] * released_upper_count + [UNCHANGED] * unchanged_count
            message = RcChannelsOverride(self._session.system_id, self._session.component_id, *values)
        if message is not None:  # PX4 has no message that releases the sticks.
            with contextlib.suppress(AerokitError):  # The overrides expire by themselves.
                self._session.connection.send(message)
