"""The API reference of DroneKit 2.9 as data: its names and signatures, and its examples in the spelling of Python 3.

Errors of the reference are corrected: a listener with two arguments, a latitude that a comma makes a tuple, a message
that was removed from all dialects.
"""

from __future__ import annotations

from typing import Any

__all__ = ["ATTRIBUTES", "EXAMPLES", "MODULE_NAMES", "OTHER_NAMES", "SIGNATURES", "SUBCLASSES"]

MODULE_NAMES = (
    *("APIException", "Attitude", "Battery", "Capabilities", "Channels", "ChannelsOverride", "Command"),
    *("CommandSequence", "ErrprinterHandler", "GPSInfo", "Gimbal", "HasObservers", "LocationGlobal"),
    *("LocationGlobalRelative", "LocationLocal", "Locations", "Parameters", "Rangefinder", "SystemStatus"),
    *("TimeoutError", "Vehicle", "VehicleMode", "Version", "ardupilotmega", "basestring", "collections"),
    *("connect", "copy", "default_still_waiting_callback", "logging", "math", "mavutil", "mavwp"),
    *("monotonic", "struct", "time", "util"),
)
"""All names of the module of DroneKit 2.9.2, intended or not."""

OTHER_NAMES = {
    "lib": MODULE_NAMES,
    "mavlink": ("APIException", "MAVConnection", "MAVWriter", "mavudpin_multi"),
    "util": ("ErrprinterHandler", "errprinter", "logger"),
}

SUBCLASSES = [
    ("TimeoutError", "APIException"),
    ("Locations", "HasObservers"),
    ("Parameters", "HasObservers"),
    ("Vehicle", "HasObservers"),
]

OBSERVERS: dict[str, dict[str, Any]] = {
    "add_attribute_listener": {"attr_name": ..., "observer": ...},
    "remove_attribute_listener": {"attr_name": ..., "observer": ...},
    "on_attribute": {"name": ...},
    "notify_attribute_listeners": {"attr_name": ..., "value": ..., "cache": False},
}
COMMAND = "target_system target_component seq frame command current autocontinue param1 param2 param3 param4 x y z"

SIGNATURES: dict[str, dict[str, Any]] = {
    "APIException": {"message": ...},
    "Attitude": {"pitch": ..., "yaw": ..., "roll": ...},
    "Battery": {"voltage": ..., "current": ..., "level": ...},
    "Capabilities": {"capabilities": ...},
    "Channels": {"vehicle": ..., "count": ...},
    "ChannelsOverride": {"vehicle": ...},
    "Command": dict.fromkeys(COMMAND.split(), ...),
    "CommandSequence": {"vehicle": ...},
    "CommandSequence.add": {"cmd": ...},
    "CommandSequence.clear": {},
    "CommandSequence.download": {},
    "CommandSequence.upload": {"timeout": None},
    "CommandSequence.wait_ready": {},
    "GPSInfo": {"eph": ..., "epv": ..., "fix_type": ..., "satellites_visible": ...},
    "Gimbal": {"vehicle": ...},
    "Gimbal.release": {},
    "Gimbal.rotate": {"pitch": ..., "roll": ..., "yaw": ...},
    "Gimbal.target_location": {"roi": ...},
    "LocationGlobal": {"lat": ..., "lon": ..., "alt": None},
    "LocationGlobalRelative": {"lat": ..., "lon": ..., "alt": None},
    "LocationLocal": {"north": ..., "east": ..., "down": ...},
    "LocationLocal.distance_home": {},
    "Locations": {"vehicle": ...},
    "Parameters": {"vehicle": ...},
    "Parameters.get": {"name": ..., "wait_ready": True},
    "Parameters.set": {"name": ..., "value": ..., "retries": 3, "wait_ready": False},
    "Parameters.wait_ready": {},
    "Rangefinder": {"distance": ..., "voltage": ...},
    "SystemStatus": {"state": ...},
    "Vehicle": {"handler": ...},
    "Vehicle.add_message_listener": {"name": ..., "fn": ...},
    "Vehicle.arm": {"wait": True, "timeout": None},
    "Vehicle.close": {},
    "Vehicle.disarm": {"wait": True, "timeout": None},
    "Vehicle.flush": {},
    "Vehicle.initialize": {"rate": 4, "heartbeat_timeout": 30},
    "Vehicle.notify_message_listeners": {"name": ..., "msg": ...},
    "Vehicle.on_message": {"name": ...},
    "Vehicle.play_tune": {"tune": ...},
    "Vehicle.reboot": {},
    "Vehicle.remove_message_listener": {"name": ..., "fn": ...},
    "Vehicle.send_calibrate_accelerometer": {"simple": False},
    "Vehicle.send_calibrate_barometer": {},
    "Vehicle.send_calibrate_gyro": {},
    "Vehicle.send_calibrate_magnetometer": {},
    "Vehicle.send_calibrate_vehicle_level": {},
    "Vehicle.send_capabilities_request": {"vehicle": ..., "name": ..., "m": ...},
    "Vehicle.send_capabilties_request": {"vehicle": ..., "name": ..., "m": ...},
    "Vehicle.send_mavlink": {"message": ...},
    "Vehicle.simple_goto": {"location": ..., "airspeed": None, "groundspeed": None},
    "Vehicle.simple_takeoff": {"alt": None},
    "Vehicle.wait_for": {"condition": ..., "timeout": None, "interval": 0.1, "errmsg": None},
    "Vehicle.wait_for_alt": {"alt": ..., "epsilon": 0.1, "rel": True, "timeout": None},
    "Vehicle.wait_for_armable": {"timeout": None},
    "Vehicle.wait_for_mode": {"mode": ..., "timeout": None},
    "Vehicle.wait_simple_takeoff": {"alt": None, "epsilon": 0.1, "timeout": None},
    "VehicleMode": {"name": ...},
    "Version": {"raw_version": ..., "autopilot_type": ..., "vehicle_type": ...},
    "Version.is_stable": {},
    "Version.release_type": {},
    "Version.release_version": {},
    "connect": {
        "ip": ...,
        "_initialize": True,
        "wait_ready": None,
        "timeout": 30,
        "still_waiting_callback": "default_still_waiting_callback",
        "still_waiting_interval": 1,
        "status_printer": None,
        "vehicle_class": None,
        "rate": 4,
        "baud": 115200,
        "heartbeat_timeout": 30,
        "source_system": 255,
        "source_component": 0,
        "use_native": False,
    },
    "default_still_waiting_callback": {"atts": ...},
    "mavlink.MAVConnection": {
        "ip": ...,
        "baud": 115200,
        "target_system": 0,
        "source_system": 255,
        "source_component": 0,
        "use_native": False,
    },
    "mavlink.MAVConnection.close": {},
    "mavlink.MAVConnection.fix_targets": {"message": ...},
    "mavlink.MAVConnection.forward_loop": {"fn": ...},
    "mavlink.MAVConnection.forward_message": {"fn": ...},
    "mavlink.MAVConnection.pipe": {"target": ...},
    "mavlink.MAVConnection.reset": {},
    "mavlink.MAVConnection.start": {},
    "mavlink.MAVConnection.stop_threads": {},
    **{f"{owner}.{name}": observer for owner in ("Vehicle", "Locations") for name, observer in OBSERVERS.items()},
}
"""Arguments in their order, with their defaults; ``...`` where there is none."""

ATTRIBUTES = {
    "Attitude": "pitch yaw roll",
    "Battery": "voltage current level",
    "Channels": "count overrides",
    "CommandSequence": "count next",
    "GPSInfo": "eph epv fix_type satellites_visible",
    "Gimbal": "pitch roll yaw",
    "LocationGlobal": "lat lon alt",
    "LocationGlobalRelative": "lat lon alt",
    "LocationLocal": "north east down",
    "Locations": "global_frame global_relative_frame local_frame",
    "Rangefinder": "distance voltage",
    "SystemStatus": "state",
    "Vehicle": """
        airspeed armed attitude battery capabilities channels commands ekf_ok gimbal gps_0 groundspeed heading
        home_location is_armable last_heartbeat location message_factory mode mount_status parameters rangefinder
        system_status velocity version
    """,
    "VehicleMode": "name",
    "Version": "major minor patch release raw_version autopilot_type vehicle_type",
}

EXAMPLES = {
    "overrides": """
        # Set and clear overrids using dictionary syntax (clear by setting override to none)
        vehicle.channels.overrides = {'5':None, '6':None,'3':500}
        vehicle.channels.overrides['2'] = 200
        print(" Channel overrides: %s" % vehicle.channels.overrides)
        print(" Ch2 override: %s" % vehicle.channels.overrides['2'])
        vehicle.channels.overrides['2'] = None
        del vehicle.channels.overrides['3']
        vehicle.channels.overrides = {}
    """,
    "command": """
        cmd = Command(0,0,0, mavutil.mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT,
            mavutil.mavlink.MAV_CMD_NAV_WAYPOINT, 0, 0, 0, 0, 0, 0,-34.364114, 149.166022, 30)
        print(cmd.command)
    """,
    "mission": """
        cmds = vehicle.commands
        cmds.download()
        cmds.wait_ready()
        print(vehicle.home_location)
        cmds.clear()
        lat = -34.364114
        lon = 149.166022
        altitude = 30.0
        cmd = Command(0,0,0, mavutil.mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT, mavutil.mavlink.MAV_CMD_NAV_WAYPOINT,
            0, 0, 0, 0, 0, 0,
            lat, lon, altitude)
        cmds.add(cmd)
        cmds.upload()
        print(len(cmds))
    """,
    "gimbal": """
        vehicle.gimbal.rotate(-90, 0, 0)
        vehicle.gimbal.target_location(vehicle.home_location)
        vehicle.gimbal.release()
    """,
    "location": """
        print("Global Location: %s" % vehicle.location.global_frame)
        print("Global Location (relative altitude): %s" % vehicle.location.global_relative_frame)
        print("Local Location: %s" % vehicle.location.local_frame)    #NED
        print("Altitude (global frame): %s" % vehicle.location.global_frame.alt)
        print("Altitude (global relative frame): %s" % vehicle.location.global_relative_frame.alt)
        print("Altitude (NED frame): %s" % vehicle.location.local_frame.down)
    """,
    "location listeners": """
        def location_callback(self, attr_name, msg):
            print("Location (Global): ", msg)
        vehicle.add_attribute_listener('global_frame', location_callback)

        @vehicle.on_attribute('location.global_frame')
        def listener(self, attr_name, value):
            print(" Global: %s" % value)

        @vehicle.location.on_attribute('global_frame')
        def listener(self, attr_name, value):
            print(" %s: %s" % (attr_name, value))

        @vehicle.on_attribute('location')
        def listener(self, attr_name, value):
            print(" Global: %s" % value.global_frame)
            print(" GlobalRelative: %s" % value.global_relative_frame)
            print(" Local: %s" % value.local_frame)

        move()
        vehicle.remove_attribute_listener('global_frame', location_callback)
    """,
    "attitude listener": """
        @vehicle.on_attribute('attitude')
        def attitude_listener(self, name, msg):
            print('%s attribute is: %s' % (name, msg))
        tilt()
    """,
    "parameters": """
        print("Param: %s" % vehicle.parameters['THR_MIN'])
        def thr_min_callback(self, attr_name, value):
            print(" PARAMETER CALLBACK: %s changed to: %s" % (attr_name, value))
        vehicle.parameters.add_attribute_listener('THR_MIN', thr_min_callback)

        @vehicle.parameters.on_attribute('THR_MIN')
        def decorated_thr_min_callback(self, attr_name, value):
            print(" PARAMETER CALLBACK: %s changed to: %s" % (attr_name, value))

        vehicle.parameters['THR_MIN']=100
        settle()
        vehicle.parameters.remove_attribute_listener('thr_min', thr_min_callback)
        vehicle.parameters['THR_MIN']=110
        settle()
    """,
    "logging": """
        import logging
        autopilot_logger = logging.getLogger('autopilot')
        autopilot_logger.setLevel(logging.DEBUG)
        autopilot_logger.setLevel(logging.NOTSET)
    """,
    "message listeners": """
        def my_method(self, name, msg):
            print(name, msg.custom_mode)
        vehicle.add_message_listener('HEARTBEAT',my_method)
        fence()
        beat()
        vehicle.remove_message_listener('HEARTBEAT',my_method)

        @vehicle.on_message('HEARTBEAT')
        def my_method(self, name, msg):
            print("decorated", name)
        fence()
        beat()
    """,
    "armed": """
        print("Armed: %s" % vehicle.armed)
        vehicle.armed = False
        vehicle.armed = True
        vehicle.wait_for(lambda: vehicle.armed, timeout=100)
        print("Armed: %s" % vehicle.armed)
    """,
    "channels": """
        print("Channel values from RC Tx:", vehicle.channels)
        print(" Ch1: %s" % vehicle.channels['1'])
        print(" Ch2: %s" % vehicle.channels['2'])
    """,
    "heartbeat": """
        pause_script=False
        @vehicle.on_attribute('last_heartbeat')
        def listener(self, attr_name, value):
            global pause_script
            if value > 1 and not pause_script:
                print("Pausing script due to bad link")
                pause_script=True;
            if value < 1 and pause_script:
                pause_script=False;
                print("Un-pausing script")
        print(vehicle.last_heartbeat < 1)
    """,
    "messages": """
        msg = vehicle.message_factory.command_long_encode(
            0, 0, mavutil.mavlink.MAV_CMD_CONDITION_YAW, 0, 90, 0, 1, 0, 0, 0, 0)
        vehicle.send_mavlink(msg)
    """,
    "modes": """
        vehicle.mode = VehicleMode('LOITER')
        vehicle.mode = 'LOITER'
        vehicle.mode = 5
        vehicle.wait_for(lambda: vehicle.mode == 'LOITER', timeout=100)
        print(vehicle.mode.name)
    """,
    "mode listener": """
        def mode_callback(self, attr_name, value):
            print("Vehicle Mode", self.mode)
        vehicle.add_attribute_listener('mode', mode_callback)
        vehicle.mode = VehicleMode("AUTO")
        vehicle.wait_for(lambda: vehicle.mode.name == 'AUTO', timeout=100)
        settle()
    """,
    "goto": """
        vehicle.mode = VehicleMode("GUIDED")
        vehicle.wait_for(lambda: vehicle.mode.name == 'GUIDED', timeout=100)
        a_location = LocationGlobal(-34.364114, 149.166022, 30)
        vehicle.simple_goto(a_location)
    """,
    "ready": """
        vehicle.wait_ready(True)
        vehicle.wait_ready('mode','airspeed')
        print("ready")
    """,
}
"""They run with a program's imports, ``vehicle``, and functions that make the flight controller send messages."""
