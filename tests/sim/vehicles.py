"""Simulated planes, rovers and submarines in the states that tests of failsafes and modes start from."""

from __future__ import annotations

from simulated_client import Client, set_mode

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd, PlaneMode, RoverMode, SubMode
from aerokit.missions import MissionItem
from aerokit.sim import SimulatedPlane, SimulatedRover, SimulatedSub
from aerokit.sim.ardupilot.vehicle import ArduPilotVehicle

ARM = MavCmd.COMPONENT_ARM_DISARM
GROUND_STATION = m.Heartbeat(6, 8, 0, 0, 4, 3)


def ready(vehicle: ArduPilotVehicle) -> Client:
    """Boot the vehicle until it has a position."""
    client = Client(vehicle)
    client.run(3.0)
    client.clear()
    return client


def arm(client: Client, mode: int) -> None:
    assert set_mode(client, mode) == 0
    assert client.command(ARM, 1) == 0


def ready_plane(**parameters: float) -> tuple[SimulatedPlane, Client]:
    plane = SimulatedPlane(boot_time_s=0.0, parameters=parameters)
    return plane, ready(plane)


def flying_plane(mode: int = PlaneMode.LOITER, /, **parameters: float) -> tuple[SimulatedPlane, Client]:
    """Return a plane 50 m above the ground in this mode."""
    plane, client = ready_plane(**parameters)
    arm(client, PlaneMode.TAKEOFF)
    client.run_until(lambda: plane.altitude_m > 45.0 and not plane.mode.is_taking_off)
    plane.rc[2] = 1500
    if mode != PlaneMode.TAKEOFF:
        assert set_mode(client, mode) == 0
    client.run(0.1)
    client.clear()
    return plane, client


def ready_rover(**parameters: float) -> tuple[SimulatedRover, Client]:
    rover = SimulatedRover(boot_time_s=0.0, parameters=parameters)
    return rover, ready(rover)


def driving_rover(north: float = 200.0, east: float = 0.0, /, **parameters: float) -> tuple[SimulatedRover, Client]:
    """Return a rover in GUIDED that drives to a position."""
    rover, client = ready_rover(**parameters)
    arm(client, RoverMode.GUIDED)
    rover.guided.go_to((north, east, 0.0))
    client.run(1.0)
    client.clear()
    return rover, client


def ready_sub(**parameters: float) -> tuple[SimulatedSub, Client]:
    sub = SimulatedSub(boot_time_s=0.0, parameters=parameters)
    return sub, ready(sub)


def armed_sub(mode: int = SubMode.ALT_HOLD, /, **parameters: float) -> tuple[SimulatedSub, Client]:
    """Return an armed submarine five metres deep."""
    sub, client = ready_sub(**parameters)
    sub.motion.down = 5.0
    arm(client, mode)
    client.run(0.5)
    client.clear()
    return sub, client


def lose_ground_station(client: Client, seconds: float) -> None:
    """Send a last heartbeat, then stay silent."""
    client.send(GROUND_STATION)
    client.run(seconds)


def drain(vehicle: ArduPilotVehicle, client: Client, percent: float) -> None:
    """Set the charge for longer than BATT_LOW_TIMER of these tests."""
    vehicle.battery.percent = percent
    client.run(3.0)


BATTERY = {"BATT_LOW_VOLT": 10.5, "BATT_CRT_VOLT": 9.5, "BATT_LOW_TIMER": 2.0}
# Per cent of charge below which the voltage is low or critical.
LOW, CRITICAL = 10.0, 2.0


def healthy(client: Client, bit: int) -> bool:
    """Return True if SYS_STATUS reports this sensor as healthy."""
    client.command(MavCmd.REQUEST_MESSAGE, m.SysStatus.ID)
    client.run(0.1)
    return bool(client.last(m.SysStatus).onboard_control_sensors_health & bit)


def rally_points(vehicle: ArduPilotVehicle, *places: tuple[float, float, float]) -> None:
    """Places are metres north and east of the start, and metres above home."""
    points = vehicle.missions.rally
    points.clear()
    for index, (north, east, height) in enumerate(places):
        place = vehicle.frame.to_global(north, east, 0.0)
        item = MissionItem(MavCmd.NAV_RALLY_POINT, 3, x=place.latitude_e7, y=place.longitude_e7, z=height)
        points.put(index, item, len(places) - 1)
