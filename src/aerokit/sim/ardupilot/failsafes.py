"""What an ArduCopter does by itself: battery, ground station and estimator failsafes, automatic disarming."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.mavlink.enums import CopterMode, MavSeverity

if TYPE_CHECKING:
    from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle

__all__ = ["Failsafes"]

_PERIOD_S = 0.1
_ESTIMATOR_PATIENCE_S = 1.0
_DISABLED, _RTL, _SMART_RTL, _LAND = 0, 1, 3, 5
_LAND_ON_BATTERY, _RTL_ON_BATTERY = 1, 2


class Failsafes:
    """Checked ten times a second; each acts once when it starts and says so.

    Of the actions that can be configured these are simulated: nothing, LAND, RTL, and SMART_RTL as RTL.
    """

    def __init__(self, vehicle: ArduPilotVehicle) -> None:
        self._vehicle = vehicle
        self.battery_is_low = self.battery_is_critical = False
        self.ground_station = False
        self.estimator = False
        self.radio = False
        """Whether the pilot's radio counts as lost."""
        self.ground_station_seen_at = math.nan
        """When the last heartbeat of the ground station MAV_GCS_SYSID came."""
        self._low_since = math.nan
        self._bad_since = math.nan
        self._idle_since = math.nan

    def start(self) -> None:
        """Watch from now on."""
        self._vehicle.every(_PERIOD_S, self._check)

    @property
    def is_any_active(self) -> bool:
        """Whether the vehicle reports a critical state."""
        return self.battery_is_low or self.ground_station or self.estimator

    def _check(self) -> None:
        self._check_battery()
        self._check_ground_station()
        self._check_estimator()
        self._check_idling()

    def _check_battery(self) -> None:
        vehicle, parameters = self._vehicle, self._vehicle.parameters
        low_v, low_mah = parameters["BATT_LOW_VOLT"], parameters["BATT_LOW_MAH"]
        battery = vehicle.battery
        left_mah = parameters["BATT_CAPACITY"] - battery.consumed_mah
        if not ((low_v > 0 and battery.voltage_v < low_v) or (low_mah > 0 and left_mah < low_mah)):
            self._low_since = math.nan
            return
        if math.isnan(self._low_since):
            self._low_since = vehicle.now
        if self.battery_is_low or vehicle.now - self._low_since < parameters["BATT_LOW_TIMER"]:
            return
        self.battery_is_low = True
        used = f"{battery.voltage_v:.2f}V used {battery.consumed_mah:.0f} mAh"
        vehicle.send_text(MavSeverity.WARNING, f"Battery 1 is low {used}")
        action = int(parameters["BATT_FS_LOW_ACT"])
        modes = {_LAND_ON_BATTERY: CopterMode.LAND, _RTL_ON_BATTERY: CopterMode.RTL}
        self._act("Battery", modes.get(action))

    def _check_ground_station(self) -> None:
        vehicle, parameters = self._vehicle, self._vehicle.parameters
        action = int(parameters["FS_GCS_ENABLE"])
        if action == _DISABLED or math.isnan(self.ground_station_seen_at):
            return
        lost = vehicle.now - self.ground_station_seen_at > parameters["FS_GCS_TIMEOUT"]
        if lost and not self.ground_station:
            self.ground_station = True
            modes = {_RTL: CopterMode.RTL, _SMART_RTL: CopterMode.RTL, _LAND: CopterMode.LAND}
            self._act("GCS", modes.get(action))
        elif not lost and self.ground_station:
            self.ground_station = False
            vehicle.send_text(MavSeverity.WARNING, "GCS Failsafe Cleared")

    def _act(self, name: str, mode: int | None) -> None:
        vehicle = self._vehicle
        if not vehicle.motors.is_armed:
            return
        if vehicle.is_landed:
            vehicle.send_text(MavSeverity.WARNING, f"{name} Failsafe - Disarming")
            vehicle.arming.disarm()
            return
        vehicle.send_text(MavSeverity.WARNING, f"{name} Failsafe")
        if mode is not None and not vehicle.set_mode(mode):
            vehicle.set_mode(CopterMode.LAND)

    def _check_estimator(self) -> None:
        vehicle = self._vehicle
        good = vehicle.navigation.has_position
        if self.estimator and good:
            self.estimator = False
            vehicle.send_text(MavSeverity.CRITICAL, "EKF Failsafe Cleared")
        if good or not vehicle.motors.is_armed or not vehicle.mode.needs_position:
            self._bad_since = math.nan
            return
        if math.isnan(self._bad_since):
            self._bad_since = vehicle.now
            vehicle.send_text(MavSeverity.CRITICAL, "EKF variance")
        if not self.estimator and vehicle.now - self._bad_since >= _ESTIMATOR_PATIENCE_S:
            self.estimator = True
            vehicle.set_mode(CopterMode.LAND)
            vehicle.send_text(MavSeverity.CRITICAL, f"EKF Failsafe: changed to {vehicle.mode.name} Mode")

    def _check_idling(self) -> None:
        """DISARM_DELAY: an armed vehicle that idles on the ground is disarmed."""
        vehicle, delay = self._vehicle, self._vehicle.parameters["DISARM_DELAY"]
        idles = vehicle.motors.is_armed and vehicle.is_landed and vehicle.motors.is_idle
        if not idles or delay <= 0:
            self._idle_since = math.nan
        elif math.isnan(self._idle_since):
            self._idle_since = vehicle.now
        elif vehicle.now - self._idle_since >= delay:
            vehicle.arming.disarm()
