"""Servos, relays and switches of a simulated ArduPilot that nothing else uses."""

from __future__ import annotations

from aerokit.mavlink.enums import MavResult, MavSeverity
from aerokit.sim.ardupilot.host import Host
from aerokit.sim.ardupilot.kinds import Kind
from aerokit.sim.commands import Command, whole

_SERVOS = 32
_RELAYS = {"rover": 2}
_FUNCTIONS = 320
_SAVE_WAYPOINT = 7
_NOT_THERE: dict[Kind, tuple[int, ...]] = {
    "copter": (0,),
    "plane": (0, _SAVE_WAYPOINT),
    "rover": (),
    "sub": (0, _SAVE_WAYPOINT),
}
"""RC options that were refused, of those that were tried."""
_FREE_FUNCTIONS = frozenset({0, 1, *range(51, 67)})
_AUX_POSITIONS = (0.0, 1.0, 2.0)


class Accessories:
    """What DO_SET_SERVO, DO_SET_RELAY and DO_AUX_FUNCTION set; a reboot forgets it."""

    def __init__(self, vehicle: Host) -> None:
        self._vehicle = vehicle
        self.servos: dict[int, int] = {}
        """Output, from 1 on → its pulse in microseconds."""
        self.relays: int = 0
        """A bit for each that is on."""
        self.functions: dict[int, int] = {}
        """RC option → position of its switch: 0 low, 1 middle, 2 high."""

    @property
    def relay_count(self) -> int:
        """How many relays there are."""
        return _RELAYS.get(self._vehicle.KIND, 1)

    def is_free(self, output: int) -> bool:
        """Whether an output has no function (SERVOn_FUNCTION), or follows a stick."""
        name, parameters = f"SERVO{output}_FUNCTION", self._vehicle.parameters
        return name not in parameters or parameters[name] in _FREE_FUNCTIONS

    def set_servo(self, command: Command) -> int:
        """DO_SET_SERVO, and DO_REPEAT_SERVO, of which only the first pulse is simulated."""
        output = whole(command.param1)
        if not 1 <= output <= _SERVOS:
            return MavResult.FAILED
        if not self.is_free(output):
            self._vehicle.info(f"ServoRelayEvent: Channel {output} is already in use")
            return MavResult.FAILED
        self.servos[output] = whole(command.param2)
        return MavResult.ACCEPTED

    def set_relay(self, command: Command) -> int:
        """DO_SET_RELAY."""
        if not 0 <= command.param1 < self.relay_count:
            return MavResult.FAILED
        bit = 1 << whole(command.param1)
        self.relays = self.relays | bit if command.param2 else self.relays & ~bit
        return MavResult.ACCEPTED

    def repeat_relay(self, command: Command) -> int:
        """DO_REPEAT_RELAY: it is back where it was when it is over, and that is all."""
        known = 0 <= command.param1 < self.relay_count
        return MavResult.ACCEPTED if known else MavResult.FAILED

    def switch(self, command: Command) -> int:
        """DO_AUX_FUNCTION is heard; what the function does is not simulated."""
        function = whole(command.param1)
        if command.param2 not in _AUX_POSITIONS:
            return MavResult.DENIED
        if not 0 <= function < _FUNCTIONS or function in _NOT_THERE[self._vehicle.KIND]:
            self._vehicle.send_text(MavSeverity.INFO, f"Invalid channel option ({function})")
            return MavResult.FAILED
        self.functions[function] = whole(command.param2)
        return MavResult.ACCEPTED
