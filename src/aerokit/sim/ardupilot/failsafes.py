"""What a simulated ArduPilot does by itself: the part that all kinds of vehicles share."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, ClassVar

from aerokit.mavlink.enums import MavSeverity
from aerokit.sim.ardupilot.battery_failsafe import BatteryFailsafe

if TYPE_CHECKING:
    from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle

__all__ = ["Failsafes"]

_PERIOD_S = 0.1


class Failsafes:
    """`watch` is called ten times a second; each failsafe acts once when it starts and says so.

    A kind of vehicle says in `watch` what it looks at, and in `act_on_battery` what its numbers mean.
    """

    BATTERY_PRIORITIES: ClassVar[tuple[int, ...]] = ()
    """Actions of BATT_FS_LOW_ACT and BATT_FS_CRT_ACT, the gravest first."""

    def __init__(self, vehicle: ArduPilotVehicle) -> None:
        self._vehicle = vehicle
        self.battery: BatteryFailsafe = BatteryFailsafe(vehicle, self.BATTERY_PRIORITIES, self.act_on_battery)
        self.ground_station = False
        self.estimator = False
        self.radio = False
        """Whether the pilot's radio counts as lost; it is not armed then."""
        self.ground_station_seen_at: float = math.nan
        """When the last heartbeat of the ground station MAV_GCS_SYSID came."""
        self.radio_heard_at: float = math.nan
        """When the last pulses of the radio came, or what RC_CHANNELS_OVERRIDE put in their place."""

    def start(self) -> None:
        """Watch from now on."""
        self._vehicle.every(_PERIOD_S, self.watch)

    @property
    def battery_is_low(self) -> bool:
        """Whether the battery was low, or worse, while the vehicle was armed."""
        return self.battery.level > 0

    @property
    def battery_is_critical(self) -> bool:
        """Whether the battery was critical while the vehicle was armed."""
        return self.battery.level > 1

    @property
    def is_any_active(self) -> bool:
        """Whether the vehicle reports a critical state."""
        return self.battery_is_low or self.ground_station or self.estimator or self.radio

    @property
    def hears_radio(self) -> bool:
        """Whether SYS_STATUS calls the radio healthy."""
        return not self.radio

    @property
    def ground_station_silence(self) -> float:
        """Seconds since the ground station was heard last; NaN before the first time, which is more than nothing."""
        return self._vehicle.now - self.ground_station_seen_at

    def watch(self) -> None:
        """Look at everything once: here at battery and fence."""
        self.battery.update()
        self._vehicle.fence.update()

    def act_on_battery(self, action: int) -> None:
        """Do what BATT_FS_LOW_ACT or BATT_FS_CRT_ACT says."""
        raise NotImplementedError

    def say(self, text: str, severity: int = MavSeverity.WARNING) -> None:
        """Send a status text."""
        self._vehicle.send_text(severity, text)

    def change_to(self, *modes: int) -> bool:
        """Go into the first of these modes that can be entered; whether there is one."""
        return any(self._vehicle.set_mode(mode) for mode in modes)
