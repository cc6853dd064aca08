"""``vehicle._master``: the part of pymavlink's connection object that DroneKit programs use."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

from pymavlink import mavutil

from aerokit.autopilots.modes import is_armed
from aerokit.connection.heartbeats import is_autopilot
from aerokit.dronekit.classic_connection import weak_callback
from aerokit.dronekit.exceptions import APIException, classic_errors
from aerokit.dronekit.observers import message_of
from aerokit.errors import InvalidArgument
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.enums import MavAutopilot, MavCmd, MavModeFlag, MavParamType
from aerokit.mavlink.message_factory import MessageFactory
from aerokit.mavlink.pymavlink import from_pymavlink
from aerokit.sync.thread_future import ThreadFuture

if TYPE_CHECKING:
    from aerokit.dronekit.classic_connection import ClassicConnection
    from aerokit.mavlink.frame import Frame
    from aerokit.mavlink.messages import Heartbeat
    from aerokit.transport.link import Peer

MAX_MESSAGES = 1000
MESSAGE_MAX_AGE_S = 5.0  # Older messages are dropped, so that a program with long pauses between reads gets new ones.
# Messages are stored from the first access to `Master.messages` on. A look-up this soon after it waits for the message.
FIRST_LOOKUP_TIMEOUT_S = 1.0
SIGNAL_CHECK_INTERVAL_S = 0.2  # Ctrl-C and a closed connection end a wait within this time.


class Master:
    """The part of pymavlink's ``mavfile`` that old programs use. New programs use the vehicle itself.

    Methods that send return immediately and do not report the result.
    """

    def __init__(self, connection: ClassicConnection) -> None:
        self._connection = connection
        self.source_system: int = connection.connection.source_system
        self.source_component: int = connection.connection.source_component
        """Component id of this program."""
        self.mav: MessageFactory = MessageFactory(self._send, self.source_system, self.source_component)
        """Object with a method for each message, which creates and sends it."""
        self.messages: Inbox = Inbox(connection)
        """The last message of every type by name, from the first access on."""

    @property
    def target_system(self) -> int:
        """System id of the vehicle; 0 until the vehicle is found."""
        return self._connection.target_system

    @property
    def target_component(self) -> int:
        """Component id of the vehicle's autopilot; 0 until the vehicle is found."""
        heartbeat = self._heartbeat
        return 0 if heartbeat is None or heartbeat.received_frame is None else heartbeat.received_frame.component_id

    @property
    def address(self) -> str:
        return self._connection.connection.link.address

    @property
    def port(self) -> Master:
        """The object itself, so that ``port.close()`` closes the connection. There is no socket or serial port."""
        return self

    @property
    def flightmode(self) -> str:
        """Name of the flight mode; ``UNKNOWN`` before the first HEARTBEAT."""
        heartbeat = self._heartbeat
        if heartbeat is None or heartbeat.received_frame is None:
            return "UNKNOWN"
        return str(mavutil.mode_string_v10(message_of(heartbeat.received_frame)))

    def close(self) -> None:
        self._connection.close()

    # --------------------------------------------------------------------------------- modes

    def mode_mapping(self) -> dict[str, Any] | None:
        """Return a dict of mode names to numbers (PX4: to three numbers), or None if the modes are unknown."""
        heartbeat = self._heartbeat
        if heartbeat is None:
            return None
        if heartbeat.autopilot == MavAutopilot.PX4:
            return dict(mavutil.px4_map)
        modes = mavutil.mode_mapping_byname(heartbeat.type)
        return dict(modes) if modes is not None else None

    def set_mode(self, mode: str | int, custom_mode: int | None = 0, custom_sub_mode: int | None = 0) -> None:
        """Set a mode by name (KeyError if unknown) or by number.

        On PX4, a mode has three numbers: those that :meth:`mode_mapping` returns for its name.
        """
        heartbeat = self._heartbeat
        is_px4 = heartbeat is not None and heartbeat.autopilot == MavAutopilot.PX4
        vehicle = self._connection.vehicle
        # Vehicle.mode accepts names and ArduPilot's numbers, but not PX4's three numbers.
        if vehicle is not None and (isinstance(mode, str) or not is_px4):
            vehicle.mode = mode
            return
        number: Any = (self.mode_mapping() or {})[mode] if isinstance(mode, str) else mode
        if not is_px4:
            params = (MavModeFlag.CUSTOM_MODE_ENABLED.value, number, 0)
        elif isinstance(mode, str):
            params = number  # three numbers
        else:
            params = (mode, custom_mode or 0, custom_sub_mode or 0)
        self._command(MavCmd.DO_SET_MODE, *params)

    set_mode_apm: Callable[..., None] = set_mode
    set_mode_px4: Callable[..., None] = set_mode

    # -------------------------------------------------------------------------------- orders

    def arducopter_arm(self) -> None:
        """Send the arming command: **propellers may start to turn**."""
        self._command(MavCmd.COMPONENT_ARM_DISARM, 1)

    def arducopter_disarm(self) -> None:
        self._command(MavCmd.COMPONENT_ARM_DISARM, 0)

    def motors_armed(self) -> bool:
        heartbeat = self._heartbeat
        return heartbeat is not None and is_armed(heartbeat.base_mode)

    def motors_armed_wait(self) -> None:
        """Wait, without limit, until HEARTBEAT reports armed motors."""
        while not self.motors_armed():
            self.wait_heartbeat()

    def motors_disarmed_wait(self) -> None:
        """Wait, without limit, until HEARTBEAT reports disarmed motors."""
        while self.motors_armed():
            self.wait_heartbeat()

    def set_servo(self, channel: int, pwm: int) -> None:
        self._command(MavCmd.DO_SET_SERVO, channel, pwm)

    def _command(self, command: int, *params: float) -> None:
        seven_params = (*params, *(0,) * (7 - len(params)))
        confirmation = 0
        self.mav.command_long_send(self.target_system, self.target_component, command, confirmation, *seven_params)

    # ------------------------------------------------------------ raw parameter and mission messages

    def param_fetch_all(self) -> None:
        self.mav.param_request_list_send(self.target_system, self.target_component)

    def param_set_send(self, parm_name: str | bytes, parm_value: float, parm_type: int | None = None) -> None:
        """Send PARAM_SET without waiting for the answer. To wait for it, set ``vehicle.parameters[name]``."""
        param_type = MavParamType.REAL32 if parm_type is None else parm_type
        self.mav.param_set_send(self.target_system, self.target_component, parm_name, parm_value, param_type)

    def waypoint_clear_all_send(self) -> None:
        self.mav.mission_clear_all_send(self.target_system, self.target_component)

    def waypoint_count_send(self, seq: int) -> None:
        """Send MISSION_COUNT, which starts the upload of ``seq`` items."""
        self.mav.mission_count_send(self.target_system, self.target_component, seq)

    def waypoint_request_list_send(self) -> None:
        self.mav.mission_request_list_send(self.target_system, self.target_component)

    def waypoint_request_send(self, seq: int) -> None:
        self.mav.mission_request_send(self.target_system, self.target_component, seq)

    def waypoint_set_current_send(self, seq: int) -> None:
        """Send MISSION_SET_CURRENT, so that the mission continues at an item."""
        self.mav.mission_set_current_send(self.target_system, self.target_component, seq)

    # ----------------------------------------------------------------------------- receiving

    def recv_match(
        self,
        condition: str | None = None,
        type: str | Iterable[str] | None = None,  # noqa: A002 - pymavlink's word
        blocking: bool = False,
        timeout: float | None = None,
    ) -> Any:
        """Return the next message of the given types (None: any) that satisfies pymavlink's ``condition``.

        From the first call on, the last 1,000 messages are stored, each for at most five seconds. If none of them
        matches, return None or, if ``blocking``, wait for ``timeout`` seconds (None: no limit). In both cases, raise
        APIException if the connection is closed. Waiting on the event loop's own thread also raises APIException.
        """
        types = (type,) if isinstance(type, str) else type
        names = None if types is None else set(types)

        def matches(message: Any) -> bool:
            return bool(mavutil.evaluate_condition(condition, {message.get_type(): message}))

        return self.messages.next_match(names, matches, timeout if blocking else 0.0)

    def wait_heartbeat(self, blocking: bool = True, timeout: float | None = None) -> Any:
        """Return the next HEARTBEAT; see :meth:`recv_match` for ``blocking`` and ``timeout``."""
        return self.recv_match(type="HEARTBEAT", blocking=blocking, timeout=timeout)

    def field(self, type: str, field: str, default: Any = None) -> Any:  # noqa: A002 - pymavlink's word
        """Return a field of the last message of a type, or ``default``."""
        return getattr(self.messages.get(type), field, default)

    def time_since(self, mtype: str) -> float:
        """Return the seconds since the last message of a type, or since the first access if there was none."""
        return self.messages.age_s(mtype)

    def param(self, name: str, default: float | None = None) -> float | None:
        """Return the value of a parameter if it is known, otherwise ``default``."""
        vehicle = self._connection.vehicle
        if vehicle is None:
            return default
        value: float | None = vehicle.parameters.get(name, wait_ready=False, default=default)
        return value

    def location(self, relative_alt: bool = False) -> Any:
        """Wait for a 3D GPS fix, and return the vehicle's last location as ``mavutil.location``.

        ``alt`` is in metres above home with ``relative_alt``, otherwise above sea level.
        """
        fix = self.recv_match(condition="GPS_RAW_INT.fix_type>=3", type="GPS_RAW_INT", blocking=True)
        self.recv_match(type="VFR_HUD", blocking=True)  # As in pymavlink, the altitude is from VFR_HUD.
        self.recv_match(type="GLOBAL_POSITION_INT", blocking=True)
        # The matching messages may be seconds old, so use the latest ones.
        gps, hud, position = map(self.messages.__getitem__, ("GPS_RAW_INT", "VFR_HUD", "GLOBAL_POSITION_INT"))
        if gps.fix_type < 3:  # The fix was lost meanwhile.
            gps = fix
        alt = position.relative_alt * 1e-3 if relative_alt else hud.alt
        return mavutil.location(gps.lat * 1e-7, gps.lon * 1e-7, alt, hud.heading)

    @staticmethod
    def probably_vehicle_heartbeat(msg: Any) -> bool:
        """Return True if a HEARTBEAT is from an autopilot, not from a gimbal, camera or ground station."""
        return is_autopilot(msg)

    def _send(self, message: Any) -> None:
        target = self._connection.target_system
        self._connection.send(from_pymavlink(message, target), to=target or None)

    @property
    def _heartbeat(self) -> Heartbeat | None:
        """The last HEARTBEAT of the vehicle's autopilot."""
        for (system_id, _), heartbeat in self._connection.connection.heartbeats.copy().items():
            if system_id == self.target_system and is_autopilot(heartbeat):
                return heartbeat
        return None


class Inbox(Mapping[str, Any]):
    """The last message of every type by name, and a queue of unread messages, as pymavlink objects.

    Messages are stored from the first access on. During the second after this access, a look-up waits until a message
    of the type arrives. Messages of radios and ground stations are included, but not those of other vehicles.
    """

    def __init__(self, connection: ClassicConnection) -> None:
        self._connection = connection
        self._latest: dict[int, Frame] = {}  # last frame by message id
        # Frames that `next_match` has not returned yet, oldest first.
        self._frames: deque[Frame] = deque(maxlen=MAX_MESSAGES)
        self._lock = threading.Lock()  # protects the other attributes
        self._arrived: ThreadFuture[None] = ThreadFuture()  # finished and replaced when a frame arrives
        self._started_at: float | None = None  # time of the first access; None before

    def next_match(self, names: Collection[str] | None, condition: Any, timeout: float | None) -> Any:
        """Return the next message of these types that satisfies ``condition``; see :meth:`Master.recv_match`."""
        self._start()
        deadline = None if timeout is None else time.monotonic() + timeout
        while (frame := self._pop(deadline)) is not None:
            message = message_of(frame)
            if (names is None or message.get_type() in names) and condition(message):
                return message
        return None

    def age_s(self, name: str) -> float:
        """Return the seconds since the last message of this type, or since the first access if there was none."""
        self._start()
        frame = self._latest.get(_id_of(name))
        if frame is None:
            return time.monotonic() - (self._started_at or 0.0)
        return self._connection.connection.now() - frame.received_at

    def __getitem__(self, name: str) -> Any:
        self._start()
        message_id = _id_of(name)
        frame = self._latest.get(message_id)
        while frame is None and self._may_wait():
            self._arrived.wait(SIGNAL_CHECK_INTERVAL_S / 10)  # short, so that `_may_wait` ends the loop in time
            frame = self._latest.get(message_id)
        if frame is None:
            raise KeyError(name)
        return message_of(frame)

    def __iter__(self) -> Iterator[str]:
        self._start()
        return iter([message_of(frame).get_type() for frame in self._latest.copy().values()])

    def __len__(self) -> int:
        self._start()
        return len(self._latest)

    def _start(self) -> None:
        with self._lock:
            if self._started_at is not None:
                return
            self._started_at = time.monotonic()
        loop, observe_frames = self._connection.loop, self._connection.connection.observe_frames
        if loop.is_current:
            observe_frames(weak_callback(self._on_frame))
        else:
            # This blocks until the observer is attached, so that no later message is missed.
            loop.call(observe_frames, weak_callback(self._on_frame))

    def _may_wait(self) -> bool:
        is_young = self._started_at is not None and time.monotonic() < self._started_at + FIRST_LOOKUP_TIMEOUT_S
        return is_young and self._connection.connection.is_open and not self._connection.loop.is_current

    def _on_frame(self, frame: Frame, peer: Peer) -> None:
        # This runs on the loop's thread.
        if self._connection.is_of_another_vehicle(frame.system_id):
            return
        with self._lock:
            self._latest[frame.message_id] = frame
            self._frames.append(frame)
            arrived, self._arrived = self._arrived, ThreadFuture()
            arrived.finish()

    def _pop(self, deadline: float | None) -> Frame | None:
        """Remove and return the oldest stored frame. If there is none until the deadline, return None."""
        now = self._connection.connection.now
        while True:
            with self._lock:
                while self._frames:
                    frame = self._frames.popleft()
                    if now() - frame.received_at < MESSAGE_MAX_AGE_S:
                        return frame
                self._raise_if_closed()
                wait_s = SIGNAL_CHECK_INTERVAL_S
                if deadline is not None:
                    wait_s = min(wait_s, deadline - time.monotonic())
                if wait_s <= 0:
                    return None
                arrived = self._arrived
            with classic_errors():
                self._connection.loop.check_may_wait()
            arrived.wait(wait_s)

    def _raise_if_closed(self) -> None:
        if self._connection.is_closed or not self._connection.connection.is_open:
            raise APIException("the connection was closed")


def _id_of(name: str) -> int:
    try:
        return STANDARD.by_name(name).ID
    except InvalidArgument:
        raise KeyError(name) from None
